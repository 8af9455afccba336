"""Colour: matching functions, illuminants, white points and sRGB pictures.

Wavelengths are in micrometres. Tables come from colour-science (CIE 1931 2 degree observer,
CIE illuminants) and are NumPy float64; functions of pixels are JAX and keep the type of
their input. White is the sum over the chosen wavelengths itself, so that a perfect mirror
under the illuminant is (1, 1, 1) in linear RGB to rounding, whatever the wavelength step.
"""

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import spectrum

ADAPTATIONS = ("white", "none")
BANDS = ("full", "three")
#: CIE 1931 chromaticities (x, y) of the sRGB primaries, IEC 61966-2-1:1999.
SRGB_PRIMARIES = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))

Table = Float[np.ndarray, "L 3"]
Matrix = Float[np.ndarray, "3 3"]
Vector = Float[np.ndarray, "3"]
Wavelengths = Float[np.ndarray, " L"] | Float[Array, " L"] | Sequence[float]


@dataclass(frozen=True)
class Illuminant:
    """Relative spectral power of a light, linear between its samples.

    Attributes
    ----------
    name
        Shown in error texts.
    wavelengths
        In micrometres, ascending.
    power
        In any unit, at least 0.
    """

    name: str
    wavelengths: tuple[float, ...]
    power: tuple[float, ...]

    def __post_init__(self) -> None:
        """Check lengths, order and sign."""
        n, m = len(self.wavelengths), len(self.power)
        if n != m or n < 2:
            raise ValueError(
                f"illuminant {self.name!r}: {n} wavelengths and {m} powers given, "
                "expected the same number, at least 2"
            )
        _ascending(np.array(self.wavelengths), f"illuminant {self.name!r}: wavelengths")
        if not (np.isfinite(self.power).all() and min(self.power) >= 0 and max(self.power) > 0):
            raise ValueError(
                f"illuminant {self.name!r}: powers between {min(self.power):g} and "
                f"{max(self.power):g} given, expected finite, none below 0, some above 0"
            )

    def at(self, wavelengths: Float[np.ndarray, " L"]) -> Float[np.ndarray, " L"]:
        """Power at other wavelengths (micrometres), by linear interpolation.

        CIE 015 recommends linear interpolation for the tabulated illuminants.

        Raises
        ------
        ValueError
            Outside the table.
        """
        table = np.array(self.wavelengths)
        _inside(wavelengths, table, f"illuminant {self.name!r}")
        return np.interp(wavelengths, table, np.array(self.power))


IlluminantLike = str | Illuminant | tuple[Any, Any]


def illuminant(which: IlluminantLike) -> Illuminant:
    """Illuminant from a name, a pair (wavelengths, power), or an `Illuminant`.

    Parameters
    ----------
    which
        "D65", "A", "E" or another name known to colour-science, or two sequences:
        wavelengths in micrometres and relative power.

    Raises
    ------
    ValueError
        For an unknown name or an unusable spectrum.
    """
    if isinstance(which, Illuminant):
        return which
    if isinstance(which, str):
        return _named_illuminant(which)
    wavelengths, power = which
    numbers = [tuple(np.asarray(x, np.float64).ravel().tolist()) for x in (wavelengths, power)]
    return Illuminant("given", *numbers)


def wavelengths(step_nm: float = 5.0) -> Float[np.ndarray, " L"]:
    """Wavelengths from 0.380 to 0.780 micrometres, float64.

    Parameters
    ----------
    step_nm
        Step in nanometres, a divisor of 400.

    Raises
    ------
    ValueError
        If the step does not divide the range.
    """
    count = round(400.0 / step_nm) if step_nm > 0 else 0
    if count < 1 or abs(count * step_nm - 400.0) > 1e-9 * 400.0:
        raise ValueError(f"step_nm: {step_nm:g} given, expected a divisor of 400 (nanometres)")
    return (380.0 + step_nm * np.arange(count + 1)) / 1000.0


def spectral_weights(
    wavelengths_um: Wavelengths, illuminant: IlluminantLike = "D65"
) -> Float[np.ndarray, "L 3"]:
    """Weights with XYZ = sum over l of weights[l] * rho[l].

    weights = K w S (xbar, ybar, zbar) with the trapezoid weights w, the illuminant S and
    K = 1/sum(w S ybar), so that rho = 1 has Y = 1. On the default grid D65 gives
    (0.95041352, 1, 1.08872503).

    Parameters
    ----------
    wavelengths_um
        At least two ascending wavelengths in micrometres, evenly spaced or not, within the
        tables (0.36 to 0.83 for the observer, 0.30 to 0.78 for D65 and A).
    illuminant
        See `illuminant`.

    Returns
    -------
    numpy.ndarray
        float64, [L, 3].

    Raises
    ------
    ValueError
        For wavelengths out of order or outside the tables.
    """
    lam = np.asarray(wavelengths_um, np.float64)
    _ascending(lam, "wavelengths_um")
    return _weights(tuple(lam.tolist()), _illuminant(illuminant)).copy()


def white_point(
    illuminant: IlluminantLike = "D65", wavelengths_um: Wavelengths | None = None
) -> Vector:
    """XYZ of a perfect mirror under the illuminant, by the rule of `spectral_weights`.

    Parameters
    ----------
    illuminant
        See `illuminant`.
    wavelengths_um
        As for `spectral_weights`; `wavelengths()` when left out.
    """
    lam = wavelengths() if wavelengths_um is None else wavelengths_um
    return spectral_weights(lam, illuminant).sum(axis=0)


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
    cones = _bradford()
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


