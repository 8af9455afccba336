"""Study of the expansions of exp(i k w h): Taylor, Chebyshev, low rank."""

import functools
import math

import numpy as np

from diffopt.accuracy.jobs import SHORTEST, hard_and_random, stack_job, truth, wave_vectors
from diffopt.accuracy.studies import Case, Study
from diffopt.kernels import expansions, phase
from diffopt.settings import (
    ChebyshevSettings,
    GatherSettings,
    LowRankSettings,
    TaylorSettings,
)

_METHODS = ("taylor", "taylor centred", "chebyshev", "lowrank")


def _gather(method: str, terms: int) -> GatherSettings:
    if method.startswith("taylor"):
        return TaylorSettings(terms=terms, reach=6, centred=method != "taylor")
    kind = ChebyshevSettings if method == "chebyshev" else LowRankSettings
    return kind(terms=terms, reach=6)


def _expansion(quick: bool) -> list[Case]:
    pixel, sigma, n = 0.1, 1.6, 64  # 4 sigma_s a side: 6 bins leave less than 1e-20 out
    wave = wave_vectors(31)
    # Rounding of Taylor terms hangs on the very argument: a few wavelengths find a bad one.
    wavelengths = np.linspace(SHORTEST, 1.05 * SHORTEST, 8)
    ranges = (1.0, 30.0) if quick else (1.0, 1.5 * math.pi, 10.0, 30.0, 100.0, 300.0)
    ladder = (6, 16) if quick else (4, 8, 16, 32, 48, 64, 100)
    s = np.outer(wave[:, 2], 1.0 / wavelengths)

    @functools.cache
    def expected(x):
        return truth(hard_and_random(x, n), pixel, sigma, "window", wave, wavelengths)

    def truncation(method, x, terms):
        if method.startswith("taylor"):
            return phase.taylor_bound(x if method == "taylor" else 0.5 * x, terms)
        # The mirror direction at the shortest wavelength is the phase range.
        z = 0.25 * x * float(np.ptp(s)) / float(np.abs(s).max())
        bound = phase.chebyshev_bound if method == "chebyshev" else expansions.lowrank_bound
        return bound(z, terms)

    def case(x, method, dtype, terms):
        return Case(
            {"phase_range": round(x, 3), "method": method, "dtype": dtype, "terms": terms},
            dtype,
            lambda: stack_job(
                hard_and_random(x, n),
                pixel,
                sigma,
                "window",
                wave,
                _gather(method, terms),
                dtype,
                wavelengths=wavelengths,
                reference=expected(x),
                names=("binary", "random"),
            ),
            (method, dtype, terms),
        )

    def counts(method, dtype, x):
        # From where the terms begin to fall to where rounding is left alone.
        useful = [t for t in ladder if truncation(method, x, t) < 1.0]
        least = 1e-8 if dtype == "float32" else 1e-12
        exact = [t for t in useful if truncation(method, x, t) < least]
        return [t for t in useful if t <= min(exact, default=ladder[-1])]

    return [
        case(x, method, dtype, terms)
        for x in ranges
        for method in _METHODS
        for dtype in (("float32",) if quick else ("float32", "float64"))
        for terms in counts(method, dtype, x)
    ]


EXPANSION = Study(
    name="diffraction.expansion",
    quantity="terms of an expansion of exp(i k w h), largest error of |P|^2 relative to a "
    "mirror's peak; time with the tables",
    reference="the direct sum in float64",
    cases=_expansion,
    conditions=("phase_range",),
    against="terms",
)
