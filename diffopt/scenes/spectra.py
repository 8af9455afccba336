"""Colours of lights: illuminants and black bodies relative to D65, with the luminance of white."""

import functools

import numpy as np
from jaxtyping import Float

from diffopt import colour
from diffopt.errors import InputError
from diffopt.materials.naming import STEP_NM
from diffopt.scenes.channels import Channels

#: Temperatures of black bodies, kelvin. Below, the light is hardly one.
COLDEST, HOTTEST = 500.0, 1e6

# Planck's second radiation constant, micrometre kelvin.
_C2 = 14387.769


def illuminant(channels: Channels, name: str) -> Float[np.ndarray, " C"]:
    """An illuminant over D65 in the channels of a scene.

    Parameters
    ----------
    channels
        Of the scene.
    name
        "A", "D50", "E", "FL11" or another name known to colour-science.

    Returns
    -------
    numpy.ndarray
        [C], its luminance that of 1 in all channels; in RGB at least 0, so that deeper reds than
        the display's are cut off.

    Raises
    ------
    InputError
        For an unknown name.
    """
    try:
        return _relative(channels, tuple(colour.illuminant(name).at(_grid()).tolist()))
    except ValueError as error:
        raise InputError(str(error)) from error


def black_body(channels: Channels, temperature: float) -> Float[np.ndarray, " C"]:
    """A black body over D65 in the channels of a scene, see `illuminant`.

    Parameters
    ----------
    channels
        Of the scene.
    temperature
        Kelvin; a candle has 1900, a lamp 2800, daylight about 6500.

    Raises
    ------
    InputError
        Outside of `COLDEST` to `HOTTEST`.
    """
    if not COLDEST <= temperature <= HOTTEST:
        raise InputError(
            f"temperature must be from {COLDEST:g} to {HOTTEST:g} kelvin; received {temperature:g}"
        )
    lam = _grid()
    # Over the value at 0.56 um, so that nothing overflows.
    power = (0.56 / lam) ** 5 * np.expm1(_C2 / (0.56 * temperature))
    power /= np.expm1(_C2 / (lam * temperature))
    return _relative(channels, tuple(power.tolist()))


def _grid() -> Float[np.ndarray, " L"]:
    return colour.wavelengths(STEP_NM)


@functools.lru_cache(maxsize=64)
def _relative(channels: Channels, power: tuple[float, ...]) -> Float[np.ndarray, " C"]:
    lam = _grid()
    ratio = np.asarray(power) / colour.illuminant("D65").at(lam)
    ratio /= colour.spectral_weights(lam)[:, 1] @ ratio
    if channels.wavelengths is not None:
        return np.interp(channels.wavelengths, lam, ratio)
    spectral = Channels(lam)
    return np.maximum(spectral.rgb(ratio), 0.0)
