"""``diffopt scene``: check scene files, and write examples of them."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.scenes import Finding, Scene, SceneFile

app = typer.Typer(help="Check scene files, and write examples.", rich_markup_mode=None)

_STYLES = {"error": "bold red", "warning": "yellow", "note": None}


@app.callback()
def _root() -> None:
    """Check scene files, and write examples."""


@app.command("check")
def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A scene, .toml.")],
) -> None:
    """Objects, lights and what is odd about them; exit code 1 if something is wrong."""
    from diffopt.cli.errors import user_input
    from diffopt.cli.progress import terminal
    from diffopt.scenes import findings, load_scene
    from diffopt.scenes.tables import SceneFileError

    console = terminal()
    try:
        with user_input():
            found = load_scene(file)
    except SceneFileError as error:
        for line in error.lines:
            console.print(line, markup=False, soft_wrap=True)
        count = len(error.faults)
        console.print(f"{count} {'fault' if count == 1 else 'faults'}", style="bold red")
        raise typer.Exit(1) from None
    seen = findings.check(found.scene, found.camera)
    _tell(found, seen)
    if any(finding.severity == "error" for finding in seen):
        raise typer.Exit(1)


@app.command("example")
def example(
    name: Annotated[
        str,
        typer.Argument(metavar="NAME", help="cornell, balls, disc, lamp, teapot, rabbit or knots."),
    ] = "balls",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="File. [default: NAME.toml]")
    ] = None,
) -> None:
    """Write a scene to start from; a file that is there is kept."""
    from diffopt.cli.progress import terminal
    from diffopt.io.files import replacing
    from diffopt.scenes import examples

    text = examples.text(name)
    target = Path(f"{name}.toml") if output is None else output
    if target.exists():
        raise InputError(f"{target}: is there already; name another file with -o")
    with replacing(target) as file:
        file.write(text.encode())
    terminal().print(f"{target}: diffopt render {target} -o {target.stem}.png")


@contextlib.contextmanager
def one_line(file: Path) -> Iterator[None]:
    """Say the first of a file's faults, how many there are, and where all are listed.

    Raises
    ------
    InputError
        In place of `SceneFileError`.
    """
    from diffopt.scenes.tables import SceneFileError

    try:
        yield
    except SceneFileError as error:
        more = len(error.faults) - 1
        rest = f" (and {more} more: diffopt scene check {file})" if more else ""
        raise InputError(error.lines[0] + rest) from None


def _tell(found: "SceneFile", seen: "list[Finding]") -> None:
    from rich.table import Table

    from diffopt.cli.progress import terminal

    console = terminal()
    scene, camera = found.scene, found.camera
    channels = scene.channels.wavelengths
    words = "linear RGB"
    if channels is not None:
        low, high = 1000.0 * channels[0], 1000.0 * channels[-1]
        words = f"{len(channels)} wavelengths from {low:g} to {high:g} nm"
    summary = Table.grid(padding=(0, 2))
    summary.add_row("scene", f"{found.path}, {words}")
    columns, rows = camera.resolution
    place = ", ".join(f"{x:g}" for x in camera.eye)
    summary.add_row("camera", f"at {place}, {columns} x {rows} pixels, {camera.field_of_view:g}°")
    if found.options:
        options = ", ".join(f"{key} {value}" for key, value in found.options.items())
        summary.add_row("render", options)
    console.print(summary, markup=False)
    _print(("object", "shape", "faces", "material", "emits"), _objects(scene))
    _print(("light", "strength"), _lights(scene))
    for note in found.notes:
        console.print(f"note: {note}", markup=False)
    if not seen:
        console.print("nothing to object to")
    for finding in seen:
        line = f"{finding.severity}: {finding.place}: {finding.text}"
        console.print(line, style=_STYLES[finding.severity], markup=False, soft_wrap=True)


def _print(titles: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    from rich.table import Table
    from rich.text import Text

    from diffopt.cli.progress import terminal

    if not rows:
        return
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in titles:
        table.add_column(title, justify="right" if title == "faces" else "left")
    for row in rows:
        table.add_row(*(Text(word) for word in row))
    console = terminal()
    console.print()
    console.print(table)
    console.print()


def _objects(scene: "Scene") -> list[tuple[str, ...]]:
    from diffopt.scenes.shapes import Triangles
    from diffopt.scenes.textures import Textured

    rows = []
    for k, one in enumerate(scene.objects):
        patch, material = one.patch, one.material
        faces = f"{len(patch.faces)}" if isinstance(patch, Triangles) else ""
        textured = isinstance(material, Textured)
        kind = type(material.material if textured else material).__name__
        kind += ", texture" if textured else ""
        emits = "" if one.emission is None else _numbers(one.emission)
        rows.append((one.name or f"{k + 1}", type(one.place.shape).__name__, faces, kind, emits))
    return rows


def _lights(scene: "Scene") -> list[tuple[str, ...]]:
    rows = []
    for light in scene.lights:
        for name in ("radiance", "irradiance", "intensity"):
            if hasattr(light, name):
                rows.append((type(light).__name__, f"{name} {_numbers(getattr(light, name))}"))
                break
        else:
            rows.append((type(light).__name__, ""))
    return rows


def _numbers(values: object) -> str:
    """A few numbers, or the size of a map with its mean."""
    import numpy as np

    array = np.asarray(values)
    if array.ndim > 1:
        return f"{array.shape[1]} x {array.shape[0]}, mean {array.mean():.3g}"
    if array.size > 4:
        return f"{array.min():.3g} to {array.max():.3g}"
    return ", ".join(f"{value:.3g}" for value in np.atleast_1d(array))


def opened(name: str) -> "SceneFile":
    """A scene file, or an example by its name."""
    import tempfile

    from diffopt.scenes import examples, load_scene

    path = Path(name)
    if name in examples.EXAMPLES and not path.exists():
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"{name}.toml"
            path.write_text(examples.text(name), encoding="utf-8")
            return load_scene(path)
    if not path.suffix and not path.exists():
        names = ", ".join(examples.EXAMPLES)
        raise InputError(f"{name}: no such file, and not the name of an example ({names})")
    with one_line(path):
        return load_scene(path)
