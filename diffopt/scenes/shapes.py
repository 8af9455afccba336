"""Shapes of objects: spheres and discs in closed form; planes, boxes and meshes as triangles.

A shape lies at the origin, z up, lengths in the scene's unit; an object's transform places
it. `Patch` is what the world is made of: a shape in its place.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from diffopt.errors import InputError
from diffopt.scenes import meshfiles, tangents, transforms
from diffopt.scenes.meshfiles import Mesh


def _positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"{name} must be a length above 0; received {value}")


@dataclasses.dataclass(frozen=True)
class Sphere:
    """Sphere about the origin; its texture has u around z from x, v from the south pole up."""

    radius: float = 1.0

    def __post_init__(self) -> None:
        """Check the radius."""
        _positive("radius", self.radius)


@dataclasses.dataclass(frozen=True)
class Disc:
    """Disc in the xy plane, facing z."""

    radius: float = 1.0

    def __post_init__(self) -> None:
        """Check the radius."""
        _positive("radius", self.radius)


@dataclasses.dataclass(frozen=True)
class Plane:
    """Rectangle in the xy plane about the origin, facing z; its texture spans it once."""

    width: float = 1.0
    height: float = 1.0

    def __post_init__(self) -> None:
        """Check the sides."""
        _positive("width", self.width)
        _positive("height", self.height)


@dataclasses.dataclass(frozen=True)
class Box:
    """Box about the origin with sides along the axes; its texture spans each face once."""

    size: Any = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        """Check the sides."""
        object.__setattr__(self, "size", tuple(transforms.vector("size", self.size).tolist()))
        for side in self.size:
            _positive("size", side)


Shape = Sphere | Disc | Plane | Box | Mesh


@dataclasses.dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles in their place.

    Attributes
    ----------
    vertices, normals, tangents
        Positions, unit normals, and directions of the material's x axis (0 where there is
        none), [V, 3].
    uv
        Texture coordinates, [V, 2].
    faces
        Vertices of each, counter-clockwise as seen from the front, [F, 3].
    """

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    tangents: Float[np.ndarray, "V 3"]
    uv: Float[np.ndarray, "V 2"]
    faces: Int[np.ndarray, "F 3"]


@dataclasses.dataclass(frozen=True, eq=False)
class Round:
    """A sphere or disc in its place: centre [3], radius, and axes as columns [3, 3]."""

    kind: type
    centre: Float[np.ndarray, "3"]
    radius: float
    axes: Float[np.ndarray, "3 3"]


def placed(shape: Shape, matrix: transforms.Matrix, direction: Any = None) -> Triangles | Round:
    """A shape in its place.

    Parameters
    ----------
    shape
        One of the classes of this module, or a `Mesh`.
    matrix
        Where it is, see `diffopt.scenes.transforms`.
    direction
        Along which the material's x axis lies, in the world, [3]. Where left out it follows
        the texture of a mesh, or circles around its z axis.

    Raises
    ------
    InputError
        For a stretched sphere or disc.
    """
    if isinstance(shape, Sphere | Disc):
        size, axes = transforms.similarity(matrix)
        return Round(type(shape), matrix[:3, 3].copy(), size * shape.radius, axes)
    mesh = _mesh(shape)
    linear = matrix[:3, :3]
    mirrored = np.linalg.det(linear) < 0.0
    normals = mesh.normals @ np.linalg.inv(linear)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    vertices = mesh.vertices @ linear.T + matrix[:3, 3]
    faces = mesh.faces[:, ::-1] if mirrored else mesh.faces
    if direction is not None:
        along = np.broadcast_to(transforms.unit("tangent", direction), vertices.shape).copy()
    else:
        along = _own_tangents(mesh) @ linear.T
    uv = np.zeros((len(vertices), 2)) if mesh.uv is None else mesh.uv
    return Triangles(vertices, normals, along, uv, np.ascontiguousarray(faces))


def _own_tangents(mesh: Mesh) -> Float[np.ndarray, "V 3"]:
    if mesh.uv is not None:
        try:
            return tangents.from_texture(mesh)
        except InputError:  # all in one point of the texture: no direction
            pass
    return tangents.around(mesh, np.array([0.0, 0.0, 1.0]))


def _mesh(shape: Plane | Box | Mesh) -> Mesh:
    if isinstance(shape, Mesh):
        return shape
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    uv = 0.5 * (square + 1.0)
    corners = np.concatenate([square, np.zeros((4, 1))], axis=-1)
    two = np.array([[0, 1, 2], [0, 2, 3]])
    if isinstance(shape, Plane):
        half = 0.5 * np.array([shape.width, shape.height, 0.0])
        return Mesh(corners * half, two, np.tile([0.0, 0.0, 1.0], (4, 1)), uv)
    sides = []
    for x in (1, 2, 0):  # +x, -x, +y, -y, +z, -z
        # The axes across are in the order that makes a right-handed frame on each side.
        for sign in (1.0, -1.0):
            axes = np.roll(np.eye(3), x, axis=1)
            axes = axes if sign > 0.0 else axes[[1, 0, 2]] * [[1.0], [1.0], [-1.0]]
            sides.append(axes)
    half = 0.5 * np.array(shape.size)
    up = np.array([0.0, 0.0, 1.0])
    vertices = np.concatenate([(corners + up) @ axes for axes in sides]) * half
    normals = np.concatenate([np.tile(axes[2], (4, 1)) for axes in sides])
    faces = np.concatenate([two + 4 * side for side in range(6)])
    return Mesh(vertices, faces, normals, np.tile(uv, (6, 1)))


def is_closed(shape: Shape) -> bool:
    """Whether a shape bounds a body: every edge of a mesh belongs to two faces.

    Planes and discs do not. Corners of a mesh count as one where they lie in one place.
    """
    if isinstance(shape, Sphere | Box):
        return True
    if isinstance(shape, Disc | Plane):
        return False
    _, place = meshfiles.weld(shape.vertices)
    faces = place[shape.faces]
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    return bool((count == 2).all())
