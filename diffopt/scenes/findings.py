"""What is odd about a scene: faults that pictures show late, or not at all."""

import dataclasses
import itertools
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from diffopt import checks
from diffopt.materials.base import Material
from diffopt.scenes import lights, overlaps, raycasting, shapes
from diffopt.scenes.camera import Camera
from diffopt.scenes.meshfiles import Mesh
from diffopt.scenes.scene import Object, Scene
from diffopt.scenes.textures import PerFace, Texture, Textured

Severity = Literal["error", "warning", "note"]
#: In their order.
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")

# Rays across a picture that look whether anything is seen.
_ACROSS = 16
# Albedo from which a material makes light: above the rounding of its quadrature.
_MOST = 1.005
# Angles of the albedo, degrees.
_ANGLES = (0.0, 40.0, 70.0)


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something about a scene.

    Attributes
    ----------
    severity
        ``"error"``: the picture is wrong or black. ``"warning"``: it may not be what was
        meant. ``"note"``: what was put right.
    place
        Object or light.
    text
        What was found, and what helps.
    """

    severity: Severity
    place: str
    text: str


def check(scene: Scene, camera: Camera | None = None) -> list[Finding]:
    """Look for faults of a scene.

    Parameters
    ----------
    scene
        Objects and lights.
    camera
        With it, whether anything is seen.

    Returns
    -------
    list
        `Finding`s, errors first; empty where all is well.
    """
    found: list[Finding] = []
    albedos: dict[int, float] = {}
    for k, one in enumerate(scene.objects):
        place = called(one, k)
        found += [Finding(severity, place, text) for severity, text in _of_shape(one)]
        found += [Finding(severity, place, text) for severity, text in _of_material(one, albedos)]
    found += _places(scene)
    found += _of_lights(scene)
    if camera is not None:
        found += _seen(scene, camera)
    return sorted(found, key=lambda finding: SEVERITIES.index(finding.severity))


def called(one: Object, number: int) -> str:
    """An object in words."""
    return f"object {one.name}" if one.name else f"object {number + 1}"


def _of_shape(one: Object) -> list[tuple[Severity, str]]:
    found: list[tuple[Severity, str]] = []
    mesh = one.place.shape
    if not isinstance(mesh, Mesh):
        return found
    done = mesh.repairs
    if done.inwards:
        found.append(("note", f"its normals pointed inwards: all {done.turned} faces were turned"))
    elif done.turned:
        found.append(("note", f"{done.turned} faces were wound against the others, and turned"))
    if done.dropped:
        found.append(("note", f"{done.dropped} faces without area were left out"))
    corners = mesh.vertices[mesh.faces]
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(*sides)
    flat = int((np.linalg.norm(across, axis=-1) == 0.0).sum())
    if flat:
        found.append(("warning", f"{flat} faces have no area: make the mesh by build_mesh"))
    if shapes.is_closed(mesh):
        middle = corners - mesh.centre
        volume = float(np.einsum("fi,fi->", middle[:, 0], np.cross(middle[:, 1], middle[:, 2])))
        if volume < 0.0:
            text = "its normals point inwards: make the mesh by build_mesh, which turns its faces"
            found.append(("error", text))
    return found


def _of_material(one: Object, albedos: dict[int, float]) -> list[tuple[Severity, str]]:
    found: list[tuple[Severity, str]] = []
    material, shape = one.material, one.place.shape
    inner = material.material if isinstance(material, Textured) else material
    if isinstance(material, Textured):
        pictures = [name for name, values in material.maps.items() if isinstance(values, Texture)]
        if pictures and isinstance(shape, Mesh) and shape.uv is None:
            text = f"its mesh has no texture coordinates for {', '.join(pictures)}: one colour"
            found.append(("error", text))
        for name, values in material.maps.items():
            count = _faces(one)
            if isinstance(values, PerFace) and values.each.shape[0] != count:
                text = f"{name} has values for {values.each.shape[0]} faces; the shape has {count}"
                found.append(("error", text))
    if inner.transmits:
        if not shapes.is_closed(shape):
            kind = "open mesh" if isinstance(shape, Mesh) else type(shape).__name__.lower()
            text = f"light passes its material, but a {kind} has no inside: take a closed shape"
            found.append(("warning", text))
        if _shines(one):
            found.append(("warning", "emits light and lets light pass: it does both, as no lamp"))
    if not inner.conserves_energy:
        if id(inner) not in albedos:
            albedos[id(inner)] = _albedo(inner)
        if albedos[id(inner)] > _MOST:
            text = f"its material reflects up to {albedos[id(inner)]:.2f} of the light: it makes"
            found.append(("warning", f"{text} light, and paths may not end"))
    return found


def _faces(one: Object) -> int:
    patch = one.patch
    return len(patch.faces) if isinstance(patch, shapes.Triangles) else 1


def _shines(one: Object) -> bool:
    known = None if one.emission is None else checks.concrete(one.emission)
    return known is not None and bool((known > 0.0).any())


def _albedo(material: Material) -> float:
    """The largest of some directions and channels."""
    angles = np.radians(_ANGLES)
    wo = np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], -1)
    leaves = [a for a in _arrays(material) if jnp.issubdtype(a.dtype, jnp.floating)]
    dtype = leaves[0].dtype if leaves else jnp.result_type(float)
    return float(np.max(np.asarray(material.albedo(jnp.asarray(wo, dtype), nodes=24))))


def _arrays(material: Material) -> list[Any]:
    import jax

    return [leaf for leaf in jax.tree.leaves(material) if eqx.is_array(leaf)]


def _places(scene: Scene) -> list[Finding]:
    """Objects in the same place."""
    found = []
    flats = [overlaps.pieces(one) for one in scene.objects]
    for (j, a), (k, b) in itertools.combinations(enumerate(scene.objects), 2):
        names = f"{called(a, j)} and {called(b, k)}"
        if a.place.shape == b.place.shape and a.place.matrix == b.place.matrix:
            found.append(Finding("error", names, "lie in exactly the same place"))
            continue
        same, opposite = overlaps.overlapping(flats[j], flats[k])
        # Where a body stands on a floor, its underside is not seen.
        bodies = [shapes.is_closed(one.place.shape) and not _passes(one) for one in (a, b)]
        if same or (opposite and not any(bodies)):
            text = (
                "have surfaces in one plane: which is seen is left to rounding; move one a little"
            )
            found.append(Finding("warning", names, text))
    return found


def _passes(one: Object) -> bool:
    material = one.material
    return (material.material if isinstance(material, Textured) else material).transmits


def _of_lights(scene: Scene) -> list[Finding]:
    found = []
    for k, light in enumerate(scene.lights):
        if not _strength(light):
            name = f"light {k + 1} ({type(light).__name__})"
            found.append(Finding("warning", name, "has no strength: it lights nothing"))
    for k, one in enumerate(scene.objects):
        if one.emission is not None and not _shines(one):
            found.append(Finding("warning", called(one, k), "emits 0: it lights nothing"))
    if not any(map(_strength, scene.lights)) and not any(map(_shines, scene.objects)):
        text = "there is no light: add [[lights]], or emission to an object"
        found.append(Finding("error", "scene", text))
    return found


def _strength(light: lights.Light) -> bool:
    values: list[Any] = []
    for name in ("radiance", "irradiance", "intensity"):
        values += [getattr(light, name)] if hasattr(light, name) else []
    if isinstance(light, lights.Environment):
        values = [light.radiance, light.scale]
    if isinstance(light, lights.LobeEnvironment):
        values = [light.lobes.alpha]
    known = [checks.concrete(value) for value in values]
    return all(value is None or bool((value > 0.0).any()) for value in known)


def _seen(scene: Scene, camera: Camera) -> list[Finding]:
    """Whether the camera sees anything, and where it stands."""
    found = []
    eye = np.asarray(camera.eye)
    for k, one in enumerate(scene.objects):
        if shapes.is_closed(one.place.shape) and inside(one, eye):
            text = f"is inside {called(one, k)}: it sees nothing else unless that lets light pass"
            found.append(Finding("warning", "camera", text))
    if not _hits(scene, camera):
        around = scene.environment
        if around is None:
            text = "nothing is seen: no ray meets an object; check eye, target and field_of_view"
            found.append(Finding("error", "camera", text))
        else:
            text = "only the environment is seen: no ray meets an object"
            found.append(Finding("warning", "camera", text))
    return found


def _hits(scene: Scene, camera: Camera) -> bool:
    if not scene.objects:
        return False
    columns, rows = camera.resolution
    x = (np.arange(_ACROSS) + 0.5) * columns / _ACROSS
    y = (np.arange(_ACROSS) + 0.5) * rows / _ACROSS
    x, y = (a.reshape(-1) for a in np.meshgrid(x, y))
    pixel = y.astype(int) * columns + x.astype(int)
    origins, along = camera.rays(pixel, np.stack([x % 1.0, y % 1.0], -1))
    return bool((raycasting.caster(scene.geometry).first(origins, along).primitive >= 0).any())


def inside(one: Object, point: np.ndarray) -> bool:
    """Whether a point [3] lies within a closed object."""
    patch = one.patch
    if isinstance(patch, shapes.Round):
        return float(np.linalg.norm(point - patch.centre)) < patch.radius
    # The solid angle of its faces is 4 pi from inside and 0 from outside (van Oosterom and
    # Strackee, The solid angle of a plane triangle, 1983).
    corners = patch.vertices[patch.faces] - point
    length = np.linalg.norm(corners, axis=-1)
    a, b, c = corners.transpose(1, 0, 2)
    volume = (a * np.cross(b, c)).sum(-1)
    rest = length.prod(-1) + sum(
        (corners[:, i] * corners[:, j]).sum(-1) * length[:, 3 - i - j]
        for i, j in ((0, 1), (0, 2), (1, 2))
    )
    return bool(abs(2.0 * np.arctan2(volume, rest).sum()) > 2.0 * np.pi)
