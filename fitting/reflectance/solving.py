"""Least squares from several starts at once, coarse to fine in the coherence window."""

import math
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from diffopt import devices
from diffopt.fitting.reflectance import forward
from diffopt.fitting.reflectance.maps import Bounds
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
    curves
        Loss after each step, first of the coarse stages under their blurs, [S, K + 1, N];
        NaN after the last.
    """

    y: Float[Array, "S P"]
    loss: Float[Array, " S"]
    steps: Int[Array, " S"]
    settled: Any
    curves: Float[Array, "S K N"]


def copies(surface: Surface, count: int) -> Surface:
    """The same surface for each of so many starts."""
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), surface)


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
    flat: float = 0.0,
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
    flat
        Share of the squared loss below which a fall ends a solve by ``normal-lm``, see
        `NormalLevenbergMarquardt`.
    """
    # Optimistix's step size has JAX's default type and its linear solves take no other: a
    # float32 model is evaluated in float32 and stepped in float64 where that is on.
    wide = jnp.result_type(float)

    def residuals(like: Surface, y: Array) -> Array:
        return forward.residuals(job, bounds.surface(like, y.astype(like.dtype)), reach)

    def one(like: Surface, y: Array, blur: Array | None) -> tuple[Array, ...]:
        def at(y: Array) -> Array:
            found = residuals(like, y)
            found = found if blur is None else jnp.matmul(blur, found, precision="highest")
            return found.astype(wide)

        start = y
        done = _solution(at, y, solver, tolerance, max_steps, flat)
        # A stage that failed hands on where it began.
        y = jnp.where(jnp.isfinite(done.value), done.value, start)
        settled = done.result == optx.RESULTS.successful
        return y, done.stats["num_steps"], settled, done.stats["curve"]

    y, steps = y.astype(wide), jnp.zeros(y.shape[:1], int)
    before = jnp.zeros((0, len(y), max_steps), wide)
    if blurs is not None:

        def stage(carry: tuple[Array, Array], blur: Array) -> tuple[tuple[Array, Array], Array]:
            y, steps = carry
            y, more, _, curve = jax.vmap(lambda like, y: one(like, y, blur))(like, y)
            return (y, steps + more), curve

        (y, steps), before = jax.lax.scan(stage, (y, steps), blurs)
    y, last, settled, curve = jax.vmap(lambda like, y: one(like, y, None))(like, y)
    loss = jax.vmap(lambda like, y: jnp.linalg.norm(residuals(like, y)))(like, y)
    curves = jnp.concatenate([before, curve[None]]).swapaxes(0, 1)
    return Solved(y, loss, steps + last, settled, curves)


def solve_on(
    count: int,
    job: forward.Job,
    like: Surface,
    bounds: Bounds,
    y: Float[Array, "S P"],
    blurs: Float[Array, "K N N"] | None,
    **options: Any,
) -> Solved:
    """The same, with the starts divided among devices.

    Parameters
    ----------
    count
        Local devices.
    job, like, bounds, y, blurs, **options
        As for `solve`.

    Raises
    ------
    InputError
        If there are fewer.
    """
    if count == 1:
        return solve(job, like, bounds, y, blurs, **options)
    over, starts = list(devices.some(count).devices.flat), len(y)
    # Starts are members of one batch throughout: the compiler divides them by itself.
    given = devices.spread(devices.filled((like, y), -(-starts // count) * count), devices=over)
    found = solve(job, given[0], bounds, given[1], blurs, **options)
    return jax.tree.map(lambda a: a[:starts], found)


class _Kept(eqx.Module):
    inner: Any
    curve: Float[Array, " N"]
    count: Int[Array, ""]


class _Recording(eqx.Module):
    """Another solver, that keeps the loss after each step."""

    inner: Any
    size: int = eqx.field(static=True)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """As the other's."""
        state = self.inner.init(fn, y, args, options, f_struct, aux_struct, tags)
        return _Kept(state, jnp.full(self.size, jnp.nan, y.dtype), jnp.zeros((), int))

    def step(self, fn, y, args, options, state, tags):
        """As the other's; its `f_info` is at the accepted point."""
        y, inner, aux = self.inner.step(fn, y, args, options, state.inner, tags)
        loss = jnp.sqrt(jnp.maximum(2.0 * inner.f_info.as_min(), 0.0)).astype(y.dtype)
        curve = state.curve.at[state.count].set(loss, mode="drop")
        return y, _Kept(inner, curve, state.count + 1), aux

    def terminate(self, fn, y, args, options, state, tags):
        """As the other's."""
        return self.inner.terminate(fn, y, args, options, state.inner, tags)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """As the other's, with the losses."""
        y, aux, stats = self.inner.postprocess(fn, y, aux, args, options, state.inner, tags, result)
        return y, aux, {**stats, "curve": state.curve}

    rtol = property(lambda self: self.inner.rtol)
    atol = property(lambda self: self.inner.atol)
    norm = property(lambda self: self.inner.norm)


class _RecordingSquares(_Recording, optx.AbstractLeastSquaresSolver):
    pass


class _RecordingMinimum(_Recording, optx.AbstractMinimiser):
    pass


# Pyright takes the properties above for fields.
_squares: Any = _RecordingSquares
_minimum: Any = _RecordingMinimum


def _solution(at: Any, y: Array, solver: str, tolerance: float, max_steps: int, flat: float) -> Any:
    options = {"max_steps": max_steps, "throw": False}
    if solver == "normal-lm":

        def with_rows(y: Array, _: Any) -> tuple[Array, Array]:
            found, push = jax.linearize(at, y)
            return found, jax.vmap(push)(jnp.eye(y.size, dtype=y.dtype))

        inner = NormalLevenbergMarquardt(tolerance, tolerance, flat=flat)
        method = _squares(inner, max_steps)
        return optx.least_squares(with_rows, method, y, has_aux=True, **options)
    if solver == "bfgs":
        method = _minimum(optx.BFGS(tolerance, tolerance), max_steps)
        return optx.minimise(lambda y, _: 0.5 * (at(y) ** 2).sum(), method, y, **options)
    kind = {"lm": optx.LevenbergMarquardt, "dogleg": optx.Dogleg}[solver]
    method = _squares(kind(tolerance, tolerance), max_steps)
    return optx.least_squares(lambda y, _: at(y), method, y, **options)


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
