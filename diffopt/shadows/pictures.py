"""Pictures of an object over the ground: camera rays, the ground from irradiance at receivers.

The ground reads what the fields gave; the object itself is shaded at its vertices by rays to the
same light, so that pictures show shadows on the ground as the fields have them, and no others.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from diffopt.drawing import tones
from diffopt.kernels import harmonics
from diffopt.scenes.camera import Camera
from diffopt.shadows import animations
from diffopt.shadows.lights import SphereLight
from diffopt.shadows.rays import Rays

#: Albedo of the ground, linear RGB.
GROUND_RGB = (0.62, 0.60, 0.57)
# Seen where there is nothing else: below and above.
_BACK_RGB = np.array([[0.15, 0.155, 0.165], [0.05, 0.055, 0.065]])
# The ground fades from here to the rim of the receivers, as a share of half their width.
_FADE = 0.5
# Directions to the sky from the object's vertices, and points of the lamp.
_POLAR, _AZIMUTHAL, _LAMP_POINTS = 12, 28, 6
# Rays leave a surface this far from it.
_OFFSET = 2e-3
# Brightness of the open ground before the tone curve.
_EXPOSED = 0.66
# Becomes white.
_WHITE = 1.7


class Stage:
    """A camera over the ground: what does not change from frame to frame is made once.

    Parameters
    ----------
    resolution
        Columns and rows of the picture.
    spp
        Samples on a side of each pixel.
    """

    def __init__(self, resolution: tuple[int, int] = (640, 400), spp: int = 2) -> None:
        self.camera = Camera(
            eye=(0.6, -6.9, 3.9), target=(0.0, 0.0, 0.95), resolution=resolution, field_of_view=31.0
        )
        self.spp = spp
        columns, rows = resolution
        steps = (np.arange(spp) + 0.5) / spp
        inside = np.stack(np.meshgrid(steps, steps, indexing="ij"), -1).reshape(-1, 2)
        pixels = np.repeat(np.arange(columns * rows), len(inside))
        self._starts, self._along = self.camera.rays(pixels, np.tile(inside, (columns * rows, 1)))
        down = self._along[:, 2] < -1e-6
        far = np.where(down, -self._starts[:, 2] / np.where(down, self._along[:, 2], -1.0), np.inf)
        place = np.where(down[:, None], self._starts[:, :2] + 0.0, 0.0)
        place = place + np.where(down, far, 0.0)[:, None] * self._along[:, :2]
        self._ground = place
        self._shown = np.where(down, ground_share(np.linalg.norm(place, axis=1)), 0.0)
        self._distance = np.where(self._shown > 0.0, far, np.inf)
        height = np.repeat((np.arange(rows) + 0.5) / rows, columns * len(inside))[:, None]
        self._back = height * _BACK_RGB[0] + (1.0 - height) * _BACK_RGB[1]

    def draw(
        self,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
        colour: tuple[float, float, float],
        irradiance: Float[np.ndarray, "n n 3"],
        lamp: SphereLight | None = None,
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Pixels of a frame.

        Parameters
        ----------
        vertices, faces
            The object in the world.
        colour
            Its albedo.
        irradiance
            At receivers `shading.plane(GROUND, n)`.
        lamp
            Local light.
        """
        ground = np.clip(_bilinear(irradiance, self._ground), 0.0, None) * GROUND_RGB / np.pi
        factor = _EXPOSED / luminance(open_ground() * GROUND_RGB / np.pi)
        shown = self._shown[:, None]
        linear = factor * ground * shown + (1.0 - shown) * self._back
        rays = Rays(vertices, faces)
        face = rays.face(self._starts, self._along)
        hit = np.flatnonzero(face >= 0)
        found, far = _seen(
            vertices, faces, face[hit], self._starts[hit], self._along[hit],
            lit(rays, vertices, faces, lamp),
        )  # fmt: skip
        nearer = far < self._distance[hit]
        hit, far = hit[nearer], far[nearer]
        linear[hit] = factor * found[nearer] * colour / np.pi
        if lamp is not None:
            distance = np.minimum(self._distance, np.inf)
            distance[hit] = far
            bulb = _on_sphere(self._starts, self._along, lamp) < distance
            radiance = np.asarray(lamp.radiance, np.float64)
            linear[bulb] = 5.0 * radiance / radiance.max()
        return self._developed(linear)

    def _developed(self, linear: np.ndarray) -> np.ndarray:
        """Tone curve, mean over the samples of a pixel, sRGB."""
        rows, columns = self.camera.shape
        toned = tones.tone(linear, 1.0, _WHITE).reshape(rows * columns, -1, 3).mean(1)
        return np.round(255.0 * tones.encode(toned)).astype(np.uint8).reshape(rows, columns, 3)


