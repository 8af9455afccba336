"""Cards of heightfields: map, profile through the middle, figures of roughness."""

import math
from typing import TYPE_CHECKING

import numpy as np

from diffopt.drawing import pictures
from diffopt.heightfield import Heightfield
from diffopt.previews import markup
from diffopt.previews.bundles import NoCardError
from diffopt.statistics import surface_statistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Pixels of a map on an axis, at most: larger ones are drawn as means over blocks.
DRAWN = 192
#: Pixels on an axis for which the spectrum is computed; of larger maps, of the middle.
ANALYSED = 512
#: Samples of the profile.
PROFILE = 400
# Steps of history, and letters of each, that a card has room for.
_STEPS, _LETTERS = 6, 120


def card(field: Heightfield) -> markup.Markup:
    """HTML of a heightfield.

    Raises
    ------
    NoCardError
        If no pixel has a height, or the heights are not one map.
    """
    heights = np.asarray(field.heights, np.float64)
    if heights.ndim != 2:
        raise NoCardError(f"heights of shape {heights.shape} are not one map")
    known = np.isfinite(heights)
    if not known.any():
        raise NoCardError("no pixel has a height")
    (ny, nx), (ey, ex) = field.shape, field.extent
    alt = f"Height map of {nx} x {ny} pixels, {ex:.4g} x {ey:.4g} µm, and its middle row"
    drawn = markup.picture(figure(heights, field.pixel), alt, most=markup.MOST)
    record = field.provenance
    source = record.source + (f", channel {record.channel}" if record.channel else "")
    pairs = [*figures(heights, field.pixel), ("from", _short(source))]
    steps = [_short(step) for step in (*record.notes, *record.steps)]
    if len(steps) > _STEPS:
        steps = ["…", *steps[-_STEPS + 1 :]]
    if steps:
        lines = (str(markup.escape(step)) for step in steps)
        pairs.append(("history", markup.Markup("<br />".join(lines))))
    return markup.card("Heightfield", drawn, markup.key_figures(pairs), *_notes(heights, known))


def figures(heights: np.ndarray, pixel: tuple[float, float]) -> list[tuple[str, str]]:
    """Names and values of the figures of a map in micrometres, [ny, nx], perhaps with NaN."""
    (ny, nx), (dy, dx) = heights.shape, pixel
    known = heights[np.isfinite(heights)]
    rows = [
        ("size", f"{nx} × {ny} pixels, {nx * dx:.4g} × {ny * dy:.4g} µm"),
        ("pixel", f"{_nm(dx)}" if dx == dy else f"{_nm(dx)} × {_nm(dy)} (x × y)"),
        ("rms height Sq", _nm(float(known.std()))),
        ("peak to valley", _nm(float(np.ptp(known)))),
    ]
    middle = _middle(heights, ANALYSED)
    if min(middle.shape) < 4 or not np.isfinite(middle).all() or np.ptp(middle) == 0.0:
        return rows
    part = "" if middle.shape == heights.shape else f", of the middle {ANALYSED} pixels"
    found = surface_statistics(middle, pixel)
    rows.append(("rms slope", f"{found.rms_slope:.3g}{part}"))
    if found.autocorrelation_length is not None:
        rows.append(("correlation length", f"{found.autocorrelation_length:.3g} µm{part}"))
    if found.dominant_period is not None and found.dominant_direction is not None:
        angle = f"{math.degrees(found.dominant_direction):.0f}°".replace("-0°", "0°")
        share = f"{100.0 * found.dominant_share:.0f} % of the variance"
        period = f"{found.dominant_period:.4g} µm at {angle.replace('-', '−')}, {share}{part}"
        rows.append(("dominant period", period))
    return rows


def figure(
    heights: np.ndarray, pixel: tuple[float, float], *, width: float = 5.9, profile: bool = True
) -> "Figure":
    """Map of heights about their mean in nm, and the profile along the middle row."""
    from matplotlib.figure import Figure

    made = Figure(figsize=(width, 3.0), layout="constrained")
    axes = made.subplots(1, 2 if profile else 1, width_ratios=(1.25, 1.0) if profile else None)
    left, right = axes if profile else (axes, None)
    height_map(left, heights, pixel)
    if right is not None:
        _profile(right, heights, pixel)
    return made


