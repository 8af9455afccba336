"""Path tracing: the whole of the rendering equation, with a stated standard error.

Light is drawn at every surface and met by the paths as well, both weighted by the power
heuristic (Veach, "Robust Monte Carlo methods for light transport simulation", 1997, sec. 9.2);
paths end by Russian roulette.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from diffopt.kernels import uniforms
from diffopt.kernels.frames import dot
from diffopt.materials.base import Sample, mask, times
from diffopt.rendering import rows, shading
from diffopt.rendering.groups import Group
from diffopt.rendering.happenings import Parts
from diffopt.rendering.programs import Program
from diffopt.rendering.queries import Queries
from diffopt.rendering.settings import PathSettings
from diffopt.rendering.shading import Rays, Shadow
from diffopt.rendering.sources import Sources
from diffopt.rendering.stage import Stage
from diffopt.scenes.raycasting import Hits
from diffopt.scenes.world import World

# Paths are ended at random from this bounce on.
_ROULETTE = 4
#: Most surfaces that light may be scattered at.
DEEPEST = shading.WORDS // 4 - 2
# Chance that a path goes on, at most.
_MOST = 0.95


@dataclasses.dataclass(frozen=True)
class Paths:
    """Path tracing as a level; see `Level` of `diffopt.rendering.driver`."""

    settings: PathSettings

    def __call__(self, stage: Stage, rays: Rays, queries: Queries, key: PRNGKeyArray) -> Rays:
        """Follow paths to their end."""
        return trace(stage, rays, queries, key, self.settings.depth)


def trace(stage: Stage, rays: Rays, queries: Queries, key: PRNGKeyArray, depth: int) -> Rays:
    """Follow paths to their end.

    Parameters
    ----------
    stage
        The scene, prepared.
    rays
        As they leave the camera.
    queries
        Answers which surfaces they meet.
    key
        Of the random numbers; those of a path follow from its words.
    depth
        Surfaces that light may be scattered at, at most.
    """
    scatter, missed = _scatter, _missed
    if stage.held is not None:
        scatter, missed = _differentiable_scatter, _differentiable_missed
    count, channels = rays.throughput.shape
    size = min(rows.block(), count)
    # The last row takes what padding collects.
    total, home = np.zeros((count + 1, channels), stage.dtype), np.arange(count, dtype=np.int32)
    first = rays
    for bounce in range(depth + 1):
        rays, hits, alive = queries.first(rays)
        if not len(alive):
            break
        for block, wanted in rows.blocks(alive[hits.primitive[alive] < 0], size):
            seen = missed(stage.sources, rows.taken(rays, block))
            total = rows.added(total, _homes(home, block, wanted, count), seen)
        parts, homes = [], []
        number_of = np.asarray(bounce, np.uint32), np.asarray(bounce == depth)
        for number, group, here in stage.by_group(alive, hits):
            held = None if stage.held is None else stage.held[number]
            for block, wanted in rows.blocks(here, size):
                some = shading.alive(rows.taken(rays, block), np.arange(size) < wanted)
                met = rows.taken(hits, block)
                scene = stage.world, stage.sources, stage.member, key
                parts.append(scatter(group, *scene, some, met, *number_of, stage.offset, held))
                homes.append(_homes(home, block, wanted, count))
        if not parts:
            break
        rays, shadow = rows.joined(parts)
        home = np.concatenate(homes)
        light = rays.radiance + rows.where(queries.seen(shadow), shadow.value)
        total = rows.added(total, home, light)
    return eqx.tree_at(lambda r: r.radiance, first, jnp.asarray(total[:count]))


def _homes(home: np.ndarray, block: np.ndarray, wanted: int, count: int) -> np.ndarray:
    """Rows of the camera that the rows of a block come from; `count` for its padding."""
    found = home[block]
    found[wanted:] = count
    return found


def _bounce(
    group: Group,
    world: World,
    sources: Sources,
    member: Array,
    key: PRNGKeyArray,
    rays: Rays,
    hits: Hits,
    bounce: Array | np.ndarray,
    last: Array | np.ndarray,
    offset: Array,
    held: Group | None,
    parts: bool = False,
) -> tuple[Rays, Shadow] | tuple[Rays, Shadow, Parts]:
    """One bounce of rays that meet one group: the light collected, that drawn, the next rays.

    With `parts`, what came to pass is told as well, and the light collected is what surfaces
    emit alone.
    """
    met = shading.meet(group, world, rays, hits, member)
    dtype = met.wo.dtype
    light = met.throughput * shading.emitted(met, sources, rays, drawn=True)
    first = rays.sample * np.uint32(shading.WORDS) + (bounce + np.uint32(1)) * np.uint32(4)
    pairs = [uniforms.at(key, rays.pixel, first + np.uint32(k)) for k in range(4)]
    u = [number.astype(dtype) for pair in pairs for number in pair]

    told = Parts.blank(shading.no_shadow(len(first), group.channels, dtype)) if parts else None
    shadow = shading.no_shadow(len(first), group.channels, dtype)
    if group.kind.smooth and sources.families:
        drawn = sources.draw(jnp.stack(u[:4], -1), met.surface.position)
        towards = drawn.towards
        factor, own = shading.reflected(group, met, towards, densities=held is None)
        if held is not None:
            _, own = shading.reflected(held, met, towards, densities=True)
        weight = jax.lax.stop_gradient(shading.heuristic(drawn.density, own))
        value = met.throughput * factor * drawn.value * weight[:, None]
        value = jnp.where((rays.alive & ~last)[:, None], value, 0.0)
        start = shading.leaving(met.surface, towards, offset)
        length = shading.short_of(drawn.distance, offset)
        shadow = Shadow(*jax.lax.stop_gradient((start, towards, length)), value)
        if told is not None:
            told = told.drawn(group, met, towards, weight, u[3], sources)

    draw = _drawn if held is None else _held
    sample = group.each(draw, met.member, met.surface, jnp.stack(u[4:7], -1), met.wo, beside=held)
    weight = group.converted(sample.weight)
    if told is not None:
        chance, _ = uniforms.at(key, rays.pixel ^ np.uint32(2**31), rays.sample + bounce)
        told, weight = told.scattered(group, met, sample, weight, chance.astype(dtype))
    if sources.has_ambient:
        # It is scattered; perfect mirrors and glass show what is met behind them.
        even = jnp.where(last | sample.delta, 0.0, 1.0).astype(dtype)
        even = even[:, None] * met.throughput * weight * sources.ambient[None]
        if told is None:
            light = light + even
        else:
            told = dataclasses.replace(told, ambient=even)
    towards = met.surface.outwards(sample.wi)
    throughput = met.throughput * shading.kept_above(group, met, towards, weight)
    brightest = jax.lax.stop_gradient(throughput.max(-1))
    # With derivatives all paths go on, so that their chance is no function of the scene.
    first = _ROULETTE if held is None else np.uint32(2**31)
    stays = jnp.where(bounce >= first, jnp.minimum(brightest, _MOST), 1.0)
    lives = rays.alive & (brightest > 0.0) & (u[7] < stays) & ~last
    throughput = throughput / jnp.where(stays > 0.0, stays, 1.0)[:, None]
    fixed = jax.lax.stop_gradient((shading.leaving(met.surface, towards, offset), towards))
    density = jax.lax.stop_gradient(jnp.where(sample.delta, jnp.inf, sample.pdf))
    onwards = Rays(*fixed, throughput, density, light, lives, rays.pixel, rays.sample)
    return (onwards, shadow) if told is None else (onwards, shadow, told)


# Derivatives cannot pass a program with options of its own.
_scatter, _differentiable_scatter = Program(_bounce), eqx.filter_jit(_bounce)
_missed, _differentiable_missed = (f(shading.surroundings) for f in (Program, eqx.filter_jit))


def _drawn(material: Any, u: Array, wo: Array) -> Sample:
    return material.scatter(u, wo)


def _held(material: Any, held: Any, u: Array, wo: Array) -> Sample:
    """A sample as another material drew it, with the weight that it has for this one.

    Its weight is f cos / density with the density of the other, so that means over directions
    have the derivative of the integral.
    """
    drawn = held.scatter(u, wo)
    smooth = jnp.zeros_like(drawn.weight)
    if material.smooth:
        possible = drawn.pdf > 0.0
        ratio = jnp.where(possible, jnp.abs(drawn.wi[..., 2]), 0.0)
        ratio = ratio / jnp.where(possible, drawn.pdf, 1.0)
        smooth = times(ratio, material._reflected(drawn.wi, wo)) + smooth
    if not material.delta:
        return Sample(drawn.wi, smooth, drawn.pdf, drawn.delta)
    now = known = jnp.zeros_like(drawn.weight)
    for lobe, other in zip(material.coherent(wo), held.coherent(wo), strict=True):
        off = other.wi - drawn.wi
        here = dot(off, off) < 1e-6
        now, known = now + mask(here, lobe.weight), known + mask(here, other.weight)
    share = jnp.where(known > 0.0, drawn.weight / jnp.where(known > 0.0, known, 1.0), 0.0)
    weight = mask(drawn.delta, share * now) + mask(~drawn.delta, smooth)
    return Sample(drawn.wi, weight, drawn.pdf, drawn.delta)
