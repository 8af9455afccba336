"""Expansions of exp(2 pi i s h) in s, against the exponential itself."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import expansions, phase

# Phase ranges 2 pi s_max (h_max - h_min) of the diffraction model; z is a quarter of them.
RANGES = (1.0, 1.5 * np.pi, 10.0, 30.0)


def expanded(z, terms, kind, x, t, dtype="float64"):
    """exp(i z x t) on the grid x, t by an expansion; only the sums over terms in `dtype`."""
    series = None
    matrix = expansions.chebyshev_projection(terms, jnp.dtype(dtype))
    if kind == "lowrank":
        series = expansions.lowrank_series(jnp.asarray(z, dtype), terms)
        matrix = jnp.matmul(
            series,
            expansions.chebyshev_projection(series.shape[1], jnp.dtype(dtype)),
            precision="highest",
        )
    points = np.cos(np.pi * (np.arange(matrix.shape[1]) + 0.5) / matrix.shape[1])
    values = np.exp(1j * z * np.outer(points, t))
    a = expansions.coefficients(jnp.asarray(x, dtype), terms, series)
    re, im = (
        jnp.matmul(a, jnp.matmul(matrix, jnp.asarray(v, dtype), precision="highest"),
                   precision="highest")
        for v in (values.real, values.imag)
    )  # fmt: skip
    return np.asarray(re, np.float64) + 1j * np.asarray(im, np.float64)


def worst(z, terms, kind, dtype="float64"):
    # Numbers that both dtypes hold: their rounding is not the expansion's.
    x = np.linspace(-1, 1, 257)
    return np.abs(expanded(z, terms, kind, x, x, dtype) - np.exp(1j * z * np.outer(x, x))).max()


def bound(z, terms, kind):
    if kind == "lowrank":
        return expansions.lowrank_bound(z, terms)
    return phase.chebyshev_bound(z, terms)


def fewest(z, error, kind):
    if kind == "lowrank":
        return expansions.lowrank_terms(z, error)
    return phase.chebyshev_nodes(z, error)


@pytest.mark.parametrize("kind", ["chebyshev", "lowrank"])
@pytest.mark.parametrize("z", [1e-8, 0.25, 1.2, 7.5, 75.0])
def test_bounds_hold_and_are_tight(z, kind):
    for error in (1e-2, 1e-8):
        terms = fewest(z, error, kind)
        got = worst(z, terms, kind)
        # 2e-14: rounding of this sum of up to 111 terms.
        assert got <= bound(z, terms, kind) + 2e-14 <= error + 2e-14
        assert bound(z, terms, kind) <= 4.0 * got
        assert terms == 1 or bound(z, terms - 1, kind) > error


@pytest.mark.parametrize("kind", ["chebyshev", "lowrank"])
def test_terms_are_those_published(kind):
    """Against the terms of carrier-Chebyshev and SVD in the model's notes, section 11."""
    published = {
        "chebyshev": [(4, 5, 6, 9), (6, 8, 9, 13), (8, 10, 12, 16), (14, 17, 20, 25)],
        "lowrank": [(3, 4, 5, 7), (5, 7, 8, 11), (6, 8, 10, 13), (10, 13, 15, 19)],
    }[kind]
    for x, counts in zip(RANGES, published, strict=True):
        found = [fewest(x / 4, 0.5 * e, kind) for e in (1e-2, 1e-4, 1e-6, 1e-10)]
        # The notes measured the error on heights; the bound on the amplitude is no worse.
        assert all(f <= c for f, c in zip(found, counts, strict=True)), (x, found)
        assert all(f >= c - 2 for f, c in zip(found, counts, strict=True)), (x, found)


def test_low_rank_takes_the_fewest_terms():
    for z in (1.2, 7.5, 30.0):
        for error in (1e-2, 1e-6):
            assert expansions.lowrank_terms(z, error) < phase.chebyshev_nodes(z, error)


@pytest.mark.parametrize("kind", ["chebyshev", "lowrank"])
@pytest.mark.parametrize("range_", [5.0, 30.0, 100.0, 300.0])
def test_rounding_in_float32_does_not_grow_like_the_taylor_terms(range_, kind):
    z = range_ / 4
    terms = fewest(z, 1e-9, kind)
    # What `diffopt.bounds` adds; half of z is that of the phase itself. The Taylor terms
    # lose eps exp(2 z).
    assert worst(z, terms, kind, "float32") <= 1.2e-7 * (6 + z)


