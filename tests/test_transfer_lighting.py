"""Light averaged over lobes: three methods against quadrature and against each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

from diffopt import InputError, Lobes
from diffopt.scenes import (
    Ambient,
    Directional,
    Environment,
    Flood,
    LobeEnvironment,
    Point,
)
from diffopt.scenes.channels import Channels
from diffopt.transfer import prefiltering
from diffopt.transfer.distant import HarmonicLight, Lights, LobeLight, Suns
from diffopt.transfer.lighting import HarmonicSettings, prepare
from diffopt.transfer.pyramid import Pyramid, PyramidSettings

RGB = Channels()
COLOURS = np.array([1.0, 0.5, 0.25])
COARSE = PyramidSettings(size=128, sharpest=256.0)
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def lobes(rng, count, low=-1.0, high=2.4):
    return unit(rng.normal(size=(count, 3))), 10 ** rng.uniform(low, high, count)


@jax.jit
def averaged(light, mu, kappa):
    return light.radiance(mu, kappa)


def radiance(light, mu, kappa, dtype=jnp.float32):
    return np.asarray(averaged(light, jnp.asarray(mu, dtype), jnp.asarray(kappa, dtype)))


def brute(image, mu, kappa, axes=None):
    """Sums over all pixels, in float64."""
    height, width = image.shape[:2]
    theta = (np.arange(height)[:, None] + 0.5) * np.pi / height
    phi = (np.arange(width) + 0.5) * 2 * np.pi / width
    x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
    d = np.stack([x, y, np.cos(theta) + 0 * x], -1)
    d = d if axes is None else d @ axes
    solid = np.cos(theta - np.pi / height / 2) - np.cos(theta + np.pi / height / 2) + 0 * x
    found = []
    for axis, k in zip(mu, kappa, strict=True):
        weight = solid * np.exp(-k * ((d - axis) ** 2).sum(-1) / 2)
        found.append((weight[..., None] * image).sum((0, 1)) / weight.sum())
    return np.stack(found)


def map_of(function, height=64, width=128):
    """Map of a function of unit vectors, in colours."""
    d = prefiltering.pixel_directions(height, width)
    return function(d)[..., None] * COLOURS


def smooth(d):
    return 2.0 + d[..., 2] + 0.5 * d[..., 0] * d[..., 1] + 0.3 * d[..., 2] ** 2


@pytest.mark.parametrize("method", ["pyramid", "lobes", "harmonics"])
@pytest.mark.parametrize(
    "source", but({"ambient", "constant", "lobe"}, ["ambient", "constant", "map", "lobe"])
)
def test_a_constant_stays_what_it_is(source, method, dtype, rng):
    if (source, method) == ("map", "lobes"):
        return
    light = {
        "ambient": Ambient(COLOURS),
        "constant": Environment(COLOURS / 2, scale=2.0),
        "map": Environment(np.ones((32, 64, 3)) * COLOURS),
        "lobe": LobeEnvironment(
            Lobes(4 * np.pi * COLOURS[None], np.array([[0.0, 0, 1]]), np.zeros(1))
        ),
    }[source]
    found = prepare([light], RGB, method, COARSE if method == "pyramid" else None, dtype)
    mu, kappa = lobes(rng, 50)
    value = radiance(found, mu, kappa, dtype)
    assert value.dtype == dtype
    # A sum of 256 harmonics, or of all pixels.
    np.testing.assert_allclose(value - COLOURS[None], 0.0, atol=100 * EPS[dtype])


def test_a_linear_sky(rng):
    """z averaged is the Langevin function times mu_z."""
    mu, kappa = lobes(rng, 400, -2, 4)
    expected = 2.0 + (1 / np.tanh(kappa) - 1 / kappa) * mu[:, 2]
    light = Environment(map_of(lambda d: 2.0 + d[..., 2], 128, 256))
    pyramid = radiance(prepare([light], RGB), mu, kappa)[:, 0]
    # Of coth kappa - 1 / kappa 0.009 at most is missing between levels.
    np.testing.assert_allclose(pyramid, expected, atol=0.01)
    harmonic = radiance(prepare([light], RGB, "harmonics"), mu, kappa)[:, 0]
    # Exact, but for the sum of 256 harmonics in float32.
    np.testing.assert_allclose(harmonic, expected, atol=1e-5)


def sunny(height=128):
    image = map_of(lambda d: 1.2 + d[..., 2], height, 2 * height)
    image[height // 4, height // 3] = 25_000.0
    sun = prefiltering.pixel_directions(height, 2 * height)[height // 4, height // 3]
    return image, sun


@pytest.fixture(scope="module")
def sun():
    """A map, where its sun stands in the world, the light, its pyramid."""
    image, towards = sunny()
    light = Environment(image, turn=20.0, up="y")
    return image, towards @ light.axes, light, prepare([light], RGB)


KAPPAS = [0.0, 1.0, 2.0, 16.0, 64.0, 256.0, 1024.0]


@pytest.mark.parametrize("kappa", but({0.0, 16.0, 1024.0}, KAPPAS))
def test_a_sun_in_a_map(kappa, sun, rng):
    """On levels the error is that of bilinear look-ups of a sun, of its largest radiance."""
    image, towards, light, pyramid = sun
    mu = towards + rng.normal(size=(200, 3)) / np.sqrt(max(kappa, 1.0))
    mu = unit(np.concatenate([mu, rng.normal(size=(50, 3)), [towards]]))
    kappas = np.full(len(mu), kappa)
    expected = brute(image, mu, kappas, light.axes)
    error = np.abs(radiance(pyramid, mu, kappas) - expected).max(1) / expected.max()
    settings = PyramidSettings()
    # As documented: 20 sharpest / size^2, and the sum of pixels two by two.
    bound = 20.0 * settings.sharpest / settings.size**2
    assert error.max() < bound + 0.015
    assert error.mean() < bound / 10
    if kappa <= 16.0:
        # A level of a quarter of the side; where the lobe is no narrow peak, its slope counts too.
        assert error.max() < 16.0 * bound * (1.0 + kappa) / settings.sharpest + 1e-4


def test_a_sun_between_levels(sun, rng):
    image, towards, light, pyramid = sun
    kappa = 10 ** rng.uniform(-1, 3, 200)
    mu = unit(towards + rng.normal(size=(200, 3)) / np.sqrt(np.maximum(kappa, 1.0))[:, None])
    expected = brute(image, mu, kappa, light.axes)
    peak = brute(image, np.broadcast_to(towards, mu.shape), kappa, light.axes)
    error = np.abs(radiance(pyramid, mu, kappa) - expected)[:, 0] / peak[:, 0]
    # Bilinear as above, and 2 % of the radiance along the axis between two levels.
    assert error.max() < 20.0 / 64 + 0.035
    assert np.median(error) < 0.015


def test_large_maps_are_summed_first():
    """Sums two by two keep the light, where it comes from, and a sun at the pole."""
    image = np.zeros((64, 128, 2))
    image[20, 33, 0], image[0, 5, 1] = 3.0, 2.0
    d = prefiltering.pixel_directions
    found = np.asarray(prefiltering._halved(jnp.asarray(image)))
    assert found.shape == (32, 64, 2)
    np.testing.assert_allclose(found.sum((0, 1)), [3.0, 2.0], rtol=1e-12)
    for channel in (0, 1):
        before = (image[..., channel, None] * d(64, 128)).sum((0, 1))
        after = (found[..., channel, None] * d(32, 64)).sum((0, 1))
        # Second order in the pixels, 0.05.
        np.testing.assert_allclose(after, before, atol=0.01)


def test_lobes_against_quadrature(rng):
    mus, kappas = lobes(rng, 5, 0, 1.5)
    alpha = rng.uniform(0.2, 1.0, (5, 3))
    light = LobeEnvironment(Lobes(alpha, mus, kappas))
    mu, kappa = lobes(rng, 60)
    d = prefiltering.pixel_directions(256, 512)
    image = np.asarray(light.lobes(d.reshape(-1, 3))).reshape(256, 512, 3)
    expected = brute(image, mu, kappa)
    exact = radiance(prepare([light], RGB, "lobes"), mu, kappa)
    # Midpoints of 256 rows, and float32.
    np.testing.assert_allclose(exact, expected, rtol=1e-3, atol=1e-4)
    pyramid = radiance(prepare([light], RGB), mu, kappa)
    # Lobes of up to 32 are known to bilinear look-ups at 64 texels: 5 * 32 / 64^2, and between
    # levels 2 %.
    assert np.abs(pyramid - expected).max() < 0.04 * expected.max()
    harmonic = prepare([light], RGB, "harmonics", HarmonicSettings(bands=40))
    np.testing.assert_allclose(radiance(harmonic, mu, kappa), exact, atol=1e-4)


def test_suns_against_lobes_that_are_all_but_infinite(rng):
    towards, irradiance = unit(rng.normal(size=(2, 3))), rng.uniform(1, 2, (2, 3))
    suns = prepare(
        [Directional(3.0 * t, e) for t, e in zip(towards, irradiance, strict=True)],
        RGB,
        dtype=jnp.float64,
    )
    assert isinstance(suns, Suns)
    sharp = LobeLight(jnp.asarray(irradiance), jnp.asarray(towards), jnp.full(2, 1e11))
    mu, kappa = lobes(rng, 50, -1, 3)
    # Lobes of kappa 1000 see 1e-8 of their width.
    expected = radiance(sharp, mu, kappa, jnp.float64)
    np.testing.assert_allclose(
        radiance(suns, mu, kappa, jnp.float64), expected, rtol=1e-5, atol=1e-12
    )


@pytest.mark.long
def test_the_methods_agree_on_a_smooth_sky(rng):
    light = Environment(map_of(smooth, 128, 256))
    mu, kappa = lobes(rng, 500, -1, 3)
    pyramid = radiance(prepare([light], RGB), mu, kappa)
    harmonic = radiance(prepare([light], RGB, "harmonics", HarmonicSettings(bands=4)), mu, kappa)
    # Between the broad levels: 1 % of what varies, as of the linear sky.
    np.testing.assert_allclose(pyramid, harmonic, atol=0.02)
    on_levels = 2.0 ** rng.integers(0, 10, 500)
    pyramid = radiance(prepare([light], RGB), mu, on_levels)
    harmonic = radiance(
        prepare([light], RGB, "harmonics", HarmonicSettings(bands=4)), mu, on_levels
    )
    # Texels straddle the folds of the octahedron, where slopes of 1 jump: a quarter of a texel of
    # 1/32 at 64. Elsewhere second order in texels of 1/20 and in pixels of 1/40.
    assert np.abs(pyramid - harmonic).max() < 0.016
    assert np.median(np.abs(pyramid - harmonic)) < 1e-3


def several(method, dtype=jnp.float32):
    mus = unit(np.array([[0.3, 0.5, 0.8], [-0.6, 0.1, 0.2]]))
    return prepare(
        [
            Ambient(0.25),
            LobeEnvironment(Lobes(np.array([2.0, 1.0]), mus, np.array([8.0, 3.0]))),
            Directional([0.2, -0.3, 0.9], COLOURS),
        ],
        RGB,
        method,
        COARSE if method == "pyramid" else None,
        dtype,
    )


@pytest.mark.parametrize("method", ["pyramid", "lobes", "harmonics"])
def test_turned_and_scaled(method, rng):
    light = several(method, jnp.float64)
    assert isinstance(light, Lights)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.linalg.det(q))
    p = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    mu, kappa = lobes(rng, 80)
    before = radiance(light, mu, kappa, jnp.float64)
    turned = light.turned(jnp.asarray(q)).turned(jnp.asarray(p))
    # The same numbers up to rounding, times kappa in exponents.
    np.testing.assert_allclose(
        radiance(turned, mu @ q.T @ p.T, kappa, jnp.float64), before, rtol=1e-10
    )
    half = light.scaled(0.5).scaled(jnp.asarray(3.0))
    np.testing.assert_allclose(radiance(half, mu, kappa, jnp.float64), 1.5 * before, rtol=1e-12)


@pytest.mark.parametrize("method", ["pyramid", "lobes", "harmonics"])
def test_slopes(method, rng):
    """In mu, kappa and every number of the light, against differences."""
    light = several(method, jnp.float64)
    mu, kappa = lobes(rng, 6)
    mu, kappa = jnp.asarray(mu), jnp.asarray(kappa)
    weights = jnp.asarray(rng.normal(size=(6, 3)))

    @jax.jit
    def total(light, mu, kappa):
        return (light.radiance(mu, kappa) * weights).sum()

    arguments = light, mu, kappa
    slopes = jax.jit(jax.grad(total, (0, 1, 2)))(*arguments)
    assert all(bool(jnp.isfinite(s).all()) for s in jax.tree.leaves(slopes))
    step = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), arguments)
    h = 1e-7
    ends = [
        total(*jax.tree.map(lambda x, d, s=sign: x + s * h * d, arguments, step))
        for sign in (1, -1)
    ]
    along = sum(
        float((a * b).sum())
        for a, b in zip(jax.tree.leaves(slopes), jax.tree.leaves(step), strict=True)
    )
    # Rounding of 1e-16 of terms of up to 1e3 over the step; a texel's edge is not met.
    assert along == pytest.approx(float((ends[0] - ends[1]) / (2 * h)), rel=1e-5, abs=1e-4)


@pytest.mark.parametrize("method", ["pyramid", "harmonics"])
def test_slopes_in_pixels(method, rng):
    """Linear in the pixels: the slope times the pixels is the value."""
    image = jnp.asarray(rng.uniform(0.5, 1.0, (8, 16, 3)))
    mu, kappa = (jnp.asarray(x) for x in lobes(rng, 10))
    settings = PyramidSettings(size=64) if method == "pyramid" else HarmonicSettings(bands=8)

    def total(image):
        light = prepare([Environment(image)], RGB, method, settings, jnp.float64)
        return (light.radiance(mu, kappa) * jnp.asarray(COLOURS)[None]).sum()

    value, slope = jax.value_and_grad(total)(image)
    assert float((slope * image).sum()) == pytest.approx(float(value), rel=1e-10)
    other = jnp.asarray(rng.uniform(0.0, 1.0, image.shape))
    assert float((slope * other).sum()) == pytest.approx(float(total(other)), rel=1e-10)


@pytest.mark.parametrize("method", ["pyramid", "lobes", "harmonics"])
def test_hard_lobes_are_finite(method, dtype):
    light = several(method, dtype)
    mu = np.concatenate([np.eye(3), -np.eye(3)])
    both = jax.jit(jax.value_and_grad(lambda m, k: light.radiance(m, k).sum(), (0, 1)))
    for kappa in (0.0, 1e-12, 0.9999999, 1.0, 256.0, 1e8):
        value, slopes = both(jnp.asarray(mu, dtype), jnp.full(6, kappa, dtype))
        assert bool(jnp.isfinite(value))
        assert all(bool(jnp.isfinite(s).all()) for s in slopes)


def test_shapes_and_maps_over_lobes(rng):
    light = several("pyramid")
    mu, kappa = lobes(rng, 12)
    flat = radiance(light, mu, kappa)
    shaped = radiance(light, mu.reshape(3, 4, 3), kappa.reshape(3, 4))
    np.testing.assert_array_equal(shaped.reshape(12, 3), flat)
    one_by_one = jax.jit(jax.vmap(light.radiance))(
        jnp.asarray(mu, jnp.float32), jnp.asarray(kappa, jnp.float32)
    )
    # Compiled another way.
    np.testing.assert_allclose(one_by_one, flat, rtol=1e-5)
    many = jax.jit(
        jax.vmap(lambda s: light.scaled(s).radiance(jnp.asarray(mu[0], jnp.float32), 1.0 + 0 * s))
    )
    assert many(jnp.arange(1.0, 4.0, dtype=jnp.float32)).shape == (3, 3)
    none = radiance(light, np.zeros((0, 3)), np.zeros(0))
    assert none.shape == (0, 3)


def test_lobes_that_are_no_numbers_read_nothing_outside():
    found = radiance(several("pyramid"), np.full((2, 3), np.nan), np.full(2, np.nan))
    assert np.isnan(found).all()


def test_sharper_lobes_than_the_pyramid():
    light = several("pyramid")
    pyramid = light.parts[0]
    assert isinstance(pyramid, Pyramid)
    mu = unit(np.array([[0.3, 0.5, 0.8]] * 2))
    last, beyond = radiance(pyramid, mu, np.array([256.0, 1e8]))
    np.testing.assert_array_equal(last, beyond)


def test_spectral_scenes(rng):
    channels = Channels([0.45, 0.5, 0.55, 0.6, 0.65])
    mu, kappa = lobes(rng, 20)
    white = radiance(
        prepare([Environment(np.ones((16, 32, 3)))], channels, settings=COARSE), mu, kappa
    )
    # RGB white is 1 in every channel, to the rounding of the table of the primaries.
    np.testing.assert_allclose(white, np.ones((20, 5)), atol=1e-3)
    grey = prepare([Environment(np.ones((32, 64)))], channels, "harmonics")
    assert isinstance(grey, HarmonicLight)
    assert grey.coefficients.shape == (256, 5)


def test_levels_of_small_maps():
    tiny = prepare([Environment(np.ones((8, 16, 3)))], RGB)
    # (8 / pi)^2 = 6.5.
    assert tiny.kappas == (0.0, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 4.0)


def test_black():
    for sources in ([], [Ambient(0.0)]):
        found = prepare(sources, RGB)
        assert radiance(found, np.eye(3), np.ones(3)).tolist() == np.zeros((3, 3)).tolist()


def test_refused():
    image = np.ones((8, 16, 3))
    for near in (Point(), Flood()):
        with pytest.raises(InputError, match=rf"sources\[1\].*infinity.*{type(near).__name__}"):
            prepare([Ambient(), near], RGB)
    with pytest.raises(InputError, match="fit_environment"):
        prepare([Environment(image)], RGB, "lobes")
    with pytest.raises(InputError, match="method must be one of"):
        prepare([], RGB, "cubes")
    with pytest.raises(InputError, match="must be finite; received inf"):
        prepare([Directional(irradiance=np.inf)], RGB)
    with pytest.raises(InputError, match="must be finite; received inf"):
        prepare([Environment(image, scale=np.inf)], RGB)
    for bad in (np.nan, np.inf):
        with pytest.raises(InputError, match="radiance"):
            Environment(np.where(np.arange(3) == 1, bad, image))
    with pytest.raises(InputError, match="must be HarmonicSettings; received PyramidSettings"):
        prepare([], RGB, "harmonics", PyramidSettings())
    with pytest.raises(InputError, match="must be None"):
        prepare([], RGB, "lobes", PyramidSettings())
    with pytest.raises(InputError, match="8 x 16; received 9"):
        prepare([Environment(image)], RGB, "harmonics", HarmonicSettings(bands=9))
    for settings in ({"size": 4}, {"sharpest": 100.0}, {"sharpest": 0.5}, {"size": True}):
        with pytest.raises(InputError):
            PyramidSettings(**settings)
    for bands in (0, 65):
        with pytest.raises(InputError, match="bands"):
            HarmonicSettings(bands=bands)
