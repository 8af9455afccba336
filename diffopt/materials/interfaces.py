"""Interfaces of transparent media and mirrors: perfect ones as delta lobes, and rough ones.

The outside is above (z > 0), with index 1; ``eta`` is the index of the inside over that of the
outside. Radiance that crosses is multiplied by the square of the ratio of indices (the same
flux in another solid angle): 2.25 from air into glass, and back again on the way out, so that
energy is conserved over both. ``radiance=False`` leaves that factor out, as for light paths
(particles) that carry power.

Sources: Walter et al., "Microfacet models for refraction through rough surfaces" (EGSR 2007),
eq. 16-21; Veach, "Robust Monte Carlo methods for light transport simulation" (1997), sec. 5.2.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.fresnel import Constant, Reflectance
from diffopt.kernels import frames, fresnel, microfacet, reflectance
from diffopt.kernels.frames import dot
from diffopt.materials.base import Material, Sample, floating, unit_square
from diffopt.materials.checking import one_of, within
from diffopt.materials.microfacet import SODIUM, facet_reflectance, widths

SmithNormals = Literal["ggx", "beckmann"]


class Mirror(Material):
    """Perfect mirror: a delta lobe, so `f` and `pdf` are 0 and `sample` returns it.

    Parameters
    ----------
    fresnel
        Reflectance (`diffopt.fresnel`); 1 by default.
    wavelengths
        In micrometres: a number for a scalar material, [L] for a spectrum.
    """

    fresnel: Reflectance = eqx.field(default_factory=Constant)
    wavelengths: Float[Array, "..."] = eqx.field(converter=floating, default=SODIUM)

    @property
    def delta(self) -> bool:
        """See `Material`."""
        return True

    @property
    def smooth(self) -> bool:
        """See `Material`."""
        return False

    def coherent(self, wo: Array) -> tuple[Sample, ...]:
        """See `Material`."""
        return (self.scatter(wo, wo),)

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        one = jax.ShapeDtypeStruct((), self.wavelengths.dtype)
        return jax.eval_shape(self._reflectance, one).shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return jnp.zeros((*wi.shape[:-1], *self.channels), wi.dtype)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return jnp.zeros(wi.shape[:-1], wi.dtype)

    def scatter(self, u: Array, wo: Array) -> Sample:
        """See `Material`."""
        weight = self._reflectance(wo[..., 2])
        one = jnp.ones(wo.shape[:-1], wo.dtype)
        return Sample(reflectance.mirrored(wo), weight, one, jnp.full(one.shape, True))

    def _reflectance(self, cos: Array) -> Array:
        return facet_reflectance(self.fresnel, self.wavelengths, cos)


class _Interface(Material):
    """What smooth and rough interfaces of transparent media have in common."""

    @property
    def transmits(self) -> bool:
        """See `Material`."""
        return True

    @property
    def reciprocal(self) -> bool:
        """Radiance grows on the way in, power on the way out: f / eta_o^2 is symmetric."""
        return False

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return ()


class Dielectric(_Interface):
    """Smooth transparent interface: perfect reflection and refraction, both delta lobes.

    Parameters
    ----------
    eta
        Index of the inside over that of the outside, above 0.
    radiance
        See the module.
    """

    eta: Float[Array, ""] = eqx.field(converter=floating, default=1.5)
    radiance: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        """Check the index, where it is known."""
        within("eta", self.eta, 0.0, 100.0, above=True)

    @property
    def delta(self) -> bool:
        """See `Material`."""
        return True

    @property
    def smooth(self) -> bool:
        """See `Material`."""
        return False

    def coherent(self, wo: Array) -> tuple[Sample, ...]:
        """Reflection, and refraction; that has no weight where reflection is total."""
        m = relative_index(self.eta, wo)
        reflected = fresnel.dielectric(jnp.abs(wo[..., 2]), m)
        one = jnp.ones(reflected.shape, wo.dtype)
        every = jnp.full(one.shape, True)
        through = (1.0 - reflected) * _scale(m, self.radiance)
        return (
            Sample(reflectance.mirrored(wo), reflected, one, every),
            Sample(refracted(wo, m), through, one, every),
        )

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return jnp.zeros(wi.shape[:-1], wi.dtype)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        return jnp.zeros(wi.shape[:-1], wi.dtype)

    def scatter(self, u: Array, wo: Array) -> Sample:
        """See `Material`."""
        m = relative_index(self.eta, wo)
        cos = jnp.abs(wo[..., 2])
        reflected = fresnel.dielectric(cos, m)
        mirrors = u[..., 2] < reflected
        through = refracted(wo, m)
        scale = _scale(m, self.radiance)
        return Sample(
            jnp.where(mirrors[..., None], reflectance.mirrored(wo), through),
            jnp.where(mirrors, 1.0, scale),
            jnp.where(mirrors, reflected, 1.0 - reflected),
            jnp.full(cos.shape, True),
        )

    def integrate(self, wo: Array, nodes: int) -> Array:
        """See `Material`."""
        m = relative_index(self.eta, wo)
        reflected = fresnel.dielectric(jnp.abs(wo[..., 2]), m)
        return reflected + (1.0 - reflected) * _scale(m, self.radiance)


class RoughDielectric(_Interface):
    """Rough transparent interface, ground glass: reflection and transmission by facets.

    Parameters
    ----------
    eta
        Index of the inside over that of the outside, above 0 and not 1.
    alpha
        As for `Microfacet`.
    normals
        ``ggx`` or ``beckmann``; masking is Smith's, uncorrelated.
    radiance
        See the module.
    """

    eta: Float[Array, ""] = eqx.field(converter=floating, default=1.5)
    alpha: Float[Array, "2"] = eqx.field(converter=widths, default=0.2)
    normals: SmithNormals = eqx.field(
        static=True, converter=one_of("normals", SmithNormals), default="ggx"
    )
    radiance: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        within("eta", self.eta, 0.0, 100.0, above=True)
        within("alpha", self.alpha, 0.0, 4.0, above=True)

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        wi, wo, m = _to_upper_side(self.eta, wi, wo)
        upper = wi[..., 2] > 0.0
        reflected, through = self._lobes(wi, wo, m)
        beside = _flip(wi, jnp.where(upper, 1.0, -1.0).astype(wi.dtype))
        masked = microfacet.projected_area(self.normals, beside, self._alpha)
        scale = jnp.where(upper, 1.0, _scale(m, self.radiance))
        seen = (wi[..., 2] != 0.0) & (wo[..., 2] != 0.0)
        # Density over cosine, times the share of wi's side that is not masked.
        return jnp.where(seen, jnp.where(upper, reflected, through) * scale / masked, 0.0)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        wi, wo, m = _to_upper_side(self.eta, wi, wo)
        # A facet may mirror light from below the mean surface, or refract it from above: part
        # of the density, and none of the value.
        reflected, through = self._lobes(wi, wo, m)
        return reflected + through

    def warp(self, u: Array, wo: Array) -> Array:
        """See `Material`."""
        half, m, f = self._facets(u, wo)
        cos = dot(half, wo)
        inner = 1.0 - (1.0 - cos * cos) / (m * m)
        # Beyond the critical angle nothing is refracted: the choice below never takes it.
        inner = jnp.sqrt(jnp.maximum(inner, 1e-12))
        through = (cos / m - inner)[..., None] * half - wo / m[..., None]
        return jnp.where((u[..., 2] < f)[..., None], frames.reflect(wo, half), through)

    def integrate(self, wo: Array, nodes: int) -> Array:
        """See `Material`."""
        points, weights = unit_square(nodes, wo.dtype)
        wo = jnp.broadcast_to(wo, points.shape)
        total = jnp.zeros((), wo.dtype)
        for choice in (0.0, 1.0):
            u = points.at[:, 2].set(choice)
            f = self._facets(u, wo)[2]
            share = f if choice == 0.0 else 1.0 - f
            total = total + (weights * share * self.scatter(u, wo).weight).sum()
        return total

    @property
    def _alpha(self) -> tuple[Array, Array]:
        return self.alpha[0], self.alpha[1]

    def _facets(self, u: Array, wo: Array) -> tuple[Array, Array, Array]:
        """Visible normals on wo's side, the index and the reflectance there."""
        side = jnp.where(wo[..., 2] < 0.0, -1.0, 1.0).astype(wo.dtype)
        m = relative_index(self.eta, wo)
        half = microfacet.sample_visible(self.normals, u[..., :2], _flip(wo, side), self._alpha)
        half = _flip(half, side)
        cos = jnp.clip(dot(half, wo), 0.0, 1.0)
        return half, m, fresnel.dielectric(cos, m)

    def _lobes(self, wi: Array, wo: Array, m: Array) -> tuple[Array, Array]:
        """Densities of mirrored and of refracted directions, wo above."""
        area = microfacet.projected_area(self.normals, wo, self._alpha)
        half, io, _, ok = _half(wi, wo, jnp.ones_like(m))
        f = fresnel.dielectric(jnp.clip(io, 0.0, 1.0), m)
        back = 0.25 * f * microfacet.density(self.normals, half, self._alpha) / area
        back = jnp.where(ok, back, 0.0)
        half, io, ii, ok = _half(wi, wo, m)
        ok = ok & (ii < 0.0)
        f = fresnel.dielectric(jnp.clip(io, 0.0, 1.0), m)
        bend = m / jnp.where(ok, io + m * ii, 1.0)
        through = (1.0 - f) * jnp.abs(io * ii) * bend * bend
        through = through * microfacet.density(self.normals, half, self._alpha) / area
        return back, jnp.where(ok, through, 0.0)


