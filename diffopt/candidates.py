"""Settings of every method that keep within a job's tolerance, or why there are none."""

import functools
from dataclasses import dataclass
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt import baking, bounds, costs, table_bounds
from diffopt.baking import Box
from diffopt.diffraction import DiffractionBRDF, Output, evaluate, factors, refuse
from diffopt.errors import InputError
from diffopt.kernels import expansions, phase, spline
from diffopt.settings import (
    ChebyshevSettings,
    DirectSettings,
    FewSettings,
    LowRankSettings,
    SeparableSettings,
    Settings,
    TableSettings,
    TaylorSettings,
)

METHODS = ("direct", "separable", "taylor", "chebyshev", "lowrank", "table")
Gradient = Literal["none", "directions", "model"]

#: Largest table that is chosen, bytes; baking takes about three times as much.
LARGEST_TABLE = 2**31
# What a table's error in w, bounded over a line of w at fixed (u, v), is at most in terms of
# the largest value among the pairs that share (u, v): C varies by less than 3 along it.
_ALONG_W = 3.0


@dataclass(frozen=True)
class Job:
    """What is asked of a model.

    Attributes
    ----------
    brdf
        The model.
    wi, wo
        Pairs above the horizon that stand for the job, [n, 3] each.
    count
        Pairs in all.
    box
        Wave vectors that a table must cover.
    wavelengths
        Micrometres, float64, [L].
    weights
        To XYZ, [L, 3], or None.
    output, tolerance, gradient
        See `diffopt.choice.prepare`.
    gain
        Error of the output over its largest value, per error of |P|^2 over a mirror's peak.
    """

    brdf: DiffractionBRDF
    wi: np.ndarray
    wo: np.ndarray
    count: int
    box: Box
    wavelengths: Float[np.ndarray, " L"]
    weights: Float[np.ndarray, "L 3"] | None
    output: Output
    tolerance: float
    gradient: Gradient
    gain: float

    @functools.cached_property
    def wave(self) -> Float[np.ndarray, "n 3"]:
        """Wave vectors of the pairs."""
        return -(self.wi + self.wo)

    @property
    def channels(self) -> int:
        """Values of the output for each pair."""
        return len(self.wavelengths) if self.weights is None else 3


@dataclass(frozen=True)
class Candidate:
    """One way to do a job, or why it cannot be done that way.

    Attributes
    ----------
    method, settings
        The method, and its settings within the tolerance (None if refused).
    bound
        Largest error over the largest value of the output; NaN where none is known.
    setup_s, run_s, nbytes
        Predicted seconds and memory.
    refused
        The reason, or None.
    """

    method: str
    settings: Settings | None
    bound: float
    setup_s: float
    run_s: float
    nbytes: int = 0
    refused: str | None = None

    @property
    def total_s(self) -> float:
        """Set-up and run together, seconds."""
        return self.setup_s + self.run_s


def gain(
    brdf: DiffractionBRDF,
    wi: np.ndarray,
    wo: np.ndarray,
    lam: np.ndarray,
    output: Output,
    weights: np.ndarray | None,
    tolerance: float,
) -> float:
    """Error of the output over its largest value, per error of |P|^2.

    Raises
    ------
    InputError
        If the output vanishes on the pairs that are tried.
    """
    before = _prefactors(brdf, wi, wo, lam, output, weights)
    # The largest value among some of the pairs, half of them the nearest to the mirror
    # direction, less its own error: the tolerance then holds for any larger one.
    windowed = brdf.surface.coverage != "patch" and brdf.surface.prefactor != "kirchhoff"
    pairs, colours = (512, len(lam)) if windowed else (8, 17)
    near = np.argsort(np.square(wi[:, :2] + wo[:, :2]).sum(-1))[:pairs]
    spaced = np.linspace(0, len(wi) - 1, pairs).astype(int)
    # Always as many pairs: one compilation.
    some = np.concatenate([np.resize(near, pairs), spaced])
    part = np.unique(np.linspace(0, len(lam) - 1, min(len(lam), colours)).astype(int))
    settings, doubt = _quick(brdf, -(wi + wo)[some], lam) if windowed else (DirectSettings(), 0.0)
    values = evaluate(
        brdf,
        wi[some],
        wo[some],
        lam[part],
        settings,
        output=output,
        weights=None if weights is None else weights[part],
    )
    largest = float(jnp.max(values)) - doubt * before
    if not largest > 0.0 and doubt > 0.0:
        values = evaluate(
            brdf,
            wi[some][:16],
            wo[some][:16],
            lam[part][::5],
            DirectSettings(),
            output=output,
            weights=None if weights is None else weights[part][::5],
        )
        largest = float(jnp.max(values))
    if not largest > 0.0:
        raise InputError(
            f"tolerance {tolerance:g} is relative to the largest value, which is "
            f"{largest:g} on the pairs that were tried: give a method and its settings"
        )
    return before / largest


