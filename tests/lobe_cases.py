"""Hard inputs of the kernels of von Mises-Fisher lobes: see `hard_cases`.

The twins take power series below a concentration of 2 (the kernels: below 1) and differences
of logarithms, which 80 bits afford, above it.
"""

from dataclasses import replace
from functools import partial
from math import factorial

import jax
import jax.numpy as jnp
import numpy as np
from hard_cases import LD, PI, Hard

from diffopt.kernels import (
    frames,
    langevin,
    lobe_squares,
    mixture,
    quadrature,
    vmf,
    vmf_pairs,
    vmf_sampling,
)
from diffopt.kernels.lobe_squares import Base, Parameters, Problem, Progress, System

SLANT = np.array([0.48, -0.36, 0.8])
OTHER = np.array([-0.48, 0.6, 0.64])
NORMAL = np.array([0.0, 0.0, 1.0])
BELOW = np.array([0.0, 0.0, -1.0])
# 1e-4 from SLANT, on the sphere to 1e-16.
CLOSE = (SLANT + 1e-4 * np.array([0.6, 0.8, 0.0])) / np.sqrt(1 + 1e-8)
LAST = 1 - 2.0**-24  # the largest number below 1 in float32
LOW = np.array([0.0, 1e-12, 1e-3, 0.999999, 1.0, 1.000001])
# As many as the low ones: operations of one shape are compiled once.
HIGH = np.array([12.0, 44.0, 89.0, 710.0, 1e5, 1e8])


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
    for fits in (_moments, _mixtures, _starts, _problems, _steps, _grids):
        for row in fits():
            # One by one, each of their hundred operations would be compiled for a shape of its own.
            yield replace(row, call=jax.jit(row.call))


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


# Directions of fits. Rows normalise them on both sides: a formula on the sphere has one slope
# there and many across it.
AROUND = np.array([[0.48, -0.36, 0.8], [0.6, 0.0, 0.8], [0.0, -0.6, 0.8], [0.36, 0.48, 0.8]])
TIGHT = SLANT + 1e-3 * np.array([[0.6, 0.8, 0.0], [-0.8, 0.0, 0.48], [0.3, 0.4, -0.1], [0, 0, 1]])
SHARPEST = 1e6


def _normal(s):
    return s / np.sqrt((s**2).sum(-1, keepdims=True))


def _on_sphere(call, place=0):
    """A kernel with directions that are brought to unit length first."""

    def wrapped(*arguments):
        held = list(arguments)
        s = held[place]
        held[place] = s / jnp.sqrt((s**2).sum(-1, keepdims=True))
        return call(*held)

    return wrapped


def _mean_direction(s, w):
    s, total = _normal(s), w.sum()
    mean = (s * w[:, None]).sum(0) / (total or LD(1))
    length = np.sqrt((mean**2).sum())
    spread = (((s - mean) ** 2).sum(-1) * w).sum() / (total or LD(1))
    if length < 1e-7:  # by symmetry: what is left of it is rounding
        return total, NORMAL.astype(LD), LD(0), LD(1)
    return total, mean / length, length, spread / (1 + length)


def _single(s, w, sharpest=SHARPEST):
    total, mu, length, rest = _mean_direction(s, w)
    rest = max(rest, 1 / LD(sharpest))
    return total, mu, min(_inverse(min(length, 1 - rest), rest), LD(sharpest))


def _moments():
    """Rows of one shape, so that one program serves them all."""
    for label, s, w in (
        ("around", AROUND, (1.0, 0.5, 2.0, 0.0)),
        ("tight", TIGHT, (1.0, 2.0, 0.5, 1.0)),
        ("alike", np.stack([SLANT] * 4), (1.0, 2.0, 0.5, 1.0)),
        ("opposite", np.stack([NORMAL, BELOW] * 2), (1.0, 1.0, 0.5, 0.5)),
        ("nothing", AROUND, (0.0,) * 4),
    ):
        if label != "alike":
            yield Hard(
                "mixture.mean_direction",
                label,
                _on_sphere(mixture.mean_direction),
                (s, np.array(w)),
                _mean_direction,
                smooth=label not in ("opposite", "nothing"),  # no direction there
            )
        if label in ("around", "tight", "alike"):
            yield Hard(
                "mixture.moments",
                label,
                _log_last(_on_sphere(lambda s, w: mixture.moments(s, w, 1e8))),
                (s, np.array(w)),
                _log_last(lambda s, w: _single(s, w, 1e8)),
                # Directions 1e-3 apart are rounded by eps / 1e-3 of their distance.
                ulps=1e3 if label == "tight" else 8,
                smooth=label == "around",  # steps of differences of a hundredth of the spread
            )


