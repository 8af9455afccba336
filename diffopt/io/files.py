"""Checks made before a file is read, and writing that leaves no half-written file."""

import contextlib
import importlib
import os
import uuid
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import IO

from diffopt.errors import InputError, missing

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

    Raises
    ------
    InputError
        If there is no such file, it is a folder, or it is empty.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; expected a file")
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty")
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


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[IO[bytes]]:
    """Open a temporary file beside ``path`` that takes its place when all went well.

    Raises
    ------
    InputError
        If the folder does not exist.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"{path}: the folder {path.parent} does not exist")
    aside = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    try:
        with aside.open("xb") as file:
            yield file
        os.replace(aside, path)
    except BaseException:
        aside.unlink(missing_ok=True)
        raise


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
