"""Scenes as files: TOML tables of the same objects as in Python.

::

    [scene]                       # left out: linear RGB
    wavelengths = { from = 0.4, to = 0.7, step = 0.02 }   # micrometres, or a list

    [camera]
    eye = [0, -6, 2]              # also target, up
    target = [0, 0, 1]
    resolution = [320, 240]       # columns, rows
    field_of_view = 40            # degrees, across the shorter side

    [materials.brass]
    kind = "gold"                 # a name of `diffopt material`, with its options
    alpha = 0.15                  # (sigma of oren-nayar in degrees)
    [materials.felt]
    file = "felt.binary"          # measured: .binary .bsdf .pbsdf .csv .npz
    [materials.paint]
    kind = "sum"                  # also "scaled": material, factor
    parts = ["felt", { kind = "phong", colour = 0.2 }]
    [materials.track]
    kind = "diffraction"          # scan: "sample:NAME" or a file of heights
    scan = "sample:compact_disc"  # also coherence (micrometres), reflectance, tolerance

    [[objects]]
    name = "ball"
    shape = "sphere"              # disc: radius; plane: width, height; box: size; mesh: file
    radius = 0.5                  # also teapot, torus, knot, rabbit, with the parameters of
                                  # `diffopt.scenes.models`
    material = "brass"            # of [materials], a name as "glass", or a table
    translate = [0, 0, 0.5]       # also scale, rotate = [[x, y, z, degrees], ...], facing =
                                  # {origin, target, up}; or matrix = four rows
    # tangent = [1, 0, 0]; emission = 3 or [r, g, b]; texture = {colour = "wood.png",
    # repeat = [2, 2], space = "srgb"} or {checks = [0.8, 0.2], repeat = [4, 4]}

    [[lights]]
    kind = "area"                 # ambient directional point flood area environment lobes
    radiance = 8                  # fields as in `diffopt.scenes.lights`; maps: file
    temperature = 3200            # kelvin, or illuminant = "A": their colour against D65,
    width = 1                     # at the luminance of the number
    facing = { origin = [0, 0, 4], target = [0, 0, 0], up = [0, 1, 0] }

    [render]                      # defaults of `diffopt render`
    level = "path"
    spp = 64

Objects are scaled first, then turned in the order given, then moved. Paths are relative to
the file. Quantities of light are numbers, RGB, or a number for each channel of the scene.
"""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.errors import InputError
from diffopt.io import limits
from diffopt.io.files import existing_file
from diffopt.scenes import reading, writing
from diffopt.scenes.camera import Camera
from diffopt.scenes.channels import Channels
from diffopt.scenes.light_tables import lights
from diffopt.scenes.material_tables import Materials
from diffopt.scenes.scene import Scene
from diffopt.scenes.tables import SceneFileError, Source, Table, shown

#: Tables of a file.
TABLES = ("scene", "camera", "materials", "objects", "lights", "render")
# Most wavelengths of a scene.
_MOST = 1000


@dataclasses.dataclass(frozen=True)
class SceneFile:
    """What a file holds.

    Attributes
    ----------
    path
        The file.
    scene, camera
        As from Python.
    options
        Of ``[render]``: the level, its settings, and perhaps the exposure.
    notes
        What was assumed, and which files outside of the scene's folder were read, one sentence
        each.
    """

    path: Path
    scene: Scene
    camera: Camera
    options: dict[str, Any]
    notes: tuple[str, ...]


