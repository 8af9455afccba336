"""Meshes against closed forms: views, tangents, shadows, and files that cannot be used."""

import numpy as np
import pytest
import trimesh

from diffopt.drawing import meshes, shapes
from diffopt.errors import InputError
from diffopt.scenes import tangents

LIGHT = shapes.unit(np.array([-0.45, 0.50, 0.75]))


def grid(rows, columns):
    """Two triangles for each cell of a grid of vertices, counter-clockwise in (column, row)."""
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    return np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])


def globe(rows=91, columns=181):
    """Unit sphere as (vertices, faces, uv): u along the parallels, v to the north pole."""
    v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
    south, east = np.pi * (1.0 - v), 2 * np.pi * u
    points = [np.sin(south) * np.sin(east), np.cos(south), np.sin(south) * np.cos(east)]
    # The same numbers at both ends of the seam, as a modelling program would write them.
    points = [p * (np.abs(p) > 1e-12) for p in points]
    for p in points:
        p[:, -1] = p[:, 0]
        p[[0, -1]] = p[[0, -1], :1]
    vertices = np.stack(points, -1).reshape(-1, 3)
    return vertices, grid(rows, columns), np.stack([u, v], -1).reshape(-1, 2)


def arc(count=301):
    """The sheet of `shapes.sheet`, u along the bend and v along -x."""
    v, u = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, count), indexing="ij")
    angle = np.radians(60.0 + 50.0 * u)
    vertices = np.stack([-v, np.sin(angle), np.cos(angle)], -1).reshape(-1, 3)
    return vertices, grid(9, count), np.stack([u, v], -1).reshape(-1, 2)


@pytest.fixture(scope="module")
def ball():
    return meshes.build(*globe())


@pytest.fixture(scope="module")
def torus():
    made = trimesh.creation.torus(1.0, 0.45, major_sections=60, minor_sections=30)
    return meshes.build(np.asarray(made.vertices), np.asarray(made.faces))


def inner(mask):
    """Samples whose four neighbours are in the mask as well."""
    edge = np.pad(mask, 1)
    return mask & edge[2:, 1:-1] & edge[:-2, 1:-1] & edge[1:-1, 2:] & edge[1:-1, :-2]


def test_fine_sphere_is_the_closed_sphere(ball):
    # From so far away that rays lean by 1e-4 at most, as shapes.sphere's do not at all.
    distance = 1e4
    fov = np.degrees(2.0 * np.arctan(1.04 / distance))
    seen = meshes.view(ball, 120, eye=np.array([0.0, 0.0, distance]), field_of_view_deg=fov)
    closed = shapes.sphere(120)
    assert (seen.covered != closed.covered).mean() < 2e-3
    both = inner(inner(seen.covered & closed.covered))
    # Facets of 2 degrees lie up to (1 - cos 1 degree) = 1.5e-4 under the sphere; at 77 degrees,
    # two pixels inside the rim, that moves a point, and its normal, by four times as much.
    for name, most in (("position", 2e-3), ("normal", 2e-3), ("eye", 2e-4)):
        error = np.linalg.norm(getattr(seen, name) - getattr(closed, name), axis=-1)
        assert error[both].max() < most, name
    # Chords of 2 degrees are 1 degree off at their ends, where their weights are unequal.
    # Tangents turn fast about the poles, which are left out.
    calm = both & (np.abs(closed.normal[..., 1]) < 0.9)
    assert np.linalg.norm(seen.tangent - closed.tangent, axis=-1)[calm].max() < 0.0175


def like_the_sheet(mesh, size):
    """The mesh before the camera of `shapes.sheet`."""
    eye, middle = np.array([1.2, 1.9, 3.5]), np.radians(60.0)
    target = np.array([0.0, np.sin(middle) - 0.28, np.cos(middle) - 0.16])
    fov = np.degrees(2.0 * np.arctan(1.28 / np.linalg.norm(eye - target)))
    return meshes.view(mesh, size, eye=eye, target=target, field_of_view_deg=fov)


