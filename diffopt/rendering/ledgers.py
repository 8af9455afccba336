"""Where the light of paths is kept: its sum, or that of each layer."""

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from diffopt.rendering.effects import BITS, LAYERS, SHADOWS, layer

_SHADOWS = sum(BITS[name] for name in SHADOWS)


@runtime_checkable
class Ledger(Protocol):
    """Takes what paths bring.

    Attributes
    ----------
    shadows
        Whether it wants to know of light that is hidden.
    """

    shadows: bool

    def add(
        self,
        home: Int[np.ndarray, " n"],
        code: Int[np.ndarray, " n"],
        values: Float[np.ndarray, "n C"],
        owner: Int[np.ndarray, " n"],
    ) -> None:
        """Take light.

        Parameters
        ----------
        home
            Rays of the camera that it goes to.
        code
            What it needed, see `effects`.
        values
            The light.
        owner
            Objects on which a shadow falls, -1 for light itself.
        """


class Whole:
    """A `Ledger` that keeps the sum for each ray, [N, C]."""

    shadows = False

    def __init__(self, count: int, channels: int, dtype: Any) -> None:
        self.total = np.zeros((count, channels), dtype)

    def add(self, home: Any, code: Any, values: Any, owner: Any) -> None:
        """See `Ledger`."""
        # Rays of the camera are named once at a time.
        self.total[home] += values


class Layers(Whole):
    """A `Ledger` that keeps the sum, and after it that of each of `effects.LAYERS`.

    Light is that which would arrive unshadowed; what shadows take away is their layer.
    """

    shadows = True

    def __init__(self, count: int, channels: int, dtype: Any) -> None:
        super().__init__(count, channels * (len(LAYERS) + 1), dtype)
        self.channels = channels

    def add(self, home: Any, code: Any, values: Any, owner: Any) -> None:
        """See `Ledger`."""
        parts = self.total.reshape(len(self.total), -1, self.channels)
        hidden = owner >= 0
        parts[home, layer(code) + 1] += values
        parts[home[hidden], layer(code[hidden] & ~_SHADOWS) + 1] -= values[hidden]
        parts[home[~hidden], 0] += values[~hidden]
