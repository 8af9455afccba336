"""Measurements kept as tensor files: polarised ones (``.pbsdf``) and RGL's (``.bsdf``).

A tensor file starts with ``tensor_file`` and a zero byte, a version of two bytes (1, 0) and
the number of fields, uint32. Each field is the length of its name (uint16), the name, the
number of axes (uint16), a type (uint8), the place of its data in the file (uint64) and its
shape (uint64 each); all little-endian. Mitsuba 3 reads the same files.

Sources: Baek et al., "Image-based acquisition and modeling of polarimetric reflectance" (ACM
TOG 39(4), 2020); Dupuy and Jakob, "An adaptive parameterization for efficient material
acquisition and rendering" (ACM TOG 37(6), 2018).
"""

import math
import os
import struct
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.io.files import existing_file, replacing, require_signature
from diffopt.kernels import tabulated
from diffopt.kernels.tabulated import Corner
from diffopt.materials.base import times
from diffopt.materials.merl import HalfLobe, HalfSampled, LobeSampled, half_lobe

_MAGIC = b"tensor_file\x00"
# Types by their number in the file; 0 is not used.
_TYPES = ("", "u1", "i1", "<u2", "<i2", "<u4", "<i4", "<u8", "<i8", "<f2", "<f4", "<f8")
# Difference angles whose mean forms the lobe that is sampled; see `diffopt.materials.merl`.
_NARROW = math.pi / 3.0


def read_tensors(path: str | os.PathLike) -> dict[str, np.ndarray]:
    """Read all fields of a tensor file, by name.

    Raises
    ------
    InputError
        If there is no such file, it is of another format or version, or is cut short.
    """
    path = existing_file(path)
    require_signature(path, (_MAGIC,), "a tensor file (.bsdf, .pbsdf)")
    data = path.read_bytes()
    fields, at = {}, len(_MAGIC)

    def take(layout: str) -> tuple[Any, ...]:
        nonlocal at
        found = struct.unpack_from("<" + layout, data, at)
        at += struct.calcsize("<" + layout)
        return found

    try:
        version = take("BB")
        if version != (1, 0):
            raise InputError(
                f"{path}: a tensor file of version {version[0]}.{version[1]}; expected 1.0"
            )
        for _ in range(take("I")[0]):
            (length,) = take("H")
            name = take(f"{length}s")[0].decode("utf-8", "replace")
            axes, kind = take("HB")
            (offset, *shape) = take(f"Q{axes}Q")
            if not 0 < kind < len(_TYPES):
                raise InputError(
                    f"{path}: field {name!r} is of type {kind}; expected 1 to {len(_TYPES) - 1}"
                )
            size = math.prod(shape) * np.dtype(_TYPES[kind]).itemsize
            if offset + size > len(data):
                raise InputError(
                    f"{path}: is cut short: field {name!r} ends at byte {offset + size}, "
                    f"the file at {len(data)}"
                )
            array = np.frombuffer(data, _TYPES[kind], math.prod(shape), offset)
            fields[name] = array.reshape(shape)
    except struct.error:
        raise InputError(f"{path}: is cut short within its list of fields") from None
    return fields


