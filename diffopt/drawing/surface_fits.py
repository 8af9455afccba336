"""Pictures of surfaces fitted to scans: heights, profiles, residuals; loss curves of any fit.

`reflectance_fits` draws fits to reflectance.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from diffopt.drawing import pictures

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def scan(
    title: str,
    measured: Float[np.ndarray, "ny nx"],
    fitted: Float[np.ndarray, "ny nx"],
    pixel: tuple[float, float],
    *,
    angle: float = 0.0,
    drawn: bool = False,
) -> "Figure":
    """Levelled heights of a scan, fitted heights, and a profile across the lines.

    Parameters
    ----------
    title
        Of the picture.
    measured
        Without plane and line offsets, micrometres; NaN where the scan has none.
    fitted
        Of the model.
    pixel
        (dy, dx), micrometres.
    angle
        Direction across the lines, radians from x.
    drawn
        Whether the fitted heights are one draw of a random surface: then spectra are compared,
        and not profiles.
    """
    figure = pictures._figure(10.5, 7.2)
    grid = figure.add_gridspec(2, 2, height_ratios=(1.5, 1.0))
    maps = [1000.0 * (part - np.nanmean(part)) for part in (measured, fitted)]
    low, high = np.nanpercentile(maps[0], (0.2, 99.8))
    words = ("measured, levelled", "one draw of the fitted model" if drawn else "fitted")
    both, picture = [], None
    for k, (heights, word) in enumerate(zip(maps, words, strict=True)):
        axes = figure.add_subplot(grid[0, k])
        picture = _map(axes, heights, pixel, vmin=low, vmax=max(high, low + 1e-9), cmap="cividis")
        axes.set_title(word, fontsize=10)
        both.append(axes)
    assert picture is not None
    figure.colorbar(picture, ax=both, label="height / nm")
    below = figure.add_subplot(grid[1, :])
    if drawn:
        for heights, word, colour in zip(maps, words, ("0.3", "C3"), strict=True):
            below.loglog(*_radial(heights, pixel), color=colour, lw=1.2, label=word)
        below.set(xlabel="frequency / (1/µm)", ylabel="power / (nm² µm²)")
        measured_power = below.lines[0].get_ydata()
        below.set_ylim(0.1 * np.min(measured_power), 5.0 * np.max(measured_power))
        words = "power spectrum, mean over directions; what was fitted as noise is not drawn"
        below.set_title(words, fontsize=10)
    else:
        shift, along = _richest(maps[1], pixel, angle)
        line = _line(measured.shape, pixel, angle, shift, along)
        below.plot(along, _at(maps[0], pixel, line), ".", ms=2.5, color="0.45", label="measured")
        below.plot(along, _at(maps[1], pixel, line), color="C3", lw=1.2, label="fitted")
        below.set(xlabel="across the lines / µm, on the dotted line", ylabel="height / nm")
        below.set_xlim(float(along[0]), float(along[-1]))
        for axes in both:
            axes.plot(line[1], line[0], color="C3", lw=1.0, ls=":")
    below.legend(frameon=False, fontsize=8, loc="upper right", ncols=2, markerscale=3.0)
    below.grid(alpha=0.3)
    figure.suptitle(title)
    return figure


def heights(
    title: str,
    start: Float[np.ndarray, "ny nx"],
    fitted: Float[np.ndarray, "ny nx"],
    pixel: tuple[float, float],
) -> "Figure":
    """Heights where a fit of every height started, where it ended, and their difference."""
    figure = pictures._figure(12.0, 4.4)
    maps = [1000.0 * (part - part.mean()) for part in (start, fitted)]
    change = maps[1] - maps[0]
    low, high = np.percentile(np.stack(maps), (0.2, 99.8))
    end = float(np.percentile(np.abs(change), 99.8)) or 1.0
    row = figure.subplots(1, 3)
    limits = ({"vmin": low, "vmax": high, "cmap": "cividis"},) * 2
    limits += ({"vmin": -end, "vmax": end, "cmap": "RdBu_r"},)
    words = ("start", "fitted", "fitted − start")
    for axes, values, limit, word in zip(row, (*maps, change), limits, words, strict=True):
        picture = _map(axes, values, pixel, **limit)
        axes.set_title(word, fontsize=10)
        if word != "start":
            shown = row[:2].tolist() if word == "fitted" else axes
            figure.colorbar(picture, ax=shown, label="height / nm", shrink=0.8)
    figure.suptitle(title)
    return figure


def scan_residual(
    title: str, residual: Float[np.ndarray, "ny nx"], pixel: tuple[float, float]
) -> "Figure":
    """What a fit leaves of a scan, micrometres, and its distribution."""
    nm = 1000.0 * residual
    end = float(np.nanpercentile(np.abs(nm), 99.5)) or 1.0
    figure = pictures._figure(10.5, 4.6)
    left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
    picture = _map(left, nm, pixel, vmin=-end, vmax=end, cmap="RdBu_r")
    left.set_facecolor("0.6")
    figure.colorbar(picture, ax=left, label="(measured − fitted) / nm", extend="both")
    distribution(right, nm[np.isfinite(nm)], "(measured − fitted) / nm", normal=False)
    figure.suptitle(title)
    return figure


def losses(
    title: str,
    curves: Mapping[str, np.ndarray],
    *,
    label: str = "loss",
    every: int = 1,
    likelihoods: Mapping[str, np.ndarray] | None = None,
) -> "Figure":
    """Loss of each start against steps.

    Parameters
    ----------
    title
        Of the picture.
    curves
        By name: of S starts [S, n], or of one [n]; NaN after the last step.
    label
        What the loss is.
    every
        Steps from one value to the next.
    likelihoods
        Curves of -2 log likelihood, which may be of either sign: on axes of their own.
    """
    from matplotlib.ticker import MaxNLocator

    panels = [(curves, label, True), (likelihoods or {}, "−2 log likelihood", False)]
    panels = [panel for panel in panels if panel[0]] or panels[:1]
    figure = pictures._figure(1.5 + 6.5 * len(panels), 4.6)
    row = figure.subplots(1, len(panels), squeeze=False)[0]
    colour = 0
    for axes, (some, what, positive) in zip(row, panels, strict=True):
        for name, found in some.items():
            rows = np.atleast_2d(np.asarray(found, np.float64))
            rows = np.where(np.isfinite(rows) & ((rows > 0.0) | (not positive)), rows, np.nan)
            _draw_losses(axes, name, rows, every, f"C{colour % 10}")
            colour += 1
        if positive:
            axes.set_yscale("log")
        axes.set(xlabel="step", ylabel=what)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.grid(alpha=0.3, which="both")
        if axes.lines:
            axes.legend(frameon=False, fontsize=8)
    figure.suptitle(title)
    return figure


def _draw_losses(axes: "Axes", name: str, rows: np.ndarray, every: int, colour: str) -> None:
    """Curves of the starts of one fit, the best of them in bold."""
    rows = rows[np.isfinite(rows).any(1)]
    if not len(rows):
        return
    best = int(np.argmin([row[np.isfinite(row)][-1] for row in rows]))
    steps = every * np.arange(rows.shape[1])
    marker = "o" if np.isfinite(rows).sum(1).max() < 2 else None
    for j, row in enumerate(rows):
        if j != best:
            axes.plot(steps, row, color=colour, lw=0.7, alpha=0.45, marker=marker)
    label = f"{name}, best of {len(rows)} starts" if len(rows) > 1 else name
    axes.plot(steps, rows[best], color=colour, lw=2.0, label=label, marker=marker)


def distribution(axes: "Axes", values: np.ndarray, label: str, normal: bool) -> None:
    """Histogram of residuals, with the normal distribution of variance 1 beside it or not."""
    rms = float(np.sqrt(np.mean(values**2)))
    end = max(5.0 if normal else 0.0, float(np.percentile(np.abs(values), 99.5))) or 1.0
    axes.hist(values.clip(-end, end), bins=50, range=(-end, end), density=True, color="0.6")
    if normal:
        x = np.linspace(-end, end, 401)
        curve = np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)
        axes.plot(x, curve, color="C3", label="normal, variance 1")
        axes.legend(frameon=False, fontsize=8, loc="upper left")
    axes.set(xlabel=label, ylabel="share per unit", title=f"root mean square {rms:.3g}")
    axes.title.set_fontsize(10)
    axes.grid(alpha=0.3)


def _map(axes: "Axes", values: np.ndarray, pixel: tuple[float, float], **limits: object):
    (ny, nx), (dy, dx) = values.shape, pixel
    picture = axes.imshow(values, extent=(0.0, nx * dx, ny * dy, 0.0), **limits)  # type: ignore
    axes.set_xlabel("x / µm", fontsize=9)
    axes.set_ylabel("y / µm (down the scan)", fontsize=9)
    return picture


def _line(
    shape: tuple[int, ...],
    pixel: tuple[float, float],
    angle: float,
    shift: float,
    along: np.ndarray,
) -> np.ndarray:
    """(y, x) in micrometres of places on a line that passes the middle at a distance, [2, n]."""
    y, x = (0.5 * n * d for n, d in zip(shape, pixel, strict=True))
    sine, cosine = math.sin(angle), math.cos(angle)
    return np.stack([y + along * sine + shift * cosine, x + along * cosine - shift * sine])


def _richest(
    heights: np.ndarray, pixel: tuple[float, float], angle: float
) -> tuple[float, np.ndarray]:
    """Distance of the line, among some across the grating, on which heights vary most."""
    size = [n * d for n, d in zip(heights.shape, pixel, strict=True)]
    reach = 0.5 * math.hypot(*size)
    best = (-1.0, 0.0, np.zeros(0))
    for shift in np.linspace(-0.3, 0.3, 31) * min(size):
        along = np.arange(-reach, reach, 0.5 * min(pixel))
        y, x = _line(heights.shape, pixel, angle, shift, along)
        along = along[(y >= 0) & (y <= size[0]) & (x >= 0) & (x <= size[1])]
        found = _at(heights, pixel, _line(heights.shape, pixel, angle, shift, along))
        # Long lines count more.
        spread = float(np.nansum((found - np.nanmean(found)) ** 2))
        if spread > best[0] * (1.0 + 1e-6):
            best = (spread, float(shift), along)
    return best[1:]


def _at(heights: np.ndarray, pixel: tuple[float, float], line: np.ndarray) -> np.ndarray:
    """Heights at places (y, x), linear between the middles of pixels."""
    parts = []
    for place, n, d in zip(line, heights.shape, pixel, strict=True):
        at = np.clip(place / d - 0.5, 0.0, n - 1.0)
        low = np.minimum(at.astype(int), n - 2)
        parts.append((low, at - low))
    (j, a), (i, b) = parts
    above = (1.0 - b) * heights[j, i] + b * heights[j, i + 1]
    return (1.0 - a) * above + a * ((1.0 - b) * heights[j + 1, i] + b * heights[j + 1, i + 1])


def _radial(heights: np.ndarray, pixel: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Power spectrum under a Hann window, mean over rings of frequency."""
    ny, nx = heights.shape
    known = np.where(np.isfinite(heights), heights, 0.0)
    window = np.hanning(ny)[:, None] * np.hanning(nx)[None, :]
    area = pixel[0] * pixel[1]
    power = np.abs(np.fft.fft2(window * known)) ** 2 * area / (window**2).sum()
    frequency = np.hypot(
        np.fft.fftfreq(ny, pixel[0])[:, None], np.fft.fftfreq(nx, pixel[1])[None, :]
    )
    first, last = 1.0 / min(ny * pixel[0], nx * pixel[1]), 0.5 / max(pixel)
    edges = np.geomspace(first, last, 49)
    ring = np.digitize(frequency.ravel(), edges)
    count = np.bincount(ring, minlength=50)[1:49]
    total = np.bincount(ring, weights=power.ravel(), minlength=50)[1:49]
    seen = count > 0
    return np.sqrt(edges[:-1] * edges[1:])[seen], total[seen] / count[seen]
