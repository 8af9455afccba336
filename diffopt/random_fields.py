"""Parts of random surfaces that repeat periodically, for `diffopt.samples`."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError


def periodic_gaussians(
    place: Float[np.ndarray, " count"], n: int, step: float, sigma: float
) -> Float[np.ndarray, "count n"]:
    """Gaussians of maximum 1 along one axis, wrapped around its ends.

    Parameters
    ----------
    place
        Their centres as shares of the side, in [0, 1).
    n, step
        Samples along the side and their distance, micrometres.
    sigma
        Standard deviation, micrometres.

    Returns
    -------
    numpy.ndarray
        [count, n], float64.
    """
    length = n * step
    offset = (np.arange(n) * step)[None, :] - place[:, None] * length
    nearest = (offset + length / 2) % length - length / 2
    # Images more than 9 sigma away add less than 3e-18.
    images = max(math.ceil(9 * sigma / length - 0.5), 0)
    shifts = np.arange(-images, images + 1) * length
    return sum(
        (np.exp(-(((nearest + shift) / sigma) ** 2) / 2) for shift in shifts),
        start=np.zeros_like(nearest),
    )


def gaussian_field(
    key: Any,
    shape: tuple[int, int],
    pixel: tuple[float, float],
    length: float | int | Array,
) -> Float[Array, "ny nx"]:
    """Periodic Gaussian field of unit variance with correlation exp(-r^2 / length^2).

    Parameters
    ----------
    key
        JAX random key.
    shape, pixel
        (ny, nx) and (dy, dx) in micrometres.
    length
        Micrometres: at least two pixels, at most a quarter of the shorter side. The field is
        differentiable in it.

    Raises
    ------
    InputError
        If the length is known and out of range.
    """
    (ny, nx), (dy, dx) = shape, pixel
    shorter = min(ny * dy, nx * dx)
    known = checks.concrete(length)
    if known is not None and not (
        2 * max(dy, dx) * (1 - 1e-6) <= float(known) <= shorter / 4 * (1 + 1e-6)
    ):
        raise InputError(
            f"correlation_length={float(known):g} um: expected two pixels "
            f"({2 * max(dy, dx):g} um) to a quarter of the side ({shorter / 4:g} um)"
        )
    noise = jax.random.normal(key, shape, jnp.result_type(float))
    spectrum = jnp.fft.rfft2(noise)
    exponent = -((math.pi * jnp.asarray(length, noise.dtype)) ** 2)
    f2 = np.fft.fftfreq(ny, dy)[:, None] ** 2 + np.fft.rfftfreq(nx, dx)[None, :] ** 2
    root = jnp.exp(0.5 * exponent * jnp.asarray(f2, noise.dtype))
    mean = jnp.exp(exponent * jnp.asarray(_full_f2(shape, pixel), noise.dtype)).mean()
    return jnp.fft.irfft2(spectrum * (root / jnp.sqrt(mean)).astype(spectrum.dtype), shape)


def _full_f2(shape: tuple[int, int], pixel: tuple[float, float]) -> np.ndarray:
    f_y, f_x = (np.fft.fftfreq(n, d) for n, d in zip(shape, pixel, strict=True))
    return f_y[:, None] ** 2 + f_x[None, :] ** 2
