"""Light sources of a scene as arrays, to draw directions towards them.

Lights are grouped into families; one family is picked by its estimated share of the light,
then one of its members. All that picks has no derivative, what is picked has.
"""

import abc
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames, vmf_sampling, warps
from diffopt.kernels.frames import dot
from diffopt.lobes import Lobes
from diffopt.scenes import lights, sky
from diffopt.scenes.scene import Scene
from diffopt.scenes.world import cross, inverse_root, lengthened

# Least share of the choices that a family gets.
_LEAST = 0.05


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

    def pick(self, u: Float[Array, " n"]) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
        """Which of them, and what is left of the number."""
        index = jnp.searchsorted(self.ends, u, side="right", method="compare_all")
        index = jnp.minimum(index, self.ends.shape[0] - 1)
        share = self.shares[index]
        start = self.ends[index] - share
        rest = (u - start) / jnp.maximum(share, jnp.finfo(u.dtype).tiny)
        return index, jnp.clip(rest, 0.0, 1.0)

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
        index, rest = self.pick(u[:, 2])
        del rest
        share = self.shares[index]
        point, normal = self.place(index, u[:, :2])
        offset = point - position
        square = dot(offset, offset)
        one_over = inverse_root(square)
        towards, distance = offset * one_over[:, None], square * one_over
        cos = -dot(towards, normal)
        density = share * square / (self.area[index] * jnp.maximum(cos, 1e-9))
        density = jnp.where(cos > 0.0, density, 0.0)
        if self.radius.shape[0]:
            cone = self._cone(index, u, position)
            use, ways, length, per = cone
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
        value = self.map.radiance(towards) / density[:, None]
        return Drawn(towards, jnp.full(density.shape, jnp.inf, u.dtype), value, density)


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


class Sources(eqx.Module):
    """All lights of a scene.

    Attributes
    ----------
    ambient
        Radiance of ambient light, [C].
    families
        What is drawn from.
    chances
        Of the families, adding up to 1.
    constant
        Radiance of an even environment, [C]: it is met, not drawn.
    entry
        Of each primitive, its place in `Surfaces`; -1 where it emits nothing, [P], padded.
    has_ambient
        Whether there is ambient light; what it needs is left out otherwise.
    """

    ambient: Float[Array, " C"]
    families: tuple[Family, ...]
    chances: Float[Array, " F"]
    constant: Float[Array, " C"] | None
    entry: Int[Array, " P"]
    has_ambient: bool = eqx.field(static=True)

    def family(self, kind: type) -> tuple[Any, Float[Array, ""]]:
        """Sources of one kind and the chance of their family; None where there are none."""
        for k, one in enumerate(self.families):
            if isinstance(one, kind):
                return one, self.chances[k]
        return None, jnp.zeros((), self.chances.dtype)

    def draw(self, u: Float[Array, "n 4"], position: Float[Array, "n 3"]) -> Drawn:
        """Light from one source at each point, divided by the chance of its family."""
        ends = jnp.cumsum(self.chances)
        drawn = None
        for k, one in enumerate(self.families):
            found = one.draw(u[:, :3], position)
            chance = self.chances[k]
            found = Drawn(
                found.towards, found.distance, found.value / chance, found.density * chance
            )
            if drawn is None:
                drawn = found
            else:
                here = u[:, 3] >= ends[k - 1]
                drawn = jax.tree.map(
                    lambda a, b, here=here: jnp.where(here[:, None] if a.ndim > 1 else here, a, b),
                    found,
                    drawn,
                )
        assert drawn is not None, "there are no lights to draw from"
        return drawn

    def surrounding(self, towards: Float[Array, "n 3"]) -> tuple[Array, Array]:
        """Radiance of the environment, [n, C], and the density of `draw` there, [n]."""
        none = jnp.zeros(towards.shape[:1], towards.dtype)
        if self.constant is not None:
            return jnp.broadcast_to(self.constant, (len(none), self.constant.size)), none
        for kind in (Sky, LobeSky):
            found, chance = self.family(kind)
            if found is not None:
                of = found.map if kind is Sky else found
                return of.radiance(towards), chance * of.density(towards)
        return jnp.broadcast_to(jnp.zeros_like(self.ambient), (len(none), self.ambient.size)), none


