"""What a camera sees of a mesh: triangles at samples, and the vertices that they need."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt.scenes.camera import Camera


class Seen(NamedTuple):
    """What a camera sees of a mesh.

    Attributes
    ----------
    vertices
        That are needed, padded with the last one, [n].
    covered
        Samples that see the front of a surface, padded with one beyond the last, [P].
    place
        Place of every sample among those, P for those that see none, [h w samples^2].
    corners
        Places among `vertices` of the corners of their triangles, [P, 3].
    shares
        Of the corners, [P, 3].
    towards
        Direction of the ray of every sample, [h w samples^2, 3].
    eye
        [3].
    shape
        Rows and columns of the picture.
    samples
        On a side of each pixel.
    """

    vertices: Int[np.ndarray, " n"]
    covered: Int[np.ndarray, " P"]
    place: Int[np.ndarray, " S"]
    corners: Int[np.ndarray, "P 3"]
    shares: Float[np.ndarray, "P 3"]
    towards: Float[np.ndarray, "S 3"]
    eye: Float[np.ndarray, "3"]
    shape: tuple[int, int]
    samples: int


class Raster:
    """Finds what cameras see of a mesh.

    Parameters
    ----------
    vertices
        [V, 3].
    triangles
        [G, 3].
    """

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self.triangles = triangles
        low, high = vertices.min(0), vertices.max(0)
        self.centre, self.radius = 0.5 * (low + high), float(np.linalg.norm(high - low)) / 2 or 1.0
        corners = ((vertices - self.centre) / self.radius)[triangles].astype(np.float32)
        edges = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        self.normal = np.cross(*edges)
        self.scene = EmbreeScene(robust=True)
        TriangleMesh(self.scene, corners)

    def __call__(self, camera: Camera, samples: int = 1) -> Seen:
        """What a camera sees, with samples on a side of each pixel."""
        rows, columns = camera.shape
        places = (np.arange(samples) + 0.5) / samples
        inside = np.stack(np.meshgrid(places, places), -1).reshape(-1, 2)
        pixel = np.repeat(np.arange(rows * columns), len(inside))
        origin, towards = camera.rays(pixel, np.tile(inside, (rows * columns, 1)))
        near = ((origin - self.centre) / self.radius).astype(np.float32)
        along = towards.astype(np.float32)
        found = self.scene.run(near, along, output=1)
        which = found["primID"]
        front = (self.normal[np.maximum(which, 0)] * along).sum(-1) < 0.0
        covered = np.flatnonzero((which >= 0) & front)
        met = self.triangles[which[covered]]
        used = np.zeros(int(self.triangles.max()) + 1, bool)
        used[met] = True
        vertices = np.flatnonzero(used).astype(np.int32)
        place = np.cumsum(used, dtype=np.int32) - 1
        u, v = found["u"][covered], found["v"][covered]
        shares = np.stack([1.0 - u - v, u, v], -1).astype(np.float32)
        size = _bucket(len(covered))
        beside = np.full(len(pixel), size, np.int32)
        beside[covered] = np.arange(len(covered), dtype=np.int32)
        return Seen(
            _filled(vertices, _bucket(len(vertices)), 0),
            _filled(covered.astype(np.int32), size, len(pixel)),
            beside,
            _filled(place[met], size, 0),
            _filled(shares, size, np.float32(1.0 / 3.0)),
            along,
            np.asarray(camera.eye, np.float32),
            (rows, columns),
            samples,
        )


def _bucket(count: int) -> int:
    """Sizes that programs are compiled for: powers of two and three quarters of them."""
    size = 1024
    while size < count:
        size *= 2
    return 3 * size // 4 if 3 * size // 4 >= max(count, 1024) else size


def _filled(rows: np.ndarray, size: int, value: Any) -> np.ndarray:
    more = np.full((size - len(rows), *rows.shape[1:]), value, rows.dtype)
    return np.concatenate([rows, more])
