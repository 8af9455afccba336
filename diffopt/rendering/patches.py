"""Surfaces of a scene cut into patches, over which light is taken as even.

Sheets (see `diffopt.rendering.charts`) carry grids. A patch is a cell of one, or a quarter of a
cell, or a quarter of that; triangles of a fine mesh are joined to patches by their place and
the direction that they face. A table over the finest cells says which patch a point belongs to.

Materials that light passes and perfect mirrors scatter nothing evenly: their patches take light
away from it.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.kernels import frames
from diffopt.rendering import charts
from diffopt.rendering.albedos import albedos, scattered
from diffopt.rendering.charts import RECTANGLE, Sheets
from diffopt.rendering.groups import Group
from diffopt.rendering.stage import Stage
from diffopt.rendering.standins import evenly
from diffopt.scenes import world
from diffopt.scenes.scene import Scene
from diffopt.scenes.textures import Textured

# Triangles below this share of the area wanted of a patch are joined.
_SMALL = 0.5
# Side of the cubes in which they are joined, in roots of that area.
_CUBE = 1.2
# Cells at least along each side of the square of a sphere or disc, whose maps have corners.
_ROUND = 8
# Cells at least along each side of what emits light: how much of it escapes counts for all.
_BRIGHT = 4
# Points of a patch at which a texture is read, and cosines and nodes of its albedo.
_POINTS, _COSINES, _NODES = 16, 4, 8


class Cells(NamedTuple):
    """All cells of one level: sheet, row and column of each, and where sheets start."""

    sheet: Int[np.ndarray, " c"]
    row: Int[np.ndarray, " c"]
    column: Int[np.ndarray, " c"]
    start: Int[np.ndarray, " K"]


@dataclasses.dataclass(frozen=True, eq=False)
class Patches:
    """Patches of a scene, P of them, on the host.

    Attributes
    ----------
    sheets
        What they lie on.
    rows, columns
        Cells of the coarsest grid of each sheet, [K].
    cap
        How often a cell of a sheet may be quartered, [K].
    sheet, level, row, column
        Of E elements, in the order of the patches, [E]: a patch is one cell, or several.
    patch
        Whose they are, [E].
    """

    sheets: Sheets
    rows: Int[np.ndarray, " K"]
    columns: Int[np.ndarray, " K"]
    cap: Int[np.ndarray, " K"]
    sheet: Int[np.ndarray, " E"]
    level: Int[np.ndarray, " E"]
    row: Int[np.ndarray, " E"]
    column: Int[np.ndarray, " E"]
    patch: Int[np.ndarray, " E"]

    @property
    def count(self) -> int:
        """P."""
        return int(self.patch[-1]) + 1 if len(self.patch) else 0

    @property
    def depth(self) -> int:
        """Levels beyond the coarsest."""
        return int(self.cap.max(initial=0))

    @functools.cached_property
    def first(self) -> Int[np.ndarray, " P"]:
        """First element of each patch."""
        return np.searchsorted(self.patch, np.arange(self.count))

    @functools.cached_property
    def shares(self) -> Float[np.ndarray, " E"]:
        """Area of the elements."""
        cells = (self.rows * self.columns)[self.sheet] * 4.0**self.level
        return self.sheets.area[self.sheet] / cells

    @functools.cached_property
    def area(self) -> Float[np.ndarray, " P"]:
        """Of the patches."""
        return np.bincount(self.patch, self.shares, self.count)

    @property
    def owner(self) -> Int[np.ndarray, " P"]:
        """Objects."""
        return self.sheets.owner[self.sheet[self.first]]

    @property
    def primitive(self) -> Int[np.ndarray, " P"]:
        """First primitives."""
        return self.sheets.primitive[self.sheet[self.first]]

    @property
    def side(self) -> Int[np.ndarray, " P"]:
        """0 for fronts, 1 for backs."""
        return self.sheets.side[self.sheet[self.first]]

    @functools.cached_property
    def centre(self) -> Float[np.ndarray, "P 3"]:
        """Point in the middle of the first element."""
        return self._middles[0]

    @functools.cached_property
    def normal(self) -> Float[np.ndarray, "P 3"]:
        """Unit normal there, on its side."""
        return self._middles[1]

    @functools.cached_property
    def _middles(self) -> tuple[np.ndarray, np.ndarray]:
        at = self.first
        scale = 2.0 ** self.level[at]
        s = (self.column[at] + 0.5) / (self.columns[self.sheet[at]] * scale)
        t = (self.row[at] + 0.5) / (self.rows[self.sheet[at]] * scale)
        return self._place(self.sheet[at], s, t)

    def _place(self, sheet: Any, s: Any, t: Any) -> tuple[np.ndarray, np.ndarray]:
        found = _placed(
            self.sheets.charts,
            jnp.asarray(sheet, jnp.int32),
            jnp.asarray(s, jnp.float32),
            jnp.asarray(t, jnp.float32),
        )
        return np.asarray(found[0]), np.asarray(found[1])

    def cells(self, level: int) -> Cells:
        """The cells of a level; sheets that are not quartered that often stay as they are."""
        scale = 2 ** np.minimum(level, self.cap)
        counts = self.rows * self.columns * scale**2
        start = np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64)
        sheet = np.repeat(np.arange(len(counts)), counts)
        inside = np.arange(len(sheet)) - start[sheet]
        wide = (self.columns * scale)[sheet]
        return Cells(sheet, inside // wide, inside % wide, start)

    @functools.cached_property
    def table(self) -> Int[np.ndarray, " c"]:
        """Patch of each of the finest cells."""
        finest = self.cells(self.depth)
        out = np.full(len(finest.sheet), -1, np.int32)
        for level in range(self.depth + 1):
            cells = self.cells(level)
            own = np.full(len(cells.sheet), -1, np.int32)
            here = self.level == level
            sheet = self.sheet[here]
            wide = self.columns[sheet] * 2**level
            own[cells.start[sheet] + self.row[here] * wide + self.column[here]] = self.patch[here]
            less = self.cap[finest.sheet] - np.minimum(level, self.cap[finest.sheet])
            wide = (self.columns * 2 ** np.minimum(level, self.cap))[finest.sheet]
            above = cells.start[finest.sheet] + (finest.row >> less) * wide
            found = own[above + (finest.column >> less)]
            out = np.where(found >= 0, found, out)
        return out

    def cell(self, sheet: np.ndarray, s: np.ndarray, t: np.ndarray) -> Int[np.ndarray, " n"]:
        """Numbers of the finest cells at places on sheets; -1 where there is no sheet."""
        known = np.maximum(sheet, 0)
        scale = 2 ** self.cap[known]
        wide, high = self.columns[known] * scale, self.rows[known] * scale
        column = np.minimum((s * wide).astype(np.int64), wide - 1)
        row = np.minimum((t * high).astype(np.int64), high - 1)
        found = self.cells(self.depth).start[known] + row * wide + column
        return np.where(sheet >= 0, found, -1).astype(np.int32)

    def sample(
        self, which: Int[np.ndarray, " n"], u: Float[np.ndarray, "n 2"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Points of patches by numbers in [0, 1): positions, normals, sheets, s, t.

        Even numbers give points that are even over the patch.
        """
        ends = np.cumsum(self.shares)
        start = (ends - self.shares)[self.first]
        inside = start[which] + u[:, 0] * self.area[which]
        last = np.append(self.first[1:], len(self.patch))[which] - 1
        at = np.clip(np.searchsorted(ends, inside, side="right"), self.first[which], last)
        rest = np.clip((inside - (ends - self.shares)[at]) / self.shares[at], 0.0, 1.0)
        scale = 2.0 ** self.level[at]
        sheet = self.sheet[at]
        s = (self.column[at] + rest) / (self.columns[sheet] * scale)
        t = (self.row[at] + u[:, 1]) / (self.rows[sheet] * scale)
        return *self._place(sheet, s, t), sheet, s, t

    def split(self, which: Int[np.ndarray, " m"]) -> "tuple[Patches, Int[np.ndarray, ' P']]":
        """Patches of which some are cut in four.

        Returns
        -------
        tuple
            Them, the ones that stay first and in their order, and the numbers before; -1 for
            quarters. What cannot be cut further stays.
        """
        cut = np.zeros(self.count, bool)
        cut[which] = True
        cut &= self.level[self.first] < self.cap[self.sheet[self.first]]
        stays = ~cut[self.patch]
        new = np.cumsum(~cut) - 1
        at = self.first[cut]
        four = np.repeat(at, 4)
        row = 2 * self.row[four] + np.tile([0, 0, 1, 1], len(at))
        column = 2 * self.column[four] + np.tile([0, 1, 0, 1], len(at))
        kept = int((~cut).sum())

        def joined(old: np.ndarray, more: np.ndarray) -> np.ndarray:
            return np.concatenate([old[stays], more])

        patches = dataclasses.replace(
            self,
            sheet=joined(self.sheet, self.sheet[four]),
            level=joined(self.level, self.level[four] + 1),
            row=joined(self.row, row),
            column=joined(self.column, column),
            patch=joined(new[self.patch], kept + np.arange(len(four))),
        )
        before = np.concatenate([np.flatnonzero(~cut), np.full(len(four), -1)])
        return patches, before


