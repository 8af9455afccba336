"""Covariance of parameters fitted to a scan whose noise is correlated."""

from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from diffopt.fitting.scans.register import Scan
from diffopt.fitting.scans.squares import Pixels, Squares, heights, project
from diffopt.gratings import Parametric


@eqx.filter_jit
def _gains(
    u: Array,
    pixels: Pixels,
    surface: Parametric,
    names: tuple[str, ...],
    pixel: tuple[float, float],
    edges: str,
) -> tuple[Array, Array]:
    """Derivatives, and the images that a deviation is summed with, before the matrix."""
    _, derivative = jax.linearize(partial(heights, pixels, surface, names, pixel, edges), u)
    jacobian = jax.lax.map(derivative, jnp.eye(u.size, dtype=u.dtype))
    rest = jax.lax.map(lambda row: project(row, pixels)[0] * pixels.weight, jacobian)
    return jacobian, rest


def covariance(
    found: Squares, scan: Scan, edges: str, correlation: np.ndarray, white: float, dtype: Any
) -> np.ndarray:
    """Covariance of the encoded parameters under correlated noise (sandwich).

    Parameters
    ----------
    found, scan, edges
        The fit.
    correlation
        [2 ny, 2 nx] covariance of the noise at lags in the order of the FFT, um^2.
    white
        Variance of white noise, um^2, in `correlation` not included.
    dtype
        Of the computation.
    """
    # Weights that fall with the noise itself are in `inflation`, not here.
    pixels = Pixels(
        heights=jnp.asarray(scan.heights / scan.scale, dtype),
        weight=jnp.asarray(scan.known, dtype),
        precision=jnp.asarray(found.precision, dtype),
        y=jnp.asarray(scan.y, dtype),
        x=jnp.asarray(scan.x, dtype),
        scale=jnp.asarray(scan.scale, dtype),
    )
    u = jnp.asarray(found.u, dtype)
    rows, gains = _gains(u, pixels, found.surface, found.names, scan.pixel, edges)
    rows, gains = np.asarray(rows, float), np.asarray(gains, float)
    matrix = np.einsum("ayx,byx->ab", rows, gains)
    ny, nx = scan.heights.shape
    spectrum = np.fft.rfft2(correlation).real
    middle = (white + found.inflation) * np.einsum("ayx,byx->ab", gains, gains)
    for a, row in enumerate(gains):
        wide = np.fft.irfft2(np.fft.rfft2(row, (2 * ny, 2 * nx)) * spectrum, (2 * ny, 2 * nx))
        middle[a] += np.einsum("yx,byx->b", wide[:ny, :nx], gains)
    inverse = np.linalg.pinv(matrix, hermitian=True, rcond=1e-12)
    return inverse @ (0.5 * (middle + middle.T)) @ inverse.T / scan.scale**2
