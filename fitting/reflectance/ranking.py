"""Which parametric surface describes measured reflectance best."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

from diffopt.errors import InputError
from diffopt.fitting.measured import Measured
from diffopt.fitting.ranked import Ranked
from diffopt.fitting.reflectance.answers import ReflectanceFit
from diffopt.fitting.reflectance.fit import Progress, fit_reflectance, rows_misfit
from diffopt.fitting.reflectance.templates import AUTO

# A difference of the criterion that counts as strong evidence (Kass and Raftery 1995). A needless
# parameter costs log n, some 8.
_STRONG = 6.0
# A model whose misfit on some rows is larger than that of another by this factor is not finished:
# its likelihood is exp(-0.6) a value or less of the other's, of hundreds.
_BEHIND = 1.5


def rank_reflectance(
    measured: Measured,
    models: Sequence[Any] = AUTO,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> ReflectanceFit:
    """Fit several parametric surfaces to the same reflectance; return the best.

    They are ranked by the Bayesian information criterion, -2 log L + P log n for n values and P
    free parameters: chi^2 for -2 log L where the noise is known, else n log of the mean squared
    residual (Schwarz 1978). A model that is far behind another on some rows of the data is not
    finished on all of them, and its row says so.

    Parameters
    ----------
    measured
        The data.
    models
        Each as for `fit_reflectance`.
    progress
        As for `fit_reflectance`, with the name of the model before what is done. A
        KeyboardInterrupt ends the comparison: the best so far is returned, not converged.
    options
        For `fit_reflectance`; `free` and `bounds` suit models of one kind only.

    Returns
    -------
    ReflectanceFit
        Of the smallest criterion, with all in its `ranking`. It is no answer
        (``converged`` False) if its own fit is none.

    Raises
    ------
    InputError
        As `fit_reflectance`, if no model could be fitted.
    """
    found: list[tuple[str, ReflectanceFit]] = []
    refused: list[tuple[str, InputError]] = []
    interrupted = False
    for k, model in enumerate(models):
        name = _name(model)

        def report(what: str, share: float, loss: float, k: int = k, name: str = name) -> None:
            if progress is not None:
                best = min([loss, *(fit.loss for _, fit in found)])
                progress(f"{name}: {what}", (k + share) / len(models), best)

        try:
            bar = _BEHIND * min((rows_misfit(fit) for _, fit in found), default=math.inf)
            fit = fit_reflectance(measured, model, progress=report, give_up=bar, **options)
        except InputError as error:
            refused.append((name, error))
            continue
        except KeyboardInterrupt:
            if not found:
                raise
            interrupted = True
            break
        found.append((name, fit))
        if fit.interrupted:
            interrupted = True
            break
    if not found:
        raise refused[0][1]
    found.sort(key=lambda pair: pair[1].criterion)
    name, best = found[0]
    count = 1 if measured.gain == "free" else 0
    ranking = [
        Ranked(
            name,
            fit.criterion,
            fit.criterion - best.criterion,
            len(fit.names) + count,
            fit.loss,
            fit.converged,
            fit.reason,
        )
        for name, fit in found
    ]
    ranking += [
        Ranked(name, math.inf, math.inf, 0, math.inf, False, str(error)) for name, error in refused
    ]
    changes: dict[str, Any] = {"ranking": tuple(ranking)}
    if interrupted:
        changes |= {
            "converged": False,
            "interrupted": True,
            "reason": f"The comparison was interrupted at model {len(found)} of {len(models)}; "
            "this is the best until then.",
        }
    elif best.converged and len(ranking) > 1 and ranking[1].difference < _STRONG:
        changes["reason"] = (
            f"{best.reason} The data do not tell {name} from {ranking[1].name}: their criteria "
            f"differ by {ranking[1].difference:.1f}, and {_STRONG:g} would be strong evidence."
        )
    return dataclasses.replace(best, **changes)


def _name(model: Any) -> str:
    if isinstance(model, str):
        return model
    kind = model if isinstance(model, type) else type(model)
    return kind.__name__.lower()
