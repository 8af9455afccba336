"""Deforming objects to watch: a flying creature, a transforming egg, a bending sheet, any mesh.

Each is a function of a phase t in [0, 1) to vertices, and loops. They stand over a plane of
receivers, 8 units wide, under a sky with a sun and a lamp that goes round (`sky`, `lamp`).
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from diffopt import checks
from diffopt.errors import InputError
from diffopt.shadows import creatures
from diffopt.shadows.lights import SphereLight

#: Names of the animations.
NAMES = ("creature", "egg", "sheet")
#: Width of the plane of receivers at z = 0.
GROUND = 8.0

_TURN = 2.0 * np.pi
_SUN = np.array([-0.50, -0.34, 0.80]) / np.linalg.norm([-0.50, -0.34, 0.80])
_SKY_RGB, _SUN_RGB = np.array([0.25, 0.285, 0.345]), np.array([3.1, 2.68, 2.02])
_SHARPNESS = 15.0
_LAMP_RGB = (62.0, 32.0, 11.0)
_LAMP_RADIUS = 0.12


@dataclasses.dataclass(frozen=True)
class Animation:
    """An object that deforms and moves in a loop.

    Attributes
    ----------
    name
        As the user knows it.
    faces
        Corners of triangles, [F, 3].
    shape
        From a phase to vertices [V, 3] in the object's frame.
    pose
        From a phase to rotation [3, 3] and translation [3], from that frame to the world.
    limbs
        Faces of its parts, for an `Occluder` of several fields; empty where it has none.
    colour
        Albedo of the object, linear RGB.
    """

    name: str
    faces: Int[np.ndarray, "F 3"]
    shape: Callable[[float], Float[np.ndarray, "V 3"]]
    pose: Callable[[float], tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]]
    limbs: tuple[Int[np.ndarray, "_ 3"], ...] = ()
    colour: tuple[float, float, float] = (0.6, 0.6, 0.6)

    def vertices(self, t: float) -> Float[np.ndarray, "V 3"]:
        """Vertices in the world."""
        rotation, translation = self.pose(t)
        return self.shape(t) @ rotation.T + translation


def animation(name: str) -> Animation:
    """One of `NAMES`.

    creature
        1,180 vertices: a winged creature flies a circle, its wings beat three times on the way.
    egg
        482 vertices: an egg grows lobes, flattens and twists.
    sheet
        8,382 vertices: a sheet bends up and down.

    Raises
    ------
    InputError
        For another name.
    """
    checks.choice("animation", name, NAMES)
    return {"creature": _creature, "egg": _egg, "sheet": _sheet}[name]()


def of_mesh(vertices: Any, faces: Any, name: str = "mesh", up: str = "z") -> Animation:
    """A mesh that twists and bends: scaled to radius 1, over the ground.

    Parameters
    ----------
    vertices, faces
        [V, 3] and [F, 3], any unit of length.
    name
        As the user knows it.
    up
        Axis of the mesh that is upwards: "x", "y" or "z".
    """
    order = {"x": (1, 2, 0), "y": (2, 0, 1), "z": (0, 1, 2)}
    axes = order[checks.choice("up", up, tuple(order))]
    points = np.asarray(vertices, np.float64)[:, axes]
    faces = np.asarray(faces)
    middle = 0.5 * (points.min(0) + points.max(0))
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    if not radius > 0.0:
        raise InputError(f"{name}: all vertices lie in one point")
    rest = (points - middle) / radius

    def shape(t: float) -> np.ndarray:
        twist, bend = 0.9 * np.sin(_TURN * t), 0.35 * (1.0 - np.cos(_TURN * t))
        return bent(twisted(rest, float(twist))[:, ::-1], float(bend))[:, ::-1]

    lowest = min(shape(t)[:, 2].min() for t in np.arange(12) / 12.0)
    height = np.array([0.0, 0.0, max(0.12 - float(lowest), 0.0)])
    return Animation(name, faces, shape, lambda t: (np.eye(3), height), (), (0.55, 0.42, 0.33))


def bent(points: Float[np.ndarray, "V 3"], curvature: float) -> Float[np.ndarray, "V 3"]:
    """Bend the plane of x and y upwards along x: lengths in it are kept."""
    x, y, z = np.moveaxis(points, -1, 0)
    angle = curvature * x
    # sin a / a and (1 - cos a) / a, also for no curvature.
    along, over = x * np.sinc(angle / np.pi), 0.5 * angle * x * np.sinc(0.5 * angle / np.pi) ** 2
    return np.stack([along - z * np.sin(angle), y, over + z * np.cos(angle)], -1)


def twisted(points: Float[np.ndarray, "V 3"], rate: float) -> Float[np.ndarray, "V 3"]:
    """Turn about z by an angle that grows with z."""
    x, y, z = np.moveaxis(points, -1, 0)
    cos, sin = np.cos(rate * z), np.sin(rate * z)
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], -1)


def sky(
    directions: Float[np.ndarray, "n 3"], sun: Float[np.ndarray, "3"] = _SUN
) -> Float[np.ndarray, "n 3"]:
    """Radiance of sky and sun, linear RGB: bluish, brighter overhead, dark below the horizon."""
    up = np.clip(directions[:, 2], 0.0, None)
    lobe = np.exp(_SHARPNESS * (directions @ sun - 1.0)) * (up > 0.0)
    above = np.where(directions[:, 2] > 0.0, 0.45 + 0.55 * up, 0.0)
    return above[:, None] * _SKY_RGB + lobe[:, None] * _SUN_RGB


def lamp(t: float) -> SphereLight:
    """A warm lamp that goes round the object once."""
    angle = _TURN * t + 0.5
    centre = np.array([2.7 * np.cos(angle), 2.1 * np.sin(angle), 2.0 + 0.25 * np.sin(2.0 * angle)])
    return SphereLight(centre, _LAMP_RADIUS, _LAMP_RGB)


def _about(axis: int, angle: float) -> np.ndarray:
    cos, sin = np.cos(angle), np.sin(angle)
    found = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    found[i, i] = found[j, j] = cos
    found[i, j], found[j, i] = -sin, sin
    return found


def _creature() -> Animation:
    limbs = creatures.creature_parts()

    def pose(t: float) -> tuple[np.ndarray, np.ndarray]:
        angle = _TURN * t + 2.5
        place = [0.75 * np.cos(angle), 0.75 * np.sin(angle), 1.3 + 0.1 * np.sin(2.0 * angle)]
        # It looks along its way and leans into the turn.
        return _about(2, angle + 0.5 * np.pi) @ _about(0, -0.22), np.array(place)

    return Animation(
        "creature",
        np.concatenate(limbs),
        lambda t: creatures.creature(_TURN * (3.0 * t + 0.15), _TURN * 2.0 * t),
        pose,
        limbs,
        (0.42, 0.16, 0.10),
    )


def _egg() -> Animation:
    unit, faces = creatures.ball(20, 24)
    theta, phi = np.arccos(np.clip(unit[:, 2], -1.0, 1.0)), np.arctan2(unit[:, 1], unit[:, 0])

    def shape(t: float) -> np.ndarray:
        angle = _TURN * t
        lobes = 0.5 * (1.0 - np.cos(angle))
        waist = 0.5 * (1.0 - np.cos(2.0 * angle))
        radius = 1.0 + 0.5 * lobes * np.sin(theta) ** 3 * np.cos(3.0 * phi)
        radius = radius - 0.35 * waist * np.sin(theta) ** 6 * (1.0 - lobes)
        # An egg is wider below; its lobes flatten it.
        wide = (0.72 - 0.14 * unit[:, 2]) * (1.0 + 0.1 * lobes)
        scale = np.stack([wide, wide, np.full_like(wide, 1.0 - 0.45 * lobes)], -1)
        return twisted(unit * radius[:, None] * scale, 1.1 * float(np.sin(angle)))

    def pose(t: float) -> tuple[np.ndarray, np.ndarray]:
        tilt = 0.35 * np.sin(_TURN * t)
        return _about(1, tilt), np.array([0.0, 0.0, 1.2])

    return Animation("egg", faces, shape, pose, (), (0.62, 0.52, 0.36))


def _sheet() -> Animation:
    flat, faces = creatures.sheet(2.4, 1.25, 127, 66)
    tilt = _about(2, 0.35) @ _about(0, 0.3)

    def shape(t: float) -> np.ndarray:
        found = bent(flat, 1.35 * float(np.sin(_TURN * t)))
        return found - np.array([0.0, 0.0, found[:, 2].mean()])

    return Animation(
        "sheet", faces, shape, lambda t: (tilt, np.array([0.0, 0.0, 1.25])), (), (0.20, 0.42, 0.45)
    )
