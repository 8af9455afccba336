"""``diffopt compare transfer``: precomputed transfer against brute force."""

import contextlib
from pathlib import Path
from typing import Annotated

import typer


def transfer(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            help="Scenes: 'teapot 32', 'teapot 128', rabbit, knots, ring. [default: both teapots]"
        ),
    ] = None,
    way: Annotated[
        list[str] | None,
        typer.Option(
            help="adaptive, 'adaptive, 2 lobes', 'adaptive, per vertex', 'adaptive, no indirect', "
            "initial, 'uniform 1', 'uniform 2', 'uniform 3'; may be repeated. [default: all but "
            "the last]"
        ),
    ] = None,
    light: Annotated[str, typer.Option(help="suns, or sky.")] = "suns",
    tolerance: Annotated[float, typer.Option(help="Of the adaptive ways.")] = 0.2,
    rays: Annotated[int, typer.Option(help="Of every vertex.")] = 2048,
    detail: Annotated[int, typer.Option(help="Divisions of the patches of the teapot.")] = 4,
    size: Annotated[int, typer.Option(help="Pixels on a side of the picture.")] = 96,
    paths: Annotated[int, typer.Option(help="Of the truth at each pixel, a multiple of 8.")] = 2048,
    once: Annotated[
        bool, typer.Option("--once", help="Precompute once; times have compilation in them.")
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help="A ring of 200 vertices in place of the scenes.")
    ] = False,
    output: Annotated[Path | None, typer.Option("-o", help="Folder for transfer.csv.")] = None,
) -> None:
    """Error, size and time of adaptive and even tessellations, of one lobe and two."""
    from diffopt.accuracy import transfer_comparison
    from diffopt.cli.errors import user_input
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages, terminal
    from diffopt.transfer.settings import TransferSettings

    with user_input():
        settings = TransferSettings(tolerance=tolerance, rays=rays)
    if quick:
        names, way = names or ["ring"], way or ["adaptive", "adaptive, no indirect", "initial"]
        settings = TransferSettings(tolerance=0.3, rays=256, finest=1, splits=1)
        size, paths, once = min(size, 24), min(paths, 256), True
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(1))
        with progress.stage("scenes") as report, user_input():
            found = transfer_comparison.compare(
                names,
                way,
                light=light,
                settings=settings,
                detail=detail,
                resolution=size,
                paths=paths,
                again=not once,
                progress=lambda done, of, _: report(done, of),
            )
        if staging is not None:
            found.save_csv(staging / "transfer.csv")
    terminal().print(found.table())
    if output is not None:
        terminal().print(f"table: {output}")
