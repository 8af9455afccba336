"""Light from infinity whose average over von Mises-Fisher lobes has a closed form.

Each has ``radiance(mu, kappa)``, the integral of L(s) gamma(s; mu, kappa) over the sphere for axes
mu [..., 3] (unit vectors, in the world) and concentrations kappa [...] >= 0, in channels [..., C];
is differentiable in its values, in mu and in kappa; and is turned and scaled at next to no cost.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels import harmonics, lobe_harmonics, vmf, vmf_pairs
from diffopt.kernels.frames import dot

Axes = Float[Array, "*batch 3"]
Scalars = Float[Array, "*batch"]
Radiance = Float[Array, "*batch C"]


class Even(eqx.Module):
    """Light that is the same from all directions.

    Attributes
    ----------
    value
        Radiance, [C].
    """

    value: Float[Array, " C"]

    def radiance(self, mu: Axes, kappa: Scalars) -> Radiance:
        """Radiance averaged over lobes: the same for all."""
        return jnp.broadcast_to(self.value, (*kappa.shape, *self.value.shape))

    def turned(self, rotation: Float[Array, "3 3"]) -> "Even":
        """The light turned in the world by a rotation matrix."""
        return self

    def scaled(self, factor: Any) -> "Even":
        """The light times a factor."""
        return Even(_times(self.value, factor))


class Suns(eqx.Module):
    """Parallel light: lobes of infinite concentration.

    Attributes
    ----------
    towards
        Directions from the scene to the light, unit vectors, [S, 3].
    irradiance
        On surfaces that face them, [S, C].
    """

    towards: Float[Array, "S 3"]
    irradiance: Float[Array, "S C"]

    def radiance(self, mu: Axes, kappa: Scalars) -> Radiance:
        """Sum of irradiance times density of the lobes towards the light."""
        towards = _beside(self.towards, kappa.ndim)
        found = vmf.pdf(towards, mu[..., None, :], kappa[..., None])
        return jnp.matmul(found, self.irradiance, precision="highest")

    def turned(self, rotation: Float[Array, "3 3"]) -> "Suns":
        """The light turned in the world by a rotation matrix."""
        return Suns(_turned(self.towards, rotation), self.irradiance)

    def scaled(self, factor: Any) -> "Suns":
        """The light times a factor."""
        return Suns(self.towards, _times(self.irradiance, factor))


class LobeLight(eqx.Module):
    """Light as a sum of lobes: the integral of the product of two lobes has a closed form.

    Attributes
    ----------
    alpha
        Integral of each lobe over the sphere, [K, C].
    mu, kappa
        Axes, unit vectors, [K, 3]; concentrations, [K].
    """

    alpha: Float[Array, "K C"]
    mu: Float[Array, "K 3"]
    kappa: Float[Array, " K"]

    def radiance(self, mu: Axes, kappa: Scalars) -> Radiance:
        """Radiance averaged over lobes, exact."""
        own = _beside(self.mu, kappa.ndim), _beside(self.kappa, kappa.ndim)
        inner = vmf_pairs.log_inner(mu[..., None, :], kappa[..., None], *own)
        return jnp.matmul(jnp.exp(inner), self.alpha, precision="highest")

    def turned(self, rotation: Float[Array, "3 3"]) -> "LobeLight":
        """The light turned in the world by a rotation matrix."""
        return LobeLight(self.alpha, _turned(self.mu, rotation), self.kappa)

    def scaled(self, factor: Any) -> "LobeLight":
        """The light times a factor."""
        return LobeLight(_times(self.alpha, factor), self.mu, self.kappa)


class HarmonicLight(eqx.Module):
    """Light in spherical harmonics, which lobes damp degree by degree.

    Attributes
    ----------
    coefficients
        [L^2, C].
    frame
        From the world to the frame of the harmonics, [3, 3].
    """

    coefficients: Float[Array, "L2 C"]
    frame: Float[Array, "3 3"]

    def radiance(self, mu: Axes, kappa: Scalars) -> Radiance:
        """Radiance averaged over lobes, of the bands."""
        bands = harmonics.bands_of(self.coefficients)
        local = jnp.stack([dot(mu, axis) for axis in self.frame], -1)
        shares = lobe_harmonics.ratios(kappa, bands)[harmonics.degrees(bands)]
        values = harmonics.basis(local, bands) * shares
        found = jnp.tensordot(self.coefficients, values, (0, 0), precision="highest")
        return jnp.moveaxis(found, 0, -1)

    def turned(self, rotation: Float[Array, "3 3"]) -> "HarmonicLight":
        """The light turned in the world by a rotation matrix."""
        frame = jnp.matmul(self.frame, rotation.T, precision="highest")
        return HarmonicLight(self.coefficients, frame)

    def scaled(self, factor: Any) -> "HarmonicLight":
        """The light times a factor."""
        return HarmonicLight(_times(self.coefficients, factor), self.frame)


class Lights(eqx.Module):
    """Several lights together.

    Attributes
    ----------
    parts
        At least one.
    """

    parts: tuple[Any, ...]

    def radiance(self, mu: Axes, kappa: Scalars) -> Radiance:
        """Radiance averaged over lobes: the sum over the lights."""
        total = self.parts[0].radiance(mu, kappa)
        for part in self.parts[1:]:
            total = total + part.radiance(mu, kappa)
        return total

    def turned(self, rotation: Float[Array, "3 3"]) -> "Lights":
        """The light turned in the world by a rotation matrix."""
        return Lights(tuple(part.turned(rotation) for part in self.parts))

    def scaled(self, factor: Any) -> "Lights":
        """The light times a factor."""
        return Lights(tuple(part.scaled(factor) for part in self.parts))


def _beside(array: Array, batch: int) -> Array:
    """With axes of one before its own."""
    return array.reshape((1,) * batch + array.shape)


def _times(values: Array, factor: Any) -> Array:
    return values * jnp.asarray(factor).astype(values.dtype)


def _turned(directions: Array, rotation: Array) -> Array:
    return jnp.matmul(directions, rotation.T, precision="highest")
