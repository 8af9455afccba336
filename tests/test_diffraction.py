"""Physics of the diffraction BRDF: angles, energy, reciprocity, white, limits."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import jv

import diffopt as do
from diffopt import colour, fresnel
from reference import directions

LAMBDAS = np.array([0.42, 0.48, 0.55, 0.6, 0.68])


def in_plane(angles):
    """Unit vectors in the x-z plane at signed angles (radians) from the normal."""
    return np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], -1)


GRATINGS = {
    "sinusoidal": do.gratings.Sinusoidal(3.2, 0.12),
    "blazed": do.gratings.Blazed(3.2, 0.2),
}
SAMPLING = {"sinusoidal": {}, "blazed": {"edges": "sharp"}}


@pytest.mark.parametrize("kind", ["sinusoidal", "blazed"])
@pytest.mark.parametrize("theta", [0.0, 20.0])
def test_orders_stand_at_the_grating_angles(kind, theta):
    """d (sin ti + sin tm) = m lambda, within half the window's angular width."""
    grating = GRATINGS[kind]
    # 25.6 um across: eight periods
    row = np.asarray(grating.heights((2, 512), (0.8, 0.05), **SAMPLING[kind]))[:1]
    scan = do.Heightfield(np.tile(row, (32, 1)), (0.8, 0.05))
    sigma, period = 2.0, 3.2
    brdf = do.DiffractionBRDF(scan, sigma)
    wi = in_plane(np.radians([theta]))[0]
    found = 0
    for lam in LAMBDAS:
        for m in range(-3, 4):
            sine = m * lam / period - wi[0]
            if abs(sine) > 0.85:
                continue
            width = lam / (2 * np.pi * sigma)
            sines = sine + np.linspace(-1.5, 1.5, 61) * width
            wo = in_plane(np.arcsin(sines))
            values = np.asarray(brdf.relative(wi, wo, np.array([lam])))[:, 0]
            # The tail of a neighbour, 3.9 sigma_f away, can hide an order below 1 %.
            kappa = -2 * np.pi / lam * (wi[2] + np.sqrt(1 - sine**2))
            if float(grating.order_efficiency(m, jnp.asarray(kappa))) < 0.01:
                continue
            assert abs(sines[np.argmax(values)] - sine) <= width / 2, (lam, m)
            found += 1
    assert found >= (20 if kind == "sinusoidal" else 9)


def test_sinusoid_efficiencies_are_bessel_functions():
    """|c_m|^2 = J_m(k w a)^2 at the orders of one period, for five wavelengths."""
    amplitude, period = 0.12, 3.2
    one = do.Heightfield(
        do.gratings.Sinusoidal(period, amplitude).heights((2, 128), (0.5, period / 128)),
        (0.5, period / 128),
    )
    brdf = do.DiffractionBRDF(one, None)
    wi = in_plane(np.radians([15.0]))[0]
    for lam in LAMBDAS:
        for m in range(-3, 4):
            sine = m * lam / period - wi[0]
            wo = in_plane(np.arcsin([sine]))[0]
            rho = float(brdf.relative(wi, wo, np.array([lam]))[0])
            w = -(wi[2] + wo[2])
            s2 = float(np.square(wi + wo).sum())
            q = s2**2 / (4 * wi[2] * wo[2] * w**2)
            expected = q * wi[2] * jv(m, 2 * np.pi / lam * w * amplitude) ** 2
            # The rectangle rule over a smooth period is exact to rounding.
            assert rho == pytest.approx(expected, abs=1e-12)


def mirror(sigma=3.0, **options):
    scan = do.samples.flat(shape=(32, 32), pixel=8 * sigma / 32)
    return do.DiffractionBRDF(scan, sigma, **options)


def lobe(wi, lam, sigma, count=161, reach=7.0):
    """Directions around the mirror direction of wi and their du dv."""
    width = reach * lam / (2 * np.pi * sigma)
    t = np.linspace(-width, width, count)
    x, y = np.meshgrid(t - wi[0], t - wi[1])
    z2 = 1 - x**2 - y**2
    inside = z2 > 0
    wo = np.stack([x, y, np.sqrt(np.where(inside, z2, 1.0))], -1)
    return wo, inside * (t[1] - t[0]) ** 2


