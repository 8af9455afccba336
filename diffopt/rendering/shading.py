"""What every level of image synthesis does where a ray meets a surface.

The state of many rays is kept in arrays of one length N; a program treats the rows of one
group of materials, padded to a block, so that each group is compiled once. Rows beyond N are
padding.
"""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from diffopt.kernels.frames import dot
from diffopt.rendering.families import Surfaces
from diffopt.rendering.groups import Group
from diffopt.rendering.sources import Sources
from diffopt.scenes import world
from diffopt.scenes.raycasting import Hits
from diffopt.scenes.world import Surface, World

#: Rows of one call.
BLOCK = 8192
#: Counters of random numbers that a path has: four for each bounce, and four for the camera.
WORDS = 4096


class Rays(eqx.Module):
    """Rays on their way.

    Attributes
    ----------
    origin, direction
        [N, 3].
    throughput
        Share of the light from their direction that reaches the camera, [N, C].
    density
        With which their direction was drawn, per steradian, [N]; infinite where it was not.
    radiance
        What they have collected, [N, C].
    alive
        Whether they go on, [N].
    pixel, sample
        Words that their random numbers follow from, [N].
    """

    origin: Float[Array, "N 3"]
    direction: Float[Array, "N 3"]
    throughput: Float[Array, "N C"]
    density: Float[Array, " N"]
    radiance: Float[Array, "N C"]
    alive: Bool[Array, " N"]
    pixel: UInt32[Array, " N"]
    sample: UInt32[Array, " N"]


class Shadow(eqx.Module):
    """Light that arrives if nothing is in its way.

    Attributes
    ----------
    origin, towards, length
        The way, [N, 3], [N, 3], [N].
    value
        What arrives at the camera, [N, C].
    """

    origin: Float[Array, "N 3"]
    towards: Float[Array, "N 3"]
    length: Float[Array, " N"]
    value: Float[Array, "N C"]


class Meeting(eqx.Module):
    """Where rows of rays meet surfaces of one group.

    Attributes
    ----------
    surface
        As the viewer sees it.
    wo
        Direction to the viewer in the material's frame, [n, 3].
    front
        Whether he sees the front, [n].
    member
        Of the group, [n].
    primitive, distance
        What was met, and how far away, [n].
    throughput
        Of the rays, [n, C].
    """

    surface: Surface
    wo: Float[Array, "n 3"]
    front: Bool[Array, " n"]
    member: Int[Array, " n"]
    primitive: Int[Array, " n"]
    distance: Float[Array, " n"]
    throughput: Float[Array, "n C"]


def camera_rays(
    origin: Any, direction: Any, channels: int, dtype: Any, pixel: Any = None, sample: Any = None
) -> Rays:
    """Rays as they leave the camera."""
    count = len(origin)
    none = np.zeros(count, np.uint32)
    return Rays(
        jnp.asarray(origin, dtype),
        jnp.asarray(direction, dtype),
        jnp.ones((count, channels), dtype),
        jnp.full(count, jnp.inf, dtype),
        jnp.zeros((count, channels), dtype),
        jnp.full(count, True),
        jnp.asarray(none if pixel is None else pixel),
        jnp.asarray(none if sample is None else sample),
    )


def alive(rays: Rays, which: Bool[Array | np.ndarray, " N"]) -> Rays:
    """The rays, of which only some go on."""
    return eqx.tree_at(lambda r: r.alive, rays, which)


def dead(rays: Rays) -> Rays:
    """As many rays that are not alive and have collected nothing."""
    return eqx.tree_at(
        lambda r: (r.alive, r.radiance),
        rays,
        (jnp.zeros_like(rays.alive), jnp.zeros_like(rays.radiance)),
    )


def cast(
    shadow: Shadow,
    rows: Int[Array, " n"],
    way: tuple[Array, Array, Array],
    value: Float[Array, "n C"],
) -> Shadow:
    """Put light of rows into a `Shadow`: the way to it, and what arrives."""
    wholes = shadow.origin, shadow.towards, shadow.length, shadow.value
    parts = (*way, value)
    return Shadow(*(w.at[rows].set(p, mode="drop") for w, p in zip(wholes, parts, strict=True)))


@functools.lru_cache(maxsize=16)
def no_shadow(count: int, channels: int, dtype: Any) -> Shadow:
    """Nothing that could be shaded."""
    # Constants also where the caller is being traced.
    with jax.ensure_compile_time_eval():
        return Shadow(
            jnp.zeros((count, 3), dtype),
            jnp.zeros((count, 3), dtype).at[:, 2].set(1.0),
            jnp.zeros(count, dtype),
            jnp.zeros((count, channels), dtype),
        )


