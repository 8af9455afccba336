"""Diffuse materials: Lambert's and Oren and Nayar's."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import reflectance
from diffopt.materials.base import Material, floating, tint
from diffopt.materials.checking import within


class Lambert(Material):
    """Lambert's material, f = albedo / pi.

    Parameters
    ----------
    colour
        Albedo in [0, 1], a scalar or channels [C]. (The factor k_d of textbooks is at most
        1/pi.)
    """

    colour: Float[Array, "..."] = eqx.field(converter=floating, default=0.5)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        within("colour", self.colour, 0.0, 1.0)

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.colour.shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return tint(jnp.full(wi.shape[:-1], 1.0 / np.pi, wi.dtype), self.colour)

    def integrate(self, wo: Array, nodes: int) -> Array:
        """See `Material`."""
        return self.colour


class OrenNayar(Material):
    """Rough diffuse material of V-shaped Lambertian facets (the qualitative model of 1994).

    Parameters
    ----------
    colour
        Albedo of the facets in [0, 1], a scalar or channels [C]. Light that several facets
        scatter is left out: the material reflects less than that.
    sigma
        Standard deviation of the facets' angle, radians, at least 0 (Lambert's material).
    """

    colour: Float[Array, "..."] = eqx.field(converter=floating, default=0.5)
    sigma: Float[Array, ""] = eqx.field(converter=floating, default=0.35)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        within("colour", self.colour, 0.0, 1.0)
        within("sigma", self.sigma, 0.0, np.pi / 2)

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.colour.shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return tint(reflectance.oren_nayar(self.sigma, wi, wo), self.colour)
