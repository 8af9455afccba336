import dataclasses
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import colour
from diffopt.kernels import spectrum

DATA = json.loads((Path(__file__).parent / "data" / "colour.json").read_text())
LAM = np.array(DATA["wavelengths_nm"]) / 1000
CASES = {case["id"]: case for case in DATA["cases"]}


def peak_balanced(case):
    """Relative reflectance of a small heightfield by the direct sum, Schlick n = 1.5."""
    height = case["height"]
    nx, ny, step = height["nx"], height["ny"], height["T0_um"]
    i, j = np.meshgrid(np.arange(nx), np.arange(ny))
    x, y = (i - nx // 2) * step, (j - ny // 2) * step
    h = {
        "flat": lambda: np.full(i.shape, height["h0"]),
        "sin": lambda: height["a"] * np.cos(2 * np.pi * x / height["d"]),
        "r2noise": lambda: height["H"] * np.mod(0.7548776662466927 * i + 0.5698402909980532 * j, 1),
    }[height["kind"]]()
    wi, wo = np.array(case["wi"]), np.array(case["wo"])
    u, v, w = -(wi + wo)
    s2 = u * u + v * v + w * w
    geometry = s2**2 / (4 * wi[2] * wo[2] * w * w)
    r0 = 0.04
    fresnel = r0 + (1 - r0) * (1 - np.sqrt(s2) / 2) ** 5
    path = u * x + v * y + w * h
    amplitude = np.array([np.exp(2j * np.pi * path / lam).mean() for lam in LAM])
    return fresnel / r0 * geometry * wi[2] * np.abs(amplitude) ** 2


def test_weights_are_the_tables(dtype):
    table = np.array([DATA[name] for name in ("xbar", "ybar", "zbar")]).T
    power = np.array(DATA["D65"])
    step = np.full(81, 5.0)
    step[[0, -1]] = 2.5
    want = (step * power)[:, None] * table / (step * power * table[:, 1]).sum()
    np.testing.assert_allclose(colour.spectral_weights(LAM), want, rtol=1e-12, atol=1e-18)
    np.testing.assert_allclose(colour.wavelengths(), LAM, rtol=1e-15)
    xyz = spectrum.weights_to_xyz(jnp.ones(81, dtype), jnp.asarray(want, dtype))
    # Printed to eight decimals; 81 additions.
    np.testing.assert_allclose(xyz, DATA["white"], atol=1e-8 if dtype == "float64" else 1e-6)


def test_white_and_matrix():
    np.testing.assert_allclose(colour.white_point(), DATA["white"], atol=5e-9)  # printed digits
    np.testing.assert_allclose(colour.rgb_matrix(), DATA["rgb_matrix"], atol=5e-10)  # the same
    np.testing.assert_allclose(colour.rgb_matrix() @ colour.white_point(), 1.0, rtol=1e-14)


@pytest.mark.parametrize("name", CASES)
def test_colours_of_small_heightfields(name):
    case = CASES[name]
    xyz = jnp.asarray(peak_balanced(case) @ colour.spectral_weights(LAM))
    # Phases of some tens of radians, rounded: 1e-14; the reference has more digits.
    np.testing.assert_allclose(xyz, case["XYZ"], atol=1e-9)
    np.testing.assert_allclose(colour.xyz_to_linear(xyz), case["linear_rgb"], atol=1e-9)


@pytest.mark.parametrize(("power", "name"), [(2, "mirror_lambda2"), (-2, "mirror_lambda-2")])
def test_colour_of_a_mirror_under_either_balance(power, name):
    """A mirror's lobe (peak balance) and its peak (radiometric balance) are not white."""
    xyz = LAM**power @ colour.spectral_weights(LAM)
    xyz /= xyz[1]
    np.testing.assert_allclose(xyz[:2] / xyz.sum(), DATA[name]["xy"], atol=5e-5)  # printed digits
    got = colour.xyz_to_linear(jnp.asarray(xyz))
    np.testing.assert_allclose(got, DATA[name]["linear_rgb"], atol=5e-4)  # printed digits


@pytest.mark.parametrize("light", ["D65", "A", "E"])
@pytest.mark.parametrize("step", [1.0, 5.0, 10.0, 20.0])
def test_mirror_is_white_at_any_step(light, step, dtype):
    lam = colour.wavelengths(step)
    xyz = jnp.asarray(colour.white_point(light, lam), dtype)
    linear = colour.xyz_to_linear(xyz, illuminant=light, wavelengths_um=lam)
    assert linear.dtype == dtype
    # Three products of size up to 3, rounded.
    np.testing.assert_allclose(linear, 1.0, atol=10 * float(jnp.finfo(dtype).eps))
    assert abs(float(xyz[1]) - 1.0) < 1e-6


@pytest.mark.parametrize(
    ("light", "xy"),
    # Chromaticities of the CIE 1931 observer in CIE 15:2004, table T.3.
    [("D65", (0.31272, 0.32903)), ("A", (0.44758, 0.40745)), ("E", (1 / 3, 1 / 3))],
)
def test_published_white_points(light, xy):
    white = colour.white_point(light)
    # The published sums go from 360 to 830 nm; the ends hold some 1e-5 of the light.
    np.testing.assert_allclose(white[:2] / white.sum(), xy, atol=3e-5)


def test_adaptation():
    """Without adaptation lamp light is orange; with it a mirror is white and Y survives."""
    white = jnp.asarray(colour.white_point("A"))
    red, green, blue = colour.xyz_to_linear(white, illuminant="A", adaptation="none")
    assert red > 1.5 > green > 0.5 > blue > 0
    same = colour.xyz_to_rgb_matrix("D65", adaptation="white")
    np.testing.assert_allclose(same, colour.xyz_to_rgb_matrix("D65", adaptation="none"), atol=1e-14)
    with pytest.raises(ValueError, match="adaptation: 'cat16' given, expected one of white, none"):
        colour.xyz_to_rgb_matrix("A", adaptation="cat16")


def test_given_illuminant():
    """A constant power is E; the unit of the power has no effect; linear in between."""
    flat = colour.spectral_weights(LAM, ([0.3, 0.8], [3.0, 3.0]))
    np.testing.assert_allclose(flat, colour.spectral_weights(LAM, "E"), rtol=1e-12)
    light = colour.illuminant(([0.3, 0.8], [0.0, 5.0]))
    np.testing.assert_allclose(light.at(np.array([0.4, 0.55])), [1.0, 2.5], rtol=1e-14)
    assert colour.illuminant(light) is light
    assert hash(light) == hash(colour.illuminant(([0.3, 0.8], [0.0, 5.0])))


def test_uneven_wavelengths_integrate_the_same():
    uneven = np.concatenate([0.38 + 0.002 * np.arange(90), 0.56 + 0.004 * np.arange(56)])

    def smooth(lam):
        return 0.5 + 0.4 * np.sin(12 * lam)

    fine = colour.wavelengths(1.0)
    want = smooth(fine) @ colour.spectral_weights(fine)
    # Second differences of D65's lines at 2 to 4 nm: some 1e-4.
    got = smooth(uneven) @ colour.spectral_weights(uneven)
    np.testing.assert_allclose(got, want, atol=5e-4)


def test_three_band_keeps_moments():
    """Exact for a constant and a slope with one sample each, a parabola with two."""
    for light in ("D65", "A", "E"):
        weights = colour.spectral_weights(LAM, light)
        for samples, degree in ((1, 1), (2, 2), (3, 2)):
            bands, table = colour.three_band(LAM, light, samples=samples)
            assert bands.shape == (3 * samples,)
            assert table.shape == (3 * samples, 3)
            assert (np.diff(bands) > 0).all()
            for power in range(degree + 1):
                # Sums of 81 terms of order 1.
                np.testing.assert_allclose(
                    bands**power @ table, LAM**power @ weights, rtol=1e-12, err_msg=str(power)
                )


def test_three_band_error_on_smooth_spectra():
    """On broad bumps: better than at 700, 561 and 436 nm, and better with more samples."""
    weights = colour.spectral_weights(LAM)
    centres, widths = np.meshgrid(np.arange(0.4, 0.75, 0.03), [0.05, 0.1])

    def bump(lam):
        d = (lam - centres.ravel()[:, None]) / widths.ravel()[:, None]
        return 0.1 + 0.7 * np.exp(-0.5 * d**2)

    exact = bump(LAM) @ weights

    def error(lam, table):
        return colour.delta_e_2000(bump(lam) @ table, exact).mean()

    one, two = (error(*colour.three_band(samples=n)) for n in (1, 2))
    # Three spectral primaries of the colour of white in linear RGB, as for three phosphors.
    book = error(np.array([0.700, 0.561, 0.436]), np.linalg.inv(colour.rgb_matrix()).T)
    assert two < one < book


def test_three_band_errors():
    with pytest.raises(ValueError, match="samples: 0 given, expected at least 1"):
        colour.three_band(samples=0)
    sodium = ([0.3, 0.587, 0.589, 0.591, 0.8], [0.0, 0.0, 1.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="illuminant 'given': too little light in one of"):
        colour.three_band(colour.wavelengths(1.0), sodium)


def test_pictures(dtype, rng):
    lines = jnp.asarray(20 * colour.spectral_weights(LAM), dtype)  # every spectral line
    raw = colour.xyz_to_srgb(lines, gamut="none")
    assert (raw.min(axis=-1) < 0).sum() > 60  # nearly all lie outside
    for gamut in ("desaturate", "clip"):
        picture = colour.xyz_to_srgb(lines, gamut=gamut)
        assert picture.dtype == dtype
        assert (picture >= 0).all()
        assert (picture <= 1).all()
    # The encoding of 1 is 1.055 - 0.055, rounded.
    white = jnp.asarray(colour.white_point(), dtype)
    np.testing.assert_allclose(colour.xyz_to_srgb(white), 1.0, atol=1e-6)
    grey = colour.xyz_to_srgb(white, exposure=0.21404114)
    np.testing.assert_allclose(grey, 0.5, atol=1e-6)  # eight digits given
    assert (colour.xyz_to_srgb(0 * white) == 0).all()


def test_picture_keeps_luminance():
    """A desaturated picture, decoded, has the luminance that it was given."""
    xyz = jnp.asarray(2.0 * colour.spectral_weights(LAM))
    decoded = spectrum.decode_srgb(colour.xyz_to_srgb(xyz))
    below_cut = np.asarray(decoded.max(axis=-1)) < 1
    luminance = decoded @ jnp.asarray(np.linalg.inv(colour.rgb_matrix())[1])
    assert below_cut.sum() > 70
    # The joint of the sRGB curve: 3e-8.
    np.testing.assert_allclose(luminance[below_cut], xyz[below_cut, 1], atol=1e-7)


def test_pictures_have_gradients(dtype):
    xyz = jnp.asarray([[0.0, 0.0, 0.0], [0.3, 0.4, 0.1], [0.9504, 1.0, 1.0887]], dtype)
    for gamut in spectrum.GAMUTS:
        picture = jax.jit(lambda c, g=gamut: colour.xyz_to_srgb(c, gamut=g).sum())
        assert np.isfinite(jax.grad(picture)(xyz)).all()


def test_agrees_with_the_textbook_matrix():
    """The standard's matrix has a white of four decimals: it differs in the fourth place."""
    published = np.array(
        [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    )
    np.testing.assert_allclose(colour.rgb_matrix(), published, atol=5e-4)
    xy_white = np.array([0.3127, 0.3290])
    white = np.array([*xy_white, 1 - xy_white.sum()]) / xy_white[1]
    # Four decimals are printed.
    np.testing.assert_allclose(colour.rgb_matrix(white), published, atol=4e-4)


def test_delta_e():
    """Grey against grey: for dL alone DE2000 = dL / S_L (Sharma et al. 2005, eq. 15)."""
    white = colour.white_point()
    first, second = 0.18, 0.2
    lightness = 116 * np.cbrt([first, second]) - 16
    middle = lightness.mean() - 50
    scale = 1 + 0.015 * middle**2 / np.sqrt(20 + middle**2)
    got = colour.delta_e_2000(first * white, second * white)
    # The white is rounded to a chromaticity on the way: chroma of some 1e-12.
    np.testing.assert_allclose(got, (lightness[1] - lightness[0]) / scale, rtol=1e-7)
    many = colour.delta_e_2000(np.tile(white, (4, 2, 1)), np.tile(white, (4, 2, 1)))
    assert many.shape == (4, 2)
    np.testing.assert_allclose(many, 0.0, atol=1e-6)


def test_settings():
    lam, weights = colour.ColourSettings().quadrature()
    assert lam.shape == (81,)
    np.testing.assert_allclose(weights, colour.spectral_weights(LAM), rtol=1e-12)
    lam, weights = colour.ColourSettings(bands="three", illuminant="A").quadrature()
    assert lam.shape == (3,)
    np.testing.assert_allclose(weights.sum(axis=0), colour.white_point("A"), rtol=1e-13)
    lam, _ = colour.ColourSettings(step_nm=2.5, illuminant="E").quadrature()
    assert lam.shape == (161,)
    for settings in (
        colour.ColourSettings(step_nm=20.0, illuminant="A"),
        colour.ColourSettings(bands="three", samples=2, illuminant="A"),
    ):
        lam, weights = settings.quadrature()
        picture = settings.picture(jnp.asarray(weights.sum(axis=0)))
        np.testing.assert_allclose(picture, 1.0, atol=1e-12)
    orange = dataclasses.replace(settings, adaptation="none", exposure=0.3)
    picture = orange.picture(jnp.asarray(weights.sum(axis=0)))
    assert picture[0] > picture[1] > picture[2]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"step_nm": 0.0}, "step_nm: 0 given, expected a divisor of 400"),
        ({"step_nm": 7.0}, "step_nm: 7 given, expected a divisor of 400"),
        ({"illuminant": "D99"}, r"^illuminant: 'D99' given, expected one of D65, [^\n]{,80}$"),
        ({"bands": "two"}, "bands: 'two' given, expected one of full, three"),
        ({"gamut": "wrap"}, "gamut: 'wrap' given"),
        ({"adaptation": "eye"}, "adaptation: 'eye' given"),
        ({"samples": 0}, "samples: 0 given"),
        ({"exposure": 0.0}, "exposure: 0 given, expected above 0"),
    ],
)
def test_bad_settings(change, message):
    with pytest.raises(ValueError, match=message):
        colour.ColourSettings(**change)


