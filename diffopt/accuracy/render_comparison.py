"""Levels of image synthesis against a path-traced reference: error and time of a picture.

The error of a picture is the mean absolute difference of its luminance from the reference's,
over the mean luminance. The reference has noise of its own, which is stated beside: errors near
it are those of the reference.
"""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diffopt import checks, rendering
from diffopt.accuracy import output, render_pictures, render_scenes
from diffopt.errors import InputError
from diffopt.rendering import Image
from diffopt.rendering.settings import (
    IncrementalSettings,
    PathSettings,
    RecursiveSettings,
    Settings,
)

#: Levels by name, those without noise.
LEVELS: dict[str, Settings] = {
    "incremental": IncrementalSettings(),
    "incremental, derived": IncrementalSettings(ambient="derived"),
    "recursive": RecursiveSettings(),
    "recursive, derived": RecursiveSettings(ambient="derived"),
    "radiosity": rendering.RadiositySettings(),
    "radiosity+rays": rendering.RadiosityRaysSettings(),
}
#: Samples of the path-traced pictures.
SPP = (1, 4, 16, 64)
# Pictures that are compared use seed 0: equal seeds would share the noise of the reference.
_REFERENCE_SEED = 1

# Called before each picture with its number from 0, their number, and what it is.
Progress = Callable[[int, int, str], None]


@dataclasses.dataclass(frozen=True)
class Row:
    """A picture of one scene by one level.

    Attributes
    ----------
    scene, level
        Names.
    error
        Mean absolute difference of the luminance from the reference, over its mean.
    bias
        Mean difference, over the same: what the level leaves out, or adds.
    reference_noise
        Part of the error that is the reference's, if its noise is normal.
    run_s, run_spread
        Median of the times of a picture, and the distance of their quartiles, seconds.
        Everything that belongs to one picture, the solution of radiosity among it.
    compile_s
        Seconds by which the first picture took longer. Programs that levels share count for
        the first of them.
    """

    scene: str
    level: str
    error: float
    bias: float
    reference_noise: float
    run_s: float
    run_spread: float
    compile_s: float


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Rows, and the pictures by scene and level; ``""`` is the reference."""

    rows: tuple[Row, ...]
    pictures: dict[str, dict[str, Image]]

    def table(self) -> Any:
        """A `rich.table.Table` of all rows."""
        from rich.table import Table

        first = next(iter(self.pictures.values()))[""]
        columns, lines = first.radiance.shape[1], first.radiance.shape[0]
        found = Table(
            title="Levels of image synthesis against path tracing",
            caption=f"Error: mean |difference| of luminance over its mean, {columns}x{lines} "
            f"pixels; reference: {first.settings.spp} paths a pixel. Medians, without compilation.",
        )
        for name in ("scene", "level"):
            found.add_column(name)
        for name in ("error", "bias", "noise of reference", "time", "spread", "compile"):
            found.add_column(name, justify="right")
        for row in self.rows:
            found.add_row(
                row.scene,
                row.level,
                f"{row.error:.1%}",
                f"{row.bias:+.1%}",
                f"{row.reference_noise:.1%}",
                output.seconds(row.run_s),
                output.seconds(row.run_spread),
                f"{row.compile_s:.2g} s",
            )
        return found

    def __str__(self) -> str:
        return output.as_text(self.table())

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write the rows."""
        names = [field.name for field in dataclasses.fields(Row)]
        output.write_csv(names, [dataclasses.astuple(row) for row in self.rows], path)

    def plot(self, path: str | os.PathLike | None = None) -> Any:
        """Error against time, a panel for each scene; PNG, PDF or SVG by its ending."""
        return render_pictures.plot(self.rows, path)

    def sheet(self, path: str | os.PathLike | None = None) -> Any:
        """All pictures, a row for each scene, the reference first."""
        return render_pictures.sheet(self.rows, self.pictures, path)


def settings(level: str, spp: Sequence[int] = SPP) -> dict[str, Settings]:
    """Settings of a level by the names that they have in rows; several of ``path``."""
    checks.choice("level", level, (*LEVELS, "path"))
    if level != "path":
        return {level: LEVELS[level]}
    return {f"path {count}": PathSettings(spp=count) for count in spp}


def compare(
    names: Sequence[str] | None = None,
    levels: Sequence[str] | None = None,
    *,
    spp: Sequence[int] = SPP,
    reference: int = 512,
    resolution: tuple[int, int] = (96, 72),
    repeats: int = 3,
    progress: Progress | None = None,
) -> Comparison:
    """Render every scene by every level.

    Parameters
    ----------
    names
        Some of `diffopt.accuracy.render_scenes.COMPARED`; all if left out.
    levels
        Some of `LEVELS`, and ``path``; all if left out.
    spp
        Samples of the path-traced pictures.
    reference
        Samples of the reference.
    resolution
        Columns and rows.
    repeats
        Timed pictures of each. The levels of a scene take turns, so that ratios hold on a
        busy machine.
    progress
        Told of the pictures.

    Raises
    ------
    InputError
        For an unknown name, or a number below 1.
    """
    if repeats < 1:
        raise InputError(f"repeats must be at least 1; received {repeats}")
    ways: dict[str, Settings] = {}
    for level in (*LEVELS, "path") if levels is None else levels:
        ways.update(settings(level, spp))
    known = tuple(render_scenes.COMPARED)
    chosen = [checks.choice("scene", n, known) for n in (known if names is None else names)]
    truth = PathSettings(spp=reference, seed=_REFERENCE_SEED)
    count = len(chosen) * (len(ways) + 1)
    rows: list[Row] = []
    pictures: dict[str, dict[str, Image]] = {}

    def report(text: str) -> None:
        if progress is not None:
            progress(len(rows) + len(pictures), count, text)

    for name in chosen:
        scene, camera = render_scenes.compared(name)
        camera = dataclasses.replace(camera, resolution=resolution)
        images: dict[str, Image] = {}
        first, runs = {}, {way: [] for way in ways}
        for turn in range(repeats + 1):
            for way, how in ways.items():
                report(f"{name}, {way}")
                begin = time.perf_counter()
                images[way] = rendering.render(scene, camera, settings=how)
                seconds = time.perf_counter() - begin
                if turn:
                    runs[way].append(seconds)
                else:
                    first[way] = seconds
        # Last, so that it compiles nothing that would be missing in the times of others.
        report(f"{name}, reference")
        images = {"": rendering.render(scene, camera, settings=truth), **images}
        rows += [_row(name, way, images, first[way], runs[way]) for way in ways]
        pictures[name] = images
    report("")
    return Comparison(tuple(rows), pictures)


def _row(name: str, way: str, images: dict[str, Image], first: float, runs: Sequence[float]) -> Row:
    truth, image = images[""], images[way]
    weights = image.channels.luminance()
    expected = truth.radiance @ weights
    difference = image.radiance @ weights - expected
    low, middle, high = np.quantile(runs, [0.25, 0.5, 0.75])
    mean = float(expected.mean())
    return Row(
        scene=name,
        level=way,
        error=float(np.abs(difference).mean()) / mean,
        bias=float(difference.mean()) / mean,
        # The mean of |x| of a normal variable over its deviation.
        reference_noise=truth.noise * math.sqrt(2.0 / math.pi),
        run_s=float(middle),
        run_spread=float(high - low),
        compile_s=max(first - float(middle), 0.0),
    )
