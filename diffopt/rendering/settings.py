"""Settings of the levels of image synthesis."""

import dataclasses
import math
from typing import ClassVar

from diffopt.errors import InputError


def _whole(name: str, value: int, least: int, most: int | float = math.inf) -> None:
    if int(value) != value or not least <= value <= most:
        limit = "" if most == math.inf else f" to {most:g}"
        raise InputError(f"{name} must be a whole number from {least}{limit}; received {value}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What all levels share.

    Attributes
    ----------
    spp
        Samples of each pixel. Time grows in proportion; noise falls with the root of it.
    seed
        Of all random numbers: equal seeds give equal pictures.
    rays
        Followed at once; by path tracing in each of up to four threads. Memory grows with it,
        some 200 bytes and 24 for each channel a ray, whatever the resolution.
    backend
        ``"embree"`` or ``"jax"``, see `diffopt.scenes.raycasting.Caster`.
    """

    spp: int = 1
    seed: int = 0
    rays: int = 2**16
    backend: str = "embree"
    level: ClassVar[str] = ""

    def __post_init__(self) -> None:
        """Check the numbers."""
        _whole("spp", self.spp, 1, 2**20)
        _whole("seed", self.seed, 0, 2**32 - 1)
        _whole("rays", self.rays, 64, 2**24)


@dataclasses.dataclass(frozen=True, kw_only=True)
class IncrementalSettings(Settings):
    """Direct light from abstract sources; coherent transmission goes straight on.

    Attributes
    ----------
    spp
        As of `Settings`: 4, for smooth edges.
    light_samples
        Points that stand for surfaces that emit light, and directions for an environment.
    shadows
        Whether lights that are hidden are left out.
    ambient
        Radiance of the light that the level leaves out, taken as even: None for that of the
        scene's own ambient lights only, ``"derived"`` to estimate it, see
        `diffopt.rendering.ambient`.
    depth
        Transparent surfaces looked through, at most.
    """

    spp: int = 4
    light_samples: int = 16
    shadows: bool = False
    ambient: str | None = None
    depth: int = 4
    level: ClassVar[str] = "incremental"

    def __post_init__(self) -> None:
        """Check the numbers."""
        super().__post_init__()
        _whole("light_samples", self.light_samples, 1, 4096)
        _whole("depth", self.depth, 0, 64)
        if self.ambient not in (None, "derived"):
            raise InputError(f"ambient must be None or 'derived'; received {self.ambient!r}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecursiveSettings(IncrementalSettings):
    """Direct light with shadows, and coherent reflection and refraction, ray by ray.

    Attributes
    ----------
    light_samples, ambient
        As of `IncrementalSettings`.
    shadows
        On.
    depth
        Coherent reflections and refractions in a row, at most: up to 2^depth rays a sample.
    """

    shadows: bool = True
    depth: int = 6
    level: ClassVar[str] = "recursive"


@dataclasses.dataclass(frozen=True, kw_only=True)
class PathSettings(Settings):
    """Path tracing: everything, with noise.

    Attributes
    ----------
    spp
        64.
    depth
        Surfaces that light is scattered at, at most; 1 is direct light.
    """

    spp: int = 64
    depth: int = 32
    level: ClassVar[str] = "path"

    def __post_init__(self) -> None:
        """Check the numbers."""
        super().__post_init__()
        _whole("depth", self.depth, 1, 512)
