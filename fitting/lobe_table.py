"""Rows of a comparison of lobe fits: table, picture, file."""

import dataclasses
import os
from dataclasses import dataclass
from typing import Any

from diffopt.accuracy import output as printing
from diffopt.errors import InputError


@dataclass(frozen=True)
class Row:
    """One method at one number of lobes.

    Attributes
    ----------
    method, lobes, dtype
        What ran, and the type of its arithmetic.
    error, worst
        Relative L2 error on fine nodes: mean and largest over the slices.
    energy
        Mean of |integral of the lobes / that of the slice - 1|.
    likelihood
        Mean log density of the lobes under the slice, nats.
    time_s, spread_s
        Seconds per slice in a batch of all: median of the runs and distance of quartiles.
    single_s
        Seconds for one slice alone, mean over the slices.
    compile_s
        Seconds until the first result, less the time of a run where that is known.
    steps, success
        Mean steps; share of slices that the solver calls done, None where it does not say.
    memory_bytes
        Arguments, results and temporaries of the program that fits the batch (of several, the
        largest); None where not known, as for SciPy.
    ratio, single_ratio
        Of rows "em+lm to RIVAL": the rival's time over this one's, in a batch and alone.
    rival
        Whether it is a converged solver that others are measured against.
    note
        Settings.
    """

    method: str
    lobes: int
    dtype: str
    error: float
    worst: float
    energy: float
    likelihood: float
    time_s: float = 0.0
    spread_s: float = 0.0
    single_s: float = 0.0
    compile_s: float = 0.0
    steps: float = 0.0
    success: float | None = None
    memory_bytes: int | None = None
    ratio: float | None = None
    single_ratio: float | None = None
    rival: bool = False
    note: str = ""


@dataclass(frozen=True)
class LobeComparison:
    """The rows and the job in words; ``str`` and `table` print them."""

    rows: tuple[Row, ...]
    job: str

    def row(self, method: str, lobes: int) -> Row:
        """The row of one method at one number of lobes."""
        for row in self.rows:
            if (row.method, row.lobes) == (method, lobes):
                return row
        raise InputError(f"no row {method!r} with {lobes} lobes")

    def table(self) -> Any:
        """A `rich.table.Table`."""
        from rich.table import Table

        table = Table(
            title=f"Lobes on {self.job}",
            caption="Times per slice without compilation, in a batch and alone. 'em+lm to X': "
            "steps that reach X's error plus 5 %, and how many times as fast (batch, alone).",
        )
        left = ("method", "settings")
        titles = (
            "lobes", "method", "type", "error", "worst", "energy", "log lik.", "batch", "+-",
            "alone", "compile", "memory", "steps", "done", "times", "settings",
        )  # fmt: skip
        for title in titles:
            table.add_column(title, justify="left" if title in left else "right")
        for row in self.rows:
            faster = "" if row.ratio is None else f"{row.ratio:.3g}, {row.single_ratio:.3g}"
            table.add_row(
                str(row.lobes),
                row.method,
                row.dtype,
                f"{row.error:.4f}",
                f"{row.worst:.3f}",
                f"{row.energy:.1e}",
                f"{row.likelihood:.3f}",
                printing.seconds(row.time_s),
                printing.seconds(row.spread_s),
                printing.seconds(row.single_s),
                printing.seconds(row.compile_s),
                "" if row.memory_bytes is None else printing.megabytes(row.memory_bytes),
                f"{row.steps:.3g}",
                "" if row.success is None else f"{row.success:.0%}",
                faster,
                row.note,
            )
        return table

    def __str__(self) -> str:
        return printing.as_text(self.table())

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write a line for each row, empty where there is no number."""
        names = [field.name for field in dataclasses.fields(Row)]
        printing.write_csv(names, [dataclasses.astuple(row) for row in self.rows], path)

    def plot(self, path: str | os.PathLike | None = None) -> Any:
        """Error against time per slice in a batch, a colour for each number of lobes."""
        from matplotlib.figure import Figure

        figure = Figure(figsize=(9.0, 6.0), layout="constrained")
        axes = figure.add_subplot()
        shown = [row for row in self.rows if not row.method.startswith("em+lm to")]
        markers = dict(zip(dict.fromkeys(r.method for r in shown), "osD^v<>pPX*hd8", strict=False))
        for index, count in enumerate(dict.fromkeys(row.lobes for row in shown)):
            for row in (r for r in shown if r.lobes == count):
                axes.plot(row.time_s * 1e6, row.error, markers[row.method], color=f"C{index}", ms=7)
            word = "lobe" if count == 1 else "lobes"
            # A bar: each marker stands for a method.
            axes.plot([], [], "-", lw=6, color=f"C{index}", label=f"{count} {word}")
        for method, marker in markers.items():
            axes.plot([], [], marker, color="0.4", label=method)
        axes.set(
            xscale="log",
            yscale="log",
            xlabel="time per slice, microseconds",
            ylabel="relative L2 error, mean over the slices",
            title=f"Lobes on {self.job}",
        )
        axes.grid(True, which="both", alpha=0.3)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        if path is not None:
            from diffopt.io.files import replacing

            with replacing(path) as file:
                figure.savefig(file, format="png", dpi=120)
        return figure

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.comparison_card)
