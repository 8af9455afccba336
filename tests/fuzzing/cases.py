"""Case k of a reader, made of nothing but the reader's seeds, its name and k.

Below 0 are the files that are made to harm. Seeds of X3P, MATLAB and stores of transfer hold the
time at which they were written; all others are the same bytes in every run.
"""

import dataclasses
import io
import os
import zlib
from pathlib import Path

import numpy as np

from fuzzing.crafted import CRAFTED
from fuzzing.crafted.base import PIPE
from fuzzing.damage import PLAIN
from fuzzing.readers.base import Seed
from fuzzing.shells import special


@dataclasses.dataclass(frozen=True)
class Case:
    """One damaged folder.

    Attributes
    ----------
    label
        Seed, file and damage in words.
    seed
        The folder, damaged.
    others
        What is no plain file in it, see `fuzzing.crafted.base.Crafted`.
    harmless
        Whether it may be read.
    """

    label: str
    seed: Seed
    others: dict[str, str | int] = dataclasses.field(default_factory=dict)
    harmless: bool = True


def case(name: str, seeds: dict[str, Seed], number: int) -> Case:
    """Case `number` of a reader; nothing else enters. Below 0: the crafted ones, from -1 down."""
    if number < 0:
        label, found = list(CRAFTED[name](seeds).items())[-1 - number]
        return Case(f"made to harm: {label}", found.seed, found.others, found.harmless)
    rng = np.random.default_rng([zlib.crc32(name.encode()), number])
    labels = list(seeds)
    label = labels[number % len(labels)]
    seed = seeds[label]
    names = list(seed.files)
    # Of a scene most often the scene, of a store all files alike.
    main = seed.main in seed.files and rng.random() < 0.7
    file = seed.main if main else names[int(rng.integers(len(names)))]
    data = seed.files[file]
    roll = rng.random()
    own = special(data)
    if roll < 0.01:
        what, damaged = "empty", b""
    elif roll < 0.04:
        other = list(FOREIGN)[int(rng.integers(len(FOREIGN)))]
        what, damaged = f"replaced by {other}", FOREIGN[other]
    elif roll < 0.07 and len(names) > 1:
        what, damaged = "deleted", None
    elif own and roll < 0.5:
        what, change = own[int(rng.integers(len(own)))]
        damaged = change(data, rng)
    else:
        what, damaged = "", data
        for _ in range(1 if rng.random() < 0.7 else int(rng.integers(2, 5))):
            word = list(PLAIN)[int(rng.integers(len(PLAIN)))]
            what += f"{', ' if what else ''}{word}"
            damaged = PLAIN[word](damaged, rng) if damaged else damaged
    files = {key: value for key, value in seed.files.items() if key != file}
    if damaged is not None:
        files[file] = damaged
    return Case(f"{label}, {file}: {what}", dataclasses.replace(seed, files=files))


def _pickled() -> bytes:
    out = io.BytesIO()
    np.save(out, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    return out.getvalue()


#: Contents that stand under other names.
FOREIGN: dict[str, bytes] = {
    "a pickle": b"\x80\x04\x95\x10\x00\x00\x00\x00\x00\x00\x00\x8c\x02os\x8c\x06getcwd\x93)R.",
    "an object array": _pickled(),
    "a ZIP archive": b"PK\x05\x06" + bytes(18),
    "a GIF": b"GIF89a\x01\x00\x01\x00\x00\x00\x00;",
    "HTML": b"<!DOCTYPE html><html><body>404 Not Found</body></html>",
    "zeros": bytes(5000),
    "spaces": b" " * 5000,
    "HDF5": b"\x89HDF\r\n\x1a\n" + bytes(100),
    "XML": b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]><a>&b;</a>',
    "JSON nested deep": b"[" * 50_000,
    "an ELF file": b"\x7fELF\x02\x01\x01" + bytes(200),
}


def lay(folder: Path, seed: Seed, others: dict[str, str | int] | None = None) -> Path:
    """Write a seed into a folder; gives what is to be loaded."""
    for name, kind in (others or {}).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == PIPE:
            os.mkfifo(path)
        elif isinstance(kind, str):
            path.symlink_to(kind)
        else:
            path.touch()
            os.truncate(path, kind)
    for name, content in seed.files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return folder / seed.main
