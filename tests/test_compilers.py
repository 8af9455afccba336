"""Slopes do not depend on how XLA compiles: what it computes twice it may round in two ways.

Heights and tables are made inside the compiled function from other numbers, so that the compiler is
free to repeat that in every place where they are used.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import DiffractionBRDF, Heightfield
from diffopt.diffraction import evaluate
from diffopt.materials.scattered import Scattered
from diffopt.settings import ChebyshevSettings, DirectSettings, TaylorSettings

# As users compile, beside how this suite does; without optimisation by night.
FLAGS = ("",)
MORE = (
    "--xla_backend_optimization_level=0",
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false",
)
WI = np.array([[0.48, 0.6, 0.64], [0.0, 0.28, 0.96]], np.float32)
WO = np.array([[-0.48, 0.36, 0.8], [0.48, -0.64, 0.6]], np.float32)
LAM = np.array([0.45, 0.6], np.float32)


def diffraction(settings):
    y, x = jnp.mgrid[:24, :24].astype(jnp.float32)

    def total(x0):
        # A product and a sum, which some programs contract to one rounding.
        heights = x0[0] * jnp.sin(0.7 * x + x0[1]) + x0[2] * jnp.cos(0.4 * y) * jnp.cos(0.3 * x)
        brdf = DiffractionBRDF(Heightfield(heights, (0.15, 0.15)), 1.0)
        return evaluate(brdf, WI, WO, LAM, settings).sum()

    return total, jnp.asarray([0.1, 0.3, 0.07], jnp.float32)


def scattered():
    rng = np.random.default_rng(3)
    n = rng.normal(size=(2, 60, 3)).astype(np.float32)
    n[..., 2] = np.abs(n[..., 2]) + 0.2
    wi, wo = n / np.linalg.norm(n, axis=-1, keepdims=True)

    def total(x0):
        values = 1.0 + x0[0] * jnp.asarray(wi[:, 2]) + x0[1] * jnp.sin(7.0 * jnp.asarray(wo[:, 0]))
        return Scattered(wi, wo, values).f(WI, WO).sum()

    return total, jnp.asarray([1.3, 0.4], jnp.float32)


CASES = {
    "direct": lambda: diffraction(DirectSettings()),
    "taylor": lambda: diffraction(TaylorSettings(terms=40)),
    "chebyshev": lambda: diffraction(ChebyshevSettings(terms=24)),
    "scattered table": scattered,
}


def slopes(name):
    total, at = CASES[name]()
    return np.asarray(jax.jit(jax.grad(total))(at), float).tolist()


@pytest.fixture(scope="module")
def found(long):
    """Slopes of all cases by flags; each in a process of its own, as XLA reads them once."""
    out = {}
    for flags in FLAGS + (MORE if long else ()):
        told = {**os.environ, "XLA_FLAGS": flags, "JAX_ENABLE_X64": "0"}
        for name in ("JAX_DISABLE_MOST_OPTIMIZATIONS", "JAX_COMPILATION_CACHE_DIR"):
            told.pop(name, None)
        child = subprocess.run(
            [sys.executable, __file__], env=told, capture_output=True, text=True, check=False
        )
        assert child.returncode == 0, child.stderr
        out[flags] = json.loads(child.stdout)
    return out


@pytest.mark.parametrize("name", CASES)
def test_slopes_are_those_of_other_flags(found, name):
    with jax.enable_x64(False):
        right = np.array(slopes(name))
    assert np.isfinite(right).all()
    for flags, values in found.items():
        # Rounding of float32 through sums of 24 x 24 cosines, or the weights of 12 neighbours.
        np.testing.assert_allclose(values[name], right, rtol=2e-3, err_msg=flags)


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))
    print(json.dumps({name: slopes(name) for name in CASES}))
