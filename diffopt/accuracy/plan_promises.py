"""Random scenes for `diffopt.plan`.

The planned picture is compared with path tracing of everything: mean absolute difference of
luminance over the mean luminance.
"""

import dataclasses
from typing import Any

import numpy as np

from diffopt import scenes
from diffopt.accuracy.plan_scenes_more import ball, floor, lamp
from diffopt.accuracy.promises import Answer, Draw, Promise, refusal
from diffopt.errors import InputError
from diffopt.materials import Dielectric, Lambert, Material, Microfacet, Mirror, OrenNayar, Sum
from diffopt.planning.choosing import plan
from diffopt.rendering.images import Image
from diffopt.rendering.settings import PathSettings
from diffopt.rendering.synthesis import render
from diffopt.scenes import Camera, Object, Scene
from diffopt.scenes.lights import Light

#: Columns and rows of the pictures: as many as make a mean.
RESOLUTION = (28, 20)
KINDS = ("matte", "rough matte", "plastic", "metal", "mirror", "glass")
LIGHTS = ("sun", "lamp", "point", "sky", "ambient")
# Of the reference: another than the plan's, whose noise it would share; paths of a pixel at first
# and at most, and what its own noise may be of the tolerance.
_SEED, _PATHS, _MOST, _SHARE = 7, 256, 4096, 0.2


def material(rng: np.random.Generator, kind: str) -> Material:
    """A random one of a kind."""
    colour = rng.uniform(0.05, 0.85, 3)
    if kind == "matte":
        return Lambert(colour)
    if kind == "rough matte":
        return OrenNayar(colour, float(rng.uniform(0.1, 0.6)))
    if kind == "plastic":
        share = float(rng.uniform(0.3, 0.8))
        coat = Microfacet(float(rng.uniform(0.1, 0.5)))
        return Sum((Lambert((1.0 - share) * colour), coat), chances=(0.5, 0.5))
    if kind == "metal":
        return Microfacet(float(rng.uniform(0.05, 0.6)))
    return Mirror() if kind == "mirror" else Dielectric(float(rng.uniform(1.3, 1.8)))


def light(rng: np.random.Generator, kind: str) -> Light | Object:
    """A random one of a kind, above the floor."""
    turn = rng.uniform(0.0, 2.0 * np.pi)
    place = np.array([2.5 * np.cos(turn), 2.5 * np.sin(turn), rng.uniform(2.5, 5.0)])
    strength = float(np.exp(rng.uniform(np.log(0.2), np.log(5.0))))
    if kind == "sun":
        return scenes.Directional(towards=tuple(place), irradiance=strength)
    if kind == "lamp":
        x, y, z = (float(value) for value in place)
        return lamp((x, y, z), (0.0, 0.0, 0.5), float(rng.uniform(0.3, 2.0)), 6.0 * strength)
    if kind == "point":
        return scenes.Point(position=tuple(place), intensity=8.0 * strength)
    if kind == "sky":
        return scenes.Environment(0.3 * strength)
    return scenes.Ambient(0.3 * strength)


