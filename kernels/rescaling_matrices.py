"""Matrices that carry a view of an object from its bounding sphere to another distance.

    S_d = M_k S_r,  M_k[i, j] = integral of Y_i(t, phi) Y_j(f_{1/k}(t), phi) over the sphere

for the maps f of `rescaling`, k = r / d. M keeps the order m and is the same for m and -m: of
its L^4 entries L (2 L^2 + 1) / 3 may differ from 0 (44 of 256 at L = 4), L (L + 1) (2 L + 1) / 6 of
them distinct (30). **Entries** are these distinct ones, [n, ...], in the order of `places`.

Zhou et al. ("Soft shadows of deforming objects", section 4.2) print the map in place of its
inverse, integrals without the sine, and appendix B lacks 2 pi; their reading is `inverse=True`,
the matrix of 1 / k. Truncated matrices do not compose.

The source of M is a function on the sphere ("sphere"), one that vanishes on the far hemisphere
("masked"), or coefficients in `hemispherical` harmonics ("hemisphere").
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import harmonics, hemispherical
from diffopt.kernels.harmonics import index

SOURCES = ("sphere", "masked", "hemisphere")


@lru_cache(maxsize=32)
def places(
    bands: int, source_bands: int | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Order m >= 0, degree of the row and degree of the column of every distinct entry."""
    columns = source_bands or bands
    found = [
        (m, row, column)
        for m in range(min(bands, columns))
        for row in range(m, bands)
        for column in range(m, columns)
    ]
    m, row, column = np.array(found).T
    return m, row, column


def _entries(rows: Array, sources: Array, weights: Array, bands: int, columns: int) -> Array:
    """Entries from harmonics on a half circle of azimuth 0; nodes are the last axis.

    Harmonics of the view from afar [L^2, ..., n], of the source [S^2, ..., n], weights [..., n].
    """
    found = []
    for m in range(min(bands, columns)):
        left, right = (
            values[np.array([index(degree, m) for degree in range(m, count)])]
            for values, count in ((rows, bands), (sources, columns))
        )
        azimuth = 2.0 * np.pi if m == 0 else np.pi
        block = jnp.einsum("i...n,j...n,...n->ij...", left, right, azimuth * weights)
        found.append(block.reshape(-1, *block.shape[2:]))
    return jnp.concatenate(found)


