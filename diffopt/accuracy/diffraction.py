"""Studies of the diffraction methods: window, patch, nodes, rounding.

Inputs are the same on every machine and with either type: heights are drawn in float64 and
rounded to float32 once, so that both types see the same surface. Directions and wavelengths
are rounded by each type for itself, as they are for a caller.
"""

import functools

import jax
import numpy as np

from diffopt import samples
from diffopt.accuracy.jobs import (
    WAVELENGTHS,
    hard_and_random,
    stack_job,
    truth,
    wave_vectors,
)
from diffopt.accuracy.studies import Case, Job, Study
from diffopt.diffraction import DiffractionBRDF
from diffopt.heightfield import Heightfield
from diffopt.methods import Coverage
from diffopt.settings import DirectSettings, SeparableSettings, TaylorSettings

DIRECT = "the direct sum in float64"
TO_PEAK = "largest error of |P|^2 relative to a mirror's peak"


@functools.cache
def _rough(n: int, pixel: float) -> np.ndarray:
    """Gaussian roughness, 0.05 um over 0.5 um, [n, n]."""
    with jax.enable_x64(True):
        surface = samples.gaussian_roughness(
            jax.random.key(0), shape=(n, n), pixel=pixel, rms=0.05, correlation_length=0.5
        )
        return np.asarray(surface.heights, np.float32)


def _window(quick: bool) -> list[Case]:
    pixel, n = 0.1, 64
    wave = wave_vectors(63)
    stack = _rough(n, pixel)[None]

    def case(average: Coverage, ratio, reach):
        # Truncation of 60 terms over the phase range of about 10 is below 1e-20.
        settings = TaylorSettings(terms=60, reach=reach)
        return Case(
            {"average": average, "side_over_sigma": ratio, "reach": reach},
            "float64",
            lambda: stack_job(stack, pixel, n * pixel / ratio, average, wave, settings, "float64"),
            (average, reach),
        )

    return [
        case(average, ratio, reach)
        for average in ("window", "positions")
        for ratio in (4, 8)
        for reach in ((2, 4) if quick else range(1, 9))
    ]


WINDOW = Study(
    name="diffraction.window",
    quantity=f"Fourier bins gathered on either side, {TO_PEAK}",
    reference=f"{DIRECT} under the window itself",
    cases=_window,
    conditions=("average", "side_over_sigma"),
)


def _patch(quick: bool) -> list[Case]:
    pixel, sigma, large = 0.125, 1.25, 160  # 16 sigma_s a side: exp(-32) at its edge
    wave = wave_vectors(63)
    shifts = [(37 * i % large, 59 * i % large) for i in range(2 if quick else 8)]
    whole = np.stack([np.roll(_rough(large, pixel), shift, (0, 1)) for shift in shifts])

    @functools.cache
    def expected():
        return truth(whole, pixel, sigma, "window", wave, WAVELENGTHS)

    def case(ratio):
        def build():
            half = ratio * round(sigma / pixel) // 2
            cut = slice(large // 2 - half, large // 2 + half)
            stack, scale = whole[:, cut, cut], expected().mean()
            job = stack_job(
                stack,
                pixel,
                sigma,
                "window",
                wave,
                DirectSettings(),
                "float64",
                reference=expected(),
            )

            def judge(value):
                error = np.abs(np.asarray(value) - expected())
                worst = error.max() / expected().max()
                return float(error.mean() / scale), f"largest over largest {worst:.1e}"

            estimate = DiffractionBRDF(Heightfield(stack[0], pixel), sigma, average="window")
            return Job(job.function, job.arguments, judge, estimate.patch_error())

        return Case({"side_over_sigma": ratio}, "float64", build)

    return [case(ratio) for ratio in ((4, 8) if quick else (3, 4, 5, 6, 8, 10))]


PATCH = Study(
    name="diffraction.patch",
    quantity="a patch cut out of a rough surface, mean error of |P|^2 over its mean; "
    "beside it the estimate patch_error()",
    reference=f"{DIRECT} on the surface, 16 sigma_s wide",
    cases=_patch,
)


def _nodes(quick: bool) -> list[Case]:
    n, pixel, sigma = (128, 0.1, 1.6) if quick else (256, 0.05, 1.6)
    wave = wave_vectors(31 if quick else 127)
    with jax.enable_x64(True):
        disc = samples.compact_disc(jax.random.key(0), shape=(n, n), pixel=pixel)
        stack = np.asarray(disc.heights, np.float32)[None]

    @functools.cache
    def expected(average):
        return truth(stack, pixel, sigma, average, wave, WAVELENGTHS)

    def case(average, dtype, nodes):
        return Case(
            {"average": average, "dtype": dtype, "nodes": nodes},
            dtype,
            lambda: stack_job(
                stack,
                pixel,
                sigma,
                average,
                wave,
                SeparableSettings(nodes=nodes),
                dtype,
                reference=expected(average),
                gradient=0 if nodes == 8 else None,
            ),
        )

    return [
        case(average, dtype, nodes)
        for average in (("positions",) if quick else ("positions", "window"))
        for dtype, counts in (
            ("float32", (2, 6) if quick else (1, 2, 3, 4, 5, 6, 8, 12)),
            ("float64", (6,) if quick else (8, 12, 16)),
        )
        for nodes in counts
    ]


NODES = Study(
    name="diffraction.nodes",
    quantity=f"Chebyshev nodes in w on a compact disc, {TO_PEAK}",
    reference=DIRECT,
    cases=_nodes,
    conditions=("average",),
)


def _rounding(quick: bool) -> list[Case]:
    sides = ((64, 0.1),) if quick else ((64, 0.1), (256, 0.1), (512, 0.2))
    ranges = (1.0, 250.0) if quick else (1.0, 5.0, 25.0, 100.0, 250.0)
    wave = wave_vectors(31)

    def case(average, side, x):
        n, pixel = side
        return Case(
            {"average": average, "side_um": n * pixel, "phase_range": x},
            "float32",
            lambda: stack_job(
                hard_and_random(x, n),
                pixel,
                n * pixel / 8.0,
                average,
                wave,
                DirectSettings(),
                "float32",
                names=("binary", "random"),
            ),
            (average, side),
        )

    return [
        case(average, side, x)
        for average in ("positions", "window", "patch")
        for side in sides
        for x in ranges
    ]


ROUNDING = Study(
    name="diffraction.rounding",
    quantity=f"rounding of the direct sum in float32, {TO_PEAK}; beside it the estimate",
    reference=DIRECT,
    cases=_rounding,
    conditions=("average", "side_um", "phase_range"),
)
