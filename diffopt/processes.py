"""Which process made something, and whether that is still running."""

import functools
import hashlib
import os
import re
import socket
import uuid
from pathlib import Path
from typing import Any

# Number of the process, when it began, machine and boot, and a random part.
_MARK = re.compile(r"(\d+)-(\d+)-([0-9a-f]{8})-[0-9a-f]{8}")


def here() -> dict[str, Any]:
    """What `running` asks of the process that calls; of what JSON has."""
    return {"pid": os.getpid(), "host": socket.gethostname(), "began": _began(os.getpid())}


def running(holder: dict[str, Any]) -> bool:
    """Whether a process may still be running; of other machines that is not known."""
    pid = holder.get("pid")
    if not isinstance(pid, int) or pid <= 0:
        return False
    if holder.get("host") != socket.gethostname():
        return True
    if not _exists(pid):
        return False
    began = _began(pid)
    return began is None or holder.get("began") is None or began == holder["began"]


def mark() -> str:
    """Part of a file's name, another at each call, that tells by `left` whose the file is."""
    pid = os.getpid()
    return f"{pid}-{_ticks(pid) or 0}-{_machine()}-{uuid.uuid4().hex[:8]}"


def left(marked: str) -> bool:
    """Whether a text is a mark of a process of this machine that has ended since."""
    found = _MARK.fullmatch(marked)
    if found is None or found[3] != _machine():
        return False
    pid = int(found[1])
    return not _exists(pid) or int(found[2]) != (_ticks(pid) or 0)


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


def _began(pid: int) -> str | None:
    """When a process began, in a form that tells it from a later one of the same number."""
    ticks, boot = _ticks(pid), _boot()
    return None if ticks is None or boot is None else f"{boot} {ticks}"


def _ticks(pid: int) -> int | None:
    """When a process began, since the machine started."""
    try:
        line = Path(f"/proc/{pid}/stat").read_text()
    except OSError:  # not Linux, or it has ended
        return None
    # After the name, which may hold anything, in brackets.
    return int(line.rpartition(")")[2].split()[19])


@functools.cache
def _boot() -> str | None:
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:  # not Linux
        return None


@functools.cache
def _machine() -> str:
    """Machine, boot and the numbering of processes, which containers have of their own."""
    try:
        numbering = os.readlink("/proc/self/ns/pid")
    except OSError:  # not Linux
        numbering = ""
    text = f"{socket.gethostname()} {_boot()} {numbering}"
    return hashlib.sha256(text.encode()).hexdigest()[:8]
