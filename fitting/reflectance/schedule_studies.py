"""What accuracy costs for fits of gratings to reflectance: how much of the data is used when.

Gratings are recovered from simulated reflectance, once with all data and the exact forward model
from the first comparison of starts on, and by schedules that compare and solve on few rows, few
wavelengths and few orders first and finish on everything. Lattices are found beforehand and are
not timed; the best starts are taken as they come, where `fit_reflectance` sees to it that they
come from several lattices.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.accuracy.studies import Case, Job, Study
from diffopt.fitting.measured import Measured
from diffopt.fitting.reflectance import forward, solving, start_design, starts
from diffopt.fitting.reflectance.maps import Bounds, default_bounds
from diffopt.fitting.reflectance.settings import FitSettings
from diffopt.gratings import Binary, Reach, Surface

SIGMA, LAM = 2.0, np.linspace(0.42, 0.68, 7)
# Of the gratings' lines: periods up to 5 um, phases up to 2 pi 2 0.5 / 0.42.
_EXACT, _FEW = Reach(3, 32, 32.0), Reach(1, 32, 32.0)
_NAMES = ("period", "depth", "duty", "angle")
_GRATINGS = 12
_ERROR = "90th percentile over the gratings of the largest relative error among period, depth "
_ERROR += "and duty"


class Problem(NamedTuple):
    """Gratings and what they reflect.

    Attributes
    ----------
    truths
        Period, depth, duty, angle; [T, 4].
    jobs
        Of all, stacked.
    starts
        Unbounded, [T, S, 4].
    box, like
        Bounds, and a surface of the kind.
    some
        Numbers of rows in the order in which a schedule takes them, [T, M].
    """

    truths: np.ndarray
    jobs: forward.Job
    starts: Float[Array, "T S P"]
    box: Bounds
    like: Surface
    some: np.ndarray


def _directions() -> np.ndarray:
    axis = np.linspace(-0.9, 0.9, 31)
    x, y = (part.ravel() for part in np.meshgrid(axis, axis))
    inside = np.hypot(x, y) <= 0.9
    x, y = x[inside], y[inside]
    return np.stack([x, y, np.sqrt(1.0 - x**2 - y**2)], -1)


@functools.cache
def problem(count: int, x64: bool) -> Problem:
    """Binary gratings of periods 0.8 to 5 um and depths 40 to 500 nm, 2 % noise."""
    del x64  # a key: arrays of either precision are kept apart
    rng, wo = np.random.default_rng(7), _directions()
    wi = np.array([math.sin(0.17), 0.0, math.cos(0.17)])
    like = Binary(1.0, 0.1, 0.4)
    empty = Measured(wi, wo, LAM, np.ones((len(wo), len(LAM)), like.dtype), SIGMA)
    clean = jax.jit(lambda s: forward.predicted(forward.job(empty), s, _EXACT))
    frequency, _ = forward.largest(forward.job(empty))
    box = default_bounds(
        like, _NAMES, frequency=frequency, coherence=SIGMA, wavelengths=(LAM[0], LAM[-1])
    )
    truths, jobs, tried, some = [], [], [], []
    for _ in range(count):
        truth = (
            math.exp(rng.uniform(math.log(0.8), math.log(5.0))),
            rng.uniform(0.04, 0.5),
            rng.uniform(0.1, 0.5),
            rng.uniform(-1.5, 1.5),
        )
        period, depth, duty, angle = truth
        values = np.asarray(clean(Binary(period, depth, duty, 0.0, angle)), np.float64)
        noise = 0.02 * values + 1e-3 * values.max()
        values = values + noise * rng.normal(size=values.shape)
        data = Measured(wi, wo, LAM, values.astype(like.dtype), SIGMA, noise=noise)
        job = forward.job(data)
        rows = starts.brightest(job, 400)
        found = start_design.tried(forward.rows(job, rows), like, box, FitSettings(), SIGMA)
        rest = np.setdiff1d(np.arange(len(wo)), rows)
        size = np.linalg.norm(np.asarray(job.values * job.scale), axis=1)
        # Bright and other rows in turn, so that any first part has both.
        order = rows[np.argsort(-size[rows])]
        mixed = np.stack([order[:200], rng.permutation(order[200:])], 1).ravel()
        truths.append(truth)
        jobs.append(job)
        tried.append(box.unbounded(found))
        some.append(np.concatenate([mixed, rest]))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *jobs)
    start = jnp.asarray(np.stack(tried), jnp.result_type(float))
    return Problem(np.array(truths), stacked, start, box, like, np.stack(some))


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How much is used of the data, and when.

    Attributes
    ----------
    rows, wavelengths
        Of the comparison of starts and of the first solves; all of the data if None.
    starts
        Solved from.
    finish
        Whether the best three are finished on all of the data with all orders.
    """

    rows: int | None
    wavelengths: int | None
    starts: int = 12
    finish: bool = True


