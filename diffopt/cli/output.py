"""Folders of results that are complete or absent."""

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path

from diffopt.errors import InputError


@contextlib.contextmanager
def folder(target: Path) -> Iterator[Path]:
    """Give a temporary folder beside `target` whose files move into it when all went well.

    Files that `target` already holds stay unless one of the same name comes. On failure
    nothing is left behind, also none of the folders made on the way.

    Raises
    ------
    InputError
        At once, if `target` is a file or cannot be written to.
    """
    target = Path(os.path.abspath(target))
    if target.exists() and not target.is_dir():
        raise InputError(f"{target}: is a file; expected a folder for the results")
    made: list[Path] = []
    staging = target.parent / f".{target.name}.{uuid.uuid4().hex}"
    try:
        _make_parents(target.parent, made)
        if target.is_dir() and not os.access(target, os.W_OK | os.X_OK):
            raise InputError(f"{target}: the folder cannot be written to")
        try:
            staging.mkdir()
        except OSError as error:
            raise InputError(f"{target}: cannot be written to: {error.strerror}") from error
        yield staging
        _move(staging, target)
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
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
            raise InputError(f"{path}: cannot be made: {error.strerror}") from error
        made.insert(0, path)


def _move(staging: Path, target: Path) -> None:
    if not target.exists():
        os.rename(staging, target)
        return
    for path in sorted(staging.iterdir()):
        os.replace(path, target / path.name)
    staging.rmdir()
