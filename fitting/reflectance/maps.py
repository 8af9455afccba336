"""Bounds of parameters, by smooth maps from unbounded numbers.

Optimistix has no bounds, so unbounded y stand for the parameters:

- a positive parameter is low (high / low)^sigmoid(y), even in its logarithm;
- a share is low + (high - low) sigmoid(y);
- an angle is y itself.

The maps are strictly increasing: a minimum in y is one in the parameter, or the parameter has
run against its bound, which `at_bound` tells.
"""

import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.fitting.measured import Measured
from diffopt.gratings import Surface
from diffopt.gratings.parametric import kinds

# A parameter this close to a bound, in y, has run against it.
_FAR = 7.0


class Bounds(eqx.Module):
    """Bounds of the free parameters of a kind of surface, by name.

    Attributes
    ----------
    names
        Free parameters, in their order.
    low, high
        In the parameters' units; heights are bounded in size, their sign is that of the start.
    shapes
        ``log``, ``share`` or ``free``, see the head of this module.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    low: Float[Array, " P"]
    high: Float[Array, " P"]
    shapes: tuple[str, ...] = eqx.field(static=True)

    def of(self, head: str) -> "Bounds":
        """Those of a surface within, by its name."""
        keep = [k for k, name in enumerate(self.names) if name.startswith(f"{head}.")]
        return Bounds(
            tuple(self.names[k].removeprefix(f"{head}.") for k in keep),
            self.low[np.array(keep)],
            self.high[np.array(keep)],
            tuple(self.shapes[k] for k in keep),
        )

    def values(self, y: Float[Array, " P"]) -> Float[Array, " P"]:
        """Parameters that unbounded numbers stand for; sizes where these are heights."""
        share = jax.nn.sigmoid(y)
        low, high = self.low.astype(y.dtype), self.high.astype(y.dtype)
        log = low * jnp.exp(jnp.log(high / low) * share)
        even = low + (high - low) * share
        shape = np.array(self.shapes)
        return jnp.where(shape == "free", y, jnp.where(shape == "log", log, even))

    def unbounded(self, values: np.ndarray) -> np.ndarray:
        """The numbers that stand for parameters [..., P]; those at a bound are moved inside."""
        value, shape = np.asarray(values, np.float64), np.array(self.shapes)
        low, high = np.asarray(self.low, np.float64), np.asarray(self.high, np.float64)
        even = (value - low) / (high - low)
        with np.errstate(divide="ignore"):
            log = np.log(np.abs(value) / low) / np.log(high / low)
        t = np.clip(np.where(shape == "log", log, even), 1e-3, 1.0 - 1e-3)
        return np.where(shape == "free", value, np.log(t / (1.0 - t)))

    def surface(self, like: Surface, y: Float[Array, " P"]) -> Surface:
        """A surface with the parameters that y stand for, signs and the rest as in `like`."""
        values = dict(zip(self.names, self.values(y), strict=True))
        every = kinds(like)
        for name in self.names:
            if every[name] == "height":
                values[name] = jnp.where(like.get(name) < 0, -values[name], values[name])
        return like.replaced(values)

    def at_bound(self, y: np.ndarray) -> dict[str, str]:
        """Names of parameters that have run against a bound, with what happened."""
        found = {}
        ends = np.asarray(self.low), np.asarray(self.high)
        for k, (name, shape) in enumerate(zip(self.names, self.shapes, strict=True)):
            if shape != "free" and abs(y[k]) > _FAR:
                found[name] = f"it ran against its bound {ends[int(y[k] > 0)][k]:.4g}"
        return found


def default_bounds(
    surface: Surface,
    names: tuple[str, ...],
    *,
    frequency: float,
    coherence: float,
    wavelengths: tuple[float, float],
    given: Mapping[str, Any] | None = None,
) -> Bounds:
    """Bounds of parameters from what the data can see.

    Parameters
    ----------
    surface
        Of the kind to fit.
    names
        Free parameters.
    frequency
        Largest frequency of the data, cycles per micrometre.
    coherence
        sigma_s, micrometres.
    wavelengths
        Shortest and longest, micrometres.
    given
        Bounds (low, high) by name that replace these.

    Raises
    ------
    InputError
        If a name is none of the free parameters, or a bound is not an ascending pair.
    """
    given = dict(given or {})
    every = kinds(surface)
    for name in given:
        if name not in names:
            raise InputError(f"bounds: {name!r} is no free parameter; expected {', '.join(names)}")
    shortest, longest = wavelengths
    # Lines of longer periods run into each other; shorter ones have no order in the data.
    length = (0.5 / frequency, 6.0 * coherence)
    ranges = {
        "length": length,
        "height": (shortest / 1000.0, 2.0 * longest),
        "density": (1e-3, 1e2),
        "share": (0.005, 0.995),
        "spread": (1e-4, 0.5),
    }
    special = {
        "amplitude": (shortest / 2000.0, longest),
        "rms": (shortest / 1000.0, 2.0 * longest),
        "displacement": (1e-3 * coherence, coherence),
        "correlation_length": (0.5 / frequency, 20.0 * coherence),
        "bit": (0.2, 0.4),
        "size": (0.25 / frequency, 2.0 * coherence),
        "width": (0.02, 0.75),
    }
    low, high, shapes = [], [], []
    for name in names:
        kind, last = every[name], name.split(".")[-1]
        shape = {"share": "share", "angle": "free", "turns": "free", "phase": "free"}.get(
            kind, "log"
        )
        bottom, top = special.get(last, ranges.get(kind, (-math.inf, math.inf)))
        if name in given:
            bottom, top = _pair(name, given[name], shape)
        # What is free has bounds that no formula trips over.
        low.append(1.0 if shape == "free" else float(bottom))
        high.append(2.0 if shape == "free" else float(top))
        shapes.append(shape)
    dtype = surface.dtype
    return Bounds(names, jnp.asarray(low, dtype), jnp.asarray(high, dtype), tuple(shapes))


def bounds_for(
    surface: Surface,
    names: tuple[str, ...],
    measured: Measured,
    frequency: float,
    given: Mapping[str, Any] | None = None,
) -> Bounds:
    """`default_bounds` from data and their largest frequency."""
    return default_bounds(
        surface,
        names,
        frequency=frequency,
        coherence=float(measured.coherence),
        wavelengths=(float(measured.wavelengths.min()), float(measured.wavelengths.max())),
        given=given,
    )


def _pair(name: str, value: Any, shape: str) -> tuple[float, float]:
    try:
        low, high = (float(v) for v in value)
    except (TypeError, ValueError):
        low = high = math.nan
    if not (low < high and (low > 0 or shape != "log") and math.isfinite(high - low)):
        positive = " and above 0" if shape == "log" else ""
        raise InputError(
            f"bounds[{name!r}] must be (low, high), ascending{positive}; received {value!r}"
        )
    return low, high
