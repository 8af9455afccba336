"""Meshes made by code against closed forms, and against the surfaces that they are of."""

import math

import numpy as np
import pytest
from scipy.interpolate import BPoly
from scipy.spatial import KDTree

from diffopt import InputError
from diffopt.materials import Lambert
from diffopt.scenes import (
    Camera,
    Object,
    Scene,
    blends,
    load_scene,
    meshfiles,
    models,
    newell,
    save_scene,
    shapes,
)
from diffopt.scenes.tables import SceneFileError
from diffopt.scenes.teapot_points import PATCHES, POINTS


def edges(mesh):
    """Edges as ordered pairs, and how often each is in its faces one way and either way."""
    ends = np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], -1).reshape(-1, 2)
    ordered, one = np.unique(ends, axis=0, return_counts=True)
    _, either = np.unique(np.sort(ends, axis=1), axis=0, return_counts=True)
    return ordered, one, either


def euler(mesh):
    return len(mesh.vertices) - len(edges(mesh)[2]) + len(mesh.faces)


def volume(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return (a * np.cross(b, c)).sum() / 6.0


def facing(mesh):
    """Cosines between the normals of faces and those of their vertices, [F, 3]."""
    return (
        meshfiles.face_normals(mesh.vertices[mesh.faces])[:, None] * mesh.normals[mesh.faces]
    ).sum(-1)


CLOSED = {
    "torus": (models.torus, 0, 0.95),
    "knot": (models.knot, 0, 0.85),
    # The tips of its ears are rounder than its faces are large.
    "rabbit": (models.rabbit, 2, 0.0),
}


@pytest.mark.parametrize("name", CLOSED)
def test_closed_models(name):
    make, characteristic, least = CLOSED[name]
    mesh = make()
    _, one, either = edges(mesh)
    assert (either == 2).all(), "open"
    assert (one == 1).all(), "wound against a neighbour"
    assert euler(mesh) == characteristic
    assert volume(mesh) > 0.0, "inside out"
    assert facing(mesh).min() > least
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=-1), 1.0, atol=1e-12)
    assert shapes.is_closed(mesh)
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


def test_torus_has_the_area_and_volume_of_its_closed_form():
    radius, tube = 1.3, 0.45
    mesh = models.torus(radius, tube, 256, 128)
    sides = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(
        np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=-1
    )
    # A polygon of n corners is smaller than its circle by (2 pi / n)^2 / 6: 4e-4 at 128.
    assert area.sum() == pytest.approx(4.0 * math.pi**2 * radius * tube, rel=1e-3)
    assert volume(mesh) == pytest.approx(2.0 * math.pi**2 * radius * tube**2, rel=1e-3)
    x, y, z = mesh.vertices.T
    np.testing.assert_allclose((np.hypot(x, y) - radius) ** 2 + z**2, tube**2, rtol=1e-12)


def trefoil(t, p=2, q=3, radius=1.0, swing=0.4):
    reach = radius + swing * np.cos(q * t)
    return np.array([reach * np.cos(p * t), reach * np.sin(p * t), swing * np.sin(q * t)])


def test_knot_is_everywhere_as_far_from_its_curve_as_its_tube():
    mesh = models.knot()
    t = np.linspace(0.0, 2.0 * math.pi, 40001)
    away, _ = KDTree(trefoil(t).T).query(mesh.vertices)
    # The points on the curve are some 3e-4 apart: (1.5e-4)^2 / 2 / 0.2 too far at most.
    np.testing.assert_allclose(away, 0.2, atol=1e-6)
    # The volume of a tube is its length times its cross section (Pappus); polygons of 80 corners
    # cut off 0.1 %, chords of the curve the rest.
    length = np.linalg.norm(np.diff(trefoil(t), axis=1), axis=0).sum()
    fine = models.knot(around=1024, across=80)
    assert volume(fine) == pytest.approx(math.pi * 0.2**2 * length, rel=3e-3)


def test_frame_of_a_knot_is_carried_without_turning():
    mesh = models.knot(around=400, across=12)
    normals = mesh.normals.reshape(400, 12, 3)
    step = np.roll(normals, -1, axis=0) - normals
    middle = mesh.vertices.reshape(400, 12, 3).mean(1)
    ahead = np.roll(middle, -1, axis=0) - middle
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    side = np.cross(ahead[:, None], normals)
    rate = (step * side).sum(-1)[:, 0]
    # What is left of a whole turn, even over the length: at most half a turn in all.
    assert abs(rate.sum()) < math.pi + 0.1
    # Even to the second order of the steps.
    assert np.ptp(rate) < 2e-3
    assert (
        np.linalg.norm(step[-1], axis=-1).max() < 1.5 * np.linalg.norm(step, axis=-1).mean() + 0.1
    )


