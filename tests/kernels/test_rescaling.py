"""Maps of a view with the distance and their matrices, against many digits and integrals."""

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import (
    harmonics,
    hemispherical,
    rescaling,
    rescaling_matrices,
    rescaling_tables,
)

DATA = json.loads((Path(__file__).parents[1] / "data" / "harmonics.json").read_text())
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
QUARTER = np.pi / 2
K = np.array([0.05, 0.3, 0.9, 1.0, 1.2, 4.0])[:, None]

cap = jax.jit(harmonics.cap, static_argnums=1)
STATIC = {
    rescaling_matrices.square: ("bands", "source", "inverse", "nodes"),
    rescaling_matrices.tangent: ("bands", "source", "source_bands", "nodes"),
    rescaling_matrices.sphere_rule: ("bands", "nodes"),
}
square, tangent, sphere_rule = (jax.jit(f, static_argnames=names) for f, names in STATIC.items())


def differences(kind, call):
    """Largest error of the matrices of a kind, by ratio, and the dtype of the entries."""
    entries = call(np.array([float(k) for k in DATA[kind]]))
    matrices = whole(entries)
    return entries.dtype, [
        max(abs(matrices[i, j, place] - value) for i, j, value in rows)
        for place, rows in enumerate(DATA[kind].values())
    ]


def whole(entries, bands=4):
    return np.asarray(rescaling_matrices.dense(jnp.asarray(entries), bands))


@pytest.mark.parametrize("place", range(5))
def test_the_square_map_of_many_digits(place):
    call = (
        rescaling.square,
        rescaling.square_slope,
        rescaling.square_slope_k,
        rescaling.square_sine_ratio,
        rescaling.square_density,
    )[place]
    columns = np.array(DATA["map"]).T
    found = call(jnp.asarray(columns[1]), jnp.asarray(columns[0]))
    np.testing.assert_allclose(found, columns[2 + place], atol=1e-12, rtol=0)


def test_the_square_map_is_a_flow_with_fixed_points(dtype):
    theta = np.linspace(0.0, np.pi, 41)[None]
    k, t = jnp.asarray(K, dtype), jnp.asarray(theta, dtype)
    f = jax.jit(rescaling.square)
    found = f(t, k)
    assert found.dtype == dtype
    # Slopes of the inverse are up to 2 / k.
    rounding = 20 * EPS[dtype] * np.maximum(K, 2 / K)
    assert (np.abs(f(found, 1.0 / k) - t) <= rounding).all()
    assert (np.abs(f(f(t, k), 0.5 * k) - f(t, 0.5 * k * k)) <= 40 * rounding / K.min()).all()
    assert (np.diff(found) > 0).all()
    fixed = jnp.asarray([[0.0, 0.75 * np.pi, np.pi]], dtype)
    assert (np.abs(f(fixed, k) - fixed) <= rounding).all()
    np.testing.assert_allclose(found[3], theta[0], atol=4 * EPS[dtype])  # k = 1


def test_slopes_of_the_square_map_are_its_derivatives(dtype):
    """Also at pi, which float32 rounds to above pi."""
    theta, k = (
        jnp.asarray(a, dtype)
        for a in np.meshgrid([0.0, 0.4, QUARTER, 2.0, np.pi], [1e-6, 0.125, 1.0, 8.0])
    )
    slopes = jax.jit(jax.vmap(jax.grad(rescaling.square, (0, 1))))(theta.ravel(), k.ravel())
    for found, call in zip(slopes, (rescaling.square_slope, rescaling.square_slope_k), strict=True):
        expected = np.asarray(call(theta, k)).ravel()
        np.testing.assert_allclose(found, expected, rtol=100 * EPS[dtype], atol=1e-5 * EPS[dtype])


def test_solid_angle_is_kept_by_the_density():
    x, weight = np.polynomial.legendre.leggauss(200)
    theta, weight = QUARTER * (x + 1), QUARTER * weight
    density = jax.jit(rescaling.square_density)(jnp.asarray(theta)[None], jnp.asarray(K[1:]))
    total = (density * (weight * np.sin(theta))[None]).sum(1)
    np.testing.assert_allclose(total, 2.0, rtol=1e-11)


def test_the_map_on_the_sphere(dtype):
    k = jnp.asarray([0.25, 0.5, 0.8, 1.0, 3.0], dtype)
    corner = jnp.full_like(k, 3 * np.pi / 8)
    f = jax.jit(rescaling.sphere_rule)
    # Continuous where it leaves the square, and no more than the cone that holds the sphere.
    rounding = 40 * EPS[dtype]
    near = 8 * EPS[dtype]
    np.testing.assert_allclose(f(corner + near, k), f(corner - near, k), atol=rounding)
    np.testing.assert_allclose(
        f(corner - near, k), rescaling.square(corner - near, k), atol=4 * EPS[dtype]
    )
    over = jnp.linspace(1.19, 1.57, 200, dtype=dtype)[None]
    assert (f(over, k[:3, None]).max(1) <= np.arcsin(np.asarray(k[:3])) + rounding).all()
    degrees = np.degrees(f(jnp.asarray(np.radians([67.5, 75, 80, 85, 90]), dtype) - near, k[1]))
    np.testing.assert_allclose(degrees, [28.7, 23.8, 17.9, 9.7, 0.0], atol=0.06)
    ends = jnp.asarray([0.0, QUARTER, QUARTER, np.pi], dtype), jnp.asarray([1, 1, 2, 8], dtype)
    assert all(np.isfinite(s).all() for s in jax.jit(jax.vmap(jax.grad(f, (0, 1))))(*ends))


def test_the_tangent_map_and_its_inverse(dtype):
    k = jnp.asarray([[1e-6], [0.5], [0.9], [1.0]], dtype)
    u = jnp.asarray(np.linspace(0.0, 1.5, 31)[None], dtype)
    seen = jax.jit(rescaling.tangent)(u, k)
    np.testing.assert_allclose(jnp.sin(seen), k * jnp.sin(u), rtol=6 * EPS[dtype])
    back = jax.jit(rescaling.tangent_inverse)(seen, k)
    # Slopes are up to 1 / cos u.
    np.testing.assert_allclose(back, jnp.broadcast_to(u, back.shape), atol=100 * EPS[dtype])
    beyond = rescaling.tangent_inverse(jnp.asarray([0.6, 2.0, np.pi], dtype), k[1])
    np.testing.assert_allclose(beyond, QUARTER, rtol=1e-6)


@pytest.mark.parametrize("call", [rescaling.tangent, rescaling.tangent_inverse])
def test_slopes_of_the_tangent_map(call, dtype):
    theta, k = np.array([0.0, 0.3, 0.3, 1.0, 1.0]), np.array([0.5, 0.9, 0.2, 0.0, 0.95])
    grad = jax.jit(jax.vmap(jax.grad(call, (0, 1))))
    slopes = grad(jnp.asarray(theta, dtype), jnp.asarray(k, dtype))
    step = 1e-6
    for axis, found in enumerate(slopes):
        ends = []
        for sign in (1, -1):
            moved = [theta, k]
            moved[axis] = moved[axis] + sign * step
            # Of the numbers as the dtype has them, in float64.
            sine = np.sin(moved[0])
            with np.errstate(invalid="ignore", divide="ignore"):
                away = np.where(sine < moved[1], np.arcsin(sine / moved[1]), QUARTER)
            ends.append(away if call is rescaling.tangent_inverse else np.arcsin(moved[1] * sine))
        expected = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(found, expected, atol=1e-8 if dtype == "float64" else 2e-6)
    edges = jnp.asarray([0.5, QUARTER, np.pi], dtype), jnp.sin(jnp.asarray([0.5, 1.6, 1.0], dtype))
    assert all(np.isfinite(s).all() for s in grad(*edges))