def blocks(rows: Int[np.ndarray, " n"], count: int) -> list[Int[Array, " B"]]:
    """Numbers of rows in blocks of `BLOCK` (or all N where there are fewer), padded with N."""
    size = min(BLOCK, count)
    padded = np.full(-(-len(rows) // size) * size, count, np.int32)
    padded[: len(rows)] = rows
    return [jnp.asarray(block) for block in padded.reshape(-1, size)]


def chosen(rays: Rays, hits: Hits, rows: Int[Array, " n"]) -> tuple[Rays, Hits]:
    """Some of the rays and what they meet; any for padding."""
    at = jnp.minimum(rows, rays.origin.shape[0] - 1)
    return jax.tree.map(lambda a: a[at], (rays, hits))


def meet(group: Group, scene: World, rays: Rays, hits: Hits, member: Array) -> Meeting:
    """Where rays meet surfaces of a group."""
    # Padding may have met nothing.
    primitive = jnp.maximum(jnp.asarray(hits.primitive), 0)
    distance = jnp.asarray(hits.distance)
    distance = jnp.where(jnp.isfinite(distance), distance, 0.0).astype(rays.origin.dtype)
    direction = rays.direction
    reached = rays.origin + distance[:, None] * direction
    u, v = (jnp.asarray(a).astype(direction.dtype) for a in (hits.u, hits.v))
    found = world.surface(scene, primitive, u, v, reached)
    seen, front = world.facing(found, -direction, both=group.transmits)
    wo = seen.local(-direction)
    return Meeting(seen, wo, front, member[primitive], primitive, distance, rays.throughput)


def emitted(met: Meeting, sources: Sources, rays: Rays, *, drawn: bool) -> Float[Array, "n C"]:
    """Radiance that the surfaces emit towards the viewer.

    Parameters
    ----------
    met
        Where rays meet them.
    sources
        The lights.
    rays
        Those that meet them.
    drawn
        Whether the light was drawn as well, at the surface before: it then gets the rest of
        the weight, by the power heuristic of Veach (1997).
    """
    family, chance = sources.family(Surfaces)
    if family is None:
        return jnp.zeros_like(met.throughput)
    entry = sources.entry[met.primitive]
    index = jnp.maximum(entry, 0)
    lit = (entry >= 0) & met.front
    weight = lit.astype(met.wo.dtype)
    if drawn:
        towards = rays.direction
        cos = -dot(towards, met.surface.geometric)
        other = chance * family.density(index, rays.origin, towards, met.distance, cos)
        weight = weight * heuristic(rays.density, other)
    return weight[:, None] * family.radiance[index]


def heuristic(own: Array, other: Array) -> Array:
    """Weight of one way to draw a direction beside another one: squares of their densities."""
    certain = jnp.isinf(own)
    ratio = other / jnp.where(certain | (own <= 0.0), 1.0, own)
    return jnp.where(certain, 1.0, 1.0 / (1.0 + ratio * ratio))


def reflected(
    group: Group, met: Meeting, towards: Float[Array, "n 3"], *, densities: bool
) -> tuple[Float[Array, "n C"], Float[Array, " n"]]:
    """F times the cosine for light from directions in the world, and the density of sampling.

    Light from below the shape itself is left out, also where the interpolated normal faces it.
    """
    wi = met.surface.local(towards)

    def one(material: Any, wi: Array, wo: Array) -> Any:
        value = material._reflected(wi, wo)
        return value, material.density(wi, wo) if densities else wi[..., 2]

    value, density = group.each(one, met.member, met.surface, wi, met.wo)
    value = group.converted(value) * jnp.abs(wi[:, 2:])
    return kept_above(group, met, towards, value), density


def kept_above(
    group: Group, met: Meeting, towards: Float[Array, "n 3"], value: Float[Array, "n C"]
) -> Float[Array, "n C"]:
    """Values of directions on the viewer's side, 0 on the other one unless light passes."""
    if group.transmits:
        return value
    side = jnp.where(met.front, 1.0, -1.0).astype(towards.dtype)
    above = side * dot(met.surface.geometric, towards) > 0.0
    return jnp.where(above[:, None], value, 0.0)


def short_of(distance: Float[Array | np.ndarray, " n"], offset: Any) -> Float[Array, " n"]:
    """Length of a ray to a light that ends just before the light's own surface."""
    return jnp.maximum(distance * (1.0 - 1e-4) - 2.0 * offset, 0.0)


@eqx.filter_jit
def missed(sources: Sources, rays: Rays, rows: Int[Array, " n"]) -> Rays:
    """Rays of which some see the surroundings, weighted as in `emitted`."""
    at = jnp.minimum(rows, rays.origin.shape[0] - 1)
    found = surroundings(sources, jax.tree.map(lambda a: a[at], rays))
    collected = rays.radiance.at[rows].add(found, mode="drop")
    return eqx.tree_at(lambda r: r.radiance, rays, collected)


def surroundings(sources: Sources, rays: Rays) -> Float[Array, "n C"]:
    """Light that rays bring from the surroundings, weighted as in `emitted`."""
    radiance, density = sources.surrounding(rays.direction)
    weight = heuristic(rays.density, density)
    return rays.throughput * weight[:, None] * radiance


def leaving(surface: Surface, towards: Float[Array, "n 3"], offset: Any) -> Float[Array, "n 3"]:
    """Where rays leave a surface: just above it on their side."""
    side = jnp.where(dot(surface.geometric, towards) >= 0.0, offset, -offset)
    return surface.position + side.astype(towards.dtype)[:, None] * surface.geometric
