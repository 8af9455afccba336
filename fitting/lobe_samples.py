"""Lobes of samples: expectation maximisation on weighted directions themselves."""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from diffopt import checks
from diffopt.errors import InputError
from diffopt.fitting.lobe_targets import COUNTS, no_negative
from diffopt.kernels import mixture
from diffopt.lobes import Lobes


def fit_samples(
    directions: Any,
    lobes: int | Literal["auto"] = 3,
    *,
    weights: Any = None,
    steps: int = 50,
    sharpest: float = 1e6,
    key: PRNGKeyArray | None = None,
) -> Lobes:
    """Lobes of samples, by expectation maximisation on the samples themselves.

    The likelihood is what is maximised: with few samples it is the honest choice. For a low
    square error from many, bin them and use `fit_table`.

    Parameters
    ----------
    directions
        Unit vectors, [N, 3].
    lobes
        How many; for one the closed form. ``"auto"``: the number of lowest Bayesian
        information criterion (Schwarz 1978), with the effective number of samples
        ``(sum w)^2 / sum w^2``.
    weights
        >= 0, [N]: throughputs of paths, say. 1 each if left out.
    steps
        Of EM.
    sharpest
        Largest concentration, which identical samples reach.
    key
        For the start.

    Returns
    -------
    Lobes
        Their integrals add up to the mean weight (1 for plain samples: a density).
    """
    checks.directions("directions", directions)
    directions = jnp.asarray(directions)
    if directions.ndim != 2 or directions.shape[0] == 0:
        raise InputError(f"directions must be [N, 3] with N >= 1; received {directions.shape}")
    count = directions.shape[0]
    weights = jnp.ones(count, directions.dtype) if weights is None else jnp.asarray(weights)
    weights = weights.astype(directions.dtype)
    if weights.shape != (count,):
        raise InputError(f"weights must be [{count}]; received {weights.shape}")
    no_negative("weights", weights)
    found = checks.concrete(weights)
    if found is not None and not found.any():
        raise InputError("all weights are zero")
    if lobes != "auto" and lobes < 1:
        raise InputError(f"lobes must be >= 1; received {lobes}")
    key = jax.random.key(0) if key is None else key
    tries = COUNTS if lobes == "auto" else (lobes,)
    best, lowest = None, np.inf
    for count in tries:
        found, likelihood = _fitted(directions, weights, key, count, steps, sharpest)
        effective = float(weights.sum() ** 2 / (weights**2).sum())
        criterion = (4 * count - 1) * np.log(effective) - 2.0 * effective * float(likelihood)
        if best is not None and criterion >= lowest:
            break
        best, lowest = Lobes(*found), criterion
    assert best is not None
    return best


@eqx.filter_jit
def _fitted(
    directions: Array, weights: Array, key: Any, lobes: int, steps: int, sharpest: float
) -> tuple[tuple[Array, Array, Array], Array]:
    """Lobes, and their mean log likelihood."""
    if lobes == 1:
        _, mu, kappa = mixture.moments(directions, weights, sharpest)
        found = mixture.Mixture(jnp.zeros_like(kappa)[None], mu[None], kappa[None])
    else:
        start = mixture.scattered_start(key, directions, weights, lobes, sharpest)
        found, _ = mixture.expectation_maximisation(directions, weights, start, steps, sharpest)
    likelihood = mixture.log_likelihood(directions, weights, found)
    return (jnp.exp(found.log_share) * weights.mean(), found.mu, found.kappa), likelihood
