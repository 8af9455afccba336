"""Whether a plan holds: the real difference that each excluded effect makes.

Everything is rendered at low resolution, path by path as in `diffopt.planning.pilot`, with more
paths and another seed than the plan's own. What an effect brings alone is found with its
standard error; simpler stand-ins are compared on the same paths.
"""

import dataclasses
from typing import Any

import numpy as np

from diffopt.planning import pilot, reasons, replacing
from diffopt.planning.choosing import LEFT_OUT
from diffopt.planning.plans import Plan
from diffopt.planning.replacing import Progress
from diffopt.rendering.effects import BITS, PATHS, SHADOWS, Composition
from diffopt.rendering.stage import Stage
from diffopt.scenes.camera import Camera
from diffopt.scenes.channels import Channels
from diffopt.scenes.scene import Scene

#: Pixels of the picture, about, and paths of each.
PIXELS, SAMPLES = 1500, 256
# Bounces that count as everything.
_DEEPEST = 32


@dataclasses.dataclass(frozen=True)
class Difference:
    """What one effect makes.

    Attributes
    ----------
    effect, included
        Of the plan.
    bound
        That the plan gave; None where it gave none.
    measured, error
        Mean absolute difference of luminance over its mean, without the effect alone, and its
        standard error.
    percentile
        99th percentile of that over the pixels (with their noise).
    delta_e, delta_e_percentile
        CIE 2000, mean and 99th percentile.
    """

    effect: str
    included: bool
    bound: float | None
    measured: float
    error: float
    percentile: float
    delta_e: float
    delta_e_percentile: float


@dataclasses.dataclass(frozen=True)
class Check:
    """A plan beside what is real.

    Attributes
    ----------
    plan
        The plan.
    rows
        Each effect that the scene has.
    together
        Difference that all excluded effects make together.
    """

    plan: Plan
    rows: tuple[Difference, ...]
    together: float

    @property
    def passed(self) -> bool:
        """Whether no excluded effect exceeds the tolerance, alone or all together."""
        alone = (row.measured - 2.0 * row.error for row in self.rows if not row.included)
        return max([*alone, self.together]) <= self.plan.tolerance

    @property
    def needless(self) -> tuple[str, ...]:
        """Effects that could be out as well: with them, what is out would stay within its share."""
        rest = LEFT_OUT * self.plan.tolerance - self.together
        return tuple(
            row.effect
            for row in self.rows
            if row.included and row.effect != "matte-light" and row.measured <= rest
        )

    def table(self) -> Any:
        """A `rich.table.Table` of the effects."""
        from rich.table import Table

        needless = ", ".join(self.needless) or "none"
        found = Table(
            title=f"Plan for a tolerance of {self.plan.tolerance:g}: real differences",
            caption=f"Left out together: {self.together:.2%}, bound {self.plan.bias:.2%}. "
            f"In without need: {needless}.",
        )
        found.add_column("effect", no_wrap=True)
        found.add_column("in")
        for name in ("bound", "without it", "+-", "99 %", "delta E", "99 %"):
            found.add_column(name, justify="right")
        for row in self.rows:
            found.add_row(
                row.effect,
                "in" if row.included else "-",
                "" if row.bound is None else f"{row.bound:.2%}",
                f"{row.measured:.2%}",
                f"{row.error:.2%}",
                f"{row.percentile:.1%}",
                f"{row.delta_e:.2g}",
                f"{row.delta_e_percentile:.2g}",
            )
        return found

    def __str__(self) -> str:
        from diffopt.accuracy import output

        return output.as_text(self.table())

    def summary(self) -> dict[str, Any]:
        """Numbers and words for records."""
        return {
            "passed": self.passed,
            "together": self.together,
            "needless": list(self.needless),
            "effects": [dataclasses.asdict(row) for row in self.rows],
        }


def check(
    scene: Scene,
    camera: Camera,
    plan: Plan,
    *,
    pixels: int = PIXELS,
    paths: int = SAMPLES,
    seed: int = 1,
    progress: Progress | None = None,
) -> Check:
    """Measure what a plan left out.

    Parameters
    ----------
    scene, camera
        As they were planned.
    plan
        From `diffopt.plan`.
    pixels, paths
        Of the small picture, about, and of each pixel.
    seed
        Another one than the plan's, so that its noise is not taken for light.
    progress
        Called with (parts done, parts in all).
    """
    stage, shared = Stage(scene), {"seed": seed, "backend": plan.settings.backend}
    every = Composition(bounces=_DEEPEST, coherent=_DEEPEST)
    size = pilot.resolution(camera, pixels)
    pictures = _Pictures(scene.channels, size[0] * size[1], paths)
    few = {"pixels": pixels, "paths": paths, "stage": stage, "notes": pictures}
    seen = pilot.fly(scene, camera, every, **shared, **few)
    changes = replacing.differences(
        scene, camera, **shared, pixels=pixels, paths=max(paths // 8, 1), progress=progress
    )
    if progress is not None:
        progress(len(changes) + 1, len(changes) + 1)
    rows = []
    for row in plan.rows:
        if row.effect in changes:
            found = changes[row.effect]
            measured = found.bound, 0.0, found.percentile, found.delta_e, found.delta_e_percentile
        elif row.effect in PATHS and not reasons.absent(row.effect, stage):
            measured = _of_paths(row.effect, seen, pictures)
        else:
            continue
        rows.append(Difference(row.effect, row.included, row.bound, *measured))
    composition = plan.composition
    lost = seen.lost(plan.excluded, composition.bounces, composition.coherent)
    together = seen.share(lost | seen.bare(composition))[0]
    together += sum(one.bound for name, one in changes.items() if name in plan.excluded)
    return Check(plan, tuple(rows), together)


class _Pictures(pilot.Notes):
    """Notes, and pictures of the light of all paths and of those that need each effect."""

    def __init__(self, channels: Channels, pixels: int, paths: int) -> None:
        super().__init__(channels.luminance())
        self.channels, self.paths = channels, paths
        self.light = np.zeros((pixels, channels.count))
        self.parts = np.zeros((len(PATHS), pixels, channels.count))

    def add(self, home: Any, code: Any, values: Any, owner: Any) -> None:
        """See `Ledger`."""
        super().add(home, code, values, owner)
        pixel, hidden = self.samples[home] // self.paths, owner >= 0
        np.add.at(self.light, pixel[~hidden], values[~hidden])
        for k, name in enumerate(PATHS):
            which = ((code & BITS[name]) != 0) & (hidden == (name in SHADOWS))
            np.add.at(self.parts[k], pixel[which], values[which])


def _of_paths(
    effect: str, seen: pilot.Pilot, pictures: _Pictures
) -> tuple[float, float, float, float, float]:
    """What an effect brings, its error, percentile and colours."""
    lost = seen.lost([effect])
    each = np.zeros(seen.pixels * seen.paths)
    np.add.at(each, seen.sample[lost], np.abs(seen.luminance[lost]))
    spread = float(np.sqrt(len(each)) * each.std()) / max(seen.total, 1e-30)
    light = pictures.channels.xyz(pictures.light)
    without = light - pictures.channels.xyz(pictures.parts[PATHS.index(effect)])
    found = replacing.compared(without, light)
    return found.bound, spread, found.percentile, found.delta_e, found.delta_e_percentile
