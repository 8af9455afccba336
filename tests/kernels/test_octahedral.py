"""The square that is the sphere: both ways, areas, folds, borders."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import octahedral

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
encode, decode = jax.jit(octahedral.encode), jax.jit(octahedral.decode)


def directions(rng, count):
    d = rng.normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def test_there_and_back(dtype, rng):
    d = np.concatenate([directions(rng, 2000), np.eye(3), -np.eye(3)])
    u, v = encode(*jnp.asarray(d.T, dtype))
    assert u.dtype == dtype
    assert float(jnp.maximum(jnp.abs(u), jnp.abs(v)).max()) <= 1
    # A step of eps on the square is one of up to sqrt 3 eps on the sphere.
    np.testing.assert_allclose(decode(u, v), d, atol=8 * EPS[dtype])


def test_any_length(dtype, rng):
    d = directions(rng, 100)
    found = np.stack(encode(*jnp.asarray(d.T, dtype)))
    far = np.stack(encode(*jnp.asarray(1e6 * d.T, dtype)))
    # In the lower half 1 - |u| has the rounding of 1.
    np.testing.assert_allclose(far, found, atol=4 * EPS[dtype])


def test_nothing_has_a_place_and_no_slope(dtype):
    zero = jnp.zeros(1, dtype)
    value, slopes = jax.value_and_grad(lambda *d: sum(encode(*d))[0], (0, 1, 2))(zero, zero, zero)
    assert float(value) == 0.0
    assert all(float(slope[0]) == 0.0 for slope in slopes)


def test_solid_angles():
    """Texels weigh dA / r^3: the sphere in all, and each harmonic of degree 2 to nothing."""
    size = 128
    d = octahedral.texels(size)
    # r = 1 / (|x| + |y| + |z|) of the unit vector.
    weight = (2.0 / size) ** 2 * np.abs(d).sum(-1) ** 3
    # Midpoints: second order in the step of 1/64.
    assert weight.sum() == pytest.approx(4 * np.pi, rel=1e-3)
    second = np.einsum("ij,ija,ijb->ab", weight, d, d)
    np.testing.assert_allclose(second, np.eye(3) * 4 * np.pi / 3, atol=5e-3)


def test_texels_are_decoded_centres():
    size = 6
    at = (np.arange(size) + 0.5) / size * 2 - 1
    v, u = np.meshgrid(at, at, indexing="ij")
    found = octahedral.decode(jnp.asarray(u, jnp.float32), jnp.asarray(v, jnp.float32))
    # Six operations of float32.
    np.testing.assert_allclose(octahedral.texels(size), found, atol=1e-6)


@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_borders_continue_the_sphere(size):
    """Just beyond a side lies what the direction there, found by another way, has inside."""
    index = octahedral.bordered(size)
    assert (index[1:-1, 1:-1].ravel() == np.arange(size**2)).all()
    d = octahedral.texels(size).reshape(-1, 3)
    at = (np.arange(-1, size + 1) + 0.5) / size * 2 - 1
    for row, column in np.ndindex(size + 2, size + 2):
        u, v = at[column], at[row]
        # Squares pave the plane, each turned by half a turn about the middle of the side it shares.
        while max(abs(u), abs(v)) > 1:
            if abs(u) > 1:
                u, v = np.sign(u) * 2 - u, -v
            else:
                u, v = -u, np.sign(v) * 2 - v
        x, y, z = u, v, 1 - abs(u) - abs(v)
        if z < 0:
            x, y = np.copysign(1 - abs(v), u), np.copysign(1 - abs(u), v)
        there = np.array([x, y, z]) / np.linalg.norm([x, y, z])
        np.testing.assert_allclose(d[index[row, column]], there, atol=1e-12)


def test_neighbours_across_the_border_are_near():
    """No jump: beyond a side the next texel is as near as any two neighbours inside."""
    size = 32
    d = octahedral.texels(size).reshape(-1, 3)[octahedral.bordered(size)]
    inside = d[1:-1, 1:-1]
    most = max(np.linalg.norm(np.diff(inside, axis=axis), axis=-1).max() for axis in (0, 1))
    for axis in (0, 1):
        assert np.linalg.norm(np.diff(d, axis=axis), axis=-1).max() <= most
