"""The display hook of objects in notebooks: a card, or plain text where there is none."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer


class NoCardError(Exception):
    """An object that no card can be made of; the text says why, in a sentence's second half."""


def bundle(thing: Any, card: Callable[[Any], str]) -> dict[str, str]:
    """What ``_repr_mimebundle_`` returns; raises nothing.

    Parameters
    ----------
    thing
        The object.
    card
        Makes its HTML. Whatever it raises ends in the text.

    Returns
    -------
    dict
        ``text/plain``, the object's `repr`, and ``text/html`` unless there is no card: then the
        last line of the text says why.
    """
    try:
        text = repr(thing)
    except Exception:
        text = object.__repr__(thing)
    try:
        if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(thing)):
            raise NoCardError("its arrays are traced")
        # A user's own style or settings of NumPy shall not spoil the card, nor be changed by it.
        from matplotlib import style

        with style.context("default"), np.errstate(all="ignore"):
            html = card(thing)
    except NoCardError as reason:
        return {"text/plain": f"{text}\n(no preview: {reason})"}
    except Exception as error:
        said = str(error).strip().split("\n")[0][:200]
        return {"text/plain": f"{text}\n(no preview: {type(error).__name__}: {said})"}
    return {"text/plain": text, "text/html": html}
