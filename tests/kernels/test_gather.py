"""The gather on the tables of every expansion, against the direct sum."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import dtft, expansions, gather, phase

SHAPE, STEP, SIGMA = (24, 32), 0.1, 0.3
LOW, HIGH = -2.6, -1.2  # range of s, cycles per micrometre
EXPANSIONS = ("thesis", "taylor", "chebyshev", "lowrank")


@pytest.fixture
def heights(rng):
    return rng.uniform(0, 0.2, SHAPE)


def argument(heights, averaged):
    """z of the expansions over the whole range of s."""
    return 0.5 * np.pi * (HIGH - LOW) * np.ptp(heights) * (2 if averaged else 1)


def bound_of(kind, heights, terms, averaged, eps):
    """Bound on |P|^2 from the expansion alone."""
    z = argument(heights, averaged)
    if kind in ("chebyshev", "lowrank"):
        bound = phase.chebyshev_bound if kind == "chebyshev" else expansions.lowrank_bound
        e = bound(z, terms) + eps * (6 + z)
        return e if averaged else 2 * e + e**2
    x = 2 * np.pi * abs(LOW) * np.ptp(heights) * (0.5 if kind == "taylor" else 1.0)
    e = phase.taylor_bound(x, terms) + 0.5 * phase.taylor_rounding(x, eps)
    return 2 * e + e**2


def expansion(kind, heights, terms, averaged):
    """Coefficients in each bin, and the functions of s."""
    if kind in ("thesis", "taylor"):
        centred = kind == "taylor"
        spectra = gather.taylor_spectra(heights, terms, centred=centred)
        _, scale = gather.height_scale(heights, centred=centred)
        return spectra, lambda s: expansions.taylor_coefficients(2 * np.pi * s * scale, terms)
    dtype = heights.dtype
    span = heights.max() - heights.min()
    middle, half = expansions.interval(jnp.asarray(LOW, dtype), jnp.asarray(HIGH, dtype), span)
    series = None
    matrix = expansions.chebyshev_projection(terms, dtype)
    if kind == "lowrank":
        z = np.pi * half * span * (2 if averaged else 1)
        series = expansions.lowrank_series(z, terms)
        back = expansions.chebyshev_projection(series.shape[1], dtype)
        matrix = jnp.matmul(series, back, precision="highest")
    at = phase.chebyshev_points(matrix.shape[1], dtype) * half + middle
    make = gather.node_powers if averaged else gather.node_spectra
    spectra = gather.project(matrix, make(heights, at))
    return spectra, lambda s: expansions.coefficients((s - middle) / half, terms, series)


@partial(jax.jit, static_argnames=("kind", "terms", "reach", "averaged", "center"))
def evaluate(heights, f, s, *, kind, terms, reach, averaged, center=(0.0, 0.0)):
    """|P|^2 by the gather at frequencies f [n, 2] and s [n]."""
    dtype = heights.dtype
    whole, rest = gather.whole_pixels(jnp.asarray(center, dtype), (STEP, STEP))
    spectra, functions = expansion(kind, jnp.roll(heights, -whole, (0, 1)), terms, averaged)
    tables = gather.table(spectra, reach)
    if not averaged:
        turns = rest / (jnp.asarray(SHAPE, dtype) * jnp.asarray(STEP, dtype))
        tables = gather.move_origin(tables, turns, reach)

    def one(f, s):
        x = gather.axis_bins(SHAPE[1], STEP, f[0], reach)
        y = gather.axis_bins(SHAPE[0], STEP, f[1], reach)
        if averaged:
            spread = jnp.asarray(1 / (2 * np.pi * SIGMA), dtype)
            return gather.averaged(tables, functions(s), x, y, spread)
        return gather.coherent(tables, functions(s), x, y, jnp.asarray(SIGMA, dtype))

    return jax.vmap(one)(f, s)


@partial(jax.jit, static_argnames=("averaged", "center"))
def direct(heights, f, s, *, averaged, center=(0.0, 0.0)):
    dtype = heights.dtype
    sigma, c = jnp.asarray(SIGMA, dtype), jnp.asarray(center, dtype)

    def one(f, s):
        if averaged:
            spread = 1 / (2 * np.pi * sigma)
            wx = dtft.bin_weights(SHAPE[1], STEP, f[0], spread)
            wy = dtft.bin_weights(SHAPE[0], STEP, f[1], spread)
            return dtft.averaged_intensity(heights, s, wx, wy)
        ax = dtft.gaussian_axis(SHAPE[1], STEP, f[0], sigma, c[1])
        ay = dtft.gaussian_axis(SHAPE[0], STEP, f[1], sigma, c[0])
        return dtft.coherent_intensity(heights, s, ax, ay)

    return jax.vmap(one)(f, s)


# Frequencies at the end of the table, too, where the gather must wrap.
FREQUENCIES = [(0.0, 0.0), (1.3, -2.1), (4.9, 0.3), (-4.95, 4.97), (5.02, -0.1)]


@pytest.mark.parametrize("averaged", [True, False])
@pytest.mark.parametrize("kind", EXPANSIONS)
def test_exact_within_bounds_at_any_frequency(heights, kind, averaged, dtype):
    terms, reach = 14, 6
    options = {"averaged": averaged, "center": (0.0, 0.0) if averaged else (0.23, -0.11)}
    cut = gather.truncation_bound(reach, 2 * np.pi * SIGMA / (SHAPE[1] * STEP), squared=averaged)
    eps = float(jnp.finfo(dtype).eps)
    h = jnp.asarray(heights, dtype)
    f = jnp.asarray(np.repeat(FREQUENCIES, 3, axis=0), dtype)
    s = jnp.asarray(np.tile([LOW, -1.9, HIGH], len(FREQUENCIES)), dtype)
    got = evaluate(h, f, s, kind=kind, terms=terms, reach=reach, **options)
    error = np.abs(np.asarray(got) - np.asarray(direct(h, f, s, **options))).max()
    # The omitted bins of powers err as well: less than a tenth of the bound here.
    assert error <= 1.1 * bound_of(kind, heights, terms, averaged, eps) + cut + 8 * eps


@pytest.mark.parametrize("averaged", [True, False])
@pytest.mark.parametrize("kind", EXPANSIONS)
def test_bounds_are_put_to_use(heights, kind, averaged):
    """With few terms or bins the error is there, and below its bound."""
    h, f, s = jnp.asarray(heights), jnp.asarray([[0.4, 0.2]]), jnp.asarray([LOW])
    expected = direct(h, f, s, averaged=averaged)
    terms = {"thesis": 6, "taylor": 4, "chebyshev": 3, "lowrank": 2}[kind]
    options = {"averaged": averaged, "kind": kind}
    error = float(jnp.abs(evaluate(h, f, s, terms=terms, reach=10, **options) - expected)[0])
    # A random surface errs less than the worst one; still by something.
    assert 1e-6 < error <= bound_of(kind, heights, terms, averaged, 2.3e-16)
    ratio = 2 * np.pi * SIGMA / (SHAPE[1] * STEP)
    cut = float(jnp.abs(evaluate(h, f, s, terms=25, reach=1, **options) - expected)[0])
    assert 1e-6 < cut <= gather.truncation_bound(1, ratio, squared=averaged)


@pytest.mark.parametrize("center", [(0.0, 0.0), (0.31, -0.07), (-5.93, 11.2)])
def test_a_window_anywhere(heights, center):
    h, f, s = jnp.asarray(heights), jnp.asarray(FREQUENCIES), jnp.full(5, -1.7)
    options = {"averaged": False, "center": center}
    got = evaluate(h, f, s, kind="chebyshev", terms=20, reach=11, **options)
    # The gather leaves out exp(-(11.5 x 0.59)^2 / 2) = 1e-10 of the amplitude.
    np.testing.assert_allclose(got, direct(h, f, s, **options), atol=1e-9)


def test_both_orders_of_summation_agree(rng, dtype):
    tables = jnp.asarray(rng.normal(size=(12, 15, 2, 5)), dtype)
    a = jnp.asarray(rng.normal(size=5), dtype)
    wx, wy = (jnp.asarray(rng.normal(size=7), dtype) for _ in range(2))
    anchor = jnp.asarray(3), jnp.asarray(8)
    bins = gather.gather_bins(tables, a, anchor, taps=7)
    expected = np.einsum("yxpn,n->yxp", np.asarray(tables)[3:10, 8:15], np.asarray(a))
    # Sums of 5, and of 245, products of size one.
    tolerance = 100 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(bins, expected, atol=tolerance)
    got = jax.jit(gather.gather_sum)(tables, a, anchor, wx, wy)
    expected = np.einsum("yxp,y,x->p", expected, np.asarray(wy), np.asarray(wx))
    np.testing.assert_allclose(got, expected, atol=4 * tolerance)


def test_long_gathers_take_the_loop(rng):
    """More rows than are written out one after the other."""
    taps = gather.ROWS + 5
    tables = jnp.asarray(rng.normal(size=(taps + 3, taps + 2, 1, 3)))
    a, wx, wy = (jnp.asarray(rng.normal(size=n)) for n in (3, taps, taps))
    got = gather.gather_sum(tables, a, (jnp.asarray(2), jnp.asarray(1)), wx, wy)
    block = np.asarray(tables)[2 : 2 + taps, 1 : 1 + taps, 0] @ np.asarray(a)
    np.testing.assert_allclose(got[0], np.asarray(wy) @ block @ np.asarray(wx), rtol=1e-11)


@pytest.mark.parametrize("kind", ["taylor", "lowrank"])
@pytest.mark.parametrize("averaged", [True, False])
def test_gradients_in_direction_and_height(heights, kind, averaged):
    options = {"kind": kind, "terms": 20, "reach": 11, "averaged": averaged}
    at = jnp.asarray(heights), jnp.asarray([[1.23, -0.3]]), jnp.asarray([-2.2])
    got = jax.grad(lambda *a: evaluate(*a, **options)[0], (0, 1, 2))(*at)
    expected = jax.grad(lambda *a: direct(*a, averaged=averaged)[0], (0, 1, 2))(*at)
    for a, b in zip(got, expected, strict=True):
        # What the gather leaves out, 1e-10 of the amplitude, times its slope.
        np.testing.assert_allclose(a, b, atol=1e-8)


def test_one_compilation_for_all_directions(heights):
    h = jnp.asarray(heights)
    options = {"kind": "chebyshev", "terms": 13, "reach": 4, "averaged": True}
    before = evaluate._cache_size()
    for shift in (0.0, 0.3):
        f = jnp.asarray(FREQUENCIES) + shift
        s = jnp.linspace(LOW, HIGH, 5)
        got, expected = evaluate(h, f, s, **options), direct(h, f, s, averaged=True)
        # exp(-(4.5 x 0.59)^2) = 9e-4 of the power at most is cut off.
        np.testing.assert_allclose(got, expected, atol=9e-4)
        assert not np.allclose(got, expected, atol=1e-9)
    assert evaluate._cache_size() == before + 1
