"""Rows of a comparison of methods: table, files, and who beats whom from how many pairs on."""

import csv
import dataclasses
import io
import json
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from diffopt.accuracy import output as printing
from diffopt.errors import InputError
from diffopt.io.files import replacing


@dataclass(frozen=True)
class Row:
    """One method on the job; numbers are None where the method was refused.

    Attributes
    ----------
    method, settings, dtype
        Name as in `diffopt.accuracy.comparison.METHODS`, settings as text, type of its arithmetic.
    setup_s, run_s
        Seconds without compilation; `run_s` is for all pairs of the job.
    compile_s
        Seconds that are not paid again: compiling, and choosing settings.
    ns
        Nanoseconds of run time per pair and wavelength of the job.
    tables_mb, memory_mb
        What is set up, and arguments, results and temporaries of the measured run.
    error, bound
        Largest error over the largest value: measured, and known beforehand (None: none).
    break_even
        Pairs from which on set-up and run together beat every method that meets the
        tolerance with no more set-up; None: never.
    extrapolated
        Whether `run_s` was scaled up from a part of the job, which the note states.
    note
        Anything else, and the reason of a refusal.
    """

    method: str
    settings: str = ""
    dtype: str = ""
    setup_s: float | None = None
    run_s: float | None = None
    compile_s: float | None = None
    ns: float | None = None
    tables_mb: float | None = None
    memory_mb: float | None = None
    error: float | None = None
    bound: float | None = None
    break_even: int | None = None
    extrapolated: bool = False
    note: str = ""

    @property
    def total_s(self) -> float | None:
        """Set-up and run together, seconds."""
        if self.setup_s is None or self.run_s is None:
            return None
        return self.setup_s + self.run_s


@dataclass(frozen=True)
class Comparison:
    """The rows, one for each method, and the job in words; ``str`` and `table` print them."""

    rows: tuple[Row, ...]
    job: str
    tolerance: float

    @property
    def best(self) -> Row:
        """The row with the least total time among those whose error meets the tolerance.

        Raises
        ------
        InputError
            If none does.
        """
        meeting = [r for r in self.rows if _meets(r, self.tolerance)]
        if not meeting:
            raise InputError(f"no method meets the tolerance {self.tolerance:g} on {self.job}")
        return min(meeting, key=lambda r: r.total_s or math.inf)

    def row(self, method: str) -> Row:
        """The row of one method."""
        for row in self.rows:
            if row.method == method:
                return row
        raise InputError(
            f"no method {method!r} was compared; there are "
            f"{', '.join(row.method for row in self.rows)}"
        )

    def table(self) -> Any:
        """A `rich.table.Table`; ~ marks times scaled up, ! errors beyond the tolerance."""
        from rich.table import Table

        table = Table(
            title=f"{self.job}, tolerance {self.tolerance:g}",
            caption="Without compilation. ~ scaled up from a part of the job; ! error beyond the "
            "tolerance. Break-even: pairs from which on it beats all\nwith no more set-up.",
        )
        for title in ("method", "set-up", "run", "total", "ns", "tables", "memory", "error"):
            table.add_column(title, justify="left" if title == "method" else "right")
        for title in ("bound", "break-even", "settings and notes"):
            table.add_column(title, justify="left" if "notes" in title else "right")
        for row in self.rows:
            if row.total_s is None:
                table.add_row(row.method, *[""] * 9, row.note)
                continue
            mark = "~" if row.extrapolated else ""
            over = "" if _meets(row, self.tolerance) else "!"
            table.add_row(
                row.method + ("" if row.dtype == "float32" else f" ({row.dtype})"),
                printing.seconds(row.setup_s),
                mark + printing.seconds(row.run_s),
                mark + printing.seconds(row.total_s),
                f"{mark}{row.ns:.3g}",
                printing.megabytes(1e6 * (row.tables_mb or 0.0)),
                "" if row.memory_mb is None else printing.megabytes(1e6 * row.memory_mb),
                f"{over}{row.error:.1e}",
                "" if row.bound is None else f"{row.bound:.1e}",
                "never" if row.break_even is None else f"{row.break_even:,}",
                "; ".join(filter(None, (row.settings, row.note))),
            )
        return table

    def __str__(self) -> str:
        return printing.as_text(self.table())

    def as_dict(self) -> dict[str, Any]:
        """Everything, as JSON can hold it."""
        rows = [{**dataclasses.asdict(row), "total_s": row.total_s} for row in self.rows]
        return {"job": self.job, "tolerance": self.tolerance, "rows": rows}

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write a line for each method, empty where there is no number."""
        text = io.StringIO()
        rows = self.as_dict()["rows"]
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
        with replacing(path) as file:
            file.write(text.getvalue().encode())

    def save_json(self, path: str | os.PathLike) -> None:
        """Write `as_dict`."""
        text = json.dumps(self.as_dict(), indent=2, allow_nan=False) + "\n"
        with replacing(path) as file:
            file.write(text.encode())


def _meets(row: Row, tolerance: float) -> bool:
    return row.error is not None and row.error <= tolerance


def with_break_even(rows: Sequence[Row], tolerance: float, pairs: int) -> tuple[Row, ...]:
    """The rows with their `Row.break_even`.

    Parameters
    ----------
    rows
        All methods on one job.
    tolerance
        Methods whose error exceeds it are nobody's rivals.
    pairs
        Of the job: run time is taken for proportional to their number.
    """
    meeting = [r for r in rows if _meets(r, tolerance)]

    def found(row: Row) -> int | None:
        if row.setup_s is None or row.run_s is None:
            return None
        least = 0.0
        for other in meeting:
            assert other.setup_s is not None
            assert other.run_s is not None
            if other is row or other.setup_s > row.setup_s:
                continue
            saved = (other.run_s - row.run_s) / pairs
            if saved <= 0.0:
                return None
            least = max(least, (row.setup_s - other.setup_s) / saved)
        return math.ceil(least)

    return tuple(dataclasses.replace(row, break_even=found(row)) for row in rows)
