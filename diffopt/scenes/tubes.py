"""Tubes about closed curves, and the curves and frames of torus knots."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from diffopt.scenes.meshfiles import Mesh


def turns(count: int) -> Float[np.ndarray, " n"]:
    """Angles of a full turn, the last before it comes round."""
    return np.arange(count) * (2.0 * math.pi / count)


class Curve(NamedTuple):
    """See `torus_knot`."""

    points: Float[np.ndarray, "n 3"]
    slopes: Float[np.ndarray, "n 3"]
    bends: Float[np.ndarray, "n 3"]
    outwards: Float[np.ndarray, "n 3"]
    turning: Float[np.ndarray, "n 3"]


def torus_knot(t: Float[np.ndarray, " n"], p: int, q: int, radius: float, swing: float) -> Curve:
    """Points, first and second derivatives; the torus's normal there and its derivative."""
    zero = np.zeros_like(t)
    axis = np.stack([np.cos(p * t), np.sin(p * t), zero], -1)
    side = np.stack([-np.sin(p * t), np.cos(p * t), zero], -1)
    up = np.array([[0.0, 0.0, 1.0]])
    c, s = np.cos(q * t)[:, None], np.sin(q * t)[:, None]
    reach = radius + swing * c
    outwards = c * axis + s * up
    turning = q * (c * up - s * axis) + p * c * side
    bends = -((p * p) * reach + (q * q * swing) * c) * axis
    bends = bends - (2 * p * q * swing) * s * side - (q * q * swing) * s * up
    return Curve(
        reach * axis + swing * s * up,
        p * reach * side + (q * swing) * (c * up - s * axis),
        bends,
        outwards,
        turning,
    )


def room(
    points: Float[np.ndarray, "n 3"], slopes: Float[np.ndarray, "n 3"], bends: np.ndarray
) -> float:
    """Radius at which the tube about a closed curve meets itself.

    The smallest radius of curvature, or half the smallest distance of points that are farther
    than half a circle of that radius apart along the curve (Litherland, Simon, Durumeric,
    Rawdon, Thickness of knots, Topology and its Applications 91, 1999).
    """
    speed = np.linalg.norm(slopes, axis=-1)
    curvature = np.linalg.norm(np.cross(slopes, bends), axis=-1) / speed**3
    bend = 1.0 / float(curvature.max())
    length = np.cumsum(speed) * (2.0 * math.pi / len(points))
    along = np.abs(length[:, None] - length[None])
    along = np.minimum(along, length[-1] - along)
    squared = (points**2).sum(-1)
    apart = squared[:, None] + squared[None] - 2.0 * points @ points.T
    far = apart[along >= math.pi * bend]
    nearest = math.sqrt(max(float(far.min()), 0.0)) if far.size else math.inf
    return min(bend, 0.5 * nearest)


def carried(rate: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Angles that undo a periodic rate of turning, a whole number of turns in all.

    The integral of the rate less its mean is periodic, and exact by its Fourier series.
    """
    series = np.fft.rfft(rate)
    times = np.arange(len(series))
    series = np.where(times > 0, series / (1j * np.maximum(times, 1)), 0.0)
    swings = np.fft.irfft(series, len(rate))
    return -(swings - swings[0]) - round(float(rate.mean())) * turns(len(rate))


def tube(
    middle: Float[np.ndarray, "n 3"],
    first: Float[np.ndarray, "n 3"],
    second: Float[np.ndarray, "n 3"],
    radius: float,
    across: int,
) -> Mesh:
    """Closed tube about a closed line; the axes across it turn left-handed about its way.

    The normals of a tube of one radius are the directions away from its middle, exactly.
    """
    turn = turns(across)[None, :, None]
    normals = np.cos(turn) * first[:, None] + np.sin(turn) * second[:, None]
    vertices = middle[:, None] + radius * normals
    here = np.arange(len(middle) * across).reshape(len(middle), across)
    along, about = np.roll(here, -1, axis=0), np.roll(here, -1, axis=1)
    both = np.roll(along, -1, axis=1)
    faces = [
        np.stack(three, -1).reshape(-1, 3) for three in ((here, both, about), (here, along, both))
    ]
    return Mesh(vertices.reshape(-1, 3), np.concatenate(faces), normals.reshape(-1, 3))
