"""Small scenes for plans, of surfaces that do more than scatter evenly.

Mirrors, glass, metals, coats, diffraction, and scenes in wavelengths. Each calls for other
effects; `diffopt.accuracy.plan_scenes` collects them.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from diffopt import fresnel, glasses, samples, scenes
from diffopt.accuracy.render_scenes import WHITE, Subject, sky_map
from diffopt.diffraction import DiffractionBRDF
from diffopt.materials import Dielectric, Diffraction, Lambert, Material, Microfacet, Mirror, Sum
from diffopt.materials.naming import named
from diffopt.scenes import Camera, Object, Scene
from diffopt.scenes.channels import Channels
from diffopt.scenes.spectra import illuminant

#: Columns and rows of all pictures.
RESOLUTION = (96, 72)
#: Wavelengths of spectral scenes, micrometres.
WAVELENGTHS = np.linspace(0.40, 0.70, 11)
#: Wavelengths of metals and glasses in linear RGB, micrometres.
_COLOURS = np.linspace(0.40, 0.70, 7)
# Directions that diffracting surfaces are prepared for, and their error: few, so that this is
# quick.
_PAIRS, _ERROR = 20_000, 0.05


def looking(
    eye: tuple[float, float, float], target: tuple[float, float, float], angle: float = 36.0
) -> Camera:
    """A camera of the scenes' resolution."""
    return Camera(eye=eye, target=target, resolution=RESOLUTION, field_of_view=angle)


#: From in front, somewhat above; what stands on z = 0 about the origin is seen.
FRONT = looking((0.0, -6.5, 2.4), (0.0, 0.2, 0.7))
#: Steeply from above on what lies at the origin.
STEEP = looking((0.0, -3.2, 3.8), (0.0, 0.0, 0.0), 30.0)


def floor(colour: Any = 0.5, size: float = 12.0) -> Object:
    """A matte square in z = 0."""
    return Object(scenes.Plane(size, size), Lambert(colour), name="floor")


def ball(material: Any, x: float, y: float, radius: float = 1.0, z: float | None = None) -> Object:
    """A ball that lies on z = 0, or has its middle at a height."""
    place = scenes.translate(x, y, radius if z is None else z)
    return Object(scenes.Sphere(radius), material, place)


def lamp(
    origin: tuple[float, float, float],
    target: tuple[float, float, float],
    size: float,
    radiance: Any,
) -> Object:
    """A square that emits light from one place towards another."""
    return scenes.area_light(size, size, scenes.facing(origin, target), radiance=radiance)


def sun(irradiance: Any = 3.0) -> scenes.Directional:
    """Parallel light from the upper left, behind the camera."""
    return scenes.Directional(towards=(-0.5, -0.6, 0.8), irradiance=irradiance)


def room(colours: Any, size: float = 3.0, materials: dict[int, Material] | None = None) -> list:
    """Walls that face inwards: floor, ceiling, back, left, right, and front behind the camera."""
    half = 0.5 * size
    middle = np.array([0.0, 0.0, half])
    ways = [(0, 0, 1), (0, 0, -1), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 1, 0)]
    found = []
    for k, way in enumerate(np.array(ways, float)):
        up = (0.0, 1.0, 0.0) if way[2] else (0.0, 0.0, 1.0)
        place = scenes.facing(middle - half * way, middle, up)
        of = (materials or {}).get(k, Lambert(colours[k]))
        found.append(Object(scenes.Plane(size, size), of, place))
    return found


@functools.lru_cache(maxsize=8)
def _diffracting(name: str, output: str = "xyz", **options: float) -> Diffraction:
    """A sample's surface of aluminium, prepared for few directions."""
    brdf = DiffractionBRDF(samples.make(name, **options), 1.25, fresnel=fresnel.metal("Al"))
    given: dict[str, Any] = {"output": "xyz"} if output == "xyz" else {"wavelengths": WAVELENGTHS}
    return Diffraction(brdf.prepare(pairs=_PAIRS, tolerance=_ERROR, **given))


def _facets(of: fresnel.Reflectance, alpha: float) -> Microfacet:
    return Microfacet(alpha, of, wavelengths=_COLOURS)