def _quick(brdf, wave, lam) -> tuple[Settings, float]:
    """A gather for a look at the largest value, and its error."""
    surface = brdf.surface
    z = bounds.expansion_argument(surface, wave, lam)
    # In coarse steps, for fewer compilations.
    terms, reach = phase.chebyshev_nodes(z, 1e-6), _reach(surface, lam, 1e-5)
    settings = ChebyshevSettings(terms=-(-terms // 8) * 8, reach=-(-reach // 4) * 4)
    return settings, bounds.error_bound(surface, settings, wave, lam)


# Pairs in one call of `_block_factors`: one compilation for jobs of every size.
_BLOCK = 1024


def _prefactors(brdf, wi, wo, lam, output, weights) -> float:
    """Largest value that the output would have with |P|^2 = 1."""
    dtype = brdf.surface.heights.dtype
    blocks = -(-len(wi) // _BLOCK)
    padded = [np.resize(v, (blocks * _BLOCK, 3)) if len(v) % _BLOCK else v for v in (wi, wo)]
    weighted = None if weights is None else jnp.asarray(weights, dtype)
    colours = jnp.asarray(lam, dtype)
    largest = []
    for k in range(blocks):
        a, b = (jnp.asarray(v[k * _BLOCK : (k + 1) * _BLOCK], dtype) for v in padded)
        largest.append(_block_factors(brdf, a, b, colours, weighted, output))
    return float(jnp.max(jnp.stack(largest)))


@eqx.filter_jit
def _block_factors(brdf, wi, wo, lam, weights, output):
    value = factors(brdf, wi, wo, lam, output)
    if weights is not None:
        value = jnp.matmul(value, weights, precision="highest")
    return jnp.max(value)


def candidate(job: Job, name: str) -> Candidate:
    """Settings of one method that keep the error within the job's tolerance.

    Parameters
    ----------
    job
        What is asked.
    name
        One of `METHODS`.
    """
    surface = job.brdf.surface
    dtype = surface.heights.dtype
    why = _not_differentiable(job, name)
    if why:
        return _refused(name, why)
    floor = rounding(job)
    if floor > job.tolerance:
        return _refused(
            name, f"tolerance {job.tolerance:g} is below the rounding of {dtype}" + _advice(dtype)
        )
    try:
        found = _settings(job, name, job.tolerance - floor)
    except InputError as error:
        return _refused(name, str(error))
    if isinstance(found, str):
        return _refused(name, found)
    priced = price(job, found)
    if priced.bound > job.tolerance:
        # A window of few pixels, say, that no gather of this patch can hold.
        return _refused(
            name,
            f"the error bound {priced.bound:.1e} of {found} stays above the tolerance "
            f"{job.tolerance:g}",
        )
    if isinstance(found, TableSettings) and priced.nbytes > LARGEST_TABLE:
        return _refused(
            name,
            f"it would take {priced.nbytes / 2**30:.1f} GiB (at most {LARGEST_TABLE / 2**30:g} are "
            "chosen; lines are lambda / (2 pi sigma_s) wide: a blur by the source and the pixel, "
            "or pairs= in a smaller box, make it smaller)",
        )
    return priced


def price(job: Job, settings: Settings) -> Candidate:
    """Bound and predicted cost of given settings."""
    cost = costs.cost(
        job.brdf.surface,
        settings,
        pairs=job.count,
        wavelengths=len(job.wavelengths),
        box=job.box,
        shortest=float(job.wavelengths.min()),
        channels=job.channels,
        gradient=job.gradient != "none",
    )
    return Candidate(
        settings.name, settings, bound(job, settings), cost.setup_s, cost.run_s, cost.nbytes
    )


def bound(job: Job, settings: Settings) -> float:
    """Largest error over the largest value of the output: truncation and rounding.

    For a table averaged over positions the error in u and v is relative to the brightest
    direction nearby (`kernels.spline.LOCAL`), so that the prefactors cancel; all others are
    bounds of |P|^2 relative to a mirror's peak times the job's gain.
    """
    surface, lam = job.brdf.surface, job.wavelengths
    if isinstance(settings, FewSettings):
        return float("nan")
    if not isinstance(settings, TableSettings):
        whole = bounds.error_bound(surface, settings, job.wave, lam)
        return job.gain * (whole - bounds.rounding_estimate(surface, job.wave, lam)) + rounding(job)
    if surface.coverage != "positions":
        error = table_bounds.table_error(surface, job.box, lam, settings)
        return job.gain * float(error.max()) + rounding(job)
    grid = spline.LOCAL * table_bounds.grid_error(surface, lam, settings.step, settings.order)
    depth = table_bounds.depth_error(surface, job.box, lam, settings.nodes, settings.intervals)
    baked = 4.0 * job.gain * settings.error
    return float((grid + _ALONG_W * depth).max()) + baked + rounding(job)


def rounding(job: Job) -> float:
    """Rounding in terms of the output's largest value.

    That of the directions moves the lines, which changes a value by a share of the brightest
    nearby; that of the transforms is relative to a mirror's peak.
    """
    surface, lam = job.brdf.surface, job.wavelengths
    if surface.coverage != "positions":
        return job.gain * bounds.rounding_estimate(surface, job.wave, lam)
    moved = bounds.direction_rounding(surface, job.wave, lam)
    return job.gain * (bounds.rounding_estimate(surface, job.wave, lam) - moved) + moved


def _settings(job: Job, name: str, room: float) -> Settings | str:
    """Settings within `room` of the output's largest value, or why there are none."""
    surface, wave, lam = job.brdf.surface, job.wave, job.wavelengths
    dtype = surface.heights.dtype
    if name == "table":
        baking.refuse_table(job.brdf)
        return _table(job, room)
    allowed = room / job.gain
    if name == "direct":
        found: Settings = DirectSettings()
    elif name == "separable":
        share = allowed if surface.coverage == "positions" else allowed / 3.0
        sweep = bounds.separable_sweep(surface, wave, lam)
        found = SeparableSettings(nodes=phase.chebyshev_nodes(sweep, min(share, 1.0)))
    elif name == "taylor":
        # Centred heights halve the argument: fewer terms and far less rounding.
        total = bounds.phase_range(surface, wave, lam)
        lost = phase.taylor_rounding(0.5 * total, float(jnp.finfo(dtype).eps))
        # It counts twice in the bound, as an error of the amplitude.
        if lost > min(0.25 * allowed, bounds.LARGEST_ROUNDING):
            return (
                f"{dtype} cannot carry Taylor terms over a phase range of {total:.1f} at this "
                f"tolerance (rounding {lost:.1e} of the mirror's peak)" + _advice(dtype)
            )
        terms = phase.taylor_terms(0.5 * total, allowed / 12.0)
        found = TaylorSettings(terms=terms, reach=_reach(surface, lam, allowed), centred=True)
    else:
        reach, z = _reach(surface, lam, allowed), bounds.expansion_argument(surface, wave, lam)
        lost = float(jnp.finfo(dtype).eps) * (6.0 + z)
        factor = 2.0
        if surface.coverage == "positions":
            factor = 1.0 + bounds.gather_omitted(surface, reach, lam)
        share = min(0.7 * allowed / factor - lost, 1.0)
        if share <= 2e-15 * (4.0 + z):
            return f"tolerance {job.tolerance:g} is below the rounding of {dtype} terms" + _advice(
                dtype
            )
        found = (
            ChebyshevSettings(terms=phase.chebyshev_nodes(z, share), reach=reach)
            if name == "chebyshev"
            else LowRankSettings(terms=expansions.lowrank_terms(z, share), reach=reach)
        )
    refuse(job.brdf, found)
    return found


def _table(job: Job, room: float) -> TableSettings:
    """The cheaper of the orders 2 and 3."""
    surface = job.brdf.surface
    factor = 1.0 if surface.coverage == "positions" else job.gain
    scale = spline.LOCAL if surface.coverage == "positions" else 1.0
    found = [
        table_bounds.table_settings(
            surface,
            job.box,
            job.wavelengths,
            lambda error: scale * factor * float(error.max()),
            room,
            order,
            along_w=_ALONG_W / spline.LOCAL if surface.coverage == "positions" else 1.0,
            baking=job.gain,
            slopes=job.gradient != "none",
        )
        for order in (2, 3)
    ]
    return min(found, key=lambda s: price(job, s).total_s)


def _not_differentiable(job: Job, name: str) -> str | None:
    if job.gradient == "model" and name not in ("direct", "separable"):
        return "what it sets up once has no derivative to the model (gradient='model')"
    return None


def _reach(surface, lam, room) -> int:
    """Fewest bins on either side that leave out at most a quarter of the room."""
    reach, longest = 1, min(surface.heights.shape) // 2 - 1
    while bounds.gather_cut(surface, reach, lam) > 0.25 * room and reach < longest:
        reach += 1
    return reach


def _advice(dtype) -> str:
    return "; use float64 heights" if dtype == jnp.float32 else ""


def _refused(name: str, why: str) -> Candidate:
    return Candidate(name, None, np.inf, np.inf, np.inf, refused=why)
