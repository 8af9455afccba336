"""What a user may change while looking: declared once, checked wherever a value comes from."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

from diffopt import checks
from diffopt.errors import InputError

#: Values of controls by their names.
Values = Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Slider:
    """A number in a range.

    Attributes
    ----------
    name, label
        In programs, and for the user with its unit.
    least, most, step
        Of the value.
    value
        At first.
    hint
        One sentence.
    """

    name: str
    label: str
    least: float
    most: float
    step: float
    value: float
    hint: str = ""

    def checked(self, value: Any) -> float:
        """A value within the range; `InputError` for any other."""
        good = isinstance(value, int | float) and not isinstance(value, bool)
        slack = 1e-9 * (self.most - self.least)
        if (
            not good
            or not math.isfinite(value)
            or not self.least - slack <= value <= self.most + slack
        ):
            raise InputError(
                f"{self.name} must be a number from {self.least:g} to {self.most:g}; "
                f"received {value!r}"
            )
        return float(value)


@dataclasses.dataclass(frozen=True)
class Steps:
    """One number of several, from the largest to the smallest: a slider of few places.

    Attributes
    ----------
    name, label, hint
        As of `Slider`.
    options
        Numbers.
    value
        One of them.
    """

    name: str
    label: str
    options: tuple[float, ...]
    value: float
    hint: str = ""

    def checked(self, value: Any) -> float:
        """The option that a value is; `InputError` where it is none."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            for option in self.options:
                if math.isclose(option, value, rel_tol=1e-9):
                    return option
        known = ", ".join(f"{option:g}" for option in self.options)
        raise InputError(f"{self.name} must be one of {known}; received {value!r}")


@dataclasses.dataclass(frozen=True)
class Menu:
    """One word of several; attributes as of `Steps`."""

    name: str
    label: str
    options: tuple[str, ...]
    value: str
    hint: str = ""

    def checked(self, value: Any) -> str:
        """The value, which must be one of the options."""
        return checks.choice(self.name, value, self.options)


@dataclasses.dataclass(frozen=True)
class Toggle:
    """Yes or no; attributes as of `Slider`."""

    name: str
    label: str
    value: bool
    hint: str = ""

    def checked(self, value: Any) -> bool:
        """The value, which must be True or False."""
        if not isinstance(value, bool):
            raise InputError(f"{self.name} must be True or False; received {value!r}")
        return value


Control = Slider | Steps | Menu | Toggle


def initial(controls: Sequence[Control]) -> dict[str, Any]:
    """Values at first."""
    return {control.name: control.value for control in controls}


def changed(controls: Sequence[Control], values: Values, name: str, value: Any) -> dict[str, Any]:
    """Values with one of them replaced.

    Raises
    ------
    InputError
        For a name that no control has, or a value that its control does not take.
    """
    for control in controls:
        if control.name == name:
            return {**values, name: control.checked(value)}
    known = [control.name for control in controls]
    raise InputError(f"control must be one of {', '.join(known)}; received {name!r}")


def light_sliders(azimuth: float, elevation: float, least: float = 2.0) -> tuple[Slider, Slider]:
    """Where a light stands, degrees."""
    return (
        Slider("azimuth", "light azimuth (°)", -180.0, 180.0, 1.0, azimuth),
        Slider("elevation", "light elevation (°)", least, 90.0, 1.0, elevation),
    )


def light_direction(values: Values, axis: int = 2) -> tuple[float, float, float]:
    """Unit vector to the light of `light_sliders`, about an axis of the world that is up."""
    azimuth, elevation = math.radians(values["azimuth"]), math.radians(values["elevation"])
    flat = math.cos(elevation)
    found = [0.0, 0.0, 0.0]
    found[(axis + 1) % 3] = flat * math.cos(azimuth)
    found[(axis + 2) % 3] = flat * math.sin(azimuth)
    found[axis] = math.sin(elevation)
    return found[0], found[1], found[2]
