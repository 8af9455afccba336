"""Where a field is sampled: directions from the centre, distances, rays of each.

Samples are taken in local frames whose z axis points to the centre (x = -e_theta, y = e_phi), so
that they vary slowly from one direction to the next; polar angles lie at half steps, and what lies
beyond a pole is the opposite direction turned by pi.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from diffopt.kernels import harmonics, hemispherical
from diffopt.shadows.settings import ShadowSettings

# Distance, in radii, from which rays of the far shell start.
_OUTSIDE = 1.001


class Shell(NamedTuple):
    """One distance: rays in the local frame, and how their answers become coefficients.

    Attributes
    ----------
    distance
        Of the points from the centre, in radii; infinite for parallel rays.
    starts, directions
        Rays in the local frame from the point, [n, 3]; starts are 0 but for parallel rays.
    projection
        From answers to coefficients, [S^2, n]: of the hemisphere of angles u, sin t = sin u / d,
        outside; of the sphere, inside.
    """

    distance: float
    starts: Float[np.ndarray, "n 3"]
    directions: Float[np.ndarray, "n 3"]
    projection: Float[np.ndarray, "S2 n"]


@lru_cache(maxsize=16)
def frames(polar: int, azimuthal: int) -> Float[np.ndarray, "g 3 3"]:
    """Local axes of the directions as columns; the third points to the centre."""
    theta = (np.arange(polar) + 0.5) * np.pi / polar
    phi = np.arange(azimuthal) * 2.0 * np.pi / azimuthal
    theta, phi = (a.reshape(-1) for a in np.meshgrid(theta, phi, indexing="ij"))
    ct, st, cp, sp = np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi)
    zero = np.zeros_like(ct)
    columns = [[-ct * cp, -ct * sp, st], [-sp, cp, zero], [-st * cp, -st * sp, -ct]]
    return np.stack([np.stack(column, -1) for column in columns], -1)


def ratios(settings: ShadowSettings) -> Float[np.ndarray, " s"]:
    """Ratio r / d of the shells outside, 1 first and 0 last: nodes of Chebyshev and Lobatto."""
    count = settings.shells or 1
    return 0.5 + 0.5 * np.cos(np.pi * np.arange(count) / max(count - 1, 1))


def inner_distances(settings: ShadowSettings, nearest: float) -> Float[np.ndarray, " j"]:
    """Distances of shells inside, in radii, from that of the nearest receiver to below 1."""
    if settings.inner_step == 0.0 or nearest >= 1.0:
        return np.zeros(0)
    count = int(np.ceil((1.0 - nearest) / settings.inner_step - 1e-9))
    return nearest + (1.0 - nearest) * np.arange(count) / count


@lru_cache(maxsize=64)
def outer(ratio: float, rays: int, bands: int, on_sphere: bool) -> Shell:
    """The shell at r / d = ratio.

    Parameters
    ----------
    ratio
        0 (parallel rays) to 1 (on the sphere).
    rays
        On a side.
    bands
        Of the coefficients.
    on_sphere
        Coefficients on the whole sphere in place of the hemisphere's; for ratio 1.
    """
    local, weights = harmonics.hemisphere_rule(rays, rays)
    sine = ratio * np.sqrt(1.0 - local[:, 2] ** 2)
    directions = np.concatenate([ratio * local[:, :2], np.sqrt(1.0 - sine**2)[:, None]], -1)
    starts = np.zeros_like(local)
    if ratio == 0.0:
        starts[:, :2] = local[:, :2]
        starts[:, 2] = -_OUTSIDE
    basis = (harmonics if on_sphere else hemispherical).numpy_basis(local, bands)
    return _shell(1.0 / ratio if ratio else np.inf, starts, directions, basis * weights)


@lru_cache(maxsize=64)
def inner(distance: float, rays: int, bands: int) -> Shell:
    """A shell inside the sphere: rays to all sides, as dense as the hemisphere's."""
    directions, weights = harmonics.sphere_rule(2 * rays, rays)
    basis = harmonics.numpy_basis(directions, bands)
    return _shell(distance, np.zeros_like(directions), directions, basis * weights)


def _shell(distance: float, *parts: np.ndarray) -> Shell:
    starts, directions, projection = (part.astype(np.float32) for part in parts)
    return Shell(distance, starts, directions, projection)


def in_object(
    shell: Shell, grid: tuple[int, int], part: slice
) -> tuple[Float[np.ndarray, "r 3"], Float[np.ndarray, "r 3"]]:
    """Starts and directions, in the frame of the object, of rays from some of the directions."""
    axes = frames(*grid)[part].astype(np.float32)
    # One product of matrices: [n, 3] with [3, 3 g].
    columns = axes.transpose(2, 0, 1).reshape(3, -1)

    def turned(local: np.ndarray) -> np.ndarray:
        found = (local @ columns).reshape(len(local), -1, 3)
        return np.ascontiguousarray(found.transpose(1, 0, 2)).reshape(-1, 3)

    directions = turned(shell.directions)
    if np.isinf(shell.distance):
        return turned(shell.starts), directions
    origins = -np.float32(shell.distance) * axes[:, :, 2]
    return np.repeat(origins, len(shell.directions), axis=0), directions


def with_antipodes(
    half: Float[np.ndarray, "S2 h"], grid: tuple[int, int]
) -> Float[np.ndarray, "S2 g"]:
    """Coefficients of parallel rays at all directions, from those of the upper half.

    From the opposite side the same lines are met: what is seen is mirrored in the plane of the
    local x, negative orders with the other sign.
    """
    polar, azimuthal = grid
    bands = round(half.shape[0] ** 0.5)
    upper = half.reshape(-1, polar // 2, azimuthal)
    sign = np.where(harmonics.orders(bands) < 0, -1.0, 1.0).astype(half.dtype)
    lower = np.roll(upper[:, ::-1], azimuthal // 2, 2) * sign[:, None, None]
    return np.concatenate([upper, lower], 1).reshape(half.shape[0], -1)
