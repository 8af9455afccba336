"""Fits of surfaces to scans: recovery, ranking, refusal, and what is refused as input."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt.errors import InputError
from diffopt.fitting.scans import noise as scan_noise
from diffopt.fitting.scans import squares as scan_squares
from diffopt.fitting.scans.fit import fit_scan
from diffopt.gratings import (
    Binary,
    Blazed,
    Bumps,
    CompactDisc,
    Crossed,
    Jittered,
    Ridges,
    Roughness,
    Sinusoidal,
    Trapezoid,
)

SHAPE, PIXEL = (64, 64), 0.05
TRUE = {
    "sinusoidal": Sinusoidal(0.83, 0.05, 1.1, 0.4),
    "binary": Binary(0.83, 0.1, 0.35, 0.3, -0.7),
    "blazed": Blazed(0.83, 0.1, 0.3, 2.2),
    "trapezoid": Trapezoid(0.83, 0.1, 0.4, 0.6, 0.3, 1.2),
}


def scanned(
    surface, rng, noise=0.02, lines=0.1, spikes=6, missing=0.08, tilt=(0.01, -0.02), dtype="float64"
):
    """Tilted, with line offsets, white noise, spikes and holes; shares are of peak-to-valley."""
    h = np.array(surface.heights(SHAPE, PIXEL, edges="averaged"), np.float64)
    size = np.ptp(h)
    y, x = (np.arange(n) * PIXEL for n in SHAPE)
    h += tilt[0] * y[:, None] + tilt[1] * x[None, :]
    h += size * lines * rng.normal(size=(SHAPE[0], 1)) + size * noise * rng.normal(size=SHAPE)
    h.flat[rng.choice(h.size, spikes, replace=False)] += 3.0 * size
    h.flat[rng.choice(h.size, int(missing * h.size), replace=False)] = np.nan
    return do.Heightfield(h.astype(dtype), PIXEL, missing="keep")


def pulls(fit, true):
    """Differences over standard errors, angles and turns by the shortest way."""
    out = {}
    for name, error in fit.errors.items():
        apart = float(fit.model.get(name)) - float(true.get(name))
        last = name.split(".")[-1]
        turn = {"shift": 1.0, "phase": 2 * math.pi, "angle": 2 * math.pi}.get(last)
        apart = apart if turn is None else (apart + turn / 2) % turn - turn / 2
        out[name] = apart / error
    return out


@pytest.mark.parametrize("name", list(TRUE))
def test_gratings_are_recovered_from_a_bad_scan(name, rng):
    true = TRUE[name]
    fit = fit_scan(scanned(true, rng), name)
    assert fit.converged, fit.reason
    # Five parameters or six: one in 3000 such draws is beyond four standard errors.
    assert max(map(abs, pulls(fit, true).values())) < 4.0, pulls(fit, true)
    # The error of a depth is a few thousandths of it, not a few tenths.
    assert fit.errors["period"] < 0.01 * 0.83
    assert set(fit.identifiable.values()) == {"determined"}
    # Slopes: noise of lines 0.01 um over 64 lines of 3.2 um, 0.0014 um/um; four of them.
    np.testing.assert_allclose(fit.tilt, (0.01, -0.02), atol=0.006)
    assert fit.tilt[1] == pytest.approx(-0.02, abs=3e-4)
    assert fit.goodness > 0.9


def test_lines_and_residual_are_those_of_the_scan(rng):
    true = TRUE["binary"]
    scan = scanned(true, rng, missing=0.05, spikes=0)
    fit = fit_scan(scan, "binary")
    holes = np.isnan(np.asarray(scan.heights))
    np.testing.assert_array_equal(np.isnan(np.asarray(fit.residual)), holes)
    # 2 % white noise of a depth of 0.1 um; 3 % for estimating it from 3,900 pixels.
    assert np.nanstd(np.asarray(fit.residual)) == pytest.approx(0.002, rel=0.06)
    assert fit.noise["white"] == pytest.approx(0.002, rel=0.15)
    # Standard deviation from 64 draws: 9 %; three of it.
    assert fit.lines.std() == pytest.approx(0.01, rel=0.3)


@pytest.mark.long
def test_curves_end_at_what_is_returned(rng):
    scan = scanned(TRUE["sinusoidal"], rng, lines=0.0, missing=0.0, spikes=0)
    fit = fit_scan(scan, ["sinusoidal", "ridges"], drift=False, robust=False)
    # Compared with, so it has a curve as well.
    assert set(fit.curves) == {"sinusoidal", "ridges", "roughness"}
    for curve in fit.curves.values():
        assert len(curve) > 2
        assert (np.diff(curve) <= 0).all()
    # Without weights and offsets the loss is the mean square of the residual; sums of 4,096.
    square = float(np.mean(np.asarray(fit.residual) ** 2))
    assert fit.curves["sinusoidal"][-1] == pytest.approx(square, rel=1e-9)
    # Rounds of a robust fit start anew.
    robust = fit_scan(scan, "sinusoidal")
    steps = int(robust.reason.split()[-2])
    assert len(robust.curves["sinusoidal"]) == steps


@pytest.mark.long
def test_only_what_may_lead_is_fitted_to_all_pixels(rng, monkeypatch):
    """On 2 x 2 averages of 128 x 128 pixels, of which the likelihood takes 64 x 64 here."""
    monkeypatch.setattr(scan_noise, "MOST", 64)
    true, seen = TRUE["sinusoidal"], []
    h = np.asarray(true.heights((128, 128), PIXEL, edges="averaged"))
    whole = scan_squares.fit

    def counted(scan, surface, **options):
        seen.append((surface.title, scan.heights.shape[0]))
        return whole(scan, surface, **options)

    monkeypatch.setattr(scan_squares, "fit", counted)
    scan = do.Heightfield(h + 0.002 * rng.normal(size=h.shape), PIXEL)
    fit = fit_scan(scan, ["sinusoidal", "binary"])
    assert {title for title, n in seen if n == 64} == {"sinusoidal", "binary"}
    assert {title for title, n in seen if n == 128} == {"sinusoidal"}
    assert fit.ranking[0].name == "sinusoidal"
    assert fit.converged, fit.reason
    # The residual has the white noise of single pixels: 1 / sqrt(2 128^2) = 0.6 %; four of it.
    assert np.std(np.asarray(fit.residual)) == pytest.approx(0.002, rel=0.025)
    assert max(map(abs, pulls(fit, true).values())) < 4.0


def test_without_drift_there_are_no_lines(rng):
    fit = fit_scan(scanned(TRUE["sinusoidal"], rng, lines=0.0), "sinusoidal", drift=False)
    assert np.abs(fit.lines).max() < 1e-9
    assert fit.noise["lines"] == 0.0
    assert max(map(abs, pulls(fit, TRUE["sinusoidal"]).values())) < 4.0


def test_lines_do_not_eat_a_grating_along_y(rng):
    true = Sinusoidal(0.83, 0.05, 1.1, math.pi / 2)
    fit = fit_scan(scanned(true, rng), "sinusoidal")
    # Lines scatter by 0.01 um, a fifth of the amplitude: it is known to 0.01 sqrt(2 / 64).
    assert fit.errors["amplitude"] == pytest.approx(0.01 * math.sqrt(2 / 64), rel=0.4)
    assert max(map(abs, pulls(fit, true).values())) < 4.0


def test_crossed_gratings(rng):
    true = Crossed(Sinusoidal(0.83, 0.05, 0.3, 0.2), Sinusoidal(0.57, 0.03, -1.0, 1.5))
    fit = fit_scan(scanned(true, rng, lines=0.02), ["sinusoidal", "crossed"])
    assert fit.ranking[0].name == "crossed"
    assert fit.converged, fit.reason
    # Ten parameters.
    assert max(map(abs, pulls(fit, true).values())) < 4.0


@pytest.mark.long
def test_errors_cover_the_truth_under_correlated_noise(rng):
    """Counts of pulls within 1 and 2 standard errors, noise white and correlated."""
    true = TRUE["sinusoidal"]
    h = np.asarray(true.heights(SHAPE, PIXEL, edges="averaged"))
    rough = Roughness(0.01, 0.15)
    found = []
    for trial in range(30):
        extra = np.asarray(rough.heights(SHAPE, PIXEL, key=jax.random.key(trial)))
        values = h + extra + 0.002 * rng.normal(size=SHAPE)
        fit = fit_scan(do.Heightfield(values, PIXEL), true, drift=False)
        found += list(pulls(fit, true).values())
    inside = [np.mean(np.abs(found) < k) for k in (1.0, 2.0)]
    # 30 trials of 4 parameters: standard error 0.043 of 0.68 and 0.019 of 0.95; three of them.
    assert 0.55 < inside[0] < 0.81
    assert inside[1] > 0.89


RANDOM = {
    "roughness": Roughness(0.02, 0.2),
    "ridges": Ridges(Sinusoidal(0.5, 0.05, 0.0, 0.6), 0.05, 0.6),
}


# By day bumps and grains are told from gratings, below.
@pytest.mark.long
@pytest.mark.parametrize("name", RANDOM)
def test_random_surfaces_rank_first(name, rng):
    true = RANDOM[name]
    h = np.asarray(true.heights((96, 96), PIXEL, key=jax.random.key(4)))
    h = h + 0.02 * h.std() * rng.normal(size=h.shape)
    fit = fit_scan(do.Heightfield(h, PIXEL), ["sinusoidal", "ridges", "roughness", "bumps"])
    assert fit.ranking[0].name == name, fit.ranking
    assert fit.converged, fit.reason
    for path in fit.names:
        if path.split(".")[-1] != "phase":
            apart = float(fit.model.get(path)) - float(true.get(path))
            assert abs(apart) < 4.0 * fit.errors[path], path
    if name == "ridges":
        assert "no phase" in fit.identifiable["grating.phase"]


def test_skewness_tells_bumps(rng):
    true = Bumps(0.05, 0.1, 5.0)
    h = np.asarray(true.heights((96, 96), PIXEL, key=jax.random.key(1)))
    h = h + 2e-4 * rng.normal(size=h.shape)
    fit = fit_scan(do.Heightfield(h, PIXEL), ["roughness", "bumps"])
    assert fit.ranking[0].name == "bumps"
    # Errors from 16 parts are known to a fifth themselves: four of them.
    for path in fit.names:
        assert abs(float(fit.model.get(path)) - float(true.get(path))) < 4.0 * fit.errors[path]


@pytest.mark.long
def test_a_disc_is_measured_along_its_tracks():
    true = CompactDisc(pitch=1.5, depth=-0.15, width=0.35, wall=0.4, angle=-0.2, shift=0.3)
    h = np.asarray(true.heights((128, 128), 0.07, key=jax.random.key(0)))
    h = h + 0.002 * np.random.default_rng(0).normal(size=h.shape)
    fit = fit_scan(do.Heightfield(h, 0.07), ["sinusoidal", "compactdisc"])
    assert isinstance(fit.model, CompactDisc)
    assert float(fit.model.pitch) == pytest.approx(1.5, rel=3e-3)
    # Pits are drawn with straight walls and fitted with round ones: 3 %.
    assert float(fit.model.depth) == pytest.approx(-0.15, rel=0.03)
    assert float(fit.model.angle) == pytest.approx(-0.2, abs=5e-3)
    assert float(fit.model.bit) == pytest.approx(float(true.bit), abs=4 * fit.errors["bit"])
    counted = next(row for row in fit.ranking if row.name == "compactdisc").parameters
    assert counted > 20


def test_grains_are_no_grating():
    h = np.asarray(Roughness(0.02, 0.2).heights((96, 96), PIXEL, key=jax.random.key(7)))
    fit = fit_scan(do.Heightfield(h, PIXEL), "sinusoidal")
    assert not fit.converged
    assert "does not support a sinusoidal grating" in fit.reason
    assert fit.ranking[0].name == "roughness"


@pytest.mark.float32
def test_float32(rng):
    true = jax.tree.map(lambda a: jnp.asarray(a, "float32"), TRUE["sinusoidal"])
    fit = fit_scan(scanned(true, rng, dtype="float32"), "sinusoidal")
    assert fit.converged, fit.reason
    assert fit.residual.dtype == jnp.float32
    assert fit.model.period.dtype == jnp.float32
    assert max(map(abs, pulls(fit, true).values())) < 4.0


def test_too_few_steps_are_said(rng):
    fit = fit_scan(scanned(TRUE["trapezoid"], rng), "trapezoid", max_steps=3)
    assert not fit.converged
    assert fit.reason.startswith("Least squares did not come to an end in 3 steps")


def test_an_interrupt_returns_the_best_so_far(rng):
    def progress(name, number, count):
        if number == 1:
            raise KeyboardInterrupt

    scan = scanned(TRUE["sinusoidal"], rng)
    fit = fit_scan(scan, ["sinusoidal", "binary"], progress=progress)
    assert isinstance(fit.model, Sinusoidal)
    assert not fit.converged
    assert fit.reason.startswith("Interrupted after 1 of 2")


@pytest.mark.float32
@pytest.mark.parametrize(
    ("values", "model", "text"),
    [
        (np.full((32, 32), np.nan), "auto", "missing"),
        (np.full((32, 32), 0.1), "auto", "flat"),
        (np.zeros((8, 40)), "auto", "16 x 16"),
        (np.eye(32), "sinusoid", "expected 'auto' or one of"),
        (np.eye(32), [], "empty"),
        (np.eye(32), Jittered, "domain"),
        (np.eye(32), 3, "expected one of"),
    ],
)
def test_bad_input_is_refused(values, model, text):
    scan = do.Heightfield(values.astype("float32"), PIXEL, missing="keep")
    with pytest.raises(InputError, match=text):
        fit_scan(scan, model)
