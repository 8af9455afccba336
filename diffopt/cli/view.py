"""``diffopt view``: scenes and surfaces in a browser, changed while looking."""

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.viewer.subject import Subject

_DEFAULT = "sample:compact_disc"


def command(
    what: Annotated[
        str,
        typer.Argument(
            metavar="[SCENE|FILE]",
            help="Scene file or example (also with --transfer), heights of a surface or "
            "sample:NAME, an animation (creature, egg, sheet), or a mesh, which then bends.",
        ),
    ] = _DEFAULT,
    transfer: Annotated[
        Path | None,
        typer.Option(metavar="STORE.zarr", help="Of diffopt precompute: the scene is relit by it."),
    ] = None,
    mesh: Annotated[
        str | None, typer.Option(metavar="FILE", help="Mesh to lay the heights on.")
    ] = None,
    up: Annotated[
        str | None,
        typer.Option(help="Axis of a mesh that is upwards: x, y, z. [default: z; --mesh: y]"),
    ] = None,
    coherence: Annotated[
        float | None, typer.Option(metavar="UM", help="Of light on heights, at first.")
    ] = None,
    material: Annotated[
        str, typer.Option(help="Of heights: mirror, al, ag, au, cu, or an index such as 1.5.")
    ] = "al",
    pixel_size: Annotated[
        str | None, typer.Option(metavar="UM", help="Of heights in a file that does not say it.")
    ] = None,
    height_range: Annotated[
        str | None, typer.Option(metavar="UM", help="Of heights in an image: black to white.")
    ] = None,
    fill: Annotated[bool, typer.Option("--fill", help="Fill missing pixels of heights.")] = False,
    host: Annotated[
        str, typer.Option(help="Address to listen on; others than this machine only if asked.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="0: any that is free.")] = 8080,
    browser: Annotated[
        bool, typer.Option("--open/--no-open", help="Open the page in a browser.")
    ] = True,
) -> None:
    """Look at a scene in the browser: turn it, light it, change materials; Ctrl-C ends."""
    from diffopt.cli.errors import user_input
    from diffopt.viewer import server

    with user_input():
        server.require()
        heights = {
            "--mesh": mesh,
            "--coherence": coherence,
            "--pixel-size": pixel_size,
            "--height-range": height_range,
        }
        kind = _kind(what)
        given = [name for name, value in heights.items() if value is not None]
        if given and kind != "heights":
            raise InputError(f"{what}: {', '.join(given)} are for heights")
        if transfer is not None and kind != "scene":
            raise InputError(f"{what}: --transfer is for a scene file or the name of an example")
        if kind == "scene":
            subject = _scene(what, transfer)
        elif kind == "heights":
            source = {"pixel_size": pixel_size, "height_range": height_range, "fill": fill}
            subject = _heights(what, source, coherence, material, mesh, _axis(up, "y"))
        else:
            subject = _shadow(what, kind, up)
        found = server.Server(subject, host, port)
    print(f"{subject.title}\n{found.url}  (Ctrl-C ends)", flush=True)
    if not server.is_loopback(host):
        print(f"note: anybody who reaches {host} can look at it and change what is shown")
    if browser:
        import webbrowser

        webbrowser.open(found.url)
    try:
        found.wait()
    except KeyboardInterrupt:
        print("stopped")
    if not found.close():
        # A compiler at work cannot be interrupted, and there is nothing to lose.
        sys.stdout.flush()
        os._exit(0)


def _kind(what: str) -> str:
    """What a word or a file is: scene, heights, animation or mesh."""
    from diffopt.cli.options import SAMPLE
    from diffopt.scenes import examples, meshfiles
    from diffopt.shadows import animations

    path = Path(what)
    if what.startswith(SAMPLE):
        return "heights"
    if not path.exists():
        if what in animations.NAMES:
            return "animation"
        if what in examples.EXAMPLES:
            return "scene"
    suffix = path.suffix.lower().removeprefix(".")
    if suffix == "toml":
        return "scene"
    if suffix == "zarr":
        raise InputError(
            f"{what}: expected the scene first, then its store: diffopt view SCENE --transfer "
            f"{what}"
        )
    if suffix in meshfiles.FORMATS:
        return "mesh"
    if not path.suffix and not path.exists():
        names = ", ".join((*examples.EXAMPLES, *animations.NAMES))
        raise InputError(f"{what}: no such file, and not the name of a scene ({names})")
    return "heights"


def _scene(what: str, stored: Path | None) -> "Subject":
    from diffopt.cli.scene import opened

    found = opened(what)
    name = Path(what).stem
    if stored is None:
        from diffopt.viewer.scenery import Scenery

        return Scenery(found.scene, found.camera, name)
    from diffopt.cli.relight import belongs
    from diffopt.transfer import infinity, store
    from diffopt.viewer.glossy import Glossy

    transfer = store.load(stored)
    body = infinity.from_infinity(found.scene).scene
    belongs(stored, transfer, body)
    if not body.lights:
        raise InputError(f"{what}: no light; expected one at least")
    return Glossy(transfer, body, found.camera, name)


def _heights(
    what: str,
    source: dict[str, Any],
    coherence: float | None,
    material: str,
    mesh: str | None,
    up: tuple[float, float, float],
) -> "Subject":
    from diffopt.cli import options
    from diffopt.scenes import meshfiles
    from diffopt.viewer.diffracting import Diffracting

    scan = options.load(options.Source(what, **source))
    body = None if mesh is None else meshfiles.load(mesh)
    return Diffracting(
        scan,
        coherence=coherence,
        material=material,
        mesh=body,
        up=up if mesh is not None else (0.0, 0.0, 1.0),
        name=options.name(what),
    )


def _shadow(what: str, kind: str, up: str | None) -> "Subject":
    from diffopt.scenes import meshfiles
    from diffopt.shadows import animations
    from diffopt.viewer.shadowed import Shadowed

    if kind == "animation":
        return Shadowed(animations.animation(what))
    mesh = meshfiles.load(what)
    name = Path(what).stem
    return Shadowed(animations.of_mesh(mesh.vertices, mesh.faces, name, up or "z"))


def _axis(word: str | None, default: str) -> tuple[float, float, float]:
    from diffopt import checks

    axes = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
    return axes[checks.choice("--up", word or default, tuple(axes))]