def cut(scene: Scene, wanted: int, depth: int = 0, backs: Any = None) -> Patches:
    """The surfaces of a scene as patches.

    Parameters
    ----------
    scene
        The scene.
    wanted
        About how many patches; each side of a sheet and each shape has at least one.
    depth
        How often patches may be quartered later.
    backs
        See `charts.sheets`.
    """
    sheets = charts.sheets(scene, backs)
    size = float(np.sqrt(sheets.area.sum() / wanted))
    cells = np.maximum(np.round(sheets.sides / size), 1).astype(np.int64)
    dark = np.array([_dark(one.material) for one in scene.objects] or [False], bool)[sheets.owner]
    cells[dark] = 1
    kind = np.asarray(sheets.charts.kind)
    round_ = (kind > charts.TRIANGLE) & ~dark
    cells[round_] = np.maximum(cells[round_], _ROUND)
    bright = np.array([one.emission is not None for one in scene.objects] or [False], bool)
    wide = bright[sheets.owner] & (kind != charts.TRIANGLE)
    cells[wide] = np.maximum(cells[wide], _BRIGHT)
    joined = (kind == charts.TRIANGLE) & ((sheets.area < _SMALL * size**2) | dark)
    cap = np.where(joined | dark, 0, depth)
    grid = Patches(sheets, cells[:, 1], cells[:, 0], cap, *(np.zeros(0, np.int64),) * 5)
    found = grid.cells(0)
    # Joined triangles: by object, side, the cube that they lie in and the axis they face.
    middle, normal = grid._place(found.sheet, *np.full((2, len(found.sheet)), 0.5))
    facing = np.argmax(np.abs(normal), 1)
    facing = 2 * facing + (np.take_along_axis(normal, facing[:, None], 1)[:, 0] > 0.0)
    cube = np.floor((middle - scene.geometry.centre) / (_CUBE * size)).astype(np.int64)
    key = np.stack([sheets.owner[found.sheet], sheets.side[found.sheet], facing, *cube.T], 1)
    key = np.where(joined[found.sheet, None], key, -1)
    alone = np.where(joined[found.sheet], -1, np.arange(len(key)))
    key = np.column_stack([key, alone])
    _, patch = np.unique(key, axis=0, return_inverse=True) if len(key) else (0, alone)
    order = np.argsort(patch.reshape(-1), kind="stable")
    level = np.zeros(len(order), np.int64)
    parts = found.sheet[order], level, found.row[order], found.column[order]
    names = ("sheet", "level", "row", "column")
    fields = dict(zip(names, parts, strict=True))
    return dataclasses.replace(grid, **fields, patch=patch.reshape(-1)[order])


