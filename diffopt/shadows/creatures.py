"""Meshes for animations: a flying creature, an egg, a sheet."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int

# Stations along the body, from the tip of the tail to the nose: place, height, half width, half
# height. The first 15 are the tail.
_SPINE = np.array(
    [
        [-1.42, 0.03, 0.010, 0.010],
        [-1.34, 0.03, 0.085, 0.012],
        [-1.26, 0.03, 0.100, 0.014],
        [-1.18, 0.03, 0.040, 0.018],
        [-1.10, 0.02, 0.024, 0.024],
        [-1.00, 0.02, 0.032, 0.032],
        [-0.90, 0.01, 0.040, 0.040],
        [-0.80, 0.00, 0.050, 0.048],
        [-0.70, 0.00, 0.060, 0.056],
        [-0.60, 0.00, 0.074, 0.068],
        [-0.50, 0.00, 0.092, 0.084],
        [-0.40, 0.00, 0.114, 0.104],
        [-0.30, 0.00, 0.136, 0.128],
        [-0.20, 0.00, 0.154, 0.150],
        [-0.10, 0.00, 0.164, 0.168],
        [0.00, 0.00, 0.170, 0.184],
        [0.10, 0.00, 0.170, 0.192],
        [0.20, 0.00, 0.160, 0.188],
        [0.30, 0.02, 0.140, 0.166],
        [0.38, 0.05, 0.112, 0.134],
        [0.46, 0.09, 0.090, 0.106],
        [0.54, 0.14, 0.076, 0.088],
        [0.61, 0.20, 0.068, 0.076],
        [0.68, 0.26, 0.062, 0.068],
        [0.75, 0.31, 0.060, 0.064],
        [0.81, 0.35, 0.068, 0.068],
        [0.87, 0.37, 0.084, 0.080],
        [0.93, 0.37, 0.088, 0.080],
        [0.99, 0.36, 0.072, 0.066],
        [1.06, 0.345, 0.056, 0.050],
        [1.13, 0.33, 0.050, 0.042],
        [1.19, 0.32, 0.040, 0.032],
        [1.22, 0.315, 0.014, 0.012],
    ]
)
_TAIL = 15
_ROUND = 12
# Wings: stations over the span, over the chord, length of the span.
_STATIONS, _CHORD, _SPAN = 27, 7, 1.3
_FINGERS = 4


def tubes(rings: Float[np.ndarray, "n m 3"]) -> Float[np.ndarray, "V 3"]:
    """Vertices of a closed tube: rings one after the other, then the middles of its ends."""
    ends = rings[[0, -1]].mean(1)
    return np.concatenate([rings.reshape(-1, 3), ends])


def tube_faces(rings: int, sides: int) -> Int[np.ndarray, "F 3"]:
    """Faces of `tubes`: outwards for rings that run counter-clockwise, seen from the last one."""
    ring, side = (a.reshape(-1) for a in np.indices((rings - 1, sides)))
    beside = (side + 1) % sides
    a, b = ring * sides + side, ring * sides + beside
    c, d = a + sides, b + sides
    around, after = np.arange(sides), (np.arange(sides) + 1) % sides
    low, high = np.full(sides, rings * sides), np.full(sides, rings * sides + 1)
    top = (rings - 1) * sides
    return np.concatenate(
        [
            np.stack([a, b, d], -1),
            np.stack([a, d, c], -1),
            np.stack([low, after, around], -1),
            np.stack([high, top + around, top + after], -1),
        ]
    )


def joined(parts: Sequence[Int[np.ndarray, "_ 3"]], counts: Sequence[int]) -> list[np.ndarray]:
    """Faces of meshes whose vertices, so many of each, follow each other in one array."""
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    return [part + at for part, at in zip(parts, first, strict=True)]


@lru_cache(maxsize=1)
def creature_parts() -> tuple[Int[np.ndarray, "_ 3"], ...]:
    """Faces of the creature: body with head, horns and legs, tail, left wing, right wing."""
    body = tube_faces(len(_SPINE), _ROUND)
    limbs = [tube_faces(5, 5)] * 2 + [tube_faces(6, 6)] * 2
    wing = tube_faces(_STATIONS, 2 * _CHORD - 2)
    counts = [len(_SPINE) * _ROUND + 2, *[27] * 2, *[38] * 2]
    counts += [_STATIONS * (2 * _CHORD - 2) + 2] * 2
    # Rings of the left wing run clockwise; the right one is its mirror image.
    faces = joined([body, *limbs, wing[:, ::-1], wing], counts)
    tip = len(_SPINE) * _ROUND
    tail = ((faces[0] < _TAIL * _ROUND) | (faces[0] == tip)).all(1)
    trunk = np.concatenate([faces[0][~tail], *faces[1:5]])
    return trunk, faces[0][tail], faces[5], faces[6]


def creature(beat: float, sway: float) -> Float[np.ndarray, "V 3"]:
    """Vertices of a creature in flight: nose along x, back along z, wings along y.

    Parameters
    ----------
    beat
        Phase of the wings, radians: down from pi / 2 on.
    sway
        Phase of the tail's wave, radians.
    """
    spine = _swaying(beat, sway)
    bodies = [tubes(_trunk(spine))]
    head = spine[26]
    bodies += [tubes(_horn(head, side)) for side in (1.0, -1.0)]
    bodies += [tubes(_leg(spine[13], side, sway)) for side in (1.0, -1.0)]
    left = tubes(_wing(beat)) + np.array([0.0, 0.0, spine[17, 2]])
    return np.concatenate([*bodies, left, left * np.array([1.0, -1.0, 1.0])])


def _swaying(beat: float, sway: float) -> np.ndarray:
    """Middles of the body's rings: tail and neck wave, the trunk rises as the wings go down."""
    x = _SPINE[:, 0]
    behind = np.clip(-0.1 - x, 0.0, None) / 1.32
    ahead = np.clip(x - 0.3, 0.0, None) / 0.92
    rise = -0.06 * np.sin(beat)
    middle = np.stack([x, np.zeros_like(x), _SPINE[:, 1] + rise], -1)
    middle[:, 1] += 0.26 * behind**1.5 * np.sin(sway - 3.5 * behind)
    middle[:, 2] += 0.20 * behind**1.5 * np.sin(beat - 1.0 - 3.0 * behind)
    middle[:, 2] += 0.05 * ahead * np.sin(beat + 0.6)
    middle[:, 1] += 0.06 * ahead**2 * np.sin(sway + 1.0)
    return middle


