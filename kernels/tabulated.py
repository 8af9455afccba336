"""Tables over pairs of directions: half and difference angles, linear lookup, warps.

Angles are Rusinkiewicz's ("A new change of variables for efficient BRDF representation",
EGWR 1998), all from sums and differences of the two unit vectors by the arctangent: the
arccosine has no digits left near 0, and its slope is infinite there.

Entries of a table stand at integer places; an axis of one entry is constant.
"""

import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames

Pair = Float[Array, "*batch 3"]
Value = Float[Array, "*batch"]
Corner = tuple[Int[Array, "*batch"], Value]


def root(x: Value) -> Value:
    """Square root, 0 below 0, with slope 0 at 0, where it has none."""
    some = x > 0.0
    return jnp.where(some, jnp.sqrt(jnp.where(some, x, 1.0)), 0.0)


def angle(y: Value, x: Value) -> Value:
    """Arctangent of y / x over the full circle, 0 with slope 0 at the origin."""
    size = jax.lax.stop_gradient(jnp.maximum(jnp.abs(x), jnp.abs(y)))
    some = size > 0.0
    # Over a size that cancels: slopes divide by the squares.
    scale = 1.0 / jnp.where(some, size, 1.0)
    return jnp.where(some, jnp.arctan2(y * scale, jnp.where(some, x * scale, 1.0)), 0.0)


def rusinkiewicz(wi: Pair, wo: Pair) -> tuple[Value, Value, Value]:
    """Half and difference angles of pairs of directions, radians.

    Parameters
    ----------
    wi, wo
        Unit vectors [..., 3], z the normal, both away from the surface.

    Returns
    -------
    tuple
        ``(theta_h, theta_d, phi_d)``: the half vector's angle to the normal, [0, pi]; the
        angle of wi to the half vector, [0, pi / 2]; the azimuth of wi about the half vector,
        (-pi, pi], 0 where wi leans straight away from the normal. Exchanging wi and wo
        turns phi_d by pi. Where an angle is not defined (phi_d for wi = wo or the half vector
        at the normal, theta_h for opposite directions) it is 0; the slopes of the angles are
        0 where they have none.
    """
    s, d = wi + wo, wi - wo
    across2 = s[..., 0] ** 2 + s[..., 1] ** 2
    across = root(across2)
    length = root(across2 + s[..., 2] ** 2)
    theta_h = angle(across, s[..., 2])
    theta_d = angle(root(d[..., 0] ** 2 + d[..., 1] ** 2 + d[..., 2] ** 2), length)
    # d in the frame of the half vector, both coordinates times |s| across.
    turn = (d[..., 1] * s[..., 0] - d[..., 0] * s[..., 1]) * length
    along = (d[..., 0] * s[..., 0] + d[..., 1] * s[..., 1]) * s[..., 2] - d[..., 2] * across2
    return theta_h, theta_d, angle(turn, along)


def half_difference(theta_h: Value, theta_d: Value, phi_d: Value) -> tuple[Pair, Pair]:
    """Directions (wi, wo) from their half and difference angles, the half vector above x.

    The inverse of `rusinkiewicz` but for a turn about the normal.

    Parameters
    ----------
    theta_h, theta_d, phi_d
        Radians, [...].
    """
    across, along = jnp.sin(theta_d), jnp.cos(theta_d)
    x, y = across * jnp.cos(phi_d), across * jnp.sin(phi_d)
    sin, cos = jnp.sin(theta_h), jnp.cos(theta_h)
    return (
        frames.direction(cos * x + sin * along, y, cos * along - sin * x),
        frames.direction(sin * along - cos * x, -y, cos * along + sin * x),
    )


def merl_places(
    theta_h: Value, theta_d: Value, phi_d: Value, shape: tuple[int, int, int]
) -> tuple[Value, Value, Value]:
    """Places in a table in the layout of the MERL database.

    Parameters
    ----------
    theta_h, theta_d, phi_d
        Of `rusinkiewicz`.
    shape
        Entries over theta_h, by square root: entry n sqrt(theta_h / (pi / 2)); over theta_d,
        linear to pi / 2; over phi_d, linear to pi.

    Returns
    -------
    tuple
        Places in entries. Entry k stands at the middle of its bin [k, k + 1): the reader
        published with the database cuts the entry off to an integer, so that its bins start
        at the integers, and a line through their left ends would shift everything by half a
        bin.
    """
    rows, columns, depth = shape
    return (
        rows * root(theta_h / (0.5 * math.pi)) - 0.5,
        columns * theta_d / (0.5 * math.pi) - 0.5,
        depth * phi_d / math.pi - 0.5,
    )


