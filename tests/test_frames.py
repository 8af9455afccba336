"""Frames are the photographs of the same object, and moving lights compile nothing."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import DiffractionBRDF, fresnel, samples
from diffopt.drawing import frames, pictures, shapes, views
from diffopt.drawing.frames import Frames
from diffopt.errors import InputError

LIGHTS = shapes.unit(np.array([[-0.45, 0.50, 0.75], [0.6, 0.2, 0.7], [0.0, -0.3, 0.9]]))
SIZE = (40, 64)
# Codes are rounded to 1/255, and float32 here meets float64 there.
STEP = 0.52 / 255.0


@pytest.fixture(autouse=True)
def single_precision():
    with jax.enable_x64(False):
        yield


@pytest.fixture(scope="module")
def brdf():
    with jax.enable_x64(False):
        scan = samples.compact_disc(jax.random.key(0), shape=(128, 128), pixel=0.1)
        return DiffractionBRDF(scan, 1.6, fresnel=fresnel.metal("au"))


@pytest.fixture(scope="module")
def view():
    return shapes.sphere(SIZE)


@pytest.fixture(scope="module")
def table(brdf, view):
    with jax.enable_x64(False):
        return views.bake(brdf, frames.reach(view, LIGHTS, turning=True), size=64)


@pytest.fixture(scope="module")
def sphere(brdf, table, view):
    with jax.enable_x64(False):
        return Frames(brdf, table, view)


def check(pixels, brdf, table, view, light, *, lit=None, illuminant="D65"):
    """Against the picture that the command line draws; gives both in [0, 1]."""
    image = views.photograph(brdf, table, view, light, lit=lit, illuminant=illuminant)
    expected = pictures.photograph(image, illuminant=illuminant)
    assert pixels.dtype == np.uint8
    assert pixels.shape == expected.shape
    np.testing.assert_allclose(np.asarray(pixels) / 255.0, expected, rtol=0, atol=STEP)
    assert np.ptp(expected[view.covered], axis=-1).max() > 0.2, "no colours to compare"


@pytest.mark.parametrize("light", LIGHTS)
def test_a_frame_is_the_photograph(sphere, brdf, table, view, light):
    # Lights of any length are directions.
    pixels = sphere(3.0 * light, exposure=sphere.exposure(light))
    check(pixels, brdf, table, view, light)


@pytest.mark.parametrize("turn", [0.4, math.pi / 2])
def test_turning_the_material_is_turning_the_view(sphere, brdf, table, view, turn):
    light = LIGHTS[0]
    exposure = sphere.exposure(light, turn=turn)
    pixels = sphere(light, exposure=exposure, turn=turn)
    check(pixels, brdf, table, view.turned(turn), light)


def test_a_near_light_has_a_direction_at_every_sample(sphere, brdf, table, view):
    lamp = 4.0 * LIGHTS[0]
    pixels = sphere(lamp, exposure=sphere.exposure(lamp, near=True), near=True)
    check(pixels, brdf, table, view, view.towards(lamp))
    far = sphere(1e4 * LIGHTS[0], exposure=1.0, near=True)
    difference = far.astype(int) - sphere(LIGHTS[0], exposure=1.0).astype(int)
    # Directions differ by 1e-4, a three hundredth of the width of a line.
    assert np.abs(difference).max() <= 3


def test_shadows_leave_the_surroundings(sphere, brdf, table, view, rng):
    lit = rng.random(SIZE) < 0.5
    light = LIGHTS[0]
    pixels = sphere(light, exposure=sphere.exposure(light, lit=lit), lit=lit)
    check(pixels, brdf, table, view, light, lit=lit)


def test_the_illuminant_is_adapted_to(brdf, view):
    waves = frames.reach(view, LIGHTS, turning=True)
    table = views.bake(brdf, waves, size=64, illuminant="A")
    warm = Frames(brdf, table, view, illuminant="A")
    pixels = warm(LIGHTS[0], exposure=warm.exposure(LIGHTS[0]))
    check(pixels, brdf, table, view, LIGHTS[0], illuminant="A")


def test_a_disc_keeps_its_hub_and_its_ground(brdf, table):
    view = shapes.disc(SIZE, eye=(0.0, -130.0, 190.0))
    lamp = np.array([4.0, 114.0, 190.0])
    disc = Frames(brdf, table, view)
    pixels = disc(lamp, exposure=disc.exposure(lamp, near=True), near=True)
    check(pixels, brdf, table, view, view.towards(lamp))


def test_changing_light_turn_and_exposure_compiles_nothing(brdf, table, view, monkeypatch):
    traces = []
    shade = frames.lookup.shade

    def counting(*arguments):
        traces.append(arguments)
        return shade(*arguments)

    monkeypatch.setattr(frames.lookup, "shade", counting)
    # A size of its own: nothing is left over from other tests.
    view = shapes.sphere((30, 46))
    frame = Frames(brdf, table, view)
    frame(LIGHTS[0], exposure=1.0)
    assert len(traces) == 1
    frame(LIGHTS[1], exposure=2.0, turn=0.3)
    frame(jnp.asarray(LIGHTS[1], jnp.float32), exposure=np.float64(2.0), turn=1)
    frame([0, 0, 5], exposure=3, near=True)
    # Another view of as many samples, as a camera that moves around the object has.
    Frames(brdf, table, view.turned(0.2))(LIGHTS[2], exposure=1.0)
    assert len(traces) == 1
    shadow = np.ones((30, 46), bool)
    frame(LIGHTS[0], exposure=1.0, lit=shadow)
    frame(LIGHTS[1], exposure=0.5, lit=~shadow)
    assert len(traces) == 2


def test_a_float64_model_gives_the_same_pixels(view, sphere):
    exposure = sphere.exposure(LIGHTS[0])
    expected = np.asarray(sphere(LIGHTS[0], exposure=exposure))
    with jax.enable_x64(True):
        scan = samples.compact_disc(jax.random.key(0), shape=(128, 128), pixel=0.1)
        wide = DiffractionBRDF(scan, 1.6, fresnel=fresnel.metal("au"))
        assert wide.surface.heights.dtype == jnp.float64
        table = views.bake(wide, frames.reach(view, LIGHTS, turning=True), size=64)
        frame = Frames(wide, table, view)
        assert frame.seen.normal.dtype == jnp.float32
        pixels = np.asarray(frame(LIGHTS[0], exposure=exposure))
    # The table's float32 rounds codes the other way; on the steep foot of the sRGB curve, 3300
    # codes per unit, it makes several.
    difference = np.abs(pixels.astype(int) - expected)
    assert difference.max() <= 5
    assert difference.mean() < 0.3


def test_reach_holds_the_wave_vectors(view):
    low, high = frames.reach(view, LIGHTS)
    wide = frames.reach(view, LIGHTS, turning=True)
    for light in LIGHTS:
        for turn, (least, most) in ((0.0, (low, high)), (0.8, wide), (2.5, wide)):
            _, wi, wo = views.wave_vectors(view.turned(turn), light)
            wave = -(wi + wo)
            assert (wave >= least - 1e-12).all()
            assert (wave <= most + 1e-12).all()
    # Tight: a sphere under a light from the eye has u from -2 to 2, but for grazing views.
    ends = frames.reach(view, np.array([[0.0, 0.0, 1.0]]))
    assert ends[0, 2] == pytest.approx(-2.0, abs=2e-3)
    assert ends[1, 0] == pytest.approx(2.0 * math.sin(views.GRAZING), abs=0.05)


def test_light_beyond_the_table_adds_nothing(brdf, view, sphere):
    table = views.bake(brdf, np.array([[-0.1, -0.1, -2.0], [0.1, 0.1, -1.9]]), size=64)
    small = Frames(brdf, table, view)
    light = np.array([0.0, 0.0, 1.0])
    pixels = np.asarray(small(light, exposure=1.0))
    dark = np.asarray(sphere(light, exposure=1.0, lit=np.zeros(SIZE, bool)))
    inside = np.abs(2.0 * view.normal[..., :2]).max(-1) < 0.1
    outside = view.covered & (np.abs(2.0 * view.normal[..., :2]).max(-1) > 0.4)
    np.testing.assert_array_equal(pixels[outside], dark[outside])
    assert (pixels[inside & view.covered] > dark[inside & view.covered]).all()


def test_refusals(sphere, brdf, table):
    view = shapes.sphere(8)
    empty = shapes.View(
        *(getattr(view, n) for n in ("position", "tangent", "normal", "eye")),
        np.zeros_like(view.covered),
        view.neutral,
    )
    with pytest.raises(InputError, match="the view shows no material; expected a camera"):
        Frames(brdf, table, empty)
    with pytest.raises(InputError, match=r"light must be a vector of three; received shape \(2,\)"):
        sphere([0.0, 1.0], exposure=1.0)
    with pytest.raises(InputError, match="lights reach no visible part of the view"):
        frames.reach(view, np.array([[0.0, 0.0, -1.0]]))
