"""Hard inputs of the queries of rays: see `hard_cases`."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from hard_cases import LD, Hard

from diffopt.kernels import hierarchy, intersect, traversal

# Two faces that share an edge, one that lies behind them, and one without area.
FACES = np.array(
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0.25]],
        [[1, 0, 0], [1, 1, 0.5], [0, 1, 0.25]],
        [[-1, -1, -1], [2, -1, -1], [-1, 3, -1]],
        [[0, 0, 2], [1, 0, 2], [2, 0, 2]],
    ],
    float,
)
TREE = hierarchy.build(FACES)
# Along an axis, with zeros of either sign, from behind, slanted, past everything, slanted.
ORIGINS = np.array(
    [[0.25, 0.25, 3], [0.75, 0.5, 3], [0.25, 0.5, -4], [4, 5, 6], [0, 0, 5], [0.25, 0.125, 1]]
)
DIRECTIONS = np.array(
    [[0, 0, -1.0], [-0.0, 0.0, -0.25], [0, -0.0, 8], [-3.7, -4.6, -6], [0, 1, 0], [3, 4, -9]]
)
# Through an edge, through a corner, within a plane, along an edge, from a face, nowhere.
EDGES = np.array(
    [[0.5, 0.5, 3], [1, 0, 3], [-3, 0.25, -1], [-2, 0, 0], [0.25, 0.25, -1], [0.25, 0.125, 1]]
)
ALONG = np.array([[0, 0, -1.0], [0, 0, -1], [1, 0, 0], [1, 0, 0], [0, 0, 1], [0, 0, 0]])
CENTRES = np.array([[0.0, 0, 0], [0.5, 0, -4], [30, 0, 0]])
RADII = np.array([1.0, 2.0, 0.25])
NORMALS = np.array([[0, 0, 1.0], [0, 0.6, -0.8], [1, 0, 0]])
# From far off, from the inside, from the sphere itself both ways, past.
BALLS = np.array([[0.3, 0.2, 8e3], [0.1, 0.2, 0.3], [0, 0, 1.0], [0, 0, 1.0], [0, 40, 0]])
SHOTS = np.array([[0, -0.0, -1.0], [0.5, 0.1, 2], [0, 0, -2], [0.1, 0, 1], [1, 0, 0]])


def intersect_rows():
    """All of them, compiled as a whole."""
    for row in _rows():
        yield replace(row, call=jax.jit(row.call))


def _held(o):
    """The tree as the dtype holds it, with faces that may be differentiated by."""
    return jax.tree.map(
        lambda a: a if a.dtype == np.int32 else jnp.asarray(a.astype(o.dtype)), TREE
    )


def _first(o, d, faces):
    distance, triangle, u, v = intersect.first_hit(_held(o)._replace(triangles=faces), o, d)
    return jnp.where(triangle >= 0, distance, 0.0), u, v


def _moeller(o, d, faces):
    """Distance and weights of the nearest face by all pairs, zeros without one."""
    out = np.zeros((3, len(o)), LD)
    for i in range(len(o)):
        best = LD(np.inf)
        for p in faces:
            first, second, away = p[1] - p[0], p[2] - p[0], o[i] - p[0]
            across, turned = np.cross(d[i], second), np.cross(away, first)
            volume = first @ across
            if volume == 0:
                continue
            t, u, v = second @ turned / volume, away @ across / volume, d[i] @ turned / volume
            if min(u, v, 1 - u - v) >= 0 and 0 < t < best:
                best = t
                out[:, i] = t, u, v
    return tuple(out)


def _found(t):
    return jnp.where(jnp.isfinite(t), t, 0.0)


def _nearest(candidates):
    """The nearest distances above rounding, zeros without one."""
    good = np.where(np.isfinite(candidates) & (candidates > 1e-4), candidates, np.inf)
    nearest = good.min(-1)
    return np.where(np.isfinite(nearest), nearest, 0)


def _balls(o, d, centres, radii):
    away = o[:, None] - centres
    a, b = (d * d).sum(-1)[:, None], (away * d[:, None]).sum(-1)
    c = (away * away).sum(-1) - radii**2
    inside = b * b - a * c
    root = np.sqrt(np.where(inside > 0, inside, np.nan))
    return _nearest(np.concatenate([(-b - root) / a, (-b + root) / a], -1))


def _plates(o, d, centres, normals, radii):
    slope = d @ normals.T
    height = ((centres - o[:, None]) * normals).sum(-1)
    t = np.where(slope != 0, height / np.where(slope != 0, slope, 1), np.nan)
    off = o[:, None] + t[..., None] * d[:, None] - centres
    return _nearest(np.where((off**2).sum(-1) <= radii**2, t, np.nan))


def _rows():
    # A distance of 40 rounds by its eps, weights by eps of a distance over a side.
    yield Hard("intersect.first_hit", "inner", _first, (ORIGINS, DIRECTIONS, FACES), _moeller, 40)
    yield Hard(
        "hierarchy.build", "edges", _first, (EDGES, ALONG, FACES), _moeller, ulps=40, smooth=False
    )
    for kernel, call in (
        ("traversal.search", lambda o, d, e: _found(traversal.search(_held(o), o, d, e)[0])),
        (
            "intersect.blocked",
            lambda o, d, e: intersect.blocked(_held(o), o, d, e).astype(o.dtype),
        ),
    ):
        yield Hard(
            kernel,
            "tiny",
            call,
            # Lengths whose squares vanish in float32, in units of their own.
            (ORIGINS, 1e-25 * DIRECTIONS, np.full(6, 1e27)),
            lambda o, d, e, kernel=kernel: (
                (_moeller(o, d, FACES.astype(LD))[0] > 0).astype(LD)
                if kernel == "intersect.blocked"
                else _moeller(o, d, FACES.astype(LD))[0]
            ),
            ulps=40,
            smooth=False,
        )
    yield Hard(
        "traversal.size",
        "zero and tiny",
        lambda d: traversal.size(d)[0],
        (np.array([[0, 0, 0], [-0.0, -3e-30, 1e-30], [1e30, -2e30, 0]]),),
        lambda d: np.where(np.abs(d).max(-1) > 0, np.abs(d).max(-1), 1),
        smooth=False,
    )
    yield Hard(
        "intersect.spheres",
        "far, inside and on",
        lambda *a: _found(intersect.spheres(*a, least=1e-4)[0]),
        (BALLS, SHOTS, CENTRES, RADII),
        _balls,
        smooth=False,  # slopes at 8e3 against differences of 1e-8: the next row
    )
    yield Hard(
        "intersect.spheres",
        "slopes",
        lambda *a: _found(intersect.spheres(*a, least=1e-4)[0]),
        (BALLS[1:], SHOTS[1:], CENTRES, RADII),
        _balls,
    )
    yield Hard(
        "intersect.discs",
        "along the normal and across",
        lambda *a: _found(intersect.discs(*a, least=1e-4)[0]),
        (BALLS[1:], SHOTS[1:] * 0.25, CENTRES, NORMALS, RADII),
        _plates,
        gradient_ulps=1e4,
    )
