"""Scenes to TOML; see `diffopt.scenes.files` for the format."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.errors import InputError
from diffopt.io.files import replacing
from diffopt.materials.base import Material
from diffopt.scenes import light_tables, material_words, meshfiles, shapes
from diffopt.scenes.camera import Camera
from diffopt.scenes.material_words import plain
from diffopt.scenes.origins import origin
from diffopt.scenes.scene import Object, Scene
from diffopt.scenes.textures import Texture, Textured

# Lists of numbers, which the library writes in a column.
_NUMBERS = re.compile(r"\[\n((?:\s+[-+.\deE]+,\n)+)\s*\]")


def save(scene: Scene, camera: Camera, path: Path, options: dict[str, Any]) -> None:
    """Write a scene; see `diffopt.scenes.files.save_scene`."""
    import tomli_w

    path = Path(os.path.abspath(path))
    if path.suffix.lower() != ".toml":
        raise InputError(f"{path}: scenes are written to .toml")
    content: dict[str, Any] = {}
    if scene.channels.wavelengths is not None:
        content["scene"] = {"wavelengths": list(scene.channels.wavelengths)}
    content["camera"] = {
        "eye": list(camera.eye),
        "target": list(camera.target),
        "up": list(camera.up),
        "resolution": list(camera.resolution),
        "field_of_view": float(camera.field_of_view),
    }
    names, tables = _materials(scene)
    if tables:
        content["materials"] = tables
    content["objects"] = [_object(one, k, names) for k, one in enumerate(scene.objects)]
    content["lights"] = []
    for k, light in enumerate(scene.lights):
        try:
            content["lights"].append(light_tables.described(light))
        except InputError as error:
            raise InputError(f"light {k} ({type(light).__name__}): {error}") from None
    if options:
        content["render"] = options
    text = _NUMBERS.sub(_in_a_row, tomli_w.dumps(_relative(content, path.parent)))
    with replacing(path) as file:
        file.write(text.encode())


def _in_a_row(found: re.Match[str]) -> str:
    return f"[{', '.join(found[1].replace(',', ' ').split())}]"


def _materials(scene: Scene) -> tuple[list[str], dict[str, Any]]:
    """The name of each object's material, and the tables of different ones."""
    names: list[str] = []
    tables: dict[str, Any] = {}
    seen: list[tuple[dict[str, Any], str]] = []
    for k, one in enumerate(scene.objects):
        try:
            table = material_words.described(_inner(one))
        except InputError as error:
            raise InputError(f"object {one.name or k}: {error}") from None
        name = next((known for other, known in seen if other == table), None)
        if name is None:
            stem = str(table.get("kind", Path(str(table.get("file"))).stem))
            name, count = stem, 1
            while name in tables:
                count += 1
                name = f"{stem}-{count}"
            tables[name] = table
            seen.append((table, name))
        names.append(name)
    return names, tables


def _inner(one: Object) -> Material:
    return one.material.material if isinstance(one.material, Textured) else one.material


def _object(one: Object, number: int, names: list[str]) -> dict[str, Any]:
    found: dict[str, Any] = {"name": one.name} if one.name else {}
    try:
        found |= _shape(one.place.shape)
        found["material"] = names[number]
        if isinstance(one.material, Textured):
            found["texture"] = _texture(one.material)
    except InputError as error:
        raise InputError(f"object {one.name or number}: {error}") from None
    matrix = np.reshape(one.place.matrix, (4, 4))
    if np.array_equal(matrix[:3, :3], np.eye(3)):
        if matrix[:3, 3].any():
            found["translate"] = matrix[:3, 3].tolist()
    else:
        found["matrix"] = matrix.tolist()
    if one.place.tangent is not None:
        found["tangent"] = list(one.place.tangent)
    if one.emission is not None:
        found["emission"] = plain(one.emission)
    return found


def _shape(shape: shapes.Shape) -> dict[str, Any]:
    if isinstance(shape, shapes.Sphere | shapes.Disc):
        return {"shape": type(shape).__name__.lower(), "radius": float(shape.radius)}
    if isinstance(shape, shapes.Plane):
        sides = {"width": float(shape.width), "height": float(shape.height)}
        return {"shape": "plane", **sides}
    if isinstance(shape, shapes.Box):
        return {"shape": "box", "size": list(shape.size)}
    known = origin(shape)
    if known is None:
        raise InputError(
            "its mesh was not read from a file, which scene files refer to, nor made by "
            "diffopt.scenes.models: write the mesh and take diffopt.scenes.load_mesh(path)"
        )
    if known.get("crease") == meshfiles.CREASE_DEG:
        del known["crease"]
    # A model brings the name of its own shape.
    return {"shape": "mesh", **known}


def _texture(material: Textured) -> dict[str, Any]:
    others = sorted(set(material.maps) - {"colour"})
    values = material.maps.get("colour")
    if others or not isinstance(values, Texture):
        what = others[0] if others else "values for each face"
        raise InputError(f"{what}: textures of scene files are pictures of the colour")
    known = origin(values.pixels)
    if known is None:
        raise InputError(
            "its texture was not read from a file, which scene files refer to: write the picture "
            "and take diffopt.scenes.load_texture(path)"
        )
    repeat = [float(value) for value in values.repeat]
    found = {"checks": known["checks"]} if "checks" in known else {"colour": known["file"]}
    if known.get("space", "srgb") != "srgb":
        found["space"] = known["space"]
    return {**found, **({} if repeat == [1.0, 1.0] else {"repeat": repeat})}


def _relative(content: Any, folder: Path, key: str = "") -> Any:
    """The tables with paths as seen from the folder."""
    if isinstance(content, dict):
        return {name: _relative(value, folder, name) for name, value in content.items()}
    if isinstance(content, list):
        return [_relative(value, folder) for value in content]
    if isinstance(content, str) and key in ("file", "scan", "colour") and os.path.isabs(content):
        return Path(os.path.relpath(content, folder)).as_posix()
    return content
