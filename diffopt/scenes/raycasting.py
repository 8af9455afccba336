"""Which surface a ray meets: Embree on the CPU, or `diffopt.kernels.intersect` on any device.

Rays have no derivative; what is computed from their hits has, at fixed visibility.
"""

import functools
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from diffopt import checks
from diffopt.kernels import hierarchy, intersect
from diffopt.scenes.scene import Geometry

Backend = Literal["embree", "jax"]
#: Rays handled at once.
BLOCK = 2**15
# Rays leave a surface this far from it, in radii of the scene: some hundred roundings of
# float32 coordinates.
OFFSET = 2e-5


class Hits(NamedTuple):
    """What rays meet first.

    Attributes
    ----------
    primitive
        Number of the primitive, -1 for none, [n].
    distance
        [n], infinite for none.
    u, v
        Shares of the second and third corner of a triangle, [n].
    """

    primitive: Int[np.ndarray, " n"]
    distance: Float[np.ndarray, " n"]
    u: Float[np.ndarray, " n"]
    v: Float[np.ndarray, " n"]


class Caster:
    """Casts rays at the shapes of a scene.

    Parameters
    ----------
    geometry
        Of the scene.
    backend
        ``"embree"``: triangles by Embree, on the CPU. ``"jax"``: everything in JAX, on the
        device that JAX uses.

    Lengths are those of the scene; directions are unit vectors.
    """

    def __init__(self, geometry: Geometry, backend: str = "embree") -> None:
        self.backend = checks.choice("backend", backend, get_args(Backend))
        self.geometry = geometry
        self.triangles, self.spheres, self.discs = geometry.world.counts

    @property
    def offset(self) -> float:
        """How far from a surface rays leave it."""
        return OFFSET * self.geometry.radius

    def first(
        self, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
    ) -> Hits:
        """What rays meet first."""
        count = len(origins)
        hits = Hits(
            np.full(count, -1, np.int32),
            np.full(count, np.inf, np.float32),
            np.zeros(count, np.float32),
            np.zeros(count, np.float32),
        )
        for start in range(0, count, BLOCK):
            part = slice(start, start + BLOCK)
            o, d = self._scaled(origins[part]), np.asarray(directions[part], np.float32)
            if self.triangles:
                self._triangles(o, d, hits, part)
            if self.spheres + self.discs:
                self._rounds(o, d, hits, part)
            hits.distance[part] *= np.float32(self.geometry.radius)
        return hits

    def blocked(
        self,
        origins: Float[np.ndarray, "n 3"],
        directions: Float[np.ndarray, "n 3"],
        lengths: Float[np.ndarray, " n"],
    ) -> Bool[np.ndarray, " n"]:
        """Whether something lies within a length along rays."""
        out = np.zeros(len(origins), bool)
        for start in range(0, len(origins), BLOCK):
            part = slice(start, start + BLOCK)
            o, d = self._scaled(origins[part]), np.asarray(directions[part], np.float32)
            far = np.asarray(lengths[part] / self.geometry.radius, np.float32)
            if self.triangles:
                out[part] = self._triangles_block(o, d, far)
            if self.spheres + self.discs:
                found, _ = _rounds(*self._device_rounds, *_padded(o, d, far), self.spheres)
                out[part] |= np.asarray(found)[: len(o)] < far
        return out

    def _scaled(self, points: np.ndarray) -> np.ndarray:
        """Places in the frame in which the scene is a unit ball."""
        near = (np.asarray(points, np.float64) - self.geometry.centre) / self.geometry.radius
        return near.astype(np.float32)

    def _triangles(self, o: np.ndarray, d: np.ndarray, hits: Hits, part: slice) -> None:
        if self.backend == "embree":
            found = self._embree.run(o, d, output=1)
            met = found["primID"] >= 0
            hits.primitive[part] = np.where(met, found["primID"], -1)
            hits.distance[part] = np.where(met, found["tfar"], np.inf)
            hits.u[part], hits.v[part] = np.where(met, found["u"], 0), np.where(met, found["v"], 0)
            return
        far = np.full(len(o), np.inf, np.float32)
        found = _first(self._tree, *_padded(o, d, far))
        distance, index, u, v = (np.asarray(a)[: len(o)] for a in found)
        hits.primitive[part], hits.distance[part] = index, distance
        hits.u[part], hits.v[part] = u, v

    def _triangles_block(self, o: np.ndarray, d: np.ndarray, far: np.ndarray) -> np.ndarray:
        if self.backend == "embree":
            # Embree takes the lengths as they are; infinite ones as large.
            limit = np.minimum(far, np.float32(1e30))
            return self._embree.run(o, d, dists=limit, query="OCCLUDED") >= 0
        return np.asarray(_blocked(self._tree, *_padded(o, d, far)))[: len(o)]

    def _rounds(self, o: np.ndarray, d: np.ndarray, hits: Hits, part: slice) -> None:
        limit = hits.distance[part]
        found, index = _rounds(*self._device_rounds, *_padded(o, d, limit), self.spheres)
        found, index = np.asarray(found)[: len(o)], np.asarray(index)[: len(o)]
        nearer = (index >= 0) & (found < limit)
        hits.distance[part] = np.where(nearer, found, limit)
        hits.primitive[part] = np.where(nearer, self.triangles + index, hits.primitive[part])

    @functools.cached_property
    def _corners(self) -> Float[np.ndarray, "T 3 3"]:
        world = self.geometry.world
        scaled = (np.asarray(world.vertices) - self.geometry.centre) / self.geometry.radius
        return scaled[np.asarray(world.faces)]

    @functools.cached_property
    def _embree(self) -> Any:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        scene = EmbreeScene(robust=True)
        TriangleMesh(scene, self._corners.astype(np.float32))
        return scene

    @functools.cached_property
    def _tree(self) -> Any:
        return hierarchy.build(self._corners.astype(np.float32))

    @functools.cached_property
    def _device_rounds(self) -> tuple[Any, ...]:
        world, scale = self.geometry.world, self.geometry.radius
        centres = (np.asarray(world.centres) - self.geometry.centre) / scale
        radii, normals = np.asarray(world.radii) / scale, np.asarray(world.axes)[:, :, 2]
        return tuple(jnp.asarray(a, jnp.float32) for a in (centres, radii, normals))


