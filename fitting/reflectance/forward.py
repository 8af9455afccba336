"""What a parametric surface would have measured: values, residuals, the free gain."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.fitting.measured import Measured
from diffopt.fresnel import Constant, Reflectance
from diffopt.gratings import Reach, Surface
from diffopt.kernels import frames
from diffopt.scalar import Shadowing, model_factors


class Job(eqx.Module):
    """Measured data with all that does not depend on the surface worked out.

    Attributes
    ----------
    fx, fy, kappa
        Frequencies (u, v) / wavelength in cycles per micrometre and 2 pi w / wavelength, [M, L].
    before
        Everything before |P|^2, [M, L].
    sigma_f, spread
        Of the window, without and with the blur, [M, L].
    values, scale
        Data, and what residuals are multiplied by: 1 / noise over the norm of values / noise,
        [M, C].
    weights
        Spectra to colours, [L, 3], or None.
    gain
        As in `Measured`; static.
    """

    fx: Float[Array, "M L"]
    fy: Float[Array, "M L"]
    kappa: Float[Array, "M L"]
    before: Float[Array, "M L"]
    sigma_f: Float[Array, "M L"]
    spread: Float[Array, "M L"]
    values: Float[Array, "M C"]
    scale: Float[Array, "M C"]
    weights: Float[Array, "L 3"] | None
    free_gain: bool = eqx.field(static=True)

    @property
    def free(self) -> int:
        """Free numbers beside the parameters of a surface."""
        return 1 if self.free_gain else 0


def norm(measured: Measured) -> Float[Array, ""]:
    """Of the values over the noise."""
    return jnp.linalg.norm(measured.values / measured.noise)


@eqx.filter_jit
def job(
    measured: Measured, fresnel: Reflectance | None = None, shadowing: Shadowing = "none"
) -> Job:
    """Work out what does not depend on the surface.

    Parameters
    ----------
    measured
        The data.
    fresnel
        Power reflectance of the surface; a perfect mirror by default.
    shadowing
        As for `diffopt.DiffractionBRDF`.
    """
    wave = frames.wave_vector(measured.wi, measured.wo)
    lam = measured.wavelengths[None, :]
    fx, fy, s = (wave[:, k, None] / lam for k in range(3))
    if measured.quantity == "power":
        before = jnp.ones_like(fx)
    else:
        relative = measured.quantity == "relative"
        before = model_factors(
            Constant() if fresnel is None else fresnel,
            measured.wi,
            measured.wo,
            measured.wavelengths,
            prefactor="stam",
            shadowing=shadowing,
            relative=relative,
        )
        before = before if relative else before * (4.0 * math.pi * measured.coherence**2)
    sigma_f = jnp.broadcast_to(1.0 / (2.0 * math.pi * measured.coherence), fx.shape)
    return Job(
        fx,
        fy,
        2.0 * math.pi * s,
        before,
        sigma_f,
        jnp.sqrt(sigma_f**2 + 2.0 * (measured.blur / lam) ** 2),
        measured.values,
        1.0 / (measured.noise * norm(measured)),
        measured.weights,
        measured.gain == "free",
    )


def predicted(job: Job, surface: Surface, reach: Reach) -> Float[Array, "M C"]:
    """Values of a surface, before the gain."""
    found = surface.components(job.fx, job.fy, job.kappa, reach)
    spectra = job.before * found.power(job.sigma_f, job.spread)
    if job.weights is None:
        return spectra
    return jnp.matmul(spectra, job.weights, precision="highest")


def best_gain(job: Job, values: Float[Array, "M C"]) -> Float[Array, ""]:
    """The factor of the model's values that fits best in least squares; 1 if it is known."""
    if not job.free_gain:
        return jnp.ones((), values.dtype)
    weight = job.scale**2
    # What predicts nothing at all has no gain.
    size = jnp.maximum((weight * values**2).sum(), jnp.finfo(values.dtype).tiny * 1e3)
    return (weight * values * job.values).sum() / size


def residuals(job: Job, surface: Surface, reach: Reach) -> Float[Array, " N"]:
    """Model less data over the noise, of norm 1 where the model predicts nothing.

    With a free gain the best one is put in, so that it is no unknown of the fit (variable
    projection, Golub and Pereyra 1973).
    """
    values = predicted(job, surface, reach)
    return ((best_gain(job, values) * values - job.values) * job.scale).reshape(-1)


_PER_VALUE = ("fx", "fy", "kappa", "before", "sigma_f", "spread", "values", "scale")


def rows(job: Job, chosen: Any) -> Job:
    """The job of some of the pairs of directions, by their numbers."""
    return _picked(job, lambda leaf: leaf[chosen])


def columns(job: Job, chosen: Any) -> Job:
    """The job of some of the wavelengths, by their numbers; of spectra, not colours."""
    return _picked(job, lambda leaf: leaf[:, chosen])


def evenly(job: Job) -> Job:
    """The job with the same weight for all values, whatever their noise."""
    scale = jnp.ones_like(job.scale) / jnp.linalg.norm(job.values)
    return eqx.tree_at(lambda job: job.scale, job, scale)


def _picked(job: Job, pick: Callable[[Array], Array]) -> Job:
    picked = {name: pick(getattr(job, name)) for name in _PER_VALUE}
    size = jnp.linalg.norm(picked["values"] * picked["scale"])
    picked["scale"] = picked["scale"] / jnp.where(size > 0, size, 1.0)
    return eqx.tree_at(
        lambda j: [getattr(j, name) for name in _PER_VALUE], job, list(picked.values())
    )


def largest(job: Job) -> tuple[float, float]:
    """Largest frequency in cycles per micrometre, and largest |kappa|, of a job; on the host."""
    frequency = jnp.sqrt(job.fx**2 + job.fy**2).max()
    return float(frequency), float(jnp.abs(job.kappa).max())
