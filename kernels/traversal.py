"""Walks of rays through a tree of boxes, on any device.

Rays walk in lockstep, `LANES` at a time, nearer boxes first; a lane whose ray has ended takes
the next one, so that no lane waits for the slowest ray. The way back needs no stack: the bits
of one number say at which levels the other child is still to be seen (Áfra and Szirmay-Kalos,
"Stackless Multi-BVH Traversal for CPU, MIC and GPU Ray Tracing", Computer Graphics Forum 2014).

Triangles are tested as Woop, Benthin and Wald do ("Watertight Ray/Triangle Intersection", JCGT
2013). Their argument needs that the two sides of an edge compute the same number, which
compilers break that fuse one of two products into the difference (XLA does); here all
triangles see an edge in the same direction, so that they evaluate the same expression.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from diffopt.kernels.frames import dot
from diffopt.kernels.hierarchy import Hierarchy

# Lanes, inner nodes looked at between two looks at leaves, and the part of the lanes that must
# be free before they are filled again: fastest on a CPU with 5,000 triangles.
LANES = 4096
LOOKS = 4
FREE = 0.25

# No child of a node, or no node: nothing to do.
REST = 8
Columns = tuple[Float[Array, " n"], ...]


class Rays(NamedTuple):
    """Rays in scaled lengths, as columns of [n].

    Attributes
    ----------
    origin, low, high
        Origins, and origins moved by more than rounding: boxes are grown by this.
    inverse
        One over the direction, whose largest component is 1.
    shear
        Rows of the matrix that turns the ray into z and keeps z its length.
    longest
        Distances, in units of the direction's largest component; negative: hits nothing.
    """

    origin: Columns
    low: Columns
    high: Columns
    inverse: Columns
    shear: Columns
    longest: Float[Array, " n"]


def search(
    tree: Hierarchy,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    longest: Float[Array, " n"],
    any_hit: bool = False,
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """The nearest triangle on each ray, or any one.

    Parameters
    ----------
    tree
        From `hierarchy.build`; its `triangles` are not used.
    origins, directions
        In the tree's unit and dtype; directions of any length.
    longest
        Hits at 0 < t < longest count, in lengths of the direction.
    any_hit
        End a ray at the first triangle that is found.

    Returns
    -------
    tuple
        ``(distance, triangle)``; the distance as the search has it, infinite where there is
        no hit and the triangle is -1. Without derivatives.
    """
    parts = jax.tree.map(jnp.asarray, (tree.boxes, tree.corners, tree.numbers, tree.scale))
    held = {a.dtype for a in (parts[3], origins, directions, longest)}
    if len(held) > 1:
        raise TypeError(f"tree and rays are of different types: {sorted(map(str, held))}")

    run = _any if any_hit else _nearest
    distance, triangle = run(*lax.stop_gradient((parts, origins, directions, longest)))
    return distance, triangle


def size(directions: Float[Array, "n 3"]) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Largest component of each vector by magnitude, and whether it is a direction at all.

    Where it is not (zero, infinite or not a number), the size is 1. Without derivatives.
    """
    largest = lax.stop_gradient(jnp.abs(directions)).max(-1)
    # Of smaller ones the inverse overflows.
    ok = (largest > 2 * jnp.finfo(directions.dtype).tiny) & jnp.isfinite(largest)
    return jnp.where(ok, largest, 1.0), ok


def _rays(origins, directions, longest, scale) -> Rays:
    """Rays as the loops have them."""
    largest, ok = size(directions)
    o, d = origins * scale, directions / largest[:, None]
    d = jnp.where(ok[:, None], d, 1.0)
    # The axis along which the ray is longest becomes z; the other two keep their cyclic order.
    z = jax.nn.one_hot(jnp.argmax(jnp.abs(d), -1), 3, dtype=o.dtype)
    sign = dot(d, z)[:, None]
    x, y = jnp.roll(z, 1, -1), jnp.roll(z, 2, -1)
    rows = (x - (dot(d, x)[:, None] * sign) * z, y - (dot(d, y)[:, None] * sign) * z, sign * z)
    # Boxes lie within 1; corners and planes round by a few eps of the larger.
    pad = 8 * jnp.finfo(o.dtype).eps * (1 + jnp.abs(o).max(-1, keepdims=True))
    # Rays within a plane cross it very far away, not at 0 times infinity.
    steep = jnp.where(jnp.abs(d) < 1e-20, 1e-20, d)
    columns = [tuple(a[:, i] for i in range(3)) for a in (o, o + pad, o - pad, 1 / steep, *rows)]
    limit = jnp.where(ok, longest * largest * scale, -1.0)
    return Rays(*columns[:4], shear=columns[4] + columns[5] + columns[6], longest=limit)


