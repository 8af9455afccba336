"""A surface with roughness or bumps added to it."""

from typing import Any, ClassVar

import jax
from jaxtyping import Array, Float

from diffopt.gratings.base import Components, Reach, Surface
from diffopt.gratings.rough import Rough


class Superposed(Surface):
    """h = base + rough, independent of each other: spectra are convolved.

    Each line of the base is spread as the rough surface spreads a mirror. What of the base is
    a continuum already (a disc's, or that of bumps) is left as it is, which holds where it is
    smooth over the lobe of the roughness. Superpositions nest.

    Parameters
    ----------
    base
        Any surface.
    rough
        `Roughness` or `Bumps`.
    """

    RANDOM: ClassVar = True

    base: Surface
    rough: Rough

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """Sum of both; see `Surface.heights`."""
        one, other = jax.random.split(key)
        base = self.base.sampled(y, x, pixel, edges, one)
        return base + self.rough.sampled(y, x, pixel, edges, other)

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Convolution of both; see `Surface.components`."""
        return self.rough.spread(self.base.components(fx, fy, kappa, reach), kappa, reach)
