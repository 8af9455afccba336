"""Settings of the whole suite.

The suite runs with 64-bit types on (each test picks its dtype); with
``DIFFOPT_TEST_X64=0`` it runs as most users do, without them, and everything that
asks for float64 is left out.

Compilation takes most of its time. Programs are kept in `.pytest_cache`, where the other
workers, the second pass, the commands that tests run and the next run find them. Most of
them run once, on little: the compiler is told to spend less on each, and least but in the
modules of `OPTIMISED`. The pass without 64-bit types is compiled as users' programs are, and
with ``XLA_FLAGS=`` set, if to nothing, so is the whole suite.
"""

import ctypes
import gc
import itertools
import os
from pathlib import Path

COMPILED = Path(__file__).parents[1] / ".pytest_cache" / "compiled"
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(COMPILED))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

X64 = os.environ.get("DIFFOPT_TEST_X64", "1") != "0"
# Most programs take longer to compile than to run. XLA stops at a flag that it does not know.
QUICK = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_cpu_parallel_codegen_split_count=1",
    "--xla_backend_optimization_level=1",
    "--xla_llvm_disable_expensive_passes=true",
)
HURRIED = X64 and "XLA_FLAGS" not in os.environ
if HURRIED:
    os.environ["XLA_FLAGS"] = " ".join(QUICK)
    # For the commands that tests run as well.
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
# Modules whose programs run for longer than they compile, or are judged by their last digits.
OPTIMISED = {
    "test_hard_cases",
    "test_heightfield",
    "test_reflectance",
    "test_rendering_mitsuba",
    "test_transfer_inputs",
    "test_transfer_precompute",
}

import jax  # noqa: E402
import lengths  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", X64)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

DTYPES = ("float32", "float64") if X64 else ("float32",)


def pytest_addoption(parser):
    parser.addoption(
        "--scan",
        action="append",
        default=[],
        metavar="FILE",
        help="a measured scan on which the methods must agree too (sigma_s: --scan-coherence)",
    )
    parser.addoption(
        "--long",
        action="store_true",
        help="many more random cases, and the tests marked long: for a night",
    )
    parser.addoption("--scan-coherence", type=float, default=1.25, metavar="UM")


def pytest_generate_tests(metafunc):
    if "surface_name" in metafunc.fixturenames:
        samples = ["compact_disc", "snake_skin", "gaussian_roughness"]
        samples = lengths.but({"compact_disc", "gaussian_roughness"}, samples)
        metafunc.parametrize("surface_name", samples + metafunc.config.getoption("scan"))
    if "dtype" in metafunc.fixturenames:
        metafunc.parametrize("dtype", DTYPES)


def pytest_collection_modifyitems(config, items):
    """What is marked long runs with --long alone; without 64-bit types only what is marked
    float32, or asks for a dtype, can run.
    """
    kept = items
    if not config.getoption("long"):
        kept = [i for i in kept if not i.get_closest_marker("long")]
    if not X64:
        kept = [i for i in kept if "dtype" in i.fixturenames or i.get_closest_marker("float32")]
    config.hook.pytest_deselected(items=[i for i in items if i not in kept])
    items[:] = kept


# Programs of a module serve few tests of another, and a worker that kept all of them would hold
# 10 GiB, most of it what the compiler freed. Linux allows a process 65,530 mappings, of which a
# program takes a few: beyond them the compiler crashes.
MOST_BYTES = 3 * 2**30
MOST_MAPPINGS = 40_000


@pytest.fixture(autouse=True, scope="module")
def _hurried(request):
    """How much the compiler is asked to do for a module."""
    if HURRIED:
        hurried = request.module.__name__.rpartition(".")[-1] not in OPTIMISED
        if hurried != jax.config.read("jax_disable_most_optimizations"):
            # The same program, compiled otherwise, may differ in its last bits.
            jax.clear_caches()
            jax.config.update("jax_disable_most_optimizations", hurried)


tests_run = itertools.count()


@pytest.fixture(autouse=True)
def _programs_are_few():
    yield
    if next(tests_run) % 8:  # counting mappings takes some 10 ms
        return
    try:
        with open("/proc/self/statm", "rb") as file:
            resident = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        with open("/proc/self/maps", "rb") as file:
            mappings = sum(1 for _ in file)
    except OSError:  # not Linux
        return
    if mappings > MOST_MAPPINGS or resident > MOST_BYTES:
        jax.clear_caches()
        gc.collect()
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:  # glibc keeps what was freed otherwise
            trim(0)


@pytest.fixture(scope="session")
def long(request):
    """Whether there is a night's time."""
    return request.config.getoption("long")


@pytest.fixture
def rng():
    import numpy as np

    return np.random.default_rng(20140113)
