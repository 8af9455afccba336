"""Local frames of the lit objects against closed-form geometry."""

import numpy as np
import pytest

from diffopt.drawing import shapes
from diffopt.errors import InputError

VIEWS = {
    "sphere": lambda size: shapes.sphere(size),
    "sheet": lambda size: shapes.sheet(size),
    "disc": lambda size: shapes.disc(size),
    "turned sheet": lambda size: shapes.sheet(size).turned(0.7),
}


@pytest.fixture(params=VIEWS)
def view(request):
    return VIEWS[request.param](64)


def test_frames_are_orthonormal(view):
    seen = view.covered
    tangent, normal, eye = view.tangent[seen], view.normal[seen], view.eye[seen]
    # Roundoff of a handful of float64 operations.
    for vectors in (tangent, normal, eye):
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose((tangent * normal).sum(-1), 0.0, atol=1e-12)


def test_local_directions_keep_lengths_and_know_the_normal(view, rng):
    seen = view.covered
    world = shapes.unit(rng.normal(size=3))
    local = view.local(world)[seen]
    np.testing.assert_allclose(np.linalg.norm(local, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(local[:, 2], view.normal[seen] @ world, atol=1e-12)
    axes = [view.local(v)[seen] for v in (view.tangent, view.normal)]
    np.testing.assert_allclose(axes[0], np.broadcast_to([1.0, 0, 0], axes[0].shape), atol=1e-12)
    np.testing.assert_allclose(axes[1], np.broadcast_to([0.0, 0, 1], axes[1].shape), atol=1e-12)


def test_frames_are_right_handed(view):
    x, z = view.tangent, view.normal
    y = np.cross(z, x)
    local = view.local(y)[view.covered]
    np.testing.assert_allclose(local, np.broadcast_to([0.0, 1, 0], local.shape), atol=1e-12)


def test_every_object_faces_its_camera(view):
    assert 0.1 < view.covered.mean() < 0.95
    assert (view.local(view.eye)[view.covered][:, 2] > 0).all()
    assert not (view.covered & view.neutral).any()
    edges = [view.covered[0], view.covered[-1], view.covered[:, 0], view.covered[:, -1]]
    assert not any(edge.any() for edge in edges), "the object is cut off by the frame"


def test_sphere_shows_the_normal_of_each_pixel():
    view = shapes.sphere(50, margin=0.0)
    # Pixel centres at (i + 1/2) / 25 - 1, rows downwards.
    x, y = (30.5 / 25 - 1), -(10.5 / 25 - 1)
    np.testing.assert_allclose(view.normal[10, 30], [x, y, np.sqrt(1 - x * x - y * y)])
    # Of a square that just holds the circle pi/4 is covered; 50 pixels give it to a percent.
    assert view.covered.mean() == pytest.approx(np.pi / 4, rel=0.01)
    # Tangents run along the parallels: level, and to the right in the middle.
    assert np.abs(view.tangent[..., 1]).max() == 0
    assert view.tangent[25, 25, 0] > 0.99


def test_sheet_lies_on_its_cylinder_and_on_the_rays():
    eye = (1.0, 2.0, 3.0)
    view = shapes.sheet(64, bend_deg=80.0, width=0.8, eye=eye)
    seen = view.covered
    position = view.position[seen]
    np.testing.assert_allclose(np.hypot(position[:, 1], position[:, 2]), 1.0, atol=1e-12)
    assert np.abs(position[:, 0]).max() <= 0.8
    angle = np.degrees(np.arctan2(position[:, 1], position[:, 2]))
    assert angle.min() >= 20.0
    assert angle.max() <= 100.0
    # The camera is where the rays towards it lead.
    np.testing.assert_allclose(view.towards(np.array(eye))[seen], view.eye[seen], atol=1e-12)


def test_disc_has_radial_tangents_a_hub_and_a_hole():
    view = shapes.disc(400, eye=(0.0, 0.0, 4000.0))
    radius = np.hypot(view.position[..., 0], view.position[..., 1])
    assert np.abs(view.position[..., 2]).max() < 1e-9
    low, high = shapes.RECORDED_RADII
    np.testing.assert_array_equal(view.covered, (radius >= low) & (radius <= high))
    np.testing.assert_allclose(
        (view.tangent * view.position).sum(-1)[view.covered], radius[view.covered], rtol=1e-12
    )
    assert not view.neutral[radius < shapes.HOLE_RADIUS].any()
    # Areas of the rings; 400 pixels give them to half a percent.
    ratio = view.covered.sum() / view.neutral.sum()
    hub_and_rim = low**2 - shapes.HOLE_RADIUS**2 + shapes.DISC_RADIUS**2 - high**2
    assert ratio == pytest.approx((high**2 - low**2) / hub_and_rim, rel=5e-3)


def test_turning_the_material_puts_a_direction_on_the_old_x_axis():
    view = shapes.sheet(32)
    turned = view.turned(np.radians(30.0))
    local = turned.local(view.tangent)[view.covered]
    expected = [np.cos(np.radians(30.0)), np.sin(np.radians(30.0)), 0.0]
    np.testing.assert_allclose(local, np.broadcast_to(expected, local.shape), atol=1e-12)


@pytest.mark.parametrize("name", ["sphere", "sheet", "disc"])
def test_wide_frames_show_the_square_picture_in_their_middle(name):
    make = getattr(shapes, name)
    square = make(36)
    for size, part in (((36, 64), np.s_[:, 14:50]), ((50, 36), np.s_[7:43, :])):
        wide = make(size)
        assert wide.covered.shape == size
        assert wide.covered.sum() >= square.covered.sum()
        for field in ("position", "tangent", "normal", "eye"):
            # Roundoff: the square pixels are counted from other ends.
            np.testing.assert_allclose(
                getattr(wide, field)[part], getattr(square, field), atol=1e-9, err_msg=field
            )
        np.testing.assert_array_equal(wide.covered[part], square.covered)


def test_a_camera_needs_a_direction():
    eye = np.array([0.0, 3.0, 0.0])
    with pytest.raises(InputError, match=r"a camera at 0,3,0 that looks at 0,0,0 with 0,1,0 up"):
        shapes.camera(8, eye, np.zeros(3), half_width=1.0)
    with pytest.raises(InputError, match="expected different places"):
        shapes.axes(eye, eye, np.array([0.0, 0.0, 1.0]))
    axes = shapes.axes(eye, np.array([0.0, 0.0, 2.0]), np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    np.testing.assert_allclose(axes[2], shapes.unit(np.array([0.0, 3.0, -2.0])), atol=1e-12)
    assert axes[1, 1] > 0.0


def test_unusable_geometry_is_refused():
    with pytest.raises(InputError, match="bend_deg=200: expected degrees above 0, at most 180"):
        shapes.sheet(16, bend_deg=200.0)
    with pytest.raises(InputError, match="expected a camera above the disc"):
        shapes.disc(16, eye=(0.0, 100.0, -1.0))
    with pytest.raises(InputError, match="size=1: expected at least 2"):
        shapes.sphere(1)
    with pytest.raises(InputError, match=r"size=\(1, 9\): expected at least 2"):
        shapes.sphere((1, 9))
