"""One set of parameters for each surface: several describe the same heights.

Conventions: depth and amplitude above 0 (a disc's depth keeps its sign: pits or bumps);
shift in [0, 1); phase in (-pi, pi]; angle in (-pi/2, pi/2], of blazed gratings, whose teeth
have a direction, in (-pi, pi].
"""

import math

import numpy as np

from diffopt.fitting.scans.disc import Pits
from diffopt.gratings import Binary, Blazed, Grating, Parametric, Sinusoidal, Trapezoid


def canonical(grating: Parametric) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Values that follow the conventions, and their derivatives to the given ones.

    Derivatives are given where they differ from those of an unchanged parameter.
    """
    values = {name: float(grating.get(name)) for name in grating.PARAMETERS}
    change: dict[str, dict[str, float]] = {}

    def apply(new: dict[str, dict[str, float]]) -> None:
        old = {name: change.get(name, {name: 1.0}) for name in values}
        for name, row in new.items():
            total: dict[str, float] = {}
            for part, factor in row.items():
                for origin, slope in old[part].items():
                    total[origin] = total.get(origin, 0.0) + factor * slope
            change[name] = total

    if isinstance(grating, Sinusoidal) and values["amplitude"] < 0:
        values["amplitude"] *= -1.0
        values["phase"] += math.pi
        apply({"amplitude": {"amplitude": -1.0}})
    if isinstance(grating, Blazed) and values["depth"] < 0:
        values["offset"] += values["depth"]
        values["depth"] *= -1.0
        values["shift"] *= -1.0
        values["angle"] += math.pi
        apply(
            {
                "offset": {"offset": 1.0, "depth": 1.0},
                "depth": {"depth": -1.0},
                "shift": {"shift": -1.0},
            }
        )
    if isinstance(grating, Binary | Trapezoid) and values["depth"] < 0:
        values["offset"] += values["depth"]
        values["depth"] *= -1.0
        values["shift"] += values["duty"]
        values["duty"] = 1.0 - values["duty"]
        apply(
            {
                "offset": {"offset": 1.0, "depth": 1.0},
                "depth": {"depth": -1.0},
                "shift": {"shift": 1.0, "duty": 1.0},
                "duty": {"duty": -1.0},
            }
        )
    if "angle" in values:
        values["angle"] = _wrapped(values["angle"], 2.0 * math.pi)
        if not isinstance(grating, Blazed) and not -math.pi / 2 < values["angle"] <= math.pi / 2:
            values["angle"] = _wrapped(values["angle"] + math.pi, 2.0 * math.pi)
            if isinstance(grating, Sinusoidal):
                values["phase"] *= -1.0
                apply({"phase": {"phase": -1.0}})
            elif isinstance(grating, Pits):
                values["shift"] *= -1.0
                apply({"shift": {"shift": -1.0}})
            elif isinstance(grating, Grating):
                values["shift"] = -values["shift"] - values.get("duty", 0.0)
                apply({"shift": {"shift": -1.0} | ({"duty": -1.0} if "duty" in values else {})})
    if "phase" in values:
        values["phase"] = _wrapped(values["phase"], 2.0 * math.pi)
    if "shift" in values:
        values["shift"] -= math.floor(values["shift"])
    return values, change


def _wrapped(value: float, turn: float) -> float:
    """Value in (-turn / 2, turn / 2]."""
    return -((-value + turn / 2) % turn - turn / 2)


def transformed(
    covariance: np.ndarray, names: tuple[str, ...], change: dict[str, dict[str, float]]
) -> np.ndarray:
    """Covariance of `names` after a change of them; offsets are not among them."""
    matrix = np.eye(len(names))
    for k, name in enumerate(names):
        if name in change:
            matrix[k] = [change[name].get(other, 0.0) for other in names]
    return matrix @ covariance @ matrix.T
