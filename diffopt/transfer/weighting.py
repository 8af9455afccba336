"""What each of a fixed set of directions adds to the slices of a material: tables of weights.

One set of directions serves all views of a vertex: the moments of all slices are one product
of a table, made once for a material, with what the rays of the vertex meet.

A slice of several lobes is split among them once, by the responsibilities of a mixture fitted
to the unoccluded material; each lobe then has moments of its own. That is one step of
expectation maximisation from the unoccluded slice. It keeps lobe j of one view or vertex beside
lobe j of the next, as interpolation wants it.
"""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames, mixture, vmf
from diffopt.kernels.langevin import inverse_langevin
from diffopt.transfer.reflectors import SHARPEST, Reflector, sharpness
from diffopt.transfer.views import Hemisphere

# Fine directions for each sharpest lobe's solid angle, and at most for each ray.
_PER_LOBE, _MOST_FINE = 256, 64
# Fine directions whose values are computed at a time.
_BLOCK = 2**19
_EM_START, _EM_STEPS, _EM_OWN = 200, 40, 12
# Views handled at a time.
_VIEWS = 64
_POLAR = 24


class Directions(NamedTuple):
    """Directions over the hemisphere in the local frame.

    Attributes
    ----------
    rays
        Evenly spread, one for each cell of equal size, [N, 3].
    fine
        More of them, sorted by the cell that they lie in, [M, 3].
    cell
        Of each fine one, [M].
    """

    rays: Float[np.ndarray, "N 3"]
    fine: Float[np.ndarray, "M 3"]
    cell: Int[np.ndarray, " M"]


class Weights(eqx.Module):
    """Weights of views.

    Attributes
    ----------
    rays
        Of each view and lobe for each ray: f cos times solid angle, the mean of the channels,
        [V * K, N].
    whole
        Their sums over the rays, [V * K].
    off
        First moment of the lobe less what the rays make of it: what fine directions within a
        cell add, [V * K, 3].
    tint
        Albedo of each channel over their mean, [V, C].
    mu, kappa
        The unoccluded lobes, [V, K, 3], [V, K].
    """

    rays: Float[Array, "VK N"]
    whole: Float[Array, " VK"]
    off: Float[Array, "VK 3"]
    tint: Float[Array, "V C"]
    mu: Float[Array, "V K 3"]
    kappa: Float[Array, "V K"]

    @property
    def alpha(self) -> Float[Array, "V K C"]:
        """Integrals of the unoccluded lobes."""
        return self.whole.reshape(self.kappa.shape)[..., None] * self.tint[:, None]


def spiral(count: int) -> Float[np.ndarray, "N 3"]:
    """Fibonacci's spiral over the hemisphere: points of equal solid angle."""
    k = np.arange(count)
    z = (k + 0.5) / count
    turn = 2.0 * np.pi * ((k * (0.5 * (math.sqrt(5.0) - 1.0))) % 1.0)
    across = np.sqrt(1.0 - z * z)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], -1)


@functools.lru_cache(maxsize=8)
def directions(rays: int, fine: int) -> Directions:
    """Rays, with about `fine` finer directions for each."""
    from scipy.spatial import KDTree

    coarse = spiral(rays)
    if fine == 1:
        return Directions(coarse, coarse, np.arange(rays))
    points = spiral(rays * fine)
    cell = np.asarray(KDTree(coarse).query(points)[1])
    order = np.argsort(cell, kind="stable")
    return Directions(coarse, points[order], cell[order])


def fineness(made: Reflector, rays: int) -> int:
    """Fine directions for each ray, that resolve the lobes of a reflector."""
    wanted = _PER_LOBE * sharpness(made) / rays
    return int(np.clip(2 ** math.ceil(math.log2(max(wanted, 1.0))), 1, _MOST_FINE))


