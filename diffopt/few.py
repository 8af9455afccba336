"""A few wavelengths, with the mirror peak apart: the diffraction thesis's fast variant.

Away from the mirror direction spectra of short coherence lengths are smooth, and a few
wavelengths carry them; the mirror peak alone has structure in every wavelength. It is known
in closed form: |mean exp(2 pi i s h)|^2 under the window's Gaussian. So the two are summed
apart, the mirror at all wavelengths, the rest at a few, with the weights of the full set
carried over by a cubic spline through the few.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import bounds, methods
from diffopt.diffraction import DiffractionBRDF, factors, intensity
from diffopt.errors import InputError
from diffopt.kernels import frames, phase
from diffopt.settings import FewSettings, SeparableSettings


class FewWavelengths(eqx.Module):
    """What `evaluate_few` needs besides the model; made by `few_wavelengths`.

    Attributes
    ----------
    wavelengths, weights
        The few and their weights, [n] and [n, 3].
    all_wavelengths, all_weights
        The full set, for the mirror peak, [L] and [L, 3].
    s, share
        Ends of the interval of w / lambda and the mirror's share at its Chebyshev points.
    """

    wavelengths: Float[Array, " n"]
    weights: Float[Array, "n 3"]
    all_wavelengths: Float[Array, " L"]
    all_weights: Float[Array, "L 3"]
    s: Float[Array, "2"]
    share: Float[Array, " nodes"]


def few_weights(
    wavelengths: Float[np.ndarray, " L"], weights: Float[np.ndarray, "L 3"], count: int
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Evenly spaced wavelengths, and weights that integrate the cubic spline through them.

    Parameters
    ----------
    wavelengths, weights
        The full set, micrometres.
    count
        How many to keep, from 4 to all.

    Raises
    ------
    InputError
        If the count is outside that range.
    """
    if not 4 <= count <= len(wavelengths):
        raise InputError(
            f"few wavelengths: count must lie between 4 and the {len(wavelengths)} of the job; "
            f"received {count}"
        )
    from scipy.interpolate import CubicSpline

    few = np.linspace(wavelengths[0], wavelengths[-1], count)
    return few, CubicSpline(few, np.eye(count))(wavelengths).T @ weights


def few_wavelengths(
    brdf: DiffractionBRDF,
    wavelengths: Float[np.ndarray, " L"],
    weights: Float[np.ndarray, "L 3"],
    w_range: tuple[float, float],
    settings: FewSettings,
) -> FewWavelengths:
    """Choose the wavelengths and tabulate the mirror's share over w / lambda.

    Parameters
    ----------
    brdf
        The model, averaged over positions.
    wavelengths, weights
        The full set.
    w_range
        Smallest and largest w of the job.
    settings
        How many wavelengths.

    Raises
    ------
    InputError
        If the model has no mirror peak of its own: one coherent window, or a bare patch.
    """
    surface = brdf.surface
    if surface.coverage != "positions":
        raise InputError(
            "method 'few' sets the mirror peak apart, which only average='positions' has; "
            f"received a model of coverage {surface.coverage!r}"
        )
    dtype = surface.heights.dtype
    few, few_w = few_weights(wavelengths, weights, settings.count)
    low, high = bounds.s_interval(surface, np.array(w_range), wavelengths)
    ends = jnp.asarray([low, high], dtype)
    sweep = np.pi * (high - low) * float(surface.heights.max() - surface.heights.min())
    nodes = phase.chebyshev_nodes(sweep, 1e-7)
    share = _shares(surface.heights, ends, nodes)
    if surface.drop_mean:
        share = jnp.zeros_like(share)
    return FewWavelengths(
        wavelengths=jnp.asarray(few, dtype),
        weights=jnp.asarray(few_w, dtype),
        all_wavelengths=jnp.asarray(wavelengths, dtype),
        all_weights=jnp.asarray(weights, dtype),
        s=ends,
        share=share,
    )


@eqx.filter_jit
def _shares(heights, ends, nodes):
    half = 0.5 * (ends[1] - ends[0])
    at = phase.chebyshev_points(nodes, ends.dtype) * half + 0.5 * (ends[0] + ends[1])
    return jax.lax.map(lambda s: methods.mean_reflectance(heights, s), at)


@eqx.filter_jit
def evaluate_few(
    brdf: DiffractionBRDF,
    few: FewWavelengths,
    wi: Float[Array, "*batch 3"],
    wo: Float[Array, "*batch 3"],
    settings: FewSettings,
) -> Float[Array, "*batch 3"]:
    """XYZ for pairs of directions, 0 below the horizon.

    Parameters
    ----------
    brdf, few
        The model and what belongs to it.
    wi, wo
        Unit vectors, [..., 3].
    settings
        Chebyshev points in w.
    """
    batch = wi.shape[:-1]
    valid, wi, wo = frames.above_horizon(wi.reshape(-1, 3), wo.reshape(-1, 3))
    wave = frames.valid_wave_vector(valid, wi, wo)
    surface = dataclasses.replace(brdf.surface, drop_mean=True)
    rest = eqx.tree_at(lambda b: b.surface, brdf, surface)
    square = intensity(rest, wave, few.wavelengths, SeparableSettings(nodes=settings.nodes))
    value = factors(brdf, wi, wo, few.wavelengths, "xyz") * square
    xyz = jnp.matmul(value, few.weights, precision="highest")
    xyz = xyz + _mirror(brdf, few, wi, wo, wave)
    return jnp.where(valid[:, None], xyz, 0.0).reshape(*batch, 3)


def _mirror(brdf, few, wi, wo, wave):
    """XYZ of the mirror peak at all wavelengths, one at a time."""
    surface = brdf.surface
    middle, half = 0.5 * (few.s[0] + few.s[1]), 0.5 * (few.s[1] - few.s[0])
    phase_w = surface.height_phase(wave)
    aside = wave[:, 0] ** 2 + wave[:, 1] ** 2

    def at(total, z):
        wavelength, weight = z
        t = (phase_w / wavelength - middle) / jnp.where(half > 0, half, 1.0)
        share = phase.chebyshev_weights(t, few.share.shape[0]) @ few.share
        gauss = jnp.exp(-aside / (wavelength * surface.spread(wavelength)) ** 2)
        before = factors(brdf, wi, wo, wavelength[None], "xyz")[:, 0]
        value = before * gauss * share * surface.peak_loss(wavelength)
        return total + value[:, None] * weight[None, :], None

    zero = jnp.zeros((wi.shape[0], 3), wi.dtype)
    return jax.lax.scan(at, zero, (few.all_wavelengths, few.all_weights))[0]
