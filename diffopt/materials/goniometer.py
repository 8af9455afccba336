"""A virtual gonioreflectometer: a material measured on a grid of angles, and kept as a table."""

import math
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.io.files import replacing
from diffopt.kernels import frames, tabulated
from diffopt.materials.base import Material
from diffopt.materials.merl import MERL_SHAPE, Merl
from diffopt.materials.scattered import ANGLES, Scattered

# Angles that are closer count as one, radians: far more than float32 rounds a full turn by.
_SAME = 1e-5
# Pairs that are evaluated at a time.
_CHUNK = 1 << 17


class Measurement(eqx.Module):
    """Values of a material over a grid of angles.

    Attributes
    ----------
    angles
        theta_i, phi_i, theta_o, phi_o of all pairs of the grid, radians, [N, 4].
    values
        In 1/sr, [N] or [N, C].
    measured
        Which values were measured, [N]; the others were filled in by symmetry.
    wavelengths
        Micrometres, [C], where the channels are a spectrum.
    shape
        Of the grid: theta_i, theta_o and phi; or theta_i, phi_i, theta_o, phi_o.
    isotropic, reciprocal
        The symmetries that were used.
    """

    angles: Float[Array, "N 4"]
    values: Float[Array, " N *C"]
    measured: Bool[np.ndarray, " N"]
    wavelengths: Float[Array, " C"] | None
    shape: tuple[int, ...] = eqx.field(static=True)
    isotropic: bool = eqx.field(static=True)
    reciprocal: bool = eqx.field(static=True)

    @property
    def count(self) -> int:
        """How many pairs were measured."""
        return int(self.measured.sum())

    def material(self) -> Scattered:
        """The interpolated measurement, as `load_table` reads it back."""
        return self._from(self.measured)

    def error(self) -> Float[Array, " M"]:
        """Estimated errors of `material` between the samples.

        Every second sample along each axis of the grid interpolates the measured samples
        between them, where the distance to a known one is that of `material`'s doubled:
        the differences, in 1/sr, the largest over the channels. An estimate by its
        distribution, no bound: a peak that is narrower than a step, as at grazing angles, is
        missed by both.

        Raises
        ------
        InputError
            For a grid with fewer than three angles on an axis, unless it has one.
        """
        if any(n == 2 for n in self.shape):
            raise InputError(
                f"an error estimate needs three angles on each axis (or one); received {self.shape}"
            )
        coarse = np.zeros(self.shape, bool)
        coarse[tuple(slice(None, None, 2) for _ in self.shape)] = True
        coarse = np.flatnonzero(coarse)
        keys = _keys(np.asarray(self.angles), self.isotropic, self.reciprocal)
        known, first = np.unique(keys[coarse], axis=0, return_index=True)
        rest = np.flatnonzero(self.measured)
        rest = rest[~(keys[rest, None, :] == known[None, :, :]).all(-1).any(-1)]
        wi, wo = self._directions()
        found = self._from(coarse[first]).f(wi[rest], wo[rest])
        return jnp.abs(found - self.values[rest]).reshape(len(rest), -1).max(-1)

    def to_merl(self, *, shape: tuple[int, int, int] = MERL_SHAPE) -> Merl:
        """The interpolated measurement on the grid of the MERL database; see `tabulate`.

        Raises
        ------
        InputError
            For an anisotropic measurement.
        """
        if not self.isotropic:
            raise InputError("a MERL table is isotropic; the measurement is not")
        return tabulate(self.material(), shape=shape)

    def save(self, path: str | os.PathLike) -> None:
        """Write the measured samples for `diffopt.materials.scattered.load_table`.

        What was filled in by symmetry is not written: `load_table` folds with the same
        symmetries, which it has to be told where they are not both True.

        Parameters
        ----------
        path
            Ends in ``.csv`` or ``.npz``; it appears when it is complete.

        Raises
        ------
        InputError
            For another ending, channels that have no name (neither one, three, nor with
            wavelengths), or no such folder.
        """
        path = Path(path)
        if path.suffix not in (".csv", ".npz"):
            raise InputError(f"{path}: expected a name that ends in .csv or .npz")
        values = np.asarray(self.values, np.float64)[self.measured]
        if values.ndim == 1:
            names = ["f"]
        elif self.wavelengths is not None:
            names = [f"{float(f'{1e3 * um:.6g}'):g}nm" for um in np.asarray(self.wavelengths)]
        elif values.shape[1] == 3:
            names = ["r", "g", "b"]
        else:
            raise InputError(
                f"{path}: {values.shape[1]} channels without wavelengths have no column names"
            )
        degrees = np.degrees(np.asarray(self.angles, np.float64)[self.measured])
        columns = np.column_stack([degrees, values.reshape(len(values), -1)])
        names = [*ANGLES, *names]
        with replacing(path) as file:
            if path.suffix == ".npz":
                np.savez(file, **dict(zip(names, columns.T, strict=True)))
            else:
                rows = (",".join(map(repr, row)) for row in columns.tolist())
                file.write("\n".join([",".join(names), *rows, ""]).encode())

    def _directions(self) -> tuple[Array, Array]:
        theta_i, phi_i, theta_o, phi_o = self.angles.T
        return frames.spherical(theta_i, phi_i), frames.spherical(theta_o, phi_o)

    def _from(self, chosen: np.ndarray) -> Scattered:
        wi, wo = self._directions()
        return Scattered(
            wi[chosen],
            wo[chosen],
            self.values[chosen],
            wavelengths=self.wavelengths,
            isotropic=self.isotropic,
            reciprocal=self.reciprocal,
        )


