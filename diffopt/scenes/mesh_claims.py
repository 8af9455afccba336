"""What a mesh file claims, and what it names beside itself, looked at before it is read.

trimesh takes memory as headers ask for it; and what a mesh names (buffers, pictures, materials) it
reads. Here a claim has to fit the bytes that are there, and what is named has to lie in the mesh's
own folder or below it.
"""

import json
import os
import struct
from pathlib import Path
from typing import Any

from trimesh.resolvers import Resolver

from diffopt.errors import InputError
from diffopt.io import limits
from diffopt.io.files import existing_file


class Beside(Resolver):
    """Files that a mesh names, of its own folder and below: links that leave it do not count.

    Parameters
    ----------
    path
        The mesh.
    """

    def __init__(self, path: Path) -> None:
        self._folder = Path(os.path.abspath(path)).parent.resolve()

    def get(self, key: str) -> bytes:
        """What a file holds.

        Raises
        ------
        InputError
            If it lies elsewhere, or is none.
        """
        name = str(key).strip()
        found = (self._folder / name).resolve()
        if not found.is_relative_to(self._folder):
            raise InputError(f"it names {name!r}, outside of its folder; expected a file in it")
        return existing_file(found).read_bytes()

    def write(self, name: str, data: Any) -> None:
        """Nothing is written."""
        raise InputError(f"{name}: nothing is written in reading")

    def keys(self) -> list[str]:
        """None: nothing is looked for."""
        return []

    def namespaced(self, namespace: str) -> "Beside":
        """Of a folder below; the same, as names are looked up from the mesh on."""
        return self


def check(path: Path, suffix: str) -> None:
    """Refuse a ``.glb`` or ``.gltf`` whose parts do not fit.

    Raises
    ------
    ValueError, KeyError, TypeError, RecursionError
        If it is damaged.
    InputError
        If it claims more than `diffopt.io.limits` allows.
    """
    if suffix == ".glb":
        _tree(path, _chunks(path))
    elif suffix == ".gltf":
        _tree(path, limits.text(path, limits.MOST_JSON))


def instances(path: Path, scene: Any) -> None:
    """Refuse a scene whose objects, each as often as it is placed, have too many faces.

    Raises
    ------
    InputError
        With their number.
    """
    total = 0
    for node in scene.graph.nodes_geometry:
        one = scene.geometry.get(scene.graph[node][1])
        total += len(getattr(one, "faces", ())) + len(getattr(one, "vertices", ()))
    limits.samples(path, (total, 3), "coordinates and corners")


def _chunks(path: Path) -> bytes:
    """The JSON text of a ``.glb``, if all its chunks lie in the file."""
    size = path.stat().st_size
    text = b""
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12:
            raise ValueError(f"{size} bytes; expected a header of 12")
        at = 12
        while at + 8 <= size:
            length, kind = struct.unpack("<I4s", file.read(8))
            if at + 8 + length > size:
                raise ValueError(
                    f"a chunk from byte {at} on claims {length} bytes; the file has {size}"
                )
            if at == 12:
                if kind != b"JSON" or length > limits.MOST_JSON:
                    raise ValueError(f"its first chunk is {kind!r} of {length} bytes")
                text = file.read(length)
            else:
                file.seek(length, os.SEEK_CUR)
            at += 8 + length
    return text


def _tree(path: Path, text: bytes) -> None:
    """Refuse accessors that claim more than there can be, and trees that are none."""
    tree = json.loads(text)
    total = 0
    for accessor in tree.get("accessors", ()):
        count = accessor["count"]
        if not isinstance(count, int) or count < 0:
            raise ValueError(f"an accessor of {str(count)[:40]} items")
        total += count
    # At most 16 numbers an item.
    limits.samples(path, (total, 16), "numbers of accessors")
    nodes = tree.get("nodes", ())
    named = [child for node in nodes for child in node.get("children", ())]
    if len(set(named)) < len(named):
        raise ValueError("a node has two parents; expected a tree")
    if any(not isinstance(k, int) or not 0 <= k < len(nodes) for k in named):
        raise ValueError("a node that does not exist is a child")