@pytest.mark.parametrize(
    ("kind", "call"),
    [
        # At k = 0.1, 96 nodes have an error of 1.4e-11.
        ("square", partial(square, bands=4, nodes=128)),
        ("inverse", partial(square, bands=4, nodes=128, inverse=True)),
        ("masked", partial(square, bands=4, nodes=48, source="masked")),
        ("tangent", partial(tangent, bands=4, nodes=24, source="masked")),
    ],
)
def test_matrices_of_many_digits(kind, call):
    for dtype, tolerance in (("float64", 1e-12), ("float32", 4e-6)):
        found, errors = differences(kind, lambda k, dtype=dtype: call(jnp.asarray(k, dtype)))
        assert found == dtype
        # In float32 k itself is rounded, where a slope is 10.
        assert max(errors) <= tolerance, errors


def test_slopes_of_the_matrix_of_many_digits():
    slope = jax.jit(jax.vmap(jax.jacfwd(partial(rescaling_matrices.square, bands=4)), 0, 1))
    assert max(differences("slope", lambda k: slope(jnp.asarray(k)))[1]) <= 1e-11


def test_places_of_the_entries():
    for bands in (1, 4, 6):
        m, row, column = rescaling_matrices.places(bands)
        assert len(m) == bands * (bands + 1) * (2 * bands + 1) // 6
        slots = bands * (2 * bands * bands + 1) // 3
        assert (np.where(m > 0, 2, 1)).sum() == slots
        assert (np.minimum(row, column) >= m).all()
    k = jnp.asarray([0.5, 0.7, 0.9])  # as many as there are of many digits
    free = whole(square(jnp.tile(k, 3)[:7], 4, nodes=128))[..., 0]
    masked = whole(square(k, 4, source="masked", nodes=48))[..., 0]
    assert (np.abs(free) > 1e-12).sum() == 41
    assert (np.abs(masked) > 1e-12).sum() == 44
    np.testing.assert_array_equal((np.abs(masked) > 1e-12), whole(np.ones(30)) == 1)


def test_the_square_matrix_keeps_what_it_should():
    k = jnp.asarray([0.3, 1.0, 1.7, 1 / 0.3, 0.5, 2.0, 4.0])
    matrices = np.moveaxis(whole(square(k, 4, nodes=128)), -1, 0)
    # Constants stay, the sphere itself stays, and half of it is masked.
    np.testing.assert_allclose(matrices[:, :, 0], np.eye(16)[[0] * 7], atol=1e-13)
    np.testing.assert_allclose(matrices[1], np.eye(16), atol=1e-13)
    half = whole(square(k[:3], 4, source="masked", nodes=48))[..., 1]
    z, weight = np.polynomial.legendre.leggauss(8)
    nodes, weights = harmonics.rule_of(0.5 * (z + 1), 0.5 * weight, 7)
    values = harmonics.numpy_basis(nodes, 4)
    near = (values * weights) @ values.T
    np.testing.assert_allclose(half, near, atol=1e-12)
    # Light with its density, as the paper has it: the matrix of 1 / k transposed.
    x, weight = np.polynomial.legendre.leggauss(120)
    theta, weight = QUARTER * (x + 1), QUARTER * weight
    t, back = jnp.asarray(theta), 1.0 / k[0]
    density = np.asarray(rescaling.square_density(t, back))
    d, weights = harmonics.rule_of(np.cos(theta), weight * np.sin(theta) * density, 7)
    source, _ = harmonics.rule_of(np.cos(rescaling.square(t, back)), weight, 7)
    light = (harmonics.numpy_basis(d, 4) * weights) @ harmonics.numpy_basis(source, 4).T
    np.testing.assert_allclose(light, matrices[3].T, atol=1e-10)
    # It keeps the integral of radiance over directions.
    np.testing.assert_allclose(light[0], np.eye(16)[0], atol=1e-10)


