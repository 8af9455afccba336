"""Settings of the methods, with their effect on error and on time."""

from dataclasses import dataclass


@dataclass(frozen=True)
class DirectSettings:
    """The direct windowed sum: the reference.

    Attributes
    ----------
    chunk
        Evaluations (pair, wavelength) computed at once. Memory grows with it, the result
        does not change; 1 is fastest on CPUs from 256x256 heights on. None: as many as
        keep 65,536 samples in flight.
    """

    chunk: int | None = None
    name = "direct"


@dataclass(frozen=True)
class SeparableSettings:
    """Matrix products at Chebyshev points in w, interpolated.

    Attributes
    ----------
    nodes
        Chebyshev points for each wavelength; the error falls faster than exponentially
        beyond half the phase that w sweeps, time grows in proportion.
    chunk
        Pairs in one matrix product; memory grows with it, the result does not change.
    """

    nodes: int = 12
    chunk: int = 1024
    name = "separable"


@dataclass(frozen=True)
class TaylorSettings:
    """The thesis's Taylor tables with a Gaussian gather.

    Attributes
    ----------
    terms
        Powers of the height; set-up time, memory and run time grow in proportion.
    reach
        Fourier bins gathered on either side; run time grows with its square.
    centred
        Measure heights from mid-range: half the phase range, fewer terms. The thesis
        measures them from the minimum (False).
    chunk
        Evaluations computed at once; memory grows with it, the result does not change.
    """

    terms: int = 25
    reach: int = 8
    centred: bool = False
    chunk: int = 64
    name = "taylor"


Settings = DirectSettings | SeparableSettings | TaylorSettings
