"""Tables, plots and files of study results, see `diffopt.accuracy.studies.StudyResult`."""

import csv
import io
import itertools
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from diffopt.errors import InputError
from diffopt.io.files import replacing

_COSTS = ("error", "bound", "compile_s", "run_s", "gradient_s", "flops", "peak_bytes")


def table(result: Any) -> Any:
    """A `rich.table.Table` of all rows; those of the front carry a star."""
    from rich.table import Table

    front = set(map(id, result.front()))
    names = _names(result.rows)
    optional = [c for c in _OPTIONAL if any(c[1](row) for row in result.rows)]
    found = Table(
        title=f"{result.study.name}: {result.study.quantity}",
        caption=f"Reference: {result.study.reference}. * on the front of error against run time.",
    )
    for name in [*names, "error", "run", "", *(title for title, _ in optional)]:
        found.add_column(name, justify="left" if name in names else "right")
    for row in result.rows:
        found.add_row(
            *(_text(row.settings.get(name, "")) for name in names),
            f"{row.error:.1e}",
            seconds(row.run_s),
            "*" if id(row) in front else "",
            *(show(row) for _, show in optional),
        )
    return found


def plot(result: Any, path: str | os.PathLike | None) -> Any:
    """Error against run time; see `diffopt.accuracy.studies.StudyResult.plot`."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 6.0), layout="constrained")
    axes = figure.add_subplot()
    varying = [n for n in _names(result.rows) if len({r.settings.get(n) for r in result.rows}) > 1]
    on_points = [n for n in varying if n not in result.study.conditions] or varying
    floor = min((r.error for r in result.rows if r.error > 0), default=1e-17)
    for index, problem in enumerate(result.problems()):
        colour = f"C{index % 10}"
        conditions = {
            n: problem.rows[0].settings[n] for n in result.study.conditions if n in varying
        }
        # An error of exactly 0 stands at the smallest of the others.
        x = [row.run_s * 1e3 for row in problem.rows]
        y = [max(row.error, floor) for row in problem.rows]
        axes.plot(x, y, "o", ms=4, color=colour, label=label(conditions) or None)
        best = problem.front()
        axes.plot([r.run_s * 1e3 for r in best], [max(r.error, floor) for r in best], color=colour)
        for row, place in zip(problem.rows, zip(x, y, strict=True), strict=True):
            text = " ".join(_text(row.settings[n]) for n in on_points if n in row.settings)
            axes.annotate(
                text, place, xytext=(3, 3), textcoords="offset points", fontsize=6, color=colour
            )
    axes.set(xscale="log", yscale="log", xlabel="run time, ms", ylabel="error")
    axes.set_title(f"{result.study.name}: {result.study.quantity}", fontsize=9, wrap=True)
    axes.text(
        0.01, 0.01, "on points: " + ", ".join(on_points), transform=axes.transAxes, fontsize=7
    )
    if len(result.problems()) > 1:
        axes.legend(fontsize=7)
    return saved(figure, path)


def plot_against(result: Any, name: str, path: str | os.PathLike | None) -> Any:
    """Error against one setting, a panel for each problem, a line for all other settings.

    A setting that is a condition itself joins the problems along it. Bounds are dashed;
    errors beyond 10 are left out.
    """
    from matplotlib.figure import Figure

    others = [n for n in result.study.conditions if n != name]
    varying = [n for n in _names(result.rows) if len({r.settings.get(n) for r in result.rows}) > 1]
    panels: dict[str, dict[str, list[Any]]] = {}
    for row in result.rows:
        panel = label({n: row.settings[n] for n in others})
        line = ", ".join(
            v if isinstance(v, str) else f"{n} {_text(v)}"
            for n, v in row.settings.items()
            if n in varying and n not in (*others, name)
        )
        panels.setdefault(panel, {}).setdefault(line, []).append(row)
    lines = list(dict.fromkeys(itertools.chain.from_iterable(panels.values())))
    columns = min(3, len(panels))
    figure = Figure(figsize=(3.6 * columns, 3.0 * -(-len(panels) // columns)), layout="constrained")
    grid = figure.subplots(-(-len(panels) // columns), columns, sharey=True, squeeze=False)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    handles: dict[str, Any] = {}
    values = [float(row.settings[name]) for row in result.rows]
    for axes, (title, drawn) in zip(grid.flat, panels.items(), strict=False):
        for text, rows in drawn.items():
            rows = sorted(rows, key=lambda row: row.settings[name])
            x = [float(row.settings[name]) for row in rows]
            style = {"color": f"C{lines.index(text) % 10}", "lw": 1}
            (handles[text],) = axes.plot(
                x, [max(row.error, 1e-16) for row in rows], marker="o", ms=3, **style
            )
            known = [(v, row.bound) for v, row in zip(x, rows, strict=True) if row.bound]
            if known:
                axes.plot(*zip(*known, strict=True), ls=":", **style)
        axes.set(yscale="log", xlabel=name)
        if max(values) > 8.0 * min(values) > 0.0:
            axes.set(xscale="log", xlim=(0.8 * min(values), 1.25 * max(values)))
        axes.set_title(title, fontsize=8)
    # All share the axis.
    heights = [e for row in result.rows for e in (row.error, row.bound) if e]
    if heights:
        grid[0, 0].set_ylim(max(0.3 * min(heights), 1e-16), min(3.0 * max(heights), 10.0))
    figure.legend(handles.values(), handles.keys(), fontsize=7, loc="outside lower center", ncols=4)
    for axes in grid[:, 0]:
        axes.set_ylabel("error (dotted: bound)" if any(r.bound for r in result.rows) else "error")
    figure.suptitle(f"{result.study.name}: {result.study.quantity}", fontsize=8, wrap=True)
    return saved(figure, path)


def saved(figure: Any, path: str | os.PathLike | None) -> Any:
    """The figure, written as PNG, PDF or SVG by the ending of the path if there is one."""
    if path is not None:
        kind = Path(path).suffix.lstrip(".").lower()
        if kind not in ("png", "pdf", "svg"):
            raise InputError(f"{path}: expected a name ending in .png, .pdf or .svg")
        with replacing(path) as file:
            figure.savefig(file, format=kind, dpi=150)
    return figure


def save_csv(result: Any, path: str | os.PathLike) -> None:
    """Write all rows: settings, then error, bound and costs, empty where unknown."""
    names, fields = _names(result.rows), (*_COSTS, "note")
    rows = [
        [*(row.settings.get(n) for n in names), *(getattr(row, n) for n in fields)]
        for row in result.rows
    ]
    write_csv((*names, *fields), rows, path)


def write_csv(names: Sequence[str], rows: Sequence[Sequence[Any]], path: str | os.PathLike) -> None:
    """Write lines of values under their names, empty for None."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([names, *rows])
    with replacing(path) as file:
        file.write(text.getvalue().encode())


