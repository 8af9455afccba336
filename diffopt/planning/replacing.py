"""What a picture loses where something simpler stands in the place of an effect.

Both pictures follow the same paths: random numbers, directions and lights are chosen alike, so
that even a few paths tell the difference.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np

from diffopt import colour
from diffopt.materials.diffracting import Diffraction
from diffopt.planning import pilot
from diffopt.planning.reductions import REPLACED, diffracting, has, mean_radiance, reduced
from diffopt.rendering import driver, sources
from diffopt.rendering.composed import Composed
from diffopt.rendering.effects import Composition
from diffopt.rendering.images import Image
from diffopt.rendering.settings import PathSettings
from diffopt.rendering.stage import Stage
from diffopt.scenes.camera import Camera
from diffopt.scenes.lights import Environment
from diffopt.scenes.scene import Scene
from diffopt.statistics import power_spectrum

#: Paths of each pixel: both pictures have the same.
PATHS = 8
# Bounces of the pictures.
_BOUNCES = 8

#: Told (done, of) as effects are compared.
Progress = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True)
class Difference:
    """What a replacement changes.

    Attributes
    ----------
    bound
        Mean absolute difference of luminance over its mean.
    percentile
        99th percentile over the pixels of the same.
    delta_e, delta_e_percentile
        CIE 2000, mean and 99th percentile, a white of four times the mean luminance.
    because
        In words, with the quantity that decides.
    """

    bound: float
    percentile: float
    delta_e: float
    delta_e_percentile: float
    because: str


def differences(
    scene: Scene,
    camera: Camera,
    *,
    seed: int = 0,
    backend: str = "embree",
    pixels: int = pilot.PIXELS,
    paths: int = PATHS,
    progress: Progress | None = None,
) -> dict[str, Difference]:
    """Compare small pictures with effects and with what stands in the place of each.

    Parameters
    ----------
    scene, camera, seed, backend, pixels, paths
        As for `diffopt.planning.pilot.fly`.
    progress
        Called with (effects done, effects in all).

    Returns
    -------
    dict
        By those of `diffopt.planning.reductions.REPLACED` that the scene has.
    """
    wanted = [name for name in REPLACED if has(scene, name)]
    if not wanted:
        return {}
    small = dataclasses.replace(camera, resolution=pilot.resolution(camera, pixels))
    settings = PathSettings(spp=paths, seed=seed, backend=backend)
    level = Composed(Composition(bounces=_BOUNCES, coherent=_BOUNCES))

    def image(stage: Stage, which: Scene) -> Image:
        return driver.picture(which, small, settings, level, even=False, stage=stage)

    words = {
        "spectrum": lambda d: f"three bands shift colours by delta E {d.delta_e:.2g}",
        "fresnel": lambda d: f"Schlick's form changes {d.bound:.2%} of the light",
        "diffraction": lambda d: _roughness(scene, d),
        "environment-map": lambda d: f"its mean changes {d.bound:.2%} of the light",
    }
    first, found = image(Stage(scene), scene).xyz, {}
    for k, name in enumerate(wanted):
        if progress is not None:
            progress(k, len(wanted))
        other, stage = _beside(scene, name)
        measured = compared(image(stage, other).xyz, first)
        found[name] = dataclasses.replace(measured, because=words[name](measured))
    return found


def compared(found: np.ndarray, right: np.ndarray) -> Difference:
    """Difference of two pictures in XYZ, [h, w, 3]."""
    mean = max(float(right[..., 1].mean()), 1e-30)
    off = np.abs(found[..., 1] - right[..., 1]) / mean
    scale = 1.0 / (4.0 * mean)
    shift = colour.delta_e_2000(np.maximum(right, 0.0) * scale, np.maximum(found, 0.0) * scale)
    return Difference(
        float(off.mean()),
        float(np.percentile(off, 99.0)),
        float(np.mean(shift)),
        float(np.percentile(shift, 99.0)),
        "",
    )


def _beside(scene: Scene, effect: str) -> tuple[Scene, Stage]:
    """The scene without an effect, and its arrays, whose lights are drawn as in the scene."""
    if effect != "environment-map":
        other = reduced(scene, frozenset({effect}))
        return other, Stage(other)
    lights = [
        dataclasses.replace(
            one,
            radiance=np.broadcast_to(mean_radiance(one), one.radiance.shape).astype(np.float32),
        )
        if isinstance(one, Environment) and one.is_map
        else one
        for one in scene.lights
    ]
    other = Scene(scene.objects, lights, wavelengths=scene.channels.wavelengths)
    stage = Stage(other)
    drawn = sources.chosen_as(stage.sources, sources.gather(scene, np.float32))
    object.__setattr__(stage, "sources", drawn)
    return other, stage


def _roughness(scene: Scene, found: Difference) -> str:
    """Heights that diffract: those between half a wavelength and the coherence length."""
    most, band = 0.0, (0.0, 0.0)
    for one in scene.objects:
        for part in diffracting(one.material):
            rms, low, high = diffracting_heights(part)
            if rms >= most:
                most, band = rms, (low, high)
    return (
        f"heights of {1000.0 * most:.3g} nm rms between {band[0]:.2g} and {band[1]:.2g} um; a "
        f"flat surface changes {found.bound:.2%} of the light"
    )


def diffracting_heights(material: Diffraction) -> tuple[float, float, float]:
    """Root mean square of the heights that diffract, and the ends of their periods.

    Parameters
    ----------
    material
        Its surface and coherence.

    Returns
    -------
    tuple
        Micrometres: the root of the power of the heights at periods between half the shortest
        wavelength and the coherence length 4 sigma_s, and those two.
    """
    surface = material._model.surface
    low = 0.5 * float(np.min(np.asarray(material.wavelengths)))
    high = 4.0 * float(surface.sigma)
    spectrum = power_spectrum(np.asarray(surface.heights, np.float64), surface.pixel)
    frequency = np.hypot(*np.meshgrid(spectrum.frequency_y, spectrum.frequency_x, indexing="ij"))
    band = (frequency >= 1.0 / high) & (frequency <= 1.0 / low)
    cell = np.diff(spectrum.frequency_y[:2])[0] * np.diff(spectrum.frequency_x[:2])[0]
    return math.sqrt(abs(float(spectrum.density[band].sum() * cell))), low, high
