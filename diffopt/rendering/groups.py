"""Materials of a scene, grouped so that one compiled program serves all of a kind.

Materials that differ in their numbers only are stacked; each ray then brings the numbers of
its own. Large ones, as measured tables, and textured ones are groups of their own.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from diffopt.materials.base import Material
from diffopt.scenes.scene import Object, Scene
from diffopt.scenes.textures import Textured
from diffopt.scenes.world import Surface

# A material of more numbers is not copied for each ray.
_SMALL = 256


class Group(eqx.Module):
    """Materials of one kind.

    Attributes
    ----------
    material
        One material, a textured one, or one whose arrays have a first axis for the members.
    stacked
        Whether it has that axis.
    matrix
        From the material's channels to the scene's; None where they are the same.
    channels
        Number of the scene's channels.
    """

    material: Any
    stacked: bool = eqx.field(static=True)
    matrix: Float[Array, "c C"] | None
    channels: int = eqx.field(static=True)

    @property
    def kind(self) -> Material:
        """A material that declares what all of them do."""
        return self.material.material if isinstance(self.material, Textured) else self.material

    @property
    def transmits(self) -> bool:
        """Whether light passes them."""
        return self.kind.transmits

    @property
    def delta(self) -> bool:
        """Whether they have lobes in single directions."""
        return self.kind.delta

    def each(
        self,
        function: Callable[..., Any],
        member: Int[Array, " n"],
        surface: Surface,
        *rows: Array,
        beside: "Group | None" = None,
    ) -> Any:
        """A function of a material and rows, with the material of each row.

        Parameters
        ----------
        function
            Takes a material and one row of each array, or all rows at once.
        member
            Number of the material within the group, [n].
        surface
            Where the rows lie, for textures.
        rows
            Arrays [n, ...].
        beside
            The same group with other numbers, whose material the function takes second.
        """
        groups = [self] if beside is None else [self, beside]
        materials, axes = zip(*(one._at(member, surface) for one in groups), strict=True)
        if all(axis is None for axis in axes):
            return function(*materials, *rows)
        return jax.vmap(function, in_axes=(*axes, *(0 for _ in rows)))(*materials, *rows)

    def _at(self, member: Array, surface: Surface) -> tuple[Any, Any]:
        """The material of each row, and which of its arrays have an axis for the rows."""
        if isinstance(self.material, Textured):
            return self.material.at(surface.uv, surface.element)
        if self.stacked:
            return jax.tree.map(lambda a: a[member], self.material), 0
        return self.material, None

    def converted(self, values: Float[Array, "n ..."]) -> Float[Array, "n C"]:
        """Values [n], [n, 1] or [n, c] as channels of the scene."""
        wide = values[:, None] if values.ndim == 1 else values
        if self.matrix is None:
            return jnp.broadcast_to(wide, (wide.shape[0], self.channels))
        return jnp.matmul(wide, self.matrix, precision="highest")


class Grouping(eqx.Module):
    """Groups, and where each object's material is: group and number within, [O]."""

    groups: tuple[Group, ...]
    group: tuple[int, ...] = eqx.field(static=True)
    member: tuple[int, ...] = eqx.field(static=True)


def grouped(scene: Scene, dtype: Any) -> Grouping:
    """The materials of a scene in a floating type; differentiable."""
    places: dict[Any, int] = {}
    parts: list[list[Any]] = []
    group, member = [], []
    for k, one in enumerate(scene.objects):
        key = _kind(one)
        # Where nothing is shared, the object's own number is its kind.
        at = places.setdefault(key if key is not None else k, len(parts))
        if at == len(parts):
            parts.append([])
        group.append(at)
        member.append(len(parts[at]))
        parts[at].append(one)
    return Grouping(
        tuple(_group(members, scene, dtype) for members in parts), tuple(group), tuple(member)
    )


def _kind(one: Object) -> Any:
    """What objects whose materials can be stacked have in common; None where they cannot."""
    material = one.material
    leaves, structure = jax.tree.flatten(material)
    if isinstance(material, Textured) or not all(eqx.is_inexact_array(leaf) for leaf in leaves):
        return None
    if sum(leaf.size for leaf in leaves) > _SMALL:
        return None
    return structure, one.wavelengths, tuple(leaf.shape for leaf in leaves)


def _group(members: list[Object], scene: Scene, dtype: Any) -> Group:
    def typed(material: Any) -> Any:
        return jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, material)

    first = typed(members[0].material)
    channels, matrix = members[0].material.channels, None
    if channels:
        matrix = scene.channels.matrix(channels[0], members[0].wavelengths)
    matrix = None if matrix is None else jnp.asarray(matrix, dtype)
    if len(members) == 1:
        return Group(first, False, matrix, scene.channels.count)
    # Up to a power of two, so that scenes of other sizes share a program.
    count = 1 << (len(members) - 1).bit_length()
    materials = [typed(one.material) for one in members]
    materials += materials[-1:] * (count - len(members))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *materials)
    return Group(stacked, True, matrix, scene.channels.count)
