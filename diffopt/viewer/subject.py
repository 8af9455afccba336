"""What can be looked at: the interface between a scene that is computed and whoever shows it."""

import dataclasses
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from diffopt.scenes.camera import Camera
from diffopt.viewer.controls import Control, Values


class StaleError(Exception):
    """A frame was given up, as something changed while it was drawn."""


class Place(NamedTuple):
    """From where a subject is looked at first.

    Attributes
    ----------
    eye, target, up
        Of the camera, [3].
    field_of_view
        From bottom to top, degrees.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    field_of_view: float = 35.0


class Row(NamedTuple):
    """A line of the table beside the picture.

    Attributes
    ----------
    effect
        Of light, or what is computed.
    included
        Whether it is in.
    because
        Why, with a number where there is one.
    settings
        At which it is computed.
    """

    effect: str
    included: bool
    because: str
    settings: str = ""


class Coloured(NamedTuple):
    """A mesh with the colours of its vertices.

    Attributes
    ----------
    vertices, faces
        [V, 3] and [F, 3].
    colours
        Codes of sRGB, [V, 3].
    """

    vertices: Float[ndarray, "V 3"]
    faces: Int[ndarray, "F 3"]
    colours: UInt8[ndarray, "V 3"]


@dataclasses.dataclass(frozen=True)
class Look:
    """All that a frame depends on beside what was built for it.

    Attributes
    ----------
    values
        Of the controls.
    camera
        Its resolution is that of the frame.
    take
        Number of the frame since anything changed: takes differ in where pixels are sampled, and
        in random numbers. A mean over them has smooth edges and less noise.
    inside
        Where in its pixel each ray goes, (0, 0) the top left corner.
    clock
        Seconds, for what moves.
    memory
        Of this viewer alone: a subject keeps there what changes from frame to frame.
    stale
        Whether the frame is wanted no longer; one that takes long asks now and then, and raises
        `StaleError`.
    """

    values: Values
    camera: Camera
    take: int = 0
    inside: tuple[float, float] = (0.5, 0.5)
    clock: float = 0.0
    memory: dict[str, Any] = dataclasses.field(default_factory=dict)
    stale: Callable[[], bool] = lambda: False


@runtime_checkable
class Subject(Protocol):
    """Something to look at.

    Attributes
    ----------
    title
        One line.
    controls
        What may be changed.
    place
        Of the camera at first.
    takes
        Frames that are averaged when nothing changes.
    averages
        Whether a frame is the mean over the takes so far already.
    """

    title: str
    controls: Sequence[Control]
    place: Place
    takes: int
    averages: bool

    def moves(self, values: Values) -> bool:
        """Whether frames change by themselves."""
        ...

    def wanted(self, values: Values, built: Mapping[str, Any]) -> dict[str, Hashable]:
        """What frames of these values are made from: a key for each name, in order.

        What takes long, tables and programs, is built once for a key, in the background.
        """
        ...

    def build(self, name: str, key: Any) -> Any:
        """Make what is wanted; anything that a frame will run is compiled by it."""
        ...

    def pixels(self, built: Mapping[str, Any], look: Look) -> UInt8[ndarray, "h w 3"]:
        """A frame, codes of sRGB."""
        ...

    def rows(self, built: Mapping[str, Any], look: Look) -> list[Row]:
        """The table beside the picture: what is in it, what is out, and why."""
        ...


@runtime_checkable
class Meshed(Subject, Protocol):
    """A subject that can be drawn as a mesh with coloured vertices, too.

    Attributes
    ----------
    turns
        Whether the colours change with the camera.
    """

    turns: bool

    def colours(self, built: Mapping[str, Any], look: Look) -> Coloured:
        """A frame as a mesh."""
        ...
