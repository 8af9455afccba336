"""Adaptive precomputation of transfer: vertices, their slices, and where more are needed."""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from typing import Protocol, runtime_checkable

import numpy as np

from diffopt import workers
from diffopt.errors import InputError
from diffopt.scenes.scene import Scene
from diffopt.transfer import tessellation
from diffopt.transfer.angular import Estimator, Vertices
from diffopt.transfer.beginning import begun, frames, surroundings
from diffopt.transfer.distributed import Company
from diffopt.transfer.refinement import Measure, Refinement
from diffopt.transfer.result import Round, Transfer
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.spatial import Known
from diffopt.transfer.tracing import Frames
from diffopt.transfer.views import hemisphere


@runtime_checkable
class Batches(Protocol):
    """Where finished batches of vertices are kept."""

    def load(self, number: int) -> Vertices | None:
        """A batch that was kept, or None."""
        ...

    def save(self, number: int, batch: Vertices) -> None:
        """Keep a batch."""
        ...


@dataclasses.dataclass(frozen=True)
class Progress:
    """How far a precomputation is: rounds begun, vertices done, vertices known to be needed."""

    round: int
    done: int
    known: int


def precompute(
    scene: Scene,
    settings: TransferSettings | None = None,
    *,
    backend: str = "embree",
    batches: Batches | None = None,
    report: Callable[[Progress], None] | None = None,
    threads: int | None = None,
    uniform: int | None = None,
    company: Company | None = None,
) -> Transfer:
    """Precompute the transfer of a scene, adaptively.

    The same scene and settings give the same result, also when batches of an interrupted run
    are at hand, and with any number of processes.

    Parameters
    ----------
    scene
        Meshes, boxes and planes of matte and glossy materials; its lights play no part. The
        front of surfaces is computed, as normals have it.
    settings
        By default those of `TransferSettings`.
    backend
        Of the rays: "embree", or "jax" for any device.
    batches
        Keeps what is finished, see `diffopt.transfer.store`.
    report
        Called after every batch.
    threads
        Batches in work at a time; as many as pay by default.
    uniform
        Split all triangles this often instead of adaptively, for comparison.
    company
        Processes that work on it together; `batches` are shared by them.

    Raises
    ------
    InputError
        For scenes that transfer does not hold; names the object. If processes do not agree.
    """
    settings = settings or TransferSettings()
    if company is not None and batches is None:
        raise InputError("company: processes work together by batches that they share; got none")
    return _Run(scene, settings, backend, batches, report, threads, company).whole(uniform)


