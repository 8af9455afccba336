"""Error bounds of baked tables before they are baked, and settings from a bound.

Errors are of |P|^2 relative to a mirror's peak, for each wavelength. All parts are rigorous
for a reflectance that is constant over a few steps: its change with the angle adds what the
study ``diffraction.table`` measures, far below the rest.
"""

import dataclasses
import math
from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from diffopt.baking import Box, height_band, line_width
from diffopt.kernels import phase, spline
from diffopt.methods import Surface
from diffopt.settings import TableSettings

Amplify = Callable[[Float[np.ndarray, " L"]], float]


def table_error(
    surface: Surface, box: Box, wavelengths: Float[np.ndarray, " L"], settings: TableSettings
) -> Float[np.ndarray, " L"]:
    """Bound on the error of |P|^2 at each wavelength, truncation only."""
    return (
        grid_error(surface, wavelengths, settings.step, settings.order)
        + depth_error(surface, box, wavelengths, settings.nodes, settings.intervals)
        + 4.0 * settings.error
    )


def grid_error(
    surface: Surface,
    wavelengths: Float[np.ndarray, " L"],
    step: float,
    order: int,
    *,
    slopes: bool = False,
) -> Float[np.ndarray, " L"]:
    """Share of the interpolation in u and v: 2 e + e^2, e by `spline.gaussian_error`.

    With `slopes` that of the derivative to u or v, over the steepest slope of a lobe.
    """
    width = line_width(surface, wavelengths)
    ratio = step * width.min() / width
    # Rounded up to a ladder of 1 %, so that wavelengths and calls share their integrals.
    ladder = np.ceil(np.log(ratio) / math.log(1.01))
    error = spline.gaussian_slope_error if slopes else spline.gaussian_error
    each = np.array([error(1.01**n, order) for n in ladder.tolist()])
    return 2.0 * each + each**2


def depth_error(
    surface: Surface,
    box: Box,
    wavelengths: Float[np.ndarray, " L"],
    nodes: int,
    intervals: int,
) -> Float[np.ndarray, " L"]:
    """Share of the Chebyshev points and of the spline in w."""
    if not surface.follows_w:
        return np.zeros(len(wavelengths))
    # The table extends one step beyond the box.
    width = (box.w[1] - box.w[0]) * (1.0 + 2.0 / intervals)
    band = height_band(surface) / np.asarray(wavelengths)
    polynomial = np.array([phase.chebyshev_bound(0.5 * width * b, nodes) for b in band])
    # Interpolating the polynomial's own error can double it.
    return 2.0 * polynomial + np.array([spline.complete_error(width * b / intervals) for b in band])


def table_settings(
    surface: Surface,
    box: Box,
    wavelengths: Float[np.ndarray, " L"],
    amplify: Amplify,
    allowed: float,
    order: int,
    *,
    along_w: float = 1.0,
    baking: float = 1.0,
    slopes: bool = False,
) -> TableSettings:
    """The coarsest table whose error stays within `allowed` of the output's largest value.

    Parameters
    ----------
    surface, box, wavelengths
        The job.
    amplify
        From errors of |P|^2 at each wavelength to the error of the output.
    allowed
        What `amplify` of the bound may come to.
    order
        Degree in u and v.
    along_w, baking
        By how much more errors along w, and errors of baking, count.
    slopes
        Whether derivatives to the directions must meet it as well.
    """
    # Seven tenths for the grid, whose size costs most; the rest for w and for baking.
    low, high = 0.02, 1.5
    for _ in range(18):
        middle = math.sqrt(low * high)
        grid = grid_error(surface, wavelengths, middle, order, slopes=slopes)
        fits = amplify(grid) <= 0.7 * allowed
        low, high = (middle, high) if fits else (low, middle)
    settings = TableSettings(
        step=math.floor(1000.0 * low) / 1000.0,
        order=order,
        error=min(1e-3, 0.02 * allowed / baking),
    )
    nodes = intervals = 1

    def depth() -> float:
        return along_w * amplify(depth_error(surface, box, wavelengths, nodes, intervals))

    # Nodes first, against a spline that is as good as exact.
    intervals = 10_000
    while depth() > 0.05 * allowed and nodes < 2000:
        nodes += 1
    low_count, high_count = 1, 10_000
    while low_count < high_count:
        intervals = (low_count + high_count) // 2
        low_count, high_count = (
            (low_count, intervals) if depth() <= 0.2 * allowed else (intervals + 1, high_count)
        )
    # The extension by a step counts for more where there are few.
    intervals = max(8, low_count)
    # The reflectance changes with w as well, also where the phase does not.
    nodes = max(6, nodes)
    while depth() > 0.2 * allowed and nodes < 2000:
        nodes += 1
    return dataclasses.replace(settings, nodes=nodes, intervals=intervals)
