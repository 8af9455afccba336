"""Precomputed transfer under light: radiance of vertices and of pictures, in one jitted function.

Slices between the views are interpolated at the vertices of what a camera sees, in their local
frames. Between the vertices lobes are interpolated at every pixel, as they differ from those of
the unoccluded material, or radiance itself is (the glossy-transfer paper, section 6.2). The light
may be anything with ``radiance(mu, kappa)``, see `diffopt.transfer.lighting`.

Differentiable in the light and in the lobes.
"""

import functools
import math
import operator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames
from diffopt.kernels.frames import dot
from diffopt.rendering import programs
from diffopt.transfer import fields, references
from diffopt.transfer.fields import Fields, unpacked
from diffopt.transfer.precomputation import Transfer
from diffopt.transfer.raster import Seen
from diffopt.transfer.references import Axis, Reference
from diffopt.transfer.slices import Slices
from diffopt.transfer.views import Locator, locator

# Pixels whose lobes are held at a time.
_PIXELS = 2**13


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
    lobes
        Of all kinds together, 3 K.
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
    diffuse: Float[Array, "V F"]
    find: Locator
    lobes: int = eqx.field(static=True)
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
        bool((transfer.level >= 0).any()),
        bool(local.alpha.any()),
    )


def _packed(found: Slices) -> np.ndarray:
    log = np.log(np.maximum(found.kappa, 1e-6))[..., None]
    each = np.concatenate([found.mu, log, found.alpha], -1)
    return each.reshape(len(each), math.prod(each.shape[1:]))  # there may be no rows


def _lit(found: Fields, light: Lighting) -> Float[Array, "n C"]:
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
    local = _into(axes, wo)
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
    over = _unoccluded(held.over, held.material[vertices], local)
    return _Held(found._replace(alpha=alpha), over, axes)


def _into(axes: tuple[Array, Array, Array], wo: Array) -> Float[Array, "n 3"]:
    """Directions [n, 3] in local frames."""
    x, y, z = wo[:, 0], wo[:, 1], wo[:, 2]
    return frames.direction(*(a[0] * x + a[1] * y + a[2] * z for a in axes))


def _out_of(axes: tuple[Array, Array, Array], local: Axis) -> Axis:
    """Directions of local frames in the world."""
    x, y, z = local
    t, b, n = axes
    first, second, third = (x * t[i] + y * b[i] + z * n[i] for i in range(3))
    return first, second, third


def _unoccluded(over: Reference, material: Array, local: Array) -> Fields:
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


def _weighed(found: Fields, over: Fields) -> list[list[Array]]:
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
    return Fields(_weighed(found, over), [_out_of(axes, m) for m in mu], log)


def _vertex_rows(held: Tables, vertices: Array, wo: Array) -> Float[Array, "n F"]:
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
        rows.append(jnp.stack([*_out_of(axes, mu), log, *alpha]))
    frame = jnp.concatenate([held.position[vertices].T, *(axes[k] for k in (0, 2))])
    return jnp.concatenate([*rows, frame]).T


def _pixel_fields(
    held: Tables, rows: list[Array], shares: list[Array], material: Array, eye: Array
) -> Fields:
    """Glossy lobes of samples from the rows [n, F] of their corners.

    The unoccluded lobes are those of each sample's own normal and direction: a surface without
    occluders is shaded as if it were not made of triangles.
    """
    parts = [unpacked(row[:, :-9], held.lobes) for row in rows]
    last = rows[0].shape[1] - 9
    frame = [fields.mixed(shares, [row[:, last + i] for row in rows]) for i in range(9)]
    away = [eye[i] - frame[i] for i in range(3)]
    x, y, z = fields.normalised(away, (frame[0] * 0.0, frame[0] * 0.0, frame[0] * 0.0 + 1.0))
    first = (rows[0][:, -3], rows[0][:, -2], rows[0][:, -1])
    normal = fields.normalised([frame[6], frame[7], frame[8]], first)
    lean = sum(n * frame[3 + i] for i, n in enumerate(normal))
    flat = [frame[3 + i] - lean * n for i, n in enumerate(normal)]
    # Any tangent will do where there is none: there only round lobes look alike on both sides.
    other = frames.tangents(frames.direction(*normal))[0].T
    tangent = fields.normalised(flat, (other[0], other[1], other[2]))
    (a, b, c), (p, q, r) = normal, tangent
    across = (b * r - c * q, c * p - a * r, a * q - b * p)
    axes = (jnp.stack(tangent), jnp.stack(across), jnp.stack(normal))
    over = _unoccluded(held.over, material, _into(axes, frames.direction(x, y, z)))
    found = fields.between(shares, parts, held.over.lobes)
    mu, log = list(found.mu), list(found.log_kappa)
    for k, axis in enumerate(over.mu):
        there = _out_of(axes, axis)
        mu[k] = fields.normalised([u + v for u, v in zip(there, mu[k], strict=True)], there)
        log[k] = log[k] + over.log_kappa[k]
    return Fields(_weighed(found, over), mu, log)


