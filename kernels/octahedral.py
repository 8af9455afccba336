"""The sphere on a square: the octahedral map, and its texels with a border that wraps.

A direction is scaled onto the octahedron |x| + |y| + |z| = 1 and projected along z; the four lower
faces are folded outwards about the sides of the inner square, so that all four corners of
[-1, 1]^2 are -z (Engelhardt and Dachsbacher, "Octahedron environment maps", VMV 2008). It takes
neither roots nor angles, and areas differ by 3 sqrt 3 at most: an area dA of the square holds
dA / r^3 steradian, r from 1 at the axes to 1 / sqrt 3 between them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import frames


def _folded(u: Array, v: Array) -> tuple[Array, Array]:
    """Reflected about the side of the inner square that is nearest; its own inverse."""
    across = jnp.where(u < 0.0, -1.0, 1.0).astype(u.dtype) * (1.0 - jnp.abs(v))
    along = jnp.where(v < 0.0, -1.0, 1.0).astype(v.dtype) * (1.0 - jnp.abs(u))
    return across, along


def encode(
    x: Float[Array, "..."], y: Float[Array, "..."], z: Float[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Place on the square of a direction given by its components.

    Parameters
    ----------
    x, y, z
        Of any length. 0 counts as z, with no slope.

    Returns
    -------
    tuple
        (u, v) in [-1, 1]. They jump at z < 0 where x or y changes sign, from one place of the
        border to another that stands for the same direction.
    """
    size = jax.lax.stop_gradient(jnp.abs(x) + jnp.abs(y) + jnp.abs(z))
    some = size > 0.0
    # Brought to 1 by a number that cancels: the square of a size may vanish.
    scale = 1.0 / jnp.where(some, size, 1.0)
    x, y, z = x * scale, y * scale, z * scale
    size = jnp.abs(x) + jnp.abs(y) + jnp.abs(z)
    shrink = jnp.where(some, 1.0 / jnp.where(some, size, 1.0), 0.0)
    u, v = x * shrink, y * shrink
    below = z < 0.0
    across, along = _folded(u, v)
    return jnp.where(below, across, u), jnp.where(below, along, v)


def decode(u: Float[Array, "..."], v: Float[Array, "..."]) -> Float[Array, "... 3"]:
    """Unit vectors of places on the square, u and v in [-1, 1]."""
    z = 1.0 - jnp.abs(u) - jnp.abs(v)
    below = z < 0.0
    across, along = _folded(u, v)
    x, y = jnp.where(below, across, u), jnp.where(below, along, v)
    # At least 1 / sqrt 3 on the octahedron.
    return frames.direction(x, y, z) / jnp.sqrt(x * x + y * y + z * z)[..., None]


def texels(size: int) -> np.ndarray:
    """Directions of the centres of size x size texels, in float64.

    Returns
    -------
    np.ndarray
        [size, size, 3]: rows by v, columns by u, both ascending.
    """
    at = (np.arange(size) + 0.5) * (2.0 / size) - 1.0
    u, v = np.broadcast_to(at, (size, size)), np.broadcast_to(at[:, None], (size, size))
    z = 1.0 - abs(u) - abs(v)
    x = np.where(z < 0.0, np.copysign(1.0 - abs(v), u), u)
    y = np.where(z < 0.0, np.copysign(1.0 - abs(u), v), v)
    directions = np.stack([x, y, z], -1)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def bordered(size: int) -> np.ndarray:
    """Which texel stands at each place of a square with a border of one texel.

    Each side of the square is folded onto itself about its middle, so that what lies beyond a
    side is the same row or column, mirrored; beyond a corner it is the opposite corner.

    Returns
    -------
    np.ndarray
        [size + 2, size + 2], int32: row times size plus column.
    """
    at = np.arange(-1, size + 1)
    row, column = np.meshgrid(at, at, indexing="ij")
    beyond_row, beyond_column = (row < 0) | (row >= size), (column < 0) | (column >= size)
    within_row, within_column = np.clip(row, 0, size - 1), np.clip(column, 0, size - 1)
    found_row = np.where(beyond_column, size - 1 - within_row, within_row)
    found_column = np.where(beyond_row, size - 1 - within_column, within_column)
    return (found_row * size + found_column).astype(np.int32)
