"""Run lengths and pits of a compact disc, as plain arrays.

Track pitch, velocity, channel bit rate and run lengths are those of IEC 60908 (2nd edition,
1999) and ECMA-130 (2nd edition, 1996): 1.6 um +- 0.1 um, 1.20 to 1.40 m/s, 4.3218 MHz, 3 to 11
channel bits, which are 0.833 to 3.054 um at 1.2 m/s.
"""

import math

import numpy as np

from diffopt.errors import InputError

TRACK_PITCH = 1.6
CHANNEL_BIT_RATE = 4.3218
SHORTEST_RUN, LONGEST_RUN = 3, 11
VELOCITIES = (1.2, 1.4)


def whole_bits(length: float, velocity: float) -> tuple[int, float]:
    """Number of channel bits on a periodic track, and the length of one.

    Parameters
    ----------
    length
        Of the track, micrometres.
    velocity
        Least scanning velocity in m/s; it is raised so that whole bits fit.

    Raises
    ------
    InputError
        If the velocity is outside 1.2 to 1.4 m/s, or would have to be to make bits fit.
    """
    if not VELOCITIES[0] <= velocity <= VELOCITIES[1]:
        raise InputError(f"velocity={velocity}: expected 1.2 to 1.4 m/s")
    bits = math.floor(length * CHANNEL_BIT_RATE / velocity * (1 + 1e-9))
    bit = length / max(bits, 1)
    if bits < 2 * SHORTEST_RUN or bit * CHANNEL_BIT_RATE > VELOCITIES[1] * (1 + 1e-9):
        raise InputError(
            f"a track of {length:.4g} um does not hold whole channel bits at 1.2 to 1.4 m/s and "
            "two runs; expected 3 um or more"
        )
    return bits, bit


def run_lengths(bits: int, draws: np.ndarray) -> list[int]:
    """Alternating lengths of pits and lands, even in number, with the sum ``bits``.

    Drawn with the probabilities of a code of greatest entropy whose runs have 3 to 11 bits
    (root^-n for a run of n, Shannon 1948, theorem 1), conditioned on the sum and on the even
    number: the total weight of all continuations is carried along, so that no draw is in vain.

    Parameters
    ----------
    bits
        Channel bits on the track, at least 6.
    draws
        Uniform numbers in [0, 1), one for each run; ``bits`` of them are enough.
    """
    runs = np.arange(SHORTEST_RUN, LONGEST_RUN + 1)
    weight = growth() ** -runs.astype(np.float64)
    # ways[p, n]: total weight of sequences of sum n whose number is p modulo 2.
    ways = np.zeros((2, bits + 1))
    ways[0, 0] = 1.0
    for n in range(SHORTEST_RUN, bits + 1):
        before = n - runs[runs <= n]
        ways[:, n] = ways[::-1, before] @ weight[: len(before)]
    result, left, parity = [], bits, 0
    while left:
        possible = runs[runs <= left]
        odds = np.cumsum(weight[: len(possible)] * ways[1 - parity, left - possible])
        index = int(np.searchsorted(odds, draws[len(result)] * odds[-1], side="right"))
        run = int(possible[min(index, len(possible) - 1)])
        result.append(run)
        left, parity = left - run, 1 - parity
    return result


def pits(
    along: np.ndarray,
    across: np.ndarray,
    runs: list[int],
    *,
    bit: float,
    start: float,
    width: float,
    wall: float,
) -> np.ndarray:
    """Depth profile of one track, 0 on the lands to 1 in the pits.

    A pit is a line with half circles at its ends, ``width`` wide and its run long at half
    depth; its wall is a smooth step (3 t^2 - 2 t^3).

    Parameters
    ----------
    along
        [ny] positions along the track, micrometres; equally spaced over one period.
    across
        [n] distances from its middle, micrometres.
    runs
        Pit, land, pit, ... in channel bits; they fill the period.
    bit
        Length of a channel bit, micrometres.
    start
        Where the first pit begins, micrometres.
    width, wall
        Micrometres.

    Returns
    -------
    depth
        [ny, n].
    """
    length = sum(runs) * bit
    depth = np.zeros((len(along), len(across)))
    position = start
    for index, run in enumerate(runs):
        if index % 2 == 0:
            centre = position + run * bit / 2
            offset = np.abs((along - centre + length / 2) % length - length / 2)
            beyond = np.maximum(offset - (run * bit - width) / 2, 0.0)
            distance = np.hypot(beyond[:, None], across[None, :])
            t = np.clip((width / 2 + wall / 2 - distance) / wall, 0.0, 1.0)
            # Lands have 3 bits or more, so that the walls of two pits never meet.
            depth += t * t * (3.0 - 2.0 * t)
        position += run * bit
    return depth


def growth() -> float:
    """Root of sum over run lengths of root^-n = 1: 1.4558, a capacity of 0.5418 bits."""
    low, high = 1.0, 2.0
    for _ in range(60):
        middle = (low + high) / 2
        total = sum(middle**-n for n in range(SHORTEST_RUN, LONGEST_RUN + 1))
        low, high = (middle, high) if total > 1 else (low, middle)
    return low
