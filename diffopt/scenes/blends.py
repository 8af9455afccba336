"""Smooth closed bodies: ellipsoids blended into one surface, and its mesh.

The surface is F = 0 of F = -k log sum_i exp(-f_i / k), f_i = r_i (|A_i (x - c_i)| - 1): the
ellipsoids joined, with fillets about k wide (after Ricci, A constructive geometry for computer
graphics, The Computer Journal 16(2), 1973). F is infinitely often differentiable but in the
ellipsoids' middles, so that the normals of a mesh are its gradient, exactly.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt.scenes.meshfiles import Mesh

# Rounds of moving vertices to the middle of their neighbours and back to the surface: after
# fewer, corners of the grid still show as slivers; more change little.
_ROUNDS = 12
# Newton's steps back to the surface in a round, and at the end: each squares what is missing.
_STEPS, _LAST = 1, 4


class Ellipsoid(NamedTuple):
    """Middle, half axes, and the angle in degrees that x is turned down to -z about y.

    A `side` not 0 stands for two: at +side and -side from the xz plane, `lean` degrees
    outwards about x.
    """

    x: float
    z: float
    radii: tuple[float, float, float]
    pitch: float = 0.0
    side: float = 0.0
    lean: float = 0.0


class Blend(NamedTuple):
    """Ellipsoids, and the width k of their fillets."""

    parts: tuple[Ellipsoid, ...]
    width: float


RABBIT = Blend(
    (
        Ellipsoid(-0.20, 0.60, (0.66, 0.50, 0.54), -14.0),  # trunk
        Ellipsoid(0.26, 0.66, (0.36, 0.36, 0.46), -10.0),  # chest
        Ellipsoid(-0.34, 0.40, (0.42, 0.22, 0.37), -20.0, 0.36, 6.0),  # haunches
        Ellipsoid(-0.02, 0.105, (0.34, 0.12, 0.10), 0.0, 0.43),  # hind feet
        Ellipsoid(0.06, 0.22, (0.15, 0.13, 0.13), 0.0, 0.33),  # knees
        Ellipsoid(0.43, 0.36, (0.12, 0.11, 0.32), -6.0, 0.17),  # fore legs
        Ellipsoid(0.55, 0.1165, (0.20, 0.105, 0.085), 0.0, 0.18),  # paws
        Ellipsoid(0.42, 1.02, (0.24, 0.24, 0.28), 20.0),  # neck
        Ellipsoid(0.56, 1.28, (0.34, 0.27, 0.27), 14.0),  # head
        Ellipsoid(0.81, 1.20, (0.16, 0.15, 0.13), 14.0),  # muzzle
        Ellipsoid(0.70, 1.17, (0.16, 0.12, 0.13), 0.0, 0.13),  # cheeks
        Ellipsoid(0.33, 1.80, (0.09, 0.125, 0.46), -20.0, 0.205, 11.0),  # ears
        Ellipsoid(-0.88, 0.42, (0.18, 0.18, 0.18)),  # tail
    ),
    0.05,
)


def build(blend: Blend, detail: int) -> Mesh:
    """The mesh of a blend.

    Marching cubes (scikit-image's, after Lewiner and others, 2003) give its topology; its
    vertices then move to the middle of their neighbours and back to the surface, several times,
    so that no sliver stays.

    Parameters
    ----------
    blend
        The body.
    detail
        Cells of the grid along its longest side.
    """
    from skimage.measure import marching_cubes

    low, high = _box(blend)
    step = float((high - low).max()) / detail
    # A cell more on each side: fillets are outside the ellipsoids.
    axes = [np.arange(a - 2.0 * step, b + 3.0 * step, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    # Downwards: the library winds its faces about falling values otherwise.
    vertices, faces, _, _ = marching_cubes(
        field(blend, grid.reshape(-1, 3)).reshape(grid.shape[:3]), 0.0, allow_degenerate=False
    )
    vertices = np.asarray(vertices, np.float64) * step + [axis[0] for axis in axes]
    faces = np.asarray(faces, np.int64)
    vertices = _relaxed(blend, vertices, faces)
    slope = gradient(blend, vertices)
    return Mesh(vertices, faces, slope / np.linalg.norm(slope, axis=-1, keepdims=True))


def field(blend: Blend, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """F at points: below 0 inside."""
    total = np.full(len(points), -np.inf)
    for part in _ellipsoids(blend):
        total = np.logaddexp(total, -_one(part, points)[0] / blend.width)
    return -blend.width * total


def gradient(blend: Blend, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Gradient of F at points, outwards on the surface; its length there is about 1."""
    total = -field(blend, points) / blend.width
    found = np.zeros_like(points)
    for part in _ellipsoids(blend):
        value, slope = _one(part, points)
        found += np.exp(-value / blend.width - total)[:, None] * slope
    return found


class _Placed(NamedTuple):
    middle: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    radii: Float[np.ndarray, "3"]


def _ellipsoids(blend: Blend) -> list[_Placed]:
    """Every ellipsoid; rows of `axes` are the directions of its half axes."""
    found = []
    for part in blend.parts:
        c, s = math.cos(math.radians(part.pitch)), math.sin(math.radians(part.pitch))
        pitch = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        for sign in (1.0, -1.0) if part.side else (0.0,):
            # Outwards on either side: the angle turns with the side.
            angle = -sign * math.radians(part.lean)
            c, s = math.cos(angle), math.sin(angle)
            lean = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
            middle = np.array([part.x, sign * part.side, part.z])
            found.append(_Placed(middle, pitch @ lean, np.array(part.radii)))
    return found


def _one(part: _Placed, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values of f of one ellipsoid, and its gradients."""
    scaled = part.axes / part.radii[:, None]
    inside = (points - part.middle) @ scaled.T
    length = np.maximum(np.linalg.norm(inside, axis=-1, keepdims=True), 1e-12)
    size = float(np.cbrt(part.radii.prod()))
    return size * (length[:, 0] - 1.0), size * (inside / length) @ scaled


def _box(blend: Blend) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box around the ellipsoids."""
    parts = _ellipsoids(blend)
    middles = np.stack([part.middle for part in parts])
    reach = np.stack([np.linalg.norm(part.axes * part.radii[:, None], axis=0) for part in parts])
    return (middles - reach).min(axis=0), (middles + reach).max(axis=0)


def _relaxed(
    blend: Blend, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Vertices spread over the surface, and on it."""
    from scipy.sparse import coo_matrix

    # Every edge of a closed mesh is in both ways in its faces.
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2).T
    near = coo_matrix((np.ones(ends.shape[1]), ends), shape=(len(vertices),) * 2).tocsr()
    count = np.asarray(near.sum(axis=1))
    for _ in range(_ROUNDS):
        vertices = _onto(blend, 0.5 * (vertices + (near @ vertices) / count), _STEPS)
    return _onto(blend, vertices, _LAST)


def _onto(blend: Blend, points: np.ndarray, steps: int) -> np.ndarray:
    for _ in range(steps):
        slope = gradient(blend, points)
        squared = (slope * slope).sum(-1, keepdims=True)
        points = points - field(blend, points)[:, None] * slope / squared
    return points
