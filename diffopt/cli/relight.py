"""``diffopt relight``: pictures of precomputed transfer under any light from infinity."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from diffopt.errors import InputError

if TYPE_CHECKING:
    from diffopt.cli.relight_output import Session
    from diffopt.scenes import Scene, SceneFile
    from diffopt.transfer.result import Transfer

#: Exit code of an animation that was interrupted.
INTERRUPTED = 130
_MOST_FRAMES, _MOST_SAMPLES = 999, 2**24
# Lobes fitted to a map, and rows of the map that they are fitted to.
_LOBES, _ROWS = 16, 64


def command(
    stored: Annotated[
        Path, typer.Argument(metavar="STORE.zarr", help="Made by diffopt precompute.")
    ],
    scene: Annotated[
        str,
        typer.Argument(
            metavar="SCENE", help="The same scene: camera and lights; .toml or an example's name."
        ),
    ],
    output: Annotated[
        Path,
        typer.Option("-o", "--output", metavar="OUT", help="Folder, or .png for a picture alone."),
    ],
    environment: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Map in place of all lights: exr, hdr, png, npy."),
    ] = None,
    method: Annotated[
        str, typer.Option(help="How light is averaged: pyramid, lobes, harmonics.")
    ] = "pyramid",
    turn: Annotated[
        float, typer.Option(metavar="DEG", help="Of the lights, about the up axis.")
    ] = 0.0,
    frames: Annotated[int, typer.Option(help="Of a loop in which the lights turn round.")] = 1,
    orbit: Annotated[
        bool, typer.Option("--orbit", help="In the loop the camera goes round instead.")
    ] = False,
    exposure: Annotated[
        float, typer.Option(metavar="STOPS", help="Brighter by powers of two.")
    ] = 0.0,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Pixels, in place of the camera's.")
    ] = None,
    samples: Annotated[int, typer.Option(help="On a side of each pixel.")] = 2,
    per_vertex: Annotated[
        bool, typer.Option("--per-vertex", help="Light vertices instead of pixels: coarser.")
    ] = False,
    layers: Annotated[
        bool, typer.Option("--layers", help="Also pictures by kind of path; they add up.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Also a path-traced picture beside ours, and numbers.")
    ] = False,
    spp: Annotated[int, typer.Option(help="Paths a pixel for --check.")] = 128,
    mesh: Annotated[bool, typer.Option("--mesh", help="Also the refined mesh.")] = False,
    levels: Annotated[bool, typer.Option("--levels", help="Also views of vertices.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")] = False,
) -> None:
    """Pictures by precomputed transfer, and how many of them a second; Ctrl-C keeps frames."""
    from diffopt.cli import relight_output
    from diffopt.cli.errors import user_input
    from diffopt.cli.render import pixels
    from diffopt.cli.scene import opened

    _numbers({"--turn": turn, "--exposure": exposure})
    _whole("--frames", frames, 1, _MOST_FRAMES)
    _whole("--samples", samples, 1, 8)
    _whole("--spp", spp, 2, 2**16)
    resolution = pixels(size)
    extras = {"--layers": layers, "--check": check, "--mesh": mesh, "--levels": levels}
    alone = output.suffix.lower() == ".png" and not output.is_dir()
    _output(output, alone, extras | {"--frames": frames > 1})
    with user_input():
        from diffopt import checks
        from diffopt.transfer import lighting, store

        checks.choice("--method", method, lighting.METHODS)
        transfer = store.load(stored)
        found = opened(scene)
        camera = found.camera
        if resolution is not None:
            camera = dataclasses.replace(camera, resolution=resolution)
        count = camera.resolution[0] * camera.resolution[1] * samples**2
        if count > _MOST_SAMPLES:
            raise InputError(f"{count} samples in a picture; at most {_MOST_SAMPLES}: --size")
        lit, notes = _lit(found, environment, method)
        belongs(stored, transfer, lit)
    settings = relight_output.Settings(
        method=method,
        turn=turn,
        frames=frames,
        orbit=orbit,
        stops=exposure,
        samples=samples,
        per_pixel=not per_vertex,
        layers=layers,
        spp=spp if check else None,
        mesh=mesh,
        levels=levels,
        quiet=quiet,
    )
    session = relight_output.Session(transfer, lit, camera, settings, Path(scene).stem)
    if alone:
        session.save(output)
    else:
        _fill(output, session)
    if not quiet:
        session.tell(output, [*found.notes, *notes])
    if session.interrupted:
        raise typer.Exit(INTERRUPTED)


def _fill(output: Path, session: "Session") -> None:
    from diffopt.cli.output import folder

    with folder(output) as staging:
        session.shoot(staging)
        session.write(staging)


def _numbers(words: dict[str, float]) -> None:
    for name, value in words.items():
        if not math.isfinite(value):
            raise InputError(f"{name} must be a finite number; received {value}")


def _whole(name: str, value: int, least: int, most: int) -> None:
    if not least <= value <= most:
        raise InputError(f"{name} must lie between {least} and {most}; received {value}")


def _output(output: Path, alone: bool, extras: dict[str, bool]) -> None:
    """Refuse what cannot be written before anything is computed."""
    if not alone:
        if output.suffix and not output.is_dir():
            raise InputError(f"-o {output}: expected a folder, or a .png")
        return
    if not output.parent.is_dir():
        raise InputError(f"-o {output}: the folder {output.parent} does not exist")
    asked = [name for name, wanted in extras.items() if wanted]
    if asked:
        raise InputError(f"-o {output}: is one picture; {', '.join(asked)} need a folder")


def _lit(
    found: "SceneFile", environment: Path | None, method: str
) -> tuple["Scene", tuple[str, ...]]:
    """The scene without what emits light, under light from infinity; what was changed."""
    from diffopt.scenes import Scene
    from diffopt.transfer import infinity

    lam = found.scene.channels.wavelengths
    if environment is None:
        distant = infinity.from_infinity(found.scene)
        body, notes = distant.scene, list(distant.notes)
        if not body.lights:
            raise InputError(f"{found.path}: no light; --environment FILE brings some")
    else:
        from diffopt.io import environments
        from diffopt.scenes import Environment

        image, said = environments.checked(environment, environments.read(environment))
        dark = [one for one in found.scene.objects if one.emission is None]
        body = Scene(dark, [Environment(image.astype("float32"))], wavelengths=lam)
        notes = [f"{environment}: {text}" for text in said]
        notes.append(f"{environment} in place of all lights of the scene")
    if method == "lobes":
        lights = [_lobes(one, notes) for one in body.lights]
        body = Scene(body.objects, lights, wavelengths=lam)
    return body, tuple(notes)


def _lobes(light: Any, notes: list[str]) -> Any:
    """A map as lobes; other lights as they are."""
    import jax.numpy as jnp
    import numpy as np

    from diffopt.fitting import fit_environment
    from diffopt.lobes import Lobes
    from diffopt.scenes import Environment, LobeEnvironment

    if not isinstance(light, Environment) or not light.is_map:
        return light
    image = np.asarray(light.radiance, np.float32) * np.float32(light.scale)
    rows, columns = image.shape[:2]
    step = max(rows // _ROWS, 1)
    if step > 1:
        # Means over blocks; rows and columns that are too many for them are left out.
        image = image[: rows // step * step, : columns // step * step]
        shape = (rows // step, step, columns // step, step, *image.shape[2:])
        image = image.reshape(shape).mean((1, 3))
    found = fit_environment(image, _LOBES)
    alpha, mu, kappa = found.lobes.arrays
    world = jnp.matmul(mu, jnp.asarray(light.axes, mu.dtype), precision="highest")
    notes.append(
        f"{_LOBES} lobes were fitted to the map (error {100.0 * float(found.error):.2g} %); "
        "they are the light, and are seen behind the scene"
    )
    return LobeEnvironment(Lobes(jnp.maximum(alpha, 0.0), world, kappa))


def belongs(stored: Path, transfer: "Transfer", body: "Scene") -> None:
    """Refuse a scene that the transfer is not of."""
    from diffopt.transfer import store, working

    own = working.identity(body, transfer.settings)
    there = store.record_of(stored).get("identity") or {}
    wrong = [name for name in ("shapes", "materials") if there.get(name, own[name]) != own[name]]
    if wrong:
        raise InputError(
            f"{stored}: computed for other {' and '.join(wrong)} than the scene has now; "
            "precompute it again"
        )