@pytest.mark.parametrize("size", [96, (60, 110)])
def test_fine_sheet_is_the_closed_sheet(size):
    seen, closed = like_the_sheet(meshes.build(*arc()), size), shapes.sheet(size)
    assert (seen.covered != closed.covered).mean() < 2e-3
    np.testing.assert_allclose(seen.eye, closed.eye, atol=1e-12)
    # Facets of a third of a degree, 1 - cos(1/6 degree) = 4e-6 under the sheet, which is ten times
    # as much along a ray with a cosine of 0.1.
    steep = seen.covered & closed.covered & ((closed.normal * closed.eye).sum(-1) > 0.1)
    assert np.linalg.norm(seen.position - closed.position, axis=-1)[steep].max() < 5e-5
    for name in ("normal", "tangent"):
        error = np.linalg.norm(getattr(seen, name) - getattr(closed, name), axis=-1)[steep]
        # At the sheet's ends vertices have the normal of one facet, 1/6 degree off.
        assert error.max() < 3e-3
        assert np.median(error) < 5e-6


def test_circles_and_texture_agree_on_a_body_of_revolution(ball):
    eye = np.array([2.0, 1.0, 4.0])
    texture = meshes.view(ball, 64, eye=eye)
    field = tangents.around(ball, np.array([0.0, 3.0, 0.0]))
    circles = meshes.view(ball, 64, eye=eye, field=field)
    calm = texture.covered & (np.abs(texture.normal[..., 1]) < 0.9)
    # Chords of 2 degrees are 1 degree off at their ends.
    assert np.linalg.norm(texture.tangent - circles.tangent, axis=-1)[calm].max() < 0.0175
    # Circles are level, at every sample: exact between the vertices.
    assert np.abs(circles.tangent[..., 1])[circles.covered].max() < 1e-12


FIELDS = {
    "texture": lambda mesh: tangents.from_texture(mesh),
    "circles": lambda mesh: tangents.around(mesh, np.array([0.0, 1.0, 0.0])),
    "to the viewer": lambda mesh: tangents.from_direction(mesh, np.array([0.0, 0.0, 1.0])),
    "upwards": lambda mesh: tangents.from_direction(mesh, np.array([0.0, 2.0, 0.0])),
    "own": lambda mesh: tangents.from_direction(mesh, np.roll(mesh.vertices, 1, axis=1)),
}


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("eye", [(0.0, 0.0, 4.0), (0.0, 4.0, 0.0), (0.0, -4.0, 0.01)])
def test_frames_are_orthonormal_and_right_handed_at_poles_as_well(ball, name, eye):
    up = (1.0, 0.0, 0.0)
    seen = meshes.view(ball, 65, eye=np.array(eye), up=up, field=FIELDS[name](ball))
    x, z = seen.tangent[seen.covered], seen.normal[seen.covered]
    assert len(x) > 1000
    for vectors in (x, z):
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose((x * z).sum(-1), 0.0, atol=1e-12)
    local = seen.local(np.cross(seen.normal, seen.tangent))[seen.covered]
    np.testing.assert_allclose(local, np.broadcast_to([0.0, 1.0, 0.0], local.shape), atol=1e-12)
    assert (seen.local(seen.eye)[seen.covered][:, 2] > 0.0).all()


def test_tangents_without_a_direction_are_smooth_functions_of_the_normal(rng):
    normals = shapes.unit(rng.normal(size=(500, 3)))
    normals = normals[normals[:, 2] > -0.9]
    moved = shapes.unit(normals + 1e-4 * rng.normal(size=normals.shape))
    none = np.zeros_like(normals)
    first, second = tangents.across(none, normals), tangents.across(none, moved)
    np.testing.assert_allclose((first * normals).sum(-1), 0.0, atol=1e-12)
    # They turn by at most |d n| / (1 + z), with 1 + z above 0.1, and |d n| below 4e-4.
    assert np.linalg.norm(first - second, axis=-1).max() < 4e-3
    # On ends square to an axis they lie along an axis, however they are rounded.
    for end in np.concatenate([np.eye(3), -np.eye(3)]):
        rounded = shapes.unit(end + 1e-9 * rng.normal(size=(20, 3)))
        found = tangents.across(np.zeros((20, 3)), rounded)
        np.testing.assert_allclose(np.abs(found).max(axis=-1), 1.0, atol=1e-8)
        assert np.ptp(found, axis=0).max() < 1e-7


