"""Benchmarks: what `measure` reports, and that what is compared computes the same."""

import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.accuracy import benchmarks, diffraction_benchmarks
from diffopt.accuracy.benchmarks import measure
from diffopt.accuracy.measurement import compile_ahead, time_together, value_and_gradient
from diffopt.errors import InputError

pytestmark = pytest.mark.float32


def test_measure_counts_operations_and_bytes():
    n = 64
    a = jnp.ones((n, n), "float32")
    got = measure(lambda a, b: jnp.matmul(a, b, precision="highest"), a, a, repeats=3, gradient=0)
    np.testing.assert_array_equal(got.value, np.full((n, n), n))
    assert got.flops == pytest.approx(2 * n**3, rel=0.01)  # a multiplication and an addition
    assert got.peak_bytes is not None
    assert got.peak_bytes >= 3 * n * n * 4  # two arguments, one result
    assert got.compile_s > 0.0
    assert got.run_s > 0.0
    assert got.run_spread >= 0.0
    assert got.gradient_s is not None
    assert got.gradient_s > 0.0
    assert measure(jnp.sin, a, repeats=1).gradient_s is None


def test_measure_waits_for_the_result():
    def slow(x):
        time.sleep(0.05)
        return x

    def function(x):
        return jax.pure_callback(slow, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

    assert measure(function, np.ones(3, np.float32), repeats=2).run_s >= 0.05


def test_programs_take_turns():
    order = []

    def program(name):
        def note(x):
            order.append(name)
            time.sleep(2e-3)  # longer than the shortest measurement: one pass each
            return x

        def function(x):
            return jax.pure_callback(note, jax.ShapeDtypeStruct(x.shape, x.dtype), x)

        x = np.ones(2, np.float32)
        return compile_ahead(function, x), (x,)

    time_together([program("a"), program("b")], repeats=3)
    assert "".join(order) == "ab" + "ababab"


def test_value_and_gradient_of_one_argument():
    both = value_and_gradient(lambda x, y: {"out": x * y}, 1)
    total, slope = both(jnp.array([1.0, 2.0], "float32"), jnp.array([3.0, 4.0], "float32"))
    assert float(total) == 11.0
    np.testing.assert_array_equal(slope, [1.0, 2.0])


def test_names_resolve():
    for name in benchmarks.NAMES:
        benchmark = benchmarks._benchmark(name)
        assert benchmark.name == name
        assert benchmark.description


def test_run_gives_every_column():
    seen = []
    found = benchmarks.run(
        ["taylor.tables", "colour.xyz"], repeats=1, progress=lambda *report: seen.append(report)
    )
    assert [r.name for r in found] == ["taylor.tables", "colour.xyz"]
    for result in found:
        assert result.shape
        assert result.dtype == "float32"
        assert result.compile_s > 0.0
        assert result.run_s > 0.0
        assert " ns per " in result.note
    assert found[0].gradient_s is None
    assert found[1].gradient_s is not None
    # A multiplication and an addition for each of 10,000 spectra, 81 wavelengths, XYZ.
    assert found[1].flops == pytest.approx(2 * 10_000 * 81 * 3, rel=0.02)
    assert seen == [(0, 2, "taylor.tables"), (1, 2, "colour.xyz"), (2, 2, "")]


def test_refusals():
    with pytest.raises(InputError, match=r"no benchmark 'colour'; expected one of colour\.xyz"):
        benchmarks.run(["colour"])
    with pytest.raises(InputError, match="size must be one of small, full; received 'large'"):
        benchmarks.run(size="large")
    with pytest.raises(InputError, match="repeats must be at least 1; received 0"):
        benchmarks.run(repeats=0)


def test_derivatives_that_are_compared_agree():
    with jax.enable_x64(False):
        entries = diffraction_benchmarks.DERIVATIVE.entries("small")
        closed, *others = [
            jax.jit(value_and_gradient(e.function, 0))(*e.arguments) for e in entries
        ]
    assert len(others) == 2
    scale = float(jnp.abs(closed[1]).max())
    assert scale > 0.0
    for value, gradient in others:
        # float32 phases of up to 60 turns across the window: 60 * 2 pi * 6e-8.
        assert float(value) == pytest.approx(float(closed[0]), rel=1e-4)
        np.testing.assert_allclose(gradient, closed[1], rtol=0, atol=1e-4 * scale)