def gather(scene: Scene, dtype: Any) -> Sources:
    """The lights of a scene in a floating type; differentiable."""
    channels, geometry = scene.channels, scene.geometry

    def values(name: str, value: Any) -> Array:
        return channels.values(name, value).astype(dtype)

    ambient = jnp.zeros(channels.count, dtype)
    beams, points, constant = [], [], None
    families: list[Family] = []
    for light in scene.lights:
        if isinstance(light, lights.Ambient):
            ambient = ambient + values("radiance", light.radiance)
        elif isinstance(light, lights.Directional):
            towards = light.towards.astype(dtype)
            towards = towards * inverse_root(dot(towards, towards))
            beams.append((towards, values("irradiance", light.irradiance)))
        elif isinstance(light, lights.Point | lights.Flood):
            points.append(_point(light, values, dtype))
        elif isinstance(light, lights.LobeEnvironment):
            found = light.lobes
            alpha = found.alpha[:, None] if found.alpha.ndim == 1 else found.alpha
            where = found.mu.astype(dtype), found.kappa.astype(dtype)
            lobes = Lobes(channels.converted(alpha.astype(dtype)), *where)
            drawn = jax.lax.stop_gradient(Lobes(lobes._share(), *where))
            families.append(LobeSky(lobes, drawn))
        elif isinstance(light, lights.Environment):
            if light.is_map:
                families.append(Sky(sky.Map(light, channels, dtype)))
            else:
                constant = values("radiance", light.radiance) * light.scale.astype(dtype)
    if beams:
        families.append(Beams(*(jnp.stack(part) for part in zip(*beams, strict=True))))
    if points:
        families.append(Points(*(jnp.stack(part) for part in zip(*points, strict=True))))
    emitting = np.array([one.emission is not None for one in scene.objects], bool)
    primitives = np.flatnonzero(emitting[geometry.owner]) if len(emitting) else np.zeros(0, int)
    entry = np.full(len(geometry.owner), -1, np.int32)
    entry[primitives] = np.arange(len(primitives))
    luminance = jnp.asarray(channels.luminance(), dtype)
    if len(primitives):
        families.append(_surfaces(scene, primitives, luminance, dtype))
    strength = [jnp.dot(one.strength(geometry.radius), luminance) for one in families]
    chances = jnp.stack(strength) if strength else jnp.zeros(0, dtype)
    chances = jax.lax.stop_gradient(chances)
    total = chances.sum()
    even = 1.0 / max(len(families), 1)
    chances = jnp.where(total > 0.0, chances / jnp.where(total > 0.0, total, 1.0), even)
    chances = (1.0 - _LEAST) * chances + _LEAST * even
    if len(entry):
        entry = lengthened(entry, 1 << (len(entry) - 1).bit_length())
    has_ambient = any(isinstance(light, lights.Ambient) for light in scene.lights)
    return Sources(ambient, tuple(families), chances, constant, jnp.asarray(entry), has_ambient)


def chosen_as(lights: Sources, other: Sources) -> Sources:
    """The lights, chosen among as among others that differ in their numbers only."""
    families = []
    for one, fixed in zip(lights.families, other.families, strict=True):
        if isinstance(one, Surfaces):
            one = eqx.tree_at(lambda f: f.ends, one, fixed.ends)  # type: ignore[attr-defined]
        elif isinstance(one, Sky):
            one = eqx.tree_at(
                lambda f: (f.map.rows, f.map.columns),
                one,
                (fixed.map.rows, fixed.map.columns),  # type: ignore[attr-defined]
            )
        elif isinstance(one, LobeSky):
            one = eqx.tree_at(lambda f: f.drawn, one, fixed.drawn)  # type: ignore[attr-defined]
        families.append(one)
    return eqx.tree_at(lambda s: (s.families, s.chances), lights, (tuple(families), other.chances))


def _point(light: Any, values: Any, dtype: Any) -> tuple[Array, ...]:
    aim, exponent = jnp.asarray([0.0, 0.0, 1.0], dtype), jnp.zeros((), dtype)
    if isinstance(light, lights.Flood):
        aim, exponent = light.aim.astype(dtype), light.exponent.astype(dtype)
        aim = aim * inverse_root(dot(aim, aim))
    of = light.falloff
    falloff = jnp.stack([part.astype(dtype) for part in (of.a, of.m, of.b)])
    intensity = values("intensity", light.intensity)
    return light.position.astype(dtype), aim, intensity, exponent, falloff


def _surfaces(scene: Scene, primitives: np.ndarray, luminance: Array, dtype: Any) -> Surfaces:
    geometry = scene.geometry
    world, triangles = geometry.world, geometry.world.counts[0]
    flat = primitives < triangles
    corners = np.asarray(world.vertices)[np.asarray(world.faces)[primitives[flat]]]
    which = primitives[~flat] - triangles
    radii, axes = np.asarray(world.radii)[which], np.asarray(world.axes)[which]
    ball = which < world.spheres

    def both(first: np.ndarray, second: np.ndarray) -> Array:
        out = np.zeros((len(primitives), *first.shape[1:]))
        out[flat], out[~flat] = first, second
        return jnp.asarray(out, dtype)

    size = radii[:, None]
    area = geometry.areas[primitives]
    radiance = scene.emission().astype(dtype)[geometry.owner[primitives]]
    power = jax.lax.stop_gradient(jnp.dot(radiance, luminance)) * jnp.asarray(area, dtype)
    ends = jnp.cumsum(power)
    dark = ends[-1] <= 0.0
    ends = jnp.where(dark, jnp.asarray(np.cumsum(area) / area.sum(), dtype), ends)
    none = np.zeros(flat.sum())
    return Surfaces(
        corner=both(corners[:, 0], np.asarray(world.centres)[which]),
        one=both(corners[:, 1] - corners[:, 0], size * axes[:, :, 0]),
        two=both(corners[:, 2] - corners[:, 0], size * axes[:, :, 1]),
        radius=both(none, np.where(ball, radii, 0.0)),
        is_disc=both(none, np.where(ball, 0.0, 1.0)),
        area=jnp.asarray(area, dtype),
        radiance=radiance,
        ends=ends / ends[-1],
    )


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
