"""Spherical harmonics, of the sphere and of the hemisphere, against many digits and two peers."""

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import sphericart
from scipy.special import sph_harm_y

from diffopt.kernels import harmonics, hemispherical

DATA = json.loads((Path(__file__).parents[1] / "data" / "harmonics.json").read_text())
NORTH = np.array([0.0, 0.0, 1.0])
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}

basis = jax.jit(harmonics.basis, static_argnames="bands")
spread = jax.jit(hemispherical.spread)
cap = jax.jit(harmonics.cap, static_argnames="bands")


def spherical(theta, phi):
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)


def directions(rng, count):
    """Random ones, and both poles."""
    d = rng.normal(size=(count, 3))
    return np.concatenate([d / np.linalg.norm(d, axis=-1, keepdims=True), [NORTH, -NORTH]])


@pytest.mark.parametrize("bands", [11, 65])
def test_values_of_many_digits(bands):
    rows = [r for r in DATA["basis"] if (r[0] > 10) == (bands == 65)]
    degree, order, theta, phi, expected = np.array(rows).T
    d = spherical(theta, phi)
    place = (degree * degree + degree + order).astype(int), np.arange(len(rows))
    np.testing.assert_allclose(basis(jnp.asarray(d), bands)[place], expected, atol=1e-12, rtol=0)
    found = harmonics.numpy_basis(d, bands)[place]
    np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)


# Errors of the recurrence, of directions that are exact.
@pytest.mark.float32
@pytest.mark.parametrize(("bands", "error"), [(4, 2e-7), (11, 1.4e-6), (33, 1.1e-5), (65, 4.7e-5)])
def test_float32(bands, error, rng):
    d = jnp.asarray(directions(rng, 500), jnp.float32)
    values = basis(d, bands)
    assert values.dtype == jnp.float32
    exact = harmonics.numpy_basis(np.asarray(d, float), bands)
    assert np.abs(np.asarray(values, float) - exact).max() <= error


def test_scipy(rng):
    """Its harmonics are complex, with the phase of Condon and Shortley."""
    d = directions(rng, 20)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    found = basis(jnp.asarray(d), 11)
    for i, (degree, order) in enumerate(
        zip(harmonics.degrees(11), harmonics.orders(11), strict=True)
    ):
        value = sph_harm_y(degree, abs(order), theta, phi) * (-1.0) ** order
        part = value.imag if order < 0 else value.real
        np.testing.assert_allclose(found[i], part * (2**0.5 if order else 1), atol=1e-13)


def test_sphericart(rng):
    d = directions(rng, 20)
    peer = sphericart.SphericalHarmonics(10).compute(d)
    np.testing.assert_allclose(basis(jnp.asarray(d), 11), peer.T, atol=1e-13)


def test_the_recurrence_unrolled_and_not(rng):
    d = jnp.asarray(directions(rng, 20))
    bands = harmonics.UNROLLED
    np.testing.assert_allclose(basis(d, bands), basis(d, bands + 1)[: bands**2], atol=1e-14)


@pytest.mark.parametrize("bands", [1, 4])
def test_orthonormal_exactly_where_the_rule_says(bands):
    def worst(polar, azimuthal):
        values, weights = harmonics.values_on(polar, azimuthal, bands)
        return np.abs((values * weights) @ values.T - np.eye(bands * bands)).max()

    assert worst(bands, 2 * bands - 1) < 1e-14
    assert worst(bands + 3, 2 * bands + 2) < 1e-14
    if bands > 1:
        assert worst(bands - 1, 2 * bands - 1) > 0.9
        assert worst(bands, 2 * bands - 2) > 0.9


def test_projection_and_evaluation_are_inverse(rng, dtype):
    nodes, weights = (jnp.asarray(part, dtype) for part in harmonics.sphere_rule(4, 7))
    c = jnp.asarray(rng.normal(size=(16, 2)), dtype)
    values = harmonics.evaluate(c[:, None, :], nodes[:, None, :])
    back = harmonics.project(values, nodes, weights, 4)
    assert values.shape == (28, 2)
    assert back.dtype == dtype
    np.testing.assert_allclose(back, c, atol=20 * EPS[dtype])


@pytest.mark.float32
@pytest.mark.parametrize(
    ("c", "d", "shape"), [((16,), (5, 3), (5,)), ((16, 5), (3,), (5,)), ((16, 5), (5, 3), (5,))]
)
def test_axes_broadcast(c, d, shape):
    assert harmonics.evaluate(jnp.ones(c), jnp.ones(d)).shape == shape
    assert harmonics.zonal(jnp.ones((4, *c[1:])), jnp.ones(d)).shape == (16, *shape)


def test_zonal_functions_are_turned_to_their_axis(rng):
    d, axes = (jnp.asarray(directions(rng, 6)) for _ in range(2))
    z = jnp.asarray(rng.normal(size=5))
    found = harmonics.evaluate(harmonics.zonal(z, axes), d)
    cosine = (axes * d).sum(-1)
    factor = np.sqrt((2 * np.arange(5) + 1) / (4 * np.pi))
    expected = (z * factor) @ harmonics.legendre(cosine, 5)
    np.testing.assert_allclose(found, expected, atol=1e-13)


def test_caps_of_many_digits():
    angle, degree, expected = np.array(DATA["cap"]).T
    found = cap(jnp.asarray(angle), 11)[degree.astype(int), np.arange(len(angle))]
    np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)


