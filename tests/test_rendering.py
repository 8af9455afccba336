"""Levels of image synthesis: furnaces, closed forms, agreement, derivatives, files."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import OpenEXR
import pytest

from diffopt import rendering, scenes, workers
from diffopt.errors import InputError
from diffopt.materials import Dielectric, Lambert, Microfacet, Mirror, RoughDielectric
from diffopt.rendering import driver, pathtrace, shading
from diffopt.rendering.pathtrace import Paths
from diffopt.rendering.settings import PathSettings
from diffopt.scenes import raycasting

# One size of picture and of batches: scenes share the programs of their groups.
CAMERA = scenes.Camera(eye=(0.0, -5.0, 2.0), resolution=(24, 16), field_of_view=35.0)
TOGETHER = {"rays": 384 * 4, "spp": 4}


def ball_on_floor(material, lights, floor=0.4, **more):
    objects = [
        scenes.Object(
            scenes.Plane(6.0, 6.0), Lambert(np.full(3, floor)), scenes.translate(0.0, 0.0, -1.0)
        ),
        scenes.Object(scenes.Sphere(1.0), material),
    ]
    return scenes.Scene(objects + more.pop("objects", []), lights, **more)


def lamp(radiance=5.0, size=1.0):
    place = scenes.translate(0.0, 0.0, 3.0) @ scenes.rotate((1, 0, 0), 180.0)
    return scenes.area_light(size, size, place, radiance=radiance)


POINT = scenes.Point(position=(3.0, -3.0, 5.0), intensity=60.0)


@pytest.mark.parametrize("level", ["incremental", "recursive", "path"])
def test_white_furnace(level):
    """What reflects all light cannot be told from its even surroundings."""
    ball = scenes.Object(scenes.Sphere(1.0), Lambert(np.ones(3)))
    scene = scenes.Scene([ball], [scenes.Environment(0.7)])
    image = rendering.render(scene, CAMERA, level, **TOGETHER)
    # Roulette makes paths brighter and fewer: noise, but none in the mean beyond 4 errors.
    tolerance = 4.0 * image.error.max() if level == "path" else 1e-5
    np.testing.assert_allclose(image.radiance.mean(), 0.7, atol=max(tolerance, 1e-5))
    if level != "path":
        np.testing.assert_allclose(image.radiance, 0.7, rtol=1e-4)


@pytest.mark.parametrize("material", [Dielectric(1.5), Mirror(), RoughDielectric(1.4, 0.3)])
def test_what_absorbs_nothing_vanishes_before_an_even_sky(material):
    scene = scenes.Scene([scenes.Object(scenes.Sphere(1.0), material)], [scenes.Environment(0.7)])
    image = rendering.render(scene, CAMERA, "path", **TOGETHER)
    # Ground glass: Smith's facets lose 1 to 3 % of the light to scattering among themselves.
    lost = 0.05 if isinstance(material, RoughDielectric) else 1e-3
    assert image.radiance.mean() == pytest.approx(0.7, rel=lost)


def test_lambert_under_a_point_light_is_the_formula():
    scene = ball_on_floor(Lambert(np.zeros(3)), [POINT])
    image = rendering.render(scene, CAMERA, "recursive", spp=1, rays=384)
    floor = image.object == 0
    origin, along = CAMERA.rays(np.arange(384))
    place = (origin + image.depth.reshape(-1, 1) * along)[floor.ravel()]
    offset = np.array([3.0, -3.0, 5.0]) - place
    square = (offset**2).sum(-1)
    expected = 0.4 / np.pi * 60.0 * offset[:, 2] / square**1.5
    to_ball = (offset * -place).sum(-1) / square
    near = place + np.clip(to_ball, 0, 1)[:, None] * offset
    shaded = np.linalg.norm(near, axis=-1) < 1.0
    found = image.radiance[floor][:, 0]
    clear = np.abs(np.linalg.norm(near, axis=-1) - 1.0) > 1e-3
    np.testing.assert_allclose(
        found[clear], np.where(shaded, 0.0, expected)[clear], rtol=2e-5, atol=1e-7
    )


def test_levels_agree_where_the_scene_has_only_their_effects():
    """Direct light of a point, no interreflection: all three are the same."""
    scene = ball_on_floor(Microfacet(alpha=0.3), [POINT])
    one = rendering.render(scene, CAMERA, "incremental", shadows=True, **TOGETHER)
    two = rendering.render(scene, CAMERA, "recursive", **TOGETHER)
    np.testing.assert_allclose(one.radiance, two.radiance, rtol=1e-5)
    three = rendering.render(scene, CAMERA, "path", depth=1, rays=384 * 16, spp=256)
    close(three, two, 2e-3)


def close(paths, other, floor):
    """Paths agree with another level within 4 standard errors of blocks of 8 x 8 pixels."""

    def block(a):
        return a.reshape(2, 8, 3, 8, 3).mean((1, 3))

    error = np.sqrt(block(paths.error**2) / 64)
    # The other level has four samples a pixel at edges, fixed ones.
    allowed = 4.0 * error + 0.02 * block(other.radiance) + floor
    assert (np.abs(block(paths.radiance) - block(other.radiance)) < allowed).all()


@pytest.mark.long
def test_mirrors_and_glass_by_recursion_and_by_paths():
    scene = ball_on_floor(Dielectric(1.5), [POINT], floor=0.0, objects=[lamp(2.0)])
    recursive = rendering.render(scene, CAMERA, "recursive", depth=8, **TOGETHER)
    paths = rendering.render(scene, CAMERA, "path", rays=384 * 16, spp=256)
    close(paths, recursive, 2e-3)


@pytest.mark.long
def test_standard_error_is_the_scatter_between_seeds():
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [scenes.Environment(0.5)], objects=[lamp()])
    images = [rendering.render(scene, CAMERA, "path", seed=s, **TOGETHER) for s in range(24)]
    scatter = np.std([i.radiance for i in images], axis=0, ddof=1).mean()
    stated = np.sqrt(np.mean([i.error**2 for i in images], axis=0)).mean()
    # Of 24 pictures the scatter is known to 15 % a pixel, and far better over all.
    assert stated == pytest.approx(scatter, rel=0.05)


def test_equal_seeds_give_equal_pictures_in_any_batches():
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT], objects=[lamp()])
    one = rendering.render(scene, CAMERA, "path", seed=7, **TOGETHER)
    two = rendering.render(scene, CAMERA, "path", seed=7, **TOGETHER)
    np.testing.assert_array_equal(one.radiance, two.radiance)
    parts = rendering.render(scene, CAMERA, "path", seed=7, spp=4, rays=384)
    # Other sizes of programs may round otherwise, and a ray at an edge then goes elsewhere.
    assert (np.abs(parts.radiance - one.radiance) > 1e-4 * one.radiance + 1e-6).mean() < 0.01
    other = rendering.render(scene, CAMERA, "path", seed=8, **TOGETHER)
    assert (other.radiance != one.radiance).mean() > 0.5


def test_changed_numbers_compile_nothing():
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT], objects=[lamp()])
    rendering.render(scene, CAMERA, "path", **TOGETHER)
    before = pathtrace._scatter.count
    other = eqx.tree_at(
        lambda s: (s.objects[0].material.colour, s.lights[0].position),
        scene,
        (jnp.asarray([0.1, 0.2, 0.3]), jnp.asarray([1.0, 2.0, 3.0])),
    )
    moved = scenes.Camera(eye=(1.0, -5.0, 1.0), resolution=(24, 16))
    rendering.render(other, moved, "path", seed=3, **TOGETHER)
    assert pathtrace._scatter.count == before


GRADIENTS = {
    "alpha": lambda s: s.objects[0].material.alpha,
    "reflectance": lambda s: s.objects[1].material.fresnel.value,
    "emission": lambda s: s.objects[0].emission,
    "position": lambda s: s.lights[0].position,
    "sky": lambda s: s.lights[1].radiance,
}


def two_metal_balls():
    """Of one kind, so that there is one program to differentiate; one of them glows."""
    left, right = (scenes.translate(x, 0.0, 0.0) for x in (-1.1, 1.1))
    return scenes.Scene(
        [
            scenes.Object(scenes.Sphere(1.0), Microfacet(alpha=0.3), left, emission=0.5),
            scenes.Object(scenes.Sphere(1.0), Microfacet(alpha=0.4), right),
        ],
        [POINT, scenes.Environment(0.25)],
    )


@pytest.mark.parametrize(
    ("level", "options"),
    [
        pytest.param("incremental", {}, marks=pytest.mark.long),
        pytest.param("recursive", {}, marks=pytest.mark.long),
        ("path", {"spp": 2, "depth": 2}),
    ],
)
def test_derivatives_at_fixed_visibility(level, options):
    scene = two_metal_balls()
    camera = scenes.Camera(eye=(0.0, -5.0, 2.0), resolution=(12, 8), field_of_view=35.0)
    small = {"rays": 192, "spp": 2} | options
    view = rendering.record(scene, camera, level, dtype="float64", **small)
    image = rendering.render(scene, camera, level, dtype="float64", **small)
    if level != "path":  # whose paths end by roulette
        np.testing.assert_allclose(view(scene), image.radiance, rtol=1e-12, atol=1e-15)
    weights = jnp.asarray(np.random.default_rng(0).random(image.radiance.shape))
    loss = lambda s: (view(s) * weights).sum()  # noqa: E731
    slope = eqx.filter_grad(loss)(scene)
    step = 1e-5
    for name, get in GRADIENTS.items():
        value = get(scene)
        ends = [loss(eqx.tree_at(get, scene, value + s * step)) for s in (1.0, -1.0)]
        expected = float(ends[0] - ends[1]) / (2.0 * step)
        # Central differences: 1e-10 of the square of the step, 1e-11 of rounding.
        assert float(get(slope).sum()) == pytest.approx(expected, rel=1e-6, abs=1e-8), name


def test_derivative_by_the_heights_of_a_diffracting_surface():
    from diffopt import DiffractionBRDF, Heightfield
    from diffopt.materials import Diffraction

    rng = np.random.default_rng(1)
    field = Heightfield(0.05 * rng.random((8, 8)), 1.0)
    brdf = DiffractionBRDF(field, coherence=2.0)
    lam = np.array([0.45, 0.55, 0.65])
    ball = scenes.Object(scenes.Sphere(1.0), Diffraction(brdf, lam))
    scene = scenes.Scene([ball], [POINT], wavelengths=lam)
    camera = scenes.Camera(eye=(0.0, -3.0, 1.5), resolution=(6, 4))
    view = rendering.record(scene, camera, "incremental", dtype="float64", spp=1, rays=64)
    heights = lambda s: s.objects[0].material.brdf.surface.heights  # noqa: E731
    loss = lambda s: (view(s) ** 2).sum()  # noqa: E731
    slope = heights(eqx.filter_grad(loss)(scene))
    along = rng.normal(size=(8, 8))
    base, step = heights(scene), 1e-5
    ends = [loss(eqx.tree_at(heights, scene, base + s * step * along)) for s in (1.0, -1.0)]
    expected = float(ends[0] - ends[1]) / (2.0 * step)
    assert float((slope * along).sum()) == pytest.approx(expected, rel=1e-5)


def test_interruption_keeps_finished_tiles(monkeypatch):
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT])
    whole = rendering.render(scene, CAMERA, "recursive", spp=1, rays=128)
    done = []

    def stop(tile, of):
        done.append(tile)
        if tile == 2:
            raise KeyboardInterrupt

    image = rendering.render(scene, CAMERA, "recursive", spp=1, rays=128, progress=stop)
    assert image.interrupted
    assert image.done.sum() == 256
    np.testing.assert_array_equal(image.radiance[image.done], whole.radiance[image.done])
    assert not image.radiance[~image.done].any()


def test_paths_by_threads_are_the_same(monkeypatch):
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT], objects=[lamp()])
    images = []
    for count in (1, 3):
        monkeypatch.setattr(workers, "count", lambda count=count: count)
        images.append(rendering.render(scene, CAMERA, "path", spp=20, rays=1024))
    np.testing.assert_array_equal(*(image.radiance for image in images))
    done = []

    def stop(tile, of):
        done.append(tile)
        if tile == 2:
            raise KeyboardInterrupt

    part = rendering.render(scene, CAMERA, "path", spp=20, rays=1024, progress=stop)
    assert part.interrupted
    assert done == [1, 2]
    np.testing.assert_array_equal(part.radiance[part.done], images[0].radiance[part.done])


def test_work_ahead_is_in_order_and_raises_where_it_is():
    def work(item):
        if item == 4:
            raise ValueError("four")
        return item * jnp.ones((), "float64")

    assert [int(n) for n in workers.ahead(work, range(4), 3)] == [0, 1, 2, 3]
    with jax.enable_x64(True):
        assert all(n.dtype == "float64" for n in workers.ahead(work, range(3), 2))
    found = workers.ahead(work, range(6), 2)
    assert [int(next(found)) for _ in range(4)] == [0, 1, 2, 3]
    with pytest.raises(ValueError, match="four"):
        next(found)


def test_pictures_in_files(tmp_path):
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT, scenes.Environment(0.2)])
    image = rendering.render(scene, CAMERA, "recursive", **TOGETHER)
    assert set(image.object.ravel()) == {-1, 0, 1}
    assert np.isinf(image.depth[image.object < 0]).all()
    length = np.linalg.norm(image.normal, axis=-1)
    np.testing.assert_allclose(length[image.object >= 0], 1.0, rtol=1e-6)
    for suffix in rendering.images.FORMATS:
        image.save(tmp_path / f"ball{suffix}")
    import PIL.Image

    with PIL.Image.open(tmp_path / "ball.png") as found:
        np.testing.assert_array_equal(np.asarray(found), image.display())
    with np.load(tmp_path / "ball.npz") as found:
        np.testing.assert_array_equal(found["radiance"], image.radiance)
    channels = OpenEXR.File(str(tmp_path / "ball.exr")).channels()
    np.testing.assert_allclose(channels["RGB"].pixels, image.radiance.astype(np.float32), rtol=1e-6)
    assert {"Z", "object"} <= set(channels)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["ball.exr", "ball.npz", "ball.png"]
    with pytest.raises(InputError, match=r"ball.jpg: pictures are written to .png, .exr, .npz"):
        image.save(tmp_path / "ball.jpg")
    with pytest.raises(InputError, match=r"the folder .* does not exist"):
        image.save(tmp_path / "none" / "ball.exr")


def test_spectral_picture_has_a_layer_for_each_wavelength(tmp_path):
    lam = np.arange(0.40, 0.701, 0.02)
    scene = ball_on_floor(Lambert(np.array([0.8, 0.3, 0.1])), [POINT], wavelengths=lam)
    rgb = ball_on_floor(Lambert(np.array([0.8, 0.3, 0.1])), [POINT])
    image = rendering.render(scene, CAMERA, "recursive", spp=1, rays=384)
    other = rendering.render(rgb, CAMERA, "recursive", spp=1, rays=384)
    assert image.radiance.shape == (16, 24, 16)
    # Sixteen wavelengths carry colours to a few percent.
    np.testing.assert_allclose(image.rgb, other.rgb, atol=0.03 * other.rgb.max())
    image.save(tmp_path / "a.exr")
    names = set(OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels())
    assert {"S0.400nm", "S0.660nm", "error.420nm"} <= names


def test_textures_and_faces_are_seen():
    image = np.kron(np.indices((2, 2)).sum(0) % 2, np.ones((8, 8)))
    checks = scenes.Textured(Lambert(), colour=scenes.Texture(image))
    scene = scenes.Scene([scenes.Object(scenes.Plane(2.0, 2.0), checks)], [scenes.Ambient(1.0)])
    above = scenes.Camera(
        eye=(0.0, 0.0, 3.0), up=(0.0, 1.0, 0.0), resolution=(8, 8), field_of_view=30.0
    )
    found = rendering.render(scene, above, "incremental", spp=1, rays=64).radiance[..., 0]
    np.testing.assert_allclose(found[1, 1], 0.0, atol=1e-6)
    np.testing.assert_allclose(found[1, 6], 1.0, rtol=1e-5)
    np.testing.assert_allclose(found[6, 1], 1.0, rtol=1e-5)
    sides = scenes.Textured(Lambert(), colour=scenes.PerFace(np.arange(12) / 12.0))
    box = scenes.Scene([scenes.Object(scenes.Box(), sides)], [scenes.Ambient(1.0)])
    found = rendering.render(box, above, "incremental", spp=1, rays=64).radiance[3:5, 3:5, 0]
    # The side +z holds faces 8 and 9.
    np.testing.assert_allclose(np.unique(found.round(6)), [8 / 12, 9 / 12], atol=1e-5)


def test_nothing_to_see():
    image = rendering.render(scenes.Scene([]), CAMERA, "path", **TOGETHER)
    assert not image.radiance.any()
    assert image.noise == 0.0
    lit = scenes.Scene([], [scenes.Environment((0.1, 0.2, 0.3))])
    image = rendering.render(lit, CAMERA, "recursive", **TOGETHER)
    np.testing.assert_allclose(image.radiance, np.broadcast_to([0.1, 0.2, 0.3], (16, 24, 3)))


def test_device_rays_are_those_of_the_camera():
    settings = PathSettings(spp=1, rays=384)
    stage = rendering.stage.Stage(ball_on_floor(Lambert(np.full(3, 0.5)), [POINT]))
    key = jax.random.key(0)
    rays = driver.primary(CAMERA, stage, key, np.arange(384), 384, 0, 1, settings, True)
    origin, along = CAMERA.rays(np.arange(384))
    np.testing.assert_allclose(rays.origin, origin, atol=1e-6)
    np.testing.assert_allclose(rays.direction, along, atol=1e-6)


def test_jax_backend_gives_the_same_picture():
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT], objects=[lamp()])
    one = rendering.render(scene, CAMERA, "path", seed=1, **TOGETHER)
    two = rendering.render(scene, CAMERA, "path", seed=1, backend="jax", **TOGETHER)
    assert (np.abs(one.radiance - two.radiance) > 1e-3 * one.radiance + 1e-6).mean() < 0.02


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda s: rendering.render(s, CAMERA, "radiation"), "level"),
        (
            lambda s: rendering.render(s, CAMERA, "path", shadows=True),
            "path has no setting shadows",
        ),
        (lambda s: rendering.render(s, CAMERA, "path", spp=0), "spp must be a whole number from 1"),
        (lambda s: rendering.render(s, CAMERA, "path", depth=0), "depth must be a whole number"),
        (
            lambda s: rendering.render(s, CAMERA, settings=PathSettings(), spp=3),
            "give settings or options, not both",
        ),
        (lambda s: rendering.render(s, CAMERA, "path", backend="gpu"), "backend"),
        (lambda s: rendering.render(s, CAMERA, "recursive", ambient="some"), "ambient must be"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(InputError, match=message):
        make(scenes.Scene([]))


def test_variation_must_have_the_recorded_shapes():
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT])
    view = rendering.record(scene, CAMERA, "incremental", spp=1, rays=384)
    with pytest.raises(InputError, match="shapes and places must be those that were recorded"):
        view(scenes.Scene(scene.objects[:1], scene.lights))


def test_paths_of_one_chunk_are_reproducible_by_hand():
    """The level is a function of rays and answers: what the driver sums is nothing else."""
    scene = ball_on_floor(Lambert(np.full(3, 0.6)), [POINT])
    settings = PathSettings(spp=1, rays=384)
    stage = rendering.stage.Stage(scene)
    key = jax.random.key(settings.seed)
    rays = driver.primary(CAMERA, stage, key, np.arange(384), 384, 0, 1, settings, False)
    caster = raycasting.caster(scene.geometry)
    found = Paths(settings)(stage, rays, rendering.queries.Queries(caster), key)
    image = rendering.render(scene, CAMERA, settings=settings)
    np.testing.assert_array_equal(np.asarray(found.radiance).reshape(16, 24, 3), image.radiance)
    assert len(shading.blocks(np.arange(384), 384)) == 1


def test_a_light_that_rendering_does_not_know_is_refused():
    """It would be black otherwise, without a word."""

    class Torch(scenes.lights.Light):
        pass

    scene = ball_on_floor(Lambert(0.5), [Torch()])
    for level in ("recursive", "path"):
        with pytest.raises(InputError, match="received Torch, which rendering does not know"):
            rendering.render(scene, CAMERA, level, spp=1)
