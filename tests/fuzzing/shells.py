"""Damage within a sound shell: archives, PNG chunks, JSON texts and chunks with checksums."""

import io
import json
import struct
import warnings
import zipfile
import zlib
from typing import Any

import numpy as np

from fuzzing.damage import WORDS, Damage, plain


def _zipped(data: bytes, rng: np.random.Generator) -> bytes:
    """A member of an archive damaged, its checksums made to fit."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[int(rng.integers(len(members)))]
    kind = int(rng.integers(8))
    if kind == 0:
        del members[name]
    elif kind == 1:
        members[WORDS[int(rng.integers(len(WORDS)))]] = members[name]
    else:
        members[name] = plain(members[name], rng)
    out = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")
        for key, content in members.items():
            # No names with zero bytes: zipfile cuts them itself.
            archive.writestr(key.replace("\0", "_") or "empty", content)
    return out.getvalue()


def _chunked(data: bytes, rng: np.random.Generator) -> bytes:
    """A chunk of a PNG damaged, its checksum made to fit."""
    chunks, at = [], 8
    while at + 12 <= len(data):
        (size,) = struct.unpack(">I", data[at : at + 4])
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    k = int(rng.integers(len(chunks)))
    name, body = chunks[k]
    if name == b"IDAT" and rng.random() < 0.5:
        body = zlib.compress(plain(zlib.decompress(body), rng))
    else:
        body = plain(body, rng)
    chunks[k] = name, body
    out = data[:8]
    for name, body in chunks:
        whole = name + body
        out += struct.pack(">I", len(body)) + whole + struct.pack(">I", zlib.crc32(whole))
    return out


def _rewritten(data: bytes, rng: np.random.Generator) -> bytes:
    """A value of a JSON text replaced by one of another kind or size."""
    content = json.loads(data)
    places: list[tuple[Any, Any]] = []

    def walk(value: Any) -> None:
        for key in value if isinstance(value, dict) else range(len(value)):
            places.append((value, key))
            if isinstance(value[key], dict | list):
                walk(value[key])

    walk(content)
    values = (
        *(0, -1, 1, 2**31, 2**63, 10**30, 1.5, 1e308, float("nan"), float("inf"), None, True, ""),
        *([], {}, [[]], "x" * 2000, "../../etc/passwd", "/dev/zero", [1] * 50, [10**9] * 4, "NaN"),
    )
    holder, key = places[int(rng.integers(len(places)))]
    kind = int(rng.integers(6))
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder.insert(key, holder[key])
    else:
        holder[key] = values[int(rng.integers(len(values)))]
    return json.dumps(content).encode()


def _summed(data: bytes, rng: np.random.Generator) -> bytes:
    """A chunk of a store damaged, its checksum (CRC-32C, the last four bytes) made to fit."""
    import google_crc32c

    body = plain(data[:-4], rng)
    return body + struct.pack("<I", google_crc32c.value(body))


def special(data: bytes) -> list[tuple[str, Damage]]:
    """Damage that keeps the outer shell of a format sound."""
    found: list[tuple[str, Damage]] = []
    if data[:4] == b"PK\x03\x04":
        found.append(("archive repacked", _zipped))
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        found.append(("PNG chunk", _chunked))
    if data[:1] == b"{":
        found.append(("JSON value", _rewritten))
    if data[:1] == b"\x02" and len(data) > 20:
        found.append(("chunk with checksum", _summed))
    return found
