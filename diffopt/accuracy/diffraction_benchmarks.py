"""Benchmarks of the diffraction methods, their derivative, and colour.

Unit costs in the notes are those of `diffopt.choice.CostModel`.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import colour, gathering, methods
from diffopt.accuracy.benchmarks import Benchmark, Entry
from diffopt.accuracy.jobs import hard_and_random, make_surface, wave_vectors
from diffopt.kernels import dtft, phase, spectrum
from diffopt.methods import Coverage, Surface
from diffopt.settings import (
    ChebyshevSettings,
    DirectSettings,
    GatherSettings,
    LowRankSettings,
    SeparableSettings,
    TaylorSettings,
)

PIXEL = 0.05
PHASE_RANGE = 5.0


def _surface(side: int, coverage: Coverage) -> Surface:
    """Random heights under a window of an eighth of the side."""
    heights = hard_and_random(PHASE_RANGE, side)[1]
    return make_surface(heights, PIXEL, side * PIXEL / 8.0, coverage)


def _with_heights(function: Callable[..., Any], surface: Surface) -> Callable[..., Any]:
    """The function with the heights of the surface as its first argument."""
    return lambda heights, *rest: function(dataclasses.replace(surface, heights=heights), *rest)


def _job(pairs: int, wavelengths: int) -> tuple:
    wave = jnp.asarray(wave_vectors(pairs - 1), "float32")
    return wave, jnp.linspace(0.4, 0.7, wavelengths, dtype="float32")


def _sides(size: str) -> tuple[int, ...]:
    return (256,) if size == "small" else (256, 512)


def _direct(coverage: Coverage) -> Callable[[str], list[Entry]]:
    def entries(size: str) -> list[Entry]:
        wave, wavelengths = _job(16, 1)
        found = []
        for side in _sides(size):
            surface = _surface(side, coverage)

            def run(surface, wave, wavelengths):
                return methods.direct(surface, wave, wavelengths, DirectSettings())

            found.append(
                Entry(
                    "",
                    _with_heights(run, surface),
                    (surface.heights, wave, wavelengths),
                    f"{side}x{side}, 16 evaluations",
                    16 * side * side,
                    "sample",
                    gradient=0,
                )
            )
        return found

    return entries


def _twin(cis: Callable[[Any], Any]) -> Callable[..., Any]:
    """|P|^2 of a window as in `methods.direct`, left to automatic differentiation.

    `cis` gives exp(2 pi i t) of an angle in turns, as a complex array.
    """

    def intensity(surface: Surface, wave, wavelengths):
        ny, nx = surface.heights.shape

        def one(wave):
            q = wave / wavelengths[0]
            ax = dtft.gaussian_axis(nx, PIXEL, q[0], surface.sigma, surface.center[1])
            ay = dtft.gaussian_axis(ny, PIXEL, q[1], surface.sigma, surface.center[0])
            rows = jnp.matmul(cis(q[2] * surface.heights), jax.lax.complex(ax[0], ax[1]))
            p = jnp.sum(rows * jax.lax.complex(ay[0], ay[1]))
            return p.real**2 + p.imag**2

        return jax.lax.map(one, wave)

    return intensity


def _exponential(turns):
    return jnp.exp(jax.lax.complex(jnp.zeros_like(turns), phase.TWO_PI * turns))


def _polynomial(turns):
    # The function under the custom derivative: the same polynomial, differentiated.
    return jax.lax.complex(*phase.cis_turns.fun(turns))


def _derivative(size: str) -> list[Entry]:
    def closed(surface, wave, wavelengths):
        return methods.direct(surface, wave, wavelengths, DirectSettings(chunk=1))

    variants = {
        "closed form": closed,
        "autodiff of exp": _twin(_exponential),
        "autodiff of polynomial": _twin(_polynomial),
    }
    wave, wavelengths = _job(16, 1)
    found = []
    for side in _sides(size):
        surface = _surface(side, "window")
        found += [
            Entry(
                name,
                _with_heights(function, surface),
                (surface.heights, wave, wavelengths),
                f"{side}x{side}, 16 evaluations",
                16 * side * side,
                "sample",
                gradient=0,
            )
            for name, function in variants.items()
        ]
    return found


def _separable_pairs(size: str) -> list[Entry]:
    pairs, nodes = 1024, 8
    wave, wavelengths = _job(pairs, 2)
    found = []
    for side in _sides(size):
        for coverage in ("positions", "window"):
            surface = _surface(side, coverage)

            def run(surface, wave, wavelengths):
                settings = SeparableSettings(nodes=nodes)
                return methods.separable_pairs(surface, wave, wavelengths, settings)

            found.append(
                Entry(
                    coverage,
                    _with_heights(run, surface),
                    (surface.heights, wave, wavelengths),
                    f"{side}x{side}, {pairs} pairs, 2 wavelengths, {nodes} nodes",
                    pairs * 2,
                    "evaluation",
                    gradient=0,
                )
            )
    return found


def _separable_grid(size: str) -> list[Entry]:
    count, nodes = 64, 8
    found = []
    for side in _sides(size):
        for coverage in ("positions", "window"):
            surface = _surface(side, coverage)
            u = jnp.linspace(-0.7, 0.7, count, dtype="float32")
            # Light from the normal: w = -(1 + cos_o).
            square = 1.0 - u[None, :] ** 2 - u[:, None] ** 2
            w = -(1.0 + jnp.sqrt(jnp.maximum(square, 0.01)))

            def run(surface, u, w, wavelength):
                settings = SeparableSettings(nodes=nodes)
                return methods.separable_grid(surface, u, u, w, wavelength, settings)

            found.append(
                Entry(
                    coverage,
                    _with_heights(run, surface),
                    (surface.heights, u, w, jnp.asarray(0.55, "float32")),
                    f"{side}x{side}, {count}x{count} directions, {nodes} nodes",
                    count * count,
                    "evaluation",
                    gradient=0,
                )
            )
    return found


def _taylor_tables(size: str) -> list[Entry]:
    terms = 24
    found = []
    for side in _sides(size):
        surface = _surface(side, "window")

        def run(surface):
            settings = TaylorSettings(terms=terms, reach=7)
            return gathering.gather_tables(surface, settings, jnp.zeros(2, "float32")).values

        found.append(
            Entry(
                "",
                _with_heights(run, surface),
                (surface.heights,),
                f"{side}x{side}, {terms} terms",
                terms * side * side,
                "sample and term",
            )
        )
    return found


def _gather(
    variants: Callable[[], dict[str, tuple[Coverage, GatherSettings]]],
) -> Callable[[str], list[Entry]]:
    """Entries that gather 2048 times from tables made before."""

    def entries(size: str) -> list[Entry]:
        wave, wavelengths = _job(512, 4)
        found = []
        for side in _sides(size):
            for name, (coverage, settings) in variants().items():
                surface = _surface(side, coverage)
                reached = gathering.s_range(surface, wave, wavelengths)
                tables = gathering.gather_tables(surface, settings, reached)

                def run(surface, wave, wavelengths, tables, settings=settings):
                    return gathering.gathered(surface, wave, wavelengths, settings, tables)

                found.append(
                    Entry(
                        name,
                        run,
                        (surface, wave, wavelengths, tables),
                        f"{side}x{side}, 2048 evaluations",
                        2048,
                        "evaluation",
                    )
                )
        return found

    return entries


def _taylor_variants() -> dict[str, tuple[Coverage, GatherSettings]]:
    return {
        f"{terms} terms, reach {reach}, {coverage}": (coverage, TaylorSettings(terms, reach))
        for coverage in ("window", "positions")
        for terms, reach in ((12, 3), (24, 3), (24, 7))
    }


def _expansion_variants() -> dict[str, tuple[Coverage, GatherSettings]]:
    """Terms for 1e-4 at the phase range of these surfaces."""
    counts: dict[Coverage, tuple[int, int]] = {"window": (7, 6), "positions": (10, 8)}
    return {
        f"{settings.name}, {settings.terms} terms, reach {reach}, {coverage}": (coverage, settings)
        for coverage, (chebyshev, lowrank) in counts.items()
        for reach in (3, 7)
        for settings in (
            ChebyshevSettings(chebyshev, reach),
            LowRankSettings(lowrank, reach),
        )
    }


def _colour(size: str) -> list[Entry]:
    count = 10_000 if size == "small" else 100_000
    weights = jnp.asarray(colour.spectral_weights(colour.wavelengths()), "float32")
    spectra = np.random.default_rng(0).uniform(size=(count, weights.shape[0]))
    return [
        Entry(
            "",
            spectrum.weights_to_xyz,
            (jnp.asarray(spectra, "float32"), weights),
            f"{count} spectra of {weights.shape[0]}",
            count,
            "spectrum",
            gradient=0,
        )
    ]


DIRECT_WINDOW = Benchmark(
    "direct.window", "the direct sum under one coherence window", _direct("window")
)
DIRECT_POSITIONS = Benchmark(
    "direct.positions", "the direct sum, averaged over window positions", _direct("positions")
)
DERIVATIVE = Benchmark(
    "derivative",
    "closed-form derivative to all heights against automatic ones",
    _derivative,
    alternatives=True,
)
SEPARABLE_PAIRS = Benchmark(
    "separable.pairs", "matrix products for pairs of directions", _separable_pairs
)
SEPARABLE_GRID = Benchmark(
    "separable.grid", "matrix products for a grid of directions", _separable_grid
)
TAYLOR_TABLES = Benchmark("taylor.tables", "Taylor tables of a heightfield", _taylor_tables)
TAYLOR_GATHER = Benchmark("taylor.gather", "gather from Taylor tables", _gather(_taylor_variants))
EXPANSION_GATHER = Benchmark(
    "expansion.gather",
    "gather from tables of Chebyshev and low-rank expansions",
    _gather(_expansion_variants),
)
COLOUR = Benchmark("colour.xyz", "XYZ of spectra", _colour)
