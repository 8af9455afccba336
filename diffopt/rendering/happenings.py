"""What comes to pass where light meets surfaces, told apart: matte and glossy, mirror and glass.

A material's matte part is known in closed form. Light that a source sends is divided between
the two parts exactly; a direction that was drawn belongs to one of them by a chance that is the
part's share of the light, so that means over paths divide exactly too.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from diffopt.materials.base import Sample
from diffopt.materials.combined import aligned, matte_part
from diffopt.rendering import effects
from diffopt.rendering.families import Beams, Points
from diffopt.rendering.groups import Group
from diffopt.rendering.shading import Meeting, Shadow
from diffopt.rendering.sources import Sources


class Parts(eqx.Module):
    """What came to pass at n rows of rays.

    Attributes
    ----------
    matte
        Share of the drawn light that the matte part scatters, [n, C].
    weight
        Weight that the drawn light has beside the light that paths meet, [n].
    soft
        Whether it was drawn from surfaces or surroundings, [n]: 1 or 0.
    ambient
        What arrives of ambient light, [n, C].
    kind
        Of what happened to the path: `effects.MATTE` and so on, [n].
    """

    matte: Float[Array, "n C"]
    weight: Float[Array, " n"]
    soft: Int[Array, " n"]
    ambient: Float[Array, "n C"]
    kind: Int[Array, " n"]

    @staticmethod
    def blank(nothing: Shadow) -> "Parts":
        """Nothing came to pass; of as many rows as a `Shadow` has."""
        none, count = nothing.value, len(nothing.length)
        number = jnp.zeros(count, jnp.int32)
        return Parts(none, jnp.ones(count, none.dtype), number, none, number)

    def drawn(
        self,
        group: Group,
        met: Meeting,
        towards: Float[Array, "n 3"],
        weight: Float[Array, " n"],
        u: Float[Array, " n"],
        sources: Sources,
    ) -> "Parts":
        """With light of one source; `u` chose its family, see `Sources.draw`."""
        wi = met.surface.local(towards)
        share = _matte(group, met, wi)
        family = (u[:, None] >= jnp.cumsum(sources.chances)[None, :-1]).sum(1)
        hard = [isinstance(one, Beams | Points) for one in sources.families]
        soft = jnp.asarray([0 if one else 1 for one in hard], jnp.int32)[family]
        return dataclasses.replace(self, matte=share, weight=weight.astype(u.dtype), soft=soft)

    def scattered(
        self,
        group: Group,
        met: Meeting,
        sample: Sample,
        weight: Float[Array, "n C"],
        u: Float[Array, " n"],
    ) -> tuple["Parts", Float[Array, "n C"]]:
        """With a direction that was drawn, and its weight for the part that it fell to."""
        part = matte_part(group.kind)
        kind = jnp.full(u.shape, effects.MATTE if part is group.kind else effects.GLOSSY)
        if part is not None and part is not group.kind:
            share = _matte(group, met, sample.wi)
            # One chance for all channels: the part's share of their sum.
            total = weight.sum(1)
            chance = (share * weight).sum(1) / jnp.where(total > 0.0, total, 1.0)
            chance = jnp.clip(chance, 0.0, 1.0)
            matte = u < chance
            kind = jnp.where(matte, effects.MATTE, effects.GLOSSY)
            own = jnp.where(matte[:, None], share, 1.0 - share)
            taken = jnp.where(matte, chance, 1.0 - chance)
            split = weight * own / jnp.where(taken > 0.0, taken, 1.0)[:, None]
            weight = jnp.where(sample.delta[:, None], weight, split)
        if group.delta:
            through = sample.wi[:, 2] * met.wo[:, 2] < 0.0
            single = jnp.where(through, effects.TRANSMITTED, effects.REFLECTED)
            kind = jnp.where(sample.delta, single, kind)
        return dataclasses.replace(self, kind=kind.astype(jnp.int32)), weight


def _matte(group: Group, met: Meeting, wi: Float[Array, "n 3"]) -> Float[Array, "n C"]:
    """Share of the scattered light that is the matte part's."""
    part = matte_part(group.kind)
    shape = (wi.shape[0], group.channels)
    if part is None or part is group.kind:
        return jnp.full(shape, 0.0 if part is None else 1.0, wi.dtype)

    def both(material: Any, wi: Array, wo: Array) -> tuple[Array, Array]:
        own = matte_part(material)
        assert own is not None
        matte = aligned(own._reflected(wi, wo), wi.ndim - 1, material.channels)
        return matte, material._reflected(wi, wo)

    matte, whole = (
        group.converted(x) for x in group.each(both, met.member, met.surface, wi, met.wo)
    )
    return jnp.where(whole > 0.0, matte / jnp.where(whole > 0.0, whole, 1.0), 0.0)
