"""Kinds of light sources as arrays: what each sends to a point, and how it is drawn."""

import abc
import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames, vmf_sampling, warps
from diffopt.kernels.frames import dot
from diffopt.lobes import Lobes
from diffopt.scenes import sky
from diffopt.scenes.world import cross, inverse_root


class Drawn(eqx.Module):
    """Light from one source at points.

    Attributes
    ----------
    towards
        Unit vectors to it, [n, 3].
    distance
        [n], infinite for what surrounds the scene.
    value
        Radiance over the density, or irradiance of sources in one direction, [n, C].
    density
        Per steradian, [n]; infinite for sources in one direction.
    """

    towards: Float[Array, "n 3"]
    distance: Float[Array, " n"]
    value: Float[Array, "n C"]
    density: Float[Array, " n"]


class Family(eqx.Module):
    """Sources of one kind."""

    @abc.abstractmethod
    def strength(self, radius: float) -> Float[Array, " C"]:
        """Rough irradiance that they send into a scene of a radius; for the choice only."""

    @abc.abstractmethod
    def draw(self, u: Float[Array, "n 3"], position: Float[Array, "n 3"]) -> Drawn:
        """Light from one of them, by numbers in [0, 1)."""


class Beams(Family):
    """Parallel light: directions to it [k, 3] and irradiance [k, C]."""

    towards: Float[Array, "k 3"]
    irradiance: Float[Array, "k C"]

    def strength(self, radius: float) -> Array:
        """See `Family`."""
        return self.irradiance.sum(0)

    def at(self, index: Array, position: Array) -> Drawn:
        """Light of one for each point."""
        far = jnp.full(index.shape, jnp.inf, position.dtype)
        return Drawn(self.towards[index], far, self.irradiance[index], far)

    def draw(self, u: Array, position: Array) -> Drawn:
        """See `Family`."""
        return _one_of(self, self.irradiance.shape[0], u, position)


class Points(Family):
    """Light from points.

    Attributes
    ----------
    position, aim
        [k, 3].
    intensity
        Along the aim, [k, C].
    exponent
        Of the cosine to the aim, [k]; 0: to all sides alike.
    falloff
        a, m, b of 1 / (a d^m + b), [k, 3].
    """

    position: Float[Array, "k 3"]
    aim: Float[Array, "k 3"]
    intensity: Float[Array, "k C"]
    exponent: Float[Array, " k"]
    falloff: Float[Array, "k 3"]

    def strength(self, radius: float) -> Array:
        """See `Family`."""
        return (self.intensity * self._decrease(self.falloff, radius)[:, None]).sum(0)

    def at(self, index: Array, position: Array) -> Drawn:
        """Light of one for each point."""
        offset = self.position[index] - position
        square = dot(offset, offset)
        one_over = inverse_root(square)
        towards, distance = offset * one_over[:, None], square * one_over
        cos = -dot(towards, self.aim[index])
        lit = cos > 0.0
        exponent = self.exponent[index]
        power = exponent * jnp.log(jnp.where(lit, cos, 1.0))
        beam = jnp.where(lit | (exponent == 0.0), jnp.exp(power), 0.0)
        factor = beam * self._decrease(self.falloff[index], distance)
        far = jnp.full(index.shape, jnp.inf, position.dtype)
        return Drawn(towards, distance, factor[:, None] * self.intensity[index], far)

    def draw(self, u: Array, position: Array) -> Drawn:
        """See `Family`."""
        return _one_of(self, self.exponent.shape[0], u, position)

    @staticmethod
    def _decrease(falloff: Array, distance: Any) -> Array:
        a, m, b = falloff[:, 0], falloff[:, 1], falloff[:, 2]
        tiny = float(jnp.finfo(falloff.dtype).tiny)
        power = jnp.exp(m * jnp.log(jnp.maximum(distance, 1e-18)))
        return 1.0 / jnp.maximum(a * power + b, tiny)


