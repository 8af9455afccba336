"""Phong's material, as the textbooks have it and normalised, and Blinn's with half vectors."""

import math
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.kernels import frames, reflectance, warps
from diffopt.kernels.reflectance import Form
from diffopt.materials.base import Material, floating, tint
from diffopt.materials.checking import one_of, within

Normalisation = Literal["energy", "book"]


class Phong(Material):
    """Phong's specular lobe k_s cos^n psi.

    Parameters
    ----------
    colour
        k_s in [0, 1], a scalar or channels [C].
    exponent
        n >= 0.
    form
        ``reflected``: psi is the angle between the viewer and the mirrored light;
        ``halfway``: cos psi = 2 (n.h)^2 - 1, the same in the plane of incidence alone.
    normalisation
        ``energy``: f = k_s (n + 2)/(2 pi) cos^n psi, reciprocal, albedo k_s at normal
        incidence (0.5 k_s at 60 degrees for large n: half of the lobe's weight, the cosine);
        ``book``: f = k_s cos^n psi / cos_i as Phong's shading formula implies, neither
        reciprocal nor bounded at grazing light.
    """

    colour: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)
    exponent: Float[Array, ""] = eqx.field(converter=floating, default=32.0)
    form: Form = eqx.field(static=True, converter=one_of("form", Form), default="reflected")
    normalisation: Normalisation = eqx.field(
        static=True, converter=one_of("normalisation", Normalisation), default="energy"
    )

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        within("colour", self.colour, 0.0, 1.0)
        within("exponent", self.exponent, 0.0, np.inf)

    @property
    def reciprocal(self) -> bool:
        """See `Material`."""
        return self.normalisation == "energy"

    @property
    def conserves_energy(self) -> bool:
        """See `Material`."""
        return self.normalisation == "energy"

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.colour.shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        lobe = reflectance.phong(self.form, self.exponent, wi, wo)
        if self.normalisation == "energy":
            return tint(lobe * ((self.exponent + 2.0) / (2.0 * math.pi)), self.colour)
        return tint(lobe / wi[..., 2], self.colour)

    def warp(self, u: Array, wo: Array) -> Array:
        """See `Material`."""
        if self.form == "reflected":
            lobe = warps.power_cosine(u[..., :2], self.exponent)
            return turned(lobe, reflectance.mirrored(wo))
        # cos psi = 2 c^2 - 1 = q^(1/(n+1)) gives half vectors with (2 c^2 - 1)^n c.
        logarithm = jnp.log1p(-u[..., 0]) / (self.exponent + 1.0)
        sin2 = -0.5 * jnp.expm1(logarithm)
        return _about_half(sin2, u[..., 1], wo)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        n = self.exponent
        if self.form == "reflected":
            angle = reflectance.lobe_angle("reflected", wi, wo)
            return warps.power_cosine_density(*angle, n)
        half, length, ok = frames.half_vector(wi, wo)
        cos, _ = reflectance.half_angle(half, half)
        lobe = warps.power(*reflectance.lobe_angle("halfway", half, half), n)
        return jnp.where(ok, (n + 1.0) / math.pi * lobe * cos / length, 0.0)


class BlinnPhong(Material):
    """Blinn's lobe k_s c (n.h)^e of half vectors.

    Parameters
    ----------
    colour
        k_s >= 0, a scalar or channels [C].
    exponent
        e >= 0.
    normalised
        True: c = (e + 2)(e + 4) / (8 pi (2^(-e/2) + e)), so that the albedo is k_s at
        normal incidence; it falls towards grazing angles. False: c = 1, as the lobes of
        precomputed transfer are written.
    """

    colour: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)
    exponent: Float[Array, ""] = eqx.field(converter=floating, default=32.0)
    normalised: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        within("colour", self.colour, 0.0, np.inf)
        within("exponent", self.exponent, 0.0, np.inf)

    @property
    def conserves_energy(self) -> bool:
        """The albedo is largest at normal incidence, where the constant makes it k_s."""
        known = checks.concrete(self.colour)
        return self.normalised and known is not None and bool((known <= 1.0).all())

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.colour.shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        lobe = reflectance.blinn_phong(self.exponent, wi, wo)
        if self.normalised:
            lobe = lobe * reflectance.blinn_phong_constant(self.exponent)
        return tint(lobe, self.colour)

    def warp(self, u: Array, wo: Array) -> Array:
        """See `Material`."""
        sin2 = -jnp.expm1(jnp.log1p(-u[..., 0]) * (2.0 / (self.exponent + 1.0)))
        return _about_half(sin2, u[..., 1], wo)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        half, length, ok = frames.half_vector(wi, wo)
        lobe = warps.power_cosine_density(*reflectance.half_angle(half, half), self.exponent)
        return jnp.where(ok, lobe / (2.0 * length), 0.0)


def turned(lobe: Array, axis: Array) -> Array:
    """Directions about z turned so that z becomes the axis."""
    first, second = frames.tangents(axis)
    return lobe[..., :1] * first + lobe[..., 1:2] * second + lobe[..., 2:] * axis


def _about_half(sin2: Array, turn: Array, wo: Array) -> Array:
    """Viewer mirrored at half vectors with a squared sine and a share of the circle."""
    tiny = float(jnp.finfo(sin2.dtype).tiny)
    sin, cos = jnp.sqrt(jnp.maximum(sin2, tiny)), jnp.sqrt(jnp.maximum(1.0 - sin2, tiny))
    return frames.reflect(wo, frames.around(sin, turn, cos))
