"""Tolerances are kept, and what tells whether they are can tell."""

import csv
import json
import math
from typing import Any

import lengths
import numpy as np
import pytest
from scipy.stats import binomtest

from diffopt.accuracy import promises
from diffopt.accuracy.keeping import Rows
from diffopt.accuracy.promises import Answer, Promise, promise, wilson
from diffopt.cli.application import main
from diffopt.errors import InputError
from diffopt.fitting import lobe_promises

# Jobs by day, and the first of them: those that compile little. A night asks for 500 of each.
BY_DAY = {
    "diffraction.spectral": (0, 5),
    "diffraction.xyz": (0, 3),
    "lobes": (26, 2),
    "plan": (2, 1),
    "shadows": (0, 3),
}


def made(answer, **options):
    options = {"shared": True, **options}
    return Promise("made", "made(tolerance=)", "error", "truth", answer, **options)


@pytest.mark.parametrize("name", lengths.but(BY_DAY, sorted(promises.NAMES)))
def test_tolerances_are_kept(name, long):
    first, jobs = (0, 500) if long else BY_DAY[name]
    result = promise(name).test(jobs, seed=1, first=first, priced=10 if long else 0)
    assert result.kept, str(result)
    assert result.answered, "all were refused: nothing was put to the test"


def test_what_is_above_its_tolerance_is_seen():
    def answer(draw):
        # Twice the tolerance in about a fifth of the jobs, a refusal in another.
        chance = draw.rng.uniform()
        if chance < 0.2:
            return Answer("far off", 2.0 * draw.tolerance)
        if chance < 0.4:
            return Answer("refused", None, refused="no")
        return Answer("near", 0.5 * draw.tolerance, price=3.0 if draw.priced else None)

    result = made(answer).test(200, priced=4)
    far = [t for t in result.trials if t.answer.job == "far off"]
    assert result.broken == tuple(far)
    assert len(far) > 20
    assert not result.kept
    assert result.worst == pytest.approx(2.0)
    assert result.usual == pytest.approx(0.5)
    assert result.refused == pytest.approx(sum(t.answer.error is None for t in result.trials) / 200)
    assert set(result.prices) == {3.0}
    assert "far off" in str(result)
    # By decades nothing is lost; tolerances are even in their logarithms, so none is empty.
    parts = [part for _, part in result.decades()]
    assert sum(len(part.trials) for part in parts) == 200
    assert len(parts) == 5
    assert min(len(part.trials) for part in parts) > 20


def test_a_measured_error_may_be_doubted_but_not_one_that_is_no_number():
    doubted = made(lambda draw: Answer("", 1.2 * draw.tolerance, 0.3 * draw.tolerance)).test(5)
    assert doubted.kept
    assert doubted.worst == pytest.approx(1.2)
    assert len(made(lambda draw: Answer("", math.nan, 1.0)).test(5).broken) == 5


def test_chance_may_exceed_in_a_hundredth():
    def rarely(share):
        return made(
            lambda draw: Answer("", draw.tolerance * (2.0 if draw.rng.uniform() < share else 0.5)),
            chance=True,
        ).test(600)

    rare, often = rarely(0.005), rarely(0.06)
    assert rare.broken
    assert rare.kept
    assert not often.kept


def test_intervals_agree_with_scipy():
    for hits, of in ((0, 10), (1, 10), (3, 500), (500, 500), (17, 40)):
        right = binomtest(hits, of).proportion_ci(method="wilson")
        np.testing.assert_allclose(wilson(hits, of), right, atol=1e-12)
    assert wilson(0, 0) == (0.0, 1.0)


def test_a_job_can_be_repeated_and_a_killed_run_goes_on(tmp_path):
    asked = []

    def answer(draw):
        asked.append(draw.tolerance)
        return Answer("", draw.rng.uniform() * draw.tolerance)

    promised = made(answer)
    whole = promised.test(6)
    assert promised.test(1, first=4).trials[0].answer == whole.trials[4].answer
    asked.clear()
    with Rows(tmp_path / "made.rows", "made", False) as rows:
        promised.test(4, keep=rows)
    with (tmp_path / "made.rows").open("ab") as file:
        file.write(b'[4, {"settings"')  # a kill within a line
    with Rows(tmp_path / "made.rows", "made", False) as rows:
        again = promised.test(6, keep=rows)
    assert len(asked) == 6
    assert [t.answer for t in again.trials] == [t.answer for t in whole.trials]


@pytest.mark.parametrize("name", ["jobs", "seed", "first", "priced"])
def test_numbers_out_of_range_are_refused(name):
    options: Any = {name: -1}
    with pytest.raises(InputError, match=f"{name} must be at least"):
        made(lambda draw: Answer("", 0.0)).test(**options)


def test_names_are_known_and_others_refused():
    for name in promises.NAMES:
        assert promise(name).name == name
    with pytest.raises(InputError, match=r"no promise 'sharpness'; expected one of diffraction"):
        promise("sharpness")


def test_the_sphere_of_the_reference_integrates_the_sharpest_lobe():
    directions, solid = lobe_promises.sphere()
    assert solid.sum() == pytest.approx(4.0 * math.pi, rel=1e-12)
    axis = np.array([0.48, 0.6, 0.64])
    # Squared, as the error of a fit has it; the tail of the rule's last band is below 1e-9.
    values = np.exp(2.0 * lobe_promises._SHARPEST * (directions @ axis - 1.0))
    right = 2.0 * math.pi / (2.0 * lobe_promises._SHARPEST)
    assert (solid * values).sum() == pytest.approx(right, rel=1e-9)


def test_the_command_writes_trials_and_fails_when_one_is_broken(tmp_path, monkeypatch, capsys):
    kept = made(lambda draw: Answer("good", 0.1 * draw.tolerance))
    monkeypatch.setattr(promises, "promise", lambda name: kept)
    output = tmp_path / "out"
    words = ["promises", "made", "--jobs", "3", "-o", str(output)]
    assert main(words) == 0
    assert sorted(path.name for path in output.iterdir()) == ["made.csv", "promises.md"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
    rows = list(csv.DictReader((output / "made.csv").read_text().splitlines()))
    assert [row["job"] for row in rows] == ["0", "1", "2"]
    assert all(float(row["error"]) < float(row["tolerance"]) for row in rows)
    assert "| `made(tolerance=)` | 3 | 0 % | 0 |" in (output / "promises.md").read_text()
    broken = made(lambda draw: Answer("bad", 10.0 * draw.tolerance))
    monkeypatch.setattr(promises, "promise", lambda name: broken)
    capsys.readouterr()
    assert main(["promises", "made", "--jobs", "2", "--first", "7"]) == 1
    assert "made, job 8: asked" in capsys.readouterr().out
    assert json.dumps(broken.test(1).trials[0].settings)
