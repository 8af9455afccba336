"""``diffopt samples`` and ``diffopt info``."""

from typing import Annotated

import typer


def samples() -> None:
    """List the embedded samples."""
    from rich.table import Table

    from diffopt import samples as made
    from diffopt.cli.progress import terminal

    table = Table.grid(padding=(0, 2))
    for name in made.NAMES:
        text = (getattr(made, name).__doc__ or "").strip().splitlines()[0]
        table.add_row(f"sample:{name}", text.removeprefix("Return ").rstrip("."))
    terminal().print(table)


def info(
    file: Annotated[str, typer.Argument(help="File of heights, or sample:NAME.")],
    pixel_size: Annotated[str | None, typer.Option(help="Pixel in um, or Y,X.")] = None,
    height_range: Annotated[
        str | None, typer.Option(help="Heights of black and white, LOW,HIGH or HIGH, in um.")
    ] = None,
    height_unit: Annotated[str | None, typer.Option(help="Unit of the numbers, as nm.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel, by number or name.")] = None,
    level: Annotated[
        str | None,
        typer.Option(help="plane, line, polynomial or none. [default: plane, samples none]"),
    ] = None,
    fill: Annotated[bool, typer.Option("--fill", help="Fill missing pixels.")] = False,
    key: Annotated[int, typer.Option(help="Random key of a sample.")] = 0,
) -> None:
    """Print shape, pixel, statistics and provenance of a file."""
    from rich.table import Table

    from diffopt.cli import options
    from diffopt.cli.errors import user_input
    from diffopt.cli.progress import terminal
    from diffopt.drawing.pictures import describe

    source = options.Source(file, pixel_size, height_range, height_unit, channel, level, fill, key)
    with user_input():
        scan = options.load(source)
        figures = scan.statistics(periodic=file.startswith(options.SAMPLE))
    record = scan.provenance
    rows = [("source", record.source)]
    if record.channel is not None:
        rows.append(("channel", record.channel))
    rows.extend(describe(scan, figures))
    rows.extend(("done", step) for step in record.steps)
    rows.extend(("note", note) for note in record.notes)
    table = Table.grid(padding=(0, 2))
    for row in rows:
        table.add_row(*row)
    terminal().print(table)
