"""Materials of a scene file: from tables to materials, and back."""

import math
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from diffopt import fresnel
from diffopt.errors import InputError
from diffopt.materials import naming
from diffopt.materials.base import Material, floating
from diffopt.materials.combined import Scaled, Sum
from diffopt.scenes.channels import Channels
from diffopt.scenes.material_words import KINDS, METALS
from diffopt.scenes.origins import remember
from diffopt.scenes.tables import Source, Table, near, shown

#: Options of ``kind = "diffraction"``; those after the fourth are for files of heights.
DIFFRACTION = (
    "scan",
    "coherence",
    "reflectance",
    "tolerance",
    "pixel_size",
    "height_range",
    "height_unit",
    "channel",
)

# Directions that a surface is prepared for: what a small picture asks for.
_PAIRS = 1_000_000
# Most arrays of the parts of a sum.
_MOST_ARRAYS = 1000


class Materials:
    """Materials by name, each made when it is first asked for.

    Parameters
    ----------
    source
        The file.
    channels
        Of the scene.
    """

    def __init__(self, source: Source, channels: Channels) -> None:
        self.source, self.channels = source, channels
        self.notes: list[str] = []
        found = source.content.get("materials", {})
        self.tables: dict[str, Any] = found if isinstance(found, dict) else {}
        if not isinstance(found, dict):
            source.say(("materials",), "expected tables, each under [materials.NAME]")
        self._made: dict[str, Material | None] = {}
        self._making: list[str] = []

    def all(self) -> None:
        """Make those as well that nothing uses, so that their faults are seen."""
        for name in self.tables:
            self.named(name, ("materials", name))

    def of(self, value: Any, where: tuple[Any, ...]) -> Material | None:
        """The material that a name or a table means; None, and a fault, if there is none."""
        if isinstance(value, str):
            return self.named(value, where)
        if isinstance(value, dict):
            return self.made(Table(self.source, where, value))
        self.source.say(where, f"expected a material's name or a table; received {shown(value)}")
        return None

    def named(self, name: str, where: tuple[Any, ...]) -> Material | None:
        """A material of the file, or one that every file knows."""
        if name in self._making:
            loop = " -> ".join([*self._making[self._making.index(name) :], name])
            self.source.say(where, f"a material must not contain itself: {loop}")
            return None
        if name in self.tables:
            if name not in self._made:
                self._making.append(name)
                self._made[name] = self.of_table(name)
                self._making.pop()
            return self._made[name]
        if name in naming.NAMES:
            return naming.named(name).material
        if os.path.splitext(name)[1].lower() in naming.SUFFIXES:
            expected = f'expected a table for the file: [materials.NAME] with file = "{name}"'
            self.source.say(where, f"no material {name!r}; {expected}")
            return None
        options = (*self.tables, *naming.NAMES)
        expected = "a table [materials.NAME] or one of " + ", ".join(naming.NAMES)
        self.source.say(where, f"no material {name!r}{near(name, options)}; expected {expected}")
        return None

    def of_table(self, name: str) -> Material | None:
        """The material under ``[materials.NAME]``."""
        found = self.tables[name]
        if not isinstance(found, dict):
            self.source.say(("materials", name), f"expected a table; received {shown(found)}")
            return None
        return self.made(Table(self.source, ("materials", name), found))

    def made(self, table: Table) -> Material | None:
        """A material from its table."""
        if "file" in table:
            path = table.file("file")
            if not table.done() or path is None:
                return None
            with self.source.at((*table.where, "file")):
                subject = naming.load(path)
                self.notes += subject.notes
                return remember(subject.material, file=os.path.abspath(path))
            return None
        kind = table.choice("kind", KINDS)
        if kind is None:
            return None
        if kind == "sum":
            return self._sum(table)
        if kind == "scaled":
            return self._scaled(table)
        return self._diffraction(table) if kind == "diffraction" else self._plain(table, kind)

    def _plain(self, table: Table, kind: str) -> Material | None:
        options: dict[str, Any] = {}
        for name in naming.NAMES[kind]:
            if name == "colour":
                options[name] = table.colour(name)
            elif name in ("normals", "masking", "compensation"):
                options[name] = table.text(name)
            elif name in ("alpha", "roughness"):
                value = table.content.get(name)
                pair = isinstance(value, list)
                options[name] = table.numbers(name, 2) if pair else table.number(name)
            else:
                options[name] = table.number(name)
        wavelengths = table.raw("wavelengths") if kind in METALS else None
        if wavelengths is not None:
            wavelengths = table.numbers("wavelengths", *range(1, 1000))
        table.done()
        if options.get("sigma") is not None:
            if not 0.0 <= options["sigma"] <= 90.0:
                table.say("sigma", f"must be from 0 to 90 degrees; received {options['sigma']:g}")
                return None
            options["sigma"] = math.radians(options["sigma"])
        spectrum = options.get("colour")
        own = isinstance(spectrum, list) and len(spectrum) not in (1, 3)
        with self.source.at(table.where, tuple(options)):
            if own and kind != "plastic":
                del options["colour"]
            subject = naming.named(kind, **options)
            self.notes += [note for note in subject.notes if "the sphere" not in note]
            material = subject.material
            if own and kind != "plastic":
                material = _replaced(material, colour=floating(spectrum))
            if wavelengths is not None:
                material = _replaced(material, wavelengths=floating(wavelengths))
            return material if table.sound else None
        return None

    def _sum(self, table: Table) -> Material | None:
        value = table.raw("parts")
        chances = table.numbers("chances", *range(1, 100))
        if not isinstance(value, list) or not value:
            table.say("parts", f"expected a list of materials; received {shown(value)}")
        table.done()
        if not isinstance(value, list):
            return None
        parts = [self.of(each, (*table.where, "parts", k)) for k, each in enumerate(value)]
        if not table.sound or any(part is None for part in parts):
            return None
        # Of materials that are named more than once the number doubles with each sum.
        count = sum(len(jax.tree.leaves(part)) for part in parts)
        if count > _MOST_ARRAYS:
            table.say("parts", f"parts of {count} arrays; at most {_MOST_ARRAYS} are accepted")
            return None
        with self.source.at(table.where, ("chances", "parts")):
            return Sum([part for part in parts if part is not None], chances)
        return None

    def _scaled(self, table: Table) -> Material | None:
        factor = table.colour("factor")
        inner = self.of(table.raw("material"), (*table.where, "material"))
        if not table.done() or inner is None:
            return None
        with self.source.at(table.where, ("factor",)):
            return Scaled(inner, 1.0 if factor is None else factor)
        return None

    def _diffraction(self, table: Table) -> Material | None:
        scan = table.text("scan")
        coherence, tolerance = table.number("coherence"), table.number("tolerance")
        reflectance = table.text("reflectance")
        loading = table.given(*DIFFRACTION[4:])
        if scan is None and "scan" not in table:
            self.source.say(table.where, 'needs scan: "sample:NAME" or a file of heights')
        path = None
        if scan is not None and not scan.startswith("sample:"):
            path = table.file("scan")
        if not table.done("kind") or scan is None:
            return None
        from diffopt import samples
        from diffopt.diffraction import DiffractionBRDF
        from diffopt.heightfield import Heightfield
        from diffopt.materials.diffracting import Diffraction

        with self.source.at(table.where, DIFFRACTION):
            if path is None:
                if loading:
                    raise InputError(f"{next(iter(loading))} is for files; {scan} is made by code")
                field = samples.make(scan.removeprefix("sample:"))
            else:
                lists: dict[str, Any] = {
                    k: tuple(v) if isinstance(v, list) else v for k, v in loading.items()
                }
                field = Heightfield.load(path, **lists).levelled()
            if coherence is None:
                coherence = min(max(min(field.extent) / 8.0, max(field.pixel)), 1.25)
            law = fresnel.parse("al" if reflectance is None else reflectance)
            brdf = DiffractionBRDF(field, coherence, fresnel=law)
            lam = self.channels.wavelengths
            given: dict[str, Any] = {"output": "xyz"}
            if lam is not None:
                given = {"wavelengths": jnp.asarray(lam)}
            limit = 1e-2 if tolerance is None else tolerance
            prepared = brdf.prepare(pairs=_PAIRS, tolerance=limit, **given)
            where = scan if path is None else os.path.abspath(path)
            kept = {
                "kind": "diffraction",
                "scan": where,
                "coherence": coherence,
                "reflectance": "al" if reflectance is None else reflectance,
                "tolerance": limit,
            }
            return remember(Diffraction(prepared), **kept, **loading)
        return None


def _replaced(material: Any, **fields: Any) -> Any:
    names = sorted(fields)
    return eqx.tree_at(
        lambda m: [getattr(m, name) for name in names], material, [fields[n] for n in names]
    )
