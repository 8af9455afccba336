"""The tracks of a compact disc: lines across them, and the random pits along them."""

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import discs
from diffopt.gratings.base import Components, Reach, Surface, lines
from diffopt.gratings.parametric import parameters
from diffopt.gratings.profiles import nearby
from diffopt.gratings.trapezoid import Trapezoid

_RUNS = np.arange(discs.SHORTEST_RUN, discs.LONGEST_RUN + 1)
# Probability of a run of n bits in the code of greatest entropy; half the track is pit.
_SHARES = discs.growth() ** -_RUNS.astype(float)
_SHARES /= _SHARES.sum()
#: Channel bit at the least velocity, micrometres.
BIT = discs.VELOCITIES[0] / discs.CHANNEL_BIT_RATE


class CompactDisc(Surface):
    """Pits of random lengths on parallel tracks.

    Along its middle a track is pit and land by turns, of 3 to 11 channel bits with the shares of
    the code of greatest entropy (see `diffopt.discs`); tracks are independent of each other. The
    mean of exp(i kappa h) along the tracks is a grating of lines: c_m = (delta_m0 + t_m) / 2 with
    t_m those of a groove without ends. What is left is a continuum across the tracks' direction,

        |G(f_across)|^2 S(f_along) / pitch,

    G the transform of one pit's cross-section less the land, S the spectral density of a random
    sequence of two levels 0 and 1 (an alternating renewal process),

        S = Re((1 - phi) / (1 + phi)) / (mean run (2 pi f)^2),

    phi the characteristic function of the runs (Cox, Renewal Theory, 1962, chapter 7; the
    spectrum of impulses of alternating sign at the edges, over the square of the frequency). The
    rounded ends of pits are left out of the spectrum; heights have them.

    Parameters
    ----------
    pitch
        Distance of tracks, micrometres.
    depth
        Depth of the pits, micrometres; negative for bumps.
    width
        Of a pit at half its depth, over the pitch, 0 to 1/2.
    wall
        Width of a pit's wall over the pit's width, 0 to 1.
    bit
        Length of a channel bit, micrometres: velocity over 4.3218 MHz.
    shift
        Middle of a track, in pitches.
    angle
        Direction across the tracks, radians from x towards y.
    offset
        Height of the land, micrometres.
    """

    PARAMETERS: ClassVar = {
        "pitch": "length",
        "depth": "height",
        "width": "share",
        "wall": "share",
        "bit": "length",
        "shift": "turns",
        "angle": "angle",
        "offset": "height",
    }
    RANDOM: ClassVar = True

    pitch: Float[Array, ""]
    depth: Float[Array, ""]
    width: Float[Array, ""]
    wall: Float[Array, ""]
    bit: Float[Array, ""]
    shift: Float[Array, ""]
    angle: Float[Array, ""]
    offset: Float[Array, ""]

    def __init__(
        self,
        pitch: Any = discs.TRACK_PITCH,
        depth: Any = 0.115,
        width: Any = 0.3,
        wall: Any = 0.2,
        bit: Any = BIT,
        shift: Any = 0.0,
        angle: Any = 0.0,
        offset: Any = 0.0,
    ):
        given = (pitch, depth, width, wall, bit, shift, angle, offset)
        values = parameters(dict(zip(self.PARAMETERS, given, strict=True)), CompactDisc)
        self.pitch, self.depth, self.width, self.wall, self.bit = values[:5]
        self.shift, self.angle, self.offset = values[5:]

    @property
    def groove(self) -> Trapezoid:
        """A track that is pit all along; the land at height 0."""
        shift = self.shift - 0.5 * self.width
        return Trapezoid(self.pitch, -self.depth, self.width, self.wall, shift, self.angle)

    def components(
        self,
        fx: Float[Array, "*batch"],
        fy: Float[Array, "*batch"],
        kappa: Float[Array, "*batch"],
        reach: Reach,
    ) -> Components:
        """Lines of the tracks and the continuum of the pits; see `Surface.components`."""
        groove = self.groove
        cos, sin = jnp.cos(self.angle), jnp.sin(self.angle)
        across, along = fx * cos + fy * sin, fy * cos - fx * sin
        order = nearby(-across * self.pitch, reach.each_side)
        amplitude = groove.order_amplitude(order, jnp.broadcast_to(kappa[None], order.shape))
        mirror = (order == 0).astype(kappa.dtype)
        weight = 0.25 * ((amplitude.real + mirror) ** 2 + amplitude.imag**2)
        line = order.astype(fx.dtype) / self.pitch
        pit, support = groove.ridge(-across * self.pitch, kappa), self.width * (1.0 + self.wall)
        pit2 = (pit.real - support * jnp.sinc(across * self.pitch * support)) ** 2 + pit.imag**2
        found = lines(weight, fx[None] + line * cos, fy[None] + line * sin)
        return dataclasses.replace(found, density=self.pitch * pit2 * self._sequence(along))

    def _sequence(self, frequency: Array) -> Array:
        """Spectral density of pit and land along a track, micrometres."""
        # Below this many turns a bit both sides of the quotient vanish as their square.
        turns = frequency * self.bit
        turns = jnp.where(jnp.abs(turns) < 1e-3, 1e-3, turns)
        angle = 2.0 * math.pi * turns
        # Plain numbers take the type of what they multiply.
        runs = [(float(run), float(share)) for run, share in zip(_RUNS, _SHARES, strict=True)]
        re = sum(share * jnp.cos(run * angle) for run, share in runs)
        im = sum(share * jnp.sin(run * angle) for run, share in runs)
        # Re((1 - phi) / (1 + phi)) = (1 - |phi|^2) / |1 + phi|^2.
        part = (1.0 - re**2 - im**2) / ((1.0 + re) ** 2 + im**2)
        mean = float((_RUNS * _SHARES).sum())
        return part * self.bit / (mean * (2.0 * math.pi * turns) ** 2)

    def sampled(
        self,
        y: Float[Array, " ny"],
        x: Float[Array, " nx"],
        pixel: tuple[float, float],
        edges: str,
        key: Any,
    ) -> Float[Array, "ny nx"]:
        """One disc, drawn by the key; made on the host, without derivatives.

        Pits end in half circles. For a disc that repeats with the patch see
        `diffopt.samples.compact_disc`.
        """
        del edges, pixel
        rows, columns = np.asarray(y, np.float64)[:, None], np.asarray(x, np.float64)[None, :]
        cos, sin = math.cos(float(self.angle)), math.sin(float(self.angle))
        pitch, bit, width = float(self.pitch), float(self.bit), float(self.width)
        place = (columns * cos + rows * sin) / pitch - float(self.shift)
        track = np.rint(place).astype(int)
        across, along = (place - track) * pitch, (rows * cos - columns * sin) / bit
        number, low = np.arange(track.min(), track.max() + 1), along.min() - 2 * _RUNS[-1]
        count = 2 * math.ceil((along.max() - low) / (2 * _RUNS[0]) + 2)
        seed = jax.random.bits(key, (2,))
        rng = np.random.default_rng([int(part) for part in seed])
        runs = rng.choice(_RUNS, size=(len(number), count), p=_SHARES)
        edge = low + rng.uniform(0, _RUNS[-1], (len(number), 1)) + np.cumsum(runs, axis=1)
        wall = max(width * float(self.wall), 1e-12) * pitch
        depth = np.zeros(track.shape)
        for row, this in zip(edge, number, strict=True):
            own = track == this
            # Pits lie between edges 2 k and 2 k + 1; the nearest middle is that of its pit.
            start, end = row[0::2], row[1::2]
            middle = 0.5 * (start + end)
            nearest = np.searchsorted(0.5 * (middle[1:] + middle[:-1]), along[own])
            around = _distance(along[own], across[own], start, end, nearest, bit, width * pitch)
            depth[own] = np.clip((width * pitch / 2 - around) / wall + 0.5, 0.0, 1.0)
        return jnp.asarray(float(self.offset) - float(self.depth) * depth, self.dtype)


def _distance(
    along: np.ndarray,
    across: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    nearest: np.ndarray,
    bit: float,
    width: float,
) -> np.ndarray:
    """Distance to the middle lines of the nearest pits, whose ends are half circles."""
    found = np.full(along.shape, np.inf)
    for step in (-1, 0, 1):
        k = np.clip(nearest + step, 0, len(start) - 1)
        middle, half = 0.5 * (start[k] + end[k]) * bit, 0.5 * (end[k] - start[k]) * bit - width / 2
        beyond = np.maximum(np.abs(along * bit - middle) - half, 0.0)
        found = np.minimum(found, np.hypot(beyond, across))
    return found
