"""A diffracting surface as a material, alone or over a diffuse texture."""

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt import colour
from diffopt.choice import PreparedBRDF
from diffopt.diffraction import DiffractionBRDF
from diffopt.errors import InputError
from diffopt.fresnel import Reflectance
from diffopt.kernels import reflectance, warps
from diffopt.materials.base import Material, floating
from diffopt.materials.phong import turned
from diffopt.scalar import model_factors


class _Coherent(Material):
    """What diffracting surfaces share: how they are sampled, by the lobe of their window."""

    wavelengths: eqx.AbstractVar[Float[Array, " L"]]
    choices: ClassVar[tuple[float, ...]] = (0.25, 0.75)

    @property
    @abc.abstractmethod
    def _window(self) -> tuple[Array, str]:
        """Width of the coherence window, micrometres, and the prefactor."""

    @property
    def reciprocal(self) -> bool:
        """Of Stam's and the symmetric prefactors; those with cos_o / cos_i are not."""
        return self._window[1] not in ("ohs", "ghs")

    @property
    def conserves_energy(self) -> bool:
        """Scalar diffraction does not promise it."""
        return False

    def warp(self, u: Array, wo: Array) -> Array:
        """Half of the directions about the mirror's peak, half by the cosine."""
        peak = turned(warps.power_cosine(u[..., :2], self._exponent), reflectance.mirrored(wo))
        return jnp.where(u[..., 2:] < 0.5, peak, warps.cosine_hemisphere(u[..., :2]))

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        angle = reflectance.lobe_angle("reflected", wi, wo)
        peak = warps.power_cosine_density(*angle, self._exponent)
        return 0.5 * (peak + jnp.maximum(wi[..., 2], 0.0) / math.pi)

    @property
    def _exponent(self) -> Array:
        """Of a lobe four times as wide as the coherent peak of the longest wavelength."""
        wide = 4.0 * self.wavelengths.max() / (2.0 * math.pi * self._window[0])
        return jnp.maximum(1.0 / (wide * wide), 1.0)


class Diffraction(_Coherent):
    """The diffraction of a heightfield, in whatever method it was prepared.

    Parameters
    ----------
    brdf
        A `DiffractionBRDF` (evaluated by the direct sum: for small surfaces), or what its
        `prepare` made: with ``output="spectral"`` the material has a channel for each
        wavelength, with ``output="xyz"`` it is linear RGB (Rec. 709 primaries; colours out of
        gamut have negative values).
    wavelengths
        Micrometres, [L]; only for a `DiffractionBRDF`, and needed there.
    texture
        Diffuse albedo under the diffracting surface, a number or channels [L]; None for none.
        The two are mixed by the relative reflectance rho (a mirror's is 1 at its peak) as in
        M. Single's thesis on diffraction shading (2014): f + (1 - min(rho, 1)) texture / pi.
        Needs spectral values.

    Raises
    ------
    InputError
        For missing wavelengths, or a texture under values that are not spectral.
    """

    brdf: DiffractionBRDF | PreparedBRDF
    wavelengths: Float[Array, " L"]
    texture: Float[Array, "..."] | None

    def __init__(self, brdf: Any, wavelengths: Any = None, texture: Any = None) -> None:
        """See the class."""
        self.brdf = brdf
        if isinstance(brdf, PreparedBRDF):
            if brdf.output == "relative":
                raise InputError(
                    "a material needs values in 1/sr: prepare with output='spectral' or 'xyz'; "
                    "received output='relative'"
                )
            if wavelengths is not None:
                raise InputError("wavelengths are those of the prepared BRDF; leave them out")
            wavelengths = brdf.wavelengths
        if wavelengths is None:
            raise InputError(
                "a DiffractionBRDF needs wavelengths=[...] in micrometres to be a material"
            )
        self.wavelengths = jnp.atleast_1d(floating(wavelengths))
        self.texture = None if texture is None else floating(texture)
        if texture is not None and self._rgb:
            raise InputError(
                "a texture is mixed by the relative reflectance of each wavelength: prepare "
                "with output='spectral'; received output='xyz'"
            )

    @property
    def _window(self) -> tuple[Array, str]:
        return self._model.surface.sigma, self._model.surface.prefactor

    @property
    def _rgb(self) -> bool:
        return isinstance(self.brdf, PreparedBRDF) and self.brdf.output == "xyz"

    @property
    def _model(self) -> DiffractionBRDF:
        return self.brdf.brdf if isinstance(self.brdf, PreparedBRDF) else self.brdf

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return (3,) if self._rgb else self.wavelengths.shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        if isinstance(self.brdf, DiffractionBRDF):
            f = self.brdf(wi, wo, self.wavelengths)
        else:
            f = self.brdf(wi, wo)
        if self._rgb:
            matrix = jnp.asarray(colour.rgb_matrix(), f.dtype)
            return jnp.matmul(f, matrix.T, precision="highest")
        if self.texture is None:
            return f
        model, lam = self._model, self.wavelengths
        peak = model.coherent_area * model.fresnel.normal(lam) / lam**2
        rho = f * wi[..., 2:] / peak.reshape((1,) * (wi.ndim - 1) + (-1,))
        diffuse = jnp.broadcast_to(self.texture, lam.shape) / math.pi
        rest = 1.0 - jnp.clip(rho, 0.0, 1.0)
        return f + rest * diffuse.reshape((1,) * (wi.ndim - 1) + (-1,))


