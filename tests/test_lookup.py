"""Baked tables against the direct sum, within their stated bounds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

import diffopt as do
from diffopt import baking, colour, lookup, table_bounds
from diffopt.baking import Box
from reference import directions

WAVELENGTHS = np.array([0.42, 0.5, 0.61])
PAIRS = 200


def disc(shape=(96, 64), pixel=0.1, dtype="float64"):
    scan = do.samples.compact_disc(jax.random.key(1), shape=shape, pixel=pixel)
    return do.Heightfield(scan.heights.astype(dtype), scan.pixel)


def relative_error(got, expected):
    got, expected = np.asarray(got), np.asarray(expected)
    return float(np.abs(got - expected).max() / np.abs(expected).max())


@pytest.fixture(scope="module")
def plain():
    """Pairs, spectra by the direct sum, and the table for them."""
    rng = np.random.default_rng(20140113)
    brdf = do.DiffractionBRDF(disc(), 0.7)
    wi, wo = directions(rng, PAIRS), directions(rng, PAIRS)
    job = {"pairs": (wi, wo), "wavelengths": WAVELENGTHS}
    exact = np.asarray(brdf(wi, wo, WAVELENGTHS))
    return brdf, wi, wo, exact, brdf.prepare(**job, tolerance=1e-2, method="table")


MODELS = {
    "window": {"average": "window", "position": (0.33, -0.27)},
    "blurred, schlick, shadowed": {
        "blur": 0.05,
        "fresnel": do.fresnel.Schlick(0.04),
        "shadowing": "v-cavity",
    },
    "mirror apart, metal": {"mirror": "apart", "fresnel": do.fresnel.metal("Cu")},
    "peak, ohs": {"balance": "peak", "fresnel": do.fresnel.Schlick(0.1), "prefactor": "ohs"},
}


@pytest.mark.parametrize("model", but({"window", "mirror apart, metal"}, MODELS))
def test_table_keeps_its_bound(model, rng):
    brdf = do.DiffractionBRDF(disc(), 0.7, **MODELS[model])
    wi, wo = directions(rng, PAIRS), directions(rng, PAIRS)
    job = {"pairs": (wi, wo), "wavelengths": WAVELENGTHS, "output": "xyz"}
    fast = brdf.prepare(**job, tolerance=1e-2, method="table")
    exact = brdf.prepare(**job, settings=do.DirectSettings())(wi, wo)
    assert relative_error(fast(wi, wo), exact) <= fast.choice.error_bound <= 1e-2


def test_spectral_table_keeps_its_bound(plain):
    _, wi, wo, exact, fast = plain
    assert relative_error(fast(wi, wo), exact) <= fast.choice.error_bound <= 1e-2


def test_relative_output(rng):
    brdf = do.DiffractionBRDF(disc(), 0.7, fresnel=do.fresnel.Schlick(0.04))
    wi, wo = directions(rng, 50), directions(rng, 50)
    fast = brdf.prepare(
        pairs=(wi, wo),
        wavelengths=WAVELENGTHS,
        output="relative",
        tolerance=1e-3,
        method="table",
    )
    assert relative_error(fast(wi, wo), brdf.relative(wi, wo, WAVELENGTHS)) <= 1e-3


@pytest.mark.float32
def test_float32_table_keeps_its_bound(rng):
    brdf = do.DiffractionBRDF(disc(dtype="float32"), 0.7)
    wi, wo = directions(rng, 200), directions(rng, 200)
    fast = brdf.prepare(pairs=(wi, wo), output="xyz", tolerance=1e-3, method="table")
    got = fast(wi, wo)
    assert got.dtype == jnp.float32
    assert relative_error(got, brdf.xyz(wi, wo)) <= fast.choice.error_bound <= 1e-3


@pytest.mark.parametrize("order", but({3}, [1, 2, 3]))
def test_error_falls_with_the_order_of_the_spline(order, plain):
    brdf, wi, wo, exact, _ = plain
    errors = []
    for step in (0.8, 0.4):
        settings = do.TableSettings(step=step, order=order, nodes=16, intervals=120, error=1e-9)
        fast = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, settings=settings)
        errors.append(relative_error(fast(wi, wo), exact))
    # Halving the step divides the error by 2^(order + 1), more while it is coarse.
    assert errors[0] / errors[1] > 0.75 * 2 ** (order + 1)


@pytest.mark.long
def test_nodes_and_intervals_in_w(plain):
    brdf, wi, wo, exact, _ = plain
    box = Box.around(-(wi + wo))
    fine = {"step": 0.15, "order": 3, "error": 1e-9}
    for coarse in ({"nodes": 4, "intervals": 60}, {"nodes": 16, "intervals": 5}):
        settings = do.TableSettings(**fine, **coarse)
        fast = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, settings=settings)
        error = relative_error(fast(wi, wo), exact)
        depth = table_bounds.depth_error(brdf.surface, box, WAVELENGTHS, **coarse).max()
        # The share of w dominates here; it is put to use, and it stays below its bound.
        assert 1e-5 < error <= 3 * depth


def test_one_table_serves_the_whole_hemisphere(rng):
    brdf = do.DiffractionBRDF(disc(), 0.5)
    fast = brdf.prepare(pairs=10**6, output="xyz", tolerance=1e-2)
    assert fast.choice.method == "table"
    wi, wo = directions(rng, 200, 89.0), directions(rng, 200, 89.0)
    assert np.isfinite(fast(wi, wo)).all()
    wi, wo = directions(rng, 100), directions(rng, 100)
    assert relative_error(fast(wi, wo), brdf.xyz(wi, wo)) <= 1e-2


def test_below_the_horizon_and_outside(plain):
    _, wi, wo, _, fast = plain
    below = wo * np.array([1.0, 1.0, -1.0])
    np.testing.assert_array_equal(fast(wi, below), 0.0)
    grazing = np.array([np.sin(1.4), 0.0, np.cos(1.4)])
    with pytest.raises(
        do.InputError, match=r"outside the table, which covers u in \[.*of the whole"
    ):
        fast(grazing, grazing)
    with pytest.raises(do.InputError, match="wi must be unit vectors; received one of length 2"):
        fast(2.0 * wi, wo)
    traced = jax.jit(lambda a, b: fast(a, b))(jnp.asarray(grazing), jnp.asarray(grazing))
    assert np.isnan(traced).all()


def test_flat_mirror_at_one_direction():
    """A box without width, heights without range: nothing is divided by zero."""
    scan = do.samples.flat(shape=(32, 32), pixel=0.1)
    scan = do.Heightfield(scan.heights.astype("float64"), scan.pixel)
    brdf = do.DiffractionBRDF(scan, 0.4)
    wi, wo = np.array([[0.6, 0.0, 0.8]]), np.array([[-0.6, 0.0, 0.8]])
    fast = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, method="table", tolerance=1e-3)
    # A mirror's peak is area / lambda^2.
    expected = 4 * np.pi * 0.4**2 / WAVELENGTHS**2
    np.testing.assert_allclose(fast(wi, wo)[0], expected, rtol=1e-3)


def test_derivative_to_the_directions(rng):
    brdf = do.DiffractionBRDF(disc(), 0.7)
    wi, wo = directions(rng, 40), directions(rng, 40)
    job = {"pairs": (wi, wo), "wavelengths": WAVELENGTHS, "tolerance": 1e-3}
    fast = brdf.prepare(**job, gradient="directions", method="table")
    plain = brdf.prepare(**job, method="table")
    assert fast.settings.step < plain.settings.step
    total = lambda f: jax.jit(jax.grad(lambda a, b: f(a, b).sum(), (0, 1)))  # noqa: E731
    got = total(fast)(jnp.asarray(wi), jnp.asarray(wo))
    exact = total(lambda a, b: brdf(a, b, WAVELENGTHS))(jnp.asarray(wi), jnp.asarray(wo))
    for a, b in zip(got, exact, strict=True):
        assert np.isfinite(a).all()
        # Summed over the wavelengths; slopes in w are bounded by those in u and v.
        assert relative_error(a, b) < 5e-3


def test_what_cannot_be_tabulated_says_so(rng):
    wi, wo = directions(rng, 4), directions(rng, 4)
    job = {"pairs": (wi, wo), "wavelengths": WAVELENGTHS, "method": "table", "tolerance": 1e-2}
    with pytest.raises(do.InputError, match="table' needs a coherence window"):
        do.DiffractionBRDF(disc(), None).prepare(**job)
    with pytest.raises(do.InputError, match="'kirchhoff' weights every facet"):
        do.DiffractionBRDF(disc(), 0.7, prefactor="kirchhoff").prepare(**job)
    brdf = do.DiffractionBRDF(disc(), 0.7)
    with pytest.raises(do.InputError, match="no derivative to the model"):
        brdf.prepare(**job, gradient="model")
    with pytest.raises(do.InputError, match="w must lie within"):
        Box((0.0, 1.0), (0.0, 1.0), (-1.0, 0.5))
    with pytest.raises(do.InputError, match="u must be a range"):
        Box((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0))


def test_a_table_too_large_is_refused_with_its_reason():
    scan = do.Heightfield(np.zeros((64, 64)) + np.eye(64) * 0.1, 1.0)
    brdf = do.DiffractionBRDF(scan, 16.0)
    fast = brdf.prepare(pairs=10**6, output="xyz", tolerance=1e-4)
    reason = {c.method: c.refused for c in fast.choice.candidates}["table"]
    assert "GiB" in reason
    assert "blur by the source" in reason
    assert fast.choice.method in ("chebyshev", "lowrank")


def test_new_values_of_the_same_shape_do_not_retrace(rng):
    """Heights, coherence and weights are values; only the table's size is static."""
    wi, wo = directions(rng, 30), directions(rng, 30)
    box, lam = Box.around(-(wi + wo)), colour.wavelengths(20.0)
    weights = np.asarray(colour.spectral_weights(lam))
    settings = do.TableSettings(step=0.6, nodes=6, intervals=8)
    before = None
    for seed in range(3):
        scan = do.samples.compact_disc(jax.random.key(seed), shape=(64, 64), pixel=0.1)
        brdf = do.DiffractionBRDF(do.Heightfield(scan.heights, scan.pixel), 0.7)
        table = baking.bake(brdf, box, lam, weights, settings, relative=False)
        lookup.shade(table, jnp.asarray(wi), jnp.asarray(wo))
        sizes = (baking._bake_block._cached._cache_size(), lookup.shade._cached._cache_size())
        assert before in (None, sizes)
        before = sizes


