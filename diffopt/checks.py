"""Checks of arguments: one line that names the argument, what came and what was expected.

Values inside somebody else's jit are traced and cannot be looked at; they pass.
"""

import difflib
import math
from collections.abc import Iterable, Sequence
from typing import Any

import jax.core
import numpy as np
from jaxtyping import ArrayLike

from diffopt.errors import InputError

# Numbers as users write them: arrays, or nested lists and tuples.
Values = ArrayLike | Sequence[Any]

# A micrometre value this large was given in nanometres.
LONGEST_WAVELENGTH = 100.0


def concrete(value: Values | None) -> np.ndarray | None:
    """The value as a NumPy array, or None where it is traced or absent."""
    if value is None or isinstance(value, jax.core.Tracer):
        return None
    return np.asarray(value)


def choice(name: str, value: str, options: Sequence[str]) -> Any:
    """`value`, which must be one of `options`."""
    if value not in options:
        raise InputError(f"{name} must be one of {', '.join(options)}; received {value!r}")
    return value


def nearest(word: Any, options: Iterable[str]) -> str:
    """The nearest of some words; empty if none is near."""
    return next(iter(difflib.get_close_matches(str(word), list(options), 1)), "")


def in_plane(wave: np.ndarray) -> bool:
    """Whether all (u, v) of pairs of directions, [M, 2], lie on one line, to a thousandth."""
    size = np.linalg.svd(wave, compute_uv=False)
    return len(size) < 2 or bool(size[1] < 1e-3 * max(float(size[0]), 1e-12))


def directions(name: str, value: Values) -> None:
    """Unit vectors on a last axis of three, to 1e-3 in length."""
    shape = np.shape(value)
    if not shape or shape[-1] != 3:
        raise InputError(f"{name} must be unit vectors [..., 3]; received shape {shape}")
    array = concrete(value)
    if array is None or array.size == 0:
        return
    with np.errstate(over="ignore"):  # then the length is infinite, and is said to be
        length = np.linalg.norm(array.astype(np.float64), axis=-1)
    worst = length.flat[np.argmax(np.abs(np.nan_to_num(length, nan=np.inf) - 1.0))]
    if not abs(worst - 1.0) <= 1e-3:
        raise InputError(
            f"{name} must be unit vectors; received one of length {worst:.6g} (divide by the norm)"
        )


def wavelengths(value: Values) -> None:
    """Positive wavelengths in micrometres, [L]."""
    if len(np.shape(value)) > 1:
        raise InputError(
            f"wavelengths must be a vector [L] in micrometres; received shape {np.shape(value)}"
        )
    array = concrete(value)
    if array is None:
        return
    if array.size == 0:
        raise InputError("wavelengths must hold at least one value in micrometres; received none")
    bad = ~((array > 0) & (array <= LONGEST_WAVELENGTH))
    if bad.any():
        hint = " (nanometres? divide by 1000)" if (array > LONGEST_WAVELENGTH).any() else ""
        raise InputError(
            f"wavelengths must be positive and in micrometres; received "
            f"{np.atleast_1d(array)[np.atleast_1d(bad)][0]:g}{hint}"
        )


def coherence(
    value: Values | None, pixel: tuple[float, float], extent: tuple[float, float]
) -> None:
    """sigma_s between one pixel and half the patch, micrometres."""
    array = concrete(value)
    if array is None:
        return
    if array.shape != ():
        raise InputError(f"coherence must be one length in micrometres; received {array.shape}")
    low, high = max(pixel), min(extent) / 2.0
    # Roundoff of a quotient must not refuse a window of exactly half the patch.
    if not low * (1 - 1e-6) <= float(array) <= high * (1 + 1e-6):
        raise InputError(
            f"coherence must lie between the pixel ({low:g} um) and half the patch "
            f"({high:g} um); received {float(array):g} um"
        )


def window_options(coverage: str, blur: Values, repeats: tuple[int, int], mirror: str) -> None:
    """Options that only one kind of window has."""
    amount = concrete(blur)
    if amount is not None and not (np.isfinite(amount).all() and float(amount) >= 0):
        raise InputError(f"blur must be a standard deviation >= 0; received {amount}")
    if coverage != "positions" and (amount is None or float(amount) > 0):
        raise InputError(
            f"blur needs average='positions' and a coherence window; received a "
            f"{coverage!r} model (a coherent window has no closed form for it)"
        )
    if coverage != "positions" and mirror == "apart":
        raise InputError(
            f"mirror='apart' needs average='positions' and a coherence window; received a "
            f"{coverage!r} model"
        )
    if len(repeats) != 2 or any(not isinstance(n, int) or n < 1 for n in repeats):
        raise InputError(f"repeats must be two integers (y, x) >= 1; received {repeats}")
    if coverage != "patch" and tuple(repeats) != (1, 1):
        raise InputError(
            f"repeats needs coherence=None (a window already sees the periodic surface); "
            f"received repeats={repeats}"
        )


def tolerance(value: float) -> None:
    """A relative error in (0, 1)."""
    if not (isinstance(value, int | float) and math.isfinite(value) and 0.0 < value < 1.0):
        raise InputError(f"tolerance must be a relative error in (0, 1); received {value!r}")
