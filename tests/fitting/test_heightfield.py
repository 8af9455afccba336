"""`fit_heightfield`: scans, reflectance and free heights by one call; rival models; errors."""

import math

import jax
import numpy as np
import pytest
import reflectance_cases
from reflectance_cases import REACH, SIGMA, WI, disc

import diffopt as do
from diffopt import fitting
from diffopt.errors import InputError
from diffopt.fitting.reflectance import forward, solving
from diffopt.gratings import Binary, Blazed, Crossed, Sinusoidal

WAVELENGTHS = np.linspace(0.42, 0.68, 4)
WO = disc(19)


def simulated(surface, rng, wo=WO, **options):
    return reflectance_cases.simulated(surface, rng, wo, WAVELENGTHS, **options)


TRUE = Binary(1.9, 0.21, 0.3, 0.0, -0.9)


@pytest.mark.parametrize("known", [pytest.param(True, marks=pytest.mark.long), False])
def test_rivals_are_ranked(known, rng):
    data = simulated(TRUE, rng)
    if not known:
        data = fitting.Measured(WI, WO, WAVELENGTHS, data.values, SIGMA, noise=data.noise)
    fit = fitting.fit_heightfield(data, ["sinusoidal", "blazed", "binary"])
    assert fit.ranking[0].name == "binary"
    assert isinstance(fit.model, Binary)
    assert fit.converged, fit.reason
    assert fit.ranking[0].difference == 0.0
    # A wrong profile leaves several per cent of values known to 2 %.
    assert fit.ranking[1].difference > 100.0
    if known:
        assert not fit.ranking[1].converged
        # For known noise the criterion is chi^2 and the price of four parameters.
        n = data.values.size
        expected = fit.chi2 * (n - 4) + 4 * math.log(n)
        assert fit.criterion == pytest.approx(expected, rel=1e-9)


def test_a_model_that_cannot_be_fitted_is_ranked_last(rng):
    # Light in the mirror's peak alone: no period can be had.
    t = np.linspace(-0.02, 0.02, 15)
    near = np.stack([np.sin(t - 0.17), 0 * t, np.cos(t - 0.17)], -1)
    values = np.ones((15, 4)) + 0.01 * rng.normal(size=(15, 4))
    data = fitting.Measured(WI, near, WAVELENGTHS, values, SIGMA, quantity="relative")
    fit = fitting.fit_heightfield(data, ["sinusoidal", "roughness"])
    assert [row.name for row in fit.ranking] == ["roughness", "sinusoidal"]
    assert "mirror's peak only" in fit.ranking[1].reason
    with pytest.raises(InputError, match="mirror's peak only"):
        fitting.fit_heightfield(data, "sinusoidal")


@pytest.mark.long
def test_an_interrupted_comparison_returns_the_best_so_far(rng):
    def progress(what, share, loss):
        assert 0.0 <= share < 1.0
        if what.startswith("binary"):
            raise KeyboardInterrupt

    fit = fitting.fit_heightfield(
        simulated(TRUE, rng), ["sinusoidal", "blazed", "binary"], progress=progress
    )
    assert fit.interrupted
    assert not fit.converged
    assert len(fit.ranking) == 2
    assert "interrupted" in fit.reason


@pytest.mark.long
def test_a_scan_and_free_heights(rng):
    true = Sinusoidal(2.0, 0.1, 0.3, 0.0)
    scan = true.heightfield((48, 48), 0.125, edges="averaged")
    heights = np.asarray(scan.heights) + 0.002 * rng.normal(size=(48, 48))
    fit = fitting.fit_heightfield(do.Heightfield(heights, 0.125), "sinusoidal")
    assert isinstance(fit, fitting.ScanFit)
    assert float(fit.model.period) == pytest.approx(2.0, abs=4 * fit.errors["period"])
    free = fitting.fit_heightfield(simulated(true, rng), scan, max_steps=2)
    assert isinstance(free, fitting.HeightsFit)
    assert free.heightfield.shape == (48, 48)


