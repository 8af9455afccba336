"""NumPy's files, read without trust: what the header promises is compared with what is there.

NumPy's own loader takes the memory that a header asks for before it reads, and its header parser
fails in ways of its own (``tokenize.TokenError``). Here data are looked at before anything is
allocated, and object arrays, which are pickles, are never loaded.
"""

import io
import warnings
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as layout

from diffopt.errors import InputError
from diffopt.io import limits
from diffopt.io.files import one_line, require_signature

_MAGIC = b"\x93NUMPY"
# Bytes of a header; of plain numbers it has some hundred.
_LONGEST = 2**16
# What NumPy writes; the others (bzip2, LZMA) need memory that only their data state.
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def array(path: Path) -> np.ndarray:
    """The array of a ``.npy`` file.

    Raises
    ------
    InputError
        If the file is of another format, damaged, shorter than its header says, of objects, or
        larger than `diffopt.io.limits` allows.
    """
    require_signature(path, (_MAGIC,), "a NumPy array file (.npy)")
    with path.open("rb") as file:
        return _read(path, file, path.stat().st_size, "the array")


def archive(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a ``.npz`` file by their names; members of other kinds are left out.

    Raises
    ------
    InputError
        As for `array`; also if an array claims more bytes than its compressed ones can hold, or
        all together more than the limit.
    """
    require_signature(path, (b"PK\x03\x04",), "a NumPy archive (.npz)")
    found: dict[str, np.ndarray] = {}
    try:
        with path.open("rb") as whole, zipfile.ZipFile(whole) as members:
            every = [m for m in members.infolist() if m.filename.endswith(".npy")]
            claim = sum(member.file_size for member in every)
            limits.inflated(path, claim, path.stat().st_size, "the archive")
            for member in every:
                if member.compress_type not in _METHODS:
                    raise InputError(
                        f"{path}: the archive cannot be read: {member.filename!r} is compressed by "
                        f"method {member.compress_type}; expected 0 (stored) or 8 (deflated)"
                    )
                limits.inflated(path, member.file_size, member.compress_size, member.filename)
                with members.open(member) as file:
                    name = member.filename.removesuffix(".npy")
                    found[name] = _read(path, file, member.file_size, "the archive")
    except InputError:
        raise
    except Exception as error:  # damaged archives fail in many ways inside zipfile and zlib
        raise InputError(f"{path}: the archive cannot be read: {one_line(error)}") from error
    return found


def doubles(values: np.ndarray) -> np.ndarray:
    """As float64; a NaN that signals becomes one that does not, without a warning."""
    with np.errstate(invalid="ignore"):
        return values.astype(np.float64)


def claimed(file: Any) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether in Fortran's order, and type, from the header of an array.

    Raises
    ------
    ValueError
        If it is damaged.
    """
    try:
        first = layout.read_magic(file) == (1, 0)
        read = layout.read_array_header_1_0 if first else layout.read_array_header_2_0
        length = file.read(2 if first else 4)
        size = int.from_bytes(length, "little")
        if size > _LONGEST:
            raise ValueError(f"it claims {size} bytes; expected at most {_LONGEST}")
        with warnings.catch_warnings():
            # Of files that Python 2 wrote, which are read all the same.
            warnings.simplefilter("ignore", UserWarning)
            return read(io.BytesIO(length + file.read(size)))
    except Exception as error:  # the parser of headers is one of Python, and fails as such
        raise ValueError(f"its header is damaged: {one_line(error)}") from error


def _read(path: Path, file: Any, size: int, what: str) -> np.ndarray:
    """An array from an open file, or a member of an archive, of so many bytes."""
    try:
        shape, fortran, kind = claimed(file)
    except ValueError as error:
        raise InputError(f"{path}: {what} cannot be read: {error}") from error
    if kind.hasobject or kind.itemsize == 0 or kind.fields is not None:
        raise InputError(f"{path}: {what} cannot be read: {kind} {shape}; expected plain numbers")
    count = limits.samples(path, shape)
    promised = count * kind.itemsize
    if promised > size or promised > 8 * limits.MOST_SAMPLES:
        raise InputError(
            f"{path}: {what} cannot be read: {kind} {shape} needs {promised:.4g} bytes; there are "
            f"{size}"
        )
    data = file.read(promised)
    # The end of a member is where its checksum is tested.
    file.read(1)
    if len(data) < promised:
        raise InputError(
            f"{path}: {what} cannot be read: it ends after {len(data)} of {promised} bytes"
        )
    try:
        flat = np.frombuffer(data, kind, count) if count else np.empty(0, kind)
        return flat.reshape(shape, order="F" if fortran else "C").copy()
    except ValueError as error:
        raise InputError(f"{path}: {what} cannot be read: {one_line(error)}") from error
