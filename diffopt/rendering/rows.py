"""Rows of arrays between compiled programs: taken in blocks of one size, and put together.

On the host, where their number may change without anything being compiled; rows of arrays that
JAX traces stay with JAX.
"""

from collections.abc import Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

Tree = TypeVar("Tree")

# Rows of a block on a CPU: few, as the last block of each group of materials is padded; and on
# other devices, that want many.
_ROWS, _MANY = 2048, 2**15


def block() -> int:
    """Rows of a block on the device that JAX uses."""
    return _ROWS if jax.default_backend() == "cpu" else _MANY


def blocks(rows: Int[np.ndarray, " n"], size: int) -> Iterator[tuple[Int[np.ndarray, " B"], int]]:
    """Numbers of rows in blocks of a size, and how many of each are wanted: the first ones."""
    for start in range(0, len(rows), size):
        part = rows[start : start + size]
        padded = np.zeros(size, np.int32)
        padded[: len(part)] = part
        yield padded, len(part)


def taken(tree: Tree, rows: Int[np.ndarray, " B"]) -> Tree:
    """Some rows of all arrays."""

    def one(array: Any) -> Any:
        if isinstance(array, Tracer):
            return _taken(array, rows)
        return np.asarray(array).take(rows, 0)

    return jax.tree.map(one, tree)


def joined(trees: list[Tree]) -> Tree:
    """All rows of arrays, one after the other."""
    return jax.tree.map(lambda *parts: _numpy(*parts).concatenate(parts), *trees)


def where(chosen: np.ndarray, values: Any) -> Any:
    """Values of chosen rows [n], 0 in the others."""
    return _numpy(values).where(chosen[:, None], values, np.zeros((), values.dtype))


def added(
    total: Float[Array | np.ndarray, "N C"],
    rows: Int[np.ndarray, " n"],
    values: Float[Array | np.ndarray, "n C"],
) -> Float[Array | np.ndarray, "N C"]:
    """A total with values added to some of its rows, each named once but for the last one.

    An array of the host is changed in place.
    """
    if isinstance(values, Tracer) or not isinstance(total, np.ndarray):
        return jnp.asarray(total).at[rows].add(values)
    total[rows] += np.asarray(values)
    return total


def _numpy(*arrays: Any) -> Any:
    return jnp if any(isinstance(a, Tracer) for a in arrays) else np


@jax.jit
def _taken(array: Array, rows: Int[Array, " B"]) -> Array:
    return array[rows]