def _slabs(low, high, rays, best):
    """Where a ray enters a box, and whether it does so before it ends."""
    near, far = jnp.zeros_like(best), best
    for axis in range(3):
        a = (low[axis] - rays.low[axis]) * rays.inverse[axis]
        b = (high[axis] - rays.high[axis]) * rays.inverse[axis]
        near, far = jnp.maximum(near, jnp.minimum(a, b)), jnp.minimum(far, jnp.maximum(a, b))
    return near, near <= far


def _triangles(corners, rays):
    """Distances to triangles, infinite where there is no hit at t > 0."""
    sheared = []
    for place in range(0, 9, 3):
        x, y, z = (corners[place + i] - rays.origin[i] for i in range(3))
        # With a zero or a one in all but one place, so that nothing rounds but that.
        m = rays.shear
        sheared.append([m[r] * x + m[r + 1] * y + m[r + 2] * z for r in (0, 3, 6)])
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = sheared
    # The corners ascend, so that the third edge runs against the other two.
    bc, ac, ab = bx * cy - by * cx, ax * cy - ay * cx, ax * by - ay * bx
    inside = ((bc >= 0) & (ac <= 0) & (ab >= 0)) | ((bc <= 0) & (ac >= 0) & (ab <= 0))
    total = bc - ac + ab
    inside &= total != 0
    t = (bc * az - ac * bz + ab * cz) / jnp.where(inside, total, 1.0)
    return jnp.where(inside & (t > 0), t, jnp.inf)


def _pop(node, trail):
    """The next node after one that is done with: 0 when none is left."""
    up = lax.population_count((trail & -trail) - 1)
    return jnp.where(trail == 0, 0, (node >> up) ^ 1), jnp.where(trail == 0, 0, (trail >> up) ^ 1)


def _advance(node, trail, code):
    """Down to the nearer child that is hit, or back."""
    both = (code & 3) == 3
    second = jnp.where(both, code >> 2, code >> 1 & 1)
    next_node, next_trail = _pop(node, trail)
    down, idle = (code & 3) != 0, code == REST
    next_node = jnp.where(down, 2 * node + second, next_node)
    next_trail = jnp.where(down, 2 * trail + both.astype(jnp.int32), next_trail)
    return jnp.where(idle, node, next_node), jnp.where(idle, trail, next_trail)