def _matte(held: Tables, light: Lighting, vertices: Array) -> Float[Array, "n C"]:
    return _lit(unpacked(held.diffuse[vertices], held.lobes), light)


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
        total = _matte(held, light, vertices)
    if held.glossy:
        total = total + _lit(_vertex_fields(held, vertices, wo), light)
    return total


def _samples(
    held: Tables,
    light: Lighting,
    vertices: Array,
    corners: Array,
    shares: Array,
    eye: Array,
    per_pixel: bool,
) -> Array:
    """Radiance of samples, [P, C]."""
    away = eye[None] - held.position[vertices]
    wo = away / jnp.sqrt(jnp.maximum(dot(away, away), 1e-30))[:, None]
    if not per_pixel or not held.glossy:
        each = vertex_radiance(held, light, vertices, wo)
        parts = [shares[:, k : k + 1] * each[corners[:, k]] for k in range(3)]
        return parts[0] + parts[1] + parts[2]
    table = _vertex_rows(held, vertices, wo)
    material = held.material[vertices]
    matte = _matte(held, light, vertices) if held.matte else None

    def some(args: tuple[Array, Array]) -> Array:
        where, share = args
        weights = [share[:, k] for k in range(3)]
        rows = [table[where[:, k]] for k in range(3)]
        value = _lit(_pixel_fields(held, rows, weights, material[where[:, 0]], eye), light)
        if matte is not None:
            for k in range(3):
                value = value + share[:, k : k + 1] * matte[where[:, k]]
        return value

    count = corners.shape[0]
    size = min(_PIXELS, count)
    blocks = -(-count // size)
    short = blocks * size - count
    padded = [jnp.concatenate([a, jnp.repeat(a[:1], short, axis=0)]) for a in (corners, shares)]
    out = jax.lax.map(some, tuple(a.reshape(blocks, size, 3) for a in padded))
    return out.reshape(blocks * size, -1)[:count]


def picture(
    held: Tables,
    light: Lighting,
    seen: Seen,
    *,
    background: Any = None,
    per_pixel: bool = True,
) -> Float[Array, "h w C"]:
    """A picture of what a camera sees.

    Parameters
    ----------
    held
        The transfer.
    light
        On it.
    seen
        By the camera, see `Raster`.
    background
        Radiance of samples that see no surface, [P, C] or one number; 0 by default.
    per_pixel
        Lobes are interpolated and lit at every sample; False: radiance of vertices is
        interpolated.
    """
    arrays = (jnp.asarray(a) for a in (seen.vertices, seen.corners, seen.shares, seen.eye))
    value = _picture(held, light, *arrays, per_pixel)
    rows, columns = seen.shape
    behind = jnp.zeros((), value.dtype) if background is None else jnp.asarray(background)
    whole = _composed(value, behind, jnp.asarray(seen.place), seen.samples)
    return whole.reshape(rows, columns, -1)


# Two compilations of the same: the first is twice as fast with lobes at every pixel, half as fast
# without, and is not for use within other programs.
_quick = programs.Program(_samples)
_traced = eqx.filter_jit(_samples)


def _picture(*args: Any) -> Array:
    inside = any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(args))
    return (_quick if args[-1] and not inside else _traced)(*args)


@functools.partial(jax.jit, static_argnums=3)
def _composed(value: Array, behind: Array, place: Array, samples: int) -> Array:
    """Samples put into their places and averaged over pixels."""
    count = value.shape[0]
    found = value[jnp.minimum(place, count - 1)]
    behind = jnp.broadcast_to(behind, found.shape).astype(value.dtype)
    whole = jnp.where((place < count)[:, None], found, behind)
    each = samples**2
    return whole if each == 1 else whole.reshape(-1, each, value.shape[1]).mean(1)
