"""PNG and TIFF files that promise, or unpack to, gigabytes."""

import struct
import zlib
from typing import Any

from fuzzing.crafted.base import Crafted, wrapped, zeros
from fuzzing.readers.base import single


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(width: int, height: int, *chunks: bytes, depth: int = 8) -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunks) + chunk(b"IEND", b"")


def pictures_of(**options: Any) -> dict[str, Crafted]:
    small = chunk(b"IDAT", zlib.compress(bytes(20)))
    bomb = wrapped(zeros(1500))
    found = {
        "promises 10^10 pixels": png(100_000, 100_000, small),
        "promises 10^18 pixels": png(2**31 - 1, 2**31 - 1, small),
        "text of gigabytes": png(4, 4, chunk(b"zTXt", b"a\0\0" + bomb), small),
        "profile of gigabytes": png(4, 4, chunk(b"iCCP", b"a\0\0" + bomb), small),
        "no pixels": png(0, 4, small),
    }
    cases = {f"png: {k}": Crafted(single("a.png", v, **options)) for k, v in found.items()}
    more = single("a.png", png(4, 4, chunk(b"IDAT", bomb)), **options)
    return cases | {"png: pixels of gigabytes": Crafted(more, harmless=True)}


def tiff(width: int, height: int, strip: bytes, compression: int, **entries: int) -> bytes:
    """A page of one strip, 8 bits."""
    tags = {256: width, 257: height, 258: 8, 259: compression, 262: 1, 273: 0, 277: 1}
    tags |= {278: min(height, 2**32 - 1), 279: len(strip)}
    start = 8 + 2 + 12 * len(tags) + 4
    tags[273] = start
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + body + bytes(4) + strip
