"""Studies: the protocol on made-up rows, and the diffraction studies themselves."""

import csv
import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt
from diffopt import bounds
from diffopt.accuracy import jobs as study_jobs
from diffopt.accuracy import studies
from diffopt.accuracy.studies import Case, Job, Row, Study, StudyResult
from diffopt.errors import InputError
from diffopt.kernels import phase
from diffopt.settings import TaylorSettings


def made_up(*rows, conditions=()):
    """A result from (settings, error, run time)."""
    study = Study("made.up", "a number", "arithmetic", lambda quick: [], conditions)
    return StudyResult(
        study, tuple(Row(settings, error, None, 0.1, run) for settings, error, run in rows)
    )


@pytest.mark.float32
def test_names_resolve():
    for name in studies.NAMES:
        study = diffopt.study(name)
        assert study.name == name
        assert study.quantity
        assert study.reference


@pytest.mark.float32
def test_unknown_name_lists_the_names():
    with pytest.raises(InputError, match=r"no study 'terms'.*diffraction\.expansion"):
        diffopt.study("terms")


@pytest.mark.float32
def test_front_holds_what_nothing_beats():
    result = made_up(
        ({"n": 1}, 1e-1, 1.0),
        ({"n": 2}, 1e-2, 2.0),
        ({"n": 3}, 5e-2, 3.0),  # beaten by n = 2 in both
        ({"n": 4}, 1e-3, 4.0),
        ({"n": 5}, 1e-3, 5.0),  # no better than n = 4
    )
    assert [row.settings["n"] for row in result.front()] == [1, 2, 4]


@pytest.mark.float32
def test_front_of_each_problem():
    result = made_up(
        ({"x": 1, "n": 1}, 1e-3, 1.0),
        ({"x": 1, "n": 2}, 1e-6, 2.0),
        ({"x": 2, "n": 1}, 1e-1, 1.0),
        ({"x": 2, "n": 2}, 1e-2, 2.0),
        conditions=("x",),
    )
    assert len(result.front()) == 4
    assert len(result.problems()) == 2
    assert {row.settings["x"] for row in result.where(x=2).rows} == {2}


@pytest.mark.float32
def test_cheapest_meets_the_tolerance_on_every_problem():
    result = made_up(
        ({"x": 1, "n": 1}, 1e-3, 1.0),
        ({"x": 1, "n": 2}, 1e-6, 2.0),
        ({"x": 1, "n": 3}, 1e-7, 3.0),
        ({"x": 2, "n": 1}, 1e-1, 1.0),
        ({"x": 2, "n": 2}, 1e-4, 2.0),
        conditions=("x",),
    )
    row = result.cheapest(1e-3)
    assert row.settings == {"x": 2, "n": 2}  # the worse of its two problems
    assert result.where(x=1).cheapest(1e-3).settings["n"] == 1
    # n = 3 was not tried on the second problem and cannot be chosen for both.
    with pytest.raises(InputError, match=r"no settings have an error of at most 1e-05.*0\.0001"):
        result.cheapest(1e-5)
    with pytest.raises(InputError, match=r"x=3 given; it has 1, 2"):
        result.where(x=3)
    with pytest.raises(InputError, match=r"y=3 given; it has no such setting"):
        result.where(y=3)
    with pytest.raises(InputError, match="no row has x 2, n 3"):
        result.where(x=2, n=3)


@pytest.mark.float32
def test_table_and_text():
    text = str(made_up(({"n": 1}, 1e-1, 2.5e-3), ({"n": 2}, 2e-1, 1.0)))
    for part in ("made.up", "a number", "arithmetic", "1.0e-01", "2.5 ms", "*"):
        assert part in text


@pytest.mark.float32
def test_csv_holds_every_row(tmp_path):
    result = made_up(({"x": 1, "n": 1}, 1.25e-3, 0.5), ({"x": 2, "n": "a,b"}, 0.0, 1.0))
    result.save_csv(tmp_path / "rows.csv")
    rows = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    assert [float(row["error"]) for row in rows] == [1.25e-3, 0.0]
    assert rows[1]["n"] == "a,b"
    assert rows[0]["gradient_s"] == ""
    assert [p.name for p in tmp_path.iterdir()] == ["rows.csv"]


@pytest.mark.float32
@pytest.mark.parametrize("kind", ["png", "svg"])
def test_plot_has_every_point_and_is_saved_whole(tmp_path, kind):
    result = made_up(
        ({"x": 1, "n": 11}, 1e-3, 1.0),
        ({"x": 1, "n": 12}, 0.0, 2.0),  # an error of 0 has no logarithm
        ({"x": 2, "n": 13}, 1e-1, 1.0),
        conditions=("x",),
    )
    figure = result.plot(tmp_path / f"study.{kind}")
    axes = figure.axes[0]
    assert axes.get_xscale() == axes.get_yscale() == "log"
    assert {"11", "12", "13"} <= {text.get_text() for text in axes.texts}
    assert [p.name for p in tmp_path.iterdir()] == [f"study.{kind}"]


