"""Stores: shapes, codecs and chunks that promise terabytes, pickles of version 2."""

import dataclasses
import json
import pickle
import struct
from collections.abc import Callable
from typing import Any

from fuzzing.crafted.base import PIPE, Crafted, Mischief
from fuzzing.readers.base import Seed, single


def changed(seed: Seed, name: str, change: Callable[[dict[str, Any]], None]) -> Seed:
    """A folder with one JSON text changed."""
    tree = json.loads(seed.files[name])
    change(tree)
    return dataclasses.replace(seed, files=seed.files | {name: json.dumps(tree).encode()})


def of(seed: Seed, folder: str) -> dict[str, Crafted]:
    """Of a store with an array in this folder."""
    meta = f"{folder}/zarr.json"
    chunks = sorted(name for name in seed.files if name.startswith(f"{folder}/c"))
    first = chunks[0]
    rest = {k: v for k, v in seed.files.items() if k != first}
    sides = len(json.loads(seed.files[meta])["shape"])

    def huge(tree: dict[str, Any]) -> None:
        tree["shape"] = [10**6] * sides

    def huge_chunk(tree: dict[str, Any]) -> None:
        tree["shape"] = [10**6] * sides
        tree["chunk_grid"]["configuration"]["chunk_shape"] = [10**6] * sides

    def small_chunks(tree: dict[str, Any]) -> None:
        tree["shape"] = [10**9] * sides
        tree["chunk_grid"]["configuration"]["chunk_shape"] = [1] * sides

    def codec(name: str, **settings: Any) -> Callable[[dict[str, Any]], None]:
        def change(tree: dict[str, Any]) -> None:
            tree["codecs"] = [tree["codecs"][0], {"name": name, "configuration": settings}]

        return change

    import gzip

    packed = gzip.compress(bytes(2**20), mtime=0)
    version2 = {
        **{k: v for k, v in rest.items() if not k.startswith(f"{folder}/")},
        f"{folder}/.zarray": json.dumps(
            {
                "zarr_format": 2,
                "shape": [1],
                "chunks": [1],
                "dtype": "|O",
                "compressor": None,
                "filters": [{"id": "pickle", "protocol": 5}],
                "fill_value": None,
                "order": "C",
            }
        ).encode(),
        f"{folder}/0": pickle.dumps(Mischief()),
    }
    whole2 = {
        f"{seed.main}/.zgroup": b'{"zarr_format": 2}',
        f"{seed.main}/.zattrs": json.dumps(
            json.loads(seed.files[f"{seed.main}/zarr.json"])["attributes"]
        ).encode(),
        **{k: v for k, v in version2.items() if k.startswith(f"{folder}/")},
    }
    zstd = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**40) + b"\x01\x00\x00"
    blosc = b"\x02\x01\x21\x08" + struct.pack("<3I", 2**31 - 1, 2**20, 16)
    files = seed.files

    def with_chunk(content: bytes) -> Crafted:
        return Crafted(dataclasses.replace(seed, files=files | {first: content}))

    return {
        "terabytes in chunks": Crafted(changed(seed, meta, huge)),
        "a chunk of terabytes": Crafted(changed(seed, meta, huge_chunk)),
        "10^27 chunks": Crafted(changed(seed, meta, small_chunks)),
        "gzip": Crafted(
            dataclasses.replace(
                changed(seed, meta, codec("gzip", level=5)),
                files=changed(seed, meta, codec("gzip", level=5)).files | {first: packed * 3000},
            )
        ),
        "another codec": Crafted(changed(seed, meta, codec("numcodecs.bz2", level=5))),
        "zstd that claims a terabyte": with_chunk(zstd),
        "blosc that claims 2 GB": with_chunk(blosc),
        "pickles of version 2 within": Crafted(dataclasses.replace(seed, files=version2)),
        "pickles of version 2": Crafted(dataclasses.replace(seed, files=whole2)),
        "a chunk that is a pipe": Crafted(dataclasses.replace(seed, files=rest), {first: PIPE}),
        "a chunk that is a device": Crafted(
            dataclasses.replace(seed, files=rest), {first: "/dev/zero"}
        ),
        "a chunk of a terabyte": Crafted(dataclasses.replace(seed, files=rest), {first: 2**40}),
        "metadata nested deep": Crafted(
            dataclasses.replace(seed, files=files | {f"{seed.main}/zarr.json": b"[" * 100_000})
        ),
        "a file": Crafted(single(seed.main, b"nothing")),
    }
