"""Diffraction BRDFs of surfaces known by their statistics: Stam's closed forms.

The mirror part is a delta and stays apart: calls return the incoherent lobe in 1/sr,
`mirror_reflectance` the share that reflects like a mirror.
"""

import abc
from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.checks import Values
from diffopt.errors import InputError
from diffopt.fresnel import Constant, Reflectance
from diffopt.kernels import ensemble, frames, phase
from diffopt.scalar import Shadowing, model_factors


def _length(name: str, value: Values, *, above_zero: bool = True) -> Array:
    out = jnp.asarray(value, jnp.result_type(float))
    number = checks.concrete(out)
    if out.shape != ():
        raise InputError(f"{name} must be one number in micrometres; received shape {out.shape}")
    if number is not None and not (number > 0 if above_zero else number >= 0):
        bound = "> 0" if above_zero else ">= 0"
        raise InputError(f"{name} must be {bound} (micrometres); received {float(number):g}")
    return out


class StatisticalBRDF(eqx.Module):
    """What the closed forms share: reflectance, prefactor, and evaluation over directions."""

    fresnel: eqx.AbstractVar[Reflectance]
    shadowing: eqx.AbstractVar[Shadowing]

    @abc.abstractmethod
    def density(self, wave: Float[Array, "3"], wavelength: Float[Array, ""]) -> Float[Array, ""]:
        """Incoherent mean of |P|^2 per area, square micrometres."""

    @abc.abstractmethod
    def mirror_share(self, w: Float[Array, ""], wavelength: Float[Array, ""]) -> Float[Array, ""]:
        """Share of the reflected power that stays in the mirror direction."""

    @abc.abstractmethod
    def check(self, wavelengths: np.ndarray) -> None:
        """Raise InputError where the closed form does not hold."""

    def __call__(self, wi: Values, wo: Values, wavelengths: Values) -> Float[Array, "*batch L"]:
        """Incoherent BRDF, 1/sr, [..., L]; arguments as for `DiffractionBRDF`."""
        checks.directions("wi", wi)
        checks.directions("wo", wo)
        checks.wavelengths(wavelengths)
        known = checks.concrete(wavelengths)
        if known is not None:
            self.check(known)
        return _evaluate(self, *self._arrays(wi, wo), self._array(wavelengths, 1))

    def mirror_reflectance(self, cos_i: Values, wavelengths: Values) -> Float[Array, "*batch L"]:
        """Reflectance of the mirror part at the cosine of incidence `cos_i`, [..., L]."""
        cos_i, lam = self._array(cos_i), self._array(wavelengths, 1)
        share = jnp.vectorize(self.mirror_share, signature="(),()->()")
        grid = jnp.broadcast_arrays(cos_i[..., None], lam.reshape((1,) * cos_i.ndim + lam.shape))
        return self.fresnel(cos_i, lam) * share(-2.0 * grid[0], grid[1])

    @property
    def _dtype(self):
        return jax.tree.leaves(eqx.filter(self, eqx.is_inexact_array))[0].dtype

    def _array(self, value: Values, least: int = 0) -> Array:
        out = jnp.asarray(value, self._dtype)
        return jnp.atleast_1d(out) if least else out

    def _arrays(self, wi: Values, wo: Values) -> tuple[Array, Array]:
        wi, wo = jnp.broadcast_arrays(self._array(wi), self._array(wo))
        return wi, wo


@eqx.filter_jit
def _evaluate(model: StatisticalBRDF, wi: Array, wo: Array, wavelengths: Array) -> Array:
    batch = wi.shape[:-1]
    valid, wi, wo = frames.above_horizon(wi.reshape(-1, 3), wo.reshape(-1, 3))
    wave = frames.wave_vector(wi, wo)
    before = model_factors(
        model.fresnel,
        wi,
        wo,
        wavelengths,
        prefactor="stam",
        shadowing=model.shadowing,
        relative=False,
    )
    over_wavelengths = jax.vmap(model.density, (None, 0))
    density = jax.vmap(over_wavelengths, (0, None))(wave, wavelengths)
    return jnp.where(valid[:, None], before * density, 0.0).reshape(*batch, -1)


