"""Primary rays: what a camera sees of a mesh, triangles and shares of their corners, by Embree.

For one mesh and one camera, in float32; `diffopt.scenes.raycasting` casts any rays at a scene.
"""

import functools
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt.scenes.camera import Camera

# The bounding sphere is taken this much larger: rays that graze it are cast.
_MARGIN = 1.001
# Farther away, in radii, float32 does not tell rays past it from others.
_FAR = 300.0


class Hits(NamedTuple):
    """What rays met.

    Attributes
    ----------
    pixel
        Numbers of the pixels that see the mesh, [n].
    face
        Of each, [n].
    shares
        Of the three corners, [n, 3].
    front
        Whether its front is seen, [n].
    distance
        From the eye, [n].
    """

    pixel: Int[np.ndarray, " n"]
    face: Int[np.ndarray, " n"]
    shares: Float[np.ndarray, "n 3"]
    front: np.ndarray
    distance: Float[np.ndarray, " n"]


class PrimaryCaster:
    """A mesh that rays are cast at.

    Parameters
    ----------
    vertices, faces
        [V, 3] and [F, 3].
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        low, high = vertices.min(0), vertices.max(0)
        self.centre, self.radius = 0.5 * (low + high), float(np.linalg.norm(high - low)) / 2 or 1.0
        corners = ((vertices - self.centre) / self.radius)[faces].astype(np.float32)
        self._normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        # Embree keeps no copy.
        self._corners = corners
        self._scene = EmbreeScene(robust=True)
        TriangleMesh(self._scene, corners)

    def __call__(self, camera: Camera, inside: tuple[float, float] = (0.5, 0.5)) -> Hits:
        """What a camera sees; `inside` is where in each pixel its ray goes."""
        own = _own_rays(camera.resolution, camera.field_of_view, inside)
        turn = camera.matrix[:3, :3]
        eye = (np.asarray(camera.eye) - self.centre) / self.radius
        distance = float(np.linalg.norm(eye))
        if _MARGIN < distance < _FAR:
            # Rays past the bounding sphere meet nothing.
            least = math.sqrt(1.0 - (_MARGIN / distance) ** 2)
            middle = (turn.T @ (-eye / distance)).astype(np.float32)
            pixel = np.flatnonzero(_dot(own, middle) > least).astype(np.int32)
            own = own[pixel]
        else:
            pixel = np.arange(len(own), dtype=np.int32)
        towards = _turned(own, turn)
        # From where the bounding sphere begins: Embree would count the way there in float32.
        ahead = np.float32(max(distance - _MARGIN, 0.0))
        starts = ahead * towards
        starts += eye.astype(np.float32)
        found = self._scene.run(starts, towards, output=1)
        face = found["primID"]
        hit = np.flatnonzero(face >= 0)
        face = face[hit]
        u, v = found["u"][hit], found["v"][hit]
        front = _dot(self._normal[face], towards[hit]) < 0.0
        far = self.radius * (found["tfar"][hit].astype(np.float64) + ahead)
        return Hits(pixel[hit], face, np.stack([1.0 - u - v, u, v], -1), front, far)

    def blocked(
        self, starts: Float[np.ndarray, "n 3"], towards: Float[np.ndarray, "3"]
    ) -> np.ndarray:
        """Whether the mesh hides one direction from points, [n]."""
        near = ((starts - self.centre) / self.radius).astype(np.float32)
        along = np.broadcast_to(np.asarray(towards, np.float32), near.shape)
        return self._scene.run(near, np.ascontiguousarray(along)) >= 0


def rays(camera: Camera, inside: tuple[float, float] = (0.5, 0.5)) -> Float[np.ndarray, "n 3"]:
    """Unit directions through the pixels of a camera, row after row, float32."""
    own = _own_rays(camera.resolution, camera.field_of_view, inside)
    return _turned(own, camera.matrix[:3, :3])


# Products of rows with small matrices are five times as slow through np.matmul.
def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _turned(rows: np.ndarray, turn: np.ndarray) -> np.ndarray:
    out = np.empty_like(rows)
    for k, axis in enumerate(turn.astype(np.float32)):
        out[:, k] = _dot(rows, axis)
    return out


@functools.lru_cache(maxsize=8)
def _own_rays(
    resolution: tuple[int, int], field_of_view: float, inside: tuple[float, float]
) -> Float[np.ndarray, "n 3"]:
    """In the axes of the camera."""
    columns, rows = resolution
    half = math.tan(math.radians(0.5 * field_of_view)) / (0.5 * min(resolution))
    x = (np.arange(columns) + inside[0] - 0.5 * columns) * half
    y = (0.5 * rows - np.arange(rows) - inside[1]) * half
    out = np.empty((rows, columns, 3), np.float32)
    length = np.sqrt(1.0 + x[None, :] ** 2 + y[:, None] ** 2)
    out[..., 0], out[..., 1], out[..., 2] = x[None, :] / length, y[:, None] / length, -1.0 / length
    return out.reshape(-1, 3)