@pytest.mark.parametrize("average", ["positions", "window"])
@pytest.mark.parametrize(("sigma", "theta"), [(3.0, 0.0), (10.0, 0.0), (10.0, 40.0)])
def test_mirror_conserves_energy(average, sigma, theta):
    wi = in_plane(np.radians([theta]))[0]
    wo, area = lobe(wi, 0.55, sigma)
    f = np.asarray(mirror(sigma, average=average)(wi, wo, np.array([0.55])))[..., 0]
    # 1.0004 at sigma = 3 um, falling as (lambda/sigma)^2: the obliquity over the lobe.
    assert float((f * area).sum()) == pytest.approx(1.0, abs=0.05 * (0.55 / sigma) ** 2 + 1e-6)


def test_extended_white_source_on_a_mirror_is_white():
    """Integrated over its lobe, f has the illuminant's white; the peak balance is orange."""
    sigma = 10.0
    wi = np.array([0.0, 0.0, 1.0])
    lam = colour.wavelengths(20.0)
    # 61 points over 14 widths: the trapezoid rule over a Gaussian is exact to exp(-50).
    wo, area = lobe(wi, 0.78, sigma, count=61)
    weights = colour.spectral_weights(lam)
    for balance, expected in (("radiometric", None), ("peak", (1.316, 0.945, 0.620))):
        brdf = mirror(sigma, balance=balance)
        call = brdf if balance == "radiometric" else brdf.relative
        spectrum = (np.asarray(call(wi, wo, lam)) * area[..., None]).sum((0, 1))
        xyz = spectrum @ weights
        if expected is None:
            white = colour.white_point("D65", lam)
            # the obliquity of a lobe 0.03 wide: (lambda / sigma)^2 / 50
            np.testing.assert_allclose(xyz, white, rtol=1e-4)
        else:
            rgb = colour.xyz_to_linear(xyz / xyz[1], wavelengths_um=lam)
            # figures quoted to three digits on a 5 nm rule; 20 nm steps here
            np.testing.assert_allclose(rgb, expected, atol=5e-3)


def test_mirror_peak_balances():
    wi = in_plane(np.radians([30.0]))[0]
    wo = wi * [-1, -1, 1]
    peak = mirror(balance="peak").xyz(wi, wo)
    np.testing.assert_allclose(peak, colour.white_point() * np.cos(np.radians(30)), rtol=1e-12)
    blue = colour.xyz_to_linear(mirror().xyz([0, 0, 1.0], [0, 0, 1.0]))
    # lambda^-2 weighted: quoted as (0.721, 1.027, 1.552)
    np.testing.assert_allclose(blue / blue[0] * 0.721, (0.721, 1.027, 1.552), atol=2e-3)


def scan_of(kind="rough", dtype="float64"):
    key = jax.random.key(5)
    scan = do.samples.gaussian_roughness(
        key, shape=(64, 64), pixel=0.1, rms=0.08, correlation_length=0.7
    )
    return do.Heightfield(scan.heights.astype(dtype), scan.pixel)


@pytest.mark.parametrize("prefactor", ["stam", "rohs", "rghs", "kirchhoff"])
def test_reciprocity(prefactor, rng):
    brdf = do.DiffractionBRDF(
        scan_of(), 0.8, prefactor=prefactor, fresnel=fresnel.Dielectric(1.5), shadowing="v-cavity"
    )
    wi, wo = directions(rng, 20), directions(rng, 20)
    a, b = brdf(wi, wo, LAMBDAS), brdf(wo, wi, LAMBDAS)
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_prefactors_are_related_as_published(rng):
    """Stam's model with reflectance 1 is RGHS / cos^4 of the half vector (Yan et al. 2018)."""
    wi, wo = directions(rng, 20), directions(rng, 20)
    models = {
        name: np.asarray(do.DiffractionBRDF(scan_of(), 0.8, prefactor=name)(wi, wo, LAMBDAS))
        for name in ("stam", "ohs", "ghs", "rohs", "rghs")
    }
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    np.testing.assert_allclose(models["stam"], models["rghs"] / half[:, 2:] ** 4, rtol=1e-11)
    c = wi[:, 2:], wo[:, 2:]
    ratio = (c[0] + c[1]) ** 2 / (4 * c[0] * c[1]) / (c[1] / c[0])
    np.testing.assert_allclose(models["rghs"] / models["ghs"], ratio * np.ones((1, 5)), rtol=1e-11)
    np.testing.assert_allclose(models["rohs"] / models["ohs"], ratio * np.ones((1, 5)), rtol=1e-11)


