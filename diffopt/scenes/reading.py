"""Objects, places and cameras of a scene file, from its tables."""

import os
from typing import Any

import numpy as np

from diffopt.errors import InputError
from diffopt.scenes import meshfiles, models, shapes, transforms
from diffopt.scenes.assets import SPACES, checkerboard, load_texture
from diffopt.scenes.camera import Camera
from diffopt.scenes.channels import Channels
from diffopt.scenes.light_tables import scaled
from diffopt.scenes.material_tables import Materials
from diffopt.scenes.scene import Object, Scene
from diffopt.scenes.tables import Table, is_number, shown
from diffopt.scenes.textures import Textured

#: Shapes, and the keys that each of them has.
SHAPES: dict[str, tuple[str, ...]] = {
    "sphere": ("radius",),
    "disc": ("radius",),
    "plane": ("width", "height"),
    "box": ("size",),
    "mesh": ("file", "crease"),
    **{name: tuple(keys) for name, keys in models.PARAMETERS.items()},
}
#: Keys that place an object.
PLACE = ("translate", "rotate", "scale", "facing", "matrix")

_MAKERS = {
    "sphere": shapes.Sphere,
    "disc": shapes.Disc,
    "plane": shapes.Plane,
    "box": shapes.Box,
}


class Meshes:
    """Mesh files and models, each read or made once."""

    def __init__(self) -> None:
        self._read: dict[Any, meshfiles.Mesh] = {}

    def load(self, path: Any, crease: float) -> meshfiles.Mesh:
        """The mesh of a file."""
        key = os.path.abspath(path), crease
        if key not in self._read:
            self._read[key] = meshfiles.load(path, crease_deg=crease)
        return self._read[key]

    def model(self, name: str, given: dict[str, Any]) -> meshfiles.Mesh:
        """A mesh made by code."""
        key = name, *sorted(given.items())
        if key not in self._read:
            self._read[key] = models.MODELS[name](**given)
        return self._read[key]


def objects(
    tables: list[Table], materials: Materials, channels: Channels, meshes: Meshes
) -> list[Object]:
    """The objects of ``[[objects]]`` whose tables are sound."""
    found = []
    for table in tables:
        one = _object(table, materials, channels, meshes)
        if one is not None:
            found.append(one)
    return found


def camera(table: Table | None) -> Camera | None:
    """The camera of ``[camera]``; None for a faulty one."""
    if table is None:
        return Camera()
    given: dict[str, Any] = {name: table.numbers(name, 3) for name in ("eye", "target", "up")}
    given["field_of_view"] = table.number("field_of_view")
    size = table.numbers("resolution", 2)
    if size is not None and all(value.is_integer() for value in size):
        given["resolution"] = tuple(int(value) for value in size)
    elif size is not None:
        table.say("resolution", f"expected whole numbers; received {shown(size)}")
    table.done()
    arguments: dict[str, Any] = {
        k: tuple(v) if isinstance(v, list) else v for k, v in given.items()
    }
    with table.source.at(table.where, tuple(given)):
        made = Camera(**{k: v for k, v in arguments.items() if v is not None})
        return made if table.sound else None
    return None


def placement(table: Table) -> transforms.Matrix | None:
    """The matrix of an object: scaled first, then turned, then moved; None if it is faulty."""
    begun = len(table.source.faults)
    parts = [name for name in PLACE if name in table]
    if "matrix" in parts and len(parts) > 1:
        other = next(name for name in parts if name != "matrix")
        table.say("matrix", f"a matrix stands alone; received {other} as well")
    if "facing" in parts and "translate" in parts:
        table.say("facing", "facing says where the object is (origin); received translate as well")
    move, value = table.numbers("translate", 3), table.raw("scale")
    factors = table.number("scale") if is_number(value) else table.numbers("scale", 3)
    matrix = table.raw("matrix")
    turns = _turns(table)
    facing = table.table("facing")
    result = np.eye(4)
    if matrix is not None:
        rows = isinstance(matrix, list) and all(isinstance(row, list) for row in matrix)
        sound = rows and len(matrix) == 4 and all(len(row) == 4 for row in matrix)
        if not sound or not all(is_number(v) for row in matrix for v in row):
            table.say("matrix", f"expected four rows of four numbers; received {shown(matrix)}")
        else:
            result = np.asarray(matrix, np.float64)
    with table.source.at(table.where, PLACE):
        if factors is not None:
            each = factors if isinstance(factors, list) else (factors,) * 3
            result = transforms.scale(*each) @ result
        for axis, degrees in turns:
            result = transforms.rotate(axis, degrees) @ result
        if move is not None:
            result = transforms.translate(*move) @ result
    if facing is not None:
        given = {name: facing.numbers(name, 3) for name in ("origin", "target", "up")}
        missing = [name for name in ("origin", "target") if name not in facing]
        if missing:
            facing.source.say(facing.where, f"facing needs {' and '.join(missing)}")
        if facing.done() and not missing:
            with table.source.at(facing.where, ("origin", "target", "up")):
                up = given.pop("up") or (0.0, 0.0, 1.0)
                result = transforms.facing(**given, up=up) @ result
    with table.source.at(table.where, PLACE):
        result = transforms.checked(result)
    return result if len(table.source.faults) == begun else None


