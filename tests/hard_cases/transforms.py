"""The windowed transform, directly and by matrix products."""

from functools import partial

import jax.numpy as jnp
import numpy as np

from diffopt.kernels import dtft, separable
from hard_cases.base import LD, Hard, dirichlet, turn
from hard_cases.patch import (
    DEEP,
    FLAT,
    ROUGH,
    STEP,
    amplitude,
    averaged,
    bins,
    gaussian,
    intensity,
    positions,
    power,
)


def transforms():
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
            gaussian,
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
            bins,
            smooth=f == 0.3,  # elsewhere a bin stands where two aliases meet
        )
    yield Hard("dtft.bin_weights", "narrow", partial(dtft.bin_weights, 6, STEP), (0.1, 1e-6), bins)
    yield Hard(
        "dtft.positions",
        "one sample",
        lambda x: dtft.positions(1, STEP, x.dtype) + 0.0 * x,
        (1.0,),
        lambda x: np.zeros(1, LD),
    )
    ax, ay = gaussian(LD(0.4), LD(0.3), LD(0.1), 5), gaussian(LD(-0.7), LD(0.3), LD(0.0))
    wx, wy = bins(LD(0.4), LD(0.6), 5), bins(LD(-0.7), LD(0.6))
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
        yield Hard("dtft.amplitude", name, dtft.amplitude, (h, s, ax, ay), amplitude, **options)
        yield Hard(
            "dtft.coherent_intensity",
            name,
            dtft.coherent_intensity,
            (h, s, ax, ay),
            intensity,
            **options,
        )
        yield Hard("dtft.power_spectrum", name, dtft.power_spectrum, (h, s), power, **options)
        yield Hard(
            "dtft.averaged_intensity",
            name,
            dtft.averaged_intensity,
            (h, s, wx, wy),
            averaged,
            **options,
        )
    one = np.ones((2, 1)) * [[1.0], [0.0]]
    yield Hard(
        "dtft.coherent_intensity",
        "one sample",
        dtft.coherent_intensity,
        (np.full((1, 1), 0.1), -3.0, one, one),
        intensity,
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
            lambda h, s: np.array([averaged(h, v, wx, wy) for v in s]),
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
            lambda h, s: np.array([intensity(h, v, ax, ay) for v in s]),
            ulps=300,
            smooth=name == "two w",
            gradient_ulps=3e4,
        )


def _contract(y, c, s, x):
    total = (y[0, 0] + 1j * y[1, 0]) @ (c + 1j * s) @ (x[0, 0] + 1j * x[1, 0])
    return np.array([total.real]), np.array([total.imag])


def _finite(f, n, copies):
    cos, sin = turn(f * positions(n))
    re, im = dirichlet(f * n * LD(STEP), copies)
    return np.stack([cos * re - sin * im, cos * im + sin * re]) / n
