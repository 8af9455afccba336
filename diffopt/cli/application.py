"""The table of commands and the entry point."""

import sys
from collections.abc import Sequence
from typing import Annotated

import typer

from diffopt import __version__
from diffopt.cli import (
    comparing,
    demo,
    diffraction,
    errors,
    fitting,
    inspection,
    material,
    plan,
    precompute,
    promising,
    relight,
    render,
    scene,
    shadow,
    studying,
    view,
)
from diffopt.errors import InputError

app = typer.Typer(
    name="diffopt",
    help="Diffraction colours of measured surfaces, materials, scenes: lengths in micrometres, "
    "those of scenes in any unit, angles in degrees.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("diffraction")(diffraction.command)
app.command("material")(material.command)
app.add_typer(fitting.app, name="fit")
app.add_typer(scene.app, name="scene")
app.command("plan")(plan.command)
app.command("render")(render.command)
app.command("precompute")(precompute.command)
app.command("relight")(relight.command)
app.command("shadow")(shadow.command)
app.command("view")(view.command)
app.command("demo")(demo.command)
app.command("accuracy")(studying.accuracy)
app.command("promises")(promising.command)
app.add_typer(comparing.app, name="compare")
app.command("bench")(studying.bench)
app.command("samples")(inspection.samples)
app.command("info")(inspection.info)

# Usage errors of the parser that typer brings along; where it lives depends on the version.
_USAGE: type[Exception] = next(
    kind for kind in typer.BadParameter.__mro__ if kind.__name__ == "ClickException"
)


def _print_version(wanted: bool) -> bool:
    if wanted:
        print(f"diffopt {__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    """Options before any command."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command line.

    Parameters
    ----------
    arguments
        Words after the program's name; those of the process if left out.

    Returns
    -------
    int
        Exit code: 0, 2 for a fault of the input (one line on the error stream), 130 when
        interrupted. Exceptions that are no fault of the input pass through.
    """
    command = typer.main.get_command(app)
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = command.main(args=words, prog_name="diffopt", standalone_mode=False)
    except InputError as error:
        return errors.report(error)
    except _USAGE as error:
        if type(error).__name__ == "NoArgsIsHelpError":
            print(command.get_help(command.make_context("diffopt", [], resilient_parsing=True)))
            return errors.BAD_INPUT
        return errors.report(ValueError(error.format_message()))  # type: ignore[attr-defined]
    except (KeyboardInterrupt, typer.Abort):
        print("diffopt: interrupted", file=sys.stderr)
        return 130
    return code if isinstance(code, int) else 0
