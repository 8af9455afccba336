"""Which reader or writer a file name calls for."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from diffopt.errors import InputError
from diffopt.io.arrays import read_npy, read_npz, write_npz
from diffopt.io.files import existing_file
from diffopt.io.gwyddion import read_gwy
from diffopt.io.images import read_png, read_tiff, write_tiff
from diffopt.io.instruments import read_instrument
from diffopt.io.record import Options, Record
from diffopt.io.text import read_matrix, read_xyz

READERS: dict[str, Callable[[Path, Options], Record]] = {
    "npy": read_npy,
    "npz": read_npz,
    "png": read_png,
    "tiff": read_tiff,
    "matrix": read_matrix,
    "xyz": read_xyz,
    "gwy": read_gwy,
    "instrument": read_instrument,
}
SUFFIXES = {
    ".npy": "npy",
    ".npz": "npz",
    ".png": "png",
    ".tif": "tiff",
    ".tiff": "tiff",
    ".txt": "matrix",
    ".asc": "matrix",
    ".csv": "matrix",
    ".xyz": "xyz",
    ".gwy": "gwy",
}
WRITERS = {".npz": write_npz, ".tif": write_tiff, ".tiff": write_tiff}

# Fewer pixels than this on a side are not a map.
_LEAST_SIDE = 2


def read(path: str | os.PathLike, options: Options | None = None) -> Record:
    """Read a heightfield file.

    The reader follows from the suffix (any other suffix than those of `SUFFIXES` is tried
    as an instrument file) or from ``options.format``, a key of `READERS`.

    Returns
    -------
    Record
        Heights [ny, nx] and pixel in micrometres, NaN where the file has no value.

    Raises
    ------
    InputError
        If the file cannot be used; the text names it and what was expected.
    """
    options = Options() if options is None else options
    path = existing_file(path)
    name = options.format or SUFFIXES.get(path.suffix.lower(), "instrument")
    if name not in READERS:
        raise InputError(f"format={name!r}: expected one of {', '.join(READERS)}")
    if options.lateral_unit is not None and name != "xyz":
        raise InputError(f"{path}: lateral_unit= is for xyz lists only")
    # What overflows in its unit is infinite, and refused below.
    with np.errstate(over="ignore", invalid="ignore"):
        record = READERS[name](path, options)
    if not all(0.0 < side < np.inf for side in record.pixel):
        raise InputError(f"{path}: pixels of {record.pixel} micrometres; expected sizes above 0")
    if min(record.heights.shape) < _LEAST_SIDE:
        raise InputError(f"{path}: a map of {record.heights.shape} pixels; expected at least 2x2")
    if np.isinf(record.heights).any():
        raise InputError(f"{path}: infinite heights; expected finite numbers or nan")
    if np.isnan(record.heights).all():
        raise InputError(f"{path}: every pixel is missing")
    return record


def write(
    path: str | os.PathLike,
    heights: np.ndarray,
    pixel: tuple[float, float],
    steps: tuple[str, ...] = (),
) -> None:
    """Write heights [ny, nx] and pixel (dy, dx), in micrometres, as the suffix says.

    ``.npz`` keeps the heights exactly; ``.tif`` rounds them to 16 bits. Both carry units and
    history, and load without further arguments. Nothing is left behind on failure.

    Raises
    ------
    InputError
        If the suffix is another one, or the folder does not exist.
    """
    path = Path(path)
    writer = WRITERS.get(path.suffix.lower())
    if writer is None:
        raise InputError(f"{path}: cannot write {path.suffix!r}; expected {', '.join(WRITERS)}")
    writer(path, heights, pixel, steps)