def scene(rng: np.random.Generator) -> tuple[Scene, Camera, str]:
    """Balls and blocks on a floor, in half of the scenes before a wall, what they are."""
    objects = [floor(rng.uniform(0.05, 0.8, 3))]
    words = []
    if rng.uniform() < 0.5:
        wall = scenes.facing((0.0, 2.4, 1.5), (0.0, 0.0, 1.5))
        kind = str(rng.choice(["matte", "matte", "plastic", "mirror"]))
        objects.append(Object(scenes.Plane(7.0, 4.0), material(rng, kind), wall))
        words.append(f"{kind} wall")
    for k in range(rng.integers(1, 4)):
        kind, size = str(rng.choice(KINDS)), float(rng.uniform(0.3, 0.9))
        x, y = float(1.6 * (k - 1) + rng.uniform(-0.3, 0.3)), float(rng.uniform(-1.0, 1.0))
        made = material(rng, kind)
        if rng.uniform() < 0.6:
            objects.append(ball(made, x, y, size))
            words.append(f"{kind} ball")
        else:
            sides = size * rng.uniform(0.6, 1.4, 3)
            turned = scenes.rotate((0.0, 0.0, 1.0), float(rng.uniform(0.0, 90.0)))
            on = scenes.translate(x, y, 0.5 * float(sides[2]) + 1e-3) @ turned
            objects.append(Object(scenes.Box(tuple(float(a) for a in sides)), made, on))
            words.append(f"{kind} block")
    kinds = [str(k) for k in rng.choice(LIGHTS, rng.integers(1, 4), replace=False)]
    if kinds == ["ambient"]:
        # Nothing but glass or metal would be black in ambient light.
        kinds.append("sun")
    lights = []
    for kind in kinds:
        found = light(rng, kind)
        if isinstance(found, Object):
            objects.append(found)
        else:
            lights.append(found)
    turn = np.radians(rng.uniform(-110.0, -70.0))
    eye = (6.5 * float(np.cos(turn)), 6.5 * float(np.sin(turn)), float(rng.uniform(1.0, 4.5)))
    camera = Camera(eye=eye, target=(0.0, 0.2, 0.6), resolution=RESOLUTION, field_of_view=38.0)
    return Scene(objects, lights), camera, ", ".join([*words, *kinds])


def right(subject: Scene, camera: Camera, tolerance: float) -> Image:
    """Everything by path tracing, with noise of a fifth of a tolerance where that can be had."""
    paths = PathSettings(spp=_PATHS, seed=_SEED)
    found = render(subject, camera, settings=paths)
    needed = _PATHS * (found.noise / (_SHARE * tolerance)) ** 2
    if needed <= _PATHS:
        return found
    # In powers of two, so that few shapes are compiled.
    more = min(2 ** int(np.ceil(np.log2(needed))), _MOST)
    return render(subject, camera, settings=dataclasses.replace(paths, spp=more))


def difference(one: Image, other: Image) -> float:
    """Mean absolute difference of luminance over the mean luminance of the other."""
    y = other.channels.luminance()
    base = other.radiance @ y
    return float(np.abs(one.radiance @ y - base).mean() / base.mean())


def _answer(draw: Draw) -> Answer:
    subject, camera, words = scene(draw.rng)
    try:
        found = plan(subject, camera, draw.tolerance)
    except InputError as error:
        return refusal(words, error)
    if found.bias + found.noise > draw.tolerance:
        # The plan says so: paths of a pixel are limited.
        told = f"the plan predicts {found.bias + found.noise:.2g}"
        return Answer(words, error=None, refused=told)
    reference = right(subject, camera, draw.tolerance)
    error = difference(render(subject, camera, found), reference)
    price = None
    if draw.priced:
        price = _price(subject, camera, found, reference, draw.tolerance)
    words = f"{words}; {found.settings.level}, without {', '.join(sorted(found.excluded))}"
    return Answer(words, error, doubt=reference.noise, price=price)


def _price(subject: Scene, camera: Camera, found: Any, reference: Image, tolerance: float) -> float:
    """Paths of a pixel over the fewest, by halves, that would have done; 1 for other levels."""
    settings = found.settings
    if not isinstance(settings, PathSettings):
        return 1.0
    paths = settings.spp
    while paths > 1:
        fewer = dataclasses.replace(settings, spp=paths // 2)
        if difference(render(subject, camera, found, settings=fewer), reference) > tolerance:
            break
        paths //= 2
    return settings.spp / paths


PLAN = Promise(
    name="plan",
    entry="plan(scene, camera, tolerance)",
    quantity="mean difference of luminance over the mean; cost in paths of a pixel",
    reference="path tracing of everything, whose own noise is doubted",
    answer=_answer,
    tolerances=(1e-2, 3e-1),
    chance=True,
    x64=False,
)
