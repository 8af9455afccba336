"""Every method on one job, in one run: set-up, run time, memory, measured error.

>>> found = compare(brdf, pairs=random_pairs(100_000), tolerance=1e-2, output="xyz")
>>> print(found)
>>> found.best.method

Settings are those that `diffopt.choice.prepare` picks for the tolerance, but for the methods
that have no bound or are tuned to their advantage (`diffopt.accuracy.contenders`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from diffopt import candidates, checks, colour
from diffopt.accuracy.ranking import Comparison as Comparison
from diffopt.accuracy.ranking import Row as Row
from diffopt.accuracy.ranking import with_break_even
from diffopt.checks import Values
from diffopt.diffraction import DiffractionBRDF, Output, evaluate
from diffopt.errors import InputError
from diffopt.settings import DirectSettings

#: In the order of the rows: see `diffopt.accuracy.contenders`, `tuning` and `nufft` there.
METHODS = (
    "direct",
    "thesis",
    "taylor",
    "chebyshev",
    "lowrank",
    "separable",
    "few",
    "nufft",
    "table",
)
_CHECKED = 200
# Called before each method with its number from 0, the number of methods, its name.
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Check:
    """Pairs on which errors are measured, brightest first, and the truth there.

    Attributes
    ----------
    index
        Which pairs of the job, [n].
    values
        The direct sum in float64, [n, channels].
    """

    index: Int[np.ndarray, " n"]
    values: Float[np.ndarray, "n channels"]

    def error(self, values: Any) -> float:
        """Largest error over the largest value, on the first pairs if fewer were computed."""
        values = np.asarray(values, np.float64)[: len(self.values)]
        return float(np.abs(values - self.values[: len(values)]).max() / self.values.max())


@dataclass(frozen=True)
class Task:
    """What all methods are asked to do.

    Attributes
    ----------
    brdf
        The model.
    wi, wo
        Every pair of the job, above the horizon, those that are checked first, float64, [M, 3].
    wavelengths, weights
        Micrometres [L], and weights to XYZ [L, 3] or None.
    output, tolerance
        As for `diffopt.choice.prepare`.
    check
        Truth.
    budget_s
        About the longest that one method may run.
    gain
        Error of the output per error of |P|^2, see `diffopt.candidates.gain`.
    """

    brdf: DiffractionBRDF
    wi: Float[np.ndarray, "M 3"]
    wo: Float[np.ndarray, "M 3"]
    wavelengths: Float[np.ndarray, " L"]
    weights: Float[np.ndarray, "L 3"] | None
    output: Output
    tolerance: float
    check: Check
    budget_s: float
    gain: float

    @property
    def allowed(self) -> float:
        """What |P|^2 may err by, relative to a mirror's peak."""
        return self.tolerance / self.gain

    @property
    def checked(self) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
        """Pairs whose truth is known."""
        count = len(self.check.index)
        return self.wi[:count], self.wo[:count]

    @property
    def wave(self) -> Float[np.ndarray, "M 3"]:
        """Wave vectors of the pairs."""
        return -(self.wi + self.wo)