def test_refusals(rng):
    data = simulated(TRUE, rng)
    scan = TRUE.heightfield((16, 16), 0.1)
    cases = (
        ((scan, scan), {}, "model: expected a kind of surface for a scan"),
        ((data, "binary"), {"drift": False}, "drift: no option of fit_reflectance"),
        ((data, "auto"), {"steps": 3}, "steps: no option of fit_reflectance"),
        ((scan, "binary"), {"fresnel": None}, "fresnel: no option of fit_scan"),
        ((data, "saw"), {}, "model must be one of sinusoidal"),
    )
    for given, options, text in cases:
        with pytest.raises(InputError, match=text):
            fitting.fit_heightfield(*given, **options)


def test_standard_errors_match_the_scatter(rng):
    """Forty noisy copies: errors in units of the standard error have variance 1."""
    true, scores = Blazed(2.0, 0.15, 0.0, 0.4), []
    start = Blazed(2.02, 0.145, 0.0, 0.42)
    settings = fitting.FitSettings(stages=0)
    for _ in range(40):
        fit = fitting.fit_heightfield(simulated(true, rng), start, settings=settings)
        errors = fit.errors
        scores.append([float(fit.model.get(n) - true.get(n)) / errors[n] for n in fit.names])
    # 3 sigma is exceeded by 1 in 370: among 120 by at most two but for 1 in 300 runs.
    assert (np.abs(scores) < 3).sum() >= 118
    # The relative scatter of a variance from 40 draws is sqrt(2 / 40) = 0.22.
    assert (np.mean(np.square(scores), axis=0) < 1.9).all()
    assert (np.mean(np.square(scores), axis=0) > 0.3).all()


def test_a_loop_of_fits_compiles_once(rng):
    true = Binary(1.9, 0.21, 0.3, 0.0, -0.9)
    others = (true, Binary(1.8, 0.15, 0.4, 0.0, 0.2))
    data = [simulated(surface, rng) for surface in (true, *others)]
    fitting.fit_heightfield(data[0], "binary")
    sizes = solving.solve._cached._cache_size(), forward.job._cached._cache_size()
    for one in data[1:]:
        fitting.fit_heightfield(one, "binary")
    assert sizes == (solving.solve._cached._cache_size(), forward.job._cached._cache_size())


@pytest.mark.long
def test_curves_end_at_the_loss(rng):
    for solver in ("normal-lm", "lm", "dogleg", "bfgs"):
        settings = fitting.FitSettings(solver=solver, stages=0, max_steps=50)
        start = [Binary(1.88, 0.2, 0.28, 0.0, -0.89), Binary(1.92, 0.22, 0.32, 0.0, -0.91)]
        fit = fitting.fit_heightfield(simulated(TRUE, rng), start, settings=settings)
        curve = fit.curves["least squares"]
        assert curve.shape[0] == 2
        known = [row[np.isfinite(row)] for row in curve]
        assert all((np.diff(row) <= 1e-12).all() for row in known)
        # Recomputed after the solve, in another program.
        assert min(row[-1] for row in known) == pytest.approx(fit.loss, rel=1e-9)


def test_float32_data(rng):
    data = simulated(TRUE, rng).astype("float32")
    start = Binary(*(np.float32(v) for v in (1.88, 0.2, 0.28, 0.0, -0.89)))
    fit = fitting.fit_heightfield(data, start)
    assert fit.model.dtype == np.float32
    assert fit.converged, fit.reason
    for name, error in fit.errors.items():
        assert float(fit.model.get(name)) == pytest.approx(float(TRUE.get(name)), abs=4 * error)


@pytest.mark.long
def test_what_spreads_lines_starts_from_the_lines(rng):
    true = fitting.reflectance.templates.NAMED["ridges"]().replaced(
        {
            "displacement": 0.15,
            "correlation_length": 1.2,
            "grating.period": 1.9,
            "grating.amplitude": 0.08,
            "grating.angle": 0.5,
        }
    )
    fit = fitting.fit_heightfield(simulated(true, rng), "ridges")
    assert fit.converged, fit.reason
    for name, error in fit.errors.items():
        assert float(fit.model.get(name)) == pytest.approx(float(true.get(name)), abs=4 * error)


@pytest.mark.long
def test_two_gratings(rng):
    true = Crossed(Sinusoidal(2.1, 0.08, 0.0, 0.3), Sinusoidal(1.6, 0.05, 0.0, 1.5))
    fit = fitting.fit_heightfield(simulated(true, rng), "crossed")
    assert fit.converged, fit.reason
    periods = sorted(float(fit.model.get(f"{part}.period")) for part in ("first", "second"))
    assert periods == pytest.approx([1.6, 2.1], rel=2e-3)


