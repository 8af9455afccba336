"""Starts of a fit to a scan: spikes, filled pixels, wave vectors and mean profiles.

Host-side float64 code; what it returns starts the fits of `squares` and is not refined
here.
"""

import dataclasses
import itertools
import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.gratings import Grating
from diffopt.statistics import power_spectrum

#: Fewest pixels on a side.
LEAST = 16
# Least share of known pixels.
_KNOWN = 0.3
# A pixel that tops all its neighbours by this many deviations of the noise is a spike.
_SPIKE = 6.0
# Neighbours that may be missing (five are at a corner of the scan).
_HOLES = 2
# Samples of a mean profile over one period.
_SAMPLES = 48
# Shape parameters that starts are tried at.
_SHARES = {"duty": np.linspace(0.1, 0.9, 9), "width": np.linspace(0.1, 0.5, 5)}
_OTHERS = np.array([0.1, 0.5, 0.9])


@dataclasses.dataclass(frozen=True)
class Scan:
    """A scan made ready: micrometres, float64.

    Attributes
    ----------
    heights
        [ny, nx], missing pixels and spikes filled from around them.
    known
        [ny, nx], False for both.
    missing
        [ny, nx], pixels without a height.
    pixel
        (dy, dx).
    y, x
        Positions of rows and columns.
    scale
        Standard deviation of the heights about a plane.
    """

    heights: np.ndarray
    known: np.ndarray
    missing: np.ndarray
    pixel: tuple[float, float]
    y: np.ndarray
    x: np.ndarray
    scale: float

    @property
    def flat(self) -> np.ndarray:
        """Heights less the plane of least squares through the known ones."""
        return self.heights - _plane(self.heights, self.known, self.y, self.x)

    def binned(self, factor: int) -> "Scan":
        """Means over blocks; rows and columns that fill none are left out."""
        if factor == 1:
            return self
        share = blocks(self.known.astype(float), factor)
        heights = blocks(self.heights, factor)
        return dataclasses.replace(
            self,
            heights=heights,
            known=share > 0.5,
            missing=share == 0.0,
            pixel=(self.pixel[0] * factor, self.pixel[1] * factor),
            y=blocks(self.y[:, None], factor, 1)[:, 0],
            x=blocks(self.x[None, :], 1, factor)[0],
        )


def blocks(values: np.ndarray, factor: int, across: int | None = None) -> np.ndarray:
    """Means over blocks of `factor` rows and `across` columns."""
    across = factor if across is None else across
    ny, nx = values.shape[0] // factor, values.shape[1] // across
    part = values[: ny * factor, : nx * across]
    return part.reshape(ny, factor, nx, across).mean((1, 3))


