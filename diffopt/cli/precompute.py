"""``diffopt precompute``: transfer of a scene into a store, in as many sittings as it takes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.scenes import SceneFile
    from diffopt.transfer.precomputation import Progress
    from diffopt.transfer.settings import TransferSettings

#: Exit code of a precomputation that was interrupted.
INTERRUPTED = 130


def command(
    scene: Annotated[
        str,
        typer.Argument(metavar="SCENE", help="A scene file, .toml, or teapot, rabbit or knots."),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="STORE.zarr", help="Folder for the result.")
    ],
    tolerance: Annotated[
        float | None,
        typer.Option(help="Difference of neighbours that is not refined. [default: 0.1]"),
    ] = None,
    lobes: Annotated[
        int | None, typer.Option(help="For each kind of light path. [default: 1]")
    ] = None,
    rays: Annotated[int | None, typer.Option(help="From each vertex. [default: 4096]")] = None,
    depth: Annotated[
        int | None, typer.Option(help="Surfaces that a path meets at most. [default: 2]")
    ] = None,
    finest: Annotated[
        int | None, typer.Option(help="Level of viewing directions at most. [default: 4]")
    ] = None,
    splits: Annotated[
        int | None, typer.Option(help="Of a triangle in four, at most. [default: 5]")
    ] = None,
    threads: Annotated[int | None, typer.Option(help="[default: as many as pay]")] = None,
    compression: Annotated[
        float | None,
        typer.Option(metavar="TOL", help="RMS error of what is stored; 0: exact. [default: 0.01]"),
    ] = None,
    table: Annotated[Path | None, typer.Option(help="Also write the table, as .csv.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a finished store, or batches of another scene.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Precompute transfer; Ctrl-C keeps what is finished, and the same command goes on."""
    from diffopt.cli import precompute_tables
    from diffopt.cli.errors import user_input
    from diffopt.cli.output import written
    from diffopt.transfer import store
    from diffopt.transfer.compression import CompressionSettings
    from diffopt.transfer.precomputation import begun, precompute, surroundings
    from diffopt.transfer.working import Working, differences, identity

    words = {"tolerance": tolerance, "lobes": lobes, "rays": rays, "depth": depth}
    words |= {"finest": finest, "splits": splits}
    settings = _settings(words)
    stored = CompressionSettings()
    if compression is not None:
        with _named("tolerance", "--compression"):
            stored = CompressionSettings(compression)
    if threads is not None and not 1 <= threads <= 256:
        raise InputError(f"--threads must lie between 1 and 256; received {threads}")
    if table is not None and (table.suffix.lower() != ".csv" or not table.parent.is_dir()):
        raise InputError(f"--table {table}: expected a .csv file in a folder that exists")
    with user_input():
        found, notes = _scene(scene)
        body = found.scene
        before = store.state(output)
        # What transfer refuses is refused before anything is written.
        begun(surroundings(body))
    say = _silent if quiet else _say
    for note in notes:
        say(f"note: {note}")
    own = identity(body, settings)
    if before == "finished" and not force:
        different = differences(store.record_of(output).get("identity") or {}, own)
        if different:
            raise InputError(
                f"{output}: finished with another scene or other settings: {different}; --force "
                "computes it again"
            )
        store.tidy(output, own)
        say(f"{output}: finished already; --force computes it again")
    else:
        with (
            written(output, "finished batches are kept, and the same command goes on from them"),
            Working(store.begin(output), body, settings, afresh=force) as batches,
        ):
            if batches.kept:
                say(f"{output}: goes on from {batches.kept} batches of an earlier run")
            seen: list[Progress] = []
            try:
                with _bar(seen, quiet) as report:
                    transfer = precompute(
                        body, settings, batches=batches, report=report, threads=threads
                    )
                record = {"scene": found.path.stem, "threads": threads}
                store.finish(batches, transfer, record, stored)
            except KeyboardInterrupt:
                done, known = (seen[-1].done, seen[-1].known) if seen else (0, 0)
                say(
                    f"interrupted: {done} of {known} vertices known so far are done; "
                    "the same command goes on from there"
                )
                raise typer.Exit(INTERRUPTED) from None
    if quiet and table is None:
        return
    rows = precompute_tables.rows(output, found)
    if not quiet:
        precompute_tables.tell(rows, output)
    if table is not None:
        with written(table):
            precompute_tables.write(rows, table)


def _say(text: str) -> None:
    from diffopt.cli.progress import terminal

    terminal().print(text, markup=False, soft_wrap=True)


def _silent(text: str) -> None:
    del text


@contextmanager
def _named(argument: str, option: str) -> Iterator[None]:
    """Name an argument in error texts as the option that sets it."""
    try:
        yield
    except InputError as error:
        text = str(error)
        if text.startswith(argument):
            text = option + text[len(argument) :]
        raise InputError(text) from None


def _settings(words: dict[str, Any]) -> "TransferSettings":
    """Settings of what is given; faults are named as options."""
    from diffopt.transfer.settings import TransferSettings

    given = {name: value for name, value in words.items() if value is not None}
    finest = given.get("finest")
    if finest is not None and 0 <= finest < TransferSettings.coarsest:
        given["coarsest"] = finest
    try:
        return TransferSettings(**given)
    except InputError as error:
        text = str(error)
        named = next((name for name in given if text.startswith(f"{name} ")), None)
        raise InputError(text if named is None else f"--{text}") from None


def _scene(name: str) -> tuple["SceneFile", list[str]]:
    """A scene file, or an example by its name, without what emits light."""
    import dataclasses

    from diffopt.cli.scene import opened
    from diffopt.scenes import Scene

    found = opened(name)
    bright = [one for one in found.scene.objects if one.emission is not None]
    notes = list(found.notes)
    if bright:
        names = ", ".join(one.name or type(one.place.shape).__name__.lower() for one in bright)
        notes.append(f"left out, as transfer is for light from infinity: {names}")
        dark = tuple(one for one in found.scene.objects if one.emission is None)
        bare = Scene(dark, found.scene.lights, wavelengths=found.scene.channels.wavelengths)
        found = dataclasses.replace(found, scene=bare)
    return found, notes


@contextmanager
def _bar(seen: "list[Progress]", quiet: bool) -> "Iterator[Callable[[Progress], None]]":
    """A bar of vertices on the error stream, if that is a terminal; keeps what was reported."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    with Progress(
        TextColumn("{task.description:<10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("vertices known so far"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=quiet or not console.is_terminal,
    ) as bar:
        task = bar.add_task("round 1", total=None)

        def report(now: "Progress") -> None:
            seen.append(now)
            name = f"round {now.round + 1}"
            bar.update(task, description=name, completed=now.done, total=now.known)

        yield report
