"""Hard inputs of the kernels of precomputed light: see `hard_cases`."""

from dataclasses import replace
from functools import partial
from math import factorial

import jax
import numpy as np
from hard_cases import LD, Hard

from diffopt.kernels import lobe_harmonics, octahedral

LAST = 1 - 2.0**-24  # the largest number below 1 in float32


def lighting_rows():
    """All of them, each compiled whole."""
    for part in (_octahedra, _lobes):
        for row in part():
            yield replace(row, call=jax.jit(row.call))


def _onto(x, y, z):
    size = abs(x) + abs(y) + abs(z)
    u, v = x / size, y / size
    if z < 0:
        return np.copysign(1 - abs(v), u), np.copysign(1 - abs(u), v)
    return u, v


def _from(u, v):
    z = 1 - abs(u) - abs(v)
    if z < 0:
        u, v = np.copysign(1 - abs(v), u), np.copysign(1 - abs(u), v)
    return np.array([u, v, z]) / np.sqrt(u * u + v * v + z * z)


def _octahedra():
    for label, place, smooth in (
        ("upper", (0.48, -0.36, 0.8), True),
        ("lower", (-0.48, 0.36, -0.8), True),
        ("north", (0.0, 0.0, 1.0), False),
        ("south", (0.0, 0.0, -1.0), False),
        ("equator", (0.6, -0.8, 0.0), False),
        ("fold", (0.0, 0.6, -0.8), False),
        ("axis", (1.0, 0.0, 0.0), False),
        ("almost an axis", (1.0, 1e-30, -1e-30), False),
    ):
        yield Hard("octahedral.encode", label, octahedral.encode, place, _onto, smooth=smooth)
    for label, place, smooth in (
        ("upper", (0.3, -0.2), True),
        ("lower", (-0.7, 0.9), True),
        ("north", (0.0, 0.0), False),
        ("south", (1.0, -1.0), False),
        ("side", (1.0, 0.25), False),
        ("equator", (0.25, -0.75), False),
        ("axis", (0.0, 1.0), False),
        ("almost a corner", (LAST, LAST), True),
    ):
        yield Hard("octahedral.decode", label, octahedral.decode, place, _from, smooth=smooth)


def _bessel(degree, k):
    """i_l(k) k^-l, up to a factor that depends on k: a series, or the sum that ends."""
    if k < 12:
        term = total = 1 / LD(np.prod(np.arange(1, 2 * degree + 2, 2, dtype=float)))
        for n in range(1, 60):
            term = term * (k * k / 2) / (n * LD(2 * degree + 2 * n + 1))
            total = total + term
        return total * k**degree
    parts = [
        factorial(degree + n) // (factorial(n) * factorial(degree - n)) for n in range(degree + 1)
    ]
    back = sum(part / (2 * k) ** n for n, part in enumerate(parts)) * np.exp(-2 * k)
    ahead = sum((-1) ** n * part / (2 * k) ** n for n, part in enumerate(parts))
    return ahead - (-1) ** degree * back


def _damping(k, bands):
    return np.array([_bessel(degree, k) / _bessel(0, k) for degree in range(bands)])


def _lobes():
    for kappa in (0.0, 1e-12, 1e-3, 0.5, LAST, 1.0, 3.0, 11.9, 12.1, 89.0, 710.0, 1e5, 1e8):
        for bands in (2, 7):
            yield Hard(
                "lobe_harmonics.ratios",
                f"kappa={kappa:g}, {bands} bands",
                partial(lobe_harmonics.ratios, bands=bands),
                (kappa,),
                partial(_damping, bands=bands),
                ulps=16,  # a product of six
            )
