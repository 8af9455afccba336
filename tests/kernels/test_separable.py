"""Matrix products at Chebyshev points in w, against the direct sum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import dtft, phase, separable

STEP = 0.1


def job(rng, dtype):
    heights = jnp.asarray(rng.uniform(0, 0.3, (16, 20)), dtype)
    fx = jnp.asarray(rng.uniform(-1.5, 1.5, 7), dtype)
    fy = jnp.asarray(rng.uniform(-1.5, 1.5, 5), dtype)
    s = jnp.asarray(rng.uniform(-4.0, -2.0, (5, 7)), dtype)
    return heights, fx, fy, s


def bound(heights, s, nodes, *, doubled):
    z = np.pi * float(jnp.ptp(s)) / 2 * float(jnp.ptp(heights))
    return phase.chebyshev_bound(2 * z if doubled else z, nodes)


@pytest.mark.parametrize("nodes", [3, 6, 14])
def test_averaged_grid_within_its_bound(rng, dtype, nodes):
    heights, fx, fy, s = job(rng, dtype)
    spread = jnp.asarray(0.4, dtype)
    wx = dtft.bin_weights(20, STEP, fx, jnp.broadcast_to(spread, fx.shape))
    wy = dtft.bin_weights(16, STEP, fy, jnp.broadcast_to(spread, fy.shape))
    run = jax.jit(lambda h: separable.averaged(h, s, wx, wy, nodes=nodes, grid=True))
    got = run(heights)
    expected = np.array(
        [
            [dtft.averaged_intensity(heights, s[j, i], wx[i], wy[j]) for i in range(7)]
            for j in range(5)
        ]
    )
    error = np.abs(got - expected).max()
    slack = 2e-6 if dtype == "float32" else 1e-14  # rounding of sums of order one
    assert error <= bound(heights, s, nodes, doubled=True) + slack
    if nodes == 3:
        assert error > 1e-6  # three points cannot do it: the bound is put to use


@pytest.mark.parametrize("grid", [True, False])
def test_coherent_within_its_bound(rng, dtype, grid):
    heights, fx, fy, s = job(rng, dtype)
    if not grid:
        fx, s = fx[:5], s[:, 0]
    sigma, center = jnp.asarray(0.4, dtype), jnp.asarray(0.1, dtype)
    axes = jax.vmap(lambda n, f: dtft.gaussian_axis(n, STEP, f, sigma, center), (None, 0), 1)
    ax, ay = axes(20, fx), axes(16, fy)
    nodes = 7
    got = separable.coherent(heights, s, ax, ay, nodes=nodes, grid=grid)
    pairs = [(j, i) for j in range(5) for i in range(7)] if grid else [(j, j) for j in range(5)]
    expected = [
        dtft.coherent_intensity(heights, s[j, i] if grid else s[j], ax[:, i], ay[:, j])
        for j, i in pairs
    ]
    e = bound(heights, s, nodes, doubled=False)
    slack = 2e-6 if dtype == "float32" else 1e-14
    assert np.abs(got.ravel() - np.array(expected)).max() <= 2 * e + e * e + slack


def test_gradients_are_those_of_the_direct_sum(rng):
    heights, fx, fy, s = job(rng, "float64")
    spread = jnp.full((5,), 0.4)
    weights = jnp.asarray(rng.uniform(0.1, 1, 5))

    def by_separable(heights, fx, s):
        wx, wy = dtft.bin_weights(20, STEP, fx, spread), dtft.bin_weights(16, STEP, fy, spread)
        return separable.averaged(heights, s, wx, wy, nodes=24, grid=False) @ weights

    def by_direct(heights, fx, s):
        wx, wy = dtft.bin_weights(20, STEP, fx, spread), dtft.bin_weights(16, STEP, fy, spread)
        each = jax.vmap(dtft.averaged_intensity, (None, 0, 0, 0))
        return each(heights, s, wx, wy) @ weights

    a = jax.grad(by_separable, (0, 1, 2))(heights, fx[:5], s[:, 0])
    b = jax.grad(by_direct, (0, 1, 2))(heights, fx[:5], s[:, 0])
    for got, expected in zip(a, b, strict=True):
        # 24 nodes interpolate to rounding; the derivative in s costs their square, 600 eps.
        np.testing.assert_allclose(
            got, expected, atol=1e-11 * float(jnp.abs(expected).max()) + 1e-13
        )


def test_a_single_w_needs_a_single_node(rng, dtype):
    heights, fx, fy, _ = job(rng, dtype)
    s = jnp.full((5, 7), -3.0, jnp.dtype(dtype))
    ones = jnp.ones((), dtype)
    wx = dtft.bin_weights(20, STEP, fx, jnp.broadcast_to(ones, fx.shape))
    wy = dtft.bin_weights(16, STEP, fy, jnp.broadcast_to(ones, fy.shape))
    one = separable.averaged(heights, s, wx, wy, nodes=1, grid=True)
    many = separable.averaged(heights, s, wx, wy, nodes=5, grid=True)
    np.testing.assert_allclose(one, many, rtol=1e-5 if dtype == "float32" else 1e-12)
    assert bool(
        jnp.isfinite(
            jax.grad(lambda s: separable.averaged(heights, s, wx, wy, nodes=3, grid=True).sum())(s)
        ).all()
    )
