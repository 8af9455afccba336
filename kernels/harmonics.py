"""Real spherical harmonics: values, quadrature, zonal functions, windows.

    Y_l^m = sqrt 2 Q_l^m(z) Re (x + iy)^m,  Y_l^-m = sqrt 2 Q_l^m(z) Im (x + iy)^m,  m > 0

without the phase (-1)^m of Condon and Shortley: Y_1 = sqrt(3 / 4 pi) (y, z, x). A function of
L bands (degrees 0 to L - 1) has L^2 coefficients; that of degree l and order m stands at
l^2 + l + m. Coefficients are the **first** axis everywhere: [L^2, ...], one contiguous array
for each, so that loops over receivers become vector instructions.

Values are polynomials of the components of the direction, so that derivatives are finite at the
poles; the recurrence over degrees neither overflows nor loses digits up to degree 64 in float32
(error 5e-5 there, 2e-7 at degree 3).
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

# Above this many bands the recurrence is a `scan`: unrolled, eight bands take a second to compile,
# sixteen five seconds, and 65 do not end.
UNROLLED = 8


def index(degree: int, order: int) -> int:
    """Place of a coefficient, l^2 + l + m."""
    return degree * degree + degree + order


def degrees(bands: int) -> np.ndarray:
    """Degree of every coefficient, [L^2]."""
    return np.repeat(np.arange(bands), 2 * np.arange(bands) + 1)


def orders(bands: int) -> np.ndarray:
    """Order of every coefficient, [L^2]."""
    return np.concatenate([np.arange(-degree, degree + 1) for degree in range(bands)])


def bands_of(coefficients: Array) -> int:
    """Number of bands of an array of coefficients [L^2, ...].

    Raises
    ------
    ValueError
        If its first axis is no square.
    """
    bands = round(coefficients.shape[0] ** 0.5)
    if bands * bands != coefficients.shape[0] or not bands:
        raise ValueError(f"coefficients: received {coefficients.shape}, expected [bands^2, ...]")
    return bands


@lru_cache(maxsize=32)
def _recurrence(bands: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Factors a, b [L, L] (degree, order) of Q_l = a z Q_{l-1} - b Q_{l-2}, and Q_m^m [L]."""
    degree, order = np.meshgrid(np.arange(bands, dtype=float), np.arange(bands), indexing="ij")
    below = degree > order
    gap = np.where(below, degree**2 - order**2, 1.0)
    a = np.where(below, np.sqrt(np.maximum(4 * degree**2 - 1, 0) / gap), 0.0)
    wide = degree > order + 1
    ratio = (2 * degree + 1) * np.maximum((degree - 1) ** 2 - order**2, 0)
    b = np.where(wide, np.sqrt(ratio / (np.where(wide, 2 * degree - 3, 1.0) * gap)), 0.0)
    m = np.arange(1, bands, dtype=float)
    diagonal = np.cumprod(np.concatenate([[1.0], np.sqrt((2 * m + 1) / (2 * m))]))
    return a, b, diagonal / np.sqrt(4.0 * np.pi)


def basis(directions: Float[Array, "... 3"], bands: int) -> Float[Array, "L2 ..."]:
    """Values of the first L^2 harmonics at unit vectors, coefficients first.

    Parameters
    ----------
    directions
        Unit vectors. The values are polynomials of the components; for vectors that are not of
        unit length they are harmonic polynomials of no norm in particular.
    bands
        L, >= 1; to degree 64 tested.

    Raises
    ------
    ValueError
        If there are no bands.
    """
    if bands < 1:
        raise ValueError(f"bands: received {bands}, expected at least 1")
    x, y, z = directions[..., 0], directions[..., 1], directions[..., 2]
    return _unrolled(x, y, z, bands) if bands <= UNROLLED else _scanned(x, y, z, bands)


def _unrolled(x: Array, y: Array, z: Array, bands: int) -> Array:
    a, b, diagonal = (factor.tolist() for factor in _recurrence(bands))
    rows: list = [None] * (bands * bands)
    c, s = jnp.ones_like(x), jnp.zeros_like(x)
    for m in range(bands):
        if m:
            c, s = x * c - y * s, x * s + y * c
        older, old = jnp.zeros_like(z), jnp.full_like(z, diagonal[m])
        for degree in range(m, bands):
            if degree > m:
                older, old = old, a[degree][m] * z * old - b[degree][m] * older
            if m:
                rows[index(degree, m)] = 2.0**0.5 * old * c
                rows[index(degree, -m)] = 2.0**0.5 * old * s
            else:
                rows[index(degree, 0)] = old
    return jnp.stack(rows)


