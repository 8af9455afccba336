"""Pictures of fits to reflectance: measured against fitted, and residuals.

Values are drawn over spatial frequency, (u, v) / wavelength, where the orders of all wavelengths
lie on one lattice; where all directions lie in one plane, over the frequency in it and the
wavelength; colours over (u, v). Residuals are fitted less measured.
"""

import math
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from diffopt import checks
from diffopt.drawing import pictures
from diffopt.drawing.surface_fits import distribution

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Decades of logarithmic scales; dots drawn of a scatter; wavelengths with a colour.
DECADES, DOTS, COLOURS = 4, 20_000, 6

_CHANNELS = {"xyz": "XYZ", "rgb": "RGB"}
_SHADES = {"X": "C3", "Y": "C2", "Z": "C0", "R": "C3", "G": "C2", "B": "C0"}


def values(
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


def residual(
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
    distribution(right, residual.ravel(), f"(fitted − measured) / {unit}", unit == "noise")
    figure.suptitle(title)
    return figure


def _names(quantity: str, wavelengths: np.ndarray) -> list[str]:
    return list(_CHANNELS.get(quantity, [f"{1000 * w:.4g} nm" for w in wavelengths]))


def _shade(name: str, place: float) -> object:
    from matplotlib import colormaps

    return _SHADES.get(name, colormaps["turbo"](0.08 + 0.84 * place))


def _places(
    wave: np.ndarray, wavelengths: np.ndarray, grey: bool
) -> tuple[np.ndarray, np.ndarray, tuple[str, str, bool]]:
    """Coordinates of the values as dots, names of the axes, and whether their scale is one."""
    if grey:
        return wave[:, 0], wave[:, 1], ("u", "v", True)
    if checks.in_plane(wave):
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
    plane = checks.in_plane(wave)
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
