"""Hard inputs of the kernels of von Mises-Fisher lobes: see `hard_cases`.

The twins take power series below a concentration of 2 (the kernels: below 1) and differences
of logarithms, which 80 bits afford, above it.
"""

from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from hard_cases import LD, PI, Hard

from diffopt.kernels import frames, langevin, vmf, vmf_pairs, vmf_sampling

SLANT = np.array([0.48, -0.36, 0.8])
OTHER = np.array([-0.48, 0.6, 0.64])
NORMAL = np.array([0.0, 0.0, 1.0])
BELOW = np.array([0.0, 0.0, -1.0])
# 1e-4 from SLANT, on the sphere to 1e-16.
CLOSE = (SLANT + 1e-4 * np.array([0.6, 0.8, 0.0])) / np.sqrt(1 + 1e-8)
LAST = 1 - 2.0**-24  # the largest number below 1 in float32
LOW = np.array([0.0, 1e-12, 1e-3, 0.999999, 1.0, 1.000001])
HIGH = np.array([44.0, 89.0, 710.0, 1e5, 1e8])


def lobe_rows():
    """All of them."""
    yield from _concentrations()
    yield from _inverses()
    yield from _densities()
    yield from _pairs()
    yield from _distances()
    yield from _interpolations()
    yield from _samplers()
    yield from _frames()


def _sum(k, term):
    """Power series in k^2, to 30 terms."""
    return sum(term(n) * (k * k) ** n for n in range(30))


def _split(near, far):
    """Twin of one concentration from its forms below and above 2."""

    def twin(k):
        return np.where(np.abs(k) < 2, near(np.where(np.abs(k) < 2, k, 0)), far(np.maximum(k, 2)))

    return twin


def _sinhc(k):
    return _sum(k, lambda n: 1 / LD(factorial(2 * n + 1)))


_log_sinhc = _split(
    lambda k: np.log1p(k * k * _sum(k, lambda n: 1 / LD(factorial(2 * n + 3)))),
    lambda k: k + np.log1p(-np.exp(-2 * k)) - np.log(2 * k),
)
_excess = _split(
    lambda k: k - _log_sinhc(k),
    lambda k: np.log(2 * k) - np.log1p(-np.exp(-2 * k)),
)
# k coth k and (k cosh k - sinh k) / (k sinh k), term by term.
_k_coth = _split(
    lambda k: _sum(k, lambda n: 1 / LD(factorial(2 * n))) / _sinhc(k),
    lambda k: k / np.tanh(k),
)
_mean = _split(
    lambda k: k * _sum(k, lambda n: LD(2 * n + 2) / factorial(2 * n + 3)) / _sinhc(k),
    lambda k: 1 / np.tanh(k) - 1 / k,
)
_rest = _split(lambda k: 1 - _mean(k), lambda k: 1 / k + 2 / np.expm1(-2 * k) * np.exp(-2 * k))
# (sinh^2 k - k^2) / (k^2 sinh^2 k), with sinh^2 k = (cosh 2k - 1) / 2.
_slope = _split(
    lambda k: _sum(k, lambda n: LD(2) ** (2 * n + 3) / factorial(2 * n + 4)) / _sinhc(k) ** 2,
    lambda k: k**-2 - 4 * np.exp(-2 * k) / np.expm1(-2 * k) ** 2,
)


def _peak(k):
    return _excess(k) - np.log(4 * PI)


def _entropy(k):
    # Either sum has no large terms where it is used.
    return np.where(
        np.abs(k) < 2, np.log(4 * PI) + _log_sinhc(k) - k * _mean(k), k * _rest(k) - _peak(k)
    )


def _norm2(k):
    return _k_coth(k) / (4 * PI)


