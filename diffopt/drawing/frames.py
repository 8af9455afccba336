"""Frames of a lit object at interactive rates: from the light to the pixels in one function.

The look is that of `diffopt.drawing.pictures.photograph` without supersampling. What does not
depend on the light is computed once, in float32, and only for the samples that show the
material; they are stored axis by axis, so that the compiled loops run along the samples.

>>> frame = Frames(brdf, table, view)
>>> exposure = frame.exposure(light)
>>> pixels = frame(light, exposure=exposure)
"""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from diffopt import colour, lookup
from diffopt.checks import Values
from diffopt.diffraction import DiffractionBRDF
from diffopt.drawing import pictures, shapes, tones, views
from diffopt.errors import InputError
from diffopt.kernels import spectrum

# The brightest value that the tone curve tells from white, see `diffopt.drawing.tones.tone`.
_WHITE = 6.0


class Frames(eqx.Module):
    """One object before one camera; called with a light it gives a picture.

    Attributes
    ----------
    table
        Colours over the wave vectors of all lights.
    tangent, across, normal
        Axes of the material at the n samples that show it, [3, n].
    position
        Their places, [3, n].
    eye
        Directions to the camera in the material's frame, [3, n]; below the horizon where the
        view is too grazing to be shown.
    pixel
        Numbers of their pixels, row after row, [n].
    ground
        The picture without the material, [h, w, 3].
    to_rgb, luminance
        From XYZ to linear sRGB, [3, 3], and from that to its luminance, [3].
    surroundings
        XYZ that uniform surroundings add at exposure 1, [3].
    """

    table: lookup.Table
    tangent: Float[Array, "3 n"]
    across: Float[Array, "3 n"]
    normal: Float[Array, "3 n"]
    position: Float[Array, "3 n"]
    eye: Float[Array, "3 n"]
    pixel: Int[Array, " n"]
    ground: UInt8[Array, "h w 3"]
    to_rgb: Float[Array, "3 3"]
    luminance: Float[Array, "3"]
    surroundings: Float[Array, "3"]

    def __init__(
        self,
        brdf: DiffractionBRDF,
        table: lookup.Table,
        view: shapes.View,
        *,
        illuminant: colour.IlluminantLike = "D65",
    ):
        """Prepare the frames of a view.

        Parameters
        ----------
        brdf, table
            The model and its table over the wave vectors of all lights to come, see `reach`.
        view
            The object before its camera.
        illuminant
            As for the table.

        Raises
        ------
        InputError
            If the view shows no material.
        """
        pixel = np.flatnonzero(view.covered)
        if len(pixel) == 0:
            raise InputError("the view shows no material; expected a camera that sees its front")

        def columns(vectors: np.ndarray) -> Array:
            return jnp.asarray(vectors.reshape(-1, 3)[pixel].T, jnp.float32)

        eye = view.local(view.eye)
        shown = eye[..., 2:] > math.cos(views.GRAZING)
        wavelengths = colour.wavelengths(tones.STEP_NM)
        matrix = colour.xyz_to_rgb_matrix(illuminant, wavelengths_um=wavelengths)
        day = colour.white_point("D65", wavelengths)
        white = colour.white_point(illuminant, wavelengths)
        ambient = pictures.SURROUNDINGS * white * views.normal_colour(brdf, illuminant)
        self.table = table
        self.tangent, self.normal = columns(view.tangent), columns(view.normal)
        self.across = columns(np.cross(view.normal, view.tangent))
        self.position = columns(view.position)
        self.eye = columns(np.where(shown, eye, [0.0, 0.0, -1.0]))
        self.pixel = jnp.asarray(pixel, jnp.int32)
        self.ground = jnp.asarray(_ground(view, illuminant))
        self.to_rgb = jnp.asarray(matrix, jnp.float32)
        self.luminance = jnp.asarray(np.linalg.inv(colour.rgb_matrix(day))[1], jnp.float32)
        self.surroundings = jnp.asarray(ambient, jnp.float32)

    def __call__(
        self,
        light: Values,
        *,
        exposure: Values,
        turn: Values = 0.0,
        near: bool = False,
        lit: Bool[Array | np.ndarray, "h w"] | None = None,
    ) -> UInt8[Array, "h w 3"]:
        """SRGB picture under one light, at unit irradiance across its beam.

        One program serves all lights, turns and exposures; one more where `lit` is given.

        Parameters
        ----------
        light
            Direction to the light in the world, of any length, or its position if `near`, [3].
        exposure
            Factor on linear values, see the method of that name.
        turn
            Of the material about the normal, radians, as `diffopt.drawing.shapes.View.turned`.
        near
            Whether `light` is a position.
        lit
            Which samples the light reaches, see `diffopt.drawing.meshes.lit`; if left out, all
            whose front it faces.
        """
        scene = self._scene(light, turn, near)
        return _frame(self, *scene, _single(exposure), lit)

    def exposure(
        self,
        light: Values,
        *,
        turn: Values = 0.0,
        near: bool = False,
        lit: Bool[Array | np.ndarray, "h w"] | None = None,
        percentile: float = 96.0,
    ) -> float:
        """Exposure of a picture under this light, see `diffopt.drawing.tones.exposure`.

        Parameters
        ----------
        light, turn, near, lit
            As for the picture.
        percentile
            Percentage of the lit samples that stay below white.
        """
        rgb, bright = _linear(self, *self._scene(light, turn, near), lit)
        return tones.exposure(np.asarray(rgb, np.float64)[np.asarray(bright)], percentile)

    def _scene(self, light: Values, turn: Values, near: bool) -> tuple[Array, Array, Array]:
        """Arguments as arrays, which change without a new compilation."""
        source = _single(light)
        if source.shape != (3,):
            raise InputError(f"light must be a vector of three; received shape {source.shape}")
        return source, _single(turn), _single(near)


