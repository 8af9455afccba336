"""Lobes as one array for each number of each: what processors take in vectors.

Interpolation of `diffopt.transfer.slices` again, five times as fast: sums over axes of three
corners, three kinds or three components leave XLA on a CPU nothing to take in vectors.
"""

import functools
import operator
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.transfer import slices


class Fields(NamedTuple):
    """Lobes as one array [n] for each number of each lobe: what processors take in vectors."""

    alpha: list[list[Array]]
    mu: list[tuple[Array, Array, Array]]
    log_kappa: list[Array]


def unpacked(rows: Float[Array, "n F"], lobes: int) -> Fields:
    """Fields of rows of a table of `lobes` lobes."""
    columns = rows.T.reshape(lobes, -1, rows.shape[0])
    return Fields(
        [list(lobe[4:]) for lobe in columns],
        [(lobe[0], lobe[1], lobe[2]) for lobe in columns],
        [lobe[3] for lobe in columns],
    )


def between(shares: list[Array], parts: list[Fields], offsets: int = 0) -> Fields:
    """As `diffopt.transfer.slices.between`; the first lobes may have offsets in place of axes."""
    alphas, axes, logs = [], [], []
    for k in range(len(parts[0].mu)):
        alpha = [
            mixed(shares, [p.alpha[k][c] for p in parts]) for c in range(len(parts[0].alpha[k]))
        ]
        light = [functools.reduce(operator.add, p.alpha[k]) for p in parts]
        weights = slices.shares_by_light(light, shares)
        mu = [mixed(weights, [p.mu[k][i] for p in parts]) for i in range(3)]
        axes.append(normalised(mu, parts[0].mu[k]) if k >= offsets else tuple(mu))
        logs.append(mixed(weights, [p.log_kappa[k] for p in parts]))
        alphas.append(alpha)
    return Fields(alphas, axes, logs)


def normalised(mu: list[Array], otherwise: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    """Components over the length; those of another vector where there is none."""
    square = mu[0] * mu[0] + mu[1] * mu[1] + mu[2] * mu[2]
    far = square > 1e-12
    scale = 1.0 / jnp.sqrt(jnp.where(far, square, 1.0))
    x, y, z = (jnp.where(far, a * scale, b) for a, b in zip(mu, otherwise, strict=True))
    return x, y, z


def mixed(shares: list[Array], values: list[Array]) -> Array:
    """Sum of products."""
    return functools.reduce(operator.add, (s * v for s, v in zip(shares, values, strict=True)))
