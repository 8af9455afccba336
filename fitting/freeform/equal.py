"""Surfaces of equal |P|^2: a translation, and the twin -h(-x, -y)."""

from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Average = Literal["positions", "window"]


class Move(NamedTuple):
    """What takes one surface to another of equal |P|^2: a half turn, then a shift in pixels."""

    twin: bool
    shift: tuple[int, int]

    def __call__(self, field: Float[Array, "ny nx"]) -> Float[Array, "ny nx"]:
        """The field turned and shifted, its sign as it was."""
        return jnp.roll(field[::-1, ::-1] if self.twin else field, self.shift, (0, 1))


def nearest_equal(
    heights: Float[Array, "ny nx"],
    start: Float[Array, "ny nx"],
    average: Average = "positions",
    middle: tuple[float, ...] = (0.0, 0.0),
) -> tuple[Float[Array, "ny nx"], Move]:
    """Of all surfaces with the same |P|^2 the one nearest to the start, and how it is reached.

    Nearest by the sum of squared differences, among the surface and its twin -h(-x, -y), each
    shifted by whole pixels where |P|^2 is averaged over positions, with the mean of the start.

    Parameters
    ----------
    heights, start
        Micrometres.
    average
        As in `fit_heights`.
    middle
        Of a single window, (y, x) in pixels from the middle of the patch. The twin about it
        lies on the grid for multiples of one half only, and is left out otherwise.
    """
    field, wanted = heights - heights.mean(), start - start.mean()
    twice = [2.0 * m if average == "window" else 0.0 for m in middle]
    moves = [Move(False, (0, 0))]
    if all(abs(t - round(t)) < 1e-3 for t in twice):
        # Samples sit at i - n // 2: about the middle m, i -> 2 m + 2 (n // 2) - i.
        turn = [round(t) + 2 * (n // 2) + 1 for t, n in zip(twice, field.shape, strict=True)]
        moves.append(Move(True, (turn[0], turn[1])))
    if average == "positions":
        target = jnp.fft.rfft2(wanted)
        for k, move in enumerate(moves):
            one = jnp.fft.rfft2(_signed(move, field))
            match = jnp.fft.irfft2(target * jnp.conj(one), field.shape)
            down, right = np.unravel_index(int(jnp.argmax(match)), field.shape)
            moves[k] = Move(move.twin, (move.shift[0] + int(down), move.shift[1] + int(right)))
    apart = [float(jnp.sum((_signed(move, field) - wanted) ** 2)) for move in moves]
    best = moves[int(np.argmin(apart))]
    return _signed(best, field) + start.mean(), best


def _signed(move: Move, field: Array) -> Array:
    return -move(field) if move.twin else move(field)
