"""Pairs of uniform numbers: the published generator, independence, equal keys."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import uniforms

pytestmark = pytest.mark.float32


def reference(key, count):
    """Threefry-2x32-20 word by word in plain integers, after Salmon et al. 2011."""
    mask, found = 0xFFFFFFFF, []
    words = [int(w) for w in np.asarray(jax.random.key_data(key))]
    words.append(words[0] ^ words[1] ^ 0x1BD11BDA)
    rotations = (13, 15, 26, 6, 17, 29, 16, 24)
    for counter in range(count):
        x, y = words[0], (counter + words[1]) & mask
        for turn in range(20):
            x = (x + y) & mask
            by = rotations[turn % 8]
            y = x ^ (((y << by) | (y >> (32 - by))) & mask)
            if turn % 4 == 3:
                group = turn // 4
                x = (x + words[(group + 1) % 3]) & mask
                y = (y + words[(group + 2) % 3] + group + 1) & mask
        found.append((x, y))
    return np.array(found, np.uint64)


def test_words_are_those_of_the_published_generator():
    key = jax.random.key(7)
    words = reference(key, 100)
    expected = (words >> np.uint64(9)).astype(np.float64) / 2**23
    found = np.stack(uniforms.pairs(key, 100), -1)
    assert np.array_equal(found, expected.astype(np.float32))
    # jax.random joins the same two words to one.
    joined = np.asarray(jax.random.bits(key, (100,), jnp.uint32))
    assert np.array_equal(joined, (words[:, 0] ^ words[:, 1]).astype(np.uint32))


def test_numbers_do_not_depend_on_the_count_and_differ_by_key():
    few, many = uniforms.pairs(jax.random.key(1), 10), uniforms.pairs(jax.random.key(1), 1000)
    assert all(np.array_equal(a, b[:10]) for a, b in zip(few, many, strict=True))
    other = uniforms.pairs(jax.random.key(2), 10)
    assert not any((a == b).any() for a, b in zip(few, other, strict=True))


def test_pairs_are_even_and_independent():
    u, v = (np.asarray(x, np.float64) for x in uniforms.pairs(jax.random.key(3), 200_000))
    assert u.min() >= 0.0
    assert max(u.max(), v.max()) < 1.0
    counts, _, _ = np.histogram2d(u, v, bins=20, range=[[0, 1], [0, 1]])
    expected = u.size / 400
    # chi-square of 399 degrees of freedom: 1e-6 quantiles lie within 5 standard deviations
    assert abs(((counts - expected) ** 2 / expected).sum() - 399) < 5 * np.sqrt(2 * 399)


def test_keys_of_other_kinds_are_asked_through_jax():
    key = jax.random.key(3, impl="rbg")
    u, v = uniforms.pairs(key, 1000)
    expected = jax.random.uniform(key, (2, 1000), jnp.float32)
    assert np.array_equal(np.stack([u, v]), expected)


def test_jit_and_vmap():
    keys = jax.random.split(jax.random.key(4), 3)
    together = jax.jit(jax.vmap(lambda k: uniforms.pairs(k, 5)))(keys)
    for row, key in enumerate(keys):
        for a, b in zip(together, uniforms.pairs(key, 5), strict=True):
            assert np.array_equal(a[row], b)
