"""Comparison of all methods on one job: what its rows say, and that they are right."""

import csv
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt
from diffopt import colour
from diffopt.accuracy import comparison, contenders, nufft
from diffopt.accuracy.comparison import Check, Comparison, Row, Task, compare, random_pairs
from diffopt.accuracy.ranking import with_break_even
from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.settings import DirectSettings

pytestmark = pytest.mark.float32

TOLERANCE = 1e-2
# One of each kind: the others differ from these in their settings alone.
METHODS = ("direct", "thesis", "chebyshev", "few", "nufft", "table")
PAIRS = random_pairs(300)
WAVELENGTHS = np.linspace(0.4, 0.7, 9)


def small(**options):
    """Random heights, 32 x 32, 0.15 um deep."""
    heights = np.random.default_rng(3).uniform(0.0, 0.15, (32, 32))
    scan = diffopt.Heightfield(jnp.asarray(heights, "float32"), pixel=0.1)
    return diffopt.DiffractionBRDF(scan, 0.4, **options)


def asked(brdf, **options):
    return compare(
        brdf,
        pairs=PAIRS,
        tolerance=TOLERANCE,
        wavelengths=WAVELENGTHS,
        budget_s=1.0,
        checked=20,
        **options,
    )


@pytest.fixture(scope="module")
def found():
    with jax.enable_x64(False):
        return asked(small(), methods=METHODS)


def test_every_row_is_complete(found):
    assert tuple(row.method for row in found.rows) == METHODS
    for row in found.rows:
        assert row.total_s is not None, row
        assert row.total_s == row.setup_s + row.run_s
        assert row.run_s > 0.0
        assert row.compile_s >= 0.0
        assert row.memory_mb > 0.0
        assert row.ns == pytest.approx(1e9 * row.run_s / (300 * 9))
        assert row.dtype == "float32"


def test_every_row_meets_the_tolerance(found):
    for row in found.rows:
        assert 0.0 < row.error <= TOLERANCE, row
    for name in ("direct", "chebyshev", "table"):
        row = found.row(name)
        assert row.error <= row.bound <= TOLERANCE, name


def test_the_tuned_take_no_more_than_they_need(found):
    # One term less, or one wavelength less, misses the tolerance.
    terms = int(found.row("thesis").settings.split("terms ")[1].split(",")[0])
    reach = int(found.row("thesis").settings.split("reach ")[1].split(",")[0])
    wi, wo = PAIRS
    weights = np.asarray(colour.spectral_weights(WAVELENGTHS))
    brdf = small()
    with jax.enable_x64(False):
        check = comparison.truth(brdf, wi, wo, WAVELENGTHS, weights, "xyz", 20)
        errors = []
        for count in (terms - 1, terms):
            settings = diffopt.TaylorSettings(terms=count, reach=reach)
            prepared = brdf.prepare(
                pairs=PAIRS, wavelengths=WAVELENGTHS, output="xyz", settings=settings
            )
            errors.append(check.error(prepared(wi[check.index], wo[check.index])))
    assert errors[0] > TOLERANCE >= errors[1]


def test_the_best_has_the_least_total(found):
    best = found.best
    assert best.total_s == min(row.total_s for row in found.rows)
    assert best.break_even is not None
    assert best.break_even <= 300
    assert found.row("direct").setup_s == 0.0
    with pytest.raises(InputError, match=r"no method 'taylor' was compared; there are direct"):
        found.row("taylor")


def test_table_csv_and_json_hold_every_row(found, tmp_path):
    text = str(found)
    assert all(row.method in text for row in found.rows)
    assert "32 x 32 heights, 300 pairs, 9 wavelengths, xyz, tolerance 0.01" in text
    found.save_csv(tmp_path / "rows.csv")
    rows = list(csv.DictReader((tmp_path / "rows.csv").read_text().splitlines()))
    assert [row["method"] for row in rows] == [row.method for row in found.rows]
    assert float(rows[-1]["total_s"]) == found.rows[-1].total_s
    found.save_json(tmp_path / "rows.json")
    content = json.loads((tmp_path / "rows.json").read_text())
    assert content["rows"][0]["error"] == found.rows[0].error
    assert content["tolerance"] == TOLERANCE


