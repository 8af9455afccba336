"""What a precomputation begins with: the scene as transfer sees it, its triangles, their frames."""

import math

import numpy as np
from jaxtyping import Float

from diffopt.errors import InputError
from diffopt.scenes import raycasting
from diffopt.scenes.scene import Scene
from diffopt.transfer import tessellation
from diffopt.transfer.reflectors import reflectors
from diffopt.transfer.tessellation import Tessellation
from diffopt.transfer.tracing import Surroundings

# What counts as the median side at most, over the radius of the scene.
_USUAL = 1.0 / 64.0


def surroundings(scene: Scene, backend: str = "embree") -> Surroundings:
    """A scene as transfer sees it."""
    if not scene.objects:
        raise InputError("the scene has no objects")
    geometry = scene.geometry
    found, number = reflectors(scene)
    return Surroundings(raycasting.caster(geometry, backend), found, number[geometry.owner])


def begun(around: Surroundings, longest: float = math.inf) -> Tessellation:
    """The triangles of a scene, labelled by their reflectors.

    Those with a side longer than so many median sides (of a 64th of the scene's radius at most)
    are halved until there are none: the corners of a wide floor see nothing of what stands in
    its middle.
    """
    shapes = around.caster.geometry.world
    triangles, spheres, discs = shapes.counts
    if spheres + discs:
        raise InputError(
            f"transfer takes triangles; the scene has {spheres} spheres and {discs} discs: use "
            "meshes in their place, as diffopt.scenes.models makes them"
        )
    radius = around.caster.geometry.radius if math.isfinite(longest) else math.inf
    mesh = tessellation.begin(
        np.asarray(shapes.vertices),
        np.asarray(shapes.normals),
        np.asarray(shapes.tangents),
        np.asarray(shapes.faces),
        around.owner[:triangles],
    )
    sides = _sides(mesh, np.arange(len(mesh.faces)))
    usual = float(np.median(sides)) if len(sides) else 0.0
    limit = longest * min(usual, _USUAL * radius)
    while len(wide := _longer(mesh, limit)):
        mesh = tessellation.split(mesh, wide)
    if len(mesh.faces) == len(tessellation.leaves(mesh)):
        return mesh
    faces, origin = tessellation.closed(mesh)
    return tessellation.begin(mesh.vertices, mesh.normals, mesh.tangents, faces, mesh.label[origin])


def _longer(mesh: Tessellation, limit: float) -> np.ndarray:
    """Leaves with a side longer than a limit."""
    leaves = tessellation.leaves(mesh)
    return leaves[(_sides(mesh, leaves) > limit).any(-1)]


def _sides(mesh: Tessellation, faces: np.ndarray) -> Float[np.ndarray, "n 3"]:
    corners = mesh.vertices[mesh.faces[faces]]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1)


def frames(mesh: Tessellation) -> Float[np.ndarray, "V 3 3"]:
    """Local frames of vertices: tangents square to the normals, any where there are none."""
    normal = mesh.normals
    flat = mesh.tangents - (mesh.tangents * normal).sum(-1, keepdims=True) * normal
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    weak = length < 1e-3 * np.maximum(np.linalg.norm(mesh.tangents, axis=-1, keepdims=True), 1e-30)
    least = np.eye(3)[np.argmin(np.abs(normal), -1)]
    other = np.cross(normal, least)
    other /= np.linalg.norm(other, axis=-1, keepdims=True)
    tangent = np.where(weak, other, flat / np.where(weak, 1.0, length))
    return np.stack([tangent, np.cross(normal, tangent), normal], 1)
