"""From samples on a few shells to a table over all distances, ready for receivers.

The table runs over rows of distance x polar angle x azimuth, in local frames. Its rows: first the
shells inside the sphere, then nodes in sqrt(acos k), k = r / d, from the sphere to infinity: in
this variable what the tangent map makes of a view is smooth, while in k it has a branch point at
the sphere. To make it costs a fraction of a millisecond; a receiver then reads eight entries, and
no matrix is applied to it, whatever the number of shells.
"""

import math
from functools import lru_cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import harmonics, rescaling_matrices
from diffopt.shadows import shells
from diffopt.shadows.sampling import Samples
from diffopt.shadows.settings import ShadowSettings

# Largest k = r / d outside: nearer the sphere, slopes by the distance grow without bound.
NEAREST = 0.9999
# sqrt(acos k) there, and at infinity.
FIRST, LAST = math.sqrt(math.acos(NEAREST)), math.sqrt(0.5 * math.pi)
# k that stands for infinity, and the least for which the square map is evaluated.
_FARTHEST, _SQUARE_FARTHEST = 1e-3, 1.0 / 64.0
# Rows inside the sphere where nothing is sampled there, and the largest k by which the square map
# expands a view.
_EXPANDED = 12
_DEEPEST = 8.0


def row_ratios(settings: ShadowSettings) -> Float[np.ndarray, " r"]:
    """Ratio r / d of the rows from the sphere outwards."""
    return np.cos(np.linspace(FIRST, LAST, settings.radial + 1) ** 2)


def row_squares(radial: int) -> Float[np.ndarray, " r"]:
    """Squares of k of the rows from the sphere outwards, by which their entries are divided.

    Far away all that is seen falls with k^2. Entries without that factor are even there, where a
    line between two of them would hide (or shine) several times too much.
    """
    k = np.cos(np.linspace(FIRST, LAST, radial + 1) ** 2)
    return np.maximum(k, _FARTHEST) ** 2


def radial_weights(settings: ShadowSettings) -> Float[np.ndarray, "r s"]:
    """Share of every shell in every row: Lagrange's polynomials in k."""
    nodes, k = shells.ratios(settings), row_ratios(settings)
    weights = np.ones((len(k), len(nodes)))
    for i, node in enumerate(nodes):
        for j, other in enumerate(nodes):
            if i != j:
                weights[:, i] *= (k - other) / (node - other)
    return weights


def build(samples: Samples, settings: ShadowSettings) -> Float[Array, "r p a C"]:
    """The table, [rows, polar + 2, azimuthal + 1, L^2 x channels].

    Two ghost rows lie beyond the poles and a ghost column after the last azimuth, so that reading
    between nodes never wraps.
    """
    dtype = jnp.result_type(float)
    outer, inner = (jnp.asarray(part, dtype) for part in (samples.outer, samples.inner))
    operators = _operators(settings, dtype.name, samples.nearest >= 1.0, samples.outer.ndim > 4)
    return _build(outer, inner, operators, settings)


class _Operators(NamedTuple):
    """What makes rows of views: made once for settings, and kept.

    Attributes
    ----------
    shares
        Of the shells in every row outside, [r, s].
    outside
        Matrices of those rows, [r, L^2, S^2].
    inside
        Matrices from the view on the sphere to rows inside, or None where these are sampled.
    """

    shares: Array
    outside: Array
    inside: Array | None


@lru_cache(maxsize=32)
def _operators(settings: ShadowSettings, dtype: str, expanded: bool, emits: bool) -> _Operators:
    bands = settings.bands
    k = jnp.asarray(row_ratios(settings), dtype)
    one = jnp.ones(1, dtype)
    if settings.map == "tangent":
        entries = rescaling_matrices.tangent(jnp.maximum(k, _FARTHEST), bands, nodes=32)
        to_sphere = _dense(rescaling_matrices.tangent(one, bands, nodes=32), bands)[0]
    else:
        # Farther than this, what the square map makes of a view falls with k^2 to 3 %.
        close = jnp.maximum(k, _SQUARE_FARTHEST)
        entries = _paper(close, settings, emits) * ((jnp.maximum(k, _FARTHEST) / close) ** 2)[None]
        to_sphere = jnp.eye(bands**2, dtype=dtype)
    inside = None
    if expanded:
        distance = np.arange(1, _EXPANDED) / _EXPANDED
        ratio = jnp.asarray(np.minimum(1.0 / distance, _DEEPEST), dtype)
        inside = _dense(_paper(ratio, settings, emits), bands) @ to_sphere
    entries = entries / jnp.asarray(row_squares(settings.radial), dtype)[None]
    return _Operators(jnp.asarray(radial_weights(settings), dtype), _dense(entries, bands), inside)


def _paper(k: Array, settings: ShadowSettings, emits: bool) -> Array:
    """Entries of the paper's maps, of a view that is empty on the far hemisphere."""
    if settings.map == "sphere rule":
        return rescaling_matrices.sphere_rule(k, settings.bands)
    if emits and settings.source_factor == "paper":
        inverse = rescaling_matrices.square(1.0 / k, settings.bands, nodes=128)
        return rescaling_matrices.transposed(inverse, settings.bands)
    return rescaling_matrices.square(k, settings.bands, source="masked", nodes=64)


def _dense(entries: Array, bands: int) -> Array:
    """Matrices [r, L^2, S^2] of entries [n, r]."""
    return jnp.moveaxis(rescaling_matrices.dense(entries, bands), 2, 0)


@partial(jax.jit, static_argnames="settings")
def _build(outer: Array, inner: Array, operators: _Operators, settings: ShadowSettings) -> Array:
    bands, dtype = settings.bands, outer.dtype
    shape = (-1, bands**2, *outer.shape[2:])
    views = jnp.tensordot(operators.shares, outer, 1)
    rows = jnp.einsum("rij,rjn->rin", operators.outside, views.reshape(*views.shape[:2], -1))
    if operators.inside is not None:
        near = outer[0].reshape(outer.shape[1], -1)
        near = jnp.einsum("rij,jn->rin", operators.inside, near).reshape(shape)
        # At the centre of the sphere all is hidden.
        centre = jnp.zeros_like(near[:1]).at[:, 0].set(math.sqrt(4.0 * math.pi))
        inner = jnp.concatenate([centre, near])
    table = jnp.concatenate([inner, rows.reshape(shape)])
    table = table * jnp.asarray(harmonics.window(bands, settings.window), dtype).reshape(
        (1, -1) + (1,) * (table.ndim - 2)
    )
    table = jnp.moveaxis(_with_ghosts(table, bands), 1, 3)
    return table.reshape(*table.shape[:3], -1)


def _with_ghosts(table: Array, bands: int) -> Array:
    """Rows beyond the poles, and the first azimuth again after the last.

    F(-theta, phi) = F(theta, phi + pi) R_z(pi): beyond a pole stands the opposite column, odd
    orders with the other sign.
    """
    sign = (-1.0) ** harmonics.orders(bands)
    sign = jnp.asarray(sign, table.dtype).reshape((1, -1) + (1,) * (table.ndim - 2))
    beyond = jnp.roll(table, table.shape[3] // 2, 3) * sign
    table = jnp.concatenate([beyond[:, :, :1], table, beyond[:, :, -1:]], 2)
    return jnp.concatenate([table, table[:, :, :, :1]], 3)
