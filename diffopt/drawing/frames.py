"""Frames of a lit object at interactive rates: from the light to the pixels in one function.

The look is that of `diffopt.drawing.pictures.photograph` without supersampling. What does not
depend on the light is computed once, in float32, and only for the samples that show the
material.

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
from diffopt.drawing import developing, pictures, shapes, tones, views
from diffopt.errors import InputError


class Frames(eqx.Module):
    """One object before one camera; called with a light it gives a picture.

    Attributes
    ----------
    table
        Colours over the wave vectors of all lights.
    seen
        The n samples that show the material.
    pixel
        Numbers of their pixels, row after row, [n].
    ground
        The picture without the material, [h, w, 3].
    film
        From XYZ to the display.
    """

    table: lookup.Table
    seen: developing.Samples
    pixel: Int[Array, " n"]
    ground: UInt8[Array, "h w 3"]
    film: developing.Film

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
        self.table = table
        self.seen = developing.Samples(
            columns(view.tangent),
            columns(np.cross(view.normal, view.tangent)),
            columns(view.normal),
            columns(view.position),
            columns(np.where(shown, eye, [0.0, 0.0, -1.0])),
        )
        self.pixel = jnp.asarray(pixel, jnp.int32)
        self.ground = jnp.asarray(_ground(view, illuminant))
        self.film = developing.film(brdf, illuminant)

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


@eqx.filter_jit
def _frame(frames, light, turn, near, exposure, lit):
    codes = developing.codes(frames.film, _radiance(frames, light, turn, near, lit), exposure)
    flat = frames.ground.reshape(-1, 3).at[frames.pixel]
    picture = flat.set(jnp.stack(codes, -1), unique_indices=True, indices_are_sorted=True)
    return picture.reshape(frames.ground.shape)


@eqx.filter_jit
def _linear(frames, light, turn, near, lit):
    xyz = _radiance(frames, light, turn, near, lit)
    return jnp.stack(developing.display(frames.film, xyz), -1), xyz[1] > 0.0


def _radiance(frames: Frames, light: Array, turn: Array, near: Array, lit: Any) -> list[Array]:
    reached = None if lit is None else jnp.asarray(lit).reshape(-1)[frames.pixel]
    return developing.radiance(frames.table, frames.seen, light, turn, near, reached)


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
