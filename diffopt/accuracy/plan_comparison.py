"""Plans over many scenes: what is left out, whether that is right, and what it saves.

Each scene is planned twice (the second time nothing compiles), checked, and rendered by its plan
and with everything on at the same noise.
"""

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from typing import Any

from diffopt import checks, rendering
from diffopt.accuracy import output, plan_scenes
from diffopt.planning import checking, choosing, reasons
from diffopt.planning.costs import MEAN
from diffopt.planning.pilot import fly
from diffopt.planning.reductions import EFFECTS, REPLACED, has
from diffopt.rendering.effects import Composition
from diffopt.rendering.settings import PathSettings
from diffopt.rendering.stage import Stage
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene

# Called before each scene with its number from 0, their number, and its name.
Progress = Callable[[int, int, str], None]
# Bounces of everything, and paths of a pixel that are timed.
_DEEPEST, _FEW = 32, 64


@dataclasses.dataclass(frozen=True)
class Row:
    """One scene.

    Attributes
    ----------
    scene
        Its name.
    tolerance
        Of the plan.
    included, excluded
        Effects that the scene has: in the plan, and not.
    worst, worst_effect
        Largest real difference of an excluded effect, and which.
    together, bound
        Real difference of all that is out, and the plan's bound of it.
    needless
        Effects that could be out as well.
    level
        Of the planned picture.
    plan_s
        Seconds of planning, after compilation.
    planned_s, everything_s
        Seconds of the picture by its plan, after compilation, and by paths with everything, as
        many as the noise that the plan promises takes: a few are timed, the time of all is in
        proportion.
    """

    scene: str
    tolerance: float
    included: tuple[str, ...]
    excluded: tuple[str, ...]
    worst: float
    worst_effect: str
    together: float
    bound: float
    needless: tuple[str, ...]
    level: str
    plan_s: float
    planned_s: float
    everything_s: float


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Rows, and what they come to."""

    rows: tuple[Row, ...]

    @property
    def needless(self) -> float:
        """Share of the effects that are in without need."""
        return sum(len(row.needless) for row in self.rows) / max(
            sum(len(row.included) for row in self.rows), 1
        )

    @property
    def exceeded(self) -> tuple[str, ...]:
        """Scenes where something excluded makes more than the tolerance."""
        return tuple(row.scene for row in self.rows if max(row.worst, row.together) > row.tolerance)

    def table(self) -> Any:
        """A `rich.table.Table` of the scenes."""
        from rich.table import Table

        found = Table(
            title="Plans over scenes that call for different effects",
            caption=f"In without need: {self.needless:.1%} of the effects. Exceeded: "
            f"{', '.join(self.exceeded) or 'nowhere'}. Times after compilation.",
        )
        for name in ("scene", "in", "out", "worst excluded"):
            found.add_column(name)
        for name in ("together", "bound", "needless", "plan", "planned", "everything"):
            found.add_column(name, justify="right")
        for row in self.rows:
            found.add_row(
                row.scene,
                ", ".join(row.included),
                str(len(row.excluded)),
                f"{row.worst_effect} {row.worst:.2%}" if row.excluded else "",
                f"{row.together:.2%}",
                f"{row.bound:.2%}",
                ", ".join(row.needless),
                output.seconds(row.plan_s),
                f"{output.seconds(row.planned_s)} {row.level}",
                output.seconds(row.everything_s),
            )
        return found

    def __str__(self) -> str:
        return output.as_text(self.table())

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write the rows."""
        names = [field.name for field in dataclasses.fields(Row)]
        rows = [
            [" ".join(v) if isinstance(v, tuple) else v for v in dataclasses.astuple(row)]
            for row in self.rows
        ]
        output.write_csv(names, rows, path)


def compare(
    names: Sequence[str] | None = None,
    *,
    tolerance: float = 0.03,
    resolution: tuple[int, int] = (96, 72),
    most_spp: int = 256,
    pixels: int = checking.PIXELS,
    paths: int = checking.SAMPLES,
    render: bool = True,
    progress: Progress | None = None,
) -> Comparison:
    """Plan, check and render scenes.

    Parameters
    ----------
    names
        Of `diffopt.accuracy.plan_scenes.SCENES`; all by default.
    tolerance, most_spp
        As of `diffopt.plan`.
    resolution
        Columns and rows of the pictures.
    pixels, paths
        Of the check.
    render
        Whether pictures are rendered and timed; their times are 0 otherwise.
    progress
        Told of the scenes.

    Raises
    ------
    InputError
        For an unknown name.
    """
    known = tuple(plan_scenes.SCENES)
    wanted = [checks.choice("scene", name, known) for name in names or known]
    rows = []
    for k, name in enumerate(wanted):
        if progress is not None:
            progress(k, len(wanted), name)
        scene, camera = plan_scenes.planned(name)
        camera = dataclasses.replace(camera, resolution=resolution)
        rows.append(_row(name, scene, camera, tolerance, most_spp, pixels, paths, render))
    return Comparison(tuple(rows))


def _row(
    name: str,
    scene: Scene,
    camera: Camera,
    tolerance: float,
    most: int,
    pixels: int,
    paths: int,
    render: bool,
) -> Row:
    choosing.plan(scene, camera, tolerance, most_spp=most)
    begin = time.perf_counter()
    plan = choosing.plan(scene, camera, tolerance, most_spp=most)
    plan_s = time.perf_counter() - begin
    found = checking.check(scene, camera, plan, pixels=pixels, paths=paths)
    planned_s = everything_s = 0.0
    if render:
        every = Composition(bounces=_DEEPEST, coherent=_DEEPEST)
        seen = fly(scene, camera, every)
        wanted = (MEAN * seen.noise(seen.light) / plan.noise) ** 2
        few = PathSettings(spp=_FEW, depth=_DEEPEST)
        planned_s = _timed(lambda: rendering.render(scene, camera, plan))
        some_s = _timed(lambda: rendering.render(scene, camera, settings=few))
        everything_s = some_s * max(wanted, 1.0) / _FEW
    stage = Stage(scene)
    own = [e for e in EFFECTS if (has(scene, e) if e in REPLACED else not reasons.absent(e, stage))]
    out = [row for row in found.rows if not row.included]
    worst = max(out, key=lambda row: row.measured, default=None)
    return Row(
        name,
        tolerance,
        tuple(effect for effect in own if effect not in plan.excluded),
        tuple(effect for effect in own if effect in plan.excluded),
        worst.measured if worst else 0.0,
        worst.effect if worst else "",
        found.together,
        plan.bias,
        found.needless,
        plan.settings.level,
        plan_s,
        planned_s,
        everything_s,
    )


def _timed(work: Callable[[], Any]) -> float:
    """Seconds of a second run."""
    work()
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin
