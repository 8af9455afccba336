"""Measurements of RGL (``.bsdf``): a reflectance in coordinates that follow the material.

Source: Dupuy and Jakob, "An adaptive parameterization for efficient material acquisition and
rendering" (ACM TOG 37(6), 2018).
"""

import math
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.kernels import frames, tabulated
from diffopt.kernels.tabulated import Corner
from diffopt.materials.base import times
from diffopt.materials.merl import HalfSampled
from diffopt.materials.tensorfile import (
    at_wavelengths,
    canonical,
    increasing,
    read_tensors,
    require,
)


class Rgl(HalfSampled):
    """Measurement in the adaptive parameterization of Dupuy and Jakob.

    f = S ndf / (4 sigma cos_o): the table S holds what is left of the measured cosine-weighted
    values after division by those of a microfacet model, at the points of the unit square that
    the model's visible normals carry to half vectors. The tabulated direction is that to the
    light. Not reciprocal as such; the visible normals seen by the viewer serve for sampling.

    Attributes
    ----------
    phi_i, theta_i
        Increasing nodes of the direction to the light, radians, [P] and [T]; at most two of
        phi_i for an isotropic material.
    ndf, sigma
        Density of normals and projected area over the square of directions, azimuth first.
    vndf
        Densities of visible normals, [P, T, height, width].
    values
        S, [P, T, height, width, C].
    wavelengths
        Micrometres, [C]; None for red, green, blue.
    jacobian
        Whether S has to be multiplied with ndf / (4 sigma).
    """

    phi_i: Float[Array, " P"]
    theta_i: Float[Array, " T"]
    ndf: Float[Array, "_ _"]
    sigma: Float[Array, "_ _"]
    vndf: Float[Array, "P T _ _"]
    values: Float[Array, "P T _ _ C"]
    wavelengths: Float[Array, " C"] | None
    jacobian: bool = eqx.field(static=True)
    folds: int = eqx.field(static=True)

    @property
    def reciprocal(self) -> bool:
        """See `Material`."""
        return False

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.values.shape[-1:]

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        sign = self._fold(wi)
        wi, wo = wi * sign, wo * sign
        (places, slices, light), (x, y) = self._slices(wi), self._square(wi + wo, wi)
        s, t, _ = tabulated.invert_bilinear(self._models, slices, x, y)
        height, width = self.values.shape[2:4]
        found = _lookup(self.values, (*places, t * (height - 1.0), s * (width - 1.0)))
        if self.jacobian:
            share = _unit_lookup(self.ndf, x, y) / (4.0 * _unit_lookup(self.sigma, *light))
            found = times(share, found)
        return times(1.0 / wo[..., 2], found)

    def half(self, u: Array, wo: Array) -> Array:
        """See `HalfSampled`."""
        sign = self._fold(wo)
        wo = wo * sign
        x, y = tabulated.sample_bilinear(self._models, self._slices(wo)[1], u[..., 0], u[..., 1])
        theta, phi = 0.5 * math.pi * x * x, (2.0 * y - 1.0) * math.pi
        if self._isotropic:
            phi = phi + tabulated.angle(wo[..., 1], wo[..., 0])
        return frames.spherical(theta, phi) * sign

    def half_density(self, wi: Array, wo: Array) -> Array:
        """See `HalfSampled`."""
        sign = self._fold(wo)
        wo, total = wo * sign, (wi + wo) * sign
        total = total * jnp.where(total[..., 2:] < 0.0, -1.0, 1.0).astype(total.dtype)
        x, y = self._square(total, wo)
        _, _, density = tabulated.invert_bilinear(self._models, self._slices(wo)[1], x, y)
        across2 = total[..., 0] ** 2 + total[..., 1] ** 2
        length2 = across2 + total[..., 2] ** 2
        # Solid angle of half vectors over the area of the square, times 2 |wi + wo|.
        stretch = 2.0 * math.pi**2 * x * jnp.sqrt(across2) * 2.0
        ok = (length2 > 1e-12) & (stretch > 0.0)
        return jnp.where(ok, density / jnp.where(ok, stretch, 1.0), 0.0)

    @property
    def _isotropic(self) -> bool:
        return self.phi_i.shape[0] <= 2

    @property
    def _models(self) -> Array:
        return self.vndf.reshape(-1, *self.vndf.shape[2:])

    def _fold(self, w: Array) -> Array:
        """Signs that turn w into the part of the circle that was measured."""
        if self.folds < 2:
            return jnp.ones_like(w)
        x, y = (jnp.where(w[..., k] < 0.0, 1.0, -1.0).astype(w.dtype) for k in (0, 1))
        return frames.direction(x if self.folds == 4 else y, y, jnp.ones_like(x))

    def _slices(self, w: Array) -> tuple[tuple[Array, Array], list[Corner], tuple[Array, Array]]:
        """Places of w among the slices, those about it, and w in the unit square."""
        theta, phi = _polar(w)
        places = (tabulated.place(self.phi_i, phi), tabulated.place(self.theta_i, theta))
        slices = tabulated.corners(self.vndf.shape[:2], places, (False, False))
        return places, slices, _to_square(theta, phi)

    def _square(self, total: Array, w: Array) -> tuple[Array, Array]:
        """The half vector in the unit square; by its azimuth from w if isotropic."""
        theta, phi = _polar(total)
        return _to_square(theta, phi - _polar(w)[1] if self._isotropic else phi)


