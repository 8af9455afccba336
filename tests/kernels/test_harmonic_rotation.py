"""Rotations of functions in spherical harmonics."""

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from diffopt.kernels import harmonic_rotation, harmonics

DATA = json.loads((Path(__file__).parents[1] / "data" / "harmonics.json").read_text())
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
BANDS = 5

blocks = jax.jit(harmonic_rotation.blocks, static_argnames="bands")
evaluate, rotate, about_z, about_y, to_frame = map(
    jax.jit,
    (
        harmonics.evaluate,
        harmonic_rotation.rotate,
        harmonic_rotation.about_z,
        harmonic_rotation.about_y,
        harmonic_rotation.to_frame,
    ),
)


def whole(parts):
    """The matrix of all blocks."""
    found = np.zeros((len(parts) ** 2, len(parts) ** 2))
    for degree, block in enumerate(parts):
        place = slice(degree**2, (degree + 1) ** 2)
        found[place, place] = block
    return found


def turns(rng, count):
    return Rotation.random(count, rng=rng).as_matrix()


def test_rotation_of_many_digits():
    matrix = jnp.asarray(DATA["rotation"]["matrix"])
    found = whole(blocks(matrix, 4))
    for row, column, expected in DATA["rotation"]["entries"]:
        assert found[row, column] == pytest.approx(expected, abs=1e-12)
    c = jnp.asarray(np.cos(np.arange(16.0)))
    angles = [jnp.asarray(a) for a in (-2.0, 1.1, 0.3)]
    turned = c
    for about, angle in zip((about_z, about_y, about_z), angles, strict=True):
        turned = about(turned, jnp.cos(angle), jnp.sin(angle))
    np.testing.assert_allclose(turned, found @ c, atol=1e-14)
    np.testing.assert_allclose(rotate(c, matrix), found @ c, atol=1e-14)


def test_a_group_of_orthogonal_matrices(rng, dtype):
    first, second = turns(rng, 2)
    a, b, both, back = (
        whole(blocks(jnp.asarray(m, dtype), BANDS))
        for m in (first, second, first @ second, first.T)
    )
    rounding = 40 * EPS[dtype]
    np.testing.assert_allclose(a @ b, both, atol=rounding)
    np.testing.assert_allclose(back, a.T, atol=rounding)
    np.testing.assert_allclose(a @ a.T, np.eye(BANDS**2), atol=rounding)
    same = whole(blocks(jnp.eye(3, dtype=dtype), BANDS))
    np.testing.assert_allclose(same, np.eye(BANDS**2), atol=rounding)


def test_values_move_with_the_rotation(rng, dtype):
    """One rotation for each function, and one for all."""
    c = jnp.asarray(rng.normal(size=(BANDS**2, 5)), dtype)
    matrix = turns(rng, 5)
    d = rng.normal(size=(5, 3))
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    before = np.einsum("nij,ni->nj", matrix, d)
    found = evaluate(rotate(c, jnp.asarray(matrix, dtype)), jnp.asarray(d, dtype))
    expected = evaluate(c, jnp.asarray(before, dtype))
    np.testing.assert_allclose(found, expected, atol=200 * EPS[dtype])
    one = rotate(c, jnp.asarray(matrix[0], dtype))
    np.testing.assert_allclose(
        one[:, 0], rotate(c, jnp.asarray(matrix, dtype))[:, 0], atol=40 * EPS[dtype]
    )


def test_the_frame_of_a_point_about_a_centre(rng, dtype):
    """Columns -e_theta, e_phi, -n; at the poles as elsewhere."""
    theta = np.array([0.0, np.pi, 0.4, 1.1, 2.9])
    phi = np.array([0.0, 1.0, -2.0, 4.0, 0.3])
    ct, st, cp, sp = np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)
    frame = np.stack(
        [
            np.stack([-ct * cp, -ct * sp, st], -1),
            np.stack([-sp, cp, 0 * phi], -1),
            np.stack([-st * cp, -st * sp, -ct], -1),
        ],
        -1,
    )
    c = jnp.asarray(rng.normal(size=(16, 5)), dtype)
    found = to_frame(c, *(jnp.asarray(a, dtype) for a in (ct, st, cp, sp)))
    assert found.dtype == dtype
    expected = rotate(c, jnp.asarray(frame, dtype))
    np.testing.assert_allclose(found, expected, atol=60 * EPS[dtype])


@pytest.mark.float32
@pytest.mark.parametrize("about", [harmonic_rotation.about_z, harmonic_rotation.about_y])
@pytest.mark.parametrize("bands", [1, 2])
def test_one_function_turned_by_many_angles(about, bands):
    c, s = jnp.cos(jnp.arange(3.0)), jnp.sin(jnp.arange(3.0))
    one = jnp.arange(1.0, bands**2 + 1)
    found = about(one, c, s)
    assert found.shape == (bands**2, 3)
    np.testing.assert_allclose(found[:, 2], about(one, c[2], s[2]), atol=1e-6)


def test_slopes_by_the_angles(rng):
    """Also at the poles, against differences."""
    c = jnp.asarray(rng.normal(size=16))

    def turned(angles):
        t, p = angles[0], angles[1]
        return harmonic_rotation.to_frame(c, jnp.cos(t), jnp.sin(t), jnp.cos(p), jnp.sin(p))

    slope, value = jax.jit(jax.vmap(jax.jacfwd(turned))), jax.jit(jax.vmap(turned))
    angles = jnp.asarray([[0.0, 0.0], [np.pi, 0.3], [1.1, -2.0]])
    step = 1e-5
    for axis in range(2):
        move = step * np.eye(2)[axis][None]
        expected = (value(angles + move) - value(angles - move)) / (2 * step)
        np.testing.assert_allclose(slope(angles)[..., axis], expected, atol=1e-8)


@pytest.mark.float32
def test_compiled_once_and_alike_over_batches(rng):
    traces = []

    @jax.jit
    def counted(c, matrix):
        traces.append(c)
        return harmonic_rotation.rotate(c, matrix)

    c = jnp.asarray(rng.normal(size=(9, 4)), jnp.float32)
    matrix = jnp.asarray(turns(rng, 4), jnp.float32)
    first = counted(c, matrix)
    counted(2.0 * c, matrix[::-1])
    assert len(traces) == 1
    each = jax.jit(jax.vmap(partial(harmonic_rotation.rotate), (1, 0), 1))(c, matrix)
    np.testing.assert_allclose(first, each, atol=2e-6)