@pytest.mark.float32
def test_plot_refuses_an_unknown_ending(tmp_path):
    with pytest.raises(InputError, match=r"study\.bmp: expected a name ending in \.png"):
        made_up(({"n": 1}, 1e-3, 1.0)).plot(tmp_path / "study.bmp")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.float32
def test_cases_choose_their_type_and_share_programs():
    traced = []

    def cases(quick):
        def job(value, dtype):
            def function(x):
                traced.append(x.dtype)
                return x * x

            expected = value * value
            return Job(
                function,
                (jnp.asarray(value, dtype),),
                lambda got: (abs(float(got) - expected), ""),
                gradient=0 if value == 0.1 else None,
            )

        return [
            Case({"value": value, "dtype": dtype}, dtype, lambda v=value, d=dtype: job(v, d), dtype)
            for dtype in ("float32", "float64")
            for value in (0.3, 0.7)
        ]

    seen = []
    outside = jax.config.jax_enable_x64  # type: ignore[attr-defined]
    for around in (False, True):
        traced.clear()
        with jax.enable_x64(around):
            result = Study("made.up", "x", "x", cases).run(
                repeats=1, progress=lambda *report: seen.append(report)
            )
        # One trace for each type, not for each case.
        assert traced == [jnp.float32, jnp.float64]
        single, double = ([r.error for r in result.where(dtype=d).rows] for d in diffopt_types())
        assert min(single) > 1e-10  # 0.3 and 0.7 are not float32 numbers
        assert max(double) < 1e-15
    assert jax.config.jax_enable_x64 == outside  # type: ignore[attr-defined]
    assert seen[0] == (0, 4, "value 0.3, dtype float32")
    assert seen[4] == (4, 4, "")


def diffopt_types():
    return ("float32", "float64")


def run_some(name, which):
    """A few of a study's quick cases."""
    study = studies.study(name)
    picked = [study.cases(True)[i] for i in which]
    return dataclasses.replace(study, cases=lambda quick: picked).run(quick=True, repeats=1)


# Window: both averages. Nodes: where truncation rules. Rounding: the deepest surface, where
# the phase itself rounds.
BOUNDED = [
    ("diffraction.window", (2, -1)),
    ("diffraction.nodes", (1,)),
    ("diffraction.rounding", (1, 5)),
]


@pytest.mark.float32
@pytest.mark.parametrize(("name", "which"), BOUNDED)
def test_measured_errors_stay_within_the_bound(name, which):
    for row in run_some(name, which).rows:
        assert row.bound is not None
        assert 0.0 < row.error <= row.bound, row.settings
        assert row.run_s > 0.0


@pytest.mark.float32
def test_patch_error_is_of_the_size_estimated():
    for row in run_some("diffraction.patch", (0, 1)).rows:
        assert row.bound is not None
        # The estimate is the weight outside the patch; what stands there is random.
        assert row.bound / 3 < row.error < 3 * row.bound


@pytest.mark.parametrize("phase_argument", [1.0, 1.5 * math.pi, 10.0])
@pytest.mark.parametrize("centred", [False, True])
def test_taylor_rounding_is_an_upper_estimate(phase_argument, centred):
    # Binary heights err alike on every sample; many wavelengths try many arguments.
    total = 2.0 * phase_argument if centred else phase_argument
    stack = study_jobs.hard_and_random(total, 64)
    wave, wavelengths = np.array([[0.0, 0.0, -2.0]]), np.linspace(0.38, 0.40, 100)
    settings = TaylorSettings(phase.taylor_terms(phase_argument, 1e-9), reach=6, centred=centred)
    run = study_jobs.over_stack(0.1, "window", settings)
    arguments = [jnp.asarray(a, "float32") for a in (stack, 1.6, wave, wavelengths)]
    got = np.asarray(jax.jit(run)(*arguments), np.float64)
    expected = study_jobs.truth(stack, 0.1, 1.6, "window", wave, wavelengths)
    eps = float(np.finfo(np.float32).eps)
    estimate = phase.taylor_rounding(phase_argument, eps)
    error = np.abs(got - expected).max()
    assert error <= estimate
    # Measured between 1.5 (at 1) and 30 times below: an estimate, not a guess.
    assert error > 0.005 * estimate


def test_bound_holds_where_taylor_rounding_passes_one():
    # Beyond 17 the rounding of the amplitude exceeds the mirror's, and its square counts.
    stack = study_jobs.hard_and_random(30.0, 64)
    wave, wavelengths = np.array([[0.0, 0.0, -2.0]]), np.linspace(0.38, 0.40, 20)
    settings = TaylorSettings(terms=100, reach=6)
    run = study_jobs.over_stack(0.1, "window", settings)
    arguments = [jnp.asarray(a, "float32") for a in (stack, 1.6, wave, wavelengths)]
    got = np.asarray(jax.jit(run)(*arguments), np.float64)
    surface = study_jobs.make_surface(stack[0], 0.1, 1.6, "window")
    bound = bounds.error_bound(surface, settings, wave, wavelengths)
    assert 1.0 < np.abs(got).max() < bound