@partial(jax.jit, static_argnames="any_hit")
def _search(parts, origins, directions, longest, any_hit):
    """`search` without checks. Node 0 means that a lane has nothing to do."""
    boxes, corners, numbers, scale = parts
    rays = _rays(origins, directions, longest, scale)
    n, leaves = len(origins), len(boxes[0])
    slots, width = len(numbers) // leaves, min(n, LANES)
    infinite = jnp.full(n, jnp.inf, origins.dtype)
    nothing = jnp.full(n, -1, jnp.int32)
    if n == 0 or slots == 0:
        return infinite, nothing
    looks = LOOKS if leaves > 1 else 0

    # What a lane learns from a box or a triangle is carried to the next round of the loop before
    # it is used: XLA on the CPU would otherwise compute it anew for everything that it is used
    # for, four times as slow altogether.
    def nodes(rays, node, trail, best):
        def look(_, state):
            node, trail = _advance(*state)
            at = jnp.where(node < leaves, node, 0)
            box = [c.at[at].get(mode="promise_in_bounds") for c in boxes]
            first, hit = _slabs(box[0:3], box[3:6], rays, best)
            second, hit_too = _slabs(box[6:9], box[9:12], rays, best)
            code = jnp.where(hit, 1, 0) + jnp.where(hit_too, 2, 0) + jnp.where(second < first, 4, 0)
            return node, trail, jnp.where(at > 0, code, REST).astype(jnp.int32)

        rest = jnp.full(width, REST, jnp.int32)
        return _advance(*lax.fori_loop(0, looks, look, (node, trail, rest)))

    def leaf(rays, node, trail, best, held):
        at = node >= leaves
        start = jnp.where(at, node - leaves, 0) * slots

        def take(slot, best, held, t):
            nearer = at & (t < best)
            return jnp.where(nearer, t, best), jnp.where(nearer, start + slot, held)

        def test(slot, state):
            best, held = take(slot - 1, *state)
            here = [c.at[start + slot].get(mode="promise_in_bounds") for c in corners]
            return best, held, _triangles(here, rays)

        none = jnp.full(width, jnp.inf, best.dtype)
        best, held = take(slots - 1, *lax.fori_loop(0, slots, test, (best, held, none)))
        next_node, next_trail = _pop(node, trail)
        if any_hit:
            next_node = jnp.where(held >= 0, 0, next_node)
        return jnp.where(at, next_node, node), jnp.where(at, next_trail, trail), best, held

    def fill(state):
        taken, ray, node, trail, best, held, distance, found = state
        mine = Rays(*jax.tree.map(lambda a: a[jnp.minimum(ray, n - 1)], tuple(rays)))

        def step(state):
            node, trail, best, held = state
            return leaf(mine, *nodes(mine, node, trail, best), best, held)

        wanted = jnp.where(taken < n, max(1, int(width * FREE)), width)
        node, trail, best, held = lax.while_loop(
            lambda state: (state[0] == 0).sum(dtype=jnp.int32) < wanted,
            step,
            (node, trail, best, held),
        )
        free = node == 0
        at = jnp.where(free, ray, n)
        distance = distance.at[at].set(best, mode="drop")
        found = found.at[at].set(held, mode="drop")
        more = jnp.minimum(taken + jnp.cumsum(free, dtype=jnp.int32) - 1, n)
        ray = jnp.where(free, more, ray)
        return (
            jnp.minimum(taken + free.sum(dtype=jnp.int32), n),
            ray,
            jnp.where(free, (ray < n).astype(jnp.int32), node),
            jnp.where(free, 0, trail),
            jnp.where(free, rays.longest[jnp.minimum(ray, n - 1)], best),
            jnp.where(free, -1, held),
            distance,
            found,
        )

    lanes = jnp.arange(width, dtype=jnp.int32)
    ones, zeros = jnp.ones(width, jnp.int32), jnp.zeros(width, jnp.int32)
    begin = (
        jnp.int32(width),
        lanes,
        ones,
        zeros,
        rays.longest[:width],
        zeros - 1,
        infinite,
        nothing,
    )
    *_, distance, found = lax.while_loop(lambda s: (s[1] < n).any(), fill, begin)
    hit = found >= 0
    distance = jnp.where(hit, distance / scale / size(directions)[0], jnp.inf)
    return distance, jnp.where(hit, numbers[jnp.maximum(found, 0)], -1)


def _batched(any_hit):
    """`_search` of one kind, with its rule for batches.

    A batched loop would compute both sides of every choice: rays of a batch are walked as one
    set of rays, trees of a batch one after the other.
    """

    @custom_vmap
    def run(parts, origins, directions, longest):
        return _search(parts, origins, directions, longest, any_hit)

    @run.def_vmap
    def _(axis_size, in_batched, parts, *rays):
        def spread(a, batched):
            return a if batched else jnp.broadcast_to(a, (axis_size, *a.shape))

        rays = tuple(map(spread, rays, in_batched[1:]))
        if any(jax.tree.leaves(in_batched[0])):
            parts = jax.tree.map(spread, parts, in_batched[0])
            return lax.map(lambda a: run(*a), (parts, *rays)), (True, True)
        found = run(parts, *(a.reshape(-1, *a.shape[2:]) for a in rays))
        return tuple(a.reshape(axis_size, -1) for a in found), (True, True)

    return run


_nearest, _any = _batched(any_hit=False), _batched(any_hit=True)
