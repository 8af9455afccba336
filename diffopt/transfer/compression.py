"""Slices in few bytes, within a stated error: quantised, and stored once where they agree.

Slices are given as `diffopt.transfer.references` has them, relative to unoccluded ones, which are
on every grid used here: where nothing is hidden nothing is lost. Steps follow from one step of
amplitude, the norm of a lobe in L2 over that of a mean slice. For a lobe of m such steps and
concentration kappa, a difference dl of the logarithm of kappa is off by ``m dl / sqrt 2`` steps,
and an angle d by ``m d sqrt(kappa / 2)`` (from the similarity of two lobes, for kappa well above
1): faint and broad lobes take few bits. All steps are powers of two.

Slices of different vertices that are then the same, at the same view, are stored once: where
nothing is hidden, all are.
"""

import dataclasses
import math
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffopt.errors import InputError
from diffopt.kernels import octahedral
from diffopt.transfer import slices
from diffopt.transfer.slices import Slices
from diffopt.transfer.zarrays import narrow

# Octaves of concentration, from 0, that are told apart.
_OCTAVES = 24
# Bits of a part of an octave, and of half the square, at most: what float32 holds.
_MOST_BITS = 23
# Radians of a unit of the square, between 1 at its middle and sqrt(pi) in the mean.
_SQUARE = 1.5
# Steps for each tolerance at most: no slice is far off, however many are exact.
_MOST_STEP = 2.0
# Slices worked on at a time.
_CHUNK = 2**15
# Slices of which the step is found, at least where there are as many.
_SAMPLE = 2**17
# Share of the tolerance that is aimed at: of a sample the error is known to about a percent.
_AIM = 0.98


@dataclasses.dataclass(frozen=True)
class CompressionSettings:
    """How slices are stored.

    Parameters
    ----------
    tolerance
        Root-mean-square error in L2 over all slices, over the root-mean-square norm of the
        slices of the same material, 1e-4 to 0.5; 0 for none: as they were computed. Twice the
        tolerance takes up to four bits less a lobe.
    shared
        Whether slices that agree within the tolerance are stored once.
    """

    tolerance: float | int = 0.01
    shared: bool = True

    def __post_init__(self) -> None:
        """Check the range."""
        value = self.tolerance
        if not (value == 0 or 1e-4 <= value <= 0.5):
            raise InputError(f"tolerance must be 0 or from 1e-4 to 0.5; received {value:g}")


@dataclasses.dataclass(frozen=True)
class CompressionError:
    """Distances of stored slices from those computed, over the norm of a mean slice.

    Attributes
    ----------
    rms, percentile_99, largest
        Root of the mean square; 99 of 100 slices are off by less; of the worst slice.
    """

    rms: float
    percentile_99: float
    largest: float


class Over(NamedTuple):
    """Unoccluded lobes that slices are relative to.

    Attributes
    ----------
    alpha, log_kappa
        Integrals and logarithms of the concentrations of R of them, [R, K, C] and [R, K].
    scale
        Norm of a mean slice, above 0, [R].
    place
        Which of them each slice is relative to, [S].
    """

    alpha: Float[np.ndarray, "R K C"]
    log_kappa: Float[np.ndarray, "R K"]
    scale: Float[np.ndarray, " R"]
    place: Int[np.ndarray, " S"]

    def part(self, rows: slice) -> "Over":
        """Of some slices."""
        return self._replace(place=self.place[rows])


class Packed(NamedTuple):
    """Quantised slices.

    Attributes
    ----------
    rows
        Whole numbers of different slices: of each lobe the channels of the weight, octave and
        part of an octave of the concentration, two coordinates of the axis, [U, 3 K (C + 4)].
    index
        For every slice 0 where it is the next of `rows`, else 1 + its place among the rows that
        begin with its group, [S]; None where `rows` has all slices.
    step
        Of the amplitude.
    """

    rows: Int[np.ndarray, "U F"]
    index: Int[np.ndarray, " S"] | None
    step: float


