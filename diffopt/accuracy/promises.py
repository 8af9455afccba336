"""Whether a tolerance is kept: random jobs, each answered within one and then measured.

A `Promise` draws a job and a tolerance from a seed, asks for the answer as a user would, and
measures its error against a trusted reference, in the terms in which the tolerance was given. A
job may be refused, with a message; what is not refused must keep to its tolerance.

>>> result = promise("diffraction.spectral").test(jobs=500)
>>> len(result.broken)
0
"""

import gc
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np

from diffopt.accuracy import registry
from diffopt.accuracy.keeping import Rows
from diffopt.errors import InputError

# Where each promise is defined; modules are imported when one is asked for.
NAMES: dict[str, str] = {
    "diffraction.spectral": "diffopt.accuracy.diffraction_promises:SPECTRAL",
    "diffraction.xyz": "diffopt.accuracy.diffraction_promises:XYZ",
    "lobes": "diffopt.fitting.lobe_promises:LOBES",
    "plan": "diffopt.accuracy.plan_promises:PLAN",
    "transfer.compression": "diffopt.accuracy.transfer_promises:COMPRESSION",
    "shadows": "diffopt.accuracy.shadow_promises:SHADOWS",
}

#: Share of jobs with chance in them that may exceed a tolerance.
CHANCE = 0.01
# Compiled programs of so many jobs are kept at most: each has shapes and settings of its own.
_PROGRAMS = 25

Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Answer:
    """What became of one random job.

    Attributes
    ----------
    job
        In words.
    error
        Measured, in the terms of the tolerance; None where the job was refused.
    doubt
        Of the measured error: how far the reference may be off, a 99 % interval where there is
        chance in it.
    refused
        The message, or an empty text.
    price
        Predicted or counted cost of what was chosen over that of the cheapest settings tried
        that would have done; None where this was not looked for.
    """

    job: str
    error: float | None
    doubt: float = 0.0
    refused: str = ""
    price: float | None = None


@dataclass(frozen=True)
class Trial:
    """An answer with what was asked; `settings` holds what it is repeated by."""

    settings: dict[str, Any]
    tolerance: float
    seconds: float
    answer: Answer

    @property
    def ratio(self) -> float:
        """Error over tolerance; NaN where the job was refused."""
        error = self.answer.error
        return math.nan if error is None else error / self.tolerance

    @property
    def broken(self) -> bool:
        """Whether the error exceeds the tolerance by more than can be doubted."""
        error = self.answer.error
        if error is None:
            return False
        return not error - self.answer.doubt <= self.tolerance


class Draw(NamedTuple):
    """What a job is drawn from.

    Attributes
    ----------
    rng
        Of this job alone.
    tolerance
        That is asked.
    priced
        Whether to look for cheaper settings that would have done, which takes longer.
    """

    rng: np.random.Generator
    tolerance: float
    priced: bool


@dataclass(frozen=True)
class Promise:
    """An entry point with a tolerance, and how to put it to the test.

    Attributes
    ----------
    name
        As in `NAMES`.
    entry
        The function and its argument.
    quantity
        The error that the tolerance bounds.
    reference
        What it is measured against.
    answer
        Makes a random job, asks, measures.
    tolerances
        Smallest and largest that are drawn, evenly in their logarithms.
    chance
        Whether the answer is a matter of chance: it may then exceed its tolerance in
        `CHANCE` of the jobs.
    x64
        Whether 64-bit types are on; with them off, most users' answers.
    shared
        Whether jobs share their compiled programs, which are then kept.
    """

    name: str
    entry: str
    quantity: str
    reference: str
    answer: Callable[[Draw], Answer]
    tolerances: tuple[float, float] = (1e-6, 1e-1)
    chance: bool = False
    x64: bool = True
    shared: bool = False

    def test(
        self,
        jobs: int = 500,
        *,
        seed: int = 0,
        first: int = 0,
        priced: int = 10,
        progress: Progress | None = None,
        keep: Rows | None = None,
    ) -> "PromiseResult":
        """Answer and measure random jobs.

        Parameters
        ----------
        jobs
            How many.
        seed, first
            Job k is drawn from (seed, first + k) alone, so that any can be repeated.
        priced
            Cheaper settings are looked for in every so-many-th job; 0 for none.
        progress
            Called as ``progress(done, total, text)`` before each job and at the end.
        keep
            Where trials are kept; those that are there are not made again.

        Raises
        ------
        InputError
            For numbers out of range.
        """
        for name, value, least in (
            ("jobs", jobs, 1),
            ("seed", seed, 0),
            ("first", first, 0),
            ("priced", priced, 0),
        ):
            if value < least:
                raise InputError(f"{name} must be at least {least}; received {value}")
        trials = []
        for k in range(jobs):
            if progress is not None:
                progress(k, jobs, f"job {first + k}")
            settings = {"promise": self.name, "seed": seed, "job": first + k}
            kept = None if keep is None else keep.load(k, settings)
            if kept is not None:
                trials.append(Trial(**{**kept, "answer": Answer(**kept["answer"])}))
                continue
            trials.append(self._trial(settings, priced > 0 and (first + k) % priced == 0))
            if keep is not None:
                keep.save(k, trials[-1])
            if not self.shared and k % _PROGRAMS == _PROGRAMS - 1:
                jax.clear_caches()
                gc.collect()
        if progress is not None:
            progress(jobs, jobs, "")
        return PromiseResult(self, tuple(trials))

    def _trial(self, settings: dict[str, Any], priced: bool) -> Trial:
        # Kept apart by name, so that no two promises draw the same numbers.
        words = [settings["seed"], settings["job"], *self.name.encode()]
        rng = np.random.default_rng(words)
        low, high = np.log10(self.tolerances)
        # As a user writes it.
        tolerance = float(f"{10.0 ** rng.uniform(low, high):.2g}")
        began = time.perf_counter()
        with jax.enable_x64(self.x64):
            answer = self.answer(Draw(rng, tolerance, priced))
        return Trial(settings, tolerance, time.perf_counter() - began, answer)


