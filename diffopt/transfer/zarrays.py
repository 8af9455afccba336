"""Arrays in zarr: compressed, with checksums, in chunks of some megabytes."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.io import zarr_files

_CHUNK_ELEMENTS = 2**20


def write(
    group: Any,
    name: str,
    values: np.ndarray,
    *,
    differences: bool = False,
    attributes: dict[str, Any] | None = None,
) -> None:
    """Write an array.

    Parameters
    ----------
    group
        A zarr group.
    name
        In it.
    values
        Numbers.
    differences
        Of whole numbers: each row less the one before it, in as many bytes as that needs.
    attributes
        Kept with it; see `read`.
    """
    from zarr.codecs import BloscCodec, Crc32cCodec

    stated = dict(attributes or {})
    if differences:
        stated["sum"] = str(values.dtype)
        values = narrow(np.diff(values.astype(np.int64), axis=0, prepend=0))
    # Small numbers in rows compress better as they stand, all others byte by byte.
    whole = values.dtype.kind in "iu"
    codec = BloscCodec(cname="zstd", clevel=9, shuffle="noshuffle" if whole else "shuffle")
    group.create_array(
        name,
        data=np.ascontiguousarray(values),
        chunks=_chunks(values.shape),
        compressors=[codec, Crc32cCodec()],
        attributes=stated,
        config={"write_empty_chunks": True},
    )


def read(group: Any, path: Path) -> dict[str, np.ndarray]:
    """All arrays of a group by their names; attributes as ``name.attribute``.

    Raises
    ------
    InputError
        As for `diffopt.io.zarr_files.read`.
    Exception
        Of many kinds, where one is damaged.
    """
    found: dict[str, np.ndarray] = {}
    for name, item in group.arrays():
        values = zarr_files.read(path, item)
        stated = dict(item.attrs)
        if "sum" in stated:
            values = np.cumsum(values, axis=0, dtype=np.int64).astype(stated.pop("sum"))
        found[name] = values
        found |= {f"{name}.{key}": np.asarray(value) for key, value in stated.items()}
    return found


def narrow(values: np.ndarray) -> np.ndarray:
    """Whole numbers as the smallest type that holds them."""
    if not values.size:
        return values.astype(np.int8)
    low, high = int(values.min()), int(values.max())
    kinds = (np.uint8, np.int8, np.uint16, np.int16, np.int32, np.int64)
    fits = [k for k in kinds if np.iinfo(k).min <= low and high <= np.iinfo(k).max]
    return values.astype(fits[0])


def _chunks(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Whole rows, as many as make a chunk."""
    row = max(math.prod(shape[1:]), 1)
    rows = max(1, min(max(shape[0], 1), _CHUNK_ELEMENTS // row))
    return (rows, *(max(n, 1) for n in shape[1:]))