def _board() -> Object:
    """A floor of light and dark squares."""
    squares = scenes.checkerboard(np.full(3, 0.75), np.array([0.1, 0.12, 0.15]), repeat=(6.0, 6.0))
    return Object(
        scenes.Plane(12.0, 12.0), scenes.Textured(Lambert(np.full(3, 0.5)), colour=squares)
    )


def _open_mirror() -> Subject:
    """An upright mirror on a floor with a red ball, in an even sky."""
    glass = scenes.facing((0.0, 2.0, 1.2), (0.0, 0.0, 1.2))
    objects = [
        floor((0.5, 0.48, 0.45)),
        ball(Lambert((0.7, 0.2, 0.1)), -0.9, -0.2, 0.6),
        Object(scenes.Plane(4.0, 2.4), Mirror(), glass),
    ]
    return Scene(objects, [scenes.Environment(0.8)]), FRONT


def _mirror_room() -> Subject:
    """Two walls of silver that face each other, a ball between them, a lamp in the ceiling."""
    silver = Mirror(fresnel.metal("Ag"), _COLOURS)
    objects = room([WHITE] * 6, materials={3: silver, 4: silver})
    objects += [
        ball(Lambert((0.2, 0.4, 0.7)), 0.3, 0.3, 0.5),
        lamp((0.0, 0.0, 2.98), (0.0, 0.01, 0.0), 1.0, 6.0),
    ]
    return Scene(objects), looking((0.4, -1.4, 1.6), (-0.6, 0.4, 1.2), 60.0)


def _glass_over_checks() -> Subject:
    """A glass ball over a checked floor, in an even sky."""
    return Scene(
        [_board(), ball(Dielectric(1.5), 0.0, 0.0)], [scenes.Environment((0.5, 0.6, 0.8))]
    ), FRONT


def _glass_under_a_lamp() -> Subject:
    """A glass ball on a floor under a small lamp, which it focuses."""
    objects = [
        floor(0.6),
        ball(Dielectric(1.5), 0.0, 0.0, 0.8),
        lamp((-2.2, 0.6, 4.0), (0.0, 0.0, 0.0), 0.7, 40.0),
    ]
    return Scene(objects), looking((0.0, -4.6, 3.2), (0.2, 0.0, 0.4))


def _two_glass_balls() -> Subject:
    """Two glass balls one behind the other before a sky with a sun: no matte surface."""
    objects = [ball(Dielectric(1.5), -0.4, -0.6, 0.9), ball(Dielectric(1.33), 0.7, 1.2, 0.9)]
    return Scene(objects, [scenes.Environment(sky_map())]), looking(
        (0.0, -5.0, 1.2), (0.0, 0.0, 0.9)
    )


def _compact_disc() -> Subject:
    """A compact disc on a dark floor, under a lamp."""
    tilt = scenes.translate(0.0, 0.0, 0.5) @ scenes.rotate((1, 0, 0), 18.0)
    objects = [
        floor(0.12, 30.0),
        Object(scenes.Disc(1.2), _diffracting("compact_disc"), tilt, name="disc"),
        lamp((-1.0, 4.0, 6.0), (0.0, 0.0, 0.4), 0.3, 300.0),
    ]
    lights = [scenes.Environment(0.04)]
    return Scene(objects, lights), looking((0.0, -4.2, 3.4), (0.0, 0.0, 0.35), 32.0)


def _snake_skin() -> Subject:
    """A ball of snake skin in the sun, nothing around it."""
    skin = _diffracting("snake_skin")
    objects = [Object(scenes.Sphere(), skin, tangent=(1.0, 0.0, 0.0))]
    return Scene(objects, [sun()]), looking((0.0, -4.0, 0.5), (0.0, 0.0, 0.0))


def _almost_flat() -> Subject:
    """A disc whose pits are a nanometre deep, and a card, under a lamp."""
    nearly = _diffracting("compact_disc", depth=0.001)
    objects = [
        floor(0.3, 10.0),
        Object(scenes.Disc(1.0), nearly, scenes.translate(0.0, 0.0, 0.2)),
        lamp((0.0, 3.2, 3.8), (0.0, 0.0, 0.2), 1.2, 8.0),
    ]
    return Scene(objects), STEEP


