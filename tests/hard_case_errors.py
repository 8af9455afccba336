"""Errors of every kernel on its hard inputs, in ulps.

    python tests/hard_case_errors.py [--write]

prints the largest of each kernel; ``--write`` puts the table into ``docs/stability.md``. An ulp is
the dtype's eps times the largest value of a row; a slope's error is relative to the largest of the
slopes in an argument and of the values, less what the differences of the 80-bit twin err by.
"""

import inspect
import sys
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from hard_cases import LD, rows
from hard_cases.curvatures import along, curved, ways
from harmonic_cases import harmonic_rows
from intersect_cases import intersect_rows
from lighting_cases import lighting_rows
from lobe_cases import lobe_rows
from material_cases import material_rows
from tabulated_cases import tabulated_rows

ROWS = [*rows(), *material_rows(), *tabulated_rows(), *lobe_rows(), *intersect_rows()]
ROWS += harmonic_rows()
ROWS += lighting_rows()
BENT = list(curved())
#: Below it a second derivative counts as 0.
LEAST = 1e-37
# Differences of the 80-bit twin over at most 1e-8: 1e-11 of rounding; over 1e-9 at cosines of
# 1.7e-5, 4e-9 of the third derivative.
STEP = LD("1e-6")
#: Relative error of the differences.
NUMERIC = 1e-8
PAGE = Path(__file__).parent.parent / "docs" / "stability.md"
BEGIN, END = "<!-- errors of hard cases -->", "<!-- end of errors -->"


class Errors(NamedTuple):
    """Of a row in one dtype.

    Attributes
    ----------
    value
        Largest error of the value, compiled and not, ulps.
    finite
        Whether all slopes are.
    slopes
        Largest error in each argument over its size; none where the function has a kink.
    """

    value: float
    finite: bool
    slopes: tuple[float, ...]


def flat(value):
    leaves = value if isinstance(value, tuple | list) else (value,)
    return np.concatenate([np.asarray(v).astype(LD).ravel() for v in leaves])


def scalar(value):
    """One number from all outputs, every output counting differently."""
    leaves = value if isinstance(value, tuple | list) else (value,)
    total, index = 0.0, 0
    for leaf in leaves:
        weights = np.cos(np.arange(index, index + np.size(leaf)) + 0.3).reshape(np.shape(leaf))
        if isinstance(leaf, jax.Array):
            total = total + (leaf * jnp.asarray(weights, leaf.dtype)).sum()
        else:
            total = total + (np.asarray(leaf) * weights).sum()
        index += np.size(leaf)
    return total


def rounded(arguments, dtype):
    """Arguments as the dtype holds them: the twin must see the same numbers."""
    held = tuple(np.asarray(a).astype(dtype) for a in arguments)
    # 0-d arrays keep NumPy functions from returning plain floats.
    return tuple(jnp.asarray(a) for a in held), tuple(a.astype(LD)[()] for a in held)


def likeness(call):
    """What tells calls apart: rows that differ in their arguments alone share a program.

    The same code with the same captured values; what cannot be hashed, by its identity.
    """
    if isinstance(call, partial):
        options = [v for item in sorted(call.keywords.items()) for v in item]
        return partial, *map(likeness, (call.func, *call.args, *options))
    if hasattr(call, "lower") and hasattr(call, "__wrapped__"):
        return jax.jit, likeness(call.__wrapped__)
    if inspect.isfunction(call) and call.__kwdefaults__ is None:
        captured = [c.cell_contents for c in call.__closure__ or ()]
        return (
            call.__module__,
            call.__code__,
            *map(likeness, (*captured, *(call.__defaults__ or ()))),
        )
    try:
        hash(call)
    except TypeError:
        return "id", id(call)
    return type(call), call


CALLS = {likeness(r.call): r.call for r in ROWS}


@cache
def compiled(alike, count):
    """Value and slopes of a call in all its arguments."""

    def weighed(*a):
        value = CALLS[alike](*a)
        return scalar(value), value

    return jax.jit(jax.value_and_grad(weighed, tuple(range(count)), has_aux=True))


def measured(row, dtype, mapped=False):
    """`Errors` of a row; with `mapped` those of a batch of two as well."""
    arguments, exact = rounded(row.arguments, dtype)
    eps = float(jnp.finfo(dtype).eps)
    expected = flat(row.twin(*exact))
    scale = float(np.abs(expected).max()) or 1.0
    program = compiled(likeness(row.call), len(arguments))
    (_, value), slopes = program(*arguments)
    # A call that is compiled already would be so again.
    found = [value] if hasattr(row.call, "lower") else [value, row.call(*arguments)]
    gradients = [slopes]
    if mapped:
        (_, values), slopes = jax.vmap(program)(*(jnp.stack([a, a]) for a in arguments))
        for k in range(2):
            found.append(jax.tree.map(lambda leaf, k=k: leaf[k], values))
            gradients.append([slope[k] for slope in slopes])
    # NumPy's maximum keeps NaN, that of Python may lose it.
    off = float(np.max([np.abs(flat(each) - expected).max() for each in found]))
    finite = all(np.isfinite(s).all() for slopes in gradients for s in slopes)
    errors = []
    for index in range(len(arguments) if row.smooth else 0):
        numeric = differences(row.twin, exact, index)
        # A slope is judged beside the value it belongs to, over the argument's size.
        size = max(float(np.abs(numeric).max()), scale)
        each = [np.abs(np.asarray(s[index]).astype(LD) - numeric).max() for s in gradients]
        errors.append(float(np.max(each)) / size)
    return Errors(off / eps / scale, finite, tuple(errors))


