"""Gwyddion files through the gwyfile package (extra ``gwy``)."""

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.errors import InputError, missing
from diffopt.io.files import one_line, require_signature
from diffopt.io.record import Options, Record
from diffopt.io.units import is_length, to_micrometres

_MAGIC = b"GWYPGwyContainer\x00"


def read_gwy(path: Path, options: Options) -> Record:
    """Read one channel of a ``.gwy`` file.

    Without ``channel`` the first channel whose values are lengths is read. A mask stored
    with the channel is disregarded, since Gwyddion masks mark selections as well as bad
    data; the notes say how many pixels it covers.

    Raises
    ------
    InputError
        If the extra is not installed, the file is damaged or of another format, or the
        channel is not a height.
    """
    try:
        import gwyfile
    except ImportError as error:
        raise missing(f"{path}: .gwy", "gwyfile", "gwy") from error

    require_signature(path, (_MAGIC,), "a Gwyddion file (.gwy)")
    options.refuse(path, "the file states its heights", "height_range", "height_unit")
    content = path.read_bytes()
    start = len(_MAGIC) + 4
    stated = struct.unpack("<I", content[start - 4 : start])[0] if len(content) >= start else 1
    if len(content) - start < stated:
        raise InputError(
            f"{path}: the Gwyddion file is truncated: {len(content)} bytes, expected "
            f"{start + stated}"
        )
    try:
        container: Any = gwyfile.objects.GwyObject.frombuffer(content[4:])
        fields = _fields(container)
    except Exception as error:  # damaged content fails in many ways inside the parser
        raise InputError(f"{path}: the Gwyddion file is damaged: {one_line(error)}") from error
    number, title, field = _choose(path, fields, options)
    unit_z, unit_xy = _unit(field.si_unit_z), _unit(field.si_unit_xy)
    data = np.asarray(field.data, dtype=np.float64)
    stated_pixel = None
    if field.xreal and field.yreal and unit_xy:
        factor = to_micrometres(unit_xy, f"{path}: the width of channel {title!r}")
        stated_pixel = (
            float(field.yreal) / data.shape[0] * factor,
            float(field.xreal) / data.shape[1] * factor,
        )
    notes = ()
    mask = container.get(f"/{number}/mask")
    if mask is not None and np.any(mask.data > 0):
        notes = (f"a mask over {int((mask.data > 0).sum())} pixels in the file was disregarded",)
    heights = data * to_micrometres(unit_z, f"{path}: channel {title!r}")
    return Record(heights, options.pixel(path, stated_pixel), title, notes=notes)


def _fields(container: Any) -> list[tuple[int, str, Any]]:
    """List (number, title, data field) of each channel, by number."""
    found = []
    for key, value in container.items():
        if match := re.fullmatch(r"/(\d+)/data", key):
            title = container.get(f"{key}/title", f"channel {match.group(1)}")
            found.append((int(match.group(1)), str(title), value))
    return sorted(found, key=lambda item: item[0])


def _unit(unit) -> str:
    return "" if unit is None else unit.unitstr


def _choose(path: Path, fields: list, options: Options):
    listing = ", ".join(f"{n}: {title!r} in {_unit(f.si_unit_z)!r}" for n, title, f in fields)
    if not fields:
        raise InputError(f"{path}: the Gwyddion file holds no channel")
    if options.channel is None:
        for item in fields:
            if is_length(_unit(item[2].si_unit_z)):
                return item
        raise InputError(f"{path}: no channel is a height; there are {listing}")
    matches = [item for item in fields if options.channel in item[:2]]
    if len(matches) != 1:
        raise InputError(f"{path}: no single channel {options.channel!r}; there are {listing}")
    if not is_length(_unit(matches[0][2].si_unit_z)):
        raise InputError(
            f"{path}: channel {options.channel!r} is not a height; there are {listing}"
        )
    return matches[0]
