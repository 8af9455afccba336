"""Peak memory of every command at its default size, and at about ten times that.

    python tests/measure_memory.py [--only WORD]

runs each in a process of its own, one after the other, in a temporary folder, and prints a table:
seconds and peak resident memory. The exit code is 1 if a command fails, or takes more than 2 GiB at
its default size.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).parent.parent
GIB = 2**30
#: What a command may take unless its page says otherwise.
ALLOWED = 2.0


class Command(NamedTuple):
    """A command line at its default size, and what makes it ten times as large.

    Attributes
    ----------
    words
        After ``diffopt``.
    larger
        Words in place of those, or added to them where they begin with ``--``; empty for none.
    what
        Is ten times as large.
    """

    words: str
    larger: str = ""
    what: str = ""


COMMANDS = (
    Command(
        "info scan.npy --pixel-size 0.02 --height-unit um",
        "info large.npy --pixel-size 0.02 --height-unit um",
        "samples",
    ),
    Command(
        "diffraction scan.npy --pixel-size 0.02 --height-unit um --coherence 1.25 -o out/scan",
        "diffraction large.npy --pixel-size 0.02 --height-unit um --coherence 1.25 --size 1619 "
        "-o out/large",
        "heights and pixels",
    ),
    Command("diffraction sample:compact_disc -o out/disc", "--size 1619", "pixels"),
    Command("material gold --roughness 0.4 -o out/gold", "--size 1619", "pixels"),
    Command("fit lobes sky.npy -o out/sky", "fit lobes wide.npy -o out/wide", "pixels"),
    Command(
        "fit lobes gold -o out/lobes",
        "fit lobes gold --angle 0,10,20,30,40,50,60,70,80 -o out/lobes",
        "angles: nine",
    ),
    Command("fit heightfield grating.csv --model binary -o out/grating"),
    Command("scene check cornell.toml"),
    Command("plan cornell.toml", "--size 2024x1518", "pixels"),
    Command("render cornell.toml -o out/cornell.png", "--size 1619x1619", "pixels"),
    Command(
        "render cornell.toml --tolerance 0.03 -o out/planned.png", "--size 1619x1619", "pixels"
    ),
    Command("precompute teapot.toml -o teapot.zarr", "--rays 40960 --force", "rays"),
    Command("relight teapot.zarr teapot.toml -o out/lit", "--size 2024x1518", "pixels"),
    Command(
        "shadow --scene creature --frames 3 -o out/creature",
        "--size 506 --picture 2024x1265",
        "receivers and pixels",
    ),
    Command("accuracy lobes.distance --quick -o out/study"),
    Command("bench -o out.csv"),
    Command("promises shadows --jobs 5"),
    Command("demo -o out/demo"),
)


class Peak(NamedTuple):
    """Of a run: exit code, seconds, bytes, the last line of the error stream."""

    code: int
    seconds: float
    nbytes: int
    said: str


def run(words: list[str], folder: Path) -> Peak:
    """Run a command to its end."""
    began = time.perf_counter()
    errors = folder / "stderr"
    with errors.open("wb") as stderr:
        child = subprocess.Popen(
            [sys.executable, "-m", "diffopt", *words],
            cwd=folder,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
        )
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    lines = errors.read_text(errors="replace").strip().splitlines()
    # Linux counts in KiB.
    seconds = time.perf_counter() - began
    return Peak(child.returncode, seconds, used.ru_maxrss * 1024, lines[-1] if lines else "")


def prepare(folder: Path) -> None:
    """Files that the commands read."""
    import shutil

    (folder / "out").mkdir()
    rng = np.random.default_rng(5)
    for name, side in (("scan.npy", 512), ("large.npy", 1619)):
        tracks = 0.06 * (np.arange(side) * 0.02 / 0.74 % 1.0 < 0.4)
        np.save(folder / name, tracks[None] + 0.002 * rng.normal(size=(side, side)))
    for name, rows in (("sky.npy", 256), ("wide.npy", 810)):
        height = np.linspace(1.0, 0.0, rows)[:, None, None]
        image = np.broadcast_to(height, (rows, 2 * rows, 3)).copy()
        image[rows // 4 : rows // 4 + rows // 32, rows // 2 : rows // 2 + rows // 32] = 300.0
        np.save(folder / name, image.astype(np.float32))
    shutil.copy(ROOT / "docs" / "examples" / "grating_reflectance.csv", folder / "grating.csv")
    for name in ("cornell", "teapot"):
        made = run(["scene", "example", name, "-o", f"{name}.toml"], folder)
        assert made.code == 0, made.said


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", help="commands that hold this text", default="")
    given = parser.parse_args()
    failed = False
    print("| command | seconds | peak, GiB | ten times as many | seconds | peak, GiB |")
    print("|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        prepare(folder)
        for command in COMMANDS:
            if given.only not in command.words:
                continue
            line = command.words.split()
            runs = [run(line, folder)]
            if command.larger:
                more = command.larger.split()
                runs.append(run(line + more if more[0].startswith("--") else more, folder))
            cells = [f"`{command.words}`"]
            for number, found in enumerate(runs):
                cells += [command.what] if number else []
                cells += [f"{found.seconds:.0f}", f"{found.nbytes / GIB:.2f}"]
                failed |= found.code != 0 or (number == 0 and found.nbytes > ALLOWED * GIB)
                if found.code:
                    cells[-1] += f" (exit code {found.code}: {found.said[:120]})"
            print(f"| {' | '.join(cells)} |", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
