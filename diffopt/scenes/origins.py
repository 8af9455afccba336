"""Where meshes, pictures and measured materials came from, so that a scene can be written.

What is kept beside an object belongs to that very object: a copy with other numbers, as a
step of a fit makes, has no origin, and is not written as if it were the file.
"""

import weakref
from typing import Any

_known: dict[int, tuple[Any, dict[str, Any]]] = {}


def remember(thing: Any, **origin: Any) -> Any:
    """Keep what a thing was made from, as a table of a scene file has it; returns the thing."""
    key = id(thing)
    gone = weakref.ref(thing, lambda _: _known.pop(key, None))
    _known[key] = (gone, origin)
    return thing


def origin(thing: Any) -> dict[str, Any] | None:
    """What a thing was made from; None where that is not known."""
    found = _known.get(id(thing))
    return dict(found[1]) if found is not None and found[0]() is thing else None
