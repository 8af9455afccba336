"""Ways to precompute transfer against brute force, on one scene, in one run.

``diffopt compare transfer``: adaptive tessellation against uniform ones, one lobe against two,
the initial triangles alone, and what is lost without indirect light.
"""

import dataclasses
import itertools
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from diffopt import checks
from diffopt.accuracy import output, transfer_runs, transfer_scenes
from diffopt.accuracy.transfer_runs import Setup
from diffopt.errors import InputError
from diffopt.transfer import relighting
from diffopt.transfer.settings import TransferSettings

#: Ways: changes of the settings, how often all triangles are split in place of adaptively.
WAYS: dict[str, tuple[dict[str, Any], int | None]] = {
    "adaptive": ({}, None),
    "adaptive, 2 lobes": ({"lobes": 2}, None),
    "adaptive, per vertex": ({}, None),
    "adaptive, no indirect": ({}, None),
    "initial": ({}, 0),
    "uniform 1": ({}, 1),
    "uniform 2": ({}, 2),
    "uniform 3": ({}, 3),
}
# Those with 64 times the triangles.
_LONG = ("uniform 3",)
_UNIFORM = ("initial", "uniform 1", "uniform 2", "uniform 3")


@dataclasses.dataclass(frozen=True)
class Row:
    """One way on one scene.

    Attributes
    ----------
    scene, way
        Names.
    rmse, noise, bias, worst, ssim
        See `diffopt.accuracy.transfer_runs.Score`.
    vertices, slices, megabytes
        Of the transfer.
    precompute_s, core_ms
        Seconds of the precomputation, and milliseconds of cores for each vertex, without
        compilation where it ran twice.
    frame_s
        Median seconds of a frame under turned light.
    """

    scene: str
    way: str
    rmse: float
    noise: float
    bias: float
    worst: float
    ssim: float
    vertices: int
    slices: int
    megabytes: float
    precompute_s: float
    core_ms: float
    frame_s: float


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All rows of one run."""

    rows: tuple[Row, ...]
    light: str

    def equal(self, scene: str) -> float | None:
        """Vertices of an even tessellation with the error of the adaptive one.

        By the powers between which the even ones lie; None where they do not reach it.
        """
        rows = {row.way: row for row in self.rows if row.scene == scene}
        even = [rows[way] for way in _UNIFORM if way in rows]
        if "adaptive" not in rows or len(even) < 2:
            return None
        aim = rows["adaptive"].rmse
        for one, other in itertools.pairwise(even):
            if one.rmse > aim >= other.rmse > 0.0:
                share = np.log(one.rmse / aim) / np.log(one.rmse / other.rmse)
                return float(one.vertices * (other.vertices / one.vertices) ** share)
        return None

    def table(self) -> Any:
        """A `rich.table.Table` of all rows."""
        from rich.table import Table

        words = []
        for scene in dict.fromkeys(row.scene for row in self.rows):
            count = self.equal(scene)
            if count is not None:
                own = next(r for r in self.rows if (r.scene, r.way) == (scene, "adaptive"))
                words.append(
                    f"{scene}: {own.vertices:,} adaptive vertices are as good as {count:,.0f} "
                    "even ones"
                )
        found = Table(
            title=f"Precomputed transfer against brute force, under {self.light}",
            caption="RMSE and worst 1 % over the mean; noise of the truth is taken out of the "
            "RMSE. " + "; ".join(words),
        )
        for name in ("scene", "way"):
            found.add_column(name)
        for name in ("RMSE", "noise", "bias", "worst 1 %", "SSIM", "vertices", "size"):
            found.add_column(name, justify="right")
        for name in ("precompute", "core-ms a vertex", "frames a second"):
            found.add_column(name, justify="right")
        for row in self.rows:
            found.add_row(
                row.scene,
                row.way,
                f"{row.rmse:.2%}",
                f"{row.noise:.2%}",
                f"{row.bias:+.2%}",
                f"{row.worst:.1%}",
                f"{row.ssim:.4f}",
                f"{row.vertices:,}",
                f"{row.megabytes:.3g} MB",
                output.seconds(row.precompute_s),
                f"{row.core_ms:.3g}",
                f"{1.0 / row.frame_s:.3g}",
            )
        return found

    def __str__(self) -> str:
        return output.as_text(self.table())

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write the rows."""
        names = [field.name for field in dataclasses.fields(Row)]
        output.write_csv(names, [dataclasses.astuple(row) for row in self.rows], path)


def compare(
    scenes: Sequence[str] | None = None,
    ways: Sequence[str] | None = None,
    *,
    light: str = "suns",
    settings: TransferSettings | None = None,
    detail: int = 4,
    resolution: int = 96,
    paths: int = 2048,
    again: bool = True,
    progress: Callable[[int, int, str], object] | None = None,
) -> Comparison:
    """Error, size and time of ways on scenes.

    Parameters
    ----------
    scenes
        Of `diffopt.accuracy.transfer_scenes.SCENES`. [default: both teapots]
    ways
        Of `WAYS`. [default: all but the finest even tessellation]
    light
        "suns" or "sky".
    settings
        Of the precomputation.
    detail, resolution, paths
        See `diffopt.accuracy.transfer_runs.Setup`.
    again
        Whether to precompute twice, so that no time is that of compilation.
    progress
        Called with what is done, how much there is, and what is next.

    Raises
    ------
    InputError
        For unknown names; settings that transfer refuses.
    """
    known = transfer_scenes.SCENES
    names = [checks.choice("scene", n, known) for n in scenes or known[:2]]
    chosen = [checks.choice("way", w, tuple(WAYS)) for w in ways or set(WAYS) - set(_LONG)]
    chosen = [way for way in WAYS if way in chosen]
    checks.choice("light", light, transfer_scenes.LIGHTS)
    if detail < 2 or resolution < 8:
        raise InputError(
            f"detail and resolution must be at least 2 and 8; received {detail}, {resolution}"
        )
    base = settings or TransferSettings()
    rows = []
    for name in names:
        setup = Setup(name, light, detail, resolution, paths)
        for way in chosen:
            if progress is not None:
                progress(len(rows), len(names) * len(chosen), f"{name}, {way}")
            rows.append(_row(setup, way, base, again))
    return Comparison(tuple(rows), light)


def _row(setup: Setup, way: str, base: TransferSettings, again: bool) -> Row:
    changes, uniform = WAYS[way]
    own = dataclasses.replace(base, **changes)
    found = transfer_runs.made(setup.scene, setup.detail, own, uniform, again)
    transfer = found.transfer
    if way == "adaptive, no indirect":
        transfer = transfer_runs.without_indirect(transfer)
    held = relighting.tables(transfer)
    light = transfer_runs.lighting(setup.light)
    at = transfer_runs.seen(transfer, setup)
    fine = way != "adaptive, per vertex"
    image = transfer_runs.picture(held, light, at, fine)
    score = transfer_runs.score(
        image, transfer_runs.reference(setup), transfer_runs.covered(transfer, setup)
    )
    count = len(transfer.level)
    return Row(
        scene=setup.scene,
        way=way,
        **dataclasses.asdict(score),
        vertices=count,
        slices=transfer.slices,
        megabytes=transfer_runs.size_bytes(held) / 1e6,
        precompute_s=found.seconds,
        core_ms=1e3 * found.core_seconds / count,
        frame_s=transfer_runs.frame_s(held, light, at, per_pixel=fine),
    )
