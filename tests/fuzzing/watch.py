"""What a load does beside giving a result: files, processes, pickles, by audit events."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any


class Watch:
    """What a load does beside giving a result, by audit events of the interpreter."""

    _WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
    _DOING = (
        *("os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate"),
        *("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect"),
        *("pickle.find_class", "shutil.rmtree", "urllib.Request", "tempfile.mkstemp"),
    )

    def __init__(self) -> None:
        self.seen: list[str] = []
        self.opened: set[str] = set()
        self._on = False
        self._patched: dict[str, Any] = {}
        sys.addaudithook(self._hook)
        self._pickles()

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._on:
            return
        if event == "open":
            path, _, flags = arguments
            if isinstance(flags, int) and flags & self._WRITING:
                self.seen.append(f"opened {path!r} for writing")
            elif isinstance(path, str | bytes):
                self.opened.add(os.path.abspath(os.fsdecode(path)))
        elif event in self._DOING:
            self.seen.append(f"{event} {arguments[:2]!r}")

    def _pickles(self) -> None:
        import pickle

        for name in ("load", "loads", "Unpickler", "_load", "_loads", "_Unpickler"):
            made = getattr(pickle, name)

            def called(*arguments: Any, _made: Any = made, _name: str = name, **more: Any) -> Any:
                if self._on:
                    self.seen.append(f"pickle.{_name}")
                return _made(*arguments, **more)

            if not isinstance(made, type):
                self._patched[name] = made
                setattr(pickle, name, called)

    def close(self) -> None:
        """Give `pickle` its functions back; the hook stays, and is still."""
        import pickle

        for name, made in self._patched.items():
            setattr(pickle, name, made)

    @contextlib.contextmanager
    def watching(self) -> Iterator[None]:
        self.seen, self.opened, self._on = [], set(), True
        try:
            yield
        finally:
            self._on = False
