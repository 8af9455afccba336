"""Trees of boxes over triangles, built on the host for the queries of `intersect`.

A complete binary tree needs no pointers: node 1 is the root, the children of node i are 2 i and
2 i + 1, and the leaves come last. Every level halves each group of triangles at the median
centroid along the group's longest side, all groups by one sort, so that building is a dozen
calls of NumPy whatever the number of triangles. Halving by count suits meshes of evenly sized
triangles; with very uneven ones, boxes overlap more than with a surface-area heuristic.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

# The corners of triangles before they are scaled lie within 2^-120 .. 2^120 (float32).
EXPONENTS = {4: 120, 8: 1000}
# Meshes up to this size are one leaf: testing all is faster than looking for a few.
DENSE = 24

Floats = np.ndarray | Array


class Hierarchy(NamedTuple):
    """Triangles with their tree; the search uses all but `triangles`.

    Arrays are NumPy's as built, and may be moved to a device. Replace `triangles`
    (``tree._replace(triangles=t)``) to differentiate by the corners; corners that move far need
    a new tree.

    Attributes
    ----------
    triangles
        Corners as given, [F, 3, 3].
    boxes
        Low and high corners of the boxes of both children of node i, 12 columns of [L];
        entry 0 is not used. Lengths are scaled.
    corners
        Corners of the triangles in each leaf, scaled, in ascending order of (x, y, z), so that
        two triangles see the edge that they share in the same direction; 9 columns of [L S].
        Leaves with fewer than S triangles hold the last one several times.
    numbers
        Number of each of those triangles, [L S].
    scale
        Power of two that brings all coordinates within 1.
    """

    triangles: Float[Floats, "F 3 3"]
    boxes: tuple[Float[Floats, " L"], ...]
    corners: tuple[Float[Floats, " LS"], ...]
    numbers: Int[Floats, " LS"]
    scale: Float[Floats, ""]


def build(triangles: Float[np.ndarray, "F 3 3"], leaf: int = 4, dense: int = DENSE) -> Hierarchy:
    """A tree over triangles.

    Triangles without area or with a corner that is not finite are left out: no ray hits them.

    Parameters
    ----------
    triangles
        Corners, in any unit; float32 or float64. Corners that triangles share must be equal
        to the last bit, or rays slip between.
    leaf
        Most triangles in a leaf, >= 2. Four is fastest on a CPU.
    dense
        Meshes of up to this many triangles are a single leaf.
    """
    triangles = np.asarray(triangles)
    kept = _with_area(triangles)
    used = triangles[kept]
    count = len(used)
    size = np.abs(used).max() if count else 1.0
    most = EXPONENTS[triangles.dtype.itemsize]
    exponent = int(np.clip(-np.frexp(size)[1], -most, most))
    scale = np.asarray(np.ldexp(1.0, exponent), triangles.dtype)
    used = used * scale
    levels = max(0, int(np.ceil(np.log2(count / leaf)))) if count > dense else 0
    order = _sorted(used, levels)
    bounds = _bounds(count, levels)
    slots = np.diff(bounds).max()
    # Triangles of each leaf, the last one repeated.
    places = np.minimum(bounds[:-1, None] + np.arange(slots), bounds[1:, None] - 1)
    members = order[places] if count else np.zeros((1, 0), np.int64)
    corners = used[members]
    ranks = np.lexsort(tuple(corners[..., axis] for axis in (2, 1, 0)), axis=-1)
    ordered = np.take_along_axis(corners, ranks[..., None], axis=-2).reshape(-1, 9)
    return Hierarchy(
        triangles,
        _boxes(corners, levels),
        tuple(np.ascontiguousarray(ordered[:, i]) for i in range(9)),
        np.flatnonzero(kept)[members].astype(np.int32).reshape(-1),
        scale,
    )


def _with_area(triangles: Float[np.ndarray, "F 3 3"]) -> np.ndarray:
    """Which triangles have finite corners and sides that are not parallel."""
    finite = np.asarray(np.isfinite(triangles).all((1, 2)))
    # Sides over the longest one: their products neither overflow nor vanish. Differences of
    # float32 are exact in float64, unless sizes differ by 2^29.
    corners = np.where(finite[:, None, None], triangles, 0).astype(np.float64)
    size = np.abs(corners).max((1, 2), keepdims=True)
    corners /= np.where(size > 0, size, 1.0)
    sides = corners[:, 1:] - corners[:, :1]
    length = np.abs(sides).max((1, 2), keepdims=True)
    sides /= np.where(length > 0, length, 1.0)
    normal = np.cross(sides[:, 0], sides[:, 1])
    return finite & (np.abs(normal).max(-1) > 4 * np.finfo(np.float64).eps)


def _bounds(count: int, level: int) -> np.ndarray:
    """First member of each group of a level, and the end: groups are halves of those above."""
    groups = 2**level
    return np.arange(groups + 1) * count // groups


def _sorted(triangles: Float[np.ndarray, "F 3 3"], levels: int) -> np.ndarray:
    """Order of triangles in which every group of every level is contiguous."""
    centres = 0.5 * (triangles.min(1) + triangles.max(1))
    order = np.arange(len(triangles))
    for level in range(levels):
        bounds = _bounds(len(triangles), level)
        group = np.repeat(np.arange(2**level), np.diff(bounds))
        held = centres[order]
        sides = np.maximum.reduceat(held, bounds[:-1]) - np.minimum.reduceat(held, bounds[:-1])
        along = held[np.arange(len(held)), sides.argmax(1)[group]]
        order = order[np.lexsort((along, group))]
    return order


def _boxes(corners: np.ndarray, levels: int) -> tuple[np.ndarray, ...]:
    """Boxes of both children of every inner node, from the corners in the leaves, as columns."""
    count = 2**levels
    columns = np.zeros((count, 2, 2, 3), corners.dtype)
    if levels == 0:  # perhaps without any triangle
        return tuple(columns.reshape(count, 12).T)
    low, high = corners.min((1, 2)), corners.max((1, 2))
    for level in range(levels - 1, -1, -1):
        first = 2**level
        pairs = np.stack([low.reshape(-1, 2, 3), high.reshape(-1, 2, 3)], 2)
        columns[first : 2 * first] = pairs
        low, high = pairs[:, :, 0].min(1), pairs[:, :, 1].max(1)
    return tuple(np.ascontiguousarray(column) for column in columns.reshape(count, 12).T)
