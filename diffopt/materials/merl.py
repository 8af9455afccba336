"""Isotropic tables over half and difference angles, as the MERL database measured them.

Source: Matusik, Pfister, Brand and McMillan, "A data-driven reflectance model" (SIGGRAPH
2003). The file (``.binary``) holds three int32 sizes, 90, 90, 180 for theta_h (by square
root), theta_d and phi_d, then three planes of float64, red, green and blue, that are scaled
by 1/1500, 1.15/1500 and 1.66/1500; the last angle runs fastest. Negative entries are missing.
"""

import abc
import math
import os
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.io.files import describe, existing_file, replacing
from diffopt.kernels import frames, tabulated, warps
from diffopt.materials.base import Material, floating

#: Entries over theta_h, theta_d and phi_d in the files of the database.
MERL_SHAPE = (90, 90, 180)
_SCALE = np.array([1.0, 1.15, 1.66]) / 1500.0
# Difference angles whose mean forms the lobe that is sampled: beyond, Fresnel's rise and the
# noise of grazing measurements would outweigh the highlight. Share of pi / 2.
_NARROW = 2.0 / 3.0


class HalfLobe(eqx.Module):
    """Distribution of half vectors, constant in rings about the normal.

    Attributes
    ----------
    edges
        sin^2(theta_h / 2) at the edges of the rings, increasing from 0 to 1/2, [N + 1].
    share
        Probability of each ring, [N].
    """

    edges: Float[Array, " N_edges"]
    share: Float[Array, " N"]

    def warp(self, u: Float[Array, "*batch 2"]) -> Float[Array, "*batch 3"]:
        """Half vectors from points of the unit square."""
        ends = jnp.cumsum(self.share)
        count = self.share.shape[0]
        k = jnp.minimum(jnp.searchsorted(ends, u[..., 0], side="right"), count - 1)
        width = self.share[k]
        some = width > 0.0
        t = (u[..., 0] - ends[k] + width) / jnp.where(some, width, 1.0)
        t = jnp.clip(jnp.where(some, t, 0.5), 0.0, 1.0)
        gap = self.edges[k] + t * (self.edges[k + 1] - self.edges[k])
        tiny = float(jnp.finfo(gap.dtype).tiny)
        sin = 2.0 * jnp.sqrt(jnp.maximum(gap * (1.0 - gap), tiny))
        return frames.around(sin, u[..., 1], 1.0 - 2.0 * gap)

    def density(
        self, wi: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Density per steradian of wi, wo mirrored at the half vector; over the sphere."""
        half, length, ok = frames.half_vector(wi, wo)
        across2 = half[..., 0] ** 2 + half[..., 1] ** 2
        gap = across2 / (2.0 * (1.0 + jnp.abs(half[..., 2])))
        last = self.share.shape[0] - 1
        k = jnp.clip(jnp.searchsorted(self.edges, gap, side="right") - 1, 0, last)
        ring = 4.0 * math.pi * (self.edges[k + 1] - self.edges[k])
        return jnp.where(ok, self.share[k] / ring / (2.0 * length), 0.0)


def half_lobe(theta: np.ndarray, means: Float[Array, " N"]) -> HalfLobe:
    """Lobe that follows f cos(theta_h).

    Parameters
    ----------
    theta
        Edges of the rings, radians, increasing from 0 to pi / 2, [N + 1].
    means
        Mean of f over each ring, [N]; all zero gives uniform half vectors.
    """
    gap = np.sin(0.5 * theta) ** 2
    weight = np.diff(gap) * np.cos(0.5 * (theta[1:] + theta[:-1]))
    share = jax.lax.stop_gradient(means) * jnp.asarray(weight, means.dtype)
    whole = share.sum()
    even = jnp.asarray(2.0 * np.diff(gap), means.dtype)
    share = jnp.where(whole > 0.0, share / jnp.where(whole > 0.0, whole, 1.0), even)
    return HalfLobe(jnp.asarray(gap, means.dtype), share)


class HalfSampled(Material):
    """A material sampled half by half vectors, half by the cosine.

    The cosine's half keeps weights bounded where the half vectors' density misses light.
    """

    choices: ClassVar[tuple[float, ...]] = (0.25, 0.75)

    @property
    def conserves_energy(self) -> bool:
        """See `Material`; a measurement promises nothing."""
        return False

    @abc.abstractmethod
    def half(
        self, u: Float[Array, "*batch 2"], wo: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch 3"]:
        """Half vectors above the horizon from points of the unit square."""

    @abc.abstractmethod
    def half_density(
        self, wi: Float[Array, "*batch 3"], wo: Float[Array, "*batch 3"]
    ) -> Float[Array, "*batch"]:
        """Density per steradian of wi where wo is mirrored at `half`, over the sphere."""

    def warp(self, u: Array, wo: Array) -> Array:
        """See `Material`."""
        peak = frames.reflect(wo, self.half(u[..., :2], wo))
        return jnp.where(u[..., 2:] < 0.5, peak, warps.cosine_hemisphere(u[..., :2]))

    def density(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        cosine = jnp.maximum(wi[..., 2], 0.0) / math.pi
        return 0.5 * (self.half_density(wi, wo) + cosine)


class LobeSampled(HalfSampled):
    """A material whose half vectors are those of a `HalfLobe`."""

    lobe: eqx.AbstractVar[HalfLobe]

    def half(self, u: Array, wo: Array) -> Array:
        """See `HalfSampled`."""
        return self.lobe.warp(u)

    def half_density(self, wi: Array, wo: Array) -> Array:
        """See `HalfSampled`."""
        return self.lobe.density(wi, wo)


class Merl(LobeSampled):
    """Isotropic measured reflectance over half and difference angles.

    Reciprocal, as phi_d counts modulo pi. Whether it conserves energy is up to the table.
    Between the entries it is linear, see `diffopt.kernels.tabulated`.

    Parameters
    ----------
    table
        Values in 1/sr, [H, D, P] or, with channels, [H, D, P, C], over theta_h (by square
        root), theta_d and phi_d in [0, pi); see `diffopt.kernels.tabulated.merl_places`.
        Negative entries are missing: their neighbours stand in, and 0 where there are none.
    nearest
        Take the nearest entry, as the reader published with the database does.

    Raises
    ------
    InputError
        For a table of other rank, an empty one, or values that are not finite.
    """

    table: Float[Array, "H D P *C"] = eqx.field(converter=floating)
    lobe: HalfLobe
    nearest: bool = eqx.field(static=True, default=False)

    def __init__(self, table: Any, *, nearest: bool = False):
        table = floating(table)
        if table.ndim not in (3, 4) or 0 in table.shape:
            raise InputError(
                "table must be [theta_h, theta_d, phi_d] or [theta_h, theta_d, phi_d, channels]; "
                f"received shape {table.shape}"
            )
        known = checks.concrete(table)
        if known is not None and not np.isfinite(known).all():
            raise InputError(
                f"table must be finite, with negative values where entries are missing; received "
                f"{known[~np.isfinite(known)][0]}"
            )
        self.table, self.nearest = table, nearest
        rows, columns = table.shape[:2]
        narrow = table[:, : max(1, math.ceil(_NARROW * columns))].reshape(rows, -1)
        seen = (narrow >= 0.0).astype(table.dtype).sum(-1)
        means = jnp.where(narrow < 0.0, 0.0, narrow).sum(-1) / jnp.maximum(seen, 1.0)
        theta = 0.5 * np.pi * (np.arange(rows + 1) / rows) ** 2
        self.lobe = half_lobe(theta, means)

    @property
    def channels(self) -> tuple[int, ...]:
        """See `Material`."""
        return self.table.shape[3:]

    def value(self, wi: Array, wo: Array) -> Array:
        """See `Material`."""
        rows, columns, depth = self.table.shape[:3]
        angles = tabulated.rusinkiewicz(wi, wo)
        places = tabulated.merl_places(*angles, (rows, columns, depth))
        return tabulated.linear(
            self.table, places, periodic=(False, False, True), nearest=self.nearest
        )


def load_merl(
    path: str | os.PathLike, *, shape: tuple[int, int, int] = MERL_SHAPE, nearest: bool = False
) -> Merl:
    """Read a file of the MERL database.

    Parameters
    ----------
    path
        The ``.binary`` file.
    shape
        Entries over theta_h, theta_d and phi_d that the file must have.
    nearest
        See `Merl`.

    Returns
    -------
    Merl
        Of three channels: red, green, blue, in 1/sr.

    Raises
    ------
    InputError
        If there is no such file, it has another layout, is cut short or too long, or holds
        values that are not finite.
    """
    path = existing_file(path)
    data = path.read_bytes()
    sizes = tuple(int(n) for n in np.frombuffer(data[:12], "<i4")) if len(data) >= 12 else ()
    if sizes != tuple(shape):
        wanted = " x ".join(map(str, shape))
        raise InputError(
            f"{path}: expected a MERL file that starts with the sizes {wanted}, found "
            f"{' x '.join(map(str, sizes)) or f'{len(data)} bytes'} ({describe(path)})"
        )
    expected = 12 + 24 * math.prod(shape)
    if len(data) != expected:
        what = "is cut short" if len(data) < expected else "has bytes left over"
        raise InputError(f"{path}: {what}: expected {expected} bytes, found {len(data)}")
    planes = np.frombuffer(data, "<f8", offset=12).reshape(3, *shape)
    if not np.isfinite(planes).all():
        plane, *at = (int(i) for i in np.argwhere(~np.isfinite(planes))[0])
        raise InputError(
            f"{path}: expected finite values, found {planes[plane, *at]} in plane {plane} at "
            f"{tuple(at)}"
        )
    return Merl(np.moveaxis(planes, 0, -1) * _SCALE, nearest=nearest)


def save_merl(path: str | os.PathLike, table: Any) -> None:
    """Write a table, or the table of a `Merl`, as a file of the MERL database.

    Parameters
    ----------
    path
        The ``.binary`` file; it appears when it is complete.
    table
        In 1/sr, [H, D, P, 3]; other programs expect 90 x 90 x 180. Missing entries stay
        negative.

    Raises
    ------
    InputError
        For a table of another shape, values that are not finite, or no such folder.
    """
    values = np.asarray(table.table if isinstance(table, Merl) else table, np.float64)
    if values.ndim != 4 or values.shape[-1] != 3:
        raise InputError(
            f"a MERL file holds a table [theta_h, theta_d, phi_d, 3]; received shape {values.shape}"
        )
    if not np.isfinite(values).all():
        raise InputError("table must be finite; missing entries are negative")
    with replacing(path) as file:
        file.write(np.array(values.shape[:3], "<i4").tobytes())
        file.write(np.moveaxis(values / _SCALE, -1, 0).astype("<f8").tobytes())
