"""Pairs of uniform numbers from a key, at the speed of the arithmetic.

Threefry-2x32 (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011) makes two
words from a key and a counter. `jax.random` joins them to one and rolls its twenty rounds up in
a loop; unrolled, and with both words kept, the same function of the same key runs several
times as fast on the CPU. Equal keys give equal numbers, whatever the count: the i-th pair
depends on the key and on i alone.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt32

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = 0x1BD11BDA


def _threefry(
    key: UInt32[Array, "2"], first: UInt32[Array, "..."], second: UInt32[Array, "..."]
) -> tuple[UInt32[Array, "..."], UInt32[Array, "..."]]:
    """Threefry-2x32 with twenty rounds: two words from a key and a counter of two words."""
    keys = (key[0], key[1], key[0] ^ key[1] ^ np.uint32(_PARITY))
    x, y = first + keys[0], second + keys[1]
    for group in range(5):
        for by in _ROTATIONS[group % 2]:
            x = x + y
            y = x ^ ((y << np.uint32(by)) | (y >> np.uint32(32 - by)))
        x = x + keys[(group + 1) % 3]
        y = y + keys[(group + 2) % 3] + np.uint32(group + 1)
    return x, y


def at(
    key: PRNGKeyArray, first: UInt32[Array, "..."], second: UInt32[Array, "..."]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Two independent numbers in [0, 1) for each counter of two words, float32.

    Parameters
    ----------
    key
        Of `jax.random.key`; one of another kind than Threefry is hashed to one.
    first, second
        The counter, of one shape.
    """
    if jax.random.key_impl(key) != "threefry2x32":
        data = jax.random.bits(key, (2,), jnp.uint32)
    else:
        data = jax.random.key_data(key)
    one, two = (_unit(word) for word in _threefry(data, first, second))
    return one, two


def pairs(key: PRNGKeyArray, count: int) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """Two times `count` independent numbers in [0, 1), float32, multiples of 2^-23.

    Parameters
    ----------
    key
        Of `jax.random.key`; one of another kind than Threefry is asked through `jax.random`.
    count
        Number of pairs, up to 2^32.
    """
    if jax.random.key_impl(key) != "threefry2x32":
        found = jax.random.uniform(key, (2, count), jnp.float32)
        return found[0], found[1]
    counter = jax.lax.iota(jnp.uint32, count)
    words = _threefry(jax.random.key_data(key), jnp.zeros_like(counter), counter)
    first, second = (_unit(word) for word in words)
    return first, second


def _unit(bits: UInt32[Array, "..."]) -> Float[Array, "..."]:
    """The upper 23 bits as a fraction: those of a float between 1 and 2, less 1."""
    filled = (bits >> np.uint32(9)) | np.uint32(0x3F800000)
    return jax.lax.bitcast_convert_type(filled, jnp.float32) - 1.0
