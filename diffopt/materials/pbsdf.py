"""Polarised measurements (``.pbsdf``): their unpolarised reflectance as a material.

Source: Baek et al., "Image-based acquisition and modeling of polarimetric reflectance" (ACM
TOG 39(4), 2020).
"""

import math
import os
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.kernels import tabulated
from diffopt.materials.merl import HalfLobe, LobeSampled, half_lobe
from diffopt.materials.tensorfile import (
    at_wavelengths,
    canonical,
    increasing,
    read_tensors,
    require,
)

# Difference angles whose mean forms the lobe that is sampled; see `diffopt.materials.merl`.
_NARROW = math.pi / 3.0


class Pbsdf(LobeSampled):
    """Unpolarised part of an isotropic polarised measurement.

    Linear between its nodes, and constant beyond them. Not reciprocal as such: exchanging the
    directions turns phi_d by pi, which was measured on its own.

    Attributes
    ----------
    table
        In 1/sr, [P, D, H, L] over phi_d, theta_d, theta_h and wavelength; negative entries
        are missing.
    phi_d, theta_d, theta_h
        Increasing nodes, radians.
    wavelengths
        Micrometres, [L].
    lobe
        What is sampled.
    """

    table: Float[Array, "P D H L"]
    phi_d: Float[Array, " P"]
    theta_d: Float[Array, " D"]
    theta_h: Float[Array, " H"]
    wavelengths: Float[Array, " L"]
    lobe: HalfLobe

    @property
    def reciprocal(self) -> bool:
        """See `Material`."""
        return False

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.table.shape[-1:]

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        theta_h, theta_d, phi_d = tabulated.rusinkiewicz(wi, wo)
        places = (
            tabulated.place(self.phi_d, phi_d),
            tabulated.place(self.theta_d, theta_d),
            tabulated.place(self.theta_h, theta_h),
        )
        return tabulated.linear(self.table, places, periodic=(False, False, False))


def load_pbsdf(path: str | os.PathLike, *, wavelengths: Any = None) -> Pbsdf:
    """Read the unpolarised reflectance M[0, 0] of a polarised measurement.

    Parameters
    ----------
    path
        A tensor file with the fields ``phi_d`` [1, P], ``theta_d`` [1, D], ``theta_h`` [1, H]
        (radians), ``wvls`` [L] (nanometres) and ``M`` [P, D, H, L, 4, 4] (1/sr). Angles
        without entries, as in reduced files, are taken as regular over [-pi, pi], [0, pi/2]
        and [0, pi/2].
    wavelengths
        In micrometres, within those of the file, between which the values are linear; all
        of the file by default.

    Returns
    -------
    Pbsdf
        NaN in the file counts as missing, negative values (noise) as 0.

    Raises
    ------
    InputError
        As `read_tensors`; also for missing fields, shapes that do not fit, nodes that do not
        increase, infinite values, and wavelengths outside the file's.
    """
    path = Path(path)
    fields = require(path, read_tensors(path), ("phi_d", "theta_d", "theta_h", "wvls", "M"))
    values, nm = fields["M"], fields["wvls"].ravel()
    if values.ndim != 6 or values.shape[4:] != (4, 4) or values.shape[3] != nm.size:
        raise InputError(
            f"{path}: expected M over phi_d, theta_d, theta_h, {nm.size} wavelengths, 4, 4; "
            f"found shape {values.shape}"
        )
    ranges = {"phi_d": (-np.pi, np.pi), "theta_d": (0.0, np.pi / 2), "theta_h": (0.0, np.pi / 2)}
    nodes = []
    for axis, (name, ends) in enumerate(ranges.items()):
        given, count = fields[name].ravel(), values.shape[axis]
        given = np.linspace(*ends, count) if given.size == 0 else given
        nodes.append(increasing(path, name, given, count))
    values = values[..., 0, 0]
    if np.isinf(values).any():
        raise InputError(f"{path}: M holds infinite values; NaN marks what is missing")
    missing = np.isnan(values)
    values = np.where(missing, np.nan, np.maximum(values, 0.0))
    um, values = at_wavelengths(path, nm * 1e-3, values, 3, wavelengths)
    values = np.where(np.isnan(values), -1.0, values).astype(canonical(fields["M"]))
    phi_d, theta_d, theta_h = (jnp.asarray(n, values.dtype) for n in nodes)
    narrow = values[:, nodes[1] <= max(_NARROW, nodes[1][0])]
    seen = narrow >= 0.0
    means = np.where(seen, narrow, 0.0).sum((0, 1, 3)) / np.maximum(seen.sum((0, 1, 3)), 1)
    middles = 0.5 * (nodes[2][1:] + nodes[2][:-1])
    lobe = half_lobe(np.r_[0.0, middles, np.pi / 2], jnp.asarray(means, values.dtype))
    um = jnp.asarray(um, values.dtype)
    return Pbsdf(
        table=jnp.asarray(values),
        phi_d=phi_d,
        theta_d=theta_d,
        theta_h=theta_h,
        wavelengths=um,
        lobe=lobe,
    )
