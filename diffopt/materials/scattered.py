"""Tables of a gonioreflectometer: values at any pairs of directions, interpolated.

Pairs are compared by their half and difference angles (Rusinkiewicz's), stretched as the MERL
table is, a = sqrt(theta_h / (pi/2)) and r = theta_d / (pi/2). An isotropic pair is the point
(a, r, a r cos m phi_d, a r |sin m phi_d|), which has no seam where phi_d is not defined; an
anisotropic one (a cos phi_h, a sin phi_h, r, r cos m psi, r sin m psi), psi the azimuth of
wi - wo. m is 2 for a reciprocal material, whose exchanged pairs are one point, else 1.

At a point the K nearest samples get the weights of Franke and Little (((R - d) / (R d))^2, R
the distance of the next one: D. Shepard's method with local support, R. Franke, "Scattered
data interpolation", Math. Comp. 38, 1982), and a plane is fitted with them. Its value there,
limited to the range of the samples, goes through the samples and is continuous.
"""

import csv
import math
import os
import re
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt import checks
from diffopt.chunks import in_chunks
from diffopt.errors import InputError
from diffopt.io import limits, numpy_files
from diffopt.io.files import describe, existing_file
from diffopt.kernels import frames, tabulated
from diffopt.materials.base import floating
from diffopt.materials.merl import HalfLobe, LobeSampled, half_lobe

ANGLES = ("theta_i", "phi_i", "theta_o", "phi_o")
_NANOMETRES = re.compile(r"^([0-9]+(?:\.[0-9]+)?)nm$")
# Pairs whose distances to all samples are held at a time.
_CHUNK = 256
# Rings of the lobe that is sampled, and the part of the scatter that holds the plane's slope
# where the samples leave a direction open.
_RINGS, _RIDGE = 32, 1e-3


class Scattered(LobeSampled):
    """Reflectance known at pairs of directions.

    Parameters
    ----------
    wi, wo
        Unit vectors to the light and the viewer, above the horizon, [N, 3].
    values
        In 1/sr, [N] or [N, C].
    wavelengths
        Micrometres, [C], where the channels are a spectrum.
    isotropic
        Whether only the size of the azimuths' difference counts: turned and mirrored pairs
        are the same. An anisotropic table needs several azimuths of the light.
    reciprocal
        Whether an exchanged pair counts as the same.
    neighbours
        K; at most N - 1 are used.

    Raises
    ------
    InputError
        For shapes that do not fit, fewer than two samples, or values that are not finite.
    """

    points: Float[Array, "N D"]
    values: Float[Array, " N *C"]
    wavelengths: Float[Array, " C"] | None
    lobe: HalfLobe
    isotropic: bool = eqx.field(static=True)
    swaps: bool = eqx.field(static=True)
    neighbours: int = eqx.field(static=True)

    def __init__(
        self,
        wi: Any,
        wo: Any,
        values: Any,
        *,
        wavelengths: Any = None,
        isotropic: bool = True,
        reciprocal: bool = True,
        neighbours: int = 12,
    ):
        values = floating(values)
        wi, wo = (jnp.asarray(w, values.dtype) for w in (wi, wo))
        count = values.shape[0] if values.ndim else 0
        if values.ndim not in (1, 2) or count < 2 or {wi.shape, wo.shape} != {(count, 3)}:
            raise InputError(
                "expected directions [N, 3] and values [N] or [N, C] of at least two samples; "
                f"received shapes {wi.shape}, {wo.shape} and {values.shape}"
            )
        for name, array in (("wi", wi), ("wo", wo), ("values", values)):
            known = checks.concrete(array)
            if known is not None and not np.isfinite(known).all():
                raise InputError(f"{name} must be finite")
        if neighbours < 1:
            raise InputError(f"neighbours must be at least 1; received {neighbours}")
        self.values, self.isotropic, self.swaps = values, isotropic, reciprocal
        self.wavelengths = None if wavelengths is None else jnp.asarray(wavelengths, values.dtype)
        self.neighbours = min(neighbours, count - 1)
        self.points = _embedded(wi, wo, isotropic, reciprocal)
        self.lobe = _lobe(tabulated.rusinkiewicz(wi, wo)[0], values)

    @property
    def reciprocal(self) -> bool:
        """See `Material`."""
        return self.swaps

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.values.shape[1:]

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        at = _embedded(wi, wo, self.isotropic, self.swaps)
        flat = at.reshape(-1, at.shape[-1])
        found = in_chunks(self._at, flat, _CHUNK)
        return found.reshape(*at.shape[:-1], *self.channels)

    def _at(self, x: Float[Array, " D"]) -> Float[Array, "*C"]:
        """The plane through the neighbours of one point, at the point."""
        fixed = jax.lax.stop_gradient(self.points - x[None])
        near = _nearest((fixed * fixed).sum(-1), self.neighbours + 1)
        gap = self.points[near] - x[None]
        # Distances count from far below the spacing on: a root has no slope at 0.
        tiny = float(jnp.finfo(x.dtype).eps) ** 2
        d = jnp.sqrt((gap * gap).sum(-1) + tiny)
        reach = d[-1]
        weight = ((reach - d[:-1]) / (reach * d[:-1])) ** 2
        whole = weight.sum()
        # All at one distance: all count.
        weight = jnp.where(whole > 0.0, weight, 1.0)
        weight = weight / weight.sum()
        gap, values = gap[:-1], self.values[near[:-1]]
        mean = (weight[:, None] * gap).sum(0)
        off = gap - mean[None]
        scatter = (weight[:, None, None] * off[:, :, None] * off[:, None, :]).sum(0)
        size = jnp.trace(scatter) * _RIDGE + tiny * tiny
        slope = jnp.linalg.solve(scatter + size * jnp.eye(x.shape[0], dtype=x.dtype), mean)
        part = weight * (1.0 - (off * slope[None]).sum(-1))
        plane = (part.reshape((-1,) + (1,) * (values.ndim - 1)) * values).sum(0)
        # The ends by place: the slope of a minimum is 0 / 0 where the compiler computes the values
        # twice and rounds them in two ways.
        low, high = (
            jnp.take_along_axis(values, place[None], 0)[0]
            for place in (values.argmin(0), values.argmax(0))
        )
        return jnp.clip(plane, low, high)


