"""Scenes on which shadow fields are judged: one object or two over a plane, a sky and a lobe.

Receivers face +z in the plane z = 0; light comes from the upper half space. The truth is cast ray
by ray; what is left when the true visibility is cut to some bands is the floor of every method.
"""

import functools
import math
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from diffopt.kernels import harmonics
from diffopt.shadows import shading, truth

#: Scenes of one object; the flat torus cuts its sphere with the plane.
SINGLE = ("capsule", "sphere", "torus flat", "torus tilted")
#: Two objects, one over the other for some receivers.
STACKED = "two objects"
# Towards the middle of the lobe.
_AXIS = np.array(
    [
        math.sin(math.radians(42.0)) * math.cos(0.6),
        math.sin(math.radians(42.0)) * math.sin(0.6),
        math.cos(math.radians(42.0)),
    ]
)


class Body(NamedTuple):
    """A mesh in the sphere that its field is given.

    Attributes
    ----------
    vertices, faces
        In the world.
    centre, radius
        Of the sphere.
    """

    vertices: Float[np.ndarray, "V 3"]
    faces: np.ndarray
    centre: Float[np.ndarray, "3"]
    radius: float


class Truth(NamedTuple):
    """Receivers, and their irradiance in units of the unshadowed one.

    Attributes
    ----------
    points
        [N, 3].
    irradiance
        [N].
    unshadowed
        Irradiance without the objects.
    """

    points: Float[np.ndarray, "N 3"]
    irradiance: Float[np.ndarray, " N"]
    unshadowed: float


def radiance(directions: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """A sky that brightens towards the zenith, and a lobe about 30 degrees wide."""
    above = directions[:, 2] > 0.0
    sky = 0.6 * directions[:, 2] + 1.4 * np.exp(15.0 * (directions @ _AXIS - 1.0))
    return np.where(above, sky, 0.0)


def bodies(name: str, detail: int = 1) -> list[Body]:
    """The objects of a scene.

    Parameters
    ----------
    name
        One of `SINGLE`, or `STACKED`.
    detail
        1 for few triangles, 2 for as many as the silhouettes' last thousandth needs.
    """
    if name == STACKED:
        small = _placed(_shape("sphere", detail), (-0.75, -0.1, 1.15), 0.5)
        return [small, _placed(_shape("torus tilted", detail), (0.95, 0.25, 1.35), 1.0)]
    height = 0.5 if name == "torus flat" else 1.15
    return [_placed(_shape(name, detail), (0.0, 0.0, height), 1.0)]


def _placed(mesh: tuple[np.ndarray, np.ndarray], centre: Any, radius: float) -> Body:
    centre = np.asarray(centre, np.float64)
    return Body(radius * mesh[0] + centre, mesh[1], centre, radius)


@functools.cache
def _shape(name: str, detail: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces about the origin, within the unit sphere."""
    import trimesh

    turn = trimesh.transformations.rotation_matrix
    if name == "sphere":
        mesh = trimesh.creation.icosphere(2 + detail, 0.999)
    elif name == "capsule":
        mesh = trimesh.creation.capsule(1.4, 0.29, count=[24 * detail] * 2)
        mesh.apply_translation(-mesh.bounds.mean(0))
        mesh.apply_transform(turn(1.1, [1.0, 0.0, 0.0]))
    else:
        mesh = trimesh.creation.torus(0.72, 0.27, 48 * detail, 32 * detail)
        if name == "torus tilted":
            mesh.apply_transform(turn(0.7, [1.0, 0.3, 0.0]))
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces)


@functools.lru_cache(maxsize=16)
def solved(name: str, side: int, polar: int, detail: int = 1) -> Truth:
    """Irradiance by rays.

    Parameters
    ----------
    name
        Of the scene.
    side
        Receivers on a side of the square [-4, 4]^2.
    polar
        Directions over the polar angle; twice as many over the azimuth.
    detail
        As for `bodies`.
    """
    points = shading.plane(8.0, side).reshape(-1, 3)
    meshes = [(body.vertices, body.faces) for body in bodies(name, detail)]
    found, unshadowed = truth.irradiance(points, meshes, radiance, polar=polar, azimuthal=2 * polar)
    return Truth(points, found[:, 0] / unshadowed[0], float(unshadowed[0]))


def floor(name: str, side: int, polar: int, bands: int, detail: int = 1) -> float:
    """RMS error when the true visibility is cut to some bands: the least that is possible."""
    right = solved(name, side, polar, detail)
    above, weights = harmonics.hemisphere_rule(polar, 2 * polar)
    meshes = [(body.vertices, body.faces) for body in bodies(name, detail)]
    factor = cut_light(above, weights, bands)
    found = np.empty(len(right.points))
    for part, hidden in truth.hidden(right.points, meshes, above):
        found[part] = 1.0 - hidden @ factor / right.unshadowed
    return rms(found, right)


def cut_light(
    above: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"], bands: int
) -> Float[np.ndarray, " n"]:
    """What each hidden direction takes of the light when what hides it is cut to bands."""
    basis = harmonics.numpy_basis(above, bands)
    return (basis @ (radiance(above) * above[:, 2] * weights)) @ (basis * weights)


def rms(found: Any, right: Truth) -> float:
    """RMS error of irradiance over the unshadowed irradiance."""
    off = np.asarray(found, np.float64).reshape(-1) - right.irradiance
    return float(np.sqrt((off * off).mean()))
