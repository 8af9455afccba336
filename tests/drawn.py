"""Properties that hold for every argument: random cases by hypothesis, one test each.

A case is drawn as a seed and a few numbers; arrays of many values come from the seed, with fixed
shapes, so that what is compiled once serves all cases. Without ``--long`` the cases are the same
every time.
"""

import inspect

import hypothesis
import numpy as np
from hypothesis import strategies

SEEDS = strategies.integers(0, 2**32 - 1)
QUICK, MANY = 25, 1000


def every(**drawn):
    """A test that a property holds, from a function of a seed (and a dtype) and what is drawn."""

    def made(check):
        names = inspect.signature(check).parameters
        fixed = [name for name in ("dtype",) if name in names]

        def run(long, **given):
            options = hypothesis.settings(
                max_examples=MANY if long else QUICK,
                derandomize=not long,
                deadline=None,
                database=None,
                suppress_health_check=list(hypothesis.HealthCheck),
                # A smaller seed is no simpler case.
                phases=(hypothesis.Phase.explicit, hypothesis.Phase.generate),
                report_multiple_bugs=False,
            )
            case = options(
                hypothesis.given(seed=SEEDS, **drawn)(lambda **case: check(**case, **given))
            )
            case()

        if fixed:

            def test(long, dtype):
                run(long, dtype=dtype)
        else:

            def test(long):
                run(long)

        test.__name__, test.__doc__, test.__module__ = (
            check.__name__,
            check.__doc__,
            check.__module__,
        )
        return test

    return made


def exponents(low, high):
    """Numbers spread evenly over the orders of magnitude."""
    return strategies.floats(low, high).map(lambda x: 10.0**x)


def spread(seed, count, low, high, *ends):
    """Positive numbers, evenly over the orders of magnitude from low to high; the ends first."""
    rng = np.random.default_rng(seed)
    found = 10.0 ** rng.uniform(np.log10(low), np.log10(high), count)
    found[: len(ends)] = ends
    return found


def unit(seed, count, *, upper=False, least=0.0):
    """Unit vectors [count, 3], evenly over the sphere or its upper half, z >= least there."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(least if upper else -1.0, 1.0, count)
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    sin = np.sqrt((1.0 - z) * (1.0 + z))
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), z], -1)


def rotation(seed):
    """One matrix, evenly over all rotations."""
    a, b, c, d = (q := np.random.default_rng(seed).normal(size=4)) / np.sqrt(q @ q)
    return np.array(
        [
            [1 - 2 * (c * c + d * d), 2 * (b * c - a * d), 2 * (b * d + a * c)],
            [2 * (b * c + a * d), 1 - 2 * (b * b + d * d), 2 * (c * d - a * b)],
            [2 * (b * d - a * c), 2 * (c * d + a * b), 1 - 2 * (b * b + c * c)],
        ]
    )
