"""What runs often, timed: compilation, run, gradient, operations, memory.

`run` gives the benchmarks of `NAMES` by name; `measure` does the same for any function:

>>> from diffopt.accuracy.benchmarks import measure
>>> print(measure(jnp.linalg.norm, jnp.ones((1000, 1000)), gradient=0))
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import jax

from diffopt.accuracy.measurement import Measurement as Measurement
from diffopt.accuracy.measurement import (
    compile_ahead,
    compile_by_running,
    time_together,
    value_and_gradient,
)
from diffopt.accuracy.measurement import measure as measure
from diffopt.errors import InputError

# Where each benchmark is defined; modules are imported when one is asked for.
NAMES: dict[str, str] = {
    "colour.xyz": "diffopt.accuracy.diffraction_benchmarks:COLOUR",
    "derivative": "diffopt.accuracy.diffraction_benchmarks:DERIVATIVE",
    "direct.positions": "diffopt.accuracy.diffraction_benchmarks:DIRECT_POSITIONS",
    "direct.window": "diffopt.accuracy.diffraction_benchmarks:DIRECT_WINDOW",
    "expansion.gather": "diffopt.accuracy.diffraction_benchmarks:EXPANSION_GATHER",
    "frames": "diffopt.accuracy.frame_benchmarks:FRAMES",
    "render.paths": "diffopt.accuracy.render_throughput:PATHS",
    "render.rays": "diffopt.accuracy.render_throughput:RAYS",
    "separable.grid": "diffopt.accuracy.diffraction_benchmarks:SEPARABLE_GRID",
    "separable.pairs": "diffopt.accuracy.diffraction_benchmarks:SEPARABLE_PAIRS",
    "shadow.distances": "diffopt.accuracy.shadow_benchmarks:DISTANCES",
    "shadow.matrices": "diffopt.accuracy.shadow_benchmarks:MATRICES",
    "shadow.receivers": "diffopt.accuracy.shadow_benchmarks:RECEIVERS",
    "shadow.sampling": "diffopt.accuracy.shadow_benchmarks:SAMPLING",
    "shadow.table": "diffopt.accuracy.shadow_benchmarks:TABLE",
    "taylor.gather": "diffopt.accuracy.diffraction_benchmarks:TAYLOR_GATHER",
    "taylor.tables": "diffopt.accuracy.diffraction_benchmarks:TAYLOR_TABLES",
    "transfer.relight": "diffopt.accuracy.transfer_benchmarks:RELIGHT",
    "transfer.slices": "diffopt.accuracy.transfer_benchmarks:SLICES",
}
SIZES = ("small", "full")

# Called before each benchmark with its number from 0, the number of benchmarks, its name.
Progress = Callable[[int, int, str], None]


@dataclass(frozen=True)
class Entry:
    """One timed function of a benchmark.

    Attributes
    ----------
    variant
        Name beside that of the benchmark; may be empty.
    function, arguments
        What is compiled and run.
    shape
        Size of the problem, for the table.
    work, unit
        Units of work in one run, and what a unit is: the note gives nanoseconds for each.
    gradient
        Position of the argument whose gradient is timed, or None.
    rate
        Whether the note gives the units in a second as well.
    whole
        Whether JAX compiles the whole function. Where it does not, the function compiles its
        parts itself when it first runs, and operations and memory are not known.
    """

    variant: str
    function: Callable[..., Any]
    arguments: tuple
    shape: str
    work: int
    unit: str
    gradient: int | None = None
    dtype: str = "float32"
    rate: bool = False
    whole: bool = True


@dataclass(frozen=True)
class Benchmark:
    """Entries that are timed in turn.

    Attributes
    ----------
    name
        As in `NAMES`.
    description
        What it is about.
    entries
        From ``small`` or ``full`` to the entries.
    alternatives
        Whether the entries of one shape do the same in different ways: the notes of all but
        the first then give its ratios to that one.
    """

    name: str
    description: str
    entries: Callable[[str], list[Entry]]
    alternatives: bool = False


@dataclass(frozen=True)
class Result:
    """One line of the table; costs as in `diffopt.accuracy.measurement.Measurement`."""

    name: str
    shape: str
    dtype: str
    compile_s: float
    run_s: float
    run_spread: float
    gradient_s: float | None
    flops: float | None
    peak_bytes: int | None
    note: str


def run(
    names: Sequence[str] | None = None,
    size: str = "small",
    repeats: int = 7,
    progress: Progress | None = None,
) -> list[Result]:
    """Run benchmarks.

    Parameters
    ----------
    names
        Some of `NAMES`; all if left out.
    size
        ``small`` (about a minute for all) or ``full``.
    repeats
        Timed runs of each, of which the median is taken. The entries of one benchmark take
        turns, so that their ratios hold on a busy machine as well.
    progress
        Called as ``progress(done, total, name)`` before each and at the end.

    Raises
    ------
    InputError
        For an unknown name or size, or fewer than one repeat.
    """
    if size not in SIZES:
        raise InputError(f"size must be one of {', '.join(SIZES)}; received {size!r}")
    if repeats < 1:
        raise InputError(f"repeats must be at least 1; received {repeats}")
    chosen = [_benchmark(name) for name in (sorted(NAMES) if names is None else names)]
    results = []
    for done, benchmark in enumerate(chosen):
        if progress is not None:
            progress(done, len(chosen), benchmark.name)
        # As most users run, whatever the caller has switched on.
        with jax.enable_x64(False):
            results += _run(benchmark, size, repeats)
    if progress is not None:
        progress(len(chosen), len(chosen), "")
    return results


def _benchmark(name: str) -> Benchmark:
    if name not in NAMES:
        raise InputError(f"no benchmark {name!r}; expected one of {', '.join(sorted(NAMES))}")
    module, attribute = NAMES[name].split(":")
    return getattr(import_module(module), attribute)


def _run(benchmark: Benchmark, size: str, repeats: int) -> list[Result]:
    entries = benchmark.entries(size)
    forward = [
        (compile_ahead if e.whole else compile_by_running)(e.function, *e.arguments)
        for e in entries
    ]
    backward = {
        index: compile_ahead(value_and_gradient(e.function, e.gradient), *e.arguments)
        for index, e in enumerate(entries)
        if e.gradient is not None
    }
    programs = [
        *zip(forward, (e.arguments for e in entries), strict=True),
        *((program, entries[index].arguments) for index, program in backward.items()),
    ]
    timings = time_together(programs, repeats)
    gradients = dict(zip(backward, timings[len(entries) :], strict=True))
    results: list[Result] = []
    first: dict[str, Result] = {}
    for index, (entry, program) in enumerate(zip(entries, forward, strict=True)):
        run_s, spread = timings[index]
        gradient_s = gradients[index][0] if index in gradients else None
        result = Result(
            name="/".join(filter(None, (benchmark.name, entry.variant))),
            shape=entry.shape,
            dtype=entry.dtype,
            compile_s=program.compile_s,
            run_s=run_s,
            run_spread=spread,
            gradient_s=gradient_s,
            flops=program.flops,
            peak_bytes=backward.get(index, program).peak_bytes,
            note="",
        )
        note = f"{run_s / entry.work * 1e9:.3g} ns per {entry.unit}"
        if entry.rate:
            note = f"{entry.work / run_s:.3g} {entry.unit}s per second, {note}"
        if benchmark.alternatives:
            note += _compared(result, first.setdefault(entry.shape, result))
        results.append(Result(**{**vars(result), "note": note}))
    return results


def _compared(result: Result, base: Result) -> str:
    """How many times as much as the first entry of the same shape."""
    if base is result:
        return ""
    text = f"; to {base.name.split('/')[-1]}: run x {result.run_s / base.run_s:.2g}"
    if result.gradient_s and base.gradient_s:
        text += f", gradient x {result.gradient_s / base.gradient_s:.2g}"
    if result.peak_bytes and base.peak_bytes:
        text += f", memory x {result.peak_bytes / base.peak_bytes:.2g}"
    return text
