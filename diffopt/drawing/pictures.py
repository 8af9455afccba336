"""Figures of a scan and of what it reflects, drawn with matplotlib, without a display.

Every function returns a `matplotlib.figure.Figure` or an sRGB array; `save` writes either.
What is drawn comes from `diffopt.drawing.views`, exposure from `diffopt.drawing.tones`; nothing is
computed here.
"""

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from diffopt import colour
from diffopt.drawing import bands, tones, views
from diffopt.heightfield import Heightfield
from diffopt.statistics import SurfaceStatistics

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Wavelengths at which orders are marked, micrometres.
MARKED = (0.45, 0.55, 0.65)
#: Linear grey behind objects.
BACKGROUND = 0.012
#: Share of the exposure's white that uniform surroundings add to lit objects.
SURROUNDINGS = 0.05

_DPI = 150


def photograph(
    image: views.Image,
    *,
    supersampling: int = 1,
    percentile: float = 96.0,
    illuminant: colour.IlluminantLike = "D65",
) -> Float[np.ndarray, "h w 3"]:
    """Exposed sRGB picture of a lit object before a dark ground.

    Parameters
    ----------
    image
        From `diffopt.drawing.views.photograph`; uniform surroundings of `SURROUNDINGS` are added.
    supersampling
        Samples averaged on each axis, after the tone curve, so that edges are smooth.
    percentile
        See `diffopt.drawing.tones.exposure`; of the material's samples that are lit.
    illuminant
        The light of the image.
    """
    parts = bands.bands(image.covered.shape)
    # What counts for the exposure is the brightest channel, of which all are kept.
    brightest = np.concatenate(
        [
            tones.display(image.xyz[rows][_lit(image, rows)], illuminant).max(-1, keepdims=True)
            for rows in parts
        ]
    )
    factor = tones.exposure(brightest, percentile)
    white = colour.white_point(illuminant, colour.wavelengths(tones.STEP_NM))
    h, w = (n // supersampling for n in image.covered.shape)
    found = np.zeros((h, w, 3))
    for rows in parts:
        ambient = SURROUNDINGS / factor * white * image.albedo[rows]
        rgb = tones.tone(tones.display(image.xyz[rows] + ambient, illuminant), factor)
        shown = (image.covered | image.neutral)[rows]
        rgb = np.where(shown[..., None], rgb, BACKGROUND)
        low, high = rows.start // supersampling, rows.stop // supersampling
        samples = rgb.reshape(high - low, supersampling, w, supersampling, 3)
        found[low:high] = samples.mean(axis=(1, 3))
    return tones.encode(found)


def _lit(image: views.Image, rows: slice) -> Bool[np.ndarray, "h w"]:
    return image.covered[rows] & (image.xyz[rows, :, 1] > 0.0)


def scan(heightfield: Heightfield, statistics: SurfaceStatistics) -> "Figure":
    """Heights with scale bar and colour bar, a profile along x, and the statistics."""
    figure = _figure(10.0, 5.2)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0), height_ratios=(1.0, 0.85))
    heights = 1000.0 * np.asarray(heightfield.heights, np.float64)
    heights = heights - heights.mean()
    (ny, nx), (ey, ex) = heightfield.shape, heightfield.extent
    axes = figure.add_subplot(grid[:, 0])
    low, high = np.percentile(heights, (0.1, 99.9))
    picture = axes.imshow(
        heights,
        extent=(0.0, ex, ey, 0.0),
        cmap="cividis",
        vmin=low,
        vmax=high if high > low else low + 1.0,
    )
    figure.colorbar(picture, ax=axes, label="height / nm", shrink=0.8)
    row = ny // 2
    axes.axhline((row + 0.5) * heightfield.pixel[0], color="C3", lw=1.0, ls=":")
    _scale_bar(axes, ex, ey)
    axes.set(xlabel="x / µm", ylabel="y / µm (down the scan)", title="Heights")
    profile = figure.add_subplot(grid[0, 1])
    profile.plot((np.arange(nx) + 0.5) * heightfield.pixel[1], heights[row], lw=0.9, color="C0")
    profile.set(xlabel="x / µm", ylabel="height / nm", title="Profile along the dotted line")
    profile.set_xlim(0.0, ex)
    profile.grid(alpha=0.3)
    words = figure.add_subplot(grid[1, 1])
    words.axis("off")
    words.table(
        cellText=[list(pair) for pair in describe(heightfield, statistics)],
        cellLoc="left",
        colWidths=[0.45, 0.55],
        loc="center",
        edges="horizontal",
    ).scale(1.0, 1.25)
    return figure


