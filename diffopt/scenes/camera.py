"""Pinhole cameras: from pixels to rays."""

import dataclasses
import math
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from diffopt.errors import InputError
from diffopt.scenes import transforms


@dataclasses.dataclass(frozen=True)
class Camera:
    """Pinhole camera; z is up in the world unless said otherwise.

    Parameters
    ----------
    eye, target
        Its place, and the point in the middle of the picture, [3].
    up
        Direction that is upright in the picture.
    resolution
        Columns and rows of pixels.
    field_of_view
        Angle across the shorter side of the picture, degrees.
    """

    eye: tuple[float, float, float] = (0.0, -4.0, 0.0)
    target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    resolution: tuple[int, int] = (320, 240)
    field_of_view: float = 40.0

    def __post_init__(self) -> None:
        """Check everything, and that the picture has an upright."""
        for name in ("eye", "target", "up"):
            found = tuple(transforms.vector(name, getattr(self, name)).tolist())
            object.__setattr__(self, name, found)
        size = tuple(self.resolution) if np.ndim(self.resolution) == 1 else ()
        if len(size) != 2 or any(int(n) != n or n < 1 for n in size):
            raise InputError(
                f"resolution must be columns and rows, at least 1; received {self.resolution}"
            )
        object.__setattr__(self, "resolution", (int(size[0]), int(size[1])))
        if not 0.0 < self.field_of_view < 180.0:
            raise InputError(
                f"field_of_view must be above 0 and below 180 degrees; received "
                f"{self.field_of_view:g}"
            )
        self.matrix  # noqa: B018  raises for an impossible upright

    @property
    def matrix(self) -> transforms.Matrix:
        """Places the camera: x to the right of the picture, y up, z backwards."""
        away = 2.0 * np.array(self.eye) - np.array(self.target)
        return transforms.facing(self.eye, away, self.up)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.resolution[1], self.resolution[0]

    def rays(
        self, pixel: Int[np.ndarray, " n"], inside: Any = 0.5
    ) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Origins and unit directions of rays through pixels.

        Parameters
        ----------
        pixel
            Numbers of pixels, row by row from the top left.
        inside
            Where in the pixel, [n, 2] or one number, (0, 0) its top left corner.
        """
        columns, rows = self.resolution
        place = np.stack([pixel % columns, pixel // columns], axis=-1) + inside
        half = math.tan(math.radians(0.5 * self.field_of_view)) / (0.5 * min(self.resolution))
        x = (place[:, 0] - 0.5 * columns) * half
        y = (0.5 * rows - place[:, 1]) * half
        matrix = self.matrix
        along = x[:, None] * matrix[:3, 0] + y[:, None] * matrix[:3, 1] - matrix[:3, 2]
        along /= np.linalg.norm(along, axis=-1, keepdims=True)
        return np.broadcast_to(matrix[:3, 3], along.shape), along
