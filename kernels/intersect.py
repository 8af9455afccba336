"""Where rays meet triangles, spheres and discs, on any device, with derivatives.

What a ray meets is found first, without derivatives; the distance to it is then computed anew,
with derivatives at fixed visibility: a ray that leaves an edge makes no slope. Distances are in
lengths of the direction, infinite, with zero slopes, where there is no hit.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from diffopt.kernels import traversal
from diffopt.kernels.frames import dot
from diffopt.kernels.hierarchy import Hierarchy

# Pairs of rays and shapes that are tested at a time.
PAIRS = 2**18

# One for all rays, or one for each.
Number = float | Float[Array, ""]
Limit = Number | Float[Array, " n"]


def first_hit(
    tree: Hierarchy,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    longest: Limit = jnp.inf,
) -> tuple[Float[Array, " n"], Int[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """The nearest triangle on each ray, from either side.

    Slopes by the corners are those of ``tree.triangles``. The formulas are Möller and
    Trumbore's ("Fast, Minimum Storage Ray/Triangle Intersection", 1997).

    Parameters
    ----------
    tree
        From `hierarchy.build`, in the unit and dtype of the rays.
    origins, directions
        Directions of any length; from a zero one nothing is hit. A ray that starts on a
        triangle may hit it at a distance of rounding: move its origin off the surface.
    longest
        Hits at 0 < t < longest count, up to rounding.

    Returns
    -------
    tuple
        ``(distance, triangle, u, v)``: the triangle is -1, and u and v are 0, where there is no
        hit; else the hit is at (1 - u - v) p0 + u p1 + v p2.
    """
    ends = _limits(longest, origins)
    found, triangle = traversal.search(tree, origins, directions, ends)
    scale = jnp.asarray(tree.scale)
    p = jnp.asarray(tree.triangles)
    if p.shape[0] == 0:
        return found, triangle, jnp.zeros_like(found), jnp.zeros_like(found)
    hit = triangle >= 0
    p = p[jnp.maximum(triangle, 0)] * scale
    # Products of scaled lengths and directions neither overflow nor vanish.
    length, _ = traversal.size(directions)
    o, d = origins * scale, directions / length[:, None]
    o, d = (jnp.where(hit[:, None], a, 0.0) for a in (o, d))
    first, second, away = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], o - p[:, 0]
    across, turned = jnp.cross(d, second), jnp.cross(away, first)
    volume = dot(first, across)
    # Where rounding leaves no volume (a ray within the plane), the distance of the search.
    good = hit & (volume != 0)
    inverse = 1.0 / jnp.where(good, volume, 1.0)
    distance = jnp.where(good, dot(second, turned) * inverse / scale / length, found)
    u, v = (jnp.where(good, a * inverse, 0.0) for a in (dot(away, across), dot(d, turned)))
    return distance, triangle, u, v


def blocked(
    tree: Hierarchy,
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    lengths: Limit = jnp.inf,
) -> Bool[Array, " n"]:
    """Whether anything is hit at 0 < t < lengths; ends at the first triangle found."""
    ends = _limits(lengths, origins)
    return traversal.search(tree, origins, directions, ends, any_hit=True)[1] >= 0


def spheres(
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    centres: Float[Array, "S 3"],
    radii: Float[Array, " S"],
    longest: Limit = jnp.inf,
    least: Number = 0.0,
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """The nearest of spheres on each ray, from outside or inside.

    Haines et al., "Precision Improvements for Ray/Sphere Intersection" (Ray Tracing Gems 2019,
    chapter 7): the discriminant from the part of the offset across the ray, the smaller root
    from the product of both. Squares of lengths must not overflow.

    Parameters
    ----------
    origins, directions
        Directions of any length; from a zero one nothing is hit.
    centres, radii
        In the unit of the origins, radii > 0.
    longest, least
        Roots at least < t < longest count. For rays from a surface `least` must be above
        rounding, some eps times the coordinates over the direction's length.

    Returns
    -------
    tuple
        ``(distance, index)``, the index -1 where there is no hit. Rays that only touch miss.
    """
    return _nearest(_sphere, origins, directions, (centres, radii), longest, least)


def discs(
    origins: Float[Array, "n 3"],
    directions: Float[Array, "n 3"],
    centres: Float[Array, "S 3"],
    normals: Float[Array, "S 3"],
    radii: Float[Array, " S"],
    longest: Limit = jnp.inf,
    least: Number = 0.0,
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """The nearest of flat discs on each ray, from either side; otherwise as `spheres`.

    Normals may have any length. Rays within the plane of a disc miss it.
    """
    return _nearest(_disc, origins, directions, (centres, normals, radii), longest, least)


def _limits(longest, origins):
    """One limit for each ray, in the dtype of the rays."""
    if not hasattr(longest, "dtype"):
        longest = jnp.asarray(longest, origins.dtype)
    return jnp.broadcast_to(longest, origins.shape[:1])


@partial(jax.jit, static_argnames="meet")
def _nearest(
    meet: Callable, origins, directions, shapes: tuple, longest, least
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """The nearest of all shapes by testing every pair, then its distance with derivatives."""
    length, ok = traversal.size(directions)
    d = jnp.where(ok[:, None], directions / length[:, None], 1.0)
    # From a zero direction nothing lies below a limit of 0.
    ends = jnp.where(ok, _limits(longest, origins) * length, 0.0)
    rays = (origins, d, least * length, ends)
    count = shapes[0].shape[0]
    if count == 0 or origins.shape[0] == 0:
        none = jnp.full(origins.shape[:1], jnp.inf, origins.dtype)
        return none, jnp.full(origins.shape[:1], -1, jnp.int32)
    held = lax.stop_gradient(shapes)

    def test(ray):
        t = jax.vmap(partial(meet, *ray))(*held)
        place = jnp.argmin(t).astype(jnp.int32)
        return jnp.where(t[place] < jnp.inf, place, -1)

    step = max(1, min(origins.shape[0], PAIRS // count))
    index = lax.map(test, lax.stop_gradient(rays), batch_size=step)
    chosen = tuple(a[jnp.maximum(index, 0)] for a in shapes)
    distance = jax.vmap(meet)(*rays, *chosen)
    hit = (index >= 0) & (distance < jnp.inf)
    return jnp.where(hit, distance, jnp.inf) / length, jnp.where(hit, index, -1)


def _sphere(o, d, least, longest, centre, radius):
    """Nearest root of one ray and one sphere, infinite without one."""
    away = o - centre
    square, middle = dot(d, d), -dot(away, d)
    across = away + (middle / square) * d
    inside = radius * radius - dot(across, across)
    hit = inside > 0
    root = jnp.sqrt(square * jnp.where(hit, inside, 1.0))
    ahead = middle >= 0
    q = jnp.where(ahead, middle + root, middle - root)
    product = dot(away, away) - radius * radius
    one, other = product / q, q / square
    near, far = jnp.where(ahead, one, other), jnp.where(ahead, other, one)
    t = jnp.where(near > least, near, far)
    return jnp.where(hit & (t > least) & (t < longest), t, jnp.inf)


def _disc(o, d, least, longest, centre, normal, radius):
    """Distance of one ray to one disc, infinite where it passes."""
    away = centre - o
    slope = dot(normal, d)
    t = dot(normal, away) / jnp.where(slope != 0, slope, 1.0)
    off = t * d - away
    hit = (slope != 0) & (dot(off, off) <= radius * radius)
    return jnp.where(hit & (t > least) & (t < longest), t, jnp.inf)
