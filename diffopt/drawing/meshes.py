"""Triangle meshes under a camera and a light: rays cast by Embree.

A mesh gives the same `diffopt.drawing.shapes.View` as the closed shapes do. The material covers
the front of the faces; their back, where an open shell shows it, is a neutral part of the body,
as the hub of a disc is. A back that lies closely before a front, as where a scan folds over, is
looked through. Unlike the closed shapes a mesh casts shadows on itself, see `lit`.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float, Int

from diffopt.drawing import shapes
from diffopt.errors import InputError
from diffopt.scenes import tangents
from diffopt.scenes.meshfiles import FORMATS as FORMATS
from diffopt.scenes.meshfiles import Mesh as Mesh
from diffopt.scenes.meshfiles import build as build
from diffopt.scenes.meshfiles import face_normals
from diffopt.scenes.meshfiles import load as load

#: From the middle of a mesh to the camera where nothing is said: right, up, to the front.
THREE_QUARTER = (0.5, 0.4, 0.8)
FIELD_OF_VIEW_DEG = 30.0
#: Empty border around the mesh, as a share of half the picture.
MARGIN = 0.04

# Rays towards a light start this far above the surface, in radii of the mesh: a hundred times
# the rounding of Embree's float32, a hundredth of a pixel.
_OFFSET = 2e-5
# Least cosine between an interpolated normal and the viewer.
_LEAST = 1e-3
# Backs this little before a front, in radii, are folds and doubled faces of a scan.
_FOLD = 3e-3
# Rays handled at once.
_BLOCK = 2**20


@dataclasses.dataclass(frozen=True)
class MeshView(shapes.View):
    """What the samples of a picture see of a mesh.

    Attributes
    ----------
    mesh
        The mesh.
    start
        Where rays from the points towards a light start, [h, w, 3], see `lit`.
    """

    mesh: Mesh
    start: Float[np.ndarray, "h w 3"]


def viewpoint(
    mesh: Mesh,
    direction: tuple[float, float, float] | None = None,
    *,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
    field_of_view_deg: float = FIELD_OF_VIEW_DEG,
) -> Float[np.ndarray, "3"]:
    """Position of a camera whose square picture the mesh just fills, from a given side.

    Parameters
    ----------
    mesh
        What it looks at.
    direction
        From the middle of the mesh to the camera, of any length. Where left out it is
        `THREE_QUARTER`, turned as the y axis is turned to `up`: the front is z where y is
        up, and -y where z is up.
    up, field_of_view_deg
        As for `view`.

    Raises
    ------
    InputError
        If a direction is 0 or not finite, or the field of view not between 0 and 180 degrees.
    """
    slope = _half_slope(field_of_view_deg)
    upright = _direction("up", up)
    if direction is None:
        towards = shapes.unit(_turn_to(upright) @ np.array(THREE_QUARTER))
    else:
        towards = _direction("direction", direction)
    across = shapes.axes(towards, np.zeros(3), upright)
    x, y, depth = across @ (mesh.vertices - mesh.centre).T
    needed = (1.0 + MARGIN) / slope * np.maximum(np.abs(x), np.abs(y))
    return mesh.centre + (depth + needed).max() * towards


def view(
    mesh: Mesh,
    size: shapes.Size,
    *,
    eye: Float[np.ndarray, "3"] | None = None,
    target: Float[np.ndarray, "3"] | None = None,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
    field_of_view_deg: float = FIELD_OF_VIEW_DEG,
    field: Float[np.ndarray, "V 3"] | None = None,
) -> MeshView:
    """Mesh seen by a near camera.

    The normals are interpolated between those of the vertices. Near the outline of a coarse
    mesh they may face away from a viewer who does see the face; they are turned towards the
    viewer then, until they are square to the line of sight, so that all that is seen has a
    front.

    Parameters
    ----------
    mesh
        The mesh.
    size
        Samples on a side, or (rows, columns).
    eye
        Position of the camera; that of `viewpoint` if left out.
    target
        The point in the middle of the picture; the middle of the mesh if left out.
    up
        Direction that is upright in the picture.
    field_of_view_deg
        Angle across the shorter side of the picture.
    field
        Directions of the material's x axis, see `diffopt.scenes.tangents`; if left out, along the
        texture if there is one, else around `up`.

    Raises
    ------
    InputError
        If no sample sees the mesh, the camera is impossible, or the texture that the material
        should follow is degenerate.
    """
    eye = viewpoint(mesh, up=up, field_of_view_deg=field_of_view_deg) if eye is None else eye
    target = mesh.centre if target is None else np.asarray(target, np.float64)
    if field is None:
        around = _direction("up", up)
        field = tangents.around(mesh, around) if mesh.uv is None else tangents.from_texture(mesh)
    distance = float(np.linalg.norm(np.asarray(eye, np.float64) - target))
    half = distance * _half_slope(field_of_view_deg)
    origin, rays = shapes.camera(size, np.asarray(eye, np.float64), target, half_width=half, up=up)
    hit = _visible(mesh, origin, rays.reshape(-1, 3))
    seen = np.flatnonzero(hit >= 0)
    if len(seen) == 0:
        raise InputError(
            f"no sample of a camera at {eye.tolist()} looking at {target.tolist()} sees the mesh "
            f"around {mesh.centre.tolist()}"
        )
    corners, rays_seen = mesh.faces[hit[seen]], rays.reshape(-1, 3)[seen]
    share = _barycentric(mesh.vertices[corners], origin, rays_seen)
    flat = face_normals(mesh.vertices[corners])
    front = (flat * rays_seen).sum(-1) < 0.0
    position = _mix(share, mesh.vertices[corners])
    normal = _towards(shapes.unit(_mix(share, mesh.normals[corners])), -rays_seen)
    tangent = tangents.across(_mix(share, field[corners]), normal)
    start = _lifted(mesh, corners, share, position) + _OFFSET * mesh.radius * flat

    def picture(values: np.ndarray) -> np.ndarray:
        out = np.zeros((rays.shape[0] * rays.shape[1], *values.shape[1:]), values.dtype)
        out[seen] = values
        return out.reshape(*rays.shape[:2], *values.shape[1:])

    return MeshView(
        position=picture(position),
        tangent=picture(tangent),
        normal=picture(normal),
        eye=-rays,
        covered=picture(front),
        neutral=picture(~front),
        mesh=mesh,
        start=picture(start),
    )


def lit(seen: MeshView, light: Float[np.ndarray, "... 3"]) -> Bool[np.ndarray, "h w"]:
    """Which samples of the material a light reaches.

    The rays start above the faces, where a surface through the vertices that follows their
    normals would lie: from the faces themselves the edge of the shadow would follow the
    triangles (Hanika, Hacking the shadow terminator, Ray Tracing Gems II, 2021).

    Parameters
    ----------
    seen
        The mesh under its camera.
    light
        Unit vectors to the light, in the world: [3] or [h, w, 3]. The light lies outside of the
        mesh's bounding sphere.
    """
    out = seen.covered & ((seen.normal * light).sum(-1) > 0.0)
    towards = np.broadcast_to(light, seen.start.shape)[out]
    # Nothing nearer than a fold casts a shadow, because a fold may lie over the surface.
    starts = seen.start[out] + _FOLD * seen.mesh.radius * towards
    out[out] = first_hit(seen.mesh, starts, towards) < 0
    return out


def first_hit(
    mesh: Mesh, origins: Float[np.ndarray, "n 3"], directions: Float[np.ndarray, "n 3"]
) -> Int[np.ndarray, " n"]:
    """Nearest face on each ray, -1 where there is none; directions are unit vectors."""
    out = np.full(len(origins), -1, np.int64)
    for first in range(0, len(origins), _BLOCK):
        part = slice(first, first + _BLOCK)
        starts, along = (origins[part] - mesh.centre) / mesh.radius, directions[part]
        # Up to the unit sphere around the mesh first: Embree would count the way there in
        # float32.
        ahead = np.maximum(-(starts * along).sum(-1, keepdims=True) - 1.01, 0.0)
        out[part] = mesh.intersector.intersects_first(starts + ahead * along, along)
    return out


def _visible(mesh: Mesh, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Face that each ray from the camera shows: the nearest, but for folds; -1 for none."""
    out = first_hit(mesh, np.broadcast_to(origin, rays.shape), rays)
    normals = face_normals(mesh.vertices[mesh.faces])
    ray = np.flatnonzero(out >= 0)
    ray = ray[(normals[out[ray]] * rays[ray]).sum(-1) >= 0.0]
    first = reached = _along(mesh, out[ray], origin, rays[ray])
    while len(ray):
        start = origin + (reached + _OFFSET * mesh.radius)[:, None] * rays[ray]
        face = first_hit(mesh, start, rays[ray])
        distance = _along(mesh, face, origin, rays[ray])
        # As thick as the fold is: on a slanted face the ray takes longer to cross it.
        depth = (distance - first) * np.abs((normals[out[ray]] * rays[ray]).sum(-1))
        near = (face >= 0) & (distance > reached) & (depth < _FOLD * mesh.radius)
        ray, face, first, reached = ray[near], face[near], first[near], distance[near]
        front = (normals[face] * rays[ray]).sum(-1) < 0.0
        out[ray[front]] = face[front]
        ray, first, reached = ray[~front], first[~front], reached[~front]
    return out


