"""What a fit of free heights minimises: misfit to reflectance plus a Gaussian prior.

The unknowns y are coordinates in which the prior is (or is not) white: h = base + C y with C a
circular convolution. Their mean has no effect, so that the mean height is that of the base.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import bounds, costs, methods
from diffopt.baking import Box
from diffopt.diffraction import DiffractionBRDF, factors
from diffopt.fitting.freeform.priors import Prior, filtered
from diffopt.fitting.measured import Measured
from diffopt.heightfield import Heightfield
from diffopt.kernels import frames, phase
from diffopt.settings import DirectSettings, SeparableSettings

Gain = Literal["known", "free"]
Settings = DirectSettings | SeparableSettings


class Problem(eqx.Module):
    """Loss of free heights over unknowns y, [ny, nx].

    ``0.5 (sum ((a f - values) / noise)^2 + weight sum (white change)^2)`` with
    ``change = colour y`` of the heights from the base; colour and white are circular
    convolutions, white with the inverse root of the prior's covariance.

    Attributes
    ----------
    surface
        What is transformed; its heights are not used.
    wave, before
        Wave vectors [M, 3], and all factors before |P|^2 [M, L].
    wavelengths, weights
        Micrometres [L], and what turns spectra into colours [L, 3], or None.
    values, inverse
        Data and the inverse of their noise, [M, L] or [M, 3].
    base
        Heights at y = 0, micrometres.
    colour, white
        Half-plane responses.
    weight
        Strength of the prior.
    """

    surface: methods.Surface
    wave: Float[Array, "M 3"]
    before: Float[Array, "M L"]
    wavelengths: Float[Array, " L"]
    weights: Float[Array, "L 3"] | None
    values: Float[Array, "M C"]
    inverse: Float[Array, "M C"]
    base: Float[Array, "ny nx"]
    colour: Float[Array, "ny half"]
    white: Float[Array, "ny half"]
    weight: Float[Array, ""]
    settings: Settings = eqx.field(static=True)
    gain: Gain = eqx.field(static=True)

    def heights(self, y: Float[Array, "ny nx"]) -> Float[Array, "ny nx"]:
        """Micrometres, at unknowns y."""
        return self.base + filtered(y.astype(self.base.dtype), self.colour)

    def residuals(
        self, heights: Float[Array, "ny nx"]
    ) -> tuple[Float[Array, "M C"], Float[Array, ""]]:
        """(a f - values) / noise, and the gain a: 1, or the best one where it is free."""
        surface = eqx.tree_at(lambda s: s.heights, self.surface, heights)
        if isinstance(self.settings, DirectSettings):
            power = methods.direct(surface, self.wave, self.wavelengths, self.settings)
        else:
            power = methods.separable_pairs(surface, self.wave, self.wavelengths, self.settings)
        model, values = self.before * power, self.values * self.inverse
        if self.weights is not None:
            model = jnp.matmul(model, self.weights, precision="highest")
        model = model * self.inverse
        gain = jnp.ones((), heights.dtype)
        if self.gain == "free":
            # The minimum over a in closed form: the derivative of the loss stays exact.
            gain = (model * values).sum() / (model * model).sum()
        return gain * model - values, gain

    @eqx.filter_jit
    def fitted(self, heights: Float[Array, "ny nx"]) -> Float[Array, "M C"]:
        """A f, as the values."""
        return self.residuals(heights)[0] / self.inverse + self.values

    def misfit(self, y: Float[Array, "ny nx"]) -> tuple[Array, Array]:
        """Sum of squared residuals in the default dtype, and the gain."""
        residual, gain = self.residuals(self.heights(y))
        # A sum of many squares wants more digits than each of them.
        return jnp.sum(residual.astype(jnp.result_type(float)) ** 2), gain

    def loss(self, y: Float[Array, "ny nx"]) -> tuple[Float[Array, ""], tuple[Array, Array]]:
        """The loss, and with it the sum of squared residuals and the gain."""
        chi2, gain = self.misfit(y)
        wide = chi2.dtype
        rough = filtered(y.astype(wide), self.colour.astype(wide) * self.white.astype(wide))
        return 0.5 * (chi2 + self.weight.astype(wide) * jnp.sum(rough**2)), (chi2, gain)

    def curvature(
        self, y: Float[Array, "ny nx"], way: Float[Array, "ny nx"] | None = None
    ) -> Float[Array, ""]:
        """Second derivative of the loss along a way, Gauss and Newton's; the gradient if None."""
        dtype = self.base.dtype
        if way is None:
            way = jnp.asarray(jax.grad(lambda y: self.loss(y)[0])(y))
        size = jnp.linalg.norm(way.astype(dtype))
        unit = way.astype(dtype) / jnp.where(size > 0.0, size, 1.0)
        y = y.astype(dtype)
        _, slope = jax.jvp(lambda y: self.residuals(self.heights(y))[0], (y,), (unit,))
        rough = filtered(unit, self.colour * self.white)
        return jnp.sum(slope**2) + self.weight * jnp.sum(rough**2)