def test_kirchhoff_agrees_with_stam_up_to_edge_terms(rng):
    """Integration by parts turns one into the other, but for the window's own slope."""
    x = np.arange(128) * 0.05
    heights = 0.05 * np.cos(2 * np.pi * x / 1.6)[None, :] * np.ones((128, 1))
    scan = do.Heightfield(jnp.asarray(heights), 0.05)
    wi, wo = directions(rng, 40, 40.0), directions(rng, 40, 40.0)
    stam = np.asarray(do.DiffractionBRDF(scan, None)(wi, wo, LAMBDAS))
    facets = np.asarray(do.DiffractionBRDF(scan, None, prefactor="kirchhoff")(wi, wo, LAMBDAS))
    bright = stam > 0.05 * stam.max()
    assert bright.any()
    # slopes by central differences, (2 pi dx / d)^2 / 6 = 0.6 %, and the cut edges
    np.testing.assert_allclose(facets[bright], stam[bright], rtol=0.08)


def test_blur_is_the_convolution_over_directions():
    """The closed form against a sum over a Gaussian source, at one wavelength."""
    scan, sigma, blur, lam = scan_of(), 0.8, 0.04, np.array([0.55])
    sharp = do.DiffractionBRDF(scan, sigma)
    soft = do.DiffractionBRDF(scan, sigma, blur=blur)
    wave = np.array([0.11, -0.23, -1.8])
    t = np.linspace(-6, 6, 41) * blur
    du, dv = np.meshgrid(t, t)
    waves = wave + np.stack([du, dv, 0 * du], -1).reshape(-1, 3)
    weight = np.exp(-(du**2 + dv**2) / (2 * blur**2)).ravel()
    intensity = do.diffraction.intensity
    each = intensity(sharp, jnp.asarray(waves), jnp.asarray(lam), do.DirectSettings())[:, 0]
    got = intensity(soft, jnp.asarray(wave[None]), jnp.asarray(lam), do.DirectSettings())[0, 0]
    # trapezoid rule over a Gaussian to 6 sigma: exp(-18) = 2e-8
    assert float(got) == pytest.approx(float(weight @ np.asarray(each) / weight.sum()), rel=1e-6)


def test_mirror_apart_adds_up(rng):
    """f with the mirror included is f without it plus the mirror's share in its lobe."""
    scan, lam = scan_of(), np.array([0.55])
    whole = do.DiffractionBRDF(scan, 0.8)
    rest = do.DiffractionBRDF(scan, 0.8, mirror="apart")
    wi = in_plane(np.radians([25.0]))[0]
    wo = wi * [-1, -1, 1]
    share = float(rest.mirror_reflectance(wi[2], lam)[0])
    assert 0.01 < share < 0.9
    difference = float((whole.relative(wi, wo, lam) - rest.relative(wi, wo, lam))[0])
    assert difference == pytest.approx(share * wi[2], rel=1e-10)
    pair = directions(rng, 6), directions(rng, 6)
    for settings in (do.SeparableSettings(nodes=18), do.TaylorSettings(terms=36, reach=9)):
        fast = rest.prepare(pairs=pair, wavelengths=lam, settings=settings)
        expected = rest(*pair, lam)
        np.testing.assert_allclose(fast(*pair), expected, atol=1e-6 * float(expected.max()))