def reach(
    view: shapes.View,
    lights: Sequence[np.ndarray] | Float[np.ndarray, "k 3"],
    *,
    turning: bool = False,
) -> Float[np.ndarray, "2 3"]:
    """Least and largest wave vectors of a view under several lights, for `views.bake`.

    Parameters
    ----------
    view
        The object before its camera.
    lights
        Unit vectors to each light in the world, [3], or for near ones [h, w, 3].
    turning
        Whether the material will be turned as well, by any angle.

    Raises
    ------
    InputError
        If no light reaches a visible sample.
    """
    ends = []
    for light in lights:
        _, wi, wo = views.wave_vectors(view, light)
        if len(wi):
            wave = -(wi + wo)
            ends += [wave.min(axis=0), wave.max(axis=0)]
            if turning:
                most = np.hypot(wave[:, 0], wave[:, 1]).max()
                ends += [np.array([s * most, s * most, ends[-1][2]]) for s in (-1.0, 1.0)]
    if not ends:
        raise InputError("lights reach no visible part of the view; expected some on its front")
    return np.stack([np.min(ends, axis=0), np.max(ends, axis=0)])


# Coordinates are lists of arrays [n] from here on: XLA does not fuse sums and maxima over an
# axis of three into the loops around them, which then take twice as long.
Coordinates = list[Array]


@eqx.filter_jit
def _frame(frames, light, turn, near, exposure, lit):
    xyz = _radiance(frames, light, turn, near, lit)
    rgb = _display(
        frames, [c + s / exposure for c, s in zip(xyz, frames.surroundings, strict=True)]
    )
    # The curve of `tones.tone`.
    brightest = jnp.maximum(jnp.maximum(rgb[0], rgb[1]), rgb[2])
    brightest = jnp.maximum(brightest, jnp.finfo(jnp.float32).tiny)
    peak = jnp.minimum(exposure * brightest, _WHITE)
    factor = peak * (1.0 + peak / _WHITE**2) / ((1.0 + peak) * brightest)
    linear = (jnp.clip(c * factor, 0.0, 1.0) for c in rgb)
    codes = [jnp.round(255.0 * spectrum.encode_srgb(c)).astype(jnp.uint8) for c in linear]
    flat = frames.ground.reshape(-1, 3).at[frames.pixel]
    picture = flat.set(jnp.stack(codes, -1), unique_indices=True, indices_are_sorted=True)
    return picture.reshape(frames.ground.shape)


@eqx.filter_jit
def _linear(frames, light, turn, near, lit):
    xyz = _radiance(frames, light, turn, near, lit)
    return jnp.stack(_display(frames, xyz), -1), xyz[1] > 0.0


def _radiance(frames: Frames, light: Array, turn: Array, near: Array, lit: Any) -> Coordinates:
    """XYZ that the light adds to the samples."""
    towards = [light[k] - near * frames.position[k] for k in range(3)]
    length = jnp.sqrt(_dot(towards, towards))
    towards = [c / length for c in towards]
    axes = (frames.tangent, frames.across, frames.normal)
    wi = _turned([_dot(list(axis), towards) for axis in axes], turn)
    wo = _turned(list(frames.eye), turn)
    dtype = frames.table.coefficients.dtype
    pairs = (jnp.stack(w, axis=-1).astype(dtype) for w in (wi, wo))
    xyz = lookup.shade(frames.table, *pairs).astype(jnp.float32)
    if lit is not None:
        reached = jnp.asarray(lit).reshape(-1)[frames.pixel]
        xyz = jnp.where(reached[:, None], xyz, 0.0)
    # Where a light lies beyond the table it adds nothing.
    return [jnp.where(jnp.isfinite(xyz[:, k]), xyz[:, k], 0.0) for k in range(3)]


def _turned(local: Coordinates, turn: Array) -> Coordinates:
    x, y, z = local
    cos, sin = jnp.cos(turn), jnp.sin(turn)
    return [cos * x - sin * y, cos * y + sin * x, z]


def _display(frames: Frames, xyz: Coordinates) -> Coordinates:
    """Linear sRGB in gamut, as `tones.display` and `diffopt.kernels.spectrum.desaturate`."""
    rgb = [_dot(list(row), xyz) for row in frames.to_rgb]
    grey = jnp.maximum(_dot(list(frames.luminance), rgb), 0.0)
    kept = jnp.ones_like(grey)
    for c in rgb:
        outside = c < 0.0
        kept = jnp.minimum(kept, jnp.where(outside, grey / jnp.where(outside, grey - c, 1.0), 1.0))
    kept = jnp.where(grey > 0.0, kept, 0.0)
    return [jnp.maximum(grey + kept * (c - grey), 0.0) for c in rgb]


def _dot(a: Coordinates, b: Coordinates) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _single(value: Values) -> Array:
    return jnp.asarray(value, jnp.float32)


def _ground(view: shapes.View, illuminant: colour.IlluminantLike) -> UInt8[np.ndarray, "h w 3"]:
    """The picture where the view shows no material: neutral parts and the background."""
    neutral = np.array([[True, False]])
    image = views.Image(
        xyz=np.zeros((1, 2, 3)),
        albedo=np.where(neutral[..., None], views.NEUTRAL, np.zeros(3)),
        covered=np.zeros_like(neutral),
        neutral=neutral,
    )
    codes = np.round(255.0 * pictures.photograph(image, illuminant=illuminant)).astype(np.uint8)
    return np.where(view.neutral[..., None], codes[0, 0], codes[0, 1])
