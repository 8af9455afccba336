"""How much a file may ask for; checked before anything of that size is made.

A file's size is a fact, what its header says is a claim. A claim is compared with the bytes that
are there where the data are plain, and with these limits where they are compressed.
"""

import math
import zlib
from collections.abc import Iterable
from pathlib import Path

from diffopt.errors import InputError

#: Most samples of an array, a picture or a map: 0.5 GB of float32, 1 GB of float64.
MOST_SAMPLES = 2**27
#: Most bytes of a file.
MOST_BYTES = 64 * MOST_SAMPLES
#: Most bytes of JSON, which is parsed as a whole; of a scene; of a table of numbers.
MOST_JSON, MOST_SCENE, MOST_TEXT = 2**26, 2**24, 2**30
# Deflated data grow by no more than this when they are inflated (zlib's technical notes).
_DEFLATE = 1032


def samples(path: Path, shape: Iterable[int], what: str = "samples") -> int:
    """How many samples a shape has, if that can be.

    Raises
    ------
    InputError
        If a side is negative, or there are more than `MOST_SAMPLES`.
    """
    sides = [int(side) for side in shape]
    count = math.prod(sides)
    if min(sides, default=0) < 0:
        raise InputError(f"{path}: sides of {sides}; expected none below 0")
    if count > MOST_SAMPLES:
        shown = f"{count:.3g}" if count < 10**300 else "more than 1e300"
        raise InputError(f"{path}: {shown} {what}; at most {MOST_SAMPLES:.3g} are accepted")
    return count


def inflated(path: Path, claim: int, packed: int, what: str) -> None:
    """Refuse a claim that so many deflated bytes cannot keep, or that is too large.

    Raises
    ------
    InputError
        With the claim and the limit.
    """
    most = min(8 * MOST_SAMPLES + 2**16, _DEFLATE * packed + 64)
    if claim > most:
        raise InputError(
            f"{path}: {what} claims {claim:.4g} bytes; expected at most {most:.4g} of its {packed}"
        )


def inflates_to(path: Path, data: bytes, most: int) -> None:
    """Refuse deflated data that hold more than so many bytes, without holding them.

    Raises
    ------
    InputError
        If they do. Broken data are left to the reader.
    """
    if len(data) * _DEFLATE <= most:
        return
    stream = zlib.decompressobj()
    try:
        found = len(stream.decompress(data, most + 1))
    except zlib.error:
        return
    if found > most:
        raise InputError(f"{path}: compressed data of more than the {most} bytes that are stated")


def text(path: Path, most: int) -> bytes:
    """A file that is parsed as a whole.

    Raises
    ------
    InputError
        If it has more than so many bytes.
    """
    size = path.stat().st_size
    if size > most:
        raise InputError(f"{path}: {size:.4g} bytes of text; at most {most:.4g} are accepted")
    return path.read_bytes()