@lru_cache(maxsize=32)
def _rule(nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre on [0, 1]."""
    x, weight = np.polynomial.legendre.leggauss(nodes)
    return 0.5 * (x + 1.0), 0.5 * weight


def square(
    k: Float[Array, "..."],
    bands: int,
    *,
    source: str = "sphere",
    inverse: bool = False,
    nodes: int = 48,
) -> Float[Array, "n ..."]:
    """Entries for the square map, by quadrature over the angle.

    Parameters
    ----------
    k
        Radius over distance, > 0.
    bands
        L.
    source
        "sphere" or "masked".
    inverse
        The matrix of 1 / k instead: the form printed in the paper with k = r / d.
    nodes
        Of Gauss-Legendre quadrature. At L = 4, 48 give 2e-6 for k in [0.1, 8] (3e-5 at 0.01, 8e-5
        at 20), 96 give 2e-11; of a masked source 16 give 1e-12 for k <= 1, 48 as much to k = 8. The
        rule runs in the angle, analytic throughout, halfway between both maps where k > 1.

    Raises
    ------
    ValueError
        For another source.
    """
    if source not in ("sphere", "masked"):
        raise ValueError(f"source: received {source!r}, expected sphere or masked")
    if inverse:
        k = 1.0 / k
    x, weight = (jnp.asarray(part, k.dtype).reshape((1,) * k.ndim + (-1,)) for part in _rule(nodes))
    half = jnp.sqrt(jnp.maximum(k, 1.0))[..., None]
    k = k[..., None]
    # The far half of the sphere is what the map carries beyond f_k(pi / 2).
    end = jnp.arctan2(k, half - k) if source == "masked" else jnp.full_like(k, jnp.pi)
    s, c = jnp.sin(end * x), jnp.cos(end * x)
    sine, far, slope = _mapped(s, c, half, jnp.ones_like(k))
    _, near, _ = _mapped(s, c, half, k)
    weights = end * weight * sine * slope
    return _entries(
        harmonics.basis(far, bands), harmonics.basis(near, bands), weights, bands, bands
    )


def _mapped(s: Array, c: Array, over: Array, under: Array) -> tuple[Array, Array, Array]:
    """The square map of k = over / under, of an angle given by sine and cosine.

    Sine, direction [..., 3] and slope: without the angle itself, and without a division by what
    may be 0.
    """
    across = under * c + (under - over) * s
    norm2 = (over * s) ** 2 + across * across
    norm = jnp.sqrt(norm2)
    sine, cosine = over * s / norm, across / norm
    return sine, _direction(sine, cosine), over * under / norm2


def tangent(
    k: Float[Array, "..."],
    bands: int,
    *,
    source: str = "hemisphere",
    source_bands: int | None = None,
    nodes: int = 16,
) -> Float[Array, "n ..."]:
    """Entries for the tangent map: sin t_d = k sin u, seen from outside the sphere.

    Parameters
    ----------
    k
        Radius over distance, in [0, 1]; slopes are infinite at 1, where k is taken as 0.9999.
    bands
        L of what comes out.
    source
        "hemisphere" or "masked" (harmonics of the sphere, of a function that is 0 behind).
    source_bands
        Bands of the source, where they differ.
    nodes
        Of Gauss-Legendre quadrature over the square root of the distance to u = pi / 2, where
        functions of the hemisphere have a branch point: 16 give 5e-10 at L = 4 for k <= 0.9.

    Raises
    ------
    ValueError
        For another source.
    """
    if source not in ("hemisphere", "masked"):
        raise ValueError(f"source: received {source!r}, expected hemisphere or masked")
    columns = source_bands or bands
    x, weight = _rule(nodes)
    # u = pi / 2 (1 - x^2): sqrt(cos u) is analytic in x.
    far = 0.5 * np.pi * x * x
    sin_u, cos_u = np.cos(far), np.sin(far)
    kind = hemispherical if source == "hemisphere" else harmonics
    values = kind.numpy_basis(np.stack([sin_u, 0.0 * far, cos_u], -1), columns)
    shape = (1,) * k.ndim + (nodes,)
    near = jnp.asarray(values, k.dtype).reshape(len(values), *shape)
    slope, u_sine, u_cosine = (
        jnp.asarray(part, k.dtype).reshape(shape)
        for part in (np.pi * x * weight * sin_u * cos_u, sin_u, cos_u)
    )
    k = jnp.minimum(k, 0.9999)[..., None]
    sine = k * u_sine
    cosine = jnp.sqrt(u_cosine**2 + (1.0 - k) * (1.0 + k) * u_sine**2)
    rows = harmonics.basis(_direction(sine, cosine), bands)
    near = jnp.broadcast_to(near, near.shape[:1] + sine.shape)
    return _entries(rows, near, slope * k * k / cosine, bands, columns)


def sphere_rule(k: Float[Array, "..."], bands: int, *, nodes: int = 32) -> Float[Array, "n ..."]:
    """Entries for `rescaling.sphere_rule`, of a source that is 0 on the far hemisphere.

    For k < 1 the map rises and falls again: its rising part is taken, where the nearer of two
    silhouettes lies; angles beyond are dropped.

    Parameters
    ----------
    k
        Radius over distance, > 0.
    bands
        L.
    nodes
        Of Gauss-Legendre quadrature, on each side of the corner at 3 pi / 8. At L = 4, 16 give
        1e-14 for k <= 1; 32 give 1e-5 at 1.01, 1e-9 at 1.05, 5e-5 at 8. M jumps at k = 1.
    """
    x, weight = (jnp.asarray(part, k.dtype).reshape((1,) * k.ndim + (-1,)) for part in _rule(nodes))
    k = k[..., None]
    corner = 0.375 * jnp.pi
    s, c = jnp.sin(corner * x), jnp.cos(corner * x)
    one = jnp.ones_like(k)
    sine, far, slope = _mapped(s, c, k, one)
    near = jnp.broadcast_to(_direction(s, c), far.shape)
    # On the sphere, by the angle below pi / 2: from pi / 8 down to that at which the map turns,
    # with a slope of 0 there, so that no derivative of the end is needed.
    turn = jax.lax.stop_gradient(0.5 * jnp.arccos(jnp.minimum(k, 1.0)))
    left = jnp.maximum(0.125 * jnp.pi - turn, 0.0)
    below = jnp.minimum(turn, 0.125 * jnp.pi) + left * (1.0 - x) ** 2
    s2 = jnp.sin(below) ** 2
    norm2 = (1.0 - k) ** 2 + 4.0 * k * s2
    norm = jnp.sqrt(norm2)
    rise = 2.0 * k * ((k - 1.0) + 2.0 * s2) / norm2
    over_sine, over_cosine = k * jnp.sin(2.0 * below) / norm, ((1.0 - k) + 2.0 * k * s2) / norm
    over = 2.0 * left * (1.0 - x) * weight * rise * over_sine
    return _entries(
        harmonics.basis(jnp.concatenate([far, _direction(over_sine, over_cosine)], -2), bands),
        harmonics.basis(
            jnp.concatenate([near, _direction(jnp.cos(below), jnp.sin(below))], -2), bands
        ),
        jnp.concatenate([corner * weight * slope * sine, over], -1),
        bands,
        bands,
    )


def _direction(sine: Array, cosine: Array) -> Array:
    """Unit vectors at azimuth 0."""
    return jnp.stack([sine, jnp.zeros_like(sine), cosine], -1)


def transposed(entries: Float[Array, "n ..."], bands: int) -> Float[Array, "n ..."]:
    """Entries of the transposed matrix, of as many bands on both sides.

    M(1/k) transposed of the square map is M(k) with the factor k^2 / N^3 by which the paper
    multiplies the light of a source (`rescaling.square_density`).
    """
    m, row, column = places(bands)
    where = {place: slot for slot, place in enumerate(zip(m, row, column, strict=True))}
    return entries[np.array([where[place] for place in zip(m, column, row, strict=True)])]


def dense(
    entries: Float[Array, "n ..."], bands: int, source_bands: int | None = None
) -> Float[Array, "L2 S2 ..."]:
    """The whole matrix from its distinct entries."""
    columns = source_bands or bands
    m, row, column = places(bands, columns)
    found = jnp.zeros((bands**2, columns**2, *entries.shape[1:]), entries.dtype)
    at = np.stack([row * row + row, column * column + column])
    found = found.at[at[0] + m, at[1] + m].set(entries)
    return found.at[at[0] - m, at[1] - m].set(entries)


def apply(
    entries: Float[Array, "n ..."], coefficients: Float[Array, "S2 ..."], bands: int
) -> Float[Array, "L2 ..."]:
    """M S from the distinct entries: 44 products at four bands in place of 256."""
    columns = harmonics.bands_of(coefficients)
    rows: list = [None] * (bands * bands)
    entered = zip(*(part.tolist() for part in places(bands, columns)), strict=True)
    for slot, (m, row, column) in enumerate(entered):
        for sign in {1, -1} if m else {1}:
            term = entries[slot] * coefficients[index(column, sign * m)]
            place = index(row, sign * m)
            rows[place] = term if rows[place] is None else rows[place] + term
    zero = jnp.zeros_like(rows[0])
    return jnp.stack([zero if row is None else row for row in rows])
