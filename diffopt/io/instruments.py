"""Instrument formats through the SurfaceTopography package (extra ``afm``).

Nanoscope ``.di``, ``.spm``; Digital Surf ``.sur``; Nanosurf ``.nid``, ``.ezd``; Molecular
Imaging ``.mi``; Wyko ``.opd``; ISO 5436-2 ``.x3p`` and the others of its list.
SurfaceTopography indexes [x, y]; rows here are y. Row 0 is the first row of the file.
"""

import re
import warnings
from pathlib import Path

import numpy as np

from diffopt.errors import InputError, missing
from diffopt.io import limits
from diffopt.io.files import describe, one_line
from diffopt.io.record import Options, Record
from diffopt.io.units import is_length, to_micrometres

# Some readers label every channel of a file as a height. A name that says otherwise wins.
_NOT_A_HEIGHT = re.compile(
    r"phase|amplitude|error|deflection|friction|lateral|current|voltage|potential"
    r"|magnitude|adhesion|stiffness|modulus|dissipation|deformation|intensity",
    re.IGNORECASE,
)


def read_instrument(path: Path, options: Options) -> Record:
    """Read one channel of an instrument file.

    Without ``channel`` the first channel that is a height is read. Points that the file
    marks as not measured are NaN. Warnings of the reader go into the notes.

    Raises
    ------
    InputError
        If the extra is not installed, no reader knows the file, it is damaged, or the
        channel is not a height or not a map on a regular grid.
    """
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            from SurfaceTopography.IO import open_topography
        except ImportError as error:
            what = f"{path}: {describe(path)}, which"
            raise missing(what, "SurfaceTopography", "afm") from error
        # The import itself warns that it runs without MPI, which is meant so.
        caught.clear()
        try:
            record = _read(path, options, open_topography)
        except InputError:
            raise
        except Exception as error:  # forty-odd parsers, each failing in its own way
            raise InputError(_refusal(path, error)) from error
    notes = tuple(dict.fromkeys(f"reader: {one_line(w.message)}" for w in caught))
    return Record(record.heights, record.pixel, record.channel, notes=notes)


def _read(path: Path, options: Options, open_topography) -> Record:
    options.refuse(path, "it is for grey values in PNG and TIFF", "height_range")
    with open_topography(str(path)) as reader:
        channel = _choose(path, list(reader.channels), options)
        name = f"{path}: channel {channel.name!r}"
        if channel.dim != 2:
            raise InputError(f"{name} is a line scan; expected a map [ny, nx]")
        if not channel.is_uniform:
            raise InputError(f"{name} is not on a regular grid")
        nx, ny = channel.nb_grid_pts
        limits.samples(path, (nx, ny))
        arguments = {}
        if channel.physical_sizes is None:
            dy, dx = options.pixel(path)
            arguments["physical_sizes"] = (dx * nx, dy * ny)
        topography = reader.topography(channel_index=channel.index, **arguments)
        heights = topography.heights()
    if channel.unit is None:
        # The package keeps one unit for lengths in all three directions.
        scale = options.unit(path)
        lateral = 1.0 if channel.physical_sizes is None else scale
    else:
        options.refuse(path, f"the file states {channel.unit!r}", "height_unit")
        scale = lateral = _factor(topography.unit, name)
    if channel.physical_sizes is None:
        pixel = options.pixel(path)
    else:
        size_x, size_y = topography.physical_sizes
        pixel = options.pixel(path, (float(size_y) * lateral / ny, float(size_x) * lateral / nx))
    heights = np.ma.filled(np.ma.asarray(heights, dtype=np.float64), np.nan)
    return Record(np.ascontiguousarray(heights.T) * scale, pixel, channel.name)


def _factor(unit: object, name: str) -> float:
    # Channels labelled as heights by the reader: here "A" can only be the angstrom.
    return to_micrometres("angstrom" if unit == "A" else unit, name)


def _is_height(channel) -> bool:
    unit_is_length = channel.unit is None or channel.unit == "A" or is_length(channel.unit)
    return channel.is_height_channel and unit_is_length and not _NOT_A_HEIGHT.search(channel.name)


def _choose(path: Path, channels: list, options: Options):
    listing = ", ".join(
        f"{c.index}: {c.name!r}" + ("" if _is_height(c) else " (not a height)") for c in channels
    )
    if options.channel is None:
        chosen = next((c for c in channels if _is_height(c)), None)
        if chosen is None:
            raise InputError(f"{path}: no channel is a height; there are {listing}")
        return chosen
    by_name = isinstance(options.channel, str)
    matches = [c for c in channels if (c.name if by_name else c.index) == options.channel]
    if not matches:
        raise InputError(f"{path}: no channel {options.channel!r}; there are {listing}")
    if len(matches) > 1:
        raise InputError(
            f"{path}: {len(matches)} channels are called {options.channel!r}; choose by number: "
            f"{listing}"
        )
    if not _is_height(matches[0]):
        raise InputError(
            f"{path}: channel {options.channel!r} is not a height; there are {listing}"
        )
    return matches[0]


def _refusal(path: Path, error: Exception) -> str:
    from SurfaceTopography.Exceptions import CannotDetectFileFormat

    if isinstance(error, CannotDetectFileFormat):
        return (
            f"{path}: no reader knows this file, or it is truncated: {describe(path)}; expected "
            "one of the instrument formats of SurfaceTopography"
        )
    return f"{path}: {describe(path)} that is damaged or truncated: {one_line(error)}"
