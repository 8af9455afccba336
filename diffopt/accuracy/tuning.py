"""Methods of a comparison that are tuned on the truth, as somebody would who knew it.

The Taylor methods, the diffraction thesis's among them, take the cheapest terms and reach
whose measured error meets the tolerance; the few wavelengths the smallest count.
"""

import dataclasses
import functools
import math
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

from diffopt import bounds, few, gathering
from diffopt.accuracy import contenders
from diffopt.accuracy.comparison import Row, Task, widened
from diffopt.diffraction import evaluate
from diffopt.errors import InputError
from diffopt.kernels import phase
from diffopt.settings import FewSettings, SeparableSettings, TaylorSettings

# Tables for tuning that would be larger are refused, bytes.
LARGEST_TABLES = 2**32


def taylor(task: Task, name: str, *, centred: bool) -> Row:
    """Row of the Taylor gather with the cheapest settings that meet the tolerance.

    In float64 where float32 meets it with no number of terms: the thesis made its tables in
    double precision as well.
    """
    start = time.perf_counter()
    try:
        settings = _tuned_taylor(task, centred)
    except InputError:
        if task.brdf.surface.heights.dtype != jnp.float32:
            raise
        with jax.enable_x64(True):
            wide = dataclasses.replace(task, brdf=widened(task.brdf))
            settings = _tuned_taylor(wide, centred)
            prepared = contenders.prepare(wide, settings=settings)
            seconds = time.perf_counter() - start
            return contenders.measured(
                wide, name, prepared, seconds, "tuned; float32 does not meet it"
            )
    prepared = contenders.prepare(task, settings=settings)
    return contenders.measured(task, name, prepared, time.perf_counter() - start, "tuned")


def _tuned_taylor(task: Task, centred: bool) -> TaylorSettings:
    """The cheapest terms and reach whose measured error meets the tolerance."""
    surface, lam = task.brdf.surface, task.wavelengths
    argument = bounds.phase_range(surface, task.wave, lam) * (0.5 if centred else 1.0)
    most = phase.taylor_terms(argument, 1e-9)
    bounds.refuse_rounding(surface, TaylorSettings(most, centred=centred), task.wave, lam)
    itemsize = surface.heights.dtype.itemsize
    if 2 * most * surface.heights.size * itemsize > LARGEST_TABLES:
        raise InputError(f"tables of {most} Taylor terms would take more than 4 GiB")
    # From a reach that leaves nothing out, down as long as the tolerance is met.
    reach, longest = 1, min(surface.heights.shape) // 2 - 1
    while bounds.gather_cut(surface, reach, lam) > 0.25 * task.allowed and reach < longest:
        reach += 1
    found: list[TaylorSettings] = []
    error = math.inf
    while reach >= 1:
        errors = _taylor_errors(task, TaylorSettings(most, reach, centred))
        error = errors(most)
        if error > task.tolerance:
            break
        low, high = 0, most
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if errors(middle) <= task.tolerance else (middle, high)
        found.append(TaylorSettings(high, reach, centred))
        reach -= 1
    if not found:
        raise InputError(
            f"{surface.heights.dtype} Taylor terms do not meet the tolerance "
            f"{task.tolerance:g}, however many: error {error:.1e}"
        )
    return min(found, key=lambda each: (2 * each.reach + 1) ** 2 * each.terms)


def _taylor_errors(task: Task, settings: TaylorSettings) -> Callable[[int], float]:
    """Measured error against the number of terms, one program for all."""
    surface = task.brdf.surface
    tables = gathering.gather_tables(surface, settings, jnp.zeros(2, surface.heights.dtype))

    @functools.cache
    def error(terms: int) -> float:
        kept = (jnp.arange(settings.terms) < terms).astype(tables.values.dtype)
        cut = dataclasses.replace(tables, values=tables.values * kept[None, None, None, :])
        value = evaluate(
            task.brdf,
            *task.checked,
            task.wavelengths,
            settings,
            output=task.output,
            weights=task.weights,
            tables=cut,
        )
        return task.check.error(value)

    return error


def few_wavelengths(task: Task, name: str) -> Row:
    """Row of the few wavelengths, the smallest count whose measured error meets the tolerance.

    Found by bisection, as if the error fell steadily with the count.
    """
    if task.weights is None:
        raise InputError(f"method 'few' is for output='xyz'; received output={task.output!r}")
    start = time.perf_counter()
    nodes = contenders.prepare(task, method="separable").settings
    assert isinstance(nodes, SeparableSettings)
    ends = float(task.wave[:, 2].min()), float(task.wave[:, 2].max())
    dtype = task.brdf.surface.heights.dtype
    wi, wo = (jnp.asarray(v, dtype) for v in task.checked)

    def error(count: int) -> float:
        settings = FewSettings(count=count, nodes=nodes.nodes)
        assert task.weights is not None
        made = few.few_wavelengths(task.brdf, task.wavelengths, task.weights, ends, settings)
        return task.check.error(few.evaluate_few(task.brdf, made, wi, wo, settings))

    low, high = 3, len(task.wavelengths)
    least = error(high)
    if least > task.tolerance:
        raise InputError(f"not even all {high} wavelengths meet it: error {least:.1e}")
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if error(middle) <= task.tolerance else (middle, high)
    prepared = contenders.prepare(task, settings=FewSettings(count=high, nodes=nodes.nodes))
    return contenders.measured(task, name, prepared, time.perf_counter() - start, "tuned")
