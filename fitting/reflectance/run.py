"""One fit of a parametric surface to reflectance: its stages, and what they leave.

`diffopt.fitting.reflectance.fit` says what the stages are.
"""

import dataclasses
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt.fitting.measured import Measured
from diffopt.fitting.reflectance import answers, forward, solving, start_design, starts
from diffopt.fitting.reflectance.answers import Minimum, ReflectanceFit
from diffopt.fitting.reflectance.maps import Bounds
from diffopt.fitting.reflectance.settings import FitSettings
from diffopt.fitting.reflectance.templates import lattice, nested
from diffopt.gratings import Reach, Surface, reach_for
from diffopt.gratings.parametric import kinds

Progress = Callable[[str, float, float], None]

# Coarse stages compare every value with every other.
_MOST_VALUES = 1536
# Of the solves on some rows: tolerance, terms of random displacements, and the share of a line's
# peak beyond which orders are left out.
_COARSE, _FEW_TERMS, _FAINT = 1e-3, 12, 1e-3
#: Stage of a fit from the data alone, by which models are compared before they are finished.
SOME_ROWS = "least squares on some rows"


@dataclasses.dataclass
class _Ended:
    """Where the solves of a stage ended."""

    like: Surface
    solved: solving.Solved
    reach: Reach

    @property
    def loss(self) -> np.ndarray:
        return np.nan_to_num(np.asarray(self.solved.loss), nan=np.inf)

    @property
    def y(self) -> np.ndarray:
        return np.asarray(self.solved.y)


