"""Gratings without perfect order: domains that differ, and ridges that wander."""

from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.gratings.base import Components, Reach, Surface
from diffopt.gratings.crossed import Crossed
from diffopt.gratings.parametric import parameters
from diffopt.gratings.profiles import Grating
from diffopt.gratings.series import displaced
from diffopt.random_fields import gaussian_field


class Jittered(Surface):
    """Domains of one grating whose line frequency and angle scatter from one to the next.

    The mean of |P|^2 over domains much larger than the coherence window: an order at the
    frequency F is a Gaussian about it, of standard deviation |F| period_spread along F and
    |F| angle_spread across.

    Parameters
    ----------
    grating
        The mean.
    period_spread
        Relative standard deviation of the frequency of lines, 0 or more.
    angle_spread
        Standard deviation of the direction, radians, 0 or more.
    """

    PARAMETERS: ClassVar = {"period_spread": "spread", "angle_spread": "spread"}
    RANDOM: ClassVar = True

    grating: Grating | Crossed
    period_spread: Float[Array, ""]
    angle_spread: Float[Array, ""]

    def __init__(
        self, grating: Grating | Crossed, period_spread: Any = 0.0, angle_spread: Any = 0.0
    ):
        self.grating = grating
        given = {"period_spread": period_spread, "angle_spread": angle_spread}
        self.period_spread, self.angle_spread = (
            value.astype(grating.dtype) for value in parameters(given, Jittered)
        )

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """One domain, drawn by the key; see `Surface.heights`."""
        draw = jax.random.normal(key, (2,), self.dtype)
        stretch, turn = 1.0 + self.period_spread * draw[0], self.angle_spread * draw[1]
        gratings = [""] if isinstance(self.grating, Grating) else ["first.", "second."]
        drawn = self.grating.replaced(
            {f"{g}period": self.grating.get(f"{g}period") / stretch for g in gratings}
            | {f"{g}angle": self.grating.get(f"{g}angle") + turn for g in gratings}
        )
        return drawn.sampled(y, x, pixel, edges, None)

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Gaussians at the orders nearest to a frequency; see `Surface.components`."""
        found = self.grating.components(fx, fy, kappa, reach)
        x, y = fx[None] - found.x, fy[None] - found.y
        along, across = self.period_spread**2, self.angle_spread**2
        return Components(
            found.weight,
            found.x,
            found.y,
            along * x**2 + across * y**2,
            (along - across) * x * y,
            along * y**2 + across * x**2,
            found.density,
        )


class Ridges(Surface):
    """A grating whose lines wander: quasi-periodic ridges, as on a snake's scales.

    h(x, y) = profile(x cos + y sin + d(x, y)) with d a Gaussian field of standard deviation
    ``displacement`` and correlation exp(-r^2 / correlation_length^2). The displacement multiplies
    order m by exp(2 pi i m d / period), a phase of variance g = (2 pi m displacement / period)^2,
    so that each order is spread as a Gaussian rough surface spreads its mirror peak
    (Beckmann and Spizzichino 1963, section 5.3).

    Parameters
    ----------
    grating
        Without the disorder.
    displacement
        Micrometres, above 0.
    correlation_length
        Micrometres, above 0.
    """

    PARAMETERS: ClassVar = {"displacement": "length", "correlation_length": "length"}
    RANDOM: ClassVar = True

    grating: Grating
    displacement: Float[Array, ""]
    correlation_length: Float[Array, ""]

    def __init__(self, grating: Grating, displacement: Any, correlation_length: Any):
        self.grating = grating
        given = {"displacement": displacement, "correlation_length": correlation_length}
        self.displacement, self.correlation_length = (
            value.astype(grating.dtype) for value in parameters(given, Ridges)
        )

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """One surface, drawn by the key; see `Surface.heights`."""
        field = gaussian_field(key, (y.size, x.size), pixel, self.correlation_length)
        across = self.grating.across(y, x) + self.displacement * field.astype(x.dtype)
        return self.grating.at(across, pixel, edges)

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Lines and lobes at the orders nearest to a frequency; see `Surface.components`."""
        found = self.grating.components(fx, fy, kappa, reach)
        # 2 pi |m| / period is the length of an order's wave vector.
        wave2 = (2.0 * jnp.pi) ** 2 * ((fx[None] - found.x) ** 2 + (fy[None] - found.y) ** 2)
        return displaced(found, wave2 * self.displacement**2, self.correlation_length, reach.terms)
