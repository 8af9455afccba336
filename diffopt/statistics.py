"""Figures that describe a surface: heights, slopes, spectrum, autocorrelation.

Host-side float64 code on height arrays [ny, nx] in micrometres; the results are numbers, not
traced values. The mean height is removed first; any other trend counts as surface, so level
a scan before asking.
"""

import dataclasses
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class PowerSpectrum:
    """Two-sided power spectral density of the heights.

    Attributes
    ----------
    frequency_y, frequency_x
        [ny], [nx] in cycles per micrometre, ascending, 0 included.
    density
        [ny, nx] in um^4; its sum times the spacing of both frequencies is the variance of
        the heights (Parseval).
    """

    frequency_y: np.ndarray
    frequency_x: np.ndarray
    density: np.ndarray


@dataclasses.dataclass(frozen=True)
class SurfaceStatistics:
    """Figures of a surface; lengths in micrometres, angles in radians.

    Attributes
    ----------
    mean, peak_to_valley, rms_height
        Of the heights; the rms about the mean.
    rms_slope_x, rms_slope_y, rms_slope
        Root mean square of dh/dx, of dh/dy and of the gradient, by central differences.
    autocorrelation_length
        Distance at which the autocorrelation, averaged over directions, falls to 1/e;
        None where it does not within half the patch, or the surface is flat.
    dominant_period
        Period of the strongest component of the spectrum; None for a flat surface.
    dominant_direction
        Direction of its wave vector from x towards y, in (-pi/2, pi/2].
    dominant_share
        Share of the variance within two frequency steps of that component (and of its
        mirror image): near 1 for a sinusoid, small for a random surface, for which the
        dominant period means little.
    """

    mean: float
    peak_to_valley: float
    rms_height: float
    rms_slope_x: float
    rms_slope_y: float
    rms_slope: float
    autocorrelation_length: float | None
    dominant_period: float | None
    dominant_direction: float | None
    dominant_share: float


def power_spectrum(
    heights: np.ndarray, pixel: tuple[float, float], *, periodic: bool = False
) -> PowerSpectrum:
    """Power spectral density by the FFT of the heights less their mean.

    Parameters
    ----------
    heights
        [ny, nx] in micrometres, complete.
    pixel
        (dy, dx) in micrometres.
    periodic
        The patch repeats: no window. Otherwise a Hann window on both axes, normalised to
        keep the variance on average.
    """
    values = np.asarray(heights, dtype=np.float64)
    values = values - values.mean()
    (ny, nx), (dy, dx) = values.shape, pixel
    if not periodic:
        window = np.outer(_hann(ny), _hann(nx))
        # Mean under the window removed, so that an offset does not leak into low frequencies.
        values = (values - (values * window).sum() / window.sum()) * window
        values /= math.sqrt(np.mean(window**2))
    density = np.abs(np.fft.fftshift(np.fft.fft2(values))) ** 2 * (dy * dx / (ny * nx))
    return PowerSpectrum(
        np.fft.fftshift(np.fft.fftfreq(ny, dy)), np.fft.fftshift(np.fft.fftfreq(nx, dx)), density
    )


