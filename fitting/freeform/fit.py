"""Free heights of a surface from its reflectance, by L-BFGS or nonlinear conjugate gradients.

Minimises the misfit of a `diffopt.DiffractionBRDF` to measured values plus a Gaussian prior
(`problem`, `priors`), from a start near the truth, in `stages`.
Retrieving phases from intensities is not convex: see `fit_heights` for how near the start must
be.
"""

import math
from collections.abc import Callable
from typing import get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffopt import checks
from diffopt.diffraction import DiffractionBRDF
from diffopt.errors import InputError
from diffopt.fitting.freeform.equal import Average
from diffopt.fitting.freeform.equal import nearest_equal as nearest_equal
from diffopt.fitting.freeform.priors import Prior, prior_root
from diffopt.fitting.freeform.problem import Settings, forward_settings, problem
from diffopt.fitting.freeform.result import HeightsFit as HeightsFit
from diffopt.fitting.freeform.result import result
from diffopt.fitting.freeform.stages import Stages
from diffopt.fitting.freeform.steps import Solver
from diffopt.fitting.measured import Measured
from diffopt.fresnel import Reflectance
from diffopt.heightfield import Heightfield

# Error of |P|^2 over a mirror's peak that the forward settings may leave, before noise counts.
_FORWARD = 1e-6
# Where noise is not given: its standard deviation over the root mean square of the values.
_NOISE = 0.01


def fit_heights(
    measured: Measured,
    start: Heightfield,
    *,
    average: Average | str = "positions",
    position: checks.Values = (0.0, 0.0),
    fresnel: Reflectance | None = None,
    prior: Prior | str = "smooth",
    roughness: tuple[float, float] | None = None,
    weight: float | None = None,
    solver: Solver | str = "lbfgs",
    max_steps: int = 500,
    tolerance: float = 1e-3,
    precondition: bool = True,
    error_rank: int = 0,
    progress: Callable[[int, float], None] | None = None,
) -> HeightsFit:
    """Fit every height of a periodic patch to measured reflectance.

    **What the data cannot tell**, and what is taken: the mean height (that of the start); for
    ``average="positions"`` a translation (whole pixels are undone, so that the sum of squared
    differences from the start is smallest; a fraction of a pixel stays); the twin -h(-x, -y),
    about the middle of the window if there is one (the nearer to the start is returned). A
    free gain adds nothing to these. Under one window, heights beyond its reach are the prior's.
    Averaged over positions, spectra are blurred by the window: a patch of many sigma_s has more
    heights than any number of directions holds (a patch of 512 x 512 pixels, 26 sigma_s wide,
    from 1,800 values: chi^2 below 1, heights no better than those of the start).

    **From how far it recovers**: intensities have many minima. For rough patches of 48 x 48
    pixels of 0.1 um, four sigma_s wide, 60 nm rms, correlated over 0.5 um, 750 directions x
    (0.45, 0.55, 0.65) um, 2 % noise, the default came back to 0.7 to 1.0 nm from all 18 starts
    off by 30, 60 and 75 nm rms (over 0.8 um), from 5 of 6 off by 90 nm and 2 of 6 by 120 nm;
    from 6 of 6 scans blurred by a Gaussian of 0.3 um, from none blurred by 0.5 um. With the
    noise known no wrong surface among them was called converged. Surfaces of 120 nm rms: 24 of
    24 starts off by up to 90 nm, 2 of 6 by 120 nm. So starts must be within about an eighth of a
    wavelength, whatever the depth; stages of long wavelengths first did not widen that in a
    trial of 12 fits.

    **Cost**: about four products of `methods.separable_pairs` a step; nothing of the size of
    heights x directions is kept. 512 x 512 heights in float32: 450 directions x 4 wavelengths
    peak at 0.74 GB resident, 0.26 GB of it before the fit (the compiled block holds 16 MB of
    temporaries beside 46 MB of state), 0.57 GB with ``cg``, 0.88 GB in float64; 1,500
    directions x 6 wavelengths at 0.75 GB. A block of 10 steps took 6 s and 40 to 75 s on two
    shared cores.

    Parameters
    ----------
    measured
        The data, any quantity, gain and blur; converted to the dtype of the start. The noise is
        taken as it is given, and where it was left out as 1 % of the root mean square of the
        values. Only with ``noise_known`` a large misfit is a failure.
    start
        Where to start; its grid is that of the result.
    average, position, fresnel
        As for `diffopt.DiffractionBRDF`, whose defaults hold for all else.
    prior
        ``smooth``: the change from the start has a white Laplacian, a tenth of the shortest
        wavelength in standard deviation at weight 1. ``spectrum``: heights about their mean
        are Gaussian with a power spectrum, by default the smoothed one of the start.
    roughness
        For ``spectrum``, instead: (rms, length), micrometres, of correlation
        rms^2 exp(-r^2 / length^2).
    weight
        Of the prior; 1 is the probability of data and prior together. None: the discrepancy
        principle (Morozov), the first of a sequence falling fourfold at which chi^2 per value
        comes down to 1 + 3 sqrt(2 / values).
    solver
        ``lbfgs`` or ``cg`` (Polak-Ribiere).
    max_steps
        Trial steps in all.
    tolerance
        Converged when a block of 10 steps lowers the loss by less than this share, and a step
        along the gradient would too.
    precondition
        Solve in unknowns in which the curvatures of data and prior together are about one at
        every frequency; False, for comparison, in heights.
    error_rank
        Directions of the unknowns that `error_map` follows (Laplace's approximation with the
        prior at the weight used, translations held; too few make it too large); 0 leaves it
        out. It means what it says only if prior and noise do.
    progress
        Called with (steps, loss) after each block. A KeyboardInterrupt from it, or between
        blocks, returns the best heights so far, marked as such.

    Raises
    ------
    InputError
        If an argument is out of range, heights are missing or flat, the coherence window does
        not suit the patch, or the pixel is too coarse for the directions.
    """
    window: Average = checks.choice("average", average, get_args(Average))
    chosen: Prior = checks.choice("prior", prior, get_args(Prior))
    name: Solver = checks.choice("solver", solver, get_args(Solver))
    _check(measured, start, weight, max_steps, error_rank)
    checks.tolerance(tolerance)
    dtype = start.heights.dtype
    data = jax.tree.map(lambda leaf: leaf.astype(dtype), measured)
    brdf = DiffractionBRDF(
        start,
        data.coherence,
        average=window,
        position=position,
        fresnel=fresnel,
        blur=data.blur,
    )
    lam = np.asarray(measured.wavelengths, np.float64)
    root = prior_root(start, float(lam.min()), chosen, roughness)
    inverse = _inverse_noise(measured)
    wave = -np.asarray(measured.wi + measured.wo, np.float64)
    span = 1.5 * float(jnp.ptp(start.heights)) + 0.25 * float(lam.min())
    made, change = problem(
        data,
        start,
        brdf,
        _settings(brdf, span, wave, lam),
        inverse=inverse,
        root=root,
        prior=chosen,
        gain=data.gain,
    )
    run = Stages(
        made=made,
        change=change,
        prior=chosen,
        name=name,
        precondition=precondition,
        tolerance=tolerance,
        max_steps=max_steps,
        progress=progress,
        span=span,
        resettle=lambda span: _settings(brdf, span, wave, lam),
    )
    run.solve(weight, data.noise_known)
    return result(run, start, brdf, root, window, error_rank)


