"""Runs the blocks of pages in order, as a reader would: ``doc_run.py PAGE...``.

With the defaults of a user, each page in an empty folder that holds the files that it names, with
names of its own. Exit code 1 where a block fails; what went wrong is on the error stream.
"""

import contextlib
import io
import json
import os
import shlex
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from doc_blocks import ROOT, Block, agrees, blocks, commands, said
from doc_commands import cheap, check_other, parse, parsed_only
from doc_inputs import provide


def run_page(page: Path, folder: Path) -> list[str]:
    """Run every block of a page; what each took, in words."""
    found = blocks(page)
    provide(folder, "\n".join(block.text for block in found))
    names: dict[str, Any] = {"__name__": "__page__"}
    times = []
    for block in found:
        start = time.perf_counter()
        RUNNERS[block.kind](block, names)
        times.append(f"{time.perf_counter() - start:6.2f} s  {block.place} ({block.kind})")
    return times


def python(block: Block, names: dict[str, Any]) -> None:
    """Execute a block, and compare what it prints with its comments ``# -> value``."""
    # Line numbers of errors are those of the page.
    code = compile("\n" * (block.line - 1) + block.text, str(block.page), "exec")
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        exec(code, names)
    expected = said(block.text)
    if expected:
        printed = out.getvalue().splitlines()
        pairs = list(zip(expected, printed, strict=False))
        if len(printed) != len(expected) or not all(agrees(*pair) for pair in pairs):
            raise AssertionError(f"printed {printed}, expected {expected}")


def console(block: Block, names: dict[str, Any]) -> None:
    """Run command lines, with options that make them cheap."""
    del names
    from diffopt import cli

    for line in commands(block):
        words = shlex.split(line)
        if words[0] != "diffopt":
            check_other(line, words)
        elif parsed_only(line, block.page):
            parse(words[1:])
        else:
            start, out = time.perf_counter(), io.StringIO()
            with contextlib.redirect_stdout(out):
                code = cli.main([*words[1:], *cheap(words)])
            if code != 0:
                raise AssertionError(f"{line}: exit code {code}\n{out.getvalue()}")
            if "DOC_TIMES" in os.environ:
                print(f"    {time.perf_counter() - start:6.2f} s  {line}", flush=True)


def toml(block: Block, names: dict[str, Any]) -> None:
    """Load a scene."""
    from diffopt import scenes

    del names
    path = Path("block.toml")
    path.write_text(block.text, encoding="utf-8")
    scenes.load_scene(path)


def csv(block: Block, names: dict[str, Any]) -> None:
    """Load measured reflectance, or a table of a gonioreflectometer, by its columns."""
    from diffopt import fitting, materials

    del names
    path = Path("block.csv")
    path.write_text(block.text, encoding="utf-8")
    (fitting.Measured.load if " nm" in block.text else materials.load_table)(path)


def as_json(block: Block, names: dict[str, Any]) -> None:
    """Every key is one that the program really writes: those of `result` in the page."""
    wanted = json.loads(block.text)
    real = json.loads(Path(wanted.pop("file")).read_text(encoding="utf-8"))
    del names
    missing = keys(wanted) - keys(real)
    if missing:
        raise AssertionError(f"not in the file that was written: {sorted(missing)}")


def keys(tree: Any, above: str = "") -> set[str]:
    """Names of all entries of nested tables."""
    if not isinstance(tree, dict):
        return set()
    return {above + k for k in tree}.union(*(keys(v, f"{above}{k}.") for k, v in tree.items()))


RUNNERS = {"python": python, "console": console, "toml": toml, "csv": csv, "json": as_json}


def main(given: list[str]) -> int:
    """Run pages, each in a new folder of the current one."""
    failed, start = [], Path.cwd()
    for number, word in enumerate(given):
        folder = start / str(number)
        folder.mkdir()
        os.chdir(folder)
        try:
            print("\n".join(run_page((ROOT / word).resolve(), folder)), flush=True)
        except BaseException:
            traceback.print_exc()
            failed.append(word)
            print(f"{word}: a block failed", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
