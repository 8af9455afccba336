"""By which level a composition is rendered, at what settings, and how long that takes.

Path tracing renders every composition, with noise that falls with the root of the paths. Without
noise, recursive ray tracing renders direct light and coherent reflection, and radiosity diffuse
interreflection besides: what is left is the unevenness of samples within pixels, of the points
that stand for wide lights, and of patches, which falls faster.

The constants were fitted to measured pictures of the scenes of `diffopt compare rendering`, 64x48
pixels on two cores, against 768 to 1024 paths a pixel.
"""

import itertools
import math
from typing import Any, NamedTuple

from diffopt.planning.pilot import Pilot
from diffopt.rendering import effects
from diffopt.rendering.effects import Composition
from diffopt.rendering.families import Beams, Points, Surfaces
from diffopt.rendering.radiosity_settings import RadiosityRaysSettings, RadiositySettings
from diffopt.rendering.settings import PathSettings, RecursiveSettings, Settings
from diffopt.rendering.sources import Sources
from diffopt.rendering.stage import Stage
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene

# Seconds of a ray of paths with what is shaded for it, by two threads; of a ray of a picture
# without noise, and of a shadow ray of that.
_PATH_RAY, _EVEN_RAY, _SHADOW_RAY = 1.2e-6, 1.5e-6, 0.35e-6
#: Mean magnitude of a normal variable over its standard deviation.
MEAN = math.sqrt(2.0 / math.pi)
# Error of s samples in a pixel, times s^0.8: in the spread within pixels of the light that is
# seen without being scattered, and the rest.
_SEEN, _EDGES = 0.65, 0.04
# Error of n points of surfaces that emit and of surroundings, in their light, times n^0.7.
_EMITTERS, _SKY = 0.4, 0.9
# Numbers of patches; their error, in the light between surfaces; seconds of their solution.
_PATCHES = ((300, 0.06, 0.5), (1000, 0.035, 1.5), (4000, 0.02, 9.0))
# Samples of a pixel, and points of a light, of pictures without noise.
_SAMPLES, _LIGHT = (4, 16, 64), (16, 32, 64, 128, 256)
# Errors that are as good as the least one, in it.
_NEARLY = 1.3


class Choice(NamedTuple):
    """A level at its settings: predicted error over the mean luminance, and seconds."""

    settings: Settings
    error: float
    seconds: float


def affordable(
    scene: Scene,
    camera: Camera,
    planned: Pilot,
    seen: Pilot,
    composition: Composition,
    noise: float,
    most: int,
    shared: dict[str, Any],
) -> tuple[Choice, PathSettings, dict[str, float]]:
    """The cheapest level and its settings.

    Parameters
    ----------
    scene, camera
        Without what is out; the picture.
    planned, seen
        Pilots of the composition and of everything.
    composition
        What is in.
    noise
        Mean magnitude that is wanted, over the mean luminance.
    most
        Paths of a pixel, at most.
    shared
        Seed and backend of the settings.

    Returns
    -------
    tuple
        The choice, the cheapest path tracing, and the share of each effect in the rays.
    """
    pixels = camera.resolution[0] * camera.resolution[1]
    found = [_paths(pixels, planned, composition, noise, most, shared)]
    found += _even(scene, pixels, planned, seen, composition, noise, shared)
    # Where none is good enough, the cheapest of those that are nearly the best.
    least = max(noise, _NEARLY * min(one.error for one in found))
    best = min((one for one in found if one.error <= least), key=lambda c: c.seconds)
    paths = found[0].settings
    assert isinstance(paths, PathSettings)
    return best, paths, _shares(planned, seen, composition)


def _paths(
    pixels: int,
    planned: Pilot,
    composition: Composition,
    noise: float,
    most: int,
    shared: dict[str, Any],
) -> Choice:
    spread = planned.noise(planned.light)
    spp = _power((MEAN * spread / noise) ** 2, 1, most)
    rays = sum(planned.rays.values()) / (planned.pixels * planned.paths)
    depth = min(max(composition.scattered + composition.mirrors, 1), 512)
    chosen = PathSettings(spp=spp, depth=depth, **shared)
    return Choice(chosen, MEAN * spread / math.sqrt(spp), pixels * spp * rays * _PATH_RAY)