def test_room_of_a_knot_is_where_strands_meet():
    # The strands of a trefoil with p = 1 lie on one ring: only its bends limit it.
    def bend(t):
        h = 1e-4
        one = (trefoil(t + h, 1, 1) - trefoil(t - h, 1, 1)) / (2.0 * h)
        two = (trefoil(t + h, 1, 1) - 2.0 * trefoil(t, 1, 1) + trefoil(t - h, 1, 1)) / h**2
        return np.linalg.norm(one) ** 3 / np.linalg.norm(np.cross(one, two))

    least = min(bend(t) for t in np.linspace(0.0, 2.0 * math.pi, 2000))
    with pytest.raises(InputError, match="tube must be below 0") as told:
        models.knot(1, 1, tube=5.0)
    assert float(str(told.value).split()[4].rstrip(",")) == pytest.approx(least, rel=1e-3)
    # Opposite strands of the trefoil are 2 s apart where it is s below and above the ring.
    with pytest.raises(InputError, match=r"tube must be below 0\.4, or the knot meets itself"):
        models.knot(tube=0.41)


def bezier(u, v, control):
    """A point of a patch and its derivatives, by scipy's polynomials in Bernstein form."""
    rows = [BPoly(row[:, None, :], [0.0, 1.0]) for row in control]
    points = np.array([row(v) for row in rows])
    slopes = np.array([row.derivative()(v) for row in rows])
    along = BPoly(points[:, None, :], [0.0, 1.0])
    return along(u), along.derivative()(u), BPoly(slopes[:, None, :], [0.0, 1.0])(u)


def test_teapot_lies_on_its_patches():
    found = newell.grid(4)
    at = np.linspace(0.0, 1.0, 5)
    for number, control in enumerate(POINTS[PATCHES]):
        for i, u in enumerate(at):
            for j, v in enumerate(at):
                place, along, across = bezier(u, v, control)
                np.testing.assert_allclose(found.points[number, i, j], place, atol=1e-13)
                normal = np.cross(across, along)
                length = np.linalg.norm(normal)
                if length > 1e-9:
                    np.testing.assert_allclose(
                        found.normals[number, i, j], normal / length, atol=1e-11
                    )


def test_normals_of_the_teapot_go_over_into_those_at_its_points():
    control = POINTS[PATCHES]
    single = np.flatnonzero(np.ptp(control[:, 0], axis=1).max(-1) == 0.0)
    assert len(single) == 8  # knob and bottom
    found = newell.grid(4).normals
    for number in single:
        for j, v in enumerate(np.linspace(0.0, 1.0, 5)):
            _, along, across = bezier(1e-6, v, control[number])
            near = np.cross(across, along)
            # The curvature is at most some 10 at a distance of 1e-6.
            np.testing.assert_allclose(found[number, 0, j], near / np.linalg.norm(near), atol=3e-5)


@pytest.mark.parametrize("divisions", [2, 5, 8, 16])
def test_teapot_is_four_surfaces_of_one_winding(divisions):
    mesh = models.teapot(divisions)
    _, one, either = edges(mesh)
    assert (one == 1).all()
    assert either.max() == 2
    # Circles of 4 patches at rim and lid, of 2 at the ends of handle and spout.
    assert (either == 1).sum() == 16 * divisions
    # Body and lid are discs, handle and spout are open tubes.
    assert euler(mesh) == 2
    n = divisions
    # 4 n columns of 4 and 2 patches that end in a point; 2 n columns of 2 patches, both sides.
    assert len(mesh.vertices) == 4 * n * 4 * n + 1 + 4 * n * 2 * n + 1 + 2 * 2 * n * (2 * n + 1)
    sides = mesh.vertices[mesh.faces]
    area = np.linalg.norm(np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0]), axis=-1)
    assert area.min() > 1e-6
    assert len(mesh.faces) == 64 * n * n - 8 * n
    if n >= 8:
        assert facing(mesh).min() > 0.2


def test_teapot_points_outwards():
    mesh = models.teapot()
    x, y, z = mesh.vertices.T
    # Where the surface runs around the axis it looks away from it, but for the lip and the lid.
    belly = (np.hypot(x, y) < 2.0 + 1e-9) & (z > 0.2) & (z < 2.3) & (np.abs(x) < 1.2)
    assert belly.sum() > 100
    assert ((mesh.normals * mesh.vertices)[belly, :2].sum(-1) > 0.0).all()
    np.testing.assert_allclose(mesh.normals[np.argmax(z)], [0.0, 0.0, 1.0], atol=1e-12)
    middle = np.flatnonzero((np.hypot(x, y) < 1e-9) & (z < 1e-9))
    assert len(middle) == 1
    np.testing.assert_allclose(mesh.normals[middle[0]], [0.0, 0.0, -1.0], atol=1e-12)
    # The handle's outer side looks away from the pot, the spout's lower side downwards.
    assert mesh.normals[np.argmin(x)][0] < -0.9
    assert mesh.normals[np.argmax(x)][0] > 0.0
    assert (z.min(), z.max()) == (0.0, 3.15)


