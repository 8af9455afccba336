"""Sums of materials, scaled materials, and surfaces that emit light."""

import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.materials.base import Material, Sample, floating, mask, times
from diffopt.materials.checking import within
from diffopt.materials.diffuse import Lambert, OrenNayar


class Scaled(Material):
    """A material whose values are multiplied by a factor.

    Parameters
    ----------
    material
        What is scaled.
    factor
        At least 0; a number, or channels that broadcast with those of the material.
    """

    material: Material
    factor: Float[Array, "..."] = eqx.field(converter=floating)

    def __check_init__(self) -> None:
        """Check the factor, where it is known."""
        within("factor", self.factor, 0.0, np.inf)

    @property
    def reciprocal(self) -> bool:
        """See `Material`."""
        return self.material.reciprocal

    @property
    def conserves_energy(self) -> bool:
        """See `Material`."""
        known = checks.concrete(self.factor)
        small = known is not None and bool((known <= 1.0).all())
        return small and self.material.conserves_energy

    @property
    def delta(self) -> bool:
        """See `Material`."""
        return self.material.delta

    @property
    def smooth(self) -> bool:
        """See `Material`."""
        return self.material.smooth

    @property
    def transmits(self) -> bool:
        """See `Material`."""
        return self.material.transmits

    def coherent(self, wo: Array) -> tuple[Sample, ...]:
        """See `Material`."""
        return tuple(
            Sample(s.wi, self._scaled(s.weight, wo.ndim - 1), s.pdf, s.delta)
            for s in self.material.coherent(wo)
        )

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return np.broadcast_shapes(self.material.channels, self.factor.shape)

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return self._scaled(self.material.value(wi, wo), wi.ndim - 1)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return self.material.density(wi, wo)

    def warp(self, u: Array, wo: Array) -> Array:
        """See `Material`."""
        return self.material.warp(u, wo)

    def scatter(self, u: Array, wo: Array) -> Sample:
        """See `Material`."""
        sample = self.material.scatter(u, wo)
        weight = self._scaled(sample.weight, wo.ndim - 1)
        return Sample(sample.wi, weight, sample.pdf, sample.delta)

    def integrate(self, wo: Array, nodes: int) -> Array:
        """See `Material`."""
        return self._scaled(self.material.integrate(wo, nodes), 0)

    def _scaled(self, values: Array, batch: int) -> Array:
        values = aligned(values, batch, self.channels)
        return values * jnp.broadcast_to(self.factor, values.shape)


