"""Progress bar on the error stream, and times with compilation apart."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

_compiled = [0.0]
_listening = [False]


def _listen() -> None:
    """Add up what JAX reports of tracing, lowering and compiling, from now on."""
    if _listening[0]:
        return
    import jax

    def note(event: str, duration_secs: float, **kwargs: str | int) -> None:
        del kwargs
        if event.startswith("/jax/core/compile/"):
            _compiled[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(note)
    _listening[0] = True


@dataclasses.dataclass
class Times:
    """Seconds of one stage.

    Attributes
    ----------
    total_s
        By the clock.
    compile_s
        Of it, JAX's tracing, lowering and compiling.
    """

    total_s: float = 0.0
    compile_s: float = 0.0

    @property
    def run_s(self) -> float:
        """The rest."""
        return self.total_s - self.compile_s


class Stages:
    """Named stages of a job, shown as a bar and timed.

    Attributes
    ----------
    times
        Of each stage that has ended, in order.
    """

    def __init__(self, bar: "Progress", count: int):
        self.times: dict[str, Times] = {}
        self._bar = bar
        self._task = bar.add_task("", total=float(count))
        self._ended = 0

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[int | float, int | float], None]]:
        """Time a stage; gives a function to report (done, of) within it."""
        self._bar.update(self._task, description=name)
        start, compiled = time.perf_counter(), _compiled[0]

        def report(done: int | float, of: int | float) -> None:
            self._bar.update(self._task, completed=self._ended + done / of)

        yield report
        elapsed = time.perf_counter() - start
        self.times[name] = Times(elapsed, min(_compiled[0] - compiled, elapsed))
        self._ended += 1
        self._bar.update(self._task, completed=self._ended)

    def tell(self, text: str) -> None:
        """Show what a stage is about, in place of its name."""
        self._bar.update(self._task, description=text)

    @property
    def sum(self) -> Times:
        """All stages together."""
        return Times(
            sum(t.total_s for t in self.times.values()),
            sum(t.compile_s for t in self.times.values()),
        )


def terminal() -> "Console":
    """Console for results: as wide as the terminal, wide in files and pipes."""
    import sys

    from rich.console import Console

    return Console(highlight=False, width=None if sys.stdout.isatty() else 160)


@contextmanager
def stages(count: int, *, left: bool = False) -> Iterator[Stages]:
    """Show a bar for a job of `count` stages, if the error stream is a terminal.

    Parameters
    ----------
    count
        Of the stages.
    left
        Whether the time left is shown too: for jobs whose parts take alike.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        ProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    _listen()
    console = Console(stderr=True)
    columns: tuple[ProgressColumn, ...] = (
        TextColumn("{task.description:<22}"),
        BarColumn(),
        TimeElapsedColumn(),
    )
    if left:
        columns += (TextColumn("left"), TimeRemainingColumn())
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        yield Stages(bar, count)