def place(nodes: Float[Array, " N"], x: Value) -> Value:
    """Place of x among increasing nodes; beyond the first and the last it is theirs."""
    count = nodes.shape[0]
    if count == 1:
        return jnp.zeros_like(x)
    first = jnp.clip(jnp.searchsorted(nodes, x, side="right") - 1, 0, count - 2)
    fraction = (x - nodes[first]) / (nodes[first + 1] - nodes[first])
    return first.astype(x.dtype) + jnp.clip(fraction, 0.0, 1.0)


def linear(
    table: Float[Array, "..."],
    places: tuple[Value, ...],
    *,
    periodic: tuple[bool, ...],
    nearest: bool = False,
) -> Float[Array, "..."]:
    """Values of a table between its entries, linear in each axis.

    Parameters
    ----------
    table
        [N_1, ..., N_D, *C]; negative entries are missing: their weights are left out and
        the others scaled to sum 1. 0 where all are missing.
    places
        D arrays [...], in entries.
    periodic
        For each of the D axes: whether entry N follows as entry 0. On the other axes places
        beyond the ends take the value there.
    nearest
        Take the nearest entry instead.

    Returns
    -------
    Array
        [..., *C].
    """
    channels = table.shape[len(places) :]
    flat = table.reshape(-1, *channels)
    total = weight = jnp.zeros((*places[0].shape, *channels), table.dtype)
    for index, part in corners(table.shape[: len(places)], places, periodic, nearest=nearest):
        entries = flat[index]
        part = part.reshape(part.shape + (1,) * len(channels))
        part = jnp.where(entries < 0.0, 0.0, part)
        total = total + part * jnp.where(entries < 0.0, 0.0, entries)
        weight = weight + part
    some = weight > 0.0
    return jnp.where(some, total / jnp.where(some, weight, 1.0), 0.0)


def corners(
    shape: tuple[int, ...],
    places: tuple[Value, ...],
    periodic: tuple[bool, ...],
    *,
    nearest: bool = False,
) -> list[Corner]:
    """The 2^D entries about a place: indices into the flattened table, and weights.

    See `linear`; ``shape`` is [N_1, ..., N_D].
    """
    axes = [
        _ends(x, n, wraps, nearest) for n, x, wraps in zip(shape, places, periodic, strict=True)
    ]
    found: list[Corner] = [(jnp.zeros(places[0].shape, jnp.int32), jnp.ones_like(places[0]))]
    for n, ends in zip(shape, axes, strict=True):
        found = [(i * n + j, a * b) for i, a in found for j, b in ends]
    return found


def invert_bilinear(
    table: Float[Array, "S H W"], slices: list[Corner], x: Value, y: Value
) -> tuple[Value, Value, Value]:
    """Where points of the unit square lie in a bilinear distribution, and its density.

    The marginal along y and the conditional along x of the density through the entries of
    an average of slices, each normalised to integral 1 (Dupuy and Jakob, "An adaptive
    parameterization for efficient material acquisition and rendering", 2018).

    Parameters
    ----------
    table
        Densities of S slices at H x W regular nodes of the square, >= 0.
    slices
        Index and weight of the slices that are averaged, as `corners` gives them.
    x, y
        In [0, 1], [...]; y runs over H.

    Returns
    -------
    tuple
        ``(u, v, density)``: the shares of the distribution below x (within the row) and
        below y, [0, 1], and its density at (x, y).
    """
    nodes, rows, marginal = _distribution(table)
    height, width = table.shape[1:]
    (i, fx), (j, fy) = _cell(x, width), _cell(y, height)
    at = functools.partial(_average, slices=slices)
    left = (1.0 - fy) * at(nodes, j, i) + fy * at(nodes, j + 1, i)
    right = (1.0 - fy) * at(nodes, j, i + 1) + fy * at(nodes, j + 1, i + 1)
    bottom, top = at(rows, j, width - 1), at(rows, j + 1, width - 1)
    start = (1.0 - fy) * at(rows, j, i) + fy * at(rows, j + 1, i)
    share = start + fx * (left + 0.5 * fx * (right - left)) / (width - 1)
    whole = (1.0 - fy) * bottom + fy * top
    some = whole > 0.0
    u = jnp.where(some, share / jnp.where(some, whole, 1.0), x)
    below = at(marginal, j, 0)
    v = below + fy * (bottom + 0.5 * fy * (top - bottom)) / (height - 1)
    density = (1.0 - fx) * left + fx * right
    return jnp.clip(u, 0.0, 1.0), jnp.clip(v, 0.0, 1.0), density