def test_below_the_horizon_is_zero_with_finite_gradients(dtype):
    brdf = do.DiffractionBRDF(scan_of(dtype=dtype), 0.8, fresnel=fresnel.Dielectric(1.5))
    up = jnp.asarray([0.6, 0.0, 0.8], dtype)
    for other in ([0.6, 0.0, -0.8], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]):
        down = jnp.asarray(other, dtype)
        lam = jnp.asarray([0.5], dtype)
        assert float(brdf(up, down, lam)[0]) == 0.0
        assert float(brdf(down, up, lam)[0]) == 0.0
        slope = jax.grad(lambda d, lam=lam: brdf(up, d, lam)[0])(down)
        np.testing.assert_array_equal(slope, 0.0)


@pytest.mark.parametrize("angle", [80.0, 89.0, 89.9, 89.99])
def test_grazing_values_and_gradients_are_finite(angle, dtype):
    brdf = do.DiffractionBRDF(scan_of(dtype=dtype), 0.8, fresnel=fresnel.Dielectric(1.5))
    lam = jnp.asarray([0.5], dtype)
    wi = jnp.asarray(in_plane(np.radians([angle]))[0], dtype)
    for wo in (wi, wi * jnp.asarray([-1, -1, 1], dtype), jnp.asarray([0, 0, 1], dtype)):
        value, slopes = jax.value_and_grad(
            lambda a, b: jnp.log(brdf(a, b, lam)[0]), argnums=(0, 1)
        )(wi, wo)
        assert bool(jnp.isfinite(value))
        assert all(bool(jnp.isfinite(s).all()) for s in slopes)


def test_twenty_wavelengths_deep_in_float32(rng):
    """Deep heights keep float32 within the rounding of their phases."""
    heights = rng.uniform(0, 11.0, (48, 48))
    wi, wo = directions(rng, 10), directions(rng, 10)
    values = [
        np.asarray(
            do.DiffractionBRDF(do.Heightfield(jnp.asarray(heights, t), 0.1), 0.6)(wi, wo, LAMBDAS)
        )
        for t in ("float32", "float64")
    ]
    # 2 pi 58 turns of 6e-8 each is 2e-5 of the mirror, over sqrt(700) samples in a window.
    scale = np.abs(values[1]).max()
    assert np.abs(values[0] - values[1]).max() < 3e-4 * scale


def average_over_surfaces(make, sigma, wi, wo, lam, count):
    """Mean and standard error of f without the mirror part over generated surfaces."""
    values = []
    for seed in range(count):
        brdf = do.DiffractionBRDF(make(seed), sigma, mirror="apart")
        values.append(np.asarray(brdf(wi, wo, lam)))
    values = np.array(values)
    return values.mean(0), values.std(0) / np.sqrt(count)


@pytest.mark.parametrize("rms", [0.02, 0.15])
def test_gaussian_roughness_is_the_mean_over_surfaces(rms):
    length = 0.6

    def make(seed):
        scan = do.samples.gaussian_roughness(
            jax.random.key(seed), shape=(128, 128), pixel=0.1, rms=rms, correlation_length=length
        )
        return do.Heightfield(scan.heights, scan.pixel)

    wi = in_plane(np.radians([20.0]))[0]
    wo = in_plane(np.radians([-60.0, -20.0, -5.0, 10.0, 40.0]))
    lam = np.array([0.45, 0.65])
    mean, error = average_over_surfaces(make, 1.6, wi, wo, lam, 24)
    closed = np.asarray(do.GaussianRoughness(rms, length)(wi, wo, lam))
    # The window blurs the density by lambda / (2 pi sigma sqrt 2) = 0.03 in u; with the
    # curvature of the density that is 2 % here. Five standard errors for ten values.
    np.testing.assert_array_less(np.abs(mean - closed), 5 * error + 0.02 * closed + 1e-4)
    share = do.GaussianRoughness(rms, length).mirror_reflectance(np.cos(np.radians(20.0)), lam)
    surface = do.DiffractionBRDF(make(1), 1.6, mirror="apart")
    expected = np.exp(-((2 * np.pi / lam * 2 * np.cos(np.radians(20)) * rms) ** 2))
    np.testing.assert_allclose(share, expected, rtol=1e-9)
    got = surface.mirror_reflectance(np.cos(np.radians(20.0)), lam)
    # one surface of 12.8 um holds about 450 correlation areas
    np.testing.assert_allclose(got, expected, atol=0.1)


