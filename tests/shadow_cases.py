"""Shapes and truth that tests of shadow fields share."""

import functools

import equinox as eqx
import numpy as np
import trimesh

from diffopt.kernels import harmonics
from diffopt.shadows import rays, shadow_field

ORIGIN = np.zeros(3)


@functools.cache
def shape(name):
    """Vertices and faces within the unit sphere about the origin."""
    make = trimesh.creation
    mesh = {
        "torus": lambda: make.torus(0.72, 0.27, 48, 32),
        "capsule": lambda: make.capsule(1.4, 0.29, count=[24, 24]),
        "cube": lambda: make.box([1.153] * 3),
        "plate": lambda: make.box([1.4, 1.4, 0.06]),
        "small": lambda: make.icosphere(3, 0.5),
        "aside": lambda: make.icosphere(3, 0.35),
    }[name]()
    turn = trimesh.transformations.rotation_matrix
    if name == "torus":
        mesh.apply_transform(turn(0.7, [1.0, 0.3, 0.0]))
    if name == "capsule":
        mesh.apply_translation(-mesh.bounds.mean(0))
        mesh.apply_transform(turn(1.1, [1.0, 0.0, 0.0]))
    if name == "aside":
        mesh.apply_translation([0.6, 0.0, 0.15])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


SHAPES = ("torus", "capsule", "cube", "plate", "small", "aside")


def field(name, settings, **options):
    return shadow_field(*shape(name), settings, centre=ORIGIN, radius=1.0, **options)


@eqx.filter_jit
def coefficients(field, points):
    """Of a field at points, in one program."""
    return field.coefficients(points)


def turned(seed):
    """A rotation, any."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def towards(count, seed=1):
    """Unit vectors, any, [count, 3]."""
    n = np.random.default_rng(seed).normal(size=(count, 3))
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def spread(count):
    """Unit vectors spread evenly: a spiral of golden steps."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    phi = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    s = np.sqrt(1.0 - z * z)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], -1)


def looking(point, polar=40):
    """Directions and weights of all that may meet the unit sphere from a point."""
    distance = np.linalg.norm(point)
    low = np.sqrt(1.0 - 1.0 / distance**2) if distance > 1.0 else -1.0
    z, weight = np.polynomial.legendre.leggauss(polar)
    half = 0.5 * (1.0 - low)
    local, weights = harmonics.rule_of(low + half * (z + 1.0), half * weight, 2 * polar)
    axis = -point / distance
    side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.6 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    return local @ np.stack([side, np.cross(axis, side), axis]), weights


@functools.cache
def _projections(key, bands):
    found = []
    for point in np.frombuffer(key).reshape(-1, 3):
        directions, weights = looking(point)
        found.append((directions, harmonics.numpy_basis(directions, bands) * weights))
    return found


def hidden(meshes, points, bands):
    """Coefficients of what meshes hide, by rays, [L^2, N]; meshes lie in the unit sphere."""
    casters = [rays.Rays(*mesh) for mesh in meshes]
    found = []
    for point, (directions, projection) in zip(
        points, _projections(np.ascontiguousarray(points, float).tobytes(), bands), strict=True
    ):
        starts = np.broadcast_to(point, directions.shape)
        met = [caster.blocked(starts, directions) for caster in casters]
        found.append(projection @ np.any(met, 0))
    return np.stack(found, 1)
