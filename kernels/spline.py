"""Interpolation by B-splines on a regular grid: prefilter, lookup, and error bounds.

A prefiltered B-spline of order p (degree) passes through the samples and, for smooth
functions, errs by O(step^(p+1)); its values are sums of (p+1) coefficients on each axis, so
that a lookup stays local. Source: M. Unser, Splines: a perfect fit for signal and image
processing, IEEE Signal Processing Magazine 16(6), 1999 (its eq. 7 for the prefilter, box 2
for the frequency response).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

ORDERS = (1, 2, 3)
# The inverse of the sampled B-spline falls as pole^|k|.
_POLE = {1: 0.0, 2: math.sqrt(8.0) - 3.0, 3: math.sqrt(3.0) - 2.0}
# The error of a mixture of positive Gaussians, relative to its largest value nearby, over
# `gaussian_error`: at most 1.21 up to a step of 0.9 (found by linear programming, which a
# test repeats).
LOCAL = 1.25


def decay(order: int) -> float:
    """Factor by which the influence of a sample falls with each step of the grid."""
    return abs(_POLE[order])


def prefilter(values: Float[Array, "..."], *, axis: int, order: int) -> Float[Array, "..."]:
    """B-spline coefficients of samples along an axis, which is continued by reflection.

    Parameters
    ----------
    values
        Samples, any shape.
    axis
        The axis that is filtered; at least two samples for orders above 1.
    order
        Degree of the spline, one of `ORDERS`.
    """
    if order == 1:
        return values
    pole = _POLE[order]
    x = jnp.moveaxis(values, axis, 0)
    count = x.shape[0]
    # The sum over all reflections of the samples, to below the last place.
    eps = float(jnp.finfo(values.dtype).eps)
    horizon = math.ceil(math.log(0.1 * eps) / math.log(-pole))
    place = np.arange(horizon) % (2 * count - 2)
    place = np.minimum(place, 2 * count - 2 - place)
    powers = jnp.asarray(pole ** np.arange(horizon), values.dtype)
    start = jnp.tensordot(powers, x[place], axes=1)

    def forward(previous, sample):
        current = sample + pole * previous
        return current, current

    def backward(following, value):
        current = pole * (following - value)
        return current, current

    _, rest = jax.lax.scan(forward, start, x[1:])
    causal = jnp.concatenate([start[None], rest])
    end = pole / (pole * pole - 1.0) * (causal[-1] + pole * causal[-2])
    _, rest = jax.lax.scan(backward, end, causal[:-1], reverse=True)
    gain = (1.0 - pole) * (1.0 - 1.0 / pole)
    return jnp.moveaxis(gain * jnp.concatenate([rest, end[None]]), 0, axis)


def weights(t: Float[Array, "..."], order: int) -> tuple[Float[Array, "..."], ...]:
    """The order + 1 B-spline weights at a fraction of a step, see `locate`."""
    if order == 1:
        return 1.0 - t, t
    if order == 2:
        return 0.5 * (0.5 - t) ** 2, 0.75 - t * t, 0.5 * (0.5 + t) ** 2
    s = 1.0 - t
    return (
        s * s * s / 6.0,
        2.0 / 3.0 - t * t * (1.0 - 0.5 * t),
        2.0 / 3.0 - s * s * (1.0 - 0.5 * s),
        t * t * t / 6.0,
    )


def locate(
    x: Float[Array, "..."], count: int, order: int
) -> tuple[Int[Array, "..."], Float[Array, "..."]]:
    """First coefficient of a lookup and the fraction of a step that `weights` wants.

    Parameters
    ----------
    x
        Place in steps from the first coefficient.
    count
        Coefficients on the axis; places whose weights would reach beyond them are served
        by the last ones inside.
    order
        Degree of the spline.
    """
    # Odd orders have their knots on the samples, even ones between them.
    base = jnp.floor(x + 0.5) if order == 2 else jnp.floor(x)
    below = (order - 1) // 2 if order != 2 else 1
    first = jnp.clip(jax.lax.stop_gradient(base).astype(jnp.int32) - below, 0, count - order - 1)
    return first, x - (first + below).astype(x.dtype)


def lookup(
    table: Float[Array, "V U W K"],
    x: Float[Array, " M"],
    y: Float[Array, " M"],
    z: Float[Array, " M"],
    *,
    order: int,
) -> Float[Array, "M K"]:
    """Values of a table of coefficients at M places.

    Parameters
    ----------
    table
        Coefficients over (y, x, z), `order` in y and x, cubic in z, for K channels.
    x, y, z
        Places in steps from the first coefficient of their axis.
    order
        Degree in x and y.
    """
    rows, columns, depth, channels = table.shape
    i, tx = locate(x, columns, order)
    j, ty = locate(y, rows, order)
    k, tz = locate(z, depth, 3)
    # The four coefficients along z lie side by side: one contiguous run for each (y, x).
    run = 4 * channels
    base = ((j * columns + i) * depth + k) * channels
    numbers = jax.lax.GatherDimensionNumbers(
        offset_dims=(1,), collapsed_slice_dims=(), start_index_map=(0,)
    )
    total = jnp.zeros((x.shape[0], run), table.dtype)
    # Unrolled on purpose: one fused loop over the places, which no batched slice gives.
    for b, weight_y in enumerate(weights(ty, order)):
        for a, weight_x in enumerate(weights(tx, order)):
            start = base + (b * columns + a) * (depth * channels)
            values = jax.lax.gather(
                table.reshape(-1), start[:, None], numbers, (run,), mode="promise_in_bounds"
            )
            total = total + values * (weight_y * weight_x)[:, None]
    runs = total.reshape(-1, 4, channels)
    parts = [runs[:, c] * weight[:, None] for c, weight in enumerate(weights(tz, 3))]
    return parts[0] + parts[1] + parts[2] + parts[3]


def frequency_error(theta: np.ndarray, order: int) -> np.ndarray:
    """Largest error of interpolating exp(i theta x) from its integer samples.

    The interpolant is exp(i theta x) sum_k eta(theta + 2 pi k) exp(2 pi i k x) with eta the
    transform of the cardinal spline, which sums to 1: the error is at most
    |1 - eta(theta)| + sum_k |eta(theta + 2 pi k)|. Beyond half a cycle per step the samples
    say nothing: 2.

    Parameters
    ----------
    theta
        Radians per step, any shape.
    order
        Degree of the spline.
    """
    theta = np.abs(np.asarray(theta, np.float64))
    k = np.arange(-12, 13)
    shifted = np.minimum(theta, math.pi)[..., None] / (2.0 * math.pi) + k
    response = np.sinc(shifted) ** (order + 1)
    eta = response / response.sum(-1, keepdims=True)
    aliases = np.abs(eta).sum(-1) - np.abs(eta[..., 12])
    return np.where(theta < math.pi, np.abs(1.0 - eta[..., 12]) + aliases, 2.0)


@functools.lru_cache(maxsize=1024)
def gaussian_error(ratio: float, order: int) -> float:
    """Bound on the error of interpolating any unit-mass mixture of waves under a Gaussian.

    A function whose spectrum is bounded by that of exp(-x^2 / 2), of peak 1: the Gaussian
    itself, or a mixture of shifted ones with weights that sum to 1. The integral of
    `frequency_error` over its spectrum.

    Parameters
    ----------
    ratio
        Step over the standard deviation, > 0.
    order
        Degree of the spline.
    """
    at, step = np.linspace(0.0, 9.0, 601, retstep=True)
    density = np.exp(-0.5 * at**2) * math.sqrt(2.0 / math.pi)
    density[0] *= 0.5
    return float((density * frequency_error(at * ratio, order)).sum() * step)


@functools.lru_cache(maxsize=1024)
def gaussian_slope_error(ratio: float, order: int) -> float:
    """As `gaussian_error`, for the derivative, over the steepest slope exp(-1/2).

    The aliases of `frequency_error` come with their own frequencies.

    Parameters
    ----------
    ratio
        Step over the standard deviation, > 0.
    order
        Degree of the spline, 2 or 3: the derivative of order 1 jumps.
    """
    at, step = np.linspace(0.0, 9.0, 601, retstep=True)
    density = np.exp(-0.5 * at**2) * math.sqrt(2.0 / math.pi)
    theta = at * ratio
    k = np.arange(-60, 61)
    shifted = np.minimum(theta, math.pi)[:, None] / (2.0 * math.pi) + k
    response = np.sinc(shifted) ** (order + 1)
    eta = response / response.sum(-1, keepdims=True)
    frequency = 2.0 * math.pi / ratio * np.abs(shifted)
    aliases = (frequency * np.abs(eta)).sum(-1) - frequency[:, 60] * np.abs(eta[:, 60])
    error = at * np.abs(1.0 - eta[:, 60]) + aliases
    return float((density * np.where(theta < math.pi, error, 2.0 * at)).sum() * step * math.e**0.5)


def complete_error(theta: float) -> float:
    """Bound for cubic splines with given end slopes, for functions of band `theta`.

    5/384 step^4 |f''''| (C. A. Hall and W. W. Meyer, Optimal error bounds for cubic spline
    interpolation, J. Approximation Theory 16, 1976), |f''''| <= theta^4 for an average of
    exp(i theta' x) with |theta'| <= theta radians per step.
    """
    return 5.0 / 384.0 * theta**4


def from_chebyshev(nodes: int, intervals: int) -> np.ndarray:
    """Matrix from values at Chebyshev points to cubic spline coefficients over [-1, 1].

    The spline interpolates the polynomial through the values at intervals + 1 places and
    takes its slopes at both ends.

    Parameters
    ----------
    nodes
        First-kind Chebyshev points, see `diffopt.kernels.phase.chebyshev_points`.
    intervals
        Number of steps, >= 1.

    Returns
    -------
    ndarray
        [intervals + 3, nodes], float64; the coefficient of index 1 belongs to -1.
    """
    angle = math.pi * (np.arange(nodes) + 0.5) / nodes
    degree = np.arange(nodes)
    # Values to Chebyshev coefficients.
    to_series = np.cos(degree[:, None] * angle[None, :]) * (2.0 / nodes)
    to_series[0] *= 0.5
    places = np.linspace(-1.0, 1.0, intervals + 1)
    values = np.polynomial.chebyshev.chebvander(places, nodes - 1)
    # T_n'(1) = n^2, T_n'(-1) = (-1)^(n + 1) n^2, per step of 2 / intervals.
    slope = degree**2 * (2.0 / intervals)
    ends = np.stack([slope * np.where(degree % 2, 1.0, -1.0), slope])
    right = np.concatenate([values, ends]) @ to_series
    system = np.zeros((intervals + 3, intervals + 3))
    for row in range(intervals + 1):
        system[row, row : row + 3] = 1.0 / 6.0, 2.0 / 3.0, 1.0 / 6.0
    system[-2, [0, 2]] = -0.5, 0.5
    system[-1, [-3, -1]] = -0.5, 0.5
    return np.linalg.solve(system, right)
