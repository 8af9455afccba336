"""Directions of the material's x axis on a mesh.

A field is one vector [V, 3] at every vertex, of any length. It is interpolated over the faces
and made a unit tangent where it is looked at, see `across`: a constant vector, or one that
follows from the normal, is then exact between the vertices as well.
"""

import numpy as np
from jaxtyping import Float

from diffopt.errors import InputError
from diffopt.scenes.meshfiles import Mesh, corner_angles

#: Shortest projection of a field that still says a direction: that of a unit vector 0.06
#: degrees from the normal, less than a pixel and more than the rounding of a flat face.
LEAST = 1e-3

# Area of a face in the texture over the square of its longest edge there, below which
# float32 coordinates say no direction.
_THIN = 1e-6


def from_texture(mesh: Mesh) -> Float[np.ndarray, "V 3"]:
    """Unit vectors along which the first texture coordinate u grows.

    On each face dP/du solves dP = dP/du du + dP/dv dv for its edges; a vertex has the mean
    direction of its faces, weighted by their angles and made orthogonal to the normal. Faces
    without area in the texture have no vote; a vertex with none but such has the vector 0.
    The material's y axis is normal x tangent: along v, or against it where the texture is
    mirrored.

    Raises
    ------
    InputError
        If the mesh has no texture coordinates, or no face has an area in the texture.
    """
    if mesh.uv is None:
        raise InputError("the mesh has no texture coordinates; expected a file with uv")
    triangles, uv = mesh.vertices[mesh.faces], mesh.uv[mesh.faces]
    edges, steps = triangles[:, 1:] - triangles[:, :1], uv[:, 1:] - uv[:, :1]
    (du1, dv1), (du2, dv2) = steps[:, 0].T, steps[:, 1].T
    area = du1 * dv2 - du2 * dv1
    longest = ((np.roll(uv, -1, axis=1) - uv) ** 2).sum(-1).max(axis=-1)
    votes = np.abs(area) > _THIN * longest
    if not votes.any():
        raise InputError(
            "the texture coordinates of the mesh are degenerate: no face has an area in the texture"
        )
    along = np.sign(area)[:, None] * (dv2[:, None] * edges[:, 0] - dv1[:, None] * edges[:, 1])
    along = _unit(along) * votes[:, None]
    weighted = corner_angles(triangles)[..., None] * along[:, None]
    total = np.zeros_like(mesh.vertices)
    np.add.at(total, mesh.faces, weighted)
    return _unit(total - _dot(total, mesh.normals) * mesh.normals)


def from_direction(
    mesh: Mesh, direction: Float[np.ndarray, "3"] | Float[np.ndarray, "V 3"]
) -> Float[np.ndarray, "V 3"]:
    """Unit vectors along a direction in the world, or along one for each vertex.

    Parameters
    ----------
    mesh
        What they lie on.
    direction
        One vector for all, or one for each vertex, which may be 0 where there is none; of
        any length. They need not lie in the surface: `across` projects them.

    Raises
    ------
    InputError
        If a number is not finite or all vectors are 0.
    """
    direction = np.asarray(direction, np.float64)
    if not np.isfinite(direction).all() or not direction.any():
        raise InputError(
            f"direction must be finite and not 0; received {direction.tolist()}"
            if direction.ndim == 1
            else "direction must be finite at every vertex, and not 0 at all of them"
        )
    if direction.ndim == 2 and direction.shape != mesh.vertices.shape:
        raise InputError(
            f"direction must be one vector or one for each of {len(mesh.vertices)} vertices; "
            f"received {len(direction)}"
        )
    return np.broadcast_to(_unit(direction), mesh.vertices.shape).copy()


def around(mesh: Mesh, axis: Float[np.ndarray, "3"]) -> Float[np.ndarray, "V 3"]:
    """Vectors along circles around an axis: axis x normal, 0 where they are parallel.

    On a body of revolution these are its parallels, as on `diffopt.drawing.shapes.sphere`.

    Parameters
    ----------
    mesh
        What they lie on.
    axis
        Direction of the axis, of any length.

    Raises
    ------
    InputError
        If the axis is 0 or not finite.
    """
    return np.cross(from_direction(mesh, axis), mesh.normals)


def own(mesh: Mesh, up: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "V 3"], str]:
    """Directions for a mesh of which nothing is known, and in words what they follow.

    Along the texture if the mesh has a usable one, see `from_texture`; else along circles,
    see `around`.

    Parameters
    ----------
    mesh
        What they lie on.
    up
        Axis of the circles, of any length.

    Raises
    ------
    InputError
        If the axis is 0 or not finite.
    """
    try:
        return from_texture(mesh), "follows u of the texture"
    except InputError as error:
        why = "no texture coordinates" if mesh.uv is None else str(error)
        return around(mesh, up), f"follows circles around the upward axis ({why})"


def across(
    field: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Unit tangents: the field projected along the normals.

    Where less than `LEAST` is left, at the poles of a field or on a flat end, there is no
    direction to follow. The tangent then is the world's x axis, carried along the shortest
    rotation that takes the z axis to the normal: a smooth function of the normal but at -z,
    and on ends square to a world axis one of the world's axes.

    Parameters
    ----------
    field
        Vectors of any length.
    normals
        Unit vectors.
    """
    tangent = field - _dot(field, normals) * normals
    weak = (tangent * tangent).sum(-1) < LEAST**2
    x, z = normals[..., :1], normals[..., 2:]
    # Within a tenth of a degree of -z, where the rotation is undetermined, x itself.
    lean = np.where(z > -1.0 + 1e-6, x / np.maximum(1.0 + z, 1e-6), 0.0)
    carried = np.array([1.0, 0.0, 0.0]) - lean * (normals + np.array([0.0, 0.0, 1.0]))
    tangent = np.where(weak[..., None], carried, tangent)
    return _unit(tangent - _dot(tangent, normals) * normals)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return (a * b).sum(axis=-1, keepdims=True)


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Vectors divided by their lengths; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(length > 0.0, vectors / np.where(length > 0.0, length, 1.0), 0.0)
