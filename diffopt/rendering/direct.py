"""Levels that leave out the coupling of surfaces, or all of it but perfect mirrors and glass.

Incremental shading: light of abstract sources, scattered once; transparent surfaces are looked
through as if their index were 1. Recursive ray tracing: with shadows, and coherent reflection
and refraction to a depth. (The three levels are those of the chapter on image synthesis by
Szirmay-Kalos, section 3.7.)
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray

from diffopt.kernels import frames
from diffopt.materials.base import mask
from diffopt.rendering import shading
from diffopt.rendering.albedos import Albedos, albedos
from diffopt.rendering.effects import EVERYTHING, Composition
from diffopt.rendering.groups import Group
from diffopt.rendering.queries import Queries
from diffopt.rendering.settings import IncrementalSettings
from diffopt.rendering.shading import Meeting, Rays, Shadow
from diffopt.rendering.smoothing import Field
from diffopt.rendering.sources import Sources
from diffopt.rendering.stage import Stage
from diffopt.rendering.standins import StandIns, stand_ins
from diffopt.scenes.raycasting import Hits
from diffopt.scenes.world import World

# Rays that bring less than this share of the light are not followed.
_FAINT = 1e-4


class Direct:
    """A level that scatters light once; see `Level` of `diffopt.rendering.driver`.

    Parameters
    ----------
    settings
        `IncrementalSettings` or `RecursiveSettings`.
    ambient
        Radiance of even light beside the scene's own, [C]; None for none.
    composition
        Which effects are in, of those that the level has: what is seen, coherent reflection
        and refraction, and on what shadows fall.

    Attributes
    ----------
    field
        Radiance of even light over the surfaces, see `diffopt.rendering.smoothing`; None for
        none.
    """

    def __init__(
        self,
        settings: IncrementalSettings,
        ambient: Any = None,
        composition: Composition = EVERYTHING,
    ) -> None:
        self.settings, self.composition = settings, composition
        self.depth = min(settings.depth, composition.mirrors)
        self.ambient = ambient
        self.field: Field | None = None
        self._prepared: tuple[Stage, StandIns, list[Albedos | None]] | None = None

    @property
    def straight(self) -> bool:
        """Whether transparent surfaces are looked through."""
        return self.settings.level == "incremental"

    def __call__(self, stage: Stage, rays: Rays, queries: Queries, key: PRNGKeyArray) -> Rays:
        """Follow rays."""
        lights, tables = self._prepare(stage)
        count, total = rays.origin.shape[0], rays.radiance
        homes = np.arange(count, dtype=np.uint32)
        waves = [eqx.tree_at(lambda r: r.pixel, rays, jnp.asarray(homes))]
        for depth in range(self.depth + 1):
            more: list[Rays] = []
            for wave in waves:
                wave, born = self._wave(stage, wave, queries, lights, tables)
                total = _gathered(total, wave)
                more += born
            if depth < self.depth:
                waves = queries.packed(more, count)
            if not waves or depth == self.depth:
                break
        return eqx.tree_at(lambda r: r.radiance, rays, total)

    def _prepare(self, stage: Stage) -> tuple[StandIns, list[Albedos | None]]:
        """Abstract lights and albedos of a stage, made once."""
        if self._prepared is None or self._prepared[0] is not stage:
            lights = stand_ins(stage.sources, self.settings.light_samples, self.settings.shadows)
            if self.ambient is not None:
                extra = jnp.asarray(self.ambient, stage.dtype)
                lights = eqx.tree_at(lambda s: s.ambient, lights, lights.ambient + extra)
            extra_light = self.ambient is not None or self.field is not None
            needed = extra_light or lights.has_ambient or lights.even is not None
            tables = [albedos(group) if needed else None for group in stage.groups]
            self._prepared = stage, lights, tables
        return self._prepared[1:]

    def _wave(
        self,
        stage: Stage,
        rays: Rays,
        queries: Queries,
        lights: StandIns,
        tables: list[Albedos | None],
    ) -> tuple[Rays, list[Rays]]:
        """What rays of one depth collect, and the rays that follow from them."""
        what = self.composition
        count, channels = rays.throughput.shape
        rays, hits, alive = queries.first(rays)
        gone = alive[hits.primitive[alive] < 0] if what.holds("surroundings") else alive[:0]
        for rows in shading.blocks(gone, count):
            rays = shading.missed(stage.sources, rays, rows)
        parts, born = [], []
        dead = shading.dead(rays)
        for number, group, rows in stage.by_group(alive, hits):
            table = tables[number]
            follow = group.transmits if self.straight else group.delta
            follow = follow and self.depth > 0
            children = (
                [dead] * (1 if self.straight else _lobes(group, stage.dtype)) if follow else []
            )
            for block, shaded in self._blocks(stage, rows, hits, count):
                rays, met = _shade(
                    group,
                    stage.world,
                    stage.sources,
                    stage.member,
                    rays,
                    hits,
                    block,
                    table,
                    lights.ambient,
                    self.field,
                    what.holds("emission"),
                )
                if group.kind.smooth:
                    share = None
                    if lights.even is not None:
                        share = _even(group, met, lights, table)
                    parts.append((group, met, share, block, shaded))
                if children:
                    kept = self.straight, what.holds("mirror"), what.holds("refraction")
                    children = _children(group, met, children, block, stage.offset, kept)
            born += children
        if not self.settings.shadows:
            for group, met, _, block, _ in parts if lights.count else []:
                rays = _unshaded(group, met, lights, rays, block)
            return rays, born
        for number in range(lights.count if parts else 0):
            shadow = shading.no_shadow(count, channels, rays.origin.dtype)
            open_ = shadow
            which, soft = jnp.asarray(number), lights.soft[number]
            for group, met, share, block, shaded in parts:
                light = group, met, lights, which, share
                if shaded[soft]:
                    shadow = _towards(*light, shadow, block, stage.offset)
                else:
                    open_ = _towards(*light, open_, block, stage.offset)
            if any(shaded[soft] for *_, shaded in parts):
                rays = queries.lit(rays, shadow)
            if not all(shaded[soft] for *_, shaded in parts):
                rays = _lit(rays, open_)
        return rays, born

    def _blocks(
        self, stage: Stage, rows: np.ndarray, hits: Hits, count: int
    ) -> list[tuple[Array, tuple[bool, bool]]]:
        """Blocks of rows, and whether hard and soft shadows fall on all in a block or on none."""
        what = self.composition
        if what.hard is None and what.soft is None:
            return [(block, (True, True)) for block in shading.blocks(rows, count)]
        owner = stage.owner[hits.primitive[rows]]
        hard, soft = what.receivers(False, owner), what.receivers(True, owner)
        found = []
        for kind in ((True, True), (True, False), (False, True), (False, False)):
            here = rows[(hard == kind[0]) & (soft == kind[1])]
            if len(here):
                found += [(block, kind) for block in shading.blocks(here, count)]
        return found


def _lobes(group: Group, dtype: Any) -> int:
    """Number of coherent lobes of the materials of a group."""
    up = jax.ShapeDtypeStruct((3,), dtype)
    return len(eqx.filter_eval_shape(lambda m, wo: m.coherent(wo), group.kind, up))


@eqx.filter_jit
def _shade(
    group: Group,
    world: World,
    sources: Sources,
    member: Array,
    rays: Rays,
    hits: Hits,
    rows: Int[Array, " n"],
    table: Albedos | None,
    ambient: Float[Array, " C"],
    field: Field | None,
    emission: bool,
) -> tuple[Rays, Meeting]:
    """Where rows meet a group; what it emits and what it reflects of even light."""
    some, there = shading.chosen(rays, hits, rows)
    met = shading.meet(group, world, some, there, member)
    light = jnp.zeros_like(met.throughput)
    if emission:
        light = shading.emitted(met, sources, some, drawn=False)
    if table is not None:
        even = ambient[None]
        if field is not None:
            place = jnp.asarray(there.u), jnp.asarray(there.v), met.surface.position
            even = even + field.at(met.primitive, *place, met.front)
        light = light + table.at(group, met) * even
    collected = rays.radiance.at[rows].add(met.throughput * light, mode="drop")
    return eqx.tree_at(lambda r: r.radiance, rays, collected), met


def _from_light(
    group: Group, met: Meeting, lights: StandIns, which: Array
) -> tuple[Array, Array, Array]:
    """What arrives at the camera from one light, and the way to it."""
    beams = lights.beams.towards.shape[0]
    index = jnp.broadcast_to(which, met.distance.shape)
    found = None
    if beams:
        found = lights.beams.at(jnp.minimum(index, beams - 1), met.surface.position)
    if lights.count > beams:
        other = lights.points.at(jnp.maximum(index - beams, 0), met.surface.position)
        if found is None:
            found = other
        else:
            first = which < beams
            found = jax.tree.map(lambda a, b: jnp.where(first, a, b), found, other)
    assert found is not None
    factor, _ = shading.reflected(group, met, found.towards, densities=False)
    return met.throughput * factor * found.value, found.towards, found.distance


@eqx.filter_jit
def _unshaded(
    group: Group, met: Meeting, lights: StandIns, rays: Rays, rows: Int[Array, " n"]
) -> Rays:
    """Light of all sources, none of them hidden."""

    def one(total: Array, which: Array) -> tuple[Array, None]:
        return total + _from_light(group, met, lights, which)[0], None

    light, _ = jax.lax.scan(one, jnp.zeros_like(met.throughput), jnp.arange(lights.count))
    collected = rays.radiance.at[rows].add(light, mode="drop")
    return eqx.tree_at(lambda r: r.radiance, rays, collected)


@eqx.filter_jit
def _even(
    group: Group, met: Meeting, lights: StandIns, table: Albedos | None
) -> Float[Array, "n C"]:
    """Factor on the beams of an even environment: together they bring what all of it brings.

    A narrow lobe meets few of the beams, or hardly any. What it reflects of an even
    environment is known, its albedo; the beams then only say how much of it is hidden.
    """
    beams = lights.beams.towards.shape[0]

    def one(total: Array, which: Array) -> tuple[Array, None]:
        return total + _from_light(group, met, lights, which)[0], None

    numbers = jnp.arange(beams - lights.last, beams)
    light, _ = jax.lax.scan(one, jnp.zeros_like(met.throughput), numbers)
    assert table is not None
    assert lights.even is not None
    whole = met.throughput * table.at(group, met) * lights.even[None]
    some = light > 0.0
    return jnp.where(some, whole / jnp.where(some, light, 1.0), 0.0)


@eqx.filter_jit
def _towards(
    group: Group,
    met: Meeting,
    lights: StandIns,
    which: Array,
    share: Float[Array, "n C"] | None,
    shadow: Shadow,
    rows: Int[Array, " n"],
    offset: Array,
) -> Shadow:
    """Light of one source, if it is not hidden."""
    value, towards, distance = _from_light(group, met, lights, which)
    if share is not None:
        beams = lights.beams.towards.shape[0]
        from_even = (which >= beams - lights.last) & (which < beams)
        value = value * jnp.where(from_even, share, 1.0)
    length = shading.short_of(distance, offset)
    start = shading.leaving(met.surface, towards, offset)
    way = jax.lax.stop_gradient((start, towards, length))
    return shading.cast(shadow, rows, way, value)


@eqx.filter_jit
def _children(
    group: Group,
    met: Meeting,
    children: list[Rays],
    rows: Int[Array, " n"],
    offset: Array,
    kept: tuple[bool, bool, bool],
) -> list[Rays]:
    """Rays that go on from rows: coherent reflection and refraction, or straight through.

    `kept` says whether they go straight, and whether reflection and refraction are in.
    """
    straight, reflection, refraction = kept

    def lobes(material: Any, wo: Array) -> Any:
        if not straight:
            return [(s.wi, s.weight) for s in material.coherent(wo)]
        # As if the index were 1: what is not reflected at the first face goes on.
        up = frames.direction(wo[..., 0], wo[..., 1], jnp.abs(wo[..., 2]))
        back = [mask(s.wi[..., 2] > 0.0, s.weight) for s in material.coherent(up)]
        rest = jnp.maximum(1.0 - sum(back, jnp.zeros(wo.shape[:-1], wo.dtype)), 0.0)
        return [(-wo, rest if material.delta else jnp.zeros_like(rest))]

    out = []
    for rays, (wi, weight) in zip(
        children, group.each(lobes, met.member, met.surface, met.wo), strict=True
    ):
        towards = met.surface.outwards(wi)
        throughput = met.throughput * group.converted(weight)
        lives = jax.lax.stop_gradient(throughput.max(-1)) > _FAINT
        if not straight:
            through = wi[:, 2] * met.wo[:, 2] < 0.0
            lives = lives & jnp.where(through, refraction, reflection)
        way = shading.leaving(met.surface, towards, offset), towards
        fixed = jax.lax.stop_gradient(way)
        out.append(
            Rays(
                rays.origin.at[rows].set(fixed[0], mode="drop"),
                rays.direction.at[rows].set(fixed[1], mode="drop"),
                rays.throughput.at[rows].set(throughput, mode="drop"),
                rays.density,
                rays.radiance,
                rays.alive.at[rows].set(lives, mode="drop"),
                rays.pixel,
                rays.sample,
            )
        )
    return out


@eqx.filter_jit
def _lit(rays: Rays, shadow: Shadow) -> Rays:
    """Add light that nothing is asked to hide."""
    return dataclasses.replace(rays, radiance=rays.radiance + shadow.value)


@jax.jit
def _gathered(total: Float[Array, "N C"], rays: Rays) -> Float[Array, "N C"]:
    """What rays have collected, added to the rays of the camera that they come from."""
    return total.at[rays.pixel].add(rays.radiance)
