"""Products, logarithms and exponentials of functions in spherical harmonics."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import harmonic_products, harmonics

DATA = json.loads((Path(__file__).parents[1] / "data" / "harmonics.json").read_text())
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}

product = jax.jit(harmonic_products.product)
logarithm = jax.jit(harmonic_products.logarithm)
exponential = jax.jit(harmonic_products.exponential)
evaluate = jax.jit(harmonics.evaluate)


def test_entries_of_many_digits():
    tensor = harmonic_products.gaunt(4)
    for i, j, k, expected in DATA["gaunt"]:
        assert tensor[i, j, k] == pytest.approx(expected, abs=1e-12)
    places = [entry[:3] for entry in harmonic_products.gaunt_triples(4)]
    assert places == [tuple(entry[:3]) for entry in DATA["gaunt"]]
    assert len(places) == 77
    counts = [(harmonic_products.gaunt(bands) != 0).sum() for bands in (2, 3, 4, 5)]
    assert counts == [10, 83, 353, 1158]
    np.testing.assert_allclose(tensor[0], np.eye(16) / np.sqrt(4 * np.pi), atol=1e-14)
    for axes in ((1, 0, 2), (2, 1, 0)):
        np.testing.assert_allclose(tensor, tensor.transpose(axes), atol=1e-14)


@pytest.mark.parametrize("bands", [4, 5])
def test_exact_where_the_bands_hold_the_product(bands, rng, dtype):
    first, second = np.zeros((2, bands**2, 3))
    first[:4], second[: (bands - 1) ** 2] = (
        rng.normal(size=(4, 3)),
        rng.normal(size=((bands - 1) ** 2, 3)),
    )
    d = rng.normal(size=(3, 3))
    d = jnp.asarray(d / np.linalg.norm(d, axis=-1, keepdims=True), dtype)
    first, second = jnp.asarray(first, dtype), jnp.asarray(second, dtype)
    both = product(first, second)
    assert both.dtype == dtype
    expected = evaluate(first, d) * evaluate(second, d)
    np.testing.assert_allclose(evaluate(both, d), expected, atol=100 * EPS[dtype])
    np.testing.assert_allclose(product(second, first), both, atol=20 * EPS[dtype])


@pytest.mark.parametrize("bands", [2, 4, 5])
def test_both_ways_are_the_tensor(bands, rng, monkeypatch):
    first, second = jnp.asarray(rng.normal(size=(2, bands**2)))
    expected = np.einsum("ijk,i,j", harmonic_products.gaunt(bands), first, second)
    for most in (1, 8):  # on a grid, and entry by entry
        monkeypatch.setattr(harmonic_products, "SPARSE", most)
        found = jax.jit(lambda a, b: harmonic_products.product(a, b))(first, second)
        np.testing.assert_allclose(found, expected, atol=1e-13)


@pytest.mark.float32
def test_bad_inputs_are_refused():
    with pytest.raises(ValueError, match="second: received 9 coefficients, expected 16"):
        harmonic_products.product(jnp.ones(16), jnp.ones(9))
    with pytest.raises(ValueError, match="floor: received 0"):
        harmonic_products.logarithm(jnp.ones(16), 0.0)


def smooth(rng, bands, dtype):
    """Positive functions: 1 and a little of the low degrees."""
    c = rng.normal(size=(bands**2, 4)) * 0.3 * 0.2 ** harmonics.degrees(bands)[:, None]
    c[0] = np.sqrt(4 * np.pi)
    return jnp.asarray(c, dtype)


def test_exponential_of_the_logarithm(rng, dtype):
    """Of smooth functions, up to the truncation of the logarithm."""
    c = smooth(rng, 4, dtype)
    np.testing.assert_allclose(exponential(logarithm(c)), c, atol=2e-5)
    # A product is the exponential of a sum.
    other = smooth(rng, 4, dtype)
    together = exponential(logarithm(c) + logarithm(other))
    np.testing.assert_allclose(together, product(c, other), atol=1e-4)


def test_constants_have_their_own_logarithm(dtype):
    one = jnp.zeros((16,), dtype).at[0].set(float(np.sqrt(4 * np.pi)))
    np.testing.assert_allclose(logarithm(0.5 * one), float(np.log(0.5)) * one, atol=40 * EPS[dtype])
    np.testing.assert_allclose(
        exponential(-3.0 * one), float(np.exp(-3.0)) * one, atol=40 * EPS[dtype]
    )
    np.testing.assert_allclose(
        logarithm(0.0 * one), float(np.log(0.02)) * one, atol=100 * EPS[dtype]
    )


@pytest.mark.parametrize("call", [product, lambda a, b: exponential(logarithm(a) + logarithm(b))])
def test_slopes(call, rng):
    a, b = smooth(rng, 3, "float64")[:, 0], smooth(rng, 3, "float64")[:, 1]
    move = jnp.asarray(rng.normal(size=9))
    _, slope = jax.jit(lambda *m: jax.jvp(lambda a: call(a, b), *m))((a,), (move,))
    step = 1e-5
    expected = (call(a + step * move, b) - call(a - step * move, b)) / (2 * step)
    np.testing.assert_allclose(slope, expected, atol=1e-8)


@pytest.mark.float32
def test_compiled_once_and_alike_over_batches(rng):
    traces = []

    @jax.jit
    def counted(a, b):
        traces.append(a)
        return harmonic_products.product(a, b)

    a, b = jnp.asarray(rng.normal(size=(2, 9, 4)), jnp.float32)
    first = counted(a, b)
    np.testing.assert_allclose(counted(b, a), first, atol=1e-6)
    assert len(traces) == 1
    each = jax.jit(jax.vmap(harmonic_products.product, 1, 1))(a, b)
    np.testing.assert_allclose(each, first, atol=1e-6)
