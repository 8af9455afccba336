"""Least squares for sums of von Mises-Fisher lobes: residuals, their Jacobian, damped steps.

A function on the sphere, sampled at the nodes of a quadrature, is approached by
``sum_j b_j g_j`` with g_j a lobe of unit L2 norm. Per lobe four parameters without bounds:

- the log of b (or b itself, where weights may be negative),
- the log of kappa,
- two offsets in the tangent plane of a base axis, in units of 1 / sqrt(base kappa):
  ``mu = normalise(base + (a1 e1 + a2 e2) / sqrt(kappa_base))``, within a half sphere.

Each row of the Jacobian is a lobe times a polynomial: all of them cost little more than the
residual. One problem at a time; batches by ``jax.vmap``.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels import frames, vmf, vmf_pairs
from diffopt.kernels.mixture import FLATTEST
from diffopt.kernels.phase import TWO_PI

# One for all lobes, or one for each.
Ends = float | Float[Array, "#K"]


class Parameters(NamedTuple):
    """What a fit moves.

    Attributes
    ----------
    weight
        Log of the L2 norm of each lobe, or the norm with its sign, [K].
    log_kappa
        Log of each concentration, [K].
    offset
        Offsets from the base axes, [2, K].
    """

    weight: Float[Array, " K"]
    log_kappa: Float[Array, " K"]
    offset: Float[Array, "2 K"]


class Base(NamedTuple):
    """What it is measured from: axes with two tangents each, over sqrt(kappa), [K, 3] each."""

    axis: Float[Array, "K 3"]
    first: Float[Array, "K 3"]
    second: Float[Array, "K 3"]


class Problem(NamedTuple):
    """A function at the nodes of a quadrature, scaled.

    Attributes
    ----------
    nodes
        Unit vectors as rows, [3, N].
    root
        Square roots of the solid angles, [N].
    target
        The function times `root`, over its norm, [N].
    """

    nodes: Float[Array, "3 N"]
    root: Float[Array, " N"]
    target: Float[Array, " N"]


def problem(
    directions: Float[Array, "N 3"], solid_angles: Float[Array, " N"], values: Float[Array, " N"]
) -> tuple[Problem, Float[Array, ""]]:
    """The problem of fitting values at directions, and the norm that was divided out."""
    root = jnp.sqrt(solid_angles)
    target = root * values
    square = (target * target).sum()
    some = square > 0.0
    norm = jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
    return Problem(directions.T, root, target / jnp.where(some, norm, 1.0)), norm


def parameters(
    alpha: Float[Array, " K"],
    mu: Float[Array, "K 3"],
    kappa: Float[Array, " K"],
    norm: Float[Array, ""],
    *,
    signed: bool,
) -> tuple[Parameters, Base]:
    """Lobes as parameters, with themselves as the base; integrals alpha over the norm."""
    weight = alpha * jnp.sqrt(vmf.squared_norm(kappa)) / jnp.where(norm > 0.0, norm, 1.0)
    if not signed:
        weight = jnp.log(jnp.maximum(weight, 1e-6))
    first, second = frames.tangents(mu)
    size = jax.lax.rsqrt(kappa)[:, None]
    zero = jnp.zeros((2, kappa.shape[0]), kappa.dtype)
    return Parameters(weight, jnp.log(kappa), zero), Base(mu, size * first, size * second)


def lobes(
    at: Parameters, base: Base, norm: Float[Array, ""], *, signed: bool
) -> tuple[Float[Array, " K"], Float[Array, "K 3"], Float[Array, " K"]]:
    """Integrals, axes and concentrations of parameters: the inverse of `parameters`."""
    kappa = jnp.exp(at.log_kappa)
    mu, _ = _axes(at, base)
    weight = at.weight if signed else jnp.exp(at.weight)
    return norm * weight / jnp.sqrt(vmf.squared_norm(kappa)), mu, kappa


def _axes(at: Parameters, base: Base) -> tuple[Array, Array]:
    vector = base.axis + at.offset[0, :, None] * base.first + at.offset[1, :, None] * base.second
    size = jax.lax.rsqrt(frames.dot(vector, vector))[:, None]
    return vector * size, size


def residuals(
    at: Parameters, base: Base, given: Problem, *, signed: bool
) -> tuple[Float[Array, " N"], Float[Array, "P N"]]:
    """Residuals over the norm, and their derivatives, a row for each of P = 4 K parameters.

    The rows come in the order of the flattened `Parameters`.
    """
    kappa = jnp.exp(at.log_kappa)
    mu, size = _axes(at, base)
    # d mu / d offset; it has no part along mu, so that s may be replaced by s - mu.
    turns = [
        kappa[:, None] * size * (e - frames.dot(mu, e)[:, None] * mu)
        for e in (base.first, base.second)
    ]
    d = [given.nodes[i][None] - mu[:, i, None] for i in range(3)]
    falls = kappa[:, None] * (0.5 * (d[0] ** 2 + d[1] ** 2 + d[2] ** 2))
    # Of unit norm: peak^2 = kappa / (pi (1 - exp(-4 kappa))).
    tail = -jnp.expm1(-4.0 * kappa)
    peak = jnp.sqrt(kappa / (math.pi * tail))
    shape = peak[:, None] * (jnp.exp(-falls) * given.root[None])
    # Slope of log peak in log kappa.
    rise = 0.5 * (1.0 - 4.0 * kappa * (1.0 - tail) / tail)
    # All rows are one expression, (a - b falls + t . d) shape: stacked from four, each of their
    # values would be picked by a branch.
    weight = at.weight if signed else jnp.exp(at.weight)
    one, none = jnp.ones_like(weight), jnp.zeros_like(weight)
    constant = jnp.stack([one if signed else weight, weight * rise, none, none])
    falling = jnp.stack([none, weight, none, none])
    still = jnp.zeros_like(mu)
    turning = jnp.stack([still, still, *(weight[:, None] * turn for turn in turns)])
    rows = shape[None] * (
        constant[..., None]
        - falling[..., None] * falls[None]
        + sum(turning[..., i, None] * d[i][None] for i in range(3))
    )
    # Written out: as a reduction it was handed to a library call, which took longer.
    together = functools.reduce(jnp.add, list(weight[:, None] * shape))
    return together - given.target, rows.reshape(-1, given.root.shape[0])


class System(NamedTuple):
    """Normal equations at a point: J J^T, J r and r . r."""

    matrix: Float[Array, "P P"]
    slope: Float[Array, " P"]
    cost: Float[Array, ""]


def normal_equations(residual: Float[Array, " N"], rows: Float[Array, "P N"]) -> System:
    """The normal equations of residuals and the rows of their derivatives."""
    exact = jax.lax.Precision.HIGHEST
    # Along the nodes of both: with rows.T a batch of one is copied, and takes twice as long.
    matrix = jax.lax.dot_general(rows, rows, (((1,), (1,)), ((), ())), precision=exact)
    return System(matrix, jnp.matmul(rows, residual, precision=exact), (residual * residual).sum())


def damped_step(
    system: System, damping: Float[Array, ""], longest: float = 1.0
) -> Float[Array, " P"]:
    """Marquardt's step, its entries cut to `longest`.

    The diagonal is scaled, with a small multiple of the identity against parameters that
    nothing depends on (the weight of a lobe that has vanished).
    """
    ridge = 1e-6 if damping.dtype == jnp.float32 else 1e-9
    unit = jnp.eye(system.slope.shape[0], dtype=damping.dtype)
    matrix = system.matrix * (1.0 + damping * unit) + ridge * unit
    factor = jax.lax.linalg.cholesky(matrix, symmetrize_input=False)
    step = jax.lax.linalg.triangular_solve(
        factor, -system.slope[:, None], left_side=True, lower=True
    )
    step = jax.lax.linalg.triangular_solve(
        factor, step, left_side=True, lower=True, transpose_a=True
    )
    return jnp.clip(step[:, 0], -longest, longest)


def resolved(
    mu: Float[Array, "K 3"],
    directions: Float[Array, "N 3"],
    solid_angles: Float[Array, " N"],
    sharpest: float,
) -> Float[Array, " K"]:
    """Largest concentrations of lobes that nodes can see, at most `sharpest`.

    2 pi over the solid angle of the node nearest to each axis, so that the solid angle of the
    lobe, 2 pi / kappa, is that of the cell. A sharper lobe hides between nodes, at no cost to
    the residual and at any to the function.
    """
    nearest = jnp.argmin(vmf.complement(directions[None], mu[:, None]), -1)
    cell = jnp.maximum(solid_angles[nearest], TWO_PI / sharpest)
    return TWO_PI / cell


class Progress(NamedTuple):
    """State of `levenberg_marquardt`, to go on from.

    Attributes
    ----------
    at, system
        The best parameters so far and their normal equations.
    damping
        Marquardt's factor for the next step.
    """

    at: Parameters
    system: System
    damping: Float[Array, ""]


def begin(at: Parameters, base: Base, given: Problem, *, signed: bool) -> Progress:
    """The state before the first step."""
    system = normal_equations(*residuals(at, base, given, signed=signed))
    return Progress(at, system, jnp.full_like(system.cost, 1e-2))


def moved(at: Parameters, step: Float[Array, " P"], sharpest: Ends, *, signed: bool) -> Parameters:
    """Parameters after a step, kept in the range of concentrations (and of logs of weights)."""
    weight, log_kappa, first, second = step.reshape(4, -1)
    weight = at.weight + weight
    return Parameters(
        weight if signed else jnp.clip(weight, -30.0, 10.0),
        jnp.clip(at.log_kappa + log_kappa, math.log(FLATTEST), jnp.log(sharpest)),
        at.offset + jnp.stack([first, second]),
    )


def levenberg_marquardt(
    state: Progress,
    base: Base,
    given: Problem,
    steps: int,
    sharpest: Ends,
    *,
    signed: bool,
) -> Progress:
    """A fixed number of Levenberg-Marquardt steps; the cost never rises.

    The damping falls to a fifth after a step that lowers the cost and grows sixfold after
    one that does not (or is not finite). Normal equations: their condition is the square of
    that of the Jacobian, which the damping and four well-scaled parameters a lobe allow.

    Parameters
    ----------
    state
        From `begin`, or from an earlier call.
    base, given
        See `parameters` and `problem`.
    steps
        How many steps; fixed, since under `jax.vmap` a loop with a condition runs to its
        slowest problem.
    sharpest
        Largest concentration of each lobe, see `resolved`.
    signed
        Whether weights may be negative.
    """

    def one(_: Any, state: Progress) -> Progress:
        at = moved(state.at, damped_step(state.system, state.damping), sharpest, signed=signed)
        system = normal_equations(*residuals(at, base, given, signed=signed))
        better = system.cost < state.system.cost
        damping = jnp.clip(state.damping * jnp.where(better, 0.2, 6.0), 1e-9, 1e6)
        kept = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (at, system), (state.at, state.system)
        )
        return Progress(kept[0], kept[1], damping)

    return jax.lax.fori_loop(0, steps, one, state)


def best_weights(
    values: Float[Array, "N C"],
    solid_angles: Float[Array, " N"],
    directions: Float[Array, "N 3"],
    mu: Float[Array, "K 3"],
    kappa: Float[Array, " K"],
    *,
    signed: bool,
) -> Float[Array, "K C"]:
    """Integrals of given lobes that approach each channel best in the square.

    Without `signed` they are >= 0, by coordinate descent from the free solution.
    """
    shape = jnp.exp(
        vmf.log_peak(kappa)[:, None]
        - kappa[:, None] * vmf.complement(directions[None], mu[:, None])
    )
    exact = jax.lax.Precision.HIGHEST
    weighed = shape * solid_angles[None]
    size = jnp.sqrt((weighed * shape).sum(-1))
    matrix = jnp.matmul(weighed, shape.T, precision=exact) / (size[:, None] * size[None])
    count = kappa.shape[0]
    matrix = matrix + (1e-6 if matrix.dtype == jnp.float32 else 1e-12) * jnp.eye(
        count, dtype=matrix.dtype
    )
    right = jnp.matmul(weighed, values, precision=exact) / size[:, None]
    found = jax.scipy.linalg.solve(matrix, right, assume_a="pos")
    if not signed:

        def sweep(_: Any, x: Array) -> Array:
            for k in range(count):  # Gauss-Seidel over a small static count
                rest = right[k] - matrix[k] @ x + matrix[k, k] * x[k]
                x = x.at[k].set(jnp.maximum(rest / matrix[k, k], 0.0))
            return x

        found = jax.lax.fori_loop(0, 30, sweep, jnp.maximum(found, 0.0))
    return found / size[:, None]


def restored(
    alpha: Float[Array, "K C"],
    whole: Float[Array, " C"],
    mu: Float[Array, "K 3"],
    kappa: Float[Array, " K"],
    *,
    signed: bool,
) -> Float[Array, "K C"]:
    """Integrals of lobes changed to add up to a whole, with the least change of the function.

    The change of least L2 norm is ``G^-1 1`` times what is missing over ``1 . G^-1 1``, with G
    the inner products of the lobes: wide lobes give and take, peaks stay. Where a weight
    would fall below 0 and may not, all are scaled by one factor instead.
    """
    gram = jnp.exp(vmf_pairs.log_inner(mu[:, None], kappa[:, None], mu[None], kappa[None]))
    size = jnp.sqrt(jnp.diagonal(gram))
    ridge = (1e-5 if gram.dtype == jnp.float32 else 1e-12) * jnp.eye(
        size.shape[0], dtype=gram.dtype
    )
    share = jax.scipy.linalg.solve(
        gram / (size[:, None] * size[None]) + ridge, 1.0 / size, assume_a="pos"
    )
    share = share / size
    moved = alpha + share[:, None] * ((whole - alpha.sum(0)) / share.sum())[None]
    # Once more: the solve is only as good as the lobes are unlike each other.
    moved = moved + share[:, None] * ((whole - moved.sum(0)) / share.sum())[None]
    total = alpha.sum(0)
    some = (total != 0.0) & (whole != 0.0)
    scaled = alpha * jnp.where(some, whole / jnp.where(some, total, 1.0), 1.0)[None]
    fits = jnp.isfinite(moved).all(0) & (signed | (moved >= 0.0).all(0))
    return jnp.where(fits[None], moved, scaled)