def height_map(axes: "Axes", heights: np.ndarray, pixel: tuple[float, float]) -> None:
    """Heights about their mean, nm, with colour bar and scale bar; NaN is grey."""
    import matplotlib

    (ny, nx), (dy, dx) = heights.shape, pixel
    nm = 1000.0 * (_decimated(heights) - np.nanmean(heights))
    low, high = np.nanpercentile(nm, (0.1, 99.9))
    if not high > low:
        low, high = low - 1.0, high + 1.0
    # A map many times as long as wide is stretched: its axes tell.
    long = max(nx * dx / (ny * dy), ny * dy / (nx * dx)) > 6.0
    picture = axes.imshow(
        nm,
        extent=(0.0, nx * dx, ny * dy, 0.0),
        cmap=matplotlib.colormaps["cividis"].with_extremes(bad="0.6"),
        vmin=low,
        vmax=high,
        interpolation="nearest",
        aspect="auto" if long else "equal",
    )
    assert axes.figure is not None
    bar = axes.figure.colorbar(picture, ax=axes, shrink=0.9)
    bar.ax.tick_params(labelsize=7)
    axes.set_title("height / nm", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x / µm", fontsize=8)
    axes.set_ylabel("y / µm", fontsize=8)
    pictures._scale_bar(axes, nx * dx, ny * dy)


def _profile(axes: "Axes", heights: np.ndarray, pixel: tuple[float, float]) -> None:
    ny, nx = heights.shape
    row = heights[ny // 2]
    first = max((nx - PROFILE) // 2, 0)
    row = row[first : first + PROFILE]
    x = (first + np.arange(len(row)) + 0.5) * pixel[1]
    axes.plot(x, 1000.0 * (row - np.nanmean(heights)), lw=0.9, color="C0")
    axes.set_xlim(first * pixel[1], (first + len(row)) * pixel[1])
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x / µm, along the middle row", fontsize=8)
    axes.set_ylabel("height / nm", fontsize=8)
    axes.grid(alpha=0.3)


def _notes(heights: np.ndarray, known: np.ndarray) -> list[str]:
    out = []
    if not known.all():
        share = 100.0 * (1.0 - known.mean())
        missing = f"{int((~known).sum())} pixels ({share:.2g} %) have no height: drawn in grey."
        out.append(markup.note(missing))
    step = _step(heights.shape)
    if step > 1:
        text = (
            f"The map is drawn as means over {step} × {step} pixels; finer structure is not seen."
        )
        if heights.shape[1] > PROFILE:
            text += f" The profile shows the middle {PROFILE} pixels as they are."
        out.append(markup.note(text))
    return out


def _step(shape: tuple[int, ...]) -> int:
    return -(-max(shape) // DRAWN)


def _decimated(heights: np.ndarray) -> np.ndarray:
    """Means over blocks of square shape, without NaN where a pixel is known; edges cut."""
    step = _step(heights.shape)
    if step == 1:
        return heights
    steps = [min(step, n) for n in heights.shape]
    (my, mx), (sy, sx) = [n // s for n, s in zip(heights.shape, steps, strict=True)], steps
    blocks = heights[: my * sy, : mx * sx].reshape(my, sy, mx, sx)
    known = np.isfinite(blocks)
    count = known.sum((1, 3))
    total = np.where(known, blocks, 0.0).sum((1, 3))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _middle(heights: np.ndarray, most: int) -> np.ndarray:
    starts = [max((n - most) // 2, 0) for n in heights.shape]
    return heights[starts[0] : starts[0] + most, starts[1] : starts[1] + most]


def _nm(micrometres: float) -> str:
    """In nm below 10 µm, in µm above."""
    if abs(micrometres) < 10.0:
        return f"{1000.0 * micrometres:.4g} nm"
    return f"{micrometres:.4g} µm"


def _short(text: str) -> str:
    return text if len(text) <= _LETTERS else text[: _LETTERS - 1] + "…"
