"""A file that says who is at work in a folder, so that no second process is."""

import contextlib
import json
import os
import time
import uuid
from pathlib import Path
from types import TracebackType
from typing import Any

from diffopt import processes
from diffopt.errors import InputError
from diffopt.io.files import aside

# A lock without words is one that is just being written, or that a crash left so.
_PATIENCE = 2.0


class Lock:
    """Held from construction to `release`, or as a context to its end.

    One that a dead process left behind is taken over.

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
        mine = processes.here() | {"name": self.name}
        while not _made(path, json.dumps(mine)):
            holder = _holder(path)
            if holder is None:
                continue
            if processes.running(holder):
                raise InputError(
                    f"{what}: process {holder.get('pid')} on {holder.get('host')} is at work on "
                    f"it; wait for it, or delete {path} if it is not running any more"
                )
            _removed(path, holder)

    def __enter__(self) -> "Lock":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.release()

    def release(self) -> None:
        """Give it back; what is another's by now stays."""
        holder = _read(self.path)
        if holder is not None and holder.get("name") == self.name:
            self.path.unlink(missing_ok=True)


def _made(path: Path, text: str) -> bool:
    try:
        handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
    except FileExistsError:
        return False
    try:
        os.write(handle, text.encode())
    except OSError:
        path.unlink(missing_ok=True)
        raise
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


def _removed(path: Path, holder: dict[str, Any]) -> None:
    """Take away a dead lock, not one that somebody else made in its place meanwhile."""
    gone = aside(path)
    try:
        os.rename(path, gone)
    except FileNotFoundError:
        return
    if (_read(gone) or {}) != holder:
        # Put back, unless there is a newer one already.
        with contextlib.suppress(OSError):
            os.link(gone, path)
    gone.unlink(missing_ok=True)
