"""Reflectance models that are a formula of two directions: Phong's, Blinn's, Oren-Nayar's.

All take unit vectors [..., 3] in the local frame, z the normal, both away from the surface and
above the horizon (`diffopt.kernels.frames.above_horizon` masks the others), and return a shape
of one colour channel, [...], in 1/sr without the cosine. Angles come from sums and differences
of the vectors: 1 - cos of a small angle has no digits left at exponents of 1e6.

Sources: Phong (CACM 1975); Blinn (SIGGRAPH 1977); Lewis, "Making shaders more physically
plausible" (EGWR 1993) for the normalisation; Oren and Nayar, "Generalization of Lambert's
reflectance model" (SIGGRAPH 1994), the qualitative model.
"""

import math
from typing import Literal

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels import warps
from diffopt.kernels.frames import dot

Form = Literal["reflected", "halfway"]
Pair = Float[Array, "*batch 3"]
Value = Float[Array, "*batch"]


def mirrored(w: Pair) -> Pair:
    """The direction of perfect reflection of w at the surface."""
    return w * jnp.asarray([-1.0, -1.0, 1.0], w.dtype).reshape((1,) * (w.ndim - 1) + (3,))


def lobe_angle(form: Form, wi: Pair, wo: Pair) -> tuple[Value, Value]:
    """Cosine and squared sine of Phong's angle psi.

    Parameters
    ----------
    form
        ``reflected``: between wo and the mirrored wi; ``halfway``: cos psi = 2 (n.h)^2 - 1.
        The two agree only where wi, wo and the normal lie in a plane: with both 60 degrees
        from the normal and 90 degrees apart they give 0.25 and -0.2.
    wi, wo
        See the module.
    """
    if form == "reflected":
        apart = mirrored(wi) - wo
        gap = 0.25 * dot(apart, apart)  # sin^2 (psi / 2)
    else:
        _, gap = half_angle(wi, wo)
    return 1.0 - 2.0 * gap, 4.0 * gap * (1.0 - gap)


def half_angle(wi: Pair, wo: Pair) -> tuple[Value, Value]:
    """Cosine and squared sine of the angle between the half vector and the normal."""
    total = wi + wo
    across, up = total[..., 0] ** 2 + total[..., 1] ** 2, total[..., 2]
    length2 = across + up * up
    return jnp.abs(up) / jnp.sqrt(length2), across / length2


def phong(form: Form, exponent: Float[Array, "*#batch"], wi: Pair, wo: Pair) -> Value:
    """cos^n psi, without a constant; 0 beyond 90 degrees."""
    return warps.power(*lobe_angle(form, wi, wo), exponent)


def blinn_phong(exponent: Float[Array, "*#batch"], wi: Pair, wo: Pair) -> Value:
    """(n . h)^e, without a constant."""
    return warps.power(*half_angle(wi, wo), exponent)


def blinn_phong_constant(exponent: Float[Array, "*batch"]) -> Value:
    """(e + 2)(e + 4) / (8 pi (2^(-e/2) + e)): albedo 1 at normal incidence."""
    e = exponent
    return (e + 2.0) * (e + 4.0) / (8.0 * math.pi * (jnp.exp2(-0.5 * e) + e))


def oren_nayar(sigma: Float[Array, "*#batch"], wi: Pair, wo: Pair) -> Value:
    """A + B max(0, cos(phi_i - phi_o)) sin(alpha) tan(beta), over pi.

    Parameters
    ----------
    sigma
        Standard deviation of the facets' angle, radians; 0 is Lambert's 1/pi.
    wi, wo
        See the module. No angle is computed: sin(alpha) tan(beta) cos(phi_i - phi_o) is
        (xi xo + yi yo) over the larger of both cosines.
    """
    s2 = sigma * sigma
    a, b = 1.0 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    along = wi[..., 0] * wo[..., 0] + wi[..., 1] * wo[..., 1]
    term = jnp.maximum(along, 0.0) / jnp.maximum(wi[..., 2], wo[..., 2])
    return (a + b * term) / math.pi