def three_band(
    wavelengths_um: Wavelengths | None = None,
    illuminant: IlluminantLike = "D65",
    *,
    samples: int = 1,
) -> tuple[Float[np.ndarray, " K"], Float[np.ndarray, "K 3"]]:
    """Three rectangular bands in place of the matching functions.

    Each matching function times illuminant becomes a box with the same integral, mean
    wavelength and variance (rectangles: Szirmay-Kalos, Theory of Three-Dimensional Computer
    Graphics, eq. 3.10). The functions are those of Bradford's sharpened cones, not X, Y, Z, whose
    overlapping boxes have nearly the same mean. Used like `wavelengths` and
    `spectral_weights`; a flat spectrum gives the white of the full rule exactly, one linear
    in wavelength too, and with `samples` of 2 or more a quadratic one.

    Measured under D65 on the 24 patches of the ColorChecker (average over many charts), delta
    E 2000 mean / largest: 4.5 / 15.6 with one sample, 2.5 / 8.4 with two; the metals of
    `diffopt.fresnel` 0.02 to 1.5. Linear RGB taken from the
    reflectance at 700, 561 and 436 nm gives 6.1 / 18.9. Three bands cannot carry diffraction
    or dispersion: a grating shows three lines for a spectrum.

    Parameters
    ----------
    wavelengths_um
        The rule to approximate; `wavelengths()` when left out.
    illuminant
        See `illuminant`.
    samples
        Wavelengths in each box (Gauss-Legendre), at least 1. The cost of anything evaluated
        at each wavelength grows with 3 * samples, against 81 for the default rule.

    Returns
    -------
    tuple of numpy.ndarray
        Wavelengths [3 * samples] in ascending order, in micrometres, and weights
        [3 * samples, 3].

    Raises
    ------
    ValueError
        If `samples` is below 1, or the illuminant leaves a band empty.
    """
    if samples < 1:
        raise ValueError(f"samples: {samples} given, expected at least 1")
    lam = wavelengths() if wavelengths_um is None else np.asarray(wavelengths_um, np.float64)
    cones = _bradford()
    response = spectral_weights(lam, illuminant) @ cones.T
    total = response.sum(axis=0)
    # The cones' small negative parts can outweigh the rest for a light in a narrow band.
    if (total <= 0.05 * np.abs(response).sum(axis=0)).any():
        raise ValueError(
            f"illuminant {_illuminant(illuminant).name!r}: too little light in one of the three "
            "bands, use the full rule"
        )
    centre = lam @ response / total
    variance = np.maximum(((lam[:, None] - centre) ** 2 * response).sum(axis=0) / total, 0.0)
    half_width = np.sqrt(3.0 * variance)
    nodes, shares = np.polynomial.legendre.leggauss(samples)
    points = (centre[:, None] + half_width[:, None] * nodes).ravel()
    _inside(points, lam, "three_band: box of the illuminant's band")
    columns = np.linalg.inv(cones).T * total[:, None]  # XYZ of each whole band
    weights = (0.5 * shares[None, :, None] * columns[:, None, :]).reshape(-1, 3)
    order = np.argsort(points)
    return points[order], weights[order]


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
    colour = _colour()
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


_illuminant = illuminant  # for functions whose argument has that name


@functools.lru_cache(maxsize=1)
def _colour() -> Any:
    """Import of colour-science (over a second), with its warnings of missing extras held."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


@functools.lru_cache(maxsize=1)
def _bradford() -> Matrix:
    """Matrix from XYZ to the sharpened cone responses of Lam (1985), known as Bradford."""
    return np.array(_colour().CHROMATIC_ADAPTATION_TRANSFORMS["Bradford"], np.float64)


@functools.lru_cache(maxsize=1)
def _observer() -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """CIE 1931 2 degree matching functions at 1 nm, wavelengths in micrometres."""
    table = _colour().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    return np.asarray(table.wavelengths) / 1000.0, np.asarray(table.values, np.float64)


@functools.lru_cache(maxsize=64)
def _named_illuminant(name: str) -> Illuminant:
    known = _colour().SDS_ILLUMINANTS
    if name not in known:
        raise ValueError(
            f"illuminant: {name!r} given, expected one of {', '.join(sorted(known))}, or "
            "(wavelengths, power)"
        )
    table = known[name]
    lam = np.asarray(table.wavelengths) / 1000.0
    return Illuminant(name, tuple(lam.tolist()), tuple(np.asarray(table.values).tolist()))


@functools.lru_cache(maxsize=128)
def _weights(wavelengths_um: tuple[float, ...], light: Illuminant) -> Table:
    lam = np.array(wavelengths_um)
    grid, matching = _observer()
    _inside(lam, grid, "observer CIE 1931 2 degree")
    matched = np.stack([np.interp(lam, grid, column) for column in matching.T], axis=1)
    weights = (np.asarray(spectrum.trapezoid_weights(lam)) * light.at(lam))[:, None] * matched
    if not weights[:, 1].sum() > 0.0:
        raise ValueError(f"illuminant {light.name!r}: no visible light at the given wavelengths")
    return weights / weights[:, 1].sum()


def _ascending(values: np.ndarray, name: str) -> None:
    if values.ndim != 1 or not (np.diff(values) > 0).all():
        raise ValueError(f"{name}: expected one ascending sequence in micrometres")


def _inside(values: np.ndarray, table: np.ndarray, name: str) -> None:
    slack = 1e-6  # micrometres: 0.78 may come in float32
    if not (values.min() >= table[0] - slack and values.max() <= table[-1] + slack):
        raise ValueError(
            f"{name}: wavelengths {values.min():g} to {values.max():g} um given, the table has "
            f"{table[0]:g} to {table[-1]:g} um"
        )
