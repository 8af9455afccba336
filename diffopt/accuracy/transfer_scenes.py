"""Scenes on which precomputed transfer is judged: glossy bodies that light themselves.

The lights are a sum of lobes, three of them narrow as suns, and a sky whose radiance is linear
in direction, of which lobes with the right moments give the right mean. Both are grey.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from diffopt import checks, materials
from diffopt.lobes import Lobes
from diffopt.scenes import lights, models
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Object, Scene
from diffopt.scenes.shapes import Plane
from diffopt.scenes.transforms import rotate, translate

#: Scenes by name: teapots of two exponents, a rabbit on a floor, a knot over a ring, and a ring of
#: 200 vertices for quick runs.
SCENES = ("teapot 32", "teapot 128", "rabbit", "knots", "ring")
#: Lights by name.
LIGHTS = ("suns", "sky")
# Rows of the map of the sky; it has twice as many columns.
_ROWS = 32
# Share of the sky's radiance that changes with the height.
_SLOPE = 0.8


class Bright(NamedTuple):
    """Light from infinity in closed form.

    Attributes
    ----------
    light
        As scenes have it.
    radiance
        Of directions [n, 3]: [n].
    lobes
        Shares, axes and concentrations from which directions are drawn: alpha [L], mu [L, 3],
        kappa [L]; None for light too even to be worth it.
    """

    light: lights.Light
    radiance: Callable[[Float[np.ndarray, "n 3"]], Float[np.ndarray, " n"]]
    lobes: tuple[np.ndarray, np.ndarray, np.ndarray] | None


class Subject(NamedTuple):
    """A scene without light, and where it is seen from."""

    scene: Scene
    camera: Camera


@functools.cache
def light(name: str) -> Bright:
    """A light of `LIGHTS`."""
    checks.choice("light", name, LIGHTS)
    if name == "sky":
        height = np.cos((np.arange(_ROWS) + 0.5) * np.pi / _ROWS)
        rows = np.repeat(1.0 + _SLOPE * height[:, None], 2 * _ROWS, axis=1)
        sky = lights.Environment(rows.astype(np.float32))
        return Bright(sky, lambda s: 1.0 + _SLOPE * s[:, 2], None)
    alpha = np.array([4.0, 3.0, 4.0, 9.0, 2.0])
    kappa = np.array([60.0, 40.0, 100.0, 1.0, 4.0])
    mu = np.array(
        [[0.3, -0.7, 0.6], [-0.8, -0.3, 0.5], [0.5, 0.5, 0.7], [0.0, 0.0, 1.0], [0.0, -1.0, -0.2]]
    )
    mu /= np.linalg.norm(mu, axis=1, keepdims=True)
    of = Lobes(*(a.astype(np.float32) for a in (alpha, mu, kappa)))

    def radiance(s: np.ndarray) -> np.ndarray:
        return densities(s, mu, kappa) @ alpha

    return Bright(lights.LobeEnvironment(of), radiance, (alpha, mu, kappa))


def densities(
    s: Float[np.ndarray, "n 3"], mu: Float[np.ndarray, "L 3"], kappa: Float[np.ndarray, " L"]
) -> Float[np.ndarray, "n L"]:
    """Densities of lobes in float64, [n, L]."""
    # Of the axis itself: exp(-kappa (1 - cos)) remains, which does not overflow.
    normal = kappa / (-2.0 * np.pi * np.expm1(-2.0 * kappa))
    return normal * np.exp(-kappa * (1.0 - s @ mu.T))


@functools.cache
def subject(name: str, detail: int = 8, resolution: int = 96) -> Subject:
    """A scene of `SCENES`.

    Parameters
    ----------
    name
        Which.
    detail
        Divisions of the teapot's patches; of other scenes in proportion.
    resolution
        Pixels on a side.
    """
    checks.choice("scene", name, SCENES)
    objects: list[Object]
    if name.startswith("teapot"):
        gloss = materials.BlinnPhong(0.8, float(name.split()[1]))
        objects = [Object(models.teapot(detail), gloss)]
        eye, target, angle = (0.0, -9.0, 4.5), (0.2, 0.0, 1.4), 42.0
    elif name == "rabbit":
        floor = Object(Plane(7.0, 7.0), materials.Lambert(0.4))
        body = models.rabbit(max(24, 3 * detail))
        objects = [Object(body, materials.BlinnPhong(0.8, 64.0)), floor]
        eye, target, angle = (2.6, -5.4, 2.5), (0.0, 0.0, 0.95), 29.0
    elif name == "knots":
        steel, ring = materials.BlinnPhong(0.8, 128.0), materials.BlinnPhong(0.35, 32.0)
        red = materials.Sum((materials.Lambert(0.3), ring))
        knot = models.knot(p=2, q=3, swing=0.45, tube=0.19, around=16 * detail, across=detail)
        place = translate(0.0, 0.0, 1.35) @ rotate((1.0, 0.0, 0.0), 22.0)
        torus = models.torus(1.9, 0.28, 8 * detail, 2 * detail)
        objects = [
            Object(knot, steel, place),
            Object(torus, red, translate(0.0, 0.0, 0.28)),
            Object(Plane(9.0, 9.0), materials.Lambert(0.35)),
        ]
        eye, target, angle = (0.0, -6.4, 4.2), (0.0, 0.0, 0.75), 34.0
    else:
        body = models.torus(1.0, 0.45, 20, 10)
        objects = [Object(body, materials.BlinnPhong(0.8, 32.0))]
        eye, target, angle = (0.0, -3.2, 2.4), (0.0, 0.0, 0.0), 50.0
    camera = Camera(
        eye=eye, target=target, field_of_view=angle, resolution=(resolution, resolution)
    )
    return Subject(Scene(objects), camera)


def lit(name: str, under: str, detail: int = 8, resolution: int = 96) -> Scene:
    """A scene with its light, for other renderers."""
    return Scene(list(subject(name, detail, resolution).scene.objects), [light(under).light])
