"""Starts that know only the data: lattices by the grating equation, the rest by a design.

Lines of a grating of vector F = (cos angle, sin angle) / period lie at whole multiples of F in
the plane of frequencies (u, v) / wavelength. The brightest values are lines of some order; their
frequencies, divided by small numbers, and the differences between them are candidates for F. Each
is judged by how much of the data lines at its multiples explain, whatever their powers, and moved
to where that is most. The other parameters are tried on points that fill their ranges evenly
(Halton 1960), for each of the best lattices.
"""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.fitting.reflectance import forward

_ORDERS = 4
_PEAKS = 16
# Wavelengths at which a bright direction of a colour may have its line, as shares of the way.
_HUES = (0.2, 0.45, 0.7)


def frequencies(job: forward.Job) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies [N, 2] at which values stand, and their |P|^2 over its noise, [N].

    A colour stands at several.
    """
    fx, fy = np.asarray(job.fx, np.float64), np.asarray(job.fy, np.float64)
    values = np.asarray(job.values * job.scale, np.float64)
    if job.weights is None:
        return np.stack([fx.ravel(), fy.ravel()], 1), values.ravel()
    columns = [round(share * (fx.shape[1] - 1)) for share in _HUES]
    both = np.stack([fx[:, columns].ravel(), fy[:, columns].ravel()], 1)
    return both, np.repeat(np.linalg.norm(values, axis=1), len(columns))


def peaks(
    job: forward.Job, width: float, count: int = _PEAKS, taken: np.ndarray | None = None
) -> np.ndarray:
    """Frequencies of the brightest values away from the mirror and from each other, [K, 2].

    Where a grating vector is `taken`, also away from its lines.
    """
    at, size = frequencies(job)
    # F and -F are the same lattice.
    at = np.where((at[:, :1] < 0) | ((at[:, :1] == 0) & (at[:, 1:] < 0)), -at, at)
    left = np.hypot(at[:, 0], at[:, 1]) > 2.5 * width
    if taken is not None:
        order = np.rint(at @ taken / (taken @ taken))
        left &= np.hypot(*(at - order[:, None] * taken).T) > 2.0 * width
    found: list[np.ndarray] = []
    while left.any() and len(found) < count:
        best = int(np.argmax(np.where(left, size, -np.inf)))
        found.append(at[best])
        left &= np.hypot(*(at - at[best]).T) > 2.0 * width
    return np.array(found).reshape(-1, 2)


def candidates(found: np.ndarray, shortest: float) -> np.ndarray:
    """Grating vectors that peaks may come from, [C, 2]: their parts and differences."""
    parts = [found / m for m in range(1, _ORDERS + 2)]
    first = found[:8]
    apart = (first[:, None] - first[None, :])[np.triu_indices(len(first), 1)]
    together = np.concatenate([*parts, apart, apart / 2.0])
    long = np.hypot(together[:, 0], together[:, 1]) > shortest
    together = together[long]
    return np.where(together[:, :1] < 0, -together, together)


@eqx.filter_jit
def explained(
    job: forward.Job, vectors: Float[Array, "C 2"], taken: Float[Array, "2"] | None = None
) -> Float[Array, " C"]:
    """Share of the squared data that lines at multiples of a vector explain, each on its own.

    Every order in every band has a power of its own, 0 or more; lines are taken as apart. What
    lies near the mirror, or near lines of a vector that is `taken`, does not count.
    """
    data = job.values * job.scale
    away = job.fx**2 + job.fy**2 > (2.5 * job.sigma_f) ** 2
    if taken is not None:
        order = jnp.round((job.fx * taken[0] + job.fy * taken[1]) / (taken**2).sum())
        off = (job.fx - order * taken[0]) ** 2 + (job.fy - order * taken[1]) ** 2
        away = away & (off > (2.0 * job.sigma_f) ** 2)
    away = away.astype(data.dtype)
    orders = jnp.asarray([m for m in range(-_ORDERS, _ORDERS + 1) if m], data.dtype)

    def one(vector: Array) -> Array:
        def order(m: Array) -> Array:
            square = (job.fx + m * vector[0]) ** 2 + (job.fy + m * vector[1]) ** 2
            line = job.before * away * jnp.exp(-square / job.spread**2)
            if job.weights is not None:
                line = jnp.matmul(line, job.weights, precision="highest")
            line = line * job.scale
            size = (line**2).sum(0)
            match = jnp.maximum((line * data).sum(0), 0.0)
            return (match**2 / jnp.maximum(size, jnp.finfo(size.dtype).tiny * 1e3)).sum()

        return jax.vmap(order)(orders).sum()

    return jax.lax.map(one, vectors, batch_size=8)


def lattices(job: forward.Job, coherence: float, most: int) -> np.ndarray:
    """Grating vectors of the data, best first, [K, 2] in cycles per micrometre."""
    width = 1.0 / (2.0 * math.pi * coherence)
    dtype = job.fx.dtype
    vectors = candidates(peaks(job, width), 0.7 * width)
    if not len(vectors):
        return vectors
    fixed = 8 * math.ceil(len(vectors) / 8)
    padded = np.concatenate([vectors, np.repeat(vectors[-1:], fixed - len(vectors), axis=0)])
    score = np.asarray(explained(job, jnp.asarray(padded, dtype)))[: len(vectors)]
    # Near ties go to the finer lattice: the coarser one has its lines and dark ones between.
    order = np.argsort(-score * np.hypot(*vectors.T) ** 0.05)
    kept: list[int] = []
    for k in order:
        if all(np.hypot(*(vectors[k] - vectors[j])) > 0.5 * width for j in kept):
            kept.append(int(k))
        if len(kept) == most:
            break
    return _moved(job, vectors[kept], width, most)


def _moved(
    job: forward.Job, vectors: np.ndarray, width: float, size: int, taken: Any = None
) -> np.ndarray:
    """Grating vectors where they explain most, best first; `size` of them are worked on."""
    dtype = job.fx.dtype
    vectors = np.concatenate([vectors, np.repeat(vectors[-1:], size - len(vectors), 0)])
    axis = np.linspace(-1.0, 1.0, 5)
    steps = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    for reach in (0.6 * width, 0.2 * width, 0.07 * width):
        around = vectors[:, None] + reach * steps[None]
        score = explained(job, jnp.asarray(around.reshape(-1, 2), dtype), taken)
        score = np.asarray(score).reshape(size, -1)
        vectors = around[np.arange(size), score.argmax(1)]
    best = score.max(1)
    keep: list[int] = []
    for k in np.argsort(-best):
        if all(np.hypot(*(vectors[k] - vectors[j])) > 0.1 * width for j in keep):
            keep.append(int(k))
    return vectors[keep]


def second(job: forward.Job, coherence: float, first: np.ndarray, most: int) -> np.ndarray:
    """Grating vectors of a second grating, given that of the first, [K, 2].

    Its lines, and those that are sums and differences of both, lie apart from the first's.
    """
    width = 1.0 / (2.0 * math.pi * coherence)
    found = peaks(job, width, most, first)
    if not len(found):
        return found
    return _moved(job, found, width, most, jnp.asarray(first, job.fx.dtype))


def halton(count: int, dimensions: int) -> np.ndarray:
    """Points that fill the unit cube evenly, [count, dimensions], none on its faces."""
    primes = (2, 3, 5, 7, 11, 13, 17, 19)
    if dimensions > len(primes):
        raise ValueError(f"at most {len(primes)} dimensions; received {dimensions}")
    out = np.zeros((count, dimensions))
    for axis, base in enumerate(primes[:dimensions]):
        number, share = np.arange(1, count + 1), 1.0 / base
        while number.any():
            out[:, axis] += share * (number % base)
            number, share = number // base, share / base
    return out


def brightest(job: forward.Job, most: int, seed: int = 0) -> np.ndarray:
    """Numbers of some rows: the brightest half of `most`, and others drawn evenly."""
    size = np.linalg.norm(np.asarray(job.values * job.scale), axis=1)
    if len(size) <= most:
        return np.arange(len(size))
    order = np.argsort(-size)
    rest = np.random.default_rng(seed).choice(order[most // 2 :], most - most // 2, replace=False)
    return np.sort(np.concatenate([order[: most // 2], rest]))
