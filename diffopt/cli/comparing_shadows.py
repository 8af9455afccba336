"""``diffopt compare shadows``: shadow fields against cast rays."""

import contextlib
from pathlib import Path
from typing import Annotated

import typer


def shadows(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Scenes: capsule, sphere, 'torus flat', 'torus tilted', creature, egg. "
            "[default: all]"
        ),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="square, 'sphere rule', tangent, two-shell, parts, default, fine; may be "
            "repeated. [default: all]"
        ),
    ] = None,
    bands: Annotated[str, typer.Option(help="Bands of spherical harmonics.")] = "4,6,8",
    side: Annotated[int, typer.Option(help="Receivers on a side of the ground.")] = 160,
    repeats: Annotated[int, typer.Option(help="Runs of which the median time counts.")] = 5,
    quick: Annotated[
        bool, typer.Option("--quick", help="Two scenes, few receivers, four bands.")
    ] = False,
    output: Annotated[Path | None, typer.Option("-o", help="Folder for shadows.csv.")] = None,
) -> None:
    """Error and time of soft shadows by every map, and the least error that is possible."""
    from diffopt.accuracy import shadow_comparison
    from diffopt.cli.options import floats
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages, terminal
    from diffopt.errors import InputError

    counts = floats(bands)
    if not counts or not all(count >= 1 and count == int(count) for count in counts):
        raise InputError(f"--bands must be whole numbers from 1, as 4,6,8; received {bands!r}")
    if quick:
        names, counts, side = names or ["capsule", "torus flat"], [4.0], min(side, 40)
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(1))
        with progress.stage("scenes") as report:
            found = shadow_comparison.compare(
                names,
                method,
                bands=[int(count) for count in counts],
                side=side,
                repeats=repeats,
                receivers=100_000 if not quick else 10_000,
                progress=lambda done, of, _: report(done, of),
            )
        if staging is not None:
            found.save_csv(staging / "shadows.csv")
    terminal().print(found.table())
    if output is not None:
        terminal().print(f"table: {output}")
