"""Studies and promises by their names."""

from importlib import import_module
from typing import Any

from diffopt.errors import InputError


def named(kind: str, places: dict[str, str], name: str) -> Any:
    """What is defined under a name; its module is imported now.

    Parameters
    ----------
    kind
        Of what is asked for, as the error says it.
    places
        From names to ``module:attribute``.
    name
        One of them.

    Raises
    ------
    InputError
        If there is none of that name; the message lists those that there are.
    """
    if name not in places:
        raise InputError(f"no {kind} {name!r}; expected one of {', '.join(sorted(places))}")
    module, attribute = places[name].split(":")
    return getattr(import_module(module), attribute)
