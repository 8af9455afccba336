"""Compiled functions with the options of the compiler that suit long chains of arithmetic.

Where a chain is used several times, the newer emitters of XLA for CPUs compute it anew for each
use: a bounce of rough metal then takes twice as long and more.
"""

import functools
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

_OLDER = {"xla_cpu_use_fusion_emitters": False}


class Program:
    """A function compiled as `equinox.filter_jit` does, but not to be called from another one.

    Parameters
    ----------
    function
        Of arrays and what else it is to be compiled for.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self._function = function

    # Asked for when first used, as that starts JAX.
    @functools.cached_property
    def _compiled(self) -> Any:
        compiler: Any = eqx.filter_jit
        return compiler(self._function, compiler_options=_options())

    def __call__(self, *args: Any) -> Any:
        """Value of the function."""
        return self._compiled(*args)

    @property
    def count(self) -> int:
        """How many variants were compiled."""
        return self._compiled._cached._cache_size()


@functools.cache
def _options() -> dict[str, Any]:
    """What this version of the compiler knows of what is wanted."""
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(lambda x: x + 1.0, compiler_options=_OLDER)(1.0)
    except Exception as error:
        if "xla_cpu_use_fusion_emitters" not in str(error):
            raise
        return {}
    return _OLDER
