"""Finished tiles of a picture in a file, so that a second run goes on from them.

Tiles do not depend on each other, and are finished in order: what is kept is a run of pixels from
the first on, and the picture is the same to the bit. The file is written aside and renamed, now and
then, so that short pictures have none.
"""

import contextlib
import hashlib
import json
import os
import re
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from diffopt import __version__
from diffopt.io.files import replacing
from diffopt.rendering.images import Image
from diffopt.scenes.scene import Scene

#: Seconds of work that a kill may cost, where writing takes less than a twentieth of them.
EVERY = 10.0
_SHARE = 0.05
_ARRAYS = ("radiance", "error", "depth", "normal", "object")


def identity(scene: Scene, *others: Any) -> str:
    """A digest of what a picture depends on.

    Parameters
    ----------
    scene
        Its arrays, and what is static of it by its text.
    *others
        By their texts: camera, settings, and what else plays a part.
    """
    digest = hashlib.sha256(__version__.encode())
    geometry = scene.geometry
    static = str(jax.tree.structure(scene)) + "\n".join(map(repr, others))
    # Functions and meshes are named with an address; the shapes are in the arrays.
    digest.update(re.sub(r" at 0x[0-9a-f]+", "", static).encode())
    for leaf in jax.tree.leaves((geometry.world, geometry.owner, scene)):
        values = np.ascontiguousarray(leaf)
        digest.update(f"{values.dtype} {values.shape}".encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


class Kept:
    """The file.

    Parameters
    ----------
    path
        Its name; the folder exists.
    belongs
        `identity` of the picture: a file of another one is as good as none.
    """

    def __init__(self, path: str | os.PathLike, belongs: str) -> None:
        self.path, self.belongs = Path(path), belongs
        self._next = time.monotonic() + EVERY

    def restore(self, image: Image) -> None:
        """Put what was kept into a picture of which nothing is done."""
        try:
            # The checksums of the zip archive are tested on the way.
            with self.path.open("rb") as whole, np.load(whole, allow_pickle=False) as file:
                head = json.loads(str(file["head"]))
                if head["belongs"] != self.belongs:
                    return
                found = {name: file[name] for name in _ARRAYS}
                layers = {name: file[f"layer {name}"] for name in head["layers"]}
                seconds = float(head["seconds"])
            count = len(found["depth"])
            pairs = [(values, getattr(image, name)) for name, values in found.items()]
            pairs += [(values, image.radiance) for values in layers.values()]
            if not all(_fits(values, _flat(whole), count) for values, whole in pairs):
                return
        except Exception:  # there is none, or it is damaged, which shows in many ways
            return
        for name, values in found.items():
            _flat(getattr(image, name))[:count] = values
        for name, values in layers.items():
            whole = image.layers.setdefault(name, np.zeros_like(image.radiance))
            _flat(whole)[:count] = values
        image.done.reshape(-1)[:count] = True
        image.seconds = seconds
        image.restored = float(image.done.mean())

    def note(self, image: Image) -> None:
        """Write what is done, if the last time is long ago and there is room on the disk."""
        began = time.monotonic()
        if began < self._next:
            return
        count = int(image.done.sum())
        head = {"belongs": self.belongs, "layers": list(image.layers), "seconds": image.seconds}
        arrays: dict[str, Any] = {name: _flat(getattr(image, name))[:count] for name in _ARRAYS}
        arrays |= {f"layer {name}": _flat(part)[:count] for name, part in image.layers.items()}
        # Without room the picture goes on: there may be some when it is saved.
        with contextlib.suppress(OSError), replacing(self.path) as file:
            np.savez(file, head=np.asarray(json.dumps(head)), **arrays)
        ended = time.monotonic()
        self._next = ended + max(EVERY, (ended - began) / _SHARE)


def _fits(values: np.ndarray, whole: np.ndarray, count: int) -> bool:
    """Whether they are the first rows of such an array."""
    rows = whole[:count]
    return (values.dtype, values.shape) == (rows.dtype, rows.shape) and len(rows) == count


def _flat(array: np.ndarray) -> np.ndarray:
    """Rows of pixels, [h w, ...]."""
    return array.reshape(-1, *array.shape[2:])
