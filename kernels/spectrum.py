"""From spectra to colours: quadrature weights, XYZ, linear RGB, gamut and sRGB encoding.

The tables (matching functions, illuminants, matrices) come from the caller; here is only
arithmetic on arrays with the spectrum or the three colour coordinates on the last axis.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

GAMUTS = ("desaturate", "clip", "none")


def trapezoid_weights(wavelengths: Float[Array | np.ndarray, " L"]):
    """Weights of the trapezoid rule, sum(weights * f) = integral of f over the wavelengths.

    Parameters
    ----------
    wavelengths
        At least two wavelengths in ascending order, evenly spaced or not. A NumPy array gives
        a NumPy array, so that float64 tables can be made without 64-bit types in JAX.

    Returns
    -------
    Array
        One weight for each wavelength, in the unit of the wavelengths.

    Raises
    ------
    ValueError
        With fewer than two wavelengths.
    """
    if wavelengths.shape[0] < 2:
        raise ValueError(
            f"wavelengths: {wavelengths.shape[0]} given, the trapezoid rule needs at least 2"
        )
    xp = np if isinstance(wavelengths, np.ndarray) else jnp
    half = 0.5 * (wavelengths[1:] - wavelengths[:-1])
    return xp.concatenate([half[:1], half[:-1] + half[1:], half[-1:]])


def weights_to_xyz(
    values: Float[Array, "*batch L"], weights: Float[Array, "L 3"]
) -> Float[Array, "*batch 3"]:
    """Tristimulus values, the sum over l of values[..., l] * weights[l].

    Parameters
    ----------
    values
        Reflectances, or any other quantity proportional to the light, at L wavelengths.
    weights
        Matching functions times illuminant times quadrature weight, normalised so that a
        perfect white reflector has Y = 1; of the same type as `values`.

    Returns
    -------
    Array
        X, Y and Z on the last axis.
    """
    return jnp.matmul(values, weights, precision=jax.lax.Precision.HIGHEST)


def transform(
    colours: Float[Array, "*batch 3"], matrix: Float[Array, "3 3"]
) -> Float[Array, "*batch 3"]:
    """Product of a 3x3 matrix with each colour, the sum over j of matrix[i, j] colours[..., j].

    Parameters
    ----------
    colours
        XYZ or linear RGB on the last axis.
    matrix
        For instance XYZ to linear RGB; of the same type as `colours`.

    Returns
    -------
    Array
        The transformed colours.
    """
    return jnp.matmul(colours, matrix.T, precision=jax.lax.Precision.HIGHEST)


def desaturate(
    rgb: Float[Array, "*batch 3"], luminance: Float[Array, "*batch"]
) -> Float[Array, "*batch 3"]:
    """Mix with the grey of the same luminance until no coordinate is negative.

    rgb' = Y + t (rgb - Y) with t the smallest Y/(Y - c) over the negative coordinates c, or 1
    without any: luminance is kept, hue direction from white is kept, saturation is lost.

    Parameters
    ----------
    rgb
        Linear RGB relative to a white (1, 1, 1) of luminance 1.
    luminance
        Y of each colour; 0 or less gives black.

    Returns
    -------
    Array
        Linear RGB with all coordinates at least 0.
    """
    grey = jnp.maximum(luminance, 0.0)[..., None]
    outside = rgb < 0.0
    span = jnp.where(outside, grey - rgb, 1.0)
    # Either by a number that cancels: the square of a dark span vanishes, its inverse does not.
    # (A quotient of quotients would be rearranged by the compiler.)
    size = jax.lax.stop_gradient(1.0 / jnp.where(span > 0.0, span, 1.0))
    each = jnp.where(outside, (grey * size) / (span * size), 1.0)
    # By pairs: the slope of a minimum over an axis is 0 / 0 where values are rounded anew.
    t = jnp.minimum(jnp.minimum(each[..., :1], each[..., 1:2]), each[..., 2:3])
    t = jnp.where(grey > 0.0, t, 0.0)
    # Rounding leaves the limiting coordinate within an ulp or so of 0, on either side.
    return jnp.maximum(grey + t * (rgb - grey), 0.0)


def fit_gamut(
    rgb: Float[Array, "*batch 3"], luminance: Float[Array, "*batch"], choice: str
) -> Float[Array, "*batch 3"]:
    """Bring linear RGB to non-negative coordinates in the named way.

    Parameters
    ----------
    rgb, luminance
        As for `desaturate`.
    choice
        "desaturate" (keeps the luminance), "clip" (sets negative coordinates to 0, which
        brightens and shifts the hue) or "none" (returns the input).

    Returns
    -------
    Array
        Linear RGB.

    Raises
    ------
    ValueError
        For another choice.
    """
    if choice == "desaturate":
        return desaturate(rgb, luminance)
    if choice == "clip":
        return jnp.maximum(rgb, 0.0)
    if choice == "none":
        return rgb
    raise ValueError(f"gamut: {choice!r} given, expected one of {', '.join(GAMUTS)}")


def encode_srgb(linear: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """SRGB transfer function from linear to encoded values (IEC 61966-2-1:1999).

    12.92 x up to 0.0031308, then 1.055 x^(1/2.4) - 0.055; odd in x, and the power goes on
    above 1, so values out of range survive a round trip. The two pieces differ by 3e-8 at
    the joint, a property of the standard's rounded constants.

    Parameters
    ----------
    linear
        Linear values, white at 1.

    Returns
    -------
    Array
        Encoded values.
    """
    size = jnp.abs(linear)
    toe = size <= 0.0031308
    power = 1.055 * jnp.where(toe, 1.0, size) ** (1.0 / 2.4) - 0.055
    return jnp.where(toe, 12.92 * linear, jnp.sign(linear) * power)


def decode_srgb(encoded: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Inverse of `encode_srgb` (IEC 61966-2-1:1999): linear up to 0.04045, odd.

    Parameters
    ----------
    encoded
        Encoded values, white at 1.

    Returns
    -------
    Array
        Linear values.
    """
    size = jnp.abs(encoded)
    toe = size <= 0.04045
    power = ((jnp.where(toe, 1.0, size) + 0.055) / 1.055) ** 2.4
    return jnp.where(toe, encoded / 12.92, jnp.sign(encoded) * power)
