"""Quality against time, from incremental shading alone to everything at full settings.

Each scene is rendered by every level and by plans of several tolerances; errors are those of
`diffopt.accuracy.render_comparison`: mean absolute difference of the luminance from a path-traced
reference, over its mean.
"""

import dataclasses
import math
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diffopt import checks, rendering
from diffopt.accuracy import output, plan_scenes
from diffopt.planning.choosing import plan
from diffopt.planning.plans import Plan
from diffopt.rendering.images import Image
from diffopt.rendering.settings import (
    IncrementalSettings,
    PathSettings,
    RecursiveSettings,
    Settings,
)
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene

#: Levels from the cheapest on.
STEPS: dict[str, Settings] = {
    "incremental, 1 sample": IncrementalSettings(spp=1),
    "incremental": IncrementalSettings(),
    "recursive": RecursiveSettings(),
    "radiosity+rays": rendering.RadiosityRaysSettings(),
    "path 16": PathSettings(spp=16),
    "path 64": PathSettings(spp=64),
    "path 256": PathSettings(spp=256),
}
#: Scenes that are shown, each with what tells it apart.
SHOWN = ("sunlit-card", "glass-over-checks", "cornell", "compact-disc", "everything")
#: Tolerances of plans.
TOLERANCES = (0.1, 0.03, 0.01, 0.003)
# Seed of references: equal seeds would share their noise.
_REFERENCE_SEED = 1

# Called before each picture with its number from 0, their number, and what it is.
Progress = Callable[[int, int, str], None]


@dataclasses.dataclass(frozen=True)
class Step:
    """One picture.

    Attributes
    ----------
    scene, way
        The scene, and a level or ``plan 0.03``.
    tolerance
        Of a plan, None for a level.
    error, run_s
        As of `diffopt.accuracy.render_comparison.Row`; the time of planning apart.
    plan_s
        Seconds of planning, after compilation.
    predicted
        Error that the plan promised: bound of what is out, and noise.
    reference_noise
        Part of the error that is the reference's.
    effects
        In the plan.
    """

    scene: str
    way: str
    tolerance: float | None
    error: float
    run_s: float
    plan_s: float
    predicted: float | None
    reference_noise: float
    effects: str