@functools.lru_cache(maxsize=8)
def caster(geometry: Geometry, backend: str = "embree") -> Caster:
    """The caster of a geometry, made once."""
    return Caster(geometry, backend)


def _padded(*arrays: np.ndarray) -> list[np.ndarray]:
    """Rows up to a full block, so that one compiled program serves all; many short of it."""
    count = len(arrays[0])
    size = BLOCK if count > BLOCK // 16 else BLOCK // 16
    return [np.concatenate([a, np.repeat(a[:1], size - count, axis=0)]) for a in arrays]


@jax.jit
def _first(tree: Any, o: Any, d: Any, far: Any) -> Any:
    return intersect.first_hit(tree, o, d, far)


@jax.jit
def _blocked(tree: Any, o: Any, d: Any, far: Any) -> Any:
    return intersect.blocked(tree, o, d, far)


@functools.partial(jax.jit, static_argnums=6)
def _rounds(centres: Any, radii: Any, normals: Any, o: Any, d: Any, far: Any, spheres: int) -> Any:
    """Nearest of spheres and discs, and its number; -1 for none."""
    distance, index = far, jnp.full(far.shape, -1, jnp.int32)
    if spheres:
        distance, index = intersect.spheres(o, d, centres[:spheres], radii[:spheres], distance)
    if spheres < len(radii):
        flat = slice(spheres, None)
        near, which = intersect.discs(o, d, centres[flat], normals[flat], radii[flat], distance)
        index = jnp.where(which >= 0, which + spheres, index)
        distance = jnp.where(which >= 0, near, distance)
    return distance, index