def test_scaling_the_texture_changes_nothing_and_turning_it_turns_the_tangents():
    vertices, faces, uv = arc(61)
    plain = meshes.build(vertices, faces, uv)
    along = tangents.from_texture(plain)
    scaled = tangents.from_texture(meshes.build(vertices, faces, uv * [7.0, 0.2] + 3.0))
    np.testing.assert_allclose(scaled, along, atol=1e-9)
    # A quarter turn of (u, v): what was -v is u now, and the new tangent is -y.
    turned = np.stack([-uv[:, 1], uv[:, 0]], axis=-1)
    across = tangents.from_texture(meshes.build(vertices, faces, turned))
    np.testing.assert_allclose(across, -np.cross(plain.normals, along), atol=1e-9)


def test_faces_without_texture_have_no_vote():
    vertices, faces, uv = arc(61)
    along = tangents.from_texture(meshes.build(vertices, faces, uv))
    # A vertex of the third face takes its neighbour's coordinates, which flattens faces.
    a, b, _ = faces[200]
    uv = uv.copy()
    uv[a] = uv[b]
    found = tangents.from_texture(meshes.build(vertices, faces, uv))
    touched = np.unique(faces[(faces == a).any(axis=-1)])
    others = np.setdiff1d(np.arange(len(vertices)), touched)
    np.testing.assert_allclose(found[others], along[others], atol=1e-12)
    assert np.isfinite(found).all()
    flat = meshes.build(vertices, faces, np.full_like(uv, 0.5))
    with pytest.raises(InputError, match="no face has an area in the texture"):
        tangents.from_texture(flat)
    with pytest.raises(InputError, match="no texture coordinates; expected a file with uv"):
        tangents.from_texture(meshes.build(vertices, faces))


def test_mirrored_halves_of_a_texture_do_not_cancel():
    x, y = np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9))
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    uv = np.stack([np.abs(x), y], -1).reshape(-1, 2)
    mesh = meshes.build(vertices, grid(9, 9), uv)
    along = tangents.from_texture(mesh)
    np.testing.assert_allclose(np.abs(along), np.broadcast_to([1.0, 0, 0], along.shape), atol=1e-12)
    seam = along[mesh.vertices[:, 0] == 0.0][:, 0]
    assert (seam == 1.0).sum() == (seam == -1.0).sum() == 9


def test_mesh_camera_and_light_may_be_turned_together(torus, rng):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    eye, up, axis = np.array([1.0, -4.0, 3.0]), (0.0, 0.0, 1.0), np.array([0.3, 0.2, 1.0])
    seen = meshes.view(torus, 100, eye=eye, up=up, field=tangents.around(torus, axis))
    other = meshes.build(torus.vertices @ turn.T, torus.faces)
    field = tangents.around(other, turn @ axis)
    turned = meshes.view(
        other,
        100,
        eye=turn @ eye,
        target=turn @ torus.centre,
        up=tuple(turn @ np.array(up)),
        field=field,
    )
    first, second = meshes.lit(seen, LIGHT), meshes.lit(turned, turn @ LIGHT)
    # Embree's float32 may decide otherwise on an edge.
    assert (seen.covered != turned.covered).mean() < 1e-3
    assert (first != second).mean() < 2e-3
    both = seen.covered & turned.covered
    for world in (LIGHT, seen.eye):
        local = seen.local(world)[both]
        there = turned.local(world @ turn.T)[both]
        error = np.linalg.norm(local - there, axis=-1)
        # But for the few samples that two neighbours on the outline share.
        assert np.quantile(error, 0.995) < 1e-9


