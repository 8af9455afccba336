"""Processes of this machine that do the work of ``diffopt precompute`` together.

This one looks after them: it holds the lock, shows how far they are, and ends all where one has
ended. They end by themselves where it has: a pipe from it is closed then.
"""

import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from typing import IO, TYPE_CHECKING, Any, NoReturn

import typer

from diffopt import workers
from diffopt.cli import errors
from diffopt.cli.precompute_jobs import FAILED, Job, Report, Run
from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.transfer.working import Working


def children(job: Job, count: int, threads: int | None) -> Run:
    """By processes of this machine."""

    def run(batches: "Working", report: Report) -> None:
        with _Family(job, count, threads) as family:
            family.watch(report)

    return run


class _Family:
    """Processes that do the work of this one; a context that leaves none of them running."""

    def __init__(self, job: Job, count: int, threads: int | None) -> None:
        self.output, self.count = job.output, count
        self.said: list[IO[bytes]] = []
        self.processes: list[subprocess.Popen[bytes]] = []
        self.lines: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        each = max(1, (cores or 1) // count)
        words = _words(job, count, threads or min(each, workers.count()))
        environment = os.environ | _environment(count, each)
        try:
            for index in range(count):
                self.said.append(tempfile.TemporaryFile())  # noqa: SIM115
                child = subprocess.Popen(
                    [*words, "--process", str(index)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL if index else subprocess.PIPE,
                    stderr=self.said[-1],
                    env=environment,
                    start_new_session=True,  # Ctrl-C is for this process
                )
                self.processes.append(child)
        except BaseException:
            self._kill()
            raise
        threading.Thread(target=self._listen, daemon=True).start()

    def __enter__(self) -> "_Family":
        return self

    def __exit__(self, *_: object) -> None:
        self._kill()

    def _kill(self) -> None:
        for child in self.processes:
            if child.poll() is None:
                child.kill()
        for child in self.processes:
            child.wait()
            if child.stdin is not None:
                child.stdin.close()

    def _listen(self) -> None:
        out = self.processes[0].stdout
        assert out is not None
        with out:
            for line in out:
                self.lines.put(line)

    def watch(self, report: Report) -> None:
        """Wait for all; ends all where one fails."""
        from diffopt.transfer.precomputation import Progress

        while True:
            codes = [child.poll() for child in self.processes]
            with contextlib.suppress(queue.Empty):
                while True:
                    report(Progress(**json.loads(self.lines.get_nowait())))
            if any(codes):
                self._failed()
            if None not in codes:
                return
            time.sleep(0.05)

    def _failed(self) -> NoReturn:
        """Say which process failed, and why; others may have followed it already."""
        from diffopt.transfer.distributed import KEPT

        time.sleep(0.2)
        codes = {k: c for k, child in enumerate(self.processes) if (c := child.poll())}
        self._kill()
        index = min(codes, key=lambda k: (_following(codes[k]), k))
        code, text = codes[index], self._text(index)
        if code == errors.BAD_INPUT:
            found = [line for line in text.splitlines() if line.startswith("diffopt: error: ")]
            if found:
                raise InputError(found[-1].removeprefix("diffopt: error: "))
        name = f"process {index} of {self.count} (pid {self.processes[index].pid})"
        if code == -signal.SIGKILL:
            what = "was killed, as by the system where memory is short"
        elif code < 0:
            what = f"was ended by signal {-code} ({signal.strsignal(-code)})"
        else:
            print(text, end="", file=sys.stderr)
            what = f"failed with exit code {code}"
        print(f"diffopt: {self.output}: {name} {what}; {KEPT}", file=sys.stderr)
        raise typer.Exit(FAILED)

    def _text(self, index: int) -> str:
        file = self.said[index]
        file.seek(0)
        return file.read().decode("utf-8", "replace")


def _following(code: int) -> int:
    """Whether a process has ended of itself, 0, or as one does that has lost the others."""
    from diffopt.transfer.distributed import DESERTED

    return 1 if code in (DESERTED, -signal.SIGABRT) else 0


def _words(job: Job, count: int, threads: int) -> list[str]:
    """The command of a child but for its number."""
    words = [sys.executable, "-m", "diffopt", "precompute", job.given, "-o", str(job.output)]
    for name, value in (job.words | {"compression": job.compression}).items():
        if value is not None:
            words += [f"--{name}", str(value)]
    words += ["--threads", str(threads), "--coordinator", f"127.0.0.1:{_port()}"]
    return [*words, "--processes", str(count), "--joined", "--quiet"]


def _port() -> int:
    """One that nobody listens at."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


def _environment(count: int, cores: int) -> dict[str, str]:
    """Of children: types as here, cores and the memory of an accelerator shared."""
    import jax

    config: Any = jax.config
    found = {"JAX_ENABLE_X64": str(int(config.jax_enable_x64))}
    # Threads of XLA's own.
    found["NPROC"] = os.environ.get("NPROC", str(cores))
    share = "XLA_PYTHON_CLIENT_MEM_FRACTION"
    found[share] = os.environ.get(share, f"{0.9 / count:.3f}")
    return found
