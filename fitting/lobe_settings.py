"""Settings of a fit of lobes, with their effect on error and on time."""

from dataclasses import dataclass
from typing import Literal

from diffopt.errors import InputError

Start = Literal["scattered", "split"]
Energy = Literal["restored", "fitted"]


@dataclass(frozen=True)
class LobeSettings:
    """How lobes are fitted.

    Attributes
    ----------
    rings, sectors
        Nodes of the quadrature about the mean direction; time grows in proportion. 32 x 48
        hold the L2 norm of lobes up to Blinn-Phong's exponent 128 to 4e-4.
    start
        ``"scattered"``: axes drawn far from each other, by the key. ``"split"``: side by
        side along the widest direction, no chance; a third more error for four lobes.
    em_steps
        Steps of expectation maximisation. Ten bring the lobes apart; a hundred times as many
        do not reach the square error of ten Levenberg-Marquardt steps more.
    coarse_steps
        Levenberg-Marquardt steps on a grid of half the rings and sectors, which follow EM on
        the same: a quarter of the time each. Targets with nodes of their own have no such grid.
    lm_steps
        Levenberg-Marquardt steps of each round on all nodes.
    rounds
        Most rounds: after each, functions that have settled leave the batch, so that none
        waits for the slowest. 1 for a fixed number of steps.
    settled
        Relative fall of the squared error in a round under which a function has settled.
    energy
        ``"restored"``: weights are changed as little as the function allows, so that the
        integral is kept exactly.
        ``"fitted"``: the least squares' own, up to 15 % off for one lobe at grazing angles.
    signed
        Let weights be negative: lower error, but no longer a mixture that can be sampled.
    sharpest
        Largest concentration. Each lobe is also kept to what the nodes about it resolve.
    chunk
        Functions fitted at once; memory grows with it, the result does not change.
    """

    rings: int = 32
    sectors: int = 48
    start: Start = "scattered"
    em_steps: int = 10
    coarse_steps: int = 20
    lm_steps: int = 5
    rounds: int = 1
    settled: float = 1e-2
    energy: Energy = "restored"
    signed: bool = False
    sharpest: float = 1e6
    chunk: int = 32

    def __post_init__(self) -> None:
        least = {"rings": 8, "sectors": 8, "rounds": 1, "chunk": 1}
        least |= dict.fromkeys(("em_steps", "coarse_steps", "lm_steps"), 0)
        for name, lowest in least.items():
            if getattr(self, name) < lowest:
                raise InputError(f"{name} must be >= {lowest}; received {getattr(self, name)}")
        for name, options in (
            ("start", ("scattered", "split")),
            ("energy", ("restored", "fitted")),
        ):
            if getattr(self, name) not in options:
                raise InputError(
                    f"{name} must be one of {', '.join(options)}; received {getattr(self, name)!r}"
                )
        if not 1.0 <= self.sharpest <= 1e12:
            raise InputError(f"sharpest must lie in [1, 1e12]; received {self.sharpest:g}")
        if not 0.0 <= self.settled < 1.0:
            raise InputError(f"settled must lie in [0, 1); received {self.settled:g}")
