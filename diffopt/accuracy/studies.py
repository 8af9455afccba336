"""Accuracy against time: what a faster answer costs.

A `Study` names a quantity and a trusted reference, and builds cases: one approximation at
one choice of its settings, on one problem. Running it gives rows with the measured error,
the bound known beforehand where there is one, and the cost. Every approximation of the
toolkit registers a study in `NAMES`.

>>> result = study("diffraction.window").run(quick=True)
>>> result.where(average="window").cheapest(1e-3).settings["reach"]
"""

import os
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from diffopt.accuracy import output, registry
from diffopt.accuracy.keeping import Rows
from diffopt.accuracy.measurement import compile_ahead, measure
from diffopt.errors import InputError

# Where each study is defined; modules are imported when a study is asked for.
NAMES: dict[str, str] = {
    "diffraction.coherence": "diffopt.accuracy.table_studies:COHERENCE",
    "diffraction.expansion": "diffopt.accuracy.expansion_studies:EXPANSION",
    "diffraction.fresnel": "diffopt.accuracy.spectral_studies:FRESNEL",
    "diffraction.nodes": "diffopt.accuracy.diffraction:NODES",
    "diffraction.patch": "diffopt.accuracy.diffraction:PATCH",
    "diffraction.rounding": "diffopt.accuracy.diffraction:ROUNDING",
    "diffraction.scalar": "diffopt.accuracy.validity:SCALAR",
    "diffraction.table": "diffopt.accuracy.table_studies:TABLE",
    "diffraction.wavelengths": "diffopt.accuracy.spectral_studies:SPECTRUM",
    "diffraction.window": "diffopt.accuracy.diffraction:WINDOW",
    "heightfield.schedule": "diffopt.fitting.reflectance.schedule_studies:SCHEDULE",
    "lobes.concentration": "diffopt.accuracy.lobe_studies:CONCENTRATION",
    "lobes.count": "diffopt.fitting.lobe_studies:COUNT",
    "lobes.distance": "diffopt.accuracy.lobe_studies:DISTANCE",
    "lobes.quadrature": "diffopt.fitting.lobe_studies:QUADRATURE",
    "lobes.samples": "diffopt.fitting.sample_studies:SAMPLES",
    "lobes.steps": "diffopt.fitting.lobe_studies:STEPS",
    "material.colour": "diffopt.accuracy.material_studies:COLOURS",
    "material.energy": "diffopt.accuracy.energy_studies:ENERGY",
    "material.fresnel": "diffopt.accuracy.material_studies:FRESNEL",
    "material.masking": "diffopt.accuracy.material_studies:MASKING",
    "material.table": "diffopt.accuracy.material_studies:TABLES",
    "shadow.bands": "diffopt.accuracy.shadow_studies:BANDS",
    "shadow.combination": "diffopt.accuracy.shadow_studies:COMBINATION",
    "shadow.directions": "diffopt.accuracy.shadow_studies:DIRECTIONS",
    "shadow.map": "diffopt.accuracy.shadow_studies:MAPS",
    "shadow.radial": "diffopt.accuracy.shadow_studies:RADIAL",
    "shadow.rays": "diffopt.accuracy.shadow_studies:RAYS",
    "transfer.estimator": "diffopt.accuracy.transfer_studies:ESTIMATOR",
    "transfer.levels": "diffopt.accuracy.transfer_studies:LEVELS",
    "transfer.lighting": "diffopt.accuracy.transfer_studies:LIGHTING",
    "transfer.lobes": "diffopt.accuracy.transfer_studies:LOBES",
    "transfer.quantisation": "diffopt.accuracy.transfer_studies:QUANTISATION",
    "transfer.rays": "diffopt.accuracy.transfer_studies:RAYS",
    "transfer.tolerance": "diffopt.accuracy.transfer_studies:TOLERANCE",
}

