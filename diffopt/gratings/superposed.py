"""A surface with roughness or bumps added to it."""

from typing import Any

import jax
from jaxtyping import Array, Float

from diffopt.gratings.base import Components, Reach, Surface
from diffopt.gratings.rough import Rough
from diffopt.heightfield import Number


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

    base: Surface
    rough: Rough

    def heights(
        self,
        shape: tuple[int, int],
        pixel: Number | tuple[Number, Number],
        *,
        edges: str = "sharp",
        key: Any = None,
    ) -> Float[Array, "ny nx"]:
        """Sum of both, see `Surface.heights`."""
        one, other = (None, None) if key is None else jax.random.split(key)
        base = self.base.heights(shape, pixel, edges=edges, key=one)
        return base + self.rough.heights(shape, pixel, edges=edges, key=other)

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Convolution of both; see `Surface.components`."""
        return self.rough.spread(self.base.components(fx, fy, kappa, reach), kappa, reach)
