"""Parameters of a material that vary over an object: by the texture or by the face.

>>> checks = Texture(image)                      # [H, W] or [H, W, C], linear
>>> floor = Object(Plane(4, 4), Textured(Lambert(), colour=checks))
"""

import abc
import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt import checks
from diffopt.errors import InputError
from diffopt.materials.base import Material, floating


class Map(eqx.Module):
    """A quantity that varies over an object."""

    @abc.abstractmethod
    def at(self, uv: Float[Array, "n 2"], element: Int[Array, " n"]) -> Float[Array, "n ..."]:
        """Values at texture coordinates and faces, [n, *C]."""

    @abc.abstractmethod
    def channels(self) -> tuple[int, ...]:
        """Shape of a value."""

    @abc.abstractmethod
    def values(self) -> Float[Array, "..."]:
        """All values, to check their range."""


class Texture(Map):
    """Picture over the texture coordinates, repeated beyond [0, 1], between pixels bilinear.

    Parameters
    ----------
    pixels
        [H, W] or [H, W, C], linear; the first row is the top one, v = 1.
    repeat
        How often it lies along u and v.
    """

    pixels: Float[Array, "H W ..."] = eqx.field(converter=floating)
    repeat: tuple[float, float] = eqx.field(static=True, default=(1.0, 1.0))

    def __check_init__(self) -> None:
        """Check the shape, and that it is finite."""
        if self.pixels.ndim not in (2, 3) or 0 in self.pixels.shape:
            raise InputError(
                f"pixels of a texture must be [H, W] or [H, W, C]; received {self.pixels.shape}"
            )
        known = checks.concrete(self.pixels)
        if known is not None and not np.isfinite(known).all():
            raise InputError("pixels of a texture must be finite")

    def channels(self) -> tuple[int, ...]:
        """See `Map`."""
        return self.pixels.shape[2:]

    def values(self) -> Float[Array, "..."]:
        """See `Map`."""
        return self.pixels

    def at(self, uv: Array, element: Array) -> Array:
        """See `Map`."""
        height, width = self.pixels.shape[:2]
        x = uv[:, 0] * (self.repeat[0] * width) - 0.5
        y = (1.0 - uv[:, 1]) * (self.repeat[1] * height) - 0.5
        left, top = jnp.floor(x), jnp.floor(y)
        column, row = left.astype(jnp.int32), top.astype(jnp.int32)
        shape = (-1,) + (1,) * len(self.channels())
        s, t = (x - left).reshape(shape), (y - top).reshape(shape)

        def pixel(down: int, right: int) -> Array:
            return self.pixels[(row + down) % height, (column + right) % width]

        upper = (1.0 - s) * pixel(0, 0) + s * pixel(0, 1)
        lower = (1.0 - s) * pixel(1, 0) + s * pixel(1, 1)
        return (1.0 - t) * upper + t * lower


class PerFace(Map):
    """One value for each face of a mesh, [F] or [F, C], in the order of `Mesh.faces`.

    Planes have two faces, boxes twelve (two a side: +x, -x, +y, -y, +z, -z).
    """

    each: Float[Array, "F ..."] = eqx.field(converter=floating)

    def channels(self) -> tuple[int, ...]:
        """See `Map`."""
        return self.each.shape[1:]

    def values(self) -> Float[Array, "..."]:
        """See `Map`."""
        return self.each

    def at(self, uv: Array, element: Array) -> Array:
        """See `Map`."""
        return self.each[element]


class Textured(eqx.Module):
    """A material some of whose parameters vary over the object.

    Parameters
    ----------
    material
        The material; what is named below is replaced in it.
    **maps
        `Texture` or `PerFace` for parameters by their names, as ``colour=`` of `Lambert`.

    Raises
    ------
    InputError
        For a name that is no parameter of the material, or values that it does not take.
    """

    material: Material
    maps: dict[str, Map]

    def __init__(self, material: Material, **maps: Map) -> None:
        """See the class."""
        self.material, self.maps = material, dict(maps)
        if not maps:
            raise InputError("a textured material needs a map, such as colour=Texture(pixels)")
        for name, values in maps.items():
            if not eqx.is_inexact_array(getattr(material, name, None)):
                known = ", ".join(n for n, v in vars(material).items() if eqx.is_inexact_array(v))
                raise InputError(f"{name} is no parameter of {type(material).__name__}: {known}")
            if not isinstance(values, Map):
                raise InputError(f"{name} must be a Texture or PerFace; received {type(values)}")
            known = checks.concrete(values.values())
            extremes = [] if known is None else [known.min(), known.max()]
            try:
                for extreme in extremes:
                    # A new material, so that its own checks of ranges run.
                    dataclasses.replace(material, **{name: jnp.full(values.channels(), extreme)})
            except ValueError as error:
                raise InputError(f"{name}: {error}") from None

    @property
    def channels(self) -> tuple[int, ...]:
        """Shape of a value: of the material with any of its parameters."""
        first = {n: jnp.zeros(m.channels()) + 0.5 for n, m in self.maps.items()}
        return self._with(**first).channels

    def at(self, uv: Float[Array, "n 2"], element: Int[Array, " n"]) -> tuple[Material, Any]:
        """The material of each point, and which of its leaves have an axis for the points."""
        fields = {name: values.at(uv, element) for name, values in self.maps.items()}
        none = jax.tree.map(lambda _: None, self.material)
        axes = eqx.tree_at(
            lambda m: [getattr(m, name) for name in sorted(fields)],
            none,
            [0] * len(fields),
            is_leaf=lambda leaf: leaf is None,
        )
        return self._with(**fields), axes

    def _with(self, **fields: Array) -> Material:
        names = sorted(fields)
        return eqx.tree_at(
            lambda m: [getattr(m, name) for name in names],
            self.material,
            [fields[name] for name in names],
        )
