"""From a table of colours to the codes of pixels in one compiled function.

Samples are stored axis by axis, so that the compiled loops run along them.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import colour, lookup
from diffopt.diffraction import DiffractionBRDF
from diffopt.drawing import pictures, tones, views
from diffopt.kernels import spectrum

# The brightest value that the tone curve tells from white, see `diffopt.drawing.tones.tone`.
_WHITE = 6.0

# Coordinates are lists of arrays [n]: XLA does not fuse sums and maxima over an axis of three
# into the loops around them, which then take twice as long.
Coordinates = list[Array]


class Samples(eqx.Module):
    """Where a surface is seen.

    Attributes
    ----------
    tangent, across, normal
        Axes of the material, [3, n].
    position
        [3, n].
    eye
        Directions to the camera in the material's frame, [3, n]; below the horizon where the
        view is too grazing to be shown.
    """

    tangent: Float[Array, "3 n"]
    across: Float[Array, "3 n"]
    normal: Float[Array, "3 n"]
    position: Float[Array, "3 n"]
    eye: Float[Array, "3 n"]


class Film(eqx.Module):
    """How light becomes colours of a display.

    Attributes
    ----------
    to_rgb, luminance
        From XYZ to linear sRGB, [3, 3], and from that to its luminance, [3].
    surroundings
        XYZ that uniform surroundings add at exposure 1, [3].
    """

    to_rgb: Float[Array, "3 3"]
    luminance: Float[Array, "3"]
    surroundings: Float[Array, "3"]


def film(brdf: DiffractionBRDF, illuminant: colour.IlluminantLike = "D65") -> Film:
    """Film for a material under an illuminant, in its dim white surroundings."""
    wavelengths = colour.wavelengths(tones.STEP_NM)
    matrix = colour.xyz_to_rgb_matrix(illuminant, wavelengths_um=wavelengths)
    day = colour.white_point("D65", wavelengths)
    white = colour.white_point(illuminant, wavelengths)
    ambient = pictures.SURROUNDINGS * white * views.normal_colour(brdf, illuminant)
    return Film(
        jnp.asarray(matrix, jnp.float32),
        jnp.asarray(np.linalg.inv(colour.rgb_matrix(day))[1], jnp.float32),
        jnp.asarray(ambient, jnp.float32),
    )


def codes(held: Film, xyz: Coordinates, exposure: Array) -> Coordinates:
    """Codes of sRGB of light and surroundings, uint8 [n] each, by the curve of `tones.tone`."""
    rgb = display(held, [c + s / exposure for c, s in zip(xyz, held.surroundings, strict=True)])
    brightest = jnp.maximum(jnp.maximum(rgb[0], rgb[1]), rgb[2])
    brightest = jnp.maximum(brightest, jnp.finfo(jnp.float32).tiny)
    peak = jnp.minimum(exposure * brightest, _WHITE)
    factor = peak * (1.0 + peak / _WHITE**2) / ((1.0 + peak) * brightest)
    linear = (jnp.clip(c * factor, 0.0, 1.0) for c in rgb)
    return [jnp.round(255.0 * spectrum.encode_srgb(c)).astype(jnp.uint8) for c in linear]


def radiance(
    table: lookup.Table,
    seen: Samples,
    light: Array,
    turn: Array,
    near: Array,
    lit: Array | None = None,
) -> Coordinates:
    """XYZ that a light adds to samples, [n] each.

    Parameters
    ----------
    table
        Colours over wave vectors; where a light lies beyond it, it adds nothing.
    seen
        The samples.
    light
        Direction to it, of any length, or its position where `near`, [3].
    turn
        Of the material about the normal, radians.
    near
        Whether `light` is a position.
    lit
        Which samples it reaches, [n].
    """
    towards = [light[k] - near * seen.position[k] for k in range(3)]
    length = jnp.sqrt(dot(towards, towards))
    towards = [c / length for c in towards]
    axes = (seen.tangent, seen.across, seen.normal)
    wi = _turned([dot(list(axis), towards) for axis in axes], turn)
    wo = _turned(list(seen.eye), turn)
    dtype = table.coefficients.dtype
    pairs = (jnp.stack(w, axis=-1).astype(dtype) for w in (wi, wo))
    xyz: Any = lookup.shade(table, *pairs).astype(jnp.float32)
    if lit is not None:
        xyz = jnp.where(lit[:, None], xyz, 0.0)
    return [jnp.where(jnp.isfinite(xyz[:, k]), xyz[:, k], 0.0) for k in range(3)]


def display(held: Film, xyz: Coordinates) -> Coordinates:
    """Linear sRGB in gamut, as `tones.display` and `diffopt.kernels.spectrum.desaturate`."""
    rgb = [dot(list(row), xyz) for row in held.to_rgb]
    grey = jnp.maximum(dot(list(held.luminance), rgb), 0.0)
    kept = jnp.ones_like(grey)
    for c in rgb:
        outside = c < 0.0
        kept = jnp.minimum(kept, jnp.where(outside, grey / jnp.where(outside, grey - c, 1.0), 1.0))
    kept = jnp.where(grey > 0.0, kept, 0.0)
    return [jnp.maximum(grey + kept * (c - grey), 0.0) for c in rgb]


def _turned(local: Coordinates, turn: Array) -> Coordinates:
    x, y, z = local
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    return [cos * x - sin * y, cos * y + sin * x, z]


def dot(a: Coordinates, b: Coordinates) -> Array:
    """Products summed over the three coordinates."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
