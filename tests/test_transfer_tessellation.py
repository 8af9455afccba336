"""Meshes refined for transfer, against a slow twin and geometry that knows no numbers of faces."""

import itertools

import numpy as np
import pytest
import trimesh

from diffopt.errors import InputError
from diffopt.transfer import mesh_checks
from diffopt.transfer.tessellation import (
    DEEPEST,
    areas,
    begin,
    closed,
    leaves,
    pairs,
    split,
    uniform,
)

UP = [0.0, 0.0, 1.0]


def made(vertices, faces, normals=None, label=None):
    vertices = np.asarray(vertices, float)
    normals = np.tile(UP, (len(vertices), 1)) if normals is None else normals
    return begin(vertices, normals, np.zeros_like(vertices), np.asarray(faces), label)


def grid(n=3):
    """The square from 0 to n in squares of two triangles."""
    x, y = (a.reshape(-1) for a in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
    corner = np.add.outer((n + 1) * np.arange(n), np.arange(n)).reshape(-1)
    lower = np.stack([corner, corner + 1, corner + n + 2], axis=1)
    upper = np.stack([corner, corner + n + 2, corner + n + 1], axis=1)
    return made(np.stack([x, y, 0.0 * x], axis=1), np.concatenate([lower, upper]))


def icosphere():
    ball = trimesh.creation.icosphere(subdivisions=0)
    return made(ball.vertices, ball.faces, ball.vertices)


def fins():
    """Three triangles on one edge, and one more beside each."""
    turn = 2.0 * np.pi * np.arange(3) / 3.0
    near = np.stack([np.cos(turn), np.sin(turn), 0.5 + 0.0 * turn], axis=1)
    far = near * [2.0, 2.0, 1.0] + [0.0, 0.0, 0.7]
    faces = [[0, 1, 2 + k] for k in range(3)] + [[1, 5 + k, 2 + k] for k in range(3)]
    return made(np.concatenate([[[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], near, far]), faces)


def moebius(n=7):
    """A strip with half a turn: the last rungs are joined the other way up."""
    turn = 2.0 * np.pi * np.arange(n) / n
    around = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], axis=1)
    across = np.cos(turn / 2.0)[:, None] * around + np.sin(turn / 2.0)[:, None] * np.array(UP)
    points = np.concatenate([around - 0.4 * across, around + 0.4 * across])
    faces = []
    for k in range(n):
        a, b, c, d = k, k + 1, k + n, k + n + 1
        if k == n - 1:
            b, d = n, 0
        faces += [[a, b, c], [b, d, c]]
    return made(points, faces)


MESHES = {"grid": grid, "icosphere": icosphere, "fins": fins, "moebius": moebius}
# Vertices less edges plus faces: disc, sphere, book of discs, strip.
EULER = {"grid": 1, "icosphere": 2, "fins": 1, "moebius": 0}


@pytest.fixture(params=MESHES)
def name(request):
    return request.param


def grown(name, rng, rounds=4, most=3):
    """A mesh after rounds of splits, more often of small faces than of large ones."""
    mesh = MESHES[name]()
    for _ in range(rounds):
        found = leaves(mesh)
        weight = 6.0 ** mesh.level[found]
        chosen = rng.choice(found, min(most, len(found)), p=weight / weight.sum())
        mesh = split(mesh, chosen)
    return mesh


def segments(mesh, faces):
    """Both ends of all sides, [3 n, 2, 3]."""
    corners = mesh.vertices[mesh.faces[faces]]
    return np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2, 3)


def within(points, ends, inside=False):
    """Whether points, [p, 3], lie on segments, [s, 2, 3], as [s, p]; `inside`: off their ends."""
    along = ends[:, 1] - ends[:, 0]
    away = points - ends[:, :1]
    share = np.einsum("spi,si->sp", away, along) / (along**2).sum(-1)[:, None]
    off = np.linalg.norm(away - share[:, :, None] * along[:, None], axis=-1)
    # Sides here are longer than 1e-3, midpoints of coordinates near 1 are exact to 1e-15.
    edge = -1e-9 if inside else 1e-9
    return (off < 1e-9) & (share > -edge) & (share < 1.0 + edge)


