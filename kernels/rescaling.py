"""How the view of an object changes with the distance: maps of the polar angle.

At distance d from the centre of a sphere of radius r, k = r / d. Angles are measured from the
direction to the centre. A direction at polar angle t on the sphere becomes `f_k(t)` at d, and what
is seen at d is the view from the sphere under the **inverse** map: V_d(t) = V_r(f_{1/k}(t)); k < 1
(outside) shrinks, k > 1 (inside) expands.

Three maps, of which the first two are those of Zhou et al., "Soft shadows of deforming objects"
(section 4.1), put right:

- `square`: the silhouette lies on a square about the centre; a bijection of [0, pi];
- `sphere_rule`: the silhouette lies on the sphere where the square would leave it;
- `tangent`: sin t_d = k sin t_r, a ray keeps its distance from the centre. The only map independent
  of azimuth with the right occlusion on average over positions, for any object, from outside.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def square(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """f_k(theta) = atan2(k sin, cos + (1 - k) sin), in [0, pi].

    f_a o f_b = f_ab, hence the inverse is f_{1/k}; 0, 3 pi / 4 and pi stay where they are.

    Parameters
    ----------
    theta
        Angle from the centre's direction, radians, in [0, pi].
    k
        Radius over distance, > 0.
    """
    s, c = jnp.sin(theta), jnp.cos(theta)
    # Rounded, pi may lie above pi, where the sine is below 0: half a turn back.
    back = (s < 0.0) & (c < 0.0)
    sign = jnp.where(back, -1.0, 1.0).astype(s.dtype)
    angle = jnp.arctan2(sign * k * s, sign * (c + (1.0 - k) * s))
    return jnp.where(back, angle + jnp.pi, angle)


def square_slope(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """Derivative of f_k by theta, k / N^2: positive."""
    return k / _square_norm(theta, k)


def square_slope_k(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """Derivative of f_k by k, sin (cos + sin) / N^2."""
    s, c = jnp.sin(theta), jnp.cos(theta)
    return s * (c + s) / _square_norm(theta, k)


def square_sine_ratio(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """Ratio sin f_k / sin theta = k / N; k at both poles."""
    return k / jnp.sqrt(_square_norm(theta, k))


def square_density(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """Solid angle before over solid angle after, f' sin f / sin theta = k^2 / N^3.

    The paper multiplies light by it. That keeps the integral of radiance over directions, and so
    takes the fall with 1 / d^2 away: radiance itself does not change along a ray.
    """
    norm = _square_norm(theta, k)
    return k * k / (norm * jnp.sqrt(norm))


def _square_norm(theta: Array, k: Array) -> Array:
    """N^2 = (k sin)^2 + (cos + (1 - k) sin)^2, never 0."""
    s, c = jnp.sin(theta), jnp.cos(theta)
    across = c + (1.0 - k) * s
    return (k * s) ** 2 + across * across


def sphere_rule(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """The square's map where its corner lies within the sphere, else atan2(k sin 2t, 1 + k cos 2t).

    The paper's fallback, active for theta between 3 pi / 8 and pi / 2 (at pi / 2 a ray touches the
    sphere). For k < 1 it rises and falls again: it has no inverse there, and what is seen is
    ambiguous. Angles above pi / 2, at which nothing of the object can be seen from the sphere, are
    mapped by the square.
    """
    s, c = jnp.sin(theta), jnp.maximum(jnp.cos(theta), 0.0)
    # Sine and cosine of twice the angle, written out: 1 + k cos 2t is 0 at k = 1, t = pi / 2,
    # where anything within [0, pi] is a limit.
    up, along = 2.0 * k * s * c, (1.0 - k) + 2.0 * k * c * c
    met = (up + jnp.abs(along)) > 4.0 * jnp.finfo(theta.dtype).eps
    on_sphere = jnp.arctan2(jnp.where(met, up, 0.0), jnp.where(met, along, 1.0))
    within = (theta < 0.375 * jnp.pi) | (theta > 0.5 * jnp.pi)
    return jnp.where(within, square(theta, k), jnp.where(met, on_sphere, theta))


def tangent(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """Angle asin(k sin theta): theta in [0, pi / 2], k in [0, 1] (above, taken as 1)."""
    k = jnp.minimum(k, 1.0)
    s, c = jnp.sin(theta), jnp.cos(theta)
    # By its tangent: the arcsine loses half the digits near 1, and its slope there.
    return jnp.arctan2(k * s, jnp.sqrt(c * c + (1.0 - k) * (1.0 + k) * s * s))


def tangent_inverse(theta: Float[Array, "..."], k: Float[Array, "..."]) -> Float[Array, "..."]:
    """Angle asin(sin theta / k), k in [0, 1]; pi / 2 beyond the cone that holds the sphere.

    Its slope is infinite at the edge of the cone, where theta = asin k; beyond, it is 0.
    """
    s, c = jnp.sin(theta), jnp.cos(theta)
    inside = (s < k) & (c > 0.0)
    along = jnp.where(inside, (k - s) * (k + s), 1.0)
    angle = jnp.arctan2(jnp.where(inside, s, 0.0), jnp.sqrt(along))
    return jnp.where(inside, angle, 0.5 * jnp.pi)
