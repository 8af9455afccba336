import math

import numpy as np
import pytest

from diffopt.statistics import autocorrelation, power_spectrum, surface_statistics


def wave(shape, pixel, frequency, amplitude=0.1):
    """A sinusoid of the given (fy, fx) in cycles per micrometre."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    phase = frequency[0] * y * pixel[0] + frequency[1] * x * pixel[1]
    return amplitude * np.cos(2 * np.pi * phase + 0.3)


def rough(rng, n, pixel, length, rms):
    """Periodic Gaussian surface with correlation rms^2 exp(-r^2 / length^2), by direct sums.

    A moving average of white noise with a Gaussian kernel of half the squared width.
    """
    lag = np.minimum(np.arange(n), n - np.arange(n)) * pixel
    kernel = np.exp(-2 * (lag / length) ** 2)
    kernel /= np.sqrt(np.sum(kernel**2))
    circulant = kernel[np.abs(np.subtract.outer(np.arange(n), np.arange(n)))]
    return rms * circulant @ rng.normal(size=(n, n)) @ circulant.T


@pytest.mark.parametrize("shape", [(32, 40), (31, 41)])
def test_spectrum_sums_to_the_variance(rng, shape):
    heights, pixel = rng.normal(size=shape), (0.2, 0.1)
    spectrum = power_spectrum(heights, pixel, periodic=True)
    cell = (spectrum.frequency_y[1] - spectrum.frequency_y[0]) * (
        spectrum.frequency_x[1] - spectrum.frequency_x[0]
    )
    np.testing.assert_allclose(spectrum.density.sum() * cell, heights.var(), rtol=1e-12)
    windowed = power_spectrum(heights, pixel)
    # On white noise of 1,300 pixels the window keeps the variance to about 2 / sqrt(1300).
    np.testing.assert_allclose(windowed.density.sum() * cell, heights.var(), rtol=0.15)
    assert np.all(np.diff(spectrum.frequency_x) > 0)
    assert 0.0 in spectrum.frequency_y


def test_spectrum_of_a_wave_is_two_lines():
    pixel = (0.1, 0.1)
    heights = wave((40, 50), pixel, (0.5, 0.8))
    spectrum = power_spectrum(heights, pixel, periodic=True)
    j, i = np.unravel_index(spectrum.density.argmax(), spectrum.density.shape)
    assert abs(spectrum.frequency_y[j]) == pytest.approx(0.5)
    assert abs(spectrum.frequency_x[i]) == pytest.approx(0.8)
    # amplitude^2 / 4 in each line, spread over one cell of (1 / 4 um) (1 / 5 um).
    np.testing.assert_allclose(spectrum.density.max(), 0.1**2 / 4 * 4 * 5, rtol=1e-12)


def test_figures_of_a_wave_along_x():
    pixel, period, amplitude = (0.2, 0.05), 2.0, 0.1
    heights = 3.0 + wave((20, 200), pixel, (0.0, 1 / period), amplitude)
    figures = surface_statistics(heights, pixel, periodic=True)
    assert figures.mean == pytest.approx(3.0)
    assert figures.rms_height == pytest.approx(amplitude / math.sqrt(2), rel=1e-12)
    # The crest lies up to half of a fortieth of a period beside a sample: 1 - cos(pi / 40).
    assert figures.peak_to_valley == pytest.approx(2 * amplitude, rel=4e-3)
    # Central differences scale the slope by sinc(2 pixel / period): known exactly.
    slope = 2 * math.pi / period * amplitude / math.sqrt(2) * np.sinc(2 * 0.05 / period)
    assert figures.rms_slope_x == pytest.approx(slope, rel=1e-12)
    assert figures.rms_slope_y == pytest.approx(0.0, abs=1e-12)
    assert figures.rms_slope == pytest.approx(slope, rel=1e-12)
    assert figures.dominant_period == pytest.approx(period, rel=1e-12)
    assert figures.dominant_direction == pytest.approx(0.0)
    assert figures.dominant_share == pytest.approx(1.0)


@pytest.mark.parametrize("degrees", [-80, -45, -10, 0, 30, 60, 90])
def test_period_and_direction_between_the_lines_of_the_spectrum(degrees):
    """A wave that does not fit the patch is found to a hundredth of a frequency step or so."""
    pixel, period, angle = (0.08, 0.05), 0.93, math.radians(degrees)
    frequency = (math.sin(angle) / period, math.cos(angle) / period)
    heights = wave((150, 200), pixel, frequency)
    figures = surface_statistics(heights, pixel)
    # Patch 12 x 10 um: one step is 0.1 cycles/um, 9 % of the frequency; a hundredth of it 0.1 %.
    assert figures.dominant_period == pytest.approx(period, rel=3e-3)
    error = (figures.dominant_direction - angle + math.pi / 2) % math.pi - math.pi / 2
    assert abs(error) < 3e-3
    assert -math.pi / 2 < figures.dominant_direction <= math.pi / 2
    assert figures.dominant_share > 0.95


def test_random_surface_has_its_correlation_length_and_slope(rng):
    n, pixel, length, rms = 400, 0.05, 0.5, 0.02
    heights = rough(rng, n, pixel, length, rms)
    # 20 um side: about (20 / 0.5)^2 / pi = 500 independent areas; three standard errors of a
    # variance, 3 sqrt(2 / 500) = 0.19, half of that for its root.
    for periodic in (True, False):
        figures = surface_statistics(heights, (pixel, pixel), periodic=periodic)
        assert figures.rms_height == pytest.approx(rms, rel=0.1)
        assert figures.autocorrelation_length == pytest.approx(length, rel=0.1)
        # <|grad h|^2> = -C''(0) summed over both axes = 4 rms^2 / length^2.
        assert figures.rms_slope == pytest.approx(2 * rms / length, rel=0.1)
        assert figures.dominant_share < 0.3


def test_autocorrelation_agrees_with_the_sum_over_pairs(rng):
    heights = rng.normal(size=(7, 9))
    centred = heights - heights.mean()
    distance, correlation = autocorrelation(heights, (1.0, 1.0))
    # Ring 1 holds the lags (0, 1), (1, 0), (1, 1) and their mirror images, weighted alike.
    along_x = np.mean(centred[:, 1:] * centred[:, :-1])
    along_y = np.mean(centred[1:] * centred[:-1])
    down = np.mean(centred[1:, 1:] * centred[:-1, :-1])
    up = np.mean(centred[1:, :-1] * centred[:-1, 1:])
    expected = (2 * along_x + 2 * along_y + 2 * down + 2 * up) / 8 / centred.var()
    np.testing.assert_allclose(correlation[1], expected, rtol=1e-12)
    np.testing.assert_allclose(distance[:2], [0.0, (4 + 4 * math.sqrt(2)) / 8], rtol=1e-12)
    assert correlation[0] == pytest.approx(1.0)


@pytest.mark.parametrize("level", [0.0, 0.1, -250.3])
def test_flat_surface(level):
    figures = surface_statistics(np.full((8, 9), level), (0.1, 0.1))
    assert figures.rms_height == figures.rms_slope == figures.peak_to_valley == 0.0
    assert figures.autocorrelation_length is None
    assert figures.dominant_period is None
    assert figures.dominant_direction is None
    assert figures.dominant_share == 0.0


def test_no_correlation_length_where_half_the_patch_is_too_short_to_show_it():
    """A strip 0.4 um wide of waves 10 um long: at 0.2 um they are still correlated."""
    heights = wave((4, 400), (0.1, 0.1), (0.0, 0.1))
    assert surface_statistics(heights, (0.1, 0.1), periodic=True).autocorrelation_length is None
