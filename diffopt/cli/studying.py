"""``diffopt accuracy`` and ``diffopt bench``: what a faster answer costs."""

import contextlib
import csv
import io
from pathlib import Path
from typing import Annotated

import typer

COLUMNS = (
    "name",
    "shape",
    "dtype",
    "compile_s",
    "run_s",
    "run_spread",
    "gradient_s",
    "flops",
    "peak_bytes",
    "note",
)


def accuracy(
    name: Annotated[str | None, typer.Argument(help="A study; all of them if left out.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and smaller cases.")] = False,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for plots (PNG) and tables (CSV).")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Print the cheapest settings within this error as well.")
    ] = None,
) -> None:
    """Error against time of every approximation: table, plot, CSV.

    With -o rows are kept as they are measured: after a kill the same command goes on.
    """
    from diffopt import checks
    from diffopt.accuracy import studies
    from diffopt.accuracy.keeping import Rows
    from diffopt.cli.output import beside, folder
    from diffopt.cli.progress import stages, terminal
    from diffopt.errors import InputError

    if tolerance is not None:
        checks.tolerance(tolerance)
    names = sorted(studies.NAMES) if name is None else [name]
    chosen = [studies.study(each) for each in names]
    console = terminal()
    results, kept = [], []
    with contextlib.ExitStack() as stack:
        # First, so that an unusable folder is refused before minutes of work.
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(len(chosen)))
        for study in chosen:
            rows = None
            if output is not None:
                rows = Rows(beside(output, f"{study.name}.rows"), study.name, quick)
                kept.append(stack.enter_context(rows))
                if rows.found:
                    console.print(
                        f"{study.name}: goes on from {len(rows.found)} rows of an earlier run, "
                        f"kept in {rows.path}",
                        markup=False,
                        soft_wrap=True,
                    )
            with progress.stage(study.name) as report:
                result = study.run(quick, lambda done, of, _, to=report: to(done, of), keep=rows)
            if staging is not None:
                result.plot(staging / f"{study.name}.png")
                result.save_csv(staging / f"{study.name}.csv")
            results.append(result)
    for rows in kept:
        rows.discard()
    for result in results:
        console.print(result.table())
        if tolerance is not None:
            try:
                row = result.cheapest(tolerance)
            except InputError as error:
                console.print(str(error))
            else:
                words = ", ".join(f"{key}={value}" for key, value in row.settings.items())
                console.print(f"cheapest within {tolerance:g}: {words}")
    if output is not None:
        console.print(f"plots and tables: {output}")


def bench(
    names: Annotated[list[str] | None, typer.Argument(help="Benchmarks; all if left out.")] = None,
    size: Annotated[str, typer.Option(help="small or full.")] = "small",
    repeats: Annotated[int, typer.Option(help="Timed runs of each.")] = 7,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="CSV file.")] = None,
) -> None:
    """Compilation, run, gradient, operations and memory of the compiled functions."""
    from rich.table import Table

    from diffopt import checks
    from diffopt.accuracy import benchmarks
    from diffopt.cli.errors import user_input
    from diffopt.cli.progress import stages, terminal
    from diffopt.errors import InputError
    from diffopt.io.files import replacing

    checks.choice("--size", size, ("small", "full"))
    if repeats < 1:
        raise InputError(f"--repeats must be at least 1; received {repeats}")
    for name in names or []:
        checks.choice("benchmark", name, tuple(benchmarks.NAMES))
    if output is not None and not output.parent.is_dir():
        raise InputError(f"{output}: the folder {output.parent} does not exist")
    with stages(1) as progress, progress.stage("benchmarks") as report:
        results = benchmarks.run(
            names or None,
            size=size,
            repeats=repeats,
            progress=lambda done, of, _: report(done, of),
        )
    table = Table()
    for title in COLUMNS:
        table.add_column(title, justify="left" if title in ("name", "note") else "right")
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for result in results:
        values = [getattr(result, column) for column in COLUMNS]
        writer.writerow(["" if value is None else value for value in values])
        table.add_row(*(_cell(value) for value in values))
    if output is not None:
        with user_input(), replacing(output) as file:
            file.write(text.getvalue().encode())
    terminal().print(table)


def _cell(value: object) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)
