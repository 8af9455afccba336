"""Harmonics of lobes against Bessel functions of 40 digits, quadrature and their limits."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from scipy.special import ive, roots_legendre

from diffopt.kernels import harmonics, lobe_harmonics, vmf

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
KAPPAS = [0.01, 0.9999, 1.0, 1.5, 3.0, 30.0, 200.0, 600.0, 2e3, 1e4, 1e6, 1e8]


def ratios(kappa, bands):
    return jax.jit(lobe_harmonics.ratios, static_argnums=1)(kappa, bands)


@pytest.mark.parametrize("bands", [1, 2, 9, 65])
def test_against_bessel_functions_of_many_digits(bands, dtype):
    kappa = jnp.asarray(KAPPAS, dtype)
    found = np.asarray(ratios(kappa, bands), np.float64)
    assert found.shape == (bands, len(KAPPAS))
    _, slopes = jax.jvp(lambda k: ratios(k, bands), (kappa,), (jnp.ones_like(kappa),))
    with mpmath.workdps(40):
        for column, value in enumerate(np.asarray(kappa, np.float64)):
            k = mpmath.mpf(float(value))
            scale = mpmath.besseli(0.5, k)
            exact = [mpmath.besseli(degree + 0.5, k) / scale for degree in range(bands + 1)]
            expected = np.array([float(x) for x in exact[:bands]])
            # Relative, down to numbers that float32 has: rounding adds up over the degrees; of
            # the start of the recurrence 2e-15 is left.
            error = np.abs(found[:, column] - expected)
            allowed = (8 + bands) * EPS[dtype] * expected + 1e-14 * expected + 1e-37
            assert (error <= allowed).all(), value
            slope = [
                (n * exact[n - 1] + (n + 1) * exact[n + 1]) / (2 * n + 1) - exact[1] * exact[n]
                for n in range(1, bands)
            ]
            slope = np.array([0.0, *map(float, slope)])
            # A slope of 1 / kappa^2 from ratios whose rounding is eps: up to 2e-3 at 1e8 in
            # float32.
            share = 5e-3 if dtype == "float32" else 5e-11
            error = np.abs(np.asarray(slopes[:, column], np.float64) - slope)
            assert (error <= share * np.abs(slope) + 1e-37).all(), value


def test_against_scipy(dtype):
    kappa = np.logspace(-1, 2.5, 40)
    degree = np.arange(12)[:, None]
    expected = ive(degree + 0.5, kappa) / ive(0.5, kappa)
    # Rounding of kappa moves the ratios of high degree by as many eps as the degree.
    found = ratios(jnp.asarray(kappa, dtype), 12)
    np.testing.assert_allclose(found, expected, rtol=32 * EPS[dtype] + 5e-13)


def test_limits(dtype):
    kappa = jnp.asarray([0.0, 1e8], dtype)
    found = np.asarray(ratios(kappa, 64), np.float64)
    np.testing.assert_array_equal(found[:, 0], np.eye(64)[0])
    degree = np.arange(64)
    expected = np.exp(-degree * (degree + 1) / 2e8)
    np.testing.assert_allclose(found[:, 1], expected, atol=32 * EPS[dtype] + 1e-12)
    slopes = jax.jacfwd(lambda k: ratios(k, 4))(jnp.asarray(0.0, dtype))
    np.testing.assert_allclose(slopes, [0.0, 1 / 3, 0.0, 0.0], rtol=4 * EPS[dtype])


def test_they_fall_with_the_degree(dtype):
    """0 <= A_(l+1) <= A_l <= 1, and they grow with kappa, up to rounding."""
    found = np.asarray(ratios(jnp.asarray(np.logspace(-6, 8, 300), dtype), 64), np.float64)
    assert (found >= 0).all()
    # Rounding adds up over 64 factors.
    assert (found <= 1 + 32 * EPS[dtype]).all()
    assert (np.diff(found, axis=0) <= 32 * EPS[dtype]).all()
    assert (np.diff(found, axis=1) >= -64 * EPS[dtype]).all()


def test_they_are_the_harmonics_of_lobes():
    """sqrt((2l + 1) / 4 pi) A_l is the integral of the density times Y_l0."""
    x, w = roots_legendre(200)
    directions = np.stack([np.sqrt(1 - x * x), 0 * x, x], -1)
    values = harmonics.numpy_basis(directions, 10)[[harmonics.index(n, 0) for n in range(10)]]
    degree = np.arange(10)
    for kappa in (0.3, 5.0, 80.0):
        up = jnp.asarray([0.0, 0.0, 1.0])
        density = np.asarray(vmf.pdf(jnp.asarray(directions), up[None], jnp.asarray([kappa])))
        expected = 2 * np.pi * values @ (w * density)
        found = np.sqrt((2 * degree + 1) / (4 * np.pi)) * ratios(jnp.asarray(kappa), 10)
        # 200 nodes: exact to rounding, times the largest value of 3.
        np.testing.assert_allclose(found, expected, atol=1e-13)


def test_no_bands():
    with pytest.raises(ValueError, match="at least 1"):
        lobe_harmonics.ratios(jnp.ones(2), 0)
