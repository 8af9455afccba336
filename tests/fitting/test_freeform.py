"""Fits of free heights: recovery from simulated data, invariances, priors, messages."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt.errors import InputError
from diffopt.fitting import Measured
from diffopt.fitting.freeform import errors as freeform_errors
from diffopt.fitting.freeform import priors as freeform_priors
from diffopt.fitting.freeform import problem as freeform_problem
from diffopt.fitting.freeform.equal import nearest_equal
from diffopt.fitting.freeform.fit import fit_heights
from diffopt.fitting.freeform.priors import filtered, prior_root
from diffopt.fitting.freeform.problem import forward_settings, problem, weighted
from diffopt.settings import DirectSettings, SeparableSettings

PIXEL, LENGTH, RMS = 0.1, 0.5, 0.05
WAVELENGTHS = np.array([0.45, 0.55, 0.65])
# Bins of a patch of 3.2 um lie 0.31 per um apart, sigma_f of this window is 0.2.
SIGMA = 0.8
LIGHTS = ((0.0, 0.0), (0.5, 0.0), (0.0, -0.5))


def pairs(count):
    """Directions over a cap of sine 0.85 from each of three lights, [3 count, 3]."""
    k = np.arange(count) + 0.5
    radius, phi = 0.85 * np.sqrt(k / count), np.pi * (1.0 + np.sqrt(5.0)) * k
    wo = np.stack([radius * np.cos(phi), radius * np.sin(phi), np.sqrt(1.0 - radius**2)], -1)
    wi = np.array([[x, y, np.sqrt(1.0 - x * x - y * y)] for x, y in LIGHTS])
    return np.repeat(wi, count, 0), np.tile(wo, (len(LIGHTS), 1))


WI, WO = pairs(200)


def field(seed, rms, n=32):
    """A smooth periodic field of a standard deviation, correlation exp(-r^2 / LENGTH^2)."""
    f2 = np.fft.fftfreq(n, PIXEL)[:, None] ** 2 + np.fft.rfftfreq(n, PIXEL)[None, :] ** 2
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=(n, n)))
    noise[0, 0] = 0.0
    made = np.fft.irfft2(noise * np.exp(-0.5 * (np.pi * LENGTH) ** 2 * f2), (n, n))
    return rms * made / made.std()


def surface(heights, dtype="float64"):
    return do.Heightfield(jnp.asarray(heights, dtype), PIXEL)


TRUTH = field(0, RMS)
# 0.3 rad of phase at normal incidence and 0.55 um for 13 nm; 30 nm is twice that.
START = TRUTH + field(1, 0.03)


def measured(heights=TRUTH, *, wi=WI, wo=WO, sigma=SIGMA, gain=1.0, free="known", **options):
    """Data with noise of a share of each value and of a twentieth of the rms of all."""
    brdf = do.DiffractionBRDF(surface(heights), sigma, **options)
    clean = np.asarray(
        brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, settings=SeparableSettings(nodes=32))(
            wi, wo
        )
    )
    level = 0.02 * np.hypot(clean, 0.05 * np.sqrt((clean**2).mean()))
    random = np.random.default_rng(0).normal(size=clean.shape)
    values = gain * (clean + level * random)
    known = {"noise_known": True, "gain": free}
    return Measured(wi, wo, WAVELENGTHS, values, sigma, noise=gain * level, **known)


@pytest.fixture(scope="module")
def data():
    return measured()


def unmoved(heights, truth=TRUTH):
    """Heights less their mean, shifted by the fraction of a pixel that fits the truth best.

    The data do not see such a shift, and a fit undoes shifts by whole pixels only.
    """
    spectrum = np.fft.fft2(np.asarray(heights, np.float64))
    spectrum[0, 0] = 0.0
    waves = 2j * np.pi * np.fft.fftfreq(len(truth))
    shift = np.zeros(2)
    for _ in range(6):
        now = spectrum * np.exp(waves[:, None] * shift[0] + waves[None, :] * shift[1])
        slopes = [np.fft.ifft2(now * w).real.ravel() for w in (waves[:, None], waves[None, :])]
        off = (truth - truth.mean() - np.fft.ifft2(now).real).ravel()
        shift = shift + np.linalg.lstsq(np.stack(slopes, 1), off)[0]
    assert np.abs(shift).max() < 1.0
    return np.fft.ifft2(now).real


def error(fit, truth=TRUTH):
    """Standard deviation of the heights' error, micrometres, shifts apart."""
    return float(np.std(unmoved(fit.heightfield.heights, truth) - truth))


