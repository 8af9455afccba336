"""Zarr folders, read without trust: only what this project writes is decoded.

The format lets an array name codecs that run code (version 2's pickles) or that grow without bound,
and metadata may promise any size. Here arrays are of version 3, of plain numbers, through the
codecs of `diffopt.stores` and `diffopt.transfer.zarrays`; and what a chunk states of itself is
compared with what its array says before it is decoded.
"""

import math
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.errors import InputError
from diffopt.io import limits

_CODECS = ("BytesCodec", "BloscCodec", "ZstdCodec", "Crc32cCodec")
# Compressed numbers of more than `MOST_SAMPLES` doubles are no smaller than this share.
_SHARE = 100


def opened(path: Path) -> Any:
    """The group of a folder, to be read.

    Raises
    ------
    InputError
        If something in it is no file and no folder (a pipe would be read for ever), or a text
        is too long.
    Exception
        Of many kinds, if it is damaged.
    """
    import zarr

    for folder, _, names in os.walk(path):
        for name in names:
            file = Path(folder) / name
            try:
                state = file.stat()
            except FileNotFoundError:  # of a process that is at work on it
                continue
            if not stat.S_ISREG(state.st_mode):
                raise InputError(f"{path}: {file.relative_to(path)} is a pipe or a device")
            if name == "zarr.json" and state.st_size > limits.MOST_JSON:
                raise InputError(f"{path}: {state.st_size} bytes of {file.relative_to(path)}")
    return zarr.open_group(path, mode="r", zarr_format=3)


def read(path: Path, item: Any) -> np.ndarray:
    """An array of a group.

    Parameters
    ----------
    path
        What is read, for texts.
    item
        The array.

    Raises
    ------
    InputError
        If chunks are missing, or it is of another kind, larger than its chunks can hold or than
        `diffopt.io.limits` allows.
    Exception
        Of many kinds, if it is damaged.
    """
    name = item.path.rpartition("/")[2]
    meta = item.metadata
    kinds = [type(codec).__name__ for codec in meta.codecs]
    if item.dtype.kind not in "biuf" or not set(kinds) <= set(_CODECS):
        raise InputError(f"{path}: {name} is of {item.dtype} through {', '.join(kinds)}")
    encoding = meta.chunk_key_encoding
    if type(encoding).__name__ != "DefaultChunkKeyEncoding" or encoding.separator != "/":
        raise InputError(f"{path}: chunks of {name} have other names than this project gives them")
    folder = Path(item.store.root) / item.path / "c"
    chunk = math.prod(item.chunks) * item.dtype.itemsize
    whole = math.prod(item.shape) * item.dtype.itemsize
    files = [f for f in folder.rglob("*") if f.is_file()] if item.shape else [folder]
    if item.size and len(files) < item.nchunks:
        lost = item.nchunks - len(files)
        raise InputError(f"{path}: {lost} of {item.nchunks} chunks of {name} are missing")
    stored = sum(file.stat().st_size for file in files)
    most = max(8 * limits.MOST_SAMPLES, _SHARE * stored)
    if max(chunk, whole) > most or min(item.shape, default=0) < 0:
        raise InputError(
            f"{path}: {name} claims {whole:.4g} bytes in chunks of {chunk:.4g}; expected at most "
            f"{most:.4g} of {stored} that are stored"
        )
    for file in files:
        # Compressors add some bytes to what they cannot compress.
        if file.stat().st_size > 2 * chunk + 1024:
            raise InputError(
                f"{path}: chunk {file.relative_to(folder.parent)} of {name} has "
                f"{file.stat().st_size:.4g} bytes; expected {chunk}"
            )
        with file.open("rb") as opened_file:
            claim = _claim(opened_file.read(32), kinds)
        if claim is None or claim > chunk:
            raise InputError(
                f"{path}: chunk {file.relative_to(folder.parent)} of {name} states "
                f"{'no size' if claim is None else f'{claim} bytes'}; expected {chunk}"
            )
    return np.asarray(item[...])


def _claim(head: bytes, kinds: list[str]) -> int | None:
    """Bytes that a chunk says it holds: Blosc's and Zstandard's headers, 0 for plain ones."""
    if "BloscCodec" in kinds and "ZstdCodec" not in kinds:
        return int.from_bytes(head[4:8], "little") if len(head) >= 16 else None
    if "ZstdCodec" in kinds and "BloscCodec" not in kinds:
        if head[:4] != b"\x28\xb5\x2f\xfd" or len(head) < 5:
            return None
        flags = head[4]
        alone = bool(flags & 32)
        size = (int(alone), 2, 4, 8)[flags >> 6]
        at = 5 + (not alone) + (0, 1, 2, 4)[flags & 3]
        found = int.from_bytes(head[at : at + size], "little")
        return found + 256 * (size == 2) if size and len(head) >= at + size else None
    return 0 if not {"BloscCodec", "ZstdCodec"} & set(kinds) else None