def seen(k, source, coefficients, bands):
    entries = tangent(k, bands, source=source, source_bands=coefficients.shape[0], nodes=40)
    m, row, column = rescaling_matrices.places(bands, coefficients.shape[0])
    found = np.zeros((bands, len(k)))
    for degree in range(bands):
        own = (m == 0) & (row == degree)
        found[degree] = np.asarray(entries)[own].T @ coefficients[column[own]]
    return found


def test_the_tangent_matrix_of_a_sphere():
    """A ball as large as its bounding sphere hides the hemisphere, from afar a cap."""
    k = jnp.asarray([0.1, 0.5, 0.9, 0.999])
    all_of_it = np.sqrt(2 * np.pi) * np.eye(4)[0]
    expected = cap(jnp.arcsin(k), 4)
    np.testing.assert_allclose(seen(k, "hemisphere", all_of_it, 4), expected, atol=1e-9)
    # A smaller one: half angle asin(rho) from the sphere, of which a series of 40 terms is left.
    rho = 0.6
    z = np.cos(np.arcsin(rho))
    x, weight = np.polynomial.legendre.leggauss(60)
    x, weight = z + (1 - z) * 0.5 * (x + 1), 0.5 * (1 - z) * weight
    d = np.stack([np.sqrt(1 - x * x), 0 * x, x], -1)
    at = np.arange(40) * (np.arange(40) + 1)
    smaller = 2 * np.pi * hemispherical.numpy_basis(d, 40)[at] @ weight
    found = seen(k, "hemisphere", smaller, 4)
    np.testing.assert_allclose(found, cap(jnp.arcsin(rho * k), 4), atol=2e-3)


def test_both_sources_of_the_tangent_matrix_agree(rng):
    """What both can hold: 1 and the cosine on the near hemisphere."""
    k = jnp.asarray([0.2, 0.8])
    on_hemisphere = np.sqrt(2 * np.pi) * np.array([0.5, 0.5 / np.sqrt(3)])
    on_sphere = np.sqrt(4 * np.pi / 3) * np.array([0.0, 1.0])
    np.testing.assert_allclose(
        seen(k, "hemisphere", on_hemisphere, 4), seen(k, "masked", on_sphere, 4), atol=1e-12
    )


def test_the_matrix_on_the_sphere_follows_its_map(dtype):
    """What is left of a hemisphere: a cap up to where the map turns."""
    k = jnp.asarray([0.3, 0.8, 1.0, 2.0], dtype)
    found = sphere_rule(k, 4, nodes=48)
    turn = np.maximum(0.5 * np.arccos(-np.minimum(np.asarray(k), 1)), 3 * np.pi / 8)
    edge = np.where(k > 1, np.pi, rescaling.sphere_rule(jnp.asarray(turn - 1e-9, dtype), k))
    constant = np.sqrt(4 * np.pi) * np.asarray(found)[[0, 4, 8, 12]]
    expected = cap(jnp.asarray(edge, dtype), 4)
    np.testing.assert_allclose(constant, expected, atol=1e-8 if dtype == "float64" else 4e-6)
    masked = square(k[2], 4, source="masked")
    np.testing.assert_allclose(found[:, 2], masked, atol=40 * EPS[dtype])


