"""Statistics of rough surfaces made of small mirrors: normals, masking, visible normals.

Directions are unit vectors [..., 3] with z the mean normal; ``alpha`` is the pair
(alpha_x, alpha_y) of widths along x and y (for `beckmann` sqrt(2) times the rms slope), each
above 0, a scalar or of the shape of the batch.

One quantity carries all of Smith's masking: the area that the facets facing a direction w
show it, per area of the mean surface,

    A(w) = integral of max(w . h, 0) D(h) dh = w_z (1 + Lambda(w)),

so that G1 = w_z / A(w), G / (cos_i cos_o) = 1 / (A_i A_o) where the two directions are
independent and 1 / (A_i cos_o + A_o cos_i - cos_i cos_o) where height ties them, and the
density of visible normals is D(h) max(w . h, 0) / A(w). Lambda grows without bound at grazing
angles; A does not, and none of these forms divides by a cosine there.

Sources: Walter et al., "Microfacet models for refraction through rough surfaces" (EGSR 2007);
Heitz, "Understanding the masking-shadowing function in microfacet-based BRDFs" (JCGT 2014);
Dupuy and Benyoub, "Sampling visible GGX normals with spherical caps" (CGF 2023).
"""

import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf, erfinv
from jaxtyping import Array, Float

from diffopt.kernels import frames
from diffopt.kernels.phase import cis_turns

Normals = Literal["ggx", "beckmann", "gaussian"]
Masking = Literal["correlated", "uncorrelated", "v-cavity"]
Alpha = tuple[Float[Array, "*#batch"], Float[Array, "*#batch"]]

SQRT_PI = math.sqrt(math.pi)
# Beyond it exp(-a^2) is below the rounding of float64.
_LARGEST_A = 6.5
# Newton steps on the distribution of visible slopes: 1e-9 of it after five.
_STEPS = 7


def density(normals: Normals, h: Float[Array, "*batch 3"], alpha: Alpha) -> Float[Array, "*batch"]:
    """D(h) per steradian: the integral of D(h) h_z over the hemisphere is 1.

    Parameters
    ----------
    normals
        ``ggx``: Trowbridge and Reitz, 1 / (pi ax ay (hx^2/ax^2 + hy^2/ay^2 + hz^2)^2);
        ``beckmann``: exp(-(hx^2/ax^2 + hy^2/ay^2)/hz^2) / (pi ax ay hz^4); ``gaussian``:
        Blinn's c exp(-theta^2 / m^2), m = alpha_x = alpha_y, with c by quadrature, since
        there is no closed form (1/(pi m^2) is 6 % off at 0.3).
    h
        Unit vectors; 0 is returned for h_z <= 0.
    alpha
        See the module.
    """
    ax, ay = alpha
    up = h[..., 2] > 0.0
    x, y, z = h[..., 0], h[..., 1], jnp.where(up, h[..., 2], 1.0)
    if normals == "gaussian":
        value = gaussian_constant(ax) * jnp.exp(-squared_angle(h) / (ax * ax))
    else:
        tangent = (x / ax) ** 2 + (y / ay) ** 2
        if normals == "ggx":
            value = 1.0 / (math.pi * ax * ay * (tangent + z * z) ** 2)
        else:
            z2 = z * z
            # The exponent wins over 1/z^4; capped where the product is 0 in any case.
            power = jnp.minimum(tangent / jnp.maximum(z2, 1e-12), 700.0)
            falls = power < 80.0
            value = jnp.exp(-jnp.where(falls, power, 80.0)) / (
                math.pi * ax * ay * jnp.where(falls, z2 * z2, 1.0)
            )
            value = jnp.where(falls, value, 0.0)
    return jnp.where(up, value, 0.0)