def prepared(heights: np.ndarray, pixel: tuple[float, float]) -> Scan:
    """Find spikes, and fill them and missing pixels.

    Raises
    ------
    InputError
        If the scan is too small, flat, or has too few known pixels.
    """
    values = np.asarray(heights, np.float64)
    if min(values.shape) < LEAST:
        raise InputError(
            f"scan: expected at least {LEAST} x {LEAST} pixels, received {values.shape}"
        )
    missing = ~np.isfinite(values)
    if missing.mean() > 1.0 - _KNOWN:
        raise InputError(
            f"scan: {missing.sum()} of {missing.size} pixels are missing; expected at least "
            f"{100 * _KNOWN:.0f} % of them known"
        )
    (ny, nx), (dy, dx) = values.shape, pixel
    y, x = (np.arange(ny) - ny // 2) * dy, (np.arange(nx) - nx // 2) * dx
    known = ~missing & ~_spikes(values)
    rest = np.where(known, values - _plane(values, known, y, x), 0.0)
    scale = math.sqrt((rest[known] ** 2).mean())
    if scale <= 1e-6 * np.abs(values[known]).max() or scale == 0.0:
        raise InputError(
            f"scan: heights deviate from a plane by {scale:.3g} um rms; expected a surface that "
            "is not flat"
        )
    return Scan(filled(values, known), known, missing, pixel, y, x, scale)


def filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Unknown pixels as solutions of Laplace's equation, approximately: by relaxation."""
    if known.all():
        return values
    out = np.where(known, values, 0.0)
    weight = known.astype(float)
    for _ in range(max(values.shape)):
        if (weight > 0).all():
            break
        mean, found = _around(out * weight), _around(weight)
        new = (weight == 0) & (found > 0)
        out[new], weight[new] = mean[new] / found[new], 1.0
    unknown = ~known
    one = np.ones_like(out)
    for _ in range(60):
        out[unknown] = (_around(out) / _around(one))[unknown]
    return out


def _around(values: np.ndarray) -> np.ndarray:
    """Sum of the four neighbours, none beyond the edges."""
    wide = np.pad(values, 1)
    return wide[:-2, 1:-1] + wide[2:, 1:-1] + wide[1:-1, :-2] + wide[1:-1, 2:]


def _spikes(values: np.ndarray) -> np.ndarray:
    """Single pixels far above or below all of their neighbours: no edge or corner is one."""
    low = high = None
    holes = np.zeros(values.shape, int)
    ny, nx = values.shape
    wide = np.pad(values, 1, constant_values=np.nan)
    for j, i in itertools.product(range(3), range(3)):
        if (j, i) == (1, 1):
            continue
        part = wide[j : j + ny, i : i + nx]
        low = part if low is None else np.fmin(low, part)
        high = part if high is None else np.fmax(high, part)
        holes += np.isnan(part)
    middle = 0.5 * (wide[1:-1, :-2] + wide[1:-1, 2:]) - values
    found = np.abs(middle[np.isfinite(middle)])
    # The deviation of that difference is sqrt(3 / 2) that of white noise.
    sigma = 1.4826 * np.median(found) / math.sqrt(1.5) if found.size else 0.0
    beyond = np.fmax(values - high, low - values)
    # Beside a hole an edge may look like one.
    return (np.nan_to_num(beyond, nan=0.0) > max(_SPIKE * sigma, 1e-12)) & (holes <= _HOLES)


def _plane(values: np.ndarray, known: np.ndarray, y: np.ndarray, x: np.ndarray) -> np.ndarray:
    ny, nx = values.shape
    basis = np.stack(
        [
            np.ones((ny, nx)),
            np.broadcast_to(y[:, None] / np.abs(y).max(), (ny, nx)),
            np.broadcast_to(x[None, :] / np.abs(x).max(), (ny, nx)),
        ]
    )
    rows = basis[:, known]
    solution = np.linalg.solve(rows @ rows.T, rows @ values[known])
    return np.tensordot(solution, basis, 1)


def wave_vectors(scan: Scan, count: int = 3) -> list[tuple[float, float]]:
    """The strongest peaks of the spectrum as (fy, fx) in cycles/um, and sub-multiples.

    Offsets of lines fill the columns of frequency 0 along x; there only what stands out of
    the column counts. Multiples of a stronger peak are left out; a half or third of a peak is
    added if what repeats with it alone holds more than 3 % of its power.
    """
    flat = scan.flat
    spectrum = power_spectrum(flat, scan.pixel)
    power = spectrum.density.copy()
    ny, nx = power.shape
    cy, cx = ny // 2, nx // 2
    for i in (cx - 1, cx, cx + 1):
        # Nine times the median: about the largest of some 300 exponential variates.
        power[:, i] = np.maximum(power[:, i] - 9.0 * np.median(power[:, i]), 0.0)
    power[cy - 1 : cy + 2, cx - 1 : cx + 2] = 0.0
    power[:, :cx] = 0.0
    power[: cy + 1, cx] = 0.0
    fy, fx = spectrum.frequency_y, spectrum.frequency_x
    step = np.array([fy[1] - fy[0], fx[1] - fx[0]])
    found: list[np.ndarray] = []
    for _ in range(20 * count):
        if len(found) == count or power.max() <= 0:
            break
        j, i = (int(k) for k in np.unravel_index(int(power.argmax()), power.shape))
        power[max(j - 2, 0) : j + 3, max(i - 2, 0) : i + 3] = 0.0
        peak = _refined(flat * scan.known, scan, np.array([fy[j], fx[i]]), step)
        if not any(_multiple(peak, other, step) for other in found):
            found.append(peak)
    out = []
    for peak in found:
        out.append(peak)
        for k in (2, 3):
            lines = _line_powers(flat * scan.known, scan, peak / k, 2 * k)
            alone = sum(p for m, p in enumerate(lines, 1) if m % k)
            if np.hypot(*(peak / k / step)) > 1.5 and alone > 0.03 * sum(lines):
                out.append(peak / k)
    return [(float(p[0]), float(p[1])) for p in out]


def _multiple(peak: np.ndarray, other: np.ndarray, step: np.ndarray) -> bool:
    ratio = float((peak @ other) / (other @ other))
    return abs(round(ratio)) >= 1 and bool(np.all(np.abs(peak - round(ratio) * other) < 1.5 * step))


def _lines_at(values: np.ndarray, scan: Scan, frequency: np.ndarray) -> np.ndarray:
    """Fourier sums under a Hann window at frequencies [..., 2]."""
    ny, nx = values.shape
    hann = np.outer(*(np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2 for n in (ny, nx)))
    along_y = np.exp(-2j * np.pi * frequency[..., 0].reshape(-1, 1) * scan.y)
    along_x = np.exp(-2j * np.pi * frequency[..., 1].reshape(-1, 1) * scan.x)
    return np.einsum("ky,ky->k", along_y, along_x @ (values * hann).T).reshape(frequency.shape[:-1])


def _line_powers(values: np.ndarray, scan: Scan, frequency: np.ndarray, count: int) -> list[float]:
    many = np.arange(1, count + 1)[:, None] * frequency[None]
    return [float(p) for p in np.abs(_lines_at(values, scan, many)) ** 2]


def _refined(values: np.ndarray, scan: Scan, frequency: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The maximum of the spectrum near a frequency, by grids that shrink."""
    reach = 0.5
    for _ in range(4):
        offsets = np.linspace(-reach, reach, 5)
        grid = np.stack(np.meshgrid(offsets, offsets, indexing="ij"), -1).reshape(-1, 2)
        many = frequency + grid * step
        frequency = many[int(np.abs(_lines_at(values, scan, many)).argmax())]
        reach *= 0.4
    return frequency


def folded(scan: Scan, frequency: tuple[float, float]) -> np.ndarray:
    """Mean profile over one period at (k + 1/2) / 48 periods; positions along the frequency."""
    t = scan.y[:, None] * frequency[0] + scan.x[None, :] * frequency[1]
    place = np.floor((t - np.floor(t)) * _SAMPLES).astype(int) % _SAMPLES
    flat = scan.flat
    count = np.bincount(place[scan.known], minlength=_SAMPLES)
    total = np.bincount(place[scan.known], flat[scan.known], minlength=_SAMPLES)
    full = count > 0
    middle = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    return np.interp(middle, middle[full], total[full] / count[full], period=1.0)


def shapes(kind: type[Grating]) -> list[dict[str, float]]:
    """Values of the shape parameters that starts are tried at."""
    names = [n for n, k in kind.PARAMETERS.items() if k == "share"]
    values = [_SHARES.get(name, _OTHERS) for name in names]
    return [
        dict(zip(names, map(float, chosen), strict=True)) for chosen in itertools.product(*values)
    ]


def start(
    kind: type[Grating], profile: np.ndarray, frequency: tuple[float, float]
) -> tuple[dict[str, float], float]:
    """Parameters of a grating nearest to a mean profile, and the variance that they explain.

    All positions are tried for each shape; the amplitude follows in closed form.
    """
    height = next(n for n, k in kind.PARAMETERS.items() if k == "height" and n != "offset")
    place = next(n for n, k in kind.PARAMETERS.items() if k in ("turns", "phase"))
    make: Any = kind
    samples = len(profile)
    middle = (np.arange(samples) + 0.5) / samples
    places = jnp.asarray(middle, jnp.result_type(float))
    target = np.fft.fft(profile - profile.mean())
    best: tuple[float, dict[str, float]] = (-1.0, {})
    for shape in shapes(kind):
        unit = np.asarray(make(**{"period": 1.0, height: 1.0} | shape).profile(places), float)
        unit = unit - unit.mean()
        square = float((unit**2).sum())
        if square < 1e-9:
            continue
        match = np.fft.ifft(target * np.conj(np.fft.fft(unit))).real
        k = int(np.abs(match).argmax())
        gain = float(match[k]) ** 2 / square
        if gain > best[0]:
            moved = k / samples
            at = moved if kind.PARAMETERS[place] == "turns" else -2.0 * math.pi * moved
            best = (gain, shape | {height: float(match[k]) / square, place: at})
    length = math.hypot(*frequency)
    angle = math.atan2(frequency[0], frequency[1])
    return {"period": 1.0 / length, "angle": angle} | best[1], best[0] / samples
