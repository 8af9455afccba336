"""Pictures of fitted surfaces: measured against fitted, residuals, loss curves.

Reflectance is drawn over spatial frequency, (u, v) / wavelength, where the orders of all
wavelengths lie on one lattice; where all directions lie in one plane, over the frequency in it
and the wavelength. Residuals are fitted less measured.
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

#: Decades of logarithmic scales; dots drawn of a scatter; wavelengths and stages with a colour.
DECADES, DOTS, COLOURS = 4, 20_000, 6

_CHANNELS = {"xyz": "XYZ", "rgb": "RGB"}
_SHADES = {"X": "C3", "Y": "C2", "Z": "C0", "R": "C3", "G": "C2", "B": "C0"}


def reflectance(
    title: str,
    wave: Float[np.ndarray, "M 2"],
    wavelengths: Float[np.ndarray, " L"],
    measured: Float[np.ndarray, "M C"],
    fitted: Float[np.ndarray, "M C"],
    *,
    quantity: str,
    unit: str,
    width: float,
    noise: Float[np.ndarray, "M C"] | None = None,
) -> "Figure":
    """Measured and fitted values: maps, a cut through the brightest, and one against the other.

    Parameters
    ----------
    title
        Of the picture.
    wave
        (u, v) of the pairs of directions.
    wavelengths
        Micrometres; of colours those that they are summed over.
    measured, fitted
        Values: spectra, C = L, or colours, C = 3.
    quantity, unit
        Of the values: ``xyz`` and ``rgb`` are colours.
    width
        Of a line in u, for the width of the cut.
    noise
        Standard deviation of each measured value, if it is known.
    """
    from matplotlib.colors import LogNorm

    names = _names(quantity, wavelengths)
    grey = quantity in _CHANNELS
    figure = pictures._figure(11.5, 7.6)
    grid = figure.add_gridspec(2, 6, height_ratios=(1.15, 1.0))
    left, right = figure.add_subplot(grid[0, :3]), figure.add_subplot(grid[0, 3:])
    x, y, labels = _places(wave, wavelengths, grey)
    one = (measured.mean(1), fitted.mean(1)) if grey else (measured.ravel(), fitted.ravel())
    high = float(max(part.max() for part in one)) or 1.0
    norm = LogNorm(high * 10.0**-DECADES, high, clip=True)
    for axes, values, what in ((left, one[0], "measured"), (right, one[1], "fitted")):
        # Bright dots last, so that lines are not buried.
        order = np.argsort(values)
        shown = np.maximum(values[order], high * 10.0**-DECADES)
        dots = axes.scatter(
            x[order],
            y[order],
            c=shown,
            s=_size(len(values)) * (0.15 + 0.85 * (np.log10(shown / high) / DECADES + 1.0)),
            norm=norm,
            cmap="magma",
            lw=0,
            rasterized=True,
        )
        _frame(axes, labels, what + (", mean of the channels" if grey else ""))
    figure.colorbar(dots, ax=[left, right], label=unit, pad=0.01)
    _cut(figure.add_subplot(grid[1, :4]), wave, measured, fitted, noise, names, width, unit)
    _against(figure.add_subplot(grid[1, 4:]), measured, fitted, unit)
    figure.suptitle(title)
    return figure


def reflectance_residual(
    title: str,
    wave: Float[np.ndarray, "M 2"],
    wavelengths: Float[np.ndarray, " L"],
    residual: Float[np.ndarray, "M C"],
    *,
    quantity: str,
    unit: str,
) -> "Figure":
    """Residuals over the directions, and their distribution.

    Parameters
    ----------
    title, wave, wavelengths, quantity
        As for `reflectance`.
    residual
        Fitted less measured.
    unit
        Of the residual; ``noise`` where it was divided by its standard deviation, and the
        distribution is compared with the normal one.
    """
    grey = quantity in _CHANNELS
    x, y, labels = _places(wave, wavelengths, grey)
    # Of colours the channel that is furthest off.
    worst = np.abs(residual).argmax(1)[:, None]
    shown = np.take_along_axis(residual, worst, 1).ravel() if grey else residual.ravel()
    end = float(np.percentile(np.abs(shown), 99.5)) or 1.0
    figure = pictures._figure(11.0, 4.8)
    left, right = figure.subplots(1, 2, width_ratios=(1.3, 1.0))
    order = np.argsort(np.abs(shown))
    dots = left.scatter(
        x[order],
        y[order],
        c=shown[order],
        s=_size(len(shown)),
        vmin=-end,
        vmax=end,
        cmap="RdBu_r",
        lw=0,
        rasterized=True,
    )
    _frame(left, labels, "the channel furthest off" if grey else "")
    left.set_facecolor("0.8")
    figure.colorbar(dots, ax=left, label=f"(fitted − measured) / {unit}", extend="both")
    _distribution(right, residual.ravel(), f"(fitted − measured) / {unit}", unit == "noise")
    figure.suptitle(title)
    return figure


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
    _distribution(right, nm[np.isfinite(nm)], "(measured − fitted) / nm", normal=False)
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


def _names(quantity: str, wavelengths: np.ndarray) -> list[str]:
    return list(_CHANNELS.get(quantity, [f"{1000 * w:.4g} nm" for w in wavelengths]))


def _shade(name: str, place: float) -> object:
    from matplotlib import colormaps

    return _SHADES.get(name, colormaps["turbo"](0.08 + 0.84 * place))


def _in_plane(wave: np.ndarray) -> bool:
    size = np.linalg.svd(wave, compute_uv=False)
    return len(size) < 2 or bool(size[1] < 1e-3 * max(float(size[0]), 1e-12))


def _places(
    wave: np.ndarray, wavelengths: np.ndarray, grey: bool
) -> tuple[np.ndarray, np.ndarray, tuple[str, str, bool]]:
    """Coordinates of the values as dots, names of the axes, and whether their scale is one."""
    if grey:
        return wave[:, 0], wave[:, 1], ("u", "v", True)
    if _in_plane(wave):
        _, _, turned = np.linalg.svd(wave, full_matrices=False)
        along = wave @ turned[0] * (1.0 if turned[0][np.argmax(np.abs(turned[0]))] > 0 else -1.0)
        x, y = np.broadcast_arrays(along[:, None], 1000.0 * wavelengths[None])
        return x.ravel(), y.ravel(), ("u in the plane of directions", "wavelength / nm", False)
    x, y = (wave[:, k, None] / wavelengths[None] for k in (0, 1))
    return x.ravel(), y.ravel(), ("u / λ  (1/µm)", "v / λ  (1/µm)", True)


def _frame(axes: "Axes", labels: tuple[str, str, bool], title: str) -> None:
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.set_title(title, fontsize=10)
    if labels[2]:
        axes.set_aspect("equal")
    axes.set_facecolor("0.88")


def _size(count: int) -> float:
    """Of dots, points squared: the fewer, the larger."""
    return float(np.clip(30_000.0 / max(count, 1), 2.0, 40.0))


def _cut(
    axes: "Axes",
    wave: np.ndarray,
    measured: np.ndarray,
    fitted: np.ndarray,
    noise: np.ndarray | None,
    names: list[str],
    width: float,
    unit: str,
) -> None:
    """Values along the line through u = v = 0 on which most light is, within a line's width."""
    # The brightest values but those of the mirror's own peak.
    apart = np.hypot(*wave.T) > 3.0 * width
    weight = np.where(apart, measured.clip(0.0).max(1), 0.0)
    angles = np.radians(np.arange(0.0, 180.0, 1.0))
    across = np.abs(wave @ np.stack([-np.sin(angles), np.cos(angles)]))
    best = angles[int(np.argmax((weight[:, None] * (across < width)).sum(0)))]
    if not weight.any():
        best = 0.0
    direction = np.array([math.cos(best), math.sin(best)])
    off = np.abs(wave @ np.array([-direction[1], direction[0]]))
    near = off < width
    if near.sum() < 12:
        near = off <= np.sort(off)[min(24, len(off)) - 1]
    order = np.flatnonzero(near)[np.argsort((wave @ direction)[near])]
    along = (wave @ direction)[order]
    chosen = np.unique(np.linspace(0, len(names) - 1, min(COLOURS, len(names))).round().astype(int))
    plane = _in_plane(wave)
    for k in chosen:
        shade = _shade(names[k], k / max(len(names) - 1, 1))
        error = None if noise is None else noise[order, k]
        axes.errorbar(
            along,
            measured[order, k],
            error,
            fmt="o",
            ms=3.2,
            mfc="none",
            color=shade,
            lw=0.6,
            label=names[k],
        )
        axes.plot(
            along,
            fitted[order, k],
            "-" if plane else "x",
            ms=4.5,
            mew=1.0,
            lw=1.0,
            color=shade,
        )
    high = float(max(measured[order].max(), fitted[order].max())) or 1.0
    axes.set_yscale("log", nonpositive="clip")
    axes.set_ylim(high * 10.0**-DECADES, 2.0 * high)
    words = "u in the plane" if plane else f"u along {math.degrees(best):.0f}°"
    axes.set(xlabel=words, ylabel=unit)
    fit = "lines" if plane else "crosses"
    axes.set_title(f"brightest cut: measured (circles), fitted ({fit})", fontsize=10)
    axes.legend(frameon=False, fontsize=7, ncols=2)
    axes.grid(alpha=0.3)


def _against(axes: "Axes", measured: np.ndarray, fitted: np.ndarray, unit: str) -> None:
    x, y = measured.ravel(), fitted.ravel()
    high = float(max(x.max(), y.max())) or 1.0
    low = high * 10.0**-DECADES
    seen = np.flatnonzero((x > low) & (y > low))
    seen = seen[:: max(math.ceil(len(seen) / DOTS), 1)]
    axes.plot([low, high], [low, high], color="C3", lw=1.0, zorder=3)
    axes.loglog(x[seen], y[seen], ".", ms=3.0, alpha=0.5, color="0.25", mew=0, rasterized=True)
    axes.set(xlabel=f"measured / ({unit})", ylabel=f"fitted / ({unit})")
    axes.set_aspect("equal")
    axes.set_title("fitted against measured", fontsize=10)
    axes.grid(alpha=0.3)


def _distribution(axes: "Axes", values: np.ndarray, label: str, normal: bool) -> None:
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
