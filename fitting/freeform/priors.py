"""Gaussian priors of free heights, by their root spectra."""

import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.heightfield import Heightfield

Prior = Literal["smooth", "spectrum"]

# Standard deviation of the change that a smooth prior of weight 1 expects, in wavelengths.
_CHANGE = 0.1
# White share of the variance in a spectrum that is taken from the start: 1 % in height.
_FLOOR = 1e-4
# Lags that a spectrum from the start keeps, standard deviation as a share of the side.
_LAGS = 0.15


def filtered(
    field: Float[Array, "ny nx"], response: Float[Array, "ny half"]
) -> Float[Array, "ny nx"]:
    """Circular convolution with a real, even kernel, given by its half-plane response."""
    spectrum = jnp.fft.rfft2(field)
    return jnp.fft.irfft2(spectrum * response.astype(spectrum.dtype), field.shape)


def smooth_root(shape: tuple[int, int], pixel: tuple[float, float], rms: float) -> np.ndarray:
    """Root spectrum of fields whose Laplacian is nearly white, [ny, nx // 2 + 1].

    1 / (f_0^2 + f^2) with f_0 the inverse of the longer side, for a variance of `rms`^2: the
    penalty is that of (f_0^2 - laplacian / 4 pi^2) of the field, squared.

    Parameters
    ----------
    shape, pixel
        (ny, nx) and (dy, dx), micrometres.
    rms
        Standard deviation of the field, micrometres.
    """
    longest = max(n * step for n, step in zip(shape, pixel, strict=True))
    return _scaled(1.0 / (longest**-2 + _squared_frequency(shape, pixel)), rms, shape)


def gaussian_root(
    shape: tuple[int, int], pixel: tuple[float, float], rms: float, length: float
) -> np.ndarray:
    """Root spectrum of correlation exp(-r^2 / length^2) and variance `rms`^2, as `smooth_root`.

    A share of 1e-4 of the variance is white, so that no frequency is forbidden.
    """
    power = np.exp(-((math.pi * length) ** 2) * _squared_frequency(shape, pixel))
    power /= _mean(power, shape)
    return _scaled(np.sqrt(power + _FLOOR), rms, shape)


def start_root(heights: np.ndarray) -> np.ndarray:
    """Root of the smoothed power spectrum of a surface, as `gaussian_root`.

    Smoothed by a Gaussian taper over lags, which keeps it positive; 1e-4 of the variance is
    white.

    Parameters
    ----------
    heights
        Micrometres, [ny, nx].
    """
    heights = np.asarray(heights, np.float64) - np.mean(heights, dtype=np.float64)
    shape = heights.shape
    covariance = np.fft.irfft2(np.abs(np.fft.rfft2(heights)) ** 2, shape)
    lags = [
        np.fft.fftfreq(n)[:, None] ** 2 if k == 0 else np.fft.fftfreq(n)[None, :] ** 2
        for k, n in enumerate(shape)
    ]
    taper = np.exp(-0.5 * (lags[0] + lags[1]) / _LAGS**2)
    power = np.maximum(np.fft.rfft2(covariance * taper).real, 0.0)
    power /= _mean(power, shape)
    return _scaled(np.sqrt(power + _FLOOR), float(heights.std()), shape)


def slopes(heights: Float[Array, "ny nx"]) -> Float[Array, "2 ny nx"]:
    """Derivatives along y and x of a periodic field, a pixel each: how it changes when moved."""
    spectrum = jnp.fft.fft2(heights)
    ny, nx = heights.shape
    fy, fx = (jnp.asarray(np.fft.fftfreq(n), heights.dtype) for n in (ny, nx))
    rates = jnp.stack(jnp.broadcast_arrays(fy[:, None], fx[None, :])) * (2.0 * math.pi)
    # The product with i, in parts.
    turned = jax.lax.complex(-spectrum.imag, spectrum.real)
    return jnp.fft.ifft2(rates.astype(spectrum.dtype) * turned[None]).real


def _squared_frequency(shape: tuple[int, int], pixel: tuple[float, float]) -> np.ndarray:
    fy, fx = np.fft.fftfreq(shape[0], pixel[0]), np.fft.rfftfreq(shape[1], pixel[1])
    return fy[:, None] ** 2 + fx[None, :] ** 2


def _mean(half: np.ndarray, shape: tuple[int, int]) -> float:
    """Mean over the whole plane of what is given on its half: inner columns count twice."""
    count = np.full(half.shape[1], 2.0)
    count[0] = 1.0
    if shape[1] % 2 == 0:
        count[-1] = 1.0
    return float((half * count[None, :]).sum() / (shape[0] * shape[1]))


def _scaled(root: np.ndarray, rms: float, shape: tuple[int, int]) -> np.ndarray:
    """The root spectrum without its mean, for a field of standard deviation `rms`."""
    root = root.copy()
    root[0, 0] = 0.0
    return root * (rms / math.sqrt(_mean(root**2, shape)))


def prior_root(
    start: Heightfield, shortest: float, prior: Prior, roughness: tuple[float, float] | None
) -> np.ndarray:
    """Root spectrum of a prior by name; arguments as in `fit_heights`.

    Raises
    ------
    InputError
        If roughness is not two positive lengths, or given for another prior.
    """
    if prior == "smooth":
        if roughness is not None:
            raise InputError(
                f"roughness needs prior='spectrum'; received prior='smooth' and {roughness}"
            )
        return smooth_root(start.shape, start.pixel, _CHANGE * shortest)
    if roughness is not None:
        if len(roughness) != 2 or not all(0.0 < float(r) < math.inf for r in roughness):
            raise InputError(
                f"roughness must be (rms, length), positive, in micrometres; received {roughness}"
            )
        return gaussian_root(start.shape, start.pixel, float(roughness[0]), float(roughness[1]))
    return start_root(np.asarray(start.heights))
