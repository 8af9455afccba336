"""Lights of a scene file, from its tables and back."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.materials.base import floating
from diffopt.scenes import spectra
from diffopt.scenes.assets import load_environment, load_lobes
from diffopt.scenes.channels import Channels
from diffopt.scenes.lights import (
    Ambient,
    Directional,
    Environment,
    Falloff,
    Flood,
    Light,
    LobeEnvironment,
    Point,
)
from diffopt.scenes.material_words import plain
from diffopt.scenes.origins import origin
from diffopt.scenes.scene import Object, area_light
from diffopt.scenes.tables import Table

#: Lights, and the quantity of each that has a colour.
KINDS: dict[str, str | None] = {
    "ambient": "radiance",
    "directional": "irradiance",
    "point": "intensity",
    "flood": "intensity",
    "area": "radiance",
    "environment": "radiance",
    "lobes": None,
}


def lights(
    tables: list[Table], channels: Channels, placement: Any
) -> tuple[list[Light], list[Object], list[str]]:
    """Lights, surfaces that emit, and notes, of the ``[[lights]]`` whose tables are sound."""
    found: list[Light] = []
    surfaces: list[Object] = []
    notes: list[str] = []
    for table in tables:
        kind = table.choice("kind", tuple(KINDS))
        if kind is None:
            continue
        name = table.text("name")
        made: Any = None
        if kind == "area":
            made = _area(table, channels, placement, name or "light")
        elif kind == "lobes":
            made = _lobes(table)
        elif kind == "environment":
            made = _environment(table, channels, notes)
        else:
            made = _abstract(table, kind, channels)
        if isinstance(made, Object):
            surfaces.append(made)
        elif made is not None:
            found.append(made)
    return found, surfaces, notes


def scaled(table: Table, name: str, channels: Channels, default: float | None) -> Any:
    """A quantity of light, times the colour that ``illuminant`` or ``temperature`` gives it.

    Parameters
    ----------
    table
        Of the light or the object.
    name
        Of the quantity.
    channels
        Of the scene.
    default
        Its value where it is left out; None makes that a fault.
    """
    value: Any = table.colour(name)
    word, kelvin = table.text("illuminant"), table.number("temperature")
    if name not in table:
        value = default
        if default is None:
            table.source.say(table.where, f"needs {name} beside illuminant or temperature")
    if word is not None and kelvin is not None:
        table.say("temperature", "give illuminant or temperature, not both")
    if value is None:
        return None
    with table.source.at(table.where, ("illuminant", "temperature", name)):
        numbers = floating(value)
        if word is None and kelvin is None:
            channels.values(name, numbers)
            return numbers
        if word is not None:
            tint = spectra.illuminant(channels, word)
        else:
            assert kelvin is not None
            tint = spectra.black_body(channels, kelvin)
        return channels.values(name, numbers) * jnp.asarray(tint, numbers.dtype)
    return None


def described(light: Light) -> dict[str, Any]:
    """The table that means a light; a path in it is absolute.

    Raises
    ------
    InputError
        For a map or lobes whose file is not known.
    """
    if isinstance(light, Ambient):
        return {"kind": "ambient", "radiance": plain(light.radiance)}
    if isinstance(light, Directional):
        towards, strength = plain(light.towards), plain(light.irradiance)
        return {"kind": "directional", "towards": towards, "irradiance": strength}
    if isinstance(light, Point | Flood):
        found = {
            "kind": "point" if isinstance(light, Point) else "flood",
            "position": plain(light.position),
            "intensity": plain(light.intensity),
        }
        if isinstance(light, Flood):
            found |= {"aim": plain(light.aim), "exponent": plain(light.exponent)}
        law = {name: plain(getattr(light.falloff, name)) for name in "amb"}
        usual = {"a": 1.0, "m": 2.0, "b": 0.0}
        return found if law == usual else {**found, "falloff": law}
    if isinstance(light, LobeEnvironment):
        return {"kind": "lobes", **_known(light.lobes, "load_lobes(path)")}
    if not isinstance(light, Environment):
        raise InputError(f"a {type(light).__name__} has no name in scene files")
    more = {"scale": plain(light.scale), "turn": float(light.turn), "up": light.up}
    usual = {"scale": 1.0, "turn": 0.0, "up": "z"}
    more = {name: value for name, value in more.items() if value != usual[name]}
    if light.is_map:
        return {
            "kind": "environment",
            **_known(light.radiance, "load_environment(path)"),
            **more,
        }
    return {"kind": "environment", "radiance": plain(light.radiance), **more}


def _known(thing: Any, maker: str) -> dict[str, Any]:
    found = origin(thing)
    if found is None:
        raise InputError(
            f"it was not read from a file, which scene files refer to: take diffopt.scenes.{maker}"
        )
    return found


def _abstract(table: Table, kind: str, channels: Channels) -> Light | None:
    quantity = KINDS[kind]
    assert quantity is not None
    given: dict[str, Any] = {quantity: scaled(table, quantity, channels, 1.0)}
    if kind == "directional":
        given["towards"] = table.numbers("towards", 3)
    if kind in ("point", "flood"):
        given["position"] = table.numbers("position", 3)
        given["falloff"] = _falloff(table.table("falloff"))
    if kind == "flood":
        given["aim"], given["exponent"] = table.numbers("aim", 3), table.number("exponent")
    table.done()
    arguments = {name: value for name, value in given.items() if value is not None}
    makers = {"ambient": Ambient, "directional": Directional, "point": Point, "flood": Flood}
    with table.source.at(table.where, tuple(given)):
        # Made of what is sound, so that all faults are seen at once.
        made = makers[kind](**arguments)
        return made if table.sound else None
    return None


def _falloff(table: Table | None) -> Falloff | None:
    if table is None:
        return None
    given = {name: table.number(name) for name in "amb"}
    if not table.done():
        return None
    with table.source.at(table.where, tuple(given)):
        return Falloff(**{name: value for name, value in given.items() if value is not None})
    return None


def _area(table: Table, channels: Channels, placement: Any, name: str) -> Object | None:
    radiance = scaled(table, "radiance", channels, 1.0)
    given = {key: table.number(key) for key in ("width", "height")}
    matrix = placement(table)
    table.done()
    sides = {key: value for key, value in given.items() if value is not None}
    with table.source.at(table.where, ("width", "height", "emission")):
        light = 1.0 if radiance is None else radiance
        made = area_light(**sides, transform=matrix, radiance=light, name=name)
        return made if table.sound else None
    return None


def _environment(table: Table, channels: Channels, notes: list[str]) -> Environment | None:
    path = table.file("file")
    more: dict[str, Any] = {"scale": table.number("scale"), "turn": table.number("turn")}
    more["up"] = table.choice("up", ("z", "y"), "z")
    more = {name: value for name, value in more.items() if value is not None}
    radiance = None
    if "file" in table:
        for name in ("radiance", "illuminant", "temperature"):
            if name in table:
                table.raw(name)
                table.say(name, f"a map brings its own colours; {name} is for even light")
    else:
        radiance = scaled(table, "radiance", channels, 1.0)
    table.done()
    with table.source.at(table.where, ("radiance", "scale", "file")):
        if path is None:
            made = Environment(1.0 if radiance is None else radiance, **more)
            return made if table.sound else None
        light, said = load_environment(path, **more)
        channels.matrix(np.shape(light.radiance)[-1])
        notes += [f"{path.name}: {note}" for note in said]
        return light if table.sound else None
    return None


def _lobes(table: Table) -> LobeEnvironment | None:
    path = table.file("file")
    if "file" not in table:
        table.source.say(table.where, "lobes need a file (.json or .npz of diffopt fit lobes)")
    if not table.done() or path is None:
        return None
    with table.source.at((*table.where, "file")):
        return load_lobes(path)
    return None
