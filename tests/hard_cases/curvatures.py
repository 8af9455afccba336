"""Second derivatives at limits, joins of series and poles, against 50 digits.

No fit here differentiates a kernel twice (Levenberg and Marquardt's method, BFGS and the
uncertainties take products of first derivatives); who puts the kernels under a Newton step or a
Laplace approximation does. A row holds kernels of the same arguments: one program gives their
second derivatives at all places and along all ways, the references are central differences in
100 digits.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import jax.numpy as jnp
import mpmath
import numpy as np

from diffopt.kernels import (
    fresnel,
    langevin,
    lobe_harmonics,
    phase,
    special,
    vmf,
    vmf_pairs,
    vmf_sampling,
)

DIGITS = mpmath.MPContext()
DIGITS.dps = 100
# Of a place: the third difference is 1e-20 of the second, rounding 1e-60.
STEP = DIGITS.mpf("1e-20")
PI = DIGITS.pi


@dataclass(frozen=True)
class Curved:
    """Kernels whose second derivatives are looked at.

    Attributes
    ----------
    kernels
        Names, one for each output.
    call
        From a vector of arguments to the vector of outputs.
    places
        Arguments, one tuple each.
    exact
        The same in 100 digits, from `DIGITS.mpf` to a list.
    ulps
        Allowed error, in the dtype's eps times the largest of the derivative, of those along
        each argument that moves, and of the kernel's output over the square of the argument (at
        least 1): what rounding of the output alone makes.
    """

    kernels: tuple[str, ...]
    label: str
    call: Callable
    places: tuple[tuple[float, ...], ...]
    exact: Callable
    ulps: float = 64.0


def _log_sinhc(k):
    return DIGITS.log(DIGITS.sinh(k) / k) if k else DIGITS.mpf(0)


def _log_sinhc_root(square):
    """An even function of the root, which may be imaginary."""
    return DIGITS.re(_log_sinhc(DIGITS.sqrt(square)))


def _mean(k):
    return DIGITS.coth(k) - 1 / k if k else DIGITS.mpf(0)


def _slope(k):
    return 1 / k**2 - 1 / DIGITS.sinh(k) ** 2 if k else DIGITS.mpf(1) / 3


def _k_coth(k):
    return k * DIGITS.coth(k) if k else DIGITS.mpf(1)


def _inverse(value):
    k = value * (3 - value**2) / (1 - value**2)
    for _ in range(10):
        if abs(k) < DIGITS.mpf("1e-15"):
            return 3 * value + 9 * value**3 / 5  # the next term is 1e-75
        k = k - (_mean(k) - value) / _slope(k)
    return k


CONCENTRATION_LIST = (
    *(0.0, 1e-12, 1e-3, 0.5, 1 - 2.0**-24, 1.0, 1 + 2.0**-23, 2.0),
    *(12.0, 44.0, 89.0, 710.0, 1e5, 1e8),
)
CONCENTRATIONS = tuple((k,) for k in CONCENTRATION_LIST)


def _one_lobe():
    log_4_pi = DIGITS.log(4 * PI)
    kernels = {
        "langevin.log_sinhc": (langevin.log_sinhc, _log_sinhc),
        "langevin.log_sinhc_complement": (
            langevin.log_sinhc_complement,
            lambda k: k - _log_sinhc(k),
        ),
        "langevin.k_coth": (langevin.k_coth, _k_coth),
        "langevin.langevin": (langevin.langevin, _mean),
        "langevin.langevin_complement": (langevin.langevin_complement, lambda k: 1 - _mean(k)),
        "langevin.langevin_slope": (langevin.langevin_slope, _slope),
        "vmf.log_normaliser": (vmf.log_normaliser, lambda k: -log_4_pi - _log_sinhc(k)),
        "vmf.log_peak": (vmf.log_peak, lambda k: k - _log_sinhc(k) - log_4_pi),
        "vmf.squared_norm": (vmf.squared_norm, lambda k: _k_coth(k) / (4 * PI)),
        "vmf.entropy": (vmf.entropy, lambda k: log_4_pi + _log_sinhc(k) - k * _mean(k)),
    }
    yield Curved(
        tuple(kernels),
        "kappa",
        lambda x: jnp.stack([call(x[0]) for call, _ in kernels.values()]),
        CONCENTRATIONS,
        lambda k: [exact(k) for _, exact in kernels.values()],
        ulps=200,  # the slope's above 1 is a difference of 6 and 6.04
    )
    yield Curved(
        ("langevin.log_sinhc_root",),
        "square",
        lambda x: langevin.log_sinhc_root(x[0])[None],
        tuple((x,) for x in (0.0, 1e-12, 0.5, 1 - 2.0**-24, 1.0, 1 + 2.0**-23, 100.0, 1e10)),
        lambda x: [_log_sinhc_root(x)],
    )
    # The larger of value and complement does not count for the slope.
    yield Curved(
        ("langevin.inverse_langevin",),
        "value",
        lambda x: langevin.inverse_langevin(x[0], 1.0 - x[0])[None],
        tuple((x,) for x in (0.0, 1e-6, 1e-3, 0.3, 0.499999, 0.5, 0.500001, 0.9, 0.999)),
        lambda x: [_inverse(x)],
    )
    degrees = (1, 2, 5)
    yield Curved(
        ("lobe_harmonics.ratios",) * 3,
        "kappa",
        lambda x: lobe_harmonics.ratios(x[0], 6)[jnp.asarray(degrees)],
        tuple((k,) for k in (1e-3, 0.5, 1 - 2.0**-24, 1.0, 1 + 2.0**-23, 12.0, 100.0, 1e4)),
        lambda k: [
            DIGITS.besseli(n + DIGITS.mpf("0.5"), k) / DIGITS.besseli(DIGITS.mpf("0.5"), k)
            for n in degrees
        ],
    )
    yield Curved(
        ("vmf_sampling.one_minus_cosine",),
        "share, kappa",
        lambda x: vmf_sampling.one_minus_cosine(x[0], x[1])[None],
        tuple(
            (v, k)
            for v in (0.0, 1e-6, 0.3, 0.9)
            for k in (0.0, 1e-8, 1e-3, 0.125 - 2.0**-27, 0.125, 0.5, 3.0, 89.0, 1e5)
        ),
        lambda v, k: [-DIGITS.log(1 + v * DIGITS.expm1(-2 * k)) / k if k else 2 * v],
        ulps=4e3,  # at the join quotients by numbers of 1/8 are differentiated twice
    )


def _log_inner(k0, k1, cos):
    both = _log_sinhc_root(k0 * k0 + k1 * k1 + 2 * k0 * k1 * cos)
    return both - _log_sinhc(k0) - _log_sinhc(k1) - DIGITS.log(4 * PI)


def _two_lobes():
    """Two concentrations and the angle between the axes."""

    def call(x):
        k0, k1, angle = x
        zero, one = jnp.zeros_like(angle), jnp.ones_like(angle)
        mu0, mu1 = jnp.stack([zero, zero, one]), jnp.stack([jnp.sin(angle), zero, jnp.cos(angle)])
        pair = (mu0, k0, mu1, k1)
        return jnp.stack(
            [
                vmf_pairs.log_inner(*pair),
                vmf_pairs.log_similarity(*pair),
                vmf_pairs.divergence(*pair),
                vmf_pairs.squared_distance(one, mu0, k0, one, mu1, k1),
            ]
        )

    def exact(k0, k1, angle):
        cos = DIGITS.cos(angle)
        inner, own0, own1 = (
            _log_inner(*each) for each in ((k0, k1, cos), (k0, k0, 1), (k1, k1, 1))
        )
        divergence = _log_sinhc(k1) - _log_sinhc(k0) + (k0 - k1 * cos) * _mean(k0)
        distance = DIGITS.exp(own0) + DIGITS.exp(own1) - 2 * DIGITS.exp(inner)
        return [inner, inner - (own0 + own1) / 2, divergence, distance]

    names = ("log_inner", "log_similarity", "divergence", "squared_distance")
    ends = ((0.0, 0.0), (0.0, 3.0), (0.5, 0.5), (1.0, 1.0), (1.0, 1.25), (3.0, 0.7), (30.0, 30.0))
    yield Curved(
        tuple(f"vmf_pairs.{name}" for name in names),
        "concentrations, angle",
        call,
        tuple((a, b, t) for a, b in ends for t in (0.0, 1e-4, 1.0, 3.0))
        # As far apart as float32 says: both cancel.
        + tuple((k, k, float(np.float32(np.pi))) for k in (0.5, 30.0))
        + ((1e4, 1.3e4, 1e-2), (1e4, 1.0, 0.5), (1e8, 1e8, 0.0)),
        exact,
        ulps=2e3,  # like lobes: differences of log 2 kappa and of kappa (1 - cos) to 30
    )
    yield Curved(
        ("vmf_pairs.convolved",),
        "concentrations",
        lambda x: vmf_pairs.convolved(x[0], x[1])[None],
        ((0.5, 3.0), (1.0, 1.0), (3.0, 5.0), (89.0, 0.1), (1e4, 2e4)),
        lambda k0, k1: [_inverse(_mean(k0) * _mean(k1))],
        ulps=300,
    )


def _waves():
    yield Curved(
        ("phase.cis_turns", "phase.cis_turns"),
        "turns",
        lambda x: jnp.stack(phase.cis_turns(x[0])),
        tuple((t,) for t in (0.0, 1e-30, 0.125, 0.25, 0.25 + 2.0**-20, 0.5, 1000.125)),
        lambda t: [DIGITS.cos(2 * PI * t), DIGITS.sin(2 * PI * t)],
        ulps=64,
    )
    yield Curved(
        ("special.sinc",),
        "x",
        lambda x: special.sinc(x[0])[None],
        tuple((x,) for x in (0.0, 1e-9, 0.3, 0.5 - 2.0**-25, 0.5, 0.5 + 2.0**-24, 13.25)),
        lambda x: [DIGITS.sin(PI * x) / (PI * x) if x else DIGITS.mpf(1)],
    )
    yield Curved(
        ("special.dirichlet", "special.dirichlet"),
        "turns",
        lambda x: jnp.stack(special.dirichlet(x[0], 7)),
        tuple((t,) for t in (0.0, 3.0, 2 + 2.0**-12, 0.5, 0.07142)),
        lambda t: [
            sum(turn(2 * PI * q * t) for q in range(7)) / 7 for turn in (DIGITS.cos, DIGITS.sin)
        ],
        ulps=2e3,  # curvatures of (14 pi)^2
    )


def _unpolarised(cos, index):
    inner = DIGITS.sqrt(index * index - 1 + cos * cos)
    s = (cos - inner) / (cos + inner)
    p = (index * index * cos - inner) / (index * index * cos + inner)
    return (abs(s) ** 2 + abs(p) ** 2) / 2


def _interfaces():
    yield Curved(
        ("fresnel.dielectric",),
        "cosine, index",
        lambda x: fresnel.dielectric(x[0], x[1])[None],
        (
            *((c, n) for c in (1e-4, 0.5, 1.0) for n in (1.0 + 2.0**-20, 1.5, 4.0)),
            # Either side of the critical angle, which is at 0.7424.
            *((0.2, 0.67), (0.75, 0.67), (0.0, 1.5)),
        ),
        lambda c, n: [_unpolarised(c, n)],
        ulps=2e3,
    )
    yield Curved(
        ("fresnel.conductor",),
        "cosine, index",
        lambda x: fresnel.conductor(x[0], x[1], x[2])[None],
        tuple(
            (c, eta, k)
            for c in (1e-4, 0.5, 1.0)
            for eta, k in ((0.96, 6.7), (1.5, 1e-6), (0.05, 3.0), (3.0, 0.1))
        ),
        lambda c, eta, k: [_unpolarised(c, DIGITS.mpc(eta, k))],
        ulps=2e3,
    )
    yield Curved(
        ("fresnel.schlick",),
        "cosine, normal",
        lambda x: fresnel.schlick(x[0], x[1])[None],
        tuple((c, r) for c in (0.0, 0.5, 1.0) for r in (0.0, 0.04, 1.0)),
        lambda c, r: [r + (1 - r) * (1 - c) ** 5],
    )


def curved():
    """All of them."""
    yield from _one_lobe()
    yield from _two_lobes()
    yield from _waves()
    yield from _interfaces()


def ways(size):
    """Along each argument, and along the sum of every two: all of the Hessian."""
    along = np.eye(size)
    return [*along, *(along[i] + along[j] for i in range(size) for j in range(i))]


@cache
def along(exact, place, way):
    """Outputs [n] and their second derivatives [n] along a way, as float64."""
    at = [DIGITS.mpf(x) for x in place]
    step = STEP * max(abs(x) if w else 1 for x, w in zip(at, way, strict=True))
    step = max(step, STEP)
    ends = [
        exact(*(x + sign * step * w for x, w in zip(at, way, strict=True))) for sign in (-1, 0, 1)
    ]
    second = [(a - 2 * b + c) / step**2 for a, b, c in zip(*ends, strict=True)]
    return np.array([float(b) for b in ends[1]]), np.array([float(d) for d in second])
