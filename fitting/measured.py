"""Measured reflectance, checked where it comes in."""

import os
from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks, colour
from diffopt.errors import InputError

Quantity = Literal["spectral", "relative", "power", "xyz", "rgb"]
Gain = Literal["known", "free"]
COLOURS = ("xyz", "rgb")


class Measured(eqx.Module):
    """Measured reflectance of a surface: spectra, or colours.

    Parameters
    ----------
    wi, wo
        Unit vectors to the light and to the viewer, above the horizon, [M, 3] each, or [3] for
        one direction shared by all.
    wavelengths
        Micrometres, [L]. For colours those over which a model is integrated, 380 to 780 nm in
        steps of 5 nm if None.
    values
        [M, L], or [M, 3] for colours.
    coherence
        sigma_s of the coherence window of the measurement, micrometres.
    quantity
        What the values are: ``spectral`` (f in 1/sr), ``relative`` (the relative reflectance of
        `DiffractionBRDF.relative`), ``power`` (|P|^2 over a mirror's peak), ``xyz`` (CIE 1931,
        of f under `illuminant`), ``rgb`` (the same in linear sRGB, neither clipped nor encoded).
    noise
        Standard deviation of each value, in its unit, as `values` or one number for all; the
        same for all, and unknown, if left out.
    noise_known
        Whether the noise is absolute, so that a misfit larger than it says that the model is
        wrong; else it is taken up to a common factor, which the residuals tell.
    gain
        ``free`` where the values are known up to one common factor.
    blur
        Standard deviation, in u and in v (direction sines), of source and pixel together.
    illuminant
        Of colours, see `diffopt.colour.spectral_weights`.

    Raises
    ------
    InputError
        If shapes do not match, values are not finite or all zero, directions are below the
        horizon, or coherence or noise is not positive.
    """

    wi: Float[Array, "M 3"]
    wo: Float[Array, "M 3"]
    wavelengths: Float[Array, " L"]
    values: Float[Array, "M C"]
    coherence: Float[Array, ""]
    noise: Float[Array, "M C"]
    blur: Float[Array, ""]
    weights: Float[Array, "L 3"] | None
    quantity: Quantity = eqx.field(static=True)
    noise_known: bool = eqx.field(static=True)
    gain: Gain = eqx.field(static=True)

    def __init__(
        self,
        wi: Any,
        wo: Any,
        wavelengths: Any,
        values: Any,
        coherence: Any,
        *,
        quantity: Quantity = "spectral",
        noise: Any = None,
        noise_known: bool = False,
        gain: Gain = "known",
        blur: Any = 0.0,
        illuminant: colour.IlluminantLike = "D65",
    ):
        checks.choice("quantity", quantity, get_args(Quantity))
        checks.choice("gain", gain, get_args(Gain))
        for name, way in (("wi", wi), ("wo", wo)):
            checks.directions(name, way)
            known = checks.concrete(way)
            if known is not None and not (known[..., 2] > 0).all():
                raise InputError(f"{name} must lie above the horizon (z > 0); received one below")
        colours = quantity in COLOURS
        if wavelengths is None:
            if not colours:
                raise InputError(f"wavelengths must be given for quantity={quantity!r}")
            wavelengths = colour.wavelengths()
        checks.wavelengths(wavelengths)
        values = jnp.asarray(values)
        count = 3 if colours else np.size(wavelengths)
        if values.ndim != 2 or values.shape[1] != count:
            what = "for colours" if colours else f"with L = {count} wavelengths"
            raise InputError(
                f"values must be [M, {3 if colours else 'L'}] {what}; received {values.shape}"
            )
        if not jnp.issubdtype(values.dtype, jnp.floating):
            raise InputError(f"values must be floating-point; received {values.dtype}")
        for name, way in (("wi", wi), ("wo", wo)):
            if np.shape(way) not in ((3,), (values.shape[0], 3)):
                raise InputError(
                    f"{name} must be [3] or [M, 3] with the M = {values.shape[0]} rows of values; "
                    f"received {np.shape(way)}"
                )
        if noise is not None and np.shape(noise) not in ((), values.shape):
            raise InputError(
                f"noise must be one number or as values, {values.shape}; received {np.shape(noise)}"
            )
        if noise_known and noise is None:
            raise InputError("noise_known=True: expected the noise, received none")
        require("values", values, lambda v: np.isfinite(v).all() and v.any(), "finite, not all 0")
        require("noise", noise, lambda v: np.isfinite(v).all() and (v > 0).all(), "positive")
        require("coherence", coherence, lambda v: v.ndim == 0 and 0 < v < np.inf, "one length > 0")
        require("blur", blur, lambda v: v.ndim == 0 and 0 <= v < 1, "one number from 0 to 1")
        dtype, shape = values.dtype, (values.shape[0], 3)
        self.wi, self.wo = (jnp.broadcast_to(jnp.asarray(w, dtype), shape) for w in (wi, wo))
        self.wavelengths = jnp.atleast_1d(jnp.asarray(wavelengths, dtype))
        self.values = values
        self.coherence, self.blur = jnp.asarray(coherence, dtype), jnp.asarray(blur, dtype)
        noise = jnp.asarray(1.0 if noise is None else noise, dtype)
        self.noise = jnp.broadcast_to(noise, values.shape)
        self.quantity, self.noise_known, self.gain = quantity, bool(noise_known), gain
        self.weights = colour_weights(np.asarray(wavelengths), illuminant, quantity, dtype)

    def astype(self, dtype: Any) -> "Measured":
        """With another floating-point type."""
        return jax.tree.map(lambda leaf: leaf.astype(dtype), self)

    def save(self, path: str | os.PathLike) -> None:
        """Write to .npz or .csv, see `diffopt.fitting.measured_files.save`."""
        from diffopt.fitting import measured_files

        data: Any = self
        measured_files.save(data, path)

    @classmethod
    def load(cls, path: str | os.PathLike, **stated: Any) -> "Measured":
        """Read what `save` wrote, or another .npz or .csv with what it does not state.

        See `diffopt.fitting.measured_files.load`.
        """
        from diffopt.fitting import measured_files

        found: Any = measured_files.load(path, **stated)
        return found

    def part(self, rows: Any) -> "Measured":
        """Some of the rows (pairs of directions), by their numbers."""
        leaves = [self.wi, self.wo, self.values, self.noise]
        return eqx.tree_at(
            lambda m: [m.wi, m.wo, m.values, m.noise], self, [leaf[rows] for leaf in leaves]
        )

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.measured_card)


def colour_weights(wavelengths: np.ndarray, illuminant: Any, quantity: Quantity, dtype: Any) -> Any:
    """From spectra on these wavelengths to colours, [L, 3]; None for spectra."""
    if quantity not in COLOURS:
        return None
    weights = np.asarray(colour.spectral_weights(wavelengths, illuminant=illuminant), np.float64)
    if quantity == "rgb":
        matrix = colour.xyz_to_rgb_matrix(illuminant, wavelengths_um=wavelengths)
        weights = weights @ matrix.T
    return jnp.asarray(weights, dtype)


def require(name: str, value: Any, holds: Callable[[np.ndarray], Any], expected: str) -> None:
    """Refuse a value that is known and not as expected."""
    array = None if value is None else checks.concrete(value)
    if array is not None and not holds(array):
        raise InputError(f"{name} must be {expected}; received {_shown(array)}")


def _shown(array: np.ndarray) -> str:
    return f"{array:g}" if array.ndim == 0 else f"values from {array.min():g} to {array.max():g}"