def _concentrations():
    """Each concentration relative to its own value: scaled by a power of two, without error."""
    for kernel, call, twin in (
        ("langevin.log_sinhc", langevin.log_sinhc, _log_sinhc),
        ("langevin.log_sinhc_complement", langevin.log_sinhc_complement, _excess),
        ("langevin.k_coth", langevin.k_coth, _k_coth),
        ("langevin.langevin", langevin.langevin, _mean),
        ("langevin.langevin_complement", langevin.langevin_complement, _rest),
        ("langevin.langevin_slope", langevin.langevin_slope, _slope),
        ("vmf.log_normaliser", vmf.log_normaliser, lambda k: -np.log(4 * PI) - _log_sinhc(k)),
        ("vmf.log_peak", vmf.log_peak, _peak),
        ("vmf.squared_norm", vmf.squared_norm, _norm2),
        ("vmf.entropy", vmf.entropy, _entropy),
    ):
        parts = {"low": LOW, "high": HIGH}
        if kernel.startswith("vmf."):
            parts = {"all": np.concatenate([LOW, HIGH])}
        for label, k in parts.items():
            size = np.abs(np.asarray(twin(k.astype(LD)), float))
            weight = np.exp2(-np.round(np.log2(np.where(size > 0, size, 1.0))))
            yield Hard(
                kernel,
                label,
                lambda k, call=call, weight=weight: call(k) * jnp.asarray(weight, k.dtype),
                (k,),
                lambda k, twin=twin, weight=weight: twin(k) * weight,
                # At 1 the logarithm of sinh(k) / k is 0.16, from terms of 1.
                ulps=16 if kernel == "langevin.log_sinhc" else 8,
            )


def _pade(value, complement):
    return value * (3 - value**2) / (complement * (1 + value))


def _inverse(value, complement):
    """Newton's method on the smaller of the two, which approaches from one side."""
    if value < 0:
        return -_inverse(-value, 2 - complement)
    k = _pade(value, complement)
    for _ in range(12):
        missing = value - _mean(k) if value < 0.5 else _rest(k) - complement
        k = k + missing / _slope(k)
    return k


def _inverses():
    for value, complement in (
        (0.0, 1.0),
        (1e-12, 1 - 1e-12),
        (0.3, 0.7),
        (0.8, 0.2),
        (1 - 1e-8, 1e-8),
    ):
        row = (f"{value}, {complement}",)
        arguments = (value, complement)
        if value not in (0.0, 0.8):
            yield Hard(
                "langevin.pade_inverse_langevin",
                *row,
                langevin.pade_inverse_langevin,
                arguments,
                _pade,
                smooth=complement > 1e-3,  # steps of differences of a tenth of it
            )
        yield Hard(
            "langevin.inverse_langevin",
            *row,
            langevin.inverse_langevin,
            arguments,
            _inverse,
            # Its slope is given by one of two arguments that depend on each other: see the
            # test of the inverse.
            smooth=False,
        )


def _gap(s, mu):
    return ((s - mu) ** 2).sum() / 2


def _log_density(s, mu, k):
    return _peak(k) - k * _gap(s, mu)


def _densities():
    for label, mu in (("meet", SLANT), ("close", CLOSE)):
        yield Hard("vmf.complement", label, vmf.complement, (SLANT, mu), _gap)
    for label, s, mu, k in (
        ("uniform", SLANT, OTHER, 0.0),
        ("join", SLANT, OTHER, 0.999999),
        ("below", CLOSE, BELOW, 3.0),
        ("flank", CLOSE, SLANT, 1e8),
        ("top", SLANT, SLANT, 89.0),
        ("away", -SLANT, SLANT, 30.0),
    ):
        arguments = (s, mu, k)
        if label in ("uniform", "below", "flank", "away"):
            yield Hard("vmf.log_pdf", label, vmf.log_pdf, arguments, _log_density)
        if label not in ("below", "uniform"):
            yield Hard(
                "vmf.pdf",
                label,
                vmf.pdf,
                arguments,
                lambda *a: np.exp(_log_density(*a)),
                # Rounding of the exponent, 60, or of a logarithm of 17.
                ulps={"away": 100, "flank": 24}.get(label, 8),
                gradient_ulps=1e5 if label == "flank" else 1e3,
            )


def _unit(mu):
    return mu / np.sqrt((mu**2).sum())


def _combined(mu0, k0, mu1, k1):
    mu0, mu1 = _unit(mu0), _unit(mu1)
    both = np.sqrt((k0 - k1) ** 2 + k0 * k1 * ((mu0 + mu1) ** 2).sum())
    total = both + k0 + k1
    return both, k0 * k1 * ((mu0 - mu1) ** 2).sum() / (total or LD(1))