@pytest.mark.long
def test_random_bumps_are_the_mean_over_surfaces():
    """Stam's closed form against sparse bumps placed at random on a periodic patch."""
    height, sigma, density = 0.1, (0.35, 0.2), 0.25

    def make(seed):
        scan = do.samples.random_bumps(
            jax.random.key(seed),
            shape=(128, 128),
            pixel=0.1,
            height=height,
            sigma=sigma,
            density=density,
        )
        return do.Heightfield(scan.heights, scan.pixel)

    wi = in_plane(np.radians([10.0]))[0]
    wo = in_plane(np.radians([-45.0, -25.0, 15.0, 35.0]))
    lam = np.array([0.45, 0.65])
    mean, error = average_over_surfaces(make, 1.6, wi, wo, lam, 16)
    closed = np.asarray(do.RandomBumps(height, sigma, density)(wi, wo, lam))
    # First order in the bumps' cover, density * A(0)/2 with A(0) of about 2 pi sx sy
    # |exp(ikH) - 1|^2 / 2: up to a quarter; the window's blur adds 3 %.
    np.testing.assert_array_less(np.abs(mean - closed), 5 * error + 0.25 * closed)
    assert np.all(error < 0.2 * closed)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"coherence": 0.0}, "coherence must lie between the pixel"),
        ({"coherence": 9.0}, "half the patch"),
        ({"coherence": np.ones(2)}, "one length in micrometres"),
        ({"coherence": 0.8, "average": "mean"}, "average must be one of positions, window"),
        ({"coherence": 0.8, "prefactor": "beckmann"}, "prefactor must be one of stam"),
        ({"coherence": 0.8, "blur": -0.1}, "blur must be a standard deviation >= 0"),
        ({"coherence": 0.8, "blur": 0.1, "average": "window"}, "blur needs average='positions'"),
        ({"coherence": None, "mirror": "apart"}, "mirror='apart' needs average='positions'"),
        ({"coherence": 0.8, "repeats": (2, 2)}, "repeats needs coherence=None"),
        ({"coherence": None, "repeats": (0, 2)}, r"repeats must be two integers \(y, x\) >= 1"),
        ({"coherence": 0.8, "shadowing": "smith"}, "shadowing must be one of none, v-cavity"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(do.InputError, match=message):
        do.DiffractionBRDF(scan_of(), options.pop("coherence"), **options)


@pytest.mark.parametrize(
    ("wi", "lam", "message"),
    [
        ([0, 0, 2.0], [0.5], "wi must be unit vectors; received one of length 2"),
        ([0, 0.0], [0.5], r"wi must be unit vectors \[..., 3\]; received shape \(2,\)"),
        ([0, 0, np.nan], [0.5], "wi must be unit vectors"),
        ([0, 0, 1.0], [0.0], "wavelengths must be positive and in micrometres; received 0"),
        ([0, 0, 1.0], [550.0], r"nanometres\? divide by 1000"),
        ([0, 0, 1.0], [np.nan], "wavelengths must be positive"),
        ([0, 0, 1.0], [], "at least one value"),
        ([0, 0, 1.0], [[0.5]], r"must be a vector \[L\]"),
    ],
)
def test_directions_and_wavelengths_out_of_range_are_refused(wi, lam, message):
    brdf = mirror()
    with pytest.raises(do.InputError, match=message):
        brdf(wi, [0, 0, 1.0], np.array(lam))


def test_patch_error_is_reported_apart():
    scan = do.samples.flat(shape=(64, 64), pixel=0.1)
    estimates = [do.DiffractionBRDF(scan, 6.4 / n).patch_error() for n in (4, 6, 8)]
    assert estimates == pytest.approx([0.091, 0.0054, 1.27e-4], rel=0.01)
    assert do.DiffractionBRDF(scan, None).patch_error() == 0.0
