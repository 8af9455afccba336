"""What rays of vertices bring: against closed forms, and against path tracing in NumPy."""

import numpy as np
import pytest
from transfer_cases import (
    LAMBERT,
    ball,
    ceiling,
    hemisphere_rule,
    lifted,
    looking,
    surroundings,
    unit,
)

import diffopt as do
from diffopt.scenes.shapes import Box, Plane
from diffopt.scenes.transforms import rotate, translate
from diffopt.transfer import tracing, weighting

UP = [[0.0, 0.0, 1.0]]
RAYS = weighting.spiral(4096)
COSINE = RAYS[:, 2] * 2.0 / len(RAYS)  # weights of sum 1


def brought(around, vertices, depth=2, rays=RAYS, seed=0):
    return tracing.columns(around, vertices, rays, depth, seed).astype(np.float64)


@pytest.mark.parametrize("angle", [0.0, 30.0, -50.0])
@pytest.mark.parametrize("backend", ["embree", "jax"])
def test_under_the_edge_of_a_half_plane(angle, backend):
    """Directions between the edge and the horizon are hidden: a wedge."""
    far, edge = 300.0, np.tan(np.radians(angle))
    roof = do.Object(Plane(2.0 * far, 2.0 * far), LAMBERT(0.5), ceiling(1.0, 1.0, far + edge))
    around = surroundings([roof], backend)
    found = brought(around, looking(*UP), depth=1)[0]
    assert not found[:, 4:].any()  # direct light alone
    # Rays begin above the surface.
    rise = np.arctan2(edge, 1.0 - around.caster.offset)
    # As many rays as points of a spiral in a wedge; the roof's ends hide 2e-3 less.
    assert abs(found[:, 0].mean() - (0.5 + rise / np.pi)) < 4e-3
    # Projected onto the ground the edge is half an ellipse; the ends hardly count.
    assert abs((found[:, 0] * COSINE).sum() - 0.5 * (1.0 + np.sin(rise))) < 2e-3
    towards = found[:, 1:4]
    np.testing.assert_array_equal(towards, found[:, :1] * RAYS.astype(np.float32))


def slab(origin, towards, low, high):
    """Whether rays meet a box: Kay and Kajiya's slabs, in float64."""
    with np.errstate(divide="ignore"):
        ends = (np.stack([low, high])[:, None] - origin) / towards
    near, far = ends.min(0).max(-1), ends.max(0).min(-1)
    return (near < far) & (far > 0.0)


def test_a_box_on_a_plane(rng):
    """Visibility against slabs, from places on the ground and above it, looking anywhere."""
    box = do.Object(Box((1.0, 2.0, 0.8)), LAMBERT(0.5), translate(0.0, 0.0, 0.4))
    floor = do.Object(Plane(40.0, 40.0), LAMBERT(0.5))
    at = np.concatenate([rng.uniform(-2.5, 2.5, (12, 2)), rng.uniform(0.9, 2.0, (12, 1))], 1)
    at[:4, 2] = 0.0
    outside = np.abs(at[:, 0]) > 0.5
    at[:4, 0] += np.where(outside[:4], 0.0, 1.5)
    looks = np.concatenate([np.tile(UP, (4, 1)), unit(rng.normal(size=(8, 3)))])
    vertices = looking(*looks, at=at)
    found = brought(surroundings([floor, box]), vertices, depth=1)[..., 0]
    for k in range(12):
        towards = RAYS @ vertices.axes[k]
        met = slab(at[k] + 1e-4 * looks[k], towards, [-0.5, -1.0, 0.0], [0.5, 1.0, 0.8])
        down = towards[:, 2] < -at[k, 2] / 25.0  # more than that misses the floor at its rim
        met = met | (down if at[k, 2] else False)
        level = np.abs(towards[:, 2]) < 0.15 if at[k, 2] else np.zeros(len(RAYS), bool)
        # Rays within rounding of an edge may fall on either side: some 4096 * 1e-4.
        assert (met[~level] == (found[k][~level] == 0.0)).mean() > 0.999


