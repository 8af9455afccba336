"""Reflectance as a table over (u, v, w): one lookup for the whole spectrum.

All that a diffraction BRDF needs besides geometry depends on the wave vector alone, so the
spectral integral is done once, over a box of wave vectors (`diffopt.baking`). A value is a
cubic B-spline in w and one of order 1 to 3 in u and v.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from diffopt.kernels import frames, spline
from diffopt.kernels.prefactor import Prefactor
from diffopt.scalar import Shadowing, geometry


class Table(eqx.Module):
    """Channels of everything but geometry: R area / lambda^2 |P|^2, weighted and summed.

    Attributes
    ----------
    coefficients
        Of the B-splines over v, u and w, [V, U, W, K]; K is 3 for XYZ, the wavelengths for
        spectra.
    first, step
        u, v, w of the first coefficient and the steps, [3] each.
    low, high
        Ends of the box that was asked for, [3] each.
    order
        Degree in u and v.
    prefactor, shadowing
        Of the model: what is left to compute for a pair of directions.
    relative
        Whether the channels are of the relative reflectance, which includes cos_i.
    """

    coefficients: Float[Array, "V U W K"]
    first: Float[Array, "3"]
    step: Float[Array, "3"]
    low: Float[Array, "3"]
    high: Float[Array, "3"]
    order: int = eqx.field(static=True)
    prefactor: Prefactor = eqx.field(static=True)
    shadowing: Shadowing = eqx.field(static=True)
    relative: bool = eqx.field(static=True)

    def at(self, wave: Float[Array, "*batch 3"]) -> Float[Array, "*batch K"]:
        """Channels without geometry at wave vectors (u, v, w).

        NaN more than half a step outside the box: a wrong value would look like a right one.
        """
        flat = wave.reshape(-1, 3)
        at = (flat - self.first[None, :]) / self.step[None, :]
        value = spline.lookup(self.coefficients, at[:, 0], at[:, 1], at[:, 2], order=self.order)
        value = jnp.where(self.holds(flat)[:, None], value, jnp.nan)
        return value.reshape(*wave.shape[:-1], value.shape[-1])

    def holds(self, wave: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
        """Whether wave vectors lie in the box, with half a step to spare."""
        low, high = self.low - 0.5 * self.step, self.high + 0.5 * self.step
        axes = [(wave[..., i] >= low[i]) & (wave[..., i] <= high[i]) for i in range(3)]
        return axes[0] & axes[1] & axes[2]

    @property
    def nbytes(self) -> int:
        """Memory of the coefficients."""
        return self.coefficients.size * self.coefficients.dtype.itemsize


def reflect(
    table: Table,
    wi: Float[Array, "*batch 3"],
    wo: Float[Array, "*batch 3"],
    *,
    irradiance: bool,
) -> Float[Array, "*batch K"]:
    """Channels of the reflectance for pairs of directions.

    Parameters
    ----------
    table
        The table.
    wi, wo
        Unit vectors in the local frame, [..., 3]; 0 where either is below the horizon.
    irradiance
        Whether to include cos_i: radiance per irradiance across the beam.
    """
    valid, wi, wo = frames.above_horizon(wi, wo)
    factor = geometry(wi, wo, prefactor=table.prefactor, shadowing=table.shadowing)
    if irradiance:
        factor = factor * wi[..., 2]
    wave = frames.wave_vector(wi, wo)
    # The normal, which stands for masked pairs, may lie outside the table.
    wave = jnp.where(valid[..., None], wave, jnp.broadcast_to(table.low, wave.shape))
    return jnp.where(valid[..., None], table.at(wave) * factor[..., None], 0.0)


@eqx.filter_jit
def shade(
    table: Table,
    wi: Float[Array, "*batch 3"],
    wo: Float[Array, "*batch 3"],
) -> Float[Array, "*batch K"]:
    """Light that leaves towards `wo` per irradiance across the beam: f cos_i, as XYZ.

    Arguments as for `reflect`.
    """
    return reflect(table, wi, wo, irradiance=True)
