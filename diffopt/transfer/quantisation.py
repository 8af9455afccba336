"""Slices as whole numbers, in steps that follow from one step of amplitude.

Slices are given as `diffopt.transfer.references` has them, relative to unoccluded ones, which are
on every grid used here: where nothing is hidden nothing is lost. A step of amplitude is a share of
the norm in L2 of a mean slice. For a lobe of m such steps and concentration kappa, a difference dl
of the logarithm of kappa is off by ``m dl / sqrt 2`` steps, and an angle d by
``m d sqrt(kappa / 2)`` (from the similarity of two lobes, for kappa well above 1): faint and broad
lobes take few bits. Of a broad lobe the norm is small and the light may not be: no step of a weight
exceeds that share of the weight of a mean slice, either. All steps are powers of two.
"""

import math
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Integer

from diffopt.kernels import octahedral
from diffopt.transfer import slices
from diffopt.transfer.slices import Slices

# Octaves of concentration, from 0, that are told apart.
_OCTAVES = 24
# Bits of a part of an octave, and of half the square, at most: what float32 holds.
_MOST_BITS = 23
# Radians of a unit of the square, between 1 at its middle and sqrt(pi) in the mean.
_SQUARE = 1.5
# Slices worked on at a time.
_CHUNK = 2**15


class Over(NamedTuple):
    """Unoccluded lobes that slices are relative to.

    Attributes
    ----------
    alpha, log_kappa
        Integrals and logarithms of the concentrations of R of them, [R, K, C] and [R, K].
    scale
        Norm of a mean slice, and its weight in the mean over the channels, above 0, [R, 2].
    place
        Which of them each slice is relative to, [S].
    """

    alpha: Float[np.ndarray, "R K C"]
    log_kappa: Float[np.ndarray, "R K"]
    scale: Float[np.ndarray, "R 2"]
    place: Int[np.ndarray, " S"]

    def part(self, rows: slice) -> "Over":
        """Of some slices."""
        return self._replace(place=self.place[rows])


def host(alpha: Any, mu: Any, kappa: Any) -> Slices:
    """Slices of NumPy arrays."""
    return Slices(alpha, mu, kappa)


def means(found: Slices, over: Over, rows: Bool[np.ndarray, " S"]) -> tuple[float, float]:
    """Root-mean-square norm and weight of some of the slices; 1 where there is no light at all."""
    count = len(over.place)
    squares = np.zeros((count, 2))
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        own = _Own.of(over.part(part))
        kappa = np.asarray(found.kappa[part], np.float64) * np.exp(own.log_kappa)
        alpha = np.asarray(found.alpha[part], np.float64) * own.alpha
        squares[part, 0] = ((alpha * _norm(kappa)[..., None]) ** 2).sum((1, 2, 3))
        squares[part, 1] = _whole(alpha) ** 2
    norm, whole = (math.sqrt(v[rows].mean()) if v[rows].any() else 1.0 for v in squares.T)
    return norm, whole


def _whole(alpha: np.ndarray) -> np.ndarray:
    """Weight of slices, in the mean over the channels."""
    return alpha.mean(-1).sum((1, 2))


class _Own(NamedTuple):
    """Of each slice: weights [n, 1, K, C], log kappa [n, 3, K] that is 0 but for direct light."""

    alpha: np.ndarray
    log_kappa: np.ndarray
    scale: np.ndarray
    whole: np.ndarray

    @classmethod
    def of(cls, over: Over) -> "_Own":
        log = over.log_kappa.astype(np.float64)[over.place]
        direct = np.stack([log, np.zeros_like(log), np.zeros_like(log)], 1)
        alpha = over.alpha.astype(np.float64)[over.place][:, None]
        scale = over.scale[over.place][:, None, None]
        return cls(alpha, direct, scale[..., 0], scale[..., 1])


def _norm(kappa: np.ndarray) -> np.ndarray:
    """Of a lobe of unit integral, in L2."""
    safe = np.maximum(kappa, 1e-9)
    return np.sqrt(safe / np.tanh(safe) / (4.0 * math.pi))


def quantised(found: Slices, over: Over, step: float) -> Int[np.ndarray, "S F"]:
    """Whole numbers: of each lobe the channels of the weight, octave and part of an octave of
    the concentration, two coordinates of the axis, [S, 3 K (C + 4)].

    Parameters
    ----------
    found
        [S, 3, K, ...].
    over
        What they are relative to.
    step
        Of amplitude, over the norm of a mean slice.
    """
    count, channels = len(over.place), found.alpha.shape[-1]
    out = np.zeros((count, *found.kappa.shape[1:], channels + 4), np.int32)
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        some, own = host(*(a[part] for a in found)), _Own.of(over.part(part))
        log = np.log2(np.maximum(some.kappa.astype(np.float64), 1e-30))
        octave = np.clip(np.rint(log), -_OCTAVES, _OCTAVES)
        size = _weight_step(own, octave, step)
        weight = np.rint(some.alpha / size)
        strength = _strength(own, weight * size, octave, step)
        within = np.rint(np.clip(log - octave, -0.5, 0.5) / _octave_step(strength))
        half = _half(own, strength, octave)
        u, v = (np.asarray(a, np.float64)[: len(log)] for a in _square(_full(some.mu)))
        at = [np.rint(w * half) for w in (u, v)]
        rest = np.stack([octave, within, *at], -1) * (strength > 0.0)[..., None]
        out[part] = np.concatenate([weight, rest], -1)
    return out.reshape(count, -1)