def _log_last(call):
    """The concentration by its logarithm: its relative error counts, whatever its size."""

    def wrapped(*arguments):
        *rest, last = call(*arguments)
        return *rest, jnp.log(last) if isinstance(last, jax.Array) else np.log(last)

    return wrapped


def _each(s, log_share, mu, kappa):
    t = ((s[None] - mu[:, None]) ** 2).sum(-1) / 2
    return (log_share + _peak(kappa))[:, None] - kappa[:, None] * t


def _log_likelihood(s, w, log_share, mu, kappa):
    density = np.log(np.exp(_each(_normal(s), log_share, _normal(mu), kappa)).sum(0))
    return (w * density).sum() / (w.sum() or LD(1))


def _em(s, w, log_share, mu, kappa):
    """Two steps, without safeguards that these rows do not need."""
    s, mu, found = _normal(s), _normal(mu), []
    for _ in range(2):
        density = np.exp(_each(s, log_share, mu, kappa))
        found.append((w * np.log(density.sum(0))).sum() / w.sum())
        owned = density / density.sum(0) * w
        log_share = np.log(owned.sum(-1) / w.sum())
        parts = [_single(s, row, 1e12) for row in owned]
        mu, kappa = np.stack([p[1] for p in parts]), np.stack([p[2] for p in parts])
    return log_share, mu, kappa, np.array(found)


def _mixtures():
    share = np.log([0.75, 0.25])
    mus = np.stack([SLANT, OTHER])
    w = np.array([1.0, 0.5, 2.0, 0.25])
    for label, s, kappa in (("wide", AROUND, (0.5, 3.0)), ("sharp", TIGHT, (1e6, 1e-3))):
        yield Hard(
            "mixture.log_likelihood",
            label,
            _on_sphere(
                _on_sphere(lambda s, w, *m: mixture.log_likelihood(s, w, mixture.Mixture(*m))), 3
            ),
            (s, w, share, mus, np.array(kappa)),
            _log_likelihood,
            # Distances of 1e-3 times 1e6 are rounded by 1e3 eps of 16 nats.
            ulps=100 if label == "sharp" else 8,
            gradient_ulps=1e5 if label == "sharp" else 1e3,
        )

    def steps(s, w, *start):
        found, likelihood = mixture.expectation_maximisation(s, w, mixture.Mixture(*start), 2, 1e6)
        return *found, likelihood

    yield Hard(
        "mixture.expectation_maximisation",
        "two steps",
        _on_sphere(_on_sphere(steps), 3),
        (AROUND, w, share, mus, np.array([2.0, 3.0])),
        _em,
        ulps=64,  # concentrations of 8 from spreads of 0.1 about means of 0.9
        gradient_ulps=1e4,
    )


def _starts():
    s, w = np.stack([SLANT, OTHER]), np.array([1.0, 0.25])

    def scattered(s, w):
        # The first draw of this key falls on the first direction, in either type; then all
        # weight lies on the second.
        return mixture.scattered_start(jax.random.key(2), s, w, 2, SHARPEST)

    def scattered_twin(s, w):
        kappa = 2 * _single(s, w)[2]
        return np.log(np.full(2, LD(1) / 2)), _normal(s), np.stack([kappa, kappa])

    yield Hard("mixture.scattered_start", "two", _on_sphere(scattered), (s, w), scattered_twin)

    def split_twin(s, w):
        s = _normal(s)
        _, mean, kappa = _single(s, w)
        share = w / (w.sum() or LD(1))
        first, second = _tangents(mean)
        across = np.stack([s @ first, s @ second])
        (a, b), (_, c) = (across * share) @ across.T
        half = np.arctan2(2 * b, a - c) / 2 if b or a != c else LD(0)
        axis = np.cos(half) * first + np.sin(half) * second
        size = np.sqrt(((s @ axis) ** 2 * share).sum())
        mu = _normal(mean + np.array([-2, 0, 2], LD)[:, None] * size * axis)
        kappa = min(max(3 * kappa, LD(mixture.FLATTEST)), LD(SHARPEST))
        return np.log(np.full(3, LD(1) / 3)), mu, np.stack([kappa] * 3)

    for label, s, w in (
        ("slanted", AROUND, (1.0, 0.5, 2.0, 0.25)),
        ("nothing", AROUND, (0.0,) * 4),
    ):
        yield Hard(
            "mixture.split_start",
            label,
            _on_sphere(lambda s, w: mixture.split_start(s, w, 3, SHARPEST)),
            (s, np.array(w)),
            split_twin,
            ulps=32,  # the axis of an ellipse of 2 : 1
            smooth=label == "slanted",
            gradient_ulps=1e4,
        )


