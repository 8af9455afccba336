"""Stages of a fit of free heights: weights of the prior that fall, blocks of steps at each."""

import dataclasses
import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array

from diffopt.fitting.freeform.priors import Prior
from diffopt.fitting.freeform.problem import Problem, Settings
from diffopt.fitting.freeform.steps import Solver, advance, begin, mean_curvature, prepare

#: Trial steps in one call of the compiled program.
BLOCK = 10
# A weight that is looked for falls by this factor, at most this many times.
_FALL, _FALLS = 4.0, 14
# Chi^2 per value beyond which a minimum is none of data whose noise is known.
_UNFIT = 2.0
# Loss that a block must gain, as a share, while the weight is still looked for.
_LOOSE = 0.03


class Stages:
    """The loop on the host: stages of weights, blocks of steps.

    Parameters
    ----------
    made, change
        The loss at weight 0, and the change of height that it starts from.
    prior, name, precondition, tolerance, max_steps, progress
        As in `fit_heights`; name is that of the solver.
    span
        Largest span of heights that the forward settings hold for, micrometres.
    resettle
        Forward settings for a larger one.
    """

    def __init__(
        self,
        *,
        made: Problem,
        change: Array,
        prior: Prior,
        name: Solver,
        precondition: bool,
        tolerance: float,
        max_steps: int,
        progress: Callable[[int, float], None] | None,
        span: float,
        resettle: Callable[[float], Settings],
    ):
        self.made, self.change, self.prior = made, change, prior
        self.name: Solver = name
        self.precondition, self.tolerance, self.max_steps = precondition, tolerance, max_steps
        self.progress, self.span, self.resettle = progress, span, resettle
        self.steps, self.history, self.reason, self.converged = 0, [], "", False
        self.loss = self.chi2 = math.nan
        self.gain = self.weight = 1.0
        self.data = mean_curvature(made, change, jax.random.key(0))

    def solve(self, weight: float | None, known: bool) -> None:
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

    def _sought(self, target: float) -> float:
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

    def _stage(self, weight: float, tolerance: float, target: float) -> bool:
        """Blocks of steps at one weight; whether chi^2 per value came down to the target."""
        self.weight, count = weight, self.made.values.size
        made, y, (loss, (chi2, gain)) = prepare(
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
        arrays = begin(made, y, name=self.name)
        while self.steps < self.max_steps:
            steps = min(BLOCK, self.max_steps - self.steps)
            count_steps = jnp.asarray(steps)
            y, arrays, change, seen = advance(made, y, arrays, count_steps, name=self.name)
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
