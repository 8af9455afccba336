"""Error bounds of the methods before they run, relative to a mirror's peak."""

import math

import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.kernels import expansions, gather, phase
from diffopt.methods import Surface
from diffopt.settings import (
    ChebyshevSettings,
    DirectSettings,
    GatherSettings,
    LowRankSettings,
    SeparableSettings,
    Settings,
    TaylorSettings,
)

# Beyond this the picture is wrong, whatever tolerance was asked.
LARGEST_ROUNDING = 5e-3


def phase_range(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """Largest phase 2 pi |w| (h_max - h_min) / wavelength of a job, radians."""
    w = float(np.abs(wave[:, 2]).max()) if surface.follows_w else 2.0
    span = float(surface.heights.max() - surface.heights.min())
    return phase.TWO_PI * w * span / float(np.min(wavelengths))


def separable_sweep(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """Half the phase that w sweeps over a job at one wavelength, the z of its bound."""
    if not surface.follows_w:
        return 0.0
    span = float(surface.heights.max() - surface.heights.min())
    sweep = math.pi * float(np.ptp(wave[:, 2])) * span / float(np.min(wavelengths))
    # |c|^2 is a product of two such functions: twice the band.
    return sweep if surface.coverage == "positions" else 0.5 * sweep


def expansion_argument(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """Half the phase swept by s = w / wavelength over a job: z of its expansions, radians.

    With heights measured from their mid-range; twice that where |c|^2 is expanded
    (averaged over positions). The interval is that of `kernels.expansions.interval`.
    """
    low, high = s_interval(surface, wave[:, 2], wavelengths)
    span = float(surface.heights.max() - surface.heights.min())
    size = 1.0 + 0.5 * abs(low + high)
    half = max(0.5 * (high - low), size / max(1.0, phase.TWO_PI * span * size))
    return math.pi * half * span * (2.0 if surface.coverage == "positions" else 1.0)


def s_interval(surface: Surface, w: np.ndarray, wavelengths: np.ndarray) -> tuple[float, float]:
    """Smallest and largest s = w / wavelength of a job, cycles per micrometre."""
    s = np.outer(w if surface.follows_w else [-2.0], 1.0 / np.atleast_1d(wavelengths))
    return float(s.min()), float(s.max())


def expansion_error(
    surface: Surface, settings: GatherSettings, wave: np.ndarray, wavelengths: np.ndarray
) -> float:
    """Bound on the error of exp(i k w h), or of |c|^2, by the expansion of the settings.

    Truncation is rigorous; the rounding of the terms is an estimate. Chebyshev and low-rank
    terms round like the direct sum, Taylor terms lose exp(argument).
    """
    eps = float(jnp.finfo(surface.heights.dtype).eps)
    if isinstance(settings, TaylorSettings):
        total = phase_range(surface, wave, wavelengths)
        argument = 0.5 * total if settings.centred else total
        # Half of `taylor_rounding` is that of the amplitude.
        rounding = 0.5 * phase.taylor_rounding(argument, eps)
        return phase.taylor_bound(argument, settings.terms) + rounding
    z = expansion_argument(surface, wave, wavelengths)
    bound = (
        phase.chebyshev_bound(z, settings.terms)
        if isinstance(settings, ChebyshevSettings)
        else expansions.lowrank_bound(z, settings.terms)
    )
    return bound + eps * (6.0 + z)


def error_bound(
    surface: Surface, settings: Settings, wave: np.ndarray, wavelengths: np.ndarray
) -> float:
    """Bound on the error of |P|^2 relative to a mirror's peak, truncation and rounding.

    Truncation is rigorous (`chebyshev_bound`, `expansion_error`, `truncation_bound`);
    rounding is an estimate of a few units in the last place, checked by the study
    ``diffraction.rounding``.
    """
    rounding = rounding_estimate(surface, wave, wavelengths)
    if isinstance(settings, DirectSettings):
        return rounding
    if isinstance(settings, SeparableSettings):
        e = phase.chebyshev_bound(separable_sweep(surface, wave, wavelengths), settings.nodes)
        truncation = e if surface.coverage == "positions" else 2.0 * e + e * e
        return truncation + rounding
    if not isinstance(settings, GatherSettings):
        raise TypeError(f"no bound known for settings {settings!r}")
    e = expansion_error(surface, settings, wave, wavelengths)
    cut = gather_cut(surface, settings.reach, wavelengths)
    if surface.coverage == "positions":
        if isinstance(settings, ChebyshevSettings | LowRankSettings):
            # Each bin errs by e at most: those left out do not cancel those gathered.
            return e * (1.0 + gather_omitted(surface, settings.reach, wavelengths)) + cut + rounding
        return 2.0 * e + e * e + cut + rounding
    # Both are errors of the amplitude, whose square counts where they near one.
    return (1.0 + cut) * (1.0 + e) ** 2 - 1.0 + rounding


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
            f"{LARGEST_ROUNDING:g} accepted): use method 'chebyshev', 'lowrank', "
            "'separable' or 'direct', centred heights, or float64"
        )


def gather_cut(surface: Surface, reach: int, wavelengths: np.ndarray) -> float:
    """Bound on what a gather of +-`reach` bins leaves out, relative to a mirror's peak."""
    squared = surface.coverage == "positions"
    return gather.truncation_bound(reach, _bin_step(surface, wavelengths), squared=squared)


def gather_omitted(surface: Surface, reach: int, wavelengths: np.ndarray) -> float:
    """Bound on the sum of the squared weights that a gather of +-`reach` bins leaves out."""
    return gather.omitted_weight(reach, _bin_step(surface, wavelengths))


def _bin_step(surface: Surface, wavelengths: np.ndarray) -> float:
    """Distance of the Fourier bins over sigma_f, blur included, on the longer side."""
    return 1.0 / (max(surface.extent) * float(spread(surface, wavelengths).max()))


def spread(surface: Surface, wavelengths: np.ndarray) -> np.ndarray:
    """`Surface.spread` in float64 on the host, [L]; without the blur for a single window."""
    sigma_f = np.full(np.shape(wavelengths), 1.0 / (phase.TWO_PI * float(surface.sigma)))
    if surface.coverage != "positions":
        return sigma_f
    return np.sqrt(sigma_f**2 + 2.0 * (float(surface.blur) / wavelengths) ** 2)


def rounding_estimate(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """Estimated rounding error of |P|^2 relative to a mirror's peak, for every method.

    Rounding of the phases 2 pi s h and 2 pi f x is random from sample to sample but for the
    rounding of s and f themselves, which acts as a change of direction by eps.
    """
    eps = float(jnp.finfo(surface.heights.dtype).eps)
    turns = 4.0 + phase_range(surface, wave, wavelengths)
    return eps * turns + direction_rounding(surface, wave, wavelengths)


def direction_rounding(surface: Surface, wave: np.ndarray, wavelengths: np.ndarray) -> float:
    """The part of `rounding_estimate` that comes from the directions: lines that move."""
    eps = float(jnp.finfo(surface.heights.dtype).eps)
    shift = float(np.abs(wave[:, :2]).max()) / float(np.min(wavelengths))
    width = max(surface.extent) if surface.coverage == "patch" else 2.0 * float(surface.sigma)
    return eps * phase.TWO_PI * shift * width
