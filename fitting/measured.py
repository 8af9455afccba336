"""Measured reflectance, checked where it comes in."""

from collections.abc import Callable
from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError

Quantity = Literal["spectral", "relative"]


class Measured(eqx.Module):
    """Measured spectral reflectance of a surface.

    Parameters
    ----------
    wi, wo
        Unit vectors to the light and to the viewer, above the horizon, x across the lines,
        [M, 3] each, or [3] for one direction shared by all.
    wavelengths
        Micrometres, [L].
    values
        f in 1/sr, or the relative reflectance of `DiffractionBRDF.relative`, [M, L].
    coherence
        sigma_s of the coherence window of the measurement, micrometres.
    quantity
        What the values are: ``spectral`` (f) or ``relative``.
    noise
        Standard deviation of each value up to a common factor, [M, L]; the same for all if
        left out. Give it where noise grows with the value, or standard errors come out
        several times too small.

    Raises
    ------
    InputError
        If shapes do not match, values are not finite or all zero, directions are below the
        horizon, or coherence or noise is not positive.
    """

    wi: Float[Array, "M 3"]
    wo: Float[Array, "M 3"]
    wavelengths: Float[Array, " L"]
    values: Float[Array, "M L"]
    coherence: Float[Array, ""]
    noise: Float[Array, "M L"]
    quantity: Quantity = eqx.field(static=True)

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
    ):
        checks.choice("quantity", quantity, get_args(Quantity))
        for name, way in (("wi", wi), ("wo", wo)):
            checks.directions(name, way)
            known = checks.concrete(way)
            if known is not None and not (known[..., 2] > 0).all():
                raise InputError(f"{name} must lie above the horizon (z > 0); received one below")
        checks.wavelengths(wavelengths)
        values = jnp.asarray(values)
        count = np.size(wavelengths)
        if values.ndim != 2 or values.shape[1] != count:
            raise InputError(
                f"values must be [M, L] with L = {count} wavelengths; received {values.shape}"
            )
        if not jnp.issubdtype(values.dtype, jnp.floating):
            raise InputError(f"values must be floating-point; received {values.dtype}")
        for name, way in (("wi", wi), ("wo", wo)):
            if np.shape(way) not in ((3,), (values.shape[0], 3)):
                raise InputError(
                    f"{name} must be [3] or [M, 3] with the M = {values.shape[0]} rows of values; "
                    f"received {np.shape(way)}"
                )
        if noise is not None and np.shape(noise) != values.shape:
            raise InputError(
                f"noise must be [M, L] as values, {values.shape}; received {np.shape(noise)}"
            )
        require("values", values, lambda v: np.isfinite(v).all() and v.any(), "finite, not all 0")
        require("noise", noise, lambda v: np.isfinite(v).all() and (v > 0).all(), "positive")
        require("coherence", coherence, lambda v: v.ndim == 0 and 0 < v < np.inf, "one length > 0")
        dtype, shape = values.dtype, (values.shape[0], 3)
        self.wi, self.wo = (jnp.broadcast_to(jnp.asarray(w, dtype), shape) for w in (wi, wo))
        self.wavelengths = jnp.atleast_1d(jnp.asarray(wavelengths, dtype))
        self.values = values
        self.coherence = jnp.asarray(coherence, dtype)
        self.noise = jnp.ones_like(values) if noise is None else jnp.asarray(noise, dtype)
        self.quantity = quantity


def require(name: str, value: Any, holds: Callable[[np.ndarray], Any], expected: str) -> None:
    """Refuse a value that is known and not as expected."""
    array = None if value is None else checks.concrete(value)
    if array is not None and not holds(array):
        raise InputError(f"{name} must be {expected}; received {_shown(array)}")


def _shown(array: np.ndarray) -> str:
    return f"{array:g}" if array.ndim == 0 else f"values from {array.min():g} to {array.max():g}"