def _turns(table: Table) -> list[tuple[list[float], float]]:
    """Axes and degrees of ``rotate``, in their order."""
    value = table.raw("rotate")
    if value is None:
        return []
    if isinstance(value, dict):
        inner = Table(table.source, (*table.where, "rotate"), value)
        axis, degrees = inner.numbers("axis", 3), inner.number("degrees")
        if inner.done() and axis is not None and degrees is not None:
            return [(axis, degrees)]
        if inner.sound:
            table.say("rotate", f"needs axis and degrees; received {shown(value)}")
        return []
    rows = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
    found = []
    for row in rows:
        if isinstance(row, list) and len(row) == 4 and all(map(is_number, row)):
            found.append(([float(value) for value in row[:3]], float(row[3])))
        else:
            table.say(
                "rotate",
                "expected [[x, y, z, degrees], ...] or {axis = [x, y, z], degrees = n}; received "
                f"{shown(row)}",
            )
    return found


def _object(
    table: Table, materials: Materials, channels: Channels, meshes: Meshes
) -> Object | None:
    source = table.source
    name = table.text("name") or ""
    kind = table.choice("shape", tuple(SHAPES))
    shape = None if kind is None else _shape(table, kind, meshes)
    material = None
    if "material" in table:
        material = materials.of(table.raw("material"), (*table.where, "material"))
    else:
        source.say(table.where, "needs a material")
    matrix = placement(table)
    tangent = table.numbers("tangent", 3)
    emission = None
    if "emission" in table or "illuminant" in table or "temperature" in table:
        emission = scaled(table, "emission", channels, None)
    texture = table.table("texture")
    covered = material
    if texture is not None:
        covered = _textured(texture, material)
    own = tuple(key for keys in SHAPES.values() for key in keys)
    table.done(*(key for key in own if kind is None))
    if not table.sound or shape is None or covered is None:
        return None
    keys = (*own, *PLACE, "material", "emission", "tangent")
    with source.at(table.where, keys):
        one = Object(shape, covered, matrix, emission=emission, tangent=tangent, name=name)
        try:
            Scene([one], wavelengths=channels.wavelengths)
        except InputError as error:
            text = str(error).partition(": ")[2]
            raise InputError(f"material: {text}") from None
        return one
    return None


def _shape(table: Table, kind: str, meshes: Meshes) -> Any:
    """The shape of an object; None for a faulty one."""
    begun = len(table.source.faults)
    others = {key for keys in SHAPES.values() for key in keys} - set(SHAPES[kind])
    for key in sorted(others & set(table.content)):
        table.raw(key)
        table.say(key, f"a {kind} has no {key}; it has {', '.join(SHAPES[kind])}")
    if kind == "mesh":
        if "file" not in table:
            table.source.say(table.where, "a mesh needs file")
        path, crease = table.file("file"), table.number("crease")
        if path is None or len(table.source.faults) > begun:
            return None
        with table.source.at((*table.where, "file")):
            return meshes.load(path, meshfiles.CREASE_DEG if crease is None else crease)
        return None
    given: dict[str, Any] = {}
    for key in SHAPES[kind]:
        given[key] = table.numbers(key, 3) if key == "size" else table.number(key)
    whole = [key for key, counts in models.PARAMETERS.get(kind, {}).items() if counts]
    for key in whole:
        if given[key] is not None and not given[key].is_integer():
            table.say(key, f"expected a whole number; received {given[key]:g}")
    if len(table.source.faults) > begun:
        return None
    if kind in models.MODELS:
        counts = {key: int(given[key]) for key in whole if given[key] is not None}
        found = {k: v for k, v in given.items() if v is not None} | counts
        with table.source.at(table.where, SHAPES[kind]):
            return meshes.model(kind, found)
        return None
    with table.source.at(table.where, SHAPES[kind]):
        sides = {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
        return _MAKERS[kind](**{k: v for k, v in sides.items() if v is not None})
    return None


def _textured(table: Table, material: Any) -> Textured | None:
    """A material with a picture or checks in place of its colour; None for a faulty one."""
    repeat = table.numbers("repeat", 2)
    times = (1.0, 1.0) if repeat is None else (float(repeat[0]), float(repeat[1]))
    space = table.choice("space", SPACES, "srgb")
    if ("colour" in table) == ("checks" in table):
        table.source.say(table.where, "needs either colour (a picture) or checks (two colours)")
    path = table.file("colour")
    pair = table.raw("checks")
    if pair is not None and (not isinstance(pair, list) or len(pair) != 2):
        table.say("checks", f"expected two colours; received {shown(pair)}")
    if not table.done() or space is None or material is None:
        return None
    with table.source.at(table.where, ("colour", "checks")):
        if path is not None:
            return Textured(material, colour=load_texture(path, repeat=times, space=space))
        assert pair is not None
        try:
            return Textured(material, colour=checkerboard(*pair, repeat=times))
        except (TypeError, ValueError) as error:
            text = str(error).removeprefix("colour: ").removeprefix("colour ")
            raise InputError(f"checks {text}") from error
    return None
