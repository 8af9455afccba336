"""Two gratings added: lattices of pits, bumps, pyramids and waves."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.gratings.base import Components, Reach, Surface, lines
from diffopt.gratings.profiles import Grating, nearby

# Sine of the least angle between the two directions.
_LEAST = 1e-3


class Crossed(Surface):
    """h = h1 + h2 of two gratings at an angle; order (m, n) has c_m c_n of the two.

    Parameters
    ----------
    first, second
        Gratings whose directions differ.

    Raises
    ------
    InputError
        If they run in one direction.
    """

    first: Grating
    second: Grating

    def __init__(self, first: Grating, second: Grating):
        self.first, self.second = first, second
        angles = [checks.concrete(g.angle) for g in (first, second)]
        if all(a is not None and a.ndim == 0 for a in angles):
            apart = abs(float(jnp.sin(first.angle - second.angle)))
            if apart < _LEAST:
                raise InputError(
                    f"Crossed: gratings must differ in angle; received {float(first.angle):g} and "
                    f"{float(second.angle):g} rad"
                )

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """Sum of both; see `Surface.heights`."""
        first = self.first.sampled(y, x, pixel, edges, key)
        return first + self.second.sampled(y, x, pixel, edges, key)

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Lines at the orders (m, n) nearest to a frequency; see `Surface.components`."""
        pair = (self.first, self.second)
        (ax, ay), (bx, by) = (
            (jnp.cos(g.angle) / g.period, jnp.sin(g.angle) / g.period) for g in pair
        )
        determinant = ax * by - ay * bx
        m = nearby((bx * fy - by * fx) / determinant, reach.each_side)
        n = nearby((ay * fx - ax * fy) / determinant, reach.each_side)
        weight = (
            self.first.order_powers(m, kappa, reach)[:, None]
            * self.second.order_powers(n, kappa, reach)[None]
        )
        m, n = m.astype(fx.dtype)[:, None], n.astype(fx.dtype)[None]
        x, y = fx[None, None] + m * ax + n * bx, fy[None, None] + m * ay + n * by
        return lines(*(part.reshape(-1, *fx.shape) for part in (weight, x, y)))
