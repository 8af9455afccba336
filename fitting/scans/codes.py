"""Parameters of a surface as numbers without bounds, and its heights at rows and columns."""

import math
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.fitting.scans.disc import Pits
from diffopt.gratings import Parametric, Surface
from diffopt.gratings.parametric import kinds

_P = TypeVar("_P", bound=Parametric)


def free(surface: Parametric) -> tuple[str, ...]:
    """Parameters that heights depend on beyond a plane: all but offsets."""
    return tuple(path for path in kinds(surface) if path.split(".")[-1] != "offset")


def encoded(surface: Parametric, names: tuple[str, ...], scale: float) -> np.ndarray:
    """Numbers of order one without bounds: log of lengths, log odds of shares."""
    out, found = [], kinds(surface)
    for name in names:
        value, kind = float(surface.get(name)), found[name]
        if kind in ("length", "density"):
            value = math.log(value)
        elif kind == "share":
            value = min(max(value, 1e-4), 1.0 - 1e-4)
            value = math.log(value / (1.0 - value))
        elif kind == "height":
            value = value / scale
        out.append(value)
    return np.array(out)


def decoded(
    u: Float[Array, " P"], surface: _P, names: tuple[str, ...], scale: Float[Array, ""]
) -> _P:
    """The surface with parameters from `encoded`."""
    found, values = kinds(surface), {}
    for k, name in enumerate(names):
        kind = found[name]
        if kind in ("length", "density"):
            values[name] = jnp.exp(u[k])
        elif kind == "share":
            values[name] = jax.nn.sigmoid(u[k])
        else:
            values[name] = u[k] * scale if kind == "height" else u[k]
    return surface.replaced(values)


def natural(u: np.ndarray, surface: Parametric, names: tuple[str, ...], scale: float) -> np.ndarray:
    """Derivatives of the parameters to their encoded numbers."""
    found, out = kinds(surface), []
    for name in names:
        value = float(surface.get(name))
        kind = found[name]
        if kind == "share":
            value = value * (1.0 - value)
        elif kind == "height":
            value = scale
        elif kind not in ("length", "density"):
            value = 1.0
        out.append(value)
    return np.array(out)


def field(
    surface: Parametric,
    y: Float[Array, " ny"],
    x: Float[Array, " nx"],
    pixel: tuple[float, float],
    edges: str,
) -> Float[Array, "ny nx"]:
    """Heights at rows and columns, of a grating, two of them crossed, or pits."""
    if isinstance(surface, Pits):
        return surface.at(y, x, pixel)
    assert isinstance(surface, Surface)
    assert not surface.RANDOM
    return surface.sampled(y, x, pixel, edges, None)
