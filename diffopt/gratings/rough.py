"""Isotropic roughness, and bumps at random places: alone, or added to another surface."""

import abc
import dataclasses
import math
from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.gratings.base import Components, Reach, Surface, lines
from diffopt.gratings.parametric import parameters
from diffopt.gratings.series import displaced
from diffopt.kernels import ensemble
from diffopt.random_fields import bumps, gaussian_field


class Rough(Surface):
    """A surface that can be added to another: it spreads each of its lines."""

    RANDOM: ClassVar = True

    @abc.abstractmethod
    def spread(self, base: Components, kappa: Float[Array, "*batch"], reach: Reach) -> Components:
        """Components of the sum of another surface and this one."""

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Spectrum of this surface alone: a mirror, spread; see `Surface.components`."""
        mirror = lines(jnp.ones_like(kappa)[None], fx[None], fy[None])
        return self.spread(mirror, kappa, reach)


class Roughness(Rough):
    """Isotropic Gaussian roughness with correlation exp(-r^2 / correlation_length^2).

    Parameters
    ----------
    rms
        Root mean square height, micrometres, above 0.
    correlation_length
        Micrometres, above 0.
    """

    PARAMETERS: ClassVar = {"rms": "length", "correlation_length": "length"}

    rms: Float[Array, ""]
    correlation_length: Float[Array, ""]

    def __init__(self, rms: Any, correlation_length: Any):
        given = {"rms": rms, "correlation_length": correlation_length}
        self.rms, self.correlation_length = parameters(given, Roughness)

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """One surface, drawn by the key, that repeats with the patch; differentiable."""
        del edges
        field = gaussian_field(key, (y.size, x.size), pixel, self.correlation_length)
        return self.rms * field.astype(self.rms.dtype)

    def spread(self, base: Components, kappa: Float[Array, "*batch"], reach: Reach) -> Components:
        """Each line loses exp(-(kappa rms)^2) to a lobe around it; a continuum stays."""
        variance = jnp.broadcast_to((kappa * self.rms)[None] ** 2, base.weight.shape)
        return displaced(base, variance, self.correlation_length, reach.terms)


class Bumps(Rough):
    """Gaussian bumps at random places (Stam, Diffraction shaders, SIGGRAPH 1999).

    h = sum of height exp(-r^2 / 2 size^2) about the points of a Poisson process. The spectrum
    is that of `diffopt.kernels.ensemble.random_bumps`, of first order in the share of the
    surface that bumps cover: its relative error is about pi density size^2.

    Parameters
    ----------
    height
        Of a bump, micrometres; negative for pits.
    size
        Standard deviation of a bump, micrometres, above 0.
    density
        Bumps on a square micrometre, above 0.
    """

    PARAMETERS: ClassVar = {"height": "height", "size": "length", "density": "density"}

    height: Float[Array, ""]
    size: Float[Array, ""]
    density: Float[Array, ""]

    def __init__(self, height: Any, size: Any, density: Any):
        given = {"height": height, "size": size, "density": density}
        self.height, self.size, self.density = parameters(given, Bumps)

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """One surface, drawn by the key, that repeats with the patch.

        Differentiable in height and size; the number of bumps is drawn on the host.
        """
        del edges
        sizes = (self.size, self.size)
        return self.height * bumps(key, y, x, pixel, sizes, float(self.density))[0]

    def spread(self, base: Components, kappa: Float[Array, "*batch"], reach: Reach) -> Components:
        """Each line keeps the mirror's share, and the rest is a continuum around it."""
        many = jnp.broadcast_to(kappa[None], base.weight.shape)
        density, mirror = jnp.vectorize(self._bumps, signature="(),(),()->(),()")(
            2.0 * math.pi * base.x, 2.0 * math.pi * base.y, many
        )
        return dataclasses.replace(
            base,
            weight=base.weight * mirror,
            density=base.density + (base.weight * density).sum(0),
        )

    def _bumps(self, qx: Array, qy: Array, kappa: Array) -> tuple[Array, Array]:
        return ensemble.random_bumps(qx, qy, kappa, self.height, self.size, self.size, self.density)
