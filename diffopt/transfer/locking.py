"""A file that says who is at work in a folder, so that no second process is."""

import contextlib
import json
import os
import socket
import time
import uuid
from pathlib import Path
from typing import Any

from diffopt.errors import InputError

# A lock without words is one that is just being written, or that a crash left so.
_PATIENCE = 2.0


class Lock:
    """Held from construction to `release`; one that a dead process left behind is taken over.

    Parameters
    ----------
    path
        The file; its folder exists.
    what
        What is locked, for the error text.

    Raises
    ------
    InputError
        If another process is at work, or one of another machine may be.
    """

    def __init__(self, path: Path, what: Path) -> None:
        self.path, self.name = path, uuid.uuid4().hex
        mine = _self() | {"name": self.name}
        while not _made(path, json.dumps(mine)):
            holder = _holder(path)
            if holder is None:
                continue
            if _alive(holder):
                raise InputError(
                    f"{what}: process {holder.get('pid')} on {holder.get('host')} is at work on "
                    f"it; wait for it, or delete {path} if it is not running any more"
                )
            _removed(path, holder)

    def release(self) -> None:
        """Give it back; what is another's by now stays."""
        holder = _read(self.path)
        if holder is not None and holder.get("name") == self.name:
            self.path.unlink(missing_ok=True)


def _self() -> dict[str, Any]:
    return {"pid": os.getpid(), "host": socket.gethostname(), "began": _began(os.getpid())}


def _began(pid: int) -> str | None:
    """When a process began, in a form that tells it from a later one of the same number."""
    try:
        line = Path(f"/proc/{pid}/stat").read_text()
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:  # not Linux
        return None
    # After the name, which may hold anything, in brackets.
    return f"{boot} {line.rpartition(')')[2].split()[19]}"


def _made(path: Path, text: str) -> bool:
    try:
        handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
    except FileExistsError:
        return False
    try:
        os.write(handle, text.encode())
    finally:
        os.close(handle)
    return True


def _holder(path: Path) -> dict[str, Any] | None:
    """What the lock says; {} if it says nothing for long, None if it is gone."""
    until = time.monotonic() + _PATIENCE
    while path.exists():
        found = _read(path)
        if found is not None:
            return found
        if time.monotonic() > until:
            return {}
        time.sleep(0.02)
    return None


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _alive(holder: dict[str, Any]) -> bool:
    """Whether the process that wrote a lock may still be running."""
    pid = holder.get("pid")
    if not isinstance(pid, int) or pid <= 0:
        return False
    if holder.get("host") != socket.gethostname():
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    began = _began(pid)
    return began is None or holder.get("began") is None or began == holder["began"]


def _removed(path: Path, holder: dict[str, Any]) -> None:
    """Take away a dead lock, not one that somebody else made in its place meanwhile."""
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        os.rename(path, aside)
    except FileNotFoundError:
        return
    if (_read(aside) or {}) != holder:
        # Put back, unless there is a newer one already.
        with contextlib.suppress(OSError):
            os.link(aside, path)
    aside.unlink(missing_ok=True)