def neighbours(mesh, faces):
    """Pairs of positions in `faces` whose sides overlap, the coarser first; by geometry."""
    ends = segments(mesh, faces)
    on = within(ends.reshape(-1, 3), ends).reshape(len(ends), -1, 2).all(axis=-1)
    coarse, fine = np.nonzero(on)
    return coarse // 3, fine // 3


def shapes(triangles):
    """Triangles without the order of their corners, as a set; positions are equal bit by bit."""
    return {tuple(sorted(map(tuple, triangle))) for triangle in triangles.tolist()}


def test_splits_are_the_fewest_that_balance(name, rng):
    """A slow twin: quarter what is asked for, then, one by one, what lies by something finer."""
    mesh = MESHES[name]()
    for _ in range(4):
        found = leaves(mesh)
        chosen = found[np.argsort(rng.random(len(found)) - mesh.level[found])[:2]]
        after = split(mesh, chosen)
        asked = [(mesh.vertices[mesh.faces[f]], mesh.level[f], f in chosen) for f in found]
        rest = [(t, level) for t, level, cut in asked if not cut]
        rest += [(t, level + 1) for whole, level, cut in asked if cut for t in quarters(whole)]
        while True:
            corners = np.stack([t for t, _ in rest])
            level = np.array([level for _, level in rest])
            twin = made(corners.reshape(-1, 3), np.arange(3 * len(rest)).reshape(-1, 3))
            coarse, fine = neighbours(twin, np.arange(len(rest)))
            wrong = set(coarse[level[fine] > level[coarse] + 1].tolist())
            if not wrong:
                break
            rest = [item for k, item in enumerate(rest) if k not in wrong] + [
                (t, level[k] + 1) for k in wrong for t in quarters(corners[k])
            ]
        assert shapes(after.vertices[after.faces[leaves(after)]]) == shapes(corners)
        mesh = after
    assert mesh.level.max() >= 3


def quarters(triangle):
    a, b, c = triangle
    ab, bc, ca = (a + b) / 2.0, (b + c) / 2.0, (c + a) / 2.0
    return [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]


def test_neighbours_differ_by_one_level(name, rng):
    mesh = grown(name, rng, rounds=6)
    assert mesh.level.max() >= 4
    found = leaves(mesh)
    coarse, fine = neighbours(mesh, found)
    step = mesh.level[found][fine].astype(int) - mesh.level[found][coarse]
    assert set(step.tolist()) == {0, 1}


def test_area_and_place_stay(name, rng):
    start, mesh = MESHES[name](), grown(name, rng)
    of = np.arange(len(mesh.faces))
    while (mesh.parent[of] >= 0).any():
        of = np.where(mesh.parent[of] >= 0, mesh.parent[of], of)
    found = leaves(mesh)
    # Sums of some hundred float64.
    total = np.bincount(of[found], areas(mesh, found), len(start.faces))
    np.testing.assert_allclose(total, areas(start, np.arange(len(start.faces))), rtol=1e-12)
    across = np.cross(
        *(start.vertices[start.faces[:, k]] - start.vertices[start.faces[:, 0]] for k in (1, 2))
    )
    # Children lie in the plane of their initial face, and are wound as it is.
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    own, whole = np.cross(b - a, c - a), across[of]
    size = np.linalg.norm(own, axis=1) * np.linalg.norm(whole, axis=1)
    np.testing.assert_allclose((own * whole).sum(1), size, rtol=1e-12)
    base = start.vertices[start.faces[of, 0]]
    assert np.abs(((a - base) * whole).sum(1)).max() < 1e-12


