"""One viewer: frames are drawn as long as something changes, and refined when nothing does."""

import dataclasses
import statistics
import threading
import time
from typing import Any

import numpy as np

from diffopt.scenes.camera import Camera
from diffopt.viewer import controls
from diffopt.viewer.building import Builder, Failure
from diffopt.viewer.controls import Menu, Values
from diffopt.viewer.screen import PIXELS, VERTICES, GoneError, Screen, Times
from diffopt.viewer.subject import Look, Meshed, StaleError, Subject

#: While something changes by the faster of both, at rest by pixels.
FASTER = "the faster, at rest pixels"
# A frame while something changes should take this long at most, seconds; it is drawn with fewer
# pixels until it does.
_BUDGET = 0.08
# Pixels of a coarse frame are this many on a side at most.
_COARSEST = 6
# Nothing has changed for so long: the frame is refined.
_REST = 0.15
# The table and times are told no more often than this, seconds.
_TELL = 0.25
# Where in their pixels the rays of takes go: a rotated grid.
_INSIDE = ((0.5, 0.5), (0.375, 0.125), (0.875, 0.375), (0.125, 0.625), (0.625, 0.875))
# Pixels show more than colours of vertices, which must be so many times as fast to be taken.
_CLEARLY = 1.5
# Frames by which both ways are compared, and how many of them do not count: a page that has
# just been opened stutters.
_COMPARED, _SETTLING = 8, 3


