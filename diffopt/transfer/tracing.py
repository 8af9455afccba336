"""What the rays of vertices meet, and the light that comes by way of it.

From every vertex a fixed set of local directions is followed. Where a ray escapes, light from
its direction arrives directly. Where it meets a surface, one direction is drawn from each of
the two terms of the material there, diffuse and glossy, and followed in turn; beyond the second
surface one of the two terms is drawn, by their albedos. What escapes is kept with its weight, in
a column for each kind of path: the term that reflected it last. (The glossy-transfer paper,
section 5.1; the weight is that of the whole path, and directions are averaged by it: its eq. 13
to 15 are right for equal weights only.)

The random numbers are the same for all vertices, so that noise does not look like a difference
between neighbours.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.kernels import warps
from diffopt.kernels.frames import dot
from diffopt.scenes import world
from diffopt.scenes.raycasting import Caster
from diffopt.transfer.reflectors import Reflector

# Rows of a compiled program; the last block of a group is padded to the smaller size.
_ROWS, _FEW = 2**14, 2**11
# Hits nearer than this many offsets count as the surface that a ray leaves: dark.
_NEAR = 50.0


class Frames(NamedTuple):
    """Vertices: positions, and axes as rows (tangent, across, normal).

    Attributes
    ----------
    position
        [n, 3].
    axes
        [n, 3, 3].
    """

    position: Float[np.ndarray, "n 3"]
    axes: Float[np.ndarray, "n 3 3"]


class Surroundings(NamedTuple):
    """The scene as rays see it.

    Attributes
    ----------
    caster
        Casts them.
    reflectors
        The materials.
    owner
        Reflector of each primitive, [P].
    """

    caster: Caster
    reflectors: tuple[Reflector, ...]
    owner: Int[np.ndarray, " P"]

    @property
    def channels(self) -> int:
        """C, of the scene."""
        return self.reflectors[0].channels


def columns(
    around: Surroundings,
    vertices: Frames,
    rays: Float[np.ndarray, "N 3"],
    depth: int,
    seed: int,
) -> Float[np.ndarray, "n N P"]:
    """What arrives along the rays of vertices.

    Returns
    -------
    array
        For each ray: 1 where it escapes and 0 elsewhere; that times its direction (3); then
        for paths reflected last by a diffuse, and by a glossy term, their weight (C) and the
        mean of that over the channels times the direction in which they leave (3), in the
        frame of the vertex. P = 4 + 2 (C + 3).
    """
    count, many, channels = len(vertices.position), len(rays), around.channels
    out = np.zeros((count * many, 4 + 2 * (channels + 3)), np.float32)
    local = np.asarray(rays, np.float32)
    axes = vertices.axes.astype(np.float32)
    towards = np.matmul(local[None], axes).reshape(-1, 3)
    lifted = vertices.position + around.caster.offset * vertices.axes[:, 2]
    start = np.repeat(lifted, many, axis=0)
    hits = around.caster.first(start, towards)
    free = hits.primitive < 0
    out[:, 0] = free
    out[:, 1:4] = np.where(free[:, None], np.tile(local, (count, 1)), np.float32(0.0))
    # Met at once is the surface itself, below which a smoothed normal lets rays begin.
    rows = np.flatnonzero(~free & (hits.distance > _NEAR * around.caster.offset))
    if depth < 2 or not len(rows):
        return out.reshape(count, many, -1)
    paths = Paths(
        rows,
        hits.primitive[rows],
        hits.u[rows],
        hits.v[rows],
        towards[rows],
        start[rows].astype(np.float32),
        hits.distance[rows],
        np.ones((len(rows), channels), np.float32),
    )
    for bounce in range(1, depth):
        paths = _bounced(around, paths, axes, many, out, bounce, seed, last=bounce == depth - 1)
        if not len(paths.row):
            break
    return out.reshape(count, many, -1)


class Paths(NamedTuple):
    """Paths that have met a surface.

    Attributes
    ----------
    row
        First ray of each, [n].
    primitive, u, v, distance
        What it met.
    towards, origin
        Of its last ray.
    weight
        Of all reflections so far, [n, C].
    """

    row: Int[np.ndarray, " n"]
    primitive: Int[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]
    v: Float[np.ndarray, " n"]
    towards: Float[np.ndarray, "n 3"]
    origin: Float[np.ndarray, "n 3"]
    distance: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, "n C"]

    def some(self, rows: np.ndarray) -> "Paths":
        """Chosen ones."""
        return Paths(*(a[rows] for a in self))


def _bounced(
    around: Surroundings,
    paths: Paths,
    axes: np.ndarray,
    many: int,
    out: np.ndarray,
    bounce: int,
    seed: int,
    *,
    last: bool,
) -> Paths:
    """Reflect paths, add those that escape to the columns, and return the others."""
    kept = []
    owner = around.owner[paths.primitive]
    numbers = _uniforms(many, bounce, seed)
    for k, one in enumerate(around.reflectors):
        mine = paths.some(np.flatnonzero(owner == k))
        if not len(mine.row):
            continue
        terms = [t for t, there in enumerate((_is_matte(one), one.glossy is not None)) if there]
        for term in terms:
            part, share = mine, 1.0
            if bounce > 1 and len(terms) == 2:
                # One of the two, so that paths do not double at every surface.
                taken = (numbers[mine.row % many, 6] < 0.5) == (term == 0)
                part, share = mine.some(np.flatnonzero(taken)), 2.0
            if len(part.row):
                u = numbers[part.row % many, 3 * term : 3 * term + 3]
                kept.append(_reflected(around, one, term, part, u, share, axes, many, out, last))
    if last or not kept:
        return paths.some(np.zeros(0, int))
    return Paths(*(np.concatenate(parts) for parts in zip(*kept, strict=True)))


def _is_matte(one: Reflector) -> bool:
    return bool((np.asarray(one.diffuse) > 0.0).any())


@functools.lru_cache(maxsize=16)
def _uniforms(many: int, bounce: int, seed: int) -> Float[np.ndarray, "N 7"]:
    """Numbers of the rays, the same for every vertex."""
    return np.random.default_rng((seed, bounce)).random((many, 7), np.float32)


def _reflected(
    around: Surroundings,
    one: Reflector,
    term: int,
    paths: Paths,
    u: np.ndarray,
    share: float,
    axes: np.ndarray,
    many: int,
    out: np.ndarray,
    last: bool,
) -> Paths:
    caster = around.caster
    shapes = caster.geometry.typed(np.float32)
    offset = jnp.asarray(caster.offset, jnp.float32)
    parts = []
    for start in range(0, len(paths.row), _ROWS):
        some = paths.some(np.arange(start, min(start + _ROWS, len(paths.row))))
        count = len(some.row)
        size = _ROWS if count > _FEW else _FEW
        rows = (*some[1:], u[start : start + size])
        block = [jnp.asarray(_filled(a, size)) for a in rows]
        found = _scattered(shapes, one, term, offset, *block)
        parts.append([np.asarray(a)[:count] for a in found])
    origin, towards, weight = (np.concatenate(a) for a in zip(*parts, strict=True))
    weight = weight * np.float32(share)
    alive = np.flatnonzero((weight > 0.0).any(-1))
    paths, origin, towards, weight = paths.some(alive), origin[alive], towards[alive], weight[alive]
    if last:
        far = np.full(len(alive), np.inf, np.float32)
        free = ~caster.blocked(origin, towards, far)
        hits = None
    else:
        hits = caster.first(origin, towards)
        free = hits.primitive < 0
    _add(out, paths.row[free], weight[free], towards[free], axes, many, term)
    if hits is None:
        return paths.some(np.zeros(0, int))
    on = np.flatnonzero(~free)
    return Paths(
        paths.row[on],
        hits.primitive[on],
        hits.u[on],
        hits.v[on],
        towards[on],
        origin[on],
        hits.distance[on],
        weight[on],
    )


def _filled(rows: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[:1], size - len(rows), axis=0)])


def _add(
    out: np.ndarray,
    row: np.ndarray,
    weight: np.ndarray,
    towards: np.ndarray,
    axes: np.ndarray,
    many: int,
    term: int,
) -> None:
    """Add paths to the columns of their term; each row comes once at most."""
    channels = weight.shape[1]
    first = 4 + term * (channels + 3)
    local = np.einsum("nij,nj->ni", axes[row // many], towards)
    out[row, first : first + channels] += weight
    out[row, first + channels : first + channels + 3] += weight.mean(-1, keepdims=True) * local


@eqx.filter_jit
def _scattered(
    shapes: world.World,
    one: Reflector,
    term: int,
    offset: Array,
    primitive: Int[Array, " n"],
    u: Float[Array, " n"],
    v: Float[Array, " n"],
    towards: Float[Array, "n 3"],
    origin: Float[Array, "n 3"],
    distance: Float[Array, " n"],
    weight: Float[Array, "n C"],
    numbers: Float[Array, "n 3"],
) -> tuple[Array, Array, Array]:
    """Where reflected rays start, their directions, and the weights of the paths."""
    reached = origin + distance[:, None] * towards
    met = world.surface(shapes, primitive, u, v, reached)
    met, front = world.facing(met, -towards, both=False)
    wo = met.local(-towards)
    if term == 0:
        wi = warps.cosine_hemisphere(numbers[:, :2])
        factor = jnp.broadcast_to(one.diffuse, weight.shape)
    else:
        wi, factor = one.scatter(numbers, wo)
        above = wi[:, 2] > 0.0
        factor = jnp.where(above[:, None], factor, 0.0)
    leaving = met.outwards(wi)
    side = jnp.where(front, 1.0, -1.0).astype(wo.dtype)[:, None] * met.geometric
    # Below the surface itself, which a smoothed normal does not know, nothing leaves.
    out = dot(leaving, side) > 0.0
    return met.position + offset * side, leaving, jnp.where(out[:, None], weight * factor, 0.0)
