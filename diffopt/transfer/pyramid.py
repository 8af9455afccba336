"""Environments averaged over lobes of many widths, looked up at the cost of a few texels.

Levels are made for the concentrations 0 (the mean), 1/2, 3/4, 1, 3/2, 2, 3 and so on to 16, then
32, 64 and so on. Between texels a look-up is bilinear, between levels linear in the concentration:
along the axis of a lobe that a small source lies on, radiance is proportional to kappa. (Linear in
log kappa a source would be off by 6 % of it halfway between powers of two.) Of the part of a sky
that varies linearly with the direction, at most 0.9 % is missing between levels, near kappa = 2.5.

The error of bilinear interpolation of a small source is about kappa / 4 times the solid angle of a
texel, so the side of a level goes with sqrt(kappa): one side for all would have to be that of the
sharpest, five times the memory, for a fifth less time of a look-up. Levels lie one after the
other in one array of texels, each with its border. `diffopt.transfer.prefiltering` makes them.
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.errors import InputError
from diffopt.kernels import octahedral
from diffopt.kernels.frames import dot

# Up to 2 to this power there are two levels to an octave.
_FINE = 4


@dataclasses.dataclass(frozen=True)
class PyramidSettings:
    """How finely an environment is averaged over lobes.

    Attributes
    ----------
    size
        Texels on a side of the sharpest level; broader ones have fewer, down to a quarter. Of a
        source much smaller than the lobe the error is 20 sharpest / size^2 of the largest radiance
        at most, and a tenth of it in the mean; of a smooth sky, 0.9 % at 256, on the folds of the
        octahedron, and 0.07 % in the mean. Time and memory of preparing grow with size^2; that of
        a look-up hardly does while the texels fit the cache (2.2 MB at 256, in three channels).
    sharpest
        Largest concentration, a power of two, 1 to 2^14; sharper lobes are averaged with it. A
        map of H rows has levels up to (H / pi)^2 at most, where a lobe is as narrow as a pixel.
    """

    size: int = 256
    sharpest: float = 1024.0

    def __post_init__(self) -> None:
        """Check the values."""
        if isinstance(self.size, bool) or not isinstance(self.size, int) or self.size < 8:
            raise InputError(f"size must be an integer >= 8; received {self.size!r}")
        if not 1.0 <= self.sharpest <= 2.0**14 or not math.log2(self.sharpest).is_integer():
            raise InputError(
                f"sharpest must be a power of two from 1 to 2^14; received {self.sharpest!r}"
            )

    def levels(self, most: float = math.inf) -> tuple[tuple[float, ...], tuple[int, ...]]:
        """Concentrations of the levels, up to one, and texels on a side of each."""
        sharpest = 2.0 ** math.floor(math.log2(max(min(self.sharpest, most), 1.0)))
        octaves = 2.0 ** np.arange(_FINE, 15)
        fine = np.outer(2.0 ** np.arange(-1, _FINE), [1.0, 1.5]).ravel()
        kappa = np.concatenate([[0.0], fine, octaves])
        kappa = kappa[kappa <= sharpest]
        sides = np.ceil(self.size * np.sqrt(kappa / self.sharpest)).astype(int)
        sides = np.maximum(sides, -(-self.size // 4))
        return tuple(kappa.tolist()), tuple(sides.tolist())


class Pyramid(eqx.Module):
    """An environment averaged over lobes, in tables.

    Attributes
    ----------
    texels
        Levels one after the other, each [side + 2, side + 2], in the scene's channels, [T, C].
    frame
        From the world to the frame of the tables, [3, 3].
    kappas
        Concentrations of the levels.
    sides
        Texels on a side of every level.
    """

    texels: Float[Array, "T C"]
    frame: Float[Array, "3 3"]
    kappas: tuple[float, ...] = eqx.field(static=True)
    sides: tuple[int, ...] = eqx.field(static=True)

    def radiance(
        self, mu: Float[Array, "*batch 3"], kappa: Float[Array, "*batch"]
    ) -> Float[Array, "*batch C"]:
        """Radiance averaged over lobes.

        Parameters
        ----------
        mu
            Axes in the world, unit vectors.
        kappa
            Concentrations, >= 0; above that of the sharpest level it is that level's.
        """
        u, v = octahedral.encode(*(dot(mu, axis) for axis in self.frame))
        below, between = self._level(kappa)
        weight = between[..., None]
        return (1.0 - weight) * self._bilinear(below, u, v) + weight * self._bilinear(
            below + 1, u, v
        )

    def _level(self, kappa: Array) -> tuple[Array, Array]:
        """The level below a concentration, and the share of the one above."""
        kappa = jnp.clip(kappa, 0.0, self.kappas[-1])
        # Twice the exponent of the number as it is stored, plus its first binary digit: at 1, 3/2,
        # 2, 3 begin halves 0, 1, 2, 3. Next to the end of one float64 may round up, to a share of
        # -1e-8.
        bits = jax.lax.bitcast_convert_type(kappa.astype(jnp.float32), jnp.int32)
        half = (bits >> 22) - 2 * 127
        fine = 2 * _FINE
        level = jnp.where(half < fine, half + 3, ((half - fine) >> 1) + fine + 3)
        level = jnp.clip(level, 0, len(self.kappas) - 2)
        # Where a level begins is the number without its other digits: cheaper than from a table.
        begin = jnp.where(half < fine, (bits >> 22) << 22, (bits >> 23) << 23)
        power = jax.lax.bitcast_convert_type((bits >> 23) << 23, jnp.float32)
        width = jnp.where(half < fine, 0.5 * power, power)
        first, last = half < -2, level == len(self.kappas) - 2
        lower = jnp.where(first, 0.0, jax.lax.bitcast_convert_type(begin, jnp.float32))
        lower = jnp.where(last, self.kappas[-2], lower).astype(kappa.dtype)
        width = jnp.where(first, self.kappas[1], width)
        width = jnp.where(last, self.kappas[-1] - self.kappas[-2], width).astype(kappa.dtype)
        return level, (kappa - lower) / width

    def _bilinear(self, level: Int[Array, "*batch"], u: Array, v: Array) -> Array:
        sides = np.asarray(self.sides, np.int32)
        starts = np.concatenate([[0], np.cumsum((sides[:-1] + 2) ** 2)]).astype(np.int32)
        side, start = _at(jnp.asarray(sides), level), _at(jnp.asarray(starts), level)
        half = 0.5 * side.astype(u.dtype)
        right, down = (u + 1.0) * half + 0.5, (v + 1.0) * half + 0.5
        # Also what is not a number must stay within the table.
        column = jnp.clip(right.astype(jnp.int32), 0, side)
        row = jnp.clip(down.astype(jnp.int32), 0, side)
        s = (right - column.astype(u.dtype))[..., None]
        t = (down - row.astype(u.dtype))[..., None]
        step = side + 2
        first = start + row * step + column
        texels = self.texels
        above = (1.0 - s) * _at(texels, first) + s * _at(texels, first + 1)
        under = (1.0 - s) * _at(texels, first + step) + s * _at(texels, first + step + 1)
        return (1.0 - t) * above + t * under

    def turned(self, rotation: Float[Array, "3 3"]) -> "Pyramid":
        """The light turned in the world by a rotation matrix."""
        frame = jnp.matmul(self.frame, rotation.T, precision="highest")
        return Pyramid(self.texels, frame, self.kappas, self.sides)

    def scaled(self, factor: Any) -> "Pyramid":
        """The light times a factor."""
        factor = jnp.asarray(factor).astype(self.texels.dtype)
        return Pyramid(self.texels * factor, self.frame, self.kappas, self.sides)


def _at(table: Array, index: Array) -> Array:
    """Rows of a table at places known to be inside: checks would cost more than the reading."""
    return table.at[index].get(mode="promise_in_bounds")
