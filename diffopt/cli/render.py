"""``diffopt render``: pictures of a scene file."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.cli.plan import MostSpp, With, Without, planned, shortfall
from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.planning import Plan
    from diffopt.rendering import Image

#: Exit code of a picture that was interrupted.
INTERRUPTED = 130
# Pixels on a side, at most.
_MOST = 16384


def command(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A scene, .toml; see diffopt scene example.")
    ],
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "-o", "--output", help=".png, .exr or .npz; may be given again. [default: FILE.png]"
        ),
    ] = None,
    level: Annotated[
        str | None,
        typer.Option(help="incremental, recursive, path or another level. [default: path]"),
    ] = None,
    spp: Annotated[int | None, typer.Option(help="Samples of each pixel.")] = None,
    depth: Annotated[
        int | None, typer.Option(help="Surfaces that light is followed over, at most.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the random numbers.")] = None,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Pixels, in place of the camera's.")
    ] = None,
    exposure: Annotated[
        float | None,
        typer.Option(help="Of a .png: factor on linear values. [default: by the brightest]"),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Render by a plan, in place of a level: only the effects that a mean difference "
            "of this share of the mean luminance calls for; see diffopt plan."
        ),
    ] = None,
    include: With = None,
    exclude: Without = None,
    most_spp: MostSpp = None,
    layers: Annotated[
        bool,
        typer.Option(
            "--layers",
            help="Keep the light of each effect apart, by paths: as layers of .exr and .npz, and "
            "beside NAME.png as NAME.EFFECT.png at its exposure. Their sum is the picture; what "
            "shadows take away is below 0, and shown in .png as its magnitude.",
        ),
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Picture of a scene; Ctrl-C ends it and keeps what is finished.

    What took longer than some ten seconds is kept, and the same command goes on from it.
    """
    import dataclasses

    from diffopt.cli import render_output
    from diffopt.cli.errors import user_input
    from diffopt.cli.output import beside, written
    from diffopt.cli.progress import terminal
    from diffopt.cli.scene import one_line
    from diffopt.io.files import openexr, remove
    from diffopt.rendering.images import FORMATS
    from diffopt.scenes import load_scene

    targets = output if output else [Path(f"{file.stem}.png")]
    for target in targets:
        if target.suffix.lower() not in FORMATS:
            raise InputError(f"-o {target}: pictures are written to {', '.join(FORMATS)}")
        if not target.parent.is_dir():
            raise InputError(f"-o {target}: the folder {target.parent} does not exist")
        if target.is_dir():
            raise InputError(f"-o {target}: is a folder; expected a file")
        if not os.access(target.parent, os.W_OK | os.X_OK):
            raise InputError(f"-o {target}: the folder {target.parent} cannot be written to")
        if target.suffix.lower() == ".exr":
            openexr(target, "as .npz")  # or what takes minutes would be lost
    if exposure is not None and not 0.0 < exposure < float("inf"):
        raise InputError(f"--exposure must be a factor above 0; received {exposure:g}")
    of_plan = {"--with": include, "--without": exclude, "--most-spp": most_spp}
    _exclusive(tolerance, {"--level": level, "--depth": depth}, of_plan)
    resolution = pixels(size)
    with one_line(file), user_input():
        found = load_scene(file)
    camera = found.camera
    if resolution is not None:
        camera = dataclasses.replace(camera, resolution=resolution)
    options = dict(found.options)
    brightness = options.pop("exposure", None) if exposure is None else exposure
    options.pop("exposure", None)
    words = {"spp": spp, "depth": depth, "seed": seed}
    plan = None
    if tolerance is None:
        settings, notes = chosen(options, level, words)
        if layers and settings.level != "path":
            raise InputError(
                f"--layers are kept by paths; received the level {settings.level}: give --level "
                "path or --tolerance"
            )
    else:
        plan = planned(
            found, camera, tolerance, include, exclude, most_spp=most_spp, seed=seed, quiet=quiet
        )
        settings, notes = by_plan(plan, options, spp)
        notes += shortfall(plan)
        if layers and settings.level != "path":
            notes.append(
                f"layers are kept by paths in place of {settings.level}: the predicted noise "
                "does not hold; raise --spp for less"
            )
        if not quiet:
            for line in render_output.effects(plan):
                terminal().print(line, markup=False, soft_wrap=True)
    keep = beside(targets[0], "tiles")
    image = picture(found.scene, camera, settings, keep, plan=plan, layers=layers, quiet=quiet)
    for target in targets:
        with written(target):
            image.save(target, exposure=brightness)
    for target in render_output.pictures(image, targets):
        with written(target):
            render_output.save_layers(image, target, brightness)
    if not image.interrupted:
        remove(keep)
    if not quiet:
        render_output.tell(image, targets, [*found.notes, *notes])
    if image.interrupted:
        raise typer.Exit(INTERRUPTED)


