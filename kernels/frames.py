"""Directions in the local frame: z is the surface normal, all vectors point away from it.

Everything is computed from the sum of the two unit vectors, never from 1 + dot: at 89.99
degrees the dot form is about 1 % wrong in float32 and from 89.999 on exactly 0; the sum form
keeps its digits.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffopt.kernels.phase import cis_turns


def above_horizon(
    wi: Float[Array, "... 3"], wo: Float[Array, "... 3"]
) -> tuple[Bool[Array, "..."], Float[Array, "... 3"], Float[Array, "... 3"]]:
    """Which pairs lie above the horizon, and pairs that are safe to differentiate.

    Returns
    -------
    tuple
        ``(valid, wi, wo)``; where a direction is at or below the horizon both are replaced
        by the normal, so that what is computed from them is finite, with its gradient, and
        can be masked afterwards.
    """
    valid = (wi[..., 2] > 0) & (wo[..., 2] > 0)
    normal = jnp.zeros_like(wi).at[..., 2].set(1.0)
    return valid, jnp.where(valid[..., None], wi, normal), jnp.where(valid[..., None], wo, normal)


def dot(a: Float[Array, "... 3"], b: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Scalar product, written out.

    A reduction over three keeps the compiler from fusing, and in float32 on the CPU (jaxlib
    0.10) ``2 (h * w).sum(-1, keepdims=True) * h - w`` of five or more w against one array of h
    came out wrong by its whole size.
    """
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def reflect(w: Float[Array, "... 3"], h: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Mirror image of a direction at a unit half vector, 2 (h.w) h - w."""
    return 2.0 * dot(h, w)[..., None] * h - w


def half_vector(
    a: Float[Array, "... 3"], b: Float[Array, "... 3"]
) -> tuple[Float[Array, "... 3"], Float[Array, "..."], Bool[Array, "..."]]:
    """Unit vector along the sum of two, its length before, and whether there is one.

    Where the two cancel it is the normal, with length 1. For unit vectors, twice the length is
    four cosines to the half vector: the solid angle of a direction over that of the half
    vector that it is mirrored at.
    """
    total = a + b
    length2 = dot(total, total)
    ok = length2 > 1e-12
    length = jnp.sqrt(jnp.where(ok, length2, 1.0))
    normal = jnp.zeros_like(total).at[..., 2].set(1.0)
    return jnp.where(ok[..., None], total, normal) / length[..., None], length, ok


def wave_vector(wi: Float[Array, "... 3"], wo: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """(u, v, w) = -(wi + wo): Stam's k1 - k2 over k, with w in [-2, 0]."""
    return -(wi + wo)


def valid_wave_vector(
    valid: Bool[Array, " M"], wi: Float[Array, "M 3"], wo: Float[Array, "M 3"]
) -> Float[Array, "M 3"]:
    """Wave vectors of pairs, with that of the first valid pair where a pair is not.

    Pairs that do not count shall not widen the range of w over which a method interpolates.
    """
    wave = wave_vector(wi, wo)
    return jnp.where(valid[:, None], wave, wave[jnp.argmax(valid)][None, :])


def half_cosine(wave: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """Cosine between either direction and their half vector, |wi + wo| / 2."""
    return 0.5 * jnp.sqrt((wave * wave).sum(-1))


def v_cavity(
    wave: Float[Array, "... 3"], cos_i: Float[Array, "..."], cos_o: Float[Array, "..."]
) -> Float[Array, "..."]:
    """Shadowing and masking of V-shaped cavities (Torrance and Sparrow 1967), in [0, 1].

    ``min(1, 4 |w| min(cos_i, cos_o) / (u^2 + v^2 + w^2))``; 1 at the specular direction.
    """
    s2 = (wave * wave).sum(-1)
    return jnp.minimum(1.0, 4.0 * jnp.abs(wave[..., 2]) * jnp.minimum(cos_i, cos_o) / s2)


def spherical(theta: Float[Array, "..."], phi: Float[Array, "..."]) -> Float[Array, "... 3"]:
    """Unit vectors from the angle to the normal and the azimuth from x, radians."""
    sin = jnp.sin(theta)
    return direction(sin * jnp.cos(phi), sin * jnp.sin(phi), jnp.cos(theta))


def direction(
    x: Float[Array, "..."], y: Float[Array, "..."], z: Float[Array, "..."]
) -> Float[Array, "... 3"]:
    """Vectors from their components, which broadcast against each other.

    Picked by the place on the last axis, not stacked: what a stack is fused with is computed
    one number after the other on the CPU (XLA of jaxlib 0.10), up to 30 times as slow as
    computing all three for every place in vectors and throwing two away.
    """
    x, y, z = jnp.broadcast_arrays(x, y, z)
    place = jax.lax.broadcasted_iota(jnp.int32, (*x.shape, 3), x.ndim)
    return jnp.where(place == 0, x[..., None], jnp.where(place == 1, y[..., None], z[..., None]))


def around(
    sin: Float[Array, "..."], turns: Float[Array, "..."], cos: Float[Array, "..."]
) -> Float[Array, "... 3"]:
    """Unit vectors from the sine and cosine to the normal and the azimuth in turns."""
    along, across = cis_turns(turns)
    return direction(sin * along, sin * across, cos)


def tangents(normal: Float[Array, "... 3"]) -> tuple[Float[Array, "... 3"], Float[Array, "... 3"]]:
    """Two unit vectors that make a right-handed frame with a unit vector.

    Duff et al., "Building an Orthonormal Basis, Revisited" (JCGT 2017): no pole, also not at
    -z; the frame jumps at z = 0.
    """
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    sign = jnp.where(z >= 0.0, 1.0, -1.0).astype(z.dtype)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = direction(1.0 + sign * x * x * a, sign * b, -sign * x)
    return first, direction(b, sign + y * y * a, -y)
