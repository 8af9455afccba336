"""Precomputed transfer under light: lobes and radiance of vertices.

Slices between the views are interpolated at the vertices of what a camera sees, in their local
frames; see `diffopt.transfer.between` for what lies between the vertices. The light may be
anything with ``radiance(mu, kappa)``, see `diffopt.transfer.lighting`.

Differentiable in the light and in the lobes.
"""

import functools
import math
import operator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames
from diffopt.transfer import fields, references
from diffopt.transfer.fields import Fields, unpacked
from diffopt.transfer.references import Axis, Reference
from diffopt.transfer.result import Transfer
from diffopt.transfer.slices import Slices
from diffopt.transfer.views import Locator, locator


@runtime_checkable
class Lighting(Protocol):
    """Light from infinity averaged over lobes."""

    def radiance(self, mu: Any, kappa: Any) -> Any:
        """Radiance for lobes about mu [..., 3] of concentrations kappa [...], [..., C]."""
        ...


class Tables(eqx.Module):
    """Transfer on the device.

    Attributes
    ----------
    position, axes
        Of vertices: [V, 3]; local frames as rows, [V, 3, 3].
    level, first
        Level of the views, -1 for none, and row of the first view, [V].
    material
        Of each vertex, [V].
    over
        Unoccluded lobes of the materials.
    views
        Slices over the unoccluded ones, a row for each: of every kind and lobe the axis (3), the
        logarithm of the concentration, and the weights (C), [S, 3 K (4 + C)].
    diffuse
        View-independent slices in the world, in rows as `views`, [V, 3 K (4 + C)].
    find
        Triangles of views around directions.
    lobes, matte_lobes
        Of all kinds together, 3 K: of slices and of view-independent ones.
    glossy, matte
        Whether any vertex has views, and any a view-independent share.
    """

    position: Float[Array, "V 3"]
    axes: Float[Array, "V 3 3"]
    level: Int[Array, " V"]
    first: Int[Array, " V"]
    material: Int[Array, " V"]
    over: Reference
    views: Float[Array, "S F"]
    diffuse: Float[Array, "V D"]
    find: Locator
    lobes: int = eqx.field(static=True)
    matte_lobes: int = eqx.field(static=True)
    glossy: bool = eqx.field(static=True)
    matte: bool = eqx.field(static=True)


def tables(transfer: Transfer, dtype: Any = np.float32) -> Tables:
    """Transfer as arrays for relighting.

    Parameters
    ----------
    transfer
        Precomputed.
    dtype
        Of the slices: float32, or float16 for half the memory at 0.05 % error.
    """
    packed = _packed(transfer.views)
    if not len(packed):
        packed = np.zeros((1, packed.shape[1]))
    axes = transfer.axes.astype(np.float32)
    local = transfer.diffuse
    world = np.einsum("vkjm,vmi->vkji", local.mu, axes)
    return Tables(
        jnp.asarray(transfer.mesh.vertices, jnp.float32),
        jnp.asarray(axes),
        jnp.asarray(transfer.level, jnp.int32),
        jnp.asarray(transfer.first, jnp.int32),
        jnp.asarray(transfer.reflector, jnp.int32),
        references.reference(list(transfer.unoccluded), transfer.lobes, references.LEVEL),
        jnp.asarray(packed, dtype),
        jnp.asarray(_packed(local._replace(mu=world)), jnp.float32),
        locator(max(int(transfer.level.max()), 0)),
        3 * transfer.lobes,
        3 * transfer.lobes,
        bool((transfer.level >= 0).any()),
        bool(local.alpha.any()),
    )


def _packed(found: Slices) -> np.ndarray:
    log = np.log(np.maximum(found.kappa, 1e-6))[..., None]
    each = np.concatenate([found.mu, log, found.alpha], -1)
    return each.reshape(len(each), math.prod(each.shape[1:]))  # there may be no rows


def lit_lobes(found: Fields, light: Lighting) -> Float[Array, "n C"]:
    """Radiance of lobes under light."""
    # Look-ups one after the other: what stacks them takes longer than they do.
    total: list[Any] = []
    for mu, log, alpha in zip(found.mu, found.log_kappa, found.alpha, strict=True):
        value = light.radiance(frames.direction(*mu), jnp.exp(log))
        if len(alpha) == 1:
            total.append(alpha[0][:, None] * value)
        else:
            total.append(_beside(alpha) * value)
    return functools.reduce(operator.add, total)


def _beside(channels: list[Array]) -> Float[Array, "n C"]:
    """Arrays side by side; see `diffopt.kernels.frames.direction` for why not by stacking."""
    if len(channels) == 3:
        return frames.direction(*channels)
    return jnp.stack(channels, -1)


class _Held(NamedTuple):
    """Lobes of vertices over the unoccluded ones, those, and the local frames."""

    found: Fields
    over: Fields
    axes: tuple[Array, Array, Array]


