"""Diffraction of pairs of directions, or at wavelengths, that are spread over several devices."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array

from diffopt import devices, gathering
from diffopt.checks import Values
from diffopt.devices import Mesh
from diffopt.kernels import frames
from diffopt.settings import GatherSettings, Settings


def pairs(wi: Values, wo: Values) -> tuple[Mesh | None, int | None]:
    """Devices over which pairs are spread, and along which axis of both together.

    Parameters
    ----------
    wi, wo
        Unit vectors, [..., 3], as a caller gave them.
    """
    over, most = devices.common(wi, wo), max(np.ndim(wi), np.ndim(wo))
    for value in (wi, wo):
        place = devices.placement(value)
        if place is not None and place[1] < np.ndim(value) - 1:
            return over, place[1] + most - np.ndim(value)
    return None, None


def evaluated(
    function: Callable[..., Array],
    over: Mesh,
    axis: int | None,
    given: tuple[Any, Any, Any, Any, Any, Any],
    settings: Settings,
    output: str,
) -> Array:
    """A diffraction BRDF, every device its share.

    Parameters
    ----------
    function
        Evaluates on one device: of what is given, with settings and output by name.
    over
        Devices.
    axis
        Of the pairs that are spread; None if wavelengths are.
    given
        The model, wi, wo, wavelengths, weights and tables, or None for these two.
    settings, output
        As for `diffopt.diffraction.evaluate`.
    """
    brdf, wi, wo, wavelengths, weights, tables = given
    if tables is None and isinstance(settings, GatherSettings):
        # Of the whole job, as on one device.
        tables = _tables(brdf, wi, wo, wavelengths, settings)
    parts = function, brdf, wi, wo, wavelengths, weights, tables, settings, output
    if axis is not None:
        axes = None, None, axis, axis, None, None, None, None, None
        return devices.run(_share, parts, axes, axis, over)
    (name,) = over.axis_names
    mine = None if weights is None else 0
    axes = None, None, None, None, 0, mine, None, None, None, None
    out = None if output == "xyz" else np.ndim(wi) - 1
    return devices.run(_bands, (*parts, name), axes, out, over)


def _share(function, brdf, wi, wo, wavelengths, weights, tables, settings, output):
    return function(brdf, wi, wo, wavelengths, weights, tables, settings=settings, output=output)


def _bands(function, brdf, wi, wo, wavelengths, weights, tables, settings, output, name):
    value = _share(function, brdf, wi, wo, wavelengths, weights, tables, settings, output)
    return jax.lax.psum(value, name) if output == "xyz" else value


@eqx.filter_jit
def _tables(brdf, wi, wo, wavelengths, settings):
    valid, wi, wo = frames.above_horizon(wi.reshape(-1, 3), wo.reshape(-1, 3))
    wave = frames.valid_wave_vector(valid, wi, wo)
    reached = gathering.s_range(brdf.surface, wave, wavelengths, valid)
    return gathering.gather_tables(brdf.surface, settings, reached)
