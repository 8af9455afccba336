"""Expansions of exp(2 pi i s h) in s over an interval, from its values at a few points.

``exp(2 pi i s (h - hc)) = exp(2 pi i s_m (h - hc)) exp(i z x t)``: s_m is the middle of the
interval of s, the carrier in front keeps, and x = (s - s_m) / s_h and t = (h - hc) / H in
[-1, 1], ``z = 2 pi s_h H``, with s_h and H half of the ranges of s and of h. Whatever is
linear in exp(2 pi i s h), such as a Fourier coefficient c_rs(s) times exp(-2 pi i s hc), is
therefore a mixture of exp(i z x t), and so is |c_rs(s)|^2, with twice the z: two functions
of x for all surfaces. Both expansions have the form

``F(x) = sum_n a_n(x) sum_j projection[n, j] F(x_j)``

with real functions a_n and real weights at Chebyshev points x_j: tables hold the second sum,
a direction and a wavelength enter through the first. Neither loses anything to cancellation,
however deep the surface; the Taylor series does.

- Chebyshev: a_n = T_n, interpolation; bound `diffopt.kernels.phase.chebyshev_bound`.
- low rank: a_n the left singular functions of exp(i z x t) (close to prolate spheroidal
  functions: Slepian and Pollak, Bell Syst. Tech. J. 40, 1961), the fewest terms that any
  expansion can have; bound `lowrank_bound`.
- Taylor: a_n = (2 pi s H)^n / n!, the diffraction thesis's; bound
  `diffopt.kernels.phase.taylor_bound`.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import phase


def interval(
    low: Float[Array, ""], high: Float[Array, ""], span: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Middle and half width of the interval of s on which to expand, cycles per micrometre.

    A single s, or a narrow range, gets an interval on which the phase sweeps half a radian
    to either side (z = 0.5), or one as wide as s for heights too flat for that: on less, the
    derivative to s would be the rounding of the terms over the width. Nothing passes a
    derivative on: what is expanded does not depend on the interval.

    Parameters
    ----------
    low, high
        Range of s.
    span
        Range of the heights, micrometres.
    """
    low, high, span = jax.lax.stop_gradient((low, high, span))
    middle = 0.5 * (low + high)
    size = 1.0 + jnp.abs(middle)
    least = size / jnp.maximum(1.0, phase.TWO_PI * span * size)
    return middle, jnp.maximum(0.5 * (high - low), least)


def chebyshev_projection(nodes: int, dtype) -> Float[Array, "nodes nodes"]:
    """Chebyshev coefficients from values at `diffopt.kernels.phase.chebyshev_points`."""
    # In float64 NumPy: the same for every input, rounded once.
    return jnp.asarray(_projection(nodes), dtype)


def _projection(nodes: int) -> np.ndarray:
    n = np.arange(nodes)
    weights = np.cos(math.pi * n[:, None] * (n[None, :] + 0.5) / nodes) * (2.0 / nodes)
    weights[0] *= 0.5
    return weights


def lowrank_nodes(terms: int) -> int:
    """Points in s from which the tables of a low-rank expansion are made.

    The Chebyshev series needs up to 1.6 times as many terms as the low-rank expansion.
    """
    return (3 * terms) // 2 + 6


def lowrank_series(z: Float[Array, ""], terms: int) -> Float[Array, "terms nodes"]:
    """The functions a_n of the low-rank expansion: Chebyshev series with orthonormal rows.

    Left singular vectors of the Chebyshev coefficients of exp(i z x t), largest singular
    values first. They pass no derivative to z on: other functions would expand as well.

    Parameters
    ----------
    z
        Half the phase swept, radians: pi / 2 times (range of s) times (range of heights),
        twice that for |c|^2.
    terms
        Number of functions.

    Returns
    -------
    Array
        ``a_n(x) = sum_m series[n, m] T_m(x)``; nodes is `lowrank_nodes`. The transpose
        projects back: ``series @ chebyshev_projection`` takes values at the points to
        coefficients.
    """
    nodes = lowrank_nodes(terms)
    points = np.cos(math.pi * (np.arange(nodes) + 0.5) / nodes)
    products = jnp.asarray(np.outer(points, points) / phase.TWO_PI, z.dtype)
    cos, sin = phase.cis_turns(jax.lax.stop_gradient(z) * products)
    project = chebyshev_projection(nodes, z.dtype)
    # Even and odd terms never mix: the coefficients of cos and i sin in one real matrix.
    matrix = jnp.matmul(
        jnp.matmul(project, cos + sin, precision="highest"), project.T, precision="highest"
    )
    u, _, _ = jnp.linalg.svd(matrix)
    return u[:, :terms].T


