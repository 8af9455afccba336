"""Parts of random surfaces that repeat periodically."""

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError


def bumps(
    key: Any,
    y: Float[Array, " ny"],
    x: Float[Array, " nx"],
    pixel: tuple[float, float],
    sizes: tuple[Any, Any],
    density: float,
) -> tuple[Float[Array, "ny nx"], int]:
    """Sum of Gaussians of maximum 1 about points of a Poisson process, and their number.

    The sum repeats with the grid and is differentiable in the sizes; how many there are is
    drawn on the host.

    Parameters
    ----------
    key
        JAX random key.
    y, x, pixel
        Positions of rows and columns, (dy, dx) apart, micrometres.
    sizes
        Standard deviations along y and x, micrometres.
    density
        Points on a square micrometre, 0 or more.
    """
    lengths = (y.size * pixel[0], x.size * pixel[1])
    # A shape, so it is drawn now even where a program is traced.
    with jax.ensure_compile_time_eval():
        key_count, key_place = jax.random.split(key)
        count = int(jax.random.poisson(key_count, density * lengths[0] * lengths[1]))
    place = jax.random.uniform(key_place, (count, 2), y.dtype)
    along_y, along_x = (
        _periodic_gaussians(at, place[:, k] * lengths[k], lengths[k], sizes[k])
        for k, at in enumerate((y, x))
    )
    return jnp.matmul(along_y.T, along_x, precision="highest"), count


def _periodic_gaussians(
    at: Float[Array, " n"], centre: Float[Array, " count"], length: float, size: Any
) -> Float[Array, "count n"]:
    """Gaussians of maximum 1 along an axis that closes on itself after a length."""
    known = checks.concrete(size)
    # Images more than 9 sigma away add less than 3e-18; a traced size is taken to be below a
    # quarter of the side.
    images = 2 if known is None else max(math.ceil(9 * float(known) / length - 0.5), 0)
    offset = at[None, :] - centre[:, None]
    nearest = offset - length * jnp.round(offset / length)
    size = jnp.asarray(size, at.dtype)
    return sum(
        (
            jnp.exp(-0.5 * ((nearest + shift * length) / size) ** 2)
            for shift in range(-images, images + 1)
        ),
        start=jnp.zeros_like(nearest),
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
