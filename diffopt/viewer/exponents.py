"""Exponents of the glossy materials of a scene, replaced while looking."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.scenes.scene import Scene
from diffopt.viewer.controls import Slider

#: The slider goes from the own exponent over this to as many times it.
SPAN = 8.0


def first(scene: Scene) -> float | None:
    """Exponent of the first material that has one; None where there is none."""
    for one in scene.objects:
        for part in _parts(one.material):
            return float(np.asarray(part.exponent).reshape(-1)[0])
    return None


def sliders(own: float | None, hint: str) -> tuple[Slider, ...]:
    """A slider about an exponent; none where there is none."""
    if own is None:
        return ()
    value = float(round(own))
    least, most = float(max(round(own / SPAN), 1)), float(max(round(SPAN * own), 8))
    return (Slider("exponent", "material exponent", least, most, 1.0, max(value, least), hint),)


def replaced(scene: Scene, wanted: float) -> Scene:
    """A scene whose glossy materials all have another exponent; shared ones stay shared.

    Raises
    ------
    InputError
        If no material has one.
    """
    if first(scene) is None:
        raise InputError("no material of the scene has an exponent")
    made: dict[int, Any] = {}
    objects = []
    for one in scene.objects:
        key = id(one.material)
        if key not in made:
            made[key] = _with(one.material, wanted)
        objects.append(eqx.tree_at(lambda o: o.material, one, made[key]))
    return Scene(objects, scene.lights, wavelengths=scene.channels.wavelengths)


def _with(material: Any, wanted: float) -> Any:
    parts = _parts(material)
    if not parts:
        return material
    new = [jnp.full_like(jnp.asarray(part.exponent), wanted) for part in parts]
    return eqx.tree_at(lambda m: [part.exponent for part in _parts(m)], material, new)


def _parts(material: Any) -> list[Any]:
    """Parts of a material that have an exponent of their own."""
    found = jax.tree.leaves(material, is_leaf=lambda m: hasattr(m, "exponent"))
    return [part for part in found if hasattr(part, "exponent")]
