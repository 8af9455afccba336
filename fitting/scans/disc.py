"""Tracks of a compact disc on a scan: pits are found by height, tracks by least squares.

Where pits start and end is not a parameter of a disc, but this scan's own: two numbers a pit,
which count against the model where it competes.
"""

import math
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import ndtr
from jaxtyping import Array, Float, Int

from diffopt import discs
from diffopt.errors import InputError
from diffopt.fitting.scans.register import Scan
from diffopt.gratings.parametric import Parametric, parameters

# Pits smaller than this share of the largest are dust.
_DUST = 0.1
_FEWEST = 4
# Length of the mean of the pits' phasors across the tracks.
_ALIGNED = 0.7


class Pits(Parametric):
    """Pits at known places on tracks; parameters as of `diffopt.gratings.CompactDisc`.

    Attributes
    ----------
    track
        Number of each pit's track.
    start, end
        Of each pit along the track, micrometres.
    """

    PARAMETERS: ClassVar = {
        "pitch": "length",
        "depth": "height",
        "width": "share",
        "wall": "share",
        "shift": "turns",
        "angle": "angle",
    }

    pitch: Float[Array, ""]
    depth: Float[Array, ""]
    width: Float[Array, ""]
    wall: Float[Array, ""]
    shift: Float[Array, ""]
    angle: Float[Array, ""]
    track: Float[Array, " pits"]
    start: Float[Array, " pits"]
    end: Float[Array, " pits"]

    def __init__(self, values: dict[str, float], track: Any, start: Any, end: Any):
        given = parameters({name: values[name] for name in self.PARAMETERS}, Pits)
        self.pitch, self.depth, self.width, self.wall, self.shift, self.angle = given
        self.track, self.start, self.end = (jnp.asarray(a) for a in (track, start, end))

    def at(
        self, y: Float[Array, " ny"], x: Float[Array, " nx"], pixel: tuple[float, float]
    ) -> Float[Array, "ny nx"]:
        """Heights; a pixel widens the walls by its own width, added in squares.

        Walls are error functions as steep at half the depth as straight ones of that width: a
        scan rounds what it shows.
        """
        cos, sin = jnp.cos(self.angle), jnp.sin(self.angle)
        across = cos * x[None, :] + sin * y[:, None] - self.shift * self.pitch
        along = cos * y[:, None] - sin * x[None, :]
        width = self.width * self.pitch
        middle = 0.5 * (self.start + self.end)
        half = jnp.maximum(0.5 * (self.end - self.start - width), 0.0)
        beyond = jnp.maximum(jnp.abs(along[..., None] - middle[None, None]) - half[None, None], 0.0)
        off = across[..., None] - (self.track * self.pitch)[None, None]
        square = (beyond**2 + off**2).min(-1)
        # The root has no derivative at 0.
        distance = jnp.sqrt(jnp.maximum(square, 1e-12))
        wall = jnp.sqrt((width * self.wall) ** 2 + pixel[0] * pixel[1])
        return -self.depth * ndtr(math.sqrt(2.0 * math.pi) * (0.5 * width - distance) / wall)


