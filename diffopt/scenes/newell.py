"""The Utah teapot as a mesh: points and normals of its Bezier patches, seams welded."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt.scenes.meshfiles import Mesh
from diffopt.scenes.teapot_points import PATCHES, POINTS

# Corners of two patches are one vertex where they are this near: coordinates are about 1 and
# carry five decimals, rounding is 1e-15.
_NEAR = 1e-9
# Cosine above which the normals of such corners are one. Those of one seam agree to rounding; the
# handle's lower end touches the body in a point, where they are 114 degrees apart.
_SMOOTH = np.cos(np.radians(5.0))


class Grid(NamedTuple):
    """Points of the patches, [32, n, n, 3], and unit normals there, outwards."""

    points: Float[np.ndarray, "P n n 3"]
    normals: Float[np.ndarray, "P n n 3"]


def grid(divisions: int) -> Grid:
    """Every patch at (divisions + 1)^2 even parameters, ends included.

    The normal is that of the derivatives across. Where a row of control points is one point,
    as on the lid's knob and in the middle of the bottom, the derivative along it is 0 for all
    of it; the normal is then the limit, whose direction along the row is the derivative of
    that derivative.
    """
    control = POINTS[PATCHES]
    at = np.linspace(0.0, 1.0, divisions + 1)
    basis, slope = _bernstein(at)
    points = _surface(basis, basis, control)
    along = _surface(slope, basis, control)
    across = _surface(basis, slope, control)
    mixed = _surface(slope, slope, control)
    still = np.linalg.norm(across, axis=-1, keepdims=True) < _NEAR
    # Only rows u = 0 are points here: the other end would need the opposite sign.
    across = np.where(still, mixed, across)
    normals = np.cross(across, along)
    return Grid(points, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def build(divisions: int) -> Mesh:
    """The mesh of `diffopt.scenes.models.teapot`."""
    points, normals = grid(divisions)
    count = divisions + 1
    number = np.arange(points[..., 0].size).reshape(-1, count, count)
    label = _welded(points.reshape(-1, 3), normals.reshape(-1, 3))[number]
    here, right = label[:, :-1, :-1], label[:, :-1, 1:]
    down, over = label[:, 1:, :-1], label[:, 1:, 1:]
    # Both halves of a square, wound so that d/dv x d/du is in front.
    faces = np.concatenate(
        [np.stack(three, -1).reshape(-1, 3) for three in ((here, right, over), (here, over, down))]
    )
    # Squares at a point have one side without length: one of their halves is no face.
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    total = label.max() + 1
    places, directions = np.zeros((total, 3)), np.zeros((total, 3))
    places[label.ravel()] = points.reshape(-1, 3)
    np.add.at(directions, label.ravel(), normals.reshape(-1, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    return Mesh(places, faces, directions)


def _bernstein(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cubic Bernstein polynomials and their derivatives, [n, 4]."""
    t, s = at, 1.0 - at
    values = [s**3, 3.0 * t * s**2, 3.0 * t**2 * s, t**3]
    slopes = [-3.0 * s**2, 3.0 * s**2 - 6.0 * t * s, 6.0 * t * s - 3.0 * t**2, 3.0 * t**2]
    return np.stack(values, -1), np.stack(slopes, -1)


def _surface(u: np.ndarray, v: np.ndarray, control: np.ndarray) -> np.ndarray:
    return np.einsum("ui,vj,pijc->puvc", u, v, control)


def _welded(points: np.ndarray, normals: np.ndarray) -> Int[np.ndarray, " N"]:
    """Labels from 0 of the vertices that points become: one for each place and direction."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    pairs = KDTree(points).query_pairs(_NEAR, output_type="ndarray")
    alike = (normals[pairs[:, 0]] * normals[pairs[:, 1]]).sum(-1) > _SMOOTH
    one, other = pairs[alike].T
    graph = coo_matrix((np.ones(len(one)), (one, other)), shape=(len(points),) * 2)
    return connected_components(graph, directed=False)[1].astype(np.int64)
