"""Settings of radiosity; see `diffopt.rendering.radiosity`."""

import dataclasses
import math
from typing import ClassVar

from diffopt import checks
from diffopt.errors import InputError
from diffopt.rendering.settings import Settings, _whole

#: Ways to gather light for a picture.
GATHER = ("patches", "direct")
#: Patches that a scene may be cut into: their form factors take 4 bytes for each pair.
MOST = 16384


@dataclasses.dataclass(frozen=True, kw_only=True)
class RadiositySettings(Settings):
    """Light between surfaces that scatter it evenly, patch by patch.

    Glossy lobes count as if they were diffuse, of the same albedo. Surfaces that light passes,
    and perfect mirrors, scatter none of it and hide what is behind them from other patches.

    Attributes
    ----------
    spp
        As of `Settings`: 4, for smooth edges.
    patches
        About how many the surfaces are cut into, both sides of open ones counted. The error
        falls with their size; memory and the time of a solution grow with the square of it.
    rays_per_patch
        Cast for the form factors. Noise of the patches falls with their number, faster than
        with the root of it.
    refinements
        Rounds in which patches that differ from their neighbours are cut in four; at most
        four times as many patches in all.
    tolerance
        Differences between neighbours, in mean radiosities, up to which patches are kept.
    light_samples
        Points on surfaces that emit light (and directions of an environment), for each patch
        in the solution, and in common for all points of the picture. Soft shadows have fewer
        bands with more.
    gather
        ``"direct"``: direct light is computed at every point of the picture, the light from
        other surfaces is that of the patches. ``"patches"``: all light is; faster, and shadows
        are as coarse as the patches.
    coherent
        Whether mirrors and glass are followed ray by ray in the picture; black otherwise.
    depth
        Coherent reflections and refractions in a row, at most.
    """

    spp: int = 4
    patches: int = 1000
    rays_per_patch: int = 512
    refinements: int = 1
    tolerance: float = 0.1
    light_samples: int = 32
    gather: str = "direct"
    coherent: bool = False
    depth: int = 6
    level: ClassVar[str] = "radiosity"

    def __post_init__(self) -> None:
        """Check the numbers."""
        super().__post_init__()
        _whole("patches", self.patches, 1, MOST)
        _whole("rays_per_patch", self.rays_per_patch, 1, 2**16)
        _whole("refinements", self.refinements, 0, 4)
        _whole("light_samples", self.light_samples, 1, 4096)
        _whole("depth", self.depth, 0, 64)
        checks.choice("gather", self.gather, GATHER)
        if not (math.isfinite(self.tolerance) and self.tolerance > 0.0):
            raise InputError(f"tolerance must be a number above 0; received {self.tolerance}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RadiosityRaysSettings(RadiositySettings):
    """Radiosity, with mirrors and glass ray by ray.

    Attributes
    ----------
    coherent
        On.
    """

    coherent: bool = True
    level: ClassVar[str] = "radiosity+rays"