def coefficients(
    x: Float[Array, "*batch"], terms: int, series: Float[Array, "terms nodes"] | None = None
) -> Float[Array, "*batch terms"]:
    """The functions a_n at x: Chebyshev polynomials, or series in them.

    Parameters
    ----------
    x
        (s - s_m) / s_h. Beyond [-1, 1] (by more than 1 %, for rounding) the value at the
        end is taken, without a slope: polynomials explode there.
    terms
        Number of functions.
    series
        From `lowrank_series`; None for the polynomials themselves.
    """
    x = jnp.where(jnp.abs(x) <= 1.01, x, jnp.sign(x))
    if series is None:
        return phase.chebyshev_polynomials(x, terms)
    rows = phase.chebyshev_rows(x, series.shape[1])
    return jnp.moveaxis(jnp.tensordot(series, rows, 1, precision="highest"), 0, -1)


def taylor_coefficients(
    argument: Float[Array, "*batch"], terms: int
) -> Float[Array, "*batch terms"]:
    """x^n / n!, n = 0 .. terms - 1; the powers of i are with the tables."""
    n = jnp.arange(1, terms, dtype=argument.dtype).reshape((1,) * argument.ndim + (-1,))
    ratios = jnp.concatenate([jnp.ones_like(argument)[..., None], argument[..., None] / n], -1)
    return jnp.cumprod(ratios, -1)


@functools.lru_cache(maxsize=4096)
def lowrank_bound(z: float, terms: int) -> float:
    """Bound on the error of the low-rank expansion of exp(i z x t), |x|, |t| <= 1.

    It holds for the expansion as it is made, from values at `lowrank_nodes` points, and for
    any average of such functions of the same z. The error is a polynomial of degree N in x
    and in t, but for 1e-16: its largest value on the product of m-point Chebyshev grids,
    m = 3 N, over cos(pi N / 2 m)^2 = 3/4 (Ehlich and Zeller, Math. Z. 86, 1964), bounds it
    everywhere.

    Parameters
    ----------
    z
        As in `lowrank_series`, radians, >= 0.
    terms
        Number of terms, >= 1.
    """
    if z == 0.0:
        return 0.0
    nodes = lowrank_nodes(terms)
    degree = max(nodes, phase.chebyshev_nodes(z, 1e-16))
    points = np.cos(math.pi * (np.arange(nodes) + 0.5) / nodes)
    project = _projection(nodes)
    matrix = np.outer(points, points) * z
    u = np.linalg.svd(project @ (np.cos(matrix) + np.sin(matrix)) @ project.T)[0][:, :terms]
    grid = np.cos(math.pi * (np.arange(3 * degree) + 0.5) / (3 * degree))
    # The error at -x or -t is that at x, t, or its conjugate: one quadrant is enough.
    grid = grid[grid >= 0.0]
    functions = np.cos(np.arange(nodes) * np.arccos(grid)[:, None]) @ u
    at_points = np.exp(1j * z * np.outer(points, grid))
    error = np.exp(1j * z * np.outer(grid, grid)) - functions @ (u.T @ project) @ at_points
    # Rounding of this very calculation, and the tail beyond the degree.
    return float(np.abs(error).max()) * 4.0 / 3.0 + 1e-15 * (4.0 + z)


def lowrank_terms(z: float, error: float) -> int:
    """Smallest number of terms whose `lowrank_bound` is at most `error`.

    Raises
    ------
    ValueError
        If rounding of the bound itself, 1e-15 (4 + z), exceeds the error.
    """
    if z == 0.0 or error >= 2.0:
        return 1
    if error <= 2e-15 * (4.0 + z):
        raise ValueError(f"error must exceed {2e-15 * (4.0 + z):.1e} at z = {z:g}; got {error:g}")
    # About 2 z / pi singular values are large: gallop from there, then halve.
    high, step = max(1, int(2.0 * z / math.pi)), 1
    low = 0 if high == 1 or lowrank_bound(z, high) <= error else high
    while lowrank_bound(z, high) > error:
        low, high, step = high, high + step, 2 * step
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if lowrank_bound(z, middle) <= error else (middle, high)
    return high
