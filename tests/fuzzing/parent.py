"""The process that asks a child to load files, and starts another one where it died."""

import contextlib
import dataclasses
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

#: Silence after which the parent kills the child: native code does not see the alarm.
SILENCE = 30.0


@dataclasses.dataclass
class Report:
    """What came of the cases of a reader.

    Attributes
    ----------
    outcomes
        How many were read, refused, or failed.
    faults
        One line each: case, file, damage, what was wrong.
    seconds, memory
        Most of a single file: seconds of the processor, bytes.
    whole
        Seconds of all.
    """

    outcomes: dict[str, int] = dataclasses.field(default_factory=dict)
    faults: list[str] = dataclasses.field(default_factory=list)
    seconds: float = 0.0
    memory: int = 0
    whole: float = 0.0

    def add(self, name: str, answer: dict[str, Any]) -> None:
        outcome = answer["outcome"]
        self.outcomes[outcome] = self.outcomes.get(outcome, 0) + 1
        self.seconds = max(self.seconds, answer.get("seconds", 0.0))
        self.memory = max(self.memory, answer.get("memory", 0))
        label = answer.get("label", "")
        self.faults += [f"{name} {answer['case']} ({label}): {f}" for f in answer["faults"]]


class Child:
    """The process that loads; started again where it died."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self._rest = b""

    def run(self, name: str, count: int | None, first: int = 0) -> Report:
        """Load cases of a reader, so many from the first on; without a number the crafted ones."""
        report, began = Report(), time.monotonic()
        end = None if count is None else first + count
        first = -1 if count is None else first
        whole = False
        while not whole:
            process = self._started()
            assert process.stdin is not None
            request = json.dumps([name, first, end, str(self.folder)])
            with contextlib.suppress(BrokenPipeError):  # what it says then is nothing
                process.stdin.write(request.encode() + b"\n")
                process.stdin.flush()
            at: int | None = None
            while True:
                answer = self._answer(SILENCE if at is not None else 10.0 * SILENCE)
                if not answer:
                    how = self._stopped(silent=answer is not None)
                    if at is None:
                        raise RuntimeError(f"{name}: the child {how} before its first file")
                    report.add(name, {"case": at, "outcome": "died", "faults": [f"child {how}"]})
                    first = at - 1 if end is None else at + 1
                    break
                if "at" in answer:
                    at = answer["at"]
                elif "case" in answer:
                    report.add(name, answer)
                else:
                    whole = True
                    break
        report.whole = time.monotonic() - began
        return report

    def close(self) -> None:
        """End the process."""
        if self._process is not None and self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()
            self._stopped()

    def _started(self) -> "subprocess.Popen[bytes]":
        if self._process is None:
            environment = dict(os.environ, JAX_PLATFORMS="cpu", JAX_ENABLE_X64="1")
            # A cache of programs is written to, which no load may do.
            environment.pop("JAX_COMPILATION_CACHE_DIR", None)
            self._rest = b""
            # For the child this package is beside the tests, as for them.
            paths = [str(Path(__file__).parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
            environment["PYTHONPATH"] = os.pathsep.join(paths)
            with (self.folder / "child.log").open("wb") as log:
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "fuzzing.child"],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    env=environment,
                    cwd=self.folder,
                )
        return self._process

    def _answer(self, patience: float) -> dict[str, Any] | None:
        """A line; None at the end of the child, empty after a silence."""
        assert self._process is not None
        assert self._process.stdout is not None
        until = time.monotonic() + patience
        while b"\n" not in self._rest:
            ready, _, _ = select.select([self._process.stdout], [], [], until - time.monotonic())
            more = os.read(self._process.stdout.fileno(), 65536) if ready else None
            if not more:
                return None if more == b"" else {}
            self._rest += more
        line, _, self._rest = self._rest.partition(b"\n")
        return json.loads(line)

    def _stopped(self, silent: bool = False) -> str:
        """End it, if it has not ended; how it did."""
        process, self._process = self._process, None
        assert process is not None
        code = None
        if silent:
            process.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            code = process.wait(SILENCE)
        if code is None:
            process.kill()
            process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # what was not sent cannot be any more
                    pipe.close()
        log = (self.folder / "child.log").read_text(errors="replace").strip().splitlines()
        last = f": {log[-1][:300]}" if log else ""
        if silent:
            return f"said nothing for long, and was killed{last}"
        if code is None:
            return f"did not end, and was killed{last}"
        return f"died of signal {-code}{last}" if code < 0 else f"ended with {code}{last}"


def scratch() -> "tempfile.TemporaryDirectory[str]":
    """A folder in memory, where there is such a one: cases make and remove many."""
    memory = Path("/dev/shm")
    return tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None)
