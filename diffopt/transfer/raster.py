"""What a camera sees of a mesh: triangles at samples, and the vertices that they need."""

import dataclasses
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt.scenes.camera import Camera
from diffopt.scenes.primary import PrimaryCaster, rays


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
    past
        Samples whose rays meet nothing, not even the back of a surface, [Q].
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
    past: Int[np.ndarray, " Q"]
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
        self.triangles = triangles
        self._caster = PrimaryCaster(vertices, triangles)

    def __call__(self, camera: Camera, samples: int = 1) -> Seen:
        """What a camera sees, with samples on a side of each pixel."""
        rows, columns = camera.shape
        size = columns * samples, rows * samples
        fine = dataclasses.replace(camera, resolution=size)
        hits = self._caster(fine)
        # From row after row of samples to pixel after pixel.
        number = np.arange(size[0] * size[1], dtype=np.int32).reshape(rows, columns, samples, -1)
        order = number.swapaxes(1, 2).reshape(-1)
        seen = np.flatnonzero(hits.front)
        seen = seen[np.argsort(order[hits.pixel[seen]])] if samples > 1 else seen
        covered = order[hits.pixel[seen]]
        met = self.triangles[hits.face[seen]]
        used = np.zeros(int(self.triangles.max()) + 1, bool)
        used[met] = True
        vertices = np.flatnonzero(used).astype(np.int32)
        place = np.cumsum(used, dtype=np.int32) - 1
        length = _bucket(len(covered))
        beside = np.full(len(order), length, np.int32)
        beside[covered] = np.arange(len(covered), dtype=np.int32)
        open_ = np.ones(len(order), bool)
        open_[hits.pixel] = False
        towards = np.empty((len(order), 3), np.float32)
        towards[order] = rays(fine)
        return Seen(
            _filled(vertices, _bucket(len(vertices)), 0),
            _filled(covered, length, len(order)),
            beside,
            _filled(place[met], length, 0),
            _filled(hits.shares[seen], length, np.float32(1.0 / 3.0)),
            order[open_],
            towards,
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
