"""Mixtures of von Mises-Fisher lobes by expectation maximisation, from weighted directions.

The directions are samples (weight 1, or the throughput of a path) or nodes of a quadrature
with weights ``value x solid angle``; weights of zero mask. One problem at a time: batches by
``jax.vmap`` over problems of one size. Products are laid out with the nodes innermost.

The likelihood of a mixture has no bound: a lobe that closes in on one direction grows for
ever. Concentrations are therefore kept in a range, whose upper end is the caller's
(for a grid, 2 pi over the solid angle of a cell).
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from diffopt.kernels import frames, vmf
from diffopt.kernels.langevin import inverse_langevin

# A lobe below this share of all weight has died: it stays where it was, with no share.
_DEAD = 1e-7
_NO_SHARE = -1e4
FLATTEST = 1e-3
Number = float | Float[Array, ""]


class Mixture(NamedTuple):
    """Lobes with shares of one whole.

    Attributes
    ----------
    log_share
        Log of each lobe's share, [..., K].
    mu
        Axes, [..., K, 3].
    kappa
        Concentrations, [..., K].
    """

    log_share: Float[Array, "*batch K"]
    mu: Float[Array, "*batch K 3"]
    kappa: Float[Array, "*batch K"]


def _shares(weights: Float[Array, " N"]) -> tuple[Float[Array, ""], Float[Array, " N"]]:
    """Sum of weights, and each over it; no shares without weight.

    The slope of a quotient has the square of what is below: brought to 1 first, by a number that
    cancels, that of a sum of 1e-30 neither overflows nor vanishes in float32.
    """
    total = weights.sum()
    scaled = weights * jax.lax.stop_gradient(1.0 / jnp.where(total > 0.0, total, 1.0))
    return total, scaled / jnp.where(total > 0.0, scaled.sum(), 1.0)


def mean_direction(
    directions: Float[Array, "N 3"], weights: Float[Array, " N"]
) -> tuple[Float[Array, ""], Float[Array, " 3"], Float[Array, ""], Float[Array, ""]]:
    """Weight, mean axis, length of the mean vector and one minus it, of weighted directions.

    The complement is accumulated as ``mean |s - m|^2 / (1 + |m|)`` about the mean m: from the
    length alone the concentration has a relative error of kappa eps. Without weight, or
    where the directions cancel, the axis is z.
    """
    s = directions.T
    total, share = _shares(weights)
    mean = (s * share[None]).sum(-1)
    square = (mean * mean).sum()
    some = square > float(jnp.finfo(square.dtype).eps) ** 2
    length = jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)
    up = jnp.asarray([0.0, 0.0, 1.0], mean.dtype)
    mu = jnp.where(some, mean / jnp.where(some, length, 1.0), up)
    d = s - mean[:, None]
    spread = ((d[0] ** 2 + d[1] ** 2 + d[2] ** 2) * share).sum()
    return total, mu, length, jnp.where(total > 0.0, spread / (1.0 + length), 1.0)


def moments(
    directions: Float[Array, "N 3"], weights: Float[Array, " N"], sharpest: Number
) -> tuple[Float[Array, ""], Float[Array, " 3"], Float[Array, ""]]:
    """The likeliest single lobe: ``(alpha, mu, kappa)`` in closed form.

    Mean and first moment of what is fitted are kept exactly; it minimises the
    Kullback-Leibler divergence, not the square error. With n samples the estimate of kappa is
    too large by n / (n - 2) on average.

    Parameters
    ----------
    directions, weights
        Unit vectors, [N, 3], and weights >= 0, [N].
    sharpest
        Largest concentration that is returned, as for one sample alone.
    """
    total, mu, length, rest = mean_direction(directions, weights)
    rest = jnp.maximum(rest, 1.0 / sharpest)  # before the inverse: it has no slope at 0
    kappa = inverse_langevin(jnp.minimum(length, 1.0 - rest), rest)
    return total, mu, jnp.minimum(kappa, sharpest)


def _distances(s: Float[Array, "3 N"], mu: Float[Array, "K 3"]) -> Float[Array, "K N"]:
    """1 - cosine between every axis and every direction, by differences."""
    d = [s[i][None] - mu[:, i, None] for i in range(3)]
    return 0.5 * (d[0] ** 2 + d[1] ** 2 + d[2] ** 2)


def _em_step(
    s1: Float[Array, "4 N"],
    weights: Float[Array, " N"],
    mixture: Mixture,
    sharpest: Number,
) -> tuple[Mixture, Float[Array, ""]]:
    """One step on rows 1, x, y, z; the next mixture and the mean log likelihood of this one."""
    log_share, mu, kappa = mixture
    s = s1[1:]
    t = _distances(s, mu)
    each = (log_share + vmf.log_peak(kappa))[:, None] - kappa[:, None] * t
    # It cancels. The slope of a maximum compares values that the compiler may round anew, and
    # is 0 / 0 where none of them is found again.
    highest = jax.lax.stop_gradient(each).max(0)
    density = jnp.exp(each - highest[None])
    together = density.sum(0)
    _, share_of = _shares(weights)
    likelihood = (share_of * (highest + jnp.log(together))).sum()
    owned = density * (share_of / together)[None]

    first = jax.lax.dot_general(
        owned, s1, (((1,), (1,)), ((), ())), precision=jax.lax.Precision.HIGHEST
    )
    share = first[:, 0]
    live = share > _DEAD
    safe = jnp.where(live, share, 1.0)
    # About the old axis, where the spread is 2 t: at convergence nothing cancels.
    mean = first[:, 1:] / safe[:, None]
    shift = mean - mu
    spread = 2.0 * (owned * t).sum(-1) / safe - (shift * shift).sum(-1)
    length2 = jnp.where(live, (mean * mean).sum(-1), 1.0)
    length = jnp.sqrt(jnp.maximum(length2, 1e-30))
    rest = jnp.clip(spread / (1.0 + length), 1.0 / sharpest, 1.0)
    fitted = inverse_langevin(jnp.minimum(length, 1.0 - rest), rest)
    kept = live & (length > 1e-12)
    return (
        Mixture(
            jnp.where(live, jnp.log(safe), _NO_SHARE),
            jnp.where(kept[:, None], mean / length[:, None], mu),
            jnp.where(live, jnp.clip(fitted, FLATTEST, sharpest), kappa),
        ),
        likelihood,
    )


def expectation_maximisation(
    directions: Float[Array, "N 3"],
    weights: Float[Array, " N"],
    start: Mixture,
    steps: int,
    sharpest: Number,
) -> tuple[Mixture, Float[Array, " steps"]]:
    """A fixed number of EM steps for a mixture, in the log domain.

    The number is fixed since, under `jax.vmap`, a loop with a condition runs to its slowest
    problem. The likelihood never falls (but for rounding, and where `sharpest` binds).

    Parameters
    ----------
    directions, weights
        Unit vectors, [N, 3], and weights >= 0, [N].
    start
        A mixture of K lobes. Lobes that coincide stay together.
    steps
        Number of steps, >= 0.
    sharpest
        Largest concentration. A lobe on identical samples ends there.

    Returns
    -------
    tuple
        The mixture, and before each step the mean log likelihood in nats, [steps].
    """
    s1 = jnp.concatenate([jnp.ones_like(directions[:, :1]), directions], -1).T

    def step(mixture: Mixture, _: None) -> tuple[Mixture, Array]:
        return _em_step(s1, weights, mixture, sharpest)

    return jax.lax.scan(step, start, None, length=steps)


def log_likelihood(
    directions: Float[Array, "N 3"], weights: Float[Array, " N"], mixture: Mixture
) -> Float[Array, ""]:
    """Weighted mean log density of a mixture, nats; 0 without weight."""
    t = _distances(directions.T, mixture.mu)
    each = (mixture.log_share + vmf.log_peak(mixture.kappa))[:, None] - mixture.kappa[:, None] * t
    _, share = _shares(weights)
    return (share * jax.scipy.special.logsumexp(each, axis=0)).sum()


def scattered_start(
    key: PRNGKeyArray,
    directions: Float[Array, "N 3"],
    weights: Float[Array, " N"],
    lobes: int,
    sharpest: Number,
) -> Mixture:
    """Equal lobes on directions drawn far from each other (Arthur and Vassilvitskii 2007).

    The first axis is drawn with the weights, every other with the weights times the distance
    1 - cosine to the nearest one drawn. All get K times the concentration of the whole.
    """
    _, mean, kappa = moments(directions, weights, sharpest)
    s = directions.T
    draws = jax.random.uniform(key, (lobes,), weights.dtype)
    nearest, axes = jnp.ones_like(weights), []
    for j in range(lobes):
        heaped = jnp.cumsum(weights * nearest)
        at = jnp.searchsorted(heaped, draws[j] * heaped[-1], side="right")
        # All weight may lie on the axes drawn so far: any direction will do.
        drawn = directions[jnp.minimum(at, weights.size - 1)]
        axis = jnp.where(heaped[-1] > 0.0, drawn, mean)
        axes.append(axis)
        distance = _distances(s, axis[None])[0]
        nearest = jnp.minimum(nearest, distance) if j else distance
    return _equal(jnp.stack(axes), kappa, sharpest)


def split_start(
    directions: Float[Array, "N 3"],
    weights: Float[Array, " N"],
    lobes: int,
    sharpest: Number,
) -> Mixture:
    """Equal lobes side by side along the widest direction of the whole: no key, no chance.

    Axes at the mean plus steps along the principal axis of what lies around it, spaced over
    two standard deviations either way.
    """
    _, mean, kappa = moments(directions, weights, sharpest)
    _, share = _shares(weights)
    first, second = frames.tangents(mean)
    across = jnp.stack([directions @ first, directions @ second])
    covariance = (across * share[None]) @ across.T
    # Half the angle of the principal axis, in closed form; the first if it is round.
    skew, wide = 2.0 * covariance[0, 1], covariance[0, 0] - covariance[1, 1]
    long = (skew != 0.0) | (wide != 0.0)
    twice = jnp.arctan2(jnp.where(long, skew, 0.0), jnp.where(long, wide, 1.0))
    axis = jnp.cos(0.5 * twice) * first + jnp.sin(0.5 * twice) * second
    square = (axis @ directions.T) ** 2 @ share
    # The root is kept off zero, where it has no slope.
    size = jnp.sqrt(jnp.maximum(square, float(jnp.finfo(square.dtype).tiny)))
    steps = jnp.linspace(-2.0, 2.0, lobes, dtype=weights.dtype) if lobes > 1 else jnp.zeros(1)
    vectors = mean[None] + (steps.astype(weights.dtype) * size)[:, None] * axis[None]
    mu = vectors / jnp.sqrt((vectors * vectors).sum(-1, keepdims=True))
    return _equal(mu, kappa, sharpest)


def _equal(mu: Float[Array, "K 3"], kappa: Float[Array, ""], sharpest: Number) -> Mixture:
    """Lobes of one share, each K times as concentrated as the whole."""
    lobes = mu.shape[0]
    spread = jnp.clip(lobes * kappa, FLATTEST, sharpest)
    share = jnp.full((lobes,), -math.log(lobes), mu.dtype)
    return Mixture(share, mu, jnp.broadcast_to(spread, (lobes,)))
