"""Small scenes that each call for other effects: what plans are tried on.

Here those of matte shapes, which differ in their light; `plan_scenes_more` has the others.
"""

import math
from collections.abc import Callable

import numpy as np

from diffopt import checks, scenes
from diffopt.accuracy.plan_scenes_more import (
    FRONT,
    RESOLUTION,
    SHINY,
    STEEP,
    ball,
    floor,
    lamp,
    looking,
    room,
    sun,
)
from diffopt.accuracy.render_scenes import GREEN, RED, WHITE, Subject, bumpy_ball, compared, sky_map
from diffopt.errors import InputError
from diffopt.materials import Dielectric, Lambert, OrenNayar
from diffopt.scenes import Camera, Object, Scene
from diffopt.shadows import animations


def _card(size: float = 2.4) -> Object:
    return Object(scenes.Plane(size, size), Lambert((0.6, 0.5, 0.4)), name="card")


def _sunlit_card() -> Subject:
    """A matte card in the sun: nothing but direct light."""
    return Scene([_card()], [sun()]), STEEP


def _card_in_a_sky() -> Subject:
    """A matte card in an even sky, which is seen around it."""
    return Scene([_card()], [scenes.Environment((0.5, 0.6, 0.8))]), STEEP


def _shapes() -> list[Object]:
    """A floor, a ball and a block."""
    block = scenes.translate(1.3, 0.4, 0.8) @ scenes.rotate((0, 0, 1), 25.0)
    return [
        floor((0.4, 0.4, 0.42)),
        ball(Lambert((0.6, 0.3, 0.2)), -1.1, 0.2),
        Object(scenes.Box((1.2, 1.2, 1.6)), Lambert((0.3, 0.4, 0.5)), block),
    ]


def _ambient() -> Subject:
    """Shapes in ambient light alone."""
    return Scene(_shapes(), [scenes.Ambient(1.0)]), FRONT


def _sun_and_ambient() -> Subject:
    """Shapes in the sun and in ambient light."""
    return Scene(_shapes(), [sun(), scenes.Ambient(0.3)]), FRONT


def _far_apart() -> Subject:
    """Balls in the sun and ambient light, so far apart that neither shadows nor light meet."""
    objects = [
        ball(OrenNayar((0.6, 0.4, 0.3), 0.4), x, y, 0.5, z)
        for x, y, z in ((-30.0, 60.0, -12.0), (0.0, 50.0, 8.0), (28.0, 70.0, -9.0))
    ]
    objects.append(ball(Lambert(0.4), -3.0, 10.0, 0.9, 1.0))
    return Scene(objects, [sun(), scenes.Ambient(0.4)]), looking(
        (0.0, 0.0, 0.0), (0.0, 50.0, 0.0), 45.0
    )


def _creature() -> Subject:
    """A flying creature over a plane, in the sun: one frame of its flight."""
    motion = animations.animation("creature")
    mesh = scenes.build_mesh(motion.vertices(0.1), motion.faces, name=motion.name)
    objects = [floor(0.5, animations.GROUND), Object(mesh, Lambert(motion.colour))]
    return Scene(objects, [sun()]), looking((0.5, -5.0, 4.5), (0.2, 0.2, 0.4))


def _two_walls() -> Subject:
    """Two coloured walls in a corner that bleed onto the floor, in the light of a point."""
    all_round = room([WHITE, WHITE, WHITE, RED, GREEN, WHITE])
    walls = [all_round[k] for k in (0, 3, 4)]
    lights = [scenes.Point(position=(0.0, -0.5, 2.6), intensity=6.0)]
    return Scene(walls, lights), looking((0.0, -3.6, 2.0), (0.0, 0.0, 0.9), 45.0)


def _teapot() -> Subject:
    """A matte teapot on a floor in the light of a map."""
    pot = Object(scenes.models.teapot(5), Lambert((0.6, 0.55, 0.5)))
    view = looking((-5.4, -6.4, 4.2), (-0.1, 0.0, 1.45), 32.0)
    return Scene([floor((0.4, 0.38, 0.35)), pot], [scenes.Environment(sky_map())]), view


def _almost_even_map() -> Subject:
    """Shapes in a map that hardly differs from its mean."""
    polar = np.cos((np.arange(16) + 0.5) / 16 * np.pi)
    turn = np.cos((np.arange(32) + 0.5) / 16 * np.pi)
    pixels = 0.8 + 0.008 * (polar[:, None] + 0.5 * turn[None, :])
    sky = scenes.Environment(np.repeat(pixels[..., None], 3, -1).astype(np.float32))
    return Scene(_shapes(), [sky]), FRONT


def _knot() -> Subject:
    """A dark knot that shadows itself, in one parallel light."""
    knot = scenes.models.knot(tube=0.22, around=128, across=12)
    objects = [Object(knot, Lambert(0.1))]
    return Scene(objects, [sun()]), looking((0.0, -3.8, 2.6), (0.0, 0.0, 0.0))


