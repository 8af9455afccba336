"""Settings of shadow fields."""

import dataclasses
from typing import Any

from diffopt import checks
from diffopt.errors import InputError

MAPS = ("tangent", "square", "sphere rule")
COMBINATIONS = ("product", "exponential", "sum")
FACTORS = ("none", "paper")
WINDOWS = ("none", "hann", "lanczos")


@dataclasses.dataclass(frozen=True)
class ShadowSettings:
    """How a shadow field is sampled, carried to other distances, combined and shaded.

    Attributes
    ----------
    bands
        Bands of spherical harmonics, 1 to 16. Sets the least error that is possible: 0.8-1 % of
        the unshadowed light at 4, 0.3 % at 6, 0.1 % at 8 (a sky and a lobe 30 degrees wide). Time
        of a receiver grows with its third power, or so.
    directions
        Polar and azimuthal directions from the centre in which the field is sampled; an even
        number of azimuths. Rays grow with their product, time of a receiver does not.
    rays
        Rays to the hemisphere from each of them: rays x rays. Error falls with rays^-1.5.
    shells
        Distances at which the field is sampled, from the bounding sphere to infinity; what lies
        between is interpolated in r / d. 1: the sphere alone, as in the paper. Each adds as many
        rays; time of a receiver does not change. [default: 2 + bands / 2; 1 for the other maps]
    map
        How views shrink with the distance: "tangent", or with one shell "square" and "sphere rule"
        of the paper, with 2 to 10 and 1 to 3 times the error of the default at four bands.
    inner_step
        Spacing, in radii, of further shells inside the bounding sphere, down to the nearest
        receiver, with rays to the whole sphere. 0: none; inside, the view from the sphere is
        expanded by the square map, as in the paper.
    radial
        Nodes of the table over distances outside the sphere; between them it is linear.
    combination
        Of several occluders: "product" (triple products), "exponential" (of the sum of logarithms,
        the same in any order), "sum" (of what they hide: double where they overlap).
    source_factor
        Of light that a field emits: "none", as radiance does not change along a ray; "paper", the
        factor f' sin f / sin t of the paper, for its square map, which takes the fall of light
        with the distance away: irradiance is 7 times too large at two radii, 140 at eight.
    window
        Damps ringing of what is hidden: "none", "hann", "lanczos". For matte receivers none is
        best: windows darken and blur.
    clamp
        Whether irradiance is cut to [0, what comes unshadowed].
    """

    bands: int = 4
    directions: tuple[int, int] = (12, 20)
    rays: int = 32
    shells: int | None = None
    map: str = "tangent"
    inner_step: float = 0.1
    radial: int = 48
    combination: str = "product"
    source_factor: str = "none"
    window: str = "none"
    clamp: bool = False

    def __post_init__(self) -> None:
        """Check every value."""
        checks.choice("map", self.map, MAPS)
        checks.choice("combination", self.combination, COMBINATIONS)
        checks.choice("window", self.window, WINDOWS)
        checks.choice("source_factor", self.source_factor, FACTORS)
        if self.source_factor == "paper" and self.map != "square":
            raise InputError(f'source_factor "paper" needs the square map; received {self.map!r}')
        _whole("bands", self.bands, 1, 16)
        _whole("rays", self.rays, 4, 1024)
        if self.shells is None:
            count = min(16, 2 + self.bands // 2) if self.map == "tangent" else 1
            object.__setattr__(self, "shells", count)
        _whole("shells", self.shells, 1, 16)
        _whole("radial", self.radial, 4, 1024)
        try:
            polar, azimuthal = self.directions
        except (TypeError, ValueError):
            raise InputError(
                f"directions must be two whole numbers; received {self.directions!r}"
            ) from None
        _whole("polar directions", polar, 2, 1024)
        _whole("azimuthal directions", azimuthal, 4, 2048)
        if azimuthal % 2:
            raise InputError(f"azimuthal directions must be even; received {azimuthal}")
        if self.map != "tangent" and self.shells != 1:
            raise InputError(f"shells must be 1 for the {self.map} map; received {self.shells}")
        if not 0.0 <= self.inner_step <= 1.0:
            raise InputError(f"inner_step must lie in [0, 1]; received {self.inner_step}")


def _whole(name: str, value: Any, least: int, most: int) -> None:
    if not isinstance(value, int) or not least <= value <= most:
        raise InputError(
            f"{name} must be a whole number from {least} to {most}; received {value!r}"
        )
