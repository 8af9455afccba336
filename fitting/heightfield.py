"""From data back to the surface, by one call: `fit_heightfield`."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any, overload

from diffopt.errors import InputError
from diffopt.fitting.freeform.fit import HeightsFit, fit_heights
from diffopt.fitting.measured import Measured
from diffopt.fitting.reflectance.answers import ReflectanceFit
from diffopt.fitting.reflectance.fit import fit_reflectance
from diffopt.fitting.reflectance.ranking import AUTO, rank_reflectance
from diffopt.fitting.scans.fit import ScanFit, fit_scan
from diffopt.gratings import Surface
from diffopt.heightfield import Heightfield


@overload
def fit_heightfield(data: Heightfield, model: Any = "auto", **options: Any) -> ScanFit: ...
@overload
def fit_heightfield(  # pyright: ignore[reportOverlappingOverload]
    data: Measured, model: Heightfield, **options: Any
) -> HeightsFit: ...
@overload
def fit_heightfield(data: Measured, model: Any = "auto", **options: Any) -> ReflectanceFit: ...


def fit_heightfield(
    data: Heightfield | Measured, model: Any = "auto", **options: Any
) -> ScanFit | ReflectanceFit | HeightsFit:
    """Fit a surface to its scan or to its reflectance.

    Parameters
    ----------
    data
        Heights (`diffopt.Heightfield`) or reflectance (`Measured`).
    model
        What the surface is taken for:

        - ``"auto"``: the best of several kinds, ranked by an information criterion;
        - the name or class of a kind (`diffopt.gratings`): starts come from the data;
        - a surface, or several of one kind: these are the starts;
        - names of several kinds, as ``["binary", "trapezoid"]``: the best of them;
        - for reflectance a `diffopt.Heightfield`: every height is fitted, from this start.
    options
        Of the function that does it: `fit_scan` for heights, `fit_reflectance` for reflectance,
        `fit_heights` for every height.

    Returns
    -------
    ScanFit, ReflectanceFit or HeightsFit
        With ``converged`` and a sentence as ``reason``.

    Raises
    ------
    InputError
        If data and model do not go together, an option is not one of the function's, or as that
        function.
    """
    if isinstance(data, Heightfield):
        if isinstance(model, Heightfield):
            raise InputError(
                "model: expected a kind of surface for a scan; received a Heightfield, "
                "which is a start for reflectance only"
            )
        return _call(fit_scan, data, model, options)
    if not isinstance(data, Measured):
        raise InputError(
            f"data: expected a Heightfield or a Measured; received {type(data).__name__}"
        )
    if isinstance(model, Heightfield):
        return _call(fit_heights, data, model, options)
    if isinstance(model, str) and model == "auto":
        return _call(rank_reflectance, data, AUTO, options, fit_reflectance)
    if _several_kinds(model):
        return _call(rank_reflectance, data, model, options, fit_reflectance)
    return _call(fit_reflectance, data, model, options)


def _several_kinds(model: Any) -> bool:
    if isinstance(model, (str, type, Surface)) or not isinstance(model, Sequence):
        return False
    return len(model) > 0 and not all(isinstance(one, Surface) for one in model)


def _call(
    function: Callable, data: Any, model: Any, options: dict[str, Any], of: Callable | None = None
) -> Any:
    owner = of or function
    known = inspect.signature(owner).parameters.values()
    names = [one.name for one in known if one.kind is one.KEYWORD_ONLY]
    for name in options:
        if name not in names:
            raise InputError(
                f"{name}: no option of {owner.__name__}; expected some of {', '.join(names)}"
            )
    return function(data, model, **options)