def bent(row, dtype):
    """Largest error of second derivatives by kernel, ulps (`Curved`); infinite if not finite."""
    places = np.asarray(row.places, dtype)
    along_all = np.asarray(ways(places.shape[1]), dtype)

    def once(x, way):
        return jax.jvp(row.call, (x,), (way,))[1]

    def twice(x, way):
        return jax.jvp(lambda x: once(x, way), (x,), (way,))[1]

    every = jax.vmap(jax.vmap(twice, (None, 0)), (0, None))
    found = np.asarray(jax.jit(every)(places, along_all)).astype(float)
    eps, worst = float(jnp.finfo(dtype).eps), dict.fromkeys(row.kernels, 0.0)
    directions = [tuple(way) for way in along_all.astype(float).tolist()]
    for place, derivatives in zip(places.astype(float).tolist(), found, strict=True):
        right = {way: along(row.exact, tuple(place), way) for way in directions}
        for way, derivative in zip(directions, derivatives, strict=True):
            value, exact = right[way]
            size = max(1.0, *(abs(x) for x, w in zip(place, way, strict=True) if w))
            # Along two arguments at once, those along each may cancel.
            parts = [np.abs(right[w][1]) for w in directions[: len(way)] if np.dot(w, way)]
            for kernel in worst:
                mine = np.array([k == kernel for k in row.kernels])
                least = max(np.abs(value[mine]).max() / size**2, LEAST)
                least = np.maximum(np.max(parts, 0), least)[mine]
                error = np.abs(derivative - exact)[mine] / np.maximum(np.abs(exact)[mine], least)
                error = np.where(np.isfinite(error), error, np.inf)
                worst[kernel] = max(worst[kernel], float(error.max()) / eps)
    return worst


def differences(twin, exact, index):
    """Central differences of the twin in one argument, entry by entry."""
    at = np.array(exact[index], dtype=LD)
    out = np.zeros(at.shape, LD)
    for place in np.ndindex(at.shape):
        ends, width = [], LD(0)
        step = STEP * min(max(abs(at[place]), LD(1e-3)), LD(1e-2))
        for sign in (1, -1):
            moved = at.copy()
            moved[place] += sign * step
            width += sign * moved[place]  # as it was rounded
            moved_arguments = (*exact[:index], moved[()], *exact[index + 1 :])
            ends.append(scalar(twin(*moved_arguments)))
        out[place] = (ends[0] - ends[1]) / width
    return out


def table():
    """Kernel, rows, and the largest errors in float32 and float64, as rows of Markdown."""
    found = {}
    for number, row in enumerate(ROWS):
        for dtype in ("float32", "float64"):
            one = measured(row, dtype)
            eps = float(jnp.finfo(dtype).eps)
            slope = max((max(s - NUMERIC, 0.0) / eps for s in one.slopes), default=0.0)
            # In float64 the differences are what errs.
            slope = slope if dtype == "float32" else 0.0
            worst = found.setdefault(row.kernel, {}).setdefault(dtype, [0, 0.0, 0.0])
            worst[:] = worst[0] + 1, max(worst[1], one.value), max(worst[2], slope)
        if not number % 100:
            jax.clear_caches()
            print(f"{number} of {len(ROWS)}", file=sys.stderr)
    curved_by = {dtype: curvatures(dtype) for dtype in ("float32", "float64")}
    lines = [
        "| kernel | rows | value, float32 | value, float64 | slope, float32 | "
        "curvature, float32 | curvature, float64 |",
        "|---|---|---|---|---|---|---|",
    ]
    for kernel, by in sorted(found.items()):
        single, double = by["float32"], by["float64"]
        bends = [f"{of[kernel]:.2g}" if kernel in of else "" for of in curved_by.values()]
        values = [f"{x:.2g}" for x in (single[1], double[1], single[2])]
        lines.append(f"| `{kernel}` | {single[0]} | {' | '.join([*values, *bends])} |")
    return lines


def curvatures(dtype):
    """Largest error of the second derivatives of each kernel that has rows of them, ulps."""
    worst = {}
    for row in BENT:
        for kernel, error in bent(row, dtype).items():
            worst[kernel] = max(worst.get(kernel, 0.0), error)
    return worst


def main(words):
    """Print the table, and write it if asked to."""
    jax.config.update("jax_enable_x64", True)
    text = "\n".join(table())
    print(text)
    if "--write" in words:
        page = PAGE.read_text(encoding="utf-8")
        before, rest = page.split(BEGIN)
        after = rest.split(END)[1]
        PAGE.write_text(f"{before}{BEGIN}\n{text}\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
