"""Free heights of a surface from its reflectance, by L-BFGS or nonlinear conjugate gradients.

Minimises the misfit of a `diffopt.DiffractionBRDF` to measured values plus a Gaussian prior
(`freeform_priors`), from a start near the truth. Retrieving phases from intensities is not
convex: see `fit_heights` for how near the start must be.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.diffraction import DiffractionBRDF
from diffopt.errors import InputError
from diffopt.fitting.freeform_priors import (
    Prior,
    Problem,
    filtered,
    forward_settings,
    posterior_deviation,
    prior_root,
    problem,
    slopes,
    weighted,
)
from diffopt.fitting.measured import Measured
from diffopt.fresnel import Reflectance
from diffopt.heightfield import Heightfield

Average = Literal["positions", "window"]
Solver = Literal["lbfgs", "cg"]

# Trial steps in one call of the compiled program.
_BLOCK = 10
# Error of |P|^2 over a mirror's peak that the forward settings may leave, before noise counts.
_FORWARD = 1e-6
# Where noise is not given: its standard deviation over the root mean square of the values.
_NOISE = 0.01
# A weight that is looked for falls by this factor, at most this many times.
_FALL, _FALLS = 4.0, 14
# Chi^2 per value beyond which a minimum is none of data whose noise is known.
_UNFIT = 2.0
# Loss that a block must gain, as a share, while the weight is still looked for.
_LOOSE = 0.03


class HeightsFit(eqx.Module):
    """Result of `fit_heights`.

    Attributes
    ----------
    heightfield
        The fitted surface.
    loss
        Half of chi^2 plus the weighted prior.
    misfit
        ``relative``: norm of the residuals over that of the values, both over the noise;
        ``chi2``: mean squared residual over the noise, near 1 for noise that is known.
    gain
        Factor on the model, 1 if known.
    weight
        Strength of the prior that was used.
    steps
        Trial steps, one evaluation of the loss each, for those accepted also its gradient.
    converged, reason
        Whether the minimum was reached, and a sentence.
    history
        Loss at the start and after each block of steps; it jumps where the weight changes.
    error_map
        Standard deviation of each height, micrometres, or None, see `fit_heights`.
    """

    heightfield: Heightfield
    loss: float
    misfit: dict[str, float]
    gain: float
    weight: float
    steps: int
    converged: bool
    reason: str
    history: tuple[float, ...]
    error_map: Float[Array, "ny nx"] | None

    def __str__(self) -> str:
        ny, nx = self.heightfield.shape
        return (
            f"{ny} x {nx} heights: relative misfit {self.misfit['relative']:.3g}, chi^2 per value "
            f"{self.misfit['chi2']:.3g}. {self.reason}"
        )


class _Remembered(optx.BacktrackingArmijo):
    """Armijo backtracking that starts at twice the last accepted step.

    Conjugate directions have no natural length: from a fixed first step every line search
    would halve its way down again.
    """

    def step(self, first_step, y, y_eval, f_info, f_eval_info, state):
        """As `optimistix.BacktrackingArmijo.step`."""
        _, accept, result, new = super().step(first_step, y, y_eval, f_info, f_eval_info, state)
        grown = jnp.where(first_step, 1.0, 2.0 * state.step_size)
        size = jnp.where(accept, grown, self.decrease_factor * state.step_size)
        return size, accept, result, eqx.tree_at(lambda s: s.step_size, new, size)


def _optimiser(name: Solver) -> Any:
    # Convergence is judged between blocks, where its reason can be told.
    never = float(jnp.finfo(jnp.result_type(float)).tiny)
    if name == "lbfgs":
        return optx.LBFGS(rtol=never, atol=never, history_length=10)
    return optx.NonlinearCG(rtol=never, atol=never, search=_Remembered())


def _fresh(made: Problem, y: Array, name: Solver) -> Any:
    wide = jax.ShapeDtypeStruct((), y.dtype)
    aux = jax.eval_shape(lambda y: made.loss(y)[1], y)
    return _optimiser(name).init(lambda y, _: made.loss(y), y, None, {}, wide, aux, frozenset())


@eqx.filter_jit
def _begin(made, y, *, name):
    return eqx.filter(_fresh(made, y, name), eqx.is_array)


@eqx.filter_jit
def _advance(made, y, arrays, count, *, name):
    """`count` trial steps; unknowns, solver state, and what the host looks at."""
    static = eqx.filter(_fresh(made, y, name), eqx.is_array, inverse=True)
    optimiser = _optimiser(name)

    def one(_, carry):
        y, arrays = carry
        state = eqx.combine(arrays, static)
        y, state, _ = optimiser.step(lambda y, _: made.loss(y), y, None, {}, state, frozenset())
        return y, eqx.filter(state, eqx.is_array)

    y, arrays = jax.lax.fori_loop(0, count, one, (y, arrays))
    state = eqx.combine(arrays, static)
    chi2, gain = state.aux
    gradient = jnp.sum(state.f_info.grad**2)
    change = filtered(y, made.colour.astype(y.dtype))
    span = jnp.ptp(made.heights(y))
    return y, arrays, change, (state.f_info.f, chi2, gain, gradient, span)


@eqx.filter_jit
def _mean_curvature(made, change, key):
    """Of the misfit, at all frequencies alike, for changes of height."""
    return made.curvature(change, jax.random.normal(key, change.shape, change.dtype))


@eqx.filter_jit
def _prepare(made, change, weight, data, *, precondition):
    """The problem at a weight, its unknowns scaled so that a step of the gradient fits."""
    if precondition:
        made, y = weighted(made, change, weight, data)
    else:
        made, y = eqx.tree_at(lambda p: p.weight, made, weight), change
    curvature = made.curvature(y)
    scale = jnp.sqrt(jnp.where(curvature > 0.0, curvature, 1.0))
    made = eqx.tree_at(lambda p: p.colour, made, made.colour / scale)
    y = y * scale.astype(y.dtype)
    return made, y, made.loss(y)


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
    run = _Run(
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
    return _result(run, start, brdf, root, window, error_rank)


class _Run:
    """The loop on the host: stages of weights, blocks of steps."""

    def __init__(
        self,
        *,
        made,
        change,
        prior,
        name,
        precondition,
        tolerance,
        max_steps,
        progress,
        span,
        resettle,
    ):
        self.made, self.change, self.prior, self.name = made, change, prior, name
        self.precondition, self.tolerance, self.max_steps = precondition, tolerance, max_steps
        self.progress, self.span, self.resettle = progress, span, resettle
        self.steps, self.history, self.reason, self.converged = 0, [], "", False
        self.loss = self.chi2 = math.nan
        self.gain = self.weight = 1.0
        self.data = _mean_curvature(made, change, jax.random.key(0))

    def solve(self, weight, known):
        """All stages; sets `converged` and `reason`."""
        count = self.made.values.size
        try:
            if weight is None:
                weight = self._sought(1.0 + 3.0 * math.sqrt(2.0 / count))
                self._stage(weight, self.tolerance, 0.0)
                if self.converged and known and self.chi2 / count > _UNFIT:
                    self.converged = False
                    self.reason = (
                        f"Came to rest after {self.steps} steps at chi^2 of "
                        f"{self.chi2 / count:.3g} per value: a local minimum too far from the "
                        "surface, or a model or noise that is not that of the data."
                    )
            else:
                self._stage(weight, self.tolerance, 0.0)
        except KeyboardInterrupt:
            self.converged = False
            self.reason = (
                f"Interrupted after {self.steps} steps: these are the best heights so far."
            )

    def _sought(self, target) -> float:
        """The first of falling weights at which chi^2 per value comes down to the target."""
        weight = 1.0
        if self.prior == "smooth":
            # Strong enough to hold the start: the change is let go from smooth to rough.
            white = self.made.white
            softest = jnp.where(white > 0.0, white, jnp.inf).min()
            weight = float(self.data) / float(softest) ** 2
        for _ in range(_FALLS):
            if self._stage(weight, _LOOSE, target) or self.steps >= self.max_steps:
                break
            weight /= _FALL
        return weight

    def _stage(self, weight, tolerance, target) -> bool:
        """Blocks of steps at one weight; whether chi^2 per value came down to the target."""
        self.weight, count = weight, self.made.values.size
        made, y, (loss, (chi2, gain)) = _prepare(
            self.made,
            self.change,
            jnp.asarray(weight, self.data.dtype),
            self.data,
            precondition=self.precondition,
        )
        self.loss, self.chi2, self.gain = float(loss), float(chi2), float(gain)
        best = self.loss
        if not math.isfinite(best):
            self.converged, self.reason = False, "The loss of the start is not finite."
            return True
        if not self.history:
            self.history.append(best)
        arrays = _begin(made, y, name=self.name)
        while self.steps < self.max_steps:
            steps = min(_BLOCK, self.max_steps - self.steps)
            count_steps = jnp.asarray(steps)
            y, arrays, change, seen = _advance(made, y, arrays, count_steps, name=self.name)
            loss, chi2, gain, gradient, span = (float(v) for v in seen)
            self.change = change
            self.steps += steps
            self.loss, self.chi2, self.gain = loss, chi2, gain
            self.history.append(loss)
            if self.progress is not None:
                self.progress(self.steps, loss)
            if span > self.span:
                # Nodes were chosen for shallower heights.
                self.span = 1.5 * span
                settings = self.resettle(self.span)
                made = dataclasses.replace(made, settings=settings)
                self.made = dataclasses.replace(self.made, settings=settings)
            if chi2 / count <= target:
                return True
            gained, promised = best - loss, 0.5 * gradient
            best = loss
            if gained < tolerance * loss:
                self.converged = promised < 10.0 * tolerance * loss
                self.reason = (
                    f"Converged after {self.steps} steps: the last {steps} lowered the loss by "
                    f"less than {tolerance:g} of it."
                    if self.converged
                    else f"The line search found no lower loss after {self.steps} steps, though "
                    "the gradient is not zero: the data are noisier or the numbers shorter "
                    "(float32) than the tolerance wants."
                )
                return False
        self.converged = False
        self.reason = (
            f"Stopped after {self.steps} steps, the most allowed, while the loss still fell: raise "
            "max_steps."
        )
        return False


class Move(NamedTuple):
    """What takes one surface to another of equal |P|^2: a half turn, then a shift in pixels."""

    twin: bool
    shift: tuple[int, int]

    def __call__(self, field: Float[Array, "ny nx"]) -> Float[Array, "ny nx"]:
        """The field turned and shifted, its sign as it was."""
        return jnp.roll(field[::-1, ::-1] if self.twin else field, self.shift, (0, 1))


def nearest_equal(
    heights: Float[Array, "ny nx"],
    start: Float[Array, "ny nx"],
    average: Average = "positions",
    middle: tuple[float, ...] = (0.0, 0.0),
) -> tuple[Float[Array, "ny nx"], Move]:
    """Of all surfaces with the same |P|^2 the one nearest to the start, and how it is reached.

    Nearest by the sum of squared differences, among the surface and its twin -h(-x, -y), each
    shifted by whole pixels where |P|^2 is averaged over positions, with the mean of the start.

    Parameters
    ----------
    heights, start
        Micrometres.
    average
        As in `fit_heights`.
    middle
        Of a single window, (y, x) in pixels from the middle of the patch. The twin about it
        lies on the grid for multiples of one half only, and is left out otherwise.
    """
    field, wanted = heights - heights.mean(), start - start.mean()
    twice = [2.0 * m if average == "window" else 0.0 for m in middle]
    moves = [Move(False, (0, 0))]
    if all(abs(t - round(t)) < 1e-3 for t in twice):
        # Samples sit at i - n // 2: about the middle m, i -> 2 m + 2 (n // 2) - i.
        turn = [round(t) + 2 * (n // 2) + 1 for t, n in zip(twice, field.shape, strict=True)]
        moves.append(Move(True, (turn[0], turn[1])))
    if average == "positions":
        target = jnp.fft.rfft2(wanted)
        for k, move in enumerate(moves):
            one = jnp.fft.rfft2(_signed(move, field))
            match = jnp.fft.irfft2(target * jnp.conj(one), field.shape)
            down, right = np.unravel_index(int(jnp.argmax(match)), field.shape)
            moves[k] = Move(move.twin, (move.shift[0] + int(down), move.shift[1] + int(right)))
    apart = [float(jnp.sum((_signed(move, field) - wanted) ** 2)) for move in moves]
    best = moves[int(np.argmin(apart))]
    return _signed(best, field) + start.mean(), best


def _signed(move: Move, field: Array) -> Array:
    return -move(field) if move.twin else move(field)


def _result(run: _Run, start, brdf, root, average, error_rank) -> HeightsFit:
    surface = brdf.surface
    heights = run.made.base + run.change.astype(run.made.base.dtype)
    middle = [float(c) / d for c, d in zip(surface.center, surface.pixel, strict=True)]
    aligned, move = nearest_equal(heights, start.heights, average, tuple(middle))
    spread = None
    if error_rank:
        spread = move(
            posterior_deviation(
                run.made,
                heights,
                jnp.asarray(root, heights.dtype),
                jnp.asarray(run.weight, heights.dtype),
                slopes(heights)[: 2 if average == "positions" else 0],
                jax.random.key(0),
                rank=error_rank,
            )
        )
    size = float(jnp.linalg.norm(run.made.values * run.made.inverse))
    count = run.made.values.size
    note = f"heights fitted to reflectance, relative misfit {math.sqrt(run.chi2) / size:.3g}"
    return HeightsFit(
        heightfield=Heightfield(aligned, start.pixel, provenance=start.provenance.then(note)),
        loss=run.loss,
        misfit={"relative": math.sqrt(run.chi2) / size, "chi2": run.chi2 / count},
        gain=run.gain,
        weight=run.weight,
        steps=run.steps,
        converged=run.converged,
        reason=run.reason,
        history=tuple(run.history),
        error_map=spread,
    )


def _settings(brdf: DiffractionBRDF, span: float, wave: np.ndarray, lam: np.ndarray):
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


def _check(measured, start, weight, max_steps, error_rank):
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