def test_shadow_of_one_sphere_on_another():
    vertices, faces, _ = globe(121, 241)
    small, way = 0.45, 2.2
    both = meshes.build(
        np.concatenate([vertices, small * vertices + way * LIGHT]),
        np.concatenate([faces, faces + len(vertices)]),
    )
    eye = np.array([3.0, 0.5, 3.0])
    seen = meshes.view(both, 160, eye=eye, target=np.zeros(3), field_of_view_deg=30.0)
    large = seen.covered & (np.linalg.norm(seen.position, axis=-1) < 1.1)
    lit = meshes.lit(seen, LIGHT)
    # Distance of the ray to the light from the middle of the small sphere.
    miss = np.linalg.norm(np.cross(seen.position - way * LIGHT, LIGHT), axis=-1)
    facing = (seen.position * LIGHT).sum(-1)
    expected = (facing > 0.0) & (miss > small)
    # Facets of 1.5 degrees, 1e-4 under the spheres, and rays that start 3e-3 of the radius
    # (1.7) away, may differ within 0.01 of the shadow's edge; samples are 0.015 wide.
    clear = large & (np.abs(miss - small) > 0.01) & (np.abs(facing) > 0.02)
    assert expected[clear].any()
    assert (large & (facing > 0.1) & ~expected).sum() > 50
    np.testing.assert_array_equal(lit[clear], expected[clear])


def test_a_coarse_sphere_has_a_round_terminator():
    made = trimesh.creation.icosphere(subdivisions=2)
    mesh = meshes.build(np.asarray(made.vertices), np.asarray(made.faces))
    seen = meshes.view(mesh, 120, eye=np.array([0.0, 0.0, 4.0]))
    light = shapes.unit(np.array([1.0, 0.3, 0.4]))
    facing = (seen.normal * light).sum(-1)
    lit = meshes.lit(seen, light)
    # Facets of 18 degrees: from the faces themselves a fifth of the samples within 9 degrees
    # of the terminator would be dark.
    near = inner(seen.covered) & (facing > 0.0) & (facing < np.sin(np.radians(9.0)))
    assert lit[near].mean() > 0.97
    assert not lit[facing <= 0.0].any()


def test_nothing_seen_faces_away_and_there_are_no_holes():
    made = trimesh.creation.icosphere(subdivisions=1)
    coarse = meshes.build(np.asarray(made.vertices), np.asarray(made.faces), crease_deg=60.0)
    assert len(coarse.vertices) == 42
    seen = meshes.view(coarse, 200)
    assert ((seen.normal * seen.eye).sum(-1)[seen.covered] > 0.0).all()
    assert not seen.neutral.any()
    rows = seen.covered.any(axis=1)
    # A convex outline: each row is one run of samples.
    assert (np.abs(np.diff(np.pad(seen.covered, ((0, 0), (1, 1))), axis=1)).sum(1)[rows] == 2).all()


def test_creases_stay_sharp_and_smooth_bodies_smooth(ball):
    box = trimesh.creation.box()
    mesh = meshes.build(np.asarray(box.vertices), np.asarray(box.faces))
    assert len(mesh.vertices) == 24
    np.testing.assert_allclose(np.sort(np.abs(mesh.normals)), [[0.0, 0.0, 1.0]] * 24, atol=1e-12)
    rounded = meshes.build(np.asarray(box.vertices), np.asarray(box.faces), crease_deg=91.0)
    assert len(rounded.vertices) == 8
    # Three faces of equal angle: along the diagonals.
    np.testing.assert_allclose(np.abs(rounded.normals), 3**-0.5, atol=1e-12)
    # No normal of the sphere is split, at its seam and poles neither, and all are radial: a
    # mean over six symmetric triangles errs by the square of their 2 degrees.
    np.testing.assert_allclose(ball.normals, ball.vertices, atol=2e-3)


def test_tips_of_cones_keep_the_normals_of_their_faces():
    count = 48
    around = 2 * np.pi * np.arange(count) / count
    rim = np.stack([np.cos(around), np.sin(around), np.zeros(count)], -1)
    vertices = np.concatenate([rim, [[0.0, 0.0, 2.0]]])
    faces = np.stack([np.arange(count), np.roll(np.arange(count), -1), np.full(count, count)], -1)
    mesh = meshes.build(vertices, faces)
    tip = mesh.normals[mesh.vertices[:, 2] == 2.0]
    assert len(tip) == count
    # The mantle's normals rise by atan(1/2), but for facets of 7.5 degrees.
    np.testing.assert_allclose(tip[:, 2], np.sin(np.arctan(0.5)), atol=2e-3)


