"""Products of functions in spherical harmonics, projected back to their bands.

    (f g)_k = sum_ij G_ijk f_i g_j,  G_ijk = integral of Y_i Y_j Y_k over the sphere

Up to four bands the sum runs over the tensor's few nonzero entries (353 of 4,096); above, where
they are thousands, both functions are evaluated on a grid that is exact for the product.
Coefficients are the first axis, [L^2, ...].
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels.harmonics import bands_of, values_on

# Most bands with which the sum over the tensor's entries is unrolled.
SPARSE = 4


@lru_cache(maxsize=16)
def gaunt(bands: int) -> np.ndarray:
    """The tensor G [L^2, L^2, L^2] in float64; entries that vanish by symmetry are 0."""
    values, weights = values_on(*grid_of(bands), bands)
    tensor = np.einsum("in,jn,kn,n->ijk", values, values, values, weights, optimize=True)
    return np.where(abs(tensor) > 1e-12, tensor, 0.0)


def grid_of(bands: int) -> tuple[int, int]:
    """Polar and azimuthal nodes with which products of L bands are projected exactly to L."""
    return -(-(3 * bands - 2) // 2), 3 * bands - 2


@lru_cache(maxsize=16)
def gaunt_triples(bands: int) -> list[tuple[int, int, int, float]]:
    """Distinct nonzero entries (i, j, k, value), i <= j <= k."""
    tensor = gaunt(bands)
    places = np.argwhere(tensor)
    places = places[(places[:, 0] <= places[:, 1]) & (places[:, 1] <= places[:, 2])]
    return [(int(i), int(j), int(k), float(tensor[i, j, k])) for i, j, k in places]


def product(
    first: Float[Array, "L2 ..."], second: Float[Array, "M2 ..."]
) -> Float[Array, "L2 ..."]:
    """Coefficients of the product of two functions of as many bands, projected to these bands.

    Raises
    ------
    ValueError
        If either has no whole number of bands, or they differ.
    """
    bands = bands_of(first)
    if first.shape[0] != second.shape[0]:
        raise ValueError(f"second: received {second.shape[0]} coefficients, expected {bands**2}")
    return _sparse(first, second, bands) if bands <= SPARSE else _gridded(first, second, bands)


def _sparse(first: Array, second: Array, bands: int) -> Array:
    pairs: dict[tuple[int, int], list[tuple[int, float]]] = {}
    for i, j, k, value in gaunt_triples(bands):
        for a, b, out in {(i, j, k), (i, k, j), (j, k, i)}:
            pairs.setdefault((min(a, b), max(a, b)), []).append((out, value))
    rows: list = [None] * (bands * bands)
    for (a, b), outputs in pairs.items():
        term = first[a] * second[b]
        if a != b:
            term = term + first[b] * second[a]
        for out, value in outputs:
            rows[out] = value * term if rows[out] is None else rows[out] + value * term
    return jnp.stack(rows)


def _gridded(first: Array, second: Array, bands: int) -> Array:
    to_grid, back = transforms(*grid_of(bands), bands)
    synthesis = jnp.asarray(to_grid, first.dtype)
    on_grid = jnp.tensordot(synthesis, first, 1) * jnp.tensordot(synthesis, second, 1)
    return jnp.tensordot(jnp.asarray(back, first.dtype), on_grid, 1)


@lru_cache(maxsize=32)
def transforms(polar: int, azimuthal: int, bands: int) -> tuple[np.ndarray, np.ndarray]:
    """Matrices from coefficients to the nodes of `harmonics.sphere_rule`, [n, L^2], and back."""
    values, weights = values_on(polar, azimuthal, bands)
    return np.ascontiguousarray(values.T), values * weights


def logarithm(visibility: Float[Array, "L2 ..."], floor: float = 0.02) -> Float[Array, "L2 ..."]:
    """Coefficients of the logarithm of a function, taken no smaller than `floor`.

    With `exponential`, a product of many functions is a sum of logarithms (Ren et al. 2006,
    "Real-time soft shadows in dynamic scenes using spherical harmonic exponentiation"), whatever
    their order. Truncated visibility rings below 0: `floor` bounds its logarithm.

    Raises
    ------
    ValueError
        If the floor is not positive.
    """
    if not floor > 0.0:
        raise ValueError(f"floor: received {floor}, expected a positive number")
    to_grid, back = _finer(bands_of(visibility))
    values = jnp.tensordot(jnp.asarray(to_grid, visibility.dtype), visibility, 1)
    clipped = jnp.log(jnp.maximum(values, floor))
    return jnp.tensordot(jnp.asarray(back, visibility.dtype), clipped, 1)


def exponential(logarithm: Float[Array, "L2 ..."]) -> Float[Array, "L2 ..."]:
    """Coefficients of the exponential of a function, projected to its bands."""
    to_grid, back = _finer(bands_of(logarithm))
    values = jnp.exp(jnp.tensordot(jnp.asarray(to_grid, logarithm.dtype), logarithm, 1))
    return jnp.tensordot(jnp.asarray(back, logarithm.dtype), values, 1)


def _finer(bands: int) -> tuple[np.ndarray, np.ndarray]:
    """A grid twice as fine as products need: logarithm and exponential have no last degree."""
    polar, azimuthal = grid_of(bands)
    return transforms(2 * polar, 2 * azimuthal, bands)
