"""Error bounds of the methods before they run, relative to a mirror's peak."""

import math

import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.kernels import gather, phase
from diffopt.methods import Surface
from diffopt.settings import DirectSettings, SeparableSettings, Settings, TaylorSettings

# Beyond this the picture is wrong, whatever tolerance was asked.
LARGEST_ROUNDING = 5e-3


def phase_range(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """Largest phase 2 pi |w| (h_max - h_min) / wavelength of a job, radians."""
    w = 2.0 if surface.prefactor in ("ohs", "rohs") else float(np.abs(wave[:, 2]).max())
    span = float(surface.heights.max() - surface.heights.min())
    return phase.TWO_PI * w * span / float(np.min(wavelengths))


def separable_sweep(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """Half the phase that w sweeps over a job at one wavelength, the z of its bound."""
    if surface.prefactor in ("ohs", "rohs"):
        return 0.0
    span = float(surface.heights.max() - surface.heights.min())
    sweep = math.pi * float(np.ptp(wave[:, 2])) * span / float(np.min(wavelengths))
    # |c|^2 is a product of two such functions: twice the band.
    return sweep if surface.coverage == "positions" else 0.5 * sweep


def error_bound(
    surface: Surface, settings: Settings, wave: np.ndarray, wavelengths: np.ndarray
) -> float:
    """Bound on the error of |P|^2 relative to a mirror's peak, truncation and rounding.

    Truncation is rigorous (`chebyshev_bound`, `taylor_bound`, `truncation_bound`);
    rounding is an estimate of a few units in the last place, checked by the study
    ``diffraction.rounding``.
    """
    eps = float(jnp.finfo(surface.heights.dtype).eps)
    total = phase_range(surface, wave, wavelengths)
    rounding = rounding_estimate(surface, wave, wavelengths)
    if isinstance(settings, DirectSettings):
        return rounding
    if isinstance(settings, SeparableSettings):
        e = phase.chebyshev_bound(separable_sweep(surface, wave, wavelengths), settings.nodes)
        truncation = e if surface.coverage == "positions" else 2.0 * e + e * e
        return truncation + rounding
    argument = 0.5 * total if settings.centred else total
    # Half of `taylor_rounding` is that of the amplitude: where it nears one, its square counts.
    e = phase.taylor_bound(argument, settings.terms) + 0.5 * phase.taylor_rounding(argument, eps)
    cut = gather_cut(surface, settings.reach, wavelengths)
    return 2.0 * e + e * e + cut + rounding


def refuse_rounding(
    surface: Surface, settings: Settings, wave: np.ndarray, wavelengths: np.ndarray
) -> None:
    """Raise InputError for Taylor terms that the dtype cannot carry over the phase range.

    In float32 a phase range of 10 (20 centred) already rounds to a few 1e-3 of a mirror's
    peak; at 30 nothing is left.
    """
    if not isinstance(settings, TaylorSettings):
        return
    dtype = surface.heights.dtype
    total = phase_range(surface, wave, wavelengths)
    argument = 0.5 * total if settings.centred else total
    rounding = phase.taylor_rounding(argument, float(jnp.finfo(dtype).eps))
    if rounding > LARGEST_ROUNDING:
        raise InputError(
            f"method 'taylor': {dtype} cannot carry Taylor terms over a phase range of "
            f"{total:.1f} (rounding {rounding:.1e} of a mirror's peak, at most "
            f"{LARGEST_ROUNDING:g} accepted): use method 'separable' or 'direct', centred "
            "heights, or float64"
        )


def gather_cut(surface: Surface, reach: int, wavelengths: np.ndarray) -> float:
    """Bound on what a gather of +-`reach` bins leaves out, relative to a mirror's peak."""
    squared = surface.coverage == "positions"
    blur = float(surface.blur) / float(np.min(wavelengths)) if squared else 0.0
    sigma_f = math.sqrt((1.0 / (phase.TWO_PI * float(surface.sigma))) ** 2 + 2.0 * blur**2)
    return gather.truncation_bound(reach, 1.0 / (max(surface.extent) * sigma_f), squared=squared)


def rounding_estimate(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """Estimated rounding error of |P|^2 relative to a mirror's peak, for every method.

    Rounding of the phases 2 pi s h and 2 pi f x is random from sample to sample but for the
    rounding of s and f themselves, which acts as a change of direction by eps.
    """
    eps = float(jnp.finfo(surface.heights.dtype).eps)
    shift = float(np.abs(wave[:, :2]).max()) / float(np.min(wavelengths))
    width = max(surface.extent) if surface.coverage == "patch" else 2.0 * float(surface.sigma)
    turns = phase_range(surface, wave, wavelengths) + phase.TWO_PI * shift * width
    return eps * (4.0 + turns)