def lit(
    rays: Rays,
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    lamp: SphereLight | None = None,
    *,
    sky: Callable[[np.ndarray], np.ndarray] = animations.sky,
    directions: tuple[int, int] = (_POLAR, _AZIMUTHAL),
) -> Float[np.ndarray, "2 V 3"]:
    """Irradiance of an object's vertices, on the front and on the back of its faces.

    Parameters
    ----------
    rays
        Of the object.
    vertices, faces
        In the world.
    lamp
        Local light.
    sky
        Radiance of directions [n, 3], linear RGB.
    directions
        To the sky, over the polar angle and the azimuth.
    """
    normals = vertex_normals(vertices, faces)
    above, weights = harmonics.hemisphere_rule(*directions)
    light = sky(above) * weights[:, None]
    total = np.empty((2, len(vertices), 3))
    for k, side in enumerate((1.0, -1.0)):
        facing = np.clip(side * normals @ above.T, 0.0, None)
        vertex, direction = np.nonzero(facing)
        starts = vertices[vertex] + side * _OFFSET * normals[vertex]
        clear = ~rays.blocked(starts, above[direction])
        facing[vertex, direction] *= clear
        total[k] = facing @ light
        # The ground sends some of its light back.
        below = 0.5 * (1.0 - side * normals[:, 2, None])
        total[k] += below * open_ground() * GROUND_RGB
        if lamp is not None:
            total[k] += _from_lamp(rays, vertices, side * normals, lamp)
    return total


def vertex_normals(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]
) -> Float[np.ndarray, "V 3"]:
    """Unit normals: means over the faces around, weighted by area; 0 where there is none."""
    corners = vertices[faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = np.zeros((len(vertices), 3))
    for corner in faces.T:
        for axis in range(3):
            total[:, axis] += np.bincount(corner, across[:, axis], len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return total / np.where(length > 0.0, length, 1.0)


def _from_lamp(
    rays: Rays, vertices: np.ndarray, normals: np.ndarray, lamp: SphereLight
) -> np.ndarray:
    """Irradiance from the lamp, by rays to a few points of it."""
    centre, radius = np.asarray(lamp.centre, np.float64), float(lamp.radius)
    axis = np.concatenate([np.eye(3), -np.eye(3)])[:_LAMP_POINTS]
    total = np.zeros(len(vertices))
    for point in centre + 0.7 * radius * axis:
        to = point - vertices
        distance = np.linalg.norm(to, axis=1)
        to = to / distance[:, None]
        cosine = np.clip((normals * to).sum(1), 0.0, None)
        facing = np.flatnonzero(cosine)
        starts = vertices[facing] + _OFFSET * normals[facing]
        cosine[facing] *= ~rays.blocked(starts, to[facing])
        total += cosine * np.pi * (radius / distance) ** 2
    return (total / len(axis))[:, None] * np.asarray(lamp.radiance, np.float64)


def _seen(
    vertices: np.ndarray,
    faces: np.ndarray,
    face: np.ndarray,
    starts: np.ndarray,
    along: np.ndarray,
    values: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Values of vertices, interpolated where rays meet faces, and distances."""
    corners = vertices[faces[face]]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(a, b)
    towards = (normal * along).sum(1)
    towards = np.where(np.abs(towards) > 1e-15, towards, 1e-15)
    far = ((corners[:, 0] - starts) * normal).sum(1) / towards
    point = starts + far[:, None] * along - corners[:, 0]
    square = np.maximum((normal**2).sum(1), 1e-30)
    u = (np.cross(point, b) * normal).sum(1) / square
    v = (np.cross(a, point) * normal).sum(1) / square
    shares = np.clip(np.stack([1.0 - u - v, u, v], -1), 0.0, 1.0)
    shares /= shares.sum(1, keepdims=True)
    side = (towards > 0.0).astype(int)
    return (values[side[:, None], faces[face]] * shares[..., None]).sum(1), far


def _on_sphere(starts: np.ndarray, along: np.ndarray, lamp: SphereLight) -> np.ndarray:
    """Distance to the lamp along rays, infinite beside it."""
    to = np.asarray(lamp.centre, np.float64) - starts
    middle = (to * along).sum(1)
    rest = float(lamp.radius) ** 2 - ((to * to).sum(1) - middle**2)
    return np.where((rest > 0.0) & (middle > 0.0), middle - np.sqrt(np.maximum(rest, 0.0)), np.inf)


def _bilinear(grid: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Values at [n, 2] on the ground, of a grid of receivers."""
    count = grid.shape[0]
    at = (place / animations.GROUND + 0.5) * count - 0.5
    at = np.clip(at, 0.0, count - 1.0)
    low = np.clip(at.astype(int), 0, max(count - 2, 0))
    (x, y), (i, j) = (at - low).T[..., None], low.T
    i_, j_ = np.minimum(i + 1, count - 1), np.minimum(j + 1, count - 1)
    lower = (1.0 - x) * grid[i, j] + x * grid[i_, j]
    upper = (1.0 - x) * grid[i, j_] + x * grid[i_, j_]
    return (1.0 - y) * lower + y * upper


def ground_share(distance: Any) -> Any:
    """Share of the ground, before what is behind it, at distances from its middle.

    Parameters
    ----------
    distance
        Array of NumPy or JAX.
    """
    share = ((distance / (0.5 * animations.GROUND) - _FADE) / (1.0 - _FADE)).clip(0.0, 1.0)
    return 1.0 - share * share * (3.0 - 2.0 * share)


@functools.cache
def open_ground() -> np.ndarray:
    """Irradiance of the ground under the sky of `diffopt.shadows.animations` alone, [3]."""
    above, weights = harmonics.hemisphere_rule(48, 96)
    return (weights * above[:, 2]) @ animations.sky(above)


def luminance(rgb: np.ndarray) -> float:
    """Of linear RGB with the primaries of sRGB."""
    return float(rgb @ [0.2126, 0.7152, 0.0722])
