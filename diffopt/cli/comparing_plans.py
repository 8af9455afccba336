"""``diffopt compare plans``: what plans leave out, whether that is right, and what it saves."""

import contextlib
from pathlib import Path
from typing import Annotated, Any

import typer

#: Scenes of ``--quick``.
QUICK = ("sunlit-card", "two-walls")
# With it, no more paths than these, and references and plans of ladders.
_FEW = 32
_QUICK_LADDERS: dict[str, Any] = {"tolerances": (0.1, 0.03), "reference": 64}


def plans(
    names: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="SCENE",
            help="Scenes, as cornell or everything; an unknown name lists them. "
            "[default: all; of --ladders five]",
        ),
    ] = None,
    tolerance: Annotated[
        float,
        typer.Option(
            help="Mean difference of luminance, over the mean, that plans keep; "
            "--ladders has its own."
        ),
    ] = 0.03,
    size: Annotated[str, typer.Option(metavar="WxH", help="Columns and rows.")] = "96x72",
    most_spp: Annotated[
        int | None,
        typer.Option(
            "--most-spp", help="Paths of a pixel, at most. [default: 256; of --ladders 1024]"
        ),
    ] = None,
    paths: Annotated[int, typer.Option(help="Paths of a pixel of the check.")] = 256,
    no_render: Annotated[
        bool, typer.Option("--no-render", help="Check plans, and time no pictures by them.")
    ] = False,
    ladders: Annotated[
        bool,
        typer.Option("--ladders", help="Error against time of every level and of plans, too."),
    ] = False,
    quick: Annotated[
        bool, typer.Option("--quick", help=f"Two scenes, small pictures, {_FEW} paths at most.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option("-o", help="Folder for plans.csv; of --ladders, ladders.csv and ladders.png."),
    ] = None,
) -> None:
    """Plans of scenes that call for different effects, checked and timed."""
    from diffopt import checks
    from diffopt.accuracy import plan_comparison, plan_ladders, plan_scenes
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages, terminal
    from diffopt.cli.render import pixels
    from diffopt.errors import InputError

    # Here, not when a scene's turn comes: that may be an hour later.
    for name in names or ():
        checks.choice("SCENE", name, tuple(plan_scenes.SCENES))
    if not 0.0 < tolerance <= 1.0:
        raise InputError(f"--tolerance must be above 0 and at most 1; received {tolerance:g}")
    for option, count in (("--most-spp", most_spp), ("--paths", paths)):
        if count is not None and not 1 <= count <= 2**20:
            raise InputError(f"{option} must be a whole number from 1 to {2**20}; received {count}")
    resolution = pixels(size) or (96, 72)
    if quick:
        names, resolution = names or list(QUICK), (32, 24)
        most_spp, paths = min(most_spp or _FEW, _FEW), min(paths, _FEW)
    most = {} if most_spp is None else {"most_spp": most_spp}
    climbed = None
    with contextlib.ExitStack() as stack:
        staging = None if output is None else stack.enter_context(folder(output))
        progress = stack.enter_context(stages(1 + ladders))
        with progress.stage("plans") as report:
            found = plan_comparison.compare(
                names,
                tolerance=tolerance,
                resolution=resolution,
                paths=paths,
                render=not no_render,
                progress=lambda done, of, _: report(done, of),
                **most,
            )
        if ladders:
            with progress.stage("ladders") as report:
                climbed = plan_ladders.climb(
                    names or plan_ladders.SHOWN,
                    resolution=resolution,
                    progress=lambda done, of, _, to=report: to(done, of),
                    **most,
                    **(_QUICK_LADDERS if quick else {}),
                )
        if staging is not None:
            found.save_csv(staging / "plans.csv")
            if climbed is not None:
                climbed.save_csv(staging / "ladders.csv")
                climbed.plot(staging / "ladders.png")
    terminal().print(found.table())
    if climbed is not None:
        terminal().print(climbed.table())
    if output is not None:
        terminal().print(f"{'table' if climbed is None else 'tables and plot'}: {output}")
