"""Form factors between patches by casting rays.

From even points of a patch rays leave by the cosine law; the share of them that reaches another
patch is the form factor. The estimates of both directions are joined as if all rays were of one
sample (Veach's balance heuristic), and the products of area and form factor, which are the
same both ways, are scaled until each patch loses to the others what its rays say.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffopt.kernels import frames, warps
from diffopt.kernels.frames import dot
from diffopt.rendering.patches import Patches
from diffopt.scenes import world
from diffopt.scenes.raycasting import BLOCK, Caster
from diffopt.scenes.world import World

#: In place of a patch's cell: the ray met nothing, or the inside of a closed shape.
ESCAPED, VOID = -1, -2
# Powers of the fractions that fill the four-dimensional cube evenly (Roberts 2018): the root
# of x^5 = x + 1.
_STEP = 1.16730397826141868426
# Steps of the scaling, rays cast at once, rows of form factors counted at once.
_SCALINGS, _TOGETHER, _ROWS = 40, 2**18, 256


@dataclasses.dataclass(frozen=True, eq=False)
class Casts:
    """What the rays of patches meet, R for each.

    Attributes
    ----------
    cell
        The finest cell, `ESCAPED` or `VOID` (the ray starts inside a body), [P, R].
    origin, normal, towards, cosine
        Where rays leave, the normal there, where to, and the cosine between, [P, R, 3], [P, R].
    distance, primitive, arrival
        How far they go, what they meet, and the cosine there, negative for backs, [P, R].
    """

    cell: Int[np.ndarray, "P R"]
    origin: Float[np.ndarray, "P R 3"]
    normal: Float[np.ndarray, "P R 3"]
    towards: Float[np.ndarray, "P R 3"]
    cosine: Float[np.ndarray, "P R"]
    distance: Float[np.ndarray, "P R"]
    primitive: Int[np.ndarray, "P R"]
    arrival: Float[np.ndarray, "P R"]

    def after(self, before: Int[np.ndarray, " Q"], more: "Casts") -> "Casts":
        """Rays of patches that stay, by their numbers, and of the new ones."""
        kept = before[before >= 0]
        pairs = ((getattr(self, f.name), getattr(more, f.name)) for f in dataclasses.fields(self))
        return Casts(*(np.concatenate([old[kept], new]) for old, new in pairs))

    @property
    def valid(self) -> Bool[np.ndarray, "P R"]:
        """Whether rays start outside bodies."""
        return self.cell != VOID


@dataclasses.dataclass(frozen=True, eq=False)
class FormFactors:
    """Form factors of P patches.

    Attributes
    ----------
    exchange
        Area times form factor, the same both ways, [P, P].
    area
        Of the patches, without what lies inside bodies, [P].
    escaped
        Share of the rays that meet nothing, [P].
    closure
        Largest difference of a row's sum from 1 less that share, over patches whose area
        counts.
    rays
        Of each patch.
    """

    exchange: Float[np.ndarray, "P P"]
    area: Float[np.ndarray, " P"]
    escaped: Float[np.ndarray, " P"]
    closure: float
    rays: int
    _whole: Float[np.ndarray, " P"]

    @property
    def shares(self) -> Float[np.ndarray, "P P"]:
        """F_ij: share of the light of i that reaches j directly; 0 for patches of no area."""
        return self.exchange / np.where(self.area > 0.0, self.area, 1.0)[:, None]

    def error(self) -> Float[np.ndarray, "P P"]:
        """Standard error of the form factors, as for random rays: an upper estimate."""
        weight = self.rays / self._whole
        count = self.exchange * (weight[:, None] + weight[None, :])
        error = np.sqrt(count) / (weight[:, None] + weight[None, :])
        return error / np.where(self.area > 0.0, self.area, 1.0)[:, None]


def cast(
    patches: Patches,
    shapes: World,
    caster: Caster,
    rays: int,
    seed: int,
    which: Int[np.ndarray, " n"] | None = None,
) -> Casts:
    """Cast rays from patches.

    Parameters
    ----------
    patches
        The patches.
    shapes
        Of the scene, on the device, in float32.
    caster
        Casts the rays.
    rays
        Of each patch.
    seed
        Of the rotation of the even numbers, another one for each patch.
    which
        Patches; all by default.
    """
    which = np.arange(patches.count) if which is None else which
    parts = []
    together = max(_TOGETHER // rays, 1)
    for at in range(0, len(which), together):
        some = which[at : at + together]
        parts.append(_cast(patches, shapes, caster, rays, seed, some))
    if not parts:
        parts = [_cast(patches, shapes, caster, rays, seed, which)]
    fields = [[getattr(p, f.name) for p in parts] for f in dataclasses.fields(Casts)]
    return Casts(*(np.concatenate(field) for field in fields))


def numbers(rays: int, seed: int, which: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n R 4"]:
    """Even points of the four-dimensional unit cube, turned differently for each patch."""
    steps = _STEP ** -np.arange(1.0, 5.0)
    turn = np.random.default_rng(seed).random((int(which.max(initial=0)) + 1, 4))[which]
    points = (np.arange(1, rays + 1)[:, None] * steps) % 1.0
    return (points + turn[:, None, :]) % 1.0


def _cast(
    patches: Patches, shapes: World, caster: Caster, rays: int, seed: int, which: np.ndarray
) -> Casts:
    u = numbers(rays, seed, which).reshape(-1, 4)
    index = np.repeat(which, rays)
    origin, normal, *_ = patches.sample(index, u[:, :2])
    towards, cosine = in_blocks(_towards, jnp.asarray(u[:, 2:], jnp.float32), normal)
    origin = origin + caster.offset * normal
    hits = caster.first(origin, towards)
    met = hits.primitive >= 0
    distance = np.where(met, hits.distance, 0.0).astype(np.float32)
    primitive = np.maximum(hits.primitive, 0)
    if len(caster.geometry.owner):
        sheet, s, t, arrival = in_blocks(
            lambda *a: arrive(patches.sheets.charts, shapes, *a),
            primitive,
            *(hits.u, hits.v, origin, towards, distance),
        )
        cell = np.where(met, patches.cell(sheet, s, t), ESCAPED)
        cell = np.where(met & (sheet < 0), VOID, cell).astype(np.int32)
    else:
        cell, arrival = np.full(len(met), ESCAPED, np.int32), np.zeros(len(met), np.float32)
    shape = len(which), rays
    return Casts(
        cell.reshape(shape),
        origin.reshape(*shape, 3).astype(np.float32),
        normal.reshape(*shape, 3),
        towards.reshape(*shape, 3),
        cosine.reshape(shape),
        np.where(met, hits.distance, np.inf).astype(np.float32).reshape(shape),
        hits.primitive.reshape(shape),
        arrival.reshape(shape),
    )


def in_blocks(function: Any, *arrays: Any) -> list[np.ndarray]:
    """A compiled function of rows, block by block of one size."""
    count = len(arrays[0])
    parts = []
    for at in range(0, count, BLOCK):
        some = [np.asarray(a[at : at + BLOCK]) for a in arrays]
        short = BLOCK - len(some[0])
        padded = [np.concatenate([a, np.repeat(a[:1], short, axis=0)]) for a in some]
        found = function(*(jnp.asarray(a) for a in padded))
        parts.append([np.asarray(a)[: BLOCK - short] for a in found])
    return [np.concatenate(part) for part in zip(*parts, strict=True)]


@jax.jit
def _towards(u: Array, normal: Array) -> tuple[Array, Array]:
    local = warps.cosine_hemisphere(u)
    x, y = frames.tangents(normal)
    towards = local[:, :1] * x + local[:, 1:2] * y + local[:, 2:] * normal
    return towards, local[:, 2]


@eqx.filter_jit
def arrive(
    found: Any, shapes: World, primitive: Any, u: Any, v: Any, origin: Any, way: Any, far: Any
) -> tuple[Array, ...]:
    """Where rays arrive: sheet, its coordinates, and the cosine, negative for backs."""
    position = origin.astype(far.dtype) + far[:, None] * way
    surface = world.surface(shapes, primitive, u, v, position)
    arrival = -dot(surface.geometric, way)
    return *found.locate(primitive, u, v, surface.position, arrival > 0.0), arrival


def form_factors(patches: Patches, casts: Casts) -> FormFactors:
    """Form factors from what rays met; float32."""
    count, rays = casts.cell.shape
    table = np.append(patches.table, [count, count])  # VOID and ESCAPED are -2 and -1.
    hit = table[casts.cell]
    valid = casts.valid.sum(1)
    escaped = (casts.cell == ESCAPED).sum(1) / np.maximum(valid, 1)
    exchange = np.empty((count, count), np.float32)
    for at in range(0, count, _ROWS):
        some = hit[at : at + _ROWS]
        number = np.arange(len(some))[:, None] * (count + 1) + some
        counted = np.bincount(number.reshape(-1), minlength=len(some) * (count + 1))
        exchange[at : at + _ROWS] = counted.reshape(len(some), -1)[:, :count]
    # Rays of a unit of area: of the two estimates of area times form factor, each has a
    # variance of itself over this number, so that they are added with it as weight.
    weight = (rays / patches.area).astype(np.float32)
    for at in range(0, count, _ROWS):
        rows = slice(at, at + _ROWS)
        # In place, block and mirrored block at once.
        both = exchange[rows, at:] + exchange[at:, rows].T
        both /= weight[rows, None] + weight[None, at:]
        exchange[rows, at:], exchange[at:, rows] = both, both.T
    area = patches.area * valid / rays
    target = area * (1.0 - escaped)
    scale = np.ones(count)
    sums = exchange @ scale.astype(np.float32)
    for _ in range(_SCALINGS):
        found = scale * sums
        ratio = np.where(found > 0.0, target / np.where(found > 0.0, found, 1.0), 1.0)
        scale *= np.sqrt(ratio)
        sums = exchange @ scale.astype(np.float32)
    counts = (area > 0.0) & (valid > 0)
    lack = np.abs(scale * sums - target)[counts] / area[counts]
    exchange *= scale.astype(np.float32)[:, None]
    exchange *= scale.astype(np.float32)[None, :]
    closure = float(lack.max(initial=0.0))
    return FormFactors(exchange, area, escaped, closure, rays, patches.area)
