"""What several occluders leave visible."""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffopt.errors import InputError
from diffopt.kernels import harmonic_products
from diffopt.shadows import tables
from diffopt.shadows.fields import Field

# Least visibility whose logarithm is taken: truncated visibility rings below 0.
_FLOOR = 0.02


def nothing_hidden(bands: int, like: Array) -> Float[Array, "L2 N"]:
    """Coefficients of visibility 1 at as many receivers."""
    rows = jnp.zeros((bands**2, like.shape[-1]), like.dtype)
    return rows.at[0].set(math.sqrt(4.0 * math.pi))


def visibility(
    x: Float[Array, "3 N"],
    occluders: Sequence[Field],
    combination: str = "product",
    nearer_than: Float[Array, " N"] | None = None,
) -> Float[Array, "L2 N"]:
    """Coefficients of what is visible past all occluders, in the world's frame.

    Parameters
    ----------
    x
        Receivers.
    occluders
        One field or more, of equal bands.
    combination
        "product": triple products, nearest first. "exponential": of the sum of logarithms; fields
        as `logarithms` returns them. "sum": of what they hide.
    nearer_than
        Distance to a light: centres of occluders beyond it hide nothing of it.
    """
    hidden = jnp.stack([field.seen(x) for field in occluders])
    distances = jnp.stack([field.distance(x) for field in occluders])
    if nearer_than is not None:
        between: Bool[Array, "K N"] = distances < nearer_than[None]
        hidden = jnp.where(between[:, None], hidden, 0.0)
    clear = nothing_hidden(occluders[0].bands, x)
    if combination == "exponential":
        return harmonic_products.exponential(jnp.sum(hidden, 0))
    if combination == "sum" or len(occluders) == 1:
        return clear - jnp.sum(hidden, 0)
    # Truncated products depend on their order a little: by distance, as the field's papers have it,
    # it does not depend on the order in which objects are given.
    order = jnp.argsort(distances, 0)
    hidden = jnp.take_along_axis(hidden, order[:, None], 0)
    visible = clear - hidden[0]
    for part in hidden[1:]:
        visible = visible - harmonic_products.product(visible, part)
    return visible


def logarithms(fields: Sequence[Field]) -> list[Field]:
    """Fields whose tables hold logarithms of visibility, for "exponential".

    The logarithm is taken of the table, once a frame, not of every receiver's view.
    """
    return [_logarithm(field) for field in fields]


@eqx.filter_jit
def _logarithm(field: Field) -> Field:
    rows, polar, azimuthal, width = field.table.shape

    fall = np.ones(rows)
    fall[field.inner :] = tables.row_squares(rows - field.inner - 1)

    def one(row: tuple[Array, Array]) -> Array:
        flat = (row[0] * row[1]).reshape(-1, width).T
        clear = nothing_hidden(field.bands, flat)
        return harmonic_products.logarithm(clear - flat, _FLOOR).T / row[1]

    # Row by row: on the grid a table is some twenty times as large.
    found = jax.lax.map(one, (field.table, jnp.asarray(fall, field.table.dtype)))
    return eqx.tree_at(lambda f: f.table, field, found.reshape(rows, polar, azimuthal, width))


def same_bands(fields: Sequence[Field]) -> int:
    """Bands of all fields, which must be equal.

    Raises
    ------
    InputError
        If they are not.
    """
    bands = {field.bands for field in fields}
    if len(bands) > 1:
        raise InputError(f"fields must have equal bands; received {sorted(bands)}")
    return bands.pop()