def problem(
    measured: Measured,
    start: Heightfield,
    brdf: DiffractionBRDF,
    settings: Settings,
    *,
    inverse: np.ndarray,
    root: np.ndarray,
    prior: Prior,
    gain: Gain,
) -> tuple[Problem, Float[Array, "ny nx"]]:
    """The loss of a fit with weight 0 over changes of height, and the change of its start.

    A smooth prior is one of the change from the start, a spectrum one of the heights about
    their mean. `inverse` is one over the noise, `root` from `prior_root`.
    """
    heights, dtype = start.heights, start.heights.dtype
    white = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0)
    base = heights if prior == "smooth" else jnp.full_like(heights, heights.mean())
    wide = jnp.result_type(float)
    lam = measured.wavelengths
    made = Problem(
        surface=brdf.surface,
        wave=frames.wave_vector(measured.wi, measured.wo),
        before=_before(measured, brdf),
        wavelengths=lam,
        weights=measured.weights,
        values=measured.values,
        inverse=jnp.asarray(inverse, dtype),
        base=base,
        colour=jnp.asarray(root > 0, dtype),
        white=jnp.asarray(white, dtype),
        weight=jnp.zeros((), dtype),
        settings=settings,
        gain=gain,
    )
    return made, (heights - base).astype(wide)


def weighted(
    made: Problem, change: Float[Array, "ny nx"], weight: Float[Array, ""], data: Float[Array, ""]
) -> tuple[Problem, Float[Array, "ny nx"]]:
    """The problem at a weight, in unknowns in which its curvature is about one, and these.

    By the curvature of the prior and the mean one of the data, `data`, at every frequency: a
    prior alone would be white in unknowns in which the data are not.
    """
    curvature = data + weight * made.white**2
    colour = jnp.where(made.white > 0.0, 1.0 / jnp.sqrt(curvature), 0.0)
    back = jnp.where(made.white > 0.0, jnp.sqrt(curvature), 0.0)
    made = eqx.tree_at(lambda p: (p.colour, p.weight), made, (colour, weight))
    return made, filtered(change, back.astype(change.dtype))


def _before(measured: Measured, brdf: DiffractionBRDF) -> Float[Array, "M L"]:
    """What |P|^2 is multiplied by to give the measured quantity, colours aside."""
    if measured.quantity == "power":
        return jnp.ones((len(measured.wi), len(measured.wavelengths)), measured.values.dtype)
    output = "relative" if measured.quantity == "relative" else "spectral"
    return factors(brdf, measured.wi, measured.wo, measured.wavelengths, output)


def forward_settings(
    surface: methods.Surface, wave: np.ndarray, lam: np.ndarray, error: float
) -> Settings:
    """The cheaper of the direct sum and matrix products within an error of |P|^2.

    Parameters
    ----------
    surface
        Its heights' span is what the settings hold for.
    wave, lam
        Wave vectors [M, 3] and wavelengths [L], micrometres.
    error
        Relative to a mirror's peak; truncation only.
    """
    share = error if surface.coverage == "positions" else error / 3.0
    nodes = phase.chebyshev_nodes(bounds.separable_sweep(surface, wave, lam), share)
    found = (DirectSettings(), SeparableSettings(nodes=nodes, chunk=min(len(wave), 1024)))
    shortest, box = float(lam.min()), Box.around(wave)
    work = {"pairs": len(wave), "wavelengths": len(lam), "box": box, "shortest": shortest}

    def seconds(settings):
        cost = costs.cost(surface, settings, **work, channels=len(lam), gradient=True)
        return cost.run_s

    return min(found, key=seconds)
