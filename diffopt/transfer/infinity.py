"""Lights of a scene as if all of them came from infinity, which precomputed transfer is for.

Surfaces that emit light become part of an environment map, as the middle of the scene sees them;
points and floods become parallel light; ambient light surrounds the scene.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt.lobes import Lobes
from diffopt.scenes import lights, raycasting
from diffopt.scenes.channels import Channels
from diffopt.scenes.scene import Scene
from diffopt.transfer.backgrounds import Background
from diffopt.transfer.prefiltering import pixel_directions

# Rows of a map that is made, and directions on a side of each of its pixels.
_ROWS, _SAMPLES = 128, 4


class Distant(NamedTuple):
    """A scene for precomputed transfer.

    Attributes
    ----------
    scene
        Without what emits light, under `Environment`, `LobeEnvironment` and `Directional` only.
    notes
        What was changed, one sentence each.
    """

    scene: Scene
    notes: tuple[str, ...]


def from_infinity(scene: Scene) -> Distant:
    """A scene with all its light from infinity.

    Parameters
    ----------
    scene
        With lights of any kind.

    Returns
    -------
    Distant
        The same objects if none emits light, the same lights if all are from infinity.
    """
    dark = [one for one in scene.objects if one.emission is None]
    bright = [one for one in scene.objects if one.emission is not None]
    centre = Scene(dark).geometry.centre
    kept, notes = [], []
    around = scene.environment
    even = np.zeros(scene.channels.count)
    for light in scene.lights:
        if isinstance(light, lights.Directional):
            kept.append(light)
        elif isinstance(light, lights.Point | lights.Flood):
            kept.append(_parallel(light, centre, scene.channels))
            notes.append(
                f"a {type(light).__name__.lower()} light is taken as parallel light, as it is in "
                "the middle of the scene"
            )
        elif isinstance(light, lights.Ambient):
            even = even + np.asarray(scene.channels.values("radiance", light.radiance))
            notes.append("ambient light is taken as light from all around: surfaces hide it")
    if bright:
        names = ", ".join(one.name or type(one.place.shape).__name__.lower() for one in bright)
        text = "taken as light from infinity, as the middle of the scene sees it"
        notes.append(f"what emits light ({names}) is {text}")
    if bright or even.any():
        around = _surroundings(scene, bright, even, centre)
    if around is not None:
        kept.append(around)
    found = Scene(dark, kept, wavelengths=scene.channels.wavelengths)
    return Distant(found, tuple(dict.fromkeys(notes)))


def axis(sources: Sequence[lights.Light]) -> int:
    """Number of the world's axis that lights are turned about: that of a map's zenith, else z."""
    up = next((one.up for one in sources if isinstance(one, lights.Environment)), "z")
    return 1 if up == "y" else 2


def rotation(about: int, degrees: float) -> Float[np.ndarray, "3 3"]:
    """Matrix that turns counter-clockwise about an axis of the world, as seen from its end."""
    angle = math.radians(degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    out = np.eye(3)
    i, j = (about + 1) % 3, (about + 2) % 3
    out[i, i] = out[j, j] = cos
    out[i, j], out[j, i] = -sin, sin
    return out


def turned(sources: Sequence[lights.Light], degrees: float) -> list[lights.Light]:
    """Lights from infinity turned about `axis`, as scenes have them."""
    matrix = rotation(axis(sources), degrees)
    out: list[lights.Light] = []
    for light in sources:
        if isinstance(light, lights.Environment):
            out.append(
                lights.Environment(light.radiance, light.scale, light.turn + degrees, light.up)
            )
        elif isinstance(light, lights.LobeEnvironment):
            alpha, mu, kappa = light.lobes.arrays
            there = jnp.matmul(mu, jnp.asarray(matrix.T, mu.dtype), precision="highest")
            out.append(lights.LobeEnvironment(Lobes(alpha, there, kappa)))
        elif isinstance(light, lights.Directional):
            towards = jnp.asarray(matrix @ np.asarray(light.towards), light.towards.dtype)
            out.append(eqx.tree_at(lambda one: one.towards, light, towards))
        else:
            out.append(light)
    return out


def _parallel(
    light: lights.Point | lights.Flood, centre: np.ndarray, channels: Channels
) -> lights.Directional:
    """Parallel light that is in one place what a light near the scene is there."""
    away = np.asarray(light.position) - centre
    distance = max(float(np.linalg.norm(away)), 1e-9)
    a, m, b = (float(x) for x in (light.falloff.a, light.falloff.m, light.falloff.b))
    value = np.asarray(channels.values("intensity", light.intensity))
    if isinstance(light, lights.Flood):
        aim = np.asarray(light.aim, np.float64)
        cosine = max(-float(aim @ away) / (float(np.linalg.norm(aim)) * distance), 0.0)
        value = value * cosine ** float(light.exponent)
    towards = away if away.any() else np.array([0.0, 0.0, 1.0])
    return lights.Directional(towards, value / (a * distance**m + b))


def _surroundings(
    scene: Scene, bright: list[Any], even: np.ndarray, centre: np.ndarray
) -> lights.Environment:
    """Everything around the scene as one environment."""
    around = scene.environment
    if not bright and around is None:
        return lights.Environment(even)
    if not bright and isinstance(around, lights.Environment) and not around.is_map:
        value = np.asarray(scene.channels.values("radiance", around.radiance))
        return lights.Environment(value * float(around.scale) + even)
    behind = Background([] if around is None else [around], scene.channels)
    fine = pixel_directions(_SAMPLES * _ROWS, 2 * _SAMPLES * _ROWS).reshape(-1, 3)
    values = np.asarray(behind(jnp.asarray(fine, jnp.float32))) + even.astype(np.float32)
    if bright:
        emitted = Scene(bright, wavelengths=scene.channels.wavelengths)
        met = _met(emitted, centre, fine)
        rows = np.asarray(emitted.emission())
        values = np.where((met >= 0)[:, None], rows[np.maximum(met, 0)], values)
    shape = (_ROWS, _SAMPLES, 2 * _ROWS, _SAMPLES, -1)
    return lights.Environment(values.reshape(shape).mean((1, 3)).astype(np.float32))


def _met(emitted: Scene, centre: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Object whose front directions from a point meet first; -1 for none."""
    geometry = emitted.geometry
    found = raycasting.caster(geometry).first(np.broadcast_to(centre, towards.shape), towards)
    which = found.primitive
    shapes = geometry.world
    corners = np.asarray(shapes.vertices)[np.asarray(shapes.faces)]
    triangles, spheres, _ = shapes.counts
    normals = np.concatenate(
        [
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]),
            np.asarray(shapes.axes)[:, :, 2],
        ]
    )
    ball = (which >= triangles) & (which < triangles + spheres)
    front = (normals[np.maximum(which, 0)] * towards).sum(-1) < 0.0
    seen = (which >= 0) & (front | ball)
    return np.where(seen, geometry.owner[np.maximum(which, 0)], -1)
