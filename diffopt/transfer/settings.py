"""Settings of precomputed transfer, with what each does to error and to time."""

import dataclasses
import math

from diffopt.errors import InputError
from diffopt.transfer.views import FINEST

#: Kinds of light paths to a surface point, in the order of their lobes.
KINDS = ("direct", "indirect diffuse", "indirect glossy")


@dataclasses.dataclass(frozen=True)
class TransferSettings:
    """How transfer is precomputed.

    Parameters
    ----------
    tolerance
        Largest difference that is not refined, in (0, 1]: of slices from what neighbouring
        views predict (root mean square in L2 over the views, over the norm of the unoccluded
        slices), and of slices at two corners of a triangle. Halved, the number of vertices
        grows two- to fourfold.
    rays
        Directions over the hemisphere that every vertex looks along, 64 to 65,536. The error
        of what is hidden, and of indirect light, falls with their number to the power 1/2 to
        3/4; the time of tracing and of the moments grows in proportion.
    lobes
        For each kind of path, 1 to 8. One lobe is 18-55 % off (L2) at grazing views, two are
        halves of that; time and size grow in proportion.
    depth
        Surfaces that a path meets at most, 1 to 16: 1 is direct light alone, 2 a single
        interreflection (the paper's).
    coarsest, finest
        Levels of viewing directions, 0 to 5, that every vertex has, and that no vertex exceeds.
    splits
        How often a triangle may be split in four, 0 to 8.
    least_area
        Triangles below this share of the scene's area are not split, in [0, 1).
    longest
        Sides of triangles to begin with, over the median side or a 64th of the scene's radius, in
        [1, 1e6]: longer ones are halved before anything is compared, as what stands in the middle
        of a wide floor is not seen from its corners.
    round_faces
        Triangles split in a round, the worst first.
    most_vertices
        Where refinement stops at the latest.
    compared
        Level of views at which the corners of triangles are compared at most.
    chunk
        Vertices computed at a time; memory grows with chunk x rays (some 100 bytes each).
    seed
        Of the directions in which light is followed beyond the first surface.
    """

    tolerance: float = 0.1
    rays: int = 4096
    lobes: int = 1
    depth: int = 2
    coarsest: int = 1
    finest: int = 4
    splits: int = 5
    least_area: float = 0.0
    longest: float = 16.0
    round_faces: int = 4000
    most_vertices: int = 200_000
    compared: int = 2
    chunk: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        _number("tolerance", self.tolerance, 0.0, 1.0, open_low=True)
        _number("least_area", self.least_area, 0.0, 1.0)
        _number("longest", self.longest, 1.0, 1e6)
        for name, low, high in (
            ("rays", 64, 65536),
            ("lobes", 1, 8),
            ("depth", 1, 16),
            ("coarsest", 0, FINEST),
            ("finest", 0, FINEST),
            ("splits", 0, 8),
            ("round_faces", 1, 10**7),
            ("most_vertices", 1, 10**7),
            ("compared", 0, FINEST),
            ("chunk", 1, 1024),
            ("seed", 0, 2**31 - 1),
        ):
            _whole(name, getattr(self, name), low, high)
        if self.coarsest > self.finest:
            raise InputError(
                f"coarsest must not exceed finest; received {self.coarsest} and {self.finest}"
            )


def _whole(name: str, value: int, low: int, high: int) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise InputError(f"{name} must be a whole number from {low} to {high}; received {value}")


def _number(name: str, value: float, low: float, high: float, open_low: bool = False) -> None:
    fine = isinstance(value, int | float) and math.isfinite(value) and low <= value <= high
    if not fine or (open_low and value == low):
        raise InputError(
            f"{name} must be {'above' if open_low else 'from'} {low:g} and at most "
            f"{high:g}; received {value}"
        )
