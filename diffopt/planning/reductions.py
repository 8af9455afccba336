"""Scenes without some of their effects: simpler materials and lights in the same places.

What is replaced is gone: no operation of it is left in what is compiled for the scene, and none
of its tables in memory.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.fresnel import Constant, Reflectance, Schlick
from diffopt.materials.base import Material
from diffopt.materials.combined import Scaled, Sum
from diffopt.materials.diffracting import Diffraction, FlatDiffraction
from diffopt.materials.diffuse import Lambert, OrenNayar
from diffopt.materials.interfaces import Mirror
from diffopt.materials.microfacet import Microfacet
from diffopt.rendering.effects import PATHS
from diffopt.scenes.lights import Ambient, Environment, Light
from diffopt.scenes.scene import Object, Scene
from diffopt.scenes.textures import Textured

#: Effects in whose place something simpler stands: three bands for a spectrum, Schlick's
#: approximation for Fresnel's formulas, a flat surface for a diffracting one, the mean of an
#: environment map.
REPLACED = ("spectrum", "fresnel", "diffraction", "environment-map")
#: All effects, in the order in which they are told.
EFFECTS = (
    "spectrum",
    "fresnel",
    "diffraction",
    "environment-map",
    *PATHS,
)


def reduced(scene: Scene, excluded: frozenset[str]) -> Scene:
    """The scene without some effects.

    Parameters
    ----------
    scene
        The scene; it is returned itself where nothing changes.
    excluded
        Of `EFFECTS`. Those of paths that leave nothing to materials and lights (shadows,
        interreflections) change nothing here.

    Raises
    ------
    InputError
        If a spectral scene has values for its channels whose wavelengths are not known.
    """
    objects = [_object(one, excluded) for one in scene.objects]
    lights = [_light(one, scene, excluded) for one in scene.lights]
    lights = [one for one in lights if one is not None]
    wavelengths = scene.channels.wavelengths
    if "spectrum" in excluded and wavelengths is not None:
        emission = [_in_gamut(scene, row) for row in scene.emission()]
        objects = [_named(one, scene) for one in objects]
        objects = [
            one if one.emission is None else _with(one, one.material, jnp.asarray(rgb))
            for one, rgb in zip(objects, emission, strict=True)
        ]
        return Scene(objects, [_in_rgb(one, scene) for one in lights])
    same = len(lights) == len(scene.lights)
    same &= all(a is b for a, b in zip(objects, scene.objects, strict=True))
    if same and all(a is b for a, b in zip(lights, scene.lights, strict=True)):
        return scene
    return Scene(objects, lights, wavelengths=wavelengths)


def _object(one: Object, excluded: frozenset[str]) -> Object:
    inner = one.material.material if isinstance(one.material, Textured) else one.material
    found = simplified(inner, excluded)
    if found is inner:
        return one
    if isinstance(one.material, Textured) and type(found) is type(inner):
        return _with(one, Textured(found, **one.material.maps), one.emission)
    return _with(one, found, one.emission)


def _with(one: Object, material: Any, emission: Any) -> Object:
    """The object of another material, in the very same place."""
    found = Object(one.place.shape, material, emission=emission, name=one.name)
    object.__setattr__(found, "place", one.place)
    if material is one.material:
        object.__setattr__(found, "wavelengths", one.wavelengths)
    return found


def _named(one: Object, scene: Scene) -> Object:
    """An object whose channels, if they are those of a spectral scene, have wavelengths."""
    if one.wavelengths is not None or one.material.channels != (scene.channels.count,):
        return one
    if scene.channels.count == 3:
        return one
    found = _with(one, one.material, one.emission)
    object.__setattr__(found, "wavelengths", scene.channels.wavelengths)
    return found


def simplified(material: Material, excluded: frozenset[str]) -> Material:
    """A material without the effects; itself where nothing changes."""
    if "fresnel" in excluded:
        material = _replaced(material, _with_schlick)
    if "diffraction" in excluded:
        material = _replaced(material, _flat)
    glossy = "glossy-light" not in excluded
    coherent = not {"mirror", "refraction", "caustics"} <= excluded
    if glossy and coherent:
        return material
    kept = _kept(material, glossy, coherent)
    return Lambert(0.0) if kept is None else kept


def _replaced(material: Material, change: Any) -> Material:
    """A material with something changed in all its parts; itself where nothing changes."""
    if isinstance(material, Sum):
        parts = tuple(_replaced(part, change) for part in material.parts)
        if all(a is b for a, b in zip(parts, material.parts, strict=True)):
            return material
        return Sum(parts, material.chances)
    if isinstance(material, Scaled):
        part = _replaced(material.material, change)
        return material if part is material.material else Scaled(part, material.factor)
    return change(material)


def exact_fresnel(material: Material) -> Reflectance | None:
    """The reflectance of a material that follows Fresnel's formulas for mirrors and facets."""
    if isinstance(material, Mirror | Microfacet):
        of = material.fresnel
        if not isinstance(of, Constant | Schlick):
            return of
    return None


