"""Fit of a parametric surface to reflectance: from the data alone, or from given starts.

1. Lattices by the grating equation, other parameters by a design (`diffopt.fitting.starts`).
2. All of them are compared with the brightest and some other rows of the data.
3. Least squares from the best, in one program, on the same rows.
4. The best few are finished on all of the data.

From given starts, 1 to 3 give way to stages that are coarse to fine in the coherence window
(`diffopt.fitting.solving.windows`).
"""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import checks
from diffopt.diffraction import Shadowing
from diffopt.errors import InputError
from diffopt.fitting import answers, forward, solving, starts
from diffopt.fitting.answers import Minimum, ReflectanceFit
from diffopt.fitting.maps import Bounds, default_bounds
from diffopt.fitting.measured import Measured
from diffopt.fitting.templates import lattice, templates
from diffopt.fresnel import Reflectance
from diffopt.gratings import Reach, Surface, reach_for
from diffopt.gratings.base import kinds, seen_in_power

Progress = Callable[[str, float, float], None]


@dataclasses.dataclass(frozen=True)
class FitSettings:
    """How a surface is fitted to reflectance.

    Attributes
    ----------
    lattices
        Grating vectors taken from the data. More cost time in proportion and find gratings
        whose first orders are dark.
    design
        Points of the other parameters for each lattice; doubled for each parameter beyond the
        first.
    starts
        Solves from the best of them. One is enough for a sinusoid; saws and steps have many
        minima.
    finalists
        Of these, finished on all data.
    rows
        Pairs of directions of the comparison and of the first solves; fewer cost less and are
        noisier.
    stages
        Coarse stages from given starts: none make a fit faster and its basin narrower.
    coarsest
        Coherence window of the first of them, in periods of the starts.
    solver
        ``normal-lm`` (Levenberg-Marquardt on normal equations), or optimistix's own ``lm``,
        ``dogleg`` and ``bfgs``.
    tolerance
        Of the last solve, on y and on the squared loss; the root of the rounding unit if None.
    max_steps
        Of each solve.
    """

    lattices: int = 8
    design: int = 24
    starts: int = 12
    finalists: int = 3
    rows: int = 400
    stages: int = 4
    coarsest: float = 0.2
    solver: solving.Solver = "normal-lm"
    tolerance: float | None = None
    max_steps: int = 64

    def __post_init__(self) -> None:
        checks.choice("solver", self.solver, solving.SOLVERS)
        for name, least in (
            ("lattices", 1),
            ("design", 1),
            ("starts", 1),
            ("finalists", 1),
            ("rows", 8),
            ("stages", 0),
            ("max_steps", 1),
        ):
            if getattr(self, name) < least:
                raise InputError(f"{name} must be {least} or more; received {getattr(self, name)}")


# Coarse stages compare every value with every other.
_MOST_VALUES = 4096


