"""Light of one kind of path at a time: pictures of them add up to the whole."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.transfer.relighting import Tables
from diffopt.transfer.settings import KINDS

#: What pictures are taken apart into: paths that a glossy surface sends on to the viewer, by how
#: light came to it, and all that matte shares send.
LAYERS = (*KINDS, "view-independent")


def layer(held: Tables, name: str) -> Tables:
    """Tables in which all but one layer is dark.

    Parameters
    ----------
    held
        The transfer.
    name
        One of `LAYERS`.

    Raises
    ------
    InputError
        For another name.
    """
    checks.choice("name", name, LAYERS)
    if name not in KINDS:
        return dataclasses.replace(held, glossy=False)
    return dataclasses.replace(
        held, views=_only(held.views, held.lobes, KINDS.index(name)), matte=False
    )


def _only(rows: Float[Array, "S F"], lobes: int, kind: int) -> Float[Array, "S F"]:
    """Rows whose weights are 0 but for those of one kind; axes and concentrations stay."""
    count = len(KINDS)
    each = rows.reshape(len(rows), count, lobes // count, -1)
    here = jnp.arange(count) == kind
    weight = jnp.arange(each.shape[-1]) >= 4
    kept = here[:, None, None] | ~weight[None, None, :]
    return jnp.where(kept[None], each, jnp.zeros((), rows.dtype)).reshape(rows.shape)