def _axes(middle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sideways and upwards across a curve."""
    along = np.gradient(middle, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross([0.0, 0.0, 1.0], along)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    return aside, np.cross(along, aside)


def _trunk(spine: np.ndarray) -> np.ndarray:
    """Rings of the body; every other one has a spike on its back."""
    aside, up = _axes(spine)
    angle = np.arange(_ROUND) * 2.0 * np.pi / _ROUND
    wide, high = _SPINE[:, 2, None] * np.cos(angle), _SPINE[:, 3, None] * np.sin(angle)
    ridge = np.zeros(_ROUND)
    ridge[_ROUND // 4] = 1.0
    spikes = np.where((np.arange(len(spine)) % 2 == 0) & (_SPINE[:, 0] < 0.8), 0.055, 0.0)
    spikes[:5] = 0.0
    high = high + spikes[:, None] * ridge
    return spine[:, None] + wide[..., None] * aside[:, None] + high[..., None] * up[:, None]


def _cone(curve: np.ndarray, radii: Sequence[float], sides: int) -> np.ndarray:
    """Rings about a curve."""
    aside, up = _axes(curve)
    angle = np.arange(sides) * 2.0 * np.pi / sides
    around = np.cos(angle)[:, None] * aside[:, None] + np.sin(angle)[:, None] * up[:, None]
    return curve[:, None] + np.asarray(radii)[:, None, None] * around


def _horn(head: np.ndarray, side: float) -> np.ndarray:
    """A horn, from its tip to the head."""
    s = np.linspace(1.0, 0.0, 5)
    offset = np.stack([-0.02 - 0.24 * s, side * (0.045 + 0.05 * s), 0.05 + 0.16 * s - 0.06 * s**2])
    return _cone(head + offset.T, [0.004, 0.012, 0.018, 0.023, 0.028], 5)


def _leg(hip: np.ndarray, side: float, sway: float) -> np.ndarray:
    """A leg that trails, from its foot to the hip."""
    s = np.linspace(1.0, 0.0, 6)
    swing = 0.03 * np.sin(sway + side)
    offset = [-0.34 * s, side * (0.11 + 0.03 * s), -0.08 - 0.14 * np.sin(2.2 * s) + swing * s]
    return _cone(hip + np.stack(offset).T, [0.012, 0.026, 0.03, 0.042, 0.058, 0.07], 6)


def _wing(beat: float) -> np.ndarray:
    """Rings about the left wing, from its root to its tip: a membrane on four fingers."""
    s = np.linspace(0.0, 1.0, _STATIONS)
    front = np.interp(s, [0, 0.2, 0.4, 0.55, 0.75, 1.0], [0.26, 0.36, 0.43, 0.42, 0.28, -0.14])
    back = np.interp(s, [0, 0.25, 0.5, 0.75, 1.0], [-0.30, -0.40, -0.46, -0.42, -0.20])
    back = back + 0.10 * np.abs(np.sin(np.pi * _FINGERS * s)) * (1.0 - 0.4 * s)
    # The slope along the span: the hand follows the arm.
    slope = 0.10 + 0.50 * np.sin(beat) + 0.75 * s * np.sin(beat - 0.9 - 0.9 * s)
    middle = 0.5 * (slope[1:] + slope[:-1])
    step = _SPAN / (_STATIONS - 1)
    y = 0.06 + np.concatenate([[0.0], np.cumsum(np.cos(middle) * step)])
    z = 0.09 + np.concatenate([[0.0], np.cumsum(np.sin(middle) * step)])
    c = np.linspace(0.0, 1.0, _CHORD)
    x = front[:, None] + (back - front)[:, None] * c
    # The membrane bulges against the motion of the wing, fingers stand out of it.
    speed = np.cos(beat - 0.5)
    between = np.abs(np.sin(np.pi * _FINGERS * s))[:, None] * np.sin(np.pi * c**0.8)
    lift = -0.05 * speed * s[:, None] * between
    lift = lift + 0.22 * np.cos(beat - 0.4) * s[:, None] * (x - front[:, None])
    half = (0.024 * (1.0 - c) ** 3 + 0.006) * (1.0 - 0.6 * s[:, None])
    bottom, top = lift - half, lift + half
    around = np.concatenate([top, bottom[:, -2:0:-1]], 1)
    x = np.concatenate([x, x[:, -2:0:-1]], 1)
    up = np.stack([np.zeros_like(s), -np.sin(slope), np.cos(slope)], -1)
    rings = np.stack([x, *(np.broadcast_to(a[:, None], x.shape) for a in (y, z))], -1)
    return rings + around[..., None] * up[:, None]


def ball(rings: int, sides: int) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Vertices on the unit sphere, rings x sides and the two poles, and faces."""
    theta = np.arange(1, rings + 1) * np.pi / (rings + 1)
    phi = np.arange(sides) * 2.0 * np.pi / sides
    theta, phi = np.meshgrid(np.pi - theta, phi, indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    poles = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    return np.concatenate([points.reshape(-1, 3), poles]), tube_faces(rings, sides)


def sheet(
    length: float, width: float, columns: int, rows: int
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """A flat sheet in the plane z = 0, its length along x, and its faces."""
    x, y = np.meshgrid(
        length * np.linspace(-0.5, 0.5, columns),
        width * np.linspace(-0.5, 0.5, rows),
        indexing="ij",
    )
    points = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    column, row = (a.reshape(-1) for a in np.indices((columns - 1, rows - 1)))
    a = column * rows + row
    b, c, d = a + rows, a + rows + 1, a + 1
    return points, np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