Value = str | int | float | bool
# Called before each case with its number from 0, the number of cases, and its settings.
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Row:
    """One approximation at one choice of settings on one problem.

    Attributes
    ----------
    settings
        Names and values, the problem's conditions among them.
    error
        Measured, in the terms of the study's quantity.
    bound
        Known before the run, an estimate where the study's quantity says so; None where
        there is none.
    compile_s, run_s, gradient_s, flops, peak_bytes
        See `diffopt.accuracy.measurement.Measurement`. Cases that differ in the values of their
        arguments only share one compilation.
    note
        Anything else that was measured.
    """

    settings: dict[str, Value]
    error: float
    bound: float | None
    compile_s: float
    run_s: float
    gradient_s: float | None = None
    flops: float | None = None
    peak_bytes: int | None = None
    note: str = ""


@dataclass(frozen=True)
class Job:
    """What a case runs: a function of arrays, its arguments, and how its result is judged.

    Attributes
    ----------
    function, arguments
        Compiled and timed by `diffopt.accuracy.measurement.measure`.
    judge
        From the result to (error, note).
    bound
        Error bound known beforehand.
    gradient
        Position of the argument whose gradient is timed as well.
    """

    function: Callable[..., Any]
    arguments: tuple
    judge: Callable[[Any], tuple[float, str]]
    bound: float | None = None
    gradient: int | None = None


@dataclass(frozen=True)
class Case:
    """Settings, and how to set up the job: `build` runs with 64-bit types on or off.

    Attributes
    ----------
    settings
        As they will stand in the row.
    dtype
        ``"float32"`` runs as most users do, without 64-bit types; ``"float64"`` with them,
        within this case only.
    build
        Makes the job.
    program
        Cases of one study with the same value (not None) share one compilation.
    """

    settings: dict[str, Value]
    dtype: str
    build: Callable[[], Job]
    program: Hashable = None


@dataclass(frozen=True)
class Study:
    """A quantity, a reference, and the cases in which an approximation is tried.

    Attributes
    ----------
    name
        As in `NAMES`.
    quantity
        What the error is of, and relative to what.
    reference
        What it is measured against.
    cases
        From ``quick`` to the list of cases.
    conditions
        Names among the settings that state the problem instead of the approximation: only
        rows with equal conditions compete with each other.
    against
        Number among the settings that the plot is drawn against, where run time does not
        tell the approximations apart, with a panel for each problem; None: against run time.
    """

    name: str
    quantity: str
    reference: str
    cases: Callable[[bool], list[Case]]
    conditions: tuple[str, ...] = ()
    against: str | None = None

    def run(
        self,
        quick: bool = False,
        progress: Progress | None = None,
        repeats: int = 5,
        keep: Rows | None = None,
    ) -> "StudyResult":
        """Run every case.

        Parameters
        ----------
        quick
            Fewer and smaller cases, seconds instead of up to a minute.
        progress
            Called as ``progress(done, total, text)`` before each case and at the end.
        repeats
            Timed runs of each case.
        keep
            Where rows are kept; those that are there are not measured again.
        """
        cases = self.cases(quick)
        programs: dict[Hashable, Any] = {}
        rows = []
        for done, case in enumerate(cases):
            if progress is not None:
                progress(done, len(cases), output.label(case.settings))
            kept = None if keep is None else keep.load(done, case.settings)
            if kept is not None:
                rows.append(Row(**{**kept, "settings": case.settings}))
                continue
            with jax.enable_x64(case.dtype == "float64"):
                rows.append(self.measured(case, programs, repeats))
            if keep is not None:
                keep.save(done, rows[-1])
        if progress is not None:
            progress(len(cases), len(cases), "")
        return StudyResult(self, tuple(rows))

    def measured(self, case: Case, programs: dict[Hashable, Any], repeats: int) -> "Row":
        """The row of a case; `programs` holds those that cases share."""
        return _row(case, programs, repeats)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, studies

        return bundles.bundle(self, studies.study_card)


def _row(case: Case, programs: dict[Hashable, Any], repeats: int) -> Row:
    job = case.build()
    program = programs.get(case.program)
    if program is None:
        program = compile_ahead(job.function, *job.arguments)
        if case.program is not None:
            programs[case.program] = program
    cost = measure(
        job.function, *job.arguments, repeats=repeats, gradient=job.gradient, program=program
    )
    error, note = job.judge(cost.value)
    return Row(
        settings=case.settings,
        error=error,
        bound=job.bound,
        compile_s=cost.compile_s,
        run_s=cost.run_s,
        gradient_s=cost.gradient_s,
        flops=cost.flops,
        peak_bytes=cost.peak_bytes,
        note=note,
    )