def test_tables_are_consistent(name, rng):
    mesh = grown(name, rng)
    cut = np.flatnonzero(mesh.children >= 0)
    assert len(cut) + len(leaves(mesh)) == len(mesh.faces)
    children = mesh.children[cut][:, None] + np.arange(4)
    later = np.arange(np.count_nonzero(mesh.parent < 0), len(mesh.faces))
    np.testing.assert_array_equal(np.sort(children.reshape(-1)), later)
    np.testing.assert_array_equal(mesh.parent[children], np.repeat(cut[:, None], 4, axis=1))
    np.testing.assert_array_equal(mesh.level[children], mesh.level[cut][:, None] + np.ones(4, int))
    kept = np.stack([mesh.faces[children[:, k], k] for k in range(3)], axis=1)
    np.testing.assert_array_equal(kept, mesh.faces[cut])
    middle = mesh.faces[children[:, 3]]
    np.testing.assert_array_equal(
        np.sort(mesh.ends[middle], axis=-1),
        np.sort(np.stack([mesh.faces[cut][:, [1, 2, 0]], mesh.faces[cut][:, [2, 0, 1]]], -1), -1),
    )
    new = np.arange(mesh.initial, len(mesh.vertices))
    assert (mesh.ends[new, 0] < mesh.ends[new, 1]).all()
    assert (mesh.ends[new, 1] < new).all()
    np.testing.assert_array_equal(mesh.ends[: mesh.initial].T, [np.arange(mesh.initial)] * 2)
    np.testing.assert_array_equal(mesh.vertices[new], mesh.vertices[mesh.ends[new]].mean(axis=1))
    assert [a.dtype for a in (mesh.faces, mesh.level, mesh.parent, mesh.children)] == [
        np.int32,
        np.int8,
        np.int32,
        np.int32,
    ]


def test_midpoints_are_shared(name, rng):
    mesh = grown(name, rng)
    assert len(np.unique(mesh.ends, axis=0)) == len(mesh.vertices)
    # These surfaces do not touch themselves: one place, one vertex.
    assert len(np.unique(mesh.vertices.round(12), axis=0)) == len(mesh.vertices)


def test_closed_has_no_gaps(name, rng):
    mesh = grown(name, rng, rounds=6)
    faces, origin = closed(mesh)
    assert set(origin) == set(leaves(mesh))
    assert (np.diff(origin) >= 0).all()
    used = np.unique(faces)
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    edges, count = np.unique(sides, axis=0, return_counts=True)
    assert len(used) - len(edges) + len(faces) == EULER[name]
    ends = mesh.vertices[edges]
    assert not within(mesh.vertices[used], ends, inside=True).any()
    # As many triangles meet at an edge as initial faces meet at the points within it.
    start = MESHES[name]()
    initial = np.arange(len(start.faces))
    lines, index = pairs(start, initial)
    meeting = np.bincount(index.reshape(-1))
    on = within(ends.mean(axis=1), start.vertices[lines])
    assert (on.sum(axis=0) <= 1).all()
    np.testing.assert_array_equal(count, np.where(on.any(axis=0), meeting @ on, 2))


def test_closed_keeps_area_and_winding(name, rng):
    mesh = grown(name, rng, rounds=6)
    faces, origin = closed(mesh)

    def across(corners):
        a, b, c = (mesh.vertices[corners[:, k]] for k in range(3))
        return np.cross(b - a, c - a)

    parts, whole = across(faces), across(mesh.faces[origin])
    size = np.linalg.norm(parts, axis=1) * np.linalg.norm(whole, axis=1)
    np.testing.assert_allclose((parts * whole).sum(1), size, rtol=1e-9)
    total = np.bincount(origin, np.linalg.norm(parts, axis=1), len(mesh.faces))
    found = leaves(mesh)
    np.testing.assert_allclose(total[found] / 2.0, areas(mesh, found), rtol=1e-12)
    # One triangle, and one more for each corner of another leaf within a side.
    used = mesh.vertices[np.unique(mesh.faces[found])]
    inside = within(used, segments(mesh, found), inside=True).sum(axis=1).reshape(-1, 3)
    assert inside.max() == 1
    np.testing.assert_array_equal(np.bincount(origin)[found], 1 + inside.sum(axis=1))


