"""``diffopt compare rendering``: every level of image synthesis on the same scenes."""

import contextlib
from pathlib import Path
from typing import Annotated

import typer


def rendering(
    names: Annotated[
        list[str] | None,
        typer.Argument(help="Scenes: box, glass, balls, points, map. [default: all]"),
    ] = None,
    level: Annotated[
        list[str] | None, typer.Option(help="A level; may be repeated. [default: all]")
    ] = None,
    spp: Annotated[str, typer.Option(help="Paths a pixel of the path-traced pictures.")] = (
        "1,4,16,64"
    ),
    reference: Annotated[int, typer.Option(help="Paths a pixel of the reference.")] = 512,
    size: Annotated[str, typer.Option(help="Columns and rows, WxH.")] = "96x72",
    repeats: Annotated[int, typer.Option(help="Pictures of which the median time counts.")] = 3,
    quick: Annotated[
        bool, typer.Option("--quick", help="Two scenes, small pictures, 64 paths for reference.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", help="Folder for rendering.csv, rendering.png and pictures.png."),
    ] = None,
) -> None:
    """Error and time of every level against a path-traced reference."""
    from diffopt.accuracy import render_comparison
    from diffopt.cli.options import floats
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages, terminal
    from diffopt.cli.render import pixels
    from diffopt.errors import InputError

    counts = floats(spp)
    if not counts or not all(count >= 1 and count == int(count) for count in counts):
        raise InputError(f"--spp must be whole numbers from 1, as 1,4,16; received {spp!r}")
    resolution = pixels(size) or (96, 72)
    if quick:
        names, resolution, reference = names or ["box", "points"], (32, 24), min(reference, 64)
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(1))
        with progress.stage("pictures") as report:
            found = render_comparison.compare(
                names,
                level,
                spp=[int(count) for count in counts],
                reference=reference,
                resolution=resolution,
                repeats=repeats,
                progress=lambda done, of, _: report(done, of),
            )
        if staging is not None:
            found.save_csv(staging / "rendering.csv")
            found.plot(staging / "rendering.png")
            found.sheet(staging / "pictures.png")
    terminal().print(found.table())
    if output is not None:
        terminal().print(f"table and pictures: {output}")