@dataclass(frozen=True)
class PromiseResult:
    """The trials of a promise; ``str`` prints what they come to."""

    promise: Promise
    trials: tuple[Trial, ...]

    @property
    def answered(self) -> tuple[Trial, ...]:
        """Trials that were not refused."""
        return tuple(t for t in self.trials if t.answer.error is not None)

    @property
    def broken(self) -> tuple[Trial, ...]:
        """Trials whose error exceeds their tolerance."""
        return tuple(t for t in self.trials if t.broken)

    @property
    def refused(self) -> float:
        """Share of jobs refused."""
        return 1.0 - len(self.answered) / len(self.trials)

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the share that is broken (Wilson)."""
        return wilson(len(self.broken), len(self.answered))

    @property
    def kept(self) -> bool:
        """Whether the promise held.

        Without chance in no trial more; with it, in a share of them that is not surely above
        `CHANCE`.
        """
        return self.interval[0] <= CHANCE if self.promise.chance else not self.broken

    @property
    def worst(self) -> float:
        """Largest error over tolerance; NaN if all were refused."""
        return max((t.ratio for t in self.answered), default=math.nan)

    @property
    def usual(self) -> float:
        """Median of error over tolerance; NaN if all were refused."""
        return float(np.median([t.ratio for t in self.answered])) if self.answered else math.nan

    @property
    def prices(self) -> tuple[float, ...]:
        """Costs over those of the cheapest settings that would have done, in order."""
        return tuple(sorted(t.answer.price for t in self.trials if t.answer.price is not None))

    def within(self, low: float, high: float) -> "PromiseResult":
        """Trials with tolerances in [low, high)."""
        return PromiseResult(
            self.promise, tuple(t for t in self.trials if low <= t.tolerance < high)
        )

    def decades(self) -> "list[tuple[str, PromiseResult]]":
        """Apart by the decade of the tolerance, the largest first; none without jobs."""
        low, high = self.promise.tolerances
        found = []
        for power in range(math.ceil(math.log10(high)), math.floor(math.log10(low)) - 1, -1):
            part = self.within(10.0 ** (power - 1), 10.0**power)
            if part.trials:
                found.append((f"1e{power - 1} to 1e{power}", part))
        return found

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write all trials."""
        from diffopt.accuracy import promise_output

        promise_output.save_csv(self, path)

    def __str__(self) -> str:
        from diffopt.accuracy import promise_output

        return promise_output.text(self)


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share; (0, 1) of nothing.

    Wilson 1927, "Probable inference, the law of succession, and statistical inference".
    """
    if of == 0:
        return 0.0, 1.0
    z = 1.959963984540054
    share = hits / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    low = 0.0 if hits == 0 else middle - half
    return low, 1.0 if hits == of else middle + half


def promise(name: str) -> Promise:
    """The promise of that name.

    Raises
    ------
    InputError
        If there is none; the message lists those in `NAMES`.
    """
    return registry.named("promise", NAMES, name)


def refusal(job: str, error: InputError) -> Answer:
    """The answer of a job that was refused."""
    return Answer(job, error=None, refused=str(error))