@dataclasses.dataclass(frozen=True)
class Ladders:
    """Steps of all scenes."""

    steps: tuple[Step, ...]

    def table(self) -> Any:
        """A `rich.table.Table` of all steps."""
        from rich.table import Table

        found = Table(
            title="From incremental shading to everything, and what plans choose",
            caption="Error: mean |difference| of luminance over its mean, the noise of the "
            "reference beside it. Times after compilation.",
        )
        for name in ("scene", "way", "error", "noise of reference", "promised", "time", "plan"):
            found.add_column(name, justify="left" if name in ("scene", "way") else "right")
        for step in self.steps:
            found.add_row(
                step.scene,
                step.way,
                f"{step.error:.2%}",
                f"{step.reference_noise:.2%}",
                "" if step.predicted is None else f"{step.predicted:.2%}",
                output.seconds(step.run_s),
                output.seconds(step.plan_s) if step.tolerance is not None else "",
            )
        return found

    def __str__(self) -> str:
        return output.as_text(self.table())

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write the steps."""
        names = [field.name for field in dataclasses.fields(Step)]
        output.write_csv(names, [dataclasses.astuple(step) for step in self.steps], path)

    def plot(self, path: str | os.PathLike | None = None) -> Any:
        """Error against time, a panel for each scene; PNG, PDF or SVG by its ending."""
        from matplotlib.figure import Figure

        names = list(dict.fromkeys(step.scene for step in self.steps))
        columns = min(3, len(names))
        lines = -(-len(names) // columns)
        figure = Figure(figsize=(3.9 * columns, 3.3 * lines + 0.4), layout="constrained")
        grid = figure.subplots(lines, columns, squeeze=False)
        for axes in grid.flat[len(names) :]:
            axes.set_axis_off()
        for name, axes in zip(names, grid.flat, strict=False):
            here = [step for step in self.steps if step.scene == name]
            _panel(axes, name, here)
        handles, labels = grid.flat[0].get_legend_handles_labels()
        figure.legend(handles, labels, fontsize=7, loc="outside lower center", ncols=4)
        figure.suptitle("Error against time; numbers: tolerances of plans", fontsize=9)
        return output.saved(figure, path)


# Colour and marker of a step.
_STYLES = {
    "incremental, 1 sample": ("C0", "."),
    "incremental": ("C0", "o"),
    "recursive": ("C1", "s"),
    "radiosity+rays": ("C2", "^"),
    "path 16": ("0.7", "p"),
    "path 64": ("0.5", "p"),
    "path 256": ("0.25", "p"),
}


def _panel(axes: Any, name: str, here: Sequence[Step]) -> None:
    for step in here:
        if step.tolerance is None:
            colour, marker = _STYLES[step.way]
            axes.plot(step.run_s, step.error, marker, color=colour, ls="", ms=6, label=step.way)
    plans = [step for step in here if step.tolerance is not None]
    times, errors = [step.run_s for step in plans], [step.error for step in plans]
    axes.plot(times, errors, "D-", color="C3", lw=0.8, ms=5, label="plan")
    for k, step in enumerate(plans):
        axes.annotate(
            f"{step.tolerance:g}",
            (step.run_s, step.error),
            xytext=(5, 4 - 9 * (k % 2)),
            textcoords="offset points",
            fontsize=7,
            color="C3",
        )
    noise = here[0].reference_noise
    axes.axhline(noise, color="0.6", lw=0.8, ls=":", label="noise of the reference")
    axes.set(xscale="log", yscale="log")
    axes.margins(0.12)
    axes.set_title(name, fontsize=9)
    axes.set_xlabel("time of a picture, s", fontsize=8)
    axes.set_ylabel("error over mean luminance", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.2)


def climb(
    names: Sequence[str] = SHOWN,
    *,
    tolerances: Sequence[float] = TOLERANCES,
    reference: int = 1024,
    resolution: tuple[int, int] = (96, 72),
    most_spp: int = 1024,
    progress: Progress | None = None,
) -> Ladders:
    """Render scenes by all levels and by plans.

    Parameters
    ----------
    names
        Of `diffopt.accuracy.plan_scenes.SCENES`.
    tolerances
        Of the plans.
    reference
        Paths of a pixel of the reference.
    resolution
        Columns and rows.
    most_spp
        As of `diffopt.plan`.
    progress
        Told of the pictures.
    """
    for name in names:
        checks.choice("scene", name, tuple(plan_scenes.SCENES))
    steps: list[Step] = []
    count = len(names) * (len(STEPS) + len(tolerances) + 1)

    def report(number: int, text: str) -> None:
        if progress is not None:
            progress(number, count, text)

    for k, name in enumerate(names):
        at = k * (len(STEPS) + len(tolerances) + 1)
        scene, camera = plan_scenes.planned(name)
        camera = dataclasses.replace(camera, resolution=resolution)
        report(at, f"{name}, reference")
        truth = rendering.render(scene, camera, spp=reference, seed=_REFERENCE_SEED)
        right, noise = truth.xyz[..., 1], truth.noise * math.sqrt(2.0 / math.pi)

        def error(image: Image, right: np.ndarray = right) -> float:
            off = image.xyz[..., 1] - right
            return float(np.abs(off).mean() / right.mean())

        for j, (way, settings) in enumerate(STEPS.items()):
            report(at + 1 + j, f"{name}, {way}")
            image, seconds = _timed(scene, camera, settings)
            steps.append(Step(name, way, None, error(image), seconds, 0.0, None, noise, ""))
        for j, tolerance in enumerate(tolerances):
            report(at + 1 + len(STEPS) + j, f"{name}, plan {tolerance:g}")
            plan(scene, camera, tolerance, most_spp=most_spp)
            begin = time.perf_counter()
            chosen = plan(scene, camera, tolerance, most_spp=most_spp)
            planning = time.perf_counter() - begin
            image, seconds = _timed(scene, camera, chosen)
            inside = " ".join(row.effect for row in chosen.rows if row.included)
            promised = chosen.bias + chosen.noise
            steps.append(
                Step(
                    name,
                    f"plan {tolerance:g}",
                    tolerance,
                    error(image),
                    seconds,
                    planning,
                    promised,
                    noise,
                    inside,
                )
            )
    return Ladders(tuple(steps))


def _timed(scene: Scene, camera: Camera, how: Settings | Plan) -> tuple[Image, float]:
    """A picture, and the seconds of a second one; of the first where that is long."""

    def picture() -> tuple[Image, float]:
        begin = time.perf_counter()
        if isinstance(how, Settings):
            image = rendering.render(scene, camera, settings=how)
        else:
            image = rendering.render(scene, camera, how)
        return image, time.perf_counter() - begin

    image, seconds = picture()
    return picture() if seconds < 120.0 else (image, seconds)
