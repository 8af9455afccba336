"""Fits of gratings: the forward model against the sampled one, and recovery from data."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt import fitting
from diffopt.errors import InputError
from diffopt.fitting.heightfield import orders_needed
from diffopt.fresnel import Schlick
from diffopt.gratings import Binary, Blazed, Grating, Sinusoidal
from reference import directions

WAVELENGTHS = np.array([0.45, 0.6])
SIGMA = 2.0
# Spacing of sines 0.03, a line is sigma_f lambda = 0.04 wide.
ANGLES = np.radians(np.linspace(-70.0, 70.0, 61))


def plane(angles):
    return np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)


WI, WO = plane(np.radians(10.0)), plane(ANGLES)


def scalars(kind, *values, dtype="float64"):
    return kind(*(jnp.asarray(v, dtype) for v in values))


def brdf(grating, sigma=SIGMA, **options):
    dtype = grating.period.dtype
    wi = jnp.broadcast_to(jnp.asarray(WI, dtype), WO.shape)
    return fitting.grating_brdf(
        grating,
        wi,
        jnp.asarray(WO, dtype),
        jnp.asarray(WAVELENGTHS, dtype),
        jnp.asarray(sigma, dtype),
        orders=orders_needed(2 * float(grating.period), sigma),
        **options,
    )


def measured(grating, share=0.0, sigma=SIGMA):
    """Data with additive noise of a share of the largest value."""
    values = np.asarray(brdf(grating, sigma))
    noise = np.random.default_rng(0).normal(size=values.shape)
    values = (values + share * values.max() * noise).astype(values.dtype)
    return fitting.Measured(WI, WO, WAVELENGTHS, values, sigma)


def fit_heightfield(data, start, **options):
    """With one number of orders, so that fits share their compiled programs."""
    return fitting.fit_heightfield(data, start, **{"orders": 3, **options})


class TestForwardModel:
    """Against `DiffractionBRDF` of a sampled grating, averaged over positions."""

    # A sine by samples is exact but for aliases. A jump on 256 samples a period leaves
    # (m / 256)^2 of an order's power, 1e-3 for m = 8.
    CASES = (
        (Sinusoidal(2.0, 0.12), {}, 1e-10),
        (Blazed(2.0, 0.15, -0.5 / 256), {}, 2e-3),
        (Binary(2.0, 0.1, 0.25, -0.5 / 256), {}, 2e-3),
    )

    @pytest.mark.parametrize("quantity", ["spectral", "relative"])
    @pytest.mark.parametrize(("grating", "options", "tolerance"), CASES)
    def test_agrees_with_the_sampled_grating(self, grating, options, tolerance, quantity, rng):
        wi, wo = directions(rng, 20), directions(rng, 20)
        # Half of them in the plane across the lines, where the orders are.
        wi[:10], wo[:10] = WI, WO[5:55:5]
        fresnel = Schlick(0.04)
        # 0.125 um along the lines keep the copies of the spectrum, 8 per um apart, out of reach.
        scan = grating.heightfield((64, 1024), (0.125, 2.0 / 256))
        model = do.DiffractionBRDF(scan, SIGMA, fresnel=fresnel)
        evaluate = model.relative if quantity == "relative" else model
        expected = evaluate(wi, wo, WAVELENGTHS)
        value = fitting.grating_brdf(
            grating,
            jnp.asarray(wi),
            jnp.asarray(wo),
            jnp.asarray(WAVELENGTHS),
            jnp.asarray(SIGMA),
            orders=4,
            fresnel=fresnel,
            quantity=quantity,
        )
        assert float(expected.max()) > 1e-3
        np.testing.assert_allclose(value, expected, atol=tolerance * float(expected.max()))

    def test_orders_left_out_are_faint(self):
        grating = Blazed(2.0, 0.15)
        # The longest period asked for is twice that of the grating: 1e-7 of a line, to the
        # power of four, plus rounding.
        np.testing.assert_allclose(
            brdf(grating),
            fitting.grating_brdf(
                grating,
                jnp.broadcast_to(jnp.asarray(WI), WO.shape),
                jnp.asarray(WO),
                jnp.asarray(WAVELENGTHS),
                jnp.asarray(SIGMA),
                orders=12,
            ),
            rtol=1e-12,
            atol=1e-12,
        )

    def test_zero_below_the_horizon(self):
        below = jnp.asarray([[0.6, 0.0, -0.8]])
        up = jnp.asarray([[0.0, 0.0, 1.0]])
        lam, sigma = jnp.asarray(WAVELENGTHS), jnp.asarray(SIGMA)
        value = fitting.grating_brdf(Blazed(2.0, 0.1), up, below, lam, sigma, orders=1)
        np.testing.assert_array_equal(value, 0.0)


STARTS = [(p, d) for p in (0.7, 0.85, 1.2, 1.5) for d in (0.4, 0.7, 1.3)]


class TestRecovery:
    def test_blazed_from_far_starts(self, dtype):
        """One program, vmapped over single fits by the caller."""
        truth = scalars(Blazed, 2.0, 0.15, dtype=dtype)
        # Lines of 0.03 in u: from half of these starts they miss each other.
        data = measured(truth, sigma=3.0)
        starts = jax.vmap(Blazed)(
            *(jnp.asarray([s[i] * v for s in STARTS], dtype) for i, v in ((0, 2.0), (1, 0.15)))
        )
        fits = eqx.filter_jit(eqx.filter_vmap(lambda start: fit_heightfield(data, start)))(starts)
        assert fits.model.period.dtype == dtype
        # The solver's tolerance is the root of the rounding unit, 3e-4 and 1.5e-8.
        tolerance = {"float32": 1e-3, "float64": 1e-6}[dtype]
        right = (jnp.abs(fits.model.period / 2.0 - 1) < tolerance) & (
            jnp.abs(fits.model.depth / 0.15 - 1) < tolerance
        )
        assert bool(right.all())
        # The coarse stages are what finds it.
        alone = eqx.filter_vmap(lambda start: fit_heightfield(data, start, stages=0))(starts)
        assert int((jnp.abs(alone.model.period / 2.0 - 1) < tolerance).sum()) < 9

    @pytest.mark.parametrize("factors", [(0.7, 1.6), (1.5, 2.0)])
    def test_several_starts_find_what_one_misses(self, factors):
        truth = Blazed(2.0, 0.15)
        start = [Blazed(2.0 * factors[0], 0.15 * factors[1] * f) for f in (0.3, 0.5, 0.7, 1.0)]
        fit = fit_heightfield(measured(truth), start)
        assert float(fit.model.period) == pytest.approx(2.0, rel=1e-6)
        assert float(fit.model.depth) == pytest.approx(0.15, rel=1e-6)
        assert float(fit.residual) < 1e-6
        assert fit.message == "converged"
        assert "Blazed: " in str(fit)

    @pytest.mark.parametrize("start", [(0.7, 0.4), (1.5, 1.5)])
    def test_sinusoid(self, start):
        fit = fit_heightfield(
            measured(Sinusoidal(2.0, 0.1)), Sinusoidal(2.0 * start[0], 0.1 * start[1], 0.3)
        )
        assert float(fit.model.period) == pytest.approx(2.0, rel=1e-6)
        assert float(fit.model.amplitude) == pytest.approx(0.1, rel=1e-6)
        # The phase cannot be seen and stays.
        assert float(fit.model.phase) == 0.3

    def test_binary_with_its_duty(self):
        truth = Binary(2.0, 0.08, 0.3)
        fit = fit_heightfield(measured(truth), Binary(1.8, 0.1, 0.4))
        for name in ("period", "depth", "duty"):
            expected = float(getattr(truth, name))
            assert float(getattr(fit.model, name)) == pytest.approx(expected, rel=1e-6)
        held = fit_heightfield(measured(truth), Binary(1.8, 0.1, 0.3), free=("period", "depth"))
        assert set(held.errors) == {"period", "depth"}
        assert float(held.model.duty) == 0.3

    def test_relative_values_and_reflectance(self):
        truth, fresnel = Blazed(2.0, 0.15), Schlick(0.04)
        values = brdf(truth, fresnel=fresnel, quantity="relative")
        data = fitting.Measured(WI, WO, WAVELENGTHS, values, SIGMA, quantity="relative")
        fit = fit_heightfield(data, Blazed(1.8, 0.12), fresnel=fresnel)
        assert float(fit.model.depth) == pytest.approx(0.15, rel=1e-6)

    def test_a_negative_depth_keeps_its_sign(self):
        fit = fit_heightfield(measured(Blazed(2.0, -0.15)), Blazed(1.8, -0.12))
        assert float(fit.model.depth) == pytest.approx(-0.15, rel=1e-6)


class TestErrors:
    def test_standard_errors_match_the_scatter(self):
        """Forty noisy copies: errors in units of the standard error have variance 1."""
        truth = Blazed(2.0, 0.15)
        clean = measured(truth)
        noise = np.random.default_rng(5).normal(size=(40, *clean.values.shape))
        values = clean.values[None] + 0.02 * float(clean.values.max()) * jnp.asarray(noise)

        def fit(values):
            data = eqx.tree_at(lambda m: m.values, clean, values)
            start = scalars(Blazed, 2.1, 0.14)
            return fit_heightfield(data, start, stages=0)

        fits = eqx.filter_jit(eqx.filter_vmap(fit))(values)
        for name, true in (("period", 2.0), ("depth", 0.15)):
            score = np.asarray((getattr(fits.model, name) - true) / fits.errors[name])
            # 3 sigma is exceeded by 1 in 370; among 40 by at most one but for 1 in 200 runs.
            assert (np.abs(score) < 3).sum() >= 39
            # The relative scatter of a variance from 40 draws is sqrt(2 / 40) = 0.22.
            assert 0.3 < np.mean(score**2) < 1.9

    def test_noise_weighs_the_values(self):
        data = measured(Blazed(2.0, 0.15))
        values = np.array(data.values)
        values[20:25] *= 3.0
        noise = np.ones_like(values)
        noise[20:25] = 1e6
        start = Blazed(1.9, 0.14)
        spoilt = fitting.Measured(WI, WO, WAVELENGTHS, values, SIGMA)
        weighed = fitting.Measured(WI, WO, WAVELENGTHS, values, SIGMA, noise=noise)
        assert abs(float(fit_heightfield(spoilt, start).model.depth) / 0.15 - 1) > 1e-4
        # The outliers still weigh 1e-12 of the others.
        fit = fit_heightfield(weighed, start)
        assert float(fit.model.depth) == pytest.approx(0.15, rel=1e-6)

    def test_what_the_data_do_not_hold_has_an_infinite_error(self):
        # Duty 1/2: no order depends on it to first order.
        fit = fit_heightfield(measured(Binary(2.0, 0.08), 0.02), Binary(1.95, 0.09, 0.5))
        assert float(fit.errors["duty"]) > 1e6
        assert float(fit.errors["period"]) < 1e-2

    def test_too_few_steps_are_reported(self):
        fit = fit_heightfield(measured(Blazed(2.0, 0.15)), Blazed(1.7, 0.12), stages=0, max_steps=2)
        assert "maximum number of steps" in fit.message


def test_a_loop_of_fits_compiles_once():
    data = measured(Blazed(2.0, 0.15), 0.02)

    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def fit(data, start):
        return fit_heightfield(data, start)

    for period in (1.8, 2.0, 2.2):
        result = fit(data, scalars(Blazed, period, 0.14))
        # 2 % noise of the largest value: 3 standard errors are below 1 %.
        assert float(result.model.period) == pytest.approx(2.0, rel=1e-2)


class TestRefusals:
    def test_shapes(self):
        values = np.ones((61, 2))
        with pytest.raises(InputError, match=r"values must be \[M, L\] with L = 2 .*\(61, 3\)"):
            fitting.Measured(WI, WO, WAVELENGTHS, np.ones((61, 3)), SIGMA)
        with pytest.raises(InputError, match=r"wo must be \[3\] or \[M, 3\] with the M = 61"):
            fitting.Measured(WI, WO[:5], WAVELENGTHS, values, SIGMA)
        with pytest.raises(InputError, match="wi must be unit vectors"):
            fitting.Measured(2 * WI, WO, WAVELENGTHS, values, SIGMA)
        with pytest.raises(InputError, match="noise must be one number or as values"):
            fitting.Measured(WI, WO, WAVELENGTHS, values, SIGMA, noise=np.ones(2))

    def test_values(self):
        values = np.ones((61, 2))
        cases = (
            ({"wi": -WI}, "wi must lie above the horizon"),
            ({"values": np.full((61, 2), np.nan)}, "values must be finite"),
            ({"values": 0 * values}, "values must be finite, not all 0"),
            ({"values": np.ones((61, 2), int)}, "values must be floating-point"),
            ({"coherence": 0.0}, "coherence must be one length > 0; received 0"),
            ({"wavelengths": 1000 * WAVELENGTHS}, "nanometres"),
            ({"noise": 0 * values}, "noise must be positive"),
        )
        good = {
            "wi": WI,
            "wo": WO,
            "wavelengths": WAVELENGTHS,
            "values": values,
            "coherence": SIGMA,
        }
        for change, text in cases:
            with pytest.raises(InputError, match=text):
                fitting.Measured(**(good | change))

    def test_starts(self):
        class Other(Grating):
            period: jax.Array
            angle: jax.Array
            offset: jax.Array

            def profile(self, x):
                return x

            def integral(self, x):
                return x

            def order_amplitude(self, order, kappa):
                return kappa + 0j

        data = measured(Blazed(2.0, 0.15))
        cases = (
            (
                Other(jnp.asarray(2.0), jnp.zeros(()), jnp.zeros(())),
                {},
                "model must be one kind of .*; received Other",
            ),
            ([Blazed(2.0, 0.1), Sinusoidal(2.0, 0.1)], {}, "received Blazed, Sinusoidal"),
            ([], {}, "received none"),
            (Blazed(jnp.asarray([2.0, -2.0]), 0.1), {}, "period must be between 0 and inf"),
            (Blazed(2.0, 0.0), {}, "depth must be .*not 0"),
            (Binary(2.0, 0.1, 1.0), {}, "duty must be between 0 and 1"),
            (Blazed(2.0, 0.1), {"free": ("shift",)}, "free must be some of period, depth"),
            (Blazed(2.0, 0.1), {"stages": -1}, "stages must be 0 or more"),
        )
        for start, options, text in cases:
            with pytest.raises(InputError, match=text):
                fit_heightfield(data, start, **options)

    def test_amounts(self):
        few = fitting.Measured(WI, WO[:1], [0.5], [[1.0]], SIGMA)
        with pytest.raises(InputError, match="outnumber the 2 free parameters; received 1"):
            fit_heightfield(few, Blazed(2.0, 0.1))
        many = fitting.Measured(WI, WO, np.linspace(0.4, 0.7, 200), np.ones((61, 200)), SIGMA)
        with pytest.raises(InputError, match="coarse stages take 8192 values at most"):
            fit_heightfield(many, Blazed(2.0, 0.1))
        data = measured(Blazed(2.0, 0.1))
        with pytest.raises(InputError, match="orders must be given"):
            jax.jit(lambda p: fitting.fit_heightfield(data, Blazed(p, 0.1)))(jnp.asarray(2.0))
