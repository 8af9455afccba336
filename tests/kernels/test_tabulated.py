"""Tables over pairs of directions: identities, batches, and distributions against SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage, stats

from diffopt.kernels import tabulated


def angles(rng, count=200):
    return rng.uniform(0, 1.5, count), rng.uniform(0.01, 1.5, count), rng.uniform(-3.1, 3.1, count)


def test_directions_and_angles_are_inverse(dtype, rng):
    given = [jnp.asarray(a, dtype) for a in angles(rng)]
    wi, wo = tabulated.half_difference(*given)
    np.testing.assert_allclose(jnp.linalg.norm(wi, axis=-1), 1.0, rtol=4e-7)
    eps = float(jnp.finfo(dtype).eps)
    for found, expected in zip(tabulated.rusinkiewicz(wi, wo), given, strict=True):
        assert found.dtype == jnp.dtype(dtype)
        # phi_d has its rounding over the sines of theta_h and theta_d, down to 1e-2 each here.
        limit = 8 * eps / jnp.maximum(jnp.sin(given[0]) * jnp.sin(given[1]), eps)
        assert bool((jnp.abs(found - expected) <= limit + 8 * eps).all())


def test_exchange_turns_phi_d_by_half_a_circle(rng):
    wi, wo = tabulated.half_difference(*map(jnp.asarray, angles(rng)))
    h, d, p = tabulated.rusinkiewicz(wi, wo)
    swapped = tabulated.rusinkiewicz(wo, wi)
    np.testing.assert_array_equal(swapped[0], h)
    np.testing.assert_array_equal(swapped[1], d)
    turn = jnp.abs(swapped[2] - p)
    np.testing.assert_allclose(turn, np.pi, atol=1e-12)


def test_linear_is_scipys(dtype, rng):
    table = rng.uniform(0.1, 2.0, (5, 6, 7))
    places = [rng.uniform(-1, n + 1, 100) for n in table.shape]
    found = tabulated.linear(
        jnp.asarray(table, dtype),
        tuple(jnp.asarray(p, dtype) for p in places),
        periodic=(False, False, True),
    )
    inside = [np.clip(places[0], 0, 4), np.clip(places[1], 0, 5), places[2] % 7]
    wrapped = np.concatenate([table, table[..., :1]], -1)
    expected = ndimage.map_coordinates(wrapped, inside, order=1)
    np.testing.assert_allclose(found, expected, rtol=3e4 * float(jnp.finfo(dtype).eps) ** 0.99)


def test_nearest_cuts_off_as_the_reader_of_the_database_does(rng):
    table = jnp.asarray(rng.uniform(size=(9, 8, 10)))
    h, d, p = (rng.uniform(0, top, 300) for top in (1.57, 1.57, 3.14))
    places = tabulated.merl_places(*map(jnp.asarray, (h, d, p)), (9, 8, 10))
    found = tabulated.linear(table, places, periodic=(False, False, True), nearest=True)
    half = np.pi / 2
    index = (np.sqrt(h / half) * 9, d / half * 8, p / np.pi * 10)
    np.testing.assert_array_equal(found, np.asarray(table)[tuple(i.astype(int) for i in index)])


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(5)
    return jnp.asarray(rng.uniform(0.05, 2.0, (4, 6, 5)))


def test_bilinear_samples_follow_their_density(model, rng):
    u, v = (jnp.asarray(a) for a in rng.uniform(size=(2, 20000)))

    @jax.jit
    def both(u, v):
        place = (jnp.full(u.shape, 0.3), jnp.full(u.shape, 0.8))
        slices = tabulated.corners((2, 2), place, (False, False))
        x, y = tabulated.sample_bilinear(model, slices, u, v)
        return x, y, tabulated.invert_bilinear(model, slices, x, y)

    x, y, (s, t, _) = both(u, v)
    np.testing.assert_allclose(s, u, atol=1e-12)
    np.testing.assert_allclose(t, v, atol=1e-12)
    counts, _, _ = np.histogram2d(x, y, bins=10, range=[[0, 1], [0, 1]])
    fine = (np.arange(20000) + 0.5) / 200
    fine = np.stack(np.meshgrid((np.arange(200) + 0.5) / 200, (np.arange(100) + 0.5) / 100), -1)
    fx, fy = (jnp.asarray(a.ravel()) for a in np.moveaxis(fine, -1, 0))
    place = (jnp.full(fx.shape, 0.3), jnp.full(fx.shape, 0.8))
    slices = tabulated.corners((2, 2), place, (False, False))
    density = np.asarray(tabulated.invert_bilinear(model, slices, fx, fy)[2])
    assert density.mean() == pytest.approx(1.0, abs=1e-3)
    expected, _, _ = np.histogram2d(fx, fy, bins=10, range=[[0, 1], [0, 1]], weights=density)
    expected *= len(u) / expected.sum()
    statistic = ((counts - expected) ** 2 / expected).sum()
    assert stats.chi2.sf(statistic, 99) > 1e-4
    assert stats.chi2.sf(((counts.T - expected) ** 2 / expected).sum(), 99) < 1e-10


def test_vmap_is_the_batch(dtype, rng):
    wi, wo = (rng.normal(size=(40, 3)) for _ in range(2))
    wi, wo = (jnp.asarray(w / np.linalg.norm(w, axis=-1, keepdims=True), dtype) for w in (wi, wo))
    whole = tabulated.rusinkiewicz(wi, wo)
    each = jax.vmap(tabulated.rusinkiewicz)(wi, wo)
    for a, b in zip(whole, each, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=4 * float(jnp.finfo(dtype).eps))