def _held(held: Tables, vertices: Array, wo: Array) -> _Held:
    """Glossy lobes of vertices in the local frames, towards directions in the world [n, 3]."""
    columns = held.axes[vertices].reshape(-1, 9).T
    axes = columns[0:3], columns[3:6], columns[6:9]
    local = into(axes, wo)
    level = held.level[vertices]
    place = held.find(local, jnp.maximum(level, 0))
    first = held.first[vertices]
    some = level >= 0
    parts, shares = [], []
    for corner in range(3):
        row = jnp.where(some, first + place.corners[:, corner], 0)
        parts.append(unpacked(held.views[row].astype(wo.dtype), held.lobes))
        shares.append(place.shares[:, corner])
    found = fields.between(shares, parts)
    alpha = [[jnp.where(some, a, 0.0) for a in each] for each in found.alpha]
    over = unoccluded(held.over, held.material[vertices], local)
    return _Held(found._replace(alpha=alpha), over, axes)


def into(axes: tuple[Array, Array, Array], wo: Array) -> Float[Array, "n 3"]:
    """Directions [n, 3] in local frames."""
    x, y, z = wo[:, 0], wo[:, 1], wo[:, 2]
    return frames.direction(*(a[0] * x + a[1] * y + a[2] * z for a in axes))


def out_of(axes: tuple[Array, Array, Array], local: Axis) -> Axis:
    """Directions of local frames in the world."""
    x, y, z = local
    t, b, n = axes
    first, second, third = (x * t[i] + y * b[i] + z * n[i] for i in range(3))
    return first, second, third


def unoccluded(over: Reference, material: Array, local: Array) -> Fields:
    """Unoccluded lobes in local frames."""
    rows, shares = over.places(material, local)
    each = [unpacked(over.rows[rows[:, k]], over.lobes) for k in range(3)]
    weights = [shares[:, k] for k in range(3)]

    def mixed(values: list[Array]) -> Array:
        return fields.mixed(weights, values)

    count, channels = range(over.lobes), range(len(each[0].alpha[0]))
    return Fields(
        [[mixed([e.alpha[k][c] for e in each]) for c in channels] for k in count],
        [
            fields.normalised([mixed([e.mu[k][i] for e in each]) for i in range(3)], each[0].mu[k])
            for k in count
        ],
        [mixed([e.log_kappa[k] for e in each]) for k in count],
    )


def weighed(found: Fields, over: Fields) -> list[list[Array]]:
    """Integrals of lobes that are held over those of the unoccluded ones."""
    lobes = len(over.alpha)
    return [
        [a * b for a, b in zip(each, over.alpha[k % lobes], strict=True)]
        for k, each in enumerate(found.alpha)
    ]


def _vertex_fields(held: Tables, vertices: Array, wo: Array) -> Fields:
    """Glossy lobes of vertices in the world towards directions [n, 3]."""
    found, over, axes = _held(held, vertices, wo)
    mu, log = list(found.mu), list(found.log_kappa)
    for k, axis in enumerate(over.mu):
        mu[k] = references.out_of(axis, mu[k])
        log[k] = log[k] + over.log_kappa[k]
    return Fields(weighed(found, over), [out_of(axes, m) for m in mu], log)


def vertex_rows(held: Tables, vertices: Array, wo: Array) -> Float[Array, "n F"]:
    """What pixels interpolate: lobes over the unoccluded ones, and where and how vertices lie.

    Of direct light the axis is held as its offset from that of the unoccluded lobe, in the world.
    """
    found, over, axes = _held(held, vertices, wo)
    rows = []
    for k, (mu, log, alpha) in enumerate(zip(found.mu, found.log_kappa, found.alpha, strict=True)):
        if k < len(over.mu):
            there = references.out_of(over.mu[k], mu)
            x, y, z = (a - b for a, b in zip(there, over.mu[k], strict=True))
            mu = (x, y, z)
        rows.append(jnp.stack([*out_of(axes, mu), log, *alpha]))
    frame = jnp.concatenate([held.position[vertices].T, *(axes[k] for k in (0, 2))])
    return jnp.concatenate([*rows, frame]).T


def matte_radiance(held: Tables, light: Lighting, vertices: Array) -> Float[Array, "n C"]:
    """View-independent radiance of vertices."""
    return lit_lobes(unpacked(held.diffuse[vertices], held.matte_lobes), light)


@eqx.filter_jit
def vertex_lobes(held: Tables, vertices: Int[Array, " n"], wo: Float[Array, "n 3"]) -> Slices:
    """Glossy lobes of vertices in the world, towards directions in the world: [n, 3, K, ...].

    Parameters
    ----------
    held
        The transfer.
    vertices
        Numbers.
    wo
        Unit vectors to the viewer, in the world.
    """
    found = _vertex_fields(held, vertices, wo)
    kinds = (len(vertices), 3, held.lobes // 3)
    alpha = jnp.stack([jnp.stack(a, -1) for a in found.alpha], 1)
    mu = jnp.stack([jnp.stack(a, -1) for a in found.mu], 1)
    kappa = jnp.exp(jnp.stack(found.log_kappa, 1))
    return Slices(alpha.reshape(*kinds, -1), mu.reshape(*kinds, 3), kappa.reshape(kinds))


@eqx.filter_jit
def vertex_radiance(
    held: Tables, light: Lighting, vertices: Int[Array, " n"], wo: Float[Array, "n 3"]
) -> Float[Array, "n C"]:
    """Radiance of vertices towards directions in the world, as for `vertex_lobes`."""
    total: Any = 0.0
    if held.matte or not held.glossy:  # zeros of the light's channels where all is black
        total = matte_radiance(held, light, vertices)
    if held.glossy:
        total = total + lit_lobes(_vertex_fields(held, vertices, wo), light)
    return total