LOBES = (
    np.array([-0.3, 0.5]),  # weights, or logs of them
    np.log([2.0, 9.0]),
    np.array([[0.1, -0.3], [0.2, 0.05]]),
)


def _base(mu, kappa):
    sides = [np.stack(x) for x in zip(*(_tangents(m) for m in mu), strict=True)]
    return mu, *(e / np.sqrt(kappa)[:, None] for e in sides)


BASE = tuple(np.asarray(x, float) for x in _base(np.stack([SLANT, OTHER]), np.array([2.0, 9.0])))
NODES = np.concatenate([AROUND, [[0.0, 0.0, 1.0], [-0.6, 0.64, 0.48], [0.8, 0.0, 0.6]]])
ROOT = np.sqrt([0.3, 0.2, 0.5, 0.4, 0.1, 0.25, 0.35])
TARGET = np.array([0.4, 0.2, 0.5, 0.1, 0.3, 0.6, 0.15])


def _residuals(weight, log_kappa, offset, *rest, signed):
    base, (nodes, root, target) = rest[:3], rest[3:]
    kappa = np.exp(log_kappa)
    vector = base[0] + offset[0][:, None] * base[1] + offset[1][:, None] * base[2]
    size = np.sqrt((vector**2).sum(-1, keepdims=True))
    mu = vector / size
    d = nodes[None] - mu[..., None]
    falls = kappa[:, None] * (d**2).sum(1) / 2
    peak = np.sqrt(kappa / (PI * -np.expm1(-4 * kappa)))
    shape = peak[:, None] * np.exp(-falls) * root
    lobe = (weight if signed else np.exp(weight))[:, None] * shape
    rise = (1 - 4 * kappa / np.expm1(4 * kappa)) / 2
    rows = [shape if signed else lobe, lobe * (rise[:, None] - falls)]
    for e in base[1:]:
        turn = kappa[:, None] * (e - (e * mu).sum(-1, keepdims=True) * mu) / size
        rows.append(lobe * (turn[..., None] * d).sum(1))
    return lobe.sum(0) - target, np.concatenate(rows)


def _equations(residual, rows):
    return rows @ rows.T, rows @ residual, (residual**2).sum()


def _solved(matrix, right):
    """Gauss's elimination: NumPy has none in 80 bits."""
    rows = np.concatenate([matrix, right[:, None]], 1)
    for i in range(len(rows)):
        rows[i] = rows[i] / rows[i, i]
        for j in range(len(rows)):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, -1]


def _step(matrix, slope, damping, third):
    """`third` is 1/3 as the type holds it, which tells the twin whose ridge to take."""
    ridge = LD(1e-6) if abs(3 * third - 1) > 1e-12 else LD(1e-9)
    damped = matrix + np.diag(damping * np.diagonal(matrix) + ridge)
    return np.clip(_solved(damped, -slope), -1, 1)


def _moved(weight, log_kappa, offset, step, signed):
    first, second, *turns = step.reshape(4, -1)
    return (
        weight + first if signed else np.clip(weight + first, -30, 10),
        np.clip(log_kappa + second, np.log(LD(mixture.FLATTEST)), np.log(LD(SHARPEST))),
        offset + np.stack(turns),
    )


def _problem(s, solid, values):
    root = np.sqrt(solid)
    norm = np.sqrt(((root * values) ** 2).sum())
    return s.T, root, root * values / (norm or LD(1)), norm