class GaussianRoughness(StatisticalBRDF):
    """Isotropic Gaussian roughness with correlation exp(-r^2 / l^2).

    Parameters
    ----------
    rms
        Root mean square height, micrometres, >= 0; any number of wavelengths.
    correlation_length
        l, micrometres, > 0.
    fresnel, shadowing
        As for `DiffractionBRDF`.

    See Also
    --------
    diffopt.kernels.ensemble.gaussian_roughness : the sum and its source.
    """

    rms: Float[Array, ""]
    correlation_length: Float[Array, ""]
    fresnel: Reflectance
    shadowing: Shadowing = eqx.field(static=True)

    def __init__(
        self,
        rms: Values,
        correlation_length: Values,
        *,
        fresnel: Reflectance | None = None,
        shadowing: Shadowing | str = "none",
    ):
        self.rms = _length("rms", rms, above_zero=False)
        self.correlation_length = _length("correlation_length", correlation_length)
        self.fresnel = Constant() if fresnel is None else fresnel
        self.shadowing = checks.choice("shadowing", shadowing, get_args(Shadowing))

    def check(self, wavelengths: np.ndarray) -> None:
        """Hold everywhere: the sum is exact for every roughness."""

    def density(self, wave: Float[Array, "3"], wavelength: Float[Array, ""]) -> Float[Array, ""]:
        """See `StatisticalBRDF.density`."""
        k = phase.TWO_PI / wavelength
        # Safe at the mirror direction, where the norm has no gradient.
        square = wave[0] ** 2 + wave[1] ** 2
        radius = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
        return ensemble.gaussian_roughness(
            k * radius, k * wave[2], self.rms, self.correlation_length
        )

    def mirror_share(self, w: Float[Array, ""], wavelength: Float[Array, ""]) -> Float[Array, ""]:
        """See `StatisticalBRDF.mirror_share`."""
        return ensemble.gaussian_mirror(phase.TWO_PI * w / wavelength, self.rms)


class RandomBumps(StatisticalBRDF):
    """Sparse Gaussian bumps at random places (Stam 1999).

    Parameters
    ----------
    height
        Bump height H, micrometres; either sign.
    sigma
        Standard deviations (sy, sx) of a bump, or one for both, micrometres, > 0.
    density
        Bumps per square micrometre, > 0; the closed form is first order in the share of
        the surface that they cover.
    fresnel, shadowing
        As for `DiffractionBRDF`.
    """

    height: Float[Array, ""]
    sx: Float[Array, ""]
    sy: Float[Array, ""]
    bumps: Float[Array, ""]
    fresnel: Reflectance
    shadowing: Shadowing = eqx.field(static=True)

    def __init__(
        self,
        height: Values,
        sigma: Values,
        density: Values,
        *,
        fresnel: Reflectance | None = None,
        shadowing: Shadowing | str = "none",
    ):
        self.height = jnp.asarray(height, jnp.result_type(float))
        if len(np.shape(sigma)) > 1 or np.size(sigma) > 2:
            raise InputError(f"sigma must be one length or (sy, sx); received {sigma}")
        sy, sx = jnp.broadcast_to(jnp.asarray(sigma, jnp.result_type(float)), (2,))
        self.sx, self.sy = _length("sigma", sx), _length("sigma", sy)
        self.bumps = _length("density", density)
        self.fresnel = Constant() if fresnel is None else fresnel
        self.shadowing = checks.choice("shadowing", shadowing, get_args(Shadowing))

    def check(self, wavelengths: np.ndarray) -> None:
        """Refuse bumps whose Taylor series the dtype cannot carry."""
        height = checks.concrete(self.height)
        if height is None:
            return
        argument = 2.0 * phase.TWO_PI * abs(float(height)) / float(np.min(wavelengths))
        limit = 10.0 if self._dtype == jnp.float32 else 25.0
        if argument > limit:
            raise InputError(
                f"height {float(height):g} um makes a phase of {argument:.1f} radians at "
                f"{float(np.min(wavelengths)):g} um: the series of a bump holds to {limit:g} "
                f"in {self._dtype}; generate a surface and use DiffractionBRDF"
            )

    def _evaluate(self, wave: Array, wavelength: Array) -> tuple[Array, Array]:
        k = phase.TWO_PI / wavelength
        return ensemble.random_bumps(
            k * wave[0], k * wave[1], k * wave[2], self.height, self.sx, self.sy, self.bumps
        )

    def density(self, wave: Float[Array, "3"], wavelength: Float[Array, ""]) -> Float[Array, ""]:
        """See `StatisticalBRDF.density`."""
        return self._evaluate(wave, wavelength)[0]

    def mirror_share(self, w: Float[Array, ""], wavelength: Float[Array, ""]) -> Float[Array, ""]:
        """See `StatisticalBRDF.mirror_share`."""
        zero = jnp.zeros_like(w)
        return self._evaluate(jnp.stack([zero, zero, w]), wavelength)[1]
