"""Bessel functions and the statistics of rough surfaces."""

from functools import partial

import jax.numpy as jnp
import numpy as np
from scipy.special import gammaln

from diffopt.kernels import bessel, ensemble
from hard_cases.base import LD, PI, Hard


def _poisson_sum(q, kappa, rms, length):
    g, a = (kappa * rms) ** 2, (q * length) ** 2 / 4
    return PI * length**2 * _bell_sum(g, a)


def _bell_sum(g, a):
    if g == 0:
        return LD(0)
    low = max(1, int(g - 12 * np.sqrt(g)) - 40)
    m = np.arange(low, int(g + 12 * np.sqrt(g) + 4 * np.sqrt(a) + 200), dtype=LD)
    logs = m * np.log(g) - g - _log_factorial(m) - a / m
    return (np.exp(logs) / m).sum()


def _log_factorial(m):
    """log(m!) in extended precision: scipy below 40, Stirling's series above (1e-17)."""
    i2 = 1 / m**2
    series = (1 / LD(12) - i2 * (1 / LD(360) - i2 * (1 / LD(1260) - i2 / 1680))) / m
    stirling = m * np.log(m) - m + np.log(2 * PI * m) / 2 + series
    return np.where(m < 40, LD(1) * gammaln(np.asarray(m + 1, float)), stirling)


def _bump(qx, qy, kappa, height, sx, sy, density):
    n = np.arange(1, 90)
    size = np.cumprod(kappa * height / n) * np.array([1, 1j, -1, -1j])[n % 4]
    series = lambda x, y: (  # noqa: E731
        size * 2 * PI * sx * sy / n * np.exp(-((x * sx) ** 2 + (y * sy) ** 2) / (2 * n))
    ).sum()
    mirror = np.exp(2 * density * series(0 * qx, 0 * qy).real)
    return density * np.abs(series(qx, qy)) ** 2 * mirror, mirror


def _bessel(z, orders):
    """Power series in long double; terms up to e^6 cancel to 1e-16 of 1."""
    out = []
    for m in range(orders):
        term = np.prod([z / 2 / LD(k) for k in range(1, m + 1)], initial=LD(1))
        total = LD(0)
        for k in range(80):
            total += term
            term = -term * (z / 2) ** 2 / (LD(k + 1) * LD(m + k + 1))
        out.append(total)
    return tuple(out)


def bessels():
    nodes = bessel.sequence_nodes(6, 30.0)
    order = jnp.asarray([[-3], [0], [4], [9]], jnp.int32)

    def sequence(z):
        return bessel.bessel_sequence(z[None], 6, nodes=nodes)[:, 0]

    def signed(z):
        return bessel.signed(bessel.bessel_sequence(z[None], 6, nodes=nodes), order)[:, 0]

    def signed_twin(z):
        j = _bessel(z, 7)
        return -j[3], j[0], j[4], LD(0)

    for z in (0.0, 1e-8, -2.5, 6.0):
        # The twin loses digits beyond. The phase is rounded to eps z, a sum of cosines to some eps.
        yield Hard(
            "bessel.bessel_sequence", f"z={z}", sequence, (z,), partial(_bessel, orders=7), 60
        )
        yield Hard("bessel.signed", f"z={z}", signed, (z,), signed_twin, 60)
    for m, g in ((1.0, 1e-6), (3.0, 3.0), (40.0, 2.0), (900.0, 1000.0)):
        yield Hard(
            "ensemble.log_poisson",
            f"m={m}, g={g}",
            ensemble.log_poisson,
            (m, g),
            lambda m, g: m * np.log(g) - g - LD(gammaln(float(m) + 1)),
            # The twin's terms of some thousands are good to 1e-16 of themselves.
            ulps=3e3,
            smooth=False,
        )


def _poisson_terms(g, a, terms):
    m, weight = ensemble.poisson_terms(g, a, terms, widths=20.0, halvings=50)
    return (weight * jnp.exp(-a / m) / m).sum()


def ensembles():
    for g, a in ((1e-6, 0.0), (3.0, 2.0), (1e3, 40.0), (1e4, 1e4)):
        yield Hard(
            "ensemble.poisson_terms",
            f"g={g}, a={a}",
            partial(_poisson_terms, terms=256),
            (g, a),
            _bell_sum,
            # As for the sum of them in `gaussian_roughness`; the twin's differences want
            # g above their step and exponents far below 1e5.
            ulps=3e3,
            smooth=1.0 < g < 1e4,
            gradient_ulps=3e5,
        )
    for q, kappa, rms, smooth in (
        (0.0, -20.0, 0.0, False),
        (3.0, -20.0, 1e-4, True),
        (0.0, -20.0, 0.05, True),
        (40.0, -20.0, 0.3, True),
        (200.0, -30.0, 10.0, True),
    ):
        yield Hard(
            "ensemble.gaussian_roughness",
            f"q={q}, rms={rms}",
            ensemble.gaussian_roughness,
            (q, kappa, rms, 0.8),
            _poisson_sum,
            # The twin's log-gamma is good to 1e-16 of up to 1e6; the kernel's terms to
            # eps times their exponent's spread.
            ulps=3e3,
            smooth=smooth and rms < 1,
            gradient_ulps=3e5,
        )
    for kappa, rms in ((0.0, 1.0), (-20.0, 0.0), (-30.0, 10.0), (-20.0, 0.02)):
        yield Hard(
            "ensemble.gaussian_mirror",
            f"{kappa}, {rms}",
            ensemble.gaussian_mirror,
            (kappa, rms),
            lambda k, r: np.exp(-((k * r) ** 2)),
            ulps=20,
        )
    for height in (0.0, 1e-8, 0.2):
        yield Hard(
            "ensemble.random_bumps",
            f"height={height}",
            partial(ensemble.random_bumps, terms=60),
            (3.0, -2.0, -25.0, height, 0.3, 0.2, 0.5),
            _bump,
            # terms up to 5^5/5! = 26 cancel
            ulps=500,
            gradient_ulps=3e4,
        )
