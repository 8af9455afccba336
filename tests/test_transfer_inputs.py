"""Hard and bad scenes, lights and settings of precomputed transfer."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but
from transfer_cases import LAMBERT, ball, grid, lifted, reflector, unit

import diffopt as do
from diffopt import InputError
from diffopt.kernels import quadrature, vmf
from diffopt.materials import Mirror
from diffopt.scenes import Environment, LobeEnvironment, meshfiles
from diffopt.scenes.channels import Channels
from diffopt.scenes.shapes import Box, Disc, Plane, Sphere
from diffopt.scenes.transforms import translate
from diffopt.transfer import between, reflectors, relighting
from diffopt.transfer.lighting import prepare
from diffopt.transfer.precomputation import precompute
from diffopt.transfer.raster import Raster
from diffopt.transfer.settings import TransferSettings

RGB = Channels()
LEAST = TransferSettings(rays=256, finest=1, coarsest=0, splits=0, depth=2)
GLOSSY = LAMBERT(0.4) + do.BlinnPhong(0.5, 20.0)
CAMERA = do.Camera((0.0, -4.0, 2.0), (0.0, 0.0, 0.3), resolution=(16, 16))


def shown(objects, light, settings=LEAST, camera=CAMERA):
    """Its transfer and picture under light."""
    found = precompute(do.Scene(objects), settings)
    seen = Raster(found.mesh.vertices, found.triangles)(camera)
    return found, np.asarray(between.picture(relighting.tables(found), light, seen))


@pytest.fixture(scope="module")
def even():
    return prepare([Environment(1.0)], RGB)


def finite(found):
    parts = [*found.views, *found.diffuse, found.error, found.axes]
    return all(np.isfinite(a).all() for a in parts)


def test_no_path_leaves_a_closed_box(even):
    """Bodies in a room without windows, one of them touching its wall: dark, and finite.

    Paths over one surface are among those over four.
    """
    objects = [
        do.Object(Box((6.0, 6.0, 6.0)), LAMBERT(0.9), name="room"),
        do.Object(ball(1, 0.5), GLOSSY, name="ball"),
        do.Object(ball(0, 0.5), GLOSSY, translate(0.0, 0.0, -3.0), name="in the wall"),
    ]
    settings = dataclasses.replace(LEAST, depth=4, finest=2, splits=1)
    found, picture = shown(
        objects, even, settings, dataclasses.replace(CAMERA, eye=(0.0, -2.5, 1.0))
    )
    assert finite(found)
    inside = np.linalg.norm(found.mesh.vertices, axis=-1) < 1.0
    assert inside.sum() >= 42
    assert not found.diffuse.alpha[inside].any()
    for vertex in np.flatnonzero(inside):
        first = found.first[vertex]
        assert not found.views.alpha[first : first + 10].any()
    assert not picture.any()


@pytest.mark.long
def test_places_inside_of_a_body(even):
    """What of a floor lies under a box is dark, and nothing but that."""
    objects = [do.Object(grid(3.0, 6), GLOSSY), do.Object(Box((1.2, 1.2, 1.2)), GLOSSY)]
    found, picture = shown(objects, even)
    floor = np.abs(found.mesh.vertices[:, 2]) < 1e-9
    away = np.abs(found.mesh.vertices[:, :2]).max(-1)
    hidden = floor & (away < 0.59)
    assert hidden.sum() >= 9
    # Along a ray that runs within a wall of the box some light may pass.
    assert found.diffuse.alpha[hidden].max() < 1e-3
    assert found.diffuse.alpha[floor & (away > 0.61), 0].min() > 0.15
    assert finite(found)
    assert np.isfinite(picture).all()


def test_a_wide_floor_of_two_triangles_has_a_shadow(even):
    """Its corners see nothing of what stands in its middle: it is cut all the same."""
    objects = [
        do.Object(Plane(4.0, 4.0), LAMBERT(0.8)),
        do.Object(Box((0.8, 0.8, 0.8)), LAMBERT(0.0), translate(0.6, -0.5, 0.5)),
    ]
    found = precompute(do.Scene(objects), dataclasses.replace(LEAST, splits=2))
    floor = (found.axes[:, 2, 2] > 0.9) & (found.mesh.vertices[:, 2] < 1e-9)
    away = np.abs(found.mesh.vertices[:, :2] - [0.6, -0.5]).max(-1)
    value = found.diffuse.alpha[:, 0, 0, 0]
    assert (floor & (away < 0.3)).sum() >= 1
    assert value[floor & (away < 0.3)].max() < 0.3
    # From 1 beside its walls it takes less than a tenth of the light.
    assert value[floor & (away > 1.4)].min() > 0.9 * 0.8


BLACK = {
    "matte": LAMBERT(0.0),
    "glossy": do.BlinnPhong(0.0, 20.0),
    "both": LAMBERT(0.0) + do.BlinnPhong(0.0, 5.0),
}


@pytest.mark.parametrize("name", but({"matte"}, BLACK))
def test_black_materials(name, even):
    """Beside others what is glossy and black has a test of its own."""
    found, picture = shown([do.Object(ball(1), BLACK[name])], even)
    assert finite(found)
    assert not picture.any()


def test_a_black_body_beside_a_white_one(even):
    objects = [
        do.Object(grid(3.0, 2), GLOSSY),
        do.Object(Box((0.5, 0.5, 0.5)), do.BlinnPhong(0.0, 20.0), lifted(0.3)),
    ]
    found, picture = shown(objects, even)
    assert finite(found)
    assert np.isfinite(picture).all()
    assert picture.max() > 0.3
    # Nothing comes by way of what is black, and the floor does not see itself.
    floor = found.axes[:, 2, 2] > 0.9
    floor &= found.mesh.vertices[:, 2] < 1e-6
    assert not found.diffuse.alpha[floor][:, 1:].any()


@pytest.mark.parametrize("exponent", but({0.0, 1e4}, [0.0, 1.0, 100.0, 1e4]))
def test_unoccluded_lobes_under_a_lobe_of_light(exponent, rng):
    """On a floor alone, from matte to all but a mirror, against quadrature of the BRDF."""
    material = do.BlinnPhong(0.8, exponent)
    settings = TransferSettings(rays=1024, finest=1, coarsest=0, splits=0, depth=1)
    found = precompute(do.Scene([do.Object(Plane(2.0, 2.0), material)]), settings)
    held = relighting.tables(found)
    elevation = np.radians([80.0, 55.0, 35.0, 20.0])
    wo = np.stack([np.cos(elevation), 0.2 * np.cos(elevation), np.sin(elevation)], -1)
    wo = unit(wo)
    axis = unit(np.array([-0.5, -0.1, 0.85]))
    light = LobeEnvironment(do.Lobes(np.ones(1), axis[None], np.array([8.0])))
    got = relighting.vertex_radiance(
        held, prepare([light], RGB, "lobes"), jnp.arange(4), jnp.asarray(wo, jnp.float32)
    )
    expected = []
    for view in wo:
        mirrored = jnp.asarray(view * [-1, -1, 1], jnp.float32)
        core = jnp.asarray(2.0 / np.sqrt(exponent + 4.0), jnp.float32)
        d, solid = quadrature.polar_grid(mirrored, 100, 80, core)
        f = np.asarray(material.f(np.asarray(d, float), np.tile(view, (len(d), 1))), np.float64)
        radiance = np.asarray(
            vmf.pdf(d, jnp.asarray(axis[None], jnp.float32), jnp.asarray([8.0], jnp.float32))
        )
        d, solid = np.asarray(d, np.float64), np.asarray(solid, np.float64)
        expected.append((f * np.maximum(d[:, 2], 0.0) * radiance * solid).sum())
    # One lobe is 18 to 55 % off in the square of the error; averaged over light that is broad
    # beside it, by some per cent, and most where the horizon cuts it.
    np.testing.assert_allclose(got[:, 0], expected, rtol=0.08, atol=0.03 * np.max(expected))


def test_all_but_mirrors_are_refused():
    objects = [do.Object(Plane(1.0, 1.0), do.BlinnPhong(0.5, 1e6), name="polished")]
    with pytest.raises(InputError, match=r"object polished.*concentration.*2\.4\d?e\+05.*20000"):
        precompute(do.Scene(objects), LEAST)
    assert abs(reflectors.sharpness(reflector(do.BlinnPhong(0.5, 1e4))) - 2500.0) < 100.0


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("mirror", "perfect mirror"),
        ("glass", "perfect mirror or one that light passes"),
        ("texture", "texture"),
        ("emitter", "emits light"),
    ],
)
def test_what_slices_do_not_hold_is_refused_by_name(kind, expected):
    shape, rest = Plane(1.0, 1.0), {}
    if kind == "mirror":
        material = Mirror()
    elif kind == "glass":
        material = "glass"
    elif kind == "texture":
        colours = do.scenes.PerFace(np.full((2, 3), 0.5))
        material = do.scenes.Textured(LAMBERT(0.5), colour=colours)
    else:
        material, rest = LAMBERT(0.5), {"emission": 1.0}
    objects = [
        do.Object(Plane(1.0, 1.0), LAMBERT(0.5), name="fine"),
        do.Object(shape, material, lifted(1.0), name="odd one", **rest),
    ]
    with pytest.raises(InputError, match=f"object odd one: .*{expected}"):
        precompute(do.Scene(objects), LEAST)


@pytest.mark.parametrize(("shape", "counts"), [(Sphere(1.0), "1 spheres"), (Disc(1.0), "1 discs")])
def test_spheres_and_discs_are_refused(shape, counts):
    objects = [do.Object(Plane(1.0, 1.0), GLOSSY), do.Object(shape, GLOSSY, lifted(2.0))]
    with pytest.raises(InputError, match=f"transfer takes triangles.*{counts}"):
        precompute(do.Scene(objects), LEAST)


def test_empty_scenes():
    with pytest.raises(InputError, match="the scene has no objects"):
        precompute(do.Scene([]), LEAST)


def bare(vertices, faces, normals=None):
    """A mesh as it is, with nothing put right."""
    vertices = np.asarray(vertices, float)
    normals = np.tile([0.0, 0.0, 1.0], (len(vertices), 1)) if normals is None else normals
    return meshfiles.Mesh(vertices, np.asarray(faces), np.asarray(normals, float))


SQUARE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]


def test_faces_without_area_and_twice_the_same(even):
    faces = [[0, 1, 2], [0, 2, 3], [0, 1, 1], [2, 0, 1], [0, 2, 3]]
    good = [[0, 1, 2], [0, 2, 3]]
    one, two = (
        shown([do.Object(bare(SQUARE, f), GLOSSY, translate(-0.5, -0.5, 0.0))], even)
        for f in (faces, good)
    )
    assert finite(one[0])
    # Nothing of the others is left; the two are wide, and cut before anything else.
    assert one[0].mesh.initial == two[0].mesh.initial
    np.testing.assert_array_equal(one[1], two[1])
    np.testing.assert_array_equal(one[0].diffuse.alpha, two[0].diffuse.alpha)


def test_no_face_has_an_area():
    line = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [0.5, 0, 0]]
    with pytest.raises(InputError, match="no triangle with an area"):
        precompute(do.Scene([do.Object(bare(line, [[0, 1, 2], [0, 1, 3]]), GLOSSY)]), LEAST)


@pytest.mark.long
def test_three_faces_at_one_edge(even):
    """As where a wall stands in the middle of a floor, all of one mesh; split across the edge."""
    vertices = [[0, -1, 0], [0, 1, 0], [1, 0, 0], [-1, 0, 0], [0, 0, 1]]
    faces = [[0, 2, 1], [0, 1, 3], [0, 1, 4]]
    normals = [[0, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1], [1, 0, 0]]
    settings = dataclasses.replace(LEAST, splits=2, tolerance=0.02)
    found, picture = shown([do.Object(bare(vertices, faces, normals), GLOSSY)], even, settings)
    assert finite(found)
    assert np.isfinite(picture).all()
    assert found.mesh.level.max() > 0


def test_normals_that_are_none(even):
    """Of the mesh: 0 is refused; left out they are made when it is built."""
    zero = bare(SQUARE, [[0, 1, 2], [0, 2, 3]], np.zeros((4, 3)))
    # Their length divides them where the mesh is placed.
    with pytest.raises(InputError, match="normals"), np.errstate(invalid="ignore"):
        precompute(do.Scene([do.Object(zero, GLOSSY)]), LEAST)
    built = meshfiles.build(np.asarray(SQUARE, float), np.array([[0, 1, 2], [0, 2, 3]]))
    found, picture = shown([do.Object(built, GLOSSY, translate(-0.5, -0.5, 0.0))], even)
    up = np.tile([0.0, 0.0, 1.0], (len(found.axes), 1))
    np.testing.assert_allclose(found.axes[:, 2], up, atol=1e-12)
    assert picture.max() > 0.5


def sunny(height=64):
    theta = (np.arange(height)[:, None] + 0.5) * np.pi / height
    image = 1.0 + 0.5 * np.cos(theta) + np.zeros((1, 2 * height))
    image[height // 4, height // 3] = 25_000.0
    phi = (np.arange(2 * height) + 0.5) * np.pi / height
    d = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi]
    solid = np.cos(theta - np.pi / height / 2) - np.cos(theta + np.pi / height / 2)
    solid = np.broadcast_to(solid * np.pi / height, image.shape)
    return image, np.stack(d, -1).reshape(-1, 3), solid.reshape(-1)


@pytest.mark.long
def test_a_sky_with_a_sun():
    """25,000 to 1: finite, and what the same lobes make of all pixels of the map."""
    image, d, solid = sunny()
    light = prepare([Environment(image)], RGB)
    objects = [do.Object(grid(3.0, 2), GLOSSY), do.Object(ball(1, 0.5), GLOSSY, lifted(0.5))]
    found, picture = shown(objects, light)
    assert np.isfinite(picture).all()
    held = relighting.tables(found)
    away = unit(np.asarray(CAMERA.eye) - found.mesh.vertices)
    rows = jnp.arange(len(away))
    lobes = relighting.vertex_lobes(held, rows, jnp.asarray(away, jnp.float32))
    matte = np.asarray(held.diffuse, np.float64).reshape(len(away), -1, 5)
    parts = [
        (
            np.asarray(lobes.alpha)[:, :, 0, 0],
            np.asarray(lobes.mu)[:, :, 0],
            np.asarray(lobes.kappa)[..., 0],
        ),
        (matte[..., 4], matte[..., :3], np.exp(matte[..., 3])),
    ]
    expected, peak = 0.0, 0.0
    for alpha, mu, kappa in parts:
        # 1 - cosine by differences: sharp lobes are one to rounding otherwise.
        off = 0.5 * ((mu[:, :, None] - d) ** 2).sum(-1)
        weight = solid * np.exp(-kappa[..., None] * off)
        mean = (weight * image.reshape(-1)).sum(-1) / weight.sum(-1)
        expected = expected + (alpha * mean).sum(1)
        # Of a lobe that looks at the sun.
        sun = solid[np.argmax(image)] * 25_000.0
        peak = peak + (alpha * (2.0 + sun * np.maximum(kappa, 1.0) / (2.0 * np.pi))).sum(1)
    got = np.asarray(relighting.vertex_radiance(held, light, rows, jnp.asarray(away, jnp.float32)))[
        :, 0
    ]
    error = np.abs(got - expected) / np.maximum(peak, 1e-9)
    # Below the ball and behind it no light is seen.
    lit = expected > 0.0
    assert lit.mean() > 0.5
    assert not got[~lit].any()
    # What is stated of a look-up: 20 kappa / size^2 of the largest, and 2 % between levels.
    assert error.max() < 20.0 / 64 + 0.035
    assert np.median(error) < 0.01
    assert got[lit].min() > 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_texels_that_are_not_radiance(value):
    image = np.ones((8, 16))
    image[3, 4] = value
    with pytest.raises(InputError, match="radiance"):
        prepare([Environment(image)], RGB)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("tolerance", (0.0, -0.1, 1.5, float("nan"))),
        ("rays", (63, 65537, True)),
        ("lobes", (0, 9)),
        ("depth", (0, 17)),
        ("coarsest", (-1, 6)),
        ("finest", (-1, 6)),
        ("splits", (-1, 9)),
        ("longest", (0.5, 2e6)),
        ("least_area", (-0.1, 1.5, float("inf"))),
        ("round_faces", (0,)),
        ("most_vertices", (0,)),
        ("compared", (-1, 6)),
        ("chunk", (0, 1025)),
        ("seed", (-1, 2**31)),
    ],
)
def test_settings_out_of_range_are_named(name, values):
    for value in values:
        with pytest.raises(InputError, match=f"{name} must be .*received {value}"):
            TransferSettings(**{name: value})


def test_every_setting_has_a_case():
    cases = next(
        m for m in test_settings_out_of_range_are_named.pytestmark if m.name == "parametrize"
    )
    named = {name for name, _ in cases.args[1]}
    assert named == {field.name for field in dataclasses.fields(TransferSettings)}


def test_the_coarsest_level_exceeds_the_finest():
    with pytest.raises(InputError, match="coarsest must not exceed finest; received 3 and 2"):
        TransferSettings(coarsest=3, finest=2)


@pytest.mark.long
@pytest.mark.parametrize("lobes", [1, 2])
def test_the_fewest_of_everything(lobes, even):
    """One ray set, one level of views, one vertex at a time."""
    settings = TransferSettings(
        rays=64, lobes=lobes, finest=0, coarsest=0, splits=1, chunk=1, compared=0, depth=1
    )
    found, picture = shown([do.Object(grid(2.0, 1), GLOSSY)], even, settings)
    assert finite(found)
    assert (found.level == 0).all()
    # The albedos of the two terms: 0.4, and up to 0.5 that falls with the angle.
    assert 0.45 < picture.max() < 0.9