def load_table(
    path: str | os.PathLike,
    *,
    isotropic: bool = True,
    reciprocal: bool = True,
    neighbours: int = 12,
) -> Scattered:
    """Read a table of a gonioreflectometer.

    Parameters
    ----------
    path
        A ``.npz`` file of arrays [N], or text separated by commas, semicolons or tabs whose
        first line names its columns; lines that start with ``#`` are comments. The columns
        ``theta_i``, ``phi_i`` (light), ``theta_o``, ``phi_o`` (viewer) are in degrees, theta
        from the normal. Values are in 1/sr: ``f``, or ``r``, ``g``, ``b``, or one column for
        each wavelength (``550nm``). Names that end in ``_cos`` (``f_cos``, ``550nm_cos``)
        hold f cos(theta_o), which is divided by the cosine. Other columns are left alone.
    isotropic, reciprocal, neighbours
        See `Scattered`.

    Raises
    ------
    InputError
        If there is no such file, a column is missing, a cell is not a number (with its
        line), an angle is outside the hemisphere, or a value is not finite.
    """
    path = existing_file(path)
    columns = _archive(path) if path.suffix == ".npz" else _text(path)
    missing = [name for name in ANGLES if name not in columns]
    if missing:
        raise InputError(f"{path}: no column {', '.join(missing)}; there are {', '.join(columns)}")
    names, um = _value_columns(path, columns)
    for name in (*ANGLES, *names):
        bad = np.flatnonzero(~np.isfinite(columns[name]))
        if bad.size:
            raise InputError(
                f"{path}: column {name} is {columns[name][bad[0]]} in row {bad[0] + 1}"
            )
    for name in ("theta_i", "theta_o"):
        limit = columns[name] < 90.0 if "_cos" in names[0] and name == "theta_o" else True
        bad = np.flatnonzero(~((columns[name] >= 0.0) & (columns[name] <= 90.0) & limit))
        if bad.size:
            raise InputError(
                f"{path}: {name} must be from 0 to 90 degrees (below 90 for cosine-weighted "
                f"values); received {columns[name][bad[0]]:g} in row {bad[0] + 1}"
            )
    if len(columns["theta_i"]) < 2:
        raise InputError(f"{path}: expected at least two samples")
    theta_i, phi_i, theta_o, phi_o = (np.radians(columns[name]) for name in ANGLES)
    values = np.stack([columns[name] for name in names], -1)
    if names[0].endswith("_cos"):
        values = values / np.cos(theta_o)[:, None]
    wi, wo = (
        np.asarray(frames.spherical(jnp.asarray(t), jnp.asarray(p)))
        for t, p in ((theta_i, phi_i), (theta_o, phi_o))
    )
    return Scattered(
        wi,
        wo,
        values[:, 0] if names[0] in ("f", "f_cos") else values,
        wavelengths=um,
        isotropic=isotropic,
        reciprocal=reciprocal,
        neighbours=neighbours,
    )