def _even(
    scene: Scene,
    pixels: int,
    planned: Pilot,
    seen: Pilot,
    composition: Composition,
    noise: float,
    shared: dict[str, Any],
) -> list[Choice]:
    """Levels without noise, where they can render a composition."""
    if composition.holds("glossy-interreflection") or composition.holds("caustics"):
        return []
    sources = Stage(scene).sources
    sky = [one for one in sources.families if not isinstance(one, Beams | Points | Surfaces)]
    emitters = [one for one in sources.families if isinstance(one, Surfaces)]
    if (sky or emitters) and composition.holds("glossy-light"):
        # Points in place of a wide light are seen in glossy surfaces.
        return []
    light = seen.share(seen.light & (effects.scattered(seen.code) == 1))[0]
    shadows = bool(composition.hard or composition.soft)
    even_sky = sources.constant is not None and shadows
    wide = light * (_EMITTERS * bool(emitters) + _SKY * (bool(sky) or even_sky))
    straight = planned.light & (effects.scattered(planned.code) == 0)
    # Edges take a share of the pixels that falls with their size.
    finer = math.sqrt(planned.pixels / pixels)
    spread = (_SEEN * planned.noise(straight) + _EDGES) * finer
    between = seen.share(seen.lost(["diffuse-interreflection"]))[0]
    seen_rays = sum(planned.rays.get(k, 0) for k in ("camera", "mirror", "refraction"))
    followed = pixels * seen_rays / max(planned.rays.get("camera", 0), 1)
    depth = min(composition.mirrors, 64)
    found = []
    for patches, coarse, solved in _PATCHES if composition.scattered > 1 else ((0, 0.0, 0.0),):
        for samples, points in itertools.product(_SAMPLES, _LIGHT if wide else _LIGHT[:1]):
            # What the three leave is independent.
            parts = coarse * between, spread / samples**0.8, wide / points**0.7
            lights = points * (len(sky) + len(emitters) + even_sky) + _abstract(sources)
            seconds = solved + followed * samples * (_EVEN_RAY + lights * _SHADOW_RAY)
            same: dict[str, Any] = {**shared, "spp": samples, "light_samples": points}
            chosen: Settings
            if not patches:
                chosen = RecursiveSettings(shadows=shadows, depth=depth, **same)
            elif depth:
                chosen = RadiosityRaysSettings(patches=patches, depth=depth, **same)
            else:
                chosen = RadiositySettings(patches=patches, depth=0, **same)
            found.append(Choice(chosen, math.hypot(*parts), seconds))
    return found


def _abstract(sources: Sources) -> int:
    """Number of abstract lights."""
    count = 0
    for one in sources.families:
        if isinstance(one, Beams):
            count += one.towards.shape[0]
        elif isinstance(one, Points):
            count += one.exponent.shape[0]
    return count


def _power(value: float, least: int, most: int) -> int:
    """The next power of two within limits."""
    whole = max(math.ceil(value), 1)
    return int(min(max(1 << (whole - 1).bit_length(), least), most))


def _shares(planned: Pilot, seen: Pilot, composition: Composition) -> dict[str, float]:
    """Share of the rays that each effect takes."""
    rays = {name: float(count) for name, count in planned.rays.items() if count}
    whole = max(sum(rays.values()), 1.0)
    base = rays.pop("camera", 0.0) + rays.pop("light", 0.0)
    more = rays.pop("interreflection", 0.0)
    kinds = [f"{k}-interreflection" for k in ("diffuse", "glossy")]
    kinds = [name for name in kinds if composition.holds(name)]
    brought = {name: seen.share(seen.lost([name]))[0] for name in kinds}
    both = sum(brought.values()) or 1.0
    rays |= {name: more * part / both for name, part in brought.items()}
    direct = {"matte-light": 1.0, "glossy-light": float(composition.holds("glossy-light"))}
    lit = {name: seen.share(seen.lost([name]))[0] * on for name, on in direct.items()}
    lit["matte-light"] = max(lit["matte-light"], 1e-9)
    rays |= {name: base * part / sum(lit.values()) for name, part in lit.items()}
    return {name: count / whole for name, count in rays.items()}
