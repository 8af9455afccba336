"""Spherical harmonics of von Mises-Fisher lobes.

A lobe of unit integral has the zonal coefficients sqrt((2l + 1) / 4 pi) A_l(kappa),

    A_l(kappa) = i_l(kappa) / i_0(kappa) = I_{l+1/2}(kappa) / I_{1/2}(kappa),

with i_l the modified spherical Bessel functions: convolving a function with it multiplies its
coefficients of degree l by A_l. A_0 = 1, A_1 = coth kappa - 1 / kappa, and for large kappa
A_l = exp(-l (l + 1) / (2 kappa)), nearly.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

# Degrees beyond the last one from which the recurrence starts: what is left of the error of the
# start is 2e-15 (at kappa = 1000; less elsewhere).
_BEYOND = 64
# Steps of a loop that are compiled as one.
_UNROLL = 8


def ratios(kappa: Float[Array, "..."], bands: int) -> Float[Array, "L ..."]:
    """A_l of degrees 0 to L - 1, degrees first.

    r_l = A_l / A_{l-1} by its recurrence downwards, ``1 / r_l = (2l + 1) / kappa + r_{l+1}``, from
    an expansion in the first three powers of 1 / sqrt(kappa^2 + l^2) (Debye's, uniform in l), and
    products of them upwards. Nothing cancels, neither in values nor in slopes: in 1 / kappa above
    1, in kappa below.

    Parameters
    ----------
    kappa
        Concentrations, 0 to 1e8 in float32, to 1e12 in float64.
    bands
        L, >= 1; tested to 65.

    Raises
    ------
    ValueError
        If there are no bands.
    """
    if bands < 1:
        raise ValueError(f"bands: received {bands}, expected at least 1")
    small = kappa < 1.0
    # r = top / ((2l + 1) bottom + top r'), with top and bottom in [0, 1].
    top = jnp.where(small, kappa, 1.0)
    bottom = jnp.where(small, 1.0, 1.0 / jnp.where(small, 1.0, kappa))
    last = bands + _BEYOND
    start = jnp.where(small, 0.0, _debye(jnp.where(small, 1.0, bottom), last))

    def down(ratio: Array, degree: Array) -> tuple[Array, Array]:
        ratio = top / ((2.0 * degree + 1.0) * bottom + top * ratio)
        return ratio, ratio

    def quiet(ratio: Array, degree: Array) -> tuple[Array, None]:
        return down(ratio, degree)[0], None

    def degrees(first: int, end: int) -> Array:
        return jnp.arange(end - 1, first - 1, -1).astype(kappa.dtype)

    ratio, _ = jax.lax.scan(quiet, start, degrees(bands, last), unroll=_UNROLL)
    _, found = jax.lax.scan(down, ratio, degrees(1, bands), unroll=_UNROLL)
    return jnp.concatenate([jnp.ones_like(kappa)[None], jnp.cumprod(found[::-1], 0)])


def _debye(y: Array, degree: int) -> Array:
    """r_l of large concentrations or degrees, from y = 1 / kappa.

    kappa r_l + l = H(l - 1/2), and the recurrence is (H(l - 1/2) - l) (H(l + 1/2) + l) = kappa^2,
    solved for y H in powers of y at fixed x = (l - 1/2) y. Its error is of the order of
    (kappa^2 + l^2)^-2.
    """
    x = (degree - 0.5) * y
    w = jnp.sqrt(1.0 + x * x)
    p = 1.0 / (w * w)
    q = x * x * p
    first = 0.5 * q
    second = -p * (1.0 - 5.0 * q) / (8.0 * w)
    third = -p * p * (1.0 - 12.0 * q + 15.0 * q * q) / 8.0
    # w - x without cancellation.
    return 1.0 / (w + x) - 0.5 * y + y * (first + y * (second + y * third))
