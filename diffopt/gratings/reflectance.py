"""BRDF of parametric surfaces by their closed-form spectra, averaged over window positions.

``f = R S C / lambda^2 * area * |P|^2`` as for `diffopt.DiffractionBRDF` with
``average="positions"``, for a surface that goes on for ever: no heights, no grid, no seams, and a
derivative in every parameter.
"""

import math

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.fresnel import Constant, Reflectance
from diffopt.gratings.base import Reach, Surface
from diffopt.kernels import frames
from diffopt.scalar import Shadowing, model_factors


def power(
    surface: Surface,
    wave: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    coherence: Float[Array, ""],
    *,
    reach: Reach,
    blur: Float[Array, ""] | None = None,
) -> Float[Array, "M L"]:
    """|P|^2 relative to a mirror's peak, averaged over positions of the window.

    Parameters
    ----------
    surface
        The surface.
    wave
        (u, v, w) of each pair of directions, see `diffopt.kernels.frames.wave_vector`.
    wavelengths
        Micrometres.
    coherence
        sigma_s, micrometres.
    reach
        What is summed.
    blur
        Standard deviation of source and pixel together in u and in v; none if left out.
    """
    fx, fy, s = (wave[:, k, None] / wavelengths[None, :] for k in range(3))
    found = surface.components(fx, fy, 2.0 * math.pi * s, reach)
    sigma_f = jnp.broadcast_to(1.0 / (2.0 * math.pi * coherence), s.shape)
    if blur is None:
        return found.power(sigma_f, sigma_f)
    return found.power(sigma_f, jnp.sqrt(sigma_f**2 + 2.0 * (blur / wavelengths[None, :]) ** 2))


@eqx.filter_jit
def brdf(
    surface: Surface,
    wi: Float[Array, "M 3"],
    wo: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    coherence: Float[Array, ""],
    *,
    reach: Reach,
    fresnel: Reflectance | None = None,
    blur: Float[Array, ""] | None = None,
    shadowing: Shadowing = "none",
    relative: bool = False,
) -> Float[Array, "M L"]:
    """BRDF of an endless surface in 1/sr without the cosine; 0 below the horizon.

    Parameters
    ----------
    surface
        The surface.
    wi, wo
        Unit vectors, [M, 3].
    wavelengths, coherence, reach, blur
        See `power`.
    fresnel
        Power reflectance; a perfect mirror by default.
    shadowing
        As for `diffopt.DiffractionBRDF`.
    relative
        The relative reflectance of `DiffractionBRDF.relative` instead.
    """
    valid, wi, wo = frames.above_horizon(wi, wo)
    wave = frames.wave_vector(wi, wo)
    before = model_factors(
        Constant() if fresnel is None else fresnel,
        wi,
        wo,
        wavelengths,
        prefactor="stam",
        shadowing=shadowing,
        relative=relative,
    )
    value = before * power(surface, wave, wavelengths, coherence, reach=reach, blur=blur)
    area = 1.0 if relative else 4.0 * math.pi * coherence**2
    return jnp.where(valid[:, None], value * area, 0.0)


def reach_for(
    *,
    longest: float,
    frequency: float,
    coherence: float,
    phase: float,
    broad: float = 0.0,
    terms: int = 32,
    faint: float = 1e-7,
) -> Reach:
    """A `Reach` that leaves out `faint` of a line's peak at most.

    Parameters
    ----------
    longest
        Longest period, micrometres.
    frequency
        Largest |(u, v)| / wavelength, cycles per micrometre.
    coherence
        sigma_s, micrometres.
    phase
        Largest kappa times amplitude, radians.
    broad
        Standard deviation of orders that disorder spreads, cycles per micrometre.
    terms
        Of the series of random displacements.
    """
    width = math.sqrt(-math.log(faint)) * math.hypot(
        1.0 / (2.0 * math.pi * coherence), math.sqrt(2.0) * broad
    )
    each_side = max(math.ceil(width * longest - 0.5), 0)
    highest = math.ceil(frequency * longest) + each_side + 1
    return Reach(each_side, highest, float(phase), terms)
