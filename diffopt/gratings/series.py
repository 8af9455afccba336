"""Lines spread by a random phase of Gaussian correlation."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.gratings.base import Components
from diffopt.kernels.ensemble import poisson_terms

# The largest term of g = 1e4 to 6e-4 of itself, 6e-2 of the bell's width; 6 widths on either
# side leave 2e-9.
_HALVINGS, _WIDTHS = 14, 12.0


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
    a = (jnp.pi * length) ** 2 * square
    n, weight = poisson_terms(g, a, terms, widths=_WIDTHS, halvings=_HALVINGS)
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