def _lobe_weights(alpha, mu, kappa, norm, signed):
    weight = alpha * np.sqrt(_norm2(kappa)) / norm
    return (
        weight if signed else np.log(np.maximum(weight, 1e-6)),
        np.log(kappa),
        np.zeros((2, len(kappa)), LD),
        *_base(mu, kappa),
    )


def _lobes_of(weight, log_kappa, offset, axis, first, second, norm, signed):
    kappa = np.exp(log_kappa)
    mu = _normal(axis + offset[0][:, None] * first + offset[1][:, None] * second)
    weight = weight if signed else np.exp(weight)
    return norm * weight / np.sqrt(_norm2(kappa)), mu, kappa


def _problems():
    for label, values in (("values", TARGET), ("zero", 0 * TARGET)):
        yield Hard(
            "lobe_squares.problem",
            label,
            lambda *a: _unpacked(lobe_squares.problem(*a)),
            (NODES, ROOT**2, values),
            _problem,
            smooth=label == "values",
        )
    at, base, given = LOBES, BASE, (NODES.T, ROOT, TARGET)
    lobes = np.array([0.7, 1.5]), np.stack([SLANT, OTHER]), np.array([0.5, 30.0]), 1.3
    for signed in (False, True):
        label = "signed" if signed else "positive"

        def residuals(*a, signed=signed):
            return lobe_squares.residuals(
                Parameters(*a[:3]), Base(*a[3:6]), Problem(*a[6:]), signed=signed
            )

        yield Hard(
            "lobe_squares.residuals",
            label,
            residuals,
            (*at, *base, *given),
            lambda *a, signed=signed: _residuals(*a, signed=signed),
        )
        if signed:
            continue
        yield Hard(
            "lobe_squares.parameters",
            label,
            _tangential(
                lambda *a, signed=signed: _unpacked(lobe_squares.parameters(*a, signed=signed)), 1
            ),
            lobes,
            lambda *a, signed=signed: _lobe_weights(*a, signed),
            smooth=False,  # tangents of a vector off the sphere differ
        )
        yield Hard(
            "lobe_squares.lobes",
            label,
            lambda *a, signed=signed: lobe_squares.lobes(
                Parameters(*a[:3]), Base(*a[3:6]), a[6], signed=signed
            ),
            (*at, *base, 1.3),
            lambda *a, signed=signed: _lobes_of(*a, signed),
        )
    yield Hard(
        "lobe_squares.best_weights",
        "positive",
        lambda *a: lobe_squares.best_weights(*a[:-1], signed=False),
        (np.stack([TARGET, TARGET[::-1]], -1), ROOT**2, NODES, *lobes[1:3], 1 / 3),
        _best_weights,
        ulps=64,  # conditions of 3
    )


def _unpacked(value):
    """Leaves of named tuples within tuples, in order."""
    return tuple(jax.tree.leaves(value))


def _best_weights(values, solid, s, mu, kappa, third):
    shape = np.exp(
        _peak(kappa)[:, None] - kappa[:, None] * ((s[None] - mu[:, None]) ** 2).sum(-1) / 2
    )
    size = np.sqrt((shape**2 * solid).sum(-1))
    unit = shape / size[:, None]
    ridge = LD(1e-6) if abs(3 * third - 1) > 1e-12 else LD(1e-12)
    matrix = (unit * solid) @ unit.T + ridge * np.eye(2)
    found = np.stack([_solved(matrix, c) for c in ((unit * solid) @ values).T], -1)
    assert (found > 0).all()  # else the bound would count
    return found / size[:, None]