def squared_angle(h: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """Square of the angle to the normal, smooth at the normal itself."""
    sin2 = h[..., 0] ** 2 + h[..., 1] ** 2
    small = sin2 < 1e-4
    angle = jnp.arctan2(jnp.sqrt(jnp.where(small, 1.0, sin2)), h[..., 2])
    # theta^2 = s + s^2/3 + 8 s^3/45 + 4 s^4/35, s = sin^2.
    series = sin2 * (1.0 + sin2 * (1.0 / 3.0 + sin2 * (8.0 / 45.0 + sin2 * (4.0 / 35.0))))
    return jnp.where(small, series, angle * angle)


def gaussian_constant(m: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Constant of Blinn's Gaussian c exp(-theta^2/m^2), so that it is a distribution.

    ``1/c = pi m^2 int_0^X exp(-x^2) sin(2 m x)/m dx`` with X = pi/(2 m) or 6.5, by Gauss's
    rule with 48 nodes (error below 1e-14 up to m = 2).
    """
    nodes, weights = (jnp.asarray(v, m.dtype) for v in np.polynomial.legendre.leggauss(48))
    end = jnp.minimum(0.5 * math.pi / m, _LARGEST_A)[..., None]
    x = 0.5 * end * (nodes + 1.0).reshape((1,) * m.ndim + (-1,))
    values = jnp.exp(-x * x) * jnp.sin(2.0 * m[..., None] * x) / m[..., None]
    total = (values * weights.reshape((1,) * m.ndim + (-1,))).sum(-1) * 0.5 * end[..., 0]
    return 1.0 / (math.pi * m * m * total)


def projected_area(
    normals: Normals, w: Float[Array, "*batch 3"], alpha: Alpha
) -> Float[Array, "*batch"]:
    """A(w), the area of the facets as w sees them without masking; see the module.

    Parameters
    ----------
    normals
        ``ggx`` or ``beckmann`` (Blinn's Gaussian has no closed form).
    w
        Unit vectors with w_z >= 0.
    alpha
        See the module.

    Raises
    ------
    ValueError
        For ``gaussian``.
    """
    ax, ay = alpha
    z = w[..., 2]
    across2 = (ax * w[..., 0]) ** 2 + (ay * w[..., 1]) ** 2
    if normals == "ggx":
        return 0.5 * (z + jnp.sqrt(z * z + across2))
    if normals != "beckmann":
        raise ValueError(f"masking by Smith needs 'ggx' or 'beckmann' normals; got {normals!r}")
    # At normal incidence `across` is 0, where its root has no slope.
    straight = across2 <= (z / _LARGEST_A) ** 2
    across = jnp.sqrt(jnp.where(straight, 1.0, across2))
    a = jnp.where(straight, _LARGEST_A, z / across)
    bent = across * jnp.exp(-a * a) / SQRT_PI + z * (1.0 + erf(a))
    return 0.5 * jnp.where(straight, 2.0 * z, bent)


def masking(normals: Normals, w: Float[Array, "*batch 3"], alpha: Alpha) -> Float[Array, "*batch"]:
    """Smith's G1(w) = w_z / A(w) in [0, 1]: the visible share of the facets facing w."""
    return w[..., 2] / projected_area(normals, w, alpha)


def visibility(
    kind: Masking,
    normals: Normals,
    wi: Float[Array, "*batch 3"],
    wo: Float[Array, "*batch 3"],
    alpha: Alpha,
) -> Float[Array, "*batch"]:
    """G(wi, wo) / (4 cos_i cos_o) of a pair above the horizon.

    Parameters
    ----------
    kind
        ``correlated``: Smith, by height (Heitz 2014 eq. 99); ``uncorrelated``: the product
        of both G1; ``v-cavity``: min(1, 2 hz cos_o / (o.h), 2 hz cos_i / (o.h)) of Torrance
        and Sparrow, whatever the normals.
    normals, alpha
        As in `density`.
    wi, wo
        Unit vectors with z > 0.
    """
    ci, co = wi[..., 2], wo[..., 2]
    if kind == "v-cavity":
        # 2 hz / (o.h) = 4 (ci + co) / |wi + wo|^2.
        total = frames.dot(wi + wo, wi + wo)
        return 0.25 * jnp.minimum(1.0 / (ci * co), 4.0 * (ci + co) / (total * jnp.maximum(ci, co)))
    ai, ao = projected_area(normals, wi, alpha), projected_area(normals, wo, alpha)
    if kind == "uncorrelated":
        return 0.25 / (ai * ao)
    return 0.25 / (ai * co + (ao - co) * ci)


def visible_density(
    normals: Normals,
    h: Float[Array, "*batch 3"],
    w: Float[Array, "*batch 3"],
    alpha: Alpha,
) -> Float[Array, "*batch"]:
    """Density per steradian of the normals that w sees, D(h) max(w.h, 0) / A(w)."""
    facing = jnp.maximum(frames.dot(w, h), 0.0)
    return density(normals, h, alpha) * facing / projected_area(normals, w, alpha)


def sample_visible(
    normals: Normals,
    u: Float[Array, "*batch 2"],
    w: Float[Array, "*batch 3"],
    alpha: Alpha,
) -> Float[Array, "*batch 3"]:
    """Normals distributed by `visible_density`, from points of the unit square.

    Parameters
    ----------
    normals
        ``ggx`` (Dupuy and Benyoub's spherical caps) or ``beckmann`` (the distribution of
        the visible slopes inverted by Newton's method).
    u
        In [0, 1).
    w
        Direction that sees them, w_z >= 0.
    alpha
        See the module.
    """
    ax, ay = alpha
    # In components throughout: a vector in between would be computed anew for each of them.
    sx, sy, sz = ax * w[..., 0], ay * w[..., 1], w[..., 2]
    size = jax.lax.rsqrt(sx * sx + sy * sy + sz * sz)
    sx, sy, sz = sx * size, sy * size, sz * size
    if normals == "ggx":
        # The cap's height is 1 - below; its sum with sz without cancellation.
        below = u[..., 0] * (1.0 + sz)
        sin = jnp.sqrt(jnp.maximum(below * (2.0 - below), jnp.finfo(below.dtype).tiny))
        along, side = cis_turns(u[..., 1])
        x, y = ax * (sin * along + sx), ay * (sin * side + sy)
        z = (1.0 - u[..., 0]) * (1.0 + sz)
    elif normals == "beckmann":
        along, side = _visible_slopes(u, sz)
        r2 = sx * sx + sy * sy
        straight = r2 <= 1e-30
        r = jnp.sqrt(jnp.where(straight, 1.0, r2))
        cos = jnp.where(straight, 1.0, sx / r)
        sin = jnp.where(straight, 0.0, sy / r)
        x, y = -ax * (cos * along - sin * side), -ay * (sin * along + cos * side)
        z = jnp.ones_like(x)
    else:
        raise ValueError(f"visible normals need 'ggx' or 'beckmann'; got {normals!r}")
    z = jnp.maximum(z, 1e-7)
    size = jax.lax.rsqrt(x * x + y * y + z * z)
    return frames.direction(x * size, y * size, z * size)


def _visible_slopes(
    u: Float[Array, "*batch 2"], cos: Float[Array, "*batch"]
) -> tuple[Float[Array, "*batch"], Float[Array, "*batch"]]:
    """Slopes along and across the direction at angle acos(cos), alpha = 1.

    Along it the distribution is C(x) = (cos (1 + erf x) + sin exp(-x^2)/sqrt(pi))/2 up to
    cot(theta). Newton's method runs on sqrt(C(end) - C) in y = erf x: nearly a straight line
    at all angles, also where C ends flat.
    """
    limit = 1.0 - 4.0 * float(jnp.finfo(cos.dtype).eps)
    target, side = u[..., 0], erfinv(jnp.clip(2.0 * u[..., 1] - 1.0, -limit, limit))
    fixed = jax.lax.stop_gradient(cos)
    sin = jnp.sqrt(jnp.maximum((1.0 - cos) * (1.0 + cos), jnp.finfo(cos.dtype).tiny))

    def below(y, cos, sin):
        x = erfinv(y)
        return 0.5 * (cos * (1.0 + y) + sin * jnp.exp(-x * x) / SQRT_PI), 0.5 * (cos - x * sin)

    end = erf(jnp.minimum(cos / sin, _LARGEST_A))
    top = jax.lax.stop_gradient(jnp.clip(end, -limit, limit))
    whole, _ = below(top, cos, sin)
    still = jax.lax.stop_gradient
    wanted = jnp.sqrt(1.0 - still(target))
    y = top - (1.0 + top) * wanted ** (1.0 + fixed)
    floor = float(jnp.finfo(cos.dtype).eps) ** 2

    def step(_, y):
        value, slope = below(y, fixed, still(sin))
        root = jnp.sqrt(jnp.maximum(still(whole) - value, floor))
        move = 2.0 * root * (root - wanted * jnp.sqrt(still(whole))) / jnp.maximum(slope, floor)
        # A step may not leave the interval: half the way to its end instead.
        low, high = 0.5 * (y - limit), 0.5 * (y + top)
        return jnp.clip(y + move, low, high)

    y = still(jax.lax.fori_loop(0, _STEPS, step, y))
    # One step more, which carries the derivatives (implicit function theorem).
    value, slope = below(y, cos, sin)
    y = jnp.clip(y + (target * whole - value) / still(jnp.maximum(slope, 1e-6)), -limit, limit)
    return erfinv(y), side
