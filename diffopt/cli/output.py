"""Folders of results that are complete or absent."""

import contextlib
import errno
import os
from collections.abc import Iterator
from pathlib import Path

from diffopt.errors import InputError
from diffopt.io.files import aside, remove

# What is wrong with the disk, not with the program: full, or not to be written to.
_DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO}


@contextlib.contextmanager
def written(target: Path, kept: str = "") -> Iterator[None]:
    """Take faults of the disk inside for faults of where the user wants something written.

    Parameters
    ----------
    target
        File or folder, for the error text.
    kept
        What is not lost, for the same.

    Raises
    ------
    InputError
        In their place.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _DISK:
            raise
        words = f"{target}: cannot be written: {_reason(error)}"
        raise InputError(words + (f"; {kept}" if kept else "")) from error


def _reason(error: OSError) -> str:
    """In the words of the system."""
    return str(error.strerror or error).lower()


def beside(target: Path, what: str) -> Path:
    """Where a command keeps what is not finished yet: .NAME.WHAT beside the target."""
    target = Path(os.path.abspath(target))
    return target.with_name(f".{target.name}.{what}")


@contextlib.contextmanager
def folder(target: Path) -> Iterator[Path]:
    """Give a temporary folder beside `target` whose files move into it when all went well.

    Files that `target` already holds stay unless one of the same name comes. On failure
    nothing is left behind, also none of the folders made on the way.

    Raises
    ------
    InputError
        At once, if `target` is a file or cannot be written to; later, if the disk is full.
    """
    target = Path(os.path.abspath(target))
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: is a file; expected a folder for the results")
    made: list[Path] = []
    staging = None
    try:
        _make_parents(target.parent, made)
        staging = aside(target)
        if target.is_dir() and not os.access(target, os.W_OK | os.X_OK):
            raise InputError(f"{target}: the folder cannot be written to")
        try:
            staging.mkdir()
        except OSError as error:
            raise InputError(f"{target}: cannot be written to: {_reason(error)}") from error
        with written(target):
            yield staging
            _move(staging, target)
    except BaseException:
        if staging is not None:
            remove(staging)
        for path in made:
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


def _make_parents(parent: Path, made: list[Path]) -> None:
    """Make missing folders, noting them innermost first."""
    missing = []
    while not parent.exists():
        missing.append(parent)
        parent = parent.parent
    if not parent.is_dir():
        raise InputError(f"{parent}: is a file; expected a folder for the results")
    for path in reversed(missing):
        try:
            path.mkdir()
        except OSError as error:
            raise InputError(f"{path}: cannot be made: {_reason(error)}") from error
        made.insert(0, path)


def _move(staging: Path, target: Path) -> None:
    if not target.exists():
        os.rename(staging, target)
        return
    for path in sorted(staging.iterdir()):
        os.replace(path, target / path.name)
    staging.rmdir()
