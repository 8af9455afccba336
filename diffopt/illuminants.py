"""Illuminants, the standard observer, and the weights that turn spectra into XYZ.

Wavelengths are in micrometres. Tables come from colour-science (CIE 1931 2 degree observer,
CIE illuminants) and are NumPy float64.
"""

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.kernels import spectrum

#: Named in the error for an unknown name; colour-science has some fifty more.
COMMON = ("D65", "D50", "A", "E", "FL11")

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
            raise InputError(
                f"illuminant {self.name!r}: {n} wavelengths and {m} powers given, "
                "expected the same number, at least 2"
            )
        ascending(np.array(self.wavelengths), f"illuminant {self.name!r}: wavelengths")
        if not (np.isfinite(self.power).all() and min(self.power) >= 0 and max(self.power) > 0):
            raise InputError(
                f"illuminant {self.name!r}: powers between {min(self.power):g} and "
                f"{max(self.power):g} given, expected finite, none below 0, some above 0"
            )

    def at(self, wavelengths: Float[np.ndarray, " L"]) -> Float[np.ndarray, " L"]:
        """Power at other wavelengths (micrometres), by linear interpolation.

        CIE 015 recommends linear interpolation for the tabulated illuminants.

        Raises
        ------
        InputError
            Outside the table.
        """
        table = np.array(self.wavelengths)
        inside(wavelengths, table, f"illuminant {self.name!r}")
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
    InputError
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
    InputError
        If the step does not divide the range.
    """
    count = round(400.0 / step_nm) if step_nm > 0 else 0
    if count < 1 or abs(count * step_nm - 400.0) > 1e-9 * 400.0:
        raise InputError(f"step_nm: {step_nm:g} given, expected a divisor of 400 (nanometres)")
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
    InputError
        For wavelengths out of order or outside the tables.
    """
    lam = np.asarray(wavelengths_um, np.float64)
    ascending(lam, "wavelengths_um")
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


_illuminant = illuminant  # for functions whose argument has that name


@functools.lru_cache(maxsize=1)
def colour_science() -> Any:
    """Import of colour-science (over a second), with its warnings of missing extras held."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    return colour


@functools.lru_cache(maxsize=1)
def bradford() -> Matrix:
    """Matrix from XYZ to the sharpened cone responses of Lam (1985), known as Bradford."""
    return np.array(colour_science().CHROMATIC_ADAPTATION_TRANSFORMS["Bradford"], np.float64)


@functools.lru_cache(maxsize=1)
def _observer() -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """CIE 1931 2 degree matching functions at 1 nm, wavelengths in micrometres."""
    table = colour_science().MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    return np.asarray(table.wavelengths) / 1000.0, np.asarray(table.values, np.float64)


@functools.lru_cache(maxsize=64)
def _named_illuminant(name: str) -> Illuminant:
    known = colour_science().SDS_ILLUMINANTS
    if name not in known:
        raise InputError(
            f"illuminant: {name!r} given, expected one of {', '.join(COMMON)} or another of the "
            f"{len(known)} names known to colour-science"
        )
    table = known[name]
    lam = np.asarray(table.wavelengths) / 1000.0
    return Illuminant(name, tuple(lam.tolist()), tuple(np.asarray(table.values).tolist()))


@functools.lru_cache(maxsize=128)
def _weights(wavelengths_um: tuple[float, ...], light: Illuminant) -> Table:
    lam = np.array(wavelengths_um)
    grid, matching = _observer()
    inside(lam, grid, "observer CIE 1931 2 degree")
    matched = np.stack([np.interp(lam, grid, column) for column in matching.T], axis=1)
    weights = (np.asarray(spectrum.trapezoid_weights(lam)) * light.at(lam))[:, None] * matched
    if not weights[:, 1].sum() > 0.0:
        raise InputError(f"illuminant {light.name!r}: no visible light at the given wavelengths")
    return weights / weights[:, 1].sum()


def ascending(values: np.ndarray, name: str) -> None:
    """Refuse (InputError) wavelengths that are not one ascending sequence."""
    if values.ndim != 1 or not (np.diff(values) > 0).all():
        raise InputError(f"{name}: expected one ascending sequence in micrometres")


def inside(values: np.ndarray, table: np.ndarray, name: str) -> None:
    """Refuse (InputError) wavelengths, in micrometres, beyond the ends of an ascending table."""
    slack = 1e-6  # micrometres: 0.78 may come in float32
    if not (values.min() >= table[0] - slack and values.max() <= table[-1] + slack):
        raise InputError(
            f"{name}: wavelengths {values.min():g} to {values.max():g} um given, the table has "
            f"{table[0]:g} to {table[-1]:g} um"
        )