def describe(heightfield: Heightfield, figures: SurfaceStatistics) -> list[tuple[str, str]]:
    """Figures of a scan as rows of words."""
    (ny, nx), (dy, dx), (ey, ex) = heightfield.shape, heightfield.pixel, heightfield.extent
    rows = [
        ("map", f"{nx} x {ny} pixels, {ex:.4g} x {ey:.4g} µm"),
        ("pixel", f"{1000 * dx:.4g} x {1000 * dy:.4g} nm"),
        ("peak to valley", f"{1000 * figures.peak_to_valley:.4g} nm"),
        ("rms height", f"{1000 * figures.rms_height:.4g} nm"),
        ("rms slope", f"{figures.rms_slope:.3g} ({_degrees(math.atan(figures.rms_slope))})"),
    ]
    if figures.autocorrelation_length is not None:
        rows.append(("correlation length", f"{figures.autocorrelation_length:.3g} µm"))
    if figures.dominant_period is not None and figures.dominant_direction is not None:
        share = 100.0 * figures.dominant_share
        direction = _degrees(figures.dominant_direction)
        rows.append(("dominant period", f"{figures.dominant_period:.4g} µm at {direction}"))
        rows.append(("its share", f"{share:.0f} % of the variance"))
    return rows


def hemisphere(
    data: views.Hemisphere,
    *,
    grating: tuple[float, float] | None = None,
    illuminant: colour.IlluminantLike = "D65",
) -> "Figure":
    """Colours over the viewing directions, with rings of equal angle, light and mirror.

    Parameters
    ----------
    data
        The map.
    grating
        Period (micrometres) and direction (radians) whose orders are marked at `MARKED`.
    illuminant
        The light of the map.
    """
    from matplotlib.patches import Circle

    figure = _figure(7.4, 7.2)
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    linear = tones.display(np.maximum(data.xyz, 0.0), illuminant)
    rgb = tones.encode(
        tones.tone(linear, tones.exposure(linear[linear.max(-1) > 0.0], 90.0, least=1e-4))
    )
    disc = Circle((0.0, 0.0), 1.0, fc="black", ec="0.4", lw=1.0, zorder=0)
    axes.add_patch(disc)
    # Short of the last pixels, which may be empty.
    radius = math.sin(views.GRAZING) - 3.0 / len(data.line)
    rim = Circle((0.0, 0.0), radius, transform=axes.transData)
    axes.imshow(
        rgb, extent=(-1.0, 1.0, 1.0, -1.0), interpolation="bilinear", clip_path=rim, zorder=1
    )
    for angle in (15, 30, 45, 60, 75):
        radius = math.sin(math.radians(angle))
        axes.add_patch(Circle((0, 0), radius, fc="none", ec="white", lw=0.5, alpha=0.35, zorder=2))
        x, y = radius * math.cos(0.7), radius * math.sin(0.7)
        axes.text(x, y, f"{angle}°", color="white", fontsize=7, alpha=0.7, ha="center", va="center")
    white = {"color": "white", "fontsize": 8, "zorder": 5}
    axes.plot(data.wi[0], data.wi[1], "*", ms=9, mfc="none", mec="white", mew=0.9, zorder=4)
    axes.annotate(
        "light",
        (data.wi[0], data.wi[1]),
        xytext=(0, 9),
        textcoords="offset points",
        ha="center",
        **white,
    )
    axes.plot(-data.wi[0], -data.wi[1], "+", ms=11, color="black", mew=1.0, zorder=4)
    axes.annotate(
        "mirror",
        (-data.wi[0], -data.wi[1]),
        xytext=(0, 26),
        textcoords="offset points",
        ha="center",
        **white,
    )
    if grating is not None:
        _mark_orders(axes, data.wi, *grating)
    axes.set(xlim=(-1.02, 1.02), ylim=(1.02, -1.02))
    axes.set_xlabel("direction cosine x of the viewer")
    axes.set_ylabel("direction cosine y (down the scan)")
    axes.set_title(f"Light at {_degrees(_polar(data.wi))}: reflected colour over the hemisphere")
    return figure


