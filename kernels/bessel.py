"""Bessel functions of integer order, a whole sequence at once.

The trapezoid rule on Bessel's integral (DLMF 10.9.2) converges on periodic functions faster
than any power: with n nodes the error of J_m(z) is the sum of J_(n k - m)(z) over k > 0,
rounding once |m| + |z| is some 25 below n.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int


def sequence_nodes(highest: int, reach: float) -> int:
    """Nodes that give J_0 to J_highest to rounding for abs(z) up to `reach`."""
    # J_n(z) falls below 1e-17 some 6 z^(1/3) + 25 past its turning point n = z.
    need = highest + reach + 6.0 * reach ** (1.0 / 3.0) + 25.0
    return 4 * math.ceil(need / 4.0)


def bessel_sequence(
    z: Float[Array, "*batch"], highest: int, *, nodes: int
) -> Float[Array, " orders *batch"]:
    """J_0(z) to J_highest(z), by one matrix product for all arguments.

    Parameters
    ----------
    z
        Arguments, [...].
    highest
        Last order; [highest + 1, ...] come back.
    nodes
        See `sequence_nodes`; a multiple of 4.
    """
    quarter = nodes // 4
    # By symmetry only a quarter of the circle is needed: its ends count half.
    t = 2.0 * np.pi * np.arange(quarter + 1) / nodes
    share = np.full(quarter + 1, 4.0 / nodes)
    share[[0, -1]] /= 2.0
    m = np.arange(highest + 1)
    even = np.where(m % 2 == 0, np.cos(m * t[:, None]), 0.0) * share[:, None]
    odd = np.where(m % 2 == 1, np.sin(m * t[:, None]), 0.0) * share[:, None]
    phase = z.reshape(-1, 1) * jnp.asarray(np.sin(t)[None, :], z.dtype)

    def summed(parts: Array, table: np.ndarray) -> Array:
        return jnp.matmul(jnp.asarray(table.T, z.dtype), parts.T, precision="highest")

    found = summed(jnp.cos(phase), even) + summed(jnp.sin(phase), odd)
    return found.reshape(highest + 1, *z.shape)


def signed(
    values: Float[Array, " orders *batch"], order: Int[Array, " K *batch"]
) -> Float[Array, " K *batch"]:
    """J_m of a sequence for orders of either sign; 0 beyond its end.

    Parameters
    ----------
    values
        Of `bessel_sequence`, [highest + 1, ...].
    order
        m, [K, ...].
    """
    highest = values.shape[0] - 1
    size = jnp.abs(order)
    picked = jnp.take_along_axis(values, jnp.minimum(size, highest), axis=0)
    sign = jnp.where((order < 0) & (order % 2 != 0), -1.0, 1.0).astype(values.dtype)
    return jnp.where(size <= highest, sign * picked, jnp.zeros_like(picked))
