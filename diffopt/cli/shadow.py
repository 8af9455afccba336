"""``diffopt shadow``: frames of a deforming object and its soft shadow, and their times."""

import dataclasses
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.cli.film import Film, frame_name
from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.shadows.animations import Animation
    from diffopt.shadows.settings import ShadowSettings

#: Exit code of an animation that was interrupted.
INTERRUPTED = 130
_MOST_FRAMES, _MOST_SAMPLES = 999, 2**24


def command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder for the frames, animation and times.")
    ] = Path("out/shadow"),
    scene: Annotated[
        str | None, typer.Option(help="creature, egg or sheet. [default: creature]")
    ] = None,
    mesh: Annotated[
        str | None,
        typer.Option(help="Mesh to twist and bend instead: ply, obj, stl, off, glb or gltf."),
    ] = None,
    up: Annotated[str, typer.Option(help="Axis of the mesh that is upwards: x, y or z.")] = "y",
    frames: Annotated[int, typer.Option(help="Of a loop.")] = 36,
    size: Annotated[int, typer.Option(help="Receivers on a side of the ground.")] = 160,
    picture: Annotated[str, typer.Option(metavar="WxH", help="Pixels of a frame.")] = "640x400",
    spp: Annotated[int, typer.Option(help="Samples on a side of each pixel.")] = 2,
    tolerance: Annotated[
        float | None,
        typer.Option(help="RMS error of light over the open light: the cheapest settings for it."),
    ] = None,
    bands: Annotated[int | None, typer.Option(help="Of spherical harmonics. [default: 4]")] = None,
    rays: Annotated[
        int | None, typer.Option(help="On a side, from each point of a shell. [default: 32]")
    ] = None,
    shells: Annotated[
        int | None,
        typer.Option(help="Distances that are sampled. [default: 2 + bands / 2, or 1 by the map]"),
    ] = None,
    parts: Annotated[int, typer.Option(help="Fields that the object is split into.")] = 1,
    map_: Annotated[
        str,
        typer.Option("--map", help="How views shrink with distance: tangent, square, sphere rule."),
    ] = "tangent",
    combination: Annotated[
        str, typer.Option(help="Of several parts: product, exponential or sum.")
    ] = "product",
    lamp: Annotated[
        bool, typer.Option("--lamp/--no-lamp", help="A local light that goes round.")
    ] = True,
    check: Annotated[
        bool, typer.Option("--check", help="Compare some frames with the light by rays.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Frames of a deforming object over its soft shadow; Ctrl-C keeps those that are finished."""
    from diffopt.cli.errors import user_input
    from diffopt.cli.output import folder
    from diffopt.cli.progress import stages

    if not quiet:
        _note_others(output, frames)
    _whole("--frames", frames, 1, _MOST_FRAMES)
    _whole("--size", size, 2, 4096)
    _whole("--spp", spp, 1, 8)
    resolution = _pixels(picture)
    samples = resolution[0] * resolution[1] * spp**2
    if samples > _MOST_SAMPLES:
        raise InputError(
            f"--picture {picture} --spp {spp} are {samples} samples; at most {_MOST_SAMPLES}"
        )
    with user_input():
        chosen = {"bands": bands, "rays": rays, "shells": shells}
        settings = _settings(
            tolerance,
            parts,
            map=map_,
            combination=combination,
            **{name: value for name, value in chosen.items() if value is not None},
        )
        if mesh is not None and scene is not None:
            raise InputError(f"--scene {scene} and --mesh {mesh}: give one of them")
        animation = _animation(scene or "creature", mesh, up)
        _whole("--parts", parts, 1, len(animation.faces))
    film = Film(animation, settings, parts, size, resolution, spp, lamp=lamp)
    with (
        folder(output) as staging,
        stages(1, left=True) as progress,
        progress.stage(animation.name) as report,
    ):
        interrupted = False
        try:
            film.prepare(frames)
            report(0, frames)
            for number in range(frames):
                film.shoot(number, frames, staging, check=check)
                report(number + 1, frames)
        except KeyboardInterrupt:
            if not film.frames:
                raise
            interrupted = True
        film.write(staging, frames)
    if not quiet:
        _tell(film, output, frames if interrupted else None)
    if interrupted:
        raise typer.Exit(INTERRUPTED)


def _tell(film: Film, output: Path, wanted: int | None) -> None:
    """Print the table, error and files."""
    from diffopt.cli.progress import terminal

    console = terminal()
    for line in film.text():
        console.print(line, markup=False)
    receivers = film.ground.shape[0] ** 2
    each = 1e9 * film.median("shadowing") / receivers
    lights = "sky, sun and lamp" if film.lamp else "sky and sun"
    console.print(
        f"{receivers} receivers on the ground under {lights}: {each:.0f} ns each (paper: 1410 ns, "
        f"sky); medians of {len(film.frames)} frames; pictures take {film.median('picture'):.2g} s",
        markup=False,
    )
    if film.worst is not None:
        checked = [frame for frame in film.frames if frame.error is not None]
        found = ", ".join(f"{100.0 * (frame.error or 0.0):.2f} %" for frame in checked)
        numbers = ", ".join(str(frame.number) for frame in checked)
        console.print(
            f"RMS error of the sky's light over the open light, frames {numbers}: {found}",
            markup=False,
        )
    if wanted is not None:
        console.print(f"interrupted: {len(film.frames)} of {wanted} frames", markup=False)
    last = len(film.frames) - 1
    span = frame_name(0) if last == 0 else f"{frame_name(0)} .. {frame_name(last)}"
    console.print(
        f"{output}: {span}, animation.gif, times.txt, times.csv, result.json", markup=False
    )


def _note_others(output: Path, frames: int) -> None:
    """Say that frames of a longer run stay."""
    if not output.is_dir():
        return
    found = [path.name for path in output.iterdir() if re.fullmatch(r"frame_\d{4}\.png", path.name)]
    others = sorted(name for name in found if name >= frame_name(frames))
    if others:
        print(f"note: {output} holds {len(others)} more frames of another run, from {others[0]} on")


def _animation(scene: str, mesh: str | None, up: str) -> "Animation":
    """What is to move.

    Raises
    ------
    InputError
        For a scene that there is not, or a file that holds no mesh.
    """
    from diffopt import checks
    from diffopt.shadows import animations

    checks.choice("--up", up, ("x", "y", "z"))
    if mesh is None:
        return animations.animation(checks.choice("--scene", scene, animations.NAMES))
    from diffopt.scenes import meshfiles

    loaded = meshfiles.load(mesh)
    return animations.of_mesh(loaded.vertices, loaded.faces, Path(mesh).name, up)


def _settings(tolerance: float | None, parts: int, **words: Any) -> "ShadowSettings":
    """Settings by tolerance and by what is given, which counts; faults are named as options."""
    from diffopt.shadows.choosing import settings_for
    from diffopt.shadows.settings import ShadowSettings

    try:
        if tolerance is None:
            return ShadowSettings(**words)
        if words.get("map", "tangent") != "tangent":
            raise InputError(f"tolerance is met by the tangent map; received {words['map']!r}")
        found = settings_for(tolerance, receivers_inside=True, occluders=max(parts, 1))
        return dataclasses.replace(found, **words)
    except InputError as error:
        text = str(error)
        known = ("tolerance", *words)
        named = next((name for name in known if text.startswith(name)), None)
        raise InputError(text if named is None else f"--{text}") from None


def _whole(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise InputError(f"{name} must lie between {least} and {most}; received {value}")


def _pixels(text: str) -> tuple[int, int]:
    from diffopt.cli.render import pixels

    try:
        found = pixels(text)
    except InputError as error:
        raise InputError(str(error).replace("--size", "--picture")) from None
    assert found is not None
    return found
