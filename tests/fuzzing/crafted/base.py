"""What a crafted case is, and arrays, archives and names of files that harm any reader of them."""

import dataclasses
import io
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np

from fuzzing.readers.base import Seed, single

#: Kinds of content of a folder beside bytes: a pipe, a link to a path, so many bytes of a hole.
PIPE = "pipe"


@dataclasses.dataclass(frozen=True)
class Crafted:
    """A folder that does harm to a careless reader.

    Attributes
    ----------
    seed
        Its files.
    others
        What is no plain file, by its name: `PIPE`, the target of a link, or a size.
    harmless
        Whether it may be read.
    """

    seed: Seed
    others: dict[str, str | int] = dataclasses.field(default_factory=dict)
    harmless: bool = False


class Mischief:
    """Unpickled it makes a folder."""

    def __reduce__(self) -> tuple[Any, ...]:
        import os

        return os.mkdir, ("unpickled",)


def zeros(megabytes: int) -> bytes:
    """Deflated zeros, made without holding them: blocks that stand alone are repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return block * megabytes + packer.flush()


def wrapped(raw: bytes) -> bytes:
    """Deflated data as zlib has them; the checksum, which is at the end, does not fit."""
    return b"\x78\x9c" + raw + bytes(4)


def npy_header(shape: Any, kind: str = "<f8") -> bytes:
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}}}".encode()
    text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def member(name: str, packed: bytes, size: int) -> bytes:
    """A ZIP archive of one deflated member that claims so many bytes."""
    size = min(size, 2**32 - 2)
    fields = struct.pack("<HHHHHIII", 20, 0, 8, 0, 0, 0, len(packed), size)
    name_ = name.encode()
    local = b"PK\x03\x04" + fields + struct.pack("<HH", len(name_), 0) + name_
    central = b"PK\x01\x02" + struct.pack("<H", 20) + fields
    central += struct.pack("<HHHHHII", len(name_), 0, 0, 0, 0, 0, 0) + name_
    end = b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, 1, 1, len(central), len(local + packed), 0)
    return local + packed + central + end


def npz_bomb(megabytes: int, name: str = "z") -> bytes:
    """Zeros of 2^20 bytes each, after the header of an array that holds them."""
    head = npy_header((megabytes, 131072))
    start = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = start.compress(head) + start.flush(zlib.Z_FULL_FLUSH)
    return member(f"{name}.npy", first + zeros(megabytes), len(head) + 2**20 * megabytes)


def archive(**members: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return out.getvalue()


def objects() -> bytes:
    out = io.BytesIO()
    np.save(out, np.array([Mischief()], dtype=object), allow_pickle=True)
    return out.getvalue()


def arrays_of(suffix: str, names: tuple[str, ...], **options: Any) -> dict[str, Crafted]:
    """Of an array or an archive with these members."""
    one, first = suffix == ".npy", names[0]
    wrap: Callable[[bytes], bytes] = (
        (lambda raw: raw) if one else lambda raw: archive(**dict.fromkeys(names, raw))
    )
    found = {
        "promises terabytes": wrap(npy_header((10**6, 10**6)) + bytes(64)),
        "promises more than 64 bits": wrap(npy_header((2**62, 2**62, 7)) + bytes(64)),
        "a side below 0": wrap(npy_header((-1, 8)) + bytes(64)),
        "nothing, of terabytes": wrap(npy_header((0, 2**62)) + bytes(64)),
        "items of no size": wrap(npy_header((2**40, 8), "|S0") + bytes(64)),
        "a pickle": wrap(objects()),
        "a bare pickle": pickle.dumps(Mischief()),
        "header of code": wrap(npy_header("__import__('os').mkdir('ran')")),
        "header of brackets": wrap(npy_header("(" * 9000)),
    }
    if not one:
        found["bomb"] = npz_bomb(3000, first)
        found["member claims 4 GB"] = member(f"{first}.npy", zeros(1), 2**32 - 2)
        found["member claims less"] = member(f"{first}.npy", zeros(2000), 2000)
        found["pickle as a member"] = archive(**dict.fromkeys(names, pickle.dumps(Mischief())))
    cases = {k: Crafted(single(f"a{suffix}", v, **options)) for k, v in found.items()}
    return {f"{suffix}: {k}": v for k, v in cases.items()}


def strange(name: str, **options: Any) -> dict[str, Crafted]:
    """What is no plain file, under a name that a reader takes."""
    empty = Seed({}, name, options)
    return {
        f"{name}: a pipe": Crafted(empty, {name: PIPE}),
        f"{name}: an endless device": Crafted(empty, {name: "/dev/zero"}),
        f"{name}: a text of the system": Crafted(empty, {name: "/proc/self/environ"}),
        f"{name}: a link to itself": Crafted(empty, {name: name}),
        f"{name}: a link to nothing": Crafted(empty, {name: "nowhere"}),
        f"{name}: a folder": Crafted(Seed({f"{name}/x": b"x"}, name, options)),
        f"{name}: a terabyte": Crafted(empty, {name: 2**40}),
    }
