"""What takes long is built in the background: tables are baked and programs compiled there."""

import collections
import threading
import time
from collections.abc import Callable, Hashable, Iterable
from typing import Any, NamedTuple

from diffopt.errors import InputError

# Results of one name that are kept.
_KEPT = 6


class Failure(NamedTuple):
    """What came in place of a result."""

    message: str


class Builder:
    """Builds what is asked for in one thread; what nobody wants any longer is not begun.

    Parameters
    ----------
    build
        From a name and a key to a result; an `InputError` of it is kept as a `Failure`.
    """

    def __init__(self, build: Callable[[str, Any], Any]) -> None:
        self._build = build
        self._held: dict[str, collections.OrderedDict[Hashable, Any]] = {}
        self._asked: dict[object, tuple[str, Hashable, Callable[[], None]]] = {}
        self._at_work: tuple[str, Hashable, float] | None = None
        self._lock = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name="diffopt-builder", daemon=True)
        self._thread.start()

    def ask(
        self, who: object, name: str, key: Hashable, done: Callable[[], None]
    ) -> tuple[bool, Any]:
        """Whether a result is there, and the result; if not, it is built for `who`.

        Parameters
        ----------
        who
            Asks; only the last thing that it asked for is built, see `Builder`.
        name, key
            Of the result.
        done
            Called, in another thread, when it is there.
        """
        with self._lock:
            found = self._held.get(name, {})
            if key in found:
                self._held[name].move_to_end(key)
                return True, found[key]
            self._asked[who] = name, key, done
            self._lock.notify_all()
            return False, None

    def leave(self, who: object) -> None:
        """Forget what was asked for."""
        with self._lock:
            self._asked.pop(who, None)

    @property
    def work(self) -> tuple[str, float] | None:
        """Name of what is being built, and for how many seconds it has been."""
        with self._lock:
            if self._at_work is None:
                return None
            name, _, begun = self._at_work
            return name, time.perf_counter() - begun

    def close(self) -> None:
        """Stop when what is in work is done."""
        with self._lock:
            self._open = False
            self._asked.clear()
            self._lock.notify_all()

    def join(self, timeout: float | None = None) -> bool:
        """Wait for that; whether it came."""
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _next(self) -> tuple[str, Hashable] | None:
        for name, key, _ in self._asked.values():
            if key not in self._held.get(name, {}):
                return name, key
        return None

    def _run(self) -> None:
        while True:
            with self._lock:
                while self._open and self._next() is None:
                    self._lock.wait()
                job = self._next()
                if not self._open or job is None:
                    return
                name, key = job
                self._at_work = name, key, time.perf_counter()
            try:
                result = self._build(name, key)
            except InputError as error:
                result = Failure(str(error))
            except Exception as error:
                # Whatever it was, viewers hear of it, and the next thing can be built.
                result = Failure(f"{type(error).__name__}: {error}")
            with self._lock:
                self._at_work = None
                held = self._held.setdefault(name, collections.OrderedDict())
                held[key] = result
                while len(held) > _KEPT:
                    held.popitem(last=False)
                calls = self._finished(name, key)
            for call in calls:
                call()

    def _finished(self, name: str, key: Hashable) -> Iterable[Callable[[], None]]:
        """Whom to call."""
        done = [who for who, asked in self._asked.items() if asked[:2] == (name, key)]
        return [self._asked.pop(who)[2] for who in done]