def autocorrelation(
    heights: np.ndarray, pixel: tuple[float, float], *, periodic: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Autocorrelation of the heights against distance, averaged over directions.

    Parameters
    ----------
    heights
        [ny, nx] in micrometres, complete.
    pixel
        (dy, dx) in micrometres.
    periodic
        The patch repeats: circular correlation. Otherwise the linear one, each lag divided
        by the number of pixel pairs that it has.

    Returns
    -------
    distance, correlation
        Mean distances in micrometres, from 0 to half the shorter side in rings one pixel
        (the finer one) wide, and the correlation there, 1 at distance 0.
    """
    values = np.asarray(heights, dtype=np.float64)
    values = values - values.mean()
    ny, nx = values.shape
    shape = (ny, nx) if periodic else (2 * ny, 2 * nx)
    product = np.fft.irfft2(np.abs(np.fft.rfft2(values, shape)) ** 2, shape)
    lag_y, lag_x = (np.fft.fftfreq(n, 1.0 / n) for n in shape)
    pairs = np.full(shape, float(ny * nx))
    if not periodic:
        pairs = np.outer(ny - np.abs(lag_y), nx - np.abs(lag_x))
    correlation = np.where(pairs > 0, product / np.maximum(pairs, 1), 0.0)
    distance = np.hypot(lag_y[:, None] * pixel[0], lag_x[None, :] * pixel[1])
    ring = np.rint(distance / min(pixel)).astype(int)
    near = distance <= 0.5 * min(ny * pixel[0], nx * pixel[1])
    count = np.bincount(ring[near])
    full = count > 0
    mean_distance = np.bincount(ring[near], distance[near])[full] / count[full]
    mean = np.bincount(ring[near], correlation[near])[full] / count[full]
    variance = mean[0]
    return mean_distance, mean / variance if variance > 0 else np.zeros_like(mean)


def surface_statistics(
    heights: np.ndarray, pixel: tuple[float, float], *, periodic: bool = False
) -> SurfaceStatistics:
    """All figures of a surface.

    Parameters
    ----------
    heights
        [ny, nx] in micrometres, complete, at least 3 x 3.
    pixel
        (dy, dx) in micrometres.
    periodic
        The patch repeats: slopes across the seam, spectrum and correlation without window.
    """
    values = np.asarray(heights, dtype=np.float64)
    if periodic:
        slope_y, slope_x = (
            (np.roll(values, -1, axis) - np.roll(values, 1, axis)) / (2 * pixel[axis])
            for axis in (0, 1)
        )
    else:
        slope_y = (values[2:] - values[:-2]) / (2 * pixel[0])
        slope_x = (values[:, 2:] - values[:, :-2]) / (2 * pixel[1])
    mean_square_y, mean_square_x = float(np.mean(slope_y**2)), float(np.mean(slope_x**2))
    rms = float(values.std())
    # A flat map has the rounding of its mean for rms.
    flat = rms <= 1e-12 * float(np.abs(values).max())
    period = direction = length = None
    share = 0.0
    if not flat:
        spectrum = power_spectrum(values, pixel, periodic=periodic)
        period, direction, share = _dominant(spectrum, periodic)
        distance, correlation = autocorrelation(values, pixel, periodic=periodic)
        length = _crossing(distance, correlation, math.exp(-1.0))
    return SurfaceStatistics(
        mean=float(values.mean()),
        peak_to_valley=float(np.ptp(values)),
        rms_height=0.0 if flat else rms,
        rms_slope_x=math.sqrt(mean_square_x),
        rms_slope_y=math.sqrt(mean_square_y),
        rms_slope=math.sqrt(mean_square_x + mean_square_y),
        autocorrelation_length=length,
        dominant_period=period,
        dominant_direction=direction,
        dominant_share=share,
    )


def _hann(n: int) -> np.ndarray:
    return np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2


def _crossing(x: np.ndarray, y: np.ndarray, threshold: float) -> float | None:
    """First x at which y, interpolated linearly, falls to the threshold."""
    below = np.flatnonzero(y <= threshold)
    if len(below) == 0 or below[0] == 0:
        return None
    k = below[0]
    return float(x[k - 1] + (x[k] - x[k - 1]) * (y[k - 1] - threshold) / (y[k - 1] - y[k]))


def _dominant(spectrum: PowerSpectrum, periodic: bool) -> tuple[float, float, float]:
    """Period, direction and share of the strongest component."""
    density = spectrum.density.copy()
    ny, nx = density.shape
    total = density.sum()
    centre_y, centre_x = ny // 2, nx // 2
    if periodic:
        density[centre_y, centre_x] = 0.0
    else:
        # The window smears what is left of the trend over one step around zero.
        density[centre_y - 1 : centre_y + 2, centre_x - 1 : centre_x + 2] = 0.0
    # One half plane: the spectrum of a real surface is symmetric.
    half = density.copy()
    half[:, :centre_x] = 0.0
    half[: centre_y + 1, centre_x] = 0.0
    if half.max() == 0.0:
        half = density
    j, i = (int(k) for k in np.unravel_index(int(half.argmax()), half.shape))
    step_y = spectrum.frequency_y[1] - spectrum.frequency_y[0]
    step_x = spectrum.frequency_x[1] - spectrum.frequency_x[0]
    offset_y, offset_x = (
        (0.0, 0.0) if periodic else (_peak_offset(density[:, i], j), _peak_offset(density[j, :], i))
    )
    frequency_y = spectrum.frequency_y[j] + offset_y * step_y
    frequency_x = spectrum.frequency_x[i] + offset_x * step_x
    rows = np.abs(np.arange(ny) - j) <= 2
    columns = np.abs(np.arange(nx) - i) <= 2
    share = 2.0 * density[np.ix_(rows, columns)].sum() / total
    direction = math.atan2(frequency_y, frequency_x)
    if direction <= -math.pi / 2:
        direction += math.pi
    elif direction > math.pi / 2:
        direction -= math.pi
    return 1.0 / math.hypot(frequency_y, frequency_x), direction, min(float(share), 1.0)


def _peak_offset(line: np.ndarray, k: int) -> float:
    """Position of a peak between samples, from the amplitude ratio under a Hann window.

    With r the greater neighbour's amplitude over the peak's, the offset is (2 r - 1) / (r + 1)
    towards it, exact for a lone sinusoid under a long Hann window (Grandke 1983).
    """
    left = line[k - 1] if k > 0 else 0.0
    right = line[k + 1] if k + 1 < len(line) else 0.0
    ratio = math.sqrt(max(left, right) / line[k])
    offset = min(max((2.0 * ratio - 1.0) / (ratio + 1.0), 0.0), 0.5)
    return offset if right > left else -offset