def made_problem(data, start, prior="smooth", average="positions", settings=None, **options):
    brdf = do.DiffractionBRDF(start, data.coherence, average=average)
    wave = -np.asarray(data.wi + data.wo)
    lam = np.asarray(data.wavelengths)
    return problem(
        data,
        start,
        brdf,
        settings or forward_settings(brdf.surface, wave, lam, 1e-6),
        inverse=np.asarray(1.0 / data.noise),
        root=prior_root(start, float(lam.min()), prior, None),
        prior=prior,
        **{"gain": "known", **options},
    )


class TestRecovery:
    # 2 % of noise leaves 1 to 1.5 nm of the 30 nm at the start, whichever prior and solver; twice
    # the largest is allowed.
    @pytest.mark.parametrize(
        ("prior", "solver"),
        [
            ("smooth", "lbfgs"),
            ("spectrum", "lbfgs"),
            pytest.param("smooth", "cg", marks=pytest.mark.long),
        ],
    )
    def test_heights_come_back(self, data, prior, solver):
        fit = fit_heights(data, surface(START), prior=prior, solver=solver)
        assert fit.converged, fit.reason
        assert fit.reason.startswith("Converged after")
        assert error(fit) < 2e-3
        # 1 + 5 standard deviations of a mean of 1800 squares.
        assert fit.misfit["chi2"] < 1.0 + 5.0 * np.sqrt(2.0 / data.values.size)
        assert fit.loss < 0.05 * fit.history[0]
        assert fit.heightfield.pixel == (PIXEL, PIXEL)
        assert "fitted to reflectance" in fit.heightfield.provenance.steps[-1]

    @pytest.mark.float32
    def test_float32(self):
        truth, start = TRUTH.astype(np.float32), surface(START, "float32")
        brdf = do.DiffractionBRDF(surface(truth, "float32"), SIGMA)
        wi, wo = pairs(200)
        settings = SeparableSettings(nodes=32)
        job = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, settings=settings)
        clean = np.asarray(job(wi, wo))
        level = 0.02 * np.hypot(clean, 0.05 * np.sqrt((clean**2).mean()))
        values = clean + level * np.random.default_rng(0).normal(size=clean.shape)
        data = Measured(
            wi, wo, WAVELENGTHS, values.astype(np.float32), SIGMA, noise=level.astype(np.float32)
        )
        fit = fit_heights(data, start)
        assert fit.converged, fit.reason
        assert fit.heightfield.heights.dtype == jnp.float32
        assert error(fit) < 2e-3

    @pytest.mark.long
    def test_a_free_gain_is_found(self, data):
        fit = fit_heights(measured(gain=1.4, free="free"), surface(START))
        assert fit.converged, fit.reason
        # The sum of values of 1800 data at 2 % holds the gain to 1e-3; heights trade against it.
        assert fit.gain == pytest.approx(1.4, rel=1e-2)
        assert error(fit) < 2e-3
        wrong = fit_heights(measured(gain=1.4), surface(START), max_steps=200)
        assert wrong.misfit["chi2"] > 10 * fit.misfit["chi2"]

    @pytest.mark.long
    def test_one_window_recovers_what_it_sees(self):
        start = surface(TRUTH + field(1, 0.02))
        fit = fit_heights(
            measured(average="window", sigma=0.6),
            start,
            average="window",
            prior="spectrum",
            max_steps=120,
        )
        x = (np.arange(32) - 16) * PIXEL
        seen = np.hypot(x[:, None], x[None, :]) < 0.6
        # One coherent window is speckle: its dark directions hold the phase badly.
        off = (np.asarray(fit.heightfield.heights) - TRUTH)[seen]
        assert np.std(off) < 0.25 * np.std((np.asarray(start.heights) - TRUTH)[seen])

    @pytest.mark.long
    def test_preconditioning_saves_steps(self, data):
        options = {"weight": 1000.0, "max_steps": 60, "tolerance": 1e-9}
        white = fit_heights(data, surface(START), **options)
        plain = fit_heights(data, surface(START), precondition=False, **options)
        # The same loss in other unknowns, so that the starts agree but for rounding.
        assert plain.history[0] == pytest.approx(white.history[0], rel=1e-9)
        # 20 steps against 170 to within 1 % of the minimum on a larger patch.
        assert white.history[4] < 1.01 * white.loss
        assert plain.loss > 1.05 * white.loss

    def test_unknowns_stand_for_the_same_heights(self, data):
        made, change = made_problem(data, surface(START), "spectrum")
        scaled, y = weighted(made, change, jnp.asarray(2.0), jnp.asarray(1e5))
        np.testing.assert_allclose(scaled.heights(y), START, atol=1e-12)
        rough = filtered(change, made.white)
        expected = 0.5 * (made.misfit(change)[0] + 2.0 * jnp.sum(rough**2))
        assert float(scaled.loss(y)[0]) == pytest.approx(float(expected), rel=1e-9)


