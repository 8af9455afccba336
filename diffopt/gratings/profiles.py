"""Gratings with closed-form orders: sinusoidal, blazed and binary.

Profiles vary along the direction ``angle`` (from x towards y) and repeat with ``period``. With
u = -(sin(theta_i) + sin(theta_o)) the orders lie at u = -m wavelength / period, and their
complex amplitudes are

    c_m = (1 / period) * integral over one period of exp(i kappa h(x) - 2 pi i m x / period) dx,

with kappa = 2 pi w / wavelength and w = -(cos(theta_i) + cos(theta_o)) of that order: the
scalar (Kirchhoff) amplitudes, before reflectance and the geometric factor. All three follow
from the integral; the sinusoid's is Jacobi-Anger's expansion (Goodman, Introduction to
Fourier Optics, 3rd edition, section 4.4.4), the others are sinc functions.

Derivatives: the order amplitudes are differentiable in every parameter. So are the sampled
heights of the sinusoid. The jumps of the blazed and binary profiles have no derivative on a
grid: with ``edges="sharp"`` their heights have the right derivative in depth only, and those in
period, shift, duty and angle miss the moving jump. With ``edges="averaged"`` each sample is the
mean over its pixel, and all derivatives are there.
"""

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from diffopt.gratings.base import Components, Reach, Surface, lines
from diffopt.gratings.parametric import parameters
from diffopt.kernels import bessel

# Nodes of the quadrature for J_m; the error is the sum of J_(m +- 512 k)(z), k > 0,
# where |m| + |z| is below _BESSEL_REACH at most J_512(400) = 3e-26.
_BESSEL_NODES = 512
_BESSEL_REACH = 400.0


def bessel_j(order: int | Int[Array, "..."], z: Float[Array, "..."]) -> Float[Array, "..."]:
    """Bessel function J_m(z) of integer order, for abs(m) + abs(z) below 400.

    The mean of cos(z sin t - m t) over equally spaced t (Bessel's integral, DLMF 10.9.2, by the
    trapezoid rule, which converges faster than any power on periodic functions). Absolute
    error a few rounding units; differentiable in z to all orders.

    Parameters
    ----------
    order
        m, an integer or an array of the shape of ``z``.
    z
        Argument.

    Raises
    ------
    RuntimeError
        At run time, if an argument lies beyond that range.
    """
    m = jnp.asarray(order, z.dtype)
    z = eqx.error_if(
        z,
        jnp.abs(m) + jnp.abs(z) >= _BESSEL_REACH,
        f"bessel_j: |m| + |z| reaches {_BESSEL_REACH:g}, beyond which the quadrature fails",
    )
    m, z = jnp.broadcast_arrays(m, z)
    t = jnp.asarray(2 * np.pi * np.arange(_BESSEL_NODES) / _BESSEL_NODES, z.dtype)
    t = t.reshape((1,) * z.ndim + (_BESSEL_NODES,))
    return jnp.mean(jnp.cos(z[..., None] * jnp.sin(t) - m[..., None] * t), axis=-1)


