"""The windowed transform as matrix products, interpolated between heights of phase.

|P|^2 depends on w only through exp(2 pi i s (h - hc)), which is smooth: it is evaluated at
a few Chebyshev points in s = w / wavelength, where it becomes a pair of matrix products
over all directions at once, and interpolated to each direction's own s. The error is
bounded beforehand by `diffopt.kernels.phase.chebyshev_bound`.

One wavelength a call; `diffopt.diffraction` scans over wavelengths.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels.dtft import power_spectrum
from diffopt.kernels.phase import chebyshev_points, chebyshev_weights, cis_turns


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision="highest")


def _interval(s: Array, nodes: int) -> tuple[Array, Array]:
    """Chebyshev points over the range of s, and s mapped to [-1, 1]."""
    low, high = jax.lax.stop_gradient((s.min(), s.max()))
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    # A job at a single s has an interval of no width: every point is its middle.
    t = (s - middle) / jnp.where(half > 0, half, 1.0)
    return chebyshev_points(nodes, s.dtype) * half + middle, t


def contract(ay: Array, p: tuple[Array, Array], ax: Array, grid: bool) -> tuple[Array, Array]:
    """a_y p a_x for complex factors [2, V, ny], [2, U, nx]: outer (grid) or row by row."""
    c, s = p
    re = _product(ay[0], c) - _product(ay[1], s)
    im = _product(ay[0], s) + _product(ay[1], c)
    if grid:
        return (
            _product(re, ax[0].T) - _product(im, ax[1].T),
            _product(re, ax[1].T) + _product(im, ax[0].T),
        )
    return (re * ax[0] - im * ax[1]).sum(-1), (re * ax[1] + im * ax[0]).sum(-1)


def coherent(
    heights: Float[Array, "ny nx"],
    s: Float[Array, "*out"],
    ax: Float[Array, "2 U nx"],
    ay: Float[Array, "2 V ny"],
    *,
    nodes: int,
    grid: bool,
) -> Float[Array, "*out"]:
    """|P|^2 of one window for many directions at one wavelength.

    Parameters
    ----------
    heights
        Heights in micrometres, [ny, nx].
    s
        w / wavelength of each direction, cycles per micrometre: [M], or [V, U] on a grid.
    ax, ay
        Axis factors (`diffopt.kernels.dtft`): of each pair, [2, M, n], or of each grid line.
    nodes
        Chebyshev points in s.
    grid
        Whether directions are the outer product of the lines of `ay` and `ax`.
    """
    at, t = _interval(s, nodes)
    # It cancels, and has no slope.
    held = jax.lax.stop_gradient(heights)
    centre = 0.5 * (held.max() + held.min())

    def evaluate(s_node):
        return contract(ay, cis_turns(s_node * (heights - centre)), ax, grid)

    re, im = jax.lax.map(jax.checkpoint(evaluate, prevent_cse=False), at)
    weights = jnp.moveaxis(chebyshev_weights(t, nodes), -1, 0)
    return (weights * re).sum(0) ** 2 + (weights * im).sum(0) ** 2


def averaged(
    heights: Float[Array, "ny nx"],
    s: Float[Array, "*out"],
    wx: Float[Array, "U nx"],
    wy: Float[Array, "V ny"],
    *,
    nodes: int,
    grid: bool,
    drop_mean: bool = False,
) -> Float[Array, "*out"]:
    """|P|^2 averaged over window positions; arguments as in `coherent`, real bin weights.

    `drop_mean` leaves out the zero order |c_00|^2 (the mirror part).
    """
    at, t = _interval(s, nodes)

    def evaluate(s_node):
        rows = _product(wy, power_spectrum(heights, s_node, drop_mean=drop_mean))
        return _product(rows, wx.T) if grid else (rows * wx).sum(-1)

    values = jax.lax.map(jax.checkpoint(evaluate, prevent_cse=False), at)
    weights = jnp.moveaxis(chebyshev_weights(t, nodes), -1, 0)
    return (weights * values).sum(0)