def _settings(brdf: DiffractionBRDF, span: float, wave: np.ndarray, lam: np.ndarray) -> Settings:
    """Forward settings for heights of a span."""
    surface = brdf.surface
    heights = jnp.zeros_like(surface.heights).at[0, 0].set(span)
    surface = eqx.tree_at(lambda s: s.heights, surface, heights)
    return forward_settings(surface, wave, lam, _FORWARD)


def _inverse_noise(measured: Measured) -> np.ndarray:
    """One over the noise."""
    noise = np.asarray(measured.noise, np.float64)
    if not measured.noise_known and (noise == 1.0).all():
        values = np.asarray(measured.values, np.float64)
        return np.full_like(noise, 1.0 / (_NOISE * np.sqrt(np.mean(values**2))))
    return 1.0 / noise


def _check(
    measured: Measured,
    start: Heightfield,
    weight: float | None,
    max_steps: int,
    error_rank: int,
) -> None:
    start.require_complete()
    if not float(jnp.ptp(start.heights)) > 0.0:
        raise InputError(
            "start must not be flat, where no intensity changes with a height to first order; "
            f"received {start.shape} equal heights"
        )
    if weight is not None and not 0.0 < weight < math.inf:
        raise InputError(f"weight must be positive, or None to have it chosen; received {weight}")
    if max_steps < 1:
        raise InputError(f"max_steps must be 1 or more; received {max_steps}")
    if not 0 <= error_rank <= start.heights.size:
        raise InputError(
            f"error_rank must be 0 to {start.heights.size}, the number of heights; received "
            f"{error_rank}"
        )
    wave = np.abs(np.asarray(measured.wi + measured.wo, np.float64))
    shortest = float(np.min(measured.wavelengths))
    for axis, (name, step) in enumerate(zip("xy", start.pixel[::-1], strict=True)):
        most = float(wave[:, axis].max())
        if most * step > 0.5 * shortest * (1.0 + 1e-6):
            raise InputError(
                f"the pixel along {name} must be {0.5 * shortest / most:.4g} um at most, half the "
                f"shortest wavelength over the largest direction sum {most:.3g}; received {step:g}"
            )
