"""The lobes that stand for unoccluded slices: the best in the square of the error.

Moments give a lobe with the mean and the first moment of a slice, which may be 30 to 60 % off at
grazing views, where slices are not round. What a vertex hides is told by moments over moments;
what remains is shown by lobes fitted to the material itself, from the same start and with the
same energy, so that lobe j is still lobe j. (Levenberg-Marquardt, `diffopt.kernels.lobe_squares`.)
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import lobe_squares, quadrature
from diffopt.transfer.reflectors import SHARPEST, Reflector
from diffopt.transfer.weighting import Weights

# Rings and azimuths about the mean direction of a slice; steps of the fit.
_RINGS, _TURNS, _STEPS = 40, 48, 20
# Views fitted by one program.
_VIEWS = 64


def best(
    made: Reflector, views: Float[np.ndarray, "V 3"], weights: Weights
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lobes of the glossy rest of a reflector for views.

    Parameters
    ----------
    made
        The reflector.
    views
        Unit vectors.
    weights
        Of these views: where the fits begin, and the integrals that they keep.

    Returns
    -------
    tuple
        alpha [V, K, C], mu [V, K, 3], kappa [V, K].
    """
    count, lobes = weights.kappa.shape
    alpha = np.asarray(weights.whole).reshape(count, lobes)
    start = [alpha, *(np.asarray(a) for a in (weights.mu, weights.kappa))]
    parts = []
    for first in range(0, count, _VIEWS):
        part = slice(first, min(first + _VIEWS, count))
        short = _VIEWS - (part.stop - first)
        rows = [
            np.concatenate([a[part], np.repeat(a[part][-1:], short, axis=0)])
            for a in (np.asarray(views, np.float32), *start)
        ]
        found = _fitted(made, *(jnp.asarray(a) for a in rows))
        parts.append([np.asarray(a)[: part.stop - first] for a in found])
    alpha, mu, kappa = (np.concatenate(a) for a in zip(*parts, strict=True))
    return alpha[..., None] * np.asarray(weights.tint)[:, None], mu, kappa


@eqx.filter_jit
def _fitted(
    made: Reflector,
    views: Float[Array, "V 3"],
    alpha: Float[Array, "V K"],
    mu: Float[Array, "V K 3"],
    kappa: Float[Array, "V K"],
) -> tuple[Array, Array, Array]:
    def one(row: tuple[Array, ...]) -> tuple[Array, Array, Array]:
        view, whole, axes, sharp = row
        mean = (whole[:, None] * axes).sum(0)
        mean = mean / jnp.sqrt(jnp.maximum((mean * mean).sum(), 1e-30))
        core = 0.5 / jnp.sqrt(jnp.maximum(sharp.max(), 1.0))
        nodes, solid = quadrature.polar_grid(mean, _RINGS, _TURNS, core)
        value = made.value(nodes, jnp.broadcast_to(view, nodes.shape)).mean(-1)
        value = value * jnp.maximum(nodes[:, 2], 0.0)
        given, norm = lobe_squares.problem(nodes, solid, value)
        least = jnp.clip(sharp, 1e-2, SHARPEST)
        at, base = lobe_squares.parameters(whole, axes, least, norm, signed=False)
        begun = lobe_squares.begin(at, base, given, signed=False)
        done = lobe_squares.levenberg_marquardt(
            begun, base, given, _STEPS, jnp.full_like(sharp, SHARPEST), signed=False
        )
        found, mu, kappa = lobe_squares.lobes(done.at, base, norm, signed=False)
        total = whole.sum()
        kept = lobe_squares.restored(found[:, None], total[None], mu, kappa, signed=False)[:, 0]
        fine = jnp.isfinite(kept).all() & jnp.isfinite(kappa).all() & (total > 1e-9)
        fine &= jnp.isfinite(mu).all()
        return (
            jnp.where(fine, kept, whole),
            jnp.where(fine, mu, axes),
            jnp.where(fine, kappa, sharp),
        )

    return jax.lax.map(one, (views, alpha, mu, kappa))
