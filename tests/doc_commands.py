"""The command lines of the pages: options that make them cheap, and those that are parsed only."""

import functools
import re
import tomllib
from pathlib import Path
from typing import Any

from doc_blocks import ROOT, blocks, commands, pages

#: Start of a command line: options added at its end, the last of which wins.
CHEAP = {
    # All of one shape, which shares its programs.
    "diffopt diffraction": "--size 32 --coherence 1.25 --incidence 30 --material al",
    "diffopt diffraction photo": "--size 32 --coherence 1.25 --pixel-size 0.08 --height-range 0.12",
    "diffopt material": "--size 16",
    "diffopt fit lobes gold": "--angle 0 --tolerance 0.5",
    "diffopt fit lobes blinn-phong": "--angle 0,60",
    "diffopt fit lobes rough-glass": "--angle 0,60 --lobes 4",
    "diffopt fit lobes sky": "--lobes 4",
    "diffopt plan": "--size 16x12 --most-spp 4",
    "diffopt render": "--size 16x12",
    "diffopt render cornell.toml --tolerance": "--size 16x12 --most-spp 4",
    "diffopt render balls.toml -o balls.png -o balls.exr": "--size 16x12 --spp 2",
    "diffopt shadow": "--frames 2 --size 16 --picture 32x20 --spp 1",
    "diffopt shadow --mesh": "--frames 2 --size 16 --picture 32x20 --spp 1 --bands 4",
    # The type of the pages' Python, which shares its programs.
    "diffopt fit heightfield docs": "--dtype float32",
}
#: Start of a command line that has to be understood but is not run: why.
PARSED: dict[str, str] = {
    "diffopt accuracy -o": "every study: many minutes",
    "diffopt accuracy diffraction.scalar": "rigorous optics: a minute",
    "diffopt accuracy transfer": "precomputes and path-traces: minutes",
    "diffopt bench -o": "every benchmark: a minute",
    "diffopt bench render": "compiles and times renderers: half a minute",
    "diffopt compare": "runs every method of a topic: minutes",
    "diffopt fit heightfield measured.npz": "every height: a fit of its own test",
    "diffopt fit heightfield scan.sur": "its own test fits scans; the page's other fit is run",
    "diffopt promises": "random jobs: a minute of compilation",
    "diffopt view": "serves until it is stopped",
    "diffopt shadow --scene creature --parts": "compiles for another number of fields",
    "diffopt precompute": "half a minute of compilation; the page's Python does the same",
    "diffopt relight": "needs the store",
}
#: Command lines without arguments that stand for everything; parsed as those above.
WHOLE = ("diffopt accuracy", "diffopt bench", "diffopt demo")

#: Command lines that write what later lines of their page need: run on every page.
PROVIDING = ("diffopt scene example",)

_PROGRAMS = ("make", "pip", "python", "mkdocs")
_EXTRAS = re.compile(r"\.\[([a-z,]+)\]")


def parsed_only(line: str, page: Path) -> bool:
    """Whether a command line of a page is not run: too slow, or run for an earlier page."""
    if line in WHOLE or any(line.startswith(start) for start in PARSED):
        return True
    return page != first_pages().get(line, page) and not line.startswith(PROVIDING)


@functools.cache
def first_pages() -> dict[str, Path]:
    """The first page on which each command line stands."""
    found: dict[str, Path] = {}
    for page in pages():
        for block in blocks(page):
            for line in commands(block) if block.kind == "console" else ():
                found.setdefault(line, page)
    return found


def cheap(words: list[str]) -> list[str]:
    """Options to add to a command."""
    line = " ".join(words)
    found = [start for start in CHEAP if line.startswith(start)]
    return CHEAP[max(found, key=len)].split() if found else []


def application() -> Any:
    """The table of commands."""
    import typer

    from diffopt.cli.application import app

    return typer.main.get_command(app)


def parse(words: list[str]) -> None:
    """Have the words understood by the command that they name, which is not run.

    Unknown commands and options raise, and so do words too many or too few.
    """
    command = application()
    context = command.make_context("diffopt", list(words))
    while hasattr(command, "resolve_command"):
        rest = [*getattr(context, "_protected_args", []), *context.args]
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)


def names(command: Any = None, above: str = "diffopt") -> set[str]:
    """Every command, as it is typed."""
    command = application() if command is None else command
    if not hasattr(command, "commands"):
        return {above}
    parts = (names(part, f"{above} {name}") for name, part in command.commands.items())
    return set().union(*parts)


def extras() -> set[str]:
    """Extras of the distribution."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return set(content["project"]["optional-dependencies"])


def targets() -> set[str]:
    """Targets of the Makefile that are named by a word."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    return set(re.findall(r"^([a-z][a-z-]*):", text, re.MULTILINE))


def check_other(line: str, words: list[str]) -> None:
    """Check a command line that is not the toolkit's own: targets, extras, files.

    Raises
    ------
    AssertionError
        If it names something that does not exist, or a program that is not known here.
    """
    while words and "=" in words[0]:  # variables before a command
        words = words[1:]
    program = words[0].rsplit("/", 1)[-1]
    assert program in _PROGRAMS, f"{line}: no rule for {program}"
    if program == "make":
        assert set(words[1:]) <= targets(), f"{line}: targets are {sorted(targets())}"
    wanted = set(",".join(_EXTRAS.findall(line)).split(",")) - {""}
    assert wanted <= extras(), f"{line}: extras are {sorted(extras())}"
    for word in words[1:]:
        if re.match(r"(tests|docs)(/|$)|.*\.txt$", word):
            assert (ROOT / word).exists(), f"{line}: no {word}"
