"""Least squares for lobes and their quadrature: derivatives, descent, exact recovery."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy.optimize import nnls
from scipy.special import sph_harm_y

from diffopt.kernels import lobe_squares, quadrature, vmf, vmf_pairs
from diffopt.kernels.lobe_squares import Parameters

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
CAP = 1e6


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


@partial(jax.jit, static_argnums=0)
def nodes(dtype):
    return quadrature.polar_grid(jnp.asarray([0.0, 0.0, 1.0], dtype), 24, 32)


def lobe_sum(s, alpha, mu, kappa):
    """In plain NumPy."""
    t = ((s[:, None] - mu) ** 2).sum(-1) / 2
    peak = kappa / (2 * np.pi * -np.expm1(-2 * kappa))
    return (alpha * peak * np.exp(-kappa * t)).sum(-1)


@pytest.mark.parametrize("signed", [False, True])
def test_rows_are_the_derivatives(signed):
    """To 1e-10 of the largest entry of each row, for wide and sharp lobes off their base."""
    kappa = jnp.asarray([1e-3, 1.0, 50.0, 1e5])
    mu = jnp.asarray(unit(np.array([[0.3, 0.2, 1], [-1, 0.4, 0.5], [0, 0, -1], [0.01, 0, 1]])))
    s, solid = nodes("float64")
    # Nodes on the flank of the sharpest lobe, for its rows are zero elsewhere.
    close = mu[3:] + 2e-3 * jnp.asarray(unit(np.array([[1, 0.2, 0], [-0.3, 1, 0], [-1, -1, 0]])))
    s = jnp.concatenate([s, close / jnp.linalg.norm(close, axis=1, keepdims=True)])
    solid = jnp.concatenate([solid, jnp.full(3, 1e-5)])
    given, norm = lobe_squares.problem(s, solid, 1.0 + s[:, 0])
    at, base = lobe_squares.parameters(jnp.ones(4), mu, kappa, norm, signed=signed)
    offset = jnp.asarray([[0.5, -0.7, 1.2, 0.3], [-0.2, 0.4, 0.6, -0.5]])
    weight = jnp.asarray([0.7, -0.4, 0.2, -1.1])  # logs, or with signs
    at = Parameters(weight, at.log_kappa, offset)
    flat, unravel = ravel_pytree(at)

    def residual(flat):
        return lobe_squares.residuals(unravel(flat), base, given, signed=signed)

    expected = jax.jit(jax.jacfwd(lambda x: residual(x)[0]))(flat).T
    found = np.asarray(jax.jit(residual)(flat)[1])
    size = np.abs(expected).max(1, keepdims=True)
    assert (size > 1e-5).all()
    assert (np.abs(found - expected) <= 1e-10 * size).all()


@pytest.mark.parametrize("signed", [False, True])
def test_lobes_come_back(signed, dtype):
    alpha, kappa = jnp.asarray([0.3, 2.0], dtype), jnp.asarray([0.5, 3e3], dtype)
    mu = jnp.asarray([[0.6, 0, -0.8], [0.48, -0.36, 0.8]], dtype)
    norm = jnp.asarray(2.5, dtype)

    @jax.jit
    def back(*lobes):
        at, base = lobe_squares.parameters(*lobes, norm, signed=signed)
        return lobe_squares.lobes(at, base, norm, signed=signed)

    found = back(alpha, mu, kappa)
    # A logarithm of 8 and back.
    for one, other in zip(found, (alpha, mu, kappa), strict=True):
        np.testing.assert_allclose(one, other, rtol=16 * EPS[dtype], atol=4 * EPS[dtype])


@partial(jax.jit, static_argnames=("steps", "signed"))
def descended(s, solid, values, lobes, steps, signed):
    """Descents from a batch of starts: lobes, and the cost after each step."""

    def one(alpha, mu, kappa):
        given, norm = lobe_squares.problem(s, solid, values)
        at, base = lobe_squares.parameters(alpha, mu, kappa, norm, signed=signed)
        state = lobe_squares.begin(at, base, given, signed=signed)

        def step(state, _):
            new = lobe_squares.levenberg_marquardt(state, base, given, 1, CAP, signed=signed)
            return new, new.system.cost

        first = state.system.cost
        state, costs = jax.lax.scan(step, state, None, length=steps)
        found = lobe_squares.lobes(state.at, base, norm, signed=signed)
        return found, jnp.concatenate([first[None], costs])

    return jax.vmap(one)(*lobes)


TRUE = (
    np.array([1.0, 0.5, 0.8]),
    unit(np.array([[0.3, 0.2, 1], [-1, 0.4, 0.5], [0.5, -1, 0.1]])),
    np.array([5.0, 2.0, 12.0]),
)


def perturbed(rng, count, signs=(1, 1, 1)):
    alpha, mu, kappa = TRUE
    return (
        jnp.asarray(alpha * signs * rng.uniform(0.7, 1.4, (count, 3))),
        jnp.asarray(unit(mu + 0.15 * rng.normal(size=(count, 3, 3)))),
        jnp.asarray(kappa * rng.uniform(0.6, 1.6, (count, 3))),
    )


@pytest.mark.parametrize("signed", [False, True])
def test_sums_of_lobes_are_recovered(signed, rng):
    """Exactly: the residual at the optimum is zero, so that steps converge fast."""
    signs = np.array([1, -1, 1] if signed else [1, 1, 1])
    alpha, mu, kappa = TRUE
    s, solid = nodes("float64")
    values = jnp.asarray(lobe_sum(np.asarray(s), alpha * signs, mu, kappa))
    found, costs = descended(s, solid, values, perturbed(rng, 4, signs), 40, signed)
    costs = np.asarray(costs)
    assert (np.diff(costs, axis=1) <= 0).all()
    # The square of the rounding of values of 1, with what 60 parameters' slack adds.
    assert (costs[:, 0] > 1e-3).all()
    assert (costs[:, -1] < 1e-24).all()
    for one, other in zip(found, (alpha * signs, mu, kappa), strict=True):
        np.testing.assert_allclose(one, np.broadcast_to(other, one.shape), rtol=1e-9, atol=1e-9)


def test_cost_never_rises_in_float32(rng):
    """To a target that no lobes make; far starts, so that steps are refused too."""
    s, solid = nodes("float32")
    values = jnp.maximum(s[:, 2], 0.0) + (s[:, 0] > 0.5).astype(s.dtype)
    lobes = jax.tree.map(lambda x: x.astype(s.dtype), perturbed(rng, 4))
    lobes = (lobes[0], lobes[1][:, ::-1], 50.0 * lobes[2])
    found, costs = descended(s, solid, values, lobes, 40, False)
    costs = np.asarray(costs)
    assert (np.diff(costs, axis=1) <= 0).all()
    assert (np.diff(costs, axis=1) == 0).any()  # refused
    assert (costs[:, -1] < 0.3 * costs[:, 0]).all()
    assert all(bool(jnp.isfinite(x).all()) for x in found)


def test_concentrations_stay_in_their_range():
    """A target of one node wants more than the cap, an even one less than the flattest."""
    s, solid = nodes("float64")
    one = jnp.zeros_like(solid).at[40].set(1.0)
    axis, kappa = s[40:41][None], jnp.full((1, 1), 100.0)
    (_, _, sharp), _ = descended(s, solid, one, (jnp.ones((1, 1)), axis, kappa), 40, False)
    assert 1e3 < float(sharp[0, 0]) <= CAP * (1 + 1e-12)
    even = (jnp.ones((1, 1)), axis, jnp.ones((1, 1)))
    (alpha, _, flat), costs = descended(s, solid, jnp.ones_like(solid), even, 40, False)
    assert 1e-3 * (1 - 1e-12) <= float(flat[0, 0]) < 2e-3
    # Next to an even function: cos theta times kappa is what is left.
    assert float(costs[0, -1]) < 1e-6
    assert float(alpha[0, 0]) == pytest.approx(4 * np.pi, rel=1e-5)


@pytest.mark.parametrize("signed", [False, True])
def test_best_weights_are_the_least_squares(signed, rng):
    s, solid = nodes("float64")
    _, mu, kappa = TRUE
    values = np.stack([np.asarray(s[:, 0]) ** 2, np.asarray(s[:, 2]), rng.uniform(0, 1, len(s))], 1)
    found = lobe_squares.best_weights(
        jnp.asarray(values), solid, s, jnp.asarray(mu), jnp.asarray(kappa), signed=signed
    )
    root = np.sqrt(np.asarray(solid))
    each = np.stack(
        [lobe_sum(np.asarray(s), *x) for x in zip(np.eye(3), [mu] * 3, [kappa] * 3, strict=True)], 1
    )
    matrix, right = root[:, None] * each, root[:, None] * values
    if signed:
        expected = np.linalg.lstsq(matrix, right)[0]
        assert (expected < 0).any()
    else:
        expected = np.stack([nnls(matrix, c)[0] for c in right.T], 1)
        assert (expected == 0).any()
        assert (np.asarray(found) >= 0).all()
    # The ridge of 1e-12; coordinate descent gains a digit or more in each of 30 sweeps.
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


AXES = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.48, -0.36, 0.8], [0.6, 0.8, -1e-9]])


@jax.jit
def grids(axes, cores):
    return jax.vmap(lambda a, c: quadrature.polar_grid(a, 32, 48, c))(axes, cores)


def test_solid_angles_and_harmonics(dtype):
    """Every axis; sums of 1536 terms. Harmonics by themselves alone: others integrate to 0."""
    cores = np.array([1.0, 0.5, 0.3, 1.0])
    s, solid = (
        np.asarray(x, np.float64) for x in grids(*(jnp.asarray(x, dtype) for x in (AXES, cores)))
    )
    assert (solid > 0).all()
    np.testing.assert_allclose(np.linalg.norm(s, axis=-1), 1, atol=8 * EPS[dtype])
    np.testing.assert_allclose(solid.sum(1), 4 * np.pi, rtol=32 * EPS[dtype])
    # In x polynomials of degree 2 l + 1; crowding by sinh is no polynomial, but smooth.
    for l in range(5):
        for m in range(-l, l + 1):
            theta, phi = np.arccos(np.clip(s[..., 2], -1, 1)), np.arctan2(s[..., 1], s[..., 0])
            total = (sph_harm_y(l, m, theta, phi) * solid).sum(1)
            expected = np.sqrt(4 * np.pi) if l == 0 else 0.0
            np.testing.assert_allclose(total, expected, atol=256 * EPS[dtype])


def test_lobes_by_quadrature():
    """Integral, mean and norm of lobes of 1 to 1e4, at the axis and beside it, with the cores
    that fits use: 8 / sqrt(kappa)."""
    kappa = np.array([1.0, 30.0, 1e3, 1e4])
    cores = np.minimum(8 / np.sqrt(kappa), 1.0)
    s, solid = grids(jnp.asarray(AXES), jnp.asarray(cores))
    for beside in (0.0, 1.0):
        # A standard deviation off the axis.
        mu = AXES + beside / np.sqrt(kappa)[:, None] * unit(np.cross(AXES, [0.3, 0.5, 0.1]))
        density = vmf.pdf(s, jnp.asarray(unit(mu))[:, None], jnp.asarray(kappa)[:, None])
        # The core does not shrink in proportion to the lobe's square, for the sake of what lies
        # about it: the sharper, the fewer of the 32 rings hold it.
        norm2 = (density**2 * solid).sum(1) / vmf.squared_norm(jnp.asarray(kappa))
        assert (np.abs((density * solid).sum(1) - 1) < [1e-14, 1e-14, 1e-7, 2e-5]).all()
        assert (np.abs(norm2 - 1) < [1e-14, 1e-14, 2e-5, 4e-4]).all()


@pytest.mark.float32
def test_grid_without_a_core_is_plain():
    """Rings by x = sin(theta / 2) itself: half the nodes within 60 degrees."""
    s, _ = nodes("float32")
    assert int((s[:, 2] > 0.5).sum()) == 12 * 32


def test_energy_is_restored_with_the_least_change(rng):
    """The sum is met, and no other change that meets it is smaller: a stationary point."""
    count = 5
    mu = rng.normal(size=(count, 3))
    mu /= np.linalg.norm(mu, axis=1, keepdims=True)
    kappa = 10.0 ** rng.uniform(0.0, 2.0, count)
    alpha = rng.uniform(1.0, 2.0, (count, 2))
    whole = np.array([1.05, 0.9]) * alpha.sum(0)
    alpha, whole, mu, kappa = map(jnp.asarray, (alpha, whole, mu, kappa))
    found = np.asarray(lobe_squares.restored(alpha, whole, mu, kappa, signed=True))
    np.testing.assert_allclose(found.sum(0), whole, rtol=1e-12)
    pairs = vmf_pairs.log_inner(mu[:, None], kappa[:, None], mu[None], kappa[None])
    gram = np.exp(np.asarray(pairs))
    # Stationary: the gradient of the change's norm is the same for every lobe.
    slope = gram @ (found - np.asarray(alpha))
    np.testing.assert_allclose(slope, slope.mean(0, keepdims=True).repeat(count, 0), rtol=1e-6)
