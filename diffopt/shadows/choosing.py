"""The cheapest settings of a shadow field within a tolerance, by a table of measured errors.

The error is the RMS error of irradiance over the unshadowed one, of receivers under a sky with a
lobe 30 degrees wide, against rays. The table holds the largest over scenes (a capsule, a sphere, a
torus over a plane; the torus that the plane cuts; two objects), as the studies `shadow.*` measure
it. Narrower light and lamps close by show more of what bands leave out, and so do other shapes: of
random ones the promise ``shadows`` found errors of up to 2.4 times the table's.
"""

from typing import NamedTuple

from diffopt import checks
from diffopt.errors import InputError
from diffopt.shadows.settings import ShadowSettings

# What was measured is exceeded by other shapes: a margin over the worst of the scenes.
_MARGIN = 1.15


class Choice(NamedTuple):
    """Settings, and their largest errors over the scenes, by where receivers lie.

    Attributes
    ----------
    bands, shells, directions, rays
        Of `ShadowSettings`.
    outside, inside, several
        Errors with receivers outside all spheres, within one, and with two objects.
    """

    bands: int
    shells: int
    directions: tuple[int, int]
    rays: int
    outside: float
    inside: float
    several: float

    @property
    def settings(self) -> ShadowSettings:
        """What it stands for; all else by default."""
        return ShadowSettings(
            bands=self.bands, shells=self.shells, directions=self.directions, rays=self.rays
        )


#: From cheap to dear: rays and coefficients of a frame grow from line to line.
CHOICES = (
    Choice(2, 1, (6, 10), 8, 0.0431, 0.0443, 0.0454),
    Choice(3, 2, (6, 10), 8, 0.0187, 0.0263, 0.0228),
    Choice(4, 1, (6, 10), 8, 0.0226, 0.0252, 0.0238),
    Choice(4, 2, (6, 10), 8, 0.0138, 0.0236, 0.0155),
    Choice(4, 4, (6, 10), 12, 0.0106, 0.0223, 0.0129),
    Choice(4, 4, (8, 14), 16, 0.0101, 0.0118, 0.0122),
    Choice(4, 4, (12, 20), 24, 0.0101, 0.0104, 0.0119),
    Choice(5, 4, (8, 14), 16, 0.0069, 0.0080, 0.0078),
    Choice(6, 3, (8, 14), 16, 0.0057, 0.0091, 0.0056),
    Choice(6, 4, (12, 20), 16, 0.0041, 0.0038, 0.0046),
    Choice(6, 5, (12, 20), 24, 0.0040, 0.0033, 0.0047),
    Choice(6, 5, (16, 28), 32, 0.0038, 0.0034, 0.0045),
    Choice(7, 5, (12, 20), 24, 0.0028, 0.0021, 0.0032),
    Choice(8, 5, (12, 20), 24, 0.0021, 0.0018, 0.0022),
    Choice(8, 5, (16, 28), 24, 0.0015, 0.0018, 0.0018),
    Choice(8, 6, (24, 40), 32, 0.0013, 0.0015, 0.0017),
    Choice(10, 7, (24, 40), 32, 0.0008, 0.0010, 0.0010),
)


def settings_for(
    tolerance: float, *, receivers_inside: bool = False, occluders: int = 1
) -> ShadowSettings:
    """The cheapest settings whose measured error is within a tolerance.

    Parameters
    ----------
    tolerance
        RMS error of irradiance over the unshadowed one.
    receivers_inside
        Whether receivers lie within the bounding sphere of an occluder.
    occluders
        How many there are: several are multiplied, which loses a little.

    Raises
    ------
    InputError
        If the tolerance is no relative error, or no settings of the table meet it; the message
        gives the smallest that one does.
    """
    checks.tolerance(tolerance)
    if not isinstance(occluders, int) or occluders < 1:
        raise InputError(f"occluders must be a whole number from 1; received {occluders!r}")
    errors = [_error(choice, receivers_inside, occluders > 1) for choice in CHOICES]
    for choice, error in zip(CHOICES, errors, strict=True):
        if error <= tolerance:
            return choice.settings
    where = "within the bounding sphere" if receivers_inside else "outside the bounding sphere"
    raise InputError(
        f"tolerance {tolerance:g} is met by no settings of shadow fields for receivers {where}: "
        f"the smallest is {min(errors):.2g}; trace rays (diffopt.shadows.truth) for less"
    )


def _error(choice: Choice, inside: bool, several: bool) -> float:
    """On the safe side."""
    found = choice.outside
    if inside:
        found = max(found, choice.inside)
    if several:
        found = max(found, choice.several)
    return _MARGIN * found