def test_closed_around_one_coarse_face():
    """Three finer neighbours: cut in four as a split would, but for the midpoints, which stay."""
    mesh = icosphere()
    _, index = pairs(mesh, np.arange(20))
    beside = np.flatnonzero(np.isin(index, index[7]).any(axis=1))
    mesh = split(mesh, beside[beside != 7])
    faces, origin = closed(mesh)
    after = split(mesh, [7])
    assert len(after.vertices) == len(mesh.vertices)
    np.testing.assert_array_equal(faces[origin == 7], after.faces[after.children[7] :])


def test_closed_cuts_along_the_shorter_diagonal():
    """A wide triangle with midpoints on two of its sides, each way round."""
    points = [[0.0, 0.0, 0.0], [9.0, 0.0, 0.0], [1.0, 2.0, 0.0], [-5.0, 3.0, 0.0], [9.0, 5.0, 0.0]]
    for turn in range(3):
        mesh = made(points, [np.roll([0, 1, 2], turn), [0, 2, 3], [1, 4, 2]])
        mesh = split(mesh, np.array([1, 2]))
        faces, origin = closed(mesh)
        parts = np.sort(faces[origin == 0], axis=1)
        assert len(parts) == 3
        # Halves of 0-2 and of 1-2; from the first to 1 it is farther than from the second to 0.
        left, right = (mesh.vertices[mesh.initial :, 0] == x for x in (0.5, 5.0))
        left, right = (mesh.initial + int(np.flatnonzero(a)[0]) for a in (left, right))
        assert np.linalg.norm(mesh.vertices[left] - points[1]) > np.linalg.norm(
            mesh.vertices[right]
        )
        assert any({0, right} <= set(part) for part in parts.tolist())
        assert not any({1, left} <= set(part) for part in parts.tolist())


def test_order_of_the_chosen_does_not_matter(name, rng):
    mesh = grown(name, rng)
    found = leaves(mesh)
    chosen = rng.choice(found, 5, replace=False)
    one = split(mesh, chosen)
    for other in (split(mesh, chosen[::-1]), split(mesh, np.concatenate([chosen, chosen[:2]]))):
        for field in ("vertices", "normals", "tangents", "ends", "faces", "level", "children"):
            np.testing.assert_array_equal(getattr(one, field), getattr(other, field))


def test_splits_leave_the_mesh_as_it_was(name, rng):
    mesh = grown(name, rng, rounds=2)
    before = [a.copy() for a in (mesh.children, mesh.faces, mesh.vertices)]
    after = split(mesh, leaves(mesh)[:3])
    assert len(after.faces) >= len(mesh.faces) + 12
    for a, b in zip(before, (mesh.children, mesh.faces, mesh.vertices), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(after.faces[: len(mesh.faces)], mesh.faces)
    np.testing.assert_array_equal(after.vertices[: len(mesh.vertices)], mesh.vertices)
    assert split(mesh, []) is mesh


def test_pairs_are_the_sides(name, rng):
    mesh = grown(name, rng, rounds=3)
    found = leaves(mesh)[::-1]
    edges, index = pairs(mesh, found)
    corners = mesh.faces[found]
    sides = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2), axis=2)
    np.testing.assert_array_equal(edges[index], sides)
    np.testing.assert_array_equal(edges, sorted(set(map(tuple, sides.reshape(-1, 2).tolist()))))


def test_uniform(name):
    mesh = split(MESHES[name](), [1])
    even = uniform(mesh, 2)
    found = leaves(even)
    assert (even.level[found] == 2).all()
    assert len(found) == 16 * len(MESHES[name]().faces)
    np.testing.assert_array_equal(closed(even)[0], even.faces[found])
    assert uniform(even, 1) is even
    with pytest.raises(InputError, match=f"level must be from 0 to {DEEPEST}; received -1"):
        uniform(mesh, -1)