def _steps():
    residual, rows = _residuals(*LOBES, *BASE, NODES.T, ROOT, TARGET, signed=False)
    equations = tuple(np.asarray(x, float) for x in _equations(residual, rows))
    yield Hard(
        "lobe_squares.normal_equations",
        "lobes",
        lambda *a: tuple(lobe_squares.normal_equations(*a)),
        (np.asarray(residual, float), np.asarray(rows, float)),
        _equations,
    )
    yield Hard(
        "lobe_squares.damped_step",
        "lobes",
        lambda m, s, d, _: lobe_squares.damped_step(System(m, s, s[0]), d),
        (*equations[:2], 0.5, 1 / 3),
        _step,
        ulps=64,
        # Entries of the matrix below the diagonal are its own: the solver reads one half.
        smooth=False,
    )
    step = np.array([0.3, -40.0, 0.5, -20.0, 0.1, 0.2, -0.3, 0.9])
    yield Hard(
        "lobe_squares.moved",
        "to the ends",
        lambda *a: tuple(lobe_squares.moved(Parameters(*a[:3]), a[3], SHARPEST, signed=False)),
        (*LOBES, step),
        lambda *a: _moved(*a, False),
    )
    given = (*BASE, NODES.T, ROOT, TARGET)

    def begun(*a):
        return lobe_squares.begin(Parameters(*a[:3]), Base(*a[3:6]), Problem(*a[6:9]), signed=False)

    def begun_twin(*a):
        found = _equations(*_residuals(*a, signed=False))
        return *a[:3], *found, np.array(0.01, LD)

    yield Hard(
        "lobe_squares.begin", "lobes", lambda *a: _unpacked(begun(*a)), (*LOBES, *given), begun_twin
    )

    def descended(*a):
        # Damped so much that each step lowers the cost by far more than rounding.
        state = begun(*a[:9])
        state = Progress(state.at, state.system, a[9])
        found = lobe_squares.levenberg_marquardt(
            state, Base(*a[3:6]), Problem(*a[6:9]), 2, SHARPEST, signed=False
        )
        return *found.at, found.system.cost, found.damping

    def descended_twin(*a):
        at, damping = a[:3], a[9]
        *system, cost = _equations(*_residuals(*a[:9], signed=False))
        for _ in range(2):
            at = _moved(*at, _step(*system, damping, a[10]), False)
            *system, now = _equations(*_residuals(*at, *a[3:9], signed=False))
            assert now < 0.99 * cost  # else both might choose otherwise
            cost, damping = now, damping * LD(0.2)
        return *at, cost, damping

    # A coarse node under one lobe, a fine one under the other, and a cap in between.
    yield Hard(
        "lobe_squares.resolved",
        "cells",
        lambda mu, s, solid: lobe_squares.resolved(mu, s, solid, 50.0),
        (np.eye(3)[:2], np.eye(3), np.array([0.5, 1e-3, 1.0])),
        lambda mu, s, solid: np.array([2 * PI / solid[0], LD(50)]),
        smooth=False,  # the gradient goes to the nearest node alone, and the cap has none
    )
    # Of one lobe; and of a faint one that would have to be negative: one factor for both.
    for label, alpha, whole in (("one", [2.0], 3.0), ("faint", [1.0, 1e-3], 0.3)):
        count = len(alpha)
        yield Hard(
            "lobe_squares.restored",
            label,
            partial(lobe_squares.restored, signed=False),
            (np.array(alpha)[:, None], np.array([whole]), np.eye(3)[:count], np.full(count, 9.0)),
            lambda a, whole, mu, k: a * (whole / a.sum(0)),
            gradient_ulps=1e4,
        )
    yield Hard(
        "lobe_squares.levenberg_marquardt",
        "two steps",
        descended,
        (*LOBES, *given, 1.0, 1 / 3),
        descended_twin,
        ulps=64,
        gradient_ulps=1e5,
    )


def _polar(axis, core, rings, sectors):
    y, dy = np.polynomial.legendre.leggauss(rings)
    y, dy = (y.astype(LD) + 1) / 2, dy.astype(LD) / 2
    reach = np.arcsinh(1 / core)
    x, dx = core * np.sinh(reach * y), core * reach * np.cosh(reach * y) * dy
    angle = 2 * PI * (np.arange(sectors) + LD(1) / 2) / sectors
    t = 2 * x * x
    across = np.sqrt(t * (2 - t))[:, None, None]
    first, second = _tangents(axis)
    around = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    s = across * around + (1 - t)[:, None, None] * axis
    return s.reshape(-1, 3), np.repeat(4 * x * dx * 2 * PI / sectors, sectors)


def _grids():
    for label, axis, core in (("slant", SLANT, 0.3), ("down", BELOW, 0.01)):
        yield Hard(
            "quadrature.polar_grid",
            label,
            lambda axis, core: quadrature.polar_grid(axis, 4, 3, core),
            (axis, core),
            lambda axis, core: _polar(axis, core, 4, 3),
            # x = core sinh(reach y) with reach 5.3: rounding of the exponent; near the opposite
            # pole the root of 2 - t.
            ulps=64,
            gradient_ulps=1e4,
        )
