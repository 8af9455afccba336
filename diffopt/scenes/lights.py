"""Light sources: what they send to a point of a surface.

Abstract sources (Szirmay-Kalos and others' chapter on image synthesis, section 3.6) are not
seen in the picture: `Ambient`, `Directional`, `Point`, `Flood`. `Environment` and
`LobeEnvironment` surround the scene and are seen. Surfaces emit light by the `emission` of
their object; `diffopt.scenes.area_light` makes one.

Quantities are numbers, RGB, or channels of the scene. In any unit that is kept to: radiance in
W / (m^2 sr), irradiance in W / m^2, intensity in W / sr, lengths in m, for instance.
"""

import math

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.lobes import Lobes
from diffopt.materials.base import floating
from diffopt.materials.checking import within
from diffopt.scenes import transforms


class Light(eqx.Module):
    """A source of light."""


class Ambient(Light):
    """Light that comes to every point from all directions alike; nothing shades it.

    Parameters
    ----------
    radiance
        At least 0.
    """

    radiance: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        within("radiance", self.radiance, 0.0, math.inf)


class Directional(Light):
    """Parallel light from infinity, as the sun's.

    Parameters
    ----------
    towards
        Direction from the scene to the light, [3], of any length.
    irradiance
        On a surface that faces it, at least 0.
    """

    towards: Float[Array, "3"] = eqx.field(converter=floating, default=(0.0, 0.0, 1.0))
    irradiance: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        _vector("towards", self.towards, direction=True)
        within("irradiance", self.irradiance, 0.0, math.inf)


class Falloff(eqx.Module):
    """Decrease with the distance d: 1 / (a d^m + b), the inverse square by default.

    Parameters
    ----------
    a, m, b
        At least 0, a and b not both 0. ``Falloff(a, 1, b)`` is 1 / (a d + b).
    """

    a: Float[Array, ""] = eqx.field(converter=floating, default=1.0)
    m: Float[Array, ""] = eqx.field(converter=floating, default=2.0)
    b: Float[Array, ""] = eqx.field(converter=floating, default=0.0)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        for name in ("a", "m", "b"):
            within(f"{name} of a falloff", getattr(self, name), 0.0, math.inf)
        known = [checks.concrete(value) for value in (self.a, self.b)]
        if all(value is not None and not value.any() for value in known):
            raise InputError("a and b of a falloff must not both be 0")


class Point(Light):
    """Light from one point to all sides.

    Parameters
    ----------
    position
        [3].
    intensity
        Radiant intensity, at least 0.
    falloff
        Of the irradiance with the distance.
    """

    position: Float[Array, "3"] = eqx.field(converter=floating, default=(0.0, 0.0, 0.0))
    intensity: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)
    falloff: Falloff = eqx.field(default_factory=Falloff)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        _vector("position", self.position)
        within("intensity", self.intensity, 0.0, math.inf)


class Flood(Light):
    """Light from one point, strongest in one direction: intensity cos^n of the angle to it.

    Parameters
    ----------
    position, intensity, falloff
        As of `Point`; the intensity is that along the axis. Behind the light it is 0.
    aim
        Direction in which it shines, [3], of any length.
    exponent
        n, at least 0.
    """

    position: Float[Array, "3"] = eqx.field(converter=floating, default=(0.0, 0.0, 0.0))
    aim: Float[Array, "3"] = eqx.field(converter=floating, default=(0.0, 0.0, -1.0))
    intensity: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)
    exponent: Float[Array, ""] = eqx.field(converter=floating, default=1.0)
    falloff: Falloff = eqx.field(default_factory=Falloff)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        _vector("position", self.position)
        _vector("aim", self.aim, direction=True)
        within("intensity", self.intensity, 0.0, math.inf)
        within("exponent", self.exponent, 0.0, math.inf)


class Environment(Light):
    """Light from infinity all around: one radiance, or a map in longitude and latitude.

    Parameters
    ----------
    radiance
        A number or channels [C] for a constant; a map [H, W] or [H, W, C], its first row at
        the zenith (`up`), its columns from the azimuth of x by way of y (for z up).
    scale
        Factor on it.
    turn
        Degrees by which the map is turned about z, counter-clockwise as seen from above.
    up
        "z", or "y": then the map's zenith is y, and azimuths run from z by way of x.
    """

    radiance: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)
    scale: Float[Array, ""] = eqx.field(converter=floating, default=1.0)
    turn: float = eqx.field(static=True, default=0.0)
    up: str = eqx.field(static=True, default="z")

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        checks.choice("up", self.up, ("y", "z"))
        within("radiance", self.radiance, 0.0, math.inf)
        within("scale", self.scale, 0.0, math.inf)
        if self.radiance.ndim > 3 or 0 in self.radiance.shape:
            raise InputError(
                f"radiance must be a number, [C], [H, W] or [H, W, C]; received "
                f"{self.radiance.shape}"
            )
        known = checks.concrete(self.radiance)
        if known is not None and not np.isfinite(known).all():
            raise InputError("radiance of an environment must be finite")

    @property
    def is_map(self) -> bool:
        """Whether it varies with the direction."""
        return self.radiance.ndim > 1

    @property
    def axes(self) -> Float[np.ndarray, "3 3"]:
        """Rows: the world's directions of the map's x, y and zenith."""
        axes = np.eye(3) if self.up == "z" else np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
        angle = math.radians(self.turn)
        cos, sin = math.cos(angle), math.sin(angle)
        return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ axes


class LobeEnvironment(Light):
    """Light from infinity all around as von Mises-Fisher lobes of radiance over directions.

    Parameters
    ----------
    lobes
        One sum of lobes (no batch), scalar or with channels; negative lobes are refused. From
        an environment map: ``diffopt.fitting.fit_environment``.
    """

    lobes: Lobes

    def __check_init__(self) -> None:
        """Check the lobes, where they are known."""
        if self.lobes.kappa.ndim != 1:
            raise InputError("lobes of an environment must be one sum, not a batch")
        within("alpha of an environment's lobes", self.lobes.alpha, 0.0, math.inf)


def _vector(name: str, value: Array, direction: bool = False) -> None:
    known = checks.concrete(value)
    if known is not None:
        (transforms.unit if direction else transforms.vector)(name, known)
