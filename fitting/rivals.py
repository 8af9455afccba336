"""The solvers that `fit_lobes` is compared with: optimistix's own, and SciPy's.

All solve the same least-squares problem (`diffopt.kernels.lobe_squares`) from the same start.
SciPy's trust-region reflective method is the Coleman-Li method that the glossy-transfer paper
names; its residuals and exact Jacobian come from one compiled function, float64.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from diffopt.fitting.lobes import Nodes
from diffopt.fitting.solvers import NormalLevenbergMarquardt
from diffopt.kernels import lobe_squares

# Lobes as arrays: alpha [B, K], mu [B, K, 3], kappa [B, K].
Start = tuple[Array, Array, Array]


class Found(NamedTuple):
    """What a solver returns for a batch of B functions."""

    alpha: Float[Array, "B K"]
    mu: Float[Array, "B K 3"]
    kappa: Float[Array, "B K"]
    steps: Array
    success: Array


def solvers(rtol: float = 1e-6, atol: float = 1e-6) -> dict[str, Any]:
    """Optimistix's solvers by name; ``normal-lm`` is that of `diffopt.fitting.solvers`."""
    return {
        "normal-lm": NormalLevenbergMarquardt(rtol, atol),
        "optimistix-lm": optx.LevenbergMarquardt(rtol, atol),
        "optimistix-dogleg": optx.Dogleg(rtol, atol),
        "optimistix-gauss-newton": optx.GaussNewton(rtol, atol),
        "optimistix-bfgs": optx.BFGS(rtol, atol),
    }


def optimistix_fit(
    solver: Any, *, max_steps: int = 300, together: bool = False
) -> Callable[[Nodes, Start], Found]:
    """A function from problems and starts to lobes, to be compiled.

    Parameters
    ----------
    solver
        Of optimistix, for least squares or minimisation.
    max_steps
        Most steps of each function.
    together
        Fit all by one `jax.vmap`, which runs until the slowest has ended; else one after
        the other by `jax.lax.map`.
    """

    def residual(y: Any, args: Any) -> tuple[Array, Array]:
        base, given = args
        return lobe_squares.residuals(y, base, given, signed=False)

    def one(given: tuple) -> Found:
        function, start = given
        problem, norm = lobe_squares.problem(*function)
        at, base = lobe_squares.parameters(start[0], start[1], start[2], norm, signed=False)
        solution = optx.least_squares(
            residual, solver, at, (base, problem), has_aux=True, max_steps=max_steps, throw=False
        )
        alpha, mu, kappa = lobe_squares.lobes(solution.value, base, norm, signed=False)
        steps = jnp.asarray(solution.stats["num_steps"])
        return Found(alpha, mu, kappa, steps, solution.result == optx.RESULTS.successful)

    def all_of(nodes: Nodes, start: Start) -> Found:
        batch = (nodes.scalar(), start)
        return jax.vmap(one)(batch) if together else jax.lax.map(one, batch)

    return all_of


@jax.jit
def _residual_and_rows(
    flat: Array, at: lobe_squares.Parameters, base: Any, given: Any
) -> tuple[Array, Array]:
    _, unravel = ravel_pytree(at)
    return lobe_squares.residuals(unravel(flat), base, given, signed=False)


def scipy_fit(nodes: Nodes, start: Start, *, max_steps: int = 300) -> Found:
    """SciPy's ``least_squares(method="trf")`` on one function after the other, float64.

    Call it with 64-bit types enabled and within `one_thread`.
    """
    from scipy.optimize import least_squares

    found, steps, success = [], [], []
    for row in range(nodes.values.shape[0]):
        function = tuple(a[row].astype(float) for a in nodes.scalar())
        problem, norm = lobe_squares.problem(*function)
        alpha, mu, kappa = (a[row].astype(float) for a in start)
        at, base = lobe_squares.parameters(alpha, mu, kappa, norm, signed=False)
        flat, unravel = ravel_pytree(at)
        last: dict[str, Any] = {}

        def both(x: np.ndarray, last: dict = last, fixed: Any = (at, base, problem)) -> Any:
            # SciPy asks for the Jacobian where it has just asked for the residuals.
            key = x.tobytes()
            if last.get("key") != key:
                residual, rows = _residual_and_rows(jnp.asarray(x), *fixed)
                last.update(key=key, residual=np.asarray(residual), rows=np.asarray(rows).T)
            return last

        def rows(x: np.ndarray, both: Callable = both) -> np.ndarray:
            return both(x)["rows"]

        exact: Any = rows
        solution = least_squares(
            lambda x, both=both: both(x)["residual"],
            np.asarray(flat),
            jac=exact,
            method="trf",
            max_nfev=max_steps,
        )
        result = lobe_squares.lobes(unravel(jnp.asarray(solution.x)), base, norm, signed=False)
        found.append(result)
        steps.append(solution.nfev)
        success.append(solution.status > 0)
    alpha, mu, kappa = (jnp.stack(column) for column in zip(*found, strict=True))
    return Found(alpha, mu, kappa, jnp.asarray(steps), jnp.asarray(success))


@contextlib.contextmanager
def one_thread() -> Iterator[bool]:
    """Linear algebra of NumPy and SciPy on one thread; whether that could be had.

    On several, small factorisations are 10 to 100 times slower. Without the package
    threadpoolctl nothing is changed: set OPENBLAS_NUM_THREADS=1 before Python starts.
    """
    try:
        from threadpoolctl import threadpool_limits
    except ImportError:
        yield False
        return
    with threadpool_limits(1, user_api="blas"):
        yield True