# Reader and writer must find the same steps: in float64, from numbers that are stored.


def _power(exponent: np.ndarray) -> np.ndarray:
    return np.exp2(np.rint(exponent))


def _weight_step(own: _Own, octave: np.ndarray, step: float) -> np.ndarray:
    """Step of relative weights, [n, 3, K, C]: about one of amplitude."""
    whole = own.alpha * _norm(np.exp2(octave) * np.exp(own.log_kappa))[..., None]
    wide = step * own.scale[..., None] / np.maximum(whole, 1e-12)
    wide = np.minimum(wide, step * own.whole[..., None] / np.maximum(own.alpha, 1e-12))
    # At most 1: the whole weight of the unoccluded lobe stands on the grid.
    return _power(np.clip(np.log2(wide), -_MOST_BITS, 0.0))


def _strength(own: _Own, alpha: np.ndarray, octave: np.ndarray, step: float) -> np.ndarray:
    """Steps of amplitude that lobes have, all channels together."""
    norm = _norm(np.exp2(octave) * np.exp(own.log_kappa))
    return np.sqrt(((alpha * own.alpha) ** 2).sum(-1)) * norm / (step * own.scale)


def _octave_step(strength: np.ndarray) -> np.ndarray:
    """Step of the logarithm of kappa to base 2."""
    wide = math.sqrt(2.0) / math.log(2.0) / np.maximum(strength, 1e-3)
    return _power(np.clip(np.log2(wide), -_MOST_BITS, 1.0))


def _half(own: _Own, strength: np.ndarray, octave: np.ndarray) -> np.ndarray:
    """Steps of the axis on half a side of the square."""
    spread = 0.5 * (octave - 1.0 + own.log_kappa / math.log(2.0))
    bits = np.log2(_SQUARE * np.maximum(strength, 1e-3)) + spread
    return _power(np.clip(bits, 0.0, _MOST_BITS))


def restored(rows: Integer[np.ndarray, "S F"], over: Over, step: float) -> Slices:
    """The slices of whole numbers, in float32; arguments as for `quantised`."""
    lobes, channels = over.alpha.shape[1:]
    shape = (len(rows), 3, lobes)
    out = host(*(np.zeros((*shape, *last), np.float32) for last in ((channels,), (3,), ())))
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        for whole, values in zip(out, _decoded(rows[part], over.part(part), step), strict=True):
            np.asarray(whole)[part] = values
    return out


def _decoded(
    rows: Integer[np.ndarray, "n F"], over: Over, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weights, axes and concentrations, relative as they were."""
    own = _Own.of(over)
    wide = rows.reshape(len(rows), *own.log_kappa.shape[1:], -1).astype(np.float64)
    octave = wide[..., -4]
    alpha = wide[..., :-4] * _weight_step(own, octave, step)
    strength = _strength(own, alpha, octave, step)
    kappa = np.exp2(octave + wide[..., -3] * _octave_step(strength))
    place = wide[..., -2:] / _half(own, strength, octave)[..., None]
    mu = np.asarray(_directions(_full(place.astype(np.float32))))[: len(rows)]
    return alpha.astype(np.float32), mu, kappa.astype(np.float32)


def errors(
    found: Slices, over: Over, rows: Integer[np.ndarray, "S F"], step: float
) -> tuple[Float[np.ndarray, " S"], Float[np.ndarray, " S"]]:
    """Exact distances of slices from their rounded ones, and differences of the weights.

    Over norm and weight of a mean slice.
    """
    count = len(over.place)
    apart, lighter = np.zeros(count), np.zeros(count)
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        some = over.part(part)
        own = _Own.of(some)
        made = host(*_decoded(rows[part], some, step))
        # Axes may stay relative: a rotation of both changes no distance.
        one, other = (
            host(
                _full((s.alpha * own.alpha).astype(np.float32)),
                _full(np.asarray(s.mu, np.float32)),
                _full((s.kappa * np.exp(own.log_kappa)).astype(np.float32)),
            )
            for s in (host(*(a[part] for a in found)), made)
        )
        weights = [_whole(np.asarray(s.alpha, np.float64))[: len(made.kappa)] for s in (one, other)]
        lighter[part] = (weights[1] - weights[0]) / own.whole[:, 0, 0]
        square = np.asarray(_distances(one, other), np.float64)[: len(made.kappa)]
        apart[part] = np.sqrt(np.maximum(square, 0.0)) / own.scale[:, 0, 0]
    return apart, lighter


def _full(values: Any) -> np.ndarray:
    """Padded to a chunk: every chunk is worked on by the same program."""
    short = _CHUNK - len(values)
    return np.concatenate([values, np.zeros((short, *values.shape[1:]), values.dtype)])


@jax.jit
def _square(mu: Array) -> tuple[Array, Array]:
    return octahedral.encode(mu[..., 0], mu[..., 1], mu[..., 2])


@jax.jit
def _directions(place: Array) -> Array:
    return octahedral.decode(place[..., 0], place[..., 1])


@jax.jit
def _distances(one: Slices, other: Slices) -> Array:
    return slices.squared_distance(one, other)
