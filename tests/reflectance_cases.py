"""Simulated reflectance of parametric surfaces, with noise, for tests of fits."""

import math

import numpy as np

from diffopt import fitting
from diffopt.fitting.reflectance import forward
from diffopt.gratings import Reach

SIGMA = 1.5
WI = np.array([math.sin(0.17), 0.0, math.cos(0.17)])
REACH = Reach(4, 64, 64.0, 16)


def disc(count, radius=0.85):
    """Directions on a square lattice of sines within a radius."""
    x, y = np.meshgrid(*2 * [np.linspace(-radius, radius, count)])
    inside = np.hypot(x, y) <= radius
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.sqrt(1 - x**2 - y**2)], -1)


def simulated(surface, rng, wo, wavelengths, share=0.02, quantity="spectral", **options):
    """Data with noise of a share of each value and a thousandth of the largest."""
    colours = quantity in ("xyz", "rgb")
    shape = (len(wo), 3 if colours else len(wavelengths))
    lam = None if colours else wavelengths
    empty = fitting.Measured(WI, wo, lam, np.ones(shape), SIGMA, quantity=quantity)
    values = np.asarray(forward.predicted(forward.job(empty), surface, REACH))
    noise = share * np.abs(values) + 1e-3 * values.max()
    values = values + noise * rng.normal(size=shape)
    return fitting.Measured(
        WI, wo, lam, values, SIGMA, quantity=quantity, noise=noise, noise_known=True, **options
    )
