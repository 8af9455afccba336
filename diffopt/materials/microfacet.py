"""Rough reflecting materials: small mirrors with a distribution of normals.

Torrance and Sparrow (1967), Cook and Torrance (1982), with the distributions and the masking
of `diffopt.kernels.microfacet`: f = F(o.h) D(h) G(wi, wo) / (4 cos_i cos_o), with the
reflectance at the facet, by the half vector, as reciprocity asks.
"""

from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.fresnel import Constant, Reflectance
from diffopt.kernels import frames, microfacet, warps
from diffopt.kernels.microfacet import Masking, Normals
from diffopt.materials.base import Material, floating, times, unit_square
from diffopt.materials.checking import one_of, within

#: Wavelength at which a material without any is taken: the sodium line of index tables, um.
SODIUM = 0.5893
# Nodes in the cosine at which compensation knows the albedo of a lossless surface.
_COSINES, _INNER = 24, 24

Mapping = Literal["square", "linear", "pbrt"]
Compensation = Literal["none", "kulla-conty"]


def alpha_from_roughness(roughness: Any, mapping: Mapping = "square") -> Float[Array, "..."]:
    """Width alpha of the normals from an artist's roughness in [0, 1].

    Parameters
    ----------
    roughness
        0 is a mirror, 1 the roughest.
    mapping
        ``square``: alpha = roughness^2 (Burley, "Physically based shading at Disney", 2012);
        ``linear``: alpha = roughness; ``pbrt``: the quartic in log(roughness) of pbrt-v3,
        1.62142 + 0.819955 x + 0.1734 x^2 + 0.0171201 x^3 + 0.000640711 x^4, for roughness of
        at least 0.001.
    """
    r = floating(roughness)
    within("roughness", r, 0.0, 1.0)
    if mapping == "linear":
        return r
    if mapping == "square":
        return r * r
    if mapping == "pbrt":
        x = jnp.log(jnp.maximum(r, 1e-3))
        coefficients = [0.000640711, 0.0171201, 0.1734, 0.819955, 1.62142]
        return jnp.polyval(jnp.asarray(coefficients, r.dtype), x)
    raise InputError(f"mapping must be one of {', '.join(get_args(Mapping))}; received {mapping!r}")


def widths(alpha: Any) -> Float[Array, "2"]:
    """Widths along x and y, from one for both or from two."""
    return jnp.broadcast_to(floating(alpha), (2,))


