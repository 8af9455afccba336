"""NumPy files: bare arrays, and the project's own ``.npz`` with units and provenance."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.errors import InputError
from diffopt.io import numpy_files
from diffopt.io.files import one_line, replacing
from diffopt.io.record import Options, Record

FORMAT = "diffopt heightfield"
VERSION = 1


def read_npy(path: Path, options: Options) -> Record:
    """Read a ``.npy`` file holding one [ny, nx] array.

    The file states neither unit nor pixel size: ``height_unit`` and ``pixel_size`` are
    required.

    Raises
    ------
    InputError
        If the file is damaged, of another format, or not a real [ny, nx] array.
    """
    options.refuse(path, "a .npy file has one channel", "channel")
    options.refuse(path, "a .npy file holds numbers, not grey values", "height_range")
    return _bare(path, numpy_files.array(path), options)


def read_npz(path: Path, options: Options) -> Record:
    """Read a ``.npz`` file: the project's own, or a foreign one with a single 2-D array.

    Of several arrays in a foreign file ``channel`` names the one to read. A foreign file
    needs ``height_unit`` and ``pixel_size``.

    Raises
    ------
    InputError
        If the file is damaged, of another format, or has no array to read.
    """
    options.refuse(path, "a .npz file holds numbers, not grey values", "height_range")
    content = numpy_files.archive(path)
    if "format" in content and str(content["format"]) == FORMAT:
        return _own(path, content, options)
    planes = {name: array for name, array in content.items() if array.ndim == 2}
    if options.channel is not None:
        if options.channel not in planes:
            raise InputError(
                f"{path}: no [ny, nx] array {options.channel!r}; there are {sorted(planes)}"
            )
        return _bare(path, planes[str(options.channel)], options, str(options.channel))
    if len(planes) != 1:
        raise InputError(
            f"{path}: expected one [ny, nx] array, found {sorted(planes)}; name one by channel="
        )
    ((name, heights),) = planes.items()
    return _bare(path, heights, options, name)


def write_npz(
    path: Path, heights: np.ndarray, pixel: tuple[float, float], steps: tuple[str, ...]
) -> None:
    """Write heights (micrometres, dtype kept), pixel and history to a ``.npz`` file."""
    with replacing(path) as file:
        np.savez_compressed(file, **entries(heights, pixel, steps))


def entries(
    heights: np.ndarray, pixel: tuple[float, float], steps: tuple[str, ...]
) -> dict[str, Any]:
    """Entries of a ``.npz`` file that are read as heights; others may stand beside them."""
    return {
        "format": np.array(FORMAT),
        "version": np.array(VERSION),
        "unit": np.array("um"),
        "pixel": np.asarray(pixel, dtype=np.float64),
        "steps": np.array(json.dumps(steps)),
        "heights": heights,
    }


def _own(path: Path, content: dict[str, np.ndarray], options: Options) -> Record:
    options.refuse(path, "the file states its unit", "height_unit")
    options.refuse(path, "the file has one channel", "channel")
    try:
        version, unit = int(content["version"]), str(content["unit"])
        dy, dx = (float(value) for value in content["pixel"])
        heights = content["heights"]
        steps = tuple(str(step) for step in json.loads(str(content["steps"])))
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: a damaged {FORMAT} file: {one_line(error)}") from error
    if version != VERSION or unit != "um":
        raise InputError(
            f"{path}: {FORMAT} version {version} in {unit!r}; expected version {VERSION} in 'um'"
        )
    return Record(_real_plane(path, heights), options.pixel(path, (dy, dx)), steps=steps)


def _bare(path: Path, heights: np.ndarray, options: Options, channel: str | None = None) -> Record:
    heights = _real_plane(path, heights)
    return Record(heights * options.unit(path), options.pixel(path), channel)


def _real_plane(path: Path, heights: np.ndarray) -> np.ndarray:
    if heights.ndim != 2 or heights.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: expected a real [ny, nx] array, found {heights.dtype} {heights.shape}"
        )
    return numpy_files.doubles(heights)
