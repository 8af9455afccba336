"""What the settings of precomputed transfer cost and lose.

Every case precomputes the transfer of a scene and takes a picture of it, beside the truth in the
middle of every pixel. Run time is that of the precomputation, but for the way the light is
averaged, where it is that of a frame, and for estimators, where it is that of a slice. What
happens partly outside JAX compiles its parts itself: compilation is what a first run takes
longer. Quick cases run once; their times have compilation in them.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.accuracy import output, transfer_estimators, transfer_runs
from diffopt.accuracy.studies import Case, Job, Row, Study, Value
from diffopt.accuracy.transfer_runs import Setup
from diffopt.transfer import relighting
from diffopt.transfer.lighting import HarmonicSettings
from diffopt.transfer.pyramid import PyramidSettings
from diffopt.transfer.settings import TransferSettings

# Small problems first; the full ones take minutes.
_QUICK = (Setup("ring", resolution=24, paths=512),)
_FULL = (Setup("teapot 32", detail=4), Setup("teapot 128", detail=4))
_BASE = {
    True: TransferSettings(tolerance=0.3, rays=256, finest=1, splits=0),
    False: TransferSettings(tolerance=0.2, rays=2048, finest=4, splits=3),
}


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a case gives: error, seconds that it is judged by, seconds to compile, and a note."""

    error: float
    run_s: float
    compile_s: float
    note: str


@dataclasses.dataclass(frozen=True)
class HostStudy(Study):
    """A study whose cases time themselves: their jobs return an `Outcome`."""

    def measured(self, case: Case, programs: dict[Hashable, Any], repeats: int) -> Row:
        """The row of a case; `programs` and `repeats` are not used."""
        found: Outcome = case.build().function()
        return Row(case.settings, found.error, None, found.compile_s, found.run_s, note=found.note)


def _case(conditions: dict[str, Value], shown: dict[str, Value], run: Callable[[], Any]) -> Case:
    def build() -> Job:
        return Job(run, (), lambda found: (found.error, found.note))

    return Case({**conditions, **shown}, "float32", build)


def _precomputed(setup: Setup, settings: TransferSettings, quick: bool) -> Outcome:
    """Precomputation, and its picture under the exact light."""
    found = transfer_runs.made(setup.scene, setup.detail, settings, again=not quick)
    held = relighting.tables(found.transfer)
    at = transfer_runs.seen(found.transfer, setup)
    light = transfer_runs.lighting(setup.light)
    score = _score(setup, found.transfer, held, light)
    frame = transfer_runs.frame_s(held, light, at, 3)
    count = len(found.transfer.level)
    note = (
        f"{count:,} vertices, {found.transfer.slices:,} slices, "
        f"{output.megabytes(transfer_runs.size_bytes(held))}; frame {1e3 * frame:.3g} ms; "
        f"{1e3 * found.core_seconds / count:.3g} core-ms a vertex; noise of truth {score.noise:.2g}"
    )
    return Outcome(score.rmse, found.seconds, found.compile_s, note)


def _score(setup: Setup, transfer: Any, held: Any, light: Any) -> transfer_runs.Score:
    truth = transfer_runs.reference(setup)
    at = transfer_runs.seen(transfer, setup)
    image = transfer_runs.picture(held, light, at)
    return transfer_runs.score(image, truth, transfer_runs.covered(transfer, setup))


def _sweep(name: str, values: dict[bool, tuple[Any, ...]]) -> Callable[[bool], list[Case]]:
    """Cases of one setting, the others as they are by default."""

    def cases(quick: bool) -> list[Case]:
        return [
            _case(
                {"scene": setup.scene},
                {name: value},
                lambda s=setup, v=value: _precomputed(
                    s, dataclasses.replace(_BASE[quick], **_changes(name, v, quick)), quick
                ),
            )
            for setup in (_QUICK if quick else _FULL)
            for value in values[quick]
        ]

    return cases


def _changes(name: str, value: Any, quick: bool) -> dict[str, Any]:
    if name == "tolerance":
        return {name: value, "splits": 1 if quick else _BASE[False].splits}
    if name == "level":
        # All vertices have all views of the level.
        return {"coarsest": value, "finest": value}
    return {name: value}


def _lighting(quick: bool) -> list[Case]:
    ways: list[tuple[str, Any]] = [("lobes", None), ("pyramid", PyramidSettings())]
    ways += [("harmonics", HarmonicSettings(bands)) for bands in ((8,) if quick else (4, 8, 16))]
    setups = _QUICK if quick else (*_FULL, Setup("teapot 32", "sky", detail=4))
    return [
        _case(
            {"scene": setup.scene, "light": setup.light},
            {"method": method, "bands": getattr(settings, "bands", 0)},
            lambda s=setup, m=method, how=settings: _lit(s, _BASE[quick], m, how),
        )
        for setup in setups
        for method, settings in ways
        if setup.light == "suns" or method != "lobes"
    ]


