"""Refusal of files that claim to be enormous, before anything of that size is allocated."""

import struct
import zipfile
from pathlib import Path

from diffopt.errors import InputError
from diffopt.io import numpy_files
from diffopt.io.limits import MOST_SAMPLES


def refuse_enormous(path: Path) -> None:
    """Refuse a file whose header states more than `MOST_SAMPLES` samples.

    Headers of ``.npy``, ``.npz``, PNG and TIFF are looked at, found by the file's first
    bytes; for all other files, and broken headers, which the readers refuse themselves, the
    size of the file is the limit: 64 bytes for each sample.

    Raises
    ------
    InputError
        With the number found and the limit.
    """
    if not path.is_file():
        return
    with path.open("rb") as file:
        head = file.read(32)
    claim = None
    if head.startswith(b"\x93NUMPY"):
        with path.open("rb") as file:
            claim = _npy(file)
    elif head.startswith(b"PK\x03\x04"):
        claim = _archive(path)
    elif head.startswith(b"\x89PNG") and len(head) >= 24:
        width, height = struct.unpack(">II", head[16:24])
        claim = width * height
    elif head[:4] in (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+"):
        claim = _tiff(path)
    if claim is None and path.stat().st_size > 64 * MOST_SAMPLES:
        claim = path.stat().st_size // 64
    if claim is not None and claim > MOST_SAMPLES:
        raise InputError(
            f"{path}: {claim:.3g} samples; at most {MOST_SAMPLES:.3g} are accepted "
            "(crop or resample the scan first)"
        )


def _npy(file) -> int | None:
    import math

    try:
        return math.prod(numpy_files.claimed(file)[0])
    except ValueError:
        return None


def _archive(path: Path) -> int | None:
    try:
        with zipfile.ZipFile(path) as archive:
            claims = []
            for name in archive.namelist():
                if name.endswith(".npy"):
                    with archive.open(name) as file:
                        claims.append(_npy(file) or 0)
            return max(claims, default=None)
    except Exception:  # a damaged archive fails in many ways; the reader says how
        return None


def _tiff(path: Path) -> int | None:
    import math

    import tifffile

    try:
        with tifffile.TiffFile(path) as file:
            return max(math.prod(page.shape) for page in file.pages)
    except Exception:  # a damaged header fails in many ways; the reader says how
        return None
