"""Trees over triangles: what they hold, and that every box holds what is below it."""

import numpy as np
import pytest

from diffopt.kernels import hierarchy


def soup(rng, count):
    return rng.normal(size=(count, 1, 3)) + 0.1 * rng.normal(size=(count, 3, 3))


def corners_of(tree):
    """Corners in the leaves, [L, S, 3, 3]."""
    return np.stack(tree.corners, -1).reshape(len(tree.boxes[0]), -1, 3, 3)


@pytest.mark.parametrize("count", [1, 2, 24, 25, 100, 1000, 1025])
@pytest.mark.parametrize("leaf", [2, 4])
def test_leaves_hold_every_triangle(rng, count, leaf):
    triangles = soup(rng, count).astype(np.float32)
    tree = hierarchy.build(triangles, leaf=leaf)
    numbers = tree.numbers.reshape(len(tree.boxes[0]), -1)
    assert set(numbers.ravel()) == set(range(count))
    if count > hierarchy.DENSE:
        assert numbers.shape[1] <= leaf
    # No triangle is in two leaves.
    assert sum(len(set(row)) for row in numbers) == count
    held = corners_of(tree)
    assert held.dtype == np.float32
    # Scaled by a power of two without error, and in ascending order.
    given = np.sort(triangles[numbers].view("f4,f4,f4").reshape(held.shape[:3]))
    np.testing.assert_array_equal(held / tree.scale, given.view("f4").reshape(held.shape))


def test_boxes_hold_what_is_below(rng):
    tree = hierarchy.build(soup(rng, 777))
    leaves = len(tree.boxes[0])
    boxes = np.stack(tree.boxes, -1).reshape(leaves, 2, 2, 3)
    held = corners_of(tree)
    low, high = np.zeros((2 * leaves, 3)), np.zeros((2 * leaves, 3))
    low[2:], high[2:] = boxes[1:, :, 0].reshape(-1, 3), boxes[1:, :, 1].reshape(-1, 3)
    np.testing.assert_array_equal(low[leaves:], held.min((1, 2)))
    np.testing.assert_array_equal(high[leaves:], held.max((1, 2)))
    inner = np.arange(2, leaves)
    np.testing.assert_array_equal(low[inner], np.minimum(low[2 * inner], low[2 * inner + 1]))
    np.testing.assert_array_equal(high[inner], np.maximum(high[2 * inner], high[2 * inner + 1]))


def test_boxes_get_small(rng):
    """Leaves of a flat grid of 64 x 64 cells are some cells wide, not slabs of the grid."""
    x, y = np.meshgrid(np.arange(64.0), np.arange(64.0))
    first = np.stack([x, y, 0 * x], -1).reshape(-1, 1, 3)
    tree = hierarchy.build(first + np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]))
    held = corners_of(tree) / tree.scale
    assert np.ptp(held, axis=(1, 2)).max() <= 3


def test_faces_that_no_ray_hits_are_left_out():
    good = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    line = np.array([[0.0, 0, 0], [1, 1, 1], [3, 3, 3]])
    needle = np.array([[0.0, 0, 0], [1, 0, 0], [2, 1e-7, 0]])
    point = np.ones((3, 3))
    broken, endless = good.copy(), good.copy()
    broken[1, 1], endless[2, 0] = np.nan, np.inf
    tree = hierarchy.build(np.stack([line, good, point, 1e-30 * good, broken, needle, endless]))
    assert sorted(tree.numbers) == [1, 3, 5]
    assert len(tree.triangles) == 7


@pytest.mark.parametrize("triangles", [np.zeros((0, 3, 3)), np.zeros((5, 3, 3), np.float32)])
def test_nothing_to_hit(triangles):
    tree = hierarchy.build(triangles)
    assert tree.numbers.shape == (0,)
    assert tree.scale.dtype == triangles.dtype


def test_coincident_triangles(rng):
    one = soup(rng, 1)
    tree = hierarchy.build(np.repeat(one, 100, 0))
    assert sorted(set(tree.numbers)) == list(range(100))


@pytest.mark.parametrize("size", [1e-37, 1e-12, 1.0, 1e12, 1e38])
def test_coordinates_come_within_one(rng, size):
    triangles = (size * rng.uniform(-1, 1, (50, 3, 3))).astype(np.float32)
    held = np.abs(corners_of(hierarchy.build(triangles)))
    assert 2.0**-9 < held.max() <= 2.0**8  # the ends of the range of exponents
    if 1e-30 < size < 1e30:
        assert 0.5 <= held.max() <= 1.0