def test_bad_wavelengths_and_lights():
    with pytest.raises(ValueError, match=r"illuminant 'D65': wavelengths 0\.4 to 0\.8 um given"):
        colour.spectral_weights([0.4, 0.6, 0.8])
    with pytest.raises(ValueError, match=r"observer CIE .*: wavelengths 400 to 700 um given"):
        colour.spectral_weights([400.0, 700.0])  # nanometres by mistake
    with pytest.raises(ValueError, match="wavelengths_um: expected one ascending sequence"):
        colour.spectral_weights([0.5, 0.4])
    with pytest.raises(ValueError, match="1 given, the trapezoid rule needs at least 2"):
        colour.spectral_weights([0.5])
    with pytest.raises(ValueError, match="2 wavelengths and 3 powers given"):
        colour.illuminant(([0.4, 0.5], [1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="powers between -1 and 1 given"):
        colour.illuminant(([0.4, 0.5], [-1.0, 1.0]))
    with pytest.raises(ValueError, match="no visible light at the given wavelengths"):
        colour.spectral_weights(LAM, ([0.3, 0.37, 0.371, 0.8], [1.0, 1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"white: XYZ \(1\.0, 0\.0, 0\.0\) given"):
        colour.rgb_matrix([1.0, 0.0, 0.0])


def test_tables_are_not_shared():
    weights = colour.spectral_weights(LAM)
    weights[:] = 0.0
    assert colour.spectral_weights(LAM)[:, 1].sum() == pytest.approx(1.0)
