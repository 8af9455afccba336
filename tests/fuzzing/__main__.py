"""One case again, or many cases of some readers and a table; see `fuzzing`."""

import json
import os
import re
import shutil
import signal
import sys
import tempfile
import traceback
from pathlib import Path

from fuzzing.attempts import SECONDS, SPACE, alarmed, attempt, limited, warm
from fuzzing.cases import case
from fuzzing.parent import Child, scratch
from fuzzing.readers import READERS
from fuzzing.watch import Watch


def again(name: str, number: int, folder: Path | None = None) -> None:
    """Make a case once more and say what comes out."""
    alarmed()
    reader = READERS[name]
    seeds = reader.seeds()
    found = case(name, seeds, number)
    print(found.label)
    watch = Watch()
    place = Path(tempfile.mkdtemp()) if folder is None else folder
    warm(reader, seeds, place)
    limited(SPACE)
    print(json.dumps(attempt(watch, reader.load, place, found), indent=1))
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        print("read:", type(reader.load(place / found.seed.main, **found.seed.options)).__name__)
    except Exception:
        traceback.print_exc()
    if folder is None:
        shutil.rmtree(place)


def survey(count: int, names: list[str], first: int = 0) -> None:
    """Many cases of some readers (0: the crafted ones), and a table."""
    with scratch() as folder:
        worker = Child(Path(folder))
        for name in names:
            found = worker.run(name, count or None, first)
            done = ", ".join(f"{n} {word}" for word, n in sorted(found.outcomes.items()))
            print(
                f"{name}: {done}; {found.whole:.1f} s, longest {found.seconds:.2f} s, most "
                f"{found.memory / 2**20:.0f} MiB; {len(found.faults)} faults",
                flush=True,
            )
            kinds: dict[str, list[str]] = {}
            for fault in found.faults:
                kind = re.sub(r"[\d.]+", "#", fault.partition("): ")[2])[:90]
                kinds.setdefault(kind, []).append(fault)
            for group in kinds.values():
                print(f"   {len(group)} x {group[0][:420]}", flush=True)
        worker.close()


if __name__ == "__main__":
    if len(sys.argv) == 1:
        sys.exit("expected READER K [FOLDER], or --survey COUNT [WORD ...]")
    if sys.argv[1] == "--survey":
        chosen = [n for n in READERS if any(word in n for word in sys.argv[3:] or [""])]
        survey(int(sys.argv[2]), chosen, int(os.environ.get("FUZZ_FIRST", "0")))
    else:
        again(sys.argv[1], int(sys.argv[2]), *map(Path, sys.argv[3:4]))
