"""Difference of the transfer at two vertices: what decides which triangles are split.

The mean distance of the slices of corresponding views (the glossy-transfer paper, section 4.3),
exact, over the norm of the unoccluded slices. Views correspond that the smallest rotation takes
into each other that takes one normal into the other, whatever the tangents. Compared, as
interpolated, is how slices differ from those of the unoccluded material: a surface that is bent
but sees nothing of itself has no difference.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames
from diffopt.transfer import references, slices
from diffopt.transfer.references import Reference, Unoccluded
from diffopt.transfer.slices import Slices
from diffopt.transfer.views import Locator, hemisphere, locator

# Pairs of one view each that are compared at a time.
_BLOCK = 2**14


class Known(NamedTuple):
    """Slices of vertices, on the host.

    Attributes
    ----------
    level
        Of the views of each vertex, -1 for none, [V].
    first
        Row of its first view, [V].
    views
        Over those of the unoccluded material, [S, 3, K, ...].
    diffuse
        In the local frames, [V, 3, K, ...].
    axes
        Local frames as rows, [V, 3, 3].
    """

    level: Int[np.ndarray, " V"]
    first: Int[np.ndarray, " V"]
    views: Slices
    diffuse: Slices
    axes: Float[np.ndarray, "V 3 3"]


def differences(
    known: Known,
    over: Reference,
    material: int,
    pairs: Int[np.ndarray, "E 2"],
    scale: Float[np.ndarray, " L"],
    matte: float,
    most: int,
) -> Float[np.ndarray, " E"]:
    """Half the difference of pairs of vertices of one material.

    Parameters
    ----------
    known
        Slices of all vertices.
    over
        Unoccluded lobes of the materials.
    material
        That of the vertices.
    pairs
        Numbers of vertices.
    scale
        Mean squared norm of the unoccluded slices of the views up to each level.
    matte
        Squared norm of the unoccluded diffuse slice.
    most
        Level of views that are compared at most.
    """
    out = np.zeros(len(pairs))
    one, two = pairs.T
    turn = _turns(known.axes[one], known.axes[two])
    common = np.minimum(np.minimum(known.level[one], known.level[two]), most)
    square = np.zeros(len(pairs))
    for level in np.unique(common):
        rows = np.flatnonzero(common == level)
        if level >= 0:
            square[rows] = _views(known, over, material, pairs[rows], turn[rows], int(level))
    for start in range(0, len(pairs), _BLOCK):
        part = slice(start, start + _BLOCK)
        near, far = (_taken(known.diffuse, _filled(i[part], _BLOCK)) for i in (one, two))
        angle = _filled(turn[part], _BLOCK).astype(np.float32)
        square[part] += np.asarray(_matte(near, far, angle))[: len(one[part])]
    whole = np.where(common >= 0, scale[np.maximum(common, 0)], 0.0) + matte
    np.divide(square, whole, out=out, where=whole > 0.0)
    return 0.5 * np.sqrt(out)


def surprises(
    known: Known,
    over: Reference,
    material: int,
    vertices: Int[np.ndarray, " n"],
    ends: Int[np.ndarray, "n 2"],
    scale: Float[np.ndarray, " L"],
    matte: float,
    most: int,
) -> Float[np.ndarray, " n"]:
    """How far the slices of vertices are from what two others, between which they lie, predict.

    Seen from the same directions of the world, as pictures interpolate. Parameters as of
    `differences`; `ends` are the two others.
    """
    square = np.zeros(len(vertices))
    axes = known.axes.astype(np.float32)
    turn = np.einsum("neij,nkj->neik", axes[ends], axes[vertices])
    level = np.minimum(known.level[vertices], most)
    for at in np.unique(level):
        rows = np.flatnonzero(level == at)
        if at >= 0:
            square[rows] = _halfway(
                known, over, material, vertices[rows], ends[rows], turn[rows], int(at)
            )
    for start in range(0, len(vertices), _BLOCK):
        part = slice(start, start + _BLOCK)
        here = _taken(known.diffuse, _filled(vertices[part], _BLOCK))
        two = _taken(known.diffuse, _filled(ends[part], _BLOCK))
        apart = _matte_halfway(here, two, _filled(turn[part], _BLOCK))
        square[part] += np.asarray(apart)[: len(vertices[part])]
    whole = np.where(level >= 0, scale[np.maximum(level, 0)], 0.0) + matte
    return np.sqrt(np.divide(square, whole, out=np.zeros_like(square), where=whole > 0.0))


def _halfway(
    known: Known,
    over: Reference,
    material: int,
    vertices: np.ndarray,
    ends: np.ndarray,
    turn: np.ndarray,
    level: int,
) -> Float[np.ndarray, " n"]:
    count = hemisphere(level).counts[level]
    step = max(1, _BLOCK // (2 * count))
    views = jnp.asarray(hemisphere(level).views, jnp.float32)
    find = _locator(int(known.level.max()))
    number = jnp.asarray(material, jnp.int32)
    here = _here(over, number, views)
    out = []
    for start in range(0, len(vertices), step):
        part = slice(start, start + step)
        size = len(vertices[part])
        own, two, turned = (_filled(a[part], step) for a in (vertices, ends, turn))
        corners, shares = _seen_from(find, views, turned, known.level[two].astype(np.int32))
        near = _taken(known.views, known.first[own][:, None] + np.arange(count))
        far = _taken(known.views, known.first[two][:, :, None, None] + np.asarray(corners))
        found = _between_ends(near, here, far, shares, turned)
        out.append(np.asarray(found)[:size])
    return np.concatenate(out)


@jax.jit
def _seen_from(find: Locator, views: Array, turn: Array, level: Array) -> Any:
    """Where the views of vertices lie among those of both ends, [n, 2, V, ...]."""
    there = jnp.einsum("neij,vj->nevi", turn, views, precision="highest")
    return tuple(find(there, level[:, :, None]))


@jax.jit
def _between_ends(near: Slices, here: Unoccluded, far: Slices, shares: Array, turn: Array) -> Array:
    ends = slices.between(shares, far)
    beyond = jnp.einsum("neij,nevkli->nevklj", turn, ends.mu[..., 1:, :, :], precision="highest")
    mu = jnp.concatenate([ends.mu[..., :1, :, :], beyond], -3)
    pair = Slices(*(jnp.moveaxis(a, 1, 2) for a in ends._replace(mu=mu)))
    half = jnp.full(pair.kappa.shape[:3], 0.5, pair.kappa.dtype)
    one, other = (
        references.absolute(s, jax.tree.map(lambda a: a[None], here))
        for s in (near, slices.between(half, pair))
    )
    return slices.squared_distance(one, other).mean(-1)


@jax.jit
def _matte_halfway(here: Slices, two: Slices, turn: Array) -> Array:
    mu = jnp.einsum("neij,nekli->neklj", turn, two.mu, precision="highest")
    half = jnp.full(two.kappa.shape[:2], 0.5, two.kappa.dtype)
    return slices.squared_distance(here, slices.between(half, two._replace(mu=mu)))


def _turns(one: np.ndarray, two: np.ndarray) -> Float[np.ndarray, " E"]:
    """Angle about the normal by which the second frame is ahead of the first, carried over."""
    n, m, tangent = one[:, 2], two[:, 2], one[:, 0]
    # The smallest rotation from n to m; next to opposite ones any will do.
    cos = (n * m).sum(-1, keepdims=True)
    axis = np.cross(n, m)
    carried = tangent * cos + np.cross(axis, tangent)
    along = (axis * tangent).sum(-1, keepdims=True) / np.maximum(1.0 + cos, 1e-6)
    carried = carried + axis * along
    x, y = ((carried * two[:, k]).sum(-1) for k in (0, 1))
    return np.arctan2(y, x)


def _views(
    known: Known, over: Reference, material: int, pairs: np.ndarray, turn: np.ndarray, level: int
) -> Float[np.ndarray, " E"]:
    """Mean over the views of a level of the squared distance."""
    count = hemisphere(level).counts[level]
    step = max(1, _BLOCK // count)
    views = jnp.asarray(hemisphere(level).views, jnp.float32)
    find = _locator(int(known.level.max()))
    number = jnp.asarray(material, jnp.int32)
    here = _here(over, number, views)
    out = []
    for start in range(0, len(pairs), step):
        some, angle = pairs[start : start + step], turn[start : start + step]
        size = len(some)
        some, angle = _filled(some, step), _filled(angle, step).astype(np.float32)
        one, two = some.T
        finer = known.level[two].astype(np.int32)
        corners, shares = _placed(find, views, angle, finer)
        near = _taken(known.views, known.first[one][:, None] + np.arange(count))
        rows = known.first[two][:, None, None] + np.asarray(corners)
        far = _taken(known.views, rows)
        out.append(np.asarray(_compared(near, here, far, shares, angle))[:size])
    return np.concatenate(out)


@functools.cache
def _locator(level: int) -> Locator:
    return locator(level)


def _filled(rows: np.ndarray, size: int) -> np.ndarray:
    return np.concatenate([rows, np.repeat(rows[-1:], size - len(rows), axis=0)])


def _taken(found: Slices, rows: np.ndarray) -> Slices:
    return Slices(*(a[rows] for a in found))


@jax.jit
def _placed(find: Locator, views: Array, angle: Array, level: Array) -> Any:
    """Where the views of the first vertices lie among those of the second."""
    cos, sin = jnp.cos(angle)[:, None], jnp.sin(angle)[:, None]
    x, y, z = (views[:, k][None] for k in range(3))
    z = jnp.broadcast_to(z, (angle.shape[0], views.shape[0]))
    there = jnp.stack([cos * x - sin * y, sin * x + cos * y, z], -1)
    return tuple(find(there, level[:, None]))


@jax.jit
def _here(over: Reference, material: Array, views: Array) -> Unoccluded:
    return over.at(material, views)


@jax.jit
def _compared(near: Slices, here: Unoccluded, far: Slices, shares: Array, angle: Array) -> Array:
    cos, sin = (f(-angle)[:, None, None] for f in (jnp.cos, jnp.sin))
    other = slices.between(shares, far)
    x, y, z = (other.mu[..., 1:, :, i] for i in range(3))
    cos, sin = cos[..., None], sin[..., None]
    beyond = frames.direction(cos * x - sin * y, sin * x + cos * y, z)
    other = other._replace(mu=jnp.concatenate([other.mu[..., :1, :, :], beyond], -3))
    one, other = (
        references.absolute(s, jax.tree.map(lambda a: a[None], here)) for s in (near, other)
    )
    return slices.squared_distance(one, other).mean(-1)


@jax.jit
def _matte(near: Slices, far: Slices, angle: Array) -> Array:
    cos, sin = (f(-angle)[:, None, None] for f in (jnp.cos, jnp.sin))
    return slices.squared_distance(near, slices.turned(far, cos, sin))