def test_rabbit_lies_on_its_surface():
    mesh = models.rabbit()
    assert 2400 < len(mesh.vertices) < 2800
    # Newton's steps end at rounding.
    np.testing.assert_allclose(blends.field(blends.RABBIT, mesh.vertices), 0.0, atol=1e-13)
    h = 1e-5
    slope = np.stack(
        [
            (
                blends.field(blends.RABBIT, mesh.vertices + step)
                - blends.field(blends.RABBIT, mesh.vertices - step)
            )
            for step in h * np.eye(3)
        ],
        -1,
    )
    slope /= np.linalg.norm(slope, axis=-1, keepdims=True)
    # Differences of second order, h^2 times the third derivative of fillets 0.05 wide.
    np.testing.assert_allclose(mesh.normals, slope, atol=1e-6)
    # On its feet, and the same on both sides.
    assert abs(mesh.vertices[:, 2].min()) < 5e-3
    mirrored = mesh.vertices * [1.0, -1.0, 1.0]
    np.testing.assert_allclose(blends.field(blends.RABBIT, mirrored), 0.0, atol=1e-12)
    # No slivers, by a margin below the 20 degrees and more that it has.
    assert np.degrees(meshfiles.corner_angles(mesh.vertices[mesh.faces]).min()) > 12.0


@pytest.mark.parametrize("detail", [24, 40, 56])
def test_rabbit_of_any_detail_is_a_sphere(detail):
    assert euler(models.rabbit(detail)) == 2


def test_blend_of_one_ball_is_that_ball():
    ball = blends.Blend((blends.Ellipsoid(0.3, -0.2, (0.7, 0.7, 0.7)),), 0.05)
    mesh = blends.build(ball, 32)
    np.testing.assert_allclose(mesh.vertices, [0.3, 0.0, -0.2] + 0.7 * mesh.normals, atol=1e-12)
    # Faces cut off about (edge / radius)^2 / 4.
    assert volume(mesh) == pytest.approx(4.0 / 3.0 * math.pi * 0.7**3, rel=0.01)


BAD = {
    "teapot": (lambda: models.teapot(1), "divisions must be a whole number from 2 to 64; rec.* 1"),
    "torus": (lambda: models.torus(0.5, 0.5), "tube must be below radius"),
    "thin": (lambda: models.torus(tube=0.0), "tube must be a length above 0; received 0"),
    "few": (lambda: models.torus(across=2), "across must be a whole number from 3 to 1024"),
    "link": (lambda: models.knot(2, 4), "p and q must have no common divisor; received 2 and 4"),
    "swing": (lambda: models.knot(swing=1.5), "swing must be below radius; received 1.5 and 1"),
    "turns": (lambda: models.knot(0, 1), "p must be a whole number from 1 to 32; received 0"),
    "rabbit": (lambda: models.rabbit(500), "detail must be a whole number from 24 to 128"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_parameters(case):
    make, text = BAD[case]
    with pytest.raises(InputError, match=text):
        make()


def test_models_in_files(tmp_path):
    made = [
        models.teapot(3),
        models.torus(2.0, 0.5, 12, 8),
        models.knot(3, 2, tube=0.1, around=64, across=6),
        models.rabbit(24),
    ]
    path = tmp_path / "scene.toml"
    save_scene(Scene([Object(mesh, Lambert()) for mesh in made]), Camera(), path)
    read = load_scene(path).scene.objects
    for mesh, one in zip(made, read, strict=True):
        again = one.place.shape
        np.testing.assert_array_equal(mesh.vertices, again.vertices)
        np.testing.assert_array_equal(mesh.faces, again.faces)
        np.testing.assert_array_equal(mesh.normals, again.normals)


def test_equal_models_of_a_file_are_one_mesh(tmp_path):
    path = tmp_path / "scene.toml"
    pot = '[[objects]]\nshape = "teapot"\ndivisions = 2\nmaterial = "lambert"\n'
    path.write_text(pot + pot)
    first, second = load_scene(path).scene.objects
    assert first.place.shape is second.place.shape


FAULTS = {
    "range": ('"teapot"\ndivisions = 1', "divisions: must be a whole number from 2 to 64; rec"),
    "whole": ('"rabbit"\ndetail = 30.5', "detail: expected a whole number; received 30.5"),
    "kind": ('"torus"\naround = "many"', "around: expected a number; received 'many'"),
    "other": ('"torus"\ndetail = 3', "detail: a torus has no detail; it has radius, tube, aro"),
    "between": ('"torus"\nradius = 1\ntube = 2', "tube: must be below radius"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_of_models_in_files(case, tmp_path):
    shape, text = FAULTS[case]
    path = tmp_path / "scene.toml"
    path.write_text(f'[[objects]]\nmaterial = "lambert"\nshape = {shape}\n')
    with pytest.raises(SceneFileError, match=text):
        load_scene(path)