def _exclusive(tolerance: float | None, of_level: dict[str, Any], of_plan: dict[str, Any]) -> None:
    """Refuse options of a level beside a plan, and those of a plan without one."""
    wrong = of_plan if tolerance is None else of_level
    typed = next((option for option, value in wrong.items() if value is not None), None)
    if typed is None:
        return
    if tolerance is None:
        raise InputError(f"{typed} belongs to plans: give --tolerance too")
    what = typed.removeprefix("--")
    raise InputError(f"--tolerance and {typed} exclude each other: the plan chooses the {what}")


def by_plan(plan: "Plan", options: dict[str, Any], spp: int | None) -> tuple[Any, list[str]]:
    """Settings of a plan, changed by what was typed, and by the file where no picture changes.

    Parameters
    ----------
    plan
        The plan.
    options
        Of the file: ``level`` and its settings.
    spp
        As typed; None for that of the plan.

    Returns
    -------
    tuple
        The settings, and notes on what was left out.

    Raises
    ------
    InputError
        For samples out of range.
    """
    import dataclasses

    changed: dict[str, Any] = {"rays": options["rays"]} if "rays" in options else {}
    left = ", ".join(sorted(set(options) - {"rays", "seed", "backend"}))
    notes = [f"{left} of the file are left out: the plan has its own"] if left else []
    if spp is not None:
        changed["spp"] = spp
    try:
        return dataclasses.replace(plan.settings, **changed), notes
    except InputError as error:
        raise InputError(f"--{error}") from None


def chosen(
    options: dict[str, Any], level: str | None, words: dict[str, Any]
) -> tuple[Any, list[str]]:
    """Settings of a level: those of the file, then those that were typed.

    Parameters
    ----------
    options
        Of the file: ``level`` and its settings.
    level
        As typed; None for that of the file.
    words
        Settings as typed; None for those not given.

    Returns
    -------
    tuple
        The settings, and notes on what was left out.

    Raises
    ------
    InputError
        For a level that there is not, or a setting that it does not have.
    """
    from diffopt import checks
    from diffopt.rendering.synthesis import LEVELS, chosen_settings

    given = dict(options)
    own = given.pop("level", "path")
    wanted = own if level is None else checks.choice("--level", level, tuple(LEVELS))
    notes = []
    if wanted != own:
        kept = {name: value for name, value in given.items() if name == "seed"}
        if len(kept) < len(given):
            left = ", ".join(sorted(set(given) - set(kept)))
            notes.append(f"{left} of the file belong to the level {own}: left out")
        given = kept
    given |= {name: value for name, value in words.items() if value is not None}
    try:
        return chosen_settings(wanted, None, given), notes
    except InputError as error:
        text = str(error)
        typed = [name for name, value in words.items() if value is not None]
        named = next((name for name in typed if text.startswith(name)), None)
        raise InputError(text if named is None else f"--{text}") from None


def picture(
    scene: Any,
    camera: Any,
    settings: Any,
    keep: Path,
    *,
    plan: "Plan | None",
    layers: bool,
    quiet: bool,
) -> "Image":
    """Render with a bar on the error stream, unless `quiet`; tiles are in the file `keep`."""
    from diffopt.cli.progress import stages
    from diffopt.rendering import render

    given: dict[str, Any] = {"settings": settings, "layers": layers, "keep": keep}
    if plan is not None:
        given["level"] = plan
    if quiet:
        return render(scene, camera, **given)
    with stages(1, left=True) as progress, progress.stage(settings.level) as report:
        return render(scene, camera, progress=report, **given)


def pixels(text: str | None) -> tuple[int, int] | None:
    """Columns and rows from ``WxH``."""
    if text is None:
        return None
    words = text.lower().split("x")
    numbers = [int(word) for word in words if word.isdecimal()]
    if len(words) != 2 or len(numbers) != 2 or not all(1 <= n <= _MOST for n in numbers):
        raise InputError(f"--size must be WxH, 1 to {_MOST} pixels each; received {text!r}")
    return numbers[0], numbers[1]
