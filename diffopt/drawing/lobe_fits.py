"""Pictures of fitted lobes: in the plane of incidence, over the hemisphere, over a map.

What has colour channels is drawn by their mean, to which the shape of the lobes is fitted.
In the plane of incidence angles on the side of the viewer are positive and drawn on the left.
"""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from diffopt.drawing import pictures, tones
from diffopt.lobes import Lobes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.projections.polar import PolarAxes

# From directions [N, 3] to values [N].
Function = Callable[[np.ndarray], np.ndarray]

#: Decades of the logarithmic scales, most lobes in a legend, most samples drawn as dots.
DECADES, NAMED, DOTS = 4, 8, 4000


def in_plane(name: str, angle: float, target: Function, lobes: Lobes) -> "Figure":
    """Polar plots of target, sum and single lobes in the plane of incidence.

    Parameters
    ----------
    name
        Of the material.
    angle
        Of the viewer, degrees.
    target
        What was fitted.
    lobes
        Without a batch.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    at = _angles(lobes)
    ways = np.stack([np.sin(at), np.zeros_like(at), np.cos(at)], -1)
    truth, each = target(ways), _each(lobes, ways)
    total = each.sum(0)
    high = max(float(truth.max()), float(total.max())) or 1.0
    low = math.ceil(math.log10(high) - 1e-6) - DECADES
    figure = Figure(figsize=(11.2, 6.6))
    for k, title in enumerate(("linear, 1/sr", "logarithmic, 1/sr")):
        box = (0.06 + 0.5 * k, 0.155, 0.38, 0.38 * 11.2 / 6.6)
        axes: PolarAxes = figure.add_axes(box, projection="polar")  # type: ignore[assignment]
        end = DECADES if k else 1.05 * high
        curves = np.stack([truth, *each, total])
        curves = np.log10(np.maximum(curves, 10.0**low)) - low if k else np.maximum(curves, 0.0)
        axes.plot(at, curves[0], color="0.7", lw=4.0, label="target")
        for j, curve in enumerate(curves[1:-1]):
            label = f"lobe {j + 1}: κ {float(lobes.kappa[j]):.3g}" if lobes.count <= NAMED else None
            axes.plot(at, curve, color=f"C{j % 10}", lw=0.9, label=label)
        axes.plot(at, curves[-1], color="black", lw=1.2, label="sum of the lobes")
        axes.plot([math.radians(angle)] * 2, [0.0, end], ":", color="0.3", lw=1.2, label="viewer")
        axes.plot([-0.5 * math.pi, 0.5 * math.pi], [end, end], color="0.3", lw=0.8)
        axes.set_theta_zero_location("N")
        ticks = np.arange(0, 360, 30)
        words = [f"{t if t <= 180 else t - 360}°".replace("-", "−") for t in ticks]
        axes.set_xticks(np.radians(ticks), words)
        axes.tick_params(axis="y", labelsize=7)
        axes.set_rlabel_position(105.0)
        rings = range(DECADES + 1) if k else MaxNLocator(4).tick_values(0.0, end)[1:-1]
        axes.set(rlim=(0.0, end), rticks=rings)
        if k:
            decades = FuncFormatter(lambda r, _: f"$10^{{{round(r) + low}}}$")
            axes.yaxis.set_major_formatter(decades)
        figure.text(0.25 + 0.5 * k, 0.885, title, ha="center", fontsize=11)
    figure.suptitle(f"{name}, viewer at {angle:g}°: f cos θi in the plane of incidence", y=0.97)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    columns = math.ceil(len(labels) / math.ceil(len(labels) / 6))
    figure.legend(handles, labels, loc="lower center", ncols=columns, frameon=False, fontsize=9)
    return figure


def over_hemisphere(
    name: str, angle: float, target: Function, lobes: Lobes, *, below: bool = False, size: int = 384
) -> "Figure":
    """Maps of target, lobes and residual over the direction cosines of the light.

    Parameters
    ----------
    name, angle, target, lobes
        As for `in_plane`.
    below
        Whether light from below counts: a second row, seen from above.
    size
        Pixels on a side. Of narrow lobes only their surroundings are shown.
    """
    from matplotlib.patches import Circle
    from matplotlib.ticker import MaxNLocator

    sides = (1.0, -1.0) if below else (1.0,)
    figure = pictures._figure(12.0, 0.6 + 3.3 * len(sides))
    rows = figure.subplots(len(sides), 3, squeeze=False)
    maps, windows = np.full((len(sides), 2, size, size), np.nan), []
    for found, side in zip(maps, sides, strict=True):
        x0, y0, half = _window(lobes, side)
        line = ((np.arange(size) + 0.5) / size * 2.0 - 1.0) * half
        x, y = np.meshgrid(x0 + line, y0 + line)
        inside = x * x + y * y < 1.0
        z = side * np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
        ways = np.stack([x, y, z], -1)[inside]
        found[0][inside], found[1][inside] = target(ways), _total(lobes, ways)
        windows.append((x0 - half, x0 + half, y0 - half, y0 + half))
    _compared(figure, rows, maps, windows, "1/sr")
    for row, side in zip(rows, sides, strict=True):
        row[0].set_ylabel("light above, y" if side > 0.0 else "light below, y")
        for axes in row:
            for ring in (15, 30, 45, 60, 75, 90):
                radius, shade = math.sin(math.radians(ring)), "0.4" if ring == 90 else "0.55"
                axes.add_patch(Circle((0.0, 0.0), radius, fc="none", ec=shade, lw=0.5))
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.yaxis.set_major_locator(MaxNLocator(5))
            axes.tick_params(labelsize=7)
            axes.set_xlabel("direction cosine x", fontsize=8)
    figure.suptitle(f"{name}, viewer at {angle:g}°: f cos θi against the light's direction")
    return figure


def over_map(name: str, image: Float[np.ndarray, "H W"], lobes: Lobes) -> "Figure":
    """An environment map, its lobes, and the residual, in longitude and latitude."""
    found = np.stack([image, _total(lobes, _grid(*image.shape)).reshape(image.shape)])
    figure = pictures._figure(8.0, 10.8)
    rows = figure.subplots(3, 1)
    _compared(figure, rows[None], found[None], [(0.0, 360.0, 180.0, 0.0)], "radiance")
    for axes in rows:
        _longitude(axes)
    rows[1].plot(*_degrees(np.asarray(lobes.mu)), "+", ms=7, color="cyan", mew=0.9)
    figure.suptitle(f"{name}: radiance and {lobes.count} lobes, axes at the crosses")
    return figure


def over_samples(
    name: str, directions: Float[np.ndarray, "N 3"], lobes: Lobes, *, height: int = 180
) -> "Figure":
    """The density of lobes, with samples as dots, in longitude and latitude."""
    from matplotlib.colors import LogNorm

    density = _total(lobes, _grid(height, 2 * height)).reshape(height, -1)
    peak = float(density.max()) or 1.0
    norm = LogNorm(peak * 10.0**-DECADES, peak, clip=True)
    figure = pictures._figure(8.0, 4.6)
    axes = figure.subplots()
    picture = axes.imshow(density, norm=norm, cmap="magma", extent=(0.0, 360.0, 180.0, 0.0))
    dots = directions[:: math.ceil(len(directions) / DOTS)]
    axes.plot(*_degrees(dots), ".", ms=2.0, color="white", alpha=0.6, mew=0)
    axes.plot(*_degrees(np.asarray(lobes.mu)), "+", ms=8, color="cyan", mew=1.2)
    _longitude(axes)
    figure.colorbar(picture, ax=axes, label="sum of the lobes, 1/sr", shrink=0.8)
    figure.suptitle(f"{name}: {len(directions)} samples, {lobes.count} lobes (axes at the crosses)")
    return figure


def in_blocks(function: Function, directions: np.ndarray) -> Float[np.ndarray, " N"]:
    """Values in blocks of one size: one compilation, little memory."""
    out = np.zeros(len(directions))
    for first in range(0, len(directions), tones.BLOCK):
        part = directions[first : first + tones.BLOCK]
        found = function(np.resize(part, (tones.BLOCK, 3)))
        out[first : first + tones.BLOCK] = found[: len(part)]
    return out


def _compared(
    figure: "Figure", rows: np.ndarray, maps: np.ndarray, windows: list, unit: str
) -> None:
    """Rows of target and lobes on one logarithmic scale, and their difference over the peak."""
    from matplotlib.colors import LogNorm

    peak = float(np.nanmax(maps)) or 1.0
    norm = LogNorm(peak * 10.0**-DECADES, peak, clip=True)
    off = 100.0 * (maps[:, 1] - maps[:, 0]) / peak
    end = float(np.nanmax(np.abs(off))) or 1.0
    for row, pair, missed, window in zip(rows, maps, off, windows, strict=True):
        place = {"extent": window, "origin": "lower" if window[3] > window[2] else "upper"}
        for axes, values in zip(row, pair, strict=False):
            axes.imshow(values, norm=norm, cmap="magma", **place)
        row[2].imshow(missed, vmin=-end, vmax=end, cmap="RdBu_r", **place)
        for axes, title in zip(row, ("target", "lobes", "lobes − target"), strict=True):
            axes.set_title(title, fontsize=10)
    left, right = rows[:, :2].ravel().tolist(), rows[:, 2].tolist()
    figure.colorbar(left[0].images[0], ax=left, label=unit, fraction=0.04)
    figure.colorbar(right[0].images[0], ax=right, label="% of the largest value", fraction=0.08)


def _each(lobes: Lobes, directions: np.ndarray) -> Float[np.ndarray, "K N"]:
    """Values of the single lobes, the mean of their channels."""
    alpha = lobes.alpha.reshape(lobes.count, -1).mean(-1)
    single = Lobes(alpha[:, None], lobes.mu[:, None], lobes.kappa[:, None])
    return np.asarray(single(np.broadcast_to(directions, (lobes.count, *directions.shape))))


def _total(lobes: Lobes, directions: np.ndarray) -> Float[np.ndarray, " N"]:
    """Values of the sum, the mean of the channels."""
    grey = Lobes(lobes.alpha.reshape(lobes.count, -1).mean(-1), lobes.mu, lobes.kappa)
    return in_blocks(lambda block: np.asarray(grey(block)), directions)


def _angles(lobes: Lobes) -> np.ndarray:
    """Angles in the plane, radians, dense about each lobe."""
    mu, kappa = np.asarray(lobes.mu, np.float64), np.asarray(lobes.kappa, np.float64)
    near = np.linspace(-6.0, 6.0, 81) / np.sqrt(np.maximum(kappa, 1.0))[:, None]
    near = np.arctan2(mu[:, 0], mu[:, 2])[:, None] + near
    near = (near + np.pi) % (2.0 * np.pi) - np.pi
    return np.sort(np.concatenate([np.linspace(-np.pi, np.pi, 1441), near.ravel()]))


def _window(lobes: Lobes, side: float) -> tuple[float, float, float]:
    """Centre and half side of a square about narrow lobes of one side; wide ones: the disc."""
    mu, kappa = np.asarray(lobes.mu, np.float64), np.asarray(lobes.kappa, np.float64)
    alpha = np.abs(np.asarray(lobes.alpha, np.float64).reshape(lobes.count, -1).mean(-1))
    counts = (alpha > 0.01 * alpha.sum()) & (mu[:, 2] * side > 0.0)
    if not counts.any():
        return 0.0, 0.0, 1.03
    reach = 5.0 / np.sqrt(np.maximum(kappa[counts], 1.0))[:, None]
    low, high = (mu[counts, :2] - reach).min(0), (mu[counts, :2] + reach).max(0)
    half = 0.5 * float((high - low).max())
    return (*(0.5 * (low + high)).tolist(), half) if half < 0.4 else (0.0, 0.0, 1.03)


def _grid(height: int, width: int) -> Float[np.ndarray, "N 3"]:
    """Centres of the pixels of a map."""
    theta = (np.arange(height) + 0.5) * np.pi / height
    phi = (np.arange(width) + 0.5) * 2.0 * np.pi / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    sin = np.sin(theta)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)


def _degrees(directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuths and angles to the normal."""
    x, y, z = np.asarray(directions, np.float64).T
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arctan2(np.hypot(x, y), z))


def _longitude(axes: "Axes") -> None:
    axes.set(xlim=(0.0, 360.0), ylim=(180.0, 0.0), aspect="equal")
    axes.set(xticks=range(0, 361, 60), yticks=range(0, 181, 45))
    axes.set_xlabel("phi / degrees", fontsize=9)
    axes.set_ylabel("theta / degrees", fontsize=9)
