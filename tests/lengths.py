"""Which of many parameters are run every time, and which in the long mode alone."""

import pytest


def but(quick, names):
    """Parameters, in their order; all but `quick` are marked long."""
    names = list(names)
    assert set(quick) <= set(names), f"{quick}: not of {names}"
    return [n if n in quick else pytest.param(n, marks=pytest.mark.long, id=str(n)) for n in names]
