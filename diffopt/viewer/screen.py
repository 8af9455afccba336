"""What a session knows of its viewer: where frames go, what they took, the camera it tells."""

from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from diffopt.errors import InputError
from diffopt.scenes.camera import Camera
from diffopt.viewer.subject import Coloured, Row

#: How a frame reaches the viewer.
PIXELS, VERTICES = "pixels", "vertices"


class GoneError(Exception):
    """The viewer is there no longer."""


class Times(NamedTuple):
    """What a frame took.

    Attributes
    ----------
    way
        `PIXELS` or `VERTICES`.
    drawn
        Seconds until it was computed.
    shown
        Seconds from there until the viewer had it.
    size
        Columns and rows, or vertices.
    rate
        Frames per second, over the last ones.
    """

    way: str
    drawn: float
    shown: float
    size: tuple[int, ...]
    rate: float


@runtime_checkable
class Screen(Protocol):
    """Where frames are shown; all raise `GoneError` when there is nobody to see them."""

    def show(self, pixels: UInt8[np.ndarray, "h w 3"]) -> None:
        """A picture; returns when the viewer has it."""
        ...

    def colour(self, found: Coloured | None) -> None:
        """A mesh in place of a picture, None for the last one; returns when the viewer has it."""
        ...

    def tell(self, rows: list[Row], times: Times | None, status: str) -> None:
        """The table beside it."""
        ...


def valid_camera(eye: Any, axes: Any, field_of_view: float, resolution: tuple[int, int]) -> Camera:
    """A camera as browsers tell it.

    Parameters
    ----------
    eye
        [3].
    axes
        Its axes as columns: right, down, forwards, [3, 3].
    field_of_view
        From bottom to top, radians.
    resolution
        Columns and rows.

    Raises
    ------
    InputError
        If a number is not finite, or the picture has no pixels.
    """
    eye, axes = np.asarray(eye, np.float64), np.asarray(axes, np.float64)
    if not (np.isfinite(eye).all() and np.isfinite(axes).all() and np.isfinite(field_of_view)):
        raise InputError(f"camera must be finite; received an eye of {eye.tolist()}")
    columns, rows = resolution
    # Ours is across the shorter side.
    slope = np.tan(0.5 * np.clip(field_of_view, 0.02, 2.9)) * min(columns / rows, 1.0)
    target = eye + axes[:, 2]
    return Camera(
        tuple(eye.tolist()),
        tuple(target.tolist()),
        tuple((-axes[:, 1]).tolist()),
        (columns, rows),
        float(np.degrees(2.0 * np.arctan(slope))),
    )