class _Run:
    """One precomputation: what it has so far."""

    def __init__(
        self,
        scene: Scene,
        settings: TransferSettings,
        backend: str,
        batches: Batches | None,
        report: Callable[[Progress], None] | None,
        threads: int | None,
        company: Company | None,
    ) -> None:
        self.settings, self.batches, self.report = settings, batches, report
        self.company = company
        self.around = surroundings(scene, backend)
        self.mesh = begun(self.around, self.settings.longest)
        if not len(self.mesh.faces):
            raise InputError("the scene has no triangle with an area")
        self.threads = threads or workers.count()
        self.estimators: dict[int, Estimator] = {}
        self.found: list[tuple[np.ndarray, Vertices]] = []
        self.number = 0
        self.rounds: list[Round] = []
        self.reflector = np.zeros(0, np.int32)
        self.axes = np.zeros((0, 3, 3))

    def whole(self, uniform: int | None) -> Transfer:
        if uniform is not None:
            self.mesh = tessellation.uniform(self.mesh, uniform)
        if self.company is not None:
            self.company.agreed("the triangles", self.mesh.vertices, self.mesh.faces)
        self._round(0)
        refinement = Refinement(self.settings)
        while uniform is None:
            chosen, waiting = refinement.chosen(
                self.mesh, self._known, self.reflector, self._measures()
            )
            if self.company is not None:
                step = f"what to split after round {len(self.rounds)}"
                self.company.agreed(step, chosen, np.asarray(waiting))
            if not len(chosen):
                break
            self.mesh = tessellation.split(self.mesh, chosen)
            self._round(waiting)
        return self._result()

    def _estimator(self, number: int) -> Estimator:
        if number not in self.estimators:
            self.estimators[number] = Estimator(self.around, number, self.settings)
        return self.estimators[number]

    def _round(self, waiting: int) -> None:
        """Slices of all vertices that have none yet."""
        began = time.perf_counter()
        mesh, old = self.mesh, len(self.axes)
        self.axes = frames(mesh)
        label = np.zeros(len(mesh.vertices), np.int32)
        label[mesh.faces.reshape(-1)] = np.repeat(mesh.label, 3)
        self.reflector = label
        new = np.arange(old, len(label))
        parts = []
        for number in np.unique(label[new]):
            mine = new[label[new] == number]
            step = self.settings.chunk
            parts += [mine[k : k + step] for k in range(0, len(mine), step)]
        done = old
        for rows, batch in zip(parts, self._computed(parts), strict=True):
            self.found.append((rows, batch))
            done += len(rows)
            if self.report is not None and self.company is None:
                self.report(Progress(len(self.rounds), done, len(label)))
        seconds = time.perf_counter() - began
        leaves = tessellation.leaves(mesh)
        self.rounds.append(Round(len(label), len(leaves), waiting, seconds))

    def _computed(self, parts: list[np.ndarray]) -> Iterator[Vertices]:
        first = self.number
        self.number += len(parts)
        for rows in parts:  # made here: their tables are not made twice by threads
            self._estimator(int(self.reflector[rows[0]]))
        if self.company is not None:
            return self._shared(parts, first, self.company)
        one = functools.partial(self._batch, parts, first)
        return workers.ahead(one, range(len(parts)), self.threads)

    def _batch(self, parts: list[np.ndarray], first: int, k: int) -> Vertices:
        """A batch that was kept, or computed and kept."""
        rows = parts[k]
        kept = None if self.batches is None else self.batches.load(first + k)
        if kept is not None and len(kept.level) == len(rows):
            return kept
        at = Frames(self.mesh.vertices[rows], self.axes[rows])
        batch = self._estimator(int(self.reflector[rows[0]]))(at)
        if self.batches is not None:
            self.batches.save(first + k, batch)
        return batch

    def _shared(self, parts: list[np.ndarray], first: int, company: Company) -> Iterator[Vertices]:
        """Batches of which this process computes its share, and reads the rest."""
        batches, step, known = self.batches, len(self.rounds), len(self.axes)
        assert batches is not None
        own = [k for k in range(len(parts)) if (first + k) % company.count == company.index]
        one = functools.partial(self._batch, parts, first)
        found, done = {}, known - sum(len(rows) for rows in parts)
        for k, batch in zip(own, workers.ahead(one, own, self.threads), strict=True):
            found[k] = batch
            # The others are taken to be as far.
            done = min(done + company.count * len(parts[k]), known)
            if self.report is not None:
                self.report(Progress(step, done, known))
        company.together(f"round {step}")

        def seen(k: int) -> Vertices:
            def look() -> Vertices | None:
                kept = batches.load(first + k)
                return kept if kept is not None and len(kept.level) == len(parts[k]) else None

            return found[k] if k in found else company.seen(f"batch {first + k}", look)

        return workers.ahead(seen, range(len(parts)), self.threads)

    def _known(self) -> Known:
        count = len(self.axes)
        level = np.zeros(count, np.int32)
        size = np.zeros(count, np.int64)
        for rows, batch in self.found:
            level[rows] = batch.level
        counts = np.array((*hemisphere(self.settings.finest).counts, 0))
        size = counts[level]
        first = np.zeros(count, np.int64)
        at = 0
        for rows, _ in self.found:
            own = size[rows]
            first[rows] = at + np.cumsum(own) - own
            at += int(own.sum())
        views = Slices(
            *(np.concatenate(a) for a in zip(*(b.views for _, b in self.found), strict=True))
        )
        order = np.argsort(np.concatenate([rows for rows, _ in self.found]), kind="stable")
        matte = zip(*(b.diffuse for _, b in self.found), strict=True)
        diffuse = Slices(*(np.concatenate(a)[order] for a in matte))
        return Known(level, first, views, diffuse, self.axes)

    def _measures(self) -> list[Measure]:
        return [self._estimator(k).measure for k in range(len(self.around.reflectors))]

    def _result(self) -> Transfer:
        known = self._known()
        error = np.zeros(len(known.level))
        for rows, batch in self.found:
            error[rows] = batch.error
        return Transfer(
            mesh=self.mesh,
            axes=self.axes,
            reflector=self.reflector,
            level=known.level,
            first=known.first,
            views=known.views,
            diffuse=known.diffuse,
            unoccluded=np.stack([m.unoccluded for m in self._measures()]).astype(np.float32),
            error=error,
            settings=self.settings,
            rounds=tuple(self.rounds),
        )
