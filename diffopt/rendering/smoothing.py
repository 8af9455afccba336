"""Values of patches as a smooth function of the place on a surface.

Cells of patches that were cut less finely are first interpolated to the finest grid, level by
level; corners of the cells then get the mean of the cells around them, also across sheets of
one object that meet there without an edge; between the corners it is bilinear.
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from diffopt.rendering.charts import TRIANGLE, Charts
from diffopt.rendering.patches import Cells, Patches
from diffopt.scenes.scene import Scene

# Corners nearer than this, in radii of the scene, with normals this much alike, are one.
_NEAR, _ALIKE = 1e-4, 0.02


class Field(eqx.Module):
    """A quantity over the surfaces of a scene.

    Attributes
    ----------
    charts
        Maps of the sheets.
    values
        At the corners of cells, row by row, [N, C].
    start, rows, columns
        Of each sheet, where its corners start and its number of cells, [K].
    """

    charts: Charts
    values: Float[Array, "N C"]
    start: Int[Array, " K"]
    rows: Int[Array, " K"]
    columns: Int[Array, " K"]

    def at(
        self,
        primitive: Int[Array, " n"],
        u: Float[Array, " n"],
        v: Float[Array, " n"],
        position: Float[Array, "n 3"],
        front: Bool[Array, " n"],
    ) -> Float[Array, "n C"]:
        """Values at points of surfaces; 0 on sides that have no patches."""
        u, v, position = (a.astype(jnp.float32) for a in (u, v, position))
        found, s, t = self.charts.locate(primitive, u, v, position, front)
        sheet = jnp.maximum(found, 0)
        rows, columns, start = self.rows[sheet], self.columns[sheet], self.start[sheet]
        x, y = s * columns.astype(s.dtype), t * rows.astype(t.dtype)
        left = jnp.minimum(x.astype(jnp.int32), columns - 1)
        low = jnp.minimum(y.astype(jnp.int32), rows - 1)
        dtype = self.values.dtype
        x = (x - left.astype(x.dtype)).astype(dtype)[:, None]
        y = (y - low.astype(y.dtype)).astype(dtype)[:, None]
        corner = start + low * (columns + 1) + left
        above = corner + columns + 1
        lower = (1.0 - x) * self.values[corner] + x * self.values[corner + 1]
        upper = (1.0 - x) * self.values[above] + x * self.values[above + 1]
        return jnp.where((found >= 0)[:, None], (1.0 - y) * lower + y * upper, 0.0)


class Step(eqx.Module):
    """From one level to the next finer one.

    Attributes
    ----------
    children
        Cells of the finer level within each cell, [c, 4].
    own
        Whether a finer cell has a value of its own, [f].
    near, weight
        Cells of the coarser level about each finer one, and their shares, [f, 4].
    """

    children: Int[Array, "c 4"]
    own: Bool[Array, " f"]
    near: Int[Array, "f 4"]
    weight: Float[Array, "f 4"]


class Smoother(eqx.Module):
    """Makes fields of values of patches; linear in them.

    Attributes
    ----------
    table
        Patch of each of the finest cells.
    steps
        From the coarsest level on.
    cells, corners
        Pairs of a cell and a corner of it: the corner as the number of its place, [m].
    place
        Number of the place of each corner of the grid, [N].
    places
        How many there are.
    blank
        A field without values.
    """

    table: Int[Array, " c"]
    steps: tuple[Step, ...]
    cells: Int[Array, " m"]
    corners: Int[Array, " m"]
    place: Int[Array, " N"]
    places: int = eqx.field(static=True)
    blank: Field

    def field(self, values: Float[Array, "P C"], weight: Float[Array, " P"]) -> Field:
        """Values of patches as a field; each counts by its weight, those of 0 not at all."""
        return _smooth(self, values, weight)


@eqx.filter_jit
def _smooth(smoother: Smoother, values: Array, weight: Array) -> Field:
    whole = jnp.concatenate([values * weight[:, None], weight[:, None]], 1)[smoother.table]
    means = [whole]
    for step in reversed(smoother.steps):
        means.append(means[-1][step.children].mean(1))
    means.reverse()
    found = means[0]
    for step, mean in zip(smoother.steps, means[1:], strict=True):
        shares = step.weight.astype(found.dtype)[:, :, None]
        between = (found[step.near] * shares).sum(1)
        found = jnp.where(step.own[:, None], mean, between)
    total = jnp.zeros((smoother.places, found.shape[1]), found.dtype)
    total = total.at[smoother.corners].add(found[smoother.cells])
    share = total[:, -1:]
    at_places = total[:, :-1] / jnp.where(share > 0.0, share, 1.0)
    return eqx.tree_at(lambda f: f.values, smoother.blank, at_places[smoother.place])


def smoother(scene: Scene, patches: Patches) -> Smoother:
    """What makes fields over the surfaces of a scene."""
    finest = patches.cells(patches.depth)
    scale = 2**patches.cap
    rows, columns = patches.rows * scale, patches.columns * scale
    count = (rows + 1) * (columns + 1)
    start = np.concatenate([[0], np.cumsum(count)[:-1]]).astype(np.int64)
    place = _places(scene, patches, start, rows, columns, count)
    first = start[finest.sheet] + finest.row * (columns + 1)[finest.sheet] + finest.column
    beside = first + (columns + 1)[finest.sheet]
    around = np.concatenate([first, first + 1, beside, beside + 1])
    cells = np.tile(np.arange(len(first)), 4)
    steps = [_step(patches, level) for level in range(patches.depth)]
    blank = Field(
        patches.sheets.charts,
        jnp.zeros((0, 0), jnp.float32),
        jnp.asarray(start, jnp.int32),
        jnp.asarray(rows, jnp.int32),
        jnp.asarray(columns, jnp.int32),
    )
    return Smoother(
        jnp.asarray(patches.table),
        tuple(steps),
        jnp.asarray(cells, jnp.int32),
        jnp.asarray(place[around], jnp.int32),
        jnp.asarray(place, jnp.int32),
        int(place.max(initial=-1)) + 1,
        blank,
    )


def _places(
    scene: Scene,
    patches: Patches,
    start: np.ndarray,
    rows: np.ndarray,
    columns: np.ndarray,
    count: np.ndarray,
) -> Int[np.ndarray, " N"]:
    """Number of the place of each corner: equal where corners of one object's side coincide."""
    sheet = np.repeat(np.arange(len(count)), count)
    inside = np.arange(len(sheet)) - start[sheet]
    wide = (columns + 1)[sheet]
    s = (inside % wide) / columns[sheet]
    t = (inside // wide) / rows[sheet]
    position, normal = patches._place(sheet, s, t)
    normal = _shading(scene, patches, sheet, s, t, normal)
    sheets = patches.sheets
    near = (position - scene.geometry.centre) / (_NEAR * scene.geometry.radius)
    # Shifted, so that common places and directions do not lie where rounding turns.
    near, alike = np.floor(near + 0.3819), np.floor(normal / _ALIKE + 0.3819)
    key = np.column_stack([sheets.owner[sheet], sheets.side[sheet], near, alike])
    key = np.ascontiguousarray(key.astype(np.int64))
    whole = key.view([("", key.dtype)] * key.shape[1])[:, 0]
    return np.unique(whole, return_inverse=True)[1].reshape(-1)


def _shading(
    scene: Scene,
    patches: Patches,
    sheet: np.ndarray,
    s: np.ndarray,
    t: np.ndarray,
    normal: np.ndarray,
) -> Float[np.ndarray, "N 3"]:
    """Normals of meshes as they are interpolated for shading; given ones elsewhere."""
    sheets, shapes = patches.sheets, scene.geometry.world
    rows = np.flatnonzero(np.asarray(sheets.charts.kind)[sheet] == TRIANGLE)
    if not len(rows):
        return normal
    upper = t[rows] > s[rows]
    a = np.where(upper, 0.5 * s[rows], s[rows] - 0.5 * t[rows])
    b = np.where(upper, t[rows] - 0.5 * s[rows], 0.5 * t[rows])
    corners = np.asarray(shapes.faces)[sheets.primitive[sheet[rows]]]
    normals = np.asarray(shapes.normals)[corners]
    mixed = np.einsum("nk,nkc->nc", np.stack([1.0 - a - b, a, b], -1), normals)
    mixed /= np.maximum(np.linalg.norm(mixed, axis=1, keepdims=True), 1e-30)
    out = np.array(normal, np.float64)
    out[rows] = mixed
    return out


def _step(patches: Patches, level: int) -> Step:
    coarse, fine = patches.cells(level), patches.cells(level + 1)
    cut = patches.cap > level
    wide = patches.columns * 2 ** np.minimum(level, patches.cap)
    high = patches.rows * 2 ** np.minimum(level, patches.cap)

    def number(cells: Cells, sheet: Any, row: Any, column: Any, wide: Any) -> np.ndarray:
        return cells.start[sheet] + row * wide[sheet] + column

    sheet, twice = coarse.sheet, np.where(cut, 2 * wide, wide)
    children = []
    for down in (0, 1):
        for right in (0, 1):
            row = np.where(cut[sheet], 2 * coarse.row + down, coarse.row)
            column = np.where(cut[sheet], 2 * coarse.column + right, coarse.column)
            children.append(number(fine, sheet, row, column, twice))
    sheet = fine.sheet
    row = np.where(cut[sheet], fine.row // 2, fine.row)
    column = np.where(cut[sheet], fine.column // 2, fine.column)
    down, right = 2 * (fine.row % 2) - 1, 2 * (fine.column % 2) - 1
    row2 = np.where(cut[sheet], np.clip(row + down, 0, high[sheet] - 1), row)
    column2 = np.where(cut[sheet], np.clip(column + right, 0, wide[sheet] - 1), column)
    near = [number(coarse, sheet, r, c, wide) for r in (row, row2) for c in (column, column2)]
    weight = np.broadcast_to([9.0, 3.0, 3.0, 1.0], (len(sheet), 4)) / 16.0
    # What was cut this finely has a value of its own, and so has what cannot be cut.
    finest = patches.cells(patches.depth)
    less = patches.cap[finest.sheet] - np.minimum(level + 1, patches.cap[finest.sheet])
    at = number(fine, finest.sheet, finest.row >> less, finest.column >> less, twice)
    own = np.zeros(len(sheet), bool)
    own[at] = patches.level[patches.first][patches.table] > level
    own |= ~cut[sheet]
    return Step(
        jnp.asarray(np.stack(children, -1), jnp.int32),
        jnp.asarray(own),
        jnp.asarray(np.stack(near, -1), jnp.int32),
        jnp.asarray(weight, jnp.float32),
    )
