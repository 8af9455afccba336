"""Every kernel on its hard inputs: value and gradient, compiled and not, in both dtypes."""

import importlib
import inspect
import pkgutil
from functools import cache, partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hard_cases import LD, rows
from harmonic_cases import harmonic_rows
from intersect_cases import intersect_rows
from lighting_cases import lighting_rows
from lobe_cases import lobe_rows
from material_cases import material_rows
from tabulated_cases import tabulated_rows

import diffopt.kernels

ROWS = [*rows(), *material_rows(), *tabulated_rows(), *lobe_rows(), *intersect_rows()]
ROWS += harmonic_rows()
ROWS += lighting_rows()
IDS = [f"{r.kernel}-{r.label}".replace(" ", "") for r in ROWS]
# Differences of the 80-bit twin over at most 1e-8: 1e-11 of rounding; over 1e-9 at cosines of
# 1.7e-5, 4e-9 of the third derivative.
STEP = LD("1e-6")


def public_kernels():
    """Names of the array-valued functions of the kernels."""
    for info in pkgutil.iter_modules(diffopt.kernels.__path__):
        module = importlib.import_module(f"diffopt.kernels.{info.name}")
        for name, function in vars(module).items():
            if name.startswith("_") or not callable(function) or inspect.isclass(function):
                continue
            if getattr(function, "__module__", None) != module.__name__:
                continue
            if on_the_host(inspect.signature(function).return_annotation):
                continue  # bounds and set-up on the host, tested beside their kernels
            yield f"{info.name}.{name}"


def on_the_host(kind):
    """Numbers and NumPy's arrays, and tuples and lists of them."""
    parts = get_args(kind)
    return kind in (float, int, np.ndarray) or (bool(parts) and all(map(on_the_host, parts)))


def test_every_kernel_has_rows():
    missing = set(public_kernels()) - {r.kernel for r in ROWS}
    assert not missing, f"no hard cases for {sorted(missing)}"


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


@pytest.mark.parametrize("row", ROWS, ids=IDS)
def test_value_and_gradient(row, dtype):
    arguments, exact = rounded(row.arguments, dtype)
    eps = float(jnp.finfo(dtype).eps)
    expected = flat(row.twin(*exact))
    scale = float(np.abs(expected).max()) or 1.0
    (_, value), slopes = compiled(likeness(row.call), len(arguments))(*arguments)
    # A call that is compiled already would be so again.
    alone = () if hasattr(row.call, "lower") else (row.call(*arguments),)
    for found in (*alone, value):
        error = float(np.abs(flat(found) - expected).max())
        assert error <= row.ulps * eps * scale, f"{error / eps / scale:.3g} ulps"
    assert all(np.isfinite(s).all() for s in slopes)
    if not row.smooth:
        return
    for index, slope in enumerate(slopes):
        numeric = differences(row.twin, exact, index)
        # A slope is judged beside the value it belongs to, over the argument's size.
        size = max(float(np.abs(numeric).max()), scale)
        error = float(np.abs(np.asarray(slope).astype(LD) - numeric).max())
        assert error <= (row.gradient_ulps * eps + 1e-8) * size, f"argument {index}"


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
