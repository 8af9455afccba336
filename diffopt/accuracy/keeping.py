"""Rows of a study in a file, so that a second run goes on from them.

The first line says what was run and on what, each further one holds a row, in JSON. Rows are added
as they are measured: a kill costs the one in work.
"""

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import jax
import numpy as np

from diffopt import __version__
from diffopt.io.files import remove, replacing
from diffopt.locking import Lock


class Rows:
    """Rows of one study; a context, whose lock no two processes hold.

    Parameters
    ----------
    path
        The file; its folder exists.
    name, quick
        The study, and how it is run: rows of another one are thrown away.

    Raises
    ------
    InputError
        If another process is at work.

    Attributes
    ----------
    found
        Rows of an earlier run by their numbers, as dictionaries.
    """

    def __init__(self, path: str | os.PathLike, name: str, quick: bool) -> None:
        self.path = Path(path)
        self._head = {
            "study": name,
            "quick": quick,
            "diffopt": __version__,
            "jax": jax.__version__,
            "device": jax.devices()[0].device_kind,
        }
        self._lock = Lock(self.path.with_name(f"{self.path.name}.lock"), self.path)
        self.found = self._read()
        self._begun = False

    def __enter__(self) -> "Rows":
        return self

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def load(self, number: int, settings: dict[str, Any]) -> dict[str, Any] | None:
        """Fields of a row that was kept, if it is of these settings; None otherwise."""
        row = self.found.get(number)
        return row if row is not None and row["settings"] == _plain(settings) else None

    def save(self, number: int, row: Any) -> None:
        """Keep a `diffopt.accuracy.studies.Row`."""
        if not self._begun:
            # Of an earlier run only what is whole, so that no line begins within another.
            lines = [self._head, *([k, row] for k, row in self.found.items())]
            with replacing(self.path) as file:
                file.writelines(map(_line, lines))
            self._begun = True
        with self.path.open("ab") as file:
            file.write(_line([number, _plain(dataclasses.asdict(row))]))

    def discard(self) -> None:
        """Remove the file: the rows are where they belong."""
        remove(self.path)

    def _read(self) -> dict[int, dict[str, Any]]:
        found: dict[int, dict[str, Any]] = {}
        try:
            head, *lines = self.path.read_bytes().splitlines()
            if json.loads(head) == self._head:
                for line in lines:
                    number, row = json.loads(line)
                    found[int(number)] = row
        except (OSError, ValueError):  # there is none, or the last line is half of one
            pass
        return found


def _line(content: Any) -> bytes:
    return json.dumps(content).encode() + b"\n"


def _plain(value: Any) -> Any:
    """Numbers of NumPy as those of Python."""
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    return value.item() if isinstance(value, np.generic) else value