class TestLoss:
    def test_the_truth_leaves_no_residual(self):
        """Against the direct sum, an implementation of its own."""
        wi, wo = WI[::9], WO[::9]
        values = do.DiffractionBRDF(surface(TRUTH), SIGMA)(wi, wo, WAVELENGTHS)
        data = Measured(wi, wo, WAVELENGTHS, values, SIGMA)
        made, _ = made_problem(data, surface(TRUTH))
        assert isinstance(made.settings, SeparableSettings)
        residual, gain = made.residuals(jnp.asarray(TRUTH))
        assert gain == 1.0
        # Settings promise 1e-6 of a mirror's peak.
        peak = float(made.before.max())
        assert float(jnp.abs(residual).max()) < 1e-6 * peak

    @pytest.mark.parametrize("average", ["positions", "window"])
    @pytest.mark.parametrize("settings", [DirectSettings(), SeparableSettings(nodes=16)])
    @pytest.mark.parametrize(
        ("prior", "gain"),
        [("smooth", "free"), pytest.param("spectrum", "known", marks=pytest.mark.long)],
    )
    def test_gradient_against_differences(self, average, settings, prior, gain):
        start = surface(field(0, RMS, n=12))
        wi, wo = pairs(4)
        data = measured(field(2, RMS, n=12), wi=wi, wo=wo, sigma=0.4, average=average)
        made, change = made_problem(data, start, prior, average, settings, gain=gain)
        made, y = weighted(made, change, jnp.asarray(3.0), jnp.asarray(1e5))
        way = jnp.asarray(np.random.default_rng(1).normal(size=y.shape))
        loss = jax.jit(lambda y: made.loss(y)[0])
        slope = float(jnp.vdot(jax.jit(jax.grad(loss))(y), way))
        # Five points: error of the fourth order in the step, rounding of 1e-12 over it.
        step = 1e-3
        ahead = [float(loss(y + k * step * way)) for k in (-2, -1, 1, 2)]
        differences = (ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / (12 * step)
        assert slope == pytest.approx(differences, rel=1e-5)

    def test_settings_are_the_cheaper_ones(self):
        brdf = do.DiffractionBRDF(surface(TRUTH), SIGMA)
        wave = -(WI + WO)
        many = forward_settings(brdf.surface, wave, WAVELENGTHS, 1e-6)
        one = forward_settings(brdf.surface, wave[200:201], WAVELENGTHS, 1e-6)
        assert isinstance(many, SeparableSettings)
        assert isinstance(one, DirectSettings) or one.nodes == 1


class TestPriors:
    @pytest.mark.parametrize("shape", [(16, 16), (15, 17)])
    def test_variance_of_roots(self, shape):
        heights = np.random.default_rng(0).normal(size=shape)
        for root in (
            freeform_priors.smooth_root(shape, (0.1, 0.2), 0.3),
            freeform_priors.gaussian_root(shape, (0.1, 0.2), 0.3, 0.4),
            freeform_priors.start_root(0.3 * heights / heights.std()),
        ):
            unit = jnp.zeros(shape).at[0, 0].set(1.0)
            kernel = filtered(unit, jnp.asarray(root))
            # White unknowns of variance 1 make fields of variance sum of kernel^2, mean 0.
            assert float(jnp.sum(kernel**2)) == pytest.approx(0.3**2, rel=1e-12)
            assert abs(float(kernel.sum())) < 1e-12

    def test_gaussian_root_has_its_correlation(self):
        root = freeform_priors.gaussian_root((64, 64), (0.1, 0.1), 0.2, 0.5)
        covariance = np.fft.irfft2(root**2, (64, 64))
        lag = np.arange(12) * 0.1
        # The mean taken out and 1e-4 of white variance; pi 0.5^2 / 6.4^2 = 0.02 of a patch.
        expected = 0.04 * np.exp(-((lag / 0.5) ** 2))
        np.testing.assert_allclose(covariance[0, :12], expected, atol=0.03 * 0.04)

    def test_spectrum_of_the_start_is_followed(self):
        lines = np.sin(2 * np.pi * np.arange(32) / 8.0)[None, :] * np.ones((32, 1))
        root = freeform_priors.start_root(lines)
        assert np.unravel_index(root.argmax(), root.shape) == (0, 4)
        assert root[1:, 1:].min() > 0.0


class TestInvariances:
    @pytest.mark.parametrize("twin", [False, True])
    @pytest.mark.parametrize("n", [12, 13])
    def test_shift_and_twin_are_undone(self, twin, n):
        start = jnp.asarray(np.random.default_rng(n).normal(size=(n, n + 1)))
        moved = -start[::-1, ::-1] if twin else start
        moved = jnp.roll(moved, (3, -4), (0, 1)) + 7.0
        found, move = nearest_equal(moved, start)
        np.testing.assert_allclose(found, start, atol=1e-12)
        assert move.twin == twin

    @pytest.mark.parametrize(("average", "middle"), [("positions", 0.0), ("window", 1.5)])
    @pytest.mark.parametrize("n", [12, 13])
    def test_equal_surfaces_have_equal_intensities(self, average, middle, n, rng):
        heights = jnp.asarray(rng.normal(scale=0.05, size=(n, n)))
        # A start so near the twin that it is chosen.
        turn = 2 * (n // 2) + 1 + round(2 * middle)
        twin = -jnp.roll(heights[::-1, ::-1], (turn, turn), (0, 1))
        start = surface(twin + 1e-3 * rng.normal(size=(n, n)))
        found, move = nearest_equal(heights, start.heights, average, (middle, middle))
        assert move.twin
        wi, wo = pairs(4)
        position = (middle * PIXEL, middle * PIXEL)
        before, after = (
            do.DiffractionBRDF(do.Heightfield(h, PIXEL), 0.4, average=average, position=position)(
                wi, wo, WAVELENGTHS
            )
            for h in (heights, found)
        )
        assert float(jnp.abs(found - heights).max()) > 0.01
        np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-12 * float(before.max()))

    def test_a_twin_off_the_grid_is_left_out(self, rng):
        heights = jnp.asarray(rng.normal(size=(8, 8)))
        _, move = nearest_equal(heights, -heights[::-1, ::-1], "window", (0.3, 0.0))
        assert not move.twin

    def test_the_mean_is_that_of_the_start(self, data):
        start = surface(START + 5.0)
        fit = fit_heights(data, start, max_steps=10)
        assert float(fit.heightfield.heights.mean()) == pytest.approx(float(start.heights.mean()))


class TestErrors:
    def test_deviation_against_dense_matrices(self):
        start, rank = surface(field(0, RMS, n=8)), 64
        wi, wo = pairs(8)
        data = measured(field(0, RMS, n=8), wi=wi, wo=wo, sigma=0.4)
        made, _ = made_problem(data, start)
        root, weight = jnp.asarray(prior_root(start, 0.45, "smooth", None)), jnp.asarray(2.0)
        key = jax.random.key(1)

        def along(z):
            return made.residuals(start.heights + filtered(z, root))[0].reshape(-1)

        jacobian = np.asarray(jax.jacfwd(along)(jnp.zeros((8, 8)))).reshape(-1, 64)
        unit = np.eye(64).reshape(64, 8, 8)
        colour = np.asarray(jax.vmap(lambda e: filtered(e, root))(jnp.asarray(unit)))
        colour = colour.reshape(64, 64).T
        moves = freeform_priors.slopes(start.heights)
        held = np.linalg.qr(colour @ np.asarray(moves).reshape(2, 64).T)[0]
        information = jacobian.T @ jacobian + 2.0 * freeform_errors._HELD * held @ held.T
        inverse = np.linalg.inv(2.0 * np.eye(64) + information)
        exact = np.sqrt(np.diag(colour @ inverse @ colour.T)).reshape(8, 8)

        def found(rank):
            args = (made, start.heights, root, weight, moves, key)
            return np.asarray(freeform_errors.posterior_deviation(*args, rank=rank))

        # Full rank but for the mean; differences of prior and gain lose digits.
        np.testing.assert_allclose(found(rank), exact, rtol=1e-5)
        # A smaller rank may only add.
        assert (found(16) > exact * (1 - 1e-6)).all()
        assert (found(16) > found(rank) * (1 - 1e-6)).all()

    @pytest.mark.long
    def test_errors_are_of_the_size_stated(self, data):
        """Truth and noise drawn from what the fit assumes."""
        fit = fit_heights(
            data,
            surface(START),
            prior="spectrum",
            roughness=(RMS, LENGTH),
            weight=1.0,
            error_rank=400,
            tolerance=1e-4,
        )
        ratio = (unmoved(fit.heightfield.heights) - TRUTH) / np.asarray(fit.error_map)
        # Some 60 independent heights: 1 +- 0.1, and Laplace's approximation is one.
        assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.4


class TestRunning:
    def test_too_few_steps_say_so(self, data):
        fit = fit_heights(data, surface(START), max_steps=15)
        assert not fit.converged
        assert fit.steps == 15
        assert fit.reason.startswith("Stopped after 15 steps")
        assert fit.reason in str(fit)

    @pytest.mark.long
    def test_a_start_too_far_is_no_answer(self, data):
        fit = fit_heights(data, surface(field(7, 0.15)), max_steps=200)
        assert not fit.converged
        assert fit.reason.startswith(("Came to rest", "Stopped after", "The line search"))

    def test_interrupt_returns_the_best(self, data):
        def progress(steps, loss):
            seen.append(loss)
            if steps >= 30:
                raise KeyboardInterrupt

        seen = []
        fit = fit_heights(data, surface(START), weight=50.0, progress=progress)
        assert fit.steps == 30
        assert not fit.converged
        assert fit.reason.startswith("Interrupted after 30 steps")
        assert fit.history[1:] == tuple(seen)
        assert fit.loss == seen[-1] < 0.5 * fit.history[0]
        assert error(fit) < np.std(START - TRUTH)

    def test_nothing_is_traced_again(self, data, monkeypatch):
        traces, at = [], []
        whole = freeform_problem.Problem.loss

        def counted(self, y):
            traces.append(1)
            return whole(self, y)

        monkeypatch.setattr(freeform_problem.Problem, "loss", counted)
        # A number of directions of its own, so that programs are traced here.
        part = Measured(
            WI[:-1], WO[:-1], WAVELENGTHS, data.values[:-1], SIGMA, noise=data.noise[:-1]
        )
        fit = fit_heights(part, surface(START), progress=lambda *_: at.append(len(traces)))
        assert at[0] > 0
        assert len(at) > 5
        assert at[-1] == at[0]
        assert fit.steps > 50

    @pytest.mark.long
    def test_deeper_heights_get_more_nodes(self, monkeypatch):
        """A flat start allows for a quarter wavelength; the surface is deeper."""
        nodes, whole = [], freeform_problem.Problem.residuals

        def seen(self, heights):
            nodes.append(self.settings.nodes)
            return whole(self, heights)

        monkeypatch.setattr(freeform_problem.Problem, "residuals", seen)
        truth = TRUTH * 0.9
        # A number of directions of its own, so that programs are traced here.
        data = measured(truth).part(slice(0, -2))
        wi, wo = WI[:-2], WO[:-2]
        fit = fit_heights(data, surface(0.02 * truth), weight=5.0, max_steps=300)
        span = float(jnp.ptp(fit.heightfield.heights))
        assert span > 0.3 * WAVELENGTHS.min()
        wanted = forward_settings(
            do.DiffractionBRDF(fit.heightfield, SIGMA).surface, -(wi + wo), WAVELENGTHS, 1e-6
        )
        assert nodes[0] < wanted.nodes <= nodes[-1]
        direct = do.DiffractionBRDF(fit.heightfield, SIGMA)(wi, wo, WAVELENGTHS)
        chi2 = float(jnp.mean(((direct - data.values) / data.noise) ** 2))
        assert fit.misfit["chi2"] == pytest.approx(chi2, rel=1e-3)

    def test_noise_left_out_is_a_share(self, data):
        bare = Measured(WI, WO, WAVELENGTHS, data.values, SIGMA)
        level = 0.01 * float(jnp.sqrt(jnp.mean(data.values**2)))
        given = Measured(
            WI, WO, WAVELENGTHS, data.values, SIGMA, noise=jnp.full_like(data.values, level)
        )
        one, two = (
            fit_heights(d, surface(START), weight=10.0, max_steps=10) for d in (bare, given)
        )
        assert one.loss == pytest.approx(two.loss, rel=1e-9)


class TestBadInput:
    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"weight": -1.0}, "weight must be positive"),
            ({"max_steps": 0}, "max_steps must be 1 or more"),
            ({"error_rank": 5000}, "error_rank must be 0 to 1024"),
            ({"prior": "flat"}, "prior must be one of smooth, spectrum"),
            ({"solver": "newton"}, "solver must be one of lbfgs, cg"),
            ({"average": "patch"}, "average must be one of"),
            ({"tolerance": 2.0}, "tolerance must be"),
            ({"roughness": (0.1, 0.5)}, "roughness needs prior='spectrum'"),
            ({"roughness": (0.1, -0.5), "prior": "spectrum"}, "roughness must be"),
        ],
    )
    def test_options(self, data, options, words):
        with pytest.raises(InputError, match=words):
            fit_heights(data, surface(START), **options)

    def test_starts(self, data):
        holes = jnp.asarray(START).at[3, 4].set(jnp.nan)
        with pytest.raises(InputError, match="missing"):
            fit_heights(data, do.Heightfield(holes, PIXEL, missing="keep"))
        with pytest.raises(InputError, match="start must not be flat"):
            fit_heights(data, surface(0 * START))
        with pytest.raises(InputError, match=r"pixel along x must be 0\.16"):
            fit_heights(data, do.Heightfield(jnp.asarray(START), (0.1, 0.2)))
        with pytest.raises(InputError, match="coherence"):
            fit_heights(data, do.Heightfield(jnp.asarray(START[:8, :8]), PIXEL))
