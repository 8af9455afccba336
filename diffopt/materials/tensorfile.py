"""Tensor files: named arrays in one binary file, as measurements are published.

A tensor file starts with ``tensor_file`` and a zero byte, a version of two bytes (1, 0) and
the number of fields, uint32. Each field is the length of its name (uint16), the name, the
number of axes (uint16), a type (uint8), the place of its data in the file (uint64) and its
shape (uint64 each); all little-endian. Mitsuba 3 reads the same files. `diffopt.materials.rgl`
and `diffopt.materials.pbsdf` make materials of them.
"""

import math
import os
import struct
from pathlib import Path
from typing import Any

import jax
import numpy as np

from diffopt import checks
from diffopt.errors import InputError
from diffopt.io.files import existing_file, replacing, require_signature

_MAGIC = b"tensor_file\x00"
# Types by their number in the file; 0 is not used.
_TYPES = ("", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")


def read_tensors(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read all fields of a tensor file, by name.

    Raises
    ------
    InputError
        If there is no such file, it is of another format or version, or is cut short.
    """
    path = existing_file(path)
    require_signature(path, (_MAGIC,), "a tensor file (.bsdf, .pbsdf)")
    data = path.read_bytes()
    fields, at = {}, len(_MAGIC)

    def take(layout: str) -> tuple[Any, ...]:
        nonlocal at
        found = struct.unpack_from("<" + layout, data, at)
        at += struct.calcsize("<" + layout)
        return found

    try:
        version = take("BB")
        if version != (1, 0):
            raise InputError(
                f"{path}: a tensor file of version {version[0]}.{version[1]}; expected 1.0"
            )
        for _ in range(take("I")[0]):
            (length,) = take("H")
            name = take(f"{length}s")[0].decode("utf-8", "replace")
            axes, kind = take("HB")
            (offset, *shape) = take(f"Q{axes}Q")
            if not 0 < kind < len(_TYPES):
                raise InputError(
                    f"{path}: field {name!r} is of type {kind}; expected 1 to {len(_TYPES) - 1}"
                )
            size = math.prod(shape) * np.dtype(_TYPES[kind]).itemsize
            if offset + size > len(data):
                raise InputError(
                    f"{path}: is cut short: field {name!r} ends at byte {offset + size}, "
                    f"the file at {len(data)}"
                )
            count = math.prod(shape)
            array = np.frombuffer(data, _TYPES[kind], count, offset) if count else np.empty(0)
            try:
                fields[name] = array.astype(_TYPES[kind], copy=False).reshape(shape)
            except ValueError:  # too many axes, or sides too long beside a side of 0
                raise InputError(
                    f"{path}: field {name!r} has {axes} axes, of {str(shape[:4])[:80]}; expected "
                    "a shape that an array can have"
                ) from None
    except struct.error:
        raise InputError(f"{path}: is cut short within its list of fields") from None
    return fields


def write_tensors(path: str | os.PathLike, fields: dict[str, np.ndarray]) -> None:
    """Write a tensor file; it appears when it is complete.

    Raises
    ------
    InputError
        For a type that the format does not have, or no such folder.
    """
    arrays = {name: np.asarray(value) for name, value in fields.items()}
    size = sum(2 + len(name.encode()) + 11 + 8 * a.ndim for name, a in arrays.items())
    header, data = struct.pack("<12s2BI", _MAGIC, 1, 0, len(arrays)), b""
    start = len(header) + size
    for name, array in arrays.items():
        kind = array.dtype.newbyteorder("<").str.lstrip("|<")
        numbers = [i for i, t in enumerate(_TYPES) if t.lstrip("<") == kind]
        if not numbers:
            raise InputError(f"field {name!r} is of type {array.dtype}; expected real numbers")
        header += struct.pack("<H", len(name.encode())) + name.encode()
        header += struct.pack(
            f"<HBQ{array.ndim}Q", array.ndim, numbers[0], start + len(data), *array.shape
        )
        data += array.astype(_TYPES[numbers[0]]).tobytes()
    with replacing(path) as file:
        file.write(header + data)


def canonical(array: np.ndarray) -> Any:
    """The type of an array, as far as jax is set up to hold it."""
    return jax.dtypes.canonicalize_dtype(array.dtype)


def require(
    path: Path, fields: dict[str, np.ndarray], names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    """The fields with these names, or an InputError that lists what the file has."""
    missing = [name for name in names if name not in fields]
    if missing:
        raise InputError(
            f"{path}: no field {', '.join(missing)}; there are {', '.join(sorted(fields))}"
        )
    return {name: fields[name] for name in names}


def increasing(path: Path, name: str, nodes: np.ndarray, count: int) -> np.ndarray:
    """Nodes of an axis: as many as its entries, increasing; else an InputError."""
    if nodes.size != count or not (np.diff(nodes) > 0.0).all():
        raise InputError(f"{path}: expected {count} increasing nodes {name}; found {nodes.size}")
    return nodes.astype(np.float64)


def at_wavelengths(
    path: Path, nodes: np.ndarray, values: np.ndarray, axis: int, wavelengths: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Values at wavelengths, linear between the nodes; all in micrometres."""
    nodes = increasing(path, "wavelengths", nodes, nodes.size)
    if wavelengths is None:
        return nodes, values
    checks.wavelengths(wavelengths)
    um = np.atleast_1d(np.asarray(wavelengths, np.float64))
    if um.min() < nodes[0] - 1e-6 or um.max() > nodes[-1] + 1e-6:
        raise InputError(
            f"{path}: wavelengths must be within {nodes[0]:g} to {nodes[-1]:g} micrometres; "
            f"received {um.min():g} to {um.max():g}"
        )
    first = np.clip(np.searchsorted(nodes, um, "right") - 1, 0, max(len(nodes) - 2, 0))
    following = np.minimum(first + 1, len(nodes) - 1)
    step = np.where(following > first, nodes[following] - nodes[first], 1.0)
    share = np.clip((um - nodes[first]) / step, 0.0, 1.0)
    share = share.reshape((-1,) + (1,) * (values.ndim - axis - 1))
    low, high = values.take(first, axis), values.take(following, axis)
    # A missing neighbour does not count where its share is 0.
    mixed = (1.0 - share) * low + share * high
    return um, np.where(share == 0.0, low, np.where(share == 1.0, high, mixed))
