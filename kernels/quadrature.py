"""Quadratures of the whole sphere that gather their nodes about an axis."""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import frames
from diffopt.kernels.phase import cis_turns


def polar_grid(
    axis: Float[Array, "3"], rings: int, sectors: int, core: Float[Array, ""] | None = None
) -> tuple[Float[Array, "N 3"], Float[Array, " N"]]:
    """Nodes about an axis: Gauss-Legendre in x = sin(theta / 2), equal steps of azimuth.

    Solid angles are ``4 x dx dphi``: rings crowd about the axis, where a lobe has its peak,
    and reach the opposite pole, so that what a fit puts below the horizon counts. With
    32 x 48 nodes the L2 norm of the cosine-weighted lobes of Blinn-Phong up to exponent 128
    is right to 4e-4, at 80 degrees too, if the axis is their mean direction.

    Parameters
    ----------
    axis
        Unit vector.
    rings, sectors
        Number of polar angles and of azimuths; N is their product.
    core
        Sine of half the angle within which the rings are to crowd, > 0: x is the core times
        sinh of what the nodes are even in, so that sharp lobes keep several rings. None: no
        crowding beyond x.

    Returns
    -------
    tuple
        ``(directions, solid_angles)``; the solid angles add up to 4 pi.
    """
    y, dy = np.polynomial.legendre.leggauss(rings)
    y, dy = (jnp.asarray(a, axis.dtype) for a in (0.5 + 0.5 * y, 0.5 * dy))
    if core is None:
        x, dx = y, dy
    else:
        reach = jnp.arcsinh(1.0 / core)
        x, dx = core * jnp.sinh(reach * y), core * reach * jnp.cosh(reach * y) * dy
    turn = (jnp.arange(sectors, dtype=axis.dtype) + 0.5) / sectors
    cos, sin = cis_turns(turn)
    t = 2.0 * x * x
    across = jnp.sqrt(t * jnp.maximum(2.0 - t, 0.0))
    a, b = jnp.outer(across, cos).ravel(), jnp.outer(across, sin).ravel()
    z = jnp.repeat(1.0 - t, sectors)
    first, second = frames.tangents(axis)
    directions = frames.direction(*(first[i] * a + second[i] * b + axis[i] * z for i in range(3)))
    return directions, jnp.repeat(4.0 * x * dx * (2.0 * math.pi / sectors), sectors)