def relative_index(eta: Array, wo: Array) -> Array:
    """Index of the other side over that of wo's side, [...]."""
    return jnp.where(wo[..., 2] < 0.0, 1.0 / eta, eta)


def refracted(wo: Array, m: Array) -> Array:
    """The direction on the other side that light seen at wo comes from (Snell's law)."""
    side = jnp.where(wo[..., 2] < 0.0, -1.0, 1.0).astype(wo.dtype)
    sin2 = wo[..., 0] ** 2 + wo[..., 1] ** 2
    inner = jnp.maximum(1.0 - sin2 / (m * m), 0.0)
    regular = inner > 0.0
    z = jnp.where(regular, jnp.sqrt(jnp.where(regular, inner, 1.0)), 0.0)
    return frames.direction(-wo[..., 0] / m, -wo[..., 1] / m, -side * z)


def _scale(m: Array, radiance: bool) -> Array:
    """Radiance seen on wo's side over that on the other."""
    return 1.0 / (m * m) if radiance else jnp.ones_like(m)


def _flip(w: Array, side: Array) -> Array:
    return frames.direction(w[..., 0], w[..., 1], w[..., 2] * side)


def _to_upper_side(eta: Any, wi: Array, wo: Array) -> tuple[Array, Array, Array]:
    """Directions turned so that wo is above, and the index of the other side."""
    side = jnp.where(wo[..., 2] < 0.0, -1.0, 1.0).astype(wo.dtype)
    return _flip(wi, side), _flip(wo, side), relative_index(eta, wo)


def _half(wi: Array, wo: Array, m: Array) -> tuple[Array, Array, Array, Array]:
    """Facet normal facing wo for the index m (1: a mirror), its cosines, and if there is one."""
    half, _, ok = frames.half_vector(wo, wi * m[..., None])
    io = dot(half, wo)
    sign = jnp.where(io < 0.0, -1.0, 1.0).astype(io.dtype)
    half = half * sign[..., None]
    return half, io * sign, dot(half, wi), ok