def write_tensors(path: str | os.PathLike, fields: dict[str, np.ndarray]) -> None:
    """Write a tensor file; it appears when it is complete.

    Raises
    ------
    InputError
        For a type that the format does not have, or no such folder.
    """
    arrays = {name: np.asarray(value) for name, value in fields.items()}
    size = sum(2 + len(name.encode()) + 11 + 8 * a.ndim for name, a in arrays.items())
    header, data = struct.pack("<12s2BI", _MAGIC, 1, 0, len(arrays)), b""
    start = len(header) + size
    for name, array in arrays.items():
        kind = array.dtype.newbyteorder("<").str.lstrip("|<")
        numbers = [i for i, t in enumerate(_TYPES) if t.lstrip("<") == kind]
        if not numbers:
            raise InputError(f"field {name!r} is of type {array.dtype}; expected real numbers")
        header += struct.pack("<H", len(name.encode())) + name.encode()
        header += struct.pack(
            f"<HBQ{array.ndim}Q", array.ndim, numbers[0], start + len(data), *array.shape
        )
        data += array.astype(_TYPES[numbers[0]]).tobytes()
    with replacing(path) as file:
        file.write(header + data)


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
    def conserves_energy(self) -> bool:
        """See `Material`; a measurement promises nothing."""
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
    fields = _require(path, read_tensors(path), ("phi_d", "theta_d", "theta_h", "wvls", "M"))
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
        nodes.append(_increasing(path, name, given, count))
    values = values[..., 0, 0]
    if np.isinf(values).any():
        raise InputError(f"{path}: M holds infinite values; NaN marks what is missing")
    missing = np.isnan(values)
    values = np.where(missing, np.nan, np.maximum(values, 0.0))
    um, values = _at_wavelengths(path, nm * 1e-3, values, 3, wavelengths)
    values = np.where(np.isnan(values), -1.0, values).astype(_floating(fields["M"]))
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
    def conserves_energy(self) -> bool:
        """See `Material`; a measurement promises nothing."""
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
            phi = phi + _polar(wo)[1]
        sin = jnp.sin(theta)
        h = jnp.stack([sin * jnp.cos(phi), sin * jnp.sin(phi), jnp.cos(theta)], -1)
        return h * sign

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
        return jnp.stack([x if self.folds == 4 else y, y, jnp.ones_like(x)], -1)

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
    fields = _require(
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
    phi_i = _increasing(path, "phi_i", fields["phi_i"].ravel(), slices[0])
    theta_i = _increasing(path, "theta_i", fields["theta_i"].ravel(), slices[1])
    um = None
    if wavelengths is not None:
        nodes = fields["wavelengths"].ravel() * 1e-3
        um, values = _at_wavelengths(path, nodes, values, 2, wavelengths)
    reach = phi_i[-1] - phi_i[0]
    dtype = _floating(fields["vndf"])
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


def _floating(array: np.ndarray) -> Any:
    """The type of an array, as far as jax is set up to hold it."""
    return jax.dtypes.canonicalize_dtype(array.dtype)


def _require(
    path: Path, fields: dict[str, np.ndarray], names: tuple[str, ...]
) -> dict[str, np.ndarray]:
    missing = [name for name in names if name not in fields]
    if missing:
        raise InputError(
            f"{path}: no field {', '.join(missing)}; there are {', '.join(sorted(fields))}"
        )
    return {name: fields[name] for name in names}


def _increasing(path: Path, name: str, nodes: np.ndarray, count: int) -> np.ndarray:
    if nodes.size != count or not (np.diff(nodes) > 0.0).all():
        raise InputError(f"{path}: expected {count} increasing nodes {name}; found {nodes.size}")
    return nodes.astype(np.float64)


def _at_wavelengths(
    path: Path, nodes: np.ndarray, values: np.ndarray, axis: int, wavelengths: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Values at wavelengths, linear between the nodes; all in micrometres."""
    nodes = _increasing(path, "wavelengths", nodes, nodes.size)
    if wavelengths is None:
        return nodes, values
    checks.wavelengths(wavelengths)
    um = np.atleast_1d(np.asarray(wavelengths, np.float64))
    if um.min() < nodes[0] - 1e-6 or um.max() > nodes[-1] + 1e-6:
        raise InputError(
            f"{path}: wavelengths must be within {nodes[0]:g} to {nodes[-1]:g} micrometres; "
            f"received {um.min():g} to {um.max():g}"
        )
    first = np.clip(np.searchsorted(nodes, um, "right") - 1, 0, max(len(nodes) - 2, 0))
    following = np.minimum(first + 1, len(nodes) - 1)
    step = np.where(following > first, nodes[following] - nodes[first], 1.0)
    share = np.clip((um - nodes[first]) / step, 0.0, 1.0)
    share = share.reshape((-1,) + (1,) * (values.ndim - axis - 1))
    low, high = values.take(first, axis), values.take(following, axis)
    # A missing neighbour does not count where its share is 0.
    mixed = (1.0 - share) * low + share * high
    return um, np.where(share == 0.0, low, np.where(share == 1.0, high, mixed))


def _polar(w: Array) -> tuple[Array, Array]:
    """Angle to the normal and azimuth, 0 with slope 0 where they have none."""
    theta, _, _ = tabulated.rusinkiewicz(w, w)
    some = (w[..., 0] != 0.0) | (w[..., 1] != 0.0)
    return theta, jnp.where(some, jnp.arctan2(w[..., 1], jnp.where(some, w[..., 0], 1.0)), 0.0)


def _to_square(theta: Array, phi: Array) -> tuple[Array, Array]:
    some = theta > 0.0
    x = jnp.where(some, jnp.sqrt(jnp.where(some, theta, 1.0) * (2.0 / math.pi)), 0.0)
    y = (phi + math.pi) / (2.0 * math.pi)
    return x, y - jnp.floor(y)


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
