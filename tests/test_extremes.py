"""Every kernel at the ends of what it takes: values and slopes are finite, never NaN."""

import jax
import jax.numpy as jnp
import lengths
import numpy as np
import pytest
from extremes import EXEMPT, SWEEPS, places
from hard_case_errors import scalar
from test_hard_cases import public_kernels

IDS = [f"{name}-{k}" for k, (name, _, _) in enumerate(SWEEPS)]


def test_every_kernel_is_swept_or_says_why_not():
    swept = {name for name, _, _ in SWEEPS}
    assert not swept & set(EXEMPT)
    missing = set(public_kernels()) - swept - set(EXEMPT)
    assert not missing, f"no extremes of {sorted(missing)}"
    assert not (swept | set(EXEMPT)) - set(public_kernels())


def floats(value):
    leaves = [v for v in jax.tree.leaves(value) if jnp.issubdtype(v.dtype, jnp.floating)]
    return tuple(leaves)


@pytest.mark.parametrize("name", lengths.but({"float32"}, ["float32", "float64"]))
@pytest.mark.parametrize("sweep", SWEEPS, ids=IDS)
def test_values_and_slopes_are_finite(sweep, name):
    if name == "float64" and not jax.config.jax_enable_x64:
        pytest.skip("64-bit types are off")
    kernel, call, ranges = sweep
    arguments = places(ranges, name)

    def weighed(*a):
        value = floats(call(*a))
        return scalar(value), value

    program = jax.value_and_grad(weighed, tuple(range(len(arguments))), has_aux=True)
    (_, value), slopes = jax.jit(jax.vmap(program))(*map(jnp.asarray, arguments))
    for what, found in (("value", value), ("slope", slopes)):
        for leaf in found:
            bad = ~np.isfinite(np.asarray(leaf).reshape(len(leaf), -1)).all(1)
            at = [a[bad][:3].tolist() for a in arguments]
            assert not bad.any(), f"{kernel}: no finite {what} at {bad.sum()} places, as {at}"
