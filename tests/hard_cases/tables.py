"""Expansions of the phase."""

from functools import partial

import jax.numpy as jnp
import numpy as np

from diffopt.kernels import expansions, phase
from hard_cases.base import LD, PI, Hard, polynomials


def _coefficients(x, terms):
    n = np.arange(terms)
    return np.concatenate([[LD(1)], np.cumprod(x / n[1:])])


def _lowrank(x, z=0.0, t=1.0):
    """cos(z x t) + sin(z x t) by the low-rank expansion: even and odd terms."""
    series = expansions.lowrank_series(jnp.asarray(z, x.dtype), 16)
    nodes = series.shape[1]
    points = phase.chebyshev_points(nodes, x.dtype)
    values = jnp.cos(z * t * points) + jnp.sin(z * t * points)
    matrix = series @ expansions.chebyshev_projection(nodes, x.dtype)
    return expansions.coefficients(x, 16, series) @ (matrix @ values)


def _interval(low, high, span):
    size = 1 + abs(low + high) / 2
    return (low + high) / 2, max((high - low) / 2, size / max(LD(1), 2 * PI * span * size))


def series():
    for x in (0.0, -10.0, 1e-20):
        yield Hard(
            "expansions.taylor_coefficients",
            f"x={x}",
            lambda x: expansions.taylor_coefficients(x, 30),
            (x,),
            lambda x: _coefficients(x, 30),
            ulps=40,
        )
    for low, high, span in ((-5.0, -1.0, 9.0), (-3.0, -3.0, 0.1), (0.0, 0.0, 0.0)):
        yield Hard(
            "expansions.interval",
            f"{low}, {high}, {span}",
            expansions.interval,
            (low, high, span),
            _interval,
            smooth=False,
        )
    yield Hard(
        "expansions.chebyshev_projection",
        "a parabola",
        lambda f: expansions.chebyshev_projection(5, f.dtype) @ f,
        (np.cos(np.pi * (np.arange(5) + 0.5) / 5) ** 2,),
        lambda f: np.array(
            [
                (2 if n else 1) * (f * np.cos(n * PI * (np.arange(5) + LD(0.5)) / 5)).mean()
                for n in range(5)
            ]
        ),
    )
    for x in (0.0, -1.0, 1.0, 0.3):
        yield Hard(
            "expansions.coefficients",
            f"x={x}",
            partial(expansions.coefficients, terms=9),
            (x,),
            lambda x: polynomials(x, 9),
            ulps=100,
            gradient_ulps=1e4,
        )
        for z in (0.0, 1e-8, 3.0) if x in (-1.0, 0.3) else ():
            yield Hard(
                "expansions.lowrank_series",
                f"x={x}, z={z}",
                partial(_lowrank, z=z, t=0.7),
                (x,),
                lambda x, z=z: np.cos(LD(z) * LD(0.7) * x) + np.sin(LD(z) * LD(0.7) * x),
                # sums of 30 products, their slopes up to 30^2 times as large
                ulps=100,
                gradient_ulps=1e4,
            )
