"""Processes that end in the middle of their work: at an operation on files, or at a moment.

`Frozen` lets nothing change below a folder from its n-th operation on, as if the process had been
killed there; hundreds of points take seconds. `Child` runs a command in a process of its own, which
gets a real SIGKILL.
"""

import collections
import contextlib
import csv
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from diffopt import processes
from diffopt.io import files

# Events of the interpreter for what changes a folder; the first argument names the place.
CHANGES = {"os.rename", "os.remove", "os.rmdir", "os.mkdir", "os.link", "os.truncate", "os.symlink"}


class Killed(BaseException):
    """In place of a kill: no handler of errors takes it for one."""


class Frozen:
    """A context in which a folder can be changed `after` times, and then not any more.

    Parameters
    ----------
    folder
        Changes elsewhere are not counted.
    after
        Operations that are carried out; all of them, but counted, for None.
    error
        Made anew for what comes after: `Killed`, or an OSError, for which removing still works.
    """

    current = None

    def __init__(self, folder, after=None, error: Callable[[], BaseException] = Killed):
        self.folder, self.after, self.error = os.path.realpath(folder), after, error
        self.events = []
        self.broken = False

    def __enter__(self):
        if not _hooked:
            sys.addaudithook(_audit)
            _hooked.append(True)
        Frozen.current = self
        return self

    def __exit__(self, *_):
        Frozen.current = None

    def seen(self, event, place):
        if not os.path.realpath(place).startswith(self.folder + os.sep):
            return
        full = self.error is not Killed
        if full and event in ("os.remove", "os.rmdir"):
            return
        self.events.append((event, place))
        if self.after is not None and len(self.events) > self.after:
            self.broken = True
            raise self.error()

    def points(self, long):
        """Operations at which to stop another run of the same: all in a night.

        Else those around every renaming but zarr's own, the first and last ones, some between.
        """
        count = len(self.events)
        if long:
            return range(count)
        renamed = [
            k
            for k, (event, place) in enumerate(self.events)
            if event == "os.rename" and not place.endswith(".partial")
        ]
        near = {n for k in renamed[:2] + renamed[-3:] for n in (k, k + 1)}
        return sorted({*range(3), *range(3, count, 90), *near, count - 2, count - 1})


_hooked = []


def _audit(event, arguments):
    """Interpreters cannot take a hook back: it asks for the context."""
    now = Frozen.current
    if now is None or (event not in CHANGES and event != "open"):
        return
    place = arguments[0]
    if not isinstance(place, str | bytes | os.PathLike):
        return
    place = os.fsdecode(place)
    if event == "open" and not (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
        return
    if event in ("os.remove", "os.rmdir") and arguments[1] >= 0:
        # In removing folders, names are within a folder that is open.
        place = os.path.join(os.readlink(f"/proc/self/fd/{arguments[1]}"), place)
    now.seen(event, place)


def as_another(monkeypatch):
    """Let locks and names of files be those of a process that has ended."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    mine, mark = processes.here(), processes.mark
    monkeypatch.setattr(processes, "here", lambda: mine | {"pid": child.pid})
    monkeypatch.setattr(processes, "mark", lambda: re.sub(r"^\d+", str(child.pid), mark()))


def fresh():
    """Forget what was looked through, as a new process has."""
    files._swept.clear()


def content(folder):
    """Digests of all files by their names; dates and what was timed are left out."""
    found = {}
    for path in sorted(Path(folder).rglob("*")):
        if path.is_file():
            data = path.read_bytes()
            if path.suffix == ".json" and data:
                data = json.dumps(_timeless(json.loads(data))).encode()
            elif path.suffix == ".csv":
                rows = list(csv.DictReader(data.decode().splitlines()))
                data = json.dumps(_timeless(rows)).encode()
            elif path.suffix == ".txt":
                lines = data.decode().splitlines()
                data = "\n".join(one for one in lines if one.split()[:1] != ["time"]).encode()
            found[str(path.relative_to(folder))] = hashlib.sha256(data).hexdigest()
    return found


def _timeless(value):
    if isinstance(value, dict):
        left = {"date", "seconds", "core_seconds", "threads", "compile_s", "run_s", "gradient_s"}
        return {name: _timeless(part) for name, part in value.items() if name not in left}
    return [_timeless(part) for part in value] if isinstance(value, list) else value


RUN = """
import sys
import jax
jax.config.update("jax_enable_x64", sys.argv[1] == "1")
from diffopt.cli import main
from diffopt.rendering import keeping
keeping.EVERY, keeping._SHARE = 0.0, 1e9
print("begun", file=sys.stderr, flush=True)
sys.exit(main(sys.argv[2:]))
"""


class Child:
    """A command in a process of its own, that keeps tiles of pictures as soon as they are done."""

    def __init__(self, words, cwd=None):
        wide = "1" if jnp.ones(()).dtype == jnp.float64 else "0"
        self.process = subprocess.Popen(
            [sys.executable, "-c", RUN, wide, *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=cwd,
        )
        # All is imported, nothing is done.
        assert self.process.stderr is not None
        assert self.process.stderr.readline() == "begun\n"
        self.began = time.monotonic()

    def ended(self, timeout=300):
        """Wait for it: exit code, what it printed, seconds of work."""
        out, err = self.process.communicate(timeout=timeout)
        return self.process.returncode, out, err, time.monotonic() - self.began

    def killed(self, after=0.0, when=None):
        """Kill it some seconds after it began, or when something is so; whether it was running."""
        until = self.began + after
        while self.process.poll() is None:
            if when() if when is not None else time.monotonic() >= until:
                break
            time.sleep(0.002)
        with contextlib.suppress(ProcessLookupError):
            self.process.send_signal(signal.SIGKILL)
        self.process.communicate()
        return self.process.returncode == -signal.SIGKILL


def many(words, at, kills, *, phase, readable, drawn=()):
    """Kill a command at random moments, over and over, on what it left before.

    Parameters
    ----------
    words
        The command but for its output, which comes last.
    at
        An empty folder.
    kills
        How many.
    phase
        From the output's path to a word for how far it is.
    readable
        Called with that path after each kill; raises where it cannot be read.
    drawn
        Names of files that show what was timed, as pictures of times do.

    Returns
    -------
    dict
        How many kills hit each phase, and of how many outputs all were the same.
    """

    def found(path):
        name = {**content(path)} if path.is_dir() else {path.name: path.read_bytes()}
        return {key: value for key, value in name.items() if key not in drawn}

    output = words.pop()
    first = at / "first" / output
    first.parent.mkdir()
    code, _, err, seconds = Child([*words, first]).ended()
    assert code in (0, 1), err
    expected = found(first)
    rng = np.random.default_rng(20140113)
    hit, whole, done, number = collections.Counter(), 0, 0, 0
    path = at / "0" / output
    path.parent.mkdir()
    while done < kills:
        child = Child([*words, path])
        if child.killed(rng.uniform(0.0, 1.05) * seconds):
            done += 1
            hit[phase(path)] += 1
            readable(path)
            continue
        assert child.process.returncode == code
        assert found(path) == expected
        # Nothing is left aside.
        assert [one.name for one in path.parent.iterdir()] == [output]
        whole, number = whole + 1, number + 1
        path = at / f"{number}" / output
        path.parent.mkdir()
    assert Child([*words, path]).ended()[0] == code
    assert found(path) == expected
    assert [one.name for one in path.parent.iterdir()] == [output]
    return {"kills": done, "seconds": round(seconds, 1), **hit, "same": whole + 1}
