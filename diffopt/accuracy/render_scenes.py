"""Scenes on which levels of image synthesis are measured, made by code.

Each stresses what tells the levels apart: light between surfaces, caustics, mirrors, glossy
surfaces under points, light from all sides.
"""

from collections.abc import Callable

import numpy as np

from diffopt import checks, fresnel, scenes
from diffopt.materials import Dielectric, Lambert, Material, Microfacet, Mirror, Scaled
from diffopt.materials.naming import named
from diffopt.scenes import Camera, Object, Scene

RED, GREEN, WHITE = (0.63, 0.065, 0.05), (0.14, 0.45, 0.091), (0.725, 0.71, 0.68)

Subject = tuple[Scene, Camera]


def _box(ball: Material) -> Subject:
    """Coloured walls, a block and a ball under a lamp in the ceiling."""
    turns: list[tuple[tuple[float, float, float], np.ndarray]] = [
        (WHITE, np.eye(4)),
        (WHITE, scenes.translate(0.0, 0.0, 2.0) @ scenes.rotate((1, 0, 0), 180.0)),
        (WHITE, scenes.translate(0.0, 1.0, 1.0) @ scenes.rotate((1, 0, 0), 90.0)),
        (RED, scenes.translate(-1.0, 0.0, 1.0) @ scenes.rotate((0, 1, 0), 90.0)),
        (GREEN, scenes.translate(1.0, 0.0, 1.0) @ scenes.rotate((0, 1, 0), -90.0)),
    ]
    walls = [Object(scenes.Plane(2.0, 2.0), Lambert(colour), place) for colour, place in turns]
    block = scenes.translate(-0.35, 0.3, 0.6) @ scenes.rotate((0, 0, 1), 20.0)
    lamp = scenes.translate(0.0, 0.0, 1.98) @ scenes.rotate((1, 0, 0), 180.0)
    objects = [
        *walls,
        Object(scenes.Box((0.6, 0.6, 1.2)), Lambert(WHITE), block),
        Object(scenes.Sphere(0.35), ball, scenes.translate(0.4, -0.3, 0.35)),
        scenes.area_light(0.5, 0.5, lamp, radiance=(17.0, 12.0, 4.0)),
    ]
    camera = Camera(eye=(0.0, -3.9, 1.0), target=(0.0, 0.0, 1.0), field_of_view=39.0)
    return Scene(objects), camera


def _floor(material: Material | scenes.Textured) -> Object:
    return Object(scenes.Plane(12.0, 12.0), material)


_BALLS = Camera(eye=(0.0, -6.5, 2.4), target=(0.0, 0.2, 0.7), field_of_view=40.0)


def _balls() -> Subject:
    """Gold, glass and a mirror over a checked floor, in an even sky."""
    board = scenes.checkerboard(
        np.array([0.75, 0.75, 0.75]), np.array([0.1, 0.12, 0.15]), repeat=(6, 6)
    )
    gold = named("gold", alpha=0.12).material
    objects = [
        _floor(scenes.Textured(Lambert(np.full(3, 0.5)), colour=board)),
        Object(scenes.Sphere(), gold, scenes.translate(-2.1, 0.4, 1.0)),
        Object(scenes.Sphere(), Dielectric(1.5), scenes.translate(0.0, -0.3, 1.0)),
        Object(scenes.Sphere(), Mirror(), scenes.translate(2.1, 0.4, 1.0)),
    ]
    return Scene(objects, [scenes.Environment((0.5, 0.6, 0.8))]), _BALLS


def _points() -> Subject:
    """A matte ball and two of rough metal, under two points."""
    objects = [
        _floor(Lambert((0.5, 0.5, 0.5))),
        Object(scenes.Sphere(), Lambert((0.7, 0.3, 0.2)), scenes.translate(-2.1, 0.4, 1.0)),
        Object(scenes.Sphere(), metal(0.2), scenes.translate(0.0, -0.3, 1.0)),
        Object(scenes.Sphere(), metal(0.5), scenes.translate(2.1, 0.4, 1.0)),
    ]
    lights = [
        scenes.Point(position=(-3.0, -4.0, 5.0), intensity=(50.0, 45.0, 38.0)),
        scenes.Point(position=(4.0, -2.0, 4.0), intensity=(9.0, 12.0, 18.0)),
    ]
    return Scene(objects, lights), _BALLS