def load_scene(path: str | os.PathLike) -> SceneFile:
    """Read a scene.

    Parameters
    ----------
    path
        A TOML file, see `diffopt.scenes.files`.

    Raises
    ------
    SceneFileError
        An `InputError` with everything that is wrong in the file, one line each: file, line,
        table and key, what was received and what was expected.
    InputError
        If there is no such file, or it is not text.
    """
    path = existing_file(path)
    try:
        text = limits.text(path, limits.MOST_SCENE).decode("utf-8").replace("\r\n", "\n")
    except (UnicodeDecodeError, OSError) as error:
        raise InputError(f"{path}: expected text in UTF-8 ({error})") from error
    source = Source(path, text)
    top = Table(source, (), source.content)
    channels = _channels(top.table("scene"))
    camera = reading.camera(top.table("camera"))
    top.raw("materials")
    materials = Materials(source, channels)
    materials.all()
    tables = top.tables("objects")
    found = reading.objects(tables, materials, channels, reading.Meshes())
    lamps, surfaces, notes = lights(top.tables("lights"), channels, reading.placement)
    options = _options(top.table("render"))
    top.done(*TABLES)
    if "camera" not in top:
        notes.append(f"no [camera]: it stands at {list(Camera().eye)} and looks at the origin")
    scene = None
    with source.at(("lights",)):
        scene = Scene([*found, *surfaces], lamps, wavelengths=channels.wavelengths)
    if source.faults or scene is None or camera is None:
        raise SceneFileError(path, source.faults)
    said = tuple(dict.fromkeys([*source.outside, *notes, *materials.notes]))
    return SceneFile(path, scene, camera, options, said)


def save_scene(
    scene: Scene,
    camera: Camera,
    path: str | os.PathLike,
    *,
    options: dict[str, Any] | None = None,
) -> None:
    """Write a scene, aside first and then renamed.

    Parameters
    ----------
    scene, camera
        What is written. Meshes, textures, maps and measured materials are referred to by
        their files: they must come from `load_mesh` (or `models`), `load_texture`,
        `load_environment`, `load_lobes` and `load_material`, or from a scene file.
    path
        ``.toml``.
    options
        Of ``[render]``: ``level`` and its settings.

    Raises
    ------
    InputError
        If the scene holds what files cannot; names the object. If the folder is missing.
    """
    writing.save(scene, camera, Path(path), options or {})


def _channels(table: Table | None) -> Channels:
    """Of ``[scene]``; linear RGB where nothing usable is said."""
    if table is None:
        return Channels()
    value = table.raw("wavelengths")
    wavelengths = None
    if isinstance(value, dict):
        span = Table(table.source, (*table.where, "wavelengths"), value)
        ends = [span.number(name) for name in ("from", "to", "step")]
        low, high, step = ends
        if low is None or high is None or step is None:
            if span.done():
                span.source.say(span.where, "needs from, to and step, in micrometres")
        elif span.done():
            count = round((high - low) / step) + 1 if step > 0.0 else 0
            if not 2 <= count <= _MOST or abs(low + (count - 1) * step - high) > 1e-6:
                span.source.say(
                    span.where,
                    f"expected a step that divides the range, 2 to {_MOST} wavelengths; received "
                    f"{shown(value)}",
                )
            else:
                wavelengths = np.round(np.linspace(low, high, count), 9).tolist()
    elif value is not None:
        wavelengths = table.numbers("wavelengths", *range(2, _MOST + 1))
    table.done()
    with table.source.at(table.where, ("wavelengths",)):
        return Channels(wavelengths)
    return Channels()


def _options(table: Table | None) -> dict[str, Any]:
    """Of ``[render]``, checked as the level checks them."""
    if table is None:
        return {}
    from diffopt.rendering.synthesis import LEVELS, chosen_settings

    level = table.choice("level", tuple(LEVELS), "path")
    exposure = table.number("exposure")
    if exposure is not None and exposure <= 0.0:
        table.say("exposure", f"expected a factor above 0; received {exposure:g}")
    fields = dataclasses.fields(LEVELS[level or "path"])
    given: dict[str, Any] = {}
    for field in fields:
        value = table.raw(field.name)
        if value is None:
            continue
        kind = type(field.default)
        fits = isinstance(value, str) if kind is type(None) else isinstance(value, kind)
        if kind is float:
            fits = isinstance(value, int | float)
        if not fits or (isinstance(value, bool) and kind is not bool):
            words = {bool: "true or false", int: "a whole number", float: "a number"}
            expected = words.get(kind, "a string")
            table.say(field.name, f"expected {expected}; received {shown(value)}")
            continue
        given[field.name] = value
    if table.done() and level is not None:
        with table.source.at(table.where, tuple(given)):
            chosen_settings(level, None, given)
    more = {} if exposure is None else {"exposure": exposure}
    return {"level": level, **given, **more}
