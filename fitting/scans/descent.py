"""Levenberg and Marquardt's steps with the loss after each of them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from diffopt.fitting.solvers import NormalLevenbergMarquardt

Residuals = Callable[[Array, Any], tuple[Array, Array]]


def descended(
    function: Residuals,
    u: Float[Array, " P"],
    args: Any,
    limit: Int[Array, ""],
    *,
    tolerance: float,
    steps: int,
) -> tuple[
    Float[Array, " P"],
    Float[Array, "P P"],
    Int[Array, ""],
    Bool[Array, ""],
    Float[Array, " steps"],
]:
    """Minimise half the sum of squared residuals, as `optimistix.least_squares` does.

    Parameters
    ----------
    function
        Of (u, args): residuals [N] and the rows of their Jacobian [P, N].
    u, args
        Start, and what else the residuals depend on.
    tolerance
        Relative and absolute, see `diffopt.fitting.solvers.NormalLevenbergMarquardt`.
    limit
        Trial steps, one evaluation each.
    steps
        The most that `limit` may be; static.

    Returns
    -------
    tuple
        Best u, its normal equations, the number of steps, whether they came to an end, and the
        least loss up to each step: the first is that of the start; NaN beyond the last.
    """
    solver = NormalLevenbergMarquardt(tolerance, tolerance)
    shape, rows = jax.eval_shape(function, u, args)
    start = solver.init(function, u, args, {}, shape, rows, frozenset())
    arrays, static = eqx.partition(start, eqx.is_array)

    def going(carry: Any) -> Array:
        _, _, k, done, good, _ = carry
        return ~done & good & (k < limit)

    def one(carry: Any) -> Any:
        u, arrays, k, _, _, losses = carry
        state = eqx.combine(arrays, static)
        u, state, _ = solver.step(function, u, args, {}, state, frozenset())
        done, result = solver.terminate(function, u, args, {}, state, frozenset())
        good = (result == optx.RESULTS.successful) & jnp.isfinite(u).all()
        losses = losses.at[k].set(state.f_info.f)
        return u, eqx.filter(state, eqx.is_array), k + 1, done, good, losses

    losses = jnp.full((steps,), jnp.nan, u.dtype)
    never = jnp.zeros((), bool)
    carry = (u, arrays, jnp.zeros((), jnp.int32), never, ~never, losses)
    u, arrays, count, done, good, losses = jax.lax.while_loop(going, one, carry)
    matrix = eqx.combine(arrays, static).f_info.hessian.as_matrix()
    return u, matrix, count, done & good, losses
