"""Meshes made by code, with exact normals: teapot, torus, torus knot, rabbit.

Scene files name them as shapes. Each lies as other shapes do, z up; lengths are in the scene's
unit, and an object's transform places it.
"""

import math
from collections.abc import Callable

import numpy as np

from diffopt.errors import InputError
from diffopt.scenes import blends, newell, tubes
from diffopt.scenes.meshfiles import Mesh
from diffopt.scenes.origins import remember

# Divisions of a mesh one way, at most: 4 million faces.
_FINEST = 1024
# Points on the curve of a knot, for each that the mesh has, over which its twist is integrated.
_STEPS = 8
# Points on it whose distances are taken: 0.5 % of the length of a trefoil apart.
_SAMPLES = 1024


def teapot(divisions: int = 8) -> Mesh:
    """The Utah teapot: 32 bicubic Bezier patches, 3.15 high, on z = 0, its spout towards x.

    Body with bottom, lid, handle and spout are four surfaces, as Newell has them. Each is
    smooth throughout and welded at its seams; they are not joined with each other. Handle and
    spout reach through the wall of the body; their ends, the gap of 0.1 between lid and rim, and
    the mouth of the spout are open. Faces whose normals differ much from those of their
    vertices are at the lip of the spout, which turns within one patch.

    Parameters
    ----------
    divisions
        Of each side of a patch, 2 to 64. 8 makes 2082 vertices and 4032 faces; about
        32 divisions^2 vertices.

    Raises
    ------
    InputError
        For divisions outside the range.
    """
    _within("divisions", divisions, 2, 64)
    return remember(newell.build(divisions), shape="teapot", divisions=divisions)


def torus(radius: float = 1.0, tube: float = 0.4, around: int = 64, across: int = 32) -> Mesh:
    """Torus about the z axis.

    Parameters
    ----------
    radius
        Of the circle in the xy plane that the middle of the tube follows, above 0.
    tube
        Radius of the tube, above 0 and below `radius`.
    around, across
        Vertices along the circle and about the tube, 3 to 1024.

    Raises
    ------
    InputError
        For a value outside its range.
    """
    _lengths(radius=radius, tube=tube)
    if tube >= radius:
        raise InputError(
            f"tube must be below radius, or the torus meets itself; received {tube:g} "
            f"and {radius:g}"
        )
    _within("around", around, 3, _FINEST)
    _within("across", across, 3, _FINEST)
    turn = tubes.turns(around)
    outwards = np.stack([np.cos(turn), np.sin(turn), np.zeros(around)], -1)
    up = np.broadcast_to([0.0, 0.0, 1.0], outwards.shape)
    found = tubes.tube(radius * outwards, outwards, up, tube, across)
    known = {"radius": radius, "tube": tube, "around": around, "across": across}
    return remember(found, shape="torus", **known)


def knot(
    p: int = 2,
    q: int = 3,
    radius: float = 1.0,
    swing: float = 0.4,
    tube: float = 0.2,
    around: int = 256,
    across: int = 20,
) -> Mesh:
    """Tube about the torus knot that runs p times about the z axis while it swings q times.

    Its middle is at ((R + s cos q t) cos p t, (R + s cos q t) sin p t, s sin q t), t from 0 to
    2 pi. The frame across it is carried along without turning about the tangent: the frame of
    the torus, turned back by the integral of the rate at which it turns. What is left when it
    comes round is spread evenly over the length, so that the mesh closes.

    Parameters
    ----------
    p, q
        Times about the axis, and about the tube of the torus; from 1 to 32, without a common
        divisor, as it would be run through several times otherwise.
    radius, swing
        R and s of the torus that the knot lies on, above 0, s below R.
    tube
        Radius of the knot's own tube, above 0; below the smallest radius of curvature, and
        below half the distance of neighbouring strands.
    around, across
        Vertices along the knot and about its tube, 3 to 1024.

    Raises
    ------
    InputError
        For a value outside its range, and for a tube that meets itself.
    """
    _lengths(radius=radius, swing=swing, tube=tube)
    for name, times in (("p", p), ("q", q)):
        _within(name, times, 1, 32)
    if math.gcd(p, q) != 1:
        raise InputError(f"p and q must have no common divisor; received {p} and {q}")
    if swing >= radius:
        raise InputError(f"swing must be below radius; received {swing:g} and {radius:g}")
    _within("around", around, 3, _FINEST)
    _within("across", across, 3, _FINEST)
    room = tubes.room(*tubes.torus_knot(tubes.turns(_SAMPLES), p, q, radius, swing)[:3])
    if tube >= room:
        raise InputError(
            f"tube must be below {room:.4g}, or the knot meets itself; received {tube:g}"
        )
    turn = tubes.turns(around * _STEPS)
    points, ahead, _, out, rate = tubes.torus_knot(turn, p, q, radius, swing)
    side = np.cross(out, ahead)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    # The rate is that of turning from `out` to `side`.
    back = tubes.carried((rate * side).sum(-1))[:, None]
    first = np.cos(back) * out + np.sin(back) * side
    second = np.cos(back) * side - np.sin(back) * out
    kept = slice(None, None, _STEPS)
    found = tubes.tube(points[kept], first[kept], second[kept], tube, across)
    known = {"p": p, "q": q, "radius": radius, "swing": swing, "tube": tube}
    return remember(found, shape="knot", **known, around=around, across=across)


def rabbit(detail: int = 33) -> Mesh:
    """A sitting rabbit, closed and smooth, about 2 high, on z = 0, looking towards x.

    Parameters
    ----------
    detail
        Cells of the grid along its height, 24 to 128. 33 makes some 2,550 vertices; their
        number grows with the square.

    Raises
    ------
    InputError
        For detail outside the range.
    """
    _within("detail", detail, 24, 128)
    return remember(blends.build(blends.RABBIT, detail), shape="rabbit", detail=detail)


#: Models by the names that scene files have for them.
MODELS: dict[str, Callable[..., Mesh]] = {
    "teapot": teapot,
    "torus": torus,
    "knot": knot,
    "rabbit": rabbit,
}
#: Their parameters, and whether each is a whole number.
PARAMETERS: dict[str, dict[str, bool]] = {
    "teapot": {"divisions": True},
    "torus": {"radius": False, "tube": False, "around": True, "across": True},
    "knot": {
        "p": True,
        "q": True,
        "radius": False,
        "swing": False,
        "tube": False,
        "around": True,
        "across": True,
    },
    "rabbit": {"detail": True},
}


def _within(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise InputError(f"{name} must be a whole number from {low} to {high}; received {value}")


def _lengths(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} must be a length above 0; received {value}")