def _dark(material: Any) -> bool:
    """Whether a material scatters no even light: it is glass or a perfect mirror."""
    kind = material.material if isinstance(material, Textured) else material
    return kind.transmits or not kind.smooth


@eqx.filter_jit
def _placed(found: charts.Charts, sheet: Array, s: Array, t: Array) -> tuple[Array, Array]:
    return found.place(sheet, s, t)


def albedo(stage: Stage, patches: Patches) -> Float[Array, "P C"]:
    """Share of light from all sides that patches scatter; differentiable.

    Lobes in single directions are left out, glossy ones count as if they were diffuse. The mean
    over the patch where the material is textured.
    """
    primitive = patches.primitive
    kinds, members = stage.group[primitive], stage.member[jnp.asarray(primitive)]
    total = jnp.zeros((patches.count, stage.channels), stage.dtype)
    for k, group in enumerate(stage.groups):
        rows = np.flatnonzero(kinds == k)
        if not len(rows) or _dark(group.material):
            continue
        if isinstance(group.material, Textured):
            found = _textured(stage, patches, group, rows)
        else:
            table = _even(group)
            found = table[members[rows]] if group.stacked else table[jnp.zeros_like(rows)]
        total = total.at[jnp.asarray(rows)].set(found)
    return total


@eqx.filter_jit
def _even(group: Group) -> Float[Array, "m C"]:
    """Mean of the albedo over the cosine, weighted with it."""
    table = albedos(group).table
    assert table is not None
    count = table.shape[1]
    # The exact mean of what is linear between the cosines of the table.
    x = np.linspace(0.0, 1.0, count)
    h = x[1]
    rise = (x[1:] ** 3 - x[:-1] ** 3) / 3.0 - x[:-1] * (x[1:] ** 2 - x[:-1] ** 2) / 2.0
    fall = (x[1:] ** 2 - x[:-1] ** 2) / 2.0 - rise / h
    weight = np.append(fall, 0.0) + np.append(0.0, rise / h)
    return jnp.einsum("mkc,k->mc", table, jnp.asarray(2.0 * weight, table.dtype))