def find(scan: Scan, vectors: list[tuple[float, float]]) -> Pits:
    """Pits and tracks from two levels of height.

    Raises
    ------
    InputError
        If fewer than four pits are found, or they lie on no tracks.
    """
    from skimage.filters import threshold_otsu
    from skimage.measure import label

    flat = scan.flat
    level = threshold_otsu(flat)
    upper = flat > level
    pits = upper if upper.mean() < 0.5 else ~upper
    depth = float(np.median(flat[~pits]) - np.median(flat[pits]))
    marks: Int[np.ndarray, "ny nx"] = np.asarray(label(pits, connectivity=1))
    area = np.bincount(marks.ravel())
    kept = [k for k in range(1, len(area)) if area[k] > _DUST * np.max(area[1:])]
    if len(kept) < _FEWEST:
        raise InputError(f"compactdisc: expected at least {_FEWEST} pits, found {len(kept)}")
    y, x = np.meshgrid(scan.y, scan.x, indexing="ij")
    inside = [marks == k for k in kept]
    places = np.array([(y[m].mean(), x[m].mean()) for m in inside])
    weight = area[kept].astype(float)

    def together(f: np.ndarray) -> np.ndarray:
        return np.abs(np.exp(-2j * np.pi * f @ places.T) @ weight)

    frequency = np.array(vectors)[int(together(np.array(vectors)).argmax())]
    step = 1.0 / (len(scan.y) * scan.pixel[0]), 1.0 / (len(scan.x) * scan.pixel[1])
    offsets = np.linspace(-0.5, 0.5, 21)
    grid = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 2)
    near = frequency + grid * np.array(step)
    frequency = near[int(together(near).argmax())]
    share = float(together(frequency[None])[0] / weight.sum())
    if share < _ALIGNED:
        raise InputError(
            f"compactdisc: expected pits on tracks (phases that agree to {_ALIGNED:g}), found "
            f"{len(kept)} parts that agree to {share:.2f}"
        )
    pitch = 1.0 / math.hypot(*frequency)
    angle = math.atan2(frequency[0], frequency[1])
    turns = places @ frequency
    shift = np.angle((weight * np.exp(2j * np.pi * turns)).sum()) / (2 * np.pi)
    along = math.cos(angle) * y - math.sin(angle) * x
    half = 0.5 * math.sqrt(scan.pixel[0] * scan.pixel[1])
    start = np.array([along[m].min() - half for m in inside])
    end = np.array([along[m].max() + half for m in inside])
    cell = scan.pixel[0] * scan.pixel[1]
    # A stadium of length l and width w has the area (l - w) w + pi w^2 / 4.
    long = end - start
    root = np.sqrt(np.maximum(long**2 - 4.0 * (1.0 - math.pi / 4.0) * weight * cell, 0.0))
    width = float(np.median((long - root) / (2.0 * (1.0 - math.pi / 4.0)))) / pitch
    values = {
        "pitch": pitch, "depth": depth, "width": min(max(width, 0.1), 0.6), "wall": 0.4,
        "shift": float(shift), "angle": angle,
    }  # fmt: skip
    return Pits(values, np.rint(turns - shift), start, end)


def ends(pits: Pits, scan: Scan, rest: np.ndarray) -> Pits:
    """Ends anew, from what is left at them: the mean residual there over the pit's depth.

    Parameters
    ----------
    pits
        Fitted.
    scan
        The scan.
    rest
        [ny, nx], scan less the fit, micrometres.
    """
    angle, pitch = float(pits.angle), float(pits.pitch)
    width, depth = float(pits.width) * pitch, float(pits.depth)
    across = math.cos(angle) * scan.x[None, :] + math.sin(angle) * scan.y[:, None]
    along = math.cos(angle) * scan.y[:, None] - math.sin(angle) * scan.x[None, :]
    place = across / pitch - float(pits.shift)
    own = np.abs(place - np.rint(place)) * pitch < 0.5 * width
    start, end = np.array(pits.start, float), np.array(pits.end, float)
    cell = scan.pixel[0] * scan.pixel[1]
    for k, track in enumerate(np.asarray(pits.track, float)):
        here = own & (np.rint(place) == track) & scan.known
        for edge, side in ((start, -1.0), (end, 1.0)):
            near = here & (np.abs(along - edge[k]) < 0.5 * width)
            # The half circle's front is pi / 4 as wide as the pit in the mean.
            missing = -(rest[near].sum() * cell) / (depth * 0.9 * width)
            if near.sum() > 4:
                edge[k] += side * float(np.clip(missing, -0.3 * width, 0.3 * width))
    dtype = pits.start.dtype
    longer = np.maximum(end, start + 0.5 * width)
    return eqx.tree_at(
        lambda p: (p.start, p.end),
        pits,
        (jnp.asarray(start, dtype), jnp.asarray(longer, dtype)),
    )


def bit(pits: Pits, scan: Scan) -> tuple[float, float]:
    """Length of a channel bit and its standard error, from the mean of complete runs."""
    runs: list[float] = []
    start, end = np.asarray(pits.start, float), np.asarray(pits.end, float)
    track = np.asarray(pits.track)
    for number in np.unique(track):
        order = np.argsort(start[track == number])
        first, last = start[track == number][order], end[track == number][order]
        runs += list(last[1:-1] - first[1:-1]) + list(first[1:] - last[:-1])
    lengths = np.arange(discs.SHORTEST_RUN, discs.LONGEST_RUN + 1)
    share = discs.growth() ** -lengths.astype(float)
    mean = float((lengths * share).sum() / share.sum())
    if len(runs) < 2:
        return float(np.mean(end - start)) / mean, math.inf
    found = np.array(runs)
    return float(found.mean()) / mean, float(found.std(ddof=1)) / math.sqrt(len(found)) / mean
