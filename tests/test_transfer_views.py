"""Views of transfer slices: nested triangles over the hemisphere, found by directions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import InputError
from diffopt.transfer.views import FINEST, hemisphere, locator

ELEVATION = 0.005  # of the views that would lie on the horizon


def flat(level):
    """Views with those next to the horizon on it: the triangles then fill the hemisphere."""
    views = hemisphere(level).views.copy()
    views[views[:, 2] < 1.001 * np.sin(ELEVATION), 2] = 0.0
    return views / np.linalg.norm(views, axis=-1, keepdims=True)


def solid_angles(points, faces):
    """Van Oosterom and Strackee 1983; positive for corners counter-clockwise from above."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    cosines = (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1)
    return 2.0 * np.arctan2(volume, 1.0 + cosines)


@pytest.mark.parametrize("level", range(FINEST + 1))
def test_triangles_fill_the_hemisphere(level):
    sphere = hemisphere(level)
    faces = sphere.faces[level]
    assert len(faces) == 12 * 4**level
    assert sphere.counts[level] == len(sphere.views) == faces.max() + 1
    angles = solid_angles(flat(level), faces)
    assert (angles > 0.0).all()
    # A sum of 12,288 terms of rounding 1e-16 each.
    np.testing.assert_allclose(angles.sum(), 2.0 * np.pi, rtol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(sphere.views, axis=-1), 1.0, rtol=1e-14)
    assert sphere.views[:, 2].min() >= 0.999999 * np.sin(ELEVATION)


def test_views_are_nested():
    finest = hemisphere(FINEST)
    apart = []
    for level in range(FINEST + 1):
        sphere = hemisphere(level)
        assert sphere.counts == finest.counts[: level + 1]
        np.testing.assert_array_equal(sphere.views, finest.views[: sphere.counts[level]])
        np.testing.assert_array_equal(sphere.faces[level], finest.faces[level])
        points, faces = flat(level), sphere.faces[level]
        sides = points[faces] - points[np.roll(faces, 1, axis=1)]
        apart.append(np.degrees(2.0 * np.arcsin(0.5 * np.linalg.norm(sides, axis=-1))).max())
        if not level:
            continue
        # What lies within a triangle are the four of the next level, no more and no less.
        inside = solid_angles(points, faces).reshape(-1, 4).sum(1)
        outside = solid_angles(points, sphere.faces[level - 1])
        np.testing.assert_allclose(inside, outside, rtol=1e-11)
        new = sphere.new(level)
        ends = sphere.ends[new]
        assert ends.max() < sphere.counts[level - 1]
        assert (ends[:, 0] != ends[:, 1]).all()
        middle = points[ends].sum(1)
        middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
        np.testing.assert_allclose(points[new], middle, atol=1e-14)
    # As documented.
    assert [round(angle) for angle in apart] == [63, 36, 19, 9, 5, 2]
    assert sphere.counts == (10, 31, 109, 409, 1585, 6241)


@pytest.mark.parametrize("level", [-1, FINEST + 1])
def test_levels_that_there_are_not(level):
    with pytest.raises(InputError, match="level must be 0 to 5"):
        hemisphere(level)


def somewhere(rng):
    """Directions above the lowest views: anywhere, near the horizon, at views, on edges."""
    v = rng.normal(size=(3000, 3))
    v[:, 2] = np.abs(v[:, 2])
    v[:500, 2] *= 0.03
    views, faces = hemisphere(3).views, hemisphere(3).faces[3]
    halves = views[faces[:, 0]] + views[faces[:, 1]]
    nudged = views[faces[:, 0]] + 1e-5 * rng.normal(size=(len(faces), 3))
    v = np.concatenate([v, views, halves, nudged, [[0, 0, 1], [1e-9, -1e-9, 1], [0, 1e-4, 1]]])
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    return v


def dense(corners, shares, count):
    """Share of every view in directions, [n, V]."""
    out = np.zeros((len(corners), count))
    np.add.at(out, (np.arange(len(corners))[:, None], np.asarray(corners)), np.asarray(shares))
    return out


@pytest.fixture(scope="module")
def find():
    """The finest locator, compiled."""
    return jax.jit(locator(FINEST).__call__)


