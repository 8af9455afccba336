"""Random objects over a plane for `diffopt.shadows.settings_for`.

What settings within a tolerance give is compared with rays to many directions, under the sky for
which the tolerance is stated: RMS error of irradiance over the unshadowed one.
"""

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from diffopt import shadows
from diffopt.accuracy import shadow_scenes
from diffopt.accuracy.promises import Answer, Draw, Promise, refusal
from diffopt.errors import InputError
from diffopt.shadows import ShadowSettings, choosing, truth

KINDS = ("egg", "torus", "capsule", "box", "plate", "knobbly", "spiky", "cross")
#: From the lowest point of an object close to the plane to the plane, in radii of the object.
#: Where they touch, sampled directions do not resolve what receivers beside the contact see.
GAPS = (0.1, 0.5)
# Receivers on a side of the square, its side, and polar directions of the truth.
_SIDE, _EXTENT, _POLAR = 16, 8.0, 40
#: How far the truth may be off: half the difference of 40 from 80 polar directions, at most.
DOUBT = 5e-4


class Scene(NamedTuple):
    """Objects over the plane z = 0 with receivers in it.

    Attributes
    ----------
    meshes
        Vertices and faces of each object.
    inside
        Whether a receiver lies within a bounding sphere.
    points
        Receivers, [N, 3].
    words
        What it is.
    """

    meshes: list[tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]]
    inside: bool
    points: Float[np.ndarray, "N 3"]
    words: str


