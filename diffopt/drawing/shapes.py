"""Curved surfaces under a camera: the local frame of the material at every sample of a picture.

Plain NumPy geometry in float64, ray against closed form; lengths in any one unit, because
only directions leave this module. The material's x axis is the tangent, z the normal.
"""

import dataclasses
import math

import numpy as np
from jaxtyping import Bool, Float

from diffopt.errors import InputError

Vectors = Float[np.ndarray, "h w 3"]
#: Samples on a side of a square picture, or rows and columns.
Size = int | tuple[int, int]

# Compact disc, radii in mm (IEC 60908: hole 15 mm, recorded area up to 116 mm, disc 120 mm in
# diameter; the lead-in starts at 46 mm, the mirror band around it inside).
HOLE_RADIUS, RECORDED_RADII, DISC_RADIUS = 7.5, (22.0, 58.0), 60.0


@dataclasses.dataclass(frozen=True)
class View:
    """What the samples of a picture see; rows run down the picture.

    Attributes
    ----------
    position
        Points on the surface, [h, w, 3].
    tangent, normal
        Unit vectors of the material's x and z axes in the world, [h, w, 3]; y is
        normal x tangent.
    eye
        Unit vectors from the points to the camera, [h, w, 3].
    covered
        Whether the sample sees the material's front; elsewhere the vectors mean nothing.
    neutral
        Whether it sees a part of the body without the material (the hub of a disc).
    """

    position: Vectors
    tangent: Vectors
    normal: Vectors
    eye: Vectors
    covered: Bool[np.ndarray, "h w"]
    neutral: Bool[np.ndarray, "h w"]

    def local(self, world: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
        """Directions in the material's frame, [h, w, 3], from world vectors [h, w, 3] or [3]."""
        axes = (self.tangent, np.cross(self.normal, self.tangent), self.normal)
        return np.stack([(axis * world).sum(-1) for axis in axes], axis=-1)

    def towards(self, point: Float[np.ndarray, "3"]) -> Vectors:
        """Unit vectors from the surface to a point, [h, w, 3]."""
        return unit(np.asarray(point, np.float64) - self.position)

    def rows(self, part: slice) -> "View":
        """Some rows of the picture."""
        fields = ("position", "tangent", "normal", "eye", "covered", "neutral")
        return View(*(getattr(self, name)[part] for name in fields))

    def turned(self, angle: float) -> "View":
        """The same with the material turned about the normal.

        The material's direction at `angle` from its x axis (radians, towards y) then lies where
        the x axis was.
        """
        across = np.cross(self.normal, self.tangent)
        tangent = math.cos(angle) * self.tangent - math.sin(angle) * across
        return dataclasses.replace(self, tangent=tangent)


def unit(vectors: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """Vectors divided by their lengths."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def sphere(size: Size, *, margin: float = 0.04, rows: slice | None = None) -> View:
    """Unit sphere seen along -z by an orthographic camera.

    The tangent runs along the parallels about the vertical axis; there is no tangent at the
    two poles, which are not covered.

    Parameters
    ----------
    size
        Samples on a side, or (rows, columns): the object then fits the shorter side.
    margin
        Empty border, as a share of the radius.
    rows
        Of the picture; all of them if left out.
    """
    x, y = _screen(size, 1.0 + margin, rows)
    r2 = x * x + y * y
    z = np.sqrt(np.maximum(1.0 - r2, 0.0))
    normal = np.stack([x, y, z], axis=-1)
    across = np.hypot(x, z)
    covered = (r2 < 1.0) & (across > 1e-9)
    safe = np.where(covered, across, 1.0)
    tangent = np.stack([z / safe, np.zeros_like(x), -x / safe], axis=-1)
    eye = np.broadcast_to([0.0, 0.0, 1.0], normal.shape)
    return View(normal, tangent, normal, eye, covered, np.zeros_like(covered))


def sheet(
    size: Size,
    *,
    bend_deg: float = 100.0,
    width: float = 1.0,
    eye: tuple[float, float, float] = (1.2, 1.9, 3.5),
    rows: slice | None = None,
) -> View:
    """Sheet of unit radius bent about the horizontal x axis, seen by a near camera.

    The sheet is part of the cylinder y^2 + z^2 = 1, convex towards the camera; the material's
    x axis runs along the bend (in the direction of curvature), its y axis along -x.

    Parameters
    ----------
    size
        Samples on a side, or (rows, columns): the object then fits the shorter side.
    bend_deg
        Angle of the arc, degrees, above 0 and at most 180.
    width
        Half the length along the axis, in radii.
    eye
        Camera position; it looks at the middle of the sheet.
    rows
        Of the picture; all of them if left out.
    """
    if not 0.0 < bend_deg <= 180.0:
        raise InputError(f"bend_deg={bend_deg:g}: expected degrees above 0, at most 180")
    # The middle of the arc looks half way up, so that the camera and a light above share it.
    middle = np.radians(60.0)
    target = np.array([0.0, np.sin(middle) - 0.28, np.cos(middle) - 0.16])
    origin, rays = camera(size, np.array(eye), target, half_width=1.28 * width, rows=rows)
    # Nearest crossing of origin + t ray with y^2 + z^2 = 1.
    a = (rays[..., 1:] ** 2).sum(-1)
    b = (rays[..., 1:] * origin[1:]).sum(-1)
    c = (origin[1:] ** 2).sum() - 1.0
    root = b * b - a * c
    t = (-b - np.sqrt(np.maximum(root, 0.0))) / np.maximum(a, 1e-12)
    position = origin + t[..., None] * rays
    angle = np.arctan2(position[..., 1], position[..., 2])
    on_sheet = (np.abs(position[..., 0]) <= width) & (
        np.abs(angle - middle) <= np.radians(0.5 * bend_deg)
    )
    covered = (root > 0.0) & (t > 0.0) & on_sheet
    zero = np.zeros_like(angle)
    normal = np.stack([zero, np.sin(angle), np.cos(angle)], axis=-1)
    tangent = np.stack([zero, np.cos(angle), -np.sin(angle)], axis=-1)
    return View(position, tangent, normal, -rays, covered, np.zeros_like(covered))


def disc(
    size: Size,
    *,
    eye: tuple[float, float, float] = (0.0, -190.0, 260.0),
    recorded: tuple[float, float] = RECORDED_RADII,
    rows: slice | None = None,
) -> View:
    """Compact disc in the plane z = 0, in mm, seen by a near camera.

    The material's x axis is radial, so that tracks, which run along its y axis, are
    concentric circles. The hub and the rim are `neutral`, the hole is empty.

    Parameters
    ----------
    size
        Samples on a side, or (rows, columns): the object then fits the shorter side.
    eye
        Camera position, above the plane; it looks at the hole.
    recorded
        Inner and outer radius of the recorded area.
    rows
        Of the picture; all of them if left out.
    """
    if not eye[2] > 0.0:
        raise InputError(f"eye={eye}: expected a camera above the disc, z > 0")
    origin, rays = camera(
        size, np.array(eye), np.array([0.0, -3.0, 0.0]), half_width=1.08 * DISC_RADIUS, rows=rows
    )
    down = np.minimum(rays[..., 2], -1e-9)
    position = origin - (origin[2] / down)[..., None] * rays
    radius = np.hypot(position[..., 0], position[..., 1])
    hit = rays[..., 2] < 0.0
    inside = hit & (radius >= HOLE_RADIUS) & (radius <= DISC_RADIUS)
    covered = inside & (radius >= recorded[0]) & (radius <= recorded[1])
    safe = np.maximum(radius, 1e-9)[..., None]
    tangent = position * [1.0, 1.0, 0.0] / safe
    normal = np.broadcast_to([0.0, 0.0, 1.0], position.shape)
    return View(position, tangent, normal, -rays, covered, inside & ~covered)


def axes(
    eye: Float[np.ndarray, "3"],
    target: Float[np.ndarray, "3"],
    up: Float[np.ndarray, "3"],
) -> Float[np.ndarray, "3 3"]:
    """Unit vectors of a camera in the world: to the right, up, and back to the viewer.

    Raises
    ------
    InputError
        If the camera is at its target, or looks along `up`.
    """
    back = np.asarray(eye, np.float64) - target
    right = np.cross(up, back)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(back) * np.linalg.norm(up):
        raise InputError(
            f"a camera at {_words(eye)} that looks at {_words(target)} with {_words(up)} upwards: "
            "expected different places, and not the upward direction between them"
        )
    right, back = unit(right), unit(back)
    return np.stack([right, np.cross(back, right), back])


def camera(
    size: Size,
    eye: Float[np.ndarray, "3"],
    target: Float[np.ndarray, "3"],
    *,
    half_width: float,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
    rows: slice | None = None,
) -> tuple[Float[np.ndarray, "3"], Vectors]:
    """Pinhole camera: its position and the unit rays through the samples.

    Parameters
    ----------
    size
        Samples on a side, or (rows, columns).
    eye, target
        Position, and the point in the middle of the picture.
    half_width
        Half the shorter side of the picture at the target.
    up
        Direction that is upright in the picture.
    rows
        Of the picture; all of them if left out.

    Raises
    ------
    InputError
        See `axes`.
    """
    x, y = _screen(size, half_width, rows)
    right, above, back = axes(eye, target, np.array(up))
    distance = float(np.linalg.norm(eye - target))
    rays = x[..., None] * right + y[..., None] * above - distance * back
    return eye.astype(np.float64), unit(rays)


def _screen(
    size: Size, half: float, part: slice | None
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Coordinates x (to the right) and y (up) of the samples' centres in some rows, or in all."""
    rows, columns = (size, size) if isinstance(size, int) else size
    shorter = min(rows, columns)
    if shorter < 2:
        raise InputError(f"size={size}: expected at least 2 samples on a side")
    across, down = (
        ((np.arange(count) + 0.5) / count * 2.0 - 1.0) * (half * count / shorter)
        for count in (columns, rows)
    )
    x, y = np.meshgrid(across, -down if part is None else -down[part])
    return x, y


def _words(vector: np.ndarray) -> str:
    return ",".join(f"{value:g}" for value in vector)
