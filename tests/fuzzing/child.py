"""The process that loads one file after another: ``python -m fuzzing.child``."""

import contextlib
import gc
import importlib
import json
import os
import sys
import tempfile
import warnings
from pathlib import Path

from fuzzing.attempts import SPACE, alarmed, attempt, limited, warm
from fuzzing.cases import case
from fuzzing.crafted import CRAFTED
from fuzzing.readers import READERS
from fuzzing.readers.base import Seed
from fuzzing.watch import Watch


def _quiet(number: int) -> int:
    """A copy of a file descriptor, whose place is taken by nothing: native code prints."""
    kept = os.dup(number)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, number)
    os.close(nothing)
    return kept


def main() -> None:
    """Answer requests ``[reader, first, end, folder]``, a line each, until there are no more.

    Without an end all crafted cases from the first on are loaded.
    """
    answers = os.fdopen(_quiet(1), "w", buffering=1)
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    alarmed()
    with contextlib.suppress(ImportError), warnings.catch_warnings():
        # Asks the system for its processor when it is imported.
        warnings.simplefilter("ignore")
        importlib.import_module("SurfaceTopography.IO")
    watch = Watch()
    made: dict[str, dict[str, Seed]] = {}
    for line in sys.stdin:
        name, first, end, folder = json.loads(line)
        reader = READERS[name]
        if name not in made:
            made[name] = reader.seeds()
        warm(reader, made[name], Path(folder))
        limited(SPACE)
        if end is None:
            numbers = range(first, -len(CRAFTED[name](made[name])) - 1, -1)
        else:
            numbers = range(first, end)
        for number in numbers:
            print(json.dumps({"at": number}), file=answers)
            found = case(name, made[name], number)
            with tempfile.TemporaryDirectory(dir=folder, prefix="case-") as place:
                answer = attempt(watch, reader.load, Path(place), found)
            print(json.dumps({"case": number, "label": found.label, **answer}), file=answers)
        limited(2**46)
        gc.collect()
        print(json.dumps({"done": True}), file=answers)


if __name__ == "__main__":
    main()