def glossy(
    made: Reflector, among: Directions, sphere: Hemisphere, new: slice, lobes: int
) -> Weights:
    """Weights of the glossy rest of a reflector for some views of a hemisphere."""
    views = jnp.asarray(sphere.views[new], jnp.float32)
    start = _meridian(made, among, lobes) if lobes > 1 else None
    fine = jnp.asarray(among.fine, jnp.float32)
    step = max(1, _BLOCK // len(among.fine))
    parts = []
    for first in range(0, len(views), step):
        some = views[first : first + step]
        short = step - len(some)
        padded = jnp.concatenate([some, jnp.repeat(some[:1], short, axis=0)])
        found = _values(made, fine, jnp.asarray(among.cell, jnp.int32), padded, len(among.rays))
        parts.append([np.asarray(a)[: len(some)] for a in found])
    value, vector, tint = (np.concatenate(a) for a in zip(*parts, strict=True))
    return _assembled(value, vector, tint, among, start, np.asarray(views), lobes)


def diffuse(made: Reflector, among: Directions, lobes: int) -> Weights:
    """Weights of the diffuse share: one slice, for all views."""
    z = among.fine[:, 2]
    solid = 2.0 * np.pi / len(z)
    albedo = np.asarray(made.diffuse, np.float64)
    mean = albedo.mean()
    weight = z / np.pi * solid * mean
    count = len(among.rays)
    value = np.bincount(among.cell, weight, count)[None]
    vector = np.stack([np.bincount(among.cell, weight * s, count) for s in among.fine.T], -1)[None]
    tint = (albedo / mean if mean > 0.0 else np.ones_like(albedo))[None]
    up = np.array([[0.0, 0.0, 1.0]])
    start = None
    if lobes > 1:
        near = _begun(np.asarray(among.rays), np.maximum(value[0], 1e-30), lobes)
        start = jax.tree.map(lambda a: np.asarray(a)[None], near)
    return _assembled(
        value.astype(np.float32),
        vector[0][None].astype(np.float32),
        tint.astype(np.float32),
        among,
        start,
        up,
        lobes,
    )


@eqx.filter_jit
def _values(
    made: Reflector, fine: Array, cell: Array, views: Array, rays: int
) -> tuple[Array, Array, Array]:
    """Sums over the fine directions of each cell, for views [B, 3]: value, vector, tint."""
    solid = 2.0 * math.pi / fine.shape[0]

    def one(view: Array) -> tuple[Array, Array, Array]:
        f = made.value(fine, jnp.broadcast_to(view, fine.shape)) * (fine[:, 2:] * solid)
        mean = f.mean(-1)
        albedo = f.sum(0)
        total = albedo.mean()
        tint = jnp.where(total > 0.0, albedo / jnp.where(total > 0.0, total, 1.0), 1.0)
        if fine.shape[0] == rays:
            return mean, mean[:, None] * fine, tint
        columns = jnp.concatenate([mean[:, None], mean[:, None] * fine], -1)
        sums = jax.ops.segment_sum(columns, cell, rays, indices_are_sorted=True)
        return sums[:, 0], sums[:, 1:], tint

    return jax.lax.map(one, views)


def _assembled(
    value: np.ndarray,
    vector: np.ndarray,
    tint: np.ndarray,
    among: Directions,
    start: Any,
    views: np.ndarray,
    lobes: int,
) -> Weights:
    s = jnp.asarray(among.rays, jnp.float32)
    at = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), start)
    found = []
    for first in range(0, len(views), _VIEWS):
        part = slice(first, first + _VIEWS)
        some = [_padded(a[part]) for a in (value, vector, np.asarray(views, np.float32))]
        made = _split_views(*some, s, at, _sharpest(len(s)))
        count = len(views[part])
        found.append(jax.tree.map(lambda a, n=count: np.asarray(a)[:n], made))
    parts = [np.concatenate(a) for a in zip(*found, strict=True)]
    rays, whole, off, mu, kappa = parts
    count = rays.shape[0] * rays.shape[1]
    return Weights(
        jnp.asarray(rays.reshape(count, -1)),
        jnp.asarray(whole.reshape(-1)),
        jnp.asarray(off.reshape(-1, 3)),
        jnp.asarray(tint),
        jnp.asarray(mu),
        jnp.asarray(kappa),
    )


def _padded(rows: np.ndarray) -> np.ndarray:
    """Rows up to a full block, the last one repeated."""
    return np.concatenate([rows, np.repeat(rows[-1:], _VIEWS - len(rows), axis=0)])


def _sharpest(rays: int) -> float:
    """Concentration that an even set of directions can tell: two pi over a cell."""
    return float(rays)


@jax.jit
def _split_views(
    value: Array, vector: Array, views: Array, s: Array, start: Any, sharpest: Any
) -> tuple[Array, ...]:
    """Weights [B, K, N] of lobes, with their sums, what lies within cells, and the lobes."""

    def one(args: tuple[Array, ...]) -> tuple[Array, ...]:
        v, vec, view = args
        if start is None:
            share = jnp.ones_like(v)[None]
        else:
            near, _ = mixture.expectation_maximisation(
                s, v, _turned(start, view), _EM_OWN, sharpest
            )
            log = vmf.log_pdf(s[None], near.mu[:, None], near.kappa[:, None])
            share = jax.nn.softmax(near.log_share[:, None] + log, axis=0)
        each = share * v[None]
        whole = each.sum(-1)
        first = jnp.einsum("kn,nc->kc", share, vec, precision="highest")
        off = first - jnp.einsum("kn,nc->kc", each, s, precision="highest")
        up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], s.dtype), first.shape)
        _, mu, kappa = lobe(whole, first, up, jnp.full_like(whole, SHARPEST))
        return each, whole, off, mu, kappa

    return jax.lax.map(one, (value, vector, views))