def test_progress_counts_to_the_end(monkeypatch):
    monkeypatch.setattr(baking, "BLOCK_ELEMENTS", 4000)
    brdf = do.DiffractionBRDF(disc(), 0.7)
    seen = []
    box = Box((-0.5, 0.5), (-0.4, 0.4), (-2.0, -1.0))
    arguments = (brdf, box, WAVELENGTHS, np.eye(3), do.TableSettings(nodes=6, intervals=8))
    in_parts = baking.bake(
        *arguments, relative=False, progress=lambda done, of: seen.append((done, of))
    )
    assert len(seen) > 2
    assert seen == [(k + 1, len(seen)) for k in range(len(seen))]
    monkeypatch.undo()
    whole = baking.bake(*arguments, relative=False)
    # Blocks differ in which distant bins they include, by the settings' error at most.
    scale = float(jnp.abs(whole.coefficients).max())
    np.testing.assert_allclose(in_parts.coefficients, whole.coefficients, atol=2e-6 * scale)


def test_table_under_vmap(plain):
    _, wi, wo, _, fast = plain
    reflect = lambda a, b: lookup.reflect(fast.tables, a, b, irradiance=False)  # noqa: E731
    one_by_one = eqx.filter_jit(jax.vmap(reflect))(jnp.asarray(wi), jnp.asarray(wo))
    np.testing.assert_allclose(one_by_one, fast(wi, wo), rtol=1e-12)
