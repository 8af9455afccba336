"""Samples of a field: what is hidden, or what is emitted, about a mesh."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffopt.errors import InputError
from diffopt.kernels import harmonics
from diffopt.shadows import shells
from diffopt.shadows.rays import Rays, check_mesh
from diffopt.shadows.settings import ShadowSettings

# Rays cast at once, for bounded memory.
_AT_ONCE = 2**19


class Samples(NamedTuple):
    """Coefficients at every direction of every shell, and where that is.

    Attributes
    ----------
    outer
        On and outside the sphere, [s, S^2, polar, azimuthal]; with channels [..., C] last.
    inner
        Inside it, [j, L^2, polar, azimuthal].
    nearest
        Distance of the innermost shell, in radii; 1 without one.
    """

    outer: Float[np.ndarray, "s S2 p a ..."]
    inner: Float[np.ndarray, "j L2 p a ..."]
    nearest: float


def bounding_sphere(vertices: Float[np.ndarray, "V 3"]) -> tuple[np.ndarray, float]:
    """Centre [3] and radius of nearly the smallest sphere about points.

    A sphere not centred on the object costs accuracy far away. The smallest one is approached, to
    0.1 % or so, by steps towards the farthest point (Badoiu and Clarkson 2003), among points that
    are extreme in some direction.
    """
    points = np.asarray(vertices, np.float64)
    directions, _ = harmonics.sphere_rule(8, 16)
    extreme = points[np.unique(np.argmax(points @ directions.T, 0))]
    centre = 0.5 * (points.min(0) + points.max(0))
    for step in range(1, 200):
        away = extreme - centre
        centre = centre + away[np.argmax((away * away).sum(1))] / (step + 1.0)
    radius = float(np.sqrt(((points - centre) ** 2).sum(1).max()))
    return centre, radius


def sample(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    settings: ShadowSettings,
    *,
    centre: Float[np.ndarray, "3"],
    radius: float,
    nearest: float = np.inf,
    emission: Float[np.ndarray, "F C"] | None = None,
    backend: str = "embree",
) -> Samples:
    """Cast the rays of every shell at a mesh and project the answers.

    Parameters
    ----------
    vertices, faces
        The mesh, any unit of length.
    settings
        Of the field.
    centre, radius
        Sphere that holds the mesh.
    nearest
        Distance of the nearest receiver from the centre, in radii: shells inside go down to it.
    emission
        Radiance of every face, from both sides: the field is then what is emitted.
    backend
        Of the rays, "embree" or "jax".

    Raises
    ------
    InputError
        For arrays that are no mesh, or a mesh that leaves the sphere.
    """
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces)
    check_mesh(vertices, faces)
    if not radius > 0.0:
        raise InputError(f"radius must be above 0; received {radius}")
    scaled = (vertices - centre) / radius
    farthest = float(np.sqrt((scaled**2).sum(1).max()))
    if farthest > 1.0 + 1e-4:
        raise InputError(
            f"the mesh reaches {farthest:.4g} radii from the centre of the sphere; expected at "
            "most 1: give a larger radius"
        )
    rays = Rays(scaled, faces, backend)
    if emission is not None and len(emission) != len(faces):
        raise InputError(f"emission must be [{len(faces)}, C]; received {np.shape(emission)}")
    grid = settings.directions
    full = settings.map != "tangent"
    outside = [
        _one(rays, grid, shells.outer(float(k), settings.rays, settings.bands, full), emission)
        for k in shells.ratios(settings)
    ]
    distances = shells.inner_distances(settings, nearest)
    inside = [
        _one(rays, grid, shells.inner(float(d), settings.rays, settings.bands), emission)
        for d in distances
    ]
    size = (settings.bands**2, *grid)
    tail = () if emission is None else (np.shape(emission)[1],)
    return Samples(
        np.stack(outside).reshape(len(outside), *size, *tail),
        np.asarray(inside, np.float32).reshape(len(inside), *size, *tail),
        float(distances[0]) if len(distances) else 1.0,
    )


def _one(
    rays: Rays, grid: tuple[int, int], shell: shells.Shell, emission: np.ndarray | None
) -> np.ndarray:
    """Coefficients of one shell, [S^2, g] or [S^2, g, C]."""
    polar, azimuthal = grid
    # Parallel rays meet the same from both ends.
    halved = np.isinf(shell.distance) and polar % 2 == 0 and emission is None
    total = polar * azimuthal // 2 if halved else polar * azimuthal
    count = max(1, _AT_ONCE // len(shell.directions))
    found = []
    for first in range(0, total, count):
        part = slice(first, min(first + count, total))
        starts, directions = shells.in_object(shell, grid, part)
        if emission is None:
            # Within the sphere a point may lie in the body, where all rays would be blocked.
            inside = shell.distance < 1.0 and rays.closed
            seen = (rays.fronts if inside else rays.blocked)(starts, directions)
            seen = seen.reshape(-1, len(shell.directions))
            found.append(shell.projection @ seen.T.astype(np.float32))
        else:
            face = rays.face(starts, directions)
            seen = np.where(face[:, None] >= 0, np.asarray(emission, np.float32)[face], 0.0)
            seen = seen.reshape(-1, len(shell.directions), seen.shape[-1])
            found.append(np.einsum("in,gnc->igc", shell.projection, seen))
    half = np.concatenate(found, 1)
    return shells.with_antipodes(half, grid) if halved else half
