"""Named parameters with their kinds, of anything made of such things."""

import dataclasses
import math
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError

#: Kinds of parameters, their units, and what values they may take.
KINDS: dict[str, tuple[str, str]] = {
    "length": ("um", "above 0"),
    "height": ("um", "of either sign"),
    "density": ("1/um^2", "above 0"),
    "share": ("", "between 0 and 1"),
    "spread": ("", "0 or more"),
    "angle": ("rad", "any"),
    "turns": ("periods", "any"),
    "phase": ("rad", "any"),
}
#: Parameters that |P|^2 averaged over positions does not depend on.
UNSEEN = ("shift", "phase", "offset")

_P = TypeVar("_P", bound="Parametric")


class Parametric(eqx.Module):
    """Anything described by named parameters, of its own and of what it is made of."""

    #: Parameters by name, with their kinds (`KINDS`).
    PARAMETERS: ClassVar[dict[str, str]] = {}

    @property
    def title(self) -> str:
        """Name in lower case."""
        return type(self).__name__.lower()

    @property
    def dtype(self) -> Any:
        """Floating-point type of the parameters."""
        return self.get(next(iter(kinds(self)))).dtype

    def get(self, path: str) -> Float[Array, ""]:
        """A parameter by its name, as ``period`` or ``grating.period``."""
        return _walk(self, path)

    def replaced(self: _P, values: dict[str, Any]) -> _P:
        """With other values of some parameters."""
        paths = list(values)
        dtype = self.dtype
        return eqx.tree_at(
            lambda s: [_walk(s, path) for path in paths],
            self,
            [jnp.asarray(values[path], dtype) for path in paths],
        )

    def __str__(self) -> str:
        names = (f"{path} {float(self.get(path)):.6g}" for path in kinds(self))
        return f"{type(self).__name__}({', '.join(names)})"


def _walk(surface: Any, path: str) -> Any:
    for name in path.split("."):
        surface = getattr(surface, name)
    return surface


def parts(surface: Parametric) -> list[tuple[str, Parametric]]:
    """What a surface is made of, by the names of its fields."""
    fields = [(field.name, getattr(surface, field.name)) for field in dataclasses.fields(surface)]
    return [(name, part) for name, part in fields if isinstance(part, Parametric)]


def kinds(surface: Parametric) -> dict[str, str]:
    """All parameters of a surface and of those within it: path and kind."""
    found = dict(surface.PARAMETERS)
    for name, part in parts(surface):
        found |= {f"{name}.{path}": kind for path, kind in kinds(part).items()}
    return found


def seen_in_power(surface: Parametric) -> tuple[str, ...]:
    """Parameters that reflectance averaged over positions depends on."""
    return tuple(path for path in kinds(surface) if path.split(".")[-1] not in UNSEEN)


def parameters(values: dict[str, Any], owner: type[Parametric]) -> list[Float[Array, ""]]:
    """Scalars as arrays of one floating-point type: that of the arrays among them.

    Raises
    ------
    InputError
        If one is known and no finite number, or not of its kind.
    """
    arrays = [v for v in values.values() if hasattr(v, "dtype")]
    dtype = jnp.result_type(*arrays) if arrays else jnp.result_type(float)
    out = []
    for name, value in values.items():
        _check(f"{owner.__name__}: {name}", value, owner.PARAMETERS[name])
        out.append(jnp.asarray(value, dtype))
    return out


def _check(name: str, value: Any, kind: str) -> None:
    from diffopt import checks

    number = checks.concrete(value)
    if number is None or np.ndim(number) != 0:
        return
    number = float(number)
    unit, expected = KINDS[kind]
    good = math.isfinite(number)
    if kind in ("length", "density"):
        good = good and number > 0
    elif kind == "share":
        good = 0 <= number <= 1
    elif kind == "spread":
        good = good and number >= 0
    if not good:
        raise InputError(
            f"{name} must be a finite number, {expected}{' in ' + unit if unit else ''}; "
            f"received {number:g}"
        )
