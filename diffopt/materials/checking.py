"""Checks of the parameters of materials."""

from collections.abc import Callable
from typing import Any, get_args

import numpy as np

from diffopt import checks
from diffopt.errors import InputError


def within(name: str, value: Any, low: float, high: float, *, above: bool = False) -> None:
    """Refuse values outside [low, high] (or (low, high] with `above`), where they are known.

    Raises
    ------
    InputError
        With the name, what was received and what was expected.
    """
    known = checks.concrete(value)
    if known is None:
        return
    fits = (known > low if above else known >= low) & (known <= high)
    if not bool(np.all(fits)):
        first = np.asarray(known)[~np.asarray(fits)].ravel()[0]
        least = f"above {low:g}" if above else f"from {low:g}"
        limit = "" if high == np.inf else f" to {high:g}"
        raise InputError(f"{name} must be {least}{limit}; received {first:g}")


def one_of(name: str, options: Any) -> Callable[[Any], Any]:
    """Converter of a field that takes one of the names of a `Literal`, or raises InputError."""
    return lambda value: checks.choice(name, value, get_args(options))