def _log_inner(mu0, k0, mu1, k1):
    both, delta = _combined(mu0, k0, mu1, k1)
    if max(k0, k1) < 2:
        return _log_sinhc(both) - _log_sinhc(k0) - _log_sinhc(k1) - np.log(4 * PI)
    return _peak(k0) + _peak(k1) - _peak(both) - delta


def _tangential(call, *places):
    """A kernel as a function on the sphere: its slopes along the unit vectors are left out.

    The values are the same. The twins normalise: formulas that agree on the sphere alone have
    different slopes across it.
    """

    def wrapped(*arguments):
        held = list(arguments)
        for place in places:
            fixed = jax.lax.stop_gradient(held[place])
            step = held[place] - fixed
            held[place] = held[place] - (step * fixed).sum() * fixed
        return call(*held)

    return wrapped


def _product(mu0, k0, mu1, k1):
    mu0, mu1 = _unit(mu0), _unit(mu1)
    vector = k0 * mu0 + k1 * mu1
    length = _combined(mu0, k0, mu1, k1)[0]
    weight = _log_inner(mu0, k0, mu1, k1)
    return weight, vector / length if length else mu0, length / (k0 + k1)


def _share(mu0, k0, mu1, k1):
    """The product with its concentration over the sum, so that every output counts."""
    weight, mu, both = vmf_pairs.product(mu0, k0, mu1, k1)
    return weight, mu, both / (k0 + k1)


def _divergence(mu0, k0, mu1, k1):
    x = (k1 - k0) / k0 if k0 else LD(0)
    if min(k0, k1) > 44 and abs(x) < 0.3:
        radial = sum((-x) ** n / n for n in range(2, 90))
    elif min(k0, k1) > 44:
        radial = _peak(k0) - _peak(k1) + (k1 - k0) * _rest(k0)
    else:
        radial = _log_sinhc(k1) - _log_sinhc(k0) - (k1 - k0) * _mean(k0)
    return radial + k1 * _mean(k0) * _gap(_unit(mu0), _unit(mu1))


def _convolved(k0, k1):
    return _inverse(_mean(k0) * _mean(k1), _rest(k0) + _mean(k0) * _rest(k1))


PAIRS = {
    "zero": (SLANT, 0.0, OTHER, 0.0),
    "tiny": (SLANT, 1e-12, OTHER, 1e-3),
    "low": (SLANT, 0.5, OTHER, 0.9),
    "join": (SLANT, 0.999999, OTHER, 1.000001),
    "alike low": (SLANT, 0.5, SLANT, 0.5),
    "alike": (SLANT, 1e5, SLANT, 1e5),
    "close": (SLANT, 1e8, CLOSE, 1.1e8),
    "narrow and wide": (SLANT, 1e8, OTHER, 3.0),
    "wide and narrow": (SLANT, 3.0, OTHER, 1e8),
    "antipodal": (SLANT, 3.0, -SLANT, 3.0),
    "antipodal unlike": (SLANT, 89.0, -SLANT, 88.0),
}


def _pairs():
    for label in ("zero", "tiny", "close", "antipodal"):
        yield Hard(
            "vmf_pairs.combined",
            label,
            _tangential(vmf_pairs.combined, 0, 2),
            PAIRS[label],
            _combined,
            smooth=label not in ("zero", "antipodal"),  # a root at zero
        )
    for label in ("tiny", "close", "wide and narrow", "antipodal"):
        yield Hard(
            "vmf_pairs.log_inner",
            label,
            _tangential(vmf_pairs.log_inner, 0, 2),
            PAIRS[label],
            _log_inner,
        )
    for label in ("close", "narrow and wide", "antipodal", "antipodal unlike"):
        yield Hard(
            "vmf_pairs.product",
            label,
            _tangential(_share, 0, 2),
            PAIRS[label],
            _product,
            smooth=label != "antipodal",  # no direction there
        )
    for label in ("tiny", "join", "alike", "close", "wide and narrow", "antipodal"):
        yield Hard(
            "vmf_pairs.divergence",
            label,
            _tangential(vmf_pairs.divergence, 0, 2),
            PAIRS[label],
            _divergence,
        )
    for k0, k1 in ((0.0, 5.0), (1e-12, 1e-3), (3.0, 1e8), (1e8, 1e8)):
        yield Hard(
            "vmf_pairs.convolved", f"{k0:g}, {k1:g}", vmf_pairs.convolved, (k0, k1), _convolved
        )


