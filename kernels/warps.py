"""Points of the unit square to directions, with their densities per steradian."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels import frames

Square = Float[Array, "*batch 2"]
Direction = Float[Array, "*batch 3"]


def cosine_hemisphere(u: Square) -> Direction:
    """Directions about z with density cos / pi."""
    return _around(u[..., 1], 1.0 - u[..., 0], u[..., 0])


def uniform_hemisphere(u: Square) -> Direction:
    """Directions about z with density 1 / (2 pi)."""
    z = 1.0 - u[..., 0]
    return _around(u[..., 1], z * z, u[..., 0] * (2.0 - u[..., 0]))


def power_cosine(u: Square, exponent: Float[Array, "*#batch"]) -> Direction:
    """Directions about z with density (n + 1) / (2 pi) cos^n, n >= 0 (also 1e8)."""
    logarithm = jnp.log1p(-u[..., 0]) * (2.0 / (exponent + 1.0))
    return _around(u[..., 1], jnp.exp(logarithm), -jnp.expm1(logarithm))


def power_cosine_density(
    cos: Float[Array, "*batch"], sin2: Float[Array, "*batch"], exponent: Float[Array, "*#batch"]
) -> Float[Array, "*batch"]:
    """(n + 1) / (2 pi) cos^n for cos > 0, else 0; sin2 is 1 - cos^2 without cancellation."""
    return (exponent + 1.0) / (2.0 * math.pi) * power(cos, sin2, exponent)


def power(
    cos: Float[Array, "*batch"], sin2: Float[Array, "*batch"], exponent: Float[Array, "*#batch"]
) -> Float[Array, "*batch"]:
    """cos^n for cos > 0, else 0, from sin^2: exact to rounding at n = 1e8, 1 at n = 0."""
    lit = cos > 0.0
    # Near grazing 1 - sin^2 has lost the cosine itself.
    near = sin2 < 0.5
    from_sin = 0.5 * jnp.log1p(-jnp.where(near & lit, sin2, 0.25))
    logarithm = jnp.where(near, from_sin, jnp.log(jnp.where(lit & ~near, cos, 0.5)))
    return jnp.where(lit, jnp.exp(exponent * logarithm), 0.0)


def gaussian_angle(u: Square, m: Float[Array, "*#batch"]) -> Direction:
    """Directions about z, their angle with density proportional to theta exp(-theta^2/m^2).

    Truncated at pi / 2. For Blinn's distribution of normals, which has no closed inverse.
    """
    reach = (0.5 * math.pi / m) ** 2
    theta = m * jnp.sqrt(-jnp.log1p(jnp.expm1(-reach) * jnp.maximum(u[..., 0], 1e-12)))
    sin, cos = jnp.sin(theta), jnp.cos(theta)
    return frames.around(sin, u[..., 1], cos)


def gaussian_angle_density(
    theta2: Float[Array, "*batch"], m: Float[Array, "*#batch"]
) -> Float[Array, "*batch"]:
    """Density per steradian of `gaussian_angle`, at the square of the angle."""
    small = theta2 < 1e-4
    theta = jnp.sqrt(jnp.where(small, 1.0, theta2))
    over_sin = jnp.where(small, 1.0 + theta2 / 6.0, theta / jnp.sin(theta))
    reach = (0.5 * math.pi / m) ** 2
    inside = theta2 <= (0.5 * math.pi) ** 2
    value = over_sin * jnp.exp(-theta2 / (m * m)) / (-math.pi * m * m * jnp.expm1(-reach))
    return jnp.where(inside, value, 0.0)


def _around(turn: Array, cos2: Array, sin2: Array) -> Array:
    """Direction from a share of the circle and the squares of cosine and sine to z.

    Roots are kept off zero, where they have no slope.
    """
    tiny = float(jnp.finfo(turn.dtype).tiny)
    sin, cos = (jnp.sqrt(jnp.maximum(square, tiny)) for square in (sin2, cos2))
    return frames.around(sin, turn, cos)
