"""Viewing directions of transfer slices: a hemisphere of nested triangles.

The upper half of an icosahedron that the horizon mirrors, its four cut faces closed at the
horizon, subdivided again and again: 10, 31, 109, 409, 1585 and 6241 views at levels 0 to 5,
at most 63, 36, 19, 9, 5 and 2 degrees apart. The views of a level are the first ones of the next;
each new one halves an edge.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.errors import InputError
from diffopt.kernels.frames import dot

#: Finest level.
FINEST = 5
# Elevation to which views on the horizon are raised, radians: a BRDF has no value there.
_LOWEST = 0.005
# Cells on a side of the table from directions to triangles: some four on an edge of level 5.
_CELLS = 256
# A share below this lies outside of a triangle.
_OUTSIDE = -1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Hemisphere:
    """Views up to a level, on the host.

    Attributes
    ----------
    views
        Unit vectors, those on the horizon raised by 0.005 radians, [V, 3].
    counts
        Views of each level, [level + 1].
    ends
        The two views between which a new one lies, [V, 2]; itself twice at level 0.
    faces
        Corners of the triangles of each level, [12 * 4**level, 3]; those within triangle f of
        one level are 4 f .. 4 f + 3 of the next.
    """

    views: Float[np.ndarray, "V 3"]
    counts: tuple[int, ...]
    ends: Int[np.ndarray, "V 2"]
    faces: tuple[Int[np.ndarray, "_ 3"], ...]

    def new(self, level: int) -> slice:
        """Views that come with a level."""
        return slice(self.counts[level - 1] if level else 0, self.counts[level])


@functools.cache
def hemisphere(level: int) -> Hemisphere:
    """Nested views.

    Parameters
    ----------
    level
        0 to 5.
    """
    if not 0 <= level <= FINEST:
        raise InputError(f"level must be 0 to {FINEST}; received {level}")
    points, faces = _base()
    ends = [np.stack([np.arange(len(points))] * 2, -1)]
    counts, levels = [len(points)], [faces]
    for _ in range(level):
        sides = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], -1)
        pairs, number = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
        middle = len(points) + number.reshape(-1, 3)
        between = points[pairs[:, 0]] + points[pairs[:, 1]]
        points = np.concatenate([points, _unit(between)])
        a, b, c = faces.T
        p, q, r = middle.T
        children = [[a, r, q], [r, b, p], [q, p, c], [p, q, r]]
        faces = np.stack([np.stack(child, -1) for child in children], 1).reshape(-1, 3)
        ends.append(pairs)
        counts.append(len(points))
        levels.append(faces)
    return Hemisphere(_raised(points), tuple(counts), np.concatenate(ends), tuple(levels))


def _base() -> tuple[np.ndarray, np.ndarray]:
    """Ten views and twelve triangles, counter-clockwise as seen from above."""
    g = 0.5 * (1.0 + math.sqrt(5.0))
    upper = [(0, 1, g), (0, -1, g), (g, 0, 1), (-g, 0, 1)]
    level = [(1, g, 0), (1, -g, 0), (-1, g, 0), (-1, -g, 0), (1, 0, 0), (-1, 0, 0)]
    points = _unit(np.array(upper + level, float))
    faces = [(0, 1, 2), (1, 0, 3), (0, 2, 4), (0, 4, 6), (0, 6, 3)]
    faces += [(1, 5, 2), (1, 7, 5), (1, 3, 7), (2, 8, 4), (2, 5, 8), (3, 6, 9), (3, 9, 7)]
    out = []
    for a, b, c in faces:
        turn = np.linalg.det(points[[a, b, c]])
        out.append((a, b, c) if turn > 0.0 else (a, c, b))
    return points, np.array(out)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _raised(points: np.ndarray) -> np.ndarray:
    low = points[:, 2] < math.sin(_LOWEST)
    flat = _unit(points[:, :2] + (~low)[:, None])
    lifted = np.concatenate(
        [flat * math.cos(_LOWEST), np.full((len(points), 1), math.sin(_LOWEST))], 1
    )
    return np.where(low[:, None], lifted, points)


class Place(NamedTuple):
    """Where directions lie among views: `corners` [..., 3] and their `shares` [..., 3]."""

    corners: Int[Array, "*batch 3"]
    shares: Float[Array, "*batch 3"]


class Locator(eqx.Module):
    """Finds the triangle of a level that holds a direction, in constant time.

    Attributes
    ----------
    cells
        Triangle of the finest level at the middle of each cell of a square, [cells, cells].
    corners, inverse, beside
        Of the triangles of all levels, one level after the other: views [F, 3]; the matrix from
        directions to shares of the corners [F, 3, 3]; triangles across from the corners [F, 3],
        their own number at the horizon.
    """

    cells: Int[Array, "n n"]
    corners: Int[Array, "F 3"]
    inverse: Float[Array, "F 9"]
    beside: Int[Array, "F 3"]
    level: int = eqx.field(static=True)

    def __call__(self, wo: Float[Array, "*batch 3"], level: Int[Array, "*#batch"]) -> Place:
        """Corners and shares of the triangles of a level around directions.

        Parameters
        ----------
        wo
            Unit vectors, [..., 3]; those below the lowest views are raised to them.
        level
            Of each, at most that of the locator.
        """
        # Shares go by the direction alone: no need of its length.
        raised = jnp.maximum(wo[..., 2], math.sin(_LOWEST))
        wo = jnp.stack([wo[..., 0], wo[..., 1], raised], -1)
        face = self._guess(wo)
        first = jnp.asarray([4 * (4**k - 1) for k in range(self.level + 1)], jnp.int32)
        face = (face >> (2 * (self.level - level))) + first[level]
        shares = self._shares(face, wo)
        # Of the six triangles around a view the one across is three sides away.
        for _ in range(3):
            out = jnp.argmin(shares, -1)
            least = shares.min(-1)
            across = jnp.take_along_axis(self.beside[face], out[..., None], -1)[..., 0]
            face = jnp.where(least < _OUTSIDE, across, face)
            shares = self._shares(face, wo)
        shares = jnp.maximum(shares, 0.0)
        return Place(self.corners[face], shares / shares.sum(-1, keepdims=True))

    def _shares(self, face: Array, wo: Array) -> Array:
        matrix = self.inverse[face]
        rows = [dot(matrix[..., 3 * k : 3 * k + 3], wo) for k in range(3)]
        return jnp.stack(rows, -1)

    def _guess(self, wo: Array) -> Array:
        """Triangle of the finest level, or one near it."""
        x, y, z = wo[..., 0], wo[..., 1], wo[..., 2]
        scale = 0.5 * _CELLS / (jnp.abs(x) + jnp.abs(y) + z)
        place = [
            jnp.clip((t * scale + 0.5 * _CELLS).astype(jnp.int32), 0, _CELLS - 1)
            for t in (x + y, x - y)
        ]
        return self.cells[place[0], place[1]]


@functools.cache
def _tables(level: int) -> tuple[np.ndarray, ...]:
    whole = hemisphere(level)
    matrices, beside, first = [], [], 0
    for faces in whole.faces:
        matrices.append(np.linalg.inv(whole.views[faces].transpose(0, 2, 1)))
        beside.append(_across(faces) + first)
        first += len(faces)
    middle = (np.arange(_CELLS) + 0.5) * (2.0 / _CELLS) - 1.0
    p, q = np.meshgrid(middle, middle, indexing="ij")
    x, y = 0.5 * (p + q), 0.5 * (p - q)
    at = _unit(np.stack([x, y, 1.0 - np.abs(x) - np.abs(y)], -1).reshape(-1, 3))
    return (
        _holding(whole, at).reshape(_CELLS, _CELLS).astype(np.int32),
        np.concatenate(whole.faces).astype(np.int32),
        np.concatenate(matrices).reshape(-1, 9),
        np.concatenate(beside).astype(np.int32),
    )


def _holding(whole: Hemisphere, at: np.ndarray) -> np.ndarray:
    """Triangles of the finest level around directions, from level to level."""
    face = np.argmax(_least(whole, 0, np.arange(12)[None], at), -1)
    for level in range(1, len(whole.faces)):
        inside = 4 * face[:, None] + np.arange(4)
        best = np.argmax(_least(whole, level, inside, at), -1)
        face = np.take_along_axis(inside, best[:, None], -1)[:, 0]
    return face


def _least(whole: Hemisphere, level: int, faces: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Smallest share of the corners of triangles [n, m] for directions [n, 3]."""
    matrix = np.linalg.inv(whole.views[whole.faces[level]].transpose(0, 2, 1))[faces]
    return np.einsum("nmij,nj->nmi", np.broadcast_to(matrix, (len(at), *matrix.shape[1:])), at).min(
        -1
    )


def _across(faces: np.ndarray) -> np.ndarray:
    """Triangle across from each corner; the triangle itself where there is none."""
    count = len(faces)
    sides = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], -1).reshape(-1, 2)
    key = sides[:, 0] * (faces.max() + 1) + sides[:, 1]
    order = np.argsort(key, kind="stable")
    owner = np.repeat(np.arange(count), 3)
    other = owner.copy()
    twin = np.flatnonzero(key[order][1:] == key[order][:-1])
    one, two = order[twin], order[twin + 1]
    other[one], other[two] = owner[two], owner[one]
    return other.reshape(count, 3)


def locator(level: int, dtype: type = np.float32) -> Locator:
    """A locator for levels up to one."""
    cells, corners, inverse, beside = _tables(level)
    arrays = (jnp.asarray(cells), jnp.asarray(corners))
    return Locator(*arrays, jnp.asarray(inverse, dtype), jnp.asarray(beside), level)
