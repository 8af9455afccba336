"""What parametric surfaces share: heights and spectra.

A surface is a pytree whose array leaves are physical parameters (`diffopt.gratings.parametric`).
It has heights on a grid, and the power spectrum of exp(i kappa h) in closed form, as Gaussians in
spatial frequency (`Components`), from which reflectance follows (`diffopt.gratings.reflectance`).
"""

import abc
import dataclasses
import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.gratings.parametric import Parametric, parts
from diffopt.heightfield import Heightfield, Number, Provenance
from diffopt.io.record import pair


@dataclasses.dataclass(frozen=True)
class Reach:
    """What is summed of a spectrum; static, so that shapes are.

    Attributes
    ----------
    each_side
        Orders on either side of the nearest one.
    highest
        Orders beyond this number are taken as dark.
    phase
        Largest kappa times amplitude that closed forms are to hold for, radians.
    terms
        Of the series of random displacements.
    """

    each_side: int = 2
    highest: int = 32
    phase: float = 60.0
    terms: int = 32


class Components(eqx.Module):
    """Power spectrum of exp(i kappa h) near a frequency f: Gaussians, and a continuum.

    Attributes
    ----------
    weight
        Shares of the power, [K, ...]; those of all orders together are 1.
    x, y
        f less the centre, 1/um, [K, ...].
    xx, xy, yy
        Covariance in 1/um^2, [K, ...]; 0 for a line.
    density
        Power per area of frequency that is smooth on the scale of the lines, um^2, [...].
    """

    weight: Float[Array, " K *batch"]
    x: Float[Array, " K *batch"]
    y: Float[Array, " K *batch"]
    xx: Float[Array, " K *batch"]
    xy: Float[Array, " K *batch"]
    yy: Float[Array, " K *batch"]
    density: Float[Array, "*batch"]

    def power(
        self, sigma_f: Float[Array, "*batch"], spread: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """|P|^2 averaged over positions of a Gaussian window, relative to a mirror's peak.

        Parameters
        ----------
        sigma_f
            Of the window, 1 / (2 pi sigma_s), cycles/um.
        spread
            The same widened by the blur over directions.
        """
        # exp(-f^2 / sigma_f^2) has variance sigma_f^2 / 2.
        narrow, wide = 0.5 * sigma_f[None] ** 2, 0.5 * spread[None] ** 2
        xx, yy = self.xx + wide, self.yy + wide
        determinant = xx * yy - self.xy**2
        square = yy * self.x**2 - 2.0 * self.xy * self.x * self.y + xx * self.y**2
        lines = self.weight * jnp.exp(-0.5 * square / determinant)
        return (lines * narrow / jnp.sqrt(determinant)).sum(0) + self.density * (
            math.pi * sigma_f**2
        )


def lines(
    weight: Float[Array, " K *batch"], x: Float[Array, " K *batch"], y: Float[Array, " K *batch"]
) -> Components:
    """Components without width or continuum."""
    none = jnp.zeros_like(weight)
    return Components(weight, x, y, none, none, none, jnp.zeros_like(weight[0]))


class Surface(Parametric):
    """A parametric surface."""

    #: Whether heights are drawn at random.
    RANDOM: ClassVar[bool] = False
    #: Whether a half turn about z leaves what the surface itself adds to `symmetric`.
    SYMMETRIC: ClassVar[bool] = True

    @property
    def symmetric(self) -> bool:
        """Whether the surface reflects alike once it is turned by half a turn about z.

        True if h(-x, -y) is h(x, y) shifted, or as probable; blazed gratings, and what is made of
        them, are not.
        """
        return self.SYMMETRIC and all(
            part.symmetric for _, part in parts(self) if isinstance(part, Surface)
        )

    def heights(
        self,
        shape: tuple[int, int],
        pixel: Number | tuple[Number, Number],
        *,
        edges: str = "sharp",
        key: Any = None,
    ) -> Float[Array, "ny nx"]:
        """Heights on a grid whose pixel (ny // 2, nx // 2) lies at x = y = 0.

        Parameters
        ----------
        shape
            (ny, nx).
        pixel
            (dy, dx), or one number for both, in micrometres.
        edges
            Of the profiles of gratings: ``"sharp"`` samples them, ``"averaged"`` takes the mean
            over each pixel: along an axis exactly, at an angle over a line across it of the same
            variance. Roughness, bumps and pits are sampled either way.
        key
            JAX random key of surfaces that are drawn at random; the others do not use it.

        Raises
        ------
        InputError
            If ``edges`` is another word, or a random surface has no key.
        """
        if edges not in ("sharp", "averaged"):
            raise InputError(f"edges={edges!r}: expected 'sharp' or 'averaged'")
        if self.RANDOM and key is None:
            raise InputError(
                f"{type(self).__name__}: heights are drawn at random, pass key=jax.random.key(...)"
            )
        (ny, nx), (dy, dx) = shape, pair(pixel, "pixel")
        y = (jnp.arange(ny, dtype=self.dtype) - ny // 2) * dy
        x = (jnp.arange(nx, dtype=self.dtype) - nx // 2) * dx
        return self.sampled(y, x, (dy, dx), edges, key)

    @abc.abstractmethod
    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """Heights at rows y and columns x, micrometres, which lie `pixel` apart; see `heights`."""

    @abc.abstractmethod
    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Spectrum of exp(i kappa h) near frequencies.

        Parameters
        ----------
        fx, fy
            (u, v) / wavelength, cycles per micrometre.
        kappa
            2 pi w / wavelength, 1/um.
        reach
            What is summed.
        """

    def heightfield(
        self,
        shape: tuple[int, int],
        pixel: Number | tuple[Number, Number],
        *,
        edges: str = "sharp",
        key: Any = None,
    ) -> Heightfield:
        """The heights of `heights` as a `Heightfield`."""
        return Heightfield(
            self.heights(shape, pixel, edges=edges, key=key),
            pixel,
            provenance=Provenance(f"{self.title} grating", steps=(f"{edges} samples",)),
        )
