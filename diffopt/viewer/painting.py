"""Pixels of frames in chunks of one size, so that a program is compiled once for all frames."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from diffopt.kernels import spectrum

#: Samples in a call of a compiled function.
CHUNK = 2**15


def in_chunks(
    shade: Callable[..., Any], count: int, *columns: np.ndarray
) -> UInt8[np.ndarray, "n 3"]:
    """Codes of samples by a function of columns of `CHUNK` rows.

    Parameters
    ----------
    shade
        From rows of the columns to codes, [CHUNK, 3].
    count
        Samples, n.
    columns
        Arrays of n rows; the last chunk is filled up with its first row.
    """
    out = np.empty((count, 3), np.uint8)
    parts = []
    # All calls are sent off before the first is waited for.
    for first in range(0, count, CHUNK):
        rows = [_full(column[first : first + CHUNK]) for column in columns]
        parts.append((first, shade(*rows)))
    for first, found in parts:
        out[first : first + CHUNK] = np.asarray(found)[: count - first]
    return out


def _full(rows: np.ndarray) -> np.ndarray:
    if len(rows) == CHUNK:
        return rows
    out = np.empty((CHUNK, *rows.shape[1:]), rows.dtype)
    out[: len(rows)], out[len(rows) :] = rows, rows[:1]
    return out


def backdrop(rows: int, columns: int) -> UInt8[np.ndarray, "h w 3"]:
    """A neutral gradient, lighter below."""
    ends = np.array([[30.0, 31.0, 34.0], [70.0, 71.0, 74.0]])
    share = (np.linspace(0.0, 1.0, rows) ** 1.5)[:, None, None]
    codes = (1.0 - share) * ends[0] + share * ends[1]
    return np.broadcast_to(np.round(codes).astype(np.uint8), (rows, columns, 3)).copy()


def linear(codes: UInt8[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """Linear values of codes of sRGB (IEC 61966-2-1), float32."""
    return _LINEAR[codes]


def _decoded() -> np.ndarray:
    c = np.arange(256) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)


_LINEAR = _decoded()


def codes(linear: Any, exposure: Any, white: float = 6.0) -> UInt8[Array, "n 3"]:
    """Codes of sRGB of linear values, exposed, with the curve of `diffopt.drawing.tones.tone`.

    `white` is the least value that becomes white, fixed for each program. Values below 0, out of
    gamut, become 0. For use within compiled functions.
    """
    rgb = [jnp.maximum(linear[:, k], 0.0) * exposure for k in range(3)]
    brightest = jnp.maximum(jnp.maximum(rgb[0], rgb[1]), rgb[2])
    peak = jnp.minimum(brightest, white)
    factor = peak * (1.0 + peak / white**2) / ((1.0 + peak) * jnp.maximum(brightest, 1e-12))
    encoded = [jnp.round(255.0 * spectrum.encode_srgb(jnp.clip(c * factor, 0.0, 1.0))) for c in rgb]
    return jnp.stack(encoded, -1).astype(jnp.uint8)


#: `codes`, compiled.
encoded = jax.jit(codes, static_argnums=2)