def _scanned(x: Array, y: Array, z: Array, bands: int) -> Array:
    dtype = z.dtype
    a, b, diagonal = _recurrence(bands)
    shape = (bands,) + (1,) * z.ndim

    def power(carry, _):
        c, s = carry
        return (x * c - y * s, x * s + y * c), (c, s)

    _, (c, s) = jax.lax.scan(power, (jnp.ones_like(x), jnp.zeros_like(x)), None, length=bands)

    def up(carry, factors):
        older, old = carry
        first, second, start = (factor.reshape(shape) for factor in factors)
        new = first * z[None] * old - second * older + start
        return (old, new), new

    zero = jnp.zeros((bands, *z.shape), dtype)
    factors = tuple(jnp.asarray(factor, dtype) for factor in (a, b, np.diag(diagonal)))
    _, legendre = jax.lax.scan(up, (zero, zero), factors)
    degree, order = degrees(bands), orders(bands)
    turning = jnp.concatenate([2.0**0.5 * s[:0:-1], c[:1], 2.0**0.5 * c[1:]])
    return legendre[degree, abs(order)] * turning[order + bands - 1]


def evaluate(
    coefficients: Float[Array, "L2 ..."], directions: Float[Array, "... 3"]
) -> Float[Array, "..."]:
    """The function with these coefficients at unit vectors; axes after the first broadcast.

    Raises
    ------
    ValueError
        If the coefficients are no whole number of bands.
    """
    values = basis(directions, bands_of(coefficients))
    return jnp.sum(_aligned(coefficients, values.ndim) * _aligned(values, coefficients.ndim), 0)


def _aligned(array: Array, ndim: int) -> Array:
    """With axes of one inserted after the first, up to as many as another array has."""
    ones = (1,) * max(ndim - array.ndim, 0)
    return array.reshape(array.shape[:1] + ones + array.shape[1:])


