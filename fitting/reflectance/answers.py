"""What a fit says: parameters, their errors, what the data cannot tell, and whether it settled."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.fitting.ranked import Ranked
from diffopt.fitting.reflectance import forward
from diffopt.gratings import Reach, Surface
from diffopt.gratings.parametric import UNSEEN, kinds

#: A parameter is not determined if its standard error exceeds this share of it (of 1 for shares
#: and angles, in radians).
LARGEST = 0.3
#: Two parameters whose errors are correlated beyond this are told apart only together.
TIED = 0.998
#: Chi-squared per value beyond which known noise does not explain the residuals.
MISFIT = 2.0

DETERMINED = "determined"


@dataclasses.dataclass(frozen=True)
class Minimum:
    """Where some of the starts ended.

    Attributes
    ----------
    parameters
        Free parameters by name.
    loss
        Relative misfit there.
    starts
        How many starts ended there.
    """

    parameters: dict[str, float]
    loss: float
    starts: int


@dataclasses.dataclass(frozen=True)
class ReflectanceFit:
    """Result of `fit_reflectance`.

    Attributes
    ----------
    model
        The fitted surface.
    names, covariance
        Free parameters, and the covariance of their errors, from the Jacobian and from the noise
        if that is known, else from the residuals.
    gain
        Factor of the model's values; 1 if it is known.
    loss
        Norm of the residuals over that of the data, both over the noise.
    chi2
        Squared residuals over the noise per degree of freedom; None if the noise is not known.
    converged
        Whether this is an answer; if not, `reason` says why.
    reason
        A sentence.
    identifiable
        By parameter, ``determined`` or a sentence that says why the data do not tell it.
    minima
        Where all starts ended, best first.
    steps
        Of the start that led to the model.
    values
        Fitted values, [M, C], as those of the data.
    curves
        By stage, the loss of each of its starts after each step, [S, N]; NaN after the last.
        Coarse stages, one after the other, compare blurred values.
    criterion
        Bayesian information criterion.
    interrupted
        Whether it ended before it was done.
    reach
        What was summed of the model's spectrum.
    ranking
        All models that were compared, best first.
    """

    model: Surface
    names: tuple[str, ...]
    covariance: np.ndarray
    gain: float
    loss: float
    chi2: float | None
    converged: bool
    reason: str
    identifiable: dict[str, str]
    minima: tuple[Minimum, ...]
    steps: int
    values: np.ndarray
    curves: dict[str, np.ndarray]
    criterion: float
    interrupted: bool
    reach: Reach
    ranking: tuple[Ranked, ...] = ()

    @property
    def errors(self) -> dict[str, float]:
        """Standard errors of the free parameters; infinite where the data do not hold one."""
        return dict(zip(self.names, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def __str__(self) -> str:
        errors = self.errors
        parts = [f"{n} {float(self.model.get(n)):.6g} +- {errors[n]:.2g}" for n in self.names]
        head = f"{type(self.model).__name__}: {', '.join(parts)}; misfit {self.loss:.2e}"
        return f"{head}. {self.reason}"

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.reflectance_card)


@eqx.filter_jit
def _linearised(
    job: forward.Job, surface: Surface, names: tuple[str, ...], reach: Reach
) -> tuple[Array, Array, Array, Array]:
    values = jnp.stack([surface.get(name) for name in names])

    def at(values: Array) -> Array:
        moved = surface.replaced(dict(zip(names, values, strict=True)))
        return forward.residuals(job, moved, reach)

    found, push = jax.linearize(at, values)
    rows = jax.vmap(push)(jnp.eye(len(names), dtype=values.dtype))
    predicted = forward.predicted(job, surface, reach)
    gain = forward.best_gain(job, predicted)
    return found, rows, gain, gain * predicted


def covariance(rows: Float[np.ndarray, "P N"], variance: float) -> Float[np.ndarray, "P P"]:
    """Of the parameters, for residuals of one variance.

    Parameters that nothing depends on have an infinite variance.
    """
    size = np.linalg.norm(rows, axis=1)
    felt = size > 1e-12 * max(float(size.max(initial=0.0)), 1e-300)
    out = np.zeros((len(rows), len(rows)))
    out[~felt, ~felt] = np.inf
    if felt.any():
        # Unit rows, so that units of the parameters do not enter the conditioning.
        unit = rows[felt] / size[felt, None]
        _, values, turned = np.linalg.svd(unit.T, full_matrices=False)
        inverse = turned.T @ np.diag(1.0 / np.maximum(values, 1e-12) ** 2) @ turned
        block = variance * inverse / np.outer(size[felt], size[felt])
        out[np.ix_(felt, felt)] = block
    return out


def judged(
    job: forward.Job,
    surface: Surface,
    names: tuple[str, ...],
    reach: Reach,
    *,
    noise_known: bool,
    scale: float,
    held: Mapping[str, str],
    bounded: Mapping[str, str],
    settled: bool,
    interrupted: str | None,
    left_out: str | None,
    minima: tuple[Minimum, ...],
    steps: int,
    curves: dict[str, np.ndarray],
) -> ReflectanceFit:
    """Put together the answer at a solution.

    Parameters
    ----------
    job, surface, names, reach
        Data, solution, free parameters, what is summed.
    noise_known, scale
        Whether the noise is absolute; the norm of the data over the noise, by which residuals
        were divided.
    held
        Parameters that were not fitted, with the sentence why.
    bounded
        Parameters that ran against a bound.
    settled, interrupted, left_out
        Whether the solver ended by its tolerance; what it was doing when it was interrupted; why it
        was not finished.
    minima, steps, curves
        See `ReflectanceFit`.
    """
    found, rows, gain, values = jax.device_get(_linearised(job, surface, names, reach))
    found, rows = np.asarray(found, np.float64), np.asarray(rows, np.float64)
    loss = float(np.linalg.norm(found))
    freedom = max(found.size - len(names) - job.free, 1)
    chi2 = (loss * scale) ** 2 / freedom if noise_known else None
    variance = 1.0 / scale**2 if noise_known else loss**2 / freedom
    matrix = covariance(rows, variance)
    count = len(names) + job.free
    # Twice the negative logarithm of the likelihood, up to a constant of the data.
    misfit = (loss * scale) ** 2 if noise_known else found.size * math.log(max(loss, 1e-300) ** 2)
    criterion = misfit + count * math.log(found.size)
    identifiable = _identifiable(surface, names, matrix, held, bounded)
    if left_out is not None:
        converged, reason = False, left_out
    else:
        converged, reason = _verdict(
            loss, chi2, settled, interrupted, identifiable, names, bounded, steps
        )
    return ReflectanceFit(
        surface,
        names,
        matrix,
        float(gain),
        loss,
        chi2,
        converged,
        reason,
        identifiable,
        minima,
        steps,
        np.asarray(values),
        curves,
        criterion,
        interrupted is not None,
        reach,
    )


def _identifiable(
    surface: Surface,
    names: tuple[str, ...],
    matrix: np.ndarray,
    held: Mapping[str, str],
    bounded: Mapping[str, str],
) -> dict[str, str]:
    every, out = kinds(surface), {}
    error = np.sqrt(np.diag(matrix))
    for k, name in enumerate(names):
        relative = every[name] not in ("share", "angle")
        size = abs(float(surface.get(name))) if relative else 1.0
        share = error[k] / max(size, 1e-300)
        if name in bounded:
            out[name] = f"{name} is not determined: {bounded[name]}"
        elif not math.isfinite(share):
            out[name] = f"{name} is not determined: the data do not depend on it at the solution"
        elif share > LARGEST:
            what = "of its value" if relative else "of a unit"
            out[name] = (
                f"{name} is not determined: its standard error is {100 * share:.0f} % {what}"
            )
        else:
            out[name] = DETERMINED
    for k, name in enumerate(names):
        for j in range(k):
            tie = matrix[k, j] / (error[k] * error[j]) if np.isfinite(error[[j, k]]).all() else 0.0
            if abs(tie) > TIED and DETERMINED in (out[name], out[names[j]]):
                text = (
                    f"only a combination of {names[j]} and {name} is determined "
                    f"(correlation {tie:.4f})"
                )
                out[name] = out[names[j]] = text
    for name in every:
        if name in out:
            continue
        if name in held:
            out[name] = held[name]
        elif name.split(".")[-1] in UNSEEN:
            out[name] = (
                f"{name} is not determined: |P|^2 averaged over positions does not change when "
                "the surface is moved"
            )
        else:
            out[name] = f"{name} was held at its start"
    return out


def _verdict(
    loss: float,
    chi2: float | None,
    settled: bool,
    interrupted: str | None,
    identifiable: dict[str, str],
    names: tuple[str, ...],
    bounded: Mapping[str, str],
    steps: int,
) -> tuple[bool, str]:
    if interrupted is not None:
        return False, f"The fit was interrupted during {interrupted}; this is the best until then."
    if not math.isfinite(loss):
        return False, "The residuals are not finite at the solution."
    misfit = ""
    if chi2 is not None and chi2 > MISFIT:
        misfit = (
            f"The model does not explain the data: chi-squared per value is {chi2:.3g}, with the "
            "noise as given it would be 1."
        )
    if not settled:
        stopped = (
            f"The solver stopped after {steps} steps without meeting its tolerance; raise "
            "max_steps or give a better start."
        )
        return False, f"{stopped} {misfit}".rstrip()
    if bounded:
        text = "; ".join(f"{name}: {why}" for name, why in bounded.items())
        return False, f"The solution lies at a bound of its range ({text})."
    if misfit:
        return False, misfit
    if loss > 0.9:
        return False, (
            f"The model explains next to nothing of the data: the misfit is {loss:.2f} of them."
        )
    loose = [name for name in names if identifiable[name] != DETERMINED]
    if loose:
        return True, f"Converged, but the data do not determine {', '.join(loose)}."
    return True, "Converged."