def made_up(name, setup_s, run_s, error=1e-3):
    return Row(name, setup_s=setup_s, run_s=run_s, error=error, ns=1.0)


def test_break_even_of_made_up_rows():
    # Per pair, of 100: a 1 s, b 0.1 s, c 0.5 s, d 0.01 s but wrong, e nothing.
    rows = [
        made_up("a", 0.0, 100.0),
        made_up("b", 9.0, 10.0),
        made_up("c", 20.0, 50.0),
        made_up("d", 1.0, 1.0, error=1.0),
        made_up("e", 109.0, 0.0),
    ]
    found = {row.method: row.break_even for row in with_break_even(rows, 0.1, 100)}
    assert found["a"] == 0
    assert found["b"] == 10  # 9 s of set-up, 0.9 s saved with each pair
    assert found["c"] is None  # more set-up than b, and slower
    assert found["e"] == 1000  # against b; against a 109 pairs would do
    best = Comparison(tuple(rows), "made up", 0.1).best
    assert best.method == "b"  # d is faster, and wrong
    with pytest.raises(InputError, match="no method meets the tolerance 1e-06 on made up"):
        Comparison(tuple(rows), "made up", 1e-6).best  # noqa: B018


UNTRUE = Check(np.arange(5), np.ones((5, 9)))


def test_refusals_become_rows():
    with jax.enable_x64(False):
        brdf = small(average="window")
        rows = asked(brdf, methods=("few", "nufft"), output="spectral", check=UNTRUE).rows
    assert rows[0].total_s is None
    assert "for output='xyz'" in rows[0].note
    assert rows[1].total_s is None
    assert "average='positions'" in rows[1].note


def test_nufft_is_left_out_where_it_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "finufft", None)
    with jax.enable_x64(False):
        (row,) = asked(small(), methods=("nufft",), output="spectral", check=UNTRUE).rows
    assert row.total_s is None
    assert row.note == "left out: the package finufft is not installed"


@pytest.mark.parametrize("blur", [0.0, 0.01])
def test_nufft_equals_the_direct_sum(blur):
    # As a general library would, with nothing in common but the heights.
    pytest.importorskip("finufft")
    with jax.enable_x64(False):
        brdf = small(blur=blur)
        wi, wo = (v[:12] for v in PAIRS)
        task = Task(brdf, wi, wo, WAVELENGTHS, None, "spectral", 1e-3, UNTRUE, 1.0, gain=100.0)
        values, _, _, done, _ = nufft.evaluate(task, nufft.make_series(task), wi, wo)
        expected = np.asarray(brdf(wi, wo, WAVELENGTHS))
    assert done == 9
    # 5e-6 of a mirror's peak was asked; float32 rounds to a few 1e-7 of it.
    peak = float(brdf.coherent_area) / WAVELENGTHS.min() ** 2
    np.testing.assert_allclose(values, expected, rtol=0, atol=2e-5 * peak)


def test_a_part_of_the_job_is_scaled_up():
    with jax.enable_x64(False):
        brdf = small()
        wi, wo = random_pairs(20_000)
        task = Task(brdf, wi, wo, WAVELENGTHS, None, "spectral", 1e-2, UNTRUE, 0.05, gain=1.0)
        prepared = brdf.prepare(pairs=(wi, wo), wavelengths=WAVELENGTHS, settings=DirectSettings())
        row = contenders.measured(task, "direct", prepared, 0.0)
    assert row.extrapolated
    assert "run on" in row.note
    # 20,000 pairs at 9 wavelengths are at least 180,000 times 1024 sines: over 20 ms each core.
    assert row.run_s > 0.1