def packed(
    found: Slices, over: Over, groups: Int[np.ndarray, " n"], settings: CompressionSettings
) -> tuple[Packed, CompressionError]:
    """Slices within a tolerance.

    Parameters
    ----------
    found
        [S, 3, K, ...].
    over
        What they are relative to.
    groups
        Lengths of runs of slices within which equal ones are looked for: those of a view.
    settings
        With a tolerance above 0.

    Returns
    -------
    tuple
        What is stored, and the error of all slices by the exact distance, at most the
        tolerance in root mean square.
    """
    count = len(over.place)
    if not count:
        fields = math.prod(found.kappa.shape[1:]) * (found.alpha.shape[-1] + 4)
        return Packed(np.zeros((0, fields), np.int8), None, 1.0), CompressionError(0.0, 0.0, 0.0)
    some = np.unique(np.linspace(0, count - 1, min(count, _SAMPLE)).astype(np.int64))
    sample, own = Slices(*(a[some] for a in found)), over._replace(place=over.place[some])
    aim, most = _AIM * settings.tolerance, _MOST_STEP * settings.tolerance
    step = settings.tolerance
    for _ in range(4):
        error = _rms(_errors(sample, own, _quantised(sample, own, step), step))
        step = min(step * min(max(aim / max(error, 1e-9), 0.25), 4.0), most)
        if 0.97 * aim <= error <= aim:
            break
    while True:
        rows = _quantised(found, over, step)
        errors = _errors(found, over, rows, step)
        error = _rms(errors)
        if error <= settings.tolerance:
            break
        step *= min(aim / error, 0.95)
    made = CompressionError(error, float(np.quantile(errors, 0.99)), float(errors.max()))
    index = None
    if settings.shared:
        rows, index = _shared(rows, groups)
        index = narrow(index)
    return Packed(narrow(rows), index, step), made


def unpacked(stored: Packed, over: Over, groups: Int[np.ndarray, " n"]) -> Slices:
    """The slices that `packed` stored, in float32; arguments as there.

    Raises
    ------
    InputError
        If the rows and indices do not belong together.
    """
    rows = _spread(stored, groups, len(over.place))
    lobes, channels = over.alpha.shape[1:]
    expected = 3 * lobes * (channels + 4)
    if rows.shape[1:] != (expected,):
        raise InputError(f"rows of slices must be {expected} wide; received {rows.shape}")
    shape = (len(rows), 3, lobes, channels)
    out = Slices(
        np.zeros(shape, np.float32),
        np.zeros((*shape[:3], 3), np.float32),
        np.zeros(shape[:3], np.float32),
    )
    for start in range(0, len(rows), _CHUNK):
        part = slice(start, start + _CHUNK)
        for whole, values in zip(
            out, _decoded(rows[part], over.part(part), stored.step), strict=True
        ):
            whole[part] = values
    return out


def mean_norm(found: Slices, over: Over, rows: Bool[np.ndarray, " S"] | None = None) -> float:
    """Root-mean-square norm of slices, those of `rows`; 1 where there is no light at all."""
    count = len(over.place)
    squares = np.zeros(count)
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        own = _Own.of(over.part(part))
        kappa = np.asarray(found.kappa[part], np.float64) * np.exp(own.log_kappa)
        alpha = found.alpha[part] * own.alpha * _norm(kappa)[..., None]
        squares[part] = (alpha**2).sum((1, 2, 3))
    squares = squares if rows is None else squares[rows]
    return math.sqrt(squares.mean()) if squares.any() else 1.0


