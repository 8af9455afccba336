"""Arguments that become meshes to refine: checked, and without faces that cannot be."""

import numpy as np
from jaxtyping import Float, Int

from diffopt.checks import Values
from diffopt.errors import InputError

# Coordinates whose fourth power still is a float64.
_LARGEST = 1e70
# Twice the area over longest side times largest coordinate, in roundings: without area below.
_FLAT = 8.0 * np.finfo(np.float64).eps
_INT32 = np.iinfo(np.int32)


def triples(name: str, value: Values, count: int | None = None) -> Float[np.ndarray, "V 3"]:
    """Finite vectors in float64; of a number of them, if that is given.

    Raises
    ------
    InputError
        If the shape is another, or a component is not finite or above 1e70.
    """
    array = _array(name, value)
    if array.size == 0 and not count:
        return np.zeros((0, 3))
    if array.ndim != 2 or array.shape[1] != 3 or (count is not None and len(array) != count):
        expected = f"[{'V' if count is None else count}, 3]"
        raise InputError(f"{name} must have shape {expected}; received {list(array.shape)}")
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} must be real numbers; received {array.dtype}")
    array = array.astype(np.float64)
    bad = ~(np.abs(array) <= _LARGEST).all(axis=1)
    if bad.any():
        raise InputError(
            f"{name} must be finite and at most {_LARGEST:g}; received "
            f"{array[np.argmax(bad)].tolist()} in row {np.argmax(bad)}"
        )
    return array


def units(name: str, value: Values, count: int) -> Float[np.ndarray, "V 3"]:
    """Directions divided by their lengths.

    Raises
    ------
    InputError
        As `triples`, and if one is 0.
    """
    array = triples(name, value, count)
    # By the largest component first: squares of small and large ones are out of range.
    largest = np.abs(array).max(axis=1, initial=0.0)
    if not largest.all():
        raise InputError(f"{name} must not be 0; received 0 in row {np.argmin(largest != 0.0)}")
    array = array / largest[:, None]
    return array / np.linalg.norm(array, axis=1, keepdims=True)


def labels(value: Values | None, count: int) -> Int[np.ndarray, " M"]:
    """One int32 for each face; 0 for None.

    Raises
    ------
    InputError
        If there are more or fewer, or one is no int32.
    """
    if value is None:
        return np.zeros(count, np.int32)
    array = _array("label", value)
    if array.shape != (count,) or (count and array.dtype.kind not in "iu"):
        raise InputError(
            f"label must be integers [{count}]; received {array.dtype} {list(array.shape)}"
        )
    if count and not (_INT32.min <= array.min() and array.max() <= _INT32.max):
        raise InputError(f"label must fit int32; received {array.min()} to {array.max()}")
    return array.astype(np.int32)


def numbers(name: str, value: Values, count: int) -> Int[np.ndarray, " n"]:
    """Numbers of faces, of which there are `count`.

    Raises
    ------
    InputError
        If they are not integers [n] from 0 to `count` - 1.
    """
    array = _array(name, value)
    if array.shape == (0,):
        return np.zeros(0, np.int64)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise InputError(f"{name} must be integers [n]; received {array.dtype} {list(array.shape)}")
    if array.min() < 0 or array.max() >= count:
        worst = array.min() if array.min() < 0 else array.max()
        raise InputError(f"{name} must name faces from 0 to {count - 1}; received {worst}")
    return array.astype(np.int64)


def usable(vertices: Values, faces: Values) -> Int[np.ndarray, " n"]:
    """Numbers of the faces that can be refined, in their order.

    Left out are faces without an area, to the rounding of float64 coordinates, and faces on the
    same three vertices, in any order, as one before them.

    Raises
    ------
    InputError
        If a shape is another, a position is not finite, or a face names a vertex that does not
        exist.
    """
    points = triples("vertices", vertices)
    corners = _array("faces", faces)
    if corners.size == 0:
        return np.zeros(0, np.int64)
    if corners.ndim != 2 or corners.shape[1] != 3 or corners.dtype.kind not in "iu":
        raise InputError(
            f"faces must be integers [M, 3]; received {corners.dtype} {list(corners.shape)}"
        )
    outside = (corners < 0) | (corners >= len(points))
    if outside.any():
        raise InputError(
            f"faces must name vertices from 0 to {len(points) - 1}; received "
            f"{corners[outside][0]} in face {np.argmax(outside.any(axis=1))}"
        )
    corners = corners.astype(np.int64)
    triangles = points[corners]
    sides = np.roll(triangles, -1, axis=1) - triangles
    longest = np.linalg.norm(sides, axis=-1).max(axis=1)
    twice = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=-1)
    good = twice > _FLAT * longest * np.abs(triangles).max(axis=(1, 2))
    ordered = np.sort(corners, axis=1)
    order = np.lexsort(ordered.T)
    again = (ordered[order[1:]] == ordered[order[:-1]]).all(axis=1)
    # The sort is stable: the first of equal faces stands before the others.
    good[order[1:][again]] = False
    return np.flatnonzero(good)


def _array(name: str, value: Values) -> np.ndarray:
    try:
        return np.asarray(value)
    except ValueError as error:  # rows of different lengths
        raise InputError(f"{name} must be one array; received rows of different lengths") from error
