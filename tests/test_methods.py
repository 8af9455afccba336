"""The three methods agree with each other within the error that each states."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt import bounds, diffraction
from reference import directions

WAVELENGTHS = np.array([0.42, 0.55, 0.7])
PAIRS = 200


@pytest.fixture
def surface(surface_name, request, dtype):
    """(scan, sigma_s) of an embedded sample, or of the file given with --scan."""
    if surface_name in do.samples.NAMES:
        options = {
            "compact_disc": {"shape": (256, 128), "pixel": 0.05},
            "snake_skin": {"shape": (160, 192), "pixel": 0.05},
        }[surface_name]
        scan = do.samples.make(surface_name, key=jax.random.key(7), **options)
        sigma = min(scan.extent) / 8
    else:
        scan = do.Heightfield.load(surface_name).levelled()
        sigma = request.config.getoption("scan_coherence")
    return do.Heightfield(scan.heights.astype(dtype), scan.pixel), sigma


@pytest.mark.parametrize("average", ["positions", "window"])
@pytest.mark.parametrize("method", ["separable", "taylor"])
def test_methods_agree_within_their_stated_error(surface, method, average, dtype, rng):
    scan, sigma = surface
    brdf = do.DiffractionBRDF(scan, sigma, average=average)
    wi, wo = directions(rng, PAIRS), directions(rng, PAIRS)
    expected = brdf(wi, wo, WAVELENGTHS)
    # float32 rounds the Taylor terms of a deep scan: it cannot promise as much.
    tolerance = 1e-2 if dtype == "float64" else 0.1
    fast = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, tolerance=tolerance, method=method)
    error = float(jnp.abs(fast(wi, wo) - expected).max() / expected.max())
    assert error <= fast.choice.error_bound <= tolerance
    assert fast.choice.method == method


def test_separable_and_taylor_reach_rounding(rng):
    """With settings to spare both methods give the direct sum to its own rounding."""
    scan = do.samples.compact_disc(jax.random.key(1), shape=(128, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.8)
    wi, wo = directions(rng, 40), directions(rng, 40)
    expected = brdf(wi, wo, WAVELENGTHS)
    for settings in (do.SeparableSettings(nodes=26), do.TaylorSettings(terms=45, reach=10)):
        fast = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, settings=settings)
        error = float(jnp.abs(fast(wi, wo) - expected).max() / expected.max())
        # float64; the Taylor terms of a phase range of 7 lose e^7 = 1100 eps of the peak,
        # which is 1e3 times the largest value here.
        assert error < 1e-8, settings


@pytest.mark.parametrize("chunk", [1, 7, 64])
def test_chunks_change_nothing(chunk, rng):
    scan = do.samples.compact_disc(jax.random.key(1), shape=(64, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.8)
    wi, wo = directions(rng, 13), directions(rng, 13)
    expected = brdf(wi, wo, WAVELENGTHS)
    for settings in (
        do.DirectSettings(chunk=chunk),
        do.SeparableSettings(nodes=24, chunk=chunk),
        do.TaylorSettings(terms=40, reach=10, chunk=chunk),
    ):
        got = diffraction.evaluate(brdf, wi, wo, WAVELENGTHS, settings)
        np.testing.assert_allclose(got, expected, atol=1e-7 * float(expected.max()))


def test_no_retrace_for_new_values(rng):
    """New directions, wavelengths, heights, coherence of the same shape: one compilation."""
    traces = 0

    class Counting(do.fresnel.Constant):
        def __call__(self, cos_h, wavelengths):
            nonlocal traces
            traces += 1
            return super().__call__(cos_h, wavelengths)

    def model(seed, sigma):
        scan = do.samples.gaussian_roughness(
            jax.random.key(seed), shape=(32, 32), pixel=0.1, rms=0.05, correlation_length=0.4
        )
        scan = do.Heightfield(scan.heights, scan.pixel)
        return do.DiffractionBRDF(scan, sigma, fresnel=Counting(0.9))

    for seed, sigma in ((0, 0.3), (1, 0.35), (2, 0.4)):
        model(seed, sigma)(directions(rng, 5), directions(rng, 5), WAVELENGTHS + 0.01 * seed)
    assert traces == 1


@pytest.mark.parametrize(
    "settings",
    [do.DirectSettings(), do.SeparableSettings(nodes=18), do.TaylorSettings(terms=30, reach=8)],
    ids=lambda s: s.name,
)
def test_gradients_of_all_methods_agree(settings, rng):
    """To heights, directions, wavelengths, coherence and blur; reverse against forward."""
    scan = do.samples.gaussian_roughness(
        jax.random.key(0), shape=(24, 20), pixel=0.1, rms=0.05, correlation_length=0.4
    )
    scan = do.Heightfield(scan.heights, scan.pixel)
    brdf = do.DiffractionBRDF(scan, 0.25, blur=0.05, fresnel=do.fresnel.Schlick(0.04))
    wi, wo = directions(rng, 3), directions(rng, 3)

    @eqx.filter_jit
    def total(brdf, wi, wo, lam, settings):
        return diffraction.evaluate(brdf, wi, wo, lam, settings).sum()

    def gradient(settings):
        return eqx.filter_grad(lambda z: total(*z, settings))(
            (brdf, jnp.asarray(wi), jnp.asarray(wo), jnp.asarray(WAVELENGTHS))
        )

    got, expected = gradient(settings), gradient(do.DirectSettings())
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected), strict=True):
        assert bool(jnp.isfinite(a).all())
        # Truncation of 18 nodes, 30 terms and 8 bins is below 1e-8 of a mirror's peak.
        np.testing.assert_allclose(a, b, atol=1e-5 * float(jnp.abs(b).max()) + 1e-12)
    tangent = jax.random.normal(jax.random.key(3), scan.heights.shape)
    f = lambda h: total(  # noqa: E731
        eqx.tree_at(lambda b: b.surface.heights, brdf, h), wi, wo, WAVELENGTHS, settings
    )
    _, forward = jax.jvp(f, (scan.heights,), (tangent,))
    reverse = jnp.vdot(jax.grad(f)(scan.heights), tangent)
    assert float(forward) == pytest.approx(float(reverse), rel=1e-9)


def test_choice_prefers_the_cheaper_and_says_why():
    scan = do.samples.compact_disc(jax.random.key(1), shape=(128, 128), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 1.25)
    many = brdf.prepare(pairs=200_000, tolerance=1e-2)
    assert many.choice.method == "taylor"  # float64 here: tables pay off
    text = str(many.choice)
    assert "error bound" in text
    assert "direct:" in text
    costs = {c.method: c.total_s for c in many.choice.candidates}
    assert costs["taylor"] == min(costs.values())
    tight = brdf.prepare(pairs=10, wavelengths=WAVELENGTHS, tolerance=1e-4)
    loose = brdf.prepare(pairs=10, wavelengths=WAVELENGTHS, tolerance=1e-1, method="separable")
    again = brdf.prepare(pairs=10, wavelengths=WAVELENGTHS, tolerance=1e-3, method="separable")
    assert tight.choice.error_bound <= 1e-4
    assert again.settings.nodes > loose.settings.nodes


def test_xyz_output_meets_its_tolerance(rng):
    scan = do.samples.compact_disc(jax.random.key(1), shape=(128, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.8)
    wi, wo = directions(rng, 30), directions(rng, 30)
    fast = brdf.prepare(pairs=(wi, wo), output="xyz", tolerance=1e-2, method="separable")
    exact = brdf.xyz(wi, wo)
    error = float(jnp.abs(fast(wi, wo) - exact).max() / exact.max())
    assert error <= fast.choice.error_bound <= 1e-2


@pytest.mark.float32
def test_float32_refuses_what_it_cannot_carry():
    scan = do.Heightfield(
        jnp.linspace(0, 1.5, 64 * 64, dtype=jnp.float32).reshape(64, 64), pixel=0.1
    )
    brdf = do.DiffractionBRDF(scan, 0.8)
    job = {"pairs": 100, "wavelengths": WAVELENGTHS}
    with pytest.raises(do.InputError, match=r"float32 cannot carry Taylor terms over a phase"):
        brdf.prepare(**job, method="taylor", tolerance=1e-2)
    with pytest.raises(do.InputError, match="use method 'separable' or 'direct'"):
        brdf.prepare(**job, settings=do.TaylorSettings(terms=80))
    # The reason that all methods share is said once.
    once = r"^methods 'direct', 'separable', 'taylor': [^;]*below the rounding of float32; [^;]*$"
    with pytest.raises(do.InputError, match=once):
        brdf.prepare(**job, tolerance=1e-7)
    assert brdf.prepare(**job, tolerance=0.1).choice.method != "taylor"


def test_refusals_name_the_way_out():
    scan = do.samples.flat(shape=(16, 16), pixel=0.1)
    bare = do.DiffractionBRDF(scan, None)
    with pytest.raises(do.InputError, match="gathers with a coherence window"):
        bare.prepare(pairs=10, method="taylor")
    facets = do.DiffractionBRDF(scan, 0.5, prefactor="kirchhoff")
    with pytest.raises(do.InputError, match="use method 'direct'"):
        facets.prepare(pairs=10, wavelengths=WAVELENGTHS, method="separable")
    with pytest.raises(do.InputError, match="tolerance must be a relative error"):
        bare.prepare(pairs=10, tolerance=0.0)
    with pytest.raises(do.InputError, match="method must be one of auto, direct"):
        bare.prepare(pairs=10, method="fft")


@pytest.mark.parametrize("range_", [1.0, 4.7, 30.0, 250.0])
def test_rounding_estimate_covers_float32(range_, rng):
    heights = rng.uniform(0, 1, (64, 64))
    span = range_ * 0.4 / (2 * np.pi * 2)
    wi, wo = directions(rng, 20), directions(rng, 20)
    lam = np.array([0.4, 0.6])
    values = {}
    for dtype in ("float32", "float64"):
        scan = do.Heightfield(jnp.asarray(heights * span, dtype), pixel=0.1)
        brdf = do.DiffractionBRDF(scan, 0.8)
        wave = jnp.asarray(-(wi + wo), dtype)
        values[dtype] = diffraction.intensity(
            brdf, wave, jnp.asarray(lam, dtype), do.DirectSettings()
        )
        if dtype == "float32":
            estimate = bounds.rounding_estimate(brdf.surface, np.asarray(wave), lam)
    error = np.abs(np.asarray(values["float32"], np.float64) - np.asarray(values["float64"])).max()
    assert error < estimate