def _lit(setup: Setup, settings: TransferSettings, method: str, how: Any) -> Outcome:
    """A frame, against the truth, and against the closed form where there is one."""
    found = transfer_runs.made(setup.scene, setup.detail, settings, again=False)
    held = relighting.tables(found.transfer)
    at = transfer_runs.seen(found.transfer, setup)
    begun = time.perf_counter()
    light = transfer_runs.lighting(setup.light, method, how)
    image = transfer_runs.picture(held, light, at)
    first = time.perf_counter() - begun
    frame = transfer_runs.frame_s(held, light, at, 5)
    score = _score(setup, found.transfer, held, light)
    note = f"lights and first frame {first:.2g} s; noise of truth {score.noise:.2g}"
    if setup.light == "suns":
        right = transfer_runs.picture(held, transfer_runs.lighting(setup.light), at)
        off = np.sqrt(((image - right) ** 2).mean() / (right**2).mean())
        note = f"{off:.2g} off the closed form; {note}"
    return Outcome(score.rmse, frame, max(first - frame, 0.0), note)


def _quantisation(quick: bool) -> list[Case]:
    return [
        _case(
            {"scene": setup.scene},
            {"compression": value},
            lambda s=setup, v=value: _stored(s, _BASE[quick], v),
        )
        for setup in (_QUICK if quick else _FULL)
        for value in ((0.0, 0.1) if quick else (0.0, 0.003, 0.01, 0.03, 0.1))
    ]


def _stored(setup: Setup, settings: TransferSettings, tolerance: float) -> Outcome:
    """Written and read again: the seconds of both."""
    from diffopt.transfer import store
    from diffopt.transfer.compression import CompressionSettings

    found = transfer_runs.made(setup.scene, setup.detail, settings, again=False).transfer
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "transfer.zarr"
        begun = time.perf_counter()
        store.save(path, found, None, CompressionSettings(tolerance))
        read = store.load(path)
        seconds = time.perf_counter() - begun
        size = store.size(path)
    light = transfer_runs.lighting(setup.light)
    score = _score(setup, read, relighting.tables(read), light)
    note = (
        f"{output.megabytes(size)}, {size / found.slices:.3g} bytes a slice; "
        f"noise of truth {score.noise:.2g}"
    )
    return Outcome(score.rmse, seconds, 0.0, note)


def _estimators(quick: bool) -> list[Case]:
    scenes = ("ring",) if quick else ("teapot 32", "teapot 128")
    problems = [
        transfer_estimators.Problem(scene, *((4, 0, 4096) if quick else (12, 1, 16384)))
        for scene in scenes
    ]
    ways: list[tuple[str, int]] = [
        (way, count)
        for way in ("paths, lobes", "paths, reflectance")
        for count in ((1000,) if quick else (100, 1000, 10_000))
    ]
    ways += [("shared rays", count) for count in ((1024,) if quick else (1024, 4096, 16384))]

    def run(problem: transfer_estimators.Problem, way: str, count: int) -> Outcome:
        found = transfer_estimators.compared(problem, way, count)
        return Outcome(found.radiance, found.seconds, found.compile_s, str(found))

    return [
        _case(
            {"scene": problem.scene},
            {"estimator": way, "count": count},
            lambda p=problem, w=way, n=count: run(p, w, n),
        )
        for problem in problems
        for way, count in ways
    ]


_TRUTH = "directions drawn at every pixel and followed to a second surface"


def _study(name: str, about: str, cases: Any, against: str | None = None, **words: str) -> Study:
    quantity = "RMS error of a picture over its mean, noise of the truth taken out"
    return HostStudy(
        name=f"transfer.{name}",
        quantity=words.get("quantity", f"{about}: {quantity}"),
        reference=words.get("reference", _TRUTH),
        cases=cases,
        conditions=("scene", "light") if name == "lighting" else ("scene",),
        against=against,
    )


TOLERANCE = _study(
    "tolerance",
    "vertices and views as they are needed; time of precomputation",
    _sweep("tolerance", {True: (0.9, 0.1), False: (0.8, 0.4, 0.2, 0.1)}),
)
RAYS = _study(
    "rays",
    "rays of a vertex; time of precomputation",
    _sweep("rays", {True: (64, 256), False: (256, 1024, 4096, 16384)}),
)
LOBES = _study(
    "lobes",
    "lobes of each kind of path; time of precomputation",
    _sweep("lobes", {True: (1, 2), False: (1, 2, 4)}),
)
LEVELS = _study(
    "levels",
    "views of every vertex; time of precomputation",
    _sweep("level", {True: (0, 1), False: (0, 1, 2, 3, 4)}),
)
LIGHTING = _study("lighting", "how light is averaged; time of a frame", _lighting)
QUANTISATION = _study(
    "quantisation", "slices in a store; time of writing and reading", _quantisation
)
ESTIMATOR = _study(
    "estimator",
    "paths of each slice, or shared rays",
    _estimators,
    quantity="RMS error of the radiance of slices under the lobes of light, over its root mean "
    "square; time of a slice",
    reference="lobes of the moments of many paths, in float64",
)
