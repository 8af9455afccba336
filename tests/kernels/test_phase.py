"""The phase factor in turns, and the bounds on its expansions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import jv

from diffopt.kernels import phase
from reference import cases

EPS = {"float32": 1.2e-7, "float64": 2.3e-16}


def test_cis_against_numpy(dtype, rng):
    turns = rng.uniform(-50, 50, 4000).astype(dtype)
    cos, sin = jax.jit(phase.cis_turns)(jnp.asarray(turns))
    # The fraction of a turn in extended precision: no rounding of the reduction.
    angle = 2 * np.pi * (turns.astype(np.longdouble) - np.round(turns.astype(np.longdouble)))
    tolerance = 3 * EPS[dtype]
    assert np.abs(np.asarray(cos, np.longdouble) - np.cos(angle)).max() < tolerance
    assert np.abs(np.asarray(sin, np.longdouble) - np.sin(angle)).max() < tolerance


@pytest.mark.parametrize("turn", [0.0, 0.25, 0.5, 0.75, 1.0, -0.25, 1e4 + 0.5])
def test_cis_at_the_joins(turn, dtype):
    """Value and slope agree on both sides of every quarter turn."""
    t = jnp.asarray(turn, dtype)
    (cos, sin), (dcos, dsin) = jax.jvp(phase.cis_turns, (t,), (jnp.ones_like(t),))
    expected = np.exp(2j * np.pi * (turn % 1.0))
    assert abs(complex(cos, sin) - expected) < 4 * EPS[dtype]
    assert abs(complex(dcos, dsin) - 2j * np.pi * expected) < 30 * EPS[dtype]


def test_cis_maps_and_keeps_the_dtype(dtype):
    t = jnp.linspace(0, 1, 12, dtype=dtype).reshape(3, 4)
    assert phase.cis_turns(t)[0].dtype == dtype
    np.testing.assert_array_equal(jax.vmap(phase.cis_turns)(t)[1], phase.cis_turns(t)[1])


@pytest.mark.parametrize("case", cases("taylor"), ids=lambda c: c["id"])
def test_taylor_bound_matches_reference(case):
    terms = int(case["N"]) + 1
    bound = phase.taylor_bound(1.5 * np.pi, terms)
    assert bound == pytest.approx(float(case["bound_M1"]), rel=1e-12)
    assert float(case["true_err"]) < bound < 1.03 * float(case["true_err"])


@pytest.mark.parametrize("x", [0.0, 0.3, 4.7, 12.0])
def test_taylor_terms_are_the_fewest(x):
    terms = phase.taylor_terms(x, 1e-6)
    grid = np.linspace(-x, x, 501)
    n = np.arange(terms)
    factorial = np.concatenate([[1.0], np.cumprod(np.arange(1.0, terms))])
    error = np.abs(((1j * grid[:, None]) ** n / factorial).sum(1) - np.exp(1j * grid)).max()
    assert error <= 1e-6
    assert terms == 1 or phase.taylor_bound(x, terms - 1) > 1e-6


@pytest.mark.parametrize("z", [0.0, 0.5, 3.0, 30.0])
@pytest.mark.parametrize("nodes", [1, 4, 12, 40])
def test_chebyshev_bound_covers_the_error(z, nodes):
    points = np.asarray(phase.chebyshev_points(nodes, jnp.float64))
    t = np.linspace(-1, 1, 401)
    weights = np.asarray(phase.chebyshev_weights(jnp.asarray(t), nodes))
    error = np.abs(weights @ np.exp(1j * z * points) - np.exp(1j * z * t)).max()
    bound = phase.chebyshev_bound(z, nodes)
    # 1e-13: rounding of the matrix of weights.
    assert error <= bound + 1e-13
    # Not idle: within 200 of the first omitted coefficient where that is small.
    if bound < 0.1 and z > 0 and nodes > z:
        assert bound < 200 * max(abs(2 * jv(nodes, z)), 1e-15)


def test_chebyshev_weights_reproduce_polynomials(dtype, rng):
    nodes = 9
    points = phase.chebyshev_points(nodes, jnp.dtype(dtype))
    t = jnp.asarray(rng.uniform(-1, 1, (3, 5)), dtype)
    weights = jax.jit(phase.chebyshev_weights, static_argnums=1)(t, nodes)
    assert weights.shape == (3, 5, nodes)
    tolerance = 40 * EPS[dtype]  # nine terms of size one, twice
    np.testing.assert_allclose(weights.sum(-1), 1.0, atol=tolerance)
    for degree in range(nodes):
        np.testing.assert_allclose(weights @ points**degree, t**degree, atol=tolerance)
    slope = jax.vmap(jax.grad(lambda x: phase.chebyshev_weights(x, nodes) @ points**3))(points)
    # The derivative amplifies by the square of the degree.
    np.testing.assert_allclose(slope, 3 * points**2, atol=81 * tolerance)