def test_random_pairs_fill_the_disc_evenly():
    wi, wo = random_pairs(20_000, 60.0, seed=4)
    for v in (wi, wo):
        np.testing.assert_allclose(np.linalg.norm(v, axis=-1), 1.0, rtol=1e-12)
        inside = np.square(v[:, :2]).sum(-1) / np.sin(np.radians(60.0)) ** 2
        assert inside.max() <= 1.0
        # Uniform in [0, 1]: five standard deviations of the mean of 20,000.
        assert abs(inside.mean() - 0.5) < 5.0 / np.sqrt(12 * 20_000)
    np.testing.assert_array_equal(random_pairs(7, seed=1)[0], random_pairs(7, seed=1)[0])


def test_refused_arguments():
    brdf = small()
    with pytest.raises(InputError, match="pairs must be at least 1; received 0"):
        random_pairs(0)
    with pytest.raises(InputError, match="angle must lie between 0 and 90 degrees; received 90"):
        random_pairs(5, 90.0)
    with pytest.raises(InputError, match="method must be one of direct, thesis"):
        compare(brdf, pairs=PAIRS, tolerance=0.1, methods=("fast",))
    with pytest.raises(InputError, match="output must be one of spectral, relative, xyz"):
        compare(brdf, pairs=PAIRS, tolerance=0.1, output="rgb")
    with pytest.raises(InputError, match=r"tolerance must be a relative error in \(0, 1\)"):
        compare(brdf, pairs=PAIRS, tolerance=2.0)
    with pytest.raises(InputError, match="budget_s must be above 0; received 0"):
        compare(brdf, pairs=PAIRS, tolerance=0.1, budget_s=0.0)
    down = (PAIRS[0], -PAIRS[1])
    with pytest.raises(InputError, match="at least one pair above the horizon; received none"):
        compare(brdf, pairs=down, tolerance=0.1)


def test_command_prints_and_writes(tmp_path, capsys):
    scan, target = tmp_path / "scan.npy", tmp_path / "out"
    np.save(scan, np.random.default_rng(3).uniform(0.0, 0.15, (48, 48)))
    words = ["compare", "diffraction", str(scan), "--pixel-size", "0.1", "--pairs", "50"]
    words += ["--height-unit", "um"]
    words += ["--coherence", "0.4", "--method", "chebyshev", "--checked", "2", "--budget", "1"]
    assert main([*words, "-o", str(target)]) == 0
    out = capsys.readouterr().out
    assert "50 pairs, 81 wavelengths, xyz, tolerance 0.01" in out
    assert {p.name for p in target.iterdir()} == {"comparison.csv", "comparison.json"}
    (row,) = json.loads((target / "comparison.json").read_text())["rows"]
    assert row["method"] == "chebyshev"
    assert row["error"] <= row["bound"] <= 1e-2


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["compare"], "Missing command"),
        (["compare", "diffraction"], "(?i)missing argument 'file'"),
        (["compare", "diffraction", "sample:vinyl"], "no sample 'vinyl'; expected one of"),
        (
            ["compare", "diffraction", "sample:flat", "--method", "guess"],
            "--method must be one of direct, thesis",
        ),
        (["compare", "diffraction", "sample:flat", "--output", "rgb"], "--output must be one of"),
        (["compare", "diffraction", "sample:flat", "--tolerance", "0"], "tolerance must be a"),
        (["compare", "diffraction", "sample:flat", "--pairs", "0"], "pairs must be at least 1"),
        (["compare", "diffraction", "sample:flat", "--angle", "95"], "angle must lie between"),
        (["compare", "diffraction", "sample:flat", "--checked", "0"], "--checked must be at"),
        (["compare", "diffraction", "sample:flat", "--budget", "-1"], "--budget must be above 0"),
        (["compare", "diffraction", "sample:flat", "--dtype", "half"], "--dtype must be one of"),
    ],
)
def test_unusable_commands(words, match, capsys):
    import re

    assert main(words) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("diffopt: error: ")
    assert shown.count("\n") == 1
    assert re.search(match, shown)
