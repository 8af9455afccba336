"""Factors before the windowed transform in scalar diffraction BRDFs, and their phases.

Every model here reads ``f = R S C(wi, wo) / lambda^2 * |integral|^2 / area`` with its own
C and its own factor of the height in the phase (Stam 1999; Yan et al. 2018, who name the
others OHS, GHS, ROHS, RGHS and Kirchhoff).
"""

from typing import Literal, get_args

import jax.numpy as jnp
from jaxtyping import Array, Float

Prefactor = Literal["stam", "ohs", "ghs", "rohs", "rghs", "kirchhoff"]
NAMES: tuple[str, ...] = get_args(Prefactor)


def geometric_factor(
    name: Prefactor,
    wave: Float[Array, "... 3"],
    cos_i: Float[Array, "..."],
    cos_o: Float[Array, "..."],
) -> Float[Array, "..."]:
    """The factor C(wi, wo) of a model, without reflectance, shadowing and wavelength.

    Parameters
    ----------
    name
        ``stam``: (u^2+v^2+w^2)^2 / (4 cos_i cos_o w^2) (Stam 1999 eq. 7 with the square
        that his derivation has); ``ohs``, ``ghs``: cos_o / cos_i; ``rohs``, ``rghs``:
        (cos_i+cos_o)^2 / (4 cos_i cos_o); ``kirchhoff``: 1 / (4 cos_i cos_o), for an
        integral weighted by `kirchhoff_weight`.
    wave
        (u, v, w), see `diffopt.kernels.frames.wave_vector`, [..., 3].
    cos_i, cos_o
        Cosines to the normal, > 0.

    Returns
    -------
    Array
        C, [...]; 1 for a mirror (for ``kirchhoff`` after its weight).
    """
    if name == "stam":
        # (s2/w)^2 before the division, and one cosine at a time: no square underflows, and no slope
        # overflows, at grazing angles.
        return ((wave * wave).sum(-1) / wave[..., 2]) ** 2 / (4.0 * cos_i) / cos_o
    if name in ("ohs", "ghs"):
        return cos_o / cos_i
    if name in ("rohs", "rghs"):
        return wave[..., 2] ** 2 / (4.0 * cos_i * cos_o)
    if name == "kirchhoff":
        return 1.0 / (4.0 * cos_i * cos_o)
    raise ValueError(f"prefactor must be one of {', '.join(NAMES)}; received {name!r}")


def height_factor(name: Prefactor, wave: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Factor of the height in the phase, in units of the wavelength: w, or -2.

    ``ohs`` and ``rohs`` take the path of a mirror seen from above, 2 h; all others follow
    the directions, (cos_i + cos_o) h.
    """
    w = wave[..., 2]
    return jnp.full_like(w, -2.0) if name in ("ohs", "rohs") else w


def kirchhoff_weight(
    wave: Float[Array, "3"],
    slope_x: Float[Array, "ny nx"],
    slope_y: Float[Array, "ny nx"],
) -> Float[Array, "ny nx"]:
    """Kirchhoff's obliquity (q . m) / m_z per facet, q = wi + wo, m the facet normal."""
    return wave[0] * slope_x + wave[1] * slope_y - wave[2]
