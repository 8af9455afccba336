"""Gratings with flat tops and sloping walls."""

from typing import Any, ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float, Int

from diffopt.gratings.parametric import parameters
from diffopt.gratings.profiles import Grating, frac, polar


class Trapezoid(Grating):
    """Ridges of height depth with two walls of one slope; a wall of 0 makes a `Binary`.

    A profile of straight pieces: each adds width * sinc(turns) to c_m, with turns the phase
    that kappa h - 2 pi m x / period gains along it over 2 pi.

    Parameters
    ----------
    period
        Micrometres, above 0.
    depth
        Height of the ridges in micrometres; negative for grooves.
    duty
        Width of the ridge at half its height over the period, 0 to 1.
    wall
        Width of one wall over the largest that fits, the narrower of ridge and groove at half
        height: 0 for steps, 1 for a ridge or groove that comes to a point.
    shift
        Position of the middle of the rising wall, in periods.
    angle
        Direction across the lines, radians from x towards y.
    offset
        Height between the ridges, micrometres.
    """

    PARAMETERS: ClassVar = {
        "period": "length",
        "depth": "height",
        "duty": "share",
        "wall": "share",
        "shift": "turns",
        "angle": "angle",
        "offset": "height",
    }

    period: Float[Array, ""]
    depth: Float[Array, ""]
    duty: Float[Array, ""]
    wall: Float[Array, ""]
    shift: Float[Array, ""]
    angle: Float[Array, ""]
    offset: Float[Array, ""]

    def __init__(
        self,
        period: Any,
        depth: Any,
        duty: Any = 0.5,
        wall: Any = 0.2,
        shift: Any = 0.0,
        angle: Any = 0.0,
        offset: Any = 0.0,
    ):
        given = (period, depth, duty, wall, shift, angle, offset)
        values = parameters(dict(zip(self.PARAMETERS, given, strict=True)), Trapezoid)
        self.period, self.depth, self.duty, self.wall, self.shift, self.angle, self.offset = values

    @property
    def wall_width(self) -> Float[Array, ""]:
        """Width of one wall seen from above, micrometres."""
        return self._wall * self.period

    @property
    def _wall(self) -> Float[Array, ""]:
        return self.wall * jnp.minimum(self.duty, 1.0 - self.duty)

    def _from_middle(self, x: Array) -> tuple[Array, Array]:
        """Whole periods, and the distance to the middle of the ridge in periods."""
        t = x / self.period - self.shift - 0.5 * self.duty + 0.5
        return jnp.floor(t), frac(t) - 0.5

    def profile(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Height at x across the lines, both in micrometres, without the offset."""
        _, off = self._from_middle(x)
        wall = jnp.maximum(self._wall, jnp.finfo(off.dtype).tiny * 1e3)
        return self.depth * jnp.clip((0.5 * self.duty - jnp.abs(off)) / wall + 0.5, 0.0, 1.0)

    def integral(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Antiderivative of the profile at x, in um^2."""
        whole, off = self._from_middle(x)
        wall = jnp.maximum(self._wall, jnp.finfo(off.dtype).eps)
        top, reach = 0.5 * (self.duty - wall), jnp.abs(off)
        down = jnp.clip(reach - top, 0.0, wall)
        part = jnp.minimum(reach, top) + down * (1.0 - 0.5 * down / wall)
        return self.depth * self.period * (whole * self.duty + jnp.sign(off) * part)

    def order_amplitude(
        self, order: int | Int[Array, "..."], kappa: Float[Array, "..."]
    ) -> Complex[Array, "..."]:
        """Complex amplitude c_m; see `Grating.order_amplitude`."""
        m = jnp.asarray(order, kappa.dtype)
        low = 1.0 - self.duty - self._wall
        # The groove lies about the ridge's other side, half a period on.
        groove = polar(low * jnp.sinc(m * low), -jnp.pi * m)
        middle = -2.0 * jnp.pi * m * (self.shift + 0.5 * self.duty)
        return (self.ridge(m, kappa) + groove) * polar(jnp.ones_like(middle), middle)

    def ridge(self, m: Float[Array, "..."], kappa: Float[Array, "..."]) -> Complex[Array, "..."]:
        """The part of c_m that ridge and walls make, about the middle of the ridge; any real m."""
        turns = kappa * self.depth / (2.0 * jnp.pi)
        half, side, flat = 0.5 * kappa * self.depth, jnp.pi * m * self.duty, self.duty - self._wall
        top = polar(flat * jnp.sinc(m * flat), 2.0 * half)
        rising = polar(self._wall * jnp.sinc(turns - m * self._wall), half + side)
        falling = polar(self._wall * jnp.sinc(turns + m * self._wall), half - side)
        return top + rising + falling