def load_rgl(path: str | os.PathLike, *, wavelengths: Any = None) -> Rgl:
    """Read a measurement of the RGL database.

    Parameters
    ----------
    path
        A tensor file (``.bsdf``) with ``theta_i``, ``phi_i``, ``ndf``, ``sigma``, ``vndf``,
        ``jacobian`` and ``rgb``, or ``spectra`` and ``wavelengths`` (nanometres).
    wavelengths
        In micrometres, within those of the file, between which the values are linear. None
        reads red, green, blue, which can be negative for saturated colours.

    Raises
    ------
    InputError
        As `read_tensors`; also for missing fields, shapes that do not fit, nodes that do not
        increase, values that are not finite, and wavelengths outside the file's.
    """
    path = Path(path)
    content = read_tensors(path)
    source = ("rgb",) if wavelengths is None else ("spectra", "wavelengths")
    fields = require(
        path, content, ("phi_i", "theta_i", "ndf", "sigma", "vndf", "jacobian", *source)
    )
    for name in fields:
        if not np.isfinite(fields[name]).all():
            raise InputError(f"{path}: field {name!r} must be finite")
    vndf, values = fields["vndf"], fields[source[0]]
    slices = (fields["phi_i"].size, fields["theta_i"].size)
    colours = 3 if wavelengths is None else fields["wavelengths"].size
    for name, shape, axes in (("vndf", slices, 4), (source[0], (*slices, colours), 5)):
        if fields[name].ndim != axes or fields[name].shape[: len(shape)] != shape:
            raise InputError(
                f"{path}: expected {name} [{', '.join(map(str, shape))}, height, width]; found "
                f"shape {fields[name].shape}"
            )
    phi_i = increasing(path, "phi_i", fields["phi_i"].ravel(), slices[0])
    theta_i = increasing(path, "theta_i", fields["theta_i"].ravel(), slices[1])
    um = None
    if wavelengths is not None:
        nodes = fields["wavelengths"].ravel() * 1e-3
        um, values = at_wavelengths(path, nodes, values, 2, wavelengths)
    reach = phi_i[-1] - phi_i[0]
    dtype = canonical(fields["vndf"])
    return Rgl(
        phi_i=jnp.asarray(phi_i, dtype),
        theta_i=jnp.asarray(theta_i, dtype),
        ndf=jnp.asarray(fields["ndf"], dtype),
        sigma=jnp.asarray(fields["sigma"], dtype),
        vndf=jnp.asarray(vndf, dtype),
        values=jnp.asarray(np.moveaxis(values, 2, -1), dtype),
        wavelengths=None if um is None else jnp.asarray(um, dtype),
        jacobian=bool(fields["jacobian"].ravel()[0]),
        folds=1 if len(phi_i) <= 2 else round(2.0 * math.pi / reach),
    )


def _polar(w: Array) -> tuple[Array, Array]:
    """Angle to the normal and azimuth of a vector of any length."""
    across = tabulated.root(w[..., 0] ** 2 + w[..., 1] ** 2)
    return tabulated.angle(across, w[..., 2]), tabulated.angle(w[..., 1], w[..., 0])


def _to_square(theta: Array, phi: Array) -> tuple[Array, Array]:
    y = (phi + math.pi) / (2.0 * math.pi)
    return tabulated.root(theta * (2.0 / math.pi)), y - jnp.floor(y)


def _lookup(table: Array, places: tuple[Array, ...]) -> Array:
    """Linear between entries of either sign."""
    axes = len(places)
    flat = table.reshape(-1, *table.shape[axes:])
    total = jnp.zeros((*places[0].shape, *table.shape[axes:]), table.dtype)
    for index, part in tabulated.corners(table.shape[:axes], places, (False,) * axes):
        total = total + times(part, flat[index])
    return total


def _unit_lookup(table: Array, x: Array, y: Array) -> Array:
    height, width = table.shape
    return _lookup(table, (y * (height - 1.0), x * (width - 1.0)))
