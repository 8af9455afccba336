"""Slices in few bytes, within a stated error: quantised, and stored once where they agree.

Slices of different vertices that round to the same numbers, at the same view, are stored once
(`diffopt.transfer.quantisation`): where nothing is hidden, all are.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Int, Integer

from diffopt.errors import InputError
from diffopt.transfer import quantisation
from diffopt.transfer.quantisation import Over, host
from diffopt.transfer.slices import Slices
from diffopt.transfer.zarrays import narrow

# Steps for each tolerance at most: no slice is far off, however many are exact.
_MOST_STEP = 2.0
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
    even
        Root-mean-square error of the radiance under even light, over that of a mean slice.
    """

    rms: float
    percentile_99: float
    largest: float
    even: float


class Packed(NamedTuple):
    """Quantised slices.

    Attributes
    ----------
    rows
        Whole numbers of different slices: of each lobe the channels of the weight, octave and
        part of an octave of the concentration, two coordinates of the axis, [U, 3 K (C + 4)].
    places
        For every slice 0 where it is the next of `rows`, else 1 + its place among the rows that
        begin with its group, [S]; None where `rows` has all slices.
    step
        Of the amplitude.
    """

    rows: Integer[np.ndarray, "U F"]
    places: Integer[np.ndarray, " S"] | None
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
        return Packed(np.zeros((0, fields), np.int8), None, 1.0), CompressionError(
            0.0, 0.0, 0.0, 0.0
        )
    some = np.unique(np.linspace(0, count - 1, min(count, _SAMPLE)).astype(np.int64))
    sample, own = host(*(a[some] for a in found)), over._replace(place=over.place[some])
    aim, most = _AIM * settings.tolerance, _MOST_STEP * settings.tolerance
    step = settings.tolerance
    for _ in range(4):
        error = _rms(
            quantisation.errors(sample, own, quantisation.quantised(sample, own, step), step)[0]
        )
        step = min(step * min(max(aim / max(error, 1e-9), 0.25), 4.0), most)
        if 0.97 * aim <= error <= aim:
            break
    while True:
        rows = quantisation.quantised(found, over, step)
        errors, lighter = quantisation.errors(found, over, rows, step)
        error = _rms(errors)
        if error <= settings.tolerance:
            break
        step *= min(aim / error, 0.95)
    made = CompressionError(
        error, float(np.quantile(errors, 0.99)), float(errors.max()), _rms(lighter)
    )
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
    return quantisation.restored(rows, over, stored.step)


def _rms(errors: np.ndarray) -> float:
    return math.sqrt((errors**2).mean())


def _shared(
    rows: Integer[np.ndarray, "S F"], groups: Int[np.ndarray, " n"]
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
    if stored.places is None:
        rows = stored.rows
        if len(rows) != count:
            raise InputError(f"expected {count} rows of slices; received {len(rows)}")
        return rows
    index = stored.places.astype(np.int64)
    new = index == 0
    seen = np.cumsum(new)
    start = np.cumsum(groups) - groups
    before = np.concatenate([[0], seen])[start]
    place = np.where(new, seen - 1, np.repeat(before, groups) + index - 1)
    if len(index) != count or (count and (seen[-1] != len(stored.rows) or (place >= seen).any())):
        raise InputError("indices of slices and their rows do not belong together")
    return stored.rows[place]
