"""Surfaces of a scene as unit squares: every map keeps areas in proportion.

A sheet is one side of a rectangle, triangle, sphere or disc. Even points of its square are
even points of the surface, so that a grid on the square cuts it into patches of one size.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames
from diffopt.kernels.frames import dot
from diffopt.scenes import shapes
from diffopt.scenes.scene import Scene
from diffopt.scenes.world import inverse_root

RECTANGLE, TRIANGLE, SPHERE, DISC = range(4)


class Charts(eqx.Module):
    """Sheets of a scene, K of them.

    Attributes
    ----------
    kind
        `RECTANGLE`, `TRIANGLE`, `SPHERE` or `DISC`, [K].
    origin, one, two, three
        A corner and the edges from it, or the centre and perpendicular radii, [K, 3].
    normal
        Of flat ones, on their side, [K, 3].
    side
        1 for fronts, -1 for backs, [K].
    sheet
        Of the front and the back of each primitive, [2, P]; -1 where there is none.
    spread
        Of triangles, what takes (1, u, v) to (s, t) of the square (to shares of the edges
        where the triangle is a sheet of its own), [T, 2, 3].
    """

    kind: Int[Array, " K"]
    origin: Float[Array, "K 3"]
    one: Float[Array, "K 3"]
    two: Float[Array, "K 3"]
    three: Float[Array, "K 3"]
    normal: Float[Array, "K 3"]
    side: Float[Array, " K"]
    sheet: Int[Array, "2 P"]
    spread: Float[Array, "T 2 3"]

    def place(
        self, sheet: Int[Array, " n"], s: Float[Array, " n"], t: Float[Array, " n"]
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """Points of sheets, and their normals on that side."""
        kind = self.kind[sheet]
        x, y, z = s, t, jnp.zeros_like(s)
        for number, coordinates in (
            (TRIANGLE, (*_folded(s, t), z)),
            (SPHERE, _on_ball(s, t)),
            (DISC, (*_on_disc(s, t), z)),
        ):
            here = kind == number
            x, y, z = (jnp.where(here, a, b) for a, b in zip(coordinates, (x, y, z), strict=True))
        offset = x[:, None] * self.one[sheet] + y[:, None] * self.two[sheet]
        offset = offset + z[:, None] * self.three[sheet]
        outward = offset * (inverse_root(dot(offset, offset)) * self.side[sheet])[:, None]
        normal = jnp.where((kind == SPHERE)[:, None], outward, self.normal[sheet])
        return self.origin[sheet] + offset, normal

    def locate(
        self,
        primitive: Int[Array, " n"],
        u: Float[Array, " n"],
        v: Float[Array, " n"],
        position: Float[Array, "n 3"],
        front: Any,
    ) -> tuple[Int[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """Sheets of points and their places (s, t) on them; see `world.surface` for u and v."""
        found = self.sheet[jnp.where(front, 0, 1), primitive]
        sheet = jnp.maximum(found, 0)
        kind = self.kind[sheet]
        s, t = jnp.zeros_like(u), jnp.zeros_like(u)
        if self.spread.shape[0]:
            spread = self.spread[jnp.minimum(primitive, self.spread.shape[0] - 1)]
            s, t = (spread[:, k, 0] + u * spread[:, k, 1] + v * spread[:, k, 2] for k in range(2))
        offset = position - self.origin[sheet]
        x, y, z = (
            dot(offset, axis[sheet]) / jnp.maximum(dot(axis[sheet], axis[sheet]), 1e-30)
            for axis in (self.one, self.two, self.three)
        )
        for number, coordinates in (
            (TRIANGLE, _unfolded(s, t)),
            (SPHERE, _from_ball(x, y, z)),
            (DISC, _from_disc(x, y)),
        ):
            here = kind == number
            s, t = (jnp.where(here, a, b) for a, b in zip(coordinates, (s, t), strict=True))
        return found, jnp.clip(s, 0.0, 1.0), jnp.clip(t, 0.0, 1.0)


class Sheets(eqx.Module):
    """What is known of sheets on the host; all [K] but the sides.

    Attributes
    ----------
    charts
        Their maps.
    owner, primitive, side
        The object, the first of the primitives, and 0 for the front or 1 for the back.
    area
        Of each.
    sides
        Lengths of the edges of a rectangle, the root of the area of others twice, [K, 2].
    """

    charts: Charts
    owner: Int[np.ndarray, " K"]
    primitive: Int[np.ndarray, " K"]
    side: Int[np.ndarray, " K"]
    area: Float[np.ndarray, " K"]
    sides: Float[np.ndarray, "K 2"]


def sheets(scene: Scene, backs: Any = None) -> Sheets:
    """The sheets of a scene.

    Parameters
    ----------
    scene
        The scene.
    backs
        Whether the back of each object has sheets, [O]; by default those of shapes that
        enclose nothing.
    """
    geometry = scene.geometry
    world, (triangles, spheres, discs) = geometry.world, geometry.world.counts
    if backs is None:
        backs = [not shapes.is_closed(one.place.shape) for one in scene.objects]
    backs = np.asarray(backs, bool)
    owner = geometry.owner
    corners = np.asarray(world.vertices)[np.asarray(world.faces)]
    origin = np.concatenate([corners[:, 0], np.asarray(world.centres)])
    axes = np.asarray(world.axes) * np.asarray(world.radii)[:, None, None]
    one = np.concatenate([corners[:, 1] - corners[:, 0], axes[:, :, 0]])
    two = np.concatenate([corners[:, 2] - corners[:, 0], axes[:, :, 1]])
    three = np.concatenate([np.zeros((triangles, 3)), axes[:, :, 2]])
    kind = np.repeat([TRIANGLE, SPHERE, DISC], [triangles, spheres, discs])
    area = geometry.areas.copy()
    normal = np.cross(one, two)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    spread = np.tile(np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), (triangles, 1, 1))
    # Planes and boxes: two triangles of a side are one rectangle, as their texture says.
    flat = [isinstance(x.place.shape, shapes.Plane | shapes.Box) for x in scene.objects]
    pairs = np.flatnonzero(np.asarray([*flat, False])[owner[:triangles]])
    uv = np.asarray(world.uv)[np.asarray(world.faces)[pairs]]
    steps = np.stack([uv[:, 0], uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]], -1)
    spread[pairs] = steps
    main = np.arange(len(owner))
    if len(pairs):
        first, second = pairs[::2], pairs[1::2]
        main[second] = first
        # Edges from those of the first triangle: its place is linear in s and t.
        inverse = np.linalg.inv(steps[::2, :, 1:])
        edges = np.stack([one[first], two[first]], 1)
        sides = np.einsum("kab,kac->kbc", inverse, edges)
        origin[first] -= np.einsum("kb,kbc->kc", steps[::2, :, 0], sides)
        one[first], two[first] = sides[:, 0], sides[:, 1]
        area[first] += area[second]
        kind[first] = RECTANGLE
    fronts = np.flatnonzero(main == np.arange(len(owner)))
    behind = fronts[backs[owner[fronts]]]
    both = np.concatenate([fronts, behind])
    sign = np.repeat([1.0, -1.0], [len(fronts), len(behind)])
    sheet = np.full((2, len(owner)), -1, np.int32)
    sheet[0, fronts] = np.arange(len(fronts))
    sheet[1, behind] = len(fronts) + np.arange(len(behind))
    sheet = sheet[:, main]
    root = np.sqrt(area[both])
    lengths = np.stack([root, root], -1)
    straight = kind[both] == RECTANGLE
    for k, edge in enumerate((one, two)):
        lengths[straight, k] = np.linalg.norm(edge[both[straight]], axis=1)

    def moved(array: np.ndarray) -> Array:
        return jnp.asarray(array, jnp.float32)

    charts = Charts(
        jnp.asarray(kind[both], jnp.int32),
        moved(origin[both]),
        moved(one[both]),
        moved(two[both]),
        moved(three[both]),
        moved(normal[both] * sign[:, None]),
        moved(sign),
        jnp.asarray(sheet),
        moved(spread),
    )
    side = (sign < 0.0).astype(np.int32)
    return Sheets(charts, owner[both], both.astype(np.int32), side, area[both], lengths)


def _folded(s: Array, t: Array) -> tuple[Array, Array]:
    """The square folded onto a triangle: shares of its two edges.

    Heitz, "A low-distortion map between triangle and square" (2019).
    """
    upper = t > s
    return jnp.where(upper, 0.5 * s, s - 0.5 * t), jnp.where(upper, t - 0.5 * s, 0.5 * t)


def _unfolded(a: Array, b: Array) -> tuple[Array, Array]:
    upper = b > a
    return jnp.where(upper, 2.0 * a, a + b), jnp.where(upper, a + b, 2.0 * b)


def _on_ball(s: Array, t: Array) -> tuple[Array, Array, Array]:
    """The square on the sphere: Clarberg, "Fast equal-area mapping of the (hemi)sphere" (2008)."""
    x, y = 2.0 * s - 1.0, 2.0 * t - 1.0
    across, up = jnp.abs(x), jnp.abs(y)
    signed = 1.0 - (across + up)
    r = 1.0 - jnp.abs(signed)
    turn = jnp.where(r > 0.0, (up - across) / jnp.where(r > 0.0, r, 1.0) + 1.0, 1.0) * 0.125
    flat = frames.around(r * jnp.sqrt(jnp.maximum(2.0 - r * r, 0.0)), turn, r)
    z = jnp.where(signed < 0.0, -1.0, 1.0) * (1.0 - r * r)
    left, down = (jnp.where(a < 0.0, -1.0, 1.0).astype(s.dtype) for a in (x, y))
    return jnp.abs(flat[:, 0]) * left, jnp.abs(flat[:, 1]) * down, z.astype(s.dtype)


def _from_ball(x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    r = jnp.sqrt(jnp.clip(1.0 - jnp.abs(z), 0.0, 1.0))
    up = jnp.arctan2(jnp.abs(y), jnp.maximum(jnp.abs(x), 1e-30)) * (2.0 / math.pi) * r
    across = r - up
    across, up = (
        jnp.where(z < 0.0, 1.0 - up, across),
        jnp.where(z < 0.0, 1.0 - across, up),
    )
    s, t = jnp.where(x < 0.0, -across, across), jnp.where(y < 0.0, -up, up)
    return 0.5 * (s + 1.0), 0.5 * (t + 1.0)


def _on_disc(s: Array, t: Array) -> tuple[Array, Array]:
    """The square on the disc: Shirley and Chiu, "A low distortion map" (1997)."""
    x, y = 2.0 * s - 1.0, 2.0 * t - 1.0
    wide = jnp.abs(x) > jnp.abs(y)
    r = jnp.where(wide, x, y)
    ratio = jnp.where(wide, y, x) / jnp.where(r == 0.0, 1.0, r)
    turn = jnp.where(wide, 0.125 * ratio, 0.25 - 0.125 * ratio)
    flat = frames.around(r, turn, r)
    return flat[:, 0], flat[:, 1]


def _from_disc(x: Array, y: Array) -> tuple[Array, Array]:
    r = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-30))
    wide = jnp.abs(x) > jnp.abs(y)
    near = jnp.where(wide, x, y)
    signed = jnp.where(near < 0.0, -r, r)
    safe = jnp.where(near == 0.0, 1.0, near)
    other = signed * jnp.arctan(jnp.where(wide, y, x) / safe) * (4.0 / math.pi)
    s, t = jnp.where(wide, signed, other), jnp.where(wide, other, signed)
    return 0.5 * (s + 1.0), 0.5 * (t + 1.0)