@lru_cache(maxsize=64)
def sphere_rule(polar: int, azimuthal: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [n, 3] and weights [n] (sum 4 pi): Gauss-Legendre in z, uniform in azimuth.

    Exact for products of two functions of L bands if and only if polar >= L and
    azimuthal >= 2 L - 1. Azimuths start at half a step.
    """
    z, weight = np.polynomial.legendre.leggauss(polar)
    return rule_of(z, weight, azimuthal)


def hemisphere_rule(polar: int, azimuthal: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [n, 3] with z > 0 and weights [n] (sum 2 pi), as those of `sphere_rule`."""
    z, weight = np.polynomial.legendre.leggauss(polar)
    return rule_of(0.5 * (z + 1.0), 0.5 * weight, azimuthal)


def rule_of(z: np.ndarray, weight: np.ndarray, azimuthal: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [n, 3] and weights [n] of a rule in z times a uniform one in azimuth."""
    azimuth = (np.arange(azimuthal) + 0.5) * (2.0 * np.pi / azimuthal)
    sine = np.sqrt((1.0 - z) * (1.0 + z))
    directions = np.stack(
        [
            np.outer(sine, np.cos(azimuth)),
            np.outer(sine, np.sin(azimuth)),
            np.broadcast_to(z[:, None], (len(z), azimuthal)),
        ],
        -1,
    )
    weights = np.broadcast_to(weight[:, None] * (2.0 * np.pi / azimuthal), (len(z), azimuthal))
    return directions.reshape(-1, 3), weights.reshape(-1)


@lru_cache(maxsize=32)
def values_on(polar: int, azimuthal: int, bands: int) -> tuple[np.ndarray, np.ndarray]:
    """Harmonics [L^2, n] on `sphere_rule`, in float64, and its weights [n]."""
    directions, weights = sphere_rule(polar, azimuthal)
    return numpy_basis(directions, bands), weights


def numpy_basis(directions: np.ndarray, bands: int) -> np.ndarray:
    """`basis` of directions [..., 3] in NumPy's float64, [L^2, ...]: for constants."""
    a, b, diagonal = _recurrence(bands)
    x, y, z = (directions[..., axis] for axis in range(3))
    values = np.empty((bands * bands, *z.shape))
    c, s = np.ones(z.shape), np.zeros(z.shape)
    for m in range(bands):
        older, old = np.zeros(z.shape), np.full(z.shape, diagonal[m])
        for degree in range(m, bands):
            if degree > m:
                older, old = old, a[degree, m] * z * old - b[degree, m] * older
            if m:
                values[index(degree, m)] = 2.0**0.5 * old * c
                values[index(degree, -m)] = 2.0**0.5 * old * s
            else:
                values[index(degree, 0)] = old
        c, s = x * c - y * s, x * s + y * c
    return values


def project(
    values: Float[Array, "n ..."],
    directions: Float[Array, "n 3"],
    weights: Float[Array, " n"],
    bands: int,
) -> Float[Array, "L2 ..."]:
    """Coefficients of a function known at the nodes of a rule of quadrature over the sphere.

    Exact for functions of as many bands on the nodes of `sphere_rule(bands, 2 * bands - 1)`.
    """
    return jnp.tensordot(basis(directions, bands) * weights[None], values, 1)


def zonal(
    coefficients: Float[Array, "L ..."], axis: Float[Array, "... 3"]
) -> Float[Array, "L2 ..."]:
    """A function symmetric about z, given by its L coefficients of order 0, turned to an axis.

    The axes after the first broadcast against those of the unit vectors.
    """
    bands = coefficients.shape[0]
    factor = np.sqrt(4.0 * np.pi / (2.0 * np.arange(bands) + 1.0))
    scaled = coefficients * jnp.asarray(factor, coefficients.dtype).reshape(
        (bands,) + (1,) * (coefficients.ndim - 1)
    )
    values = basis(axis, bands)
    return _aligned(values, scaled.ndim) * _aligned(scaled[degrees(bands)], values.ndim)


def legendre(x: Float[Array, "..."], bands: int) -> Float[Array, "L ..."]:
    """Legendre polynomials of degrees 0 to L - 1."""
    rows = [jnp.ones_like(x), x]
    for degree in range(2, bands):
        rows.append(((2 * degree - 1) * x * rows[-1] - (degree - 1) * rows[-2]) / degree)
    return jnp.stack(rows[:bands])


def cap(half_angle: Float[Array, "..."], bands: int) -> Float[Array, "L ..."]:
    """Zonal coefficients of 1 within an angle of z and 0 beyond.

        z_0 = 2 sqrt(pi) sin^2(a / 2),  z_l = sqrt(pi / (2 l + 1)) (P_{l-1} - P_{l+1})(cos a)

    Parameters
    ----------
    half_angle
        a, radians, in [0, pi].
    bands
        L.
    """
    # P_{l-1} - P_{l+1} = (2l + 1) / (l (l + 1)) sin^2(a) P_l', and P_l' by its own recurrence:
    # the difference of two numbers near 1 would lose a small cap altogether.
    x, square = jnp.cos(half_angle), jnp.sin(half_angle) ** 2
    rows = [2.0 * np.pi**0.5 * jnp.sin(0.5 * half_angle) ** 2]
    below, slope = jnp.zeros_like(x), jnp.ones_like(x)
    for degree in range(1, bands):
        scale = (np.pi * (2 * degree + 1)) ** 0.5 / (degree * (degree + 1))
        rows.append(scale * square * slope)
        below, slope = slope, ((2 * degree + 1) * x * slope - (degree + 1) * below) / degree
    return jnp.stack(rows)


@lru_cache(maxsize=32)
def clamped_cosine(bands: int) -> np.ndarray:
    """Zonal coefficients [L] of max(z, 0): sqrt(pi) / 2, sqrt(pi / 3), ... in float64."""
    nodes, weights = np.polynomial.legendre.leggauss(bands + 1)
    z = 0.5 * (nodes + 1.0)
    values = numpy_basis(np.stack([np.sqrt(1.0 - z * z), 0.0 * z, z], -1), bands)
    rows = [values[index(degree, 0)] for degree in range(bands)]
    return np.pi * np.stack(rows) @ (weights * z)


@lru_cache(maxsize=32)
def window(bands: int, kind: str) -> np.ndarray:
    """Factor [L^2] of every coefficient that damps ringing, 1 at degree 0.

    Parameters
    ----------
    bands
        L.
    kind
        "none"; "hann", (1 + cos(pi l / L)) / 2; "lanczos", sin(pi l / L) / (pi l / L).

    Raises
    ------
    ValueError
        If it is none of these.
    """
    t = degrees(bands) / bands
    if kind == "none":
        return np.ones_like(t)
    if kind == "hann":
        return 0.5 * (1.0 + np.cos(np.pi * t))
    if kind == "lanczos":
        return np.sinc(t)
    raise ValueError(f"window: received {kind!r}, expected none, hann or lanczos")
