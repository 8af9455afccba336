"""Triangle meshes cut finer where it is needed: quarters of faces, balanced two to one.

A face is cut at the midpoints of its sides into four of its own shape (Bank, Sherman and Weiser,
Some refinement algorithms and data structures for regular local mesh refinement, 1983), so that
the geometry stays what it was. All faces ever made are kept; those not cut are the leaves. Faces
are neighbours where they have two vertices in common by number: surfaces that repeat their
vertices, as on a crease, are refined on their own.

Every result depends on the input alone; what was chosen may come in any order.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from diffopt.checks import Values
from diffopt.errors import InputError
from diffopt.transfer import mesh_checks, mesh_edges

#: Level of the smallest faces: their sides are 1e-9 of the initial ones, which positions in
#: float64 still tell apart.
DEEPEST = 30

# Sums of directions shorter than this, in lengths of both, are the rounding of float32.
_CANCELLED = 1e-6


@dataclasses.dataclass(frozen=True, eq=False)
class Tessellation:
    """A mesh with all faces ever made of it; see `begin` and `split`.

    Attributes
    ----------
    vertices
        Positions in the unit of the scene, [V, 3].
    normals
        Unit vectors, [V, 3].
    tangents
        Of any length, 0 for none, [V, 3].
    ends
        The two vertices, lower number first, whose edge a vertex halves; its own number twice
        for initial vertices, [V, 2].
    faces
        Corners of all faces ever made, initial ones first, [F, 3].
    label
        Number of the object or material, that of the parent, [F].
    level
        How often the initial face was cut, 0 to `DEEPEST`, [F].
    parent
        Face that was cut, -1 for initial ones, [F].
    children
        First of the four consecutive faces into which a face was cut, -1 for leaves, [F]. Child
        k < 3 has corner k of its parent as its own corner k, child 3 is the middle.
    initial
        Number of initial vertices.
    """

    vertices: Float[np.ndarray, "V 3"]
    normals: Float[np.ndarray, "V 3"]
    tangents: Float[np.ndarray, "V 3"]
    ends: Int[np.ndarray, "V 2"]
    faces: Int[np.ndarray, "F 3"]
    label: Int[np.ndarray, " F"]
    level: Int[np.ndarray, " F"]
    parent: Int[np.ndarray, " F"]
    children: Int[np.ndarray, " F"]
    initial: int


def begin(
    vertices: Values, normals: Values, tangents: Values, faces: Values, label: Values | None = None
) -> Tessellation:
    """The mesh before any split.

    Faces without area and repeated ones are left out, and those behind them move up;
    `diffopt.transfer.mesh_checks.usable` tells which ones stay.

    Parameters
    ----------
    vertices, normals, tangents
        Positions, [V, 3]; directions of any length, [V, 3], where tangents may be 0.
    faces
        Corners, counter-clockwise as seen from the front, [M, 3].
    label
        Integer of each face, [M]; 0 by default.

    Raises
    ------
    InputError
        If a shape is another, a number is not finite, a normal is 0, or a face names a vertex
        that does not exist.
    """
    points = mesh_checks.triples("vertices", vertices)
    count = len(points)
    kept = mesh_checks.usable(points, faces)
    names = mesh_checks.labels(label, len(np.asarray(faces)))
    own = np.arange(count, dtype=np.int32)
    return Tessellation(
        vertices=points,
        normals=mesh_checks.units("normals", normals, count),
        tangents=mesh_checks.triples("tangents", tangents, count),
        ends=np.stack([own, own], axis=1),
        faces=np.asarray(faces, np.int32).reshape(-1, 3)[kept],
        label=names[kept],
        level=np.zeros(len(kept), np.int8),
        parent=np.full(len(kept), -1, np.int32),
        children=np.full(len(kept), -1, np.int32),
        initial=count,
    )


def split(mesh: Tessellation, chosen: Values) -> Tessellation:
    """The mesh with leaves cut in four, and those coarser neighbours that balance asks for.

    No leaf shares a side, or a part of one, with a leaf more than one level finer or coarser:
    neighbours that would are cut as well, and theirs. A midpoint belongs to all faces on its
    edge, however many. Its position is the mean of the ends; its normal and its tangent are unit
    vectors along the sums of theirs. Where normals cancel, it has that of the first of the faces
    cut; where tangents cancel, none. New vertices stand in the order of their `ends`, new faces in
    that of their parents.

    Parameters
    ----------
    chosen
        Numbers of leaves, [n], in any order, repeated or not.

    Raises
    ------
    InputError
        If one is not the number of a leaf, or at the level `DEEPEST`.
    """
    picked = mesh_checks.numbers("chosen", chosen, len(mesh.faces))
    if (mesh.children[picked] >= 0).any():
        wrong = picked[mesh.children[picked] >= 0][0]
        raise InputError(f"chosen must be leaves; received face {wrong}, which is cut already")
    if (mesh.level[picked] >= DEEPEST).any():
        raise InputError(f"chosen must be leaves below level {DEEPEST}; received one at it")
    if len(picked) == 0:
        return mesh
    cut = np.flatnonzero(_balanced(mesh, picked))
    edges, side = pairs(mesh, cut)
    middle = mesh_edges.midpoints(mesh.ends, mesh.initial, edges)
    new = middle < 0
    before, count = len(mesh.vertices), len(mesh.faces)
    middle[new] = before + np.arange(np.count_nonzero(new))
    normals, tangents = _directions(mesh, cut, edges, side, new)
    (a, b, c), (ab, bc, ca) = mesh.faces[cut].T, middle[side].T
    quarters = [[a, ab, ca], [ab, b, bc], [ca, bc, c], [bc, ca, ab]]
    corners = np.stack([np.stack(quarter, axis=-1) for quarter in quarters], axis=1)
    children = np.concatenate([mesh.children, np.full(4 * len(cut), -1, np.int32)])
    children[cut] = count + 4 * np.arange(len(cut))
    parents = np.repeat(cut, 4).astype(np.int32)
    ends = edges[new]
    return Tessellation(
        vertices=np.concatenate([mesh.vertices, mesh.vertices[ends].mean(axis=1)]),
        normals=np.concatenate([mesh.normals, normals]),
        tangents=np.concatenate([mesh.tangents, tangents]),
        ends=np.concatenate([mesh.ends, ends]),
        faces=np.concatenate([mesh.faces, corners.reshape(-1, 3).astype(np.int32)]),
        label=np.concatenate([mesh.label, mesh.label[parents]]),
        level=np.concatenate([mesh.level, mesh.level[parents] + np.int8(1)]),
        parent=np.concatenate([mesh.parent, parents]),
        children=children,
        initial=mesh.initial,
    )


def uniform(mesh: Tessellation, level: int) -> Tessellation:
    """The mesh with leaves cut until none is coarser than a level; finer ones stay.

    Raises
    ------
    InputError
        If the level is not from 0 to `DEEPEST`.
    """
    if not 0 <= level <= DEEPEST:
        raise InputError(f"level must be from 0 to {DEEPEST}; received {level}")
    while True:
        found = leaves(mesh)
        coarse = found[mesh.level[found] < level]
        if len(coarse) == 0:
            return mesh
        mesh = split(mesh, coarse)


def leaves(mesh: Tessellation) -> Int[np.ndarray, " n"]:
    """Numbers of the faces that are not cut."""
    return np.flatnonzero(mesh.children < 0)


def pairs(
    mesh: Tessellation, faces: Values
) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "n 3"]]:
    """Edges of faces, and which of them the sides of each are.

    Parameters
    ----------
    faces
        Numbers, [n].

    Returns
    -------
    edges
        Different pairs of vertices, lower number first, sorted, [E, 2].
    index
        Edge from corner k to the next, in column k, [n, 3].

    Raises
    ------
    InputError
        If one is not the number of a face.
    """
    corners = mesh.faces[mesh_checks.numbers("faces", faces, len(mesh.faces))]
    return mesh_edges.unique(mesh_edges.sides(corners), len(mesh.vertices))


def areas(mesh: Tessellation, faces: Values) -> Float[np.ndarray, " n"]:
    """Areas of faces, in the squared unit of the scene.

    Raises
    ------
    InputError
        If one of `faces` is not the number of a face.
    """
    triangles = mesh.vertices[mesh.faces[mesh_checks.numbers("faces", faces, len(mesh.faces))]]
    return 0.5 * np.linalg.norm(_across(triangles), axis=-1)


def closed(mesh: Tessellation) -> tuple[Int[np.ndarray, "G 3"], Int[np.ndarray, " G"]]:
    """Leaves as triangles that meet side to side, wound as they are, in their order.

    A leaf next to finer ones has their midpoints on its sides. With one it is cut in two, with two
    in three, along the shorter diagonal, with three in four. This is so for drawing: the next
    round starts from the leaves (Bank, Sherman and Weiser, 1983).

    Returns
    -------
    faces
        Corners, [G, 3].
    origin
        The leaf that a triangle is part of, ascending, [G].
    """
    whole = leaves(mesh)
    ends = mesh_edges.sides(mesh.faces[whole])
    middle = mesh_edges.midpoints(mesh.ends, mesh.initial, ends.reshape(-1, 2)).reshape(-1, 3)
    count = (middle >= 0).sum(axis=1)
    # Turned so that sides with a midpoint come first.
    turn = np.zeros(len(whole), np.int64)
    turn[count == 1] = np.argmax(middle[count == 1] >= 0, axis=1)
    turn[count == 2] = np.argmin(middle[count == 2], axis=1) + 1
    columns = (turn[:, None] + np.arange(3)) % 3
    a, b, c = np.take_along_axis(mesh.faces[whole], columns, axis=1).T
    ab, bc, ca = np.take_along_axis(middle, columns, axis=1).T
    start = np.cumsum(count + 1) - (count + 1)
    faces = np.empty((int((count + 1).sum()), 3), np.int32)

    def put(which: np.ndarray, *parts: tuple[np.ndarray, ...]) -> None:
        for at, corners in enumerate(parts):
            faces[start[which] + at] = np.stack([corner[which] for corner in corners], axis=1)

    put(count == 0, (a, b, c))
    put(count == 1, (a, ab, c), (ab, b, c))
    across = [
        np.sum((mesh.vertices[p] - mesh.vertices[q]) ** 2, axis=1) for p, q in ((a, bc), (ab, c))
    ]
    first = across[0] <= across[1]
    put((count == 2) & first, (ab, b, bc), (a, ab, bc), (a, bc, c))
    put((count == 2) & ~first, (ab, b, bc), (a, ab, c), (ab, bc, c))
    put(count == 3, (a, ab, ca), (ab, b, bc), (ca, bc, c), (bc, ca, ab))
    return faces, np.repeat(whole, count + 1)


def _balanced(mesh: Tessellation, chosen: np.ndarray) -> Bool[np.ndarray, " F"]:
    """Which faces are to be cut: those chosen, and those that would be two levels coarser.

    The side of a face is an initial edge, half of an edge of the level above, or lies inside the
    parent. Only beyond a half can a coarser leaf lie: one that has all of that edge.
    """
    cut = np.zeros(len(mesh.faces), bool)
    cut[chosen] = True
    coarse = np.flatnonzero((mesh.children < 0) & (mesh.level < mesh.level[chosen].max()))
    corners = mesh.faces[coarse]
    front = chosen
    while len(front) and len(coarse):
        low, high = mesh_edges.sides(mesh.faces[front]).reshape(-1, 2).T
        # Of two vertices the one with the higher number is the younger.
        halved = mesh.ends[high]
        halved = halved[(halved == low[:, None]).any(axis=1)]
        near = np.flatnonzero(
            mesh_edges.touching(corners, halved, len(mesh.vertices)) & ~cut[coarse]
        )
        sides = mesh_edges.sides(corners[near])
        found = (mesh_edges.find(halved, sides, len(mesh.vertices)) >= 0).any(axis=1)
        front = coarse[near[found]]
        cut[front] = True
    return cut


def _directions(
    mesh: Tessellation, cut: np.ndarray, edges: np.ndarray, side: np.ndarray, new: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normals and tangents of new midpoints."""
    normals, apart = _middle(mesh.normals[edges[new]])
    tangents, none = _middle(mesh.tangents[edges[new]])
    tangents[none] = 0.0
    if apart.any():
        # Of values written to one place the last remains: that of the first face.
        first = np.empty(len(edges), np.int64)
        first[side.reshape(-1)[::-1]] = np.repeat(cut, 3)[::-1]
        across = _across(mesh.vertices[mesh.faces[first[new][apart]]])
        normals[apart] = across / np.linalg.norm(across, axis=1, keepdims=True)
    return normals, tangents


def _middle(two: Float[np.ndarray, "n 2 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors along the sums of two vectors, and where these cancel."""
    scale = np.abs(two).max(axis=(1, 2), initial=0.0)
    two = two / np.where(scale > 0.0, scale, 1.0)[:, None, None]
    total = two.sum(axis=1)
    length = np.linalg.norm(total, axis=1)
    cancelled = length <= _CANCELLED * np.linalg.norm(two, axis=2).sum(axis=1)
    return total / np.where(cancelled, 1.0, length)[:, None], cancelled


def _across(triangles: Float[np.ndarray, "n 3 3"]) -> Float[np.ndarray, "n 3"]:
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    return np.cross(b - a, c - a)
