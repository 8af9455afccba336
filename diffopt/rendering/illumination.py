"""Direct light on patches: what is hidden is found once, what the lights send may change.

Abstract lights are asked from several points of each patch. Light of surfaces and of
environments is drawn, and met by the rays of the form factors as well; both are weighted by the
balance heuristic (Veach, "Robust Monte Carlo methods for light transport simulation", 1997,
sec. 9.2), so that neither small lights nor near ones are noisy.
"""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffopt.kernels.frames import dot
from diffopt.rendering import shading
from diffopt.rendering.families import Beams, Points, Surfaces
from diffopt.rendering.formfactors import ESCAPED, Casts, FormFactors, in_blocks
from diffopt.rendering.patches import Patches
from diffopt.rendering.sources import Sources
from diffopt.rendering.standins import evenly
from diffopt.scenes.raycasting import Caster

# Points of a patch from which abstract lights are asked, and rays for all patches and lights.
_POINTS, _MOST = 16, 2**23


class Asked(eqx.Module):
    """Abstract lights of one family from points of patches.

    Attributes
    ----------
    position, normal
        Points, [P, Q, 3].
    seen
        Whether each of k lights is not hidden, [P, Q, k].
    """

    position: Float[Array, "P Q 3"]
    normal: Float[Array, "P Q 3"]
    seen: Bool[Array, "P Q k"]

    def irradiance(self, family: Beams | Points) -> Float[Array, "P C"]:
        """Means over the points."""
        patches, points, count = self.seen.shape
        flat = self.position.reshape(-1, 3), self.normal.reshape(-1, 3)
        dtype = family.strength(1.0).dtype
        position, normal = (a.astype(dtype) for a in flat)
        total = 0.0
        for k in range(count):
            index = jnp.full(len(position), k, jnp.int32)
            found = family.at(index, position)
            cos = jnp.maximum(dot(found.towards, normal), 0.0)
            seen = self.seen[:, :, k].reshape(-1)
            total = total + jnp.where(seen, cos, 0.0)[:, None] * found.value
        return jnp.asarray(total).reshape(patches, points, -1).mean(1)


class Drawn(eqx.Module):
    """Radiance of one family, drawn and met.

    Attributes
    ----------
    patch
        That the light falls on, [m].
    weight
        Irradiance for a radiance of 1, [m].
    index
        Of surfaces, which of them, [m].
    towards
        Directions of an environment, [m, 3].
    """

    patch: Int[Array, " m"]
    weight: Float[Array, " m"]
    index: Int[Array, " m"]
    towards: Float[Array, "m 3"]

    def irradiance(self, family: Any, count: int) -> Float[Array, "P C"]:
        """Sums over what was drawn and met."""
        if isinstance(family, Surfaces):
            radiance = family.radiance[self.index]
        else:
            dtype = family.strength(1.0).dtype
            towards = self.towards.astype(dtype)
            radiance = family.radiance(towards)
        weight = self.weight.astype(radiance.dtype)[:, None]
        return (
            jnp.zeros((count, radiance.shape[1]), radiance.dtype)
            .at[self.patch]
            .add(weight * radiance)
        )


class Illumination(eqx.Module):
    """Direct light on patches.

    Attributes
    ----------
    parts
        Of each family of sources, in their order.
    escaped
        Share of the rays of each patch that meet nothing, [P].
    """

    parts: tuple[Asked | Drawn, ...]
    escaped: Float[Array, " P"]

    def irradiance(self, sources: Sources) -> tuple[Float[Array, "P C"], Float[Array, "P C"]]:
        """Of surfaces that emit light, and of all other lights; differentiable.

        Parameters
        ----------
        sources
            As many as those that the light was prepared for, in the same order.
        """
        count, dtype = self.escaped.shape[0], sources.ambient.dtype
        emitted = jnp.zeros((count, sources.ambient.shape[0]), dtype)
        other = jnp.zeros_like(emitted) + math.pi * sources.ambient[None]
        if sources.constant is not None:
            other = other + math.pi * self.escaped.astype(dtype)[:, None] * sources.constant[None]
        for family, part in zip(sources.families, self.parts, strict=True):
            if isinstance(part, Asked):
                other = other + part.irradiance(family)  # type: ignore[arg-type]
            elif isinstance(family, Surfaces):
                emitted = emitted + part.irradiance(family, count)
            else:
                other = other + part.irradiance(family, count)
        return emitted, other