def test_labels_are_inherited():
    label = np.arange(10, 28, dtype=np.int64)
    start = grid()
    mesh = uniform(made(start.vertices, start.faces, label=label), 2)
    later = mesh.parent >= 0
    np.testing.assert_array_equal(mesh.label[later], mesh.label[mesh.parent[later]])
    assert np.bincount(mesh.label[leaves(mesh)])[10:].tolist() == [16] * 18


def test_normals_and_tangents_of_midpoints():
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]
    normals = np.array([[3.0, 0.0, 0.0], [0.0, 1e-60, 0.0], [0.0, -2.0, 0.0], [1e60, 0.0, 0.0]])
    tangents = np.array([[0.0, 0.0, 0.0], [1e-30, 0.0, 1e-30], [-2.0, 0.0, 0.0], [2.0, 0.0, 0.0]])
    mesh = begin(points, normals, tangents, [[0, 1, 2], [3, 2, 1]])
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, rtol=1e-15)
    np.testing.assert_array_equal(mesh.tangents, tangents)
    mesh = split(mesh, [0, 1])
    at = {tuple(ends): k for k, ends in enumerate(mesh.ends.tolist())}
    half = np.sqrt(0.5)
    # One rounding or two of numbers up to 1.
    close = {"atol": 1e-15, "rtol": 0.0}
    np.testing.assert_allclose(mesh.normals[at[0, 1]], [half, half, 0.0], **close)
    # Opposite normals: that of the face.
    np.testing.assert_allclose(mesh.normals[at[1, 2]], [0.0, 0.0, 1.0], **close)
    # No tangent at one end, however small the other; opposite ones; one much longer.
    np.testing.assert_allclose(mesh.tangents[at[0, 1]], [half, 0.0, half], **close)
    np.testing.assert_array_equal(mesh.tangents[at[2, 3]], 0.0)
    np.testing.assert_allclose(mesh.tangents[at[1, 2]], [-1.0, 0.0, 0.0], **close)
    np.testing.assert_array_equal(uniform(grid(), 2).tangents, 0.0)


def test_normal_of_the_first_face_where_normals_cancel():
    """Two faces of a fold, whose edge has opposite normals at its ends."""
    points = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    normals = [[1.0, 0.0, 0.0], [-1.0, 1e-8, 0.0], UP, UP]
    for faces, expected in (
        ([[0, 1, 2], [1, 0, 3]], UP),
        ([[1, 0, 3], [0, 1, 2]], [0.0, 1.0, 0.0]),
    ):
        mesh = made(points, faces, normals)
        for chosen in ([0, 1], [1, 0]):
            after = split(mesh, chosen)
            (at,) = np.flatnonzero((after.ends == [0, 1]).all(axis=1))
            np.testing.assert_allclose(after.normals[at], expected, atol=1e-15)


def test_unusable_faces_are_left_out():
    points = [
        *([x, y, 0.0] for x, y in itertools.product((0.0, 0.3, 0.6), (0.1, 0.2, 0.3))),
        [0.0, 0.1, 0.0],
    ]
    faces = [
        [0, 0, 4],  # one corner twice
        [0, 4, 1],
        [4, 0, 1],  # turned
        [1, 4, 0],  # and the other way round
        [0, 4, 8],  # on a line, but for rounding
        [0, 9, 4],  # two corners in one place
        [3, 4, 0],
        [0, 4, 1],
    ]
    kept = mesh_checks.usable(points, faces)
    np.testing.assert_array_equal(kept, [1, 6])
    mesh = made(points, faces, label=np.arange(8))
    np.testing.assert_array_equal(mesh.faces, [[0, 4, 1], [3, 4, 0]])
    np.testing.assert_array_equal(mesh.label, [1, 6])
    assert len(leaves(split(mesh, [0]))) == 5


def test_thin_faces_are_kept():
    """A needle 1e-9 wide is no line, wherever it points."""
    for turn in np.linspace(0.0, 3.0, 7):
        x, y = (
            np.array([np.cos(turn), np.sin(turn), 0.3]),
            np.array([-np.sin(turn), np.cos(turn), 0]),
        )
        assert len(made([0.0 * x, x, x + 1e-9 * y], [[0, 1, 2]]).faces) == 1


