"""Levenberg-Marquardt on normal equations among the solvers of optimistix."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from diffopt.fitting import NormalLevenbergMarquardt
from diffopt.kernels import lobe_squares, quadrature

OWN = NormalLevenbergMarquardt(1e-9, 1e-9)
START = jnp.asarray([-1.2, 1.0])


def valley(y, scale):
    """Rosenbrock's, with its Jacobian's rows by hand; the least is at (1, 1)."""
    x, z = y
    r = jnp.stack([scale * (z - x * x), 1.0 - x])
    zero = jnp.zeros_like(x)
    return r, jnp.stack([jnp.stack([-2.0 * scale * x, -1.0 + zero]), jnp.stack([scale, zero])])


def solved(solver, y0, scale, **options):
    options = {"max_steps": 256, "throw": False} | options
    return optx.least_squares(valley, solver, y0, scale, has_aux=True, **options)


TEN = jnp.asarray(10.0)


def test_textbook_problem():
    own = solved(OWN, START, TEN)
    other = solved(optx.LevenbergMarquardt(1e-9, 1e-9), START, TEN)
    assert own.result == optx.RESULTS.successful
    np.testing.assert_allclose(own.value, [1, 1], atol=1e-6)
    np.testing.assert_allclose(own.value, other.value, atol=1e-6)
    # The auxiliary output is that of the solution.
    np.testing.assert_allclose(own.aux, valley(own.value, TEN)[1], atol=1e-12)


def test_mapped_and_compiled():
    """A batch of starts in one program, each as it ends alone."""
    traces = []

    @jax.jit
    @jax.vmap
    def batch(y0):
        traces.append(y0)
        found = solved(OWN, y0, TEN)
        return found.value, found.stats["num_steps"]

    starts = jnp.asarray([[-1.2, 1.0], [0.0, 0.0], [2.0, -1.0], [1.0, 1.0]])
    for _ in range(2):
        values, steps = batch(starts)
    assert len(traces) == 1
    np.testing.assert_allclose(values, 1, atol=1e-6)
    assert int(steps[3]) < int(steps[0])


def test_says_when_it_did_not_arrive():
    found = solved(OWN, START, TEN, max_steps=4)
    assert found.result == optx.RESULTS.nonlinear_max_steps_reached
    start, end = (float((valley(y, TEN)[0] ** 2).sum()) for y in (START, found.value))
    assert end <= start
    with pytest.raises(eqx.EquinoxRuntimeError, match="maximum number of steps"):
        solved(OWN, START, TEN, max_steps=4, throw=True)


def test_slope_through_the_solution():
    """By the implicit function theorem, of a problem whose least is not zero: against its
    closed form."""

    def line(y, target):
        """The mean of targets, and their slope over [-1, 1]."""
        at = jnp.linspace(-1.0, 1.0, 5)
        return y[0] + y[1] * at - target, jnp.stack([jnp.ones(5), at])

    @jax.jit
    def fitted(target):
        found = optx.least_squares(line, OWN, jnp.zeros(2), target, has_aux=True, max_steps=64)
        return found.value

    target = jnp.asarray([1.0, -0.5, 2.0, 0.3, 0.7])
    rows = np.asarray(line(jnp.zeros(2), target)[1])
    expected = np.linalg.solve(rows @ rows.T, rows)
    np.testing.assert_allclose(fitted(target), expected @ np.asarray(target), atol=1e-8)
    np.testing.assert_allclose(jax.jacrev(fitted)(target), expected, atol=1e-8)


@pytest.mark.parametrize("given", ["nothing", "turned", "tree"])
def test_rows_are_asked_for(given):
    def fn(y, scale):
        r, rows = valley(y, scale)
        r = jnp.concatenate([r, r[:1]])
        rows = jnp.concatenate([rows, rows[:, :1]], 1)
        return r, {"nothing": None, "turned": rows.T, "tree": (rows,)}[given]

    with pytest.raises(ValueError, match=r"rows of the Jacobian \[P, N\].*expected rows \(2, 3\)"):
        optx.least_squares(fn, OWN, START, TEN, has_aux=True)


def test_lobes_end_where_the_other_solver_does():
    """Two lobes for a cosine-weighted power; the solvers differ in damping and linear algebra."""

    @jax.jit
    def problem():
        s, solid = quadrature.polar_grid(jnp.asarray([0.6, 0.0, 0.8]), 12, 16)
        values = jnp.maximum(s[:, 2], 0.0) * jnp.maximum(0.6 * s[:, 0] + 0.8 * s[:, 2], 0.0) ** 6
        given, norm = lobe_squares.problem(s, solid, values)
        mu = jnp.asarray([[0.6, 0.1, 0.8], [0.6, 0.0, 0.8]])
        mu = mu / jnp.linalg.norm(mu, axis=1, keepdims=True)
        kappa = jnp.asarray([3.0, 16.0])
        at, base = lobe_squares.parameters(jnp.asarray([0.3, 0.3]), mu, kappa, norm, signed=False)
        return given, at, base

    given, at, base = problem()

    def residuals(y, args):
        return lobe_squares.residuals(y, *args, signed=False)

    found = [
        optx.least_squares(
            residuals, solver, at, (base, given), has_aux=True, max_steps=512, throw=False
        )
        for solver in (OWN, optx.LevenbergMarquardt(1e-9, 1e-9))
    ]
    costs = [float((residuals(f.value, (base, given))[0] ** 2).sum()) for f in found]
    assert all(f.result == optx.RESULTS.successful for f in found)
    assert costs[0] == pytest.approx(costs[1], rel=1e-6)
    # The target is its own mirror image in y, and the lobes may be of either.
    for name in ("weight", "log_kappa"):
        one, other = (np.sort(getattr(f.value, name)) for f in found)
        np.testing.assert_allclose(one, other, atol=1e-6, err_msg=name)
