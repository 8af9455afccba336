"""What a fit of free heights returns."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.diffraction import DiffractionBRDF
from diffopt.fitting.freeform.equal import Average, nearest_equal
from diffopt.fitting.freeform.errors import posterior_deviation
from diffopt.fitting.freeform.priors import slopes
from diffopt.fitting.freeform.stages import Stages
from diffopt.heightfield import Heightfield


class HeightsFit(eqx.Module):
    """Result of `fit_heights`.

    Attributes
    ----------
    heightfield
        The fitted surface.
    loss
        Half of chi^2 plus the weighted prior.
    misfit
        ``relative``: norm of the residuals over that of the values, both over the noise;
        ``chi2``: mean squared residual over the noise, near 1 for noise that is known.
    gain
        Factor on the model, 1 if known.
    weight
        Strength of the prior that was used.
    steps
        Trial steps, one evaluation of the loss each, for those accepted also its gradient.
    converged, reason
        Whether the minimum was reached, and a sentence.
    history
        Loss at the start and after each block of steps; it jumps where the weight changes.
    values
        Fitted values, [M, C], as those of the data.
    error_map
        Standard deviation of each height, micrometres, or None, see `fit_heights`.
    """

    heightfield: Heightfield
    loss: float
    misfit: dict[str, float]
    gain: float
    weight: float
    steps: int
    converged: bool
    reason: str
    history: tuple[float, ...]
    values: Float[Array, "M C"]
    error_map: Float[Array, "ny nx"] | None

    def __str__(self) -> str:
        ny, nx = self.heightfield.shape
        return (
            f"{ny} x {nx} heights: relative misfit {self.misfit['relative']:.3g}, chi^2 per value "
            f"{self.misfit['chi2']:.3g}. {self.reason}"
        )

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.heights_card)


def result(
    run: Stages,
    start: Heightfield,
    brdf: DiffractionBRDF,
    root: np.ndarray,
    average: Average,
    error_rank: int,
) -> HeightsFit:
    """What a run came to, as the surface of equal |P|^2 nearest to the start."""
    surface = brdf.surface
    heights = run.made.base + run.change.astype(run.made.base.dtype)
    middle = [float(c) / d for c, d in zip(surface.center, surface.pixel, strict=True)]
    aligned, move = nearest_equal(heights, start.heights, average, tuple(middle))
    spread = None
    if error_rank:
        spread = move(
            posterior_deviation(
                run.made,
                heights,
                jnp.asarray(root, heights.dtype),
                jnp.asarray(run.weight, heights.dtype),
                slopes(heights)[: 2 if average == "positions" else 0],
                jax.random.key(0),
                rank=error_rank,
            )
        )
    size = float(jnp.linalg.norm(run.made.values * run.made.inverse))
    count = run.made.values.size
    note = f"heights fitted to reflectance, relative misfit {math.sqrt(run.chi2) / size:.3g}"
    return HeightsFit(
        heightfield=Heightfield(aligned, start.pixel, provenance=start.provenance.then(note)),
        loss=run.loss,
        misfit={"relative": math.sqrt(run.chi2) / size, "chi2": run.chi2 / count},
        gain=run.gain,
        weight=run.weight,
        steps=run.steps,
        converged=run.converged,
        reason=run.reason,
        history=tuple(run.history),
        values=run.made.fitted(heights),
        error_map=spread,
    )