def _fit(schedule: Schedule, p: Problem) -> Any:
    def few(job: forward.Job, rows: Array) -> forward.Job:
        if schedule.rows is not None:
            job = forward.rows(job, rows[: schedule.rows])
        if schedule.wavelengths is not None:
            kept = np.linspace(0, len(LAM) - 1, schedule.wavelengths + 2).round().astype(int)[1:-1]
            job = forward.columns(job, kept)
        return job

    exact = schedule.rows is None and schedule.wavelengths is None
    reach = _EXACT if exact else _FEW
    finish = FitSettings().last(p.jobs.values[0])
    coarse = finish | {"tolerance": 1e-3, "max_steps": 24, "flat": 1e-3}

    def solve(job: forward.Job, y: Array, reach: Reach, options: dict[str, Any]) -> Any:
        like = solving.copies(p.like, len(y))
        return solving.solve(job, like, p.box, y, None, reach=reach, **options)

    def one(part: tuple[forward.Job, Array, Array]) -> Array:
        job, y, rows = part
        first = few(job, rows)
        loss = solving.losses(first, solving.copies(p.like, len(y)), p.box, y, reach=reach)
        y = y[jnp.argsort(loss)[: schedule.starts]]
        found = solve(first, y, reach, finish if exact or not schedule.finish else coarse)
        y, loss = found.y, found.loss
        if schedule.finish and not exact:
            found = solve(job, y[jnp.argsort(loss)[:3]], _EXACT, finish)
            y, loss = found.y, found.loss
        return p.box.values(y[jnp.argmin(loss)])

    return lambda jobs, y, rows: jax.lax.map(one, (jobs, y, rows))


def _judge(found: Any, truths: np.ndarray) -> tuple[float, str]:
    found = np.asarray(found, np.float64)[:, :3]
    true = truths[:, :3].copy()
    # Ridges of duty d and 1 - d reflect alike.
    found[:, 2], true[:, 2] = (
        np.minimum(found[:, 2], 1 - found[:, 2]),
        np.minimum(true[:, 2], 1 - true[:, 2]),
    )
    error = np.abs(found / true - 1.0).max(1)
    good = error < 0.05
    return float(np.percentile(error, 90.0)), (
        f"{good.sum()} of {len(good)} recovered, median error {np.median(error):.2g}"
    )


def _case(schedule: Schedule, count: int) -> Case:
    def build() -> Job:
        p = problem(count, jnp.result_type(float) == jnp.dtype("float64"))
        return Job(
            _fit(schedule, p),
            (p.jobs, p.starts, jnp.asarray(p.some)),
            functools.partial(_judge, truths=p.truths),
        )

    named = {
        "rows": schedule.rows or "all",
        "wavelengths": schedule.wavelengths or "all",
        "starts": schedule.starts,
        "finished on all": "yes" if schedule.finish else "no",
    }
    return Case(named, "float32", build)


def _cases(quick: bool) -> list[Case]:
    every = [
        Schedule(None, None),
        Schedule(400, None),
        Schedule(200, 2),
        Schedule(100, 2),
        Schedule(400, None, finish=False),
        Schedule(400, None, starts=4),
        Schedule(400, None, starts=1),
        Schedule(200, 2, starts=4),
        Schedule(200, None),
        Schedule(400, 2),
        Schedule(400, 1),
    ]
    return [
        _case(schedule, 3 if quick else _GRATINGS) for schedule in (every[:3] if quick else every)
    ]


SCHEDULE = Study(
    "heightfield.schedule",
    f"{_ERROR}; {_GRATINGS} binary gratings, 2 % noise, 697 pairs of directions, 7 wavelengths",
    "the gratings that were simulated",
    _cases,
)
