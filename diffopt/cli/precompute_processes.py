"""``diffopt precompute`` as one of several processes.

They were started by ``srun`` or its like, and look after each other, see
`diffopt.transfer.distributed`; or by a process of this machine that looks after them, see
`diffopt.cli.precompute_children`.
"""

import contextlib
import dataclasses
import json
import os
import sys
import threading
import traceback
import uuid
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NoReturn

import typer

from diffopt.cli import errors
from diffopt.cli.precompute_jobs import FAILED, Job, Report, compute, finish
from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.transfer.distributed import Company
    from diffopt.transfer.working import Working

# Processes of one machine.
_MOST = 256


@dataclasses.dataclass(frozen=True)
class Place:
    """Options that say which processes there are.

    Raises
    ------
    InputError
        Where they do not go together.
    """

    processes: int | None
    distributed: bool
    coordinator: str | None
    process: int | None
    joined: bool

    def __post_init__(self) -> None:
        if self.distributed and (self.coordinator or self.processes or self.process is not None):
            raise InputError(
                "--distributed asks srun or mpirun which processes there are; give it alone, or "
                "--coordinator, --processes and --process"
            )
        if self.coordinator is None and self.process is not None:
            raise InputError("--process needs --coordinator HOST:PORT and --processes")
        if self.coordinator is not None:
            host, _, port = self.coordinator.rpartition(":")
            if not host or not port.isdigit() or not 0 < int(port) < 65536:
                raise InputError(f"--coordinator must be HOST:PORT; received {self.coordinator!r}")
            if self.processes is None or self.process is None:
                raise InputError("--coordinator needs --processes and --process")
            if not 0 <= self.process < self.processes:
                raise InputError(
                    f"--process must lie between 0 and {self.processes - 1}, one below "
                    f"--processes; received {self.process}"
                )
        elif self.processes is not None and not 1 <= self.processes <= _MOST:
            raise InputError(
                f"--processes must lie between 1 and {_MOST}; received {self.processes}"
            )

    @property
    def member(self) -> bool:
        """Whether this process is one of several that something else started."""
        return self.distributed or self.coordinator is not None

    @property
    def count(self) -> int:
        """Processes to start, 1 for none."""
        return 1 if self.member else self.processes or 1


@contextlib.contextmanager
def member(place: Place) -> "Iterator[Company]":
    """One of several processes: joins them, and takes leave at the end.

    A process that fails ends at once, as the service of `jax.distributed` would wait for it.
    """
    from diffopt.transfer.distributed import DESERTED, DesertedError, joined

    if place.joined:
        threading.Thread(target=_with_parent, daemon=True).start()
    company = joined(
        place.coordinator,
        place.processes,
        place.process,
        watched=not place.joined,
        # Of one machine the parent takes care.
        **({"patience": 120, "heartbeat": 100} if place.joined else {}),
    )
    try:
        yield company
    except DesertedError as error:
        if company.index == 0:
            errors.report(error)
        _end(DESERTED)
    except InputError as error:
        named = str(error) if company.index == 0 else f"{company.name(company.index)}: {error}"
        _end(errors.report(InputError(named)))
    except typer.Exit as error:
        _end(error.exit_code)
    except SystemExit as error:
        _end(error.code if isinstance(error.code, int) else FAILED)
    except BaseException:
        traceback.print_exc()
        _end(FAILED)
    company.close()
    if place.joined or company.index:
        # At once: threads that wait for the service would be torn down with the interpreter.
        _end(0)


def _end(code: int) -> NoReturn:
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _with_parent() -> None:
    """End when the process that looks after this one has ended, however that was."""
    while os.read(0, 1):
        pass
    os._exit(FAILED)


def work(job: Job, company: "Company", threads: int | None, *, joined: bool, quiet: bool) -> None:
    """The share of one process; process 0 finishes the store.

    Parameters
    ----------
    job
        Checked.
    company
        All processes.
    threads
        Of this one.
    joined
        Whether a parent holds the lock, and shows how far the work is.
    quiet
        Tell nothing.
    """
    from diffopt.transfer.distributed import DESERTED
    from diffopt.transfer.precomputation import precompute
    from diffopt.transfer.working import Working

    def run(batches: "Working", report: Report | None) -> None:
        company.leaving.append(batches.close)
        transfer = precompute(
            job.scene,
            job.settings,
            batches=batches,
            report=report,
            threads=threads,
            company=company,
        )
        # All have read all batches, which are removed then.
        company.together("the end")
        if company.index == 0:
            finish(job, batches, transfer, threads)

    def begin() -> str:
        session = uuid.uuid4().hex
        company.tell("way", session)
        return session

    def share(session: str, report: Report | None) -> None:
        named = f"{session}/{company.index}"
        with Working(job.output, job.scene, job.settings, session=named, joined=True) as batches:
            run(batches, report)

    if company.index:
        way = company.hear("way")
        if way == "refused":
            raise SystemExit(DESERTED)
        if way != "finished":
            share(way, None)
    elif joined:
        share(begin(), _told)
    else:
        told: list[str] = []
        session = uuid.uuid4().hex

        def first(batches: "Working", report: Report) -> None:
            told.append(session)
            company.tell("way", session)
            run(batches, report)

        try:
            compute(job, first, quiet=quiet, session=f"{session}/0")
        except InputError:
            if not told:
                company.tell("way", "refused")
            raise
        if not told:
            company.tell("way", "finished")


def _told(now: Any) -> None:
    """Tell the parent how far the work is."""
    print(json.dumps(dataclasses.asdict(now)), flush=True)
