"""The inputs on which numerical code breaks, by kernel: limits, poles, cancellations.

Every array-valued public function of `diffopt.kernels` has at least one row here (a test
sees to it). A row gives the arguments and a twin in NumPy extended precision (80 bits);
values, compiled and not, in both dtypes, are compared with the twin, gradients with central
differences of the twin. `ulps` is the error allowed, in units of the dtype's eps times the
largest value; its reason stands beside it where it is not a handful of operations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import gammaln

from diffopt.kernels import (
    bessel,
    dtft,
    ensemble,
    expansions,
    frames,
    fresnel,
    gather,
    phase,
    prefactor,
    separable,
    special,
    spectrum,
    spline,
    uniforms,
    vmf_sampling,
)

LD = np.longdouble
PI = LD("3.14159265358979323846264338327950288")


@dataclass(frozen=True)
class Hard:
    """One hard input of one kernel."""

    kernel: str
    label: str
    call: Callable
    arguments: tuple
    twin: Callable
    ulps: float = 8.0
    smooth: bool = True
    gradient_ulps: float = 1e3


def rows():
    """All hard cases."""
    yield from _phases()
    yield from _transforms()
    yield from _expansions()
    yield from _directions()
    yield from _ensembles()
    yield from _bessels()
    yield from _reflectances()
    yield from _colours()
    yield from _splines()


def _turn(t):
    """Cosine and sine of an angle in turns, reduced exactly."""
    angle = 2 * PI * (t - np.round(t))
    return np.cos(angle), np.sin(angle)


def _phases():
    for t in (0.0, 0.25, 0.5, -0.75, 1e-30, 2.0**20 + 0.125):
        yield Hard("phase.cis_turns", f"t={t}", phase.cis_turns, (t,), _turn, gradient_ulps=64)
    for t in (-1.0, 1.0, 0.0, float(np.cos(np.pi / 10))):
        yield Hard(
            "phase.chebyshev_weights",
            f"t={t}",
            partial(phase.chebyshev_weights, nodes=5),
            (t,),
            lambda t: _lagrange(t, 5),
            ulps=30,
            gradient_ulps=500,  # the slope of a Chebyshev polynomial of degree 4 is up to 16
        )
        for kernel in (phase.chebyshev_rows, phase.chebyshev_polynomials):
            yield Hard(
                f"phase.{kernel.__name__}",
                f"t={t}",
                partial(kernel, count=40),
                (t,),
                lambda t: _polynomials(t, 40),
                # T_n' is n^2 at the ends, and so is what rounding of t and of the recurrence makes
                ulps=800,
                gradient_ulps=1e6,  # T_39'' is up to 1e6
            )
    yield Hard(
        "phase.chebyshev_points",
        "one node",
        lambda x: phase.chebyshev_points(1, x.dtype) + 0.0 * x,
        (1.0,),
        lambda x: 0.0 * x,
    )
    for x in (0.0, 1e-9, 0.5, -0.4999999, 13.25):
        yield Hard(
            "special.sinc",
            f"x={x}",
            special.sinc,
            (x,),
            lambda x: np.sin(PI * x) / (PI * x) if x else LD(1),
            smooth=abs(x) > 1e-8,
            gradient_ulps=200,
        )
    for t, n in ((0.0, 26), (3.0, 26), (2.0 + 2.0**-12, 26), (0.5, 7), (1e-9, 1001)):
        yield Hard(
            "special.dirichlet",
            f"t={t}, N={n}",
            partial(special.dirichlet, copies=n),
            (t,),
            partial(_dirichlet, n=n),
            ulps=8 + n,  # rounding of N t
            gradient_ulps=20 * n,
        )


def _lagrange(t, nodes):
    points = np.cos(PI * (np.arange(nodes) + LD(0.5)) / nodes)
    out = []
    for j in range(nodes):
        others = np.delete(points, j)
        out.append(np.prod((t - others) / (points[j] - others)))
    return np.array(out)


def _polynomials(t, count):
    values = [LD(1), t]
    for _ in range(count - 2):
        values.append(2 * t * values[-1] - values[-2])
    return np.array(values[:count])


def _dirichlet(t, n):
    cos, sin = _turn((t - np.round(t)) * np.arange(n))
    return cos.mean(), sin.mean()


# A patch of 6 x 5 samples, its window and its transforms, written out.
STEP = 0.25
ROUGH = np.mod(0.7548776662466927 * np.arange(5) + 0.5698402909980532 * np.arange(6)[:, None], 1)
FLAT = np.zeros((6, 5))
DEEP = 11.0 * ROUGH  # 20 wavelengths of 0.55 um


def _positions(n):
    return (np.arange(n) - n // 2) * LD(STEP)


def _gaussian(f, sigma, center, n=6):
    length = n * LD(STEP)
    center = center - length * np.round(center / length)
    x = _positions(n)[None] + length * np.arange(-12, 13)[:, None]
    g = np.exp(-((x - center) ** 2) / (2 * sigma**2)) * LD(STEP) / (np.sqrt(2 * PI) * sigma)
    cos, sin = _turn(f * x)
    return np.stack([(g * cos).sum(0), (g * sin).sum(0)])


def _bins(f, spread, n=6):
    d = f - np.arange(n) / (n * LD(STEP))
    d = d - np.round(d * LD(STEP)) / LD(STEP)
    return np.exp(-((d / spread) ** 2))


def _amplitude(h, s, ax, ay):
    cos, sin = _turn(s * h)
    p = (cos + 1j * sin) * (ay[0] + 1j * ay[1])[:, None] * (ax[0] + 1j * ax[1])[None, :]
    return p.sum().real, p.sum().imag


def _intensity(h, s, ax, ay):
    re, im = _amplitude(h, s, ax, ay)
    return re**2 + im**2


def _power(h, s):
    cos, sin = _turn(s * h)
    p = cos + 1j * sin
    out = []
    for n in h.shape:
        k = np.outer(np.arange(n), np.arange(n)) / LD(n)
        c, q = _turn(k)
        out.append((c + 1j * q) / n)
    c = out[0] @ p @ out[1].T
    return c.real**2 + c.imag**2


def _averaged(h, s, wx, wy):
    return wy @ _power(h, s) @ wx


def _transforms():
    axis = partial(dtft.gaussian_axis, 6, STEP)
    for f, sigma, center in (
        (0.0, 0.3, 0.0),
        (2.0, 0.25, 0.0),
        (-1.9, 0.7, 40.1),
        (0.3, 0.5, -0.75),
    ):
        yield Hard(
            "dtft.gaussian_axis",
            f"f={f}, sigma={sigma}, at {center}",
            axis,
            (f, sigma, center),
            _gaussian,
            ulps=60,  # turns of f x up to 10, x4 in 2 pi
            smooth=abs(center) < 0.5,
            gradient_ulps=2e3,
        )
    for f in (0.0, 0.3, 2.0, 4.0, -1e-20):
        yield Hard(
            "dtft.finite_axis",
            f"f={f}",
            lambda f: dtft.finite_axis(6, STEP, f, 3),
            (f,),
            lambda f: _finite(f, 6, 3),
            ulps=60,
            gradient_ulps=2e3,
        )
        yield Hard(
            "dtft.bin_weights",
            f"f={f}",
            partial(dtft.bin_weights, 6, STEP),
            (f, 0.6),
            _bins,
            smooth=f == 0.3,  # elsewhere a bin stands where two aliases meet
        )
    yield Hard("dtft.bin_weights", "narrow", partial(dtft.bin_weights, 6, STEP), (0.1, 1e-6), _bins)
    yield Hard(
        "dtft.positions",
        "one sample",
        lambda x: dtft.positions(1, STEP, x.dtype) + 0.0 * x,
        (1.0,),
        lambda x: np.zeros(1, LD),
    )
    ax, ay = _gaussian(LD(0.4), LD(0.3), LD(0.1), 5), _gaussian(LD(-0.7), LD(0.3), LD(0.0))
    wx, wy = _bins(LD(0.4), LD(0.6), 5), _bins(LD(-0.7), LD(0.6))
    for name, h, s in (
        ("flat", FLAT, -3.0),
        ("w = 0", ROUGH, 0.0),
        ("w -> 0", ROUGH, -1e-20),
        ("20 wavelengths", DEEP, -3.6),
        ("rough", ROUGH, -2.0),
    ):
        # Each phase of 40 turns rounds by 40 x 2 pi eps / 2; 30 samples of both signs.
        ulps = 400 if name == "20 wavelengths" else 40
        options = {"ulps": ulps, "gradient_ulps": 100 * ulps}
        yield Hard("dtft.amplitude", name, dtft.amplitude, (h, s, ax, ay), _amplitude, **options)
        yield Hard(
            "dtft.coherent_intensity",
            name,
            dtft.coherent_intensity,
            (h, s, ax, ay),
            _intensity,
            **options,
        )
        yield Hard("dtft.power_spectrum", name, dtft.power_spectrum, (h, s), _power, **options)
        yield Hard(
            "dtft.averaged_intensity",
            name,
            dtft.averaged_intensity,
            (h, s, wx, wy),
            _averaged,
            **options,
        )
    one = np.ones((2, 1)) * [[1.0], [0.0]]
    yield Hard(
        "dtft.coherent_intensity",
        "one sample",
        dtft.coherent_intensity,
        (np.full((1, 1), 0.1), -3.0, one, one),
        _intensity,
        ulps=20,
    )
    yield Hard(
        "separable.contract",
        "one line",
        lambda y, c, s, x: separable.contract(y, (c, s), x, grid=False),
        (ay[:, None], ROUGH, ROUGH, ax[:, None]),
        lambda y, c, s, x: _contract(y, c, s, x),
    )
    for name, s in (("one w", [-2.0, -2.0]), ("two w", [-2.0, -1.5])):
        yield Hard(
            "separable.averaged",
            name,
            lambda h, s: separable.averaged(
                h,
                s,
                jnp.asarray(np.stack([wx, wx]), h.dtype),
                jnp.asarray(np.stack([wy, wy]), h.dtype),
                nodes=22,
                grid=False,
            ),
            (ROUGH, np.array(s)),
            lambda h, s: np.array([_averaged(h, v, wx, wy) for v in s]),
            # the weights of 22 nodes sum 22 products each
            ulps=300,
            smooth=name == "two w",
            gradient_ulps=3e4,
        )
        yield Hard(
            "separable.coherent",
            name,
            lambda h, s: separable.coherent(
                h,
                s,
                jnp.asarray(np.stack([ax, ax], 1), h.dtype),
                jnp.asarray(np.stack([ay, ay], 1), h.dtype),
                nodes=22,
                grid=False,
            ),
            (ROUGH, np.array(s)),
            lambda h, s: np.array([_intensity(h, v, ax, ay) for v in s]),
            ulps=300,
            smooth=name == "two w",
            gradient_ulps=3e4,
        )


def _contract(y, c, s, x):
    total = (y[0, 0] + 1j * y[1, 0]) @ (c + 1j * s) @ (x[0, 0] + 1j * x[1, 0])
    return np.array([total.real]), np.array([total.imag])


def _finite(f, n, copies):
    cos, sin = _turn(f * _positions(n))
    re, im = _dirichlet(f * n * LD(STEP), copies)
    return np.stack([cos * re - sin * im, cos * im + sin * re]) / n


def _coefficients(x, terms):
    n = np.arange(terms)
    return np.concatenate([[LD(1)], np.cumprod(x / n[1:])])


def _lowrank(x, z=0.0, t=1.0):
    """cos(z x t) + sin(z x t) by the low-rank expansion: even and odd terms."""
    series = expansions.lowrank_series(jnp.asarray(z, x.dtype), 16)
    nodes = series.shape[1]
    points = phase.chebyshev_points(nodes, x.dtype)
    values = jnp.cos(z * t * points) + jnp.sin(z * t * points)
    matrix = series @ expansions.chebyshev_projection(nodes, x.dtype)
    return expansions.coefficients(x, 16, series) @ (matrix @ values)


def _interval(low, high, span):
    size = 1 + abs(low + high) / 2
    return (low + high) / 2, max((high - low) / 2, size / max(LD(1), 2 * PI * span * size))


def _expansions():
    for x in (0.0, -10.0, 1e-20):
        yield Hard(
            "expansions.taylor_coefficients",
            f"x={x}",
            lambda x: expansions.taylor_coefficients(x, 30),
            (x,),
            lambda x: _coefficients(x, 30),
            ulps=40,
        )
    for low, high, span in ((-5.0, -1.0, 9.0), (-3.0, -3.0, 0.1), (0.0, 0.0, 0.0)):
        yield Hard(
            "expansions.interval",
            f"{low}, {high}, {span}",
            expansions.interval,
            (low, high, span),
            _interval,
            smooth=False,
        )
    yield Hard(
        "expansions.chebyshev_projection",
        "a parabola",
        lambda f: expansions.chebyshev_projection(5, f.dtype) @ f,
        (np.cos(np.pi * (np.arange(5) + 0.5) / 5) ** 2,),
        lambda f: np.array(
            [
                (2 if n else 1) * (f * np.cos(n * PI * (np.arange(5) + LD(0.5)) / 5)).mean()
                for n in range(5)
            ]
        ),
    )
    for x in (0.0, -1.0, 1.0, 0.3):
        yield Hard(
            "expansions.coefficients",
            f"x={x}",
            partial(expansions.coefficients, terms=9),
            (x,),
            lambda x: _polynomials(x, 9),
            ulps=100,
            gradient_ulps=1e4,
        )
        for z in (0.0, 1e-8, 3.0) if x in (-1.0, 0.3) else ():
            yield Hard(
                "expansions.lowrank_series",
                f"x={x}, z={z}",
                partial(_lowrank, z=z, t=0.7),
                (x,),
                lambda x, z=z: np.cos(LD(z) * LD(0.7) * x) + np.sin(LD(z) * LD(0.7) * x),
                # sums of 30 products, their slopes up to 30^2 times as large
                ulps=100,
                gradient_ulps=1e4,
            )
    for at in ((0.0, 0.0), (0.26, -40.1), (1e-20, 0.124)):
        yield Hard(
            "gather.whole_pixels",
            f"{at}",
            lambda p: jnp.concatenate(
                [v.astype(p.dtype) for v in gather.whole_pixels(p, (STEP, STEP))]
            ),
            (np.array(at),),
            lambda p: np.concatenate(
                [np.round(p / LD(STEP)), p - np.round(p / LD(STEP)) * LD(STEP)]
            ),
            smooth=False,
        )
        yield Hard(
            "gather.move_origin",
            f"{at}",
            lambda p: gather.move_origin(jnp.ones((8, 7, 2, 1), p.dtype), p, 1)[..., 0],
            (np.mod(np.array(at), 0.1),),
            _moved,
            ulps=20,
            gradient_ulps=400,
        )
    for name, h in (("flat", FLAT), ("rough", ROUGH), ("20 wavelengths", DEEP)):
        deep = name == "20 wavelengths"
        yield Hard(
            "gather.height_scale",
            name,
            partial(gather.height_scale, centred=False),
            (h,),
            lambda h: (h.min(), np.ptp(h) if np.ptp(h) > 0 else LD(1)),
            smooth=False,
        )
        yield Hard(
            "gather.taylor_spectra",
            name,
            lambda h: gather.taylor_spectra(h, 3, centred=False)[0],
            (h,),
            lambda h: _delta(h.shape),
            smooth=False,
        )
        # Phases of 40 turns round by 40 x 2 pi eps / 2.
        options = {"ulps": 400 if deep else 40, "smooth": False}
        yield Hard(
            "gather.node_spectra",
            name,
            lambda h, s: jnp.square(gather.node_spectra(h, s)).sum(1),
            (h, np.array([-3.6, -1.0])),
            lambda h, s: np.stack([_power(h, v) for v in s]),
            **options,
        )
        yield Hard(
            "gather.node_powers",
            name,
            lambda h, s: gather.node_powers(h, s)[:, 0],
            (h, np.array([-3.6, -1.0])),
            lambda h, s: np.stack([_power(h, v) for v in s]),
            **options,
        )
    yield Hard(
        "gather.project",
        "two by three",
        lambda m, s: gather.project(m, s.reshape(3, 1, 6, 5)).ravel(),
        (MIX, np.stack([ROUGH, FLAT, -ROUGH])),
        lambda m, s: (m @ s.reshape(3, -1)).ravel(),
    )
    yield Hard(
        "gather.table",
        "one term",
        lambda h: gather.table(h[None, None], 2)[:, :, 0, 0],
        (ROUGH,),
        lambda h: np.pad(np.fft.fftshift(h), 2, mode="wrap"),
    )
    for name, h in (("flat", FLAT), ("rough", ROUGH)):
        for mode, twin in (
            ("gather_bins", _all_bins),
            ("gather_sum", _weighted_all),
            ("averaged", _averaged_all),
            ("coherent", _coherent_all),
        ):
            yield Hard(
                f"gather.{mode}",
                name,
                partial(_gathered, mode),
                (h, -3.0),
                twin,
                ulps=400,
                smooth=False,
            )
    for f in (0.0, 1.999, -2.0):
        yield Hard(
            "gather.axis_bins",
            f"f={f}",
            lambda f: gather.axis_bins(6, STEP, f, 2)[1],
            (f,),
            lambda f: f - (np.round(f * LD(1.5)) + np.arange(-2, 3)) / LD(1.5),
            smooth=False,
        )


MIX = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, 1e-3]])


def _moved(p):
    (cy, sy), (cx, sx) = (_turn(-(np.arange(n) - n // 2) * v) for n, v in ((8, p[0]), (7, p[1])))
    factor = (cy + 1j * sy)[:, None] * (cx + 1j * sx)[None, :] * (1 + 1j)
    return np.stack([factor.real, factor.imag], -1)


def _delta(shape):
    out = np.zeros((2, *shape), LD)
    out[0, 0, 0] = 1
    return out


def _scaled(h, x):
    """Heights such that x is the phase of the highest point."""
    span = np.ptp(h) if np.ptp(h) > 0 else LD(1)
    return (h - h.min()) / span, x / (2 * PI)


def _gathered(mode, h, x):
    """All bins (reach 2 of a 5 x 5 patch) around zero frequency."""
    h = h[:5]
    tables = gather.table(gather.taylor_spectra(h, 24, centred=False), 2)
    a = expansions.taylor_coefficients(x, 24)
    bins = gather.axis_bins(5, STEP, jnp.zeros((), h.dtype), 2)
    width = jnp.asarray(0.6, h.dtype)
    if mode == "gather_bins":
        out = gather.gather_bins(tables, a, (bins[0], bins[0]), taps=5)
        return out[..., 0], out[..., 1]
    if mode == "gather_sum":
        w = jnp.arange(1, 6).astype(h.dtype)
        return gather.gather_sum(tables, a, (bins[0], bins[0]), w, 0.5 * w)
    if mode == "averaged":
        return gather.averaged(tables, a, bins, bins, width)
    return gather.coherent(tables, a, bins, bins, width)


def _spectrum(h, x):
    t, s = _scaled(h[:5], x)
    cos, sin = _turn(s * t)
    n = np.arange(5) - 2
    c, q = _turn(np.outer(n, n) / LD(5))
    e = (c + 1j * q) / 5
    return e @ (cos + 1j * sin) @ e.T


def _all_bins(h, x):
    c = _spectrum(h, x)
    return c.real, c.imag


def _weighted_all(h, x):
    w = np.arange(1, 6)
    c = w @ _spectrum(h, x) @ w / 2
    return np.array([c.real, c.imag])


def _averaged_all(h, x):
    w = np.exp(-((((np.arange(5) - 2) / LD(1.25)) / LD(0.6)) ** 2))
    return w @ np.abs(_spectrum(h, x)) ** 2 @ w


def _coherent_all(h, x):
    w = np.exp(-((2 * PI * LD(0.6) * (np.arange(5) - 2) / LD(1.25)) ** 2) / 2)
    return np.abs(w @ _spectrum(h, x) @ w) ** 2


def _unit(degrees, azimuth=0.0):
    t, p = np.radians(degrees), np.radians(azimuth)
    return np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)])


GRAZING = _unit(89.999)


def _square(q):
    return (q * q).sum()


def _directions():
    pairs = {
        "normal": (_unit(0), _unit(0)),
        "grazing mirror": (GRAZING, GRAZING * [-1, -1, 1]),
        "grazing retro": (GRAZING, GRAZING),
        "one grazing": (GRAZING, _unit(10, 40.0)),
    }
    # The pole, the horizon, a full turn less a rounding, many turns.
    for sin, turns, cos in ((0.0, 0.3, 1.0), (1.0, 0.25, 0.0), (0.6, 1.0 - 2.0**-24, -0.8)):
        yield Hard(
            "frames.around",
            f"turns={turns:.3g}",
            frames.around,
            (sin, turns, cos),
            lambda s, t, c: np.array([s * _turn(t)[0], s * _turn(t)[1], c]),
        )
    # Not real-valued in its arguments; the numbers have tests of their own.
    held = np.stack(uniforms.pairs(jax.random.key(7), 3)).astype(LD)
    yield Hard(
        "uniforms.pairs",
        "scaled",
        lambda x: tuple(p.astype(x.dtype) * x for p in uniforms.pairs(jax.random.key(7), 3)),
        (2.0,),
        lambda x: tuple(row * x for row in held),
    )
    # Counted from 0, a pair at a time: the same words.
    counter = jnp.arange(3, dtype=jnp.uint32)

    def at(x):
        return uniforms.at(jax.random.key(7), jnp.zeros_like(counter), counter)

    yield Hard(
        "uniforms.at",
        "scaled",
        lambda x: tuple(p.astype(x.dtype) * x for p in at(x)),
        (2.0,),
        lambda x: tuple(row * x for row in held),
    )
    up = jnp.asarray([0.0, 0.0, 1.0])

    def around_z(kappa):
        u, v = held
        t = -np.log1p(v * np.expm1(-2 * kappa)) / kappa
        sin, (cos_u, sin_u) = np.sqrt(t * (2 - t)), _turn(u)
        return np.stack([sin * cos_u, sin * sin_u, 1 - t], -1)

    yield Hard(
        "vmf_sampling.sample",
        "kappa=30",
        lambda k: vmf_sampling.sample(jax.random.key(7), up.astype(k.dtype), k, 3),
        (30.0,),
        around_z,
    )
    for name, (wi, wo) in pairs.items():
        wave = -(wi + wo)
        yield Hard("frames.wave_vector", name, frames.wave_vector, (wi, wo), lambda a, b: -(a + b))
        yield Hard(
            "frames.half_cosine",
            name,
            frames.half_cosine,
            (wave,),
            lambda q: np.sqrt(_square(q)) / 2,
        )
        yield Hard(
            "frames.v_cavity",
            name,
            frames.v_cavity,
            (wave, wi[2], wo[2]),
            lambda q, a, b: min(LD(1), 4 * abs(q[2]) * min(a, b) / _square(q)),
            smooth=name == "one grazing",
        )
        yield Hard(
            "frames.above_horizon",
            name,
            lambda a, b: frames.above_horizon(a, b)[1:],
            (wi, wo),
            lambda a, b: (a, b),
            smooth=False,
        )
        twins = {
            "stam": lambda q, a, b: (_square(q) / q[2]) ** 2 / (4 * a * b),
            "ghs": lambda q, a, b: b / a,
            "rghs": lambda q, a, b: q[2] ** 2 / (4 * a * b),
            "kirchhoff": lambda q, a, b: 1 / (4 * a * b),
        }
        for model, twin in twins.items():
            # the gradient divides by cosines of 1.7e-5: relative differences, not ulps, of it
            yield Hard(
                "prefactor.geometric_factor",
                f"{model}, {name}",
                partial(prefactor.geometric_factor, model),
                (wave, wi[2], wo[2]),
                twin,
                ulps=16,
            )
        yield Hard(
            "prefactor.height_factor",
            name,
            partial(prefactor.height_factor, "stam"),
            (wave,),
            lambda q: q[2],
        )
        yield Hard(
            "prefactor.kirchhoff_weight",
            name,
            prefactor.kirchhoff_weight,
            (wave, ROUGH, -ROUGH),
            lambda q, x, y: q[0] * x + q[1] * y - q[2],
        )
    for theta, phi in ((0.0, 0.0), (np.pi / 2, np.pi), (1e-20, 3.0)):
        yield Hard(
            "frames.spherical",
            f"{theta:.3g}, {phi:.3g}",
            frames.spherical,
            (theta, phi),
            lambda t, p: np.array([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)]),
        )


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


def _bessels():
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


def _ensembles():
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


def _dielectric(cos, n):
    ct = np.sqrt(np.asarray(1 - (1 - cos**2) / n**2, np.clongdouble))
    rs, rp = (cos - n * ct) / (cos + n * ct), (n * cos - ct) / (n * cos + ct)
    return np.abs(rs) ** 2, np.abs(rp) ** 2


def _conductor(cos, eta, k):
    return _dielectric(cos, eta + 1j * k)


def _reflectances():
    for cos in (0.0, 1e-20, 1e-4, 0.5, 1.0):
        edge = cos in (0.0, 1e-20, 1.0)
        for n in (0.67, 1.0 + 2.0**-20, 1.5):
            smooth = (n == 1.5 and not edge) or (cos == 0.5 and n == 0.67)
            arguments = (np.float64(cos), n)
            yield Hard(
                "fresnel.dielectric_polarised",
                f"cos={cos}, n={n}",
                fresnel.dielectric_polarised,
                arguments,
                _dielectric,
                ulps=60,
                smooth=smooth,
                gradient_ulps=1e5,
            )
            yield Hard(
                "fresnel.dielectric",
                f"cos={cos}, n={n}",
                fresnel.dielectric,
                arguments,
                lambda c, n: sum(_dielectric(c, n)) / 2,
                ulps=60,
                smooth=smooth,
                gradient_ulps=1e5,
            )
        for eta, k in ((0.96, 6.7), (1.5, 1e-6), (0.05, 3.0)):
            arguments = (np.float64(cos), eta, k)
            yield Hard(
                "fresnel.conductor_polarised",
                f"cos={cos}, {eta}+{k}i",
                fresnel.conductor_polarised,
                arguments,
                _conductor,
                ulps=60,
                smooth=not edge,
                gradient_ulps=1e5,
            )
            yield Hard(
                "fresnel.conductor",
                f"cos={cos}, {eta}+{k}i",
                fresnel.conductor,
                arguments,
                lambda c, e, k: sum(_conductor(c, e, k)) / 2,
                ulps=60,
                smooth=not edge,
                gradient_ulps=1e5,
            )
        yield Hard(
            "fresnel.schlick",
            f"cos={cos}",
            fresnel.schlick,
            (np.float64(cos), 0.04),
            lambda c, r: r + (1 - r) * (1 - c) ** 5,
            smooth=not edge,
        )
    for re, im in ((-40.0, 15.0), (2.25, 0.0), (-9.0, 1e-6), (1e-3, 1e-3)):
        yield Hard(
            "fresnel.index_from_permittivity",
            f"{re}+{im}i",
            fresnel.index_from_permittivity,
            (re, im),
            _index,
            ulps=20,
            smooth=im > 1e-3,
        )


def _index(re, im):
    size = np.hypot(re, im)
    larger = np.sqrt((size + np.abs(re)) / 2)
    smaller = im / (2 * larger)
    return (larger, smaller) if re >= 0 else (smaller, larger)


MATRIX = np.array([[3.24, -1.54, -0.5], [-0.97, 1.88, 0.04], [0.06, -0.2, 1.06]])


def _colours():
    for value in (0.0, 0.0031308, -0.2, 1.0, 1e-30, 7.0):
        yield Hard(
            "spectrum.encode_srgb",
            f"{value}",
            spectrum.encode_srgb,
            (value,),
            lambda x: (
                12.92 * x
                if abs(x) <= 0.0031308
                else np.sign(x) * (LD(1.055) * np.abs(x) ** (1 / LD(2.4)) - LD(0.055))
            ),
            ulps=16,
            smooth=value != 0.0031308,
        )
        yield Hard(
            "spectrum.decode_srgb",
            f"{value}",
            spectrum.decode_srgb,
            (value,),
            lambda x: (
                x / LD(12.92)
                if abs(x) <= 0.04045
                else np.sign(x) * ((np.abs(x) + LD(0.055)) / LD(1.055)) ** LD(2.4)
            ),
            ulps=16,
        )
    for name, rgb, y in (
        ("inside", [0.2, 0.3, 0.4], 0.29),
        ("negative", [-0.5, 0.6, 0.1], 0.33),
        ("black", [0.0, 0.0, 0.0], 0.0),
        ("dark", [-0.1, -0.1, 0.2], -0.05),
    ):
        rgb = np.array(rgb)
        for choice in spectrum.GAMUTS:
            yield Hard(
                "spectrum.fit_gamut",
                f"{choice}, {name}",
                partial(spectrum.fit_gamut, choice=choice),
                (rgb, y),
                partial(_gamut, choice=choice),
                smooth=False,
            )
        yield Hard(
            "spectrum.desaturate",
            name,
            spectrum.desaturate,
            (rgb, y),
            partial(_gamut, choice="desaturate"),
            smooth=False,
        )
        yield Hard(
            "spectrum.transform",
            name,
            spectrum.transform,
            (rgb, MATRIX),
            lambda x, m: m @ x,
            ulps=16,
        )
        yield Hard(
            "spectrum.weights_to_xyz",
            name,
            spectrum.weights_to_xyz,
            (rgb, MATRIX),
            lambda x, m: x @ m,
            ulps=16,
        )
    yield Hard(
        "spectrum.trapezoid_weights",
        "uneven",
        spectrum.trapezoid_weights,
        (np.array([0.38, 0.4, 0.5, 0.78]),),
        lambda x: np.array(
            [(x[1] - x[0]) / 2, (x[2] - x[0]) / 2, (x[3] - x[1]) / 2, (x[3] - x[2]) / 2]
        ),
        ulps=16,
    )


def _gamut(rgb, y, choice):
    if choice == "none":
        return rgb
    if choice == "clip":
        return np.maximum(rgb, 0)
    if y <= 0:
        return 0 * rgb
    t = min([LD(1)] + [y / (y - c) for c in rgb if c < 0])
    return np.maximum(y + t * (rgb - y), 0)


def _bspline(x, order):
    """The B-spline of a degree, centred, by its truncated powers."""
    total = LD(0) * x
    for k, binomial in enumerate({1: (1, 2, 1), 2: (1, 3, 3, 1), 3: (1, 4, 6, 4, 1)}[order]):
        term = np.maximum(x - k + LD(order + 1) / 2, LD(0)) ** order
        total = total + (-1) ** k * binomial * term
    return total / {1: 1, 2: 2, 3: 6}[order]


def _spline_value(table, x, y, z, order):
    total = LD(0)
    for j, i, k in np.ndindex(table.shape[:3]):
        weight = _bspline(y[0] - j, order) * _bspline(x[0] - i, order) * _bspline(z[0] - k, 3)
        total = total + weight * table[j, i, k]
    return total[None]


def _spline_coefficients(values, order):
    """Those whose spline passes through the samples, reflected at both ends, by iteration."""
    middle, side = {2: (LD(6) / 8, LD(1) / 8), 3: (LD(4) / 6, LD(1) / 6)}[order]
    c = values
    for _ in range(400):  # the error falls by 2/3 each time
        padded = np.concatenate([c[1:2], c, c[-2:-1]])
        c = c + values - (middle * c + side * (padded[:-2] + padded[2:]))
    return c


def _splines():
    for order in (1, 2, 3):
        # At the knots, beside them, and in the middle between.
        for t in (0.0, 1e-8, 0.5) if order == 2 else (0.0, 1e-8, 0.5, 1.0):
            shift = 0 if order == 2 else 1
            places = range(-1, 2) if order == 2 else range(1 - (order + 1) // 2, order // 2 + 2)
            yield Hard(
                "spline.weights",
                f"order={order},t={t}",
                partial(spline.weights, order=order),
                (t,),
                partial(
                    lambda t, order, places: tuple(_bspline(t - k, order) for k in places),
                    order=order,
                    places=tuple(places),
                ),
                # The slope of order 1 and the curvature of order 2 jump at the knots.
                smooth=order == 3 or (order == 2 and t < 0.5) or (0 < t < 1 and shift == 1),
                gradient_ulps=1e9 if t == 1e-8 else 1e3,
            )
        table = np.cos(np.arange(5 * 6 * 5.0)).reshape(5, 6, 5, 1)
        for x in (2.0, 2.5, 3.9999, 4.0):
            yield Hard(
                "spline.lookup",
                f"order={order},x={x}",
                partial(spline.lookup, order=order),
                (table, np.array([x]), np.array([2.25]), np.array([3.0])),
                partial(_spline_value, order=order),
                ulps=40,
                smooth=order == 3,
            )
    for x in (0.0, 3.0, 4.9999, 9.0, -2.5, 30.0):
        yield Hard(
            "spline.locate",
            f"x={x}",
            lambda x: spline.locate(x, 10, 3)[1],
            (x,),
            lambda x: x - np.clip(np.floor(x) - 1, 0, 6) - 1,
            smooth=False,
        )
    for order in (2, 3):
        for label, values in (
            ("two", [1.0, -1.0]),
            ("constant", [3.0] * 5),
            ("alternating", [1.0, -1.0] * 6),
        ):
            yield Hard(
                "spline.prefilter",
                f"order={order},{label}",
                partial(spline.prefilter, axis=0, order=order),
                (np.array(values),),
                partial(_spline_coefficients, order=order),
                ulps=40,
            )
    yield Hard(
        "frames.valid_wave_vector",
        "one pair masked",
        partial(frames.valid_wave_vector, jnp.array([False, True])),
        (np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8]]), np.array([[0.0, 0, 1.0], [0.0, -0.6, 0.8]])),
        lambda a, b: -(a + b)[[1, 1]],
    )
