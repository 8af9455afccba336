"""Studies and throughput of materials: published errors, and what the table says."""

import csv

import pytest

import diffopt
from diffopt.accuracy import material_throughput
from diffopt.cli import main
from diffopt.errors import InputError


def test_schlick_errs_as_published():
    """Glass: 22 % low at 60 degrees, exact at rounding."""
    result = diffopt.study("material.fresnel").run(quick=True)
    exact, schlick = (
        result.where(form=form, within_deg=60.0).rows[0] for form in ("exact", "schlick")
    )
    assert exact.error < 1e-6
    assert 0.20 < schlick.error < 0.24
    assert result.cheapest(1e-3).settings["form"] == "exact"


def test_the_rational_fit_errs_as_published():
    """Walter et al. 2007: below 0.35 % everywhere; erf to the rounding of float32."""
    result = diffopt.study("material.masking").run(quick=True)
    assert 2e-3 < result.where(form="rational fit").rows[0].error < 3.5e-3
    assert result.where(form="erf").rows[0].error < 1e-6


def test_three_numbers_do_not_carry_gold():
    result = diffopt.study("material.colour").run(quick=True)
    rgb = result.where(form="RGB, Schlick").rows[0]
    fine = result.where(form="spectral", numbers=81).rows[0]
    assert fine.error < 1e-3 < 1e-2 < rgb.error < 0.1


def test_linear_lookup_is_of_second_order():
    result = diffopt.study("material.table").run(quick=True)
    error = {(row.settings["rows"], row.settings["lookup"]): row.error for row in result.rows}
    assert error[30, "linear"] < 0.5 * error[30, "nearest"]
    assert error[30, "linear"] < 0.5 * error[15, "linear"]


def test_throughput(tmp_path, capsys, monkeypatch):
    kept = ("lambert", "conductor, ggx")
    every = material_throughput.models()
    monkeypatch.setattr(material_throughput, "models", lambda: {k: every[k] for k in kept})
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    assert main(["compare", "materials", "--count", "2000", "-o", str(tmp_path / "out")]) == 0
    out = capsys.readouterr().out
    assert "conductor" in out
    with (tmp_path / "out" / "materials.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["what"] for row in rows] == ["f", "sample"] * 2
    assert all(float(row["rate"]) > 0 for row in rows)
    assert all(row["vectorised_rate"] == "" for row in rows)
    with pytest.raises(InputError, match="count must be at least 1; received 0"):
        material_throughput.compare(0)