class FlatDiffraction(_Coherent):
    """What is left of a diffracting surface without its heights: the lobe of its window.

    A mirror blurred by the limited coherence: the area 4 pi sigma_s^2 reflects with the density
    exp(-(2 pi sigma_s)^2 (u^2 + v^2) / lambda^2), u and v the sums of the directions' parts along
    the surface (Stam, "Diffraction shaders", SIGGRAPH 1999, with a Gaussian window).

    Parameters
    ----------
    material
        The diffracting one: its wavelengths, coherence, reflectance and prefactor. Linear RGB
        becomes a spectrum of seven wavelengths.
    """

    sigma: Float[Array, ""]
    area: Float[Array, ""]
    fresnel: Reflectance
    wavelengths: Float[Array, " L"]
    texture: Float[Array, "..."] | None
    sampled: Float[Array, ""]
    prefactor: str = eqx.field(static=True)
    shadowing: str = eqx.field(static=True)

    def __init__(self, material: Diffraction) -> None:
        """See the class."""
        typed = material.typed(material.wavelengths.dtype)
        assert isinstance(typed, Diffraction)
        material, model = typed, typed._model
        self.sigma, self.prefactor = material._window
        # Directions are drawn as by the diffracting one, so that the two compare path by path.
        self.sampled = material._exponent
        self.area, self.fresnel = model.coherent_area, model.fresnel
        self.shadowing = model.shadowing
        self.texture = material.texture
        # A spectrum of its own: a scene makes colours of it.
        few = floating([0.40, 0.45, 0.50, 0.55, 0.60, 0.65, 0.70])
        self.wavelengths = few if material._rgb else material.wavelengths

    @property
    def _window(self) -> tuple[Array, str]:
        return self.sigma, self.prefactor

    @property
    def _exponent(self) -> Array:
        return self.sampled

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.wavelengths.shape

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        batch = wi.shape[:-1]
        wi, wo = wi.reshape(-1, 3), wo.reshape(-1, 3)
        lam = self.wavelengths.astype(wi.dtype)
        before = model_factors(
            self.fresnel,
            wi,
            wo,
            lam,
            prefactor=self.prefactor,  # type: ignore[arg-type]
            shadowing=self.shadowing,  # type: ignore[arg-type]
            relative=False,
        )
        across = (wi + wo)[:, :2]
        wide = 2.0 * math.pi * self.sigma.astype(wi.dtype) / lam
        exponent = (wide * wide)[None, :] * (across * across).sum(1)[:, None]
        f = before * self.area.astype(wi.dtype) * jnp.exp(-exponent)
        if self.texture is not None:
            peak = self.area * self.fresnel.normal(lam) / lam**2
            rest = 1.0 - jnp.clip(f * wi[:, 2:] / peak[None, :], 0.0, 1.0)
            f = f + rest * (jnp.broadcast_to(self.texture, lam.shape) / math.pi)[None, :]
        return f.reshape(*batch, -1)
