"""Every kernel on its hard inputs: value and gradient, compiled and not, in both dtypes."""

import importlib
import inspect
import pkgutil
from typing import get_args

import jax.numpy as jnp
import numpy as np
import pytest
from hard_case_errors import BENT, NUMERIC, ROWS, bent, measured

import diffopt.kernels

IDS = [f"{r.kernel}-{r.label}".replace(" ", "") for r in ROWS]


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


@pytest.mark.parametrize("row", ROWS, ids=IDS)
def test_value_and_gradient(row, dtype, long):
    """A batch of two as well where there is time."""
    found = measured(row, dtype, mapped=long)
    assert found.value <= row.ulps, f"{found.value:.3g} ulps"
    assert found.finite
    eps = float(jnp.finfo(dtype).eps)
    for index, error in enumerate(found.slopes):
        assert error <= row.gradient_ulps * eps + NUMERIC, f"argument {index}"


@pytest.mark.parametrize("row", BENT, ids=[f"{r.kernels[0]}-{r.label}" for r in BENT])
def test_second_derivatives(row, dtype):
    worst = bent(row, dtype)
    assert max(worst.values()) <= row.ulps, worst