def _thin_occluder() -> Subject:
    """A thin rod high over a floor, whose soft shadow is hardly seen."""
    rod = Object(scenes.Box((2.0, 0.012, 0.012)), Lambert(0.3), scenes.translate(0.0, 0.0, 3.0))
    panel = lamp((0.0, 0.0, 6.0), (0.0, 0.01, 0.0), 3.0, 3.0)
    return Scene([floor(0.1), rod, panel]), looking((0.0, -4.0, 2.4), (0.0, 0.2, 0.0))


def _seen_lamp() -> Subject:
    """A small bright ball over a dark floor, seen directly."""
    bulb = Object(scenes.Sphere(0.12), Lambert(0.0), scenes.translate(0.0, 0.0, 0.9), emission=60.0)
    return Scene([floor(0.15), bulb]), FRONT


def _furnace() -> Subject:
    """A closed box whose walls emit what they absorb: the radiance is 1 everywhere."""
    walls = [
        Object(one.place.shape, one.material, np.reshape(one.place.matrix, (4, 4)), emission=0.3)
        for one in room([0.7] * 6)
    ]
    return Scene(walls), looking((0.0, -1.2, 1.5), (0.0, 1.0, 1.3), 60.0)


def _white_ball() -> Subject:
    """A white ball in an even sky: it is not to be told from it."""
    objects = [Object(scenes.Sphere(), Lambert(1.0))]
    return Scene(objects, [scenes.Environment(1.0)]), looking((0.0, -4.0, 0.5), (0.0, 0.0, 0.0))


def _hall() -> Subject:
    """A hall with eight points below its ceiling, and columns."""
    lights = [
        scenes.Point(position=(x, y, 2.6), intensity=1.5)
        for x in (-1.5, 1.5)
        for y in (-1.8, -0.6, 0.6, 1.8)
    ]
    columns = [
        Object(scenes.Box((0.4, 0.4, 3.0)), Lambert(WHITE), scenes.translate(x, y, 1.5))
        for x in (-1.2, 1.2)
        for y in (0.0, 1.2)
    ]
    walls = room([WHITE] * 6, size=5.0)
    return Scene([*walls, *columns], lights), looking((0.0, -2.3, 1.6), (0.0, 1.0, 1.2), 60.0)


def _behind_a_wall() -> Subject:
    """A room whose lamp stands behind a screen: light arrives from the walls alone."""
    screen = scenes.translate(0.0, 0.6, 1.0)
    objects = [
        *room([WHITE, WHITE, WHITE, RED, GREEN, WHITE]),
        Object(scenes.Box((2.4, 0.05, 2.0)), Lambert(0.6), screen),
        lamp((0.0, 0.7, 0.6), (0.0, 2.0, 0.4), 0.8, 20.0),
    ]
    return Scene(objects), looking((0.0, -1.4, 1.2), (0.0, 0.6, 1.0), 55.0)


def _cornell() -> Subject:
    """The box of the comparison of levels."""
    scene, camera = compared("box")
    return scene, looking(camera.eye, camera.target, camera.field_of_view)


#: Scenes by name.
SCENES: dict[str, Callable[[], Subject]] = {
    "sunlit-card": _sunlit_card,
    "card-in-a-sky": _card_in_a_sky,
    "ambient-shapes": _ambient,
    "sun-and-ambient": _sun_and_ambient,
    "far-apart": _far_apart,
    "creature": _creature,
    "two-walls": _two_walls,
    "teapot-in-a-map": _teapot,
    "almost-even-map": _almost_even_map,
    "knot": _knot,
    "thin-occluder": _thin_occluder,
    "seen-lamp": _seen_lamp,
    "furnace": _furnace,
    "white-ball": _white_ball,
    "hall-of-points": _hall,
    "behind-a-wall": _behind_a_wall,
    "cornell": _cornell,
    **SHINY,
}


def planned(name: str) -> Subject:
    """A scene of `SCENES`, and its camera.

    Raises
    ------
    InputError
        For another name.
    """
    return SCENES[checks.choice("scene", name, tuple(SCENES))]()


def large(triangles: int = 100_000) -> Subject:
    """A bumpy ball of many triangles and one of glass on a floor, under a lamp.

    Parameters
    ----------
    triangles
        Of the bumpy ball, about; at least 18.

    Raises
    ------
    InputError
        For fewer.
    """
    if triangles < 18:
        raise InputError(f"triangles must be at least 18; received {triangles}")
    rows = round(math.sqrt(triangles / 2))
    objects = [
        floor((0.5, 0.48, 0.45)),
        Object(bumpy_ball(rows), Lambert((0.7, 0.4, 0.2)), scenes.translate(-0.9, 0.2, 1.1)),
        ball(Dielectric(1.5), 1.2, -0.4, 0.7),
        lamp((2.5, -2.0, 4.5), (0.0, 0.0, 1.0), 1.5, 12.0),
    ]
    return Scene(objects), Camera(
        eye=FRONT.eye, target=FRONT.target, resolution=RESOLUTION, field_of_view=40.0
    )
