"""Transfer slices: moments of what rays bring, lobes from them, interpolation, distance.

Arrays of lobes have axes [..., kind, lobe], see `KINDS`; alpha has the channels last.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.kernels import frames, vmf, vmf_pairs
from diffopt.transfer.reflectors import SHARPEST
from diffopt.transfer.weighting import Weights, lobe

# Lobes below this share of the heaviest have little say in where lobes between them point.
_FAINT = 0.02


class Slices(NamedTuple):
    """Lobes of slices, on the device or on the host.

    Attributes
    ----------
    alpha
        Integrals, [..., 3, K, C].
    mu
        Axes, [..., 3, K, 3].
    kappa
        Concentrations, [..., 3, K].
    """

    alpha: Any
    mu: Any
    kappa: Any


def from_moments(
    weights: Weights, columns: Float[Array, "n N P"], sharpest: Float[Array, "3"]
) -> Slices:
    """Slices of the views of a table of weights, for vertices: [n, V, 3, K, ...].

    Parameters
    ----------
    weights
        Of V views and K lobes for N rays.
    columns
        What the rays of n vertices bring, see `diffopt.transfer.tracing.columns`.
    sharpest
        Largest concentration of each kind.
    """
    views, lobes = weights.kappa.shape
    channels = weights.tint.shape[1]
    moments = jnp.einsum("mn,bnp->bmp", weights.rays, columns)
    moments = moments.reshape(-1, views, lobes, columns.shape[-1])
    whole = weights.whole.reshape(views, lobes)
    seen = moments[..., 0]
    share = seen / jnp.where(whole > 0.0, whole, 1.0)[None]
    first = moments[..., 1:4] + share[..., None] * weights.off.reshape(views, lobes, 3)[None]
    tint = weights.tint[None, :, None]
    found = [_kind(seen[..., None] * tint, seen, first, weights, sharpest[0])]
    for kind in (1, 2):
        at = 4 + (kind - 1) * (channels + 3)
        colour = moments[..., at : at + channels]
        first = moments[..., at + channels : at + channels + 3]
        found.append(_kind(colour * tint, colour.mean(-1), first, weights, sharpest[kind]))
    return Slices(*(jnp.stack(a, 2) for a in zip(*found, strict=True)))


def _kind(
    alpha: Array, whole: Array, first: Array, weights: Weights, sharpest: Array
) -> tuple[Array, Array, Array]:
    some, mu, kappa = lobe(
        whole,
        first,
        jnp.broadcast_to(weights.mu[None], first.shape),
        jnp.full_like(whole, sharpest),
    )
    # Where nothing is seen the lobe is the unoccluded one, with no weight.
    dark = some <= 0.0
    kappa = jnp.where(dark, jnp.minimum(weights.kappa[None], sharpest), kappa)
    return jnp.where(dark[..., None], 0.0, alpha), mu, kappa


def unoccluded(weights: Weights) -> Slices:
    """Slices of a point that sees nothing but the light, [V, 3, K, ...]."""
    alpha, mu, kappa = weights.alpha, weights.mu, weights.kappa
    nothing = jnp.zeros_like(alpha)
    return Slices(
        jnp.stack([alpha, nothing, nothing], 1),
        jnp.stack([mu] * 3, 1),
        jnp.stack([jnp.minimum(kappa, SHARPEST)] * 3, 1),
    )


def between(shares: Float[Array, "*batch n"], slices: Slices) -> Slices:
    """Slices between n others (the glossy-transfer paper, eq. 6).

    Weights linearly, concentrations by their logarithms, axes by their mean: unweighted but for
    lobes with next to no light, which point nowhere.

    Parameters
    ----------
    shares
        Barycentric, >= 0, of sum 1.
    slices
        [*batch, n, 3, K, ...].
    """
    lit = slices.alpha.sum(-1)
    count = lit.shape[-3]
    parts = [lit[..., k, :, :] for k in range(count)]
    own = [jnp.broadcast_to(shares[..., k, None, None], parts[k].shape) for k in range(count)]
    weight = jnp.stack(shares_by_light(parts, own), -3)
    vector = (weight[..., None] * slices.mu).sum(-4)
    square = (vector * vector).sum(-1, keepdims=True)
    far = square > 1e-12
    mu = jnp.where(far, vector / jnp.sqrt(jnp.where(far, square, 1.0)), slices.mu[..., 0, :, :, :])
    log = jnp.log(jnp.maximum(slices.kappa, float(jnp.finfo(slices.kappa.dtype).tiny)))
    return Slices(
        (shares[..., None, None, None] * slices.alpha).sum(-4), mu, jnp.exp((weight * log).sum(-3))
    )


def shares_by_light(light: list[Array], shares: list[Array]) -> list[Array]:
    """Shares of lobes in the axis and concentration between them: less for those without light.

    Parameters
    ----------
    light
        Integrals of the lobes, >= 0.
    shares
        Barycentric, of the same shapes.
    """
    most = light[0]
    for one in light[1:]:
        most = jnp.maximum(most, one)
    some = most > 0.0
    weights = [
        share * jnp.where(some, one / jnp.where(some, one + _FAINT * most, 1.0), 1.0)
        for one, share in zip(light, shares, strict=True)
    ]
    total = weights[0]
    for one in weights[1:]:
        total = total + one
    left = total > 0.0
    inverse = 1.0 / jnp.where(left, total, 1.0)
    return [
        jnp.where(left, one * inverse, share) for one, share in zip(weights, shares, strict=True)
    ]


def squared_distance(one: Slices, other: Slices) -> Float[Array, "..."]:
    """Integral of the squared difference, lobe by lobe, summed over kinds, lobes and channels."""
    norm = [jnp.sqrt(vmf.squared_norm(s.kappa))[..., None] for s in (one, other)]
    angle = vmf_pairs.log_similarity(one.mu, one.kappa, other.mu, other.kappa)
    angle = jnp.expm1(angle)[..., None]
    a, b = one.alpha * norm[0], other.alpha * norm[1]
    return ((a - b) ** 2 - 2.0 * a * b * angle).sum((-3, -2, -1))


def squared_norm(slices: Slices) -> Float[Array, "..."]:
    """Squared norms of lobes, summed over kinds, lobes and channels."""
    return (slices.alpha**2 * vmf.squared_norm(slices.kappa)[..., None]).sum((-3, -2, -1))


def turned(slices: Slices, cos: Float[Array, "..."], sin: Float[Array, "..."]) -> Slices:
    """Slices turned about z, by angles that broadcast with [..., 3, K]."""
    x, y, z = slices.mu[..., 0], slices.mu[..., 1], slices.mu[..., 2]
    mu = frames.direction(cos * x - sin * y, sin * x + cos * y, z)
    return Slices(slices.alpha, mu, slices.kappa)


def picked(slices: Slices, rows: Any) -> Slices:
    """Rows of the first axis."""
    return jax.tree.map(lambda a: a[rows], slices)