@dataclass(frozen=True)
class StudyResult:
    """The rows of a study that was run; ``str`` and `table` print them."""

    study: Study
    rows: tuple[Row, ...]

    def where(self, **settings: Value) -> "StudyResult":
        """Only the rows with these settings.

        Raises
        ------
        InputError
            If there is none; the message lists the values that there are.
        """
        for name, value in settings.items():
            known = list(dict.fromkeys(row.settings.get(name) for row in self.rows))
            if value not in known:
                values = ", ".join(map(str, known)) if known != [None] else "no such setting"
                raise InputError(
                    f"study {self.study.name!r}: {name}={value!r} given; it has {values}"
                )
        rows = tuple(r for r in self.rows if all(r.settings[k] == v for k, v in settings.items()))
        if not rows:
            raise InputError(f"study {self.study.name!r}: no row has {output.label(settings)}")
        return StudyResult(self.study, rows)

    def problems(self) -> list["StudyResult"]:
        """The rows apart by their conditions, in order of appearance."""
        key = self._conditions
        found = dict.fromkeys(key(row) for row in self.rows)
        return [StudyResult(self.study, tuple(r for r in self.rows if key(r) == k)) for k in found]

    def front(self) -> tuple[Row, ...]:
        """Rows that no other of the same problem beats in both error and run time.

        Sorted by problem, then by run time.
        """
        found = []
        for problem in self.problems():
            best = np.inf
            for row in sorted(problem.rows, key=lambda r: (r.run_s, r.error)):
                if row.error < best:
                    found.append(row)
                    best = row.error
        return tuple(found)

    def cheapest(self, tolerance: float) -> Row:
        """The cheapest settings whose measured error is at most `tolerance`.

        With several problems (see `where`) the settings must meet it on all of them; costs
        are added, and the row with the largest error is returned.

        Raises
        ------
        InputError
            If no settings meet it; the message gives the smallest error measured.
        """
        groups: dict[tuple, list[Row]] = {}
        for row in self.rows:
            rest = {k: v for k, v in row.settings.items() if k not in self.study.conditions}
            groups.setdefault(tuple(rest.items()), []).append(row)
        count = len(self.problems())
        everywhere = [rows for rows in groups.values() if len(rows) == count] or [list(self.rows)]
        meeting = [rows for rows in everywhere if max(r.error for r in rows) <= tolerance]
        if not meeting:
            smallest = min(max(r.error for r in rows) for rows in everywhere)
            raise InputError(
                f"study {self.study.name!r}: no settings have an error of at most {tolerance:g}; "
                f"the smallest measured is {smallest:.2g}"
                + (f" over its {count} problems, see where()" if count > 1 else "")
            )
        return max(min(meeting, key=lambda rs: sum(r.run_s for r in rs)), key=lambda r: r.error)

    def table(self) -> Any:
        """A `rich.table.Table` of all rows; those of the front carry a star."""
        return output.table(self)

    def __str__(self) -> str:
        return output.as_text(self.table())

    def plot(self, path: str | os.PathLike | None = None) -> Any:
        """Error against run time, both logarithmic, settings written on each point.

        Parameters
        ----------
        path
            File to write (PNG, PDF or SVG, by its ending); none if left out.

        Returns
        -------
        matplotlib.figure.Figure
            With a line along the front of each problem; for a study drawn against one of
            its settings, a panel for each problem and a line for each other setting.
        """
        if self.study.against is not None:
            return output.plot_against(self, self.study.against, path)
        return output.plot(self, path)

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write all rows: settings, then error, bound and costs, empty where unknown."""
        output.save_csv(self, path)

    def _conditions(self, row: Row) -> tuple:
        return tuple(row.settings.get(name) for name in self.study.conditions)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, studies

        return bundles.bundle(self, studies.card)


def study(name: str) -> Study:
    """The study of that name.

    Raises
    ------
    InputError
        If there is none; the message lists those in `NAMES`.
    """
    return registry.named("study", NAMES, name)