def test_nothing_at_all():
    for mesh in (
        made(np.zeros((0, 3)), np.zeros((0, 3), int)),
        made([[1.0, 2.0, 3.0]], [[0, 0, 0]]),
    ):
        assert len(leaves(mesh)) == 0
        assert len(mesh.faces) == 0
        assert [len(a) for a in (*closed(mesh), *pairs(mesh, []), areas(mesh, []))] == [0] * 5
        assert uniform(split(mesh, []), 3) is mesh


def test_deepest_level():
    mesh = made([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [[0, 1, 2]])
    mesh = split(mesh, [0])
    while mesh.level.max() < DEEPEST:
        mesh = split(mesh, [mesh.children[mesh.parent[-1]] + 1])
    small = np.flatnonzero(mesh.level == DEEPEST)
    # A quarter each time; coordinates of 1 and 2^-30 are exact.
    np.testing.assert_allclose(areas(mesh, small), 0.5 * 4.0**-DEEPEST, rtol=1e-7)
    np.testing.assert_allclose(areas(mesh, leaves(mesh)).sum(), 0.5, rtol=1e-12)
    with pytest.raises(InputError, match=f"leaves below level {DEEPEST}"):
        split(mesh, small[:1])


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"vertices": np.zeros((3, 2))}, r"vertices must have shape \[V, 3\]; received \[3, 2\]"),
        ({"vertices": np.full((3, 3), np.nan)}, "vertices must be finite .* in row 0"),
        ({"vertices": np.full((3, 3), 1e80)}, "vertices must be finite and at most 1e[+]70"),
        ({"vertices": np.ones((3, 3), complex)}, "vertices must be real numbers"),
        ({"normals": np.zeros((2, 3))}, r"normals must have shape \[3, 3\]; received \[2, 3\]"),
        ({"normals": [UP, [0.0, 0.0, 0.0], UP]}, "normals must not be 0; received 0 in row 1"),
        ({"normals": [UP, [np.inf, 0.0, 0.0], UP]}, "normals must be finite"),
        ({"tangents": np.full((3, 3), np.inf)}, "tangents must be finite"),
        ({"faces": [[0, 1, 3]]}, "faces must name vertices from 0 to 2; received 3 in face 0"),
        ({"faces": [[0, 1, 2], [0, -1, 2]]}, "received -1 in face 1"),
        ({"faces": [[0.0, 1.0, 2.0]]}, r"faces must be integers \[M, 3\]; received float64"),
        ({"faces": [0, 1, 2]}, r"faces must be integers \[M, 3\]; received int64 \[3\]"),
        ({"faces": [[0, 1], [0, 1, 2]]}, "faces must be one array; received rows of different"),
        ({"label": [0, 1]}, r"label must be integers \[1\]; received int64 \[2\]"),
        ({"label": [0.5]}, "label must be integers"),
        ({"label": [2**40]}, "label must fit int32"),
    ],
)
def test_bad_meshes(changed, text):
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    good = {"vertices": points, "normals": [UP] * 3, "tangents": 0.0 * points, "faces": [[0, 1, 2]]}
    assert len(begin(**good).faces) == 1
    with pytest.raises(InputError, match=text):
        begin(**(good | changed))


@pytest.mark.parametrize(
    ("chosen", "text"),
    [
        ([0], "chosen must be leaves; received face 0, which is cut already"),
        ([-1], "chosen must name faces from 0 to 21; received -1"),
        ([1, 22], "received 22"),
        (np.ones(22, bool), r"chosen must be integers \[n\]; received bool \[22\]"),
        ([[1]], "chosen must be integers"),
        ([1.0], "received float64"),
    ],
)
def test_bad_choices(chosen, text):
    mesh = split(grid(), [0])
    with pytest.raises(InputError, match=text):
        split(mesh, chosen)
