"""Matrices of `rescaling_matrices` from tables over k: linear, or Chebyshev's polynomials.

What matters is the variable. The square map is smooth in log k; the tangent map has a branch point
at k = 1, where no polynomial and no line in k or log k comes near: its variable is asin k for a
masked source, and sqrt(acos k) for one in harmonics of the hemisphere. For an error of the entries
below 1e-3 at L = 4, on [1/8, 8] and [0, 1]:

==============  ===============  ===============  =====
map             variable         nodes of a line  terms
==============  ===============  ===============  =====
square          log k            115              20
tangent         asin k           40               8
tangent, hemi.  sqrt(acos k)     48               9
==============  ===============  ===============  =====

Twelve terms in sqrt(acos k) leave 2e-5 at four bands, 4e-4 at six.
"""

import math
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import phase, rescaling_matrices

#: Least and largest k of tables of the square map.
LEAST, LARGEST = 0.125, 8.0
KINDS = ("square", "square masked", "tangent masked", "tangent hemisphere")
#: Largest k of tables of the tangent map: at 1 its slope is infinite.
NEAREST = 0.9999


def _span(kind: str) -> tuple[float, float]:
    """Range of the variable.

    Raises
    ------
    ValueError
        For another kind.
    """
    if kind in ("square", "square masked"):
        return math.log(LEAST), math.log(LARGEST)
    if kind == "tangent masked":
        return 0.0, math.asin(NEAREST)
    if kind == "tangent hemisphere":
        return math.sqrt(math.acos(NEAREST)), math.sqrt(0.5 * math.pi)
    raise ValueError(f"kind: received {kind!r}, expected one of {', '.join(KINDS)}")


def place(k: Float[Array, "..."], kind: str) -> Float[Array, "..."]:
    """Where k lies in the range of the variable, in [0, 1]; k beyond it at its end.

    Parameters
    ----------
    k
        Radius over distance: clipped to [1/8, 8] for the square map, to [0, 0.9999] else.
    kind
        "square", "square masked", "tangent masked" or "tangent hemisphere".
    """
    first, last = _span(kind)
    if kind in ("square", "square masked"):
        value = jnp.log(jnp.clip(k, LEAST, LARGEST))
    elif kind == "tangent masked":
        value = jnp.arcsin(jnp.clip(k, 0.0, NEAREST))
    else:
        value = jnp.sqrt(jnp.arccos(jnp.clip(k, 0.0, NEAREST)))
    return (value - first) / (last - first)


def _ratio(share: np.ndarray, kind: str) -> np.ndarray:
    """Inverse of `place`."""
    first, last = _span(kind)
    value = first + (last - first) * share
    if kind in ("square", "square masked"):
        return np.exp(value)
    return np.sin(value) if kind == "tangent masked" else np.cos(value * value)


def _exact(k: Array, bands: int, kind: str) -> Array:
    name, _, source = kind.partition(" ")
    if name == "square":
        make = partial(rescaling_matrices.square, nodes=64, source=source or "sphere")
    else:
        make = partial(rescaling_matrices.tangent, nodes=64, source=source)
    return make(k, bands)


def linear(bands: int, kind: str, nodes: int, dtype=float) -> Float[Array, "t n"]:
    """Entries at equal steps of the variable, [nodes, n]: a table for `from_linear`."""
    if nodes < 2:
        raise ValueError(f"nodes: received {nodes}, expected at least 2")
    k = jnp.asarray(_ratio(np.linspace(0.0, 1.0, nodes), kind), dtype)
    return _exact(k, bands, kind).T


def from_linear(
    table: Float[Array, "t n"], k: Float[Array, "..."], kind: str
) -> Float[Array, "n ..."]:
    """Entries [n, ...] between the rows of a table."""
    steps = table.shape[0] - 1
    value = place(k, kind) * steps
    low = jnp.clip(value.astype(jnp.int32), 0, steps - 1)
    share = (value - low.astype(value.dtype))[..., None]
    return jnp.moveaxis((1.0 - share) * table[low] + share * table[low + 1], -1, 0)


def chebyshev(bands: int, kind: str, terms: int, dtype=float) -> Float[Array, "t n"]:
    """Coefficients of Chebyshev's polynomials in the variable, [terms, n]: for `from_chebyshev`."""
    if terms < 1:
        raise ValueError(f"terms: received {terms}, expected at least 1")
    angle = np.pi * (np.arange(terms) + 0.5) / terms
    k = jnp.asarray(_ratio(0.5 + 0.5 * np.cos(angle), kind), dtype)
    values = _exact(k, bands, kind).T
    factor = np.cos(np.outer(np.arange(terms), angle)) * (2.0 / terms)
    factor[0] *= 0.5
    return jnp.asarray(factor, values.dtype) @ values


def from_chebyshev(
    table: Float[Array, "t n"], k: Float[Array, "..."], kind: str
) -> Float[Array, "n ..."]:
    """Entries [n, ...] by the polynomials: no gather, and smooth slopes by k."""
    rows = phase.chebyshev_rows(2.0 * place(k, kind) - 1.0, table.shape[0])
    return jnp.tensordot(table.T, rows, 1)