class _Ways(NamedTuple):
    """Points of patches from which light is drawn: patch, position, normal, numbers."""

    patch: Int[np.ndarray, " m"]
    position: Float[np.ndarray, "m 3"]
    normal: Float[np.ndarray, "m 3"]
    numbers: Float[np.ndarray, "m 3"]


def illuminate(
    sources: Sources,
    patches: Patches,
    factors: FormFactors,
    casts: Casts,
    caster: Caster,
    samples: int,
    seed: int,
) -> Illumination:
    """Prepare direct light.

    Parameters
    ----------
    sources
        The lights, in float32.
    patches, factors
        The patches and their form factors.
    casts
        Rays of the patches: light is asked for where they start.
    caster
        Says what is hidden.
    samples
        Of each family that is drawn, for each patch.
    seed
        Of the rotation of even numbers.
    """
    valid = casts.valid
    rays = valid.sum(1)
    order = np.argsort(~valid, axis=1, kind="stable")
    every = np.arange(len(rays))
    escaped = (casts.cell == ESCAPED).sum(1) / np.maximum(rays, 1)

    def points(count: int) -> tuple[np.ndarray, np.ndarray]:
        at = order[every[:, None], np.arange(count) % np.maximum(rays, 1)[:, None]]
        return casts.origin[every[:, None], at], casts.normal[every[:, None], at]

    parts: list[Asked | Drawn] = []
    for family in sources.families:
        if isinstance(family, Beams | Points):
            lights = _members(family)
            count = int(np.clip(_MOST // max(len(every) * lights, 1), 1, _POINTS))
            parts.append(_asked(family, lights, *points(count), rays > 0, caster))
        else:
            position, facing = points(samples)
            turn = np.random.default_rng([seed, len(parts)]).random((len(every), 1, 3))
            u = (evenly(samples) + turn) % 1.0
            ways = _Ways(
                np.repeat(every, samples),
                position.reshape(-1, 3),
                facing.reshape(-1, 3),
                u.reshape(-1, 3),
            )
            drawn = _drawn(family, sources, ways, casts, rays, caster, samples)
            if isinstance(family, Surfaces):
                drawn = _balanced(drawn, sources, patches, factors, caster)
            parts.append(drawn)
    return Illumination(tuple(parts), jnp.asarray(escaped, jnp.float32))


def _members(family: Beams | Points) -> int:
    first = family.towards if isinstance(family, Beams) else family.position
    return first.shape[0]


def _asked(
    family: Any, lights: int, position: Any, normal: Any, valid: Any, caster: Caster
) -> Asked:
    shape = position.shape[:2]
    flat, facing = position.reshape(-1, 3), normal.reshape(-1, 3)
    seen = np.zeros((len(flat), lights), bool)
    for k in range(lights):
        index = np.full(len(flat), k, np.int32)
        towards, distance = in_blocks(lambda *a: _towards(family, *a), index, flat)
        rows = np.flatnonzero((towards * facing).sum(1) > 0.0)
        hidden = caster.blocked(flat[rows], towards[rows], distance[rows] * (1.0 - 1e-6))
        seen[rows, k] = ~hidden
    seen = seen.reshape(*shape, lights) & valid[:, None, None]
    return Asked(*(jnp.asarray(a) for a in (position, normal, seen)))


@eqx.filter_jit
def _towards(family: Any, index: Array, position: Array) -> tuple[Array, Array]:
    found = family.at(index, position)
    return found.towards, found.distance


def _drawn(
    family: Any,
    sources: Sources,
    ways: _Ways,
    casts: Casts,
    rays: np.ndarray,
    caster: Caster,
    samples: int,
) -> Drawn:
    """Both estimates of one family; the weights are those of their joint density."""
    index, towards, distance, density = in_blocks(
        lambda *a: _draw(family, *a), ways.numbers.astype(np.float32), ways.position
    )
    cos = (towards * ways.normal).sum(1)
    rows = np.flatnonzero((cos > 0.0) & (density > 0.0) & (rays[ways.patch] > 0))
    length = np.asarray(shading.short_of(distance[rows], caster.offset))
    hidden = caster.blocked(ways.position[rows], towards[rows], length)
    rows = rows[~hidden]
    # Radiance times cosine over the number of samples per steradian of both kinds.
    both = samples * density[rows] + rays[ways.patch[rows]] * cos[rows] / math.pi
    weight = cos[rows] / both
    drawn = ways.patch[rows], weight, index[rows], towards[rows]
    met = _met(family, sources, casts, rays, samples)
    fields = [np.concatenate(pair) for pair in zip(drawn, met, strict=True)]
    kinds = (jnp.int32, jnp.float32, jnp.int32, jnp.float32)
    return Drawn(*(jnp.asarray(a, kind) for a, kind in zip(fields, kinds, strict=True)))


def _balanced(
    drawn: Drawn, sources: Sources, patches: Patches, factors: FormFactors, caster: Caster
) -> Drawn:
    """As much light of each object as the rays say that does not escape."""
    owner = caster.geometry.owner
    objects = int(owner.max()) + 1
    lands = np.where(patches.side == 0, math.pi * factors.area * (1.0 - factors.escaped), 0.0)
    wanted = np.bincount(patches.owner, lands, objects)
    entry = np.asarray(sources.entry)[: len(owner)]
    source = np.zeros(int(entry.max()) + 1, np.int64)
    source[entry[entry >= 0]] = owner[entry >= 0]
    of = source[np.asarray(drawn.index)]
    found = np.bincount(of, np.asarray(drawn.weight) * factors.area[drawn.patch], objects)
    known = (found > 0.0) & (wanted > 0.0)
    ratio = np.where(known, wanted / np.where(known, found, 1.0), 1.0)
    weight = drawn.weight * jnp.asarray(np.clip(ratio, 0.5, 2.0)[of], jnp.float32)
    return eqx.tree_at(lambda d: d.weight, drawn, weight)


def _met(
    family: Any, sources: Sources, casts: Casts, rays: np.ndarray, samples: int
) -> tuple[np.ndarray, ...]:
    """Light that the rays of form factors meet."""
    if isinstance(family, Surfaces):
        entry = np.asarray(sources.entry)[np.maximum(casts.primitive, 0)]
        lit = (casts.primitive >= 0) & casts.valid & (entry >= 0) & (casts.arrival > 0.0)
    else:
        entry, lit = np.zeros_like(casts.cell), casts.cell == ESCAPED
    patch, ray = np.nonzero(lit)
    fields = casts.origin, casts.towards, casts.distance, casts.arrival, casts.cosine
    origin, towards, distance, arrival, cos = (a[patch, ray] for a in fields)
    index = entry[patch, ray]
    if not len(patch):
        return patch, cos, index, towards
    (density,) = in_blocks(
        lambda *a: _density(family, *a), index, origin, towards, distance, arrival
    )
    both = samples * density + rays[patch] * cos / math.pi
    return patch, cos / both, index, towards


@eqx.filter_jit
def _draw(family: Any, u: Array, position: Array) -> tuple[Array, ...]:
    found = family.draw(u, position)
    index = jnp.zeros(len(u), jnp.int32)
    if isinstance(family, Surfaces):
        index = family.pick(u[:, 2]).astype(jnp.int32)
    return index, found.towards, found.distance, found.density


@eqx.filter_jit
def _density(
    family: Any, index: Array, origin: Array, towards: Array, distance: Array, arrival: Array
) -> tuple[Array]:
    if isinstance(family, Surfaces):
        return (family.density(index, origin, towards, distance, arrival),)
    return (family.density(towards),)