def rectangle(a, b, c):
    """Form factor of a small surface to a parallel rectangle [0, a] x [0, b] at a distance."""
    x, y = a / c, b / c
    one, two = np.sqrt(1.0 + x * x), np.sqrt(1.0 + y * y)
    return (x / one * np.arctan(y / one) + y / two * np.arctan(x / two)) / (2.0 * np.pi)


def onto_square(x, y, half, distance):
    """Form factor from places above a square about the origin to it."""
    total = 0.0
    for sx in (1.0, -1.0):
        for sy in (1.0, -1.0):
            total = total + rectangle(half + sx * x, half + sy * y, distance)
    return total


def test_light_between_parallel_planes():
    """From the ceiling back: what does not fall onto the floor escapes."""
    half, height, albedo = 1.0, 0.8, 0.7
    floor = do.Object(Plane(2.0 * half, 2.0 * half), LAMBERT(0.5))
    roof = do.Object(Plane(2.0 * half, 2.0 * half), LAMBERT(albedo), ceiling(1.0, height))
    found = brought(surroundings([floor, roof]), looking(*UP))[0]
    x, y = (RAYS[:, k] / RAYS[:, 2] * height for k in (0, 1))
    under = (np.abs(x) < half) & (np.abs(y) < half)
    assert (under == (found[:, 0] == 0.0)).mean() > 0.999
    # The hemisphere sees the ceiling by the form factor of its middle.
    hidden = ((found[:, 0] == 0.0) * COSINE).sum()
    np.testing.assert_allclose(hidden, onto_square(0.0, 0.0, half, height), atol=2e-3)
    back = onto_square(x[under], y[under], half, height)
    expected = (albedo * (1.0 - back) * COSINE[under]).sum()
    # One direction for each ray, that escapes or does not.
    deviation = albedo * np.sqrt((back * (1.0 - back) * COSINE[under] ** 2).sum())
    energy = (found[:, 4] * COSINE).sum()
    assert abs(energy - expected) < 4.0 * deviation
    assert deviation < 0.05 * expected
    # It leaves downwards, past the rim of the floor.
    lit = found[:, 4] > 0.0
    assert (found[lit, 7] < 0.0).all()
    assert not found[:, 8:].any()


def test_a_ceiling_alone_reflects_all_that_meets_it(rng):
    """Without a floor all that the ceiling reflects escapes, in directions by the cosine."""
    white = (0.9, 0.5, 0.1)
    roof = do.Object(Plane(60.0, 60.0), LAMBERT(white), ceiling(1.0, 1.0))
    found = brought(surroundings([roof]), looking(*UP))[0]
    hidden = found[:, 0] == 0.0
    np.testing.assert_allclose(found[hidden, 4:7], np.tile(white, (hidden.sum(), 1)), rtol=1e-6)
    mean = found[hidden, 7:10].mean(0) / 0.5
    # Mean cosine 2/3; components along the plane have the variance 1/4, the cosine 1/18.
    np.testing.assert_allclose(mean, [0.0, 0.0, -2.0 / 3.0], atol=4.0 * 0.5 / np.sqrt(hidden.sum()))


def test_glossy_and_diffuse_terms_are_kept_apart():
    """Each column has the albedo of its term, at the angle of the ray."""
    glossy = do.BlinnPhong((0.6, 0.3, 0.1), 20.0)
    roof = do.Object(Plane(60.0, 60.0), LAMBERT(0.3) + glossy, ceiling(1.0, 1.0))
    found = brought(surroundings([roof]), looking(*UP))[0]
    hidden = found[:, 0] == 0.0
    np.testing.assert_allclose(found[hidden, 4:7], 0.3, rtol=1e-6)
    d, solid = hemisphere_rule(100, 200)
    angles = np.linspace(0.05, 0.5 * np.pi - 0.05, 12)
    wo = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)
    albedo = [np.asarray(glossy.f(d, np.tile(w, (len(d), 1)))).T @ (d[:, 2] * solid) for w in wo]
    z = RAYS[hidden, 2]
    expected = np.stack([np.interp(np.arccos(z), angles, a) for a in np.transpose(albedo)], -1)
    got = found[hidden, 10:13]
    error = (got - expected) / expected.max()
    # One direction for each ray; their deviation is below that of weights of 0 to 2.
    np.testing.assert_allclose(
        error.mean(0), 0.0, atol=4.0 * error.std(0).max() / hidden.sum() ** 0.5
    )