def body(rng: np.random.Generator, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of an object of a kind, turned at random, in the unit sphere."""
    import trimesh

    make = trimesh.creation
    if kind == "torus":
        thick = rng.uniform(0.08, 0.45)
        mesh = make.torus(1.0 - thick, thick, 64, 32)
    elif kind == "capsule":
        mesh = make.capsule(1.0, rng.uniform(0.08, 0.8), count=[32, 32])
    elif kind in ("box", "plate"):
        sides = rng.uniform(0.4, 1.0, 3)
        sides[2] = rng.uniform(0.02, 0.1) if kind == "plate" else sides[2]
        mesh = make.box(sides)
    elif kind == "cross":
        long = [[1.0, w, w] for w in rng.uniform(0.08, 0.25, 3)]
        parts = [make.box(np.roll(side, k)) for k, side in enumerate(long)]
        corners = np.concatenate([part.vertices for part in parts])
        counted = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        faces = [part.faces + first for part, first in zip(parts, counted, strict=True)]
        mesh = trimesh.Trimesh(corners, np.concatenate(faces), process=False)
    else:
        mesh = make.icosphere(4)
        n = np.asarray(mesh.vertices)
        if kind == "egg":
            scaled = n * rng.uniform(0.35, 1.0, 3)
            scaled[:, 2] *= 1.0 + rng.uniform(0.0, 0.5) * n[:, 0]
        else:
            # Waves over the sphere: a few broad ones, or many that stand out.
            axes = rng.normal(size=(12, 3)) * (2.0 if kind == "knobbly" else 6.0)
            waves = np.cos(n @ axes.T + rng.uniform(0, 6.28, 12)) @ rng.normal(size=12)
            waves /= np.abs(waves).max()
            scaled = n * (1.0 + (0.35 if kind == "knobbly" else 0.5) * waves)[:, None]
        mesh = trimesh.Trimesh(scaled, mesh.faces, process=False)
    turned, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    vertices = np.asarray(mesh.vertices, np.float64) @ (turned * np.sign(np.linalg.det(turned)))
    vertices -= 0.5 * (vertices.min(0) + vertices.max(0))
    return vertices / np.linalg.norm(vertices, axis=1).max(), np.asarray(mesh.faces)


def scene(rng: np.random.Generator) -> Scene:
    """One object, or two or three, over the plane; in a third of the scenes close to it."""
    count = int(rng.choice([1, 1, 2, 3]))
    inside = bool(rng.uniform() < 1 / 3)
    kinds = [str(k) for k in rng.choice(KINDS, count)]
    meshes = []
    for k, kind in enumerate(kinds):
        vertices, faces = body(rng, kind)
        size = 1.0 if count == 1 else rng.uniform(0.4, 1.0)
        vertices = size * vertices
        lowest = -vertices[:, 2].min()
        height = size * rng.uniform(1.08, 2.5)
        if inside:
            height = lowest + size * rng.uniform(*GAPS)
        around = 2.0 * np.pi * (k / count + rng.uniform(0, 0.1))
        far = 0.0 if count == 1 else rng.uniform(0.3, 1.3)
        place = [far * np.cos(around), far * np.sin(around), height]
        meshes.append((vertices + place, faces))
    points = shadows.plane(_EXTENT, _SIDE).reshape(-1, 3)
    words = f"{', '.join(kinds)}, {'close to' if inside else 'over'} the plane"
    return Scene(meshes, inside, points, words)


def right(made: Scene) -> Float[np.ndarray, " N"]:
    """Irradiance by rays over the unshadowed one."""
    found, bare = truth.irradiance(
        made.points, made.meshes, shadow_scenes.radiance, polar=_POLAR, azimuthal=2 * _POLAR
    )
    return found[:, 0] / bare[0]


def error_of(made: Scene, expected: Float[np.ndarray, " N"], settings: ShadowSettings) -> float:
    """RMS error of irradiance over the unshadowed one."""
    fields = [shadows.shadow_field(v, f, settings, receivers=made.points) for v, f in made.meshes]
    light = shadows.distant_light(shadow_scenes.radiance, settings.bands)
    at = jnp.asarray(made.points, jnp.float32)
    up = jnp.asarray([0.0, 0.0, 1.0], jnp.float32)
    found = np.asarray(shadows.irradiance(at, up, fields, light, settings), np.float64)[:, 0]
    bare = np.asarray(shadows.irradiance(at[:1], up, [], light, settings), np.float64)[0, 0]
    off = found / bare - expected
    return float(np.sqrt((off * off).mean()))


def _answer(draw: Draw) -> Answer:
    made = scene(draw.rng)
    count = len(made.meshes)
    try:
        settings = shadows.settings_for(
            draw.tolerance, receivers_inside=made.inside, occluders=count
        )
    except InputError as error:
        return refusal(made.words, error)
    expected = right(made)
    error = error_of(made, expected, settings)
    price = None
    if draw.priced:
        chosen = _work(settings)
        price = 1.0
        for choice in choosing.CHOICES:
            cheaper = choice.settings
            if _work(cheaper) < chosen and error_of(made, expected, cheaper) <= draw.tolerance:
                price = max(price, chosen / _work(cheaper))
    words = [made.words, *(f"{k}={v}" for k, v in _shown(settings).items())]
    return Answer(", ".join(words), error, DOUBT, price=price)


def _work(settings: ShadowSettings) -> float:
    """Rays of a frame, to which its time is nearly in proportion."""
    across, around = settings.directions
    return (settings.shells or 1) * across * around * settings.rays**2


def survey(scenes: int, seed: int = 1) -> list[choosing.Choice]:
    """The lines of `diffopt.shadows.choosing.CHOICES` with their largest errors measured anew.

    Parameters
    ----------
    scenes
        Random scenes, as many for each of: one object over the plane, one close to it, several.
    seed
        Of the scenes; the promise draws others.
    """
    errors = np.zeros((len(choosing.CHOICES), 3))
    found = np.zeros(3, int)
    rng = np.random.default_rng([seed, scenes])
    while found.min() < scenes:
        made = scene(rng)
        kind = 1 if made.inside else 2 if len(made.meshes) > 1 else 0
        if found[kind] >= scenes:
            continue
        found[kind] += 1
        expected = right(made)
        for k, choice in enumerate(choosing.CHOICES):
            error = error_of(made, expected, choice.settings)
            errors[k, kind] = max(errors[k, kind], error)
    return [
        choice._replace(outside=float(a), inside=float(b), several=float(c))
        for choice, (a, b, c) in zip(choosing.CHOICES, errors, strict=True)
    ]


def _shown(settings: ShadowSettings) -> dict[str, Any]:
    fields = dataclasses.asdict(settings)
    return {name: fields[name] for name in ("bands", "shells", "directions", "rays")}


SHADOWS = Promise(
    name="shadows",
    entry="shadows.settings_for(tolerance)",
    quantity="RMS error of irradiance over the unshadowed one, under the sky of the studies; "
    "cost in rays of a frame",
    reference=f"rays to {_POLAR} x {2 * _POLAR} directions, which err by up to {DOUBT:g}",
    answer=_answer,
    tolerances=(5e-4, 1e-1),
    x64=False,
    shared=True,
)
