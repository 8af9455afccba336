"""B-splines against SciPy's, and their error bounds against what is measured."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads
from scipy import ndimage
from scipy.optimize import linprog

from diffopt.kernels import phase, spline

ORDERS = pytest.mark.parametrize("order", spline.ORDERS)


def at(coefficients, x, order):
    """One-dimensional spline value at places in steps."""
    first, t = spline.locate(x, coefficients.shape[0], order)
    return sum(w * coefficients[first + k] for k, w in enumerate(spline.weights(t, order)))


@ORDERS
def test_prefilter_is_scipys(order, dtype, rng):
    values = rng.normal(size=(40, 3))
    got = spline.prefilter(jnp.asarray(values, dtype), axis=0, order=order)
    expected = (
        ndimage.spline_filter1d(values, order, axis=0, mode="mirror") if order > 1 else values
    )
    # A filter of gain 3 at most; its tail is cut at a tenth of eps.
    np.testing.assert_allclose(got, expected, atol=20 * float(jnp.finfo(dtype).eps))


@ORDERS
def test_spline_passes_through_its_samples(order, rng):
    values = jnp.asarray(rng.normal(size=30))
    c = spline.prefilter(values, axis=0, order=order)
    inside = jnp.arange(3.0, 26.0)
    np.testing.assert_allclose(at(c, inside, order), values[3:26], atol=1e-14)


@ORDERS
def test_lookup_is_scipys_map_coordinates(order, rng):
    table = rng.normal(size=(9, 11, 8, 2))
    # Places whose weights stay inside.
    y, x, z = (rng.uniform(2, n - 3, 50) for n in table.shape[:3])
    got = spline.lookup(jnp.asarray(table), *map(jnp.asarray, (x, y, z)), order=order)
    for channel in range(2):
        # SciPy has one order for all axes: along z by hand.
        first, t = spline.locate(jnp.asarray(z), 8, 3)
        expected = 0.0
        for k, w in enumerate(spline.weights(t, 3)):
            plane = np.asarray(first) + k
            for i in range(50):
                slab = table[:, :, plane[i], channel]
                value = ndimage.map_coordinates(
                    slab, [[y[i]], [x[i]]], order=order, prefilter=False
                )[0]
                expected = expected + np.eye(50)[i] * float(w[i]) * value
        np.testing.assert_allclose(got[:, channel], expected, atol=1e-12)


@ORDERS
@pytest.mark.parametrize("theta", [0.1, 0.5, 1.0, 2.0])
def test_frequency_error_bounds_a_wave(order, theta):
    x = np.arange(120.0)
    places = jnp.linspace(40.0, 80.0, 2001)
    worst = 0.0
    for shift in (0.0, 0.4, 1.0):
        c = spline.prefilter(jnp.cos(theta * x + shift), axis=0, order=order)
        worst = max(
            worst, float(jnp.abs(at(c, places, order) - jnp.cos(theta * places + shift)).max())
        )
    bound = float(spline.frequency_error(np.array(theta), order))
    # A real wave may reach half of the complex one's bound.
    assert 0.4 * bound < worst <= bound * (1 + 1e-9) + 1e-14


@ORDERS
@pytest.mark.parametrize("ratio", [0.25, 0.5, 0.8])
def test_gaussian_error_bounds_a_gaussian(order, ratio):
    x = (np.arange(161) - 80) * ratio
    places = jnp.linspace(50.0, 110.0, 6001)
    worst = 0.0
    for shift in (0.0, 0.25 * ratio, 0.5 * ratio):
        c = spline.prefilter(jnp.exp(-0.5 * (x - shift) ** 2), axis=0, order=order)
        exact = jnp.exp(-0.5 * ((places - 80) * ratio - shift) ** 2)
        worst = max(worst, float(jnp.abs(at(c, places, order) - exact).max()))
    # Quadrature of the bound: a percent.
    assert (
        0.5 * spline.gaussian_error(ratio, order)
        < worst
        <= 1.01 * spline.gaussian_error(ratio, order)
    )


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("ratio", [0.3, 0.7, 0.9])
def test_error_is_relative_to_the_neighbourhood(order, ratio):
    """What `LOCAL` claims: shifted Gaussians of total weight LOCAL e cover the error.

    Found by linear programming; then the error at a place is at most LOCAL e times the
    largest value of the interpolated mixture within seven standard deviations.
    """
    half = int(20 / ratio) + 30
    centres = np.linspace(-9, 9, 181)
    places = np.linspace(-7, 7, 141)
    cover = np.exp(-0.5 * (centres[:, None] - places[None]) ** 2)
    worst = 0.0
    for fraction in (0.0, 0.25, 0.5):
        knots = (np.arange(2 * half + 1) - half - fraction) * ratio
        c = ndimage.spline_filter1d(
            np.exp(-0.5 * (knots[:, None] - centres) ** 2), order, axis=0, mode="mirror"
        )
        one = jax.vmap(lambda c, x=half + fraction: at(c, jnp.asarray([x]), order)[0], in_axes=1)
        value = np.asarray(one(jnp.asarray(c)))
        error = value - np.exp(-0.5 * centres**2)
        inner = np.abs(centres) <= 8
        for sign in (1, -1):
            found = linprog(
                np.ones(len(places)),
                A_ub=-cover[inner],
                b_ub=-np.maximum(sign * error[inner], 0.0),
                bounds=(0, None),
            )
            assert found.success
            worst = max(worst, found.fun)
    assert worst <= spline.LOCAL * spline.gaussian_error(ratio, order)


@pytest.mark.parametrize("band", [0.0, 1.0, 4.0])
def test_complete_spline_from_chebyshev(band):
    nodes, intervals = 24, 10
    t = np.asarray(phase.chebyshev_points(nodes, jnp.float64))
    c = jnp.asarray(spline.from_chebyshev(nodes, intervals) @ np.cos(band * t + 0.3))
    places = jnp.linspace(-1, 1, 501)
    got = at(c, (places + 1) * (intervals / 2) + 1, 3)
    error = float(jnp.abs(got - jnp.cos(band * places + 0.3)).max())
    # 24 nodes interpolate the wave to rounding.
    bound = spline.complete_error(band * 2 / intervals)
    assert 0.1 * bound <= error <= bound + 1e-12


@ORDERS
def test_gradients_of_a_lookup(order, rng):
    table = jnp.asarray(rng.normal(size=(8, 8, 8, 2)))
    x, y, z = (jnp.asarray(rng.uniform(2.2, 4.8, 4)) for _ in range(3))

    def total(table, x, y, z):
        places = map(jnp.asarray, (table, x, y, z))
        return (spline.lookup(*places, order=order) ** 2).sum()

    # Order 1 has kinks at the knots only, none of which is met.
    check_grads(total, (table, x, y, z), order=1, modes=("fwd", "rev"), eps=1e-6)


def test_jit_and_vmap(rng):
    table = jnp.asarray(rng.normal(size=(8, 9, 7, 3)))
    places = jnp.asarray(rng.uniform(2, 4, (3, 5, 3)))

    def values(p):
        return spline.lookup(table, p[:, 0], p[:, 1], p[:, 2], order=3)

    many = jax.jit(jax.vmap(values))(places)
    one = jnp.stack([values(p) for p in places])
    np.testing.assert_allclose(many, one, atol=1e-14)
