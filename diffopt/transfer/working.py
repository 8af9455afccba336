"""Batches of a precomputation that is running, kept so that a second run goes on from them.

A run is deterministic: batches are kept by their number, and a run that finds them replays
itself. They lie in the folder ``working`` of the store, one file each, written aside and renamed,
beside a record of the scene and settings that they belong to and the lock of the process at work.
"""

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import re
import threading
import time
import uuid
from pathlib import Path
from types import TracebackType
from typing import Any

import jax
import numpy as np

from diffopt import __version__
from diffopt.errors import InputError
from diffopt.io.files import aside, remove, replacing
from diffopt.locking import Lock
from diffopt.scenes.scene import Scene
from diffopt.transfer.angular import Vertices
from diffopt.transfer.reflectors import reflectors
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.views import hemisphere

FOLDER = "working"
_ARRAYS = ("alpha", "mu", "kappa")


def identity(
    scene: Scene,
    settings: TransferSettings,
    *,
    backend: str = "embree",
    uniform: int | None = None,
) -> dict[str, Any]:
    """What the result of a precomputation depends on: settings by name, the rest as digests."""
    world = scene.geometry.world
    shapes = hashlib.sha256()
    for array in (*jax.tree.leaves(world), scene.geometry.owner):
        _add(shapes, array)
    found, number = reflectors(scene)
    materials = hashlib.sha256()
    # Static fields are in the text of the structure, functions with an address.
    materials.update(re.sub(r" at 0x[0-9a-f]+", "", str(jax.tree.structure(found))).encode())
    for array in (*jax.tree.leaves(found), number):
        _add(materials, array)
    return {
        "shapes": shapes.hexdigest(),
        "materials": materials.hexdigest(),
        "settings": dataclasses.asdict(settings) | {"backend": backend, "uniform": uniform},
        "diffopt": __version__,
    }


def _add(digest: Any, array: Any) -> None:
    values = np.ascontiguousarray(array)
    digest.update(f"{values.dtype} {values.shape}".encode())
    digest.update(values.tobytes())


def differences(there: Any, here: dict[str, Any]) -> str:
    """How an identity that was read differs from one made here, in words; empty if it does not."""
    there = there if isinstance(there, dict) else {}
    out = [f"other {name}" for name in ("shapes", "materials") if there.get(name) != here[name]]
    old, new = there.get("settings"), here["settings"]
    old = old if isinstance(old, dict) else {}
    for name in sorted({*old, *new}):
        if old.get(name) != new.get(name):
            out.append(f"{name} {old.get(name)} there, {new.get(name)} here")
    if there.get("diffopt") != here["diffopt"]:
        out.append(f"diffopt {there.get('diffopt')} there, {here['diffopt']} here")
    return "; ".join(out)


def discard(path: Path, own: dict[str, Any]) -> None:
    """Remove the batches of a store that belong to an identity, unless a process is at work."""
    folder = path / FOLDER
    if not folder.is_dir() or differences(_recorded(folder) or {}, own):
        return
    with contextlib.suppress(InputError), Lock(folder / "lock", path):
        _remove(folder)


def _remove(folder: Path) -> None:
    """Remove the folder of batches with its lock, at once for all that look for it."""
    gone = aside(folder)
    os.rename(folder, gone)
    remove(gone)


def _recorded(folder: Path) -> dict[str, Any] | None:
    """The identity that batches belong to; None if there is none, or it is damaged."""
    try:
        found = json.loads((folder / "record.json").read_text())
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) and isinstance(found.get("settings"), dict) else None