def twin(rays, seed_count, rng, depth, albedo, height, half):
    """Mean weight of paths that escape from between two squares, in NumPy; cosine-weighted."""
    n = len(rays) * seed_count
    towards = np.repeat(rays, seed_count, axis=0)
    place = np.zeros((n, 3))
    weight = np.repeat(COSINE, seed_count) / seed_count
    out = []
    for bounce in range(depth + 1):
        up = towards[:, 2] > 0.0
        far = np.where(up, height - place[:, 2], place[:, 2]) / np.maximum(
            np.abs(towards[:, 2]), 1e-12
        )
        met = place + far[:, None] * towards
        on = (np.abs(met[:, :2]) < half).all(-1)
        out.append(weight[~on].sum())
        if bounce == depth:
            break
        place, up, weight = met[on], up[on], weight[on] * np.where(up[on], albedo[1], albedo[0])
        place[:, 2] = np.where(up, height, 0.0)
        u = rng.random((len(place), 2))
        across, turn = np.sqrt(u[:, 0]), 2.0 * np.pi * u[:, 1]
        z = np.sqrt(1.0 - u[:, 0]) * np.where(up, -1.0, 1.0)
        towards = np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)
    return out


@pytest.mark.parametrize("depth", [1, 2, 3, 6])
def test_depth_counts_surfaces(depth, rng):
    """Light of all orders between two squares, against paths in NumPy."""
    half, height, albedo = 1.0, 0.8, (0.9, 0.6)
    floor = do.Object(Plane(2.0 * half, 2.0 * half), LAMBERT(albedo[0]))
    roof = do.Object(Plane(2.0 * half, 2.0 * half), LAMBERT(albedo[1]), ceiling(1.0, height))
    around = surroundings([floor, roof])
    found = brought(around, looking(*UP), depth)[0]
    parts = twin(RAYS, 20, rng, depth - 1, albedo, height, half)
    np.testing.assert_allclose((found[:, 0] * COSINE).sum(), parts[0], atol=2e-3)
    # Weights of rays below 1, a deviation below 1/2 of each; the twin has 20 times as many.
    deviation = 0.5 * np.sqrt((COSINE**2).sum())
    assert abs((found[:, 4] * COSINE).sum() - sum(parts[1:])) < 4.0 * deviation


def test_no_more_than_all_light_arrives():
    """White bodies about a place: what comes directly and by way of them is 1 at most."""
    white = LAMBERT(0.5) + do.BlinnPhong(0.5, 10.0)
    objects = [
        do.Object(Plane(6.0, 6.0), LAMBERT(1.0)),
        do.Object(Plane(3.0, 3.0), white, ceiling(1.0, 1.0)),
        do.Object(Box((0.5, 0.5, 0.5)), LAMBERT(1.0), translate(1.0, 0.3, 0.25)),
        do.Object(ball(2, 0.3), white, translate(-0.7, -0.2, 0.3)),
    ]
    vertices = looking(*np.tile(UP, (3, 1)), at=[[0, 0, 0], [0.4, -0.3, 0], [-1.2, 0.5, 0]])
    around, before = surroundings(objects), np.zeros(3)
    for depth in (1, 2, 4, 8):
        found = brought(around, vertices, depth)
        total = found[..., 0] + found[..., 4] + found[..., 8]
        energy = (total * COSINE).sum(-1)
        # The noise of weights that may be 2 and more beyond the second surface.
        error = np.sqrt(((total - total.mean(-1, keepdims=True)) ** 2 * COSINE**2).sum(-1))
        assert (energy < 1.0 + 4.0 * error).all()
        # The longest paths are the last ones to come.
        assert (energy > before).all()
        before = energy
        # First moments are no longer than their weights.
        for first in (4, 8):
            length = np.linalg.norm(found[..., first + 1 : first + 4], axis=-1)
            assert (length <= 1.0001 * found[..., first]).all()


