"""Directions distributed as a von Mises-Fisher lobe, for every concentration from 0 on."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from diffopt.kernels import frames, uniforms
from diffopt.kernels.phase import cis_turns


def one_minus_cosine(v: Float[Array, "*#batch"], kappa: Float[Array, "*#batch"]) -> Array:
    """1 - cos of the angle to the axis, from a uniform number: the inverse distribution.

    ``-log(1 + v expm1(-2 kappa)) / kappa``. The glossy-transfer paper has a parenthesis
    astray (eqs. 10 and 12) and overflows at kappa = 89 in float32; and the sine of the angle
    has to come from 1 - cos, not from the cosine, which has lost it at kappa = 1e7.

    Parameters
    ----------
    v
        In [0, 1).
    kappa
        Concentration, >= 0.

    Returns
    -------
    Array
        In [0, 2].
    """
    # A quotient of two small numbers has lost its slopes by kappa^-1 and kappa^-2. With
    # y = 1 - exp(-2 kappa) times v and z = y / (2 - y), -log(1 - y) = 2 artanh z; all terms small.
    small = kappa < 0.125
    low = jnp.where(small, kappa, 0.0)
    single = v.dtype == jnp.float32
    fall = _fall(2.0 * low, 6 if single else 12)  # (1 - exp(-x)) / x
    y = 2.0 * low * (v * fall)
    z = y / (2.0 - y)
    series = jnp.zeros_like(z)
    for n in reversed(range(4 if single else 9)):  # z^2 is at most 0.016
        series = series * (z * z) + 1.0 / (2 * n + 1)
    near = 4.0 * (v * fall) / (2.0 - y) * series
    k = jnp.where(small, 1.0, kappa)
    return jnp.where(small, near, -jnp.log1p(v * jnp.expm1(-2.0 * k)) / k)


def _fall(x: Array, terms: int) -> Array:
    """(1 - exp(-x)) / x by its series, for x up to 1/4."""
    total = jnp.zeros_like(x)
    for n in reversed(range(terms)):
        total = 1.0 / math.factorial(n + 1) - x * total
    return total


def warp(
    u: Float[Array, "*#batch 2"], mu: Float[Array, "*#batch 3"], kappa: Float[Array, "*#batch"]
) -> Array:
    """Unit square to directions with the density `diffopt.kernels.vmf.pdf`.

    Parameters
    ----------
    u
        In [0, 1): azimuth in turns, share of the distribution from the axis on.
    mu
        Axis, unit vectors.
    kappa
        Concentration, >= 0.
    """
    return _warp(u[..., 0], u[..., 1], mu, kappa)


def sample(
    key: PRNGKeyArray, mu: Float[Array, "3"], kappa: Float[Array, ""], count: int
) -> Float[Array, "{count} 3"]:
    """Directions of one lobe from a key: `warp` of the numbers of `uniforms.pairs`.

    Parameters
    ----------
    key
        Of `jax.random.key`; the first n directions do not depend on how many are drawn.
    mu
        Axis, unit vector.
    kappa
        Concentration, >= 0.
    count
        How many.
    """
    turn, share = (number.astype(kappa.dtype) for number in uniforms.pairs(key, count))
    return _warp(turn, share, mu[None], kappa[None])


def _warp(turn: Array, share: Array, mu: Array, kappa: Array) -> Array:
    t = one_minus_cosine(share, kappa)
    # The root is kept off zero, where it has no slope.
    sin = jnp.sqrt(jnp.maximum(t * (2.0 - t), float(jnp.finfo(t.dtype).tiny)))
    cos_turn, sin_turn = cis_turns(turn)
    a, b, z = sin * cos_turn, sin * sin_turn, 1.0 - t
    first, second = frames.tangents(mu)
    return frames.direction(
        *(a * first[..., i] + b * second[..., i] + z * mu[..., i] for i in range(3))
    )
