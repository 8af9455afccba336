"""The command lines of the pages: options that make them cheap, and those that are parsed only."""

import re
import tomllib
from pathlib import Path
from typing import Any

from doc_blocks import ROOT

#: Start of a command line: options added at its end, the last of which wins.
CHEAP = {
    "diffopt diffraction": "--size 32",
    "diffopt demo": "--size 48",
}
#: Start of a command line that only has to be understood: why it is not run.
PARSED: dict[str, str] = {}


def cheap(words: list[str]) -> list[str]:
    """Options to add to a command."""
    line = " ".join(words)
    found = [start for start in CHEAP if line.startswith(start)]
    return CHEAP[max(found, key=len)].split() if found else []


def parse(words: list[str]) -> None:
    """Have the words understood by the command that they name, which is not run.

    Unknown commands and options raise, and so do files that have to exist.
    """
    import typer

    from diffopt.cli import application

    command: Any = typer.main.get_command(application.app)
    context = command.make_context("diffopt", list(words), resilient_parsing=False)
    while hasattr(command, "resolve_command"):
        rest = [*context.protected_args, *context.args]
        name, command, rest = command.resolve_command(context, rest)
        context = command.make_context(name, rest, parent=context)
