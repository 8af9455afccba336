"""Levenberg-Marquardt on normal equations, as an optimistix solver.

Optimistix's own solver differentiates the residual function and factorises the Jacobian by
QR. Where the residual function hands over its Jacobian, and P parameters are few against N
residuals, forming the P x P normal equations costs one matrix product; a step then costs
little more than an evaluation. The function returns the Jacobian as auxiliary output:

    def residuals(y, args):
        return r, rows                      # [N], and [P, N]: rows in the order of flattened y

    optx.least_squares(residuals, NormalLevenbergMarquardt(1e-6, 1e-6), y0, args, has_aux=True)

Any other solver takes the same function, and the compiler drops the rows.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, PyTree

from diffopt.kernels.lobe_squares import normal_equations


class NormalDescent(optx.AbstractDescent[PyTree, optx.FunctionInfo.EvalGradHessian, Any]):
    """Marquardt's step: the diagonal of the normal equations is scaled by 1 + 1 / step size.

    Attributes
    ----------
    longest
        Bound on each entry of a step, in units of the parameters.
    """

    longest: float = 1.0

    def init(self, y: PyTree, f_info_struct: Any) -> Any:
        """A state of the right structure."""
        return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), f_info_struct)

    def query(self, y: PyTree, f_info: Any, state: Any) -> Any:
        """Take in the equations at an accepted point."""
        return f_info

    def step(self, step_size: Any, state: Any) -> tuple[PyTree, optx.RESULTS]:
        """The step and whether the linear solve went well."""
        matrix = state.hessian.as_matrix()
        diagonal = jnp.diagonal(matrix)
        # For parameters that nothing depends on.
        ridge = 1e-6 if matrix.dtype == jnp.float32 else 1e-9
        damped = matrix + jnp.diag(diagonal / step_size + ridge)
        operator = lx.MatrixLinearOperator(damped, lx.positive_semidefinite_tag)
        slope, unravel = ravel_pytree(state.grad)
        solution = lx.linear_solve(operator, -slope, lx.Cholesky(), throw=False)
        step = jnp.clip(solution.value, -self.longest, self.longest)
        return unravel(step), optx.RESULTS.promote(solution.result)


class _State(eqx.Module):
    first: Bool[Array, ""]
    trial: PyTree
    f_info: Any
    aux: PyTree
    step_size: Float[Array, ""]
    terminate: Bool[Array, ""]
    result: optx.RESULTS


class NormalLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """Levenberg-Marquardt for residual functions that return their Jacobian's rows.

    The damping falls to a fifth after a step that lowers the cost and grows sixfold after one
    that does not. Stops when a step is within the tolerances, both the parameters' and the
    cost's, when a step without much damping lowers the cost by less than ``flat``, or when no step
    that is long enough to matter lowers it.

    Parameters
    ----------
    rtol, atol
        Relative and absolute tolerance of parameters and cost.
    norm
        Norm of a pytree; the largest entry by default.
    descent
        From normal equations to a step.
    flat
        Share of the cost; ends the crawl along parameters that the data do not hold.

    Raises
    ------
    ValueError
        When solving, if the residual function has no auxiliary output [P, N].
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Any] = optx.max_norm
    descent: optx.AbstractDescent = NormalDescent()
    flat: float = 0.0

    def init(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        f_struct: PyTree,
        aux_struct: PyTree,
        tags: frozenset[object],
    ) -> _State:
        """The state before the first evaluation."""
        flat, _ = ravel_pytree(y)
        expected = (flat.size, *f_struct.shape) if hasattr(f_struct, "shape") else None
        if getattr(aux_struct, "shape", None) != expected:
            raise ValueError(
                "the residual function must return (residuals [N], rows of the Jacobian [P, N]) "
                f"with has_aux=True; expected rows {expected}, received {aux_struct}"
            )
        zero = jnp.zeros((), flat.dtype)
        matrix = jnp.zeros((flat.size, flat.size), flat.dtype)
        info = _info(zero, jax.tree.map(jnp.zeros_like, y), matrix)
        aux = jnp.zeros(aux_struct.shape, aux_struct.dtype)
        never = jnp.zeros((), bool)
        return _State(~never, y, info, aux, zero + 1e2, never, optx.RESULTS.successful)

    def step(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
    ) -> tuple[PyTree, _State, PyTree]:
        """Judge the trial point, and propose the next."""
        residual, rows = fn(state.trial, args)
        matrix, slope, cost = normal_equations(residual, rows)
        _, unravel = ravel_pytree(y)
        found = _info(0.5 * cost, unravel(slope), matrix)
        better = state.first | (found.f < state.f_info.f)
        size = state.step_size * jnp.where(state.first, 1.0, jnp.where(better, 5.0, 1.0 / 6.0))
        size = jnp.clip(size, 1e-6, 1e9)
        terminate = ~state.first & self._settled(y, state, found, better)

        new = (state.trial, found, rows)
        old = (y, state.f_info, state.aux)
        kept, info, aux = jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)
        difference, result = self.descent.step(size, info)
        trial = jax.tree.map(jnp.add, kept, difference)
        never = jnp.zeros((), bool)
        return kept, _State(never, trial, info, aux, size, terminate, result), aux

    def _settled(self, y: PyTree, state: _State, found: Any, better: Array) -> Array:
        moved = jax.tree.map(jnp.subtract, state.trial, y)
        scale = jax.tree.map(lambda a: self.atol + self.rtol * jnp.abs(a), y)
        short = self.norm(jax.tree.map(jnp.divide, moved, scale)) < 1.0
        fall = jnp.abs(found.f - state.f_info.f) <= self.atol**2 + self.rtol * state.f_info.f
        stuck = ~better & (state.step_size <= 1e-6)
        gained = state.f_info.f - found.f
        crawling = better & (state.step_size >= 1.0) & (gained < self.flat * state.f_info.f)
        return (short & fall) | stuck | crawling

    def terminate(
        self,
        fn: Any,
        y: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
    ) -> tuple[Array, optx.RESULTS]:
        """Whether to stop, and how the last linear solve went."""
        return state.terminate, state.result

    def postprocess(
        self,
        fn: Any,
        y: PyTree,
        aux: PyTree,
        args: PyTree,
        options: dict[str, Any],
        state: _State,
        tags: frozenset[object],
        result: optx.RESULTS,
    ) -> tuple[PyTree, PyTree, dict[str, Any]]:
        """Nothing is left to do."""
        return y, aux, {}


def _info(cost: Array, slope: PyTree, matrix: Array) -> Any:
    operator = lx.MatrixLinearOperator(matrix, lx.positive_semidefinite_tag)
    return optx.FunctionInfo.EvalGradHessian(cost, slope, operator)
