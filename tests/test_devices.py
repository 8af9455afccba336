"""Batches over several devices: eight simulated ones, in a process of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from device_cases import COUNT

import diffopt as do
from diffopt import devices, fitting
from diffopt.errors import InputError


@pytest.fixture(scope="module")
def eight(tmp_path_factory):
    path = tmp_path_factory.mktemp("devices") / "found.json"
    environment = os.environ | {"JAX_ENABLE_X64": str(int(jnp.ones(()).dtype == jnp.float64))}
    script = Path(__file__).with_name("device_cases.py")
    done = subprocess.run(
        [sys.executable, str(script), str(path)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(path.read_text())


def divided(found, most):
    """Every device holds its share, and the result is that of one device."""
    assert found["devices"] == COUNT
    assert len(set(found["members"])) == 1
    assert found["error"] <= most


@pytest.mark.float32
def test_the_direct_sum(eight):
    found = eight["direct"]
    assert isinstance(found, dict), found
    # Shares are other shapes, whose sums are made in another order: some units in the last place
    # of sums of 1024 values.
    for name in ("pairs", "grid", "wavelengths", "xyz"):
        divided(found[name], 16 * found[name]["eps"])
    assert len(found["wavelengths"]["members"]) == COUNT
    assert 0.0 <= found["slope"] < 1e-5  # a sum over pairs, of both signs


@pytest.mark.float32
def test_nothing_is_sent_between_devices(eight):
    """The compiler alone gathers all pairs on every device, before the loop over chunks."""
    assert eight["programs"]["each"] == []
    assert "all-gather" in eight["programs"]["left"]


def test_methods_set_up_for_a_job(eight):
    found = eight["prepared"]
    assert isinstance(found, dict), found
    # Its nodes span the phases of the pairs at hand: within its error, and in truth far below.
    divided(found["separable"], 1e-2 * found["separable"]["bound"])
    divided(found["chebyshev"], 16 * found["chebyshev"]["eps"])  # tables of the whole job
    divided(found["table"], 4 * found["table"]["eps"])
    # Whether any pair is wrong, and nothing of the batch.
    assert set(found["table"]["sent"]) == {"all-reduce"}
    divided(found["wavelengths"], found["wavelengths"]["bound"])
    assert found["sum"] < 1e-5  # the spectral sum, over devices


def test_lobes_of_slices(eight):
    found = eight["lobes"]
    assert isinstance(found, dict), found
    # Float32 through six to twelve steps of least squares.
    divided(found, 1e-3)
    assert found["steps"][0] == found["steps"][1]
    np.testing.assert_allclose(*found["errors"], rtol=1e-3)
    assert max(found["steps"][0]) > min(found["steps"][0])  # later rounds took place


def test_radiance_of_vertices(eight):
    found = eight["vertices"]
    assert isinstance(found, dict), found
    for one in found.values():
        divided(one, 16 * one["eps"])
        assert one["sent"] == []


def test_starts_of_a_fit(eight):
    found = eight["starts"]
    assert isinstance(found, dict), found
    # Where it ends, within its tolerance: the root of the rounding unit of float32 at most.
    np.testing.assert_allclose(*found["fit"], rtol=1e-3)
    assert found["loss"] < 1e-4  # the solve's tolerance
    assert found["devices"] == COUNT
    # Whether any start goes on.
    assert set(found["sent"]) == {"all-reduce"}


@pytest.mark.float32
def test_a_batch_of_any_length(eight):
    found = eight["parts"]
    assert isinstance(found, dict), found
    assert found["shape"] == [45, COUNT]
    assert found["mesh"] == COUNT
    assert found["error"] < 1e-5


@pytest.mark.float32
def test_one_device_is_the_same_code():
    values = np.arange(6.0, dtype=np.float32)
    assert devices.placement(do.spread(values)) is None
    np.testing.assert_array_equal(do.spread(values), values)
    np.testing.assert_array_equal(do.each(jnp.sin, axes=(0,))(values), jnp.sin(values))
    sizes = []

    @jax.jit
    def doubled(a):
        sizes.append(a.shape)  # once for each program
        return 2.0 * a

    np.testing.assert_array_equal(do.in_batches(doubled, values, size=4), 2.0 * values)
    assert sizes == [(4,)]
    tree = do.in_batches(lambda a: {"a": a, "b": a[:, None]}, values, size=5)
    assert tree["b"].shape == (6, 1)


@pytest.mark.float32
@pytest.mark.parametrize(
    ("call", "text"),
    [
        (lambda: do.spread(np.ones(3), axis=1), r"axis 1: the array has the shape \(3,\)"),
        (lambda: do.spread(np.ones(3), devices=[]), "expected at least one; received none"),
        (lambda: do.in_batches(jnp.sin, np.ones(3), size=0), "size must be 1 or more; received 0"),
        (lambda: do.in_batches(jnp.add, np.ones(3), np.ones(2), size=1), r"\(2,\), \(3,\)"),
        (lambda: do.in_batches(jnp.sin, np.ones(0), size=1), r"received \(0,\)"),
        (lambda: devices.some(99), "devices must be 1 to 1, as there are here; received 99"),
        (lambda: fitting.FitSettings(devices=0), "devices must be 1 or more; received 0"),
    ],
)
def test_what_is_refused(call, text):
    with pytest.raises(InputError, match=text):
        call()


@pytest.mark.float32
def test_lengths_that_do_not_divide(monkeypatch):
    """Of meshes, sizes are all that is looked at before arrays are placed."""
    monkeypatch.setattr(devices, "mesh", lambda given: type("Eight", (), {"size": 8})())
    with pytest.raises(InputError, match=r"45 members: expected a multiple of 8.* as 40 or 48"):
        do.spread(np.ones((45, 3)))
