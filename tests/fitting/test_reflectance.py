"""Fits of parametric surfaces to reflectance: recovery from the data alone, honest answers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reflectance_cases
from lengths import but
from reflectance_cases import disc

from diffopt import fitting, gratings
from diffopt.errors import InputError
from diffopt.fitting.reflectance import forward
from diffopt.gratings import Binary, Blazed, Reach, Sinusoidal

WAVELENGTHS = np.linspace(0.42, 0.68, 5)
WO = disc(23)


def simulated(surface, rng, wo=WO, **options):
    return reflectance_cases.simulated(surface, rng, wo, WAVELENGTHS, **options)


TRUTHS = {
    "sinusoidal": Sinusoidal(2.3, 0.09, 0.0, 0.6),
    "blazed": Blazed(1.7, 0.3, 0.0, 2.2),
    "binary": Binary(1.9, 0.21, 0.3, 0.0, -0.9),
}


@pytest.mark.parametrize("name", but({"sinusoidal", "binary"}, TRUTHS))
def test_recovers_from_the_data_alone(name, rng):
    truth = TRUTHS[name]
    fit = fitting.fit_reflectance(simulated(truth, rng), name)
    assert fit.converged, fit.reason
    for path, error in fit.errors.items():
        # Four standard errors: one in 16,000 of right fits would fail.
        assert float(fit.model.get(path)) == pytest.approx(float(truth.get(path)), abs=4 * error)
    # Chi-squared per value of some 2,000: its standard deviation is 0.03.
    assert fit.chi2 == pytest.approx(1.0, abs=0.15)


def test_a_free_gain_takes_up_a_factor(rng):
    data = simulated(Sinusoidal(2.3, 0.09, 0.0, 0.6), rng, gain="free")
    leaves = (7.0 * data.values, 7.0 * data.noise)
    import equinox as eqx

    fit = fitting.fit_reflectance(
        eqx.tree_at(lambda m: (m.values, m.noise), data, leaves), "sinusoidal"
    )
    # The gain comes from some thousand values of 2 %.
    assert fit.gain == pytest.approx(7.0, rel=0.01)
    assert float(fit.model.period) == pytest.approx(2.3, rel=1e-3)


@pytest.mark.parametrize("quantity", ["relative", "power"])
def test_other_quantities(quantity, rng):
    fit = fitting.fit_reflectance(
        simulated(Sinusoidal(2.3, 0.09, 0.0, 0.6), rng, quantity=quantity), "sinusoidal"
    )
    assert fit.converged, fit.reason
    assert float(fit.model.amplitude) == pytest.approx(0.09, rel=0.01)


def test_the_wrong_model_is_no_answer(rng, long):
    # By night with the second try, which has three times the starts and ends no better.
    settings = fitting.FitSettings() if long else fitting.FitSettings(retries=0)
    data = simulated(Blazed(1.7, 0.3, 0.0, 2.2), rng)
    fit = fitting.fit_reflectance(data, "sinusoidal", settings=settings)
    assert not fit.converged
    assert "does not explain the data" in fit.reason


def test_too_few_steps_are_no_answer(rng):
    data = simulated(Blazed(1.7, 0.3, 0.0, 2.2), rng)
    settings = fitting.FitSettings(max_steps=2, stages=0)
    fit = fitting.fit_reflectance(data, Blazed(1.6, 0.25, 0.0, 2.2), settings=settings)
    assert not fit.converged
    assert "without meeting its tolerance" in fit.reason


def test_what_the_data_cannot_tell(rng):
    plane = np.stack([np.sin(t := np.linspace(-1.1, 1.1, 61)), 0 * t, np.cos(t)], -1)
    data = simulated(Sinusoidal(2.3, 0.09), rng, wo=plane)
    fit = fitting.fit_reflectance(data, Sinusoidal(2.2, 0.08))
    assert fit.names == ("period", "amplitude")
    assert "one plane" in fit.identifiable["angle"]
    assert "surface is moved" in fit.identifiable["phase"]
    assert fit.identifiable["period"] == "determined"


def test_interrupted(rng):
    def progress(what, share, loss):
        if what == "least squares on all data":
            raise KeyboardInterrupt

    data = simulated(Sinusoidal(2.3, 0.09, 0.0, 0.6), rng)
    fit = fitting.fit_reflectance(data, "sinusoidal", progress=progress)
    assert not fit.converged
    assert "interrupted" in fit.reason
    # The best of the solves on some rows is there already.
    assert float(fit.model.period) == pytest.approx(2.3, rel=0.01)


@pytest.mark.long
def test_solvers_agree(rng):
    data = simulated(Binary(1.9, 0.21, 0.3, 0.0, -0.9), rng)
    start = Binary(1.85, 0.2, 0.28, 0.0, -0.88)
    periods = {}
    for solver in ("normal-lm", "lm", "dogleg", "bfgs"):
        settings = fitting.FitSettings(solver=solver, stages=0, max_steps=200)
        fit = fitting.fit_reflectance(data, start, settings=settings)
        periods[solver] = float(fit.model.period)
        error = fit.errors["period"]
    # All stop at tolerances far below the standard error.
    assert np.ptp(list(periods.values())) < 0.1 * error


@pytest.mark.long
def test_coarse_windows_widen_the_basin(rng):
    data = simulated(Sinusoidal(2.3, 0.09, 0.0, 0.6), rng)
    start = Sinusoidal(1.75, 0.12, 0.0, 0.55)
    fits = [
        fitting.fit_reflectance(data, start, settings=fitting.FitSettings(stages=stages))
        for stages in (0, 4)
    ]
    assert float(fits[1].model.period) == pytest.approx(2.3, rel=1e-2)
    assert fits[1].loss <= fits[0].loss * 1.001


@pytest.mark.parametrize(
    ("model", "options", "text"),
    [
        ("saw", {}, "model must be one of sinusoidal"),
        ([], {}, "model must be a name"),
        ([Sinusoidal(1.0, 0.1), Blazed(1.0, 0.1)], {}, "received Blazed, Sinusoidal"),
        ("blazed", {"free": ("shift",)}, "free must be some of period, depth, angle"),
        ("blazed", {"bounds": {"size": (1.0, 2.0)}}, "'size' is no free parameter"),
        ("blazed", {"bounds": {"period": (2.0, 1.0)}}, "ascending and above 0"),
    ],
)
def test_refusals(model, options, text, rng):
    data = simulated(Sinusoidal(2.3, 0.09, 0.0, 0.6), rng)
    with pytest.raises(InputError, match=text):
        fitting.fit_reflectance(data, model, **options)


def test_residuals_have_the_gradient_of_differences(rng):
    surface = gratings.Superposed(
        gratings.Ridges(gratings.Trapezoid(1.9, 0.2, 0.35, 0.4, 0.1, -0.5), 0.1, 2.0),
        gratings.Roughness(0.03, 0.6),
    )
    job = forward.job(simulated(Binary(1.9, 0.21, 0.3, 0.0, -0.9), rng, wo=WO[::20]))
    names = gratings.parametric.seen_in_power(surface)
    probe = jnp.asarray(rng.normal(size=job.values.size))

    def loss(values):
        moved = surface.replaced(dict(zip(names, values, strict=True)))
        return (forward.residuals(job, moved, Reach(2, 16, 32.0, 8)) * probe).sum()

    values = jnp.stack([surface.get(name) for name in names])
    slope = np.asarray(jax.grad(loss)(values))
    for k in range(len(names)):
        step = 1e-6 * max(abs(float(values[k])), 0.1)
        up, down = (float(loss(values.at[k].add(sign * step))) for sign in (1.0, -1.0))
        # Central differences: rounding 1e-16 / 1e-6 and curvature 1e-12 of the slope's scale.
        expected = (up - down) / (2 * step)
        assert slope[k] == pytest.approx(expected, rel=1e-4, abs=1e-5 * np.abs(slope).max())


# By day of the least; every step is taken all the same.
SMALL = fitting.FitSettings(lattices=2, design=6, starts=3, finalists=1, rows=60, max_steps=24)


@pytest.mark.parametrize("stop", [pytest.param(False, marks=pytest.mark.long), True])
def test_a_wrong_answer_is_tried_again(stop, rng, long):
    """A saw is no sine: the second try cannot help, and leaves the first."""
    seen, settings = [], fitting.FitSettings() if long else SMALL

    def progress(what, share, loss):
        seen.append(what)
        if stop and seen.count("least squares on all data") == 2:
            raise KeyboardInterrupt

    data = simulated(Blazed(1.7, 0.3, 0.0, 2.2), rng)
    fit = fitting.fit_reflectance(data, "sinusoidal", settings=settings, progress=progress)
    assert seen.count("least squares on all data") == 2
    assert fit.interrupted == stop
    alone = dataclasses.replace(settings, retries=0)
    once = fitting.fit_reflectance(data, "sinusoidal", settings=alone)
    assert fit.loss <= once.loss * (1 + 1e-9)
    assert len(fit.values) == len(data.values)
