"""Environment maps: radiance from directions, and directions by their brightness."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import frames
from diffopt.kernels.frames import dot
from diffopt.scenes.channels import Channels
from diffopt.scenes.lights import Environment

# Share of directions drawn evenly: between the pixels of a map the radiance is interpolated,
# also next to black ones.
_EVEN = 0.1


class Map(eqx.Module):
    """Radiance [H, W, C] over longitude and latitude.

    Attributes
    ----------
    pixels
        In the map's own channels.
    matrix
        From those to the scene's; None where they are the same.
    axes
        Rows: directions in the world of the map's x, y and zenith, [3, 3].
    rows
        Where the shares of the rows end, [H].
    columns
        Within each row, where the shares of the pixels end, [H, W].
    """

    pixels: Float[Array, "H W c"]
    matrix: Float[Array, "c C"] | None
    axes: Float[Array, "3 3"]
    rows: Float[Array, " H"]
    columns: Float[Array, "H W"]
    count: int = eqx.field(static=True)

    def __init__(self, light: Environment, channels: Channels, dtype: Any) -> None:
        """Prepare a light for a scene with channels."""
        image = light.radiance if light.radiance.ndim == 3 else light.radiance[..., None]
        self.pixels = image.astype(dtype) * light.scale.astype(dtype)
        matrix = channels.matrix(image.shape[-1])
        self.matrix = None if matrix is None else jnp.asarray(matrix, dtype)
        self.count = channels.count
        self.axes = jnp.asarray(light.axes, dtype)
        bright = jax.lax.stop_gradient(self.pixels.mean(-1))
        # What may be interpolated at a pixel comes from its neighbours too.
        bright = jnp.maximum(bright, jnp.maximum(jnp.roll(bright, 1, 1), jnp.roll(bright, -1, 1)))
        padded = jnp.pad(bright, ((1, 1), (0, 0)), mode="edge")
        bright = jnp.maximum(bright, jnp.maximum(padded[2:], padded[:-2]))
        height, width = bright.shape
        sine = jnp.asarray(_band(height), dtype)[:, None]
        weight = bright * sine
        total = weight.sum()
        even = jnp.broadcast_to(sine / (sine.sum() * width), weight.shape)
        weight = jnp.where(total > 0.0, weight / jnp.where(total > 0.0, total, 1.0), even)
        weight = (1.0 - _EVEN) * weight + _EVEN * even
        by_row = weight.sum(1)
        rows, columns = jnp.cumsum(by_row), jnp.cumsum(weight / by_row[:, None], axis=1)
        self.rows, self.columns = rows / rows[-1], columns / columns[:, -1:]

    def _local(self, towards: Array) -> tuple[Array, Array, Array]:
        """Place in the map in pixels, from the left and from the top, and the angle's sine."""
        x, y, z = (dot(towards, axis) for axis in self.axes)
        across = jnp.sqrt(jnp.maximum(x * x + y * y, 1e-20))
        pole = (x == 0.0) & (y == 0.0)
        turn = jnp.arctan2(y, jnp.where(pole, 1.0, x)) / (2.0 * math.pi)
        height, width = self.pixels.shape[:2]
        down = jnp.arctan2(across, z) / math.pi
        return jnp.where(turn < 0.0, turn + 1.0, turn) * width, down * height, across

    def radiance(self, towards: Float[Array, "n 3"]) -> Float[Array, "n C"]:
        """Radiance from directions, bilinear between the centres of pixels."""
        height, width = self.pixels.shape[:2]
        right, down, _ = self._local(towards)
        right, down = right - 0.5, down - 0.5
        left, top = jnp.floor(right), jnp.floor(down)
        s, t = (right - left)[:, None], (down - top)[:, None]
        column = left.astype(jnp.int32) % width
        beside = (column + 1) % width
        row = top.astype(jnp.int32)
        upper, lower = jnp.clip(row, 0, height - 1), jnp.clip(row + 1, 0, height - 1)
        above = (1.0 - s) * self.pixels[upper, column] + s * self.pixels[upper, beside]
        below = (1.0 - s) * self.pixels[lower, column] + s * self.pixels[lower, beside]
        return self._own((1.0 - t) * above + t * below)

    def _own(self, values: Array) -> Array:
        if self.matrix is None:
            return jnp.broadcast_to(values, (*values.shape[:-1], self.count))
        return jnp.matmul(values, self.matrix, precision="highest")

    def mean(self) -> Float[Array, " C"]:
        """Mean radiance over the sphere."""
        weight = jnp.asarray(_band(self.pixels.shape[0]), self.pixels.dtype)
        rows = self.pixels.mean(1) * weight[:, None]
        return self._own((rows.sum(0) / weight.sum())[None])[0]

    def density(self, towards: Float[Array, "n 3"]) -> Float[Array, " n"]:
        """Density of `draw` per steradian."""
        height, width = self.pixels.shape[:2]
        right, down, across = self._local(towards)
        row = jnp.clip(down.astype(jnp.int32), 0, height - 1)
        column = jnp.clip(right.astype(jnp.int32), 0, width - 1)
        return self._per_steradian(row, column, across)

    def _per_steradian(self, row: Array, column: Array, sine: Array) -> Array:
        height, width = self.pixels.shape[:2]
        share = _share(self.rows, row)
        before = jnp.where(column > 0, self.columns[row, jnp.maximum(column - 1, 0)], 0.0)
        share = share * (self.columns[row, column] - before)
        return share * (height * width / (2.0 * math.pi**2)) / sine

    def draw(self, u: Float[Array, "n 2"]) -> tuple[Float[Array, "n 3"], Float[Array, " n"]]:
        """Directions, and their density per steradian."""
        height, width = self.pixels.shape[:2]
        row = jnp.minimum(jnp.searchsorted(self.rows, u[:, 0], side="right"), height - 1)
        down = _within(self.rows, row, u[:, 0])
        column = _search(self.columns, row, u[:, 1])
        before = jnp.where(column > 0, self.columns[row, jnp.maximum(column - 1, 0)], 0.0)
        step = self.columns[row, column] - before
        right = jnp.clip((u[:, 1] - before) / jnp.maximum(step, 1e-30), 0.0, 1.0)
        theta = (row.astype(u.dtype) + down) * (math.pi / height)
        sine = jnp.maximum(jnp.sin(theta), 1e-7)
        local = frames.around(sine, (column.astype(u.dtype) + right) / width, jnp.cos(theta))
        towards = jnp.matmul(local, self.axes, precision="highest")
        return towards, self._per_steradian(row, column, sine)


def _band(height: int) -> Float[np.ndarray, " H"]:
    """Solid angle of the rows, up to a factor."""
    edges = np.linspace(0.0, np.pi, height + 1)
    return np.cos(edges[:-1]) - np.cos(edges[1:])


def _share(ends: Array, index: Array) -> Array:
    before = jnp.where(index > 0, ends[jnp.maximum(index - 1, 0)], 0.0)
    return ends[index] - before


def _within(ends: Array, index: Array, u: Array) -> Array:
    before = jnp.where(index > 0, ends[jnp.maximum(index - 1, 0)], 0.0)
    return jnp.clip((u - before) / jnp.maximum(ends[index] - before, 1e-30), 0.0, 1.0)


def _search(ends: Array, row: Array, u: Array) -> Array:
    """First column of each row whose end lies above a number, by halving."""
    width = ends.shape[1]
    low = jnp.zeros_like(row)
    high = jnp.full_like(row, width - 1)
    for _ in range(math.ceil(math.log2(max(width, 2)))):
        middle = (low + high) // 2
        above = ends[row, middle] > u
        low, high = jnp.where(above, low, middle + 1), jnp.where(above, middle, high)
    return jnp.minimum(low, width - 1)
