"""Polar plots about the normal: 0 degrees at the top, linear and logarithmic side by side.

Positive angles are drawn on the left, as everywhere in the toolkit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

#: Decades of the logarithmic plot, at least and at most.
DECADES = (2, 4)


@dataclass(frozen=True)
class Curve:
    """A line of a polar plot.

    Attributes
    ----------
    at
        Angles, radians, ascending, [N].
    values
        At them, [N]; what is below the scale is drawn at its end.
    colour
        As matplotlib writes it.
    label
        In the legend; none if empty.
    mark
        Angle of a dotted line from the middle, radians: where the light or the viewer stands.
    width, style
        Of the line.
    """

    at: np.ndarray
    values: np.ndarray
    colour: str
    label: str = ""
    mark: float | None = None
    width: float = 1.4
    style: str = "-"


def plot(
    curves: Sequence[Curve],
    titles: tuple[str, str],
    *,
    whole: bool = False,
    relative: bool = False,
) -> "Figure":
    """Curves over the angle to the normal, linear on the left and logarithmic on the right.

    Parameters
    ----------
    curves
        At least one.
    titles
        Of the two plots.
    whole
        The full circle; else the upper half, -90 to 90 degrees.
    relative
        Each curve over its own peak, in the linear plot.
    """
    from matplotlib.figure import Figure

    labels = [curve.label for curve in curves if curve.label]
    lines = -(-len(labels) // 3)
    # Matplotlib centres a half disc in the square of the whole one, whose empty quarters lie
    # under the titles and the legend.
    side, foot = (2.3, 0.25) if whole else (2.6, -0.42)
    width, foot = 6.6, foot + 0.2 * lines + 0.1
    height = foot + side + (0.62 if whole else -0.02)
    figure = Figure(figsize=(width, height))
    high = max(float(curve.values.max()) for curve in curves)
    high = high if high > 0.0 else 1.0
    top = math.ceil(math.log10(high) - 1e-6)
    low = top - _decades(curves, high, top)
    for k, title in enumerate(titles):
        left = (k + 0.5) * width / 2.0 - side / 2.0
        box = (left / width, foot / height, side / width, side / height)
        axes: PolarAxes = figure.add_axes(box, projection="polar")  # type: ignore[assignment]
        end = float(top - low) if k else (1.0 if relative else 1.05 * high)
        for curve in curves:
            values = np.maximum(curve.values, 0.0)
            if k:
                values = np.log10(np.maximum(values, 10.0**low)) - low
            elif relative:
                values = values / (float(values.max()) or 1.0)
            shade, label = curve.colour, curve.label or None
            axes.plot(curve.at, values, curve.style, lw=curve.width, label=label, color=shade)
            if curve.mark is not None:
                axes.plot([curve.mark] * 2, [0.0, end], ":", lw=1.0, color=shade)
        _frame(axes, end, low if k else None, whole)
        figure.text((k + 0.5) / 2.0, 1.0 - 0.22 / height, title, ha="center", fontsize=9)
    handles, words = figure.axes[0].get_legend_handles_labels()
    if words:
        figure.legend(
            handles, words, loc="lower center", ncols=min(3, len(words)), frameon=False, fontsize=8
        )
    return figure


def _decades(curves: Sequence[Curve], high: float, top: int) -> int:
    """Decades down to the smallest value that is not 0, within `DECADES`."""
    positive = [curve.values[curve.values > 0.0] for curve in curves]
    least = min((float(values.min()) for values in positive if len(values)), default=high)
    return int(np.clip(top - math.floor(math.log10(least)), *DECADES))


def _frame(axes: "PolarAxes", end: float, low: int | None, whole: bool) -> None:
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    axes.set_theta_zero_location("N")
    ticks = np.arange(0, 360, 30) if whole else np.arange(-90, 91, 30)
    words = [f"{t if t <= 180 else t - 360}°".replace("-", "−") for t in ticks]
    axes.set_xticks(np.radians(ticks), words)
    if not whole:
        axes.set(thetamin=-90.0, thetamax=90.0)
    axes.set_axisbelow(True)
    axes.tick_params(axis="x", labelsize=7, pad=0 if whole else 2)
    axes.tick_params(axis="y", labelsize=6)
    if whole:
        axes.set_rlabel_position(105.0)
        axes.plot([-0.5 * math.pi, 0.5 * math.pi], [end, end], color="0.3", lw=0.8)
    rings = range(int(end) + 1) if low is not None else MaxNLocator(4).tick_values(0.0, end)[1:-1]
    axes.set(rlim=(0.0, end), rticks=list(rings))
    if low is not None:
        decades = FuncFormatter(lambda r, _: f"$10^{{{round(r) + low}}}$")
        axes.yaxis.set_major_formatter(decades)
