"""Special functions in forms that stay finite, with their gradients."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels.phase import cis_turns


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
    size = jnp.sinc(copies * t) / jnp.sinc(t)
    cos, sin = cis_turns(0.5 * (copies - 1) * t)
    return cos * size, sin * size