def _value_columns(path: Path, columns: dict[str, np.ndarray]) -> tuple[list[str], Any]:
    """Names of the columns of values, and their wavelengths in micrometres."""
    for end in ("", "_cos"):
        spectrum = {}
        for name in columns:
            found = _NANOMETRES.match(name.removesuffix(end)) if name.endswith(end) else None
            if found:
                spectrum[float(found[1])] = name
        for names in (["f" + end], ["r" + end, "g" + end, "b" + end]):
            if all(name in columns for name in names):
                return names, None
        if spectrum:
            order = sorted(spectrum)
            try:
                checks.wavelengths(np.asarray(order) * 1e-3)
            except InputError as error:
                raise InputError(f"{path}: {error}") from None
            return [spectrum[nm] for nm in order], np.asarray(order) * 1e-3
    raise InputError(
        f"{path}: no values: expected a column f, or r, g, b, or wavelengths like 550nm (with "
        f"_cos where they are cosine-weighted); there are {', '.join(columns)}"
    )


def _archive(path: Path) -> dict[str, np.ndarray]:
    content = numpy_files.archive(path)
    count = len(content["theta_i"]) if np.ndim(content.get("theta_i", 0)) == 1 else None
    columns = {}
    for name, array in content.items():
        if array.dtype.kind in "fiu" and array.ndim == 1:
            if count is not None and len(array) != count:
                raise InputError(
                    f"{path}: column {name} has {len(array)} entries, theta_i has {count}"
                )
            columns[name] = numpy_files.doubles(array)
    return columns


def _text(path: Path) -> dict[str, np.ndarray]:
    try:
        lines = limits.text(path, limits.MOST_TEXT).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise InputError(f"{path}: expected a table in text, found {describe(path)}") from None
    kept = [(n, s) for n, s in enumerate(lines, 1) if s.strip() and not s.startswith("#")]
    if not kept:
        raise InputError(f"{path}: expected a line of column names, found comments alone")
    mark = max(",;\t", key=kept[0][1].count)
    rows = [_cells(path, line, text, mark) for line, text in kept]
    names = [name.strip() for name in rows[0]]
    if len(set(names)) < len(names):
        raise InputError(f"{path}: column names must differ; received {', '.join(names)}")
    numbers = np.empty((len(rows) - 1, len(names)))
    for at, ((line, _), row) in enumerate(zip(kept[1:], rows[1:], strict=True)):
        if len(row) != len(names):
            raise InputError(f"{path}, line {line}: expected {len(names)} cells, found {len(row)}")
        for column, cell in enumerate(row):
            try:
                numbers[at, column] = float(cell)
            except ValueError:
                raise InputError(
                    f"{path}, line {line}: {names[column]} must be a number; received {cell!r}"
                ) from None
    return dict(zip(names, numbers.T, strict=True))


def _cells(path: Path, line: int, text: str, mark: str) -> list[str]:
    """Cells of a line; quotes that go on in the next one are none."""
    try:
        return next(csv.reader([text], delimiter=mark, strict=True))
    except csv.Error as error:
        raise InputError(f"{path}, line {line}: {error}") from None


def _embedded(wi: Array, wo: Array, isotropic: bool, swaps: bool) -> Array:
    """Pairs as points, see the module."""
    theta_h, theta_d, phi_d = tabulated.rusinkiewicz(wi, wo)
    a = tabulated.root(theta_h * (2.0 / math.pi))
    r = theta_d * (2.0 / math.pi)
    m = 2.0 if swaps else 1.0
    if isotropic:
        turn = m * phi_d
        return jnp.stack([a, r, a * r * jnp.cos(turn), a * r * jnp.abs(jnp.sin(turn))], -1)
    phi_h, psi = (tabulated.angle(w[..., 1], w[..., 0]) for w in (wi + wo, wi - wo))
    psi = m * psi
    parts = [a * jnp.cos(phi_h), a * jnp.sin(phi_h), r, r * jnp.cos(psi), r * jnp.sin(psi)]
    return jnp.stack(parts, -1)


def _nearest(distance: Float[Array, " N"], count: int) -> Int[Array, " K"]:
    """Indices of the smallest, in order; a pass for each beats sorting all on a processor."""

    def step(left, _):
        index = jnp.argmin(left)
        return left.at[index].set(jnp.inf), index

    return jax.lax.scan(step, distance, length=count)[1]


def _lobe(theta_h: Array, values: Array) -> HalfLobe:
    """Mean of the samples in rings; empty rings take the mean of all."""
    theta = 0.5 * np.pi * (np.arange(_RINGS + 1) / _RINGS) ** 2
    ring = jnp.searchsorted(jnp.asarray(theta[1:-1], values.dtype), theta_h, side="right")
    grey = jnp.maximum(values.reshape(len(values), -1).mean(-1), 0.0)
    total = jnp.zeros(_RINGS, values.dtype).at[ring].add(grey)
    count = jnp.zeros(_RINGS, values.dtype).at[ring].add(jnp.ones_like(grey))
    means = jnp.where(count > 0.0, total / jnp.maximum(count, 1.0), grey.mean())
    return half_lobe(theta, means)
