"""Triangle meshes from files and arrays: checked, consistently wound, with smooth normals.

Files are read by trimesh; lengths stay in the file's unit, because only directions leave the
drawing. Normals are computed here for every corner of every face, so that creases stay sharp,
and so that seams of the texture, where files repeat their vertices, do not show.
"""

import dataclasses
import functools
import math
import os
import warnings
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int

from diffopt.errors import InputError
from diffopt.io.files import describe, existing_file, one_line
from diffopt.scenes.origins import remember

if TYPE_CHECKING:
    from trimesh import Trimesh
    from trimesh.ray.ray_pyembree import RayMeshIntersector

#: Suffixes of files that are read.
FORMATS = (".glb", ".gltf", ".obj", ".off", ".ply", ".stl")
#: Faces that meet at a larger angle than this, degrees, meet at a crease.
CREASE_DEG = 40.0

# Height of a triangle over its longest edge: below the rounding of float32 coordinates it has
# no normal.
_FLAT = 1e-7
# Coordinates whose fourth power still is a float64.
_LARGEST = 1e70


@dataclasses.dataclass(frozen=True)
class Repairs:
    """What `build` put right.

    Attributes
    ----------
    turned
        Faces that were wound against their neighbours, or inwards on a closed body.
    dropped
        Faces without area, left out.
    inwards
        Whether the whole mesh was closed and wound inwards.
    """

    turned: int = 0
    dropped: int = 0
    inwards: bool = False


@dataclasses.dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with a normal at every vertex; see `build` and `load`.

    Attributes
    ----------
    vertices
        Positions, [V, 3]. Those on a crease or on a seam of the texture are repeated.
    faces
        Vertices of each triangle, counter-clockwise as seen from its front, [F, 3].
    normals
        Unit normals on the front, [V, 3].
    uv
        Texture coordinates, [V, 2], None where there are none.
    repairs
        What was put right in them.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "V 3"]
    uv: Float[np.ndarray, "V 2"] | None = None
    repairs: Repairs = Repairs()

    @functools.cached_property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Middle of the box around the vertices."""
        return 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))

    @functools.cached_property
    def radius(self) -> float:
        """Distance of the farthest vertex from the centre."""
        return float(np.linalg.norm(self.vertices - self.centre, axis=-1).max())

    @functools.cached_property
    def intersector(self) -> "RayMeshIntersector":
        """Embree's tree of the triangles, moved to the origin and scaled to unit radius."""
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        return RayMeshIntersector(_plain((self.vertices - self.centre) / self.radius, self.faces))