def test_winding_is_put_right():
    vertices, faces, _ = globe(31, 61)
    right = meshes.build(vertices, faces)
    inside_out = meshes.build(vertices, faces[:, ::-1])
    mixed = faces.copy()
    mixed[::3] = mixed[::3, ::-1]
    for mesh in (inside_out, meshes.build(vertices, mixed)):
        seen, expected = (meshes.view(m, 40, eye=np.array([0, 1.0, 4.0])) for m in (mesh, right))
        np.testing.assert_array_equal(seen.covered, expected.covered)
        np.testing.assert_allclose(seen.normal, expected.normal, atol=1e-9)
    # An open sheet has no outside: most of its faces decide.
    points, flat, _ = arc(61)
    few = flat.copy()
    few[::5] = few[::5, ::-1]
    np.testing.assert_allclose(
        meshes.build(points, few).normals, meshes.build(points, flat).normals, atol=1e-12
    )


def test_backs_are_neutral_and_backs_of_folds_are_looked_through():
    points, faces, _ = arc(61)
    behind = np.array([0.0, -2.0, -2.5])
    seen = meshes.view(meshes.build(points, faces), 64, eye=behind)
    assert seen.neutral.any()
    assert not seen.covered.any()
    assert not meshes.lit(seen, LIGHT).any()
    # A sheet of two layers a thousandth apart, each showing its front to one side.
    inward = 0.999 * points * [0.0, 1.0, 1.0] + points * [1.0, 0.0, 0.0]
    double = meshes.build(
        np.concatenate([inward, points]), np.concatenate([faces, faces[:, ::-1] + len(points)])
    )
    seen, closed = like_the_sheet(double, 64), shapes.sheet(64)
    both = inner(closed.covered & seen.covered)
    # Only past the inner layer's ends is nothing behind the back.
    assert both.sum() > 0.9 * closed.covered.sum()
    assert seen.neutral.sum() < 0.02 * closed.covered.sum()
    # Facets of 1.7 degrees, ends as above.
    assert np.linalg.norm(seen.normal - closed.normal, axis=-1)[both].max() < 0.02


@pytest.mark.parametrize(
    "up", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 2.0, 3.0)]
)
def test_the_default_camera_frames_the_mesh(torus, up):
    seen = meshes.view(torus, 100, up=up)
    shown = seen.covered | seen.neutral
    edges = [shown[0], shown[-1], shown[:, 0], shown[:, -1]]
    assert not any(edge.any() for edge in edges)
    rows, columns = np.flatnonzero(shown.any(1)), np.flatnonzero(shown.any(0))
    # The border is 4 % of half the picture on the tightest side.
    assert min(rows[0], columns[0], 99 - rows[-1], 99 - columns[-1]) <= 3
    # Up is upwards.
    above = seen.position[rows[0]][shown[rows[0]]] @ np.array(up)
    below = seen.position[rows[-1]][shown[rows[-1]]] @ np.array(up)
    assert above.min() > below.max()


def exported(folder, suffix):
    vertices, faces, uv = globe(13, 25)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.visual = trimesh.visual.TextureVisuals(uv=uv)
    path = folder / f"globe{suffix}"
    mesh.export(path)
    return path


