"""Fit of a parametric surface to reflectance: from the data alone, or from given starts.

1. Lattices by the grating equation, other parameters by a design (`starts`).
2. All of them are compared with the brightest and some other rows of the data.
3. Least squares from the best, in one program, on the same rows.
4. The best few are finished on all of the data; once more with more starts if chi^2 says that
   they are wrong.

A surface that spreads the lines of one within it (`Ridges`, `Jittered`, `Superposed`) starts from a
fit of that one.

From given starts, 1 to 3 give way to stages that are coarse to fine in the coherence window
(`solving.windows`).
"""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from diffopt import checks
from diffopt.errors import InputError
from diffopt.fitting.measured import Measured
from diffopt.fitting.reflectance import forward
from diffopt.fitting.reflectance.answers import ReflectanceFit
from diffopt.fitting.reflectance.maps import bounds_for
from diffopt.fitting.reflectance.run import SOME_ROWS, Progress, Run
from diffopt.fitting.reflectance.settings import FitSettings
from diffopt.fitting.reflectance.templates import lattice, templates
from diffopt.fresnel import Reflectance
from diffopt.gratings import CompactDisc, Surface
from diffopt.gratings.parametric import seen_in_power
from diffopt.scalar import Shadowing


def fit_reflectance(
    measured: Measured,
    model: str | type[Surface] | Surface | Sequence[Surface],
    *,
    free: Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fresnel: Reflectance | None = None,
    shadowing: Shadowing = "none",
    settings: FitSettings | None = None,
    give_up: float | None = None,
    progress: Progress | None = None,
) -> ReflectanceFit:
    """Fit a parametric surface to reflectance, from the data alone or from starts.

    Parameters
    ----------
    measured
        The data, with their noise and, if it is not known, a free gain.
    model
        A name (`templates.NAMED`) or a class of `diffopt.gratings`: starts come
        from the data. Or a surface, or several of one kind: these are the starts, and what is
        not free stays as in them.
    free
        Names of the parameters to fit; by default all that |P|^2 depends on, less the angle
        where all directions lie in one plane.
    bounds
        (low, high) by name, in place of those of `maps.default_bounds`.
    fresnel, shadowing
        Of the surface, as for `diffopt.DiffractionBRDF`.
    settings
        See `FitSettings`.
    give_up
        Misfit on some rows (`rows_misfit`) beyond which a fit from the data alone is not finished
        on all of them: for comparisons.
    progress
        Called as progress(what, share done, best loss) before each stage. A KeyboardInterrupt
        after the first solve returns the best so far, not converged.

    Returns
    -------
    ReflectanceFit
        With ``converged`` false and a reason where there is no answer.

    Raises
    ------
    InputError
        If the model is unknown, starts differ in kind, names or bounds are not those of free
        parameters, or fewer values than free parameters were measured.
    """
    settings = FitSettings() if settings is None else settings
    known = isinstance(model, Surface) or not isinstance(model, (str, type))
    given = templates(model)
    like = given[0]
    names, held = _free(measured, like, free)
    check_size(measured, names)
    job = forward.job(measured.astype(like.dtype), fresnel, shadowing)
    frequency, kappa = forward.largest(job)
    box = bounds_for(like, names, measured, frequency, bounds)
    run = Run(measured, job, like, box, settings, frequency, kappa, progress)
    interrupted = left_out = None
    try:
        if known:
            run.from_starts(given)
        elif not run.from_data(give_up):
            left_out = run.left_out(give_up)
    except KeyboardInterrupt:
        interrupted = run.doing
        if run.last is None:
            raise
    return run.answer(held, interrupted, left_out)


def rows_misfit(fit: ReflectanceFit) -> float:
    """Least misfit on some rows of a fit from the data alone; infinite for one from starts."""
    return float(np.nanmin(fit.curves.get(SOME_ROWS, np.array([[math.inf]]))))


def _free(
    measured: Measured, like: Surface, free: Sequence[str] | None
) -> tuple[tuple[str, ...], dict[str, str]]:
    """Names of free parameters, and why others are held."""
    seen = seen_in_power(like)
    held: dict[str, str] = {}
    if free is not None:
        names = tuple(free)
        if not names or not set(names) <= set(seen):
            raise InputError(f"free must be some of {', '.join(seen)}; received {names}")
        return names, held
    wave = np.asarray(measured.wi + measured.wo, np.float64)[:, :2]
    for _, angle in lattice(like):
        if checks.in_plane(wave):
            held[angle] = f"{angle} was held: all directions of the data lie in one plane"
    if isinstance(like, CompactDisc):
        held |= {n: f"{n} was held: pass free= to fit it" for n in ("bit", "wall")}
    return tuple(name for name in seen if name not in held), held


def check_size(measured: Measured, names: Sequence[str]) -> None:
    """Refuse data with fewer values than free parameters."""
    size = measured.values.size
    if size <= len(names):
        raise InputError(f"values must outnumber the {len(names)} free parameters; received {size}")
