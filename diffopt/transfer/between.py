"""Pictures by precomputed transfer, in one jitted function.

Between the vertices lobes are interpolated at every pixel, as they differ from those of the
unoccluded material, or radiance itself is (the glossy-transfer paper, section 6.2).
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames
from diffopt.kernels.frames import dot
from diffopt.rendering import programs
from diffopt.transfer import fields, relighting
from diffopt.transfer.fields import Fields, unpacked
from diffopt.transfer.raster import Seen
from diffopt.transfer.relighting import Lighting, Tables

#: Samples whose lobes are held at a time.
BLOCK = 2**13


class Met(NamedTuple):
    """Vertices as an eye sees them: what samples between them are made of, a row for each.

    Attributes
    ----------
    rows
        Lobes over the unoccluded ones, place, tangent and normal, [n, F].
    matte
        Radiance of the view-independent share, None where there is none, [n, C].
    material
        [n].
    """

    rows: Float[Array, "n F"]
    matte: Float[Array, "n C"] | None
    material: Int[Array, " n"]


def met(
    held: Tables,
    light: Lighting,
    vertices: Int[Array, " n"],
    eye: Float[Array, "3"],
) -> Met:
    """Some vertices, for `shaded`; the transfer has glossy materials.

    Parameters
    ----------
    held
        The transfer.
    light
        On it.
    vertices
        Numbers.
    eye
        In the world.
    """
    matte = relighting.matte_radiance(held, light, vertices) if held.matte else None
    return Met(
        relighting.vertex_rows(held, vertices, towards(held, vertices, eye)),
        matte,
        held.material[vertices],
    )


def shaded(
    held: Tables,
    light: Lighting,
    known: Met,
    corners: Int[Array, "P 3"],
    shares: Float[Array, "P 3"],
    eye: Float[Array, "3"],
) -> Float[Array, "P C"]:
    """Radiance of samples between vertices, with lobes of their own.

    Parameters
    ----------
    held, light
        As for `met`.
    known
        Of `met`.
    corners
        Of the triangles of the samples, places among the vertices.
    shares
        Of the corners.
    eye
        As for `met`.
    """
    weights = [shares[:, k] for k in range(3)]
    rows = [known.rows[corners[:, k]] for k in range(3)]
    found = _pixel_fields(held, rows, weights, known.material[corners[:, 0]], eye)
    value = relighting.lit_lobes(found, light)
    if known.matte is not None:
        for k in range(3):
            value = value + shares[:, k : k + 1] * known.matte[corners[:, k]]
    return value


def towards(held: Tables, vertices: Array, eye: Array) -> Float[Array, "n 3"]:
    """Unit vectors from vertices to an eye."""
    away = eye[None] - held.position[vertices]
    return away / jnp.sqrt(jnp.maximum(dot(away, away), 1e-30))[:, None]


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
    if not per_pixel or not held.glossy:
        each = relighting.vertex_radiance(held, light, vertices, towards(held, vertices, eye))
        parts = [shares[:, k : k + 1] * each[corners[:, k]] for k in range(3)]
        return parts[0] + parts[1] + parts[2]
    known = met(held, light, vertices, eye)

    def some(args: tuple[Array, Array]) -> Array:
        return shaded(held, light, known, *args, eye)

    count = corners.shape[0]
    size = min(BLOCK, count)
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
    over = relighting.unoccluded(
        held.over, material, relighting.into(axes, frames.direction(x, y, z))
    )
    found = fields.between(shares, parts, held.over.lobes)
    mu, log = list(found.mu), list(found.log_kappa)
    for k, axis in enumerate(over.mu):
        there = relighting.out_of(axes, axis)
        mu[k] = fields.normalised([u + v for u, v in zip(there, mu[k], strict=True)], there)
        log[k] = log[k] + over.log_kappa[k]
    return Fields(relighting.weighed(found, over), mu, log)