def test_caps_near_nothing_and_near_the_whole(dtype):
    small = np.array([0.0, 1e-5, 1e-3])
    found = cap(jnp.asarray(small, dtype), 6)
    # The value on the axis times the solid angle.
    expected = np.sqrt((2 * np.arange(6)[:, None] + 1) / (4 * np.pi)) * np.pi * small**2
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    whole = cap(jnp.asarray(np.pi - small, dtype), 6)
    missing = expected * (-1.0) ** np.arange(6)[:, None]
    missing[0] -= np.sqrt(4 * np.pi)
    # In float32 pi is off by 9e-8, beside an angle of 1e-3.
    np.testing.assert_allclose(whole, -missing, atol=2e-6 if dtype == "float32" else 1e-10)


def test_clamped_cosine():
    degree, expected = np.array(DATA["cosine"]).T
    found = harmonics.clamped_cosine(11)[degree.astype(int)]
    np.testing.assert_allclose(found, expected, atol=1e-12, rtol=0)
    # Ramamoorthi and Hanrahan's factors, over pi.
    factor = found * np.sqrt(4 * np.pi / (2 * degree + 1)) / np.pi
    np.testing.assert_allclose(factor[[0, 1, 2, 4, 6]], [1, 2 / 3, 1 / 4, -1 / 24, 1 / 64])


def test_windows():
    for kind in ("none", "hann", "lanczos"):
        factor = harmonics.window(4, kind)
        assert factor.shape == (16,)
        assert factor[0] == 1.0
        assert (np.diff(factor) <= 0).all()
        assert (factor > 0).all()
    assert harmonics.window(4, "hann")[4] == pytest.approx(0.5)
    assert harmonics.window(4, "lanczos")[4] == pytest.approx(2 / np.pi)


@pytest.mark.float32
def test_bad_inputs_are_refused():
    with pytest.raises(ValueError, match="window: received 'box'"):
        harmonics.window(4, "box")
    with pytest.raises(ValueError, match="bands: received 0"):
        harmonics.basis(jnp.ones(3), 0)
    with pytest.raises(ValueError, match="coefficients: received"):
        harmonics.evaluate(jnp.ones(15), jnp.ones(3))


@pytest.mark.parametrize("bands", [4, 65])
def test_slopes_at_the_poles(bands, dtype):
    """In float32 as in float64, where they agree with differences."""
    d = np.stack([NORTH, -NORTH, [0.48, -0.36, 0.8], [1.0, 0.0, 0.0]])
    slope = jax.jit(jax.vmap(jax.jacfwd(partial(harmonics.basis, bands=bands))))
    found = slope(jnp.asarray(d, dtype))
    step = {4: 1e-5, 65: 1e-6}[bands]
    offsets = step * np.eye(3)
    ends = [harmonics.numpy_basis(d[:, None] + sign * offsets, bands) for sign in (1, -1)]
    expected = np.moveaxis((ends[0] - ends[1]) / (2 * step), 0, 1)
    # A third derivative is up to l^4 times the first.
    size = np.abs(expected).max()
    assert np.isfinite(found).all()
    rounding = {4: 4, 65: 2000}[bands] * EPS[dtype]
    np.testing.assert_allclose(found, expected, atol=(rounding + (bands**2 * step) ** 2) * size)


@pytest.mark.float32
def test_compiled_once_and_alike_over_batches(rng):
    traces = []

    @jax.jit
    def counted(d):
        traces.append(d)
        return harmonics.basis(d, 4)

    d = jnp.asarray(directions(rng, 5), jnp.float32)
    first, second = counted(d), counted(d[::-1])
    assert len(traces) == 1
    np.testing.assert_allclose(first[:, ::-1], second, atol=1e-7)
    np.testing.assert_allclose(jax.vmap(lambda d: harmonics.basis(d, 4), 0, 1)(d), first, atol=1e-7)


def test_orthonormal_on_the_hemisphere():
    z, weight = np.polynomial.legendre.leggauss(4)
    d, weights = harmonics.rule_of(0.5 * (z + 1), 0.5 * weight, 7)
    values = hemispherical.numpy_basis(d, 4)
    np.testing.assert_allclose((values * weights) @ values.T, np.eye(16), atol=1e-14)
    found = hemispherical.basis(jnp.asarray(d), 4)
    np.testing.assert_allclose(found, values, atol=1e-14)


def test_the_hemisphere_is_spread_evenly(rng, dtype):
    d = directions(rng, 200)
    d[:, 2] = abs(d[:, 2])
    found = spread(jnp.asarray(d, dtype))
    found = np.asarray(found)
    np.testing.assert_allclose((found**2).sum(-1), 1.0, atol=8 * EPS[dtype])
    np.testing.assert_allclose(found[:, 2], 2 * d[:, 2] - 1, atol=4 * EPS[dtype])
    low = jnp.asarray([[0.6, 0.8, 0.0], [0.6, 0.0, -0.8]], dtype)
    np.testing.assert_array_equal(spread(low), [-NORTH, -NORTH])


@pytest.mark.float32
def test_slopes_on_the_hemisphere_are_finite():
    d = jnp.asarray([[0.0, 0.0, 1.0], [0.6, 0.8, 0.0], [0.6, 0.8, 1e-6], [0.6, 0.0, -0.8]])
    slope = jax.jit(jax.vmap(jax.jacfwd(partial(hemispherical.basis, bands=4))))(d)
    assert np.isfinite(slope).all()
