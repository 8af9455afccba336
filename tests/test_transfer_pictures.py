"""Pictures of precomputed transfer: loops of frames, layers, figures, light from infinity."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt import transfer
from diffopt.errors import InputError
from diffopt.materials import BlinnPhong, Lambert
from diffopt.scenes import (
    Ambient,
    Camera,
    Directional,
    Environment,
    Flood,
    LobeEnvironment,
    Object,
    Plane,
    Point,
    Scene,
    area_light,
    facing,
    models,
    translate,
)
from diffopt.scenes.channels import Channels
from diffopt.transfer import infinity, pictures, tessellation
from diffopt.transfer.backgrounds import Background
from diffopt.transfer.precomputation import precompute

SETTINGS = transfer.TransferSettings(rays=256, finest=2, splits=1, tolerance=0.4)
CAMERA = Camera((0.4, -4.6, 2.4), (0.0, 0.0, 0.1), resolution=(40, 30), field_of_view=40.0)
RGB = Channels()


def sky(rows=32):
    """Bright above and towards x, never dark."""
    theta = (np.arange(rows) + 0.5)[:, None] * np.pi / rows
    phi = (np.arange(2 * rows) + 0.5) * np.pi / rows
    value = 1.0 + 0.5 * np.cos(theta) + 0.4 * np.sin(theta) * np.cos(phi)
    return (value[..., None] * np.array([1.0, 0.8, 0.6])).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    """A glossy ring over a matte plane."""
    shine = do.materials.Sum([Lambert(0.2), BlinnPhong(0.5, 16.0)])
    ring = Object(models.torus(1.0, 0.4, 10, 6), shine, translate(0.0, 0.0, 0.45), name="ring")
    return Scene([ring, Object(Plane(5.0, 5.0), Lambert(0.4))], [Environment(sky())])


@pytest.fixture(scope="module")
def held(scene):
    return precompute(scene, SETTINGS)


@pytest.fixture(scope="module")
def relit(held, scene):
    return transfer.Relit(held, scene, CAMERA, samples=2)


@pytest.fixture(autouse=True)
def _as_before(request):
    yield
    if "relit" in request.fixturenames:
        found = request.getfixturevalue("relit")
        found.look(CAMERA)
        found.turn(0.0)
        found.expose(0.0)


class Compiled:
    """Counts programs that JAX compiles."""

    count = 0

    def __call__(self, event, seconds, **words):
        del seconds, words
        self.count += event == "/jax/core/compile/backend_compile_duration"


COMPILED = Compiled()
jax.monitoring.register_event_duration_secs_listener(COMPILED)


def test_frames_after_the_first_compile_nothing(relit):
    relit.turn(10.0)
    relit.frame()
    relit.look(dataclasses.replace(CAMERA, eye=(0.5, -4.6, 2.4)))
    relit.frame()
    relit.expose(1.0)
    relit.look(dataclasses.replace(CAMERA, eye=(0.5, -6.0, 3.0)))
    relit.frame()
    before = COMPILED.count
    for k in range(3):
        relit.turn(20.0 * k)
        relit.expose(0.1 * k)
        relit.frame()
        # From further away, so that less is seen than before.
        relit.look(dataclasses.replace(CAMERA, eye=(0.5 + 0.2 * k, -6.0, 3.0)))
        relit.frame()
    assert COMPILED.count == before


def test_a_frame_is_the_picture_of_the_functions(relit, held, scene):
    tables = transfer.tables(held)
    light = transfer.prepare(scene.lights, scene.channels)
    assert CAMERA.eye[2] > 0.0  # no back of the plane is seen
    seen = transfer.Raster(held.mesh.vertices, held.triangles)(CAMERA, 2)
    behind = Background(scene.lights, scene.channels)(jnp.asarray(seen.towards))
    expected = transfer.picture(tables, light, seen, background=behind)
    # The same numbers but for padding; float32.
    np.testing.assert_allclose(relit.frame(), np.asarray(expected), rtol=1e-5, atol=1e-6)


def test_turned_lights_are_those_of_the_scene_file(relit, held, scene):
    turned = Scene(scene.objects, infinity.turned(scene.lights, 70.0))
    expected = transfer.Relit(held, turned, CAMERA, samples=2).frame()
    relit.turn(70.0)
    # Tables of the sky are made in its own frame: only rounding is between them.
    np.testing.assert_allclose(relit.frame(), expected, rtol=1e-4, atol=1e-5)
    relit.turn(0.0)
    assert np.abs(relit.frame() - expected).max() > 0.05


def test_exposure_is_in_stops(relit):
    plain = relit.frame()
    relit.expose(2.0)
    np.testing.assert_allclose(relit.frame(), 4.0 * plain, rtol=1e-6)
    for call in (relit.expose, relit.turn):
        with pytest.raises(InputError, match="must be a finite number; received nan"):
            call(math.nan)


@pytest.mark.long
def test_a_smaller_view_does_not_leave_the_larger_one_behind(relit, held, scene):
    """Arrays keep the size of the largest view: what is beyond the smaller one is not drawn."""
    near = dataclasses.replace(CAMERA, eye=(0.2, -2.0, 1.5))
    far = dataclasses.replace(CAMERA, eye=(1.0, -16.0, 8.0))
    relit.look(near)
    relit.frame()
    relit.look(far)
    expected = transfer.Relit(held, scene, far, samples=2).frame()
    np.testing.assert_allclose(relit.frame(), expected, rtol=1e-5, atol=1e-6)


def test_backs_are_dark(relit):
    below = dataclasses.replace(CAMERA, eye=(0.4, -4.6, -2.4))
    relit.look(below)
    frame = relit.frame()
    assert not frame[13:17, 18:22].any()
    assert frame[-1].min() > 0.1


def test_layers_add_up(relit):
    whole = np.asarray(relit.radiance(background=False))
    parts = [
        np.asarray(relit.radiance(transfer.layer(relit.tables, name), background=False))
        for name in transfer.LAYERS
    ]
    assert len(parts) == 4
    assert all(part.max() > 0.0 for part in parts)
    np.testing.assert_allclose(sum(parts), whole, rtol=1e-4, atol=1e-5)
    with pytest.raises(InputError, match="name must be one of direct"):
        transfer.layer(relit.tables, "diffuse")


@pytest.mark.long
def test_one_surface_leaves_direct_light_only(scene):
    """Of paths over one surface the layers of indirect light are dark."""
    found = precompute(scene, dataclasses.replace(SETTINGS, depth=1, splits=0, finest=1))
    alone = transfer.Relit(found, scene, CAMERA)
    for name in ("indirect diffuse", "indirect glossy"):
        lit = alone.radiance(transfer.layer(alone.tables, name), background=False)
        assert not np.asarray(lit).any()


@pytest.mark.long
def test_the_background_is_what_path_tracing_sees(relit, scene):
    expected = do.render(scene, CAMERA, "path", spp=64, depth=1)
    past = (expected.object < 0) & (relit.frame().mean(-1) > 0.0)
    # Whole pixels only: none at an outline.
    inside = past.copy()
    inside[:, 1:] &= past[:, :-1]
    inside[:, :-1] &= past[:, 1:]
    inside[:-1] &= past[1:]
    assert inside.sum() > 100
    # A smooth sky: samples of a pixel differ by less than this from their mean.
    np.testing.assert_allclose(relit.frame()[inside], expected.rgb[inside], rtol=5e-3)


def test_backgrounds_of_all_kinds(rng):
    d = rng.normal(size=(50, 3)).astype(np.float32)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    lobes = do.Lobes(np.ones((2, 3), np.float32), np.eye(3, dtype=np.float32)[:2], np.ones(2, "f4"))
    found = Background([LobeEnvironment(lobes)], RGB)(jnp.asarray(d))
    np.testing.assert_allclose(found, lobes(jnp.asarray(d)), rtol=1e-5)
    even = Background([Environment(2.0), Directional(irradiance=9.0), Ambient(5.0)], RGB)
    np.testing.assert_allclose(even(jnp.asarray(d)), 2.0, rtol=1e-6)
    image = sky(64)
    there = Background([Environment(image)], RGB)
    quarter = jnp.asarray(infinity.rotation(2, 90.0), jnp.float32)
    along = np.asarray(there(jnp.asarray(d), quarter))
    before = np.stack([d[:, 1], -d[:, 0], d[:, 2]], -1)
    np.testing.assert_allclose(along, there(jnp.asarray(before)), rtol=1e-4)


@pytest.mark.long
def test_lights_near_the_scene_become_distant():
    """Irradiance in the middle of the scene, by closed forms."""
    ring = Object(models.torus(1.0, 0.4, 8, 6), Lambert(0.5))
    lamp = area_light(
        0.5, 0.5, facing((0.0, 0.0, 10.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)), radiance=800.0
    )
    scene = Scene([ring, lamp], [Point((0.0, 3.0, 4.0), 50.0), Ambient(0.25), Environment(0.5)])
    found = transfer.from_infinity(scene)
    assert len(found.scene.objects) == 1
    parallel, around = found.scene.lights
    assert isinstance(parallel, Directional)
    assert parallel.irradiance == pytest.approx(50.0 / 25.0, rel=1e-5)
    towards = np.asarray(parallel.towards) / np.linalg.norm(parallel.towards)
    np.testing.assert_allclose(towards, [0.0, 0.6, 0.8], atol=1e-6)
    assert around.is_map
    lit = transfer.prepare([around], RGB)
    mean = lit.radiance(jnp.asarray([0.0, 0.0, 1.0], jnp.float32), jnp.zeros((), jnp.float32))
    # Solid angle of the lamp over that of the sphere; its edge falls on pixels of 1.4 degrees,
    # which are sampled 16 times each.
    share = 0.25 / 100.0 / (4.0 * np.pi)
    assert float(mean[0]) == pytest.approx(0.75 + (800.0 - 0.75) * share, rel=0.03)
    assert any("emits light (light)" in text for text in found.notes)
    assert any("point light" in text for text in found.notes)
    assert any("ambient light" in text for text in found.notes)
    # The back of the lamp is dark: it is not there.
    under = Scene([ring, area_light(0.5, 0.5, translate(0.0, 0.0, 10.0), radiance=800.0)])
    dark = transfer.from_infinity(under).scene.lights[0]
    assert float(np.asarray(dark.radiance).max()) == 0.0


def test_a_flood_shines_by_its_cosine():
    ring = Object(models.torus(1.0, 0.4, 8, 6), Lambert(0.5))
    flood = Flood((0.0, 0.0, 2.0), (0.0, 1.0, -1.0), 8.0, 3.0)
    (found,) = transfer.from_infinity(Scene([ring], [flood])).scene.lights
    assert found.irradiance == pytest.approx(8.0 * math.cos(math.pi / 4) ** 3 / 4.0, rel=1e-5)


def test_distant_lights_stay_as_they_are(scene):
    found = transfer.from_infinity(scene)
    assert found.notes == ()
    assert found.scene.lights == scene.lights
    both = Scene(scene.objects, [Ambient(0.25), Environment(0.5)])
    (even,) = transfer.from_infinity(both).scene.lights
    np.testing.assert_allclose(even.radiance, 0.75)


def test_turning_about_the_zenith_of_a_map():
    image = sky()
    for up, about in (("z", 2), ("y", 1)):
        light = Environment(image, turn=20.0, up=up)
        assert infinity.axis([light]) == about
        (turned,) = infinity.turned([light], 50.0)
        matrix = infinity.rotation(about, 50.0)
        np.testing.assert_allclose(turned.axes, light.axes @ matrix.T, atol=1e-12)
    sun = Directional((1.0, 0.0, 1.0))
    (found,) = infinity.turned([sun], 90.0)
    np.testing.assert_allclose(found.towards, [0.0, 1.0, 1.0], atol=1e-6)


def test_numbers_of_a_comparison(rng):
    expected = 0.5 + 0.1 * rng.normal(size=(24, 20, 3))
    surface = np.ones((24, 20), bool)
    surface[:, :4] = False
    same = pictures.differences(expected, expected, surface, 1.0)
    assert same.rmse == 0.0
    assert same.worst == 0.0
    assert same.ssim == pytest.approx(1.0)
    assert math.isnan(same.noise)
    off = expected.copy()
    off[:, :4] += 5.0  # not on the surface
    off[surface] += 0.05
    mean = expected[surface].mean()
    error = np.full_like(expected, 0.01)
    found = pictures.differences(off, expected, surface, 1.0, error)
    assert found.rmse == pytest.approx(0.05 / mean)
    assert found.worst == pytest.approx(0.05 / mean)
    assert found.noise == pytest.approx(0.01 / mean)
    assert 0.5 < found.ssim < 1.0
    with pytest.raises(InputError, match="surface must hold a pixel"):
        pictures.differences(off, expected, np.zeros_like(surface), 1.0)


def test_edges_lie_where_triangles_meet(held):
    """Distances to the nearest edge against the edges projected onto the picture."""
    triangles = held.triangles
    found = pictures._hits(held, triangles, CAMERA, 1)
    matrix = CAMERA.matrix
    step = math.tan(math.radians(20.0)) / 15.0
    local = (held.mesh.vertices - matrix[:3, 3]) @ matrix[:3, :3]
    flat = local[:, :2] / -local[:, 2:] / step * [1.0, -1.0] + [20.0, 15.0]
    met = np.flatnonzero((found.triangle >= 0) & (found.edge > 1e-3))
    assert len(met) > 200
    place = np.stack([met % 40, met // 40], -1) + 0.5
    corners = flat[triangles[found.triangle[met]]]
    # Planes of which a corner is behind the camera have none there.
    assert (local[..., 2] < 0.0).all()
    side = np.roll(corners, -1, axis=1) - corners
    across = side[..., 0] * (place[:, None] - corners)[..., 1]
    across -= side[..., 1] * (place[:, None] - corners)[..., 0]
    away = (np.abs(across) / np.linalg.norm(side, axis=-1)).min(-1)
    # Shares are linear in the plane, their quotients on the picture are not: to first order.
    near = away < 0.5
    np.testing.assert_allclose(found.edge[met][near], away[near], rtol=0.1, atol=0.02)


def test_figures(held, relit, tmp_path):
    shaded = pictures.displayed(relit.frame(), 0.5)
    assert shaded.min() >= 0.0
    assert shaded.max() <= 1.0
    figure = pictures.wireframe(held, CAMERA, shaded, title="mesh")
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    leaves = tessellation.leaves(held.mesh)
    counts = np.bincount(held.mesh.level[leaves])
    assert words == [f"split {k} times: {n:,} triangles" for k, n in enumerate(counts) if n]
    assert counts[1] > 0
    figure = pictures.levels(held, CAMERA)
    words = [text.get_text() for text in figure.legends[0].get_texts()]
    total = sum(int(text.split(": ")[1].split()[0].replace(",", "")) for text in words)
    assert total == len(held.axes)
    assert words[-1].startswith("matte: ")
    with pytest.raises(InputError, match="rows and columns of the camera"):
        pictures.wireframe(held, CAMERA, shaded[1:])


@pytest.mark.long
def test_a_comparison_against_path_tracing(held, relit, scene):
    relit.samples = 4
    relit.look(CAMERA)
    ours = relit.frame().astype(float)
    relit.samples = 2
    image = do.render(scene, CAMERA, "path", spp=64, depth=SETTINGS.depth)
    compared = pictures.Compared(
        ours, np.roll(ours, 1, axis=1), image.rgb, image.error, image.object >= 0, 0.5
    )
    fine, coarse = compared.numbers
    # 256 rays and 100 vertices: a tenth of the mean and more at contacts, but the same picture; one
    # that is moved by a pixel is further off.
    assert fine.rmse < 0.35
    assert fine.noise < 0.1
    assert fine.ssim > 0.7
    assert coarse.rmse > fine.rmse
    figure = pictures.comparison(compared, title="ring")
    titles = [axes.get_title() for axes in figure.axes]
    assert any("RMSE" in text and "SSIM" in text for text in titles)
    assert any("standard error" in text for text in titles)
    assert any(axes.get_ylabel() == "difference / % of the mean" for axes in figure.axes)


def test_the_initial_mesh_is_what_was_there_before(held):
    found = pictures.initial(held)
    assert found.triangles.max() < held.mesh.initial
    assert len(found.triangles) == (held.mesh.level == 0).sum()


def test_bad_samples(held, scene):
    with pytest.raises(InputError, match="samples must be a whole number from 1 to 16; received 0"):
        transfer.Relit(held, scene, CAMERA, samples=0)