def seconds(value: int | float | None) -> str:
    """A time in s, ms or us with three digits; empty for None."""
    if value is None:
        return ""
    for unit, size in (("s", 1.0), ("ms", 1e-3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value * 1e6:.3g} us"


def megabytes(value: int | float | None) -> str:
    """A size in MB with two digits; empty for None."""
    return "" if value is None else f"{value / 1e6:.2g} MB"


def as_text(table: Any) -> str:
    """A rich table as plain text, as wide as it needs."""
    from rich.console import Console

    console = Console(file=io.StringIO(), width=220, color_system=None)
    console.print(table)
    return console.file.getvalue()  # type: ignore[attr-defined]


_OPTIONAL: Sequence[tuple[str, Callable[[Any], str]]] = (
    ("bound", lambda row: "" if row.bound is None else f"{row.bound:.1e}"),
    ("compile", lambda row: seconds(row.compile_s)),
    ("gradient", lambda row: seconds(row.gradient_s)),
    ("memory", lambda row: megabytes(row.peak_bytes)),
    ("note", lambda row: row.note),
)


def _names(rows: Sequence[Any]) -> list[str]:
    return list(dict.fromkeys(itertools.chain.from_iterable(row.settings for row in rows)))


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def label(settings: dict[str, Any]) -> str:
    """Names and values, for people."""
    return ", ".join(f"{name} {_text(value)}" for name, value in settings.items())