def _tiny_disc() -> Subject:
    """A compact disc far away on a wide matte floor in the sun."""
    disc = Object(scenes.Disc(0.06), _diffracting("compact_disc"), scenes.translate(0.4, 0.3, 0.02))
    objects = [floor((0.5, 0.5, 0.55), 40.0), disc]
    return Scene(objects, [sun()]), looking((0.0, -5.0, 4.0), (0.0, 0.0, 0.0))


def _glossy_teapot() -> Subject:
    """A glossy teapot under a point."""
    glaze = Sum((Lambert((0.3, 0.1, 0.08)), Microfacet(0.15, fresnel.Schlick(0.3))))
    lights = [scenes.Point(position=(-3.0, -5.0, 6.0), intensity=60.0)]
    pot = Object(scenes.models.teapot(5), glaze)
    return Scene([pot], lights), looking((-5.4, -6.4, 4.2), (-0.1, 0.0, 1.45), 32.0)


def _rough_gold() -> Subject:
    """A ball of rough gold alone in the sun, by the oscillators of its fit."""
    objects = [Object(scenes.Sphere(), named("gold", alpha=0.4).material)]
    return Scene(objects, [sun()]), looking((0.0, -4.0, 0.5), (0.0, 0.0, 0.0))


def _plastic() -> Subject:
    """Balls of plastic on a floor under two floods."""
    lights = [
        scenes.Flood(position=(x, -3.0, 4.5), aim=(-x, 3.0, -4.0), intensity=40.0, exponent=4.0)
        for x in (-3.0, 3.0)
    ]
    objects = [
        floor(0.2),
        ball(named("plastic", colour=(0.5, 0.05, 0.05), alpha=0.3).material, -1.2, 0.0),
        ball(named("plastic", colour=(0.05, 0.3, 0.5), alpha=0.1).material, 1.2, 0.0),
    ]
    return Scene(objects, lights), FRONT


def _metals() -> Subject:
    """Shapes of measured copper and aluminium beside Schlick's form of gold, in an even sky."""
    objects = [
        ball(_facets(fresnel.metal("Cu", "measured"), 0.3), -2.1, 0.0),
        ball(_facets(fresnel.metal("Al"), 0.3), 0.0, 0.0),
        ball(Microfacet(0.3, fresnel.Schlick([1.0, 0.77, 0.34]), _COLOURS[:3]), 2.1, 0.0),
    ]
    return Scene(objects, [scenes.Environment(0.7)]), FRONT


def _crown_glass() -> Subject:
    """Plates of rough crown glass seen at a flat angle against a bright panel."""
    plate = _facets(glasses.glass("n-bk7"), 0.08)
    objects = [
        Object(scenes.Plane(6.0, 6.0), plate),
        lamp((0.0, 5.0, 1.5), (0.0, 0.0, 0.0), 3.0, 2.0),
    ]
    return Scene(objects), looking((0.0, -5.0, 1.2), (0.0, 1.0, 0.6))


def _lacquer() -> Subject:
    """A dark lacquered table that mirrors balls as its index says, in an even sky."""
    lacquer = Sum((Lambert(0.08), Mirror(fresnel.Dielectric(1.7))))
    objects = [
        Object(scenes.Plane(12.0, 12.0), lacquer),
        ball(Lambert((0.7, 0.2, 0.1)), -1.1, 0.0, 0.8),
        ball(Lambert((0.1, 0.4, 0.7)), 1.1, 0.4, 0.8),
    ]
    return Scene(objects, [scenes.Environment(0.9)]), looking((0.0, -6.0, 1.4), (0.0, 0.0, 0.4))


def _dim_coat() -> Subject:
    """A matte ball under a coat of one hundredth, in the sun."""
    coat = Microfacet(0.5, fresnel.Constant(0.01))
    objects = [floor(0.4), ball(Sum((Lambert((0.6, 0.5, 0.4)), coat)), 0.0, 0.0)]
    return Scene(objects, [sun()]), FRONT


