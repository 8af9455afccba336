"""Light sources of a scene as arrays, to draw directions towards them.

Lights are grouped into families; one family is picked by its estimated share of the light,
then one of its members. All that picks has no derivative, what is picked has.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.errors import InputError
from diffopt.kernels.frames import dot
from diffopt.lobes import Lobes
from diffopt.rendering.families import Beams, Drawn, Family, LobeSky, Points, Sky, Surfaces
from diffopt.scenes import lights, sky
from diffopt.scenes.scene import Scene
from diffopt.scenes.world import inverse_root, lengthened

# Least share of the choices that a family gets.
_LEAST = 0.05


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
                return found.radiance(towards), chance * found.density(towards)
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
        else:
            known = "Ambient, Directional, Point, Flood, Environment, LobeEnvironment"
            raise InputError(
                f"lights must be of {known}; received {type(light).__name__}, which rendering "
                "does not know"
            )
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
    has_ambient = any(isinstance(light, lights.Ambient) for light in scene.lights)
    return Sources(
        ambient, tuple(families), chances, constant, jnp.asarray(lengthened(entry)), has_ambient
    )


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
