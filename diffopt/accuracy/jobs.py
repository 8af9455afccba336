"""What the diffraction studies and benchmarks share: surfaces, directions, truth, jobs."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import bounds, gathering, methods
from diffopt.accuracy.studies import Job
from diffopt.choice import sample_pairs
from diffopt.kernels import phase
from diffopt.methods import Coverage, Surface
from diffopt.settings import DirectSettings, GatherSettings, SeparableSettings

# The shortest visible wavelength has the largest phases.
SHORTEST = 0.38
WAVELENGTHS = np.array([SHORTEST])

Method = DirectSettings | SeparableSettings | GatherSettings


def make_surface(
    heights: Any, pixel: float, sigma: Any, coverage: Coverage, dtype: Any = "float32"
) -> Surface:
    """A surface for the methods themselves, past the checks of `DiffractionBRDF`.

    Parameters
    ----------
    heights
        Micrometres, [ny, nx].
    pixel, sigma
        Micrometres.
    coverage
        ``positions``, ``window`` or ``patch``, see `diffopt.methods.Surface`.
    dtype
        Of heights and sigma.
    """
    return Surface(
        heights=jnp.asarray(heights, dtype),
        sigma=jnp.asarray(sigma, dtype),
        center=jnp.zeros(2, dtype),
        blur=jnp.zeros((), dtype),
        pixel=(pixel, pixel),
        coverage=coverage,
        repeats=(1, 1),
        prefactor="stam",
        drop_mean=False,
    )


def wave_vectors(count: int) -> np.ndarray:
    """Wave vectors [count + 1, 3] of pairs within 75 degrees and of the mirror at 0."""
    wi, wo = sample_pairs(count)
    return np.append(-(wi + wo), [[0.0, 0.0, -2.0]], 0)


def method(surface: Surface, wave, wavelengths, settings: Method):
    """|P|^2 by the method of the settings, with everything it sets up."""
    if isinstance(settings, DirectSettings):
        return methods.direct(surface, wave, wavelengths, settings)
    if isinstance(settings, SeparableSettings):
        return methods.separable_pairs(surface, wave, wavelengths, settings)
    reached = gathering.s_range(surface, wave, wavelengths)
    tables = gathering.gather_tables(surface, settings, reached)
    return gathering.gathered(surface, wave, wavelengths, settings, tables)


def over_stack(
    pixel: float, coverage: Coverage, settings: Method
) -> Callable[[Any, Any, Any, Any], Any]:
    """Function of (heights [S, ny, nx], sigma, wave, wavelengths): |P|^2 [S, M, L]."""

    def run(stack, sigma, wave, wavelengths):
        def one(heights):
            surface = make_surface(heights, pixel, sigma, coverage, heights.dtype)
            return method(surface, wave, wavelengths, settings)

        return jax.lax.map(one, stack)

    return run


def truth(
    stack: np.ndarray,
    pixel: float,
    sigma: float,
    coverage: Coverage,
    wave: np.ndarray,
    wavelengths: np.ndarray,
) -> np.ndarray:
    """The direct sum in float64, [S, M, L], with or without 64-bit types around it."""
    with jax.enable_x64(True):
        arguments = (jnp.asarray(a, "float64") for a in (stack, sigma, wave, wavelengths))
        return np.asarray(_compiled_truth(pixel, coverage)(*arguments))


@functools.cache
def _compiled_truth(pixel: float, coverage: Coverage):
    return jax.jit(over_stack(pixel, coverage, DirectSettings()))


def stack_job(
    stack: np.ndarray,
    pixel: float,
    sigma: float,
    coverage: Coverage,
    wave: np.ndarray,
    settings: Method,
    dtype: str,
    *,
    wavelengths: np.ndarray = WAVELENGTHS,
    reference: np.ndarray | None = None,
    names: tuple[str, ...] = (),
    function: Callable | None = None,
    gradient: int | None = None,
) -> Job:
    """Job of one method on a stack of surfaces, with its a-priori bound.

    The note gives the largest error of each surface if `names` are given, otherwise the
    mean error relative to the mean.
    """
    expected = (
        truth(stack, pixel, sigma, coverage, wave, wavelengths) if reference is None else reference
    )

    def judge(value):
        error = np.abs(np.asarray(value, np.float64) - expected)
        if names:
            each = error.reshape(len(names), -1).max(1)
            note = ", ".join(f"{n} {e:.1e}" for n, e in zip(names, each, strict=True))
        else:
            note = f"mean over mean {error.mean() / expected.mean():.1e}"
        return float(error.max()), note

    return Job(
        function=function or over_stack(pixel, coverage, settings),
        arguments=tuple(jnp.asarray(a, dtype) for a in (stack, sigma, wave, wavelengths)),
        judge=judge,
        bound=max(
            bounds.error_bound(
                make_surface(h, pixel, sigma, coverage, dtype), settings, wave, wavelengths
            )
            for h in stack
        ),
        gradient=gradient,
    )


def hard_and_random(phase_range: float, side: int) -> np.ndarray:
    """A binary grating, whose samples all err alike, and random heights: [2, n, n].

    `phase_range` is that of the mirror direction at `SHORTEST`.
    """
    n = side
    height = phase_range * SHORTEST / (2.0 * phase.TWO_PI)
    binary = np.broadcast_to(np.arange(n) // 8 % 2, (n, n))
    random = np.random.default_rng(1).uniform(size=(n, n))
    # The whole range is there, so that the phase range is what it says.
    random.flat[:2] = 0.0, 1.0
    return (height * np.stack([binary, random])).astype(np.float32)