class Grating(Surface):
    """What the gratings share: a profile along one direction, and orders."""

    period: eqx.AbstractVar[Float[Array, ""]]
    angle: eqx.AbstractVar[Float[Array, ""]]
    offset: eqx.AbstractVar[Float[Array, ""]]

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """Heights of the profile; see `Surface.heights`."""
        del key
        return self.at(self.across(y, x), pixel, edges)

    def across(self, y: Float[Array, " ny"], x: Float[Array, " nx"]) -> Float[Array, "ny nx"]:
        """Positions across the lines of rows and columns, micrometres."""
        return jnp.cos(self.angle) * x[None, :] + jnp.sin(self.angle) * y[:, None]

    def at(
        self, across: Float[Array, "..."], pixel: tuple[float, float], edges: str
    ) -> Float[Array, "..."]:
        """Height at positions across the lines; `pixel` and `edges` as in `heights`."""
        if edges == "sharp":
            return self.profile(across) + self.offset
        (dy, dx), cos, sin = pixel, jnp.cos(self.angle), jnp.sin(self.angle)
        half = 0.5 * jnp.sqrt((cos * dx) ** 2 + (sin * dy) ** 2)
        mean = (self.integral(across + half) - self.integral(across - half)) / (2.0 * half)
        return mean + self.offset

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Lines at the orders nearest to a frequency; see `Surface.components`."""
        cos, sin = jnp.cos(self.angle), jnp.sin(self.angle)
        order = nearby(-(fx * cos + fy * sin) * self.period, reach.each_side)
        along = order.astype(fx.dtype) / self.period
        weight = self.order_powers(order, kappa, reach)
        return lines(weight, fx[None] + along * cos, fy[None] + along * sin)

    def order_powers(
        self, order: Int[Array, " K *batch"], kappa: Float[Array, "*batch"], reach: Reach
    ) -> Float[Array, " K *batch"]:
        """`order_efficiency` of several orders at each kappa."""
        del reach
        return self.order_efficiency(order, jnp.broadcast_to(kappa[None], order.shape))

    def order_efficiency(
        self, order: int | Int[Array, "..."], kappa: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """Squared modulus of `order_amplitude`: 1 in all orders together at one kappa."""
        amplitude = self.order_amplitude(order, kappa)
        return amplitude.real**2 + amplitude.imag**2

    @abc.abstractmethod
    def profile(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Height at x across the lines, both in micrometres, without the offset."""

    @abc.abstractmethod
    def integral(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Antiderivative of the profile at x, in um^2."""

    @abc.abstractmethod
    def order_amplitude(
        self, order: int | Int[Array, "..."], kappa: Float[Array, "..."]
    ) -> Complex[Array, "..."]:
        """Complex amplitude c_m of order m, without the phase of the offset.

        Parameters
        ----------
        order
            m, an integer or an array of the shape of ``kappa``.
        kappa
            2 pi w / wavelength of that order, in 1/um; negative for reflection.
        """


def nearby(place: Float[Array, "*batch"], each_side: int) -> Int[Array, " K *batch"]:
    """The whole numbers around `place`, `each_side` on either side of the nearest."""
    nearest = jnp.round(jax.lax.stop_gradient(place)).astype(jnp.int32)
    steps = jnp.arange(-each_side, each_side + 1, dtype=jnp.int32)
    return nearest[None] + steps.reshape((-1,) + (1,) * place.ndim)


class Sinusoidal(Grating):
    """h(x) = amplitude cos(2 pi x / period + phase); c_m = i^m J_m(kappa amplitude) e^(i m phase).

    Parameters
    ----------
    period
        Micrometres, above 0.
    amplitude
        Micrometres; half of peak-to-valley.
    phase
        Radians.
    angle
        Direction across the lines, radians from x towards y.
    offset
        Mean height, micrometres.
    """

    PARAMETERS: ClassVar = {
        "period": "length",
        "amplitude": "height",
        "phase": "phase",
        "angle": "angle",
        "offset": "height",
    }

    period: Float[Array, ""]
    amplitude: Float[Array, ""]
    phase: Float[Array, ""]
    angle: Float[Array, ""]
    offset: Float[Array, ""]

    def __init__(
        self, period: Any, amplitude: Any, phase: Any = 0.0, angle: Any = 0.0, offset: Any = 0.0
    ):
        given = (period, amplitude, phase, angle, offset)
        self.period, self.amplitude, self.phase, self.angle, self.offset = parameters(
            dict(zip(self.PARAMETERS, given, strict=True)), Sinusoidal
        )

    def order_powers(
        self, order: Int[Array, " K *batch"], kappa: Float[Array, "*batch"], reach: Reach
    ) -> Float[Array, " K *batch"]:
        """J_m^2 of several orders, from one sequence for each kappa."""
        nodes = bessel.sequence_nodes(reach.highest, reach.phase)
        values = bessel.bessel_sequence(kappa * self.amplitude, reach.highest, nodes=nodes)
        return bessel.signed(values, order) ** 2

    def profile(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Height at x, both in micrometres."""
        return self.amplitude * jnp.cos(2 * jnp.pi * x / self.period + self.phase)

    def integral(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Antiderivative of the profile at x, in um^2."""
        scale = self.amplitude * self.period / (2 * jnp.pi)
        return scale * jnp.sin(2 * jnp.pi * x / self.period + self.phase)

    def order_amplitude(
        self, order: int | Int[Array, "..."], kappa: Float[Array, "..."]
    ) -> Complex[Array, "..."]:
        """Complex amplitude c_m; see `Grating.order_amplitude` and `bessel_j` for its range."""
        turn = jnp.asarray(order, kappa.dtype) * (self.phase + jnp.pi / 2)
        return polar(bessel_j(order, kappa * self.amplitude), turn)


class Blazed(Grating):
    """h(x) = depth frac(x / period - shift): teeth that rise along +x and fall in a jump.

    c_m = sinc(q) e^(i pi q - 2 pi i m shift), q = kappa depth / (2 pi) - m, sinc normalised.

    Parameters
    ----------
    period
        Micrometres, above 0.
    depth
        Micrometres; negative for teeth that fall along +x.
    shift
        Position of a jump, in periods.
    angle
        Direction across the lines, radians from x towards y.
    offset
        Height of the feet of the teeth, micrometres.
    """

    SYMMETRIC: ClassVar = False
    PARAMETERS: ClassVar = {
        "period": "length",
        "depth": "height",
        "shift": "turns",
        "angle": "angle",
        "offset": "height",
    }

    period: Float[Array, ""]
    depth: Float[Array, ""]
    shift: Float[Array, ""]
    angle: Float[Array, ""]
    offset: Float[Array, ""]

    def __init__(
        self, period: Any, depth: Any, shift: Any = 0.0, angle: Any = 0.0, offset: Any = 0.0
    ):
        given = (period, depth, shift, angle, offset)
        self.period, self.depth, self.shift, self.angle, self.offset = parameters(
            dict(zip(self.PARAMETERS, given, strict=True)), Blazed
        )

    def profile(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Height at x, both in micrometres."""
        return self.depth * frac(x / self.period - self.shift)

    def integral(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Antiderivative of the profile at x, in um^2."""
        t = x / self.period - self.shift
        whole, part = jnp.floor(t), frac(t)
        return self.depth * self.period * 0.5 * (whole + part**2)

    def order_amplitude(
        self, order: int | Int[Array, "..."], kappa: Float[Array, "..."]
    ) -> Complex[Array, "..."]:
        """Complex amplitude c_m; see `Grating.order_amplitude`."""
        m = jnp.asarray(order, kappa.dtype)
        q = kappa * self.depth / (2 * jnp.pi) - m
        return polar(jnp.sinc(q), jnp.pi * q - 2 * jnp.pi * m * self.shift)


class Binary(Grating):
    """h(x) = depth on ridges of width duty * period, else 0; a ridge starts at shift * period.

    c_m = delta_m0 + (e^(i kappa depth) - 1) duty sinc(m duty) e^(-i pi m (duty + 2 shift)).

    Parameters
    ----------
    period
        Micrometres, above 0.
    depth
        Height of the ridges in micrometres; negative for grooves.
    duty
        Share of the period that is ridge, 0 to 1.
    shift
        Position of the rising edge, in periods.
    angle
        Direction across the lines, radians from x towards y.
    offset
        Height between the ridges, micrometres.
    """

    PARAMETERS: ClassVar = {
        "period": "length",
        "depth": "height",
        "duty": "share",
        "shift": "turns",
        "angle": "angle",
        "offset": "height",
    }

    period: Float[Array, ""]
    depth: Float[Array, ""]
    duty: Float[Array, ""]
    shift: Float[Array, ""]
    angle: Float[Array, ""]
    offset: Float[Array, ""]

    def __init__(
        self,
        period: Any,
        depth: Any,
        duty: Any = 0.5,
        shift: Any = 0.0,
        angle: Any = 0.0,
        offset: Any = 0.0,
    ):
        given = (period, depth, duty, shift, angle, offset)
        self.period, self.depth, self.duty, self.shift, self.angle, self.offset = parameters(
            dict(zip(self.PARAMETERS, given, strict=True)), Binary
        )

    def profile(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Height at x, both in micrometres."""
        ridge = frac(x / self.period - self.shift) < self.duty
        return jnp.where(ridge, self.depth, jnp.zeros_like(self.depth))

    def integral(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Antiderivative of the profile at x, in um^2."""
        t = x / self.period - self.shift
        whole, part = jnp.floor(t), frac(t)
        return self.depth * self.period * (whole * self.duty + jnp.minimum(part, self.duty))

    def order_amplitude(
        self, order: int | Int[Array, "..."], kappa: Float[Array, "..."]
    ) -> Complex[Array, "..."]:
        """Complex amplitude c_m; see `Grating.order_amplitude`."""
        m = jnp.asarray(order, kappa.dtype)
        ridge = polar(
            self.duty * jnp.sinc(m * self.duty), -jnp.pi * m * (self.duty + 2 * self.shift)
        )
        step = polar(jnp.ones_like(kappa), kappa * self.depth) - 1
        return (m == 0).astype(step.dtype) + step * ridge


def polar(radius: Float[Array, "..."], angle: Float[Array, "..."]) -> Complex[Array, "..."]:
    """Return radius e^(i angle), from real parts: no type is mixed with another."""
    radius, angle = jnp.broadcast_arrays(radius, angle)
    return jax.lax.complex(radius * jnp.cos(angle), radius * jnp.sin(angle))


def frac(t: Float[Array, "..."]) -> Float[Array, "..."]:
    """Fractional part, from the floor; the derivative is 1 everywhere."""
    return t - jnp.floor(t)