def sample_bilinear(
    table: Float[Array, "S H W"], slices: list[Corner], u: Value, v: Value
) -> tuple[Value, Value]:
    """Points (x, y) of the distribution of `invert_bilinear`, which is its inverse.

    Parameters
    ----------
    table, slices
        As for `invert_bilinear`.
    u, v
        In [0, 1], [...].
    """
    nodes, rows, marginal = _distribution(table)
    height, width = table.shape[1:]
    at = functools.partial(_average, slices=slices)
    sums = at(marginal, _every(height, v), 0)
    j, start = _below(sums, v)
    bottom, top = at(rows, j, width - 1), at(rows, j + 1, width - 1)
    fy = _solve(bottom, top, (v - start) * (height - 1))

    def line(array: Array, i: Array) -> Array:
        low, high = (jnp.broadcast_to(k[None], (i.shape[0], *k.shape)) for k in (j, j + 1))
        return (1.0 - fy)[None] * at(array, low, i) + fy[None] * at(array, high, i)

    sums = line(rows, _every(width, v))
    target = u * sums[-1]
    i, start = _below(sums, target)
    left, right = line(nodes, i[None])[0], line(nodes, i[None] + 1)[0]
    fx = _solve(left, right, (target - start) * (width - 1))
    return (i.astype(u.dtype) + fx) / (width - 1), (j.astype(v.dtype) + fy) / (height - 1)


def _ends(x: Array, count: int, wraps: bool, nearest: bool) -> list[Corner]:
    """Both entries about a place on an axis, with their weights."""
    if nearest:
        index = jnp.floor(jax.lax.stop_gradient(x) + 0.5).astype(jnp.int32)
        index = index % count if wraps else jnp.clip(index, 0, count - 1)
        return [(index, jnp.ones_like(x))]
    if count == 1:
        return [(jnp.zeros(x.shape, jnp.int32), jnp.ones_like(x))]
    if not wraps:
        x = jnp.clip(x, 0.0, count - 1.0)
    first = jnp.floor(jax.lax.stop_gradient(x)).astype(jnp.int32)
    first = first if wraps else jnp.clip(first, 0, count - 2)
    t = x - first.astype(x.dtype)
    following = first + 1
    if wraps:
        first, following = first % count, following % count
    return [(first, 1.0 - t), (following, t)]


def _distribution(table: Array) -> tuple[Array, Array, Array]:
    """Densities of integral 1, their integrals along x, and of those along y, [S, H, 1]."""
    _, height, width = table.shape
    rows = _integral(table) / (width - 1)
    marginal = _integral(rows[:, :, -1]) / (height - 1)
    whole = marginal[:, -1]
    scale = 1.0 / jnp.where(whole > 0.0, whole, 1.0)
    scale = scale[:, None, None]
    return table * scale, rows * scale, marginal[..., None] * scale


def _integral(values: Array) -> Array:
    """Running trapezoids along the last axis, from 0."""
    steps = 0.5 * (values[..., 1:] + values[..., :-1])
    return jnp.concatenate([jnp.zeros_like(values[..., :1]), jnp.cumsum(steps, -1)], -1)


def _cell(x: Array, count: int) -> tuple[Array, Array]:
    """First node and fraction of the step, of x in [0, 1] among regular nodes."""
    x = jnp.clip(x, 0.0, 1.0) * (count - 1)
    first = jnp.clip(jax.lax.stop_gradient(jnp.floor(x)).astype(jnp.int32), 0, count - 2)
    return first, x - first.astype(x.dtype)


def _every(count: int, like: Array) -> Array:
    """0 to count - 1 along a new first axis."""
    index = jnp.arange(count, dtype=jnp.int32).reshape((count,) + (1,) * like.ndim)
    return jnp.broadcast_to(index, (count, *like.shape))


def _average(array: Array, j: Array, i: Array | int, *, slices: list[Corner]) -> Array:
    """Entries [j, i] of the average of slices; j may have axes before those of the slices."""
    flat, (_, height, width) = array.reshape(-1), array.shape
    total = jnp.zeros(j.shape, array.dtype)
    for s, a in slices:
        s, a = (
            jnp.broadcast_to(k.reshape((1,) * (j.ndim - k.ndim) + k.shape), j.shape) for k in (s, a)
        )
        total = total + a * flat[(s * height + j) * width + i]
    return total


def _below(sums: Array, target: Array) -> tuple[Array, Array]:
    """Last of the increasing sums [N, ...] that is not above the target, and its value."""
    index = jnp.clip((sums <= target[None]).sum(0, dtype=jnp.int32) - 1, 0, sums.shape[0] - 2)
    return index, jnp.take_along_axis(sums, index[None], 0)[0]


def _solve(a: Array, b: Array, target: Array) -> Array:
    """Root t in [0, 1] of a t + (b - a) t^2 / 2 = target, without cancellation for a near b."""
    below = a + root(a * a + 2.0 * target * (b - a))
    some = below > 0.0
    return jnp.clip(jnp.where(some, 2.0 * target / jnp.where(some, below, 1.0), 0.0), 0.0, 1.0)
