"""Pictures have content, and the physics in them is right."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

from diffopt import DiffractionBRDF, Heightfield, InputError, colour, samples
from diffopt.drawing import bands, pictures, shapes, tones, views

INCIDENCE = math.radians(20.0)
PITCH = 1.6
SIGMA = 1.6


@pytest.fixture(scope="module")
def disc():
    with jax.enable_x64(False):
        scan = samples.compact_disc(jax.random.key(0), shape=(128, 128), pixel=0.1)
        return DiffractionBRDF(scan, SIGMA)


@pytest.fixture(scope="module")
def dome(disc):
    with jax.enable_x64(False):
        return views.hemisphere(disc, views.incident(INCIDENCE, 0.0), size=160)


@pytest.fixture(scope="module")
def cut(disc):
    with jax.enable_x64(False):
        return views.in_plane(disc, INCIDENCE, 0.0, step_nm=10.0)


@pytest.fixture(scope="module")
def mirror():
    with jax.enable_x64(False):
        scan = Heightfield(jnp.zeros((64, 64), jnp.float32), 0.1)
        return DiffractionBRDF(scan, SIGMA)


@pytest.fixture(autouse=True)
def single_precision():
    with jax.enable_x64(False):
        yield


def half_width(wavelength):
    """Half the angular width lambda / (2 pi sigma_s) of the window, in direction sines."""
    return 0.5 * wavelength / (2.0 * math.pi * SIGMA)


@pytest.mark.parametrize("order", [-1, 1])
@pytest.mark.parametrize("wavelength", [0.45, 0.65])
def test_first_order_lies_where_the_grating_equation_puts_it(cut, order, wavelength):
    sine = np.sin(cut.angles)
    expected = order * wavelength / PITCH - math.sin(INCIDENCE)
    column = int(np.argmin(np.abs(cut.wavelengths - wavelength)))
    near = np.abs(sine - expected) < 0.08
    found = sine[near][np.argmax(cut.spectra[near, column])]
    assert abs(found - expected) < half_width(wavelength)


def test_mirror_direction_is_the_brightest_of_the_cut(cut):
    brightest = cut.angles[np.argmax(cut.xyz[:, 1])]
    # Angles are half a degree apart.
    assert math.degrees(brightest + INCIDENCE) == pytest.approx(0.0, abs=0.51)


def test_in_plane_spectra_keep_their_tolerance(disc, cut):
    some = slice(None, None, 16)
    direct = np.asarray(disc(cut.wi, cut.wo[some], cut.wavelengths))
    error = np.abs(cut.spectra[some] - direct).max() / cut.spectra.max()
    assert error < 1e-3
    assert cut.choice.error_bound <= 1e-3


def test_in_plane_colour_under_the_peak_balance_is_that_of_the_relative_reflectance(disc):
    brdf = DiffractionBRDF(
        Heightfield(disc.surface.heights, disc.surface.pixel), SIGMA, balance="peak"
    )
    cut = views.in_plane(brdf, INCIDENCE, 0.3, count=9, step_nm=50.0)
    rho = np.asarray(brdf.relative(cut.wi, cut.wo, cut.wavelengths))
    weights = colour.spectral_weights(cut.wavelengths)
    # The spectra are good to a thousandth of the largest, that of the method chosen.
    np.testing.assert_allclose(cut.xyz, rho @ weights, atol=2e-3 * (rho @ weights).max())


@pytest.mark.parametrize("side", [-1, 1])
def test_violet_lies_nearer_to_the_mirror_than_red(dome, side):
    row = dome.xyz[np.argmin(np.abs(dome.line))]
    u = side * (dome.line + math.sin(INCIDENCE))
    order = (u > 0.2) & (u < 0.5)
    blue = u[order][np.argmax(row[order, 2])]
    red = u[order][np.argmax(row[order, 0] - row[order, 2])]
    assert blue < red
    # Z peaks near 450 nm, X - Z near 610 nm, under a window of 50 nm or so; pixels are 0.0125.
    assert blue == pytest.approx(0.45 / PITCH, abs=0.03)
    assert red == pytest.approx(0.61 / PITCH, abs=0.04)


def test_hemisphere_of_a_mirror_is_a_spot_in_the_mirror_direction(mirror):
    wi = views.incident(math.radians(35.0), math.radians(60.0))
    dome = views.hemisphere(mirror, wi, size=100)
    j, i = np.unravel_index(np.argmax(dome.xyz[..., 1]), dome.xyz.shape[:2])
    # A pixel is 0.02 wide.
    assert dome.line[i] == pytest.approx(-wi[0], abs=0.021)
    assert dome.line[j] == pytest.approx(-wi[1], abs=0.021)
    # All of the light: the integral of f cos_i cos_o over solid angle is that of f cos_i over
    # the plane of direction cosines. The rest is the factor (cos_h / cos_o)^2 and such across
    # a lobe 0.05 wide, and the tails.
    total = dome.xyz[..., 1].sum() * 0.02**2 / wi[2]
    assert total == pytest.approx(1.0, abs=0.03)


def test_nothing_beyond_the_grazing_limit(dome):
    x, y = np.meshgrid(dome.line, dome.line)
    beyond = np.hypot(x, y) > math.sin(views.GRAZING)
    assert dome.xyz[beyond].max() == 0.0
    assert (dome.xyz[~beyond][:, 1] > 0).mean() > 0.99


def test_order_directions_obey_the_conical_grating_equation(rng):
    for _ in range(20):
        wi = views.incident(rng.uniform(0, 1.2), rng.uniform(0, 6))
        period, direction, wavelength = rng.uniform(1, 3), rng.uniform(-1, 1), 0.55
        order = int(rng.integers(-2, 3))
        wo = views.order_direction(wi, period, direction, order, wavelength)
        if wo is None:
            continue
        k = np.array([math.cos(direction), math.sin(direction), 0.0])
        across = np.cross([0.0, 0.0, 1.0], k)
        assert period * (wi + wo) @ k == pytest.approx(order * wavelength, abs=1e-12)
        assert (wi + wo) @ across == pytest.approx(0.0, abs=1e-12)
        assert np.linalg.norm(wo) == pytest.approx(1.0, abs=1e-12)
    assert views.order_direction(views.incident(0.0, 0.0), 0.5, 0.0, 1, 0.55) is None


def shot(brdf, view, light, size=64):
    lit, wi, wo = views.wave_vectors(view, light)
    assert lit.any()
    table = views.bake(brdf, -(wi + wo), size=size)
    return views.photograph(brdf, table, view, light)


def test_sphere_has_its_highlight_where_the_half_vector_is_the_normal(mirror):
    view, light = shapes.sphere(120), shapes.unit(np.array([-0.45, 0.5, 0.75]))
    image = shot(mirror, view, light, size=256)
    j, i = np.unravel_index(np.argmax(image.xyz[..., 1]), image.covered.shape)
    half = shapes.unit(light + np.array([0.0, 0.0, 1.0]))
    # A pixel turns the normal by one degree.
    angle = math.degrees(math.acos(min(1.0, float(view.normal[j, i] @ half))))
    assert angle < 1.5
    # Nothing reaches the side that the light does not.
    assert image.xyz[view.normal @ light <= 0].max() == 0.0


def test_rainbow_of_a_disc_runs_from_violet_inside_to_red_outside(disc):
    view = shapes.disc(160, eye=(0.0, -130.0, 190.0))
    light = view.towards(np.array([4.0, 114.0, 190.0]))
    image = shot(disc, view, light, size=160)
    radius = np.hypot(view.position[..., 0], view.position[..., 1])
    far = image.covered & (np.abs(view.position[..., 0]) < 2.0) & (view.position[..., 1] > 0)
    blue = radius[far][np.argmax(image.xyz[far][:, 2])]
    red = radius[far][np.argmax(image.xyz[far][:, 0] - image.xyz[far][:, 2])]
    assert shapes.RECORDED_RADII[0] < blue < red < shapes.RECORDED_RADII[1]
    # On this line both directions lie in the plane of the radius; u = -(sum of the sines).
    wi, wo = view.local(light), view.local(view.eye)
    u = np.abs(wi + wo)[..., 0]
    at_blue = u[far][np.argmax(image.xyz[far][:, 2])]
    assert at_blue == pytest.approx(0.45 / PITCH, abs=half_width(0.45) + 0.01)


def test_pictures_of_objects_show_object_and_ground(disc):
    view = shapes.disc(96, eye=(0.0, -130.0, 190.0))
    light = view.towards(np.array([4.0, 114.0, 190.0]))
    image = shot(disc, view, light)
    rgb = pictures.photograph(image, supersampling=2)
    assert rgb.shape == (48, 48, 3)
    assert rgb.min() >= 0
    assert rgb.max() <= 1
    corner, hub = rgb[0, 0], rgb[~view.covered[::2, ::2] & view.neutral[::2, ::2]]
    # Ground and hub are neutral, to the steps of the encoding in float32.
    np.testing.assert_allclose(corner, corner[0], atol=1e-6)
    np.testing.assert_allclose(np.median(hub, axis=0), np.median(hub), atol=5e-3)
    saturation = np.ptp(rgb, axis=-1)
    assert saturation.max() > 0.5, "no rainbow"


def test_a_picture_made_in_bands_is_the_whole_one(disc, monkeypatch):
    size, light = (44, 52), shapes.unit(np.array([-0.3, 0.6, 0.8]))
    whole = shapes.sheet(size).turned(0.4)

    def part(rows):
        return shapes.sheet(size, rows=rows).turned(0.4), light, None

    shot, held = bands.Shot(size, part), bands.Shot(size, lambda r: (whole.rows(r), light, None))
    once = bands.extremes([shot])
    monkeypatch.setattr(bands, "BAND", 640)
    parts = bands.bands(size)
    assert [p.start for p in parts] == [0, 12, 24, 36]
    assert parts[-1].stop == 44
    waves = bands.extremes([shot, held])
    np.testing.assert_array_equal(waves.min(axis=0), once.min(axis=0))
    np.testing.assert_array_equal(waves.max(axis=0), once.max(axis=0))
    table = views.bake(disc, waves, size=44)
    expected = views.photograph(disc, table, whole, light)
    for one in (shot, held):
        image = bands.photograph(disc, table, one)
        # Of the same numbers, rounded to float32.
        np.testing.assert_allclose(image.xyz, expected.xyz, rtol=1e-7)
        np.testing.assert_array_equal(image.covered, expected.covered)
    drawn = pictures.photograph(image, supersampling=2)
    monkeypatch.undo()
    np.testing.assert_allclose(drawn, pictures.photograph(expected, supersampling=2), atol=1e-6)


def test_pictures_without_light_are_refused(disc):
    behind = shapes.unit(np.array([0.0, 0.0, -1.0]))
    shot = bands.Shot((16, 16), lambda rows: (shapes.sphere(16, rows=rows), behind, None))
    with pytest.raises(InputError, match="no sample of the pictures is lit and seen"):
        bands.extremes([shot])


def test_tone_curve_keeps_hues_and_order(rng):
    rgb = rng.uniform(0, 1, (200, 3)) * 10.0 ** rng.uniform(-3, 3, (200, 1))
    out = tones.tone(rgb, 0.7, white=6.0)
    # Shares of the channels stay, to rounding.
    np.testing.assert_allclose(out / out.max(-1, keepdims=True), rgb / rgb.max(-1, keepdims=True))
    assert out.max() <= 1.0 + 1e-12
    order = np.argsort(rgb.max(-1))
    assert (np.diff(out.max(-1)[order]) >= -1e-12).all()
    assert tones.tone(np.full((1, 3), 6.0 / 0.7), 0.7).max() == pytest.approx(1.0)
    assert tones.tone(np.zeros((1, 3)), 1.0).max() == 0.0


def test_exposure_brings_the_percentile_to_one():
    rgb = np.linspace(0.0, 2.0, 201)[:, None] * [1.0, 0.5, 0.25]
    assert tones.exposure(rgb, 50.0) == pytest.approx(1.0)
    # A lone spot in the dark: the limit of a thousandth of the largest.
    spot = np.zeros((1000, 3))
    spot[0] = 5.0
    assert tones.exposure(spot) == pytest.approx(1.0 / 5e-3)
    assert tones.exposure(np.zeros((0, 3))) == 1.0


def test_display_colours_are_in_gamut_and_keep_luminance():
    lam = colour.wavelengths(10.0)
    lines = colour.spectral_weights(lam)
    rgb = tones.display(lines)
    assert rgb.min() >= 0.0
    row = np.linalg.inv(colour.rgb_matrix(colour.white_point("D65", lam)))[1]
    # float32 inside.
    np.testing.assert_allclose(rgb @ row, lines[:, 1], atol=1e-6)
    np.testing.assert_allclose(tones.display(lines.sum(0)[None]), 1.0, atol=1e-5)


@pytest.mark.parametrize(("wavelength", "channel"), [(0.65, 0), (0.53, 1), (0.45, 2)])
def test_swatches_of_spectral_lines(wavelength, channel):
    lam = colour.wavelengths(10.0)
    line = colour.spectral_weights(lam)[int(np.argmin(np.abs(lam - wavelength)))]
    assert int(np.argmax(tones.swatch(line))) == channel
    assert max(tones.swatch(line)) == pytest.approx(1.0, abs=1e-6)


def test_figures_are_written_with_axes_that_state_units(disc, dome, cut, tmp_path):
    scan = Heightfield(disc.surface.heights, disc.surface.pixel)
    figures = {
        "scan": pictures.scan(scan, scan.statistics(periodic=True)),
        "dome": pictures.hemisphere(dome, grating=(PITCH, 0.0)),
        "cut": pictures.in_plane(cut, period=PITCH),
    }
    words = {
        name: " ".join(
            text
            for axes in figure.axes
            for text in (axes.get_xlabel(), axes.get_ylabel(), axes.get_title())
        )
        for name, figure in figures.items()
    }
    assert "x / µm" in words["scan"]
    assert "height / nm" in words["scan"]
    assert "direction cosine" in words["dome"]
    assert "wavelength / nm" in words["cut"]
    assert "1/sr" in words["cut"]
    for name, figure in figures.items():
        path = pictures.save(figure, tmp_path / f"{name}.png")
        with PIL.Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"), np.float64)
        assert pixels.std() > 10.0, f"{name} is empty"


def test_drawn_orders_follow_the_grating_equation(cut):
    figure = pictures.in_plane(cut, period=PITCH)
    lines = {}
    for line in figure.axes[0].lines:
        degrees, nm = (np.asarray(v, np.float64) for v in line.get_data())
        total = np.sin(np.radians(degrees)) + math.sin(INCIDENCE)
        order = PITCH * total / (nm / 1000.0)
        np.testing.assert_allclose(order, np.round(order[0]), atol=1e-9)
        lines[round(order[0])] = len(nm)
    assert {-1, 0, 1, 2} <= set(lines)


def test_flat_scan_can_be_drawn(mirror, tmp_path):
    scan = Heightfield(mirror.surface.heights, mirror.surface.pixel)
    statistics = scan.statistics(periodic=True)
    assert pictures.save(pictures.scan(scan, statistics), tmp_path / "flat.png").stat().st_size
    assert not any(name == "dominant period" for name, _ in pictures.describe(scan, statistics))


def test_unusable_views_are_refused(mirror):
    with pytest.raises(InputError, match="incidence must lie between -90 and 90 degrees"):
        views.incident(math.radians(95.0), 0.0)
    with pytest.raises(InputError, match="azimuth must be a finite angle"):
        views.incident(0.1, math.nan)
    with pytest.raises(InputError, match="size must be at least 8 pixels; received 4"):
        views.hemisphere(mirror, views.incident(0.1, 0.0), size=4)