class Working:
    """Batches of one precomputation; a context that holds the lock, and gives it back.

    For ``precompute(scene, settings, batches=...)``; safe for its threads.

    Parameters
    ----------
    path
        Folder of the store, which exists.
    scene, settings, backend, uniform
        As given to `precompute`.
    afresh
        Throw away batches of another scene or other settings instead of refusing them.
    session
        Name of what is timed together; that of a process among several is RUN/NUMBER.
    joined
        Whether another process of the run holds the lock, and has begun.

    Raises
    ------
    InputError
        If the batches there belong to another scene or other settings, with what differs, or
        another process is at work.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        scene: Scene,
        settings: TransferSettings,
        *,
        backend: str = "embree",
        uniform: int | None = None,
        afresh: bool = False,
        session: str | None = None,
        joined: bool = False,
    ) -> None:
        self.path = Path(path)
        self.folder = self.path / FOLDER
        self.settings = settings
        self.identity = identity(scene, settings, backend=backend, uniform=uniform)
        self._guard = threading.Lock()
        self._session = session or uuid.uuid4().hex
        self._earlier: dict[str, tuple[float, float]] = {}
        self._lock: Lock | None = None
        if not joined:
            self.folder.mkdir(exist_ok=True)
            self._lock = Lock(self.folder / "lock", self.path)
            try:
                self._begin(afresh)
            except BaseException:
                self.close()
                raise
        self._clock, self._cpu = time.perf_counter(), time.process_time()

    def __enter__(self) -> "Working":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def kept(self) -> int:
        """Batches that are there."""
        return sum(1 for _ in self.folder.glob("[0-9]*.npz"))

    @property
    def spent(self) -> tuple[float, float]:
        """Seconds by the clock and of all cores, with those of earlier runs as far as loaded."""
        with self._guard:
            every = {**self._earlier, self._session: self._own()}
        clock: dict[str, float] = {}
        for name, (seconds, _) in every.items():
            run = name.partition("/")[0]  # whose processes ran side by side
            clock[run] = max(clock.get(run, 0.0), seconds)
        return sum(clock.values()), sum(cpu for _, cpu in every.values())

    def load(self, number: int) -> Vertices | None:
        """A batch that was kept, or None; damaged ones count as none."""
        path = self._file(number)
        try:
            # The checksums of the zip archive are tested on the way.
            with path.open("rb") as whole, np.load(whole, allow_pickle=False) as file:
                views, diffuse = (
                    Slices(*(file[f"{part}_{name}"] for name in _ARRAYS))
                    for part in ("views", "diffuse")
                )
                batch = Vertices(file["level"], views, diffuse, file["error"])
                session, clock, cpu = str(file["session"]), float(file["clock"]), float(file["cpu"])
        except FileNotFoundError:
            return None
        except Exception:  # a damaged archive fails in many ways
            return None
        if not self._sound(batch) or not math.isfinite(clock + cpu):
            return None
        with self._guard:
            before = self._earlier.get(session, (0.0, 0.0))
            if session != self._session:
                self._earlier[session] = (max(before[0], clock), max(before[1], cpu))
        return batch

    def save(self, number: int, batch: Vertices) -> None:
        """Keep a batch."""
        clock, cpu = self._own()
        arrays: dict[str, Any] = {
            f"{part}_{name}": values
            for part, found in (("views", batch.views), ("diffuse", batch.diffuse))
            for name, values in zip(_ARRAYS, found, strict=True)
        }
        arrays |= {"clock": clock, "cpu": cpu}
        with replacing(self._file(number)) as file:
            np.savez(
                file,
                level=batch.level,
                error=batch.error,
                session=np.array(self._session),
                **arrays,
            )

    def close(self) -> None:
        """Give the lock back; batches stay."""
        if self._lock is not None:
            self._lock.release()

    def discard(self) -> None:
        """Remove all batches, and give the lock back."""
        _remove(self.folder)

    def _own(self) -> tuple[float, float]:
        return time.perf_counter() - self._clock, time.process_time() - self._cpu

    def _file(self, number: int) -> Path:
        return self.folder / f"{number:07d}.npz"

    def _begin(self, afresh: bool) -> None:
        for path in self.folder.glob(".*.npz.*"):  # of a run that was killed in writing
            path.unlink(missing_ok=True)
        old = _recorded(self.folder)
        if old is not None:
            different = differences(old, self.identity)
            if not different:
                return
            if not afresh and self.kept:
                raise InputError(
                    f"{self.path}: begun with another scene or other settings: {different}"
                )
        for path in self.folder.glob("*.npz"):
            path.unlink()
        with replacing(self.folder / "record.json") as file:
            file.write(json.dumps(self.identity, indent=2).encode())

    def _sound(self, batch: Vertices) -> bool:
        """Whether kinds and shapes are what they must be."""
        # Of a member that is no array NumPy gives the bytes.
        numbers = (batch.error, *batch.views, *batch.diffuse)
        for kind, arrays in (("i", (batch.level,)), ("f", numbers)):
            if not all(isinstance(a, np.ndarray) and a.dtype.kind == kind for a in arrays):
                return False
        counts = np.array((*hemisphere(self.settings.finest).counts, 0))
        level = batch.level
        if level.ndim != 1 or level.min(initial=0) < -1 or level.max(initial=0) >= len(counts) - 1:
            return False
        lobes = (3, self.settings.lobes)
        for found, rows in ((batch.views, int(counts[level].sum())), (batch.diffuse, len(level))):
            channels = found.alpha.shape[-1:]
            shapes = ((rows, *lobes, *channels), (rows, *lobes, 3), (rows, *lobes))
            if tuple(a.shape for a in found) != shapes:
                return False
        return batch.error.shape == level.shape