class Sum(Material):
    """Several materials on one surface, their values added.

    Parameters
    ----------
    parts
        At least one; each scalar, or all of the same channels.
    chances
        Probability with which sampling takes each part, [K], adding up to 1; equal by
        default. It changes the noise, not the result.
    """

    parts: tuple[Material, ...]
    chances: Float[Array, " K"]

    def __init__(self, parts: Any, chances: Any = None) -> None:
        """See the class."""
        self.parts = tuple(parts)
        if not self.parts:
            raise InputError("parts must hold at least one material; received none")
        count = len(self.parts)
        self.chances = floating(np.full(count, 1.0 / count) if chances is None else chances)
        if self.chances.shape != (count,):
            raise InputError(
                f"chances must be one for each of {count} parts; received {self.chances.shape}"
            )
        within("chances", self.chances, 0.0, 1.0)
        known = checks.concrete(self.chances)
        if known is not None and abs(float(known.sum()) - 1.0) > 1e-5:
            raise InputError(f"chances must add up to 1; received {float(known.sum()):g}")
        np.broadcast_shapes(*(part.channels for part in self.parts))

    @property
    def reciprocal(self) -> bool:
        """See `Material`."""
        return all(part.reciprocal for part in self.parts)

    @property
    def conserves_energy(self) -> bool:
        """Not known of a sum: its albedo is that of the parts together."""
        return len(self.parts) == 1 and self.parts[0].conserves_energy

    @property
    def delta(self) -> bool:
        """See `Material`."""
        return any(part.delta for part in self.parts)

    @property
    def smooth(self) -> bool:
        """See `Material`."""
        return any(part.smooth for part in self.parts)

    @property
    def transmits(self) -> bool:
        """See `Material`."""
        return any(part.transmits for part in self.parts)

    def coherent(self, wo: Array) -> tuple[Sample, ...]:
        """See `Material`."""
        seen = wo[..., 2] > 0.0
        found = []
        for part in self.parts:
            for sample in part.coherent(wo):
                weight = sample.weight if part.transmits else mask(seen, sample.weight)
                weight = aligned(weight, wo.ndim - 1, self.channels)
                found.append(Sample(sample.wi, weight, sample.pdf, sample.delta))
        return tuple(found)

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return np.broadcast_shapes(*(part.channels for part in self.parts))

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return self._total([part._reflected(wi, wo) for part in self.parts], wi.ndim - 1)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        seen = wo[..., 2] > 0.0
        densities = []
        for part in self.parts:
            found = part.density(wi, wo)
            densities.append(found if part.transmits else jnp.where(seen, found, 0.0))
        return jnp.tensordot(self.chances, jnp.stack(densities), 1, precision="highest")

    def scatter(self, u: Array, wo: Array) -> Sample:
        """See `Material`."""
        ends = jnp.cumsum(self.chances)
        starts = ends - self.chances
        index = jnp.clip(
            (u[..., 2:] >= ends.reshape((1,) * (u.ndim - 1) + (-1,))).sum(-1),
            0,
            len(self.parts) - 1,
        )
        # What is left of the third number within its share serves the part's own choice.
        rest = jnp.clip((u[..., 2] - starts[index]) / self.chances[index], 0.0, 1.0)
        inner = jnp.concatenate([u[..., :2], rest[..., None]], -1)
        drawn = [part.scatter(inner, wo) for part in self.parts]
        wi, delta, alone = drawn[0].wi, drawn[0].delta, drawn[0].pdf
        colour = aligned(drawn[0].weight, wo.ndim - 1, self.channels)
        for k, sample in enumerate(drawn[1:], 1):
            here = index == k
            wi = jnp.where(here[..., None], sample.wi, wi)
            delta = jnp.where(here, sample.delta, delta)
            alone = jnp.where(here, sample.pdf, alone)
            wide = aligned(sample.weight, wo.ndim - 1, self.channels)
            colour = jnp.where(here.reshape(here.shape + (1,) * len(self.channels)), wide, colour)
        pdf = self.density(wi, wo)
        seen = pdf > 0.0
        ratio = jnp.where(seen, jnp.abs(wi[..., 2]) / jnp.where(seen, pdf, 1.0), 0.0)
        smooth = aligned(times(ratio, self._reflected(wi, wo)), wo.ndim - 1, self.channels)
        chance = self.chances[index]
        single = times(1.0 / chance, colour)
        return Sample(
            wi,
            mask(delta, single) + mask(~delta, smooth),
            jnp.where(delta, alone * chance, pdf),
            delta,
        )

    def integrate(self, wo: Array, nodes: int) -> Array:
        """See `Material`."""
        seen = wo[2] > 0.0
        parts = []
        for part in self.parts:
            found = part.integrate(wo, nodes)
            parts.append(found if part.transmits else jnp.where(seen, found, 0.0))
        return self._total(parts, 0)

    def _total(self, values: list[Array], batch: int) -> Array:
        return functools.reduce(jnp.add, [aligned(v, batch, self.channels) for v in values])


class Emission(Material):
    """A surface that emits light and scatters none.

    Parameters
    ----------
    radiance
        W / (m^2 sr), or any unit of radiance: a number or channels [C], at least 0; the same
        in all directions above the horizon.
    """

    radiance: Float[Array, "..."] = eqx.field(converter=floating, default=1.0)

    def __check_init__(self) -> None:
        """Check the radiance, where it is known."""
        within("radiance", self.radiance, 0.0, np.inf)

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.radiance.shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return jnp.zeros((*wi.shape[:-1], *self.channels), wi.dtype)

    def emitted(self, wo: Float[Array, "*batch 3"]) -> Float[Array, "..."]:
        """Radiance that leaves in directions, [..., *C]; 0 below the horizon."""
        above = (wo[..., 2] > 0.0).astype(wo.dtype)
        colour = self.radiance.astype(wo.dtype)
        return times(above, colour.reshape((1,) * above.ndim + colour.shape))


def matte_part(material: Material) -> Material | None:
    """What a material scatters evenly: Lambert's and Oren and Nayar's parts of it.

    Returns
    -------
    Material or None
        The material itself where it is all of that kind, the sum of such parts, or None.
    """
    if isinstance(material, Lambert | OrenNayar):
        return material
    if isinstance(material, Scaled):
        part = matte_part(material.material)
        if part is None or part is material.material:
            return material if part is not None else None
        return Scaled(part, material.factor)
    if isinstance(material, Sum):
        found = [matte_part(part) for part in material.parts]
        kept = tuple(part for part in found if part is not None)
        if all(a is b for a, b in zip(found, material.parts, strict=True)):
            return material
        return kept[0] if len(kept) == 1 else Sum(kept) if kept else None
    return None


def aligned(values: Array, batch: int, channels: tuple[int, ...]) -> Array:
    """Values [*batch, *C] broadcast to channels, those of a sum where parts have fewer."""
    shape, own = values.shape[:batch], values.shape[batch:]
    values = values.reshape(shape + (1,) * (len(channels) - len(own)) + own)
    return jnp.broadcast_to(values, (*shape, *channels))
