"""Colour: from XYZ to sRGB pictures; colour differences; the settings of it all.

The spectral side, `diffopt.illuminants` and `diffopt.bands`, is exported here as well.
Wavelengths are in micrometres. Matrices are NumPy float64; functions of pixels are JAX and
keep the type of their input. White is the sum over the chosen wavelengths itself, so that a
perfect mirror under the illuminant is (1, 1, 1) in linear RGB to rounding, whatever the
wavelength step.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.bands import three_band as three_band
from diffopt.illuminants import Illuminant as Illuminant
from diffopt.illuminants import IlluminantLike as IlluminantLike
from diffopt.illuminants import Matrix as Matrix
from diffopt.illuminants import Table as Table
from diffopt.illuminants import Vector as Vector
from diffopt.illuminants import Wavelengths as Wavelengths
from diffopt.illuminants import bradford, colour_science
from diffopt.illuminants import illuminant as illuminant
from diffopt.illuminants import spectral_weights as spectral_weights
from diffopt.illuminants import wavelengths as wavelengths
from diffopt.illuminants import white_point as white_point
from diffopt.kernels import spectrum

ADAPTATIONS = ("white", "none")
BANDS = ("full", "three")
#: CIE 1931 chromaticities (x, y) of the sRGB primaries, IEC 61966-2-1:1999.
SRGB_PRIMARIES = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))


def rgb_matrix(white: Sequence[float] | np.ndarray | None = None) -> Matrix:
    """Matrix from XYZ to linear RGB with the sRGB primaries and a given white.

    Parameters
    ----------
    white
        XYZ that becomes (1, 1, 1); `white_point()` when left out. The textbook matrix, whose
        white is rounded to x = 0.3127, y = 0.3290, turns that one into (1.00003, 1.00003,
        0.99965).

    Raises
    ------
    ValueError
        If the white is not inside the triangle of the primaries.
    """
    target = white_point() if white is None else np.asarray(white, np.float64)
    columns = np.array([[x, y, 1.0 - x - y] for x, y in SRGB_PRIMARIES]).T
    share = np.linalg.solve(columns, target)
    if not (share > 0).all():
        raise ValueError(
            f"white: XYZ {tuple(target.round(4).tolist())} given, expected a colour that the "
            "sRGB primaries can mix"
        )
    return np.linalg.inv(columns * share)


def xyz_to_rgb_matrix(
    illuminant: IlluminantLike = "D65",
    *,
    adaptation: str = "white",
    wavelengths_um: Wavelengths | None = None,
) -> Matrix:
    """Matrix from XYZ under an illuminant to linear RGB for an sRGB display.

    Parameters
    ----------
    illuminant
        The light of the scene, see `illuminant`.
    adaptation
        "white": the eye is adapted to the illuminant, a mirror is (1, 1, 1); Bradford's
        transform takes the illuminant's white to that of D65. "none": the eye is adapted to
        D65 and sees the coloured light.
    wavelengths_um
        The wavelengths that the XYZ values were summed over; `wavelengths()` when left out.

    Raises
    ------
    ValueError
        For another adaptation.
    """
    if adaptation not in ADAPTATIONS:
        raise ValueError(
            f"adaptation: {adaptation!r} given, expected one of {', '.join(ADAPTATIONS)}"
        )
    day = white_point("D65", wavelengths_um)
    matrix = rgb_matrix(day)
    if adaptation == "none":
        return matrix
    cones = bradford()
    gain = (cones @ day) / (cones @ white_point(illuminant, wavelengths_um))
    return matrix @ np.linalg.inv(cones) @ (gain[:, None] * cones)


def xyz_to_linear(
    xyz: Float[Array | np.ndarray, "*batch 3"],
    *,
    illuminant: IlluminantLike = "D65",
    adaptation: str = "white",
    wavelengths_um: Wavelengths | None = None,
) -> Float[Array, "*batch 3"]:
    """Linear RGB without any limit; negative or above 1 where the display cannot follow.

    Parameters
    ----------
    xyz
        Y = 1 for a perfect mirror.
    illuminant, adaptation, wavelengths_um
        See `xyz_to_rgb_matrix`.
    """
    xyz = jnp.asarray(xyz)
    matrix = xyz_to_rgb_matrix(illuminant, adaptation=adaptation, wavelengths_um=wavelengths_um)
    return spectrum.transform(xyz, jnp.asarray(matrix, xyz.dtype))


def xyz_to_srgb(
    xyz: Float[Array | np.ndarray, "*batch 3"],
    *,
    illuminant: IlluminantLike = "D65",
    gamut: str = "desaturate",
    exposure: float = 1.0,
    adaptation: str = "white",
    wavelengths_um: Wavelengths | None = None,
) -> Float[Array, "*batch 3"]:
    """Encode XYZ as sRGB values for a picture.

    Parameters
    ----------
    xyz
        Y = 1 for a perfect mirror.
    illuminant, adaptation, wavelengths_um
        See `xyz_to_rgb_matrix`.
    gamut
        "desaturate" mixes with grey at constant luminance until nothing is negative (every
        spectral line needs it), "clip" cuts negative values; both then cut at 1. "none" does
        neither: values outside [0, 1] remain, encoded by the odd extension of the curve.
    exposure
        Factor on the linear values, before the cut at 1.

    Returns
    -------
    Array
        Encoded values, in [0, 1] unless `gamut` is "none".

    Raises
    ------
    ValueError
        For an unknown choice.
    """
    xyz = jnp.asarray(xyz)
    matrix = xyz_to_rgb_matrix(illuminant, adaptation=adaptation, wavelengths_um=wavelengths_um)
    linear = spectrum.transform(xyz, jnp.asarray(matrix, xyz.dtype))
    # Luminance on the display, which after adaptation is not the Y that came in.
    luminance_row = np.linalg.inv(rgb_matrix(white_point("D65", wavelengths_um)))[1]
    luminance = (linear * jnp.asarray(luminance_row, xyz.dtype)[(None,) * (xyz.ndim - 1)]).sum(-1)
    linear = exposure * spectrum.fit_gamut(linear, luminance, gamut)
    if gamut != "none":
        linear = jnp.minimum(linear, 1.0)
    return spectrum.encode_srgb(linear)


def delta_e_2000(
    xyz1: Any, xyz2: Any, illuminant: IlluminantLike = "D65"
) -> Float[np.ndarray, "..."]:
    """Colour difference CIE DE2000 between XYZ values under the same illuminant.

    1 is about the least difference seen side by side. NumPy, not differentiable.

    Parameters
    ----------
    xyz1, xyz2
        Arrays [..., 3] with Y = 1 for a perfect mirror.
    illuminant
        The light; its white by the default rule is the reference white of CIE Lab.

    Returns
    -------
    numpy.ndarray
        float64, of shape [...].
    """
    colour = colour_science()
    white = white_point(illuminant)
    xy = white[:2] / white.sum()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", category=colour.utilities.ColourWarning)
        lab1, lab2 = (
            colour.XYZ_to_Lab(np.asarray(x, np.float64), illuminant=xy) for x in (xyz1, xyz2)
        )
        return np.asarray(colour.delta_E(lab1, lab2, method="CIE 2000"), np.float64)


@dataclass(frozen=True)
class ColourSettings:
    """How spectra become colours.

    Attributes
    ----------
    step_nm
        Wavelength step in nanometres. Cost is proportional to 1/step. A smooth reflectance
        is safe at 10; a diffraction line of width lambda^2/(2 pi |u| sigma_s) wants a step of
        a quarter of it or less: at 5, a grating of period 2 um has a mean error in XYZ of
        2.6e-4 at a coherence of 5 um, 2.6e-3 at 16 um and 11 % at 40 um.
    illuminant
        See `illuminant`; no effect on the cost.
    bands
        "full", or "three" for the approximation of `three_band`: 27 times fewer wavelengths,
        delta E 2000 of 4.5 on average on smooth reflectances, useless for gratings.
    samples
        Wavelengths in each of the three bands; two nearly halve the error at twice the cost. Unused
        for "full".
    gamut
        See `xyz_to_srgb`; only pictures depend on it.
    exposure
        Factor on linear RGB; only pictures depend on it.
    adaptation
        See `xyz_to_rgb_matrix`.
    """

    step_nm: float = 5.0
    illuminant: str | Illuminant = "D65"
    bands: str = "full"
    samples: int = 1
    gamut: str = "desaturate"
    exposure: float = 1.0
    adaptation: str = "white"

    def __post_init__(self) -> None:
        """Check every field."""
        wavelengths(self.step_nm)
        illuminant(self.illuminant)
        for name, allowed in (
            ("bands", BANDS),
            ("gamut", spectrum.GAMUTS),
            ("adaptation", ADAPTATIONS),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(
                    f"{name}: {getattr(self, name)!r} given, expected one of {', '.join(allowed)}"
                )
        if self.samples < 1:
            raise ValueError(f"samples: {self.samples} given, expected at least 1")
        if not self.exposure > 0.0:
            raise ValueError(f"exposure: {self.exposure:g} given, expected above 0")

    def quadrature(self) -> tuple[Float[np.ndarray, " L"], Float[np.ndarray, "L 3"]]:
        """Wavelengths [L] in micrometres and weights [L, 3] with XYZ = rho @ weights."""
        grid = wavelengths(self.step_nm)
        if self.bands == "three":
            return three_band(grid, self.illuminant, samples=self.samples)
        return grid, spectral_weights(grid, self.illuminant)

    def picture(self, xyz: Float[Array | np.ndarray, "*batch 3"]) -> Float[Array, "*batch 3"]:
        """Encode XYZ values made with `quadrature` as sRGB, see `xyz_to_srgb`."""
        return xyz_to_srgb(
            xyz,
            illuminant=self.illuminant,
            gamut=self.gamut,
            exposure=self.exposure,
            adaptation=self.adaptation,
            wavelengths_um=wavelengths(self.step_nm),
        )
