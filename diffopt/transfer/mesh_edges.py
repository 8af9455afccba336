"""Edges of triangles as pairs of vertex numbers, the lower first: found, counted, halved."""

import numpy as np
from jaxtyping import Bool, Int


def sides(corners: Int[np.ndarray, "n 3"]) -> Int[np.ndarray, "n 3 2"]:
    """Ends of the sides from each corner to the next."""
    after = corners[:, [1, 2, 0]]
    return np.stack([np.minimum(corners, after), np.maximum(corners, after)], axis=-1)


def unique(
    ends: Int[np.ndarray, "n 3 2"], count: int
) -> tuple[Int[np.ndarray, "E 2"], Int[np.ndarray, "n 3"]]:
    """Different edges of `count` vertices, sorted, and the number of each side among them."""
    keys, index = np.unique(_keys(ends, count), return_inverse=True)
    low, high = np.divmod(keys, max(count, 1))
    return np.stack([low, high], axis=1).astype(np.int32), index.reshape(-1, 3)


def find(
    known: Int[np.ndarray, "k 2"], ends: Int[np.ndarray, "... 2"], count: int
) -> Int[np.ndarray, "..."]:
    """A place in `known` of each edge, -1 for those not there; of `count` vertices."""
    keys, ordered = _keys(ends, count), _keys(known, count)
    if len(ordered) == 0:
        return np.full(keys.shape, -1)
    order = np.argsort(ordered, kind="stable")
    ordered = ordered[order]
    at = np.minimum(np.searchsorted(ordered, keys), len(ordered) - 1)
    return np.where(ordered[at] == keys, order[at], -1)


def touching(
    corners: Int[np.ndarray, "n 3"], edges: Int[np.ndarray, "E 2"], count: int
) -> Bool[np.ndarray, " n"]:
    """Which faces have two corners among the ends of edges: few, to be looked at closely."""
    marked = _marked(edges, count)
    a, b, c = (marked[corners[:, k]] for k in range(3))
    return (a & b) | (b & c) | (c & a)


def midpoints(
    halved: Int[np.ndarray, "V 2"], initial: int, edges: Int[np.ndarray, "... 2"]
) -> Int[np.ndarray, "..."]:
    """Vertices that halve edges, -1 for none.

    Parameters
    ----------
    halved
        The edge that each vertex halves.
    initial
        Number of vertices, in front of the others, that halve none.
    edges
        Pairs of vertices.
    """
    marked = _marked(edges, len(halved))
    later = halved[initial:]
    near = np.flatnonzero(marked[later[:, 0]] & marked[later[:, 1]])
    found = find(later[near], edges, len(halved))
    return np.append(initial + near, -1)[found]


def _marked(edges: np.ndarray, count: int) -> np.ndarray:
    marked = np.zeros(count, bool)
    marked[edges] = True
    return marked


def _keys(edges: np.ndarray, count: int) -> np.ndarray:
    """One number for each edge, in the order of the pairs."""
    return edges[..., 0].astype(np.int64) * count + edges[..., 1]
