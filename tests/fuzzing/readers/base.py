"""Readers, their seeds, and small files that several of them take.

A seed is a folder: files by their names, and the one that is loaded. Seeds are made by the
project's writers, by the libraries that read them, or byte by byte where nothing here writes
the format.
"""

import dataclasses
import io
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

PIXEL = (0.25, 0.125)
HEIGHTS = np.add.outer(np.arange(6.0) ** 2, 0.5 * np.arange(9.0)) / 100
GREY = {"pixel_size": PIXEL, "height_range": 2.0}
BARE = {"pixel_size": PIXEL, "height_unit": "um"}


@dataclasses.dataclass(frozen=True)
class Seed:
    """A folder of files: their contents by name, and the name that is loaded."""

    files: dict[str, bytes]
    main: str
    options: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Reader:
    """A loading function and its seeds.

    Attributes
    ----------
    load
        Of a path and the seed's options, as the command line or a script calls it.
    seeds
        Makes them.
    quick, long
        Damaged files in the usual run and at night.
    """

    load: Callable[..., Any]
    seeds: Callable[[], dict[str, Seed]]
    quick: int = 1000
    long: int = 10_000


def written(name: str, write: Callable[[Path], Any], **options: Any) -> Seed:
    """The seed that a function leaves at a path: a file or a folder."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write(Path(folder) / name)
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(Path(folder).rglob("*"))
            if path.is_file()
        }
    return Seed(files, name, options)


def single(name: str, content: bytes | str, **options: Any) -> Seed:
    """A seed of one file."""
    raw = content.encode() if isinstance(content, str) else content
    return Seed({name: raw}, name, options)


def picture(values: np.ndarray, kind: str) -> bytes:
    import PIL.Image

    out = io.BytesIO()
    PIL.Image.fromarray(values).save(out, format=kind)
    return out.getvalue()


def grey(kind: Any) -> np.ndarray:
    return np.rint(HEIGHTS / HEIGHTS.max() * np.iinfo(kind).max).astype(kind)


def npy(array: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def npz(**arrays: Any) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def colours() -> np.ndarray:
    return np.random.default_rng(4).integers(1, 255, (4, 8, 3), dtype=np.uint8)


def sky() -> np.ndarray:
    return np.linspace(0.1, 2.0, 4 * 8 * 3).reshape(4, 8, 3).astype(np.float32)