def _similarity(mu0, k0, mu1, k1):
    if max(k0, k1) < 1:
        both = _combined(mu0, k0, mu1, k1)[0]
        return _log_sinhc(both) - (_log_sinhc(2 * k0) + _log_sinhc(2 * k1)) / 2
    value = _log_inner(mu0, k0, mu1, k1) - np.log(_norm2(k0) * _norm2(k1)) / 2
    return value if abs(value) > 1e-15 else LD(0)  # its own rounding


def _own(a0, k0, a1, k1, norm2):
    return a0 * a0 * norm2(k0) + a1 * a1 * norm2(k1)


def _with_scale(call, norm2):
    """A distance beside the squares it is the difference of, which its error is relative to."""
    return lambda *a: (call(*a), _own(a[0], a[2], a[3], a[5], norm2))


def _distance(a0, mu0, k0, a1, mu1, k1):
    shared = a0 * a1 * np.exp(_log_inner(mu0, k0, mu1, k1))
    return _own(a0, k0, a1, k1, _norm2) - 2 * shared


def _asymptotic(a0, mu0, k0, a1, mu1, k1):
    both, delta = _combined(mu0, k0, mu1, k1)
    return (
        _own(a0, k0, a1, k1, lambda k: k / (4 * PI))
        - a0 * a1 * k0 * k1 / both * np.exp(-delta) / PI
    )


def _distances():
    for label in ("tiny", "low", "alike", "close", "narrow and wide", "antipodal"):
        yield Hard(
            "vmf_pairs.log_similarity",
            label,
            _tangential(vmf_pairs.log_similarity, 0, 2),
            PAIRS[label],
            _similarity,
        )
    exact = _with_scale(vmf_pairs.squared_distance, vmf.squared_norm)
    limit = _with_scale(vmf_pairs.squared_distance_asymptotic, vmf.squared_norm)
    for label in ("zero", "low", "alike", "close", "wide and narrow", "antipodal"):
        mu0, k0, mu1, k1 = PAIRS[label]
        arguments = (0.7, mu0, k0, 0.0 if label == "low" else 0.7, mu1, k1)
        yield Hard(
            "vmf_pairs.squared_distance",
            label,
            _tangential(exact, 1, 4),
            arguments,
            _with_scale(_distance, _norm2),
        )
        if label in ("alike", "close"):
            yield Hard(
                "vmf_pairs.squared_distance_asymptotic",
                label,
                _tangential(limit, 1, 4),
                arguments,
                _with_scale(_asymptotic, _norm2),
            )


def _interpolated(weights, alphas, mus, kappas):
    mean = (weights[:, None] * mus).sum(0)
    length = np.sqrt((mean**2).sum())
    mu = mean / length if length > 1e-6 else mus[np.argmax(weights)]
    return (weights * alphas).sum(), mu, np.exp((weights * np.log(kappas)).sum())


def _blend(s, weights, alphas, mus, kappas):
    share = weights * alphas
    values = [np.exp(_log_density(s, mu, k)) for mu, k in zip(mus, kappas, strict=True)]
    return (share * np.array(values)).sum() / share.sum()


def _interpolations():
    mus = np.stack([SLANT, OTHER, NORMAL])
    alphas = np.array([0.7, 0.2, 1.0])
    for label, weights, mus_here, kappas in (
        ("between", (0.5, 0.25, 0.25), mus, (3.0, 10.0, 1.0)),
        ("one at zero", (0.0, 0.25, 0.75), mus, (1e-12, 1.0, 3.0)),
        ("opposite", (0.25, 0.5, 0.25), np.stack([-OTHER, OTHER, -OTHER]), (1.0, 2.0, 3.0)),
        ("wide range", (0.5, 0.25, 0.25), mus, (1e8, 1e-12, 1.0)),
    ):
        arguments = (np.array(weights), alphas, mus_here, np.array(kappas))
        yield Hard(
            "vmf_pairs.interpolated",
            label,
            vmf_pairs.interpolated,
            arguments,
            _interpolated,
            ulps=40 if label == "wide range" else 8,  # logarithms of up to 28
            # No direction where they cancel; steps of differences larger than 1e-12.
            smooth=label == "between",
        )
    for label, s, weights, kappas in (
        ("one at zero", SLANT, (0.0, 0.25, 0.75), (1e8, 1.0, 3.0)),
        ("wide range", CLOSE, (0.5, 0.25, 0.25), (1e8, 0.0, 710.0)),
    ):
        yield Hard(
            "vmf_pairs.interpolant_pdf",
            label,
            vmf_pairs.interpolant_pdf,
            (s, np.array(weights), alphas, mus, np.array(kappas)),
            _blend,
            ulps=24,  # rounding of the logarithm of 1e8
            gradient_ulps=1e5,
        )


