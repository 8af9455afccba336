"""Tables of Fourier bins and the sums over them."""

from functools import partial

import jax.numpy as jnp
import numpy as np

from diffopt.kernels import expansions, gather
from hard_cases.base import LD, PI, Hard, turn
from hard_cases.patch import DEEP, FLAT, ROUGH, STEP, power

MIX = np.array([[1.0, -2.0, 0.5], [0.0, 3.0, 1e-3]])


def gathers():
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
            lambda h, s: np.stack([power(h, v) for v in s]),
            **options,
        )
        yield Hard(
            "gather.node_powers",
            name,
            lambda h, s: gather.node_powers(h, s)[:, 0],
            (h, np.array([-3.6, -1.0])),
            lambda h, s: np.stack([power(h, v) for v in s]),
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


def _moved(p):
    (cy, sy), (cx, sx) = (turn(-(np.arange(n) - n // 2) * v) for n, v in ((8, p[0]), (7, p[1])))
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
    cos, sin = turn(s * t)
    n = np.arange(5) - 2
    c, q = turn(np.outer(n, n) / LD(5))
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