def _with_schlick(material: Material) -> Material:
    of = exact_fresnel(material)
    if of is None:
        return material
    lam = material.wavelengths  # type: ignore[attr-defined]
    normal = jax.jit(lambda m, x: m.normal(x))(of, jnp.atleast_1d(lam))
    return dataclasses.replace(material, fresnel=Schlick(normal if lam.ndim else normal[0]))


def _flat(material: Material) -> Material:
    return FlatDiffraction(material) if isinstance(material, Diffraction) else material


def _kept(material: Material, glossy: bool, coherent: bool) -> Material | None:
    """What is left of a material without its glossy or its coherent parts."""
    if isinstance(material, Sum):
        parts = [_kept(part, glossy, coherent) for part in material.parts]
        if all(a is b for a, b in zip(parts, material.parts, strict=True)):
            return material
        which = [k for k, part in enumerate(parts) if part is not None]
        if len(which) < 2:
            return parts[which[0]] if which else None
        chances = material.chances[jnp.asarray(which)]
        return Sum([parts[k] for k in which], chances / chances.sum())
    if isinstance(material, Scaled):
        part = _kept(material.material, glossy, coherent)
        if part is None or part is material.material:
            return None if part is None else material
        return Scaled(part, material.factor)
    if isinstance(material, Lambert | OrenNayar):
        return material
    return material if (coherent if not material.smooth else glossy) else None


def _light(light: Light, scene: Scene, excluded: frozenset[str]) -> Light | None:
    if isinstance(light, Ambient) and "ambient" in excluded:
        return None
    if isinstance(light, Environment) and light.is_map and "environment-map" in excluded:
        return Environment(scene.channels.values("radiance", mean_radiance(light)), light.scale)
    return light


def mean_radiance(light: Environment) -> np.ndarray:
    """Mean over the sphere of a map's radiance, without its scale: a number or channels."""
    pixels = np.asarray(light.radiance, np.float64)
    edges = np.cos(np.linspace(0.0, math.pi, len(pixels) + 1))
    share = (edges[:-1] - edges[1:]) / 2.0
    return np.tensordot(share, pixels.mean(1), 1)


def _in_rgb(light: Light, scene: Scene) -> Light:
    """A light of a spectral scene in linear RGB."""
    for name in ("radiance", "irradiance", "intensity"):
        value = getattr(light, name, None)
        if value is None or value.ndim == 0 or value.shape[-1] in (1, 3):
            continue
        if value.shape[-1] != scene.channels.count or (name == "radiance" and value.ndim == 2):
            continue
        return dataclasses.replace(light, **{name: jnp.asarray(_in_gamut(scene, value))})
    return light


def _in_gamut(scene: Scene, value: Any) -> np.ndarray:
    """Light in linear RGB; of deeper colours than the primaries what is below 0 is cut off."""
    return np.maximum(scene.channels.rgb(np.asarray(value)), 0.0)


def has(scene: Scene, effect: str) -> bool:
    """Whether a scene has what one of `REPLACED` stands for."""
    inner = [
        one.material.material if isinstance(one.material, Textured) else one.material
        for one in scene.objects
    ]
    if effect == "spectrum":
        return scene.channels.wavelengths is not None
    if effect == "environment-map":
        return any(isinstance(one, Environment) and one.is_map for one in scene.lights)
    if effect in ("fresnel", "diffraction"):
        return any(simplified(one, frozenset({effect})) is not one for one in inner)
    raise InputError(f"effect must be one of {', '.join(REPLACED)}; received {effect!r}")


def diffracting(material: Any) -> list[Diffraction]:
    """The diffracting parts of a material."""
    if isinstance(material, Textured):
        material = material.material
    if isinstance(material, Diffraction):
        return [material]
    if isinstance(material, Sum):
        return [found for part in material.parts for found in diffracting(part)]
    return diffracting(material.material) if isinstance(material, Scaled) else []