def test_starts_may_be_batched_by_vmap(rng):
    """The solve itself is traced code: over copies of the data in one program."""
    fits = [simulated(TRUE, rng) for _ in range(3)]
    jobs = jax.tree.map(lambda *leaves: np.stack(leaves), *[forward.job(one) for one in fits])
    names = ("period", "depth", "duty", "angle")
    box = fitting.reflectance.maps.default_bounds(
        TRUE, names, frequency=3.0, coherence=SIGMA, wavelengths=(0.42, 0.68)
    )
    y = box.unbounded(np.array([[1.88, 0.2, 0.28, -0.89]]))
    like = jax.tree.map(lambda leaf: leaf[None], TRUE)

    def solve(job):
        return solving.solve(
            job, like, box, y, None, reach=REACH, solver="normal-lm", tolerance=1e-6, max_steps=30
        )

    together = jax.vmap(solve)(jobs)
    alone = [solve(forward.job(one)) for one in fits]
    np.testing.assert_allclose(
        together.y[:, 0], np.stack([one.y[0] for one in alone]), rtol=1e-5, atol=1e-6
    )


def test_a_disc_from_the_reflectance_of_its_heights(rng):
    """Simulated by the sampled transform of one disc, which shares nothing with the fit's model."""
    scan = do.samples.compact_disc(
        jax.random.key(0), shape=(256, 256), pixel=(0.06, 1.6 * 10 / 256), depth=0.12
    )
    brdf = do.DiffractionBRDF(scan, SIGMA, average="positions")
    wi = np.broadcast_to(WI, WO.shape)
    ready = brdf.prepare(
        pairs=(wi, WO), wavelengths=WAVELENGTHS, method="separable", tolerance=1e-5
    )
    values = np.asarray(ready(wi, WO))
    noise = 0.02 * values + 1e-3 * values.max()
    values = values + noise * rng.normal(size=values.shape)
    data = fitting.Measured(WI, WO, WAVELENGTHS, values, SIGMA, noise=noise)
    fit = fitting.fit_heightfield(data, "compactdisc")
    assert fit.converged, fit.reason
    # One patch of pits is not their mean: over six patches pitches were 1.598 to 1.603 um and
    # depths 0.111 to 0.120 um.
    assert float(fit.model.pitch) == pytest.approx(do.discs.TRACK_PITCH, rel=0.01)
    assert float(fit.model.depth) == pytest.approx(0.12, rel=0.1)


class TestProfiles:
    def test_near_the_minimum_it_is_the_covariance(self, rng):
        data = simulated(TRUE, rng)
        fit = fitting.fit_heightfield(data, Binary(1.88, 0.2, 0.28, 0.0, -0.89))
        at, error = float(fit.model.depth), fit.errors["depth"]
        found = fitting.profile(data, fit, "depth", at + error * np.array([-2.0, -1.0, 0.0, 1.0]))
        # Chi^2 of a parameter held n standard errors off is n^2, but for curvature.
        np.testing.assert_allclose(found.chi2, [4.0, 1.0, 0.0, 1.0], atol=0.1)
        assert set(found.others) == {"period", "duty", "angle"}

    @pytest.mark.long
    def test_minima_of_a_saw(self, rng):
        # Depths a wavelength's order apart reflect much alike where there is one wavelength.
        true = Blazed(2.0, 0.2, 0.0, 0.4)
        data = simulated(true, rng)
        fit = fitting.fit_heightfield(data, "blazed")
        found = fitting.profile(data, fit, "depth")
        assert len(found.minima) > 1
        best = found.values[found.loss.argmin()]
        assert best == pytest.approx(float(fit.model.depth), abs=fit.errors["depth"])
        assert found.loss.min() == pytest.approx(fit.loss, rel=1e-3)

    def test_refusals(self, rng):
        data = simulated(TRUE, rng)
        fit = fitting.fit_heightfield(data, TRUE, free=("period", "depth"))
        with pytest.raises(InputError, match="name must be one of period, depth; received 'duty'"):
            fitting.profile(data, fit, "duty")
        with pytest.raises(InputError, match="values must be finite"):
            fitting.profile(data, fit, "depth", [0.1, np.nan])
