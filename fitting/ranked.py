"""A row of a ranking of models for the same data."""

import dataclasses
from typing import Any


@dataclasses.dataclass(frozen=True)
class Ranked:
    """A model among others for the same data.

    Attributes
    ----------
    name
        Of the model.
    criterion
        Bayesian information criterion: smaller is better; infinite if it could not be fitted.
    difference
        To the best of the ranking.
    parameters
        That count: a free gain, parameters of the noise, and a disc's own pits included.
    misfit
        Of a scan: rms of the residual, micrometres, for random surfaces of the noise beside them.
        Of reflectance: norm of the residuals over that of the data, both over the noise.
    converged, reason
        Whether it can be used, and a sentence.
    """

    name: str
    criterion: float
    difference: float
    parameters: int
    misfit: float
    converged: bool
    reason: str

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.ranked_card)
