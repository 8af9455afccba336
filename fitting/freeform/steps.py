"""Trial steps of the optimisers of free heights, compiled in blocks."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array

from diffopt.fitting.freeform.priors import filtered
from diffopt.fitting.freeform.problem import Problem, weighted

Solver = Literal["lbfgs", "cg"]


class _Remembered(optx.BacktrackingArmijo):
    """Armijo backtracking that starts at twice the last accepted step.

    Conjugate directions have no natural length: from a fixed first step every line search
    would halve its way down again.
    """

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """As `optimistix.BacktrackingArmijo.step`."""
        _, accept, result, new = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        grown = jnp.where(first_step, 1.0, 2.0 * state.step_size)
        size = jnp.where(accept, grown, self.decrease_factor * state.step_size)
        return size, accept, result, eqx.tree_at(lambda s: s.step_size, new, size)


def _optimiser(name: Solver) -> Any:
    # Convergence is judged between blocks, where its reason can be told.
    never = float(jnp.finfo(jnp.result_type(float)).tiny)
    if name == "lbfgs":
        return optx.LBFGS(rtol=never, atol=never, history_length=10)
    return optx.NonlinearCG(rtol=never, atol=never, search=_Remembered())


def _fresh(made: Problem, y: Array, name: Solver) -> Any:
    wide = jax.ShapeDtypeStruct((), y.dtype)
    aux = jax.eval_shape(lambda y: made.loss(y)[1], y)
    return _optimiser(name).init(lambda y, _: made.loss(y), y, None, {}, wide, aux, frozenset())


@eqx.filter_jit
def begin(made: Problem, y: Array, *, name: Solver) -> Any:
    """Arrays of the state of a solver that has not stepped yet."""
    return eqx.filter(_fresh(made, y, name), eqx.is_array)


@eqx.filter_jit
def advance(
    made: Problem, y: Array, arrays: Any, count: Array, *, name: Solver
) -> tuple[Array, Any, Array, tuple[Array, ...]]:
    """`count` trial steps; unknowns, solver state, and what the host looks at."""
    static = eqx.filter(_fresh(made, y, name), eqx.is_array, inverse=True)
    optimiser = _optimiser(name)

    def one(_, carry):
        y, arrays = carry
        state = eqx.combine(arrays, static)
        y, state, _ = optimiser.step(lambda y, _: made.loss(y), y, None, {}, state, frozenset())
        return y, eqx.filter(state, eqx.is_array)

    y, arrays = jax.lax.fori_loop(0, count, one, (y, arrays))
    state = eqx.combine(arrays, static)
    chi2, gain = state.aux
    gradient = jnp.sum(state.f_info.grad**2)
    change = filtered(y, made.colour.astype(y.dtype))
    span = jnp.ptp(made.heights(y))
    return y, arrays, change, (state.f_info.f, chi2, gain, gradient, span)


@eqx.filter_jit
def mean_curvature(made: Problem, change: Array, key: Array) -> Array:
    """Of the misfit, at all frequencies alike, for changes of height."""
    return made.curvature(change, jax.random.normal(key, change.shape, change.dtype))


@eqx.filter_jit
def prepare(
    made: Problem, change: Array, weight: Array, data: Array, *, precondition: bool
) -> tuple[Problem, Array, Any]:
    """The problem at a weight, its unknowns scaled so that a step of the gradient fits."""
    if precondition:
        made, y = weighted(made, change, weight, data)
    else:
        made, y = eqx.tree_at(lambda p: p.weight, made, weight), change
    curvature = made.curvature(y)
    scale = jnp.sqrt(jnp.where(curvature > 0.0, curvature, 1.0))
    made = eqx.tree_at(lambda p: p.colour, made, made.colour / scale)
    y = y * scale.astype(y.dtype)
    return made, y, made.loss(y)
