"""The comparison of lobe fits: what its rows say is so, and its files come back."""

import csv
import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt.errors import InputError
from diffopt.fitting import LobeSettings, comparison, rivals
from diffopt.fitting.lobe_targets import slices
from diffopt.fitting.lobes import fit_bytes, fit_nodes

METHODS = ("em-50", "em+lm", "normal-lm", "scipy-trf")
# Each number of steps is a program of its own: the default ones alone.
BUDGETS = ((10, 20, 5),)


@pytest.fixture(scope="module")
def found():
    wo = np.array([[0.5, 0.0, np.sqrt(0.75)], [0.0, 0.0, 1.0]])
    material = do.BlinnPhong(exponent=32.0)
    with pytest.MonkeyPatch.context() as patch, jax.enable_x64(False):
        patch.setattr(comparison, "BUDGETS", BUDGETS)
        patch.setattr(comparison, "_FINE", LobeSettings(rings=48, sectors=72))
        return comparison.compare(material, (2,), wo=wo, methods=METHODS, repeats=1, samples=100)


@pytest.mark.long
def test_solvers_end_at_one_error_below_that_of_em(found):
    error = {method: found.row(method, 2).error for method in METHODS}
    # Least squares of one problem from one start, in float32 and float64.
    assert error["normal-lm"] == pytest.approx(error["scipy-trf"], rel=0.02)
    assert error["scipy-trf"] < 0.8 * error["em-50"]
    assert error["em+lm"] < 1.1 * error["scipy-trf"]
    for row in found.rows:
        assert 0.0 < row.error <= row.worst < 1.0
        assert min(row.time_s, row.single_s) > 0.0


@pytest.mark.long
def test_time_to_a_rivals_error_is_told(found):
    for rival in ("normal-lm", "scipy-trf"):
        row = found.row(f"em+lm to {rival}", 2)
        assert row.error <= 1.05 * found.row(rival, 2).error
        assert row.ratio == pytest.approx(found.row(rival, 2).time_s / row.time_s)
        assert found.row(rival, 2).success == 1.0


def test_em_gains_likelihood_and_keeps_energy(found):
    assert found.row("em-50", 2).likelihood > found.row("em+lm", 2).likelihood
    # EM keeps the integral, least squares does not.
    assert found.row("em-50", 2).energy < 1e-3 < found.row("em+lm", 2).energy


def test_memory_holds_at_least_the_slices(found):
    """Two of 32 x 48 nodes with direction, solid angle and value, float32, and a Jacobian."""
    values = 2 * 32 * 48 * 5 * 4
    for method in ("em-50", "em+lm", "normal-lm", "em+lm to scipy-trf"):
        assert found.row(method, 2).memory_bytes > values, method
    # EM has no Jacobian of 8 parameters.
    assert found.row("em+lm", 2).memory_bytes > values + 8 * 32 * 48 * 4
    assert found.row("scipy-trf", 2).memory_bytes is None


@pytest.mark.long
def test_memory_of_a_fit_in_rounds_is_that_of_its_largest_program():
    key, few = jax.random.key(0), LobeSettings(rings=8, sectors=8)
    wo = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    nodes = slices(do.BlinnPhong(exponent=8.0), jnp.asarray(wo), few)
    # One lobe, and no coarse nodes: a third less to compile.
    nodes = dataclasses.replace(nodes, coarse=None)
    once = fit_bytes(nodes, 1, few, key)
    rounds = dataclasses.replace(few, rounds=3)
    fit_nodes(nodes, 1, settings=rounds, key=key)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(nodes))
    assert size < fit_bytes(nodes, 1, rounds, key) <= 2 * once


def test_table_and_files(found, tmp_path):
    text = str(found)
    assert "scipy-trf" in text
    assert "2 slices of 1 materials" in text
    found.save_csv(tmp_path / "lobes.csv")
    with open(tmp_path / "lobes.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows] == [row.method for row in found.rows]
    assert float(rows[0]["error"]) == found.rows[0].error
    found.plot(tmp_path / "lobes.png")
    assert (tmp_path / "lobes.png").read_bytes().startswith(b"\x89PNG")


def test_unknown_methods_are_refused():
    with pytest.raises(InputError, match="methods must be some of"):
        comparison.compare(methods=("simplex",))
    assert set(rivals.solvers()) < set(comparison.METHODS)