class Microfacet(Material):
    """Rough conductor, or the reflecting side of anything rough.

    Parameters
    ----------
    alpha
        Width of the normals, in (0, 4]: one number, or those along x and y (anisotropic).
        sqrt(2) times the rms slope for ``beckmann``, the angle's m in radians for
        ``gaussian``; `alpha_from_roughness` maps from roughness.
    fresnel
        Reflectance of the facets (`diffopt.fresnel`); 1 by default.
    wavelengths
        In micrometres: one number for a scalar material, [L] for a spectrum. A `Schlick`
        with colours brings its own channels.
    normals
        ``ggx`` (Trowbridge-Reitz), ``beckmann`` or ``gaussian`` (Blinn's of Torrance and
        Sparrow's; isotropic, with V-cavities).
    masking
        ``correlated`` or ``uncorrelated`` (Smith's), or ``v-cavity``.
    compensation
        ``kulla-conty`` adds back the light that several facets scatter (Kulla and Conty,
        "Revisiting physically based shading at Imageworks", 2017): a lobe
        (1 - E(i))(1 - E(o)) / (pi (1 - mean E)), E the albedo with perfect facets, times
        the colour F^2 mean E / (1 - F (1 - mean E)), F the mean reflectance. Exact in energy
        for isotropic perfect facets; an anisotropic surface takes the geometric mean of its
        widths.
    """

    alpha: Float[Array, "2"] = eqx.field(converter=widths, default=0.2)
    fresnel: Reflectance = eqx.field(default_factory=Constant)
    wavelengths: Float[Array, "..."] = eqx.field(converter=floating, default=SODIUM)
    normals: Normals = eqx.field(static=True, converter=one_of("normals", Normals), default="ggx")
    masking: Masking = eqx.field(
        static=True, converter=one_of("masking", Masking), default="correlated"
    )
    compensation: Compensation = eqx.field(
        static=True, converter=one_of("compensation", Compensation), default="none"
    )

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        within("alpha", self.alpha, 0.0, 4.0, above=True)
        if self.normals == "gaussian":
            if self.masking != "v-cavity":
                raise InputError(
                    "normals 'gaussian' have no closed form of Smith's masking; use "
                    "masking='v-cavity'"
                )
            known = checks.concrete(self.alpha)
            if known is not None and known[0] != known[1]:
                raise InputError("normals 'gaussian' are isotropic; received two widths")

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        shape = jax.eval_shape(self.reflectance, jax.ShapeDtypeStruct((), self.alpha.dtype))
        return shape.shape

    @property
    def conserves_energy(self) -> bool:
        """Facets mask each other exactly; only compensation is rounded for two widths."""
        known = checks.concrete(self.alpha)
        return self.compensation == "none" or (known is not None and bool(known[0] == known[1]))

    def reflectance(self, cos: Float[Array, "*batch"]) -> Float[Array, "..."]:
        """Reflectance of a facet at a cosine of incidence, [..., *C]."""
        return facet_reflectance(self.fresnel, self.wavelengths, cos)

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        half, length, _ = frames.half_vector(wi, wo)
        d = microfacet.density(self.normals, half, self._alpha)
        g = microfacet.visibility(self.masking, self.normals, wi, wo, self._alpha)
        single = times(d * g, self.reflectance(0.5 * length))
        if self.compensation == "none":
            return single
        return single + self._multiple(wi, wo)

    def warp(self, u: Array, wo: Array) -> Array:
        """See `Material`."""
        if self.normals == "gaussian":
            half = warps.gaussian_angle(u[..., :2], self.alpha[0])
        else:
            half = microfacet.sample_visible(self.normals, u[..., :2], wo, self._alpha)
        return frames.reflect(wo, half)

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        half, length, ok = frames.half_vector(wi, wo)
        half = half * jnp.where(half[..., 2:] < 0.0, -1.0, 1.0).astype(half.dtype)
        if self.normals == "gaussian":
            angle = microfacet.squared_angle(half)
            pdf = warps.gaussian_angle_density(angle, self.alpha[0]) / (2.0 * length)
        else:
            # D (o.h) / A over the solid angle 4 (o.h); facets that face away are not seen.
            facing = frames.dot(half, wo) > 0.0
            area = microfacet.projected_area(self.normals, wo, self._alpha)
            pdf = microfacet.density(self.normals, half, self._alpha) / (4.0 * area)
            pdf = jnp.where(facing, pdf, 0.0)
        return jnp.where(ok, pdf, 0.0)

    @property
    def _alpha(self) -> tuple[Array, Array]:
        return self.alpha[0], self.alpha[1]

    def _multiple(self, wi: Array, wo: Array) -> Array:
        """Light scattered by several facets; see `compensation`."""
        width = jnp.sqrt(self.alpha[0] * self.alpha[1])
        lossless = Microfacet(width, normals=self.normals, masking=self.masking)
        x, weights = np.polynomial.legendre.leggauss(_COSINES)
        cosines = jnp.asarray(0.5 * (x + 1.0), wi.dtype)
        weights = jnp.asarray(weights * 0.5, wi.dtype)
        missing = 1.0 - _albedos(lossless, cosines)
        # 2 int (1 - E) mu dmu, and the mean reflectance 2 int F mu dmu.
        lost = 2.0 * (weights * cosines * missing).sum()
        facet = self.reflectance(cosines)
        mean = 2.0 * jnp.tensordot(weights * cosines, facet, 1, precision="highest")
        colour = mean * mean * (1.0 - lost) / (1.0 - mean * lost)
        ends = [jnp.interp(w[..., 2], cosines, missing) for w in (wi, wo)]
        lobe = ends[0] * ends[1] / (np.pi * lost)
        return times(lobe, jnp.broadcast_to(colour, (*lobe.shape, *colour.shape)))


def facet_reflectance(
    fresnel: Reflectance, wavelengths: Float[Array, "..."], cos: Float[Array, "*batch"]
) -> Float[Array, "..."]:
    """Reflectance at a cosine, [..., *C]: without a last axis for one scalar wavelength."""
    value = fresnel(cos, jnp.atleast_1d(wavelengths).astype(cos.dtype))
    return value[..., 0] if wavelengths.ndim == 0 and value.shape[-1] == 1 else value


def _albedos(material: Microfacet, cosines: Float[Array, " N"]) -> Float[Array, " N"]:
    """Albedo of an isotropic scalar material at cosines, differentiable in its width."""
    points, weights = unit_square(_INNER, cosines.dtype)
    wo = jnp.stack([jnp.sqrt(1.0 - cosines**2), jnp.zeros_like(cosines), cosines], -1)

    def one(w):
        sample = material.scatter(points, jnp.broadcast_to(w, points.shape))
        return (weights * sample.weight).sum()

    return jax.vmap(one)(wo)
