"""Taylor tables and the Gaussian gather, against the direct sum."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import dtft, gather, phase

SHAPE, STEP, SIGMA = (24, 32), 0.1, 0.3


@pytest.fixture
def heights(rng):
    return rng.uniform(0, 0.2, SHAPE)


def argument_bound(heights, s, centred):
    x = 2 * np.pi * abs(s) * np.ptp(heights)
    return 0.5 * x if centred else x


def evaluate(heights, f, s, *, terms, reach, centred, averaged, center=(0.0, 0.0)):
    dtype = heights.dtype
    tables = gather.taylor_tables(heights, reach, terms=terms, centred=centred)
    _, scale = gather.height_scale(heights, centred=centred)
    f = jnp.asarray(f, dtype)
    x = gather.axis_bins(SHAPE[1], STEP, f[0], reach)
    y = gather.axis_bins(SHAPE[0], STEP, f[1], reach)
    argument = jnp.asarray(2 * np.pi * s, dtype) * scale
    if averaged:
        spread = jnp.asarray(1 / (2 * np.pi * SIGMA), dtype)
        return gather.averaged(tables, argument, x, y, spread, SHAPE)
    return gather.coherent(
        tables, argument, x, y, jnp.asarray(SIGMA, dtype), jnp.asarray(center, dtype)
    )


def direct(heights, f, s, *, averaged, center=(0.0, 0.0)):
    dtype = heights.dtype
    f, s = jnp.asarray(f, dtype), jnp.asarray(s, dtype)
    sigma, c = jnp.asarray(SIGMA, dtype), jnp.asarray(center, dtype)
    if averaged:
        spread = 1 / (2 * np.pi * sigma)
        wx = dtft.bin_weights(SHAPE[1], STEP, f[0], spread)
        wy = dtft.bin_weights(SHAPE[0], STEP, f[1], spread)
        return dtft.averaged_intensity(heights, s, wx, wy)
    ax = dtft.gaussian_axis(SHAPE[1], STEP, f[0], sigma, c[1])
    ay = dtft.gaussian_axis(SHAPE[0], STEP, f[1], sigma, c[0])
    return dtft.coherent_intensity(heights, s, ax, ay)


@pytest.mark.parametrize("averaged", [True, False])
@pytest.mark.parametrize("centred", [True, False])
@pytest.mark.parametrize(
    "f", [(0.0, 0.0), (1.3, -2.1), (4.9, 0.3), (-4.95, 4.97), (5.02, -0.1)], ids=str
)
def test_exact_within_bounds_at_any_frequency(heights, f, centred, averaged, dtype):
    """Including frequencies at the end of the table, where the gather must wrap."""
    h, s, terms, reach = jnp.asarray(heights, dtype), -2.4, 14, 6
    options = {"averaged": averaged}
    if not averaged:
        options["center"] = (0.2, -0.1)
    got = float(evaluate(h, f, s, terms=terms, reach=reach, centred=centred, **options))
    expected = float(direct(h, f, s, **options))
    x = argument_bound(heights, s, centred)
    e = phase.taylor_bound(x, terms)
    cut = gather.truncation_bound(reach, 2 * np.pi * SIGMA / (SHAPE[1] * STEP), squared=averaged)
    eps = float(jnp.finfo(dtype).eps)
    assert abs(got - expected) <= 2 * e + e * e + cut + phase.taylor_rounding(x, eps) + 8 * eps


def test_bounds_are_put_to_use(heights):
    """With few terms or bins the error is there, and below its bound."""
    h, f, s = jnp.asarray(heights), (0.4, 0.2), -2.4
    expected = float(direct(h, f, s, averaged=True))
    x = argument_bound(heights, s, False)
    error = abs(float(evaluate(h, f, s, terms=5, reach=7, centred=False, averaged=True)) - expected)
    e = phase.taylor_bound(x, 5)
    assert 1e-4 < error <= 2 * e + e * e
    ratio = 2 * np.pi * SIGMA / (SHAPE[1] * STEP)
    cut = abs(float(evaluate(h, f, s, terms=25, reach=1, centred=False, averaged=True)) - expected)
    assert 1e-6 < cut <= gather.truncation_bound(1, ratio, squared=True)


def test_drop_mean_leaves_out_the_zero_order(heights, dtype):
    h = jnp.asarray(heights, dtype)
    tables = gather.taylor_tables(h, 5, terms=16, centred=True)
    _, scale = gather.height_scale(h, centred=True)
    argument = jnp.asarray(-2 * np.pi * 2.4, dtype) * scale
    spread = jnp.asarray(0.5, dtype)
    for f in ((0.05, -0.1), (0.9, 0.0), (3.0, 2.0)):
        fx, fy = (jnp.asarray(v, dtype) for v in f)
        x, y = gather.axis_bins(SHAPE[1], STEP, fx, 5), gather.axis_bins(SHAPE[0], STEP, fy, 5)
        got = gather.averaged(tables, argument, x, y, spread, SHAPE, drop_mean=True)
        wx = dtft.bin_weights(SHAPE[1], STEP, fx, spread)
        wy = dtft.bin_weights(SHAPE[0], STEP, fy, spread)
        expected = dtft.averaged_intensity(h, jnp.asarray(-2.4, dtype), wx, wy, True)
        # Gather cut at reach 5: exp(-(5.5 / 3.2 / 0.5)^2) = 7e-6 on the coarse axis.
        assert float(got) == pytest.approx(float(expected), abs=2e-5)


def test_gradients_in_direction_and_height(heights):
    h = jnp.asarray(heights)

    def by_gather(h, fx, s):
        tables = gather.taylor_tables(h, 8, terms=24, centred=True)
        _, scale = gather.height_scale(h, centred=True)
        x = gather.axis_bins(SHAPE[1], STEP, fx, 8)
        y = gather.axis_bins(SHAPE[0], STEP, jnp.asarray(-0.3), 8)
        return gather.averaged(tables, 2 * np.pi * s * scale, x, y, jnp.asarray(0.5), SHAPE)

    def by_direct(h, fx, s):
        wx = dtft.bin_weights(SHAPE[1], STEP, fx, jnp.asarray(0.5))
        wy = dtft.bin_weights(SHAPE[0], STEP, jnp.asarray(-0.3), jnp.asarray(0.5))
        return dtft.averaged_intensity(h, s, wx, wy)

    at = (h, jnp.asarray(1.23), jnp.asarray(-2.2))
    a, b = jax.grad(by_gather, (0, 1, 2))(*at), jax.grad(by_direct, (0, 1, 2))(*at)
    for got, expected in zip(a, b, strict=True):
        # Gather cut at reach 8 and spread 0.5: exp(-28) = 5e-13, times its slope.
        np.testing.assert_allclose(got, expected, atol=1e-9)


def test_jit_and_vmap_over_directions(heights):
    h = jnp.asarray(heights)
    tables = gather.taylor_tables(h, 4, terms=12, centred=True)

    @jax.jit
    def many(fx, argument):
        def one(fx, argument):
            x = gather.axis_bins(SHAPE[1], STEP, fx, 4)
            y = gather.axis_bins(SHAPE[0], STEP, 0.0 * fx, 4)
            return gather.averaged(tables, argument, x, y, jnp.asarray(0.5), SHAPE)

        return jax.vmap(one)(fx, argument)

    fx, argument = jnp.linspace(-2, 2, 9), jnp.linspace(-1, 1, 9)
    got = many(fx, argument)
    assert got.shape == (9,)
    assert float(got[4]) > 0
    assert many._cache_size() == 1
