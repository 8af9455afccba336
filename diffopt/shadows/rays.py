"""What rays meet of one mesh: Embree on the CPU, or JAX on any device."""

import functools
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from diffopt import checks
from diffopt.errors import InputError
from diffopt.kernels import hierarchy, intersect

Backend = Literal["embree", "jax"]
# Rays of the JAX backend at once.
_BLOCK = 2**15
# Backs of faces that a ray goes through at most, and how far behind one it goes on, in units of
# the mesh, which lies in a sphere of radius 1.
_LAYERS = 32
_BEHIND = 1e-5


class Rays:
    """Casts rays at triangles.

    Parameters
    ----------
    vertices
        [V, 3], any unit of length.
    faces
        Corners, [F, 3].
    backend
        "embree" or "jax": the same answers but for rays that graze an edge.

    Raises
    ------
    InputError
        If shapes are wrong, a vertex is not finite, or a face names a vertex that is not there.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        backend: str = "embree",
    ) -> None:
        self.backend = checks.choice("backend", backend, get_args(Backend))
        vertices, faces = np.asarray(vertices, np.float32), np.asarray(faces)
        check_mesh(vertices, faces)
        corners = vertices[faces]
        if self.backend == "embree":
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene

            self._scene: Any = EmbreeScene(robust=True)
            TriangleMesh(self._scene, corners)
        else:
            self._tree = hierarchy.build(corners)
        self._corners = corners

    def blocked(
        self, starts: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether each ray meets anything."""
        starts = np.ascontiguousarray(starts, np.float32)
        directions = np.ascontiguousarray(directions, np.float32)
        if self.backend == "embree":
            return self._scene.run(starts, directions, query="OCCLUDED") >= 0
        return self._in_blocks(_blocked, starts, directions)

    def face(
        self, starts: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Int[np.ndarray, " n"]:
        """Number of the face that each ray meets first, -1 for none."""
        starts = np.ascontiguousarray(starts, np.float32)
        directions = np.ascontiguousarray(directions, np.float32)
        if self.backend == "embree":
            return np.asarray(self._scene.run(starts, directions))
        return self._in_blocks(_face, starts, directions)

    def fronts(
        self, starts: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Bool[np.ndarray, " n"]:
        """Whether each ray meets the front of a face, whatever backs it goes through before.

        From outside a closed mesh this is whether it meets anything. From inside it leaves the
        body freely: what is seen then changes little as a point crosses the surface.
        """
        starts, directions = (np.asarray(a, np.float32) for a in (starts, directions))
        found = np.zeros(len(starts), bool)
        going = np.arange(len(starts))
        for _ in range(_LAYERS):
            face = self.face(starts, directions)
            met = face >= 0
            going, starts, directions, face = (a[met] for a in (going, starts, directions, face))
            facing = (self._normals[face] * directions).sum(1) < 0.0
            found[going[facing]] = True
            going, starts, directions, face = (
                a[~facing] for a in (going, starts, directions, face)
            )
            if not len(going):
                break
            # Behind the plane of the face that was met.
            normals = self._normals[face]
            along = ((self._corners[face, 0] - starts) * normals).sum(1)
            reach = np.maximum(along / (directions * normals).sum(1), 0.0) + _BEHIND
            starts = starts + reach[:, None] * directions
        return found

    @functools.cached_property
    def closed(self) -> bool:
        """Whether the mesh is closed and wound outwards: each edge once in either direction."""
        _, same = np.unique(self._corners.reshape(-1, 3), axis=0, return_inverse=True)
        ends = same.reshape(-1, 3)
        edges = ends[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        edges = edges[edges[:, 0] != edges[:, 1]]
        there = edges[:, 0] * (ends.max() + 1) + edges[:, 1]
        back = edges[:, 1] * (ends.max() + 1) + edges[:, 0]
        if len(np.unique(there)) != len(there) or len(np.setdiff1d(there, back)):
            return False
        a, b, c = (self._corners[:, i].astype(np.float64) for i in range(3))
        return float((a * np.cross(b, c)).sum()) > 0.0

    @functools.cached_property
    def _normals(self) -> Float[np.ndarray, "F 3"]:
        a, b, c = (self._corners[:, i] for i in range(3))
        normals = np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)

    def _in_blocks(self, query: Any, starts: np.ndarray, directions: np.ndarray) -> np.ndarray:
        found = []
        for first in range(0, len(starts), _BLOCK):
            o, d = starts[first : first + _BLOCK], directions[first : first + _BLOCK]
            spare = _BLOCK - len(o) if len(starts) > _BLOCK else 0
            o, d = (np.concatenate([a, np.repeat(a[:1], spare, 0)]) for a in (o, d))
            found.append(np.asarray(query(self._tree, o, d))[: len(o) - spare])
        return np.concatenate(found) if found else np.zeros(0, int)


def check_mesh(vertices: np.ndarray, faces: np.ndarray) -> None:
    """Refuse arrays that are no mesh."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or not len(vertices):
        raise InputError(f"vertices must be [V, 3]; received {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or not len(faces):
        raise InputError(f"faces must be [F, 3]; received {faces.shape}")
    if not np.isfinite(vertices).all():
        raise InputError("vertices must be finite; received infinite values or NaN")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise InputError(
            f"faces must name vertices 0 to {len(vertices) - 1}; received {faces.min()} "
            f"to {faces.max()}"
        )


@jax.jit
def _blocked(tree: Any, starts: Any, directions: Any) -> Any:
    return intersect.blocked(tree, starts, directions)


@jax.jit
def _face(tree: Any, starts: Any, directions: Any) -> Any:
    far = jnp.full(starts.shape[0], jnp.inf, starts.dtype)
    return intersect.first_hit(tree, starts, directions, far)[1]
