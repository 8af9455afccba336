"""``diffopt render``: pictures of a scene file."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
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
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Picture of a scene; Ctrl-C ends it and keeps what is finished."""
    import dataclasses

    from diffopt.cli.errors import user_input
    from diffopt.cli.scene import one_line
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
    if exposure is not None and not 0.0 < exposure < float("inf"):
        raise InputError(f"--exposure must be a factor above 0; received {exposure:g}")
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
    settings, notes = chosen(options, level, words)
    image = picture(found.scene, camera, settings, quiet=quiet)
    for target in targets:
        image.save(target, exposure=brightness)
    if not quiet:
        tell(image, targets, [*found.notes, *notes])
    if image.interrupted:
        raise typer.Exit(INTERRUPTED)


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


def picture(scene: Any, camera: Any, settings: Any, *, quiet: bool) -> "Image":
    """Render with a bar on the error stream, unless `quiet`."""
    from diffopt.cli.progress import stages
    from diffopt.rendering import render

    if quiet:
        return render(scene, camera, settings=settings)
    with stages(1, left=True) as progress, progress.stage(settings.level) as report:
        return render(scene, camera, settings=settings, progress=report)


def tell(image: "Image", targets: list[Path], notes: list[str]) -> None:
    """Print level, time, noise and files."""
    import numpy as np
    from rich.table import Table

    from diffopt.cli.progress import terminal

    console = terminal()
    settings, (rows, columns) = image.settings, image.done.shape
    table = Table.grid(padding=(0, 2))
    table.add_row("level", f"{settings.level}, {settings.spp} samples a pixel")
    table.add_row("picture", f"{columns} x {rows} pixels, {image.channels.count} channels")
    table.add_row("time", _duration(image.seconds))
    if np.isfinite(image.noise):
        kind = "standard error" if settings.level == "path" else "bound of the error"
        table.add_row("noise", f"{100.0 * image.noise:.2g} % of the mean luminance ({kind})")
    if image.interrupted:
        share = f"{100.0 * image.done.mean():.0f} % of the pixels are done; the others are black"
        table.add_row("interrupted", share)
    table.add_row("files", ", ".join(map(str, targets)))
    console.print(table, markup=False)
    for note in notes:
        console.print(f"note: {note}", markup=False)


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.3g} s"
    return time.strftime("%H:%M:%S", time.gmtime(seconds))


def pixels(text: str | None) -> tuple[int, int] | None:
    """Columns and rows from ``WxH``."""
    if text is None:
        return None
    words = text.lower().split("x")
    numbers = [int(word) for word in words if word.isdecimal()]
    if len(words) != 2 or len(numbers) != 2 or not all(1 <= n <= _MOST for n in numbers):
        raise InputError(f"--size must be WxH, 1 to {_MOST} pixels each; received {text!r}")
    return numbers[0], numbers[1]