def _map() -> Subject:
    """Matte shapes in the light of a map."""
    objects = [
        _floor(Lambert((0.5, 0.48, 0.45))),
        Object(scenes.Sphere(), Lambert((0.7, 0.3, 0.2)), scenes.translate(-1.3, 0.4, 1.0)),
        Object(scenes.Sphere(0.6), Lambert((0.3, 0.5, 0.7)), scenes.translate(0.4, -0.8, 0.6)),
        Object(
            scenes.Box((1.2, 1.2, 2.0)),
            Lambert(WHITE),
            scenes.translate(1.9, 0.8, 1.0) @ scenes.rotate((0, 0, 1), 25.0),
        ),
    ]
    return Scene(objects, [scenes.Environment(sky_map())]), _BALLS


def _ball_in_map() -> Subject:
    """One ball of rough metal on a floor, in the light of a map."""
    objects = [
        _floor(Lambert((0.5, 0.48, 0.45))),
        Object(scenes.Sphere(), metal(0.3), scenes.translate(0.0, 0.0, 1.0)),
    ]
    return Scene(objects, [scenes.Environment(sky_map())]), _BALLS


def _mesh() -> Subject:
    """A matte bumpy ball of some 20,000 triangles on a floor, under a lamp."""
    lamp = scenes.facing((2.5, -2.0, 4.5), (0.0, 0.0, 1.0))
    objects = [
        _floor(Lambert((0.5, 0.48, 0.45))),
        Object(bumpy_ball(), Lambert((0.7, 0.4, 0.2)), scenes.translate(0.0, 0.0, 1.1)),
        scenes.area_light(1.5, 1.5, lamp, radiance=12.0),
    ]
    return Scene(objects), _BALLS


def metal(alpha: float) -> Material:
    """Rough facets of one colour, whatever the angle."""
    return Scaled(Microfacet(alpha, fresnel.Constant(1.0)), np.array([0.9, 0.7, 0.4]))


def sky_map(rows: int = 32) -> np.ndarray:
    """Linear RGB over longitude and latitude: a blue sky with a soft sun, dark earth below."""
    polar = (np.arange(rows) + 0.5) / rows * np.pi
    turn = (np.arange(2 * rows) + 0.5) / rows * np.pi
    up, round_ = np.cos(polar)[:, None], turn[None, :]
    sine = np.sin(polar)[:, None]
    # The sun, 45 degrees high, some 20 degrees wide.
    towards = np.array([-0.5, -0.5, 0.7071])
    cosine = sine * np.cos(round_) * towards[0] + sine * np.sin(round_) * towards[1]
    sun = np.exp(60.0 * (cosine + up * towards[2] - 1.0))[..., None] * [30.0, 25.0, 18.0]
    sky = np.where(up[..., None] > 0.0, [0.35, 0.5, 0.8], [0.12, 0.1, 0.08])
    return (sun + sky).astype(np.float32)


def bumpy_ball(rows: int = 100) -> scenes.Mesh:
    """A ball with waves on it: 2 rows^2 triangles, about."""
    # Circles of latitude between the poles; each pole is one vertex.
    v, u = np.meshgrid(
        np.arange(1, rows) / rows * np.pi, np.arange(rows) / rows * 2.0 * np.pi, indexing="ij"
    )
    radius = 1.0 + 0.08 * np.sin(8.0 * u) * np.sin(v) ** 2 * np.sin(7.0 * v)
    around = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1)
    poles = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    vertices = np.concatenate([(radius[..., None] * around).reshape(-1, 3), poles])
    circles = np.arange((rows - 1) * rows).reshape(rows - 1, rows)
    after = np.roll(circles, -1, axis=1)
    north, south = np.full(rows, len(vertices) - 2), np.full(rows, len(vertices) - 1)
    corners = [
        (circles[:-1], circles[1:], after[1:]),
        (circles[:-1], after[1:], after[:-1]),
        (north, circles[0], after[0]),
        (circles[-1], south, after[-1]),
    ]
    faces = np.concatenate([np.stack(three, -1).reshape(-1, 3) for three in corners])
    return scenes.build_mesh(vertices, faces, name="bumpy ball")


#: Scenes of the comparison of levels.
COMPARED: dict[str, Callable[[], Subject]] = {
    "box": lambda: _box(Lambert(WHITE)),
    "glass": lambda: _box(Dielectric(1.5)),
    "balls": _balls,
    "points": _points,
    "map": _map,
}
#: Scenes of the throughput.
TIMED: dict[str, Callable[[], Subject]] = {
    "box": COMPARED["box"],
    "metal in a map": _ball_in_map,
    "mesh": _mesh,
}


def compared(name: str) -> Subject:
    """A scene of `COMPARED`, and its camera.

    Raises
    ------
    InputError
        For another name.
    """
    return COMPARED[checks.choice("scene", name, tuple(COMPARED))]()