def in_plane(
    data: views.InPlane,
    *,
    period: float | None = None,
    illuminant: colour.IlluminantLike = "D65",
) -> "Figure":
    """Spectra against the viewing angle, and the resulting colours.

    Parameters
    ----------
    data
        The cut.
    period
        Period along the plane of incidence, micrometres, whose orders
        d (sin ti + sin to) = m lambda are drawn.
    illuminant
        The light of the cut.
    """
    from matplotlib.colors import LogNorm

    figure = _figure(9.0, 6.0)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(5.0, 1.0))
    degrees, nm = np.degrees(data.angles), 1000.0 * data.wavelengths
    largest = float(data.spectra.max())
    low = max(float(np.percentile(data.spectra, 2.0)), 1e-6 * largest)
    norm = LogNorm(low, largest) if largest > low else None
    mesh = upper.pcolormesh(
        degrees,
        nm,
        np.maximum(data.spectra.T, low),
        norm=norm,
        cmap="magma",
        shading="nearest",
        rasterized=True,
    )
    figure.colorbar(mesh, ax=[upper, lower], label="BRDF f / (1/sr)", pad=0.02)
    angle_in = math.copysign(_polar(data.wi), float(data.wi[:2] @ data.wo[-1, :2]))
    if period is not None:
        _draw_orders(upper, math.sin(angle_in), period, data.wavelengths)
    upper.set(ylabel="wavelength / nm", ylim=(nm[0], nm[-1]))
    upper.set_title(
        f"Plane of incidence, light at {math.degrees(angle_in):.3g}°, ".replace("-", "−")
        + f"mirror direction at {-math.degrees(angle_in):.3g}°".replace("-", "−")
    )
    linear = tones.display(np.maximum(data.xyz, 0.0), illuminant)
    rgb = tones.encode(tones.tone(linear, tones.exposure(linear, 90.0, least=1e-4)))
    lower.imshow(rgb[None], extent=(degrees[0], degrees[-1], 0.0, 1.0), aspect="auto")
    lower.set(xlabel="viewing angle / degrees (positive towards the light)", yticks=[])
    lower.set_ylabel("colour")
    return figure


def save(content: "Figure | np.ndarray", path: str | os.PathLike) -> Path:
    """Write a figure or an sRGB array [h, w, 3] in [0, 1] as PNG."""
    path = Path(path)
    if isinstance(content, np.ndarray):
        from matplotlib.image import imsave

        imsave(path, content)
    else:
        content.savefig(path, dpi=_DPI)
    return path


def _figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def _scale_bar(axes: "Axes", width: float, height: float) -> None:
    """White bar of a round length, about a quarter of the width."""
    from matplotlib import patheffects

    power = 10.0 ** math.floor(math.log10(0.3 * width))
    length = max(n for n in (1.0, 2.0, 5.0) if n * power <= 0.3 * width) * power
    x, y = 0.05 * width, 0.94 * height
    outline = [patheffects.withStroke(linewidth=3.0, foreground="black")]
    axes.plot([x, x + length], [y, y], color="white", lw=2.0, path_effects=outline)
    axes.text(
        x + 0.5 * length,
        y - 0.015 * height,
        f"{length:g} µm",
        color="white",
        ha="center",
        va="bottom",
        path_effects=outline,
    )


def _mark_orders(axes: "Axes", wi: np.ndarray, period: float, direction: float) -> None:
    for wavelength in MARKED:
        shade = _spectral(wavelength)
        for order in _orders(period, wavelength):
            at = views.order_direction(wi, period, direction, order, wavelength)
            if at is None:
                continue
            axes.plot(at[0], at[1], "o", ms=7, mfc="none", mec=shade, mew=0.9, alpha=0.9, zorder=4)
            if wavelength == MARKED[1]:
                axes.annotate(
                    f"{order:+d}".replace("-", "−"),
                    (at[0], at[1]),
                    xytext=(0, -14),
                    textcoords="offset points",
                    ha="center",
                    color="white",
                    fontsize=7,
                    alpha=0.8,
                )
    words = ", ".join(f"{1000 * w:.0f}" for w in MARKED)
    axes.text(
        0.01,
        0.01,
        f"circles: orders of {period:.4g} µm at {words} nm",
        transform=axes.transAxes,
        fontsize=8,
    )


def _draw_orders(axes: "Axes", sin_in: float, period: float, wavelengths: np.ndarray) -> None:
    for order in (0, *_orders(period, float(wavelengths[0]))):
        sine = order * wavelengths / period - sin_in
        seen = np.abs(sine) < math.sin(views.STEEPEST)
        if not seen.any():
            continue
        angle, nm = np.degrees(np.arcsin(sine[seen])), 1000.0 * wavelengths[seen]
        axes.plot(angle, nm, color="cyan", lw=0.9, ls="--", alpha=0.75)
        middle = len(angle) // 2
        axes.annotate(
            f"m = {order}".replace("-", "−"),
            (angle[middle], nm[middle]),
            xytext=(4, 0),
            textcoords="offset points",
            color="cyan",
            fontsize=8,
            clip_on=True,  # orders that only just enter have no room for their name
        )


def _orders(period: float, wavelength: float) -> Sequence[int]:
    """Orders but the zeroth that could propagate; few enough to be read."""
    most = min(int(2.0 * period / wavelength), 6)
    return [m for m in range(-most, most + 1) if m != 0]


def _spectral(wavelength: float) -> tuple[float, float, float]:
    """SRGB of a spectral line, for a mark."""
    lam = colour.wavelengths(tones.STEP_NM)
    weights = colour.spectral_weights(lam)[int(np.argmin(np.abs(lam - wavelength)))]
    return tones.swatch(weights)


def _polar(direction: np.ndarray) -> float:
    return math.atan2(math.hypot(direction[0], direction[1]), direction[2])


def _degrees(angle: float) -> str:
    return f"{math.degrees(angle):.3g}°"
