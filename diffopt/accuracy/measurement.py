"""Cost of a compiled function: compilation, run, gradient, operations, memory.

Everything is compiled ahead of time, so that no run includes compilation, and every run is
waited for, so that none is measured while it is still under way.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

# Runs shorter than this are repeated within one measurement: the clock and the call take
# some 10 microseconds.
SHORTEST_S = 1e-3


@dataclass(frozen=True)
class Measurement:
    """What a function costs on the present machine.

    Attributes
    ----------
    compile_s
        Seconds to trace and compile, without the gradient.
    run_s, run_spread
        Median of the runs and distance of their quartiles, seconds.
    gradient_s
        Median seconds for value and gradient together; None if not asked for.
    flops
        Floating-point operations as XLA counts them: the body of a loop counts once,
        whatever the number of its passes. None where the backend does not say.
    peak_bytes
        Arguments, results and temporaries of the compiled program together, of the
        gradient's where it was asked for. None where the backend does not say.
    value
        What the function returned.
    """

    compile_s: float
    run_s: float
    run_spread: float
    gradient_s: float | None = None
    flops: float | None = None
    peak_bytes: int | None = None
    value: Any = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class Program:
    """A function compiled for the shapes of its arguments, see `compile_ahead`."""

    compiled: Callable[..., Any]
    compile_s: float
    flops: float | None
    peak_bytes: int | None

    def __call__(self, *arguments: Any) -> Any:
        """Run it and wait for the result."""
        return jax.block_until_ready(self.compiled(*arguments))


def compile_ahead(function: Callable[..., Any], *arguments: Any) -> Program:
    """Compile a function for arguments (pytrees of arrays) without running it.

    JAX keeps what it has traced and compiled: the seconds are those of a first time only for a
    function and shapes that nothing in the process has used.
    """
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    seconds = time.perf_counter() - start
    costs = compiled.cost_analysis() or {}
    return Program(compiled, seconds, costs.get("flops"), peak_bytes(compiled))


def compile_by_running(function: Callable[..., Any], *arguments: Any) -> Program:
    """A function that works partly outside JAX: what its first run takes longer than its second."""
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        jax.block_until_ready(function(*arguments))
        seconds.append(time.perf_counter() - start)
    return Program(function, max(seconds[0] - seconds[1], 0.0), None, None)


def peak_bytes(compiled: Any) -> int | None:
    """Arguments, results and temporaries of a compiled program; None where it does not say."""
    memory = compiled.memory_analysis()
    if memory is None:
        return None
    return (
        memory.argument_size_in_bytes
        + memory.output_size_in_bytes
        + memory.temp_size_in_bytes
        - memory.alias_size_in_bytes
    )


def value_and_gradient(function: Callable[..., Any], argument: int) -> Callable[..., Any]:
    """Sum of a function's results, and its gradient with respect to one argument."""

    def total(chosen, *arguments):
        result = function(*arguments[:argument], chosen, *arguments[argument:])
        return sum(jnp.sum(leaf) for leaf in jax.tree.leaves(result))

    derivative = eqx.filter_value_and_grad(total)

    def both(*arguments):
        rest = arguments[:argument] + arguments[argument + 1 :]
        return derivative(arguments[argument], *rest)

    return both


def time_together(
    programs: Sequence[tuple[Callable[..., Any], tuple]], repeats: int
) -> list[tuple[float, float]]:
    """Median and quartile distance of the seconds of each program, taken in turn.

    One run of each, then the next of each: a machine that slows down slows all of them, and
    ratios remain. A program is called with its arguments, waits for its result, and has run
    once before it is timed.
    """
    passes = []
    for program, arguments in programs:
        start = time.perf_counter()
        program(*arguments)
        seconds = time.perf_counter() - start
        passes.append(max(1, min(1000, int(SHORTEST_S / max(seconds, 1e-7)))))
    samples = np.zeros((len(programs), repeats))
    for repeat in range(repeats):
        for index, ((program, arguments), count) in enumerate(zip(programs, passes, strict=True)):
            start = time.perf_counter()
            for _ in range(count):
                program(*arguments)
            samples[index, repeat] = (time.perf_counter() - start) / count
    low, middle, high = np.quantile(samples, [0.25, 0.5, 0.75], axis=1)
    return [(float(m), float(q)) for m, q in zip(middle, high - low, strict=True)]


def measure(
    function: Callable[..., Any],
    *arguments: Any,
    repeats: int = 7,
    gradient: int | None = None,
    program: Program | None = None,
) -> Measurement:
    """Compile a function ahead of time and time it.

    Parameters
    ----------
    function
        Of arrays or pytrees of arrays, as `jax.jit` takes it.
    arguments
        What it is called with.
    repeats
        Runs of which the median is taken, after one that is not counted.
    gradient
        Position of the argument for which value and gradient are timed as well (of the sum
        of the results); None for none.
    program
        The function already compiled by `compile_ahead`, to save compiling it again.
    """
    if program is None:
        program = compile_ahead(function, *arguments)
    runs = [(program, arguments)]
    peak = program.peak_bytes
    if gradient is not None:
        backward = compile_ahead(value_and_gradient(function, gradient), *arguments)
        runs.append((backward, arguments))
        peak = backward.peak_bytes
    timings = time_together(runs, repeats)
    return Measurement(
        compile_s=program.compile_s,
        run_s=timings[0][0],
        run_spread=timings[0][1],
        gradient_s=timings[1][0] if gradient is not None else None,
        flops=program.flops,
        peak_bytes=peak,
        value=program(*arguments),
    )
