"""What scalar models of diffraction have in common: R S C, all that |P|^2 is multiplied by.

R is the power reflectance at the half-vector angle, S shadowing, C the geometric factor
(`diffopt.kernels.prefactor`).
"""

from typing import Literal

from jaxtyping import Array, Float

from diffopt.fresnel import Reflectance
from diffopt.kernels import frames
from diffopt.kernels import prefactor as prefactors

Shadowing = Literal["none", "v-cavity"]


def geometry(
    wi: Float[Array, "*batch 3"],
    wo: Float[Array, "*batch 3"],
    *,
    prefactor: prefactors.Prefactor,
    shadowing: Shadowing,
) -> Float[Array, "*batch"]:
    """S C of a scalar model: what depends on directions alone, above the horizon."""
    wave, cos_i, cos_o = frames.wave_vector(wi, wo), wi[..., 2], wo[..., 2]
    factor = prefactors.geometric_factor(prefactor, wave, cos_i, cos_o)
    return factor * frames.v_cavity(wave, cos_i, cos_o) if shadowing == "v-cavity" else factor


def model_factors(
    fresnel: Reflectance,
    wi: Float[Array, "M 3"],
    wo: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    *,
    prefactor: prefactors.Prefactor,
    shadowing: Shadowing,
    relative: bool,
) -> Float[Array, "M L"]:
    """R S C / lambda^2 of a scalar model, or R/R0 S C cos_i if `relative`.

    Parameters
    ----------
    fresnel
        Power reflectance.
    wi, wo
        Unit vectors above the horizon.
    wavelengths
        Micrometres.
    prefactor, shadowing
        As for `diffopt.diffraction.DiffractionBRDF`.
    relative
        Whether for the relative reflectance.
    """
    factor = geometry(wi, wo, prefactor=prefactor, shadowing=shadowing)
    reflectance = fresnel(frames.half_cosine(frames.wave_vector(wi, wo)), wavelengths)
    if relative:
        normal = fresnel.normal(wavelengths)
        return reflectance / normal[None, :] * (factor * wi[:, 2])[:, None]
    return reflectance * factor[:, None] / (wavelengths**2)[None, :]
