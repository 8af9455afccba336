"""Checks made before a file is read, and writing that leaves no half-written file."""

import contextlib
import importlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import IO

from diffopt import processes
from diffopt.errors import InputError, missing
from diffopt.io.limits import MOST_BYTES

# First bytes of common files, for error texts that say what a renamed file really is.
_SIGNATURES = (
    (b"\x89PNG\r\n\x1a\n", "a PNG image"),
    (b"II*\x00", "a TIFF image"),
    (b"MM\x00*", "a TIFF image"),
    (b"II+\x00", "a BigTIFF image"),
    (b"MM\x00+", "a BigTIFF image"),
    (b"\x93NUMPY", "a NumPy array file"),
    (b"PK\x03\x04", "a zip archive (.npz, .x3p)"),
    (b"GWYP", "a Gwyddion file"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
    (b"\xff\xd8\xff", "a JPEG image"),
    (b"GIF8", "a GIF image"),
    (b"%PDF", "a PDF document"),
    (b"DIGITAL SURF", "a Digital Surf file (.sur)"),
    (b"\\*File list", "a Nanoscope file"),
    (b"\\*Force file list", "a Nanoscope force file"),
)


def existing_file(path: str | os.PathLike) -> Path:
    """Return the path, if it names a file that is not empty.

    Pipes and devices, which may never end, are none.

    Raises
    ------
    InputError
        If there is no such file, it is a folder, a pipe or a device, it is empty, or has more
        than `diffopt.io.limits.MOST_BYTES` bytes.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; expected a file")
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if not path.is_file():
        raise InputError(f"{path}: is a pipe or a device; expected a file")
    size = path.stat().st_size
    if size == 0:
        raise InputError(f"{path}: the file is empty")
    if size > MOST_BYTES:
        raise InputError(f"{path}: {size:.4g} bytes; at most {MOST_BYTES:.4g} are accepted")
    return path


def describe(path: Path) -> str:
    """Say what a file is by its first bytes."""
    with path.open("rb") as file:
        head = file.read(512)
    for signature, name in _SIGNATURES:
        if head.startswith(signature):
            return name
    if b"\x00" in head:
        return f"binary data starting with {head[:8]!r}"
    return f"text starting with {head[:20].decode('utf-8', 'replace')!r}"


def require_signature(path: Path, signatures: tuple[bytes, ...], expected: str) -> None:
    """Refuse a file that does not start as its format does, and say what it looks like.

    Raises
    ------
    InputError
        If none of the signatures is found.
    """
    with path.open("rb") as file:
        head = file.read(max(map(len, signatures)))
    if not head.startswith(signatures):
        raise InputError(f"{path}: expected {expected}, found {describe(path)}")


def aside(path: Path) -> Path:
    """A name beside a path for what is to take its place when it is complete.

    The first call for a folder removes what processes that were killed left there under such
    names.
    """
    folder = Path(os.path.abspath(path.parent))
    if folder not in _swept:
        _swept.add(folder)
        sweep(folder)
    return path.with_name(f".{path.name}.{processes.mark()}")


# Folders that were looked through by this process.
_swept: set[Path] = set()


def sweep(folder: Path) -> None:
    """Remove what has a name of `aside` by a process of this machine that has ended."""
    try:
        names = os.listdir(folder)
    except OSError:  # there is none: what writes to it says so
        return
    for name in names:
        if name.startswith(".") and processes.left(name.rpartition(".")[2]):
            remove(folder / name)


def remove(path: Path) -> None:
    """Remove a file or a folder as far as that can be done."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[IO[bytes]]:
    """Open a temporary file beside ``path`` that takes its place when all went well.

    Raises
    ------
    InputError
        If the folder does not exist.
    OSError
        If the file cannot be written; it has a name.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    temporary = aside(path)
    try:
        with temporary.open("xb") as file:
            yield file
        os.replace(temporary, path)
    except BaseException as error:
        remove(temporary)
        # A full disk is noticed in writing, where only numbers of files are known.
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(temporary)):
            error.filename = str(path)
        raise


def swap(new: Path, target: Path) -> None:
    """Put a folder in the place of another; until it is there, `standing` finds the old one."""
    old = replaced(target)
    if target.exists():
        remove(old)
        os.rename(target, old)
    try:
        os.rename(new, target)
    except BaseException:
        if old.exists():
            os.rename(old, target)
        raise
    remove(old)


def standing(target: Path) -> Path:
    """A folder, or if a process was killed as it was replaced, where the old one is."""
    old = replaced(target)
    return old if old.exists() and not target.exists() else target


def replaced(target: Path) -> Path:
    """Where the old folder is while `swap` puts a new one in its place."""
    return target.with_name(f".{target.name}.replaced")


def settle(folder: Path) -> None:
    """Wait until all files below a folder, and their names, are on the disk."""
    for path in [*folder.rglob("*"), folder, folder.parent]:
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def openexr(path: str | os.PathLike, instead: str) -> ModuleType:
    """The library that reads and writes .exr.

    Raises
    ------
    InputError
        If it is not installed; names the file and says what to do `instead`.
    """
    try:
        return importlib.import_module("OpenEXR")
    except ImportError:
        raise missing(f"{path}: .exr", "OpenEXR", "exr", f", or save {instead}") from None


def one_line(error: BaseException | str, limit: int = 160) -> str:
    """Return the first line of an error text, shortened."""
    text = str(error).strip()
    line = text.splitlines()[0] if text else type(error).__name__
    return line if len(line) <= limit else line[: limit - 3] + "..."
