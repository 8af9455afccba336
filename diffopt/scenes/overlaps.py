"""Flat surfaces of different objects that lie in one place."""

import itertools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from diffopt.scenes import shapes
from diffopt.scenes.scene import Object

# Corners that stand for a disc, and the faces of a mesh up to which it is looked at.
_CORNERS, _FEW = 32, 64
# Distance of planes, and depth of an overlap, as shares of the smaller piece.
_CLOSE, _DEEP = 1e-6, 1e-3


class Flat(NamedTuple):
    """A convex piece of a surface: corners [K, 3] and the normal of its front [3]."""

    corners: Float[np.ndarray, "K 3"]
    normal: Float[np.ndarray, "3"]


def pieces(one: Object) -> list[Flat]:
    """The flat pieces of an object; none of spheres and large meshes."""
    patch = one.patch
    if isinstance(patch, shapes.Round):
        if patch.kind is shapes.Sphere:
            return []
        angle = 2.0 * math.pi * np.arange(_CORNERS)[:, None] / _CORNERS
        x, y, z = patch.axes.T
        around = patch.radius * (np.cos(angle) * x + np.sin(angle) * y)
        return [Flat(patch.centre + around, z)]
    faces = patch.faces
    if len(faces) > _FEW:
        return []
    if isinstance(one.place.shape, shapes.Plane | shapes.Box):
        # Two triangles share a diagonal: corners in order from the first, then the last.
        quads = []
        for a, b in faces.reshape(-1, 2, 3):
            (last,) = set(b.tolist()) - set(a.tolist())
            shared = [v for v in a.tolist() if v in b]
            (alone,) = set(a.tolist()) - set(shared)
            quads.append([shared[0], alone, shared[1], last])
        corners = patch.vertices[np.array(quads)]
        fronts = patch.vertices[faces[::2]]
    else:
        corners = fronts = patch.vertices[faces]
    across = np.cross(fronts[:, 1] - fronts[:, 0], fronts[:, 2] - fronts[:, 0])
    length = np.linalg.norm(across, axis=-1)
    return [
        Flat(c, n / size) for c, n, size in zip(corners, across, length, strict=True) if size > 0.0
    ]


def overlapping(first: list[Flat], second: list[Flat]) -> tuple[bool, bool]:
    """Whether pieces lie in one place facing the same way, and facing opposite ways."""
    same = opposite = False
    for a, b in itertools.product(first, second):
        along = float(a.normal @ b.normal)
        if abs(along) < 1.0 - 1e-9 or not _share(a, b):
            continue
        same, opposite = same or along > 0.0, opposite or along < 0.0
    return same, opposite


def _share(a: Flat, b: Flat) -> bool:
    """Whether two parallel pieces lie in one plane and have an area in common."""
    size = min(float(np.linalg.norm(np.ptp(p.corners, axis=0))) for p in (a, b))
    if abs(float((b.corners[0] - a.corners[0]) @ a.normal)) > _CLOSE * size:
        return False
    # Convex pieces are apart if an edge of one of them separates them.
    for piece in (a, b):
        for edge in np.roll(piece.corners, -1, axis=0) - piece.corners:
            length = np.linalg.norm(edge)
            if length == 0.0:
                continue
            side = np.cross(a.normal, edge / length)
            one, other = a.corners @ side, b.corners @ side
            if min(one.max(), other.max()) - max(one.min(), other.min()) < _DEEP * size:
                return False
    return True
