"""Channels of a scene, RGB or wavelengths, and how other quantities become them.

An RGB scene is linear, with the primaries of sRGB and D65 as white. In a spectral scene 1 in
every channel is D65: lights are given relative to it, so that one scene renders either way.
"""

import functools
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks, colour
from diffopt.errors import InputError
from diffopt.materials.base import Material
from diffopt.materials.naming import STEP_NM


class Channels(eqx.Module):
    """Channels of a scene: linear RGB, or one for each wavelength.

    Attributes
    ----------
    wavelengths
        Micrometres, ascending; None for RGB.
    """

    wavelengths: tuple[float, ...] | None = eqx.field(static=True, default=None)

    def __init__(self, wavelengths: Any = None) -> None:
        """Take wavelengths [L], L >= 2, in micrometres, or None for RGB."""
        if wavelengths is None:
            self.wavelengths = None
            return
        lam = np.asarray(wavelengths, np.float64)
        checks.wavelengths(lam)
        if lam.ndim != 1 or len(lam) < 2 or (np.diff(lam) <= 0.0).any():
            raise InputError(
                f"wavelengths of a scene must be [L], ascending, L >= 2; received {lam.tolist()}"
            )
        self.wavelengths = tuple(lam.tolist())

    @property
    def count(self) -> int:
        """Number of channels."""
        return 3 if self.wavelengths is None else len(self.wavelengths)

    @property
    def names(self) -> tuple[str, ...]:
        """Of the channels, as layers of a file: R, G, B, or ``550nm``."""
        if self.wavelengths is None:
            return ("R", "G", "B")
        return tuple(f"{1000.0 * lam:g}nm" for lam in self.wavelengths)

    def values(self, name: str, value: Any) -> Float[Array, " C"]:
        """A number, RGB, or one for each channel, as one for each channel.

        Raises
        ------
        InputError
            For another shape; names the argument.
        """
        array = jnp.asarray(value)
        if not jnp.issubdtype(array.dtype, jnp.floating):
            array = array.astype(float)
        if array.shape not in ((), (1,), (3,), (self.count,)):
            raise InputError(
                f"{name} must be one number, RGB, or {self.count} channels; received "
                f"shape {array.shape}"
            )
        return self.converted(array)

    def converted(
        self, values: Float[Array, "..."], wavelengths: Any = None
    ) -> Float[Array, "... C"]:
        """Values with channels of their own on the last axis as channels of the scene.

        Parameters
        ----------
        values
            [..., 1], [..., 3] (RGB), [..., C], or [..., L'] with their `wavelengths`; a number
            alone is the same in all channels.
        wavelengths
            Of the last axis, micrometres, if it is neither RGB nor that of the scene.
        """
        if values.ndim == 0:
            return jnp.broadcast_to(values, (self.count,))
        matrix = self.matrix(values.shape[-1], wavelengths)
        if matrix is None:
            return jnp.broadcast_to(values, (*values.shape[:-1], self.count))
        return jnp.matmul(values, jnp.asarray(matrix, values.dtype), precision="highest")

    def matrix(self, own: int, wavelengths: Any = None) -> np.ndarray | None:
        """What takes `own` channels to those of the scene, [own, C]; None if they are alike.

        Between spectra: linear interpolation, the ends continued. From a spectrum to RGB: the
        colour of the reflectance under D65. From RGB to a spectrum: the sum of the three
        spectra of Mallett and Yuksel (Spectral primary decomposition for rendering with sRGB
        reflectance, EGSR 2019), which adds up to 1 and reproduces RGB under D65.
        """
        lam = None if wavelengths is None else tuple(np.asarray(wavelengths, float).tolist())
        if own == 1 or lam == self.wavelengths:
            if own not in (1, self.count):
                raise InputError(f"expected 1 or {self.count} channels; received {own}")
            return None
        if lam is None and self.wavelengths is not None and own == 3:
            return _upsampling(self.wavelengths)
        if lam is None:
            if own == self.count:
                return None
            raise InputError(
                f"{own} channels of unknown wavelengths; expected 1, 3 or {self.count}"
            )
        return _to_rgb(lam) if self.wavelengths is None else _shares(lam, self.wavelengths)

    def xyz(self, values: np.ndarray) -> Float[np.ndarray, "*batch 3"]:
        """XYZ of values in the channels; 1 in all of them is D65 with Y = 1.

        Outside the scene's wavelengths the first and the last channel are continued.
        """
        values = np.asarray(values, np.float64)
        white = colour.white_point("D65", colour.wavelengths(STEP_NM))
        if self.wavelengths is None:
            return values @ np.linalg.inv(colour.rgb_matrix(white)).T
        return values @ _to_xyz(self.wavelengths)

    def rgb(self, values: np.ndarray) -> Float[np.ndarray, "*batch 3"]:
        """Linear RGB of values in the channels; below 0 outside the gamut."""
        if self.wavelengths is None:
            return np.asarray(values, np.float64)
        return np.asarray(values, np.float64) @ _to_rgb(self.wavelengths)

    def luminance(self) -> Float[np.ndarray, " C"]:
        """Weights of the channels in Y, adding up to 1."""
        return self.xyz(np.eye(self.count))[:, 1]


def wavelengths_of(material: Material) -> Float[np.ndarray, " L"] | None:
    """Wavelengths of a material's channels, also of one inside; None where it has none."""
    lam = getattr(material, "wavelengths", None)
    if lam is not None and np.ndim(lam) == 1 and np.shape(lam) == material.channels:
        return np.asarray(lam, np.float64)
    for value in vars(material).values():
        for part in value if isinstance(value, tuple) else (value,):
            found = wavelengths_of(part) if isinstance(part, Material) else None
            if found is not None:
                return found
    return None


@functools.lru_cache(maxsize=64)
def _shares(own: tuple[float, ...], wanted: tuple[float, ...]) -> np.ndarray:
    """Linear interpolation, [own, wanted]: each channel's share of the wavelengths around it."""
    return np.stack([np.interp(wanted, own, row) for row in np.eye(len(own))])


@functools.lru_cache(maxsize=16)
def _to_xyz(own: tuple[float, ...]) -> np.ndarray:
    grid = colour.wavelengths(STEP_NM)
    return _shares(own, tuple(grid.tolist())) @ colour.spectral_weights(grid)


@functools.lru_cache(maxsize=16)
def _to_rgb(own: tuple[float, ...]) -> np.ndarray:
    white = colour.white_point("D65", colour.wavelengths(STEP_NM))
    return _to_xyz(own) @ colour.rgb_matrix(white).T


@functools.lru_cache(maxsize=16)
def _upsampling(wanted: tuple[float, ...]) -> np.ndarray:
    from diffopt.illuminants import colour_science

    table = colour_science().recovery.MSDS_BASIS_FUNCTIONS_sRGB_MALLETT2019
    own = np.asarray(table.wavelengths) / 1000.0
    basis = np.stack([np.interp(wanted, own, column) for column in np.asarray(table.values).T])
    return np.clip(basis, 0.0, None)
