"""Harmonics on the hemisphere about z: real spherical harmonics of a direction spread to a sphere.

    d' = (2 x g, 2 y g, 2 z - 1),  g = sqrt(z / (1 + z)),  H_i(d) = sqrt 2 Y_i(d')

d' covers the sphere once as d covers the upper hemisphere, with solid angles twice as large, so
that the H_i are orthonormal on the hemisphere: the shifted functions P_l^m(2 cos t - 1) of Gautron
et al. 2004 ("A novel hemispherical basis for accurate and efficient rendering"). What is known on
a hemisphere alone rings far less in them than in harmonics of the sphere.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import harmonics


def spread(directions: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Directions of the upper hemisphere spread over the sphere; below the horizon as on it.

    Continuous at the horizon, where all of it is one point, but with a slope of 1 / sqrt(z).
    """
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    above = z > 0.0
    safe = jnp.where(above, z, 1.0)
    stretch = jnp.where(above, 2.0 * jnp.sqrt(safe / (1.0 + safe)), 0.0)
    return jnp.stack([x * stretch, y * stretch, 2.0 * jnp.maximum(z, 0.0) - 1.0], -1)


def basis(directions: Float[Array, "... 3"], bands: int) -> Float[Array, "L2 ..."]:
    """Values of the first L^2 functions at unit vectors with z >= 0, coefficients first."""
    return 2.0**0.5 * harmonics.basis(spread(directions), bands)


def numpy_basis(directions: np.ndarray, bands: int) -> np.ndarray:
    """`basis` of directions [..., 3] in NumPy's float64, [L^2, ...]: for constants."""
    z = np.maximum(directions[..., 2:], 0.0)
    stretched = directions[..., :2] * (2.0 * np.sqrt(z / (1.0 + z)))
    spread_out = np.concatenate([stretched, 2.0 * z - 1.0], -1)
    return 2.0**0.5 * harmonics.numpy_basis(spread_out, bands)
