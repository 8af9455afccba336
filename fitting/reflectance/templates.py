"""Kinds of surfaces by name, and which of their parameters make a lattice."""

from collections.abc import Callable, Sequence
from typing import Any

from diffopt import gratings
from diffopt.errors import InputError
from diffopt.gratings import Surface
from diffopt.gratings.parametric import kinds

#: Surfaces by the names that a user passes; the numbers are no starts, a search sets them.
NAMED: dict[str, Callable[[], Surface]] = {
    "sinusoidal": lambda: gratings.Sinusoidal(1.0, 0.1),
    "binary": lambda: gratings.Binary(1.0, 0.1, 0.4),
    "blazed": lambda: gratings.Blazed(1.0, 0.1),
    "trapezoid": lambda: gratings.Trapezoid(1.0, 0.1, 0.4, 0.3),
    "crossed": lambda: gratings.Crossed(
        gratings.Sinusoidal(1.0, 0.1), gratings.Sinusoidal(1.0, 0.1, 0.0, 1.5)
    ),
    "jittered": lambda: gratings.Jittered(gratings.Sinusoidal(1.0, 0.1), 0.02, 0.02),
    "ridges": lambda: gratings.Ridges(gratings.Sinusoidal(1.0, 0.1), 0.05, 1.0),
    "compactdisc": lambda: gratings.CompactDisc(),
    "roughness": lambda: gratings.Roughness(0.05, 1.0),
    "bumps": lambda: gratings.Bumps(0.1, 0.3, 0.5),
}
#: What ``"auto"`` compares, simple ones first. A jittered grating must be asked for by name: one
#: scan shows one domain of it.
AUTO = tuple(name for name in NAMED if name != "jittered")


def templates(model: Any) -> list[Surface]:
    """Surfaces that a user's `model` stands for: given starts, or one of a kind.

    Raises
    ------
    InputError
        If it is no name, class, surface, or list of surfaces of one kind.
    """
    if isinstance(model, str):
        if model not in NAMED:
            raise InputError(f"model must be one of {', '.join(NAMED)}; received {model!r}")
        return [NAMED[model]()]
    if isinstance(model, type) and issubclass(model, Surface):
        return templates(model.__name__.lower())
    given = [model] if isinstance(model, Surface) else model
    if (
        not isinstance(given, Sequence)
        or not given
        or not all(isinstance(one, Surface) for one in given)
        or len({str(_structure(one)) for one in given}) != 1
    ):
        received = type(model).__name__
        if isinstance(given, Sequence) and given:
            received = ", ".join(sorted({type(one).__name__ for one in given}))
        raise InputError(
            "model must be a name, a class, a surface, or surfaces of one kind; "
            f"received {received}"
        )
    return list(given)


def lattice(surface: Surface) -> list[tuple[str, str]]:
    """Names of period and angle of each grating within a surface."""
    found = []
    for name in kinds(surface):
        head, _, last = name.rpartition(".")
        if last in ("period", "pitch"):
            found.append((name, f"{head}.angle" if head else "angle"))
    return found


def nested(surface: Surface) -> str:
    """Name of the surface within that has the only period, for one that spreads its lines; or ''.

    The lattice and much of the rest can then be had from a fit of that alone.
    """
    heads = {period.rpartition(".")[0] for period, _ in lattice(surface)}
    return heads.pop().partition(".")[0] if len(heads) == 1 else ""


def _structure(surface: Surface) -> Any:
    import jax

    return jax.tree.structure(surface)