def fit_reflectance(
    measured: Measured,
    model: str | type[Surface] | Surface | Sequence[Surface],
    *,
    free: Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    fresnel: Reflectance | None = None,
    shadowing: Shadowing = "none",
    settings: FitSettings | None = None,
    progress: Progress | None = None,
) -> ReflectanceFit:
    """Fit a parametric surface to reflectance, from the data alone or from starts.

    Parameters
    ----------
    measured
        The data, with their noise and, if it is not known, a free gain.
    model
        A name (`diffopt.fitting.templates.NAMED`) or a class of `diffopt.gratings`: starts come
        from the data. Or a surface, or several of one kind: these are the starts, and what is
        not free stays as in them.
    free
        Names of the parameters to fit; by default all that |P|^2 depends on, less the angle
        where all directions lie in one plane.
    bounds
        (low, high) by name, in place of those of `diffopt.fitting.maps.default_bounds`.
    fresnel, shadowing
        Of the surface, as for `diffopt.DiffractionBRDF`.
    settings
        See `FitSettings`.
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
    box = default_bounds(
        like,
        names,
        frequency=frequency,
        coherence=float(measured.coherence),
        wavelengths=(float(measured.wavelengths.min()), float(measured.wavelengths.max())),
        given=bounds,
    )
    run = _Run(measured, job, like, names, box, settings, frequency, kappa, progress)
    try:
        solved = run.from_starts(given) if known else run.from_data()
        interrupted = None
    except KeyboardInterrupt:
        solved, interrupted = run.best, run.doing
        if solved is None:
            raise
    return run.answer(solved, held, interrupted)


@dataclasses.dataclass
class _Run:
    """One fit under way; `best` is what an interruption leaves."""

    measured: Measured
    job: forward.Job
    like: Surface
    names: tuple[str, ...]
    box: Bounds
    settings: FitSettings
    frequency: float
    kappa: float
    progress: Progress | None
    best: tuple[Any, np.ndarray, solving.Solved, Reach] | None = None
    doing: str = "the start"
    history: dict[str, float] = dataclasses.field(default_factory=dict)

    def tell(self, doing: str, share: float) -> None:
        self.doing = doing
        if self.progress is not None:
            loss = math.inf if self.best is None else float(np.min(self.best[2].loss))
            self.progress(doing, share, loss)

    def reach(self, longest: float, broad: float = 0.0) -> Reach:
        """Static sizes, rounded so that similar data share their programs."""
        found = reach_for(
            longest=longest,
            frequency=self.frequency,
            coherence=float(self.measured.coherence),
            phase=self.kappa * self._highest(),
            broad=broad,
        )
        return Reach(
            next((n for n in (1, 2, 3, 4, 6) if n >= found.each_side), found.each_side),
            16 * math.ceil(found.highest / 16),
            32.0 * math.ceil(found.phase / 32.0),
            found.terms,
        )

    def _highest(self) -> float:
        every = kinds(self.like)
        sizes = [
            float(high)
            for name, high in zip(self.names, self.box.high, strict=True)
            if every[name] == "height"
        ]
        rest = [abs(float(self.like.get(n))) for n in every if every[n] == "height"]
        return max([*sizes, *rest, 1e-3])

    def solve(
        self, name: str, job: forward.Job, like: Any, y: np.ndarray, reach: Reach, **options: Any
    ) -> solving.Solved:
        wide = jnp.result_type(float)
        eps = float(jnp.finfo(self.like.dtype).eps)
        options = {
            "blurs": None,
            "solver": self.settings.solver,
            "tolerance": self.settings.tolerance or eps**0.5,
            "max_steps": self.settings.max_steps,
            **options,
        }
        found = solving.solve(job, like, self.box, jnp.asarray(y, wide), reach=reach, **options)
        found = jax.block_until_ready(found)
        self.history[name] = float(np.nanmin(np.asarray(found.loss)))
        self.best = (like, y, found, reach)
        return found

    def from_starts(self, given: list[Surface]) -> Any:
        values = np.array([[float(s.get(n)) for n in self.names] for s in given])
        y = self.box.unbounded(values)
        like = jax.tree.map(lambda *leaves: jnp.stack(leaves), *given)
        paths = [period for period, _ in lattice(self.like)]
        lengths = [float(s.get(p)) for s in given for p in paths]
        longest = 2.0 * max(lengths, default=1.0)
        reach = self.reach(longest)
        blurs, job = None, self.job
        if self.settings.stages and lengths and self.job.weights is None:
            self.tell("coarse to fine", 0.1)
            per_row = self.job.fx.shape[1]
            some = starts.brightest(self.job, max(_MOST_VALUES // per_row, 1))
            job = forward.rows(self.job, some)
            dtype = self.like.dtype
            coarsest = jnp.asarray(self.settings.coarsest * np.mean(lengths), dtype)
            sigma = self.measured.coherence.astype(dtype)
            blurs = solving.windows(job, sigma, coarsest, stages=self.settings.stages)
            found = self.solve("coarse to fine", job, like, y, reach, blurs=blurs)
            y = np.asarray(found.y)
        self.tell("least squares", 0.5)
        self.solve("least squares", self.job, like, y, reach)
        return self.best

    def from_data(self) -> Any:
        settings = self.settings
        self.tell("lattices", 0.0)
        some = starts.brightest(self.job, settings.rows)
        job = forward.rows(self.job, some)
        paths = lattice(self.like)
        tried = self._tried(job, paths)
        values, longest = tried
        reach = self.reach(1.1 * longest)
        self.tell("comparison of starts", 0.2)
        y = self.box.unbounded(values)
        like = _copies(self.like, len(y))
        wide = jnp.result_type(float)
        loss = np.asarray(solving.losses(job, like, self.box, jnp.asarray(y, wide), reach=reach))
        chosen = _diverse(loss, settings.starts, len(paths) and settings.lattices)
        self.tell("least squares on some rows", 0.4)
        found = self.solve(
            "least squares on some rows",
            job,
            _copies(self.like, len(chosen)),
            y[chosen],
            reach,
            tolerance=1e-3,
            max_steps=min(self.settings.max_steps, 24),
        )
        loss = np.nan_to_num(np.asarray(found.loss), nan=np.inf)
        y = np.asarray(found.y)
        minima = self.minima(y, loss)
        order = _apart(y, loss, settings.finalists)
        self.tell("least squares on all data", 0.8)
        like = _copies(self.like, len(order))
        self.solve("least squares on all data", self.job, like, y[order], reach)
        self.known = minima
        return self.best

    def _tried(self, job: forward.Job, paths: list[tuple[str, str]]) -> tuple[np.ndarray, float]:
        """Parameters of all starts to compare, [S, P], and the longest period among them."""
        settings, names = self.settings, self.names
        own = [p for pair in paths for p in pair]
        others = [k for k, name in enumerate(names) if name not in own]
        count = settings.design * 2 ** max(len(others) - 1, 0)
        points = starts.halton(min(count, 512), max(len(others), 1))
        design = np.zeros((len(points), len(names)))
        low, high = np.asarray(self.box.low, float), np.asarray(self.box.high, float)
        for column, k in enumerate(others):
            design[:, k] = _spread(names[k], self.box.shapes[k], low[k], high[k], points[:, column])
        if not paths:
            return design, 1.0
        vectors = starts.lattices(job, float(self.measured.coherence), settings.lattices)
        if not len(vectors):
            raise InputError(
                "measured: expected light away from the mirror direction to take a period from; "
                "received frequencies within the mirror's peak only. Give a start"
            )
        groups = _groups(
            vectors, len(paths), settings.lattices, signed="Blazed" in str(type(self.like))
        )
        out = []
        for group in groups:
            block = design.copy()
            for (period, angle), vector in zip(paths, group, strict=True):
                for path, value in (
                    (period, 1.0 / math.hypot(*vector)),
                    (angle, math.atan2(vector[1], vector[0])),
                ):
                    if path in names:
                        block[:, names.index(path)] = value
            out.append(block)
        longest = max(1.0 / math.hypot(*vector) for group in groups for vector in group)
        return np.concatenate(out), longest

    known: tuple[Minimum, ...] = ()

    def minima(self, y: np.ndarray, loss: np.ndarray) -> tuple[Minimum, ...]:
        """Distinct places where solves ended."""
        found: list[Minimum] = []
        order = np.argsort(loss)
        left = list(order[np.isfinite(loss[order])])
        while left:
            first = left[0]
            near = [k for k in left if np.abs(y[k] - y[first]).max() < 0.02]
            values = np.asarray(self.box.values(jnp.asarray(y[first])))
            found.append(
                Minimum(
                    dict(zip(self.names, values.tolist(), strict=True)),
                    float(loss[first]),
                    len(near),
                )
            )
            left = [k for k in left if k not in near]
        return tuple(found)

    def answer(
        self, solved: Any, held: Mapping[str, str], interrupted: str | None
    ) -> ReflectanceFit:
        like, _, found, reach = solved
        y, loss = np.asarray(found.y), np.nan_to_num(np.asarray(found.loss), nan=np.inf)
        best = int(np.argmin(loss))
        chosen = jax.tree.map(lambda leaf: leaf[best], like)
        surface = self.box.surface(chosen, jnp.asarray(y[best], self.like.dtype))
        surface = conventional(surface)
        norm = float(jnp.linalg.norm(self.measured.values / self.measured.noise))
        return answers.judged(
            self.job,
            surface,
            self.names,
            reach,
            noise_known=self.measured.noise_known,
            scale=norm,
            held=held,
            bounded=self.box.at_bound(y[best]),
            settled=bool(np.asarray(found.settled)[best]),
            interrupted=interrupted,
            minima=self.known or self.minima(y, loss),
            steps=int(np.asarray(found.steps)[best]),
            history=dict(self.history),
        )


def conventional(surface: Surface) -> Surface:
    """Among surfaces that reflect alike, the one with angles in a half turn.

    A profile that is its own mirror image repeats after half a turn, and is taken to lie in
    (-pi/2, pi/2]; a saw in (-pi, pi].
    """
    from diffopt.gratings import Blazed

    values = {}
    for period, angle in lattice(surface):
        owner = surface
        for part in period.split(".")[:-1]:
            owner = getattr(owner, part)
        turn = 2.0 * math.pi if isinstance(owner, Blazed) else math.pi
        at = surface.get(angle)
        values[angle] = at - turn * jnp.ceil(at / turn - 0.5)
    return surface.replaced(values) if values else surface


def _copies(surface: Surface, count: int) -> Surface:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), surface)


def _spread(name: str, shape: str, low: float, high: float, t: np.ndarray) -> np.ndarray:
    """Values of a parameter over the part of its range where starts are worth it."""
    last = name.split(".")[-1]
    if shape == "share":
        # Ridges of duty d and 1 - d reflect alike.
        top = 0.5 if last in ("duty", "width") else high
        return low + (top - low) * (0.05 + 0.9 * t)
    if last in ("depth", "amplitude", "height"):
        # Even in the depth itself: phases, and minima, are.
        return high * (0.02 + 0.6 * t)
    return low * (high / low) ** (0.2 + 0.6 * t)


def _groups(vectors: np.ndarray, count: int, most: int, *, signed: bool) -> list[tuple[Any, ...]]:
    """Lattices of one vector, both ways round where that matters, or pairs of vectors."""
    if count == 1:
        ways = (1.0, -1.0) if signed else (1.0,)
        return [(way * vector,) for vector in vectors for way in ways]
    pairs = []
    for j in range(len(vectors)):
        for k in range(j):
            a, b = vectors[k], vectors[j]
            sine = abs(a[0] * b[1] - a[1] * b[0]) / (math.hypot(*a) * math.hypot(*b))
            if sine > 0.2:
                pairs += [(a, b), (b, a)]
    if not pairs:
        a = vectors[0]
        pairs = [(a, np.array([-a[1], a[0]]))]
    return pairs[:most]


def _diverse(loss: np.ndarray, count: int, groups: int) -> np.ndarray:
    """The best starts, no more than a third of them from one lattice."""
    loss = np.nan_to_num(loss, nan=np.inf)
    size = max(len(loss) // max(groups, 1), 1) if groups else 1
    most = max(math.ceil(count / 3), 1) if groups else count
    taken: dict[int, int] = {}
    chosen = []
    for k in np.argsort(loss):
        group = int(k) // size
        if taken.get(group, 0) < most:
            taken[group] = taken.get(group, 0) + 1
            chosen.append(int(k))
        if len(chosen) == count:
            break
    # Always the same number, so that programs are shared.
    return np.array((chosen * math.ceil(count / len(chosen)))[:count])


def _apart(y: np.ndarray, loss: np.ndarray, count: int) -> np.ndarray:
    """The best ends that differ from each other; repeated where few are near the best."""
    chosen: list[int] = []
    for k in np.argsort(loss):
        if chosen and loss[k] > 1.5 * loss[chosen[0]] + 1e-6:
            break
        if all(np.abs(y[k] - y[j]).max() > 0.02 for j in chosen):
            chosen.append(int(k))
        if len(chosen) == count:
            break
    return np.array((chosen * count)[:count])


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
    for _, angle in lattice(like):
        if _in_plane(measured):
            held[angle] = f"{angle} was held: all directions of the data lie in one plane"
    from diffopt.gratings import CompactDisc

    if isinstance(like, CompactDisc):
        held |= {n: f"{n} was held: pass free= to fit it" for n in ("bit", "wall")}
    return tuple(name for name in seen if name not in held), held


def _in_plane(measured: Measured) -> bool:
    wave = np.asarray(measured.wi + measured.wo, np.float64)[:, :2]
    _, size, _ = np.linalg.svd(wave, full_matrices=False)
    return len(size) < 2 or bool(size[1] < 1e-3 * max(size[0], 1e-12))


def check_size(measured: Measured, names: Sequence[str]) -> None:
    """Refuse data with fewer values than free parameters."""
    size = measured.values.size
    if size <= len(names):
        raise InputError(f"values must outnumber the {len(names)} free parameters; received {size}")