@pytest.mark.parametrize(
    "call",
    [
        rescaling_matrices.square,
        partial(rescaling_matrices.square, source="masked"),
        rescaling_matrices.sphere_rule,
        rescaling_matrices.tangent,
    ],
)
def test_slopes_of_the_matrices(call, dtype):
    """Finite from the centre to any distance; right where the matrix is smooth."""
    value = jax.jit(partial(call, bands=2, nodes=32))
    slope = jax.jit(jax.vmap(jax.jacfwd(partial(call, bands=2, nodes=32)), 0, 1))
    k = jnp.asarray([1e-6, 0.3, 0.6, 0.9, 1.0, 1.5, 8.0], dtype)
    found = slope(k)
    assert found.dtype == dtype
    assert np.isfinite(found).all()
    assert np.isfinite(value(k)).all()
    step = {"float64": 1e-6, "float32": 3e-3}[dtype]
    k = k[1:4]
    expected = (value(k + step) - value(k - step)) / (2 * step)
    np.testing.assert_allclose(found[:, 1:4], expected, atol=1e-8 if dtype == "float64" else 2e-3)


@pytest.mark.parametrize("columns", [2, 3, 5])
def test_entries_applied_are_the_matrix(columns, rng):
    entries = tangent(jnp.asarray([0.2, 0.7]), 3, source_bands=columns)
    c = jnp.asarray(rng.normal(size=(columns**2, 2)))
    matrix = rescaling_matrices.dense(entries, 3, columns)
    assert matrix.shape == (9, columns**2, 2)
    expected = np.einsum("ijn,jn->in", matrix, c)
    found = jax.jit(partial(rescaling_matrices.apply, bands=3))(entries, c)
    np.testing.assert_allclose(found, expected, atol=1e-14)


@pytest.mark.float32
def test_bad_inputs_are_refused():
    k = jnp.asarray(0.5)
    with pytest.raises(ValueError, match="source: received 'hemisphere'"):
        rescaling_matrices.square(k, 4, source="hemisphere")
    with pytest.raises(ValueError, match="source: received 'sphere'"):
        rescaling_matrices.tangent(k, 4, source="sphere")


@pytest.mark.float32
def test_compiled_once_and_alike_over_batches():
    traces = []

    @jax.jit
    def counted(k):
        traces.append(k)
        return rescaling_matrices.tangent(k, 3)

    k = jnp.asarray([[0.1, 0.4], [0.7, 1.0]], jnp.float32)
    first = counted(k)
    assert first.shape == (14, 2, 2)
    np.testing.assert_allclose(counted(k[::-1])[:, ::-1], first, atol=1e-7)
    assert len(traces) == 1
    each = jax.jit(jax.vmap(partial(rescaling_matrices.tangent, bands=3), 1, 2))(k)
    np.testing.assert_allclose(each, first, atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "nodes", "terms"),
    [("square", 115, 20), ("tangent masked", 40, 8), ("tangent hemisphere", 48, 9)],
)
def test_tables_of_matrices_are_as_exact_as_they_say(kind, nodes, terms):
    square = kind == "square"
    k = jnp.geomspace(0.125, 8.0, 301) if square else jnp.linspace(0.0, 0.9999, 301)
    source = kind.partition(" ")[2]
    make = rescaling_matrices.square if square else rescaling_matrices.tangent
    exact = make(k, 4, source=source or "sphere", nodes=96)
    line = rescaling_tables.from_linear(rescaling_tables.linear(4, kind, nodes), k, kind)
    sums = rescaling_tables.from_chebyshev(rescaling_tables.chebyshev(4, kind, terms), k, kind)
    # Documented: below 1e-3.
    assert abs(line - exact).max() < 1e-3
    assert abs(sums - exact).max() < 1e-3
    # Half the nodes of a line leave up to four times the error.
    half = rescaling_tables.linear(4, kind, nodes // 2)
    assert abs(rescaling_tables.from_linear(half, k, kind) - exact).max() > 1e-3


def test_tables_of_matrices_refuse_what_they_are_not():
    with pytest.raises(ValueError, match="kind: received 'round'"):
        rescaling_tables.place(jnp.ones(()), "round")
    with pytest.raises(ValueError, match="nodes: received 1"):
        rescaling_tables.linear(4, "square", 1)
    with pytest.raises(ValueError, match="terms: received 0"):
        rescaling_tables.chebyshev(4, "square", 0)
