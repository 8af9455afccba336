"""Environments averaged over lobes: from maps and from sums of lobes to a `Pyramid`.

Maps are in longitude and latitude, every pixel a point with the weight of its solid angle. Broad
levels are made by spherical harmonics, at the same cost for any map; sharper ones as sums over the
pixels in the rows within reach of each texel. Both are linear in the pixels, and differentiable.
"""

import functools
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import harmonics, lobe_harmonics, octahedral, vmf_pairs
from diffopt.transfer.pyramid import Pyramid, PyramidSettings

Levels = tuple[tuple[float, ...], tuple[int, ...]]

# Levels up to this concentration by spherical harmonics: at 24 bands 1e-8 of a lobe is missing.
_BROAD, _BANDS = 16.0, 24
# Sharper ones over the pixels around: where the density is below exp(-16) = 1e-7 of its peak they
# are left out.
_REACH = 16.0
# Texels times pixels at once.
_BLOCK = 1 << 22
# Pixels are summed two by two first while that spreads a lobe by 3/16 of this of its variance at
# most (and lowers the peak of a small source by as much).
_SPREAD = 0.08
# Texels times lobes at once.
_PAIRS = 1 << 18


def from_lobes(
    alpha: Float[Array, "K C"],
    mu: Float[Array, "K 3"],
    kappa: Float[Array, " K"],
    settings: PyramidSettings,
) -> Pyramid:
    """Pyramid of an environment that is a sum of lobes, exact at the texels."""
    levels, parts = settings.levels(), []
    for sharp, side in zip(*levels, strict=True):
        towards = jnp.asarray(octahedral.texels(side).reshape(-1, 3), mu.dtype)
        parts.append(_of_lobes(alpha, mu, kappa, towards, jnp.asarray(sharp, mu.dtype)))
    return _assembled(parts, levels, jnp.eye(3, dtype=mu.dtype))


