"""Shapes made by code to lay a surface on, and from where a mesh is looked at first."""

import math

import numpy as np
from jaxtyping import Float, Int

from diffopt.scenes.meshfiles import Mesh
from diffopt.viewer.subject import Place


def sheet(
    bend_deg: float = 110.0, around: int = 200, along: int = 160
) -> tuple[Mesh, Float[np.ndarray, "V 3"]]:
    """A sheet bent about the x axis, its middle upwards: mesh, and the material's x axis.

    The material's x axis runs along the bend, as in `diffopt.drawing.shapes.sheet`.
    """
    half = math.radians(0.5 * bend_deg)
    angle, x = np.meshgrid(np.linspace(-half, half, around), np.linspace(-0.9, 0.9, along))
    zero = np.zeros_like(angle)
    normal = np.stack([zero, np.sin(angle), np.cos(angle)], -1).reshape(-1, 3)
    field = np.stack([zero, np.cos(angle), -np.sin(angle)], -1).reshape(-1, 3)
    middle = np.array([0.0, 0.0, 0.5 * (1.0 + math.cos(half))])
    points = normal + x.reshape(-1, 1) * np.array([1.0, 0.0, 0.0]) - middle
    return Mesh(points, triangles(along, around), normal), field


def ball(around: int = 256, across: int = 128) -> tuple[Mesh, Float[np.ndarray, "V 3"]]:
    """A unit ball: mesh, and the material's x axis, along the parallels about z."""
    theta, phi = np.meshgrid(
        np.linspace(0.0, math.pi, across), np.linspace(0.0, 2.0 * math.pi, around), indexing="ij"
    )
    sin = np.sin(theta)
    points = np.stack([sin * np.cos(phi), sin * np.sin(phi), np.cos(theta)], -1)
    field = np.stack([-np.sin(phi), np.cos(phi), np.zeros_like(phi)], -1).reshape(-1, 3)
    faces = triangles(across, around)
    flat = points.reshape(-1, 3)
    corner = flat[faces]
    area = np.linalg.norm(
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1
    )
    return Mesh(flat, faces[area > 1e-12], flat.copy()), field


def triangles(rows: int, columns: int) -> Int[np.ndarray, "F 3"]:
    """Two for each square of a grid of vertices that are numbered row after row."""
    number = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    return np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])


def place(mesh: Mesh, up: np.ndarray, whole: bool) -> Place:
    """A camera that sees all of a mesh from the front and above."""
    axis = up / np.linalg.norm(up)
    front = np.array([0.0, -1.0, 0.0]) if abs(axis[1]) < 0.9 else np.array([0.0, 0.0, 1.0])
    side = np.cross(front, axis)
    towards = 0.75 * front + (0.5 if whole else 0.85) * axis + 0.3 * side
    towards /= np.linalg.norm(towards)
    eye = mesh.centre + 3.1 * mesh.radius * towards
    return Place(
        (float(eye[0]), float(eye[1]), float(eye[2])),
        (float(mesh.centre[0]), float(mesh.centre[1]), float(mesh.centre[2])),
        (float(axis[0]), float(axis[1]), float(axis[2])),
    )