def random_pairs(
    count: int, largest_angle: float = 75.0, seed: int = 0
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Random pairs, each direction uniform in the disc of direction sines within an angle.

    Parameters
    ----------
    count
        Number of pairs, at least 1.
    largest_angle
        Degrees from the normal, in (0, 90).
    seed
        Same seed, same pairs.
    """
    if count < 1:
        raise InputError(f"pairs must be at least 1; received {count}")
    if not 0.0 < largest_angle < 90.0:
        raise InputError(f"angle must lie between 0 and 90 degrees; received {largest_angle:g}")
    rng = np.random.default_rng(seed)
    sine = np.sqrt(rng.uniform(size=(count, 2))) * math.sin(math.radians(largest_angle))
    turn = rng.uniform(0.0, 2.0 * math.pi, (count, 2))
    both = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.sqrt(1.0 - sine**2)], -1)
    return both[:, 0], both[:, 1]


def compare(
    brdf: DiffractionBRDF,
    *,
    pairs: tuple[Values, Values],
    tolerance: float,
    output: Output | str = "xyz",
    wavelengths: Values | None = None,
    methods: Sequence[str] = METHODS,
    budget_s: float = 10.0,
    checked: int = _CHECKED,
    illuminant: colour.IlluminantLike = "D65",
    check: Check | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Time every method on one job, in one run, and measure its error.

    Parameters
    ----------
    brdf
        The model.
    pairs
        The job's directions (wi, wo), [..., 3] each; those below the horizon are left out.
    tolerance
        Largest error of the output over its largest value, in (0, 1).
    output, wavelengths, illuminant
        As for `diffopt.choice.prepare`.
    methods
        Some of `METHODS`.
    budget_s
        Seconds that a method may run; of a longer job a part is run, and scaled up.
    checked
        Pairs on which errors are measured, a tenth of them the brightest of the job.
    check
        From `truth`, to share it between tolerances; made if not given.
    progress
        Called as ``progress(done, total, name)`` before each method and at the end.

    Raises
    ------
    InputError
        For an argument out of its range.
    """
    for name in methods:
        checks.choice("method", name, METHODS)
    kind: Output = checks.choice("output", output, get_args(Output))
    checks.tolerance(tolerance)
    if not budget_s > 0.0:
        raise InputError(f"budget_s must be above 0; received {budget_s:g}")
    wi, wo = _above(pairs)
    wavelengths = colour.wavelengths() if wavelengths is None else wavelengths
    checks.wavelengths(wavelengths)
    lam = np.atleast_1d(np.asarray(wavelengths, np.float64))
    weights = None
    if kind == "xyz":
        weights = np.asarray(colour.spectral_weights(lam, illuminant=illuminant))
    if check is None:
        check = truth(brdf, wi, wo, lam, weights, kind, checked)
    gain = candidates.gain(brdf, wi, wo, lam, kind, weights, tolerance)
    order = np.concatenate([check.index, np.setdiff1d(np.arange(len(wi)), check.index)])
    task = Task(brdf, wi[order], wo[order], lam, weights, kind, tolerance, check, budget_s, gain)
    rows = []
    for done, name in enumerate(methods):
        if progress is not None:
            progress(done, len(methods), name)
        try:
            rows.append(_entered(name, task))
        except InputError as error:
            rows.append(Row(name, note=str(error)))
    if progress is not None:
        progress(len(methods), len(methods), "")
    ny, nx = brdf.surface.heights.shape
    job = f"{ny} x {nx} heights, {len(wi)} pairs, {len(lam)} wavelengths, {kind}"
    return Comparison(with_break_even(rows, tolerance, len(wi)), job, tolerance)


def truth(
    brdf: DiffractionBRDF,
    wi: Float[np.ndarray, "M 3"],
    wo: Float[np.ndarray, "M 3"],
    wavelengths: Float[np.ndarray, " L"],
    weights: Float[np.ndarray, "L 3"] | None,
    output: Output,
    count: int = _CHECKED,
) -> Check:
    """The direct sum in float64 on some pairs of a job, a tenth of them the brightest.

    The brightest are found by a Chebyshev gather at some of the wavelengths, within 10 % of
    the largest value, or, where it cannot, are the nearest to the mirror direction.
    """
    count = min(count, len(wi))
    few = max(1, count // 10)
    look = np.unique(np.linspace(0, len(wi) - 1, min(len(wi), 100_000)).astype(int))
    try:
        quick = brdf.prepare(
            pairs=(wi[look], wo[look]),
            wavelengths=np.asarray(wavelengths)[:: max(1, len(wavelengths) // 16)],
            output=output,
            tolerance=0.1,
            method="chebyshev",
        )
        order = np.argsort(-np.asarray(quick(wi[look], wo[look])).max(-1))
    except InputError:
        order = np.argsort(np.square(wi[look, :2] + wo[look, :2]).sum(-1))
    bright = look[order[:few]]
    rest = np.setdiff1d(np.arange(len(wi)), bright)
    # Evenly through the job, in whatever order its pairs come.
    if len(rest) > 0:
        rest = rest[np.unique(np.linspace(0, len(rest) - 1, count - few).astype(int))]
    chosen = np.concatenate([bright, rest])
    with jax.enable_x64(True):
        values = evaluate(
            widened(brdf),
            wi[chosen],
            wo[chosen],
            wavelengths,
            DirectSettings(),
            output=output,
            weights=weights,
        )
        return Check(chosen, np.asarray(values))


def widened(brdf: DiffractionBRDF) -> DiffractionBRDF:
    """The model in float64; call it with 64-bit types on."""
    leaves, rest = eqx.partition(brdf, eqx.is_inexact_array)
    return eqx.combine(jax.tree.map(lambda leaf: leaf.astype(jnp.float64), leaves), rest)


def _entered(name: str, task: Task) -> Row:
    from diffopt.accuracy import contenders, nufft, tuning

    if name in ("thesis", "taylor"):
        return tuning.taylor(task, name, centred=name == "taylor")
    if name == "few":
        return tuning.few_wavelengths(task, name)
    return nufft.compared(task, name) if name == "nufft" else contenders.named(task, name)


def _above(pairs: tuple[Values, Values]) -> tuple[np.ndarray, np.ndarray]:
    wi, wo = (np.asarray(values, np.float64) for values in pairs)
    checks.directions("wi", wi)
    checks.directions("wo", wo)
    wi, wo = (v.reshape(-1, 3) for v in np.broadcast_arrays(wi, wo))
    above = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    if not above.any():
        raise InputError("pairs must hold at least one pair above the horizon; received none")
    return wi[above], wo[above]