@dataclasses.dataclass
class Run:
    """One fit under way; `last` is what an interruption leaves."""

    measured: Measured
    job: forward.Job
    like: Surface
    box: Bounds
    settings: FitSettings
    frequency: float
    kappa: float
    progress: Progress | None
    last: _Ended | None = None
    doing: str = "the start"
    minima: tuple[Minimum, ...] = ()
    curves: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def tell(self, doing: str, share: float) -> None:
        """Begin a stage, and report it."""
        self.doing = doing
        if self.progress is not None:
            self.progress(doing, share, self.least())

    def least(self) -> float:
        """Least loss of the last stage that was done; infinite before the first."""
        return math.inf if self.last is None else float(min(self.last.loss))

    def reach(self, longest: float, faint: float = 1e-7) -> Reach:
        """Static sizes, rounded so that similar data share their programs."""
        found = reach_for(
            longest=longest,
            frequency=self.frequency,
            coherence=float(self.measured.coherence),
            phase=self.kappa * self._highest(),
            faint=faint,
        )
        return Reach(
            next((n for n in (1, 2, 3, 4, 6) if n >= found.each_side), found.each_side),
            32 * math.ceil(found.highest / 32),
            32.0 * math.ceil(found.phase / 32.0),
            found.terms,
        )

    def _highest(self) -> float:
        every, names = kinds(self.like), self.box.names
        sizes = [
            float(high)
            for name, high in zip(names, self.box.high, strict=True)
            if every[name] == "height"
        ]
        rest = [abs(float(self.like.get(n))) for n in every if every[n] == "height"]
        return max([*sizes, *rest, 1e-3])

    def solve(
        self, job: forward.Job, like: Surface, y: np.ndarray, reach: Reach, **options: Any
    ) -> _Ended:
        """Solve from starts [S, P] in one program; keep where they ended."""
        options = {"blurs": None, **self.settings.last(job.values), **options}
        start = jnp.asarray(y, jnp.result_type(float))
        blurs = options.pop("blurs")
        among = self.settings.devices
        found = solving.solve_on(among, job, like, self.box, start, blurs, reach=reach, **options)
        found = jax.block_until_ready(found)
        curves = np.asarray(found.curves)
        curves = curves.reshape(len(curves), -1)
        self.curves[self.doing] = curves[:, np.isfinite(curves).any(0)]
        self.last = _Ended(like, found, reach)
        self.minima = start_design.minima(self.last.y, self.last.loss, self.box)
        return self.last

    def from_starts(self, given: list[Surface]) -> None:
        """From given starts: coarse to fine in the coherence window, then all data."""
        values = np.array([[float(s.get(n)) for n in self.box.names] for s in given])
        y = self.box.unbounded(values)
        like = jax.tree.map(lambda *leaves: jnp.stack(leaves), *given)
        lengths = [float(s.get(path)) for s in given for path, _ in lattice(self.like)]
        reach = self.reach(2.0 * max(lengths, default=1.0))
        if self.settings.stages and lengths and self.job.weights is None:
            self.tell("coarse to fine", 0.1)
            per_row = self.job.fx.shape[1]
            some = starts.brightest(self.job, max(_MOST_VALUES // per_row, 1))
            # Evenly: blurs of values over their noise would be those of the darkest.
            job = forward.evenly(forward.rows(self.job, some))
            dtype = self.like.dtype
            coarsest = jnp.asarray(self.settings.coarsest * np.mean(lengths), dtype)
            sigma = self.measured.coherence.astype(dtype)
            blurs = solving.windows(job, sigma, coarsest, stages=self.settings.stages)
            coarse = self.solve(job, like, y, reach, blurs=blurs).y
            # Blurs widen the basin in the period, and may lead astray where it was right.
            y = np.concatenate([coarse, y])
            like = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf]), like)
        self.tell("least squares", 0.5)
        self.solve(self.job, like, y, reach)

    def from_data(self, give_up: float | None = None) -> bool:
        """Whether it was finished on all data; again with more starts where chi^2 is too large."""
        if not self._once(self.settings, give_up):
            return False
        for _ in range(self.settings.retries):
            if not self.measured.noise_known or self.chi2() < answers.MISFIT:
                break
            loss, first = self.least(), (self.last, self.minima, self.curves)
            self.curves, better = {}, False
            try:
                self._once(self.settings.harder(), None)
                better = self.least() < loss
            finally:
                # An interruption leaves losses on some rows, which are not those on all.
                if not better:
                    self.last, self.minima, self.curves = first
        return True

    def chi2(self) -> float:
        """Squared residuals over the noise per value."""
        return (self.least() * self.norm) ** 2 / self.measured.values.size

    @property
    def norm(self) -> float:
        """Of the values over the noise."""
        return float(forward.norm(self.measured))

    def _once(self, settings: FitSettings, give_up: float | None) -> bool:
        self.tell("lattices", 0.0)
        job = forward.rows(self.job, starts.brightest(self.job, settings.rows))
        head = nested(self.like)
        if head:
            values, longest = self.within(head, settings)
            count, groups = max(settings.starts // 2, 1), 0
        else:
            coherence = float(self.measured.coherence)
            values = start_design.tried(job, self.like, self.box, settings, coherence)
            # Of any period, so that all data from the same directions share a program.
            longest = self.longest(np.asarray(self.box.high)[None])
            count, groups = settings.starts, settings.lattices if lattice(self.like) else 0
        coarse = dataclasses.replace(self.reach(longest, _FAINT), terms=_FEW_TERMS)
        self.tell("comparison of starts", 0.2)
        y = self.box.unbounded(values)
        wide = jnp.asarray(y, jnp.result_type(float))
        loss = solving.losses(job, solving.copies(self.like, len(y)), self.box, wide, reach=coarse)
        chosen = start_design.diverse(np.asarray(loss), count, groups)
        self.tell(SOME_ROWS, 0.4)
        ended = self.solve(
            job,
            solving.copies(self.like, len(chosen)),
            y[chosen],
            coarse,
            tolerance=_COARSE,
            flat=_COARSE,
            max_steps=min(settings.max_steps, 24),
        )
        if give_up is not None and min(ended.loss) > give_up:
            return False
        minima = self.minima
        order = start_design.finalists(ended.y, ended.loss, settings.finalists)
        self.tell("least squares on all data", 0.8)
        y = ended.y[order]
        ends = np.stack([np.asarray(self.box.values(jnp.asarray(row))) for row in y])
        reach = self.reach(1.1 * self.longest(ends))
        self.solve(self.job, solving.copies(self.like, len(order)), y, reach)
        self.minima = minima
        return True

    def left_out(self, give_up: float | None) -> str:
        """Why it was not finished."""
        return (
            f"The fit was not finished: the misfit on some rows is {self.least():.3g}, that "
            f"of a better model below {give_up:.3g}."
        )

    def within(self, head: str, settings: FitSettings) -> tuple[np.ndarray, float]:
        """Starts about a fit of the surface within, and their longest period."""
        inner, box = getattr(self.like, head), self.box.of(head)
        run = dataclasses.replace(self, like=inner, box=box, curves={}, progress=None)
        run._once(settings, None)
        found = [one.parameters for one in run.minima[:2]]
        found = (found * 2)[:2]
        # What is not free lies in the surface itself.
        held = {n: float(inner.get(n)) for n in kinds(inner) if n not in box.names}
        starts = [held | one for one in found]
        longest = 1.3 * max(one[path] for one in starts for path, _ in lattice(inner))
        return start_design.around(self.like, self.box, head, starts, settings.design), longest

    def longest(self, values: np.ndarray) -> float:
        """Longest period among parameters [S, P]; 1 for a surface without one."""
        names = self.box.names
        found = [
            float(values[:, names.index(path)].max() if path in names else self.like.get(path))
            for path, _ in lattice(self.like)
        ]
        return max(found, default=1.0)

    def answer(
        self, held: Mapping[str, str], interrupted: str | None, left_out: str | None
    ) -> ReflectanceFit:
        """The best of the last stage that was done."""
        assert self.last is not None
        y, solved = self.last.y, self.last.solved
        best = int(np.argmin(self.last.loss))
        chosen = jax.tree.map(lambda leaf: leaf[best], self.last.like)
        surface = self.box.surface(chosen, jnp.asarray(y[best], self.like.dtype))
        return answers.judged(
            self.job,
            conventional(surface),
            self.box.names,
            self.last.reach,
            noise_known=self.measured.noise_known,
            scale=self.norm,
            held=held,
            bounded=self.box.at_bound(y[best]),
            settled=bool(np.asarray(solved.settled)[best]),
            interrupted=interrupted,
            left_out=left_out,
            minima=self.minima,
            steps=int(np.asarray(solved.steps)[best]),
            curves=self.curves,
        )


def conventional(surface: Surface) -> Surface:
    """Among surfaces that reflect alike, the one with angles in a half turn.

    A profile that is its own mirror image repeats after half a turn, and is taken to lie in
    (-pi/2, pi/2]; a saw in (-pi, pi].
    """
    values = {}
    for period, angle in lattice(surface):
        head = period.rpartition(".")[0]
        owner = operator.attrgetter(head)(surface) if head else surface
        turn = math.pi if owner.symmetric else 2.0 * math.pi
        at = surface.get(angle)
        values[angle] = at - turn * jnp.ceil(at / turn - 0.5)
    return surface.replaced(values) if values else surface