def _narrow_bands() -> Subject:
    """Coloured cards in the light of two narrow bands, in wavelengths: three bands do not do."""
    bands = np.zeros(len(WAVELENGTHS))
    bands[[4, 7]] = 12.0
    colours = [(0.7, 0.1, 0.08), (0.1, 0.6, 0.15), (0.6, 0.6, 0.6)]
    objects = [
        Object(scenes.Plane(0.9, 1.8), Lambert(colour), scenes.translate(x, 0.0, 0.0))
        for x, colour in zip((-1.0, 0.0, 1.0), colours, strict=True)
    ]
    lights = [scenes.Directional(towards=(0.3, -0.5, 1.0), irradiance=bands)]
    return Scene(objects, lights, wavelengths=WAVELENGTHS), STEEP


def _grey_wavelengths() -> Subject:
    """Grey shapes in white light, in wavelengths: three bands do."""
    objects = [floor(0.5), ball(Lambert(0.3), -1.0, 0.0), ball(Lambert(0.7), 1.2, 0.3)]
    return Scene(objects, [scenes.Environment(1.0)], wavelengths=WAVELENGTHS), FRONT


def _gold_under_a_tube() -> Subject:
    """Gold by its fit under a fluorescent tube on a coloured floor, in wavelengths."""
    band = illuminant(Channels(WAVELENGTHS), "FL11")
    objects = [
        floor((0.2, 0.5, 0.3)),
        ball(named("gold", alpha=0.2).material, 0.0, 0.0),
        lamp((-2.5, -2.0, 4.5), (0.0, 0.0, 0.8), 1.5, band * 12.0),
    ]
    return Scene(objects, wavelengths=WAVELENGTHS), FRONT


def _everything() -> Subject:
    """Glass, mirror, gold, a disc, a map, ambient light and lamps, in wavelengths."""
    map_ = sky_map(16)
    tilt = scenes.translate(0.1, -1.7, 0.35) @ scenes.rotate((1, 0, 0), 25.0)
    objects = [
        floor((0.55, 0.45, 0.4)),
        ball(named("gold", alpha=0.15).material, -2.1, 0.4),
        ball(Dielectric(1.5), 0.0, 0.3, 0.9),
        ball(Mirror(fresnel.metal("Cu"), WAVELENGTHS), 2.1, 0.4),
        Object(scenes.Disc(0.6), _diffracting("compact_disc", "spectral"), tilt),
        lamp((-2.0, 1.5, 4.0), (0.0, 0.0, 0.5), 1.2, (12.0, 9.0, 5.0)),
        Object(scenes.Sphere(0.12), Lambert(0.0), scenes.translate(1.0, -1.6, 1.2), emission=25.0),
    ]
    lights = [
        scenes.Environment(map_, scale=0.3),
        scenes.Ambient(0.1),
        scenes.Point(position=(3.0, -3.0, 4.0), intensity=25.0),
    ]
    return Scene(objects, lights, wavelengths=WAVELENGTHS), FRONT


#: Scenes of mirrors, glass, gloss, diffraction and wavelengths.
SHINY: dict[str, Callable[[], Subject]] = {
    "open-mirror": _open_mirror,
    "mirror-room": _mirror_room,
    "glass-over-checks": _glass_over_checks,
    "glass-under-a-lamp": _glass_under_a_lamp,
    "two-glass-balls": _two_glass_balls,
    "compact-disc": _compact_disc,
    "snake-skin": _snake_skin,
    "almost-flat": _almost_flat,
    "tiny-disc": _tiny_disc,
    "glossy-teapot": _glossy_teapot,
    "rough-gold": _rough_gold,
    "plastic": _plastic,
    "metals": _metals,
    "crown-glass": _crown_glass,
    "lacquer": _lacquer,
    "dim-coat": _dim_coat,
    "narrow-bands": _narrow_bands,
    "grey-wavelengths": _grey_wavelengths,
    "gold-under-a-tube": _gold_under_a_tube,
    "everything": _everything,
}
