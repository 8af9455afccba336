"""Plot and contact sheet of `diffopt.accuracy.render_comparison`."""

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from diffopt.accuracy import output
from diffopt.rendering import Image

if TYPE_CHECKING:
    from diffopt.accuracy.render_comparison import Row

# Colour and marker of a level; those with derived ambient light are hollow.
_STYLES = {
    "incremental": ("C0", "o"),
    "recursive": ("C1", "s"),
    "radiosity": ("C2", "^"),
    "radiosity+rays": ("C3", "v"),
    "path": ("0.35", "D"),
}


def plot(rows: "Sequence[Row]", path: str | os.PathLike | None) -> Any:
    """Error against time, both logarithmic: a panel for each scene, a mark for each level."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(row.scene for row in rows))
    columns = min(3, len(names))
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(3.7 * columns, 3.1 * lines + 0.6), layout="constrained")
    grid = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False)
    handles: dict[str, Any] = {}
    for axes in grid.flat[len(names) :]:
        axes.set_axis_off()
    for name, axes in zip(names, grid.flat, strict=False):
        here = [row for row in rows if row.scene == name]
        for row in here:
            kind = row.level.split(",")[0].split(" ")[0]
            colour, marker = _STYLES[kind]
            hollow = "derived" in row.level
            label = kind + (", derived ambient" if hollow else "")
            handles[label] = axes.plot(
                row.run_s,
                row.error,
                marker,
                ms=6,
                ls="",
                color=colour,
                markerfacecolor="none" if hollow else colour,
            )[0]
            if kind == "path":
                axes.annotate(
                    row.level.removeprefix("path "),
                    (row.run_s, row.error),
                    xytext=(5, 3),
                    textcoords="offset points",
                    fontsize=7,
                )
        paths = [row for row in here if row.level.startswith("path")]
        axes.plot([r.run_s for r in paths], [r.error for r in paths], color="0.35", lw=0.8)
        noise = here[0].reference_noise
        handles["noise of the reference"] = axes.axhline(noise, color="0.6", lw=0.8, ls=":")
        axes.set(xscale="log", yscale="log")
        axes.margins(0.08)
        axes.set_title(name, fontsize=9)
        axes.grid(alpha=0.2)
    for axes in grid[:, 0]:
        axes.set_ylabel("error over mean luminance", fontsize=8)
    # Where the panel below is empty the one above carries the labels.
    for index, axes in enumerate(grid.flat[: len(names)]):
        if index + columns >= len(names):
            axes.set_xlabel("time of a picture, s", fontsize=8)
            axes.tick_params(labelbottom=True)
    figure.legend(handles.values(), handles.keys(), fontsize=7, loc="outside lower center", ncols=4)
    figure.suptitle("Error against time; numbers: paths a pixel", fontsize=9)
    return output.saved(figure, path)


def sheet(
    rows: "Sequence[Row]",
    pictures: Mapping[str, Mapping[str, Image]],
    path: str | os.PathLike | None,
) -> Any:
    """All pictures at the exposure of the reference, with error and time beneath each."""
    from matplotlib.figure import Figure

    errors = {(row.scene, row.level): row for row in rows}
    levels = list(next(iter(pictures.values())))
    first = next(iter(pictures.values()))[""]
    aspect = first.radiance.shape[0] / first.radiance.shape[1]
    figure = Figure(
        figsize=(1.55 * len(levels), (1.55 * aspect + 0.14) * len(pictures) + 0.3),
        layout="constrained",
    )
    grid = figure.subplots(len(pictures), len(levels), squeeze=False)
    for line, (name, images) in zip(grid, pictures.items(), strict=True):
        exposure = images[""].exposure()
        for axes, level in zip(line, levels, strict=True):
            pixels = np.asarray(images[level].display(exposure))
            axes.imshow(pixels, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            for edge in axes.spines.values():
                edge.set_visible(False)
            if level:
                row = errors[name, level]
                text = f"{row.error:.1%}, {output.seconds(row.run_s)}"
            else:
                text = f"noise {images[level].noise:.1%}"
            axes.set_xlabel(text, fontsize=7, labelpad=2)
            if axes in grid[0]:
                samples = images[level].settings.spp
                axes.set_title(level or f"reference, {samples} paths", fontsize=7)
        line[0].set_ylabel(name, fontsize=8)
    return output.saved(figure, path)
