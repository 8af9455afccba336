"""The direct windowed transform: oracles, derivatives, transformations."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from diffopt.kernels import dtft
from reference import direct_p, window_p

PIXEL = (0.11, 0.07)
Q = np.array([0.31, -0.47, -3.1])
SIGMA = 0.31


def surface(rng, shape=(20, 28)):
    return rng.uniform(-0.1, 0.15, shape)


def factors(heights, q, sigma, center, dtype=jnp.float64):
    ny, nx = heights.shape
    arrays = [jnp.asarray(x, dtype) for x in (q[0], q[1], sigma, *center)]
    return (
        dtft.gaussian_axis(nx, PIXEL[1], arrays[0], arrays[2], arrays[4]),
        dtft.gaussian_axis(ny, PIXEL[0], arrays[1], arrays[2], arrays[3]),
    )


@pytest.mark.parametrize("center", [(0.0, 0.0), (0.4, -0.3), (5.0, 2.0)])
def test_window_against_numpy(rng, center):
    heights = surface(rng)
    ax, ay = factors(heights, Q, SIGMA, center)
    re, im = dtft.amplitude(jnp.asarray(heights), jnp.asarray(Q[2]), ax, ay)
    expected = window_p(heights, PIXEL, Q, SIGMA, center, copies=6)
    if center == (5.0, 2.0):
        # The kernel moves the window to the nearest copy: only the phase may differ.
        assert abs(complex(re, im)) == pytest.approx(abs(expected), abs=1e-13)
    else:
        assert complex(re, im) == pytest.approx(expected, abs=1e-13)


def test_bare_patch_against_numpy(rng):
    heights = surface(rng)
    ax = dtft.finite_axis(28, PIXEL[1], jnp.asarray(Q[0]))
    ay = dtft.finite_axis(20, PIXEL[0], jnp.asarray(Q[1]))
    re, im = dtft.amplitude(jnp.asarray(heights), jnp.asarray(Q[2]), ax, ay)
    assert complex(re, im) == pytest.approx(direct_p(heights, PIXEL, Q) / 560, abs=1e-14)


def test_average_is_the_mean_over_positions(rng):
    """sum |c|^2 phi^2 equals the mean of |P|^2 over windows at every pixel."""
    heights = surface(rng, (12, 16))
    values = []
    for j in range(12):
        for i in range(16):
            center = ((j - 6) * PIXEL[0], (i - 8) * PIXEL[1])
            ax, ay = factors(heights, Q, SIGMA, center)
            values.append(dtft.coherent_intensity(jnp.asarray(heights), jnp.asarray(Q[2]), ax, ay))
    spread = jnp.asarray(1 / (2 * np.pi * SIGMA))
    wx = dtft.bin_weights(16, PIXEL[1], jnp.asarray(Q[0]), spread)
    wy = dtft.bin_weights(12, PIXEL[0], jnp.asarray(Q[1]), spread)
    got = dtft.averaged_intensity(jnp.asarray(heights), jnp.asarray(Q[2]), wx, wy)
    # Aliases of the sampled window: exp(-2 pi^2 sigma^2 / dy^2) = 1e-68.
    assert float(got) == pytest.approx(float(np.mean(values)), rel=1e-12)


def test_power_spectrum_keeps_the_energy(rng, dtype):
    heights = jnp.asarray(surface(rng, (16, 24)), dtype)
    power = dtft.power_spectrum(heights, jnp.asarray(-3.0, dtype))
    assert float(power.sum()) == pytest.approx(1.0, abs=2e-6 if dtype == "float32" else 1e-14)
    rest = dtft.power_spectrum(heights, jnp.asarray(-3.0, dtype), drop_mean=True)
    assert float(rest[0, 0]) == 0.0
    np.testing.assert_array_equal(rest.ravel()[1:], power.ravel()[1:])


@pytest.mark.parametrize("drop_mean", [False, True])
def test_closed_forms_against_differences(rng, drop_mean):
    heights = jnp.asarray(surface(rng, (5, 6)))
    s = jnp.asarray(-2.3)
    ax, ay = factors(heights, Q, SIGMA, (0.1, 0.0))
    single = lambda *a: dtft.coherent_intensity(*map(jnp.asarray, a))  # noqa: E731
    check_grads(single, (heights, s, ax, ay), order=1, atol=2e-5, rtol=2e-5)
    wx, wy = jnp.asarray(rng.uniform(0, 1, 6)), jnp.asarray(rng.uniform(0, 1, 5))
    averaged = lambda *a: dtft.averaged_intensity(*map(jnp.asarray, a), drop_mean)  # noqa: E731
    check_grads(averaged, (heights, s, wx, wy), order=1, atol=2e-5, rtol=2e-5)


def test_closed_form_equals_plain_autodiff(rng, dtype):
    """The custom derivative against autodiff of the same sum in complex arithmetic."""
    heights = jnp.asarray(surface(rng), dtype)
    ax, ay = factors(heights, Q, SIGMA, (0.0, 0.0), jnp.dtype(dtype))
    s = jnp.asarray(Q[2], dtype)

    def plain(heights, s):
        p = jnp.exp(2j * jnp.pi * jax.lax.complex(s * heights, jnp.zeros_like(heights)))
        y, x = jax.lax.complex(*ay), jax.lax.complex(*ax)
        total = jnp.einsum("j,ji,i->", y, p, x, precision="highest")
        return total.real**2 + total.imag**2

    by_closed = jax.grad(dtft.coherent_intensity, (0, 1))(heights, s, ax, ay)
    by_plain = jax.grad(plain, (0, 1))(heights, s)
    # Rounding: eps on each of two sums of terms of the gradient's own size.
    eps = 5e-6 if dtype == "float32" else 1e-13
    scale = float(jnp.abs(by_plain[0]).max())
    np.testing.assert_allclose(by_closed[0], by_plain[0], atol=eps * scale)
    assert float(by_closed[1]) == pytest.approx(float(by_plain[1]), rel=20 * eps)


def test_forward_equals_reverse(rng):
    heights = jnp.asarray(surface(rng, (6, 7)))
    ax, ay = factors(heights, Q, SIGMA, (0.0, 0.0))
    f = lambda h: dtft.coherent_intensity(h, jnp.asarray(-2.0), ax, ay)  # noqa: E731
    np.testing.assert_allclose(
        jax.jacfwd(f)(heights), jax.jacrev(f)(heights), rtol=1e-12, atol=1e-15
    )


def test_maps_over_heights_without_retracing(rng):
    stack = jnp.asarray(np.stack([surface(rng) for _ in range(3)]))
    ax, ay = factors(stack[0], Q, SIGMA, (0.0, 0.0))

    @eqx.filter_jit
    @eqx.debug.assert_max_traces(max_traces=1)
    def gradients(stack, s):
        return jax.vmap(jax.grad(dtft.coherent_intensity), (0, None, None, None))(stack, s, ax, ay)

    for s in (-1.0, -2.0):
        got = gradients(stack, jnp.asarray(s))
        one = jax.grad(dtft.coherent_intensity)(stack[1], jnp.asarray(s), ax, ay)
        np.testing.assert_allclose(got[1], one, rtol=1e-10, atol=1e-14)


def test_invariances(rng):
    """|P|^2 of one period does not see an offset, and the twin -h(-x) looks the same."""
    heights = jnp.asarray(surface(rng, (15, 21)))
    spread = jnp.asarray(0.6)
    wx = dtft.bin_weights(21, PIXEL[1], jnp.asarray(Q[0]), spread)
    wy = dtft.bin_weights(15, PIXEL[0], jnp.asarray(Q[1]), spread)
    f = lambda h: float(dtft.averaged_intensity(h, jnp.asarray(Q[2]), wx, wy))  # noqa: E731
    base = f(heights)
    assert f(heights + 7.3) == pytest.approx(base, rel=1e-11)
    assert f(jnp.roll(heights, (3, 5), (0, 1))) == pytest.approx(base, rel=1e-11)
    assert f(-heights[::-1, ::-1]) == pytest.approx(base, rel=1e-11)
