"""A scene prepared for rendering: shapes, materials and lights as arrays of one type."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.rendering import sources
from diffopt.rendering.groups import Group, grouped
from diffopt.rendering.sources import Sources
from diffopt.scenes import raycasting
from diffopt.scenes.raycasting import Hits
from diffopt.scenes.scene import Scene
from diffopt.scenes.world import World, lengthened


@dataclasses.dataclass(frozen=True, init=False, eq=False)
class Stage:
    """What rays are traced in.

    Attributes
    ----------
    world
        The shapes.
    groups
        The materials.
    group, member, owner
        Of each primitive, [P]; `member` is padded as the world is. `owner` is its object.
    sources
        The lights.
    offset
        How far from a surface rays leave it.
    held
        Materials of another scene that directions are drawn by, for derivatives; else None.
    """

    world: World
    groups: tuple[Group, ...]
    group: Int[np.ndarray, " P"]
    member: Int[Array, " P"]
    owner: Int[np.ndarray, " P"]
    sources: Sources
    offset: Float[Array, ""]
    held: tuple[Group, ...] | None

    def __init__(self, scene: Scene, dtype: Any = "float32", *, held: Scene | None = None) -> None:
        """Prepare a scene; differentiable in its arrays.

        Parameters
        ----------
        scene
            What is rendered.
        dtype
            Floating type of the arrays.
        held
            The scene that a record was made of, of which this one is a variation: directions,
            lights and their densities are chosen as there.
        """
        geometry = scene.geometry
        found = grouped(scene, dtype)
        owner = geometry.owner
        group = np.asarray(found.group, np.int32)[owner] if len(owner) else owner
        member = np.asarray(found.member, np.int32)[owner] if len(owner) else owner
        lights = sources.gather(scene, dtype)
        if held is not None:
            lights = sources.chosen_as(lights, sources.gather(held, dtype))
        fields = {
            "world": geometry.typed(dtype),
            "groups": found.groups,
            "group": group,
            "member": jnp.asarray(lengthened(member)),
            "owner": owner,
            "sources": lights,
            "offset": jnp.asarray(raycasting.OFFSET * geometry.radius, dtype),
            "held": None if held is None else grouped(held, dtype).groups,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    @property
    def channels(self) -> int:
        """Number of the scene's channels."""
        return self.sources.ambient.shape[0]

    @property
    def dtype(self) -> Any:
        """Floating type."""
        return self.offset.dtype

    def by_group(
        self, rows: Int[np.ndarray, " n"], hits: Hits
    ) -> Iterator[tuple[int, Group, Int[np.ndarray, " m"]]]:
        """Number of a group, the group, and rows whose rays meet its surfaces."""
        met = hits.primitive[rows]
        rows, met = rows[met >= 0], met[met >= 0]
        kinds = self.group[met]
        for k, group in enumerate(self.groups):
            here = rows[kinds == k]
            if len(here):
                yield k, group, here
