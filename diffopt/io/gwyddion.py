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
# Bytes of one item of a component, by its type; texts and objects end where they say.
_SIZES = {b"b": 1, b"c": 1, b"i": 4, b"q": 8, b"d": 8, b"C": 1, b"I": 4, b"Q": 8, b"D": 8}
_DEEPEST = 32


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
        _object(content, 4, len(content), 0)
        container: Any = gwyfile.objects.GwyObject.frombuffer(content[4:])
        fields = _fields(container)
        number, title, field = _choose(path, fields, options)
        unit_z, unit_xy = _unit(field.si_unit_z), _unit(field.si_unit_xy)
        data = np.asarray(field.data, dtype=np.float64)
        xreal, yreal = float(field.xreal or 0.0), float(field.yreal or 0.0)
        mask = container.get(f"/{number}/mask")
        masked = 0 if mask is None else int((np.asarray(mask.data) > 0).sum())
    except InputError:
        raise
    except Exception as error:  # damaged content fails in many ways inside the parser
        raise InputError(f"{path}: the Gwyddion file is damaged: {one_line(error)}") from error
    if data.ndim != 2 or 0 in data.shape:
        raise InputError(f"{path}: channel {title!r} is of shape {data.shape}; expected [ny, nx]")
    stated_pixel = None
    if xreal and yreal and unit_xy:
        factor = to_micrometres(unit_xy, f"{path}: the width of channel {title!r}")
        stated_pixel = (yreal / data.shape[0] * factor, xreal / data.shape[1] * factor)
    notes = ()
    if masked:
        notes = (f"a mask over {masked} pixels in the file was disregarded",)
    heights = data * to_micrometres(unit_z, f"{path}: channel {title!r}")
    return Record(heights, options.pixel(path, stated_pixel), title, notes=notes)


def _object(content: bytes, at: int, end: int, depth: int) -> int:
    """Where an object ends, if it and all in it lie before `end`.

    The parser follows sizes without looking whether they fit, for ever if they do not.

    Raises
    ------
    ValueError
        If something does not fit, is of an unknown type, or lies deeper than `_DEEPEST`.
    """
    if depth > _DEEPEST:
        raise ValueError(f"objects lie deeper than {_DEEPEST} in another")
    at = _word(content, at, end)
    (size,) = struct.unpack_from("<I", content, at)
    at, stop = at + 4, at + 4 + size
    if stop > end:
        raise ValueError(f"an object ends at byte {stop}, what holds it at {end}")
    while at < stop:
        at = _word(content, at, stop)
        kind, at = content[at : at + 1], at + 1
        count = 1
        if kind in (b"C", b"I", b"Q", b"D", b"S", b"O"):
            (count,) = struct.unpack_from("<I", content, at)
            at += 4
        if kind in _SIZES:
            at += count * _SIZES[kind]
        elif kind in (b"s", b"S", b"o", b"O"):
            for _ in range(count):
                text = kind in (b"s", b"S")
                at = _word(content, at, stop) if text else _object(content, at, stop, depth + 1)
        else:
            raise ValueError(f"a component of type {kind!r}")
        if at > stop:
            raise ValueError(f"a component ends at byte {at}, what holds it at {stop}")
    return stop


def _word(content: bytes, at: int, end: int) -> int:
    """Where a text that a zero byte ends is over."""
    found = content.find(b"\0", at, end)
    if found < 0:
        raise ValueError(f"a text from byte {at} on has no end")
    return found + 1


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