@pytest.mark.parametrize("level", range(FINEST + 1))
def test_found_is_the_triangle_around_a_direction(level, find, rng):
    """Against all triangles of the level, in float64."""
    wo = somewhere(rng)
    views, faces = hemisphere(level).views, hemisphere(level).faces[level]
    matrix = np.linalg.inv(views[faces].transpose(0, 2, 1))
    wo = wo if level < 4 else wo[:: 4 ** (level - 2)]  # all pairs: some 10^7 at most
    whole = (matrix.reshape(-1, 3) @ wo.T).reshape(len(faces), 3, -1).transpose(2, 0, 1)
    least = whole.min(-1)
    best = np.argmax(least, -1)
    inside = least.max(-1) >= -1e-12
    # What lies below the arcs between the lowest views is between the horizon and 0.34 degrees.
    assert (wo[~inside, 2] < 1.2 * ELEVATION).all()
    shares = np.take_along_axis(whole, best[:, None, None], 1)[inside, 0]
    shares /= shares.sum(-1, keepdims=True)
    expected = dense(faces[best[inside]], shares, len(views))
    place = find(jnp.asarray(wo[inside], jnp.float32), jnp.full(inside.sum(), level, jnp.int32))
    got = dense(place.corners, place.shares, len(views))
    # Rounding of directions over the height of a triangle, 0.03 at level 5.
    np.testing.assert_allclose(got, expected, atol=2e-6 * 2**level)


def test_next_to_the_horizon_and_below_it(find, rng):
    turn = rng.uniform(0.0, 2.0 * np.pi, 2000)
    z = np.concatenate([np.linspace(-1.0, 0.0, 1000), np.geomspace(1e-9, 0.005, 1000)])
    across = np.sqrt(1.0 - z * z)
    wo = np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)
    views = hemisphere(FINEST).views
    for level in range(FINEST + 1):
        place = find(jnp.asarray(wo, jnp.float32), jnp.full(len(wo), level, jnp.int32))
        shares = np.asarray(place.shares)
        assert np.isfinite(shares).all()
        assert (shares >= 0.0).all()
        np.testing.assert_allclose(shares.sum(-1), 1.0, atol=3e-7)
        assert np.asarray(place.corners).max() < hemisphere(level).counts[-1]
        met = (shares[..., None] * views[np.asarray(place.corners)]).sum(1)
        met /= np.linalg.norm(met, axis=-1, keepdims=True)
        # Raised to the lowest views, and, at level 0, to arcs 17 % above them and as far aside.
        near = z >= 0.0
        assert np.linalg.norm(met - wo, axis=-1)[near].max() < 1.4 * ELEVATION


def test_levels_of_their_own_and_batches(find, rng):
    """Each direction may have its level; batches of any shape, and one direction alone."""
    wo = jnp.asarray(somewhere(rng)[:600], jnp.float32)
    level = jnp.asarray(rng.integers(0, FINEST + 1, 600), jnp.int32)
    place = find(wo, level)
    for k in range(FINEST + 1):
        rows = np.flatnonzero(np.asarray(level) == k)
        alone = find(wo[rows], jnp.full(len(rows), k, jnp.int32))
        np.testing.assert_array_equal(place.corners[rows], alone.corners)
    square = find(wo.reshape(20, 30, 3), level.reshape(20, 30))
    np.testing.assert_array_equal(square.corners.reshape(600, 3), place.corners)
    mapped = jax.vmap(find)(wo, level)
    np.testing.assert_array_equal(mapped.corners, place.corners)
    np.testing.assert_allclose(mapped.shares, place.shares, atol=1e-6)


def test_slopes_of_shares(rng, dtype):
    """Within a triangle shares are smooth: against central differences in float64."""
    find = locator(3, np.dtype(dtype).type)
    wo = somewhere(rng)[500:1000]
    wo = wo[wo[:, 2] > 0.05]
    level = jnp.full(len(wo), 3, jnp.int32)
    along = rng.normal(size=wo.shape)

    def shares(v):
        return find(v, level).shares

    held = jnp.asarray(wo, dtype)
    value, slope = jax.jit(lambda v, t: jax.jvp(shares, (v,), (t,)))(
        held, jnp.asarray(along, dtype)
    )
    # Edges are kinks: away from them, by more than the step of the difference.
    inside = np.asarray(value).min(-1) > 1e-3
    assert inside.sum() > 300
    step = 1e-6
    corners = np.asarray(find(held, level).corners)
    matrix = np.linalg.inv(hemisphere(3).views[corners].transpose(0, 2, 1))

    def exact(v):
        own = np.einsum("nij,nj->ni", matrix, v)
        return own / own.sum(-1, keepdims=True)

    expected = (exact(wo + step * along) - exact(wo - step * along)) / (2.0 * step)
    size = np.abs(expected).max(-1, keepdims=True)
    # Differences: 1e-8; single precision, over triangles of 0.15.
    error = np.abs(np.asarray(slope) - expected) / size
    assert error[inside].max() < {"float32": 1e-4, "float64": 1e-7}[dtype]
    # On edges, at views and below the horizon slopes are finite.
    hard = np.concatenate([hemisphere(3).views, [[0, 0, -1.0], [1, 0, 0], [0, -0.6, -0.8]]])
    hard = jnp.asarray(hard, dtype)

    def total(v):
        place = find(v, jnp.full(len(hard), 3, jnp.int32))
        return (place.shares * jnp.asarray([[1.0, 2.0, 3.0]], dtype)).sum()

    assert np.isfinite(np.asarray(jax.jit(jax.grad(total))(hard))).all()
