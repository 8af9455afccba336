"""How the methods of a comparison are set up, timed and judged, one `Row` for each.

Those with a bound take the settings of `diffopt.choice.prepare`; see `diffopt.accuracy.tuning`
for the others, and `diffopt.accuracy.nufft` for the one that is no method of this package.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import baking, bounds, few, gathering
from diffopt.accuracy import output as printing
from diffopt.accuracy.comparison import Row, Task
from diffopt.accuracy.measurement import compile_ahead
from diffopt.baking import Box
from diffopt.choice import PreparedBRDF
from diffopt.settings import (
    FewSettings,
    GatherSettings,
    SeparableSettings,
    Settings,
    TableSettings,
)

# Runs that are repeated, as long as they take less than a second together.
_REPEATS = 5


def named(task: Task, name: str) -> Row:
    """Row of a method with the settings that `prepare` chooses for it."""
    start = time.perf_counter()
    prepared = prepare(task, method=name)
    return measured(task, name, prepared, time.perf_counter() - start)


def prepare(task: Task, **how: Any) -> PreparedBRDF:
    """The task's model with a method, or settings, as `diffopt.choice.prepare` takes them."""
    return task.brdf.prepare(
        pairs=(task.wi, task.wo),
        wavelengths=task.wavelengths,
        output=task.output,
        tolerance=task.tolerance,
        **how,
    )


def measured(task: Task, name: str, prepared: PreparedBRDF, first_s: float, note: str = "") -> Row:
    """Row of a prepared method; `first_s` is what preparing took the first time."""
    setup_s = _setup_seconds(task, prepared)
    timed = _run(task, prepared)
    value = timed.value
    if timed.wavelengths < len(task.wavelengths):
        value = prepared(*task.checked)
    notes = [note]
    extrapolated = (timed.pairs, timed.wavelengths) != (len(task.wi), len(task.wavelengths))
    if extrapolated:
        notes.append(f"run on {timed.pairs} pairs at {timed.wavelengths} wavelengths")
    if len(value) < len(task.check.index):
        notes.append(f"error on {len(value)} pairs")
    bound = prepared.choice.error_bound
    return Row(
        method=name,
        settings=_words(prepared.settings),
        dtype=str(task.brdf.surface.heights.dtype),
        setup_s=setup_s,
        run_s=timed.whole_s,
        compile_s=max(0.0, first_s - setup_s) + timed.compile_s,
        ns=1e9 * timed.whole_s / (len(task.wi) * len(task.wavelengths)),
        tables_mb=_nbytes(prepared.tables) / 1e6,
        memory_mb=None if timed.peak is None else timed.peak / 1e6,
        error=task.check.error(value),
        bound=None if np.isnan(bound) else bound,
        extrapolated=extrapolated,
        note="; ".join(filter(None, notes)),
    )


def _words(settings: Settings) -> str:
    values = dataclasses.asdict(settings)
    values.pop("chunk", None)
    return printing.label(values)


def _nbytes(tables: Any) -> int:
    leaves = (np.asarray(leaf) for leaf in jax.tree.leaves(tables))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)


def _setup_seconds(task: Task, prepared: PreparedBRDF) -> float:
    """Seconds to make the tables once more, now that all is compiled."""
    brdf, lam, settings = task.brdf, task.wavelengths, prepared.settings
    make: Callable[[], Any]
    if isinstance(settings, TableSettings):
        channels = np.eye(len(lam)) if task.weights is None else task.weights
        relative = task.output == "relative" or (task.output == "xyz" and brdf.balance == "peak")
        box = Box.around(task.wave)
        make = lambda: baking.bake(brdf, box, lam, channels, settings, relative=relative)  # noqa: E731
    elif isinstance(settings, FewSettings):
        assert task.weights is not None
        weights, w = task.weights, task.wave[:, 2]
        ends = float(w.min()), float(w.max())
        make = lambda: few.few_wavelengths(brdf, lam, weights, ends, settings)  # noqa: E731
    elif isinstance(settings, GatherSettings):
        return _gather_seconds(task, settings)
    else:
        return 0.0
    jax.block_until_ready(jax.tree.leaves(make()))
    return _median(make)


def _gather_seconds(task: Task, settings: GatherSettings) -> float:
    surface = task.brdf.surface
    reached = jnp.asarray(
        bounds.s_interval(surface, task.wave[:, 2], task.wavelengths), surface.heights.dtype
    )
    program = compile_ahead(
        lambda surface, reached: gathering.gather_tables(surface, settings, reached),
        surface,
        reached,
    )
    return _median(lambda: program(surface, reached))


def _median(make: Callable[[], Any]) -> float:
    """Seconds of a call: of one if it is long, the median of several if not."""
    seconds: list[float] = []
    while len(seconds) < _REPEATS and sum(seconds) < 1.0:
        start = time.perf_counter()
        jax.block_until_ready(jax.tree.leaves(make()))
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


@dataclasses.dataclass(frozen=True)
class _Timed:
    """A part of a job that was run: its size, its cost, and that of the whole job."""

    pairs: int
    wavelengths: int
    whole_s: float
    compile_s: float
    peak: int | None
    value: Any


def _run(task: Task, prepared: PreparedBRDF) -> _Timed:
    """Time as much of the job as the budget holds."""
    pairs, colours = len(task.wi), len(task.wavelengths)
    unit = 1
    if isinstance(prepared.settings, SeparableSettings | FewSettings):
        # One product serves a whole chunk: fewer pairs would cost as much.
        unit = min(pairs, SeparableSettings().chunk)
    divisible = not isinstance(prepared.settings, TableSettings | FewSettings)
    # The first guess by the cost model, on the safe side; then by what was measured.
    aim, compile_s = 0.3 * task.budget_s, 0.0
    rate = prepared.choice.run_s / (pairs * colours)
    while True:
        asked = aim / max(rate, 1e-12)
        m = min(pairs, max(unit, int(asked / colours) // unit * unit))
        n = int(np.clip(asked / m, 1, colours)) if divisible and asked < m * colours else colours
        part = _at_some(prepared, n)
        dtype = prepared.wavelengths.dtype
        arguments = (part, jnp.asarray(task.wi[:m], dtype), jnp.asarray(task.wo[:m], dtype))
        program = compile_ahead(lambda model, wi, wo: model(wi, wo), *arguments)
        compile_s += program.compile_s
        value = program(*arguments)
        seconds = _median(functools.partial(program, *arguments))
        rate = seconds / (m * n)
        whole = (m, n) == (pairs, colours)
        if whole or seconds > 0.1 * task.budget_s or aim > 0.5 * task.budget_s:
            return _Timed(m, n, rate * pairs * colours, compile_s, program.peak_bytes, value)
        aim = task.budget_s


def _at_some(prepared: PreparedBRDF, count: int) -> PreparedBRDF:
    """The same at `count` of its wavelengths."""
    kept = np.linspace(0, len(prepared.wavelengths) - 1, count).astype(int)
    if count == len(prepared.wavelengths):
        return prepared
    weights = prepared.weights
    return dataclasses.replace(
        prepared,
        wavelengths=prepared.wavelengths[kept],
        weights=None if weights is None else weights[kept],
    )