class Surfaces(Family):
    """Triangles, spheres and discs that emit light from their front.

    Attributes
    ----------
    corner, one, two
        Of triangles, the first corner and the edges from it; of spheres and discs, the centre
        and for discs two perpendicular radii, [k, 3].
    radius
        Of spheres, [k]; 0 for others.
    is_disc
        Whether it is one, [k].
    area
        [k].
    radiance
        [k, C].
    ends
        Where the shares of the choice end, [k].
    """

    corner: Float[Array, "k 3"]
    one: Float[Array, "k 3"]
    two: Float[Array, "k 3"]
    radius: Float[Array, " k"]
    is_disc: Float[Array, " k"]
    area: Float[Array, " k"]
    radiance: Float[Array, "k C"]
    ends: Float[Array, " k"]

    def strength(self, radius: float) -> Array:
        """See `Family`."""
        return (self.radiance * self.area[:, None]).sum(0) / radius**2

    @property
    def shares(self) -> Float[Array, " k"]:
        """Chance of each."""
        return jnp.diff(self.ends, prepend=jnp.zeros(1, self.ends.dtype))

    def pick(self, u: Float[Array, " n"]) -> Int[Array, " n"]:
        """Which of them, by their shares."""
        index = jnp.searchsorted(self.ends, u, side="right", method="compare_all")
        return jnp.minimum(index, self.ends.shape[0] - 1)

    def place(
        self, index: Int[Array, " n"], u: Float[Array, "n 2"]
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """Points spread evenly over the shapes, and the normals there."""
        root = jnp.sqrt(u[:, 0])
        s, t = 1.0 - root, u[:, 1] * root
        spiral = warps.cosine_hemisphere(u)
        disc = (self.is_disc[index] > 0.0)[:, None]
        along = jnp.where(disc, spiral[:, :1], s[:, None])
        across = jnp.where(disc, spiral[:, 1:2], t[:, None])
        flat = self.corner[index] + along * self.one[index] + across * self.two[index]
        normal = cross_unit(self.one[index], self.two[index])
        ball = (self.radius[index] > 0.0)[:, None]
        z = 1.0 - 2.0 * u[:, 0]
        round_ = frames.around(jnp.sqrt(jnp.maximum(1.0 - z * z, 0.0)), u[:, 1], z)
        on_ball = self.corner[index] + self.radius[index][:, None] * round_
        return jnp.where(ball, on_ball, flat), jnp.where(ball, round_, normal)

    def draw(self, u: Array, position: Array) -> Drawn:
        """See `Family`."""
        index = self.pick(u[:, 2])
        share = self.shares[index]
        point, normal = self.place(index, u[:, :2])
        offset = point - position
        square = dot(offset, offset)
        one_over = inverse_root(square)
        towards, distance = offset * one_over[:, None], square * one_over
        cos = -dot(towards, normal)
        density = share * square / (self.area[index] * jnp.maximum(cos, 1e-9))
        density = jnp.where(cos > 0.0, density, 0.0)
        use, ways, length, per = self._cone(index, u, position)
        towards = jnp.where(use[:, None], ways, towards)
        distance = jnp.where(use, length, distance)
        density = jnp.where(use, share * per, density)
        seen = density > 0.0
        inverse = jnp.where(seen, 1.0 / jnp.where(seen, density, 1.0), 0.0)
        return Drawn(towards, distance, inverse[:, None] * self.radiance[index], density)

    def density(
        self, index: Int[Array, " n"], origin: Array, towards: Array, distance: Array, cos: Array
    ) -> Float[Array, " n"]:
        """Density of `draw` for a ray that meets a source, whose front it meets at a cosine."""
        share = self.shares[index]
        even = share * distance**2 / (self.area[index] * jnp.maximum(cos, 1e-9))
        sine2, outside = self._opening(index, origin)
        per = 1.0 / (2.0 * math.pi * _one_minus_root(sine2))
        found = jnp.where(outside, share * per, even)
        return jnp.where(cos > 0.0, found, 0.0)

    def _opening(self, index: Array, position: Array) -> tuple[Array, Array]:
        """Square of the sine of half the angle that a sphere fills, and whether it does."""
        offset = self.corner[index] - position
        square = dot(offset, offset)
        radius2 = self.radius[index] ** 2
        outside = (radius2 > 0.0) & (square > 1.0001 * radius2)
        sine2 = jnp.where(outside, radius2 / jnp.where(outside, square, 1.0), 0.5)
        return jnp.maximum(sine2, 1e-12), outside

    def _cone(self, index: Array, u: Array, position: Array) -> tuple[Array, ...]:
        """Directions spread evenly over the angle that a sphere fills."""
        sine2, outside = self._opening(index, position)
        offset = self.corner[index] - position
        square = jnp.maximum(dot(offset, offset), jnp.finfo(u.dtype).tiny)
        axis = offset * inverse_root(square)[:, None]
        whole = _one_minus_root(sine2)
        less = u[:, 0] * whole  # 1 - cos
        sin2 = less * (2.0 - less)
        local = frames.around(jnp.sqrt(jnp.maximum(sin2, 1e-30)), u[:, 1], 1.0 - less)
        x, y = frames.tangents(axis)
        ways = local[:, :1] * x + local[:, 1:2] * y + local[:, 2:] * axis
        inside = jnp.maximum(self.radius[index] ** 2 - square * sin2, 0.0)
        length = jnp.sqrt(square) * (1.0 - less) - jnp.sqrt(inside)
        return outside, ways, length, 1.0 / (2.0 * math.pi * whole)


class Sky(Family):
    """An environment map, see `diffopt.scenes.sky`."""

    map: sky.Map

    def strength(self, radius: float) -> Array:
        """See `Family`."""
        return math.pi * self.map.mean()

    def draw(self, u: Array, position: Array) -> Drawn:
        """See `Family`."""
        towards, density = self.map.draw(u[:, :2])
        value = self.radiance(towards) / density[:, None]
        return Drawn(towards, jnp.full(density.shape, jnp.inf, u.dtype), value, density)

    def density(self, towards: Array) -> Array:
        """Density of `draw` per steradian."""
        return self.map.density(towards)

    def radiance(self, towards: Array) -> Array:
        """Radiance from directions, [n, C]."""
        return self.map.radiance(towards)


class LobeSky(Family):
    """Lobes of radiance over directions.

    Attributes
    ----------
    lobes
        The radiance, alpha [K, C].
    drawn
        The density of directions, alpha [K].
    """

    lobes: Lobes
    drawn: Lobes

    def strength(self, radius: float) -> Array:
        """See `Family`."""
        return 0.25 * self.lobes.integral()

    def draw(self, u: Array, position: Array) -> Drawn:
        """See `Family`."""
        share, mu, kappa = self.drawn.arrays
        index = jnp.searchsorted(jnp.cumsum(share), u[:, 2], side="right", method="compare_all")
        index = jnp.minimum(index, share.shape[0] - 1)
        towards = vmf_sampling.warp(u[:, :2], mu[index], kappa[index])
        density = self.density(towards)
        seen = density > 0.0
        inverse = jnp.where(seen, 1.0 / jnp.where(seen, density, 1.0), 0.0)
        value = self.radiance(towards) * inverse[:, None]
        return Drawn(towards, jnp.full(density.shape, jnp.inf, u.dtype), value, density)

    def density(self, towards: Array) -> Array:
        """Density of `draw` per steradian."""
        return self.drawn._values(towards)

    def radiance(self, towards: Array) -> Array:
        """Radiance from directions, [n, C]."""
        return self.lobes._values(towards)


def _one_of(family: Any, count: int, u: Array, position: Array) -> Drawn:
    """Light of one member, all with the same chance."""
    index = jnp.minimum((u[:, 2] * count).astype(jnp.int32), count - 1)
    found = family.at(index, position)
    return Drawn(found.towards, found.distance, found.value * float(count), found.density)


def _one_minus_root(square: Array) -> Array:
    """1 - sqrt(1 - x), without cancellation."""
    return square / (1.0 + jnp.sqrt(1.0 - square))


def cross_unit(a: Array, b: Array) -> Array:
    """Unit vectors square to two."""
    normal = cross(a, b)
    return normal * inverse_root(dot(normal, normal))[:, None]