def _along(mesh: Mesh, faces: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Distance on rays from one point to the planes of faces."""
    corners = mesh.vertices[mesh.faces[faces]]
    normals = face_normals(corners)
    slope = (normals * rays).sum(-1)
    height = ((corners[:, 0] - origin) * normals).sum(-1)
    return np.where(slope == 0.0, np.inf, height / np.where(slope == 0.0, 1.0, slope))


def _mix(share: np.ndarray, corners: np.ndarray) -> np.ndarray:
    return (share[..., None] * corners).sum(axis=1)


def _barycentric(
    triangles: Float[np.ndarray, "n 3 3"],
    origin: Float[np.ndarray, "3"],
    rays: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 3"]:
    """Shares of the corners where rays meet their triangles, in [0, 1].

    Areas of the triangles that the ray makes with the edges (Moeller and Trumbore 1997), in
    float64; those that Embree found from outside by its rounding are moved to the edge.
    """
    a, b, c = (triangles[:, i] - origin for i in range(3))
    sides = [(np.cross(p, q) * rays).sum(-1) for p, q in ((b, c), (c, a), (a, b))]
    share = np.stack(sides, axis=-1)
    total = share.sum(axis=-1, keepdims=True)
    share = np.where(total == 0.0, 1.0, share) / np.where(total == 0.0, 3.0, total)
    share = np.clip(share, 0.0, 1.0)
    return share / share.sum(axis=-1, keepdims=True)


def _towards(normals: np.ndarray, eyes: np.ndarray) -> np.ndarray:
    """Normals turned to the viewer as far as they must be to face him."""
    cosine = (normals * eyes).sum(-1, keepdims=True)
    return shapes.unit(normals + np.maximum(_LEAST - cosine, 0.0) * eyes)


def _lifted(
    mesh: Mesh, corners: np.ndarray, share: np.ndarray, position: np.ndarray
) -> Float[np.ndarray, "n 3"]:
    """Points moved out to the tangent planes of the vertices, where they lie below them."""
    offset = position[:, None] - mesh.vertices[corners]
    normals = mesh.normals[corners]
    below = np.minimum((offset * normals).sum(-1, keepdims=True), 0.0)
    return _mix(share, mesh.vertices[corners] + offset - below * normals)


def _half_slope(field_of_view_deg: float) -> float:
    """Half the shorter side of a picture, per distance."""
    if not 0.0 < field_of_view_deg < 180.0:
        raise InputError(
            f"field_of_view_deg={field_of_view_deg:g}: expected degrees above 0, below 180"
        )
    return math.tan(math.radians(0.5 * field_of_view_deg))


def _direction(name: str, vector: tuple[float, float, float]) -> Float[np.ndarray, "3"]:
    array = np.asarray(vector, np.float64)
    if not np.isfinite(array).all() or not array.any():
        raise InputError(f"{name} must be a direction, finite and not 0; received {vector}")
    return shapes.unit(array)


def _turn_to(up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Shortest rotation that takes the y axis to `up`; about x where it is opposite."""
    y = np.array([0.0, 1.0, 0.0])
    if up[1] < -1.0 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    half = (y + up) / np.linalg.norm(y + up)
    # Two reflections, in the planes square to y and to the half vector.
    mirror = [np.eye(3) - 2.0 * np.outer(n, n) for n in (y, half)]
    return mirror[1] @ mirror[0]
