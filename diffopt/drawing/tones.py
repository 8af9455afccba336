"""From colours to what a display can show: gamut, exposure, tone curve, sRGB.

Arrays are NumPy and hold XYZ (Y = 1 for a perfect mirror) or linear sRGB on the last axis. The
wavelengths behind the XYZ values are those of `STEP_NM`, for the white point.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import colour
from diffopt.kernels import spectrum

#: Wavelength step of the tables behind pictures, nanometres.
STEP_NM = 10.0
#: Samples handled in one call of a compiled function.
BLOCK = 16384


def display(
    xyz: Float[np.ndarray, "*batch 3"], illuminant: colour.IlluminantLike = "D65"
) -> Float[np.ndarray, "*batch 3"]:
    """Linear sRGB without negative values: colours out of gamut are mixed with grey.

    Luminance is kept; values above 1 remain.
    """
    wavelengths = colour.wavelengths(STEP_NM)
    matrix = colour.xyz_to_rgb_matrix(illuminant, wavelengths_um=wavelengths)
    linear = np.asarray(xyz, np.float64) @ matrix.T
    white = colour.white_point("D65", wavelengths)
    luminance = linear @ np.linalg.inv(colour.rgb_matrix(white))[1]
    fitted = _in_blocks(_fit, np.concatenate([linear, luminance[..., None]], axis=-1))
    return np.maximum(fitted, 0.0)


def exposure(
    rgb: Float[np.ndarray, "*batch C"], percentile: float = 97.0, least: float = 1e-3
) -> float:
    """Factor that brings a percentile of the brightest channel to 1.

    Parameters
    ----------
    rgb
        Linear values of everything that counts, or of its brightest channel alone.
    percentile
        Share of it, in percent, that stays below 1.
    least
        Smallest value brought to 1, as a share of the largest: a lone mirror spot shall not
        lift the rounding around it.
    """
    if rgb.size == 0 or not rgb.max() > 0.0:
        return 1.0
    return 1.0 / max(float(np.percentile(rgb.max(-1), percentile)), least * float(rgb.max()))


def tone(
    rgb: Float[np.ndarray, "*batch 3"], factor: float, white: float = 6.0
) -> Float[np.ndarray, "*batch 3"]:
    """Exposed linear RGB with the brightest channel p compressed: p (1 + p / white^2) / (1 + p).

    All channels share one factor, so that hues stay: compressing luminance instead would cut
    off the channels of saturated colours. The curve is equation 4 of Reinhard et al.,
    Photographic tone reproduction for digital images, 2002; `white` is the least p that
    becomes 1, and brighter ones are scaled to it.
    """
    brightest = np.maximum(rgb.max(-1, keepdims=True), np.finfo(np.float64).tiny)
    peak = np.minimum(factor * brightest, white)
    return rgb / brightest * (peak * (1.0 + peak / white**2) / (1.0 + peak))


def encode(rgb: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    """SRGB code values in [0, 1] of linear ones."""
    return np.clip(_in_blocks(_encode, np.clip(rgb, 0.0, 1.0)), 0.0, 1.0)


def swatch(
    xyz: Float[np.ndarray, "3"], illuminant: colour.IlluminantLike = "D65"
) -> tuple[float, float, float]:
    """SRGB of a colour as bright as the display can show it."""
    linear = display(xyz[None], illuminant)[0]
    r, g, b = encode(linear / linear.max())
    return float(r), float(g), float(b)


@jax.jit
def _fit(block: Float[Array, "n 4"]) -> Float[Array, "n 3"]:
    return spectrum.fit_gamut(block[:, :3], block[:, 3], "desaturate")


@jax.jit
def _encode(block: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return spectrum.encode_srgb(block)


def _in_blocks(function: Callable[[Array], Array], values: np.ndarray) -> np.ndarray:
    """Apply a function of rows in float32, in blocks of one size: one compilation for all."""
    rows = values.reshape(-1, values.shape[-1])
    out = np.zeros((len(rows), 3))
    for first in range(0, len(rows), BLOCK):
        part = rows[first : first + BLOCK]
        block = np.zeros((BLOCK, rows.shape[-1]), np.float32)
        block[: len(part)] = part
        out[first : first + BLOCK] = np.asarray(function(jnp.asarray(block)))[: len(part)]
    return out.reshape(*values.shape[:-1], 3)
