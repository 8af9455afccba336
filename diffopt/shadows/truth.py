"""The trusted reference: irradiance past meshes by rays to many directions."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from diffopt.kernels import harmonics
from diffopt.shadows.lights import radiance_function
from diffopt.shadows.rays import Rays

# Rays at once.
_AT_ONCE = 2**20
# Rays leave a receiver this far from it, in units of the scene.
_OFFSET = 1e-5


def irradiance(
    points: Float[np.ndarray, "N 3"],
    meshes: Sequence[tuple[Any, Any]],
    radiance: Any,
    *,
    polar: int = 40,
    azimuthal: int = 80,
) -> tuple[Float[np.ndarray, "N C"], Float[np.ndarray, " C"]]:
    """Irradiance of receivers that face +z past meshes, and without them.

    Parameters
    ----------
    points
        [N, 3].
    meshes
        Vertices and faces of each.
    radiance
        Of distant light, as for `distant_light`.
    polar, azimuthal
        Directions to which rays are cast.
    """
    points = np.asarray(points, np.float64).reshape(-1, 3)
    above, weights = harmonics.hemisphere_rule(polar, azimuthal)
    light = np.asarray(radiance_function(radiance)(above), np.float64)
    light = (light[:, None] if light.ndim == 1 else light) * (weights * above[:, 2])[:, None]
    found = np.empty((len(points), light.shape[1]))
    for part, blocked in hidden(points, meshes, above):
        found[part] = ~blocked @ light
    return found, light.sum(0)


def hidden(
    points: Float[np.ndarray, "N 3"],
    meshes: Sequence[tuple[Any, Any]],
    directions: Float[np.ndarray, "n 3"],
) -> Iterator[tuple[slice, Bool[np.ndarray, "b n"]]]:
    """Whether meshes hide each direction from points: a block of points after the other."""
    casters = [Rays(vertices, faces) for vertices, faces in meshes]
    count = max(1, _AT_ONCE // len(directions))
    for first in range(0, len(points), count):
        here = points[first : first + count]
        to = np.tile(directions, (len(here), 1))
        starts = np.repeat(here, len(directions), 0) + _OFFSET * to
        blocked = np.zeros(len(starts), bool)
        for caster in casters:
            blocked |= caster.blocked(starts, to)
        yield slice(first, first + len(here)), blocked.reshape(len(here), -1)
