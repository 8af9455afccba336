"""Scenes: objects, lights and channels.

>>> scene = Scene(
...     objects=[
...         Object(Sphere(), Lambert((0.8, 0.3, 0.2)), name="ball"),
...         Object(Plane(8, 8), Lambert(0.5), translate(0, 0, -1), name="floor"),
...     ],
...     lights=[Point(position=(3, -2, 4), intensity=40.0), Environment(0.2)],
... )
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.materials import naming
from diffopt.materials.base import Material, floating
from diffopt.materials.checking import within
from diffopt.materials.combined import Emission
from diffopt.materials.diffuse import Lambert
from diffopt.scenes import shapes, transforms, world
from diffopt.scenes.channels import Channels, wavelengths_of
from diffopt.scenes.lights import Environment, Light, LobeEnvironment
from diffopt.scenes.textures import Textured

_SHAPES = (shapes.Sphere, shapes.Disc, shapes.Plane, shapes.Box, shapes.Mesh)


class Place(eqx.Module):
    """A shape where it stands: what rays meet. Equal places are the same geometry."""

    shape: Any = eqx.field(static=True)
    matrix: tuple[float, ...] = eqx.field(static=True)
    tangent: tuple[float, ...] | None = eqx.field(static=True)


class Object(eqx.Module):
    """A shape of one material in its place.

    Parameters
    ----------
    shape
        `Sphere`, `Disc`, `Plane`, `Box`, or a mesh (`load_mesh`).
    material
        A material of `diffopt.materials`, a `Textured` one, or the name of one (as the
        command line has them: "gold", "glass"). `Emission` emits and scatters nothing.
    transform
        Matrix [4, 4], see `diffopt.scenes.transforms`; lengths in the scene's unit.
    emission
        Radiance that its front emits in all directions, a number or channels, at least 0.
    tangent
        Direction in the world along which the material's x axis lies, [3]; along the texture
        or around the z axis if left out.
    name
        For messages and files.

    Raises
    ------
    InputError
        If an argument is not of its kind, or the transform flattens space or stretches a
        sphere or disc.
    """

    place: Place
    material: Material | Textured
    emission: Float[Array, "..."] | None
    wavelengths: tuple[float, ...] | None = eqx.field(static=True)
    name: str = eqx.field(static=True)

    def __init__(
        self,
        shape: Any,
        material: Any,
        transform: Any = None,
        *,
        emission: Any = None,
        tangent: Any = None,
        name: str = "",
    ) -> None:
        """See the class."""
        if not isinstance(shape, _SHAPES):
            raise InputError(f"shape must be a Sphere, Disc, Plane, Box or mesh; received {shape}")
        if isinstance(material, str):
            material = naming.named(material).material
        if isinstance(material, Emission):
            emission = material.radiance if emission is None else emission
            material = Lambert(0.0)
        if not isinstance(material, Material | Textured):
            raise InputError(f"material must be a material or its name; received {material}")
        matrix = transforms.checked(transform)
        if isinstance(shape, shapes.Sphere | shapes.Disc):
            transforms.similarity(matrix)
        along = None if tangent is None else tuple(transforms.unit("tangent", tangent).tolist())
        self.place = Place(shape, tuple(matrix.reshape(-1).tolist()), along)
        self.material = material
        self.emission = None if emission is None else floating(emission)
        if self.emission is not None:
            within("emission", self.emission, 0.0, math.inf)
        self.name = name
        inner = material.material if isinstance(material, Textured) else material
        lam = wavelengths_of(inner)
        self.wavelengths = None if lam is None else tuple(lam.tolist())

    @property
    def patch(self) -> shapes.Triangles | shapes.Round:
        """Its shape in the world."""
        return _patch(self.place)


def area_light(
    width: float = 1.0,
    height: float = 1.0,
    transform: Any = None,
    *,
    radiance: Any = 1.0,
    name: str = "light",
) -> Object:
    """A rectangle that emits light from its front (z, before the transform) and reflects none.

    Parameters
    ----------
    width, height
        Along x and y, in the scene's unit.
    transform, name
        As of `Object`.
    radiance
        A number, RGB or channels of the scene, at least 0.
    """
    shape = shapes.Plane(width, height)
    return Object(shape, Lambert(0.0), transform, emission=radiance, name=name)


class Scene(eqx.Module):
    """Objects and lights, and the channels that they are rendered in.

    Differentiable in everything that its arrays hold: materials, emission and lights, at
    fixed visibility.

    Parameters
    ----------
    objects
        `Object`s.
    lights
        Of `diffopt.scenes.lights`; at most one environment.
    wavelengths
        Micrometres, [L], L >= 2, ascending, for a spectral scene; None for linear RGB.

    Raises
    ------
    InputError
        If something is neither an object nor a light, or its channels are not known to the
        scene; names the object.
    """

    objects: tuple[Object, ...]
    lights: tuple[Light, ...]
    channels: Channels

    def __init__(
        self,
        objects: Sequence[Any],
        lights: Sequence[Any] = (),
        *,
        wavelengths: Any = None,
    ) -> None:
        """See the class."""
        self.objects, self.lights = tuple(objects), tuple(lights)
        self.channels = Channels(wavelengths)
        for k, one in enumerate(self.objects):
            if not isinstance(one, Object):
                raise InputError(f"objects[{k}] must be an Object; received {type(one).__name__}")
            try:
                self._known(one)
            except InputError as error:
                raise InputError(f"object {one.name or k}: {error}") from None
        for k, light in enumerate(self.lights):
            if not isinstance(light, Light):
                raise InputError(f"lights[{k}] must be a light; received {type(light).__name__}")
        around = [x for x in self.lights if isinstance(x, Environment | LobeEnvironment)]
        if len(around) > 1:
            raise InputError(f"a scene has at most one environment; received {len(around)}")

    def _known(self, one: Object) -> None:
        """Refuse channels that the scene cannot convert."""
        channels = one.material.channels
        if channels:
            self.channels.matrix(channels[0], one.wavelengths)
        if one.emission is not None:
            self.channels.values("emission", one.emission)

    @property
    def environment(self) -> Environment | LobeEnvironment | None:
        """The light that surrounds the scene, if there is one."""
        found = [x for x in self.lights if isinstance(x, Environment | LobeEnvironment)]
        return found[0] if found else None

    @property
    def geometry(self) -> "Geometry":
        """All shapes, made once for equal places."""
        return _geometry(tuple(one.place for one in self.objects))

    def emission(self) -> Float[Array, "O C"]:
        """Radiance that each object's front emits, in the scene's channels."""
        rows = [
            jnp.zeros(self.channels.count)
            if one.emission is None
            else self.channels.values("emission", one.emission)
            for one in self.objects
        ]
        return jnp.stack(rows) if rows else jnp.zeros((0, self.channels.count))


class Geometry:
    """The shapes of a scene: arrays, bounds, and who owns what; see `World`.

    Attributes
    ----------
    world
        Arrays in float64, on the host.
    owner
        Object of each primitive, [P].
    centre, radius
        Of a ball that holds everything.
    """

    def __init__(self, places: tuple[Place, ...]) -> None:
        patches = [_patch(place) for place in places]
        self.world = world.build(patches)
        self.owner = world.owners(patches)
        ends = [np.zeros((0, 3)), np.asarray(self.world.vertices)]
        centres, radii = np.asarray(self.world.centres), np.asarray(self.world.radii)[:, None]
        corners = np.concatenate([*ends, centres - radii, centres + radii])
        low, high = (
            (corners.min(axis=0), corners.max(axis=0)) if len(corners) else (np.zeros(3),) * 2
        )
        self.centre = 0.5 * (low + high)
        self.radius = float(np.linalg.norm(high - low)) / 2.0 or 1.0

    @functools.cached_property
    def areas(self) -> Float[np.ndarray, " P"]:
        """Of the primitives."""
        corners = np.asarray(self.world.vertices)[np.asarray(self.world.faces)]
        sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        triangles = 0.5 * np.linalg.norm(np.cross(*sides), axis=-1)
        radii = np.asarray(self.world.radii)
        ball = np.arange(len(radii)) < self.world.spheres
        return np.concatenate([triangles, np.where(ball, 4.0, 1.0) * math.pi * radii**2])

    def typed(self, dtype: Any) -> world.World:
        """Arrays on the device in a floating type."""
        return _typed(self, np.dtype(dtype).name)


@functools.lru_cache(maxsize=64)
def _patch(place: Place) -> shapes.Triangles | shapes.Round:
    return shapes.placed(place.shape, np.reshape(place.matrix, (4, 4)), place.tangent)


@functools.lru_cache(maxsize=8)
def _geometry(places: tuple[Place, ...]) -> Geometry:
    return Geometry(places)


@functools.lru_cache(maxsize=16)
def _typed(geometry: Geometry, dtype: str) -> world.World:
    import jax

    def moved(array: Any) -> Array:
        return jnp.asarray(array, dtype if array.dtype.kind == "f" else array.dtype)

    return jax.tree.map(moved, world.padded(geometry.world))