class Session:
    """Draws a subject for one viewer, in a thread of its own.

    Parameters
    ----------
    subject, builder
        What is looked at, and what builds its tables.
    screen
        Where.
    camera
        At first.

    Attributes
    ----------
    controls
        Those of the subject, and which way frames are sent.
    log
        What the last frames took.
    """

    def __init__(self, subject: Subject, builder: Builder, screen: Screen, camera: Camera) -> None:
        self.subject, self.builder, self.screen = subject, builder, screen
        self.controls = list(subject.controls)
        self._meshed = subject if isinstance(subject, Meshed) else None
        if self._meshed is not None:
            hint = "Pictures computed here, or colours of vertices that the browser draws."
            self.controls.append(
                Menu("drawn", "drawn by", (FASTER, PIXELS, VERTICES), FASTER, hint)
            )
        self.log: list[Times] = []
        self._values = controls.initial(self.controls)
        self._camera = camera
        self._memory: dict[str, Any] = {}
        self._built: dict[str, Any] = {}
        self._keys: dict[str, Any] = {}
        self._version = self._vertices = 0
        self._coloured: Any = None
        self._changed = time.perf_counter()
        self._faster: str | None = PIXELS if self._meshed is None else None
        self._compared: dict[str, list[float]] = {PIXELS: [], VERTICES: []}
        self._per_pixel = 2e-7
        self._told = -_TELL
        self._stamps: list[float] = []
        self._failure = ""
        self._lock = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name="diffopt-session", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End; the frame in work is finished first."""
        with self._lock:
            self._open = False
            self._lock.notify_all()
        self.builder.leave(self)

    def join(self, timeout: float | None = None) -> bool:
        """Wait for the end; whether it came."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    @property
    def values(self) -> dict[str, Any]:
        """Of the controls."""
        return dict(self._values)

    def set(self, name: str, value: Any) -> None:
        """Change a control; errors as for `diffopt.viewer.controls.changed`."""
        with self._lock:
            self._values = controls.changed(self.controls, self._values, name, value)
            self._touch()

    def look(self, camera: Camera) -> None:
        """Look from elsewhere."""
        with self._lock:
            if camera != self._camera:
                self._camera = camera
                self._touch()

    def _touch(self) -> None:
        self._version += 1
        self._changed = time.perf_counter()
        self._lock.notify_all()

    def _wake(self) -> None:
        """Something was built."""
        with self._lock:
            self._touch()

    def _run(self) -> None:
        try:
            self._loop()
        except GoneError:
            pass
        finally:
            self.close()

    def _loop(self) -> None:
        done, drawn_for = -1, -1
        while True:
            with self._lock:
                while self._open and self._version == done:
                    self._lock.wait(0.5)
                if not self._open:
                    return
                version, values, camera = self._version, self._values, self._camera
            ready = self._prepare(values)
            if not self._built:
                self._say(values, camera)
                self._pause(version)
                continue
            look = Look(values, camera, clock=time.perf_counter(), memory=self._memory)
            moves = self.subject.moves(values)
            if self._comparing(values):
                # As they would be in motion.
                self._send(look, self._way(values), self._coarse(camera))
                continue
            if moves or version != drawn_for:
                self._draft(look)
                drawn_for = version
            if moves:
                continue
            if not ready:
                # What was asked for is being built.
                self._say(values, camera)
                self._pause(version)
            elif self._rests(version):
                if values.get("drawn") != VERTICES:
                    self._refine(look, version)
                self._say(values, camera, last=True)
                done = version

    def _draft(self, look: Look) -> None:
        """A frame while something changes."""
        if self._meshed is None or self._way(look.values) == PIXELS:
            self._send(look, PIXELS, self._coarse(look.camera))
            return
        # Where colours do not depend on the camera, the browser turns them itself.
        state = look.values, id(self._built)
        same = not self._meshed.turns and not self.subject.moves(look.values)
        self._send(look, VERTICES, again=same and state == self._coloured)
        self._coloured = state

    def _rests(self, version: int) -> bool:
        """Wait until nothing has changed for a while; False if something did."""
        left = _REST - (time.perf_counter() - self._changed)
        if left > 0.0:
            self._pause(version, left)
        return self._version == version

    def _refine(self, look: Look, version: int) -> None:
        """Takes of a frame at rest, averaged, until something changes."""
        total = None
        for take in range(max(self.subject.takes, 1)):
            if self._version != version or not self._open:
                return
            inside = _INSIDE[take % len(_INSIDE)]
            now = dataclasses.replace(
                look, take=take, inside=inside, stale=lambda: self._version != version
            )
            try:
                total = self._send(now, PIXELS, total=total)
            except StaleError:
                return

    def _pause(self, version: int, seconds: float = _TELL) -> None:
        """Wait until something changes, at most so long."""
        with self._lock:
            if self._open and self._version == version:
                self._lock.wait(seconds)

    def _prepare(self, values: dict[str, Any]) -> bool:
        """Take what has been built for these values; ask for what has not."""
        built, keys = dict(self._built), dict(self._keys)
        self._failure = ""
        while missing := self._missing(values, built, keys):
            name, key = missing
            there, found = self.builder.ask(self, name, key, self._wake)
            if not there:
                return False
            if isinstance(found, Failure):
                self._failure = found.message
                return True
            built[name], keys[name] = found, key
        self._built, self._keys = built, keys
        return True

    def _missing(
        self, values: Values, built: dict[str, Any], keys: dict[str, Any]
    ) -> tuple[str, Any] | None:
        """The first thing that is of other values; what follows may depend on it."""
        for name, key in self.subject.wanted(values, built).items():
            if name not in keys or keys[name] != key:
                return name, key
        return None

    def _comparing(self, values: Values) -> bool:
        """Whether it is still to be found which way is the faster."""
        return self._faster is None and values["drawn"] == FASTER

    def _way(self, values: Values) -> str:
        asked = values.get("drawn", PIXELS)
        if asked != FASTER:
            return asked
        # One way after the other, as in motion: the browser is slower with many meshes in a row.
        return self._faster or (VERTICES if len(self._compared[PIXELS]) >= _COMPARED else PIXELS)

    def _coarse(self, camera: Camera) -> int:
        """Pixels of a coarse frame, on a side, that keep to the time of a frame."""
        columns, rows = camera.resolution
        whole = self._per_pixel * columns * rows
        return int(np.clip(np.ceil(np.sqrt(whole / _BUDGET)), 1, _COARSEST))

    def _send(
        self,
        look: Look,
        way: str,
        coarse: int = 1,
        total: np.ndarray | None = None,
        again: bool = False,
    ) -> np.ndarray | None:
        """Draw a frame and show it; sums of takes are returned.

        `again` is for a mesh that the viewer has already.
        """
        begun = time.perf_counter()
        size: tuple[int, ...]
        if self._meshed is not None and way == VERTICES:
            found = None if again else self._meshed.colours(self._built, look)
            self._vertices = self._vertices if found is None else len(found.vertices)
            size = (self._vertices,)
            drawn = time.perf_counter()
            self.screen.colour(found)
        else:
            columns, rows = look.camera.resolution
            size = max(columns // coarse, 1), max(rows // coarse, 1)
            camera = dataclasses.replace(look.camera, resolution=size)
            pixels = self.subject.pixels(self._built, dataclasses.replace(look, camera=camera))
            drawn = time.perf_counter()
            self._per_pixel = 0.5 * (self._per_pixel + (drawn - begun) / (size[0] * size[1]))
            if self.subject.averages:
                total = None
            elif look.take and total is not None:
                total = total + pixels
                pixels = ((total + (look.take + 1) // 2) // (look.take + 1)).astype(np.uint8)
            else:
                total = pixels.astype(np.uint16)
            self.screen.show(pixels)
        shown = time.perf_counter()
        if self._comparing(look.values):
            self._compare(way, shown - begun)
        self._stamps = [*self._stamps[-11:], shown]
        elapsed = self._stamps[-1] - self._stamps[0]
        rate = (len(self._stamps) - 1) / elapsed if elapsed > 0.0 else 0.0
        times = Times(way, drawn - begun, shown - drawn, size, rate)
        self.log = [*self.log[-199:], times]
        self._say(look.values, look.camera)
        return total

    def _compare(self, way: str, spent: float) -> None:
        self._compared[way].append(spent)
        if min(map(len, self._compared.values())) >= _COMPARED:
            spent_by = {
                way: statistics.median(each[_SETTLING:]) for way, each in self._compared.items()
            }
            clearly = _CLEARLY * spent_by[VERTICES] < spent_by[PIXELS]
            self._faster = VERTICES if clearly else PIXELS

    def _say(self, values: Values, camera: Camera, last: bool = False) -> None:
        """The table; not more often than is read, but always after the last frame."""
        now = time.perf_counter()
        if not last and now - self._told < _TELL:
            return
        self._told = now
        work, status = self.builder.work, ""
        if work is not None:
            status = f"building {work[0]}: {work[1]:.0f} s"
            if self._built:
                status += "; what is shown is of the values before"
        elif self._failure:
            status = f"not possible: {self._failure}"
        look = Look(values, camera, memory=self._memory)
        rows = self.subject.rows(self._built, look) if self._built else []
        self.screen.tell(rows, self.log[-1] if self.log else None, status)
