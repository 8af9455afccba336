"""Least squares from several starts at once, coarse to fine in the coherence window."""

import math
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from diffopt.fitting import forward
from diffopt.fitting.maps import Bounds
from diffopt.fitting.solvers import NormalLevenbergMarquardt
from diffopt.gratings import Reach, Surface

Solver = Literal["normal-lm", "lm", "dogleg", "bfgs"]
SOLVERS: tuple[str, ...] = get_args(Solver)


class Solved(eqx.Module):
    """Where solves from S starts ended.

    Attributes
    ----------
    y
        Unbounded parameters, [S, P].
    loss
        Norm of the residuals over that of the data, both over the noise, [S].
    steps
        Of all stages, [S].
    settled
        Whether the last stage ended by its tolerance and not by its number of steps, [S].
    """

    y: Float[Array, "S P"]
    loss: Float[Array, " S"]
    steps: Int[Array, " S"]
    settled: Any


@eqx.filter_jit
def solve(
    job: forward.Job,
    like: Surface,
    bounds: Bounds,
    y: Float[Array, "S P"],
    blurs: Float[Array, "K N N"] | None,
    *,
    reach: Reach,
    solver: Solver,
    tolerance: float,
    max_steps: int,
) -> Solved:
    """Least squares from every start, all in one program.

    Parameters
    ----------
    job
        The data.
    like
        Surfaces [S] that hold what is not free, and signs.
    bounds
        Of the free parameters.
    y
        Starts.
    blurs
        Of coarse stages, see `windows`; both data and model go through them.
    reach, solver, tolerance, max_steps
        What is summed; the method; its tolerance on y and on the squared loss; steps of each
        stage.
    """
    # Optimistix's step size has JAX's default type and its linear solves take no other: a
    # float32 model is evaluated in float32 and stepped in float64 where that is on.
    wide = jnp.result_type(float)

    def residuals(like: Surface, y: Array) -> Array:
        return forward.residuals(job, bounds.surface(like, y.astype(like.dtype)), reach)

    def one(like: Surface, y: Array, blur: Array | None) -> tuple[Array, Array, Array]:
        def at(y: Array) -> Array:
            found = residuals(like, y)
            found = found if blur is None else jnp.matmul(blur, found, precision="highest")
            return found.astype(wide)

        start = y
        done = _solution(at, y, solver, tolerance, max_steps)
        # A stage that failed hands on where it began.
        y = jnp.where(jnp.isfinite(done.value), done.value, start)
        return y, done.stats["num_steps"], done.result == optx.RESULTS.successful

    y, steps = y.astype(wide), jnp.zeros(y.shape[:1], int)
    if blurs is not None:

        def stage(carry: tuple[Array, Array], blur: Array) -> tuple[tuple[Array, Array], None]:
            y, steps = carry
            y, more, _ = jax.vmap(lambda like, y: one(like, y, blur))(like, y)
            return (y, steps + more), None

        (y, steps), _ = jax.lax.scan(stage, (y, steps), blurs)
    y, last, settled = jax.vmap(lambda like, y: one(like, y, None))(like, y)
    loss = jax.vmap(lambda like, y: jnp.linalg.norm(residuals(like, y)))(like, y)
    return Solved(y, loss, steps + last, settled)


def _solution(at: Any, y: Array, solver: str, tolerance: float, max_steps: int) -> Any:
    options = {"max_steps": max_steps, "throw": False}
    if solver == "normal-lm":

        def with_rows(y: Array, _: Any) -> tuple[Array, Array]:
            found, push = jax.linearize(at, y)
            return found, jax.vmap(push)(jnp.eye(y.size, dtype=y.dtype))

        method = NormalLevenbergMarquardt(tolerance, tolerance)
        return optx.least_squares(with_rows, method, y, has_aux=True, **options)
    if solver == "bfgs":
        return optx.minimise(
            lambda y, _: 0.5 * (at(y) ** 2).sum(), optx.BFGS(tolerance, tolerance), y, **options
        )
    method = {"lm": optx.LevenbergMarquardt, "dogleg": optx.Dogleg}[solver]
    return optx.least_squares(lambda y, _: at(y), method(tolerance, tolerance), y, **options)


@eqx.filter_jit
def losses(
    job: forward.Job, like: Surface, bounds: Bounds, y: Float[Array, "S P"], *, reach: Reach
) -> Float[Array, " S"]:
    """Norms of the residuals at many points, a few at once."""

    def one(part: tuple[Surface, Array]) -> Array:
        like, y = part
        surface = bounds.surface(like, y.astype(like.dtype))
        return jnp.linalg.norm(forward.residuals(job, surface, reach))

    return jax.lax.map(one, (like, y), batch_size=16)


@eqx.filter_jit
def windows(
    job: forward.Job,
    coherence: Float[Array, ""],
    coarsest: Float[Array, ""],
    *,
    stages: int,
) -> Float[Array, "K N N"]:
    """Means over neighbours in frequency that widen lines to those of shorter windows.

    Lines far from their place overlap under a short window and pull the period towards it.

    Parameters
    ----------
    job
        Spectra, not colours: each value has one frequency. N of them.
    coherence
        sigma_s of the data.
    coarsest
        sigma_s of the first stage; those between are evenly spaced in the logarithm.
    stages
        Static number K.
    """
    frequency = jnp.stack([job.fx.reshape(-1), job.fy.reshape(-1)], axis=-1)
    square = (frequency**2).sum(-1)
    product = jnp.matmul(frequency, frequency.T, precision="highest")
    apart = jnp.maximum(square[:, None] + square[None, :] - 2.0 * product, 0.0)

    def blur(share: Array) -> Array:
        window = jnp.minimum(coarsest, coherence) ** (1.0 - share) * coherence**share
        # Squares of widths add; a tenth of a line is as good as none, and keeps 0 / 0 away.
        width2 = jnp.maximum(window**-2 - coherence**-2, 0.01 * coherence**-2)
        weight = jnp.exp(-apart / (width2 / (2.0 * math.pi) ** 2))
        return weight / weight.sum(1, keepdims=True)

    return jax.vmap(blur)(jnp.arange(stages, dtype=coherence.dtype) / stages)
