"""Functions of one, over batches too large to be evaluated at once."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array


def in_chunks(one: Callable[[Any], Any], batch: Any, chunk: int) -> Any:
    """A function over the first axis of a batch, `chunk` at most at once.

    All chunks have one size, the last member repeated where they hold too many: what
    `jax.lax.map` makes of a remainder is a second copy of the function, which takes as long to
    compile as the first.

    Parameters
    ----------
    one
        Of one member.
    batch
        Arrays with one length of their first axis.
    chunk
        Most members at once, >= 1.
    """
    count = jax.tree.leaves(batch)[0].shape[0]
    blocks = max(1, -(-count // chunk))
    size = -(-count // blocks)
    spare = blocks * size - count

    def split(array: Array) -> Array:
        if spare:
            last = jnp.broadcast_to(array[-1:], (spare, *array.shape[1:]))
            array = jnp.concatenate([array, last])
        return array.reshape(blocks, size, *array.shape[1:])

    def joined(array: Array) -> Array:
        return array.reshape(blocks * size, *array.shape[2:])[:count]

    found = jax.lax.map(jax.vmap(one), jax.tree.map(split, batch))
    return jax.tree.map(joined, found)
