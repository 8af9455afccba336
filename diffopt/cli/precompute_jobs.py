"""What ``diffopt precompute`` computes: checked before anything starts, then into the store."""

import dataclasses
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.scenes import Scene, SceneFile
    from diffopt.transfer.compression import CompressionSettings
    from diffopt.transfer.precomputation import Progress
    from diffopt.transfer.result import Transfer
    from diffopt.transfer.settings import TransferSettings
    from diffopt.transfer.working import Working

#: Exit code of a precomputation that was interrupted.
INTERRUPTED = 130
#: Exit code where one of several processes was killed or failed.
FAILED = 1

Report = Callable[["Progress"], None]
#: Computes a job and finishes its store.
Run = Callable[["Working", Report], None]


@dataclasses.dataclass(frozen=True)
class Job:
    """A command that was understood.

    Attributes
    ----------
    given
        The scene as it was given.
    found
        It, without what emits light.
    notes
        About it, to be told.
    output
        Of the store.
    words
        Options of the settings, by name.
    settings, compression, stored
        Made of them; the option, and settings made of it.
    identity
        Of the result.
    before
        State of the store.
    force
        Whether to replace what is there.
    """

    given: str
    found: "SceneFile"
    notes: list[str]
    output: Path
    words: dict[str, Any]
    settings: "TransferSettings"
    compression: float | None
    stored: "CompressionSettings"
    identity: dict[str, Any]
    before: str
    force: bool

    @property
    def scene(self) -> "Scene":
        """What is computed."""
        return self.found.scene


def checked(
    given: str, output: Path, words: dict[str, Any], compression: float | None, *, force: bool
) -> Job:
    """Read and check all that a command names; nothing is written.

    Raises
    ------
    InputError
        Where something is wrong.
    """
    from diffopt.cli.errors import user_input
    from diffopt.transfer import store
    from diffopt.transfer.beginning import begun, surroundings
    from diffopt.transfer.compression import CompressionSettings
    from diffopt.transfer.working import identity

    settings = _settings(words)
    stored = CompressionSettings()
    if compression is not None:
        with _named("tolerance", "--compression"):
            stored = CompressionSettings(compression)
    with user_input():
        found, notes = _scene(given)
        before = store.state(output)
        # What transfer refuses is refused before anything is written.
        begun(surroundings(found.scene))
    own = identity(found.scene, settings)
    return Job(
        given, found, notes, output, words, settings, compression, stored, own, before, force
    )


def compute(job: Job, run: Run, *, quiet: bool, session: str | None = None) -> None:
    """Have a job computed into its store, unless that is finished; tells about it.

    Parameters
    ----------
    job
        Checked.
    run
        Does it, given the batches and what to report to.
    quiet
        Tell nothing.
    session
        See `diffopt.transfer.working.Working`.
    """
    from diffopt.cli.output import written
    from diffopt.transfer import store
    from diffopt.transfer.distributed import KEPT
    from diffopt.transfer.working import Working, differences

    say = _silent if quiet else _say
    output = job.output
    for note in job.notes:
        say(f"note: {note}")
    if job.before == "finished" and not job.force:
        different = differences(store.record_of(output).get("identity") or {}, job.identity)
        if different:
            raise InputError(
                f"{output}: finished with another scene or other settings: {different}; --force "
                "computes it again"
            )
        store.tidy(output, job.identity)
        say(f"{output}: finished already; --force computes it again")
        return
    with (
        written(output, KEPT),
        Working(
            store.begin(output), job.scene, job.settings, afresh=job.force, session=session
        ) as batches,
    ):
        if batches.kept:
            say(f"{output}: goes on from {batches.kept} batches of an earlier run")
        seen: list[Progress] = []
        try:
            with _bar(seen, quiet) as report:
                run(batches, report)
        except KeyboardInterrupt:
            done, known = (seen[-1].done, seen[-1].known) if seen else (0, 0)
            say(
                f"interrupted: {done} of {known} vertices known so far are done; "
                "the same command goes on from there"
            )
            raise typer.Exit(INTERRUPTED) from None


def alone(job: Job, threads: int | None) -> Run:
    """By this process."""

    def run(batches: "Working", report: Report) -> None:
        from diffopt.transfer.precomputation import precompute

        transfer = precompute(
            job.scene, job.settings, batches=batches, report=report, threads=threads
        )
        finish(job, batches, transfer, threads)

    return run


def finish(job: Job, batches: "Working", transfer: "Transfer", threads: int | None) -> None:
    """Write the store."""
    from diffopt.transfer import store

    store.finish(batches, transfer, {"scene": job.found.path.stem, "threads": threads}, job.stored)


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
