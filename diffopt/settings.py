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
    chunk: int = 2048
    name = "taylor"


@dataclass(frozen=True)
class ChebyshevSettings:
    """The thesis's gather on tables of a Chebyshev expansion in s = w / wavelength.

    Attributes
    ----------
    terms
        Chebyshev polynomials: of the amplitude of each bin under one window, of its power
        when averaged over positions (about 1.3 times as many for the same error, at half
        the work for each). The error falls faster than exponentially beyond half the phase
        that s sweeps (`diffopt.bounds.expansion_argument`); set-up time, memory and run
        time grow in proportion. No term loses accuracy in float32.
    reach
        Fourier bins gathered on either side; run time grows with its square.
    chunk
        Evaluations computed at once; memory grows with it, the result does not change.
    """

    terms: int = 9
    reach: int = 8
    chunk: int = 2048
    name = "chebyshev"


@dataclass(frozen=True)
class LowRankSettings:
    """The thesis's gather on tables of the low-rank expansion, the fewest terms there are.

    Attributes
    ----------
    terms
        Singular functions, as in `ChebyshevSettings`: 0.6 to 0.8 times as many do, and run
        time and memory with them. Set-up makes 1.5 terms + 6 spectra.
    reach
        Fourier bins gathered on either side; run time grows with its square.
    chunk
        Evaluations computed at once; memory grows with it, the result does not change.
    """

    terms: int = 8
    reach: int = 8
    chunk: int = 2048
    name = "lowrank"


@dataclass(frozen=True)
class TableSettings:
    """A table over (u, v, w) that holds the spectral integral, baked once.

    Attributes
    ----------
    step
        Step in u and v, in standard deviations of the finest line at the shortest
        wavelength. The error falls with its power order + 1, memory and baking time grow
        with its inverse square; a lookup takes the same time, but for the caches.
    order
        Degree of the B-spline in u and v: 1, 2 or 3. Higher orders allow coarser steps; a
        lookup reads 4 (order + 1)^2 entries.
    nodes
        Chebyshev points in w at which the table is baked.
    intervals
        Steps of the cubic spline in w that a lookup reads.
    error
        What baking itself may leave out, relative to a mirror's peak: Gaussian tails,
        interpolation between transforms, reflection at the ends.
    """

    step: float = 0.5
    order: int = 3
    nodes: int = 12
    intervals: int = 24
    error: float = 1e-6
    name = "table"


@dataclass(frozen=True)
class FewSettings:
    """A few wavelengths for XYZ, the mirror peak apart; the thesis's fast variant.

    Its error has no bound beforehand (the study ``diffraction.wavelengths`` measures it), so
    that it is only used where asked for.

    Attributes
    ----------
    count
        Wavelengths, 4 or more; time grows in proportion. A line at a fixed direction is
        lambda^2 / (2 pi |u| sigma_s) wide: fewer than two wavelengths a line lose it.
    nodes
        Chebyshev points in w, as in `SeparableSettings`.
    """

    count: int = 11
    nodes: int = 12
    name = "few"


GatherSettings = TaylorSettings | ChebyshevSettings | LowRankSettings
Settings = DirectSettings | SeparableSettings | GatherSettings | TableSettings | FewSettings