def measure(
    material: Material,
    theta_i: Any,
    theta_o: Any,
    phi: Any,
    *,
    isotropic: bool = True,
    reciprocal: bool = True,
    noise: float = 0.0,
    key: Array | None = None,
) -> Measurement:
    """Measure a material at all pairs of a grid, each pair once.

    Parameters
    ----------
    material
        What is measured.
    theta_i, theta_o
        Angles of the light and the viewer to the normal, radians in [0, pi / 2).
    phi
        Azimuth of the viewer from that of the light, radians; of an anisotropic material
        the azimuths of both, all against all.
    isotropic
        Use that only the size of the azimuths' difference counts (turns and mirror images
        of the surface are the same).
    reciprocal
        Use that an exchanged pair has the same value.
    noise
        Standard deviation of each measurement over its value, >= 0.
    key
        Of `jax.random.key`, for the noise.

    Returns
    -------
    Measurement
        In the type of the angles; in that of Python numbers for lists.

    Raises
    ------
    InputError
        For angles outside their range, negative noise, or noise without a key.
    """
    axes = []
    for name, given in (("theta_i", theta_i), ("theta_o", theta_o), ("phi", phi)):
        array = np.atleast_1d(np.asarray(given))
        array = array if array.dtype.kind == "f" else array.astype(np.float64)
        high = 0.5 * math.pi if name != "phi" else math.inf
        if array.ndim != 1 or array.size == 0 or not np.isfinite(array).all():
            raise InputError(f"{name} must be finite angles [N]; received shape {array.shape}")
        if name != "phi" and not ((array >= 0.0) & (array < high)).all():
            raise InputError(
                f"{name} must be from 0 to below pi / 2 (radians); received "
                f"{array.min():g} to {array.max():g}"
            )
        axes.append(array)
    if not 0.0 <= noise < math.inf:
        raise InputError(f"noise must be at least 0; received {noise:g}")
    if noise > 0.0 and key is None:
        raise InputError("noise needs a key of jax.random.key; received none")
    dtype = jnp.asarray(np.zeros(0, np.result_type(*axes))).dtype
    theta_i, theta_o, phi = axes
    if isotropic:
        shape = (len(theta_i), len(theta_o), len(phi))
        ti, to, po = (a.ravel() for a in np.meshgrid(theta_i, theta_o, phi, indexing="ij"))
        angles = np.stack([ti, np.zeros_like(ti), to, po], -1)
    else:
        shape = (len(theta_i), len(phi), len(theta_o), len(phi))
        grid = np.meshgrid(theta_i, phi, theta_o, phi, indexing="ij")
        angles = np.stack([a.ravel() for a in grid], -1)
    _, first, source = np.unique(
        _keys(angles, isotropic, reciprocal), axis=0, return_index=True, return_inverse=True
    )
    at = jnp.asarray(angles[first], dtype)
    wi, wo = frames.spherical(at[:, 0], at[:, 1]), frames.spherical(at[:, 2], at[:, 3])
    values = material.f(wi, wo)
    if noise > 0.0 and key is not None:
        values = values * (1.0 + noise * jax.random.normal(key, values.shape, values.dtype))
    measured = np.zeros(len(angles), bool)
    measured[first] = True
    spectrum = checks.concrete(getattr(material, "wavelengths", None))
    named = spectrum is not None and spectrum.shape == values.shape[1:] and spectrum.ndim == 1
    return Measurement(
        jnp.asarray(angles, dtype),
        values[source.ravel()],
        measured,
        jnp.asarray(spectrum, dtype) if named else None,
        shape,
        isotropic,
        reciprocal,
    )