@eqx.filter_jit
def _of_lobes(alpha: Array, mu: Array, kappa: Array, towards: Array, sharp: Array) -> Array:
    def one(axis: Array) -> Array:
        inner = vmf_pairs.log_inner(axis[None], sharp[None], mu, kappa)
        return jnp.matmul(jnp.exp(inner), alpha, precision="highest")

    return jax.lax.map(one, towards, batch_size=max(1, _PAIRS // max(len(kappa), 1)))


def _assembled(parts: list[Array], levels: Levels, frame: Array) -> Pyramid:
    """With borders, one level after the other."""
    kappas, sides = levels
    rows = [
        part[octahedral.bordered(side).ravel()] for part, side in zip(parts, sides, strict=True)
    ]
    return Pyramid(jnp.concatenate(rows), frame, kappas, sides)


def from_map(
    pixels: Float[Array, "H W C"], frame: Float[Array, "3 3"], settings: PyramidSettings
) -> Pyramid:
    """Pyramid of a map in longitude and latitude.

    Every pixel is a point with the weight of its solid angle; averages are divided by the sum of
    their weights, so that a constant stays what it is.

    Parameters
    ----------
    pixels
        First row at the zenith, columns from the azimuth of x by way of y.
    frame
        Rows: the world's directions of the map's x, y and zenith.
    """
    height, width, _ = pixels.shape
    levels = settings.levels((height / math.pi) ** 2)
    weights = band_weights(height)[:, None, None]
    ones = jnp.ones((height, width, 1), pixels.dtype)
    weighted = jnp.concatenate([pixels, ones], -1) * jnp.asarray(weights, pixels.dtype)
    coefficients = project(weighted, _BANDS)
    parts = []
    for kappa, side in zip(*levels, strict=True):
        if kappa <= _BROAD:
            values = jnp.asarray(_values(side), pixels.dtype)
            found = _broad(coefficients, values, jnp.asarray(kappa, pixels.dtype))
        else:
            found = _sharp(_reduced(weighted, kappa), kappa, side)
        parts.append(found[:, :-1] / found[:, -1:])
    return _assembled(parts, levels, frame)


@eqx.filter_jit
def _broad(coefficients: Array, values: Array, kappa: Array) -> Array:
    shares = lobe_harmonics.ratios(kappa, _BANDS)[harmonics.degrees(_BANDS)]
    return jnp.matmul(values.T, coefficients * shares[:, None], precision="highest")


def band_weights(height: int) -> Float[np.ndarray, " H"]:
    """Solid angles of the rows of a map over those of the sphere, of sum 1."""
    edges = np.linspace(0.0, np.pi, height + 1)
    return 0.5 * (np.cos(edges[:-1]) - np.cos(edges[1:]))


def fejer_weights(height: int) -> Float[np.ndarray, " H"]:
    """Weights of the rows of a map, of sum 1, that integrate H bands exactly (Fejer's first rule).

    For maps that are samples of a smooth function: solid angles of pixels are second order only.
    """
    theta = (np.arange(height) + 0.5) * (np.pi / height)
    j = np.arange(1, height // 2 + 1)
    # The last term of an even rule counts as a whole, since theta_i are midpoints.
    terms = np.cos(2.0 * theta[:, None] * j) / (4.0 * j * j - 1.0)
    return (1.0 - 2.0 * terms.sum(1)) / height


@functools.lru_cache(maxsize=8)
def _values(side: int) -> np.ndarray:
    return harmonics.numpy_basis(octahedral.texels(side).reshape(-1, 3), _BANDS)


def project(weighted: Float[Array, "H W C"], bands: int) -> Float[Array, "L2 C"]:
    """Sums over pixels times harmonics: first over the azimuth, then over the polar angle."""
    height, width, _ = weighted.shape
    theta = (np.arange(height) + 0.5) * (np.pi / height)
    meridian = np.stack([np.sin(theta), 0.0 * theta, np.cos(theta)], -1)
    values = harmonics.numpy_basis(meridian, bands)
    degree, order = harmonics.degrees(bands), harmonics.orders(bands)
    # On the meridian of x only orders >= 0 are not 0, and have their largest value.
    largest: np.ndarray = degree * degree + degree + np.abs(order)
    polar = jnp.asarray(values[largest], weighted.dtype)
    phi = (np.arange(width) + 0.5) * (2.0 * np.pi / width)
    turns = np.arange(1 - bands, bands)[:, None] * phi
    around = np.where(turns < 0.0, -np.sin(turns), np.cos(turns))
    columns = jnp.einsum(
        "mj,ijc->mic", jnp.asarray(around, weighted.dtype), weighted, precision="highest"
    )
    rows = columns[order + bands - 1]
    return jnp.einsum("li,lic->lc", polar, rows, precision="highest")


@eqx.filter_jit
def _reduced(weighted: Array, kappa: float) -> Array:
    """Pixels summed two by two, as often as a concentration allows."""
    height, width, _ = weighted.shape
    coarser = 2.0 * max(math.pi / height, 2.0 * math.pi / width)
    if height % 2 or width % 4 or kappa * coarser**2 > _SPREAD:
        return weighted
    return _reduced(_halved(weighted), kappa)


def _halved(weighted: Array) -> Array:
    """Pixels shared between the nearest two of half as many, rows and columns.

    By shares of 3/4 and 1/4, so that their centre stays; what goes over a pole lands on the
    opposite azimuth.
    """
    height, width, _ = weighted.shape
    ends = jnp.roll(weighted[:1], width // 2, 1), jnp.roll(weighted[-1:], width // 2, 1)
    rows = jnp.concatenate([ends[0], weighted, ends[1]])
    rows = 0.25 * (rows[:height:2] + rows[3::2]) + 0.75 * (rows[1:-1:2] + rows[2::2])
    outer = jnp.roll(rows, 1, 1)[:, ::2] + jnp.roll(rows, -1, 1)[:, 1::2]
    return 0.25 * outer + 0.75 * (rows[:, ::2] + rows[:, 1::2])


def _sharp(weighted: Array, kappa: float, side: int) -> Array:
    """Sums over the pixels within reach of the texels, [side^2, C]."""
    height, width, _ = weighted.shape
    at = octahedral.texels(side).reshape(-1, 3)
    order = np.argsort(-at[:, 2], kind="stable")
    theta = np.arccos(np.clip(at[order, 2], -1.0, 1.0))
    # Texels of like polar angle share the rows of pixels that they reach.
    reach = 2.0 * math.asin(math.sqrt(min(0.5 * _REACH / kappa, 1.0)))
    some = max(1, min(64, _BLOCK // (height * width)))
    blocks = -(-len(at) // some)
    places = np.minimum(np.arange(blocks * some), len(at) - 1)
    low, high = theta[places[::some]], theta[places[some - 1 :: some]]
    first = np.clip(np.floor((low - reach) * height / np.pi), 0, height - 1).astype(int)
    last = np.clip(np.ceil((high + reach) * height / np.pi), 1, height).astype(int)
    rows = int((last - first).max())
    first = np.minimum(first, height - rows)
    towards = at[order[places]].reshape(blocks, some, 3)
    found: Array = _gathered(
        weighted,
        jnp.asarray(pixel_directions(height, width), weighted.dtype),
        jnp.asarray(towards, weighted.dtype),
        jnp.asarray(first, jnp.int32),
        kappa,
        rows,
    )
    return found[np.argsort(order)]


def pixel_directions(height: int, width: int) -> Float[np.ndarray, "H W 3"]:
    """Centres of the pixels of a map, in its own frame."""
    theta = ((np.arange(height) + 0.5) * (np.pi / height))[:, None]
    phi = (np.arange(width) + 0.5) * (2.0 * np.pi / width)
    x, y = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi)
    return np.stack([x, y, np.broadcast_to(np.cos(theta), x.shape)], -1)


@eqx.filter_jit
def _gathered(
    weighted: Array, directions: Array, towards: Array, first: Array, kappa: float, rows: int
) -> Array:
    channels = weighted.shape[-1]

    # Its weights are not kept for the slope: they are larger than all else by far.
    @jax.checkpoint
    def block(part: tuple[Array, Array]) -> Array:
        axes, start = part
        near = jax.lax.dynamic_slice_in_dim(weighted, start, rows).reshape(-1, channels)
        there = jax.lax.dynamic_slice_in_dim(directions, start, rows).reshape(-1, 3)
        cosines = jnp.matmul(axes, there.T, precision="highest")
        return jnp.matmul(jnp.exp(kappa * (cosines - 1.0)), near, precision="highest")

    return jax.lax.map(block, (towards, first)).reshape(-1, channels)