def _meridian(made: Reflector, among: Directions, lobes: int) -> mixture.Mixture:
    """Mixtures at polar angles from the normal to the horizon, each begun at the one before."""
    angles = np.linspace(0.0, 0.5 * np.pi - 0.005, _POLAR)
    views = np.stack([np.sin(angles), 0.0 * angles, np.cos(angles)], -1)
    fine, cell = jnp.asarray(among.fine, jnp.float32), jnp.asarray(among.cell, jnp.int32)
    value, _, _ = _values(made, fine, cell, jnp.asarray(views, jnp.float32), len(among.rays))
    s = jnp.asarray(among.rays, jnp.float32)
    at = _begun(np.asarray(among.rays), np.asarray(value[0], np.float64), lobes)
    at = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), at)
    found = []
    for k in range(_POLAR):
        if k:
            turn = jnp.asarray(angles[k - 1] - angles[k], jnp.float32)
            at = mixture.Mixture(at.log_share, _about_y(at.mu, turn), at.kappa)
        at = _em(s, value[k], at, _EM_STEPS, _sharpest(len(among.rays)))
        found.append(at)
    return jax.tree.map(lambda *a: jnp.stack(a), *found)


@functools.partial(jax.jit, static_argnums=3)
def _em(s: Array, value: Array, at: Any, steps: int, sharpest: Any) -> Any:
    return mixture.expectation_maximisation(s, value, at, steps, sharpest)[0]


def _begun(s: np.ndarray, weights: np.ndarray, lobes: int) -> mixture.Mixture:
    """Lobes about one axis, from broad to sharp: what a lobe that is round splits into."""
    points, w = jnp.asarray(s, jnp.float32), jnp.asarray(weights, jnp.float32)
    most = _sharpest(len(s))
    _, mu, kappa = mixture.moments(points, w, most)
    spread = jnp.asarray(4.0 ** np.linspace(-0.75, 1.0, lobes), jnp.float32)
    each = jnp.clip(kappa * spread, mixture.FLATTEST, most)
    at = mixture.Mixture(
        jnp.full((lobes,), -math.log(lobes), jnp.float32), jnp.tile(mu[None], (lobes, 1)), each
    )
    return _em(points, w, at, _EM_START, most)


def _about_y(mu: Array, angle: Array) -> Array:
    """Axes turned in the plane of x and z: from z towards x for positive angles."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return frames.direction(
        cos * mu[..., 0] + sin * mu[..., 2], mu[..., 1], cos * mu[..., 2] - sin * mu[..., 0]
    )


def _turned(table: mixture.Mixture, view: Array) -> mixture.Mixture:
    """The mixture of the polar angle of a view, turned to its azimuth."""
    if table.kappa.shape[0] == 1:
        return jax.tree.map(lambda a: a[0], table)
    across = jnp.sqrt(view[0] ** 2 + view[1] ** 2)
    steps = (0.5 * math.pi - 0.005) / (_POLAR - 1)
    place = jnp.arctan2(across, view[2]) / steps
    k = jnp.clip(place.astype(jnp.int32), 0, _POLAR - 2)
    t = jnp.clip(place - k.astype(place.dtype), 0.0, 1.0)
    low, high = (jax.tree.map(lambda a, i=i: a[i], table) for i in (k, k + 1))
    mean = (1.0 - t) * low.mu + t * high.mu
    mean = mean / jnp.sqrt((mean * mean).sum(-1, keepdims=True))
    some = across > 1e-6
    c = jnp.where(some, view[0] / jnp.where(some, across, 1.0), 1.0)
    s = jnp.where(some, view[1] / jnp.where(some, across, 1.0), 0.0)
    mu = frames.direction(
        c * mean[:, 0] - s * mean[:, 1], s * mean[:, 0] + c * mean[:, 1], mean[:, 2]
    )
    kappa = jnp.exp((1.0 - t) * jnp.log(low.kappa) + t * jnp.log(high.kappa))
    return mixture.Mixture((1.0 - t) * low.log_share + t * high.log_share, mu, kappa)


def lobe(
    whole: Array, first: Array, otherwise: Array, sharpest: Array
) -> tuple[Array, Array, Array]:
    """Lobes from their moments: integral, axis and concentration.

    Parameters
    ----------
    whole
        Sum of the weights, >= 0, [...].
    first
        Sum of weights times directions, [..., 3].
    otherwise
        Axis where there is nothing, [..., 3].
    sharpest
        Largest concentration, broadcast with [...].
    """
    some = whole > 1e-12
    mean = first / jnp.where(some, whole, 1.0)[..., None]
    square = jnp.where(some, (mean * mean).sum(-1), 0.0)
    far = square > 1e-12
    length = jnp.sqrt(jnp.where(far, square, 1.0))
    mu = jnp.where(far[..., None], mean / length[..., None], otherwise)
    length = jnp.where(far, length, 0.0)
    rest = jnp.clip(1.0 - length, 1.0 / sharpest, 1.0)
    kappa = inverse_langevin(jnp.minimum(length, 1.0 - rest), rest)
    return jnp.where(some, whole, 0.0), mu, jnp.minimum(kappa, sharpest)