class _Own(NamedTuple):
    """Of each slice: weights [n, 1, K, C], log kappa [n, 3, K] that is 0 but for direct light."""

    alpha: np.ndarray
    log_kappa: np.ndarray
    scale: np.ndarray

    @classmethod
    def of(cls, over: Over) -> "_Own":
        log = over.log_kappa.astype(np.float64)[over.place]
        direct = np.stack([log, np.zeros_like(log), np.zeros_like(log)], 1)
        alpha = over.alpha.astype(np.float64)[over.place][:, None]
        return cls(alpha, direct, over.scale[over.place][:, None, None])


def _norm(kappa: np.ndarray) -> np.ndarray:
    """Of a lobe of unit integral, in L2."""
    safe = np.maximum(kappa, 1e-9)
    return np.sqrt(safe / np.tanh(safe) / (4.0 * math.pi))


def _quantised(found: Slices, over: Over, step: float) -> Int[np.ndarray, "S F"]:
    count, channels = len(over.place), found.alpha.shape[-1]
    out = np.zeros((count, *found.kappa.shape[1:], channels + 4), np.int32)
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        some, own = Slices(*(a[part] for a in found)), _Own.of(over.part(part))
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
    return _power(np.clip(np.log2(wide), -_MOST_BITS, _MOST_BITS))


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


def _decoded(
    rows: Int[np.ndarray, "n F"], over: Over, step: float
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


def _errors(
    found: Slices, over: Over, rows: Int[np.ndarray, "S F"], step: float
) -> Float[np.ndarray, " S"]:
    """Exact distance of each slice from its rounded one, over the scale."""
    count = len(over.place)
    out = np.zeros(count)
    for start in range(0, count, _CHUNK):
        part = slice(start, start + _CHUNK)
        some = over.part(part)
        own = _Own.of(some)
        made = Slices(*_decoded(rows[part], some, step))
        # Axes may stay relative: a rotation of both changes no distance.
        one, other = (
            Slices(
                _full((s.alpha * own.alpha).astype(np.float32)),
                _full(np.asarray(s.mu, np.float32)),
                _full((s.kappa * np.exp(own.log_kappa)).astype(np.float32)),
            )
            for s in (Slices(*(a[part] for a in found)), made)
        )
        square = np.asarray(_distances(one, other), np.float64)[: len(made.kappa)]
        out[part] = np.sqrt(np.maximum(square, 0.0)) / own.scale[:, 0, 0]
    return out


def _rms(errors: np.ndarray) -> float:
    return math.sqrt((errors**2).mean())


def _shared(
    rows: Int[np.ndarray, "S F"], groups: Int[np.ndarray, " n"]
) -> tuple[np.ndarray, np.ndarray]:
    """Different rows of each group in the order in which they come, and the indices."""
    index = np.zeros(len(rows), np.int64)
    kept, start = [], 0
    for length in groups.tolist():
        own = rows[start : start + length]
        _, first, number = np.unique(own, axis=0, return_index=True, return_inverse=True)
        rank = np.empty(len(first), np.int64)
        rank[np.argsort(first)] = np.arange(len(first))
        place = rank[number.reshape(-1)] + 1
        place[first] = 0
        index[start : start + length] = place
        kept.append(own[np.sort(first)])
        start += length
    return np.concatenate(kept), index


def _spread(stored: Packed, groups: Int[np.ndarray, " n"], count: int) -> np.ndarray:
    """The row of every slice."""
    if stored.index is None:
        rows = stored.rows
        if len(rows) != count:
            raise InputError(f"expected {count} rows of slices; received {len(rows)}")
        return rows
    index = stored.index.astype(np.int64)
    new = index == 0
    seen = np.cumsum(new)
    start = np.cumsum(groups) - groups
    before = np.concatenate([[0], seen])[start]
    place = np.where(new, seen - 1, np.repeat(before, groups) + index - 1)
    if len(index) != count or (count and (seen[-1] != len(stored.rows) or (place >= seen).any())):
        raise InputError("indices of slices and their rows do not belong together")
    return stored.rows[place]


def _full(values: np.ndarray) -> np.ndarray:
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
