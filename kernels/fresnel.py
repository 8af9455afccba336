"""Fresnel reflectance of smooth interfaces: dielectrics, conductors and Schlick's formula.

All functions take the cosine of the angle of incidence on the facet, so for a half-vector
model cos_h = wi.h = wo.h (reciprocity then holds exactly), and return power reflectances.
Light arrives in a medium of index 1; a relative index below 1 means arriving in the denser
medium, with total reflection beyond the critical angle.

With c the cosine of incidence, m the (complex) relative index and g = m cos(theta_t) =
sqrt(m^2 - 1 + c^2), the amplitude coefficients r_s = (c - g)/(c + g) and
r_p = (m^2 c - g)/(m^2 c + g) (Born and Wolf, Principles of Optics, section 1.5.2) are
written as

    r_s = (1 - m^2) / (c + g)^2,    r_p = (m^2 - 1)((m^2 + 1) c^2 - 1) / (m^2 c + g)^2,

which has no cancellation for m near 1. Complex numbers are carried as pairs of reals.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

Batch = Float[Array, "*#batch"]
Value = Float[Array, "*#batch"] | float


def dielectric(cos: Batch, n: Value) -> Batch:
    """Reflectance for unpolarised light of an interface without absorption.

    Parameters
    ----------
    cos
        Cosine of the angle of incidence, in [0, 1].
    n
        Relative index (transmitting side over incident side), positive. It is broadcast
        against `cos`; ranks must agree unless one of them is a scalar.

    Returns
    -------
    Array
        Power reflectance in [0, 1]. The value is 1 at grazing incidence and under total
        reflection, 0 for n = 1. The slope grows without bound towards the critical angle
        (it does so in nature) and is 0 from there on.
    """
    s, p = dielectric_polarised(cos, n)
    return 0.5 * (s + p)


def dielectric_polarised(cos: Batch, n: Value) -> tuple[Batch, Batch]:
    """Reflectance of an interface without absorption, for both polarisations.

    Parameters
    ----------
    cos, n
        As for `dielectric`.

    Returns
    -------
    tuple of Array
        Power reflectance for the electric field perpendicular (s) and parallel (p) to the
        plane of incidence.
    """
    cos, n = _same_type(cos, n)
    contrast = (n - 1.0) * (n + 1.0)
    square = contrast + cos * cos  # g^2
    refracts = square > _smallest(square)
    # The untaken side of a `where` is differentiated too: keep it away from sqrt(0).
    g = jnp.sqrt(jnp.where(refracts, square, 1.0))
    index2 = n * n
    # Two divisions, since the square of the divisor underflows in float32 near c = g = 0.
    s = contrast / (cos + g) / (cos + g)
    p = contrast / (index2 * cos + g) * ((index2 + 1.0) * cos * cos - 1.0) / (index2 * cos + g)
    beyond = jnp.where(n == 1.0, 0.0, 1.0).astype(square.dtype)
    return jnp.where(refracts, s * s, beyond), jnp.where(refracts, p * p, beyond)


def conductor(cos: Batch, eta: Value, k: Value) -> Batch:
    """Reflectance for unpolarised light of an interface with absorption.

    Parameters
    ----------
    cos
        Cosine of the angle of incidence, in [0, 1].
    eta, k
        Real part and extinction coefficient of the relative index m = eta + i k, both at
        least 0; k = 0 reproduces `dielectric`. They are broadcast against `cos`; ranks must
        agree unless an argument is a scalar.

    Returns
    -------
    Array
        Power reflectance in [0, 1].
    """
    s, p = conductor_polarised(cos, eta, k)
    return 0.5 * (s + p)


def conductor_polarised(cos: Batch, eta: Value, k: Value) -> tuple[Batch, Batch]:
    """Reflectance of an interface with absorption, for both polarisations.

    Parameters
    ----------
    cos, eta, k
        As for `conductor`.

    Returns
    -------
    tuple of Array
        Power reflectance for the electric field perpendicular (s) and parallel (p) to the
        plane of incidence.
    """
    cos, eta, k = _same_type(cos, eta, k)
    cos2, sin2 = cos * cos, (1.0 - cos) * (1.0 + cos)
    square, imag = (eta - k) * (eta + k), 2.0 * eta * k  # m^2
    # Of g^2, without cancellation for m near 1, and for m near 0.
    near = (eta - 1.0) * (eta + 1.0) - k * k + cos2
    a, b, regular = _root(jnp.where(square < 0.5, square - sin2, near), imag)  # g = a + i b
    # |m^2 - 1| = |m - 1| |m + 1|: no cancellation at any index.
    contrast = ((eta - 1.0) ** 2 + k * k) * ((eta + 1.0) ** 2 + k * k)
    below_s = (cos + a) ** 2 + b * b
    s = contrast / below_s / below_s
    below_p = (square * cos + a) ** 2 + (imag * cos + b) ** 2
    above_p = (square * cos2 - sin2) ** 2 + (imag * cos2) ** 2
    p = contrast / below_p * above_p / below_p
    # g = 0: the critical angle of a transparent medium, or n = 1 at grazing incidence.
    limit = jnp.where(contrast == 0.0, 0.0, 1.0).astype(s.dtype)
    return jnp.where(regular, s, limit), jnp.where(regular, p, limit)


def schlick(cos: Batch, r0: Value) -> Batch:
    """Schlick's approximation r0 + (1 - r0)(1 - cos)^5 of the unpolarised reflectance.

    Against the exact formula for glass (n = 1.5) it is 16 % low at 45 degrees, 22 % low at 60
    and 6 % high at 85. Source: Schlick, Computer Graphics Forum 13, 233 (1994), eq. 15.

    Parameters
    ----------
    cos
        Cosine of the angle of incidence, in [0, 1].
    r0
        Power reflectance at normal incidence, in [0, 1].

    Returns
    -------
    Array
        Power reflectance in [0, 1].
    """
    cos, r0 = _same_type(cos, r0)
    return r0 + (1.0 - r0) * (1.0 - cos) ** 5


def index_from_normal(r0: Batch) -> Batch:
    """Index above 1 of a dielectric from its reflectance at normal incidence.

    ``(1 + sqrt(r0)) / (1 - sqrt(r0))``: Cook and Torrance, "A reflectance model for computer
    graphics" (1982), section on Fresnel. The slope grows as 1 / sqrt(r0) and is 0 at r0 = 0.

    Parameters
    ----------
    r0
        Power reflectance, in [0, 1).
    """
    lit = r0 > _smallest(r0)
    root = jnp.where(lit, jnp.sqrt(jnp.where(lit, r0, 1.0)), 0.0)
    return (1.0 + root) / (1.0 - root)


def index_from_permittivity(real: Batch, imag: Batch) -> tuple[Batch, Batch]:
    """Complex index eta + i k, the root of a relative permittivity with imag >= 0.

    Parameters
    ----------
    real, imag
        Real and imaginary part of the relative permittivity, of the same shape and type.

    Returns
    -------
    tuple of Array
        eta and k, both at least 0 (both 0, with zero slope, where the permittivity is 0).
    """
    eta, k, regular = _root(real, imag)
    return jnp.where(regular, eta, 0.0), jnp.where(regular, k, 0.0)


def _root(real: Batch, imag: Batch) -> tuple[Batch, Batch, Array]:
    """Root a + i b (a, b >= 0) of real + i imag, and where it is regular; 1 elsewhere.

    The larger part comes from the modulus and the other from 2 a b = imag, so that neither
    suffers from cancellation and both have finite derivatives at imag = 0.
    """
    norm2 = real * real + imag * imag
    regular = norm2 > _smallest(norm2)
    real, imag = jnp.where(regular, real, 1.0), jnp.where(regular, imag, 0.0)
    modulus = jnp.sqrt(real * real + imag * imag)
    larger = jnp.sqrt(0.5 * (modulus + jnp.abs(real)))
    smaller = 0.5 * imag / larger
    ahead = real >= 0.0
    return jnp.where(ahead, larger, smaller), jnp.where(ahead, smaller, larger), regular


def _smallest(x: Array) -> float:
    """Level below which a squared quantity counts as 0; its inverse square root is finite."""
    return 1e3 * float(jnp.finfo(x.dtype).tiny)


def _same_type(cos: Array, *others: Value) -> tuple[Array, ...]:
    """All arguments as arrays; Python numbers take the type of `cos`."""
    return cos, *(x if isinstance(x, Array) else jnp.asarray(x, cos.dtype) for x in others)