@pytest.mark.parametrize("z", [0.0, 1e-8, 300.0])
@pytest.mark.parametrize("kind", ["chebyshev", "lowrank"])
def test_the_ends_of_z(z, kind, dtype):
    terms = fewest(z, 1e-9, kind)
    assert terms >= (1 if z < 1 else z / 2)
    eps = float(jnp.finfo(dtype).eps)
    assert worst(z, terms, kind, dtype) <= 2e-9 + eps * (6 + z)
    assert bound(z, 1, kind) <= (1e-7 if z < 1 else 5.0)


def test_any_z_gives_a_valid_expansion():
    """The basis made for one z expands another, smaller one, as well."""
    x = np.linspace(-1, 1, 101)
    series = expansions.lowrank_series(jnp.asarray(4.0), 16)
    points = np.cos(np.pi * (np.arange(series.shape[1]) + 0.5) / series.shape[1])
    matrix = series @ expansions.chebyshev_projection(series.shape[1], series.dtype)
    for z in (0.0, 1.0, 3.9):
        values = np.asarray(matrix) @ np.exp(1j * z * np.outer(points, x))
        got = np.asarray(expansions.coefficients(jnp.asarray(x), 16, series)) @ values
        # The bound at the basis's own z is 2e-12.
        assert np.abs(got - np.exp(1j * z * np.outer(x, x))).max() < 1e-11


def test_gradients_under_jit_and_vmap(dtype):
    """To x through the functions, to heights through the values at the points."""
    z, terms = 5.0, 16
    series = expansions.lowrank_series(jnp.asarray(z, dtype), terms)
    nodes = series.shape[1]
    matrix = series @ expansions.chebyshev_projection(nodes, series.dtype)
    points = phase.chebyshev_points(nodes, series.dtype)
    assert expansions.lowrank_bound(z, terms) < 1e-8

    def cosine(x, t):
        return expansions.coefficients(x, terms, series) @ (matrix @ jnp.cos(z * points * t))

    many = jax.jit(jax.vmap(jax.grad(cosine, (0, 1))))

    x = jnp.asarray([-1.0, -0.3, 0.0, 0.77, 1.0], dtype)
    t = jnp.asarray([0.9, 1.0, -1.0, 0.0, 1.0], dtype)
    slopes = many(x, t)
    many(0.5 * x, t)
    assert many._cache_size() == 1
    phases = z * np.asarray(x, float) * np.asarray(t, float)
    # Slopes at the ends are up to the square of the degree times the error of the value.
    tolerance = 1e-6 + 600 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(slopes[0], -z * np.asarray(t) * np.sin(phases), atol=tolerance)
    np.testing.assert_allclose(slopes[1], -z * np.asarray(x) * np.sin(phases), atol=tolerance)


def test_beyond_the_interval_the_end_is_kept(dtype):
    x = jnp.asarray([-7.0, 1.5, 1e30], dtype)
    got = expansions.coefficients(x, 40)
    expected = expansions.coefficients(jnp.sign(x), 40)
    np.testing.assert_array_equal(got, expected)
    slope = jax.vmap(jax.grad(lambda x: expansions.coefficients(x, 40).sum()))(x)
    np.testing.assert_array_equal(slope, 0.0)


@pytest.mark.parametrize("span", [0.0, 1e-6, 0.3, 20.0])
def test_interval_of_a_single_s_sweeps_half_a_radian(span, dtype):
    for s in (0.0, -5.0, -1e-3):
        s = jnp.asarray(s, dtype)
        middle, half = expansions.interval(s, s, jnp.asarray(span, dtype))
        assert float(middle) == float(s)
        assert 0.0 < float(half) <= 1.000001 * (1 + abs(float(s)))
        assert np.pi * float(half) * span == pytest.approx(
            min(0.5, np.pi * span * (1 + abs(float(s)))), rel=1e-6
        )
    low, high = jnp.asarray(-5.0, dtype), jnp.asarray(-1.0, dtype)
    wide = expansions.interval(low, high, jnp.asarray(1.0, dtype))
    assert tuple(map(float, wide)) == (-3.0, 2.0)
    slope = jax.grad(lambda a, h: sum(expansions.interval(a, high, h)), (0, 1))
    assert tuple(map(float, slope(low, high))) == (0.0, 0.0)


def test_error_below_the_rounding_of_the_bound_is_refused():
    with pytest.raises(ValueError, match=r"error must exceed 8\.6e-14 at z = 39; got 1e-16"):
        expansions.lowrank_terms(39.0, 1e-16)
