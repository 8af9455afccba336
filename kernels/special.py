"""Special functions in forms that stay finite, with their gradients."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels.phase import TWO_PI, cis_turns

# Of the series of sin(pi x)/(pi x): the first omitted term at |x| = 1/2 is 8e-19.
_SINC_TERMS = 11


def sinc(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """sin(pi x) / (pi x), with value and gradient right down to x = 0.

    A series inside |x| < 1/2: the slope of the quotient loses eps / x^2 there (jnp.sinc
    at 1e-9 has a slope of the wrong size).
    """
    small = jnp.abs(x) < 0.5
    square = jnp.where(small, x, 0.0) ** 2 * (math.pi**2)
    series = jnp.ones_like(x)
    for n in reversed(range(1, _SINC_TERMS)):  # Horner over a small static count
        series = 1.0 - square / ((2 * n) * (2 * n + 1)) * series
    _, sin = cis_turns(0.5 * x)
    return jnp.where(small, series, sin / (0.5 * TWO_PI * jnp.where(small, 1.0, x)))


def dirichlet(
    turns: Float[Array, "..."], copies: int
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Array factor of `copies` equal cells: the mean of exp(2 pi i q t), q = 0 .. copies - 1.

    ``D/N = exp(i pi (N-1) t) sinc(N t)/sinc(t)`` with t reduced to [-1/2, 1/2], where both
    normalised sincs have their limits: no 0/0 at the orders (t integer), where the
    thesis's form (its eq. 30, 31) is undefined.

    Parameters
    ----------
    turns
        Phase step from one cell to the next, in turns.
    copies
        Number of cells N, >= 1.

    Returns
    -------
    tuple
        Real and imaginary part; 1 and 0 at an order.
    """
    t = turns - jnp.round(turns)
    size = sinc(copies * t) / sinc(t)
    cos, sin = cis_turns(0.5 * (copies - 1) * t)
    return cos * size, sin * size
