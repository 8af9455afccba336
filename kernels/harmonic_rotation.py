"""Rotation of functions in spherical harmonics.

A function turned by R has the value f(R^T d) at d; its coefficients are D(R) c, with D orthogonal,
one block for each degree, and D(R1 R2) = D(R1) D(R2). Coefficients are the first axis.

Two ways: any rotation by its matrix (`blocks`, `rotate`), and rotations about z and y, of which
`to_frame` is made: what the fields of shadows need at every receiver, with no trigonometric
function beyond those of its position.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels.harmonics import bands_of, index


def blocks(rotation: Float[Array, "... 3 3"], bands: int) -> list[Float[Array, "... n n"]]:
    """Blocks D^l, [..., 2 l + 1, 2 l + 1], of every degree below `bands`.

    Recurrence of Ivanic and Ruedenberg (J. Phys. Chem. 100, 1996, with the erratum of 1998).

    Parameters
    ----------
    rotation
        Orthogonal matrices of determinant 1, acting on column vectors.
    bands
        L.
    """
    return _blocks(rotation, bands, jnp)


def _blocks(rotation, bands: int, xp):
    one = xp.ones_like(rotation[..., :1, :1])
    cyclic = np.array([1, 2, 0])
    found = [one]
    if bands > 1:
        first = rotation[..., cyclic, :][..., cyclic]
        found.append(first)
    for degree in range(2, bands):
        found.append(_next(found[1], found[-1], degree, xp))
    return found


def _next(first, below, degree: int, xp):
    """D^l from D^1 and D^{l-1}."""

    def product(i):
        row = first[..., i + 1, :]
        left, middle, right = (row[..., j, None, None] for j in range(3))
        top, bottom = below[..., -1:], below[..., :1]
        return xp.concatenate(
            [right * bottom + left * top, middle * below, right * top - left * bottom], -1
        )

    def constant(matrix):
        return xp.asarray(matrix, first.dtype).reshape((1,) * (first.ndim - 2) + matrix.shape)

    p_minus, p_zero, p_plus = product(-1), product(0), product(1)
    size = 2 * degree + 1
    u, v, w = _factors(degree)
    m = np.arange(-degree, degree + 1)
    zero = xp.zeros_like(p_zero[..., :1, :])

    def rows(source, order, factor):
        """Rows of P at the given orders, times a factor; nothing where the factor is 0."""
        place = np.where(factor == 0, size - 2, order + degree - 1)
        padded = xp.concatenate([source, zero], -2)
        return constant(factor[:, None]) * padded[..., place, :]

    positive, negative, null = m > 0, m < 0, m == 0
    root = np.sqrt(2.0)
    u_part = rows(p_zero, np.where(abs(m) < degree, m, 0), (abs(m) < degree) * 1.0)
    plus = np.where(m == 1, root, 1.0) * positive + null + negative * (m != -1)
    plus_order = np.where(positive, m - 1, np.where(null, 1, m + 1))
    minus = -1.0 * (positive & (m != 1)) + null + negative * np.where(m == -1, root, 1.0)
    minus_order = np.where(positive, 1 - m, np.where(null, -1, -m - 1))
    v_part = rows(p_plus, plus_order, plus) + rows(p_minus, minus_order, minus)
    inner = (abs(m) + 1 < degree) & ~null
    w_plus = inner * 1.0
    w_plus_order = np.where(positive, m + 1, m - 1)
    w_minus = inner * np.where(positive, 1.0, -1.0)
    w_minus_order = np.where(positive, -m - 1, 1 - m)
    w_part = rows(p_plus, w_plus_order, w_plus) + rows(p_minus, w_minus_order, w_minus)
    return constant(u) * u_part + constant(v) * v_part + constant(w) * w_part


@lru_cache(maxsize=128)
def _factors(degree: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """u, v, w of the recurrence, [2 l + 1, 2 l + 1] (m, n)."""
    order = np.arange(-degree, degree + 1)
    m, n = order[:, None], order[None, :]
    edge = 2 * degree * (2 * degree - 1)
    below = np.where(abs(n) < degree, (degree + n) * (degree - n), edge)
    size = abs(m)
    u = np.sqrt((degree + m) * (degree - m) / below)
    null = m == 0
    v = 0.5 * np.sqrt((1 + null) * (degree + size - 1) * (degree + size) / below) * (1 - 2 * null)
    w = -0.5 * np.sqrt(np.maximum((degree - size - 1) * (degree - size), 0) / below) * (1 - null)
    return u, v, w


def rotate(
    coefficients: Float[Array, "L2 ..."], rotation: Float[Array, "... 3 3"]
) -> Float[Array, "L2 ..."]:
    """Coefficients of the function turned by a rotation; one, or one for each function.

    Raises
    ------
    ValueError
        If the coefficients are no whole number of bands.
    """
    bands = bands_of(coefficients)
    parts = []
    for degree, block in enumerate(blocks(rotation, bands)):
        part = coefficients[degree * degree : (degree + 1) ** 2]
        parts.append(jnp.einsum("...mn,n...->m...", block, part))
    return jnp.concatenate(parts)


def about_z(
    coefficients: Float[Array, "L2 ..."], cosine: Float[Array, "..."], sine: Float[Array, "..."]
) -> Float[Array, "L2 ..."]:
    """Turned about z by an angle given by its cosine and sine."""
    bands = bands_of(coefficients)
    rows = list(coefficients)
    c, s = cosine, sine
    for m in range(1, bands):
        if m > 1:
            c, s = cosine * c - sine * s, cosine * s + sine * c
        for degree in range(m, bands):
            plus, minus = index(degree, m), index(degree, -m)
            rows[plus], rows[minus] = (
                c * rows[plus] - s * rows[minus],
                s * rows[plus] + c * rows[minus],
            )
    shape = jnp.broadcast_shapes(coefficients.shape[1:], cosine.shape)
    return jnp.stack([jnp.broadcast_to(row, shape) for row in rows])


@lru_cache(maxsize=16)
def _tilts(bands: int) -> list[tuple[int, int, np.ndarray, np.ndarray]]:
    """Entries of D(R_y(b)) as sums over j of a_j cos(j b) + b_j sin(j b): row, column, a, b."""
    count = 2 * bands - 1
    angle = 2.0 * np.pi * np.arange(count) / count
    turn = np.zeros((count, 3, 3))
    turn[:, 0, 0] = turn[:, 2, 2] = np.cos(angle)
    turn[:, 0, 2], turn[:, 2, 0] = np.sin(angle), -np.sin(angle)
    turn[:, 1, 1] = 1.0
    found = []
    for degree, block in enumerate(_blocks(turn, bands, np)):
        wave = np.fft.rfft(block, axis=0) / count
        even, odd = 2.0 * wave.real, -2.0 * wave.imag
        even[0] *= 0.5
        for m in range(-degree, degree + 1):
            for n in range(-degree, degree + 1):
                if (m >= 0) == (n >= 0):
                    cosines = even[: degree + 1, m + degree, n + degree]
                    sines = odd[: degree + 1, m + degree, n + degree]
                    row, column = index(degree, m), index(degree, n)
                    found.append((row, column, _clean(cosines), _clean(sines)))
    return found


def _clean(wave: np.ndarray) -> np.ndarray:
    """Zeros in place of what is rounding."""
    return np.where(abs(wave) > 1e-13, wave, 0.0)


def about_y(
    coefficients: Float[Array, "L2 ..."], cosine: Float[Array, "..."], sine: Float[Array, "..."]
) -> Float[Array, "L2 ..."]:
    """Turned about y by an angle given by its cosine and sine."""
    bands = bands_of(coefficients)
    waves = [(jnp.ones_like(cosine), jnp.zeros_like(sine))]
    for _ in range(1, bands):
        c, s = waves[-1]
        waves.append((cosine * c - sine * s, cosine * s + sine * c))
    rows: list = [None] * (bands * bands)
    for row, column, cosines, sines in _tilts(bands):
        factor = None
        for j, (a, b) in enumerate(zip(cosines.tolist(), sines.tolist(), strict=True)):
            for value, wave in ((a, waves[j][0]), (b, waves[j][1])):
                if value:
                    term = value * wave if j else jnp.full_like(wave, value)
                    factor = term if factor is None else factor + term
        if factor is not None:
            term = factor * coefficients[column]
            rows[row] = term if rows[row] is None else rows[row] + term
    return jnp.stack(rows)


def to_frame(
    coefficients: Float[Array, "L2 ..."],
    cos_polar: Float[Array, "..."],
    sin_polar: Float[Array, "..."],
    cos_azimuth: Float[Array, "..."],
    sin_azimuth: Float[Array, "..."],
) -> Float[Array, "L2 ..."]:
    """From the local frame of a point about a centre to the frame of the world.

    The local z axis points from the point (polar angle theta, azimuth phi, as seen from the centre)
    to the centre: F = R_z(phi) R_y(theta - pi), columns -e_theta, e_phi, -n.
    """
    tilted = about_y(coefficients, -cos_polar, -sin_polar)
    return about_z(tilted, cos_azimuth, sin_azimuth)