def _textured(
    stage: Stage, patches: Patches, group: Group, rows: Int[np.ndarray, " n"]
) -> Float[Array, "n C"]:
    """Mean albedo over points of patches."""
    which = np.repeat(rows, _POINTS)
    u = np.tile(evenly(_POINTS)[:, :2], (len(rows), 1))
    position, _, sheet, s, t = patches.sample(which, u)
    primitive, u, v = _corners(patches.sheets, sheet, s, t)
    member = jnp.zeros(len(which), jnp.int32)
    arrays = (jnp.asarray(a, stage.dtype) for a in (u, v, position))
    found = _at_points(group, stage.world, member, jnp.asarray(primitive), *arrays)
    return found.reshape(len(rows), _POINTS, -1).mean(1)


@eqx.filter_jit
def _at_points(
    group: Group, shapes: world.World, member: Array, primitive: Array, u: Any, v: Any, p: Any
) -> Float[Array, "n C"]:
    found = world.surface(shapes, primitive, u, v, p)
    x, w = np.polynomial.legendre.leggauss(_COSINES)
    cos, weight = 0.5 * (x + 1.0), 0.5 * w * (x + 1.0)
    total = jnp.zeros((len(u), group.channels), u.dtype)
    for c, share in zip(cos, weight, strict=True):
        wo = frames.direction(*(jnp.full(len(u), a, u.dtype) for a in (np.sqrt(1 - c * c), 0, c)))
        value = group.each(lambda m, w: scattered(m, w, _NODES), member, found, wo)
        total = total + group.converted(value) * float(share)
    return total


def _corners(
    sheets: Sheets, sheet: np.ndarray, s: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Primitives at places on sheets, and shares of their corners; 0 for round ones."""
    kind = np.asarray(sheets.charts.kind)[sheet]
    primitive = sheets.primitive[sheet]
    spread = np.asarray(sheets.charts.spread)
    u, v = (np.array(a) for a in jax.device_get(charts._folded(jnp.asarray(s), jnp.asarray(t))))
    u, v = (np.where(kind == charts.TRIANGLE, a, 0.0) for a in (u, v))
    for second in (0, 1):
        rows = np.flatnonzero(kind == RECTANGLE)
        this = spread[primitive[rows] + second]
        inverse = np.linalg.inv(this[:, :, 1:])
        st = np.stack([s, t], -1)[rows] - this[:, :, 0]
        a, b = np.einsum("nab,nb->an", inverse, st)
        inside = (a >= -1e-4) & (b >= -1e-4) & (a + b <= 1.0 + 1e-4)
        u[rows[inside]], v[rows[inside]] = a[inside], b[inside]
        if second:
            primitive = primitive.copy()
            primitive[rows[inside]] += 1
    return primitive.astype(np.int32), u, v