def _one_minus_cosine(v, k):
    # -log(1 + v expm1(-2k)) / k; at small k by its series.
    def one(v, k):
        if abs(k) < 1e-6:
            return 2 * v * (1 - k * (1 - v) + 2 * k * k * (1 - v) * (1 - 2 * v) / 3)
        return -np.log1p(v * np.expm1(-2 * k)) / k

    if np.ndim(v) == 0:
        return one(v, k)
    return np.array([one(*pair) for pair in zip(v, k, strict=True)])


def _warp(u, mu, k):
    t = _one_minus_cosine(u[1], k)
    first, second = _tangents(mu)
    angle = 2 * PI * u[0]
    around = np.cos(angle) * first + np.sin(angle) * second
    return np.sqrt(t * (2 - t)) * around + (1 - t) * mu


def _tangents(mu):
    """x and y mirrored so that the pole of the normal's side falls on the normal."""
    side = LD(1) if mu[2] >= 0 else LD(-1)
    pole = np.array([LD(0), LD(0), side])
    over = (mu + pole) / (1 + side * mu[2])
    x, y = np.array([LD(1), LD(0), LD(0)]), np.array([LD(0), LD(1), LD(0)])
    return x - mu[0] * over, side * (y - mu[1] * over)


def _samplers():
    for label, v, k in (
        ("small", [0.3, 0.0, 0.3, 0.999], [0.0, 1e-12, 1e-3, 1e-3]),
        ("middle", [0.0, 0.3, 0.3, 0.3], [1.0, 1.0, 44.0, 89.0]),
        ("last", [LAST, LAST, LAST, LAST], [1.0, 44.0, 89.0, 710.0]),
        ("large", [0.0, 0.3, 0.3, 0.999], [710.0, 710.0, 1e5, 1e5]),
        ("largest", [0.3, 0.999], [1e8, 1e8]),
    ):
        scale = {"large": 2.0**16, "largest": 2.0**26}.get(label, 1.0)
        yield Hard(
            "vmf_sampling.one_minus_cosine",
            label,
            lambda v, k, scale=scale: vmf_sampling.one_minus_cosine(v, k) * scale,
            (np.array(v), np.array(k)),
            lambda v, k, scale=scale: _one_minus_cosine(v, k) * scale,
            # At 1e-3 the slope by the concentration is a difference of numbers of 1e3.
            gradient_ulps=4e3 if label == "small" else 1e3,
            smooth=label != "last",  # steps of differences of a sixth of 1 - v
        )
    for label, u, mu, k in (
        ("sphere", (0.3, 0.7), SLANT, 0.0),
        ("below", (0.6, 0.999), BELOW, 1e8),
        ("axis", (0.3, 0.0), NORMAL, 89.0),
        ("tail", (0.3, LAST), -SLANT, 710.0),
    ):
        yield Hard(
            "vmf_sampling.warp",
            label,
            vmf_sampling.warp,
            (np.array(u), mu, k),
            _warp,
            smooth=label not in ("axis", "tail"),  # the sine has its root there; 1 / (1 - v)
        )


def _frames():
    yield Hard(
        "frames.direction",
        "components",
        frames.direction,
        (np.array([1.0, -2.0]), np.array([0.0, 3.0]), np.array([1e-9, 4.0])),
        lambda x, y, z: np.stack([x, y, z], -1),
    )
    for label, mu in (
        ("up", NORMAL),
        ("down", BELOW),
        ("slant", SLANT),
        ("just below", np.array([0.6, 0.8, -1e-9])),
    ):
        # Differences about z = -1e-9 cross the jump at 0.
        yield Hard(
            "frames.tangents",
            label,
            frames.tangents,
            (mu,),
            _tangents,
            smooth=label != "just below",
        )
