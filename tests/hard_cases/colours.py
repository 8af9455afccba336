"""Spectra to colours."""

from functools import partial

import numpy as np

from diffopt.kernels import spectrum
from hard_cases.base import LD, Hard

MATRIX = np.array([[3.24, -1.54, -0.5], [-0.97, 1.88, 0.04], [0.06, -0.2, 1.06]])


def colours():
    for value in (0.0, 0.0031308, -0.2, 1.0, 1e-30, 7.0):
        yield Hard(
            "spectrum.encode_srgb",
            f"{value}",
            spectrum.encode_srgb,
            (value,),
            lambda x: (
                12.92 * x
                if abs(x) <= 0.0031308
                else np.sign(x) * (LD(1.055) * np.abs(x) ** (1 / LD(2.4)) - LD(0.055))
            ),
            ulps=16,
            smooth=value != 0.0031308,
        )
        yield Hard(
            "spectrum.decode_srgb",
            f"{value}",
            spectrum.decode_srgb,
            (value,),
            lambda x: (
                x / LD(12.92)
                if abs(x) <= 0.04045
                else np.sign(x) * ((np.abs(x) + LD(0.055)) / LD(1.055)) ** LD(2.4)
            ),
            ulps=16,
        )
    for name, rgb, y in (
        ("inside", [0.2, 0.3, 0.4], 0.29),
        ("negative", [-0.5, 0.6, 0.1], 0.33),
        ("black", [0.0, 0.0, 0.0], 0.0),
        ("dark", [-0.1, -0.1, 0.2], -0.05),
    ):
        rgb = np.array(rgb)
        for choice in spectrum.GAMUTS:
            yield Hard(
                "spectrum.fit_gamut",
                f"{choice}, {name}",
                partial(spectrum.fit_gamut, choice=choice),
                (rgb, y),
                partial(_gamut, choice=choice),
                smooth=False,
            )
        yield Hard(
            "spectrum.desaturate",
            name,
            spectrum.desaturate,
            (rgb, y),
            partial(_gamut, choice="desaturate"),
            smooth=False,
        )
        yield Hard(
            "spectrum.transform",
            name,
            spectrum.transform,
            (rgb, MATRIX),
            lambda x, m: m @ x,
            ulps=16,
        )
        yield Hard(
            "spectrum.weights_to_xyz",
            name,
            spectrum.weights_to_xyz,
            (rgb, MATRIX),
            lambda x, m: x @ m,
            ulps=16,
        )
    yield Hard(
        "spectrum.trapezoid_weights",
        "uneven",
        spectrum.trapezoid_weights,
        (np.array([0.38, 0.4, 0.5, 0.78]),),
        lambda x: np.array(
            [(x[1] - x[0]) / 2, (x[2] - x[0]) / 2, (x[3] - x[1]) / 2, (x[3] - x[2]) / 2]
        ),
        ulps=16,
    )


def _gamut(rgb, y, choice):
    if choice == "none":
        return rgb
    if choice == "clip":
        return np.maximum(rgb, 0)
    if y <= 0:
        return 0 * rgb
    t = min([LD(1)] + [y / (y - c) for c in rgb if c < 0])
    return np.maximum(y + t * (rgb - y), 0)
