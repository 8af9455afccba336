"""Placing objects: matrices [4, 4] on columns (x, y, z, 1), composed with ``@``.

``translate(...) @ rotate(...) @ scale(...)`` scales first. Lengths are in the scene's unit.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from diffopt.errors import InputError

Matrix = Float[np.ndarray, "4 4"]


def vector(name: str, value: Any) -> Float[np.ndarray, "3"]:
    """Three finite numbers, or an error that names them."""
    try:
        found = np.asarray(value, np.float64)
    except (TypeError, ValueError):
        found = np.empty(0)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise InputError(f"{name} must be three finite numbers; received {value}")
    return found


def unit(name: str, value: Any) -> Float[np.ndarray, "3"]:
    """Direction of three numbers that are not all 0, as a unit vector."""
    found = vector(name, value)
    length = float(np.linalg.norm(found))
    if length == 0.0:
        raise InputError(f"{name} must be a direction; received {value}")
    return found / length


def translate(x: float, y: float, z: float) -> Matrix:
    """Move by a vector."""
    out = np.eye(4)
    out[:3, 3] = vector("translation", (x, y, z))
    return out


def scale(x: float, y: float | None = None, z: float | None = None) -> Matrix:
    """Scale by one factor, or by one along each axis; none is 0."""
    factors = vector("scale", (x, x if y is None else y, x if z is None else z))
    if not factors.all():
        raise InputError(f"scale must not be 0; received {factors.tolist()}")
    return np.diag([*factors, 1.0])


def rotate(axis: Any, degrees: float) -> Matrix:
    """Turn about an axis through the origin, counter-clockwise as seen from its tip."""
    x, y, z = unit("axis", axis)
    angle = math.radians(degrees)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    out = np.eye(4)
    # Rodrigues' formula.
    out[:3, :3] += math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)
    return out


def facing(origin: Any, target: Any, up: Any = (0.0, 0.0, 1.0)) -> Matrix:
    """Put the origin at a place and turn the z axis towards a target, y as far up as it goes.

    Raises
    ------
    InputError
        If origin and target coincide, or `up` points along their line.
    """
    origin = vector("origin", origin)
    z = unit("target - origin", vector("target", target) - origin)
    x = np.cross(unit("up", up), z)
    if np.linalg.norm(x) < 1e-9:
        raise InputError(f"up must not point along the line to the target; received {up}")
    x /= np.linalg.norm(x)
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 2], out[:3, 3] = x, np.cross(z, x), z, origin
    return out


def checked(value: Any) -> Matrix:
    """A matrix that places an object: finite, affine, invertible.

    Raises
    ------
    InputError
        For anything else.
    """
    found = np.eye(4) if value is None else np.asarray(value, np.float64)
    if found.shape != (4, 4) or not np.isfinite(found).all():
        raise InputError(f"transform must be [4, 4] and finite; received shape {found.shape}")
    if not np.array_equal(found[3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(
            f"the last row of transform must be 0, 0, 0, 1; received {found[3].tolist()}"
        )
    size = np.linalg.svd(found[:3, :3], compute_uv=False)
    if size[-1] <= 1e-12 * size[0]:
        raise InputError("transform must not flatten space; received a singular matrix")
    return found


def similarity(matrix: Matrix) -> tuple[float, Float[np.ndarray, "3 3"]]:
    """Scale and rotation (a mirror image's determinant is -1) of a matrix that keeps shapes.

    Raises
    ------
    InputError
        If the matrix stretches or shears.
    """
    linear = matrix[:3, :3]
    size = float(np.cbrt(abs(np.linalg.det(linear))))
    if np.abs(linear.T @ linear - size**2 * np.eye(3)).max() > 1e-9 * size**2:
        raise InputError(
            "spheres and discs stay round: expected a transform that scales all axes alike; "
            f"received {linear.tolist()} (use a mesh for an ellipsoid)"
        )
    return size, linear / size
