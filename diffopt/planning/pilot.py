"""A small picture, path by path: what each effect of a scene brings, before it is rendered.

Some tens of thousands of paths through a grid of pixels are followed with all effects in, and
what each brings is noted with the effects that it needs. Sums of these notes are unbiased
estimates of what a picture loses with any set of effects, with a standard error.
"""

import collections
import dataclasses
import math
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.rendering import driver, effects
from diffopt.rendering.composed import Walk
from diffopt.rendering.effects import BITS, OF_SOFT, SHADOWS, Composition
from diffopt.rendering.queries import Queries
from diffopt.rendering.settings import PathSettings
from diffopt.rendering.stage import Stage
from diffopt.scenes import raycasting
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene

#: Pixels of the grid, about, and paths of each.
PIXELS, PATHS = 2000, 16
SHADOW_BITS = sum(BITS[name] for name in SHADOWS)


@dataclasses.dataclass(frozen=True, eq=False)
class Pilot:
    """Light of paths.

    Attributes
    ----------
    code
        What each needed, see `diffopt.rendering.effects`, [M].
    sample
        Path that it belongs to, counted through all pixels, [M]: pixel times `paths` and more.
    luminance
        What it brings, below 0 for light that a shadow takes away, [M].
    owner
        Object on which a shadow falls, -1 for light, [M].
    pixels, paths
        Number of pixels, and of paths of each.
    rays
        Number of rays cast, by what for; see `Walk`.
    again
        Share of the rays from the first surface that scatters light which meet a surface.
    """

    code: Int[np.ndarray, " M"]
    sample: Int[np.ndarray, " M"]
    luminance: Float[np.ndarray, " M"]
    owner: Int[np.ndarray, " M"]
    pixels: int
    paths: int
    rays: dict[str, int]
    again: float

    @property
    def light(self) -> np.ndarray:
        """Whether a note is of light, not of a shadow, [M]."""
        return self.owner < 0

    @property
    def total(self) -> float:
        """Sum of all light."""
        return float(self.luminance[self.light].sum())

    def lost(self, excluded: Any, bounces: int = 10**6, coherent: int = 10**6) -> np.ndarray:
        """Which notes differ without some effects, [M]."""
        mask = sum(BITS[name] for name in excluded if name in BITS)
        gone = (self.code & mask & ~SHADOW_BITS) != 0
        gone |= effects.scattered(self.code) > bounces
        gone |= effects.coherent(self.code) > coherent
        # With light goes the shadow in it.
        dark = ~self.light & ~gone & ((self.code & mask & SHADOW_BITS) != 0)
        return (gone & self.light) | dark

    def hidden(self, soft: bool, composition: Composition) -> np.ndarray:
        """Which notes are of shadows of a composition in one kind of light, [M]."""
        kept = [name for name in SHADOWS if composition.holds(name)]
        bits = sum(BITS[name] for name in kept)
        of_soft = (self.code & OF_SOFT) != 0
        lost = self.lost(composition.excluded, composition.bounces, composition.coherent)
        return ~self.light & ~lost & (of_soft == soft) & ((self.code & bits) != 0)

    def bare(self, composition: Composition) -> np.ndarray:
        """Which notes are of shadows on objects that a composition has none on, [M]."""
        out = np.zeros(len(self.code), bool)
        for soft in (False, True):
            falls = composition.receivers(soft, self.owner)
            out |= self.hidden(soft, composition) & ~falls
        return out

    def share(self, which: np.ndarray) -> tuple[float, float]:
        """Magnitude of some notes over all light, and a bound of it.

        The bound is the estimate and three standard errors; where few paths brought anything,
        there may be three that were not found, each as bright as ten mean ones (of a Poisson
        distribution with mean 3, none is found in one case of 20).
        """
        total = max(self.total, 1e-30)
        some = np.abs(self.luminance[which])
        if self.total <= 0.0:
            return 0.0, 0.0
        estimate = float(some.sum()) / total
        spread = math.sqrt(float((some**2).sum())) / total
        return estimate, estimate + max(3.0 * spread, 30.0 / (self.pixels * self.paths))

    def noise(self, which: np.ndarray) -> float:
        """Standard deviation of paths in their pixels over the mean luminance, of some notes."""
        values = np.zeros(self.pixels * self.paths)
        np.add.at(values, self.sample[which], self.luminance[which])
        spread = values.reshape(self.pixels, self.paths).std(1, ddof=1)
        return float(spread.mean()) / max(self.total / (self.pixels * self.paths), 1e-30)

    def by_pixel(self) -> Float[np.ndarray, " pixels"]:
        """Mean luminance of pixels."""
        values = np.zeros(self.pixels)
        np.add.at(values, self.sample[self.light] // self.paths, self.luminance[self.light])
        return values / self.paths


class Notes:
    """A ledger that keeps everything; see `diffopt.rendering.ledgers.Ledger`."""

    shadows = True

    def __init__(self, weights: Float[np.ndarray, " C"]) -> None:
        self.weights = weights
        self.samples = np.zeros(0, np.int64)
        self.notes: list[tuple[np.ndarray, ...]] = []

    def add(self, home: Any, code: Any, values: Any, owner: Any) -> None:
        """See `Ledger`."""
        luminance = np.asarray(values, np.float64) @ self.weights
        self.notes.append((code, self.samples[home], luminance, owner))


def fly(
    scene: Scene,
    camera: Camera,
    composition: Composition,
    *,
    seed: int = 0,
    backend: str = "embree",
    pixels: int = PIXELS,
    paths: int = PATHS,
    stage: Stage | None = None,
    notes: Notes | None = None,
) -> Pilot:
    """Follow paths of a small picture.

    Parameters
    ----------
    scene, camera
        What is looked at; the camera's resolution is replaced.
    composition
        Effects that are in.
    seed, backend
        As of `diffopt.rendering.settings.Settings`.
    pixels, paths
        Of the small picture, about, and of each pixel.
    stage
        The scene as arrays, where it is prepared already.
    notes
        Where what paths bring is kept.
    """
    small = dataclasses.replace(camera, resolution=resolution(camera, pixels))
    settings = PathSettings(spp=paths, seed=seed, backend=backend)
    stage = Stage(scene) if stage is None else stage
    caster = raycasting.caster(scene.geometry, backend)
    key: Array = jax.random.key(seed)
    runs, together = driver.tiles(small, settings)
    notes = Notes(scene.channels.luminance()) if notes is None else notes
    rays: collections.Counter[str] = collections.Counter()
    first = np.zeros(2)
    for run in runs:
        for at in range(0, paths, together):
            primary = driver.primary(
                small, stage, key, run, len(runs[0]), at, together, settings, False
            )
            pixel = np.asarray(primary.pixel, np.int64)
            notes.samples = pixel * paths + np.asarray(primary.sample, np.int64)
            walk = Walk(composition, notes)
            walk.trace(stage, primary, Queries(caster), key)
            rays.update(walk.rays)
            first += walk.first
    none = np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.int64)
    code, sample, luminance, owner = (
        np.concatenate(part) for part in zip(none, *notes.notes, strict=True)
    )
    count = small.resolution[0] * small.resolution[1]
    again = float(first[1] / max(first[0], 1.0))
    return Pilot(code, sample, luminance, owner, count, paths, dict(rays), again)


def resolution(camera: Camera, pixels: int) -> tuple[int, int]:
    """Columns and rows of the camera's shape, with about as many pixels."""
    columns, lines = camera.resolution
    factor = math.sqrt(pixels / (columns * lines))
    return max(round(columns * factor), 1), max(round(lines * factor), 1)