@pytest.mark.parametrize("suffix", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_formats(suffix, tmp_path):
    found = meshes.load(exported(tmp_path, suffix))
    built = meshes.build(*globe(13, 25))
    # Degenerate faces at the poles are gone.
    assert len(found.faces) == len(built.faces) == 24 * 11 * 2
    assert (found.uv is not None) == (suffix in (".ply", ".obj", ".glb"))
    # Facets of 15 degrees share their normals at seam and poles, whatever the file repeats;
    # float32, or eight digits.
    y = np.array([0.0, 1.0, 0.0])
    seen, expected = (meshes.view(m, 40, field=tangents.around(m, y)) for m in (found, built))
    both = inner(seen.covered & expected.covered)
    assert (seen.covered != expected.covered).mean() < 2e-3
    np.testing.assert_allclose(seen.normal[both], expected.normal[both], atol=1e-5)


def test_scenes_are_taken_together(tmp_path):
    scene = trimesh.Scene()
    for x in (-2.0, 2.0):
        scene.add_geometry(
            trimesh.creation.box(), transform=trimesh.transformations.translation_matrix([x, 0, 0])
        )
    scene.export(tmp_path / "two.glb")
    mesh = meshes.load(tmp_path / "two.glb")
    assert len(mesh.faces) == 24
    np.testing.assert_allclose(np.ptp(mesh.vertices, axis=0), [5.0, 1.0, 1.0], atol=1e-6)


PLY = "ply\nformat ascii 1.0\nelement vertex 3\n"
PLY += "".join(f"property float {axis}\n" for axis in "xyz")
FACE = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
CORNERS = "0 0 0\n1 0 0\n0 1 0\n"

# name of the file, content (None: no file), what the message says
FILES = {
    "missing": ("gone.ply", None, "gone.ply: no such file"),
    "empty": ("a.ply", "", "the file is empty"),
    "suffix": ("a.fbx", "Kaydara", "suffixes .glb, .gltf, .obj, .off, .ply, .stl; found text"),
    "renamed": ("a.ply", "\x89PNG", r"a.ply: cannot be read as .ply \(Not a ply file!\); found"),
    "truncated": ("a.ply", PLY + FACE + "0 0 0\n", "a.ply: no faces; found 1 points"),
    "points": ("a.ply", PLY + "end_header\n" + CORNERS, "no faces; found 3 points, expected tri"),
    "no faces": ("a.stl", "solid a\nendsolid a\n", "no faces; found text starting with 'solid a"),
    "vertex": ("a.ply", PLY + FACE + CORNERS + "3 0 1 7\n", "a face names vertex 7; expected .* 2"),
    "negative": ("a.ply", PLY + FACE + CORNERS + "3 0 1 -1\n", "a face names vertex -1"),
    "flat": ("a.ply", PLY + FACE + CORNERS + "3 0 1 1\n", "none of the 1 faces has an area"),
    "NaN": ("a.ply", PLY + FACE + "0 0 0\n1 nan 0\n0 1 0\n3 0 1 2\n", "1 of 3 vertices are not fi"),
    "letters": (
        "a.obj",
        "v 0 0 0\nv 1 zero 0\nv 0 1 0\nf 1 2 3\n",
        "a.obj: cannot be read as .obj",
    ),
}


@pytest.mark.parametrize("case", FILES)
def test_unusable_files(case, tmp_path):
    name, content, match = FILES[case]
    if content is not None:
        (tmp_path / name).write_text(content, encoding="latin-1")
    with pytest.raises(InputError, match=match):
        meshes.load(tmp_path / name)


def test_unusable_arguments(ball):
    with pytest.raises(InputError, match="crease_deg=-1: expected degrees from 0 to 180"):
        meshes.build(ball.vertices, ball.faces, crease_deg=-1.0)
    with pytest.raises(InputError, match="texture coordinates are not finite"):
        meshes.build(ball.vertices, ball.faces, np.full((len(ball.vertices), 2), np.nan))
    with pytest.raises(InputError, match="field_of_view_deg=180: expected degrees above 0"):
        meshes.view(ball, 16, field_of_view_deg=180.0)
    with pytest.raises(InputError, match="direction must be a direction, finite and not 0"):
        meshes.viewpoint(ball, (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match=r"camera at 0,5,0 .* 0,1,0 upwards: expected different"):
        meshes.view(ball, 16, eye=np.array([0.0, 5.0, 0.0]), target=np.zeros(3))
    with pytest.raises(InputError, match=r"no sample of a camera at .* sees the mesh"):
        meshes.view(ball, 16, eye=np.array([0.0, 0.0, 5.0]), target=np.array([0.0, 0.0, 9.0]))
    with pytest.raises(InputError, match="direction must be finite and not 0; received"):
        tangents.from_direction(ball, np.zeros(3))
    with pytest.raises(InputError, match=r"one for each of .* vertices; received 4"):
        tangents.from_direction(ball, np.ones((4, 3)))
