"""Whether a grid is fine enough for the diffraction of light."""

import math
from typing import Any

import numpy as np

from diffopt.errors import InputError


def check_sampling(
    heights: np.ndarray,
    pixel: tuple[float, float],
    wavelength: Any,
    *,
    max_angle: float | int | None = None,
    u_max: float | int | None = None,
    jumps: bool = False,
) -> None:
    """Refuse a pixel too coarse for diffraction at the shortest wavelength.

    With u = sin(theta_i) + sin(theta_o) the transform of the samples repeats every
    wavelength / pixel in u, so that the pixel must not exceed
    wavelength / (2 abs(u)); and the phase 2 pi w h / wavelength, w = cos(theta_i) +
    cos(theta_o) <= 2, must turn by less than pi between neighbours.

    Parameters
    ----------
    heights
        [ny, nx] in micrometres, complete.
    pixel
        (dy, dx) in micrometres.
    wavelength
        The shortest, or all of them, in micrometres.
    max_angle
        Largest polar angle of light and viewer, in radians, from 0 to pi / 2.
    u_max
        Instead: largest abs(u), 0 to 2. Without either 2 is assumed.
    jumps
        Accept steps between neighbours that turn the phase by pi or more, for surfaces
        with real jumps (binary and blazed profiles). The sum over pixels then converges
        with the second power of the pixel only.

    Raises
    ------
    InputError
        If the pixel is too coarse; the text says which would do.
    """
    shortest = float(np.min(np.asarray(wavelength), initial=np.inf))
    if not 0 < shortest < float("inf"):
        raise InputError(f"wavelength={shortest}: expected positive micrometres")
    if max_angle is not None and u_max is not None:
        raise InputError("check_sampling: pass either max_angle or u_max")
    if max_angle is not None:
        if not 0 <= max_angle <= math.pi / 2 + 1e-12:
            raise InputError(f"max_angle={max_angle}: expected radians from 0 to pi/2")
        u_max = 2 * math.sin(max_angle)
    u_max = 2.0 if u_max is None else u_max
    if not 0 <= u_max <= 2:
        raise InputError(f"u_max={u_max}: expected a number from 0 to 2")
    limit = shortest / (2 * u_max) if u_max > 0 else float("inf")
    # One part in 1e9: a pixel computed from the limit may round to just above it.
    if max(pixel) > limit * (1 + 1e-9):
        raise InputError(
            f"pixel {max(pixel):.4g} um is too coarse for wavelength {shortest:.4g} um "
            f"and |u| up to {u_max:.4g}: directions would alias; at most {limit:.4g} um will do"
        )
    step_limit = shortest / 4
    for axis, name in enumerate("yx"):
        steps = np.abs(np.diff(heights, axis=axis))
        steepest = float(steps.max())
        if steepest >= step_limit and not jumps:
            share = 100 * float((steps >= step_limit).mean())
            fine = pixel[axis] * step_limit / steepest
            raise InputError(
                f"neighbours along {name} differ by up to {steepest:.4g} um ({share:.2g} % of "
                f"the steps), but wavelength {shortest:.4g} um allows less than "
                f"{step_limit:.4g} um at pixel {pixel[axis]:.4g} um; such slopes need a "
                f"pixel below {fine:.3g} um, real jumps need jumps=True"
            )
