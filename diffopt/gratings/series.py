"""Lines spread by a random phase of Gaussian correlation."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.gratings.base import Components
from diffopt.kernels.ensemble import log_poisson

# Halvings of the interval in which the largest term is looked for, in its logarithm.
_HALVINGS = 14


def displaced(
    lines: Components,
    variance: Float[Array, " K *batch"],
    length: Float[Array, ""],
    terms: int,
) -> Components:
    """Components multiplied by exp(i phi), phi a Gaussian field of a variance for each of them.

    With the correlation exp(-r^2 / l^2) of phi and g its variance, each becomes itself times
    exp(-g) and the Gaussians n = 1, 2, ... of weight exp(-g) g^n / n! and of variance
    n / (2 pi^2 l^2) per axis. `terms` of these are summed, about the largest of them at that
    frequency; where more matter, every second, third, ... n (a trapezoid rule that is exact
    to rounding for a smooth bell).

    Parameters
    ----------
    lines
        [K, ...].
    variance
        g in square radians, [K, ...].
    length
        l in micrometres.
    terms
        Static number of Gaussians; [K (1 + terms), ...] come back.
    """
    g = jnp.maximum(variance, jnp.finfo(variance.dtype).tiny * 1e3)
    square = lines.x**2 + lines.y**2
    n, step = jax.lax.stop_gradient(_window(g, (jnp.pi * length) ** 2 * square, terms))
    weight = step[None] * jnp.exp(log_poisson(n, g[None]))
    per_axis = n / (2.0 * (jnp.pi * length) ** 2)

    def joined(first: Array, others: Array) -> Array:
        others = jnp.broadcast_to(others, weight.shape)
        return jnp.concatenate([first, others.reshape(-1, *first.shape[1:])])

    return Components(
        joined(lines.weight * jnp.exp(-g), lines.weight[None] * weight),
        joined(lines.x, lines.x[None]),
        joined(lines.y, lines.y[None]),
        joined(lines.xx, lines.xx[None] + per_axis),
        joined(lines.xy, lines.xy[None]),
        joined(lines.yy, lines.yy[None] + per_axis),
        lines.density,
    )


def _window(g: Array, a: Array, terms: int) -> tuple[Array, Array]:
    """The n of the terms that matter, [terms, K, ...], and their step, [K, ...]."""

    def slope(n):
        return jnp.log(g / n) + a / n**2 - 1.5 / n

    def halve(_, ends):
        low, high = ends
        middle = jnp.sqrt(low * high)
        up = slope(middle) > 0
        return jnp.where(up, middle, low), jnp.where(up, high, middle)

    ends = (jnp.ones_like(g), 2.0 * (g + jnp.sqrt(a) + 10.0))
    peak, _ = jax.lax.fori_loop(0, _HALVINGS, halve, ends)
    width = 1.0 / jnp.sqrt(1.0 / peak + 2.0 * a / peak**3)
    step = jnp.maximum(1.0, jnp.ceil(12.0 * width / terms))
    first = jnp.maximum(1.0, jnp.floor(peak - 0.5 * terms * step))
    count = jnp.arange(terms, dtype=g.dtype).reshape((terms,) + (1,) * g.ndim)
    return first[None] + step[None] * count, step