def load(path: str | os.PathLike, *, crease_deg: float = CREASE_DEG) -> Mesh:
    """Read a mesh; all objects of a scene are taken together, in their places.

    Normals in the file are not used; see `build`, which also says what else is put right.

    Parameters
    ----------
    path
        A file with one of the suffixes `FORMATS`.
    crease_deg
        See `build`.

    Raises
    ------
    InputError
        If the file cannot be read as what it says it is, or holds no usable triangles.
    """
    import trimesh

    from diffopt.scenes import mesh_claims

    path = existing_file(path)
    if path.suffix.lower() not in FORMATS:
        raise InputError(
            f"{path}: expected a mesh with one of the suffixes {', '.join(FORMATS)}; found "
            f"{describe(path)}"
        )
    suffix = path.suffix.lower()
    try:
        mesh_claims.check(path, suffix)
        # In glTF the texture coordinates come with the materials.
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            # Of what is odd in a file `build` finds all that matters here.
            warnings.simplefilter("ignore")
            scene = trimesh.load_scene(
                path,
                process=False,
                skip_materials=suffix == ".obj",
                resolver=mesh_claims.Beside(path),
            )
            mesh_claims.instances(path, scene)
            parts = scene.dump()
    except Exception as error:  # readers of damaged files fail in many ways
        if isinstance(error, InputError) and str(error).startswith(str(path)):
            raise
        raise InputError(
            f"{path}: cannot be read as {suffix} ({one_line(error)}); found {describe(path)}"
        ) from error
    solid = [part for part in parts if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    if not solid:
        points = sum(len(getattr(part, "vertices", ())) for part in parts)
        found = f"{points} points" if points else describe(path)
        raise InputError(f"{path}: no faces; found {found}, expected triangles")
    for part in solid:
        if np.shape(part.vertices)[1:] != (3,) or np.shape(part.faces)[1:] != (3,):
            raise InputError(
                f"{path}: vertices {np.shape(part.vertices)} and faces {np.shape(part.faces)}; "
                "expected three coordinates and three corners"
            )
        _check_indices(np.asarray(part.faces), len(part.vertices), str(path))
    vertices = np.concatenate([np.asarray(part.vertices, np.float64) for part in solid])
    first = np.cumsum([0] + [len(part.vertices) for part in solid])
    faces = np.concatenate(
        [np.asarray(part.faces, np.int64) + at for part, at in zip(solid, first, strict=False)]
    )
    textures = [_texture(part) for part in solid]
    uv = None
    if all(texture is not None for texture in textures):
        uv = np.concatenate([texture for texture in textures if texture is not None])
    mesh = build(vertices, faces, uv, crease_deg=crease_deg, name=str(path))
    return remember(mesh, file=os.path.abspath(path), crease=float(crease_deg))


def build(
    vertices: Float[np.ndarray, "N 3"],
    faces: Int[np.ndarray, "M 3"],
    uv: Float[np.ndarray, "N 2"] | None = None,
    *,
    crease_deg: float = CREASE_DEG,
    name: str = "mesh",
) -> Mesh:
    """Mesh of triangles: winding put right, normals computed, vertices split where they differ.

    Faces without area are left out. Neighbours are wound alike, as the larger part of them
    was, and closed bodies so that their front is outside. A corner's normal is the mean over
    the faces around its vertex that no crease separates from it, weighted by their angles
    (Thuermer and Wuethrich, Computing vertex normals from polygonal facets, 1998); where that
    lies farther than `crease_deg` from the face's own normal, as at the tip of a cone, the
    face's own is taken.

    Parameters
    ----------
    vertices, faces
        Positions and their numbers, counter-clockwise as seen from the front.
    uv
        Texture coordinates of the vertices.
    crease_deg
        Angle between faces above which their edge is a crease, degrees in [0, 180].
    name
        Names the mesh in error texts.

    Raises
    ------
    InputError
        If there are no faces, or none with an area; if a face names a vertex that does not
        exist; if a used number is not finite.
    """
    if not 0.0 <= crease_deg <= 180.0:
        raise InputError(f"crease_deg={crease_deg:g}: expected degrees from 0 to 180")
    if len(faces) == 0:
        raise InputError(f"{name}: no faces; expected triangles")
    _check_indices(faces, len(vertices), name)
    used, faces = np.unique(faces, return_inverse=True)
    faces, vertices = faces.reshape(-1, 3), vertices[used]
    uv = None if uv is None else uv[used]
    bad = ~(np.abs(vertices) < _LARGEST).all(axis=-1)
    if bad.any():
        raise InputError(
            f"{name}: {bad.sum()} of {len(used)} vertices are not finite; expected numbers"
        )
    if uv is not None and not np.isfinite(uv).all():
        raise InputError(f"{name}: texture coordinates are not finite; expected numbers")
    points, place = weld(vertices)
    longest, height = _heights(points[place[faces]])
    solid = height > _FLAT * longest
    if not solid.any():
        raise InputError(f"{name}: none of the {len(faces)} faces has an area; expected triangles")
    faces = faces[solid]
    welded = place[faces]
    flipped = _to_flip(points, welded)
    repairs = Repairs(int(flipped.sum()), int((~solid).sum()), bool(flipped.all()))
    faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    welded = np.where(flipped[:, None], welded[:, ::-1], welded)
    normals, labels = _corner_normals(points, welded, math.radians(crease_deg))
    key = labels
    if uv is not None:
        # Where the texture is mirrored, its direction turns round: no vertex has both.
        mirrored = np.repeat(_orientation(uv[faces]) < 0.0, 3)
        key = (labels * len(vertices) + faces.reshape(-1)) * 2 + mirrored
    _, chosen, corner = np.unique(key, return_index=True, return_inverse=True)
    kept = faces.reshape(-1)[chosen]
    return Mesh(
        vertices=vertices[kept],
        faces=corner.reshape(-1, 3),
        normals=normals[chosen],
        uv=None if uv is None else uv[kept],
        repairs=repairs,
    )


def corner_angles(triangles: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "F 3"]:
    """Angles of triangles at their corners, radians."""
    ahead = np.roll(triangles, -1, axis=1) - triangles
    back = np.roll(triangles, 1, axis=1) - triangles
    across = np.linalg.norm(np.cross(ahead, back), axis=-1)
    return np.arctan2(across, (ahead * back).sum(-1))


def face_normals(triangles: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "F 3"]:
    """Unit normals of triangles."""
    across = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return across / np.linalg.norm(across, axis=-1, keepdims=True)


def _plain(vertices: np.ndarray, faces: np.ndarray) -> "Trimesh":
    import trimesh

    return trimesh.Trimesh(vertices, faces, process=False)


def _check_indices(faces: np.ndarray, count: int, name: str) -> None:
    if faces.min() < 0 or faces.max() >= count:
        worst = faces.min() if faces.min() < 0 else faces.max()
        raise InputError(
            f"{name}: a face names vertex {worst}; expected numbers from 0 to {count - 1}"
        )


def _texture(part: "Trimesh") -> np.ndarray | None:
    uv = getattr(part.visual, "uv", None)
    if uv is None or np.shape(uv) != (len(part.vertices), 2):
        return None
    return np.asarray(uv, np.float64)


def weld(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Different places among vertices, and the place of each."""
    order = np.lexsort(vertices.T)
    ordered = vertices[order]
    new = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=-1))
    place = np.empty(len(vertices), np.int64)
    place[order] = np.cumsum(new) - 1
    return ordered[new], place


def _heights(triangles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Longest edge of triangles and the height over it."""
    longest = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=-1).max(axis=1)
    sides = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    area = np.linalg.norm(np.cross(*sides), axis=-1)
    return longest, area / np.maximum(longest, np.finfo(np.float64).tiny)


def _orientation(uv: Float[np.ndarray, "F 3 2"]) -> Float[np.ndarray, " F"]:
    """Twice the signed area of triangles in the plane of the texture."""
    (a, b), (c, d) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    return a * d - b * c


def _to_flip(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Which faces are wound against their neighbours, or inwards on a closed body."""
    import trimesh
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    mesh = _plain(points - points.mean(axis=0), faces)
    trimesh.repair.fix_winding(mesh)
    flipped = _wound_otherwise(faces, np.asarray(mesh.faces))
    pairs = mesh.face_adjacency
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(faces), len(faces)))
    _, body = connected_components(graph, directed=False)
    # Which of its two windings the library gives a body depends on the face it starts from.
    area = mesh.area_faces
    against = np.bincount(body, np.where(flipped, area, -area))
    mesh.faces = np.where((against[body] > 0.0)[:, None], mesh.faces[:, ::-1], mesh.faces)
    trimesh.repair.fix_inversion(mesh, multibody=True)
    return _wound_otherwise(faces, np.asarray(mesh.faces))


def _wound_otherwise(faces: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Which of the same triangles run the other way round."""
    after = np.roll(faces, -1, axis=1)
    start = np.argmax(others == faces[:, :1], axis=1)
    second = np.take_along_axis(others, ((start + 1) % 3)[:, None], axis=1)[:, 0]
    return second != after[:, 0]


def _corner_normals(
    points: np.ndarray, faces: np.ndarray, crease: float
) -> tuple[np.ndarray, np.ndarray]:
    """Normals of all corners, [3 F, 3], and labels of those that share one, [3 F]."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    triangles = points[faces]
    # Each about its first corner and of its own size: beside large ones, small ones would vanish.
    triangles = triangles - triangles[:, :1]
    triangles = triangles / np.abs(triangles).max(axis=(1, 2), keepdims=True)
    own = face_normals(triangles)
    corners = np.arange(faces.size).reshape(faces.shape)
    ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    at = np.stack([corners, np.roll(corners, -1, axis=1)], axis=-1).reshape(-1, 2)
    turned = ends[:, 0] > ends[:, 1]
    ends, at = (np.where(turned[:, None], a[:, ::-1], a) for a in (ends, at))
    order = np.lexsort(ends.T)
    ends, at = ends[order], at[order]
    joined = [np.zeros((2, 0), np.int64)]
    same, step = np.arange(len(ends)), 0
    while len(same):
        # Most edges have two faces; where more meet, all pairs are looked at.
        step += 1
        same = same[same + step < len(ends)]
        same = same[(ends[same] == ends[same + step]).all(axis=-1)]
        a, b = at[same], at[same + step]
        smooth = (own[a[:, 0] // 3] * own[b[:, 0] // 3]).sum(-1) >= math.cos(crease)
        joined += [np.stack([a[smooth, end], b[smooth, end]]) for end in (0, 1)]
    pairs = np.concatenate(joined, axis=1)
    graph = coo_matrix((np.ones(pairs.shape[1]), pairs), shape=(faces.size, faces.size))
    count, labels = connected_components(graph, directed=False)
    labels = labels.astype(np.int64)
    face = np.repeat(own, 3, axis=0)
    weights = corner_angles(triangles).reshape(-1, 1) * face
    total = np.stack([np.bincount(labels, column, count) for column in weights.T], axis=-1)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    mean = (total / np.maximum(length, 1e-9))[labels]
    # The margin is for rounding, which shall not separate the faces of a plane.
    alone = (mean * face).sum(-1) < math.cos(crease) - 1e-9
    labels = np.where(alone, count + np.arange(faces.size), labels)
    return np.where(alone[:, None], face, mean), labels
