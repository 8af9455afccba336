"""Albedos of a scene's materials, for light that comes evenly from all sides.

Only what they scatter is counted: perfect mirrors and glass show what rays meet behind them.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.rendering.groups import Group
from diffopt.rendering.shading import Meeting
from diffopt.scenes.textures import Textured

# Cosines of a table, and nodes on a side of the quadrature of each.
_COSINES = 48
_NODES = 32
# Nodes where every point has parameters of its own.
_FEW = 8


class Albedos(eqx.Module):
    """Albedo of the materials of a group over the cosine to the viewer.

    Attributes
    ----------
    table
        At equal steps of the cosine from `low` to 1, [members, K, C]; None where it is
        computed for each point.
    low
        0, or -1 for materials with an inside.
    """

    table: Float[Array, "m K C"] | None
    low: float = eqx.field(static=True)

    def at(self, group: Group, met: Meeting) -> Float[Array, "n C"]:
        """Albedo where rays meet the group.

        Directions off the material's x axis take the value of those along it; an anisotropic
        material's albedo differs by little.
        """
        if self.table is None:

            def few(material: Any, wo: Array) -> Array:
                return scattered(material, wo, _FEW)

            return group.converted(group.each(few, met.member, met.surface, met.wo))
        count = self.table.shape[1]
        place = (met.wo[:, 2] - self.low) * ((count - 1) / (1.0 - self.low))
        left = jnp.clip(jnp.floor(place).astype(jnp.int32), 0, count - 2)
        share = jnp.clip(place - left.astype(place.dtype), 0.0, 1.0)[:, None]
        member = met.member if group.stacked else jnp.zeros_like(met.member)
        below, above = self.table[member, left], self.table[member, left + 1]
        return (1.0 - share) * below + share * above


def scattered(material: Any, wo: Float[Array, "3"], nodes: int) -> Float[Array, "..."]:
    """Albedo of a material without its coherent lobes."""
    if not material.smooth:
        return jnp.zeros(material.channels, wo.dtype)
    whole = material.integrate(wo, nodes)
    return whole - sum((lobe.weight for lobe in material.coherent(wo)), jnp.zeros_like(whole))


@eqx.filter_jit
def albedos(group: Group) -> Albedos:
    """Albedos of a group; differentiable."""
    low = -1.0 if group.transmits else 0.0
    if isinstance(group.material, Textured):
        return Albedos(None, low)
    leaves = [leaf for leaf in jax.tree.leaves(group.material) if eqx.is_inexact_array(leaf)]
    dtype = leaves[0].dtype if leaves else jnp.float32
    cos = np.linspace(low, 1.0, _COSINES)
    # At the horizon itself nothing is defined.
    cos = np.where(np.abs(cos) < 1e-3, 1e-3, cos)
    wo = np.stack([np.sqrt(1.0 - cos * cos), np.zeros_like(cos), cos], -1)
    wo = jnp.asarray(wo, dtype)

    def one(material: Any) -> Array:
        found = jax.lax.map(lambda w: scattered(material, w, _NODES), wo, batch_size=8)
        return group.converted(found)

    if group.stacked:
        return Albedos(jax.lax.map(one, group.material), low)
    return Albedos(one(group.material)[None], low)
