"""Scenes and quadrature that the tests of precomputed transfer share."""

import numpy as np

import diffopt as do
from diffopt.scenes import meshfiles
from diffopt.scenes.shapes import Plane
from diffopt.scenes.transforms import facing, translate
from diffopt.transfer import beginning, reflectors
from diffopt.transfer.tracing import Frames

LAMBERT = do.materials.Lambert


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def reflector(material):
    """As transfer sees a material."""
    return reflectors.reflectors(do.Scene([do.Object(Plane(1.0, 1.0), material)]))[0][0]


def ball(level=2, radius=1.0):
    """Icosphere with smooth normals."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=level, radius=radius)
    return meshfiles.build(np.asarray(mesh.vertices), np.asarray(mesh.faces), crease_deg=180.0)


def ceiling(size, height, x=0.0):
    """Transform of a plane that faces down."""
    return facing((x, 0.0, height), (x, 0.0, 0.0), (0.0, 1.0, 0.0))


def lifted(height):
    return translate(0.0, 0.0, height)


def looking(*directions, at=None):
    """Vertices that look along directions, by default from the origin."""
    out = []
    for n in np.asarray(directions, float):
        n = unit(n)
        t = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
        t = unit(t)
        out.append([t, np.cross(n, t), n])
    places = np.zeros((len(out), 3)) if at is None else np.asarray(at, float)
    return Frames(places, np.array(out))


def surroundings(objects, backend="embree"):
    return beginning.surroundings(do.Scene(objects), backend)


def hemisphere_rule(nodes=200, turns=400):
    """Directions over the upper hemisphere and their solid angles: Gauss in z, even in turn."""
    z, weight = np.polynomial.legendre.leggauss(nodes)
    z, weight = 0.5 * (z + 1.0), 0.5 * weight
    turn = (np.arange(turns) + 0.5) * 2.0 * np.pi / turns
    across = np.sqrt(1.0 - z * z)[:, None]
    d = np.stack([across * np.cos(turn), across * np.sin(turn), z[:, None] + 0 * turn], -1)
    solid = np.repeat(weight, turns) * 2.0 * np.pi / turns
    return d.reshape(-1, 3), solid


def grid(size, cells):
    """A square in the xy plane in cells of two triangles, facing z."""
    line = np.linspace(-0.5 * size, 0.5 * size, cells + 1)
    x, y = (a.reshape(-1) for a in np.meshgrid(line, line))
    corner = np.add.outer((cells + 1) * np.arange(cells), np.arange(cells)).reshape(-1)
    lower = np.stack([corner, corner + 1, corner + cells + 2], 1)
    upper = np.stack([corner, corner + cells + 2, corner + cells + 1], 1)
    return meshfiles.build(np.stack([x, y, 0.0 * x], 1), np.concatenate([lower, upper]))