def tabulate(material: Material, *, shape: tuple[int, int, int] = MERL_SHAPE) -> Merl:
    """An isotropic material on the grid of the MERL database.

    Parameters
    ----------
    material
        Evaluated with the light's half vector above x; an anisotropic one loses its turn.
    shape
        Entries over theta_h, theta_d and phi_d.

    Returns
    -------
    Merl
        Entries whose directions are below the horizon are missing.
    """
    rows, columns, depth = shape
    theta_h = 0.5 * np.pi * ((np.arange(rows) + 0.5) / rows) ** 2
    theta_d = 0.5 * np.pi * (np.arange(columns) + 0.5) / columns
    phi_d = np.pi * (np.arange(depth) + 0.5) / depth
    grid = np.meshgrid(theta_h, theta_d, phi_d, indexing="ij")
    wi, wo = tabulated.half_difference(*(jnp.asarray(a.ravel(), float) for a in grid))
    above = np.flatnonzero((wi[:, 2] > 0.0) & (wo[:, 2] > 0.0))
    found = [
        material.f(wi[part], wo[part])
        for part in np.array_split(above, max(1, -(-len(above) // _CHUNK)))
    ]
    values = jnp.concatenate(found)
    table = jnp.full((rows * columns * depth, *values.shape[1:]), -1.0, values.dtype)
    table = table.at[above].set(values)
    return Merl(table.reshape(*shape, *values.shape[1:]))


def _keys(angles: np.ndarray, isotropic: bool, reciprocal: bool) -> np.ndarray:
    """Integers that are equal for pairs that the symmetries make the same."""
    ti, pi, to, po = angles.astype(np.float64).T
    pi, po = (np.where(t < _SAME, 0.0, p) for t, p in ((ti, pi), (to, po)))
    if isotropic:
        turn = np.abs(np.remainder(po - pi + np.pi, 2.0 * np.pi) - np.pi)
        pi, po = np.zeros_like(pi), np.where((ti < _SAME) | (to < _SAME), 0.0, turn)
    # Rounded before the circle is closed, so that just below a full turn is 0.
    whole = np.rint(2.0 * np.pi / _SAME)
    near = [np.rint(a / _SAME) for a in (ti, pi, to, po)]
    near = [near[0], near[1] % whole, near[2], near[3] % whole]
    if reciprocal:
        swap = near[0] > near[2]
        if not isotropic:
            swap |= (near[0] == near[2]) & (near[1] > near[3])
            near[1], near[3] = np.where(swap, near[3], near[1]), np.where(swap, near[1], near[3])
        near[0], near[2] = np.where(swap, near[2], near[0]), np.where(swap, near[0], near[2])
    return np.stack(near, -1).astype(np.int64)