def test_convex_bodies_hide_nothing_of_themselves():
    box = do.Object(Box((1.0, 2.0, 3.0)), LAMBERT(0.5), rotate((1.0, 2.0, 0.5), 25.0))
    patch = box.patch
    around = surroundings([box])
    corners = patch.vertices[patch.faces]
    inside = np.array([[0.2, 0.3, 0.5], [0.01, 0.98, 0.01]])
    places = (inside @ corners).reshape(-1, 3)
    normals = np.repeat(patch.normals[patch.faces[:, 0]], 2, axis=0)
    found = brought(around, looking(*normals, at=places))
    assert (found[..., 0] == 1.0).all()
    assert not found[..., 4:].any()
    # A ray that runs within a face, from its corner, meets it by rounding: 4 in 10^5.
    found = brought(around, looking(*patch.normals, at=patch.vertices))
    assert found[..., 0].mean() > 0.9999
    assert found[..., 4:].sum() < 10.0


def test_a_smoothed_ball_hides_what_is_below_its_faces():
    """Rays that begin under a face count as hidden, and are not reflected by it."""
    one = do.Object(ball(1), LAMBERT(1.0))
    patch = one.patch
    vertices = looking(*patch.normals, at=patch.vertices)
    found = brought(surroundings([one]), vertices)
    assert not found[..., 4:].any()
    # Faces slope by 18 degrees at most under the tangent plane of a corner: none are hidden.
    assert found[..., 0].mean() > 0.999


def test_inside_of_a_closed_box_is_dark():
    """No path escapes, however deep: zeros, all finite; also inside of a body."""
    room = do.Object(Box((4.0, 4.0, 4.0)), LAMBERT(1.0))
    thing = do.Object(ball(1, 0.5), LAMBERT(0.5) + do.BlinnPhong(0.5, 30.0))
    vertices = looking(
        UP[0], [1.0, 0.2, -0.3], [0.0, -1.0, 0.0], at=[[0, 0, 1.0], [1, 1, 1], [0, 0, 0]]
    )
    found = brought(surroundings([room, thing]), vertices, depth=4)
    assert not found.any()


def test_a_ray_tracer_on_any_device_sees_the_same():
    objects = [
        do.Object(Plane(6.0, 6.0), LAMBERT((0.8, 0.5, 0.2))),
        do.Object(
            Box((0.5, 0.5, 0.5)), LAMBERT(0.4) + do.BlinnPhong(0.4, 30.0), translate(0.6, 0.2, 0.3)
        ),
        do.Object(ball(1, 0.4), do.BlinnPhong(0.7, 100.0), lifted(1.1)),
    ]
    vertices = looking(*np.tile(UP, (2, 1)), at=[[0, 0, 0], [0.2, -0.5, 0]])
    rays = weighting.spiral(1024)
    one, other = (
        brought(surroundings(objects, backend), vertices, 2, rays) for backend in ("embree", "jax")
    )
    # Rays within rounding of an edge fall on either side.
    same = np.isclose(one, other, rtol=1e-3, atol=1e-4).all(-1)
    assert same.mean() > 0.997
    assert one[..., 4:].any()


def test_the_same_numbers_for_all_vertices_and_runs():
    """Noise is no difference between neighbours; the seed chooses it."""
    roof = do.Object(Plane(60.0, 60.0), LAMBERT(0.5), ceiling(1.0, 1.0))
    around = surroundings([roof, do.Object(Plane(1.0, 1.0), LAMBERT(0.5), lifted(0.3))])
    vertices = looking(*np.tile(UP, (3, 1)), at=[[4.0, 4.0, 0], [4.0, 4.0, 0], [-4.0, 3.0, 0]])
    rays = weighting.spiral(512)
    found = brought(around, vertices, 3, rays)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(
        found[2:], brought(around, type(vertices)(*(a[2:] for a in vertices)), 3, rays)
    )
    np.testing.assert_array_equal(found, brought(around, vertices, 3, rays))
    assert (found != brought(around, vertices, 3, rays, seed=1)).any()


def test_black_surfaces_reflect_nothing():
    roof = do.Object(Plane(60.0, 60.0), LAMBERT(0.0), ceiling(1.0, 1.0))
    found = brought(surroundings([roof]), looking(*UP), 4)[0]
    assert not found[:, 4:].any()
    assert np.isfinite(found).all()
