"""The methods agree with each other within the error that each states."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

import diffopt as do
from diffopt import bounds, choice, diffraction
from reference import directions

WAVELENGTHS = np.array([0.42, 0.55, 0.7])
PAIRS = 200
# Both averages, each in one of the types: the two choices do not touch each other.
AVERAGES = {"float32": "positions", "float64": "window"}


def relative_error(found, expected):
    found, expected = np.asarray(found), np.asarray(expected)
    return float(np.abs(found - expected).max() / expected.max())


@pytest.fixture
def scan(surface_name, request):
    """(scan, sigma_s) of an embedded sample, or of the file given with --scan."""
    if surface_name in do.samples.NAMES:
        shape, pixel = (160, 192) if surface_name == "snake_skin" else (256, 128), 0.05
        options = {"rms": 0.04, "correlation_length": 0.5} if "rough" in surface_name else {}
        scan = do.samples.make(
            surface_name, key=jax.random.key(7), shape=shape, pixel=pixel, **options
        )
        return scan, min(scan.extent) / 8
    scan = do.Heightfield.load(surface_name).levelled()
    return scan, request.config.getoption("scan_coherence")


def test_methods_agree_within_their_stated_error(scan, dtype, rng):
    scan, sigma = do.Heightfield(scan[0].heights.astype(dtype), scan[0].pixel), scan[1]
    brdf = do.DiffractionBRDF(scan, sigma, average=AVERAGES[dtype])
    wi, wo = directions(rng, PAIRS), directions(rng, PAIRS)
    expected = brdf(wi, wo, WAVELENGTHS)
    for method in ("separable", "taylor", "chebyshev", "lowrank", "table"):
        # float32 rounds the Taylor terms of a deep scan: it cannot promise as much. Nor is one
        # window's speckle worth a fine table, whose bound is relative to a mirror's peak.
        hard = (method == "taylor" and dtype == "float32") or (
            method == "table" and AVERAGES[dtype] == "window"
        )
        tolerance = 0.1 if hard else 1e-2
        fast = brdf.prepare(
            pairs=(wi, wo), wavelengths=WAVELENGTHS, tolerance=tolerance, method=method
        )
        error = relative_error(fast(wi, wo), expected)
        assert error <= fast.choice.error_bound <= tolerance, method
        assert fast.choice.method == method


def test_fast_methods_reach_rounding(rng):
    """With settings to spare all methods give the direct sum to its own rounding."""
    scan = do.samples.compact_disc(jax.random.key(1), shape=(128, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.8)
    wi, wo = directions(rng, 40), directions(rng, 40)
    expected = brdf(wi, wo, WAVELENGTHS)
    for settings in (
        do.SeparableSettings(nodes=26),
        do.TaylorSettings(terms=45, reach=10),
        do.ChebyshevSettings(terms=26, reach=10),
        do.LowRankSettings(terms=22, reach=10),
    ):
        fast = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, settings=settings)
        error = relative_error(fast(wi, wo), expected)
        # float64; the Taylor terms of a phase range of 7 lose e^7 = 1100 eps of the peak,
        # which is 1e3 times the largest value here.
        assert error < 1e-8, settings


@pytest.mark.parametrize("chunk", but({7}, [7, 64]))
def test_chunks_change_nothing(chunk, rng):
    scan = do.samples.compact_disc(jax.random.key(1), shape=(64, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.8)
    wi, wo = directions(rng, 13), directions(rng, 13)
    expected = brdf(wi, wo, WAVELENGTHS)
    for settings in (
        do.DirectSettings(chunk=chunk),
        do.SeparableSettings(nodes=24, chunk=chunk),
        do.TaylorSettings(terms=40, reach=10, chunk=chunk),
        do.ChebyshevSettings(terms=24, reach=10, chunk=chunk),
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


@pytest.fixture(scope="module")
def slopes():
    """By settings: slopes to everything, and along a change of the heights, in one program."""
    scan = do.samples.gaussian_roughness(
        jax.random.key(0), shape=(24, 20), pixel=0.1, rms=0.05, correlation_length=0.4
    )
    scan = do.Heightfield(scan.heights, scan.pixel)
    brdf = do.DiffractionBRDF(scan, 0.25, blur=0.05, fresnel=do.fresnel.Schlick(0.04))
    rng = np.random.default_rng(20140113)
    pairs = [jnp.asarray(directions(rng, 3)) for _ in range(2)]
    tangent = jnp.asarray(rng.normal(size=scan.heights.shape))

    @eqx.filter_jit
    def both(given, tangent, settings):
        def total(given):
            return diffraction.evaluate(*given, settings).sum()

        def along(heights):
            return total(eqx.tree_at(lambda g: g[0].surface.heights, given, heights))

        heights = given[0].surface.heights
        return eqx.filter_grad(total)(given), jax.jvp(along, (heights,), (tangent,))[1]

    @cache
    def of(settings):
        found, forward = both((brdf, *pairs, jnp.asarray(WAVELENGTHS)), tangent, settings)
        reverse = np.vdot(found[0].surface.heights, tangent)
        return jax.tree.leaves(found), float(forward), float(reverse)

    return of


@pytest.mark.parametrize(
    "settings",
    [
        do.DirectSettings(),
        do.SeparableSettings(nodes=18),
        do.TaylorSettings(terms=30, reach=8),
        do.ChebyshevSettings(terms=20, reach=8),
        do.LowRankSettings(terms=18, reach=8),
    ],
    ids=lambda s: s.name,
)
def test_gradients_of_all_methods_agree(settings, slopes):
    """To heights, directions, wavelengths, coherence and blur; reverse against forward."""
    (got, forward, reverse), (expected, _, _) = slopes(settings), slopes(do.DirectSettings())
    for a, b in zip(got, expected, strict=True):
        assert bool(np.isfinite(a).all())
        # Truncation of 18 nodes or terms and 8 bins is below 1e-8 of a mirror's peak.
        np.testing.assert_allclose(a, b, atol=1e-5 * float(np.abs(b).max()) + 1e-12)
    assert forward == pytest.approx(reverse, rel=1e-9)


def test_choice_prefers_the_cheaper_and_says_why():
    scan = do.samples.compact_disc(jax.random.key(1), shape=(128, 128), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 1.25)
    many = brdf.prepare(pairs=200_000, tolerance=1e-2)
    text = str(many.choice)
    assert "error bound" in text
    assert "direct:" in text
    costs = {c.method: c.total_s for c in many.choice.candidates}
    assert costs[many.choice.method] == min(costs.values())
    assert min(costs["chebyshev"], costs["lowrank"]) < costs["taylor"] < costs["direct"]
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
    error = relative_error(fast(wi, wo), exact)
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
    with pytest.raises(do.InputError, match="use method 'chebyshev', 'lowrank', 'separable' or"):
        brdf.prepare(**job, settings=do.TaylorSettings(terms=80))
    # The reason that all methods share is said once.
    names = ", ".join(repr(name) for name in choice.METHODS)
    once = rf"^methods {names}: [^;]*below the rounding of float32; [^;]*$"
    with pytest.raises(do.InputError, match=once):
        brdf.prepare(**job, tolerance=1e-7)
    assert brdf.prepare(**job, tolerance=0.1).choice.method != "taylor"


def test_refusals_name_the_way_out():
    scan = do.samples.flat(shape=(16, 16), pixel=0.1)
    bare = do.DiffractionBRDF(scan, None)
    with pytest.raises(do.InputError, match="gathers with a coherence window"):
        bare.prepare(pairs=10, method="taylor")
    with pytest.raises(do.InputError, match="method 'lowrank' gathers with a coherence window"):
        bare.prepare(pairs=10, settings=do.LowRankSettings())
    facets = do.DiffractionBRDF(scan, 0.5, prefactor="kirchhoff")
    with pytest.raises(do.InputError, match="use method 'direct'"):
        facets.prepare(pairs=10, wavelengths=WAVELENGTHS, method="separable")
    with pytest.raises(do.InputError, match="tolerance must be a relative error"):
        bare.prepare(pairs=10, tolerance=0.0)
    with pytest.raises(do.InputError, match="method must be one of auto, direct"):
        bare.prepare(pairs=10, method="fft")


GATHERS = [
    do.TaylorSettings(terms=30, reach=9, centred=True),
    do.ChebyshevSettings(terms=20, reach=9),
    do.LowRankSettings(terms=16, reach=9),
]


@pytest.mark.parametrize("settings", GATHERS, ids=lambda s: s.name)
def test_a_single_s_and_a_flat_surface(settings, dtype):
    """Intervals without a width: values and gradients are there, and right."""
    flat = np.full((24, 20), 0.3)
    rough = flat + 0.05 * np.random.default_rng(3).uniform(size=flat.shape)
    scan = do.Heightfield(jnp.asarray(flat, dtype), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.25, average=AVERAGES[dtype])
    wi, wo = np.array([0.6, 0.0, 0.8]), np.array([-0.6, 0.0, 0.8])

    def value(settings, wo, heights):
        model = eqx.tree_at(lambda b: b.surface.heights, brdf, heights)
        return diffraction.evaluate(model, wi, wo, [0.5], settings)[0]

    slopes = [
        jax.jit(jax.value_and_grad(lambda *a, s=s: value(s, *a), (0, 1)))
        for s in (settings, do.DirectSettings())
    ]
    for heights in (flat, rough):
        at = jnp.asarray(wo, dtype), jnp.asarray(heights, dtype)
        both = [f(*at) for f in slopes]
        for a, b in zip(jax.tree.leaves(both[0]), jax.tree.leaves(both[1]), strict=True):
            assert bool(np.isfinite(a).all())
            # The gather leaves out 1e-7 of the amplitude at 9.5 bins of 0.65 sigma_f, and
            # its slopes; float32 slopes of heights sum 480 phases of about 6 radians.
            tolerance = 1e-5 if dtype == "float64" else 1e-3
            # There is no slope at all at the peak of a flat surface.
            scale = max(float(np.abs(b).max()), float(both[1][0]))
            np.testing.assert_allclose(a, b, atol=tolerance * scale)


@pytest.mark.parametrize("settings", GATHERS, ids=lambda s: s.name)
def test_tables_are_made_for_the_pairs_above_the_horizon(settings, rng):
    """Masked pairs, and none at all, change nothing for the others."""
    scan = do.samples.compact_disc(jax.random.key(1), shape=(64, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.8)
    wi, wo = directions(rng, 6), directions(rng, 6)
    wo[:, 2] = np.abs(wo[:, 2])
    below = wo * [1, 1, -1]
    expected = diffraction.evaluate(brdf, wi, wo, WAVELENGTHS, settings)
    got = diffraction.evaluate(
        brdf, np.concatenate([wi, wi]), np.concatenate([wo, below]), WAVELENGTHS, settings
    )
    np.testing.assert_allclose(got[:6], expected, rtol=1e-9)
    np.testing.assert_array_equal(got[6:], 0.0)
    np.testing.assert_array_equal(diffraction.evaluate(brdf, wi, below, WAVELENGTHS, settings), 0.0)


@pytest.mark.parametrize("method", ["chebyshev", "lowrank"])
def test_a_job_by_number_holds_over_its_whole_cone(method):
    """Tables of a job without directions cover w at 75 degrees and at the normal."""
    scan = do.samples.compact_disc(jax.random.key(1), shape=(64, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.8)
    fast = brdf.prepare(pairs=100, wavelengths=WAVELENGTHS, tolerance=1e-3, method=method)
    for degrees in (0.0, 40.0, 75.0):
        sin, cos = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
        wi, wo = np.array([sin, 0.0, cos]), np.array([-sin, 0.0, cos])
        expected = brdf(wi, wo, WAVELENGTHS)
        np.testing.assert_allclose(fast(wi, wo), expected, atol=1e-3 * float(expected.max()))


@pytest.mark.float32
@pytest.mark.parametrize("method", ["chebyshev", "lowrank"])
def test_float32_carries_deep_surfaces(method, rng):
    """A phase range of 150, where Taylor terms would need float numbers of 1e65."""
    heights = rng.uniform(0, 5.0, (64, 64)).astype("float32")
    brdf = do.DiffractionBRDF(do.Heightfield(heights, 0.1), 0.8)
    wi, wo = directions(rng, 20), directions(rng, 20)
    job = {"pairs": (wi, wo), "wavelengths": np.array([0.42, 0.7]), "tolerance": 0.1}
    fast = brdf.prepare(**job, method=method)
    expected = brdf(wi, wo, job["wavelengths"])
    error = relative_error(fast(wi, wo), expected)
    assert error <= fast.choice.error_bound <= 0.1


intensity = eqx.filter_jit(diffraction.intensity)


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
        values[dtype] = intensity(brdf, wave, jnp.asarray(lam, dtype), do.DirectSettings())
        if dtype == "float32":
            estimate = bounds.rounding_estimate(brdf.surface, np.asarray(wave), lam)
    error = np.abs(np.asarray(values["float32"], np.float64) - np.asarray(values["float64"])).max()
    assert error < estimate


def test_pairs_below_the_horizon_do_not_widen_the_job(rng):
    """They are masked; their stand-in must not stretch the range of w that is interpolated."""
    scan = do.samples.gaussian_roughness(
        jax.random.key(0), shape=(48, 48), pixel=0.1, rms=0.1, correlation_length=0.4
    )
    brdf = do.DiffractionBRDF(do.Heightfield(scan.heights, scan.pixel), 0.5)
    # All near 60 degrees: w hardly changes, unless the normal comes in with w = -2.
    turn = rng.uniform(0, 2 * np.pi, (2, 40))
    sin, cos = np.sin(1.05), np.cos(1.05)
    wi, wo = (np.stack([sin * np.cos(t), sin * np.sin(t), np.full_like(t, cos)], -1) for t in turn)
    wo[::2, 2] *= -1.0
    expected = brdf(wi, wo, WAVELENGTHS)
    for method in ("separable", "chebyshev"):
        fast = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, tolerance=1e-3, method=method)
        error = relative_error(fast(wi, wo), expected)
        assert error <= fast.choice.error_bound <= 1e-3
