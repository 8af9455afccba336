import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import discs, samples
from diffopt.errors import InputError
from diffopt.heightfield import Heightfield

SMALL = {
    "binary_grating": {"shape": (8, 80)},
    "blazed_grating": {"shape": (8, 64)},
    "compact_disc": {"shape": (256, 192)},
    "flat": {"shape": (8, 9)},
    "gaussian_roughness": {"shape": (96, 64)},
    "random_bumps": {"shape": (96, 64)},
    "sinusoidal_grating": {"shape": (8, 80)},
    "snake_skin": {"shape": (96, 128)},
}


def test_every_sample_is_tried_here():
    assert set(SMALL) == set(samples.NAMES)


@pytest.mark.parametrize("name", samples.NAMES)
class TestEverySample:
    def test_same_key_same_surface(self, name):
        one, two = (samples.make(name, key=jax.random.key(5), **SMALL[name]) for _ in range(2))
        assert isinstance(one, Heightfield)
        assert one.shape == SMALL[name]["shape"]
        assert one.heights.dtype == jnp.result_type(float)
        np.testing.assert_array_equal(one.heights, two.heights)
        assert one.provenance == two.provenance

    def test_default_pixel_samples_visible_light(self, name):
        field = samples.make(name)
        field.check_sampling(0.38, jumps=name in ("binary_grating", "blazed_grating"))

    def test_repeats_without_a_seam(self, name):
        """Steps across the seam are no steeper than within the patch."""
        field = samples.make(name, **SMALL[name])
        for axis in (0, 1):
            heights = np.asarray(field.heights)
            within = np.abs(np.diff(heights, axis=axis)).max()
            across = np.abs(heights.take(0, axis) - heights.take(-1, axis)).max()
            # A tenth: the steepest place need not be sampled alike.
            assert across <= 1.1 * within + 1e-12


@pytest.mark.parametrize("name", sorted(samples._KEYED))
def test_another_key_gives_another_surface(name):
    one, two = (samples.make(name, key=jax.random.key(k), **SMALL[name]) for k in (1, 2))
    assert np.abs(one.heights - two.heights).max() > 0.01


def test_unknown_name_lists_the_others():
    with pytest.raises(InputError, match=r"no sample 'vinyl'; expected one of binary_grating"):
        samples.make("vinyl")


class TestRunLengths:
    def test_distribution_is_that_of_the_greatest_entropy(self, rng):
        runs = discs.run_lengths(50_000, rng.random(50_000))
        assert sum(runs) == 50_000
        assert len(runs) % 2 == 0
        # sum_n 1.4558^-n = 1 over 3 to 11; mean sum_n n 1.4558^-n.
        odds = 1.4558 ** -np.arange(3.0, 12.0)
        assert odds.sum() == pytest.approx(1.0, abs=1e-4)
        counts = np.bincount(runs, minlength=12)
        assert counts[:3].sum() == 0
        expected = odds * len(runs)
        chi_square = np.sum((counts[3:] - expected) ** 2 / expected)
        # Eight degrees of freedom: 26.1 is exceeded once in a thousand; the key is fixed.
        assert chi_square < 26.1

    @pytest.mark.parametrize("bits", [6, 7, 11, 23, 29])
    def test_short_tracks_are_filled_exactly(self, rng, bits):
        for _ in range(20):
            runs = discs.run_lengths(bits, rng.random(bits))
            assert sum(runs) == bits
            assert len(runs) % 2 == 0
            assert min(runs) >= 3
            assert max(runs) <= 11

    def test_the_velocity_is_raised_until_bits_fit(self):
        bits, bit = discs.whole_bits(12.8, 1.2)
        assert bits * bit == pytest.approx(12.8)
        assert 1.2 <= bit * 4.3218 < 1.2 * (bits + 1) / bits


class TestCompactDisc:
    field = samples.compact_disc(jax.random.key(7), shape=(4096, 256), pixel=(0.0125, 0.025))
    bit = 4096 * 0.0125 / int(4096 * 0.0125 * 4.3218 / 1.2)

    def runs(self, track):
        """Lengths of pits and of lands along the middle of a track, in um, circular."""
        centre = round((track + 0.5) * 1.6 / 0.025)
        pit = np.asarray(self.field.heights)[:, centre] < -0.115 / 2
        start = int(np.flatnonzero(pit & ~np.roll(pit, 1))[0])
        pit = np.roll(pit, -start)
        edges = np.flatnonzero(np.diff(np.append(pit.astype(int), 1)))
        lengths = np.diff(np.concatenate([[0], edges + 1])) * 0.0125
        return lengths[::2], lengths[1::2]

    def test_track_pitch_lies_across_x(self):
        figures = self.field.statistics(periodic=True)
        assert figures.dominant_period == pytest.approx(1.6, rel=1e-6)
        assert figures.dominant_direction == 0.0

    def test_depth_and_width(self):
        heights = np.asarray(self.field.heights)
        assert heights.min() == pytest.approx(-0.115)
        assert heights.max() == 0.0
        # A row through the middle of a long pit: half depth 0.5 um apart, to one pixel.
        middle = heights[:, 32]
        lengths = np.convolve(middle < -0.11, np.ones(100), "same")
        row = heights[int(lengths.argmax()), :64]
        assert (row < -0.115 / 2).sum() * 0.025 == pytest.approx(0.5, abs=0.03)

    def test_runs_are_3_to_11_channel_bits(self):
        assert self.bit == pytest.approx(1.2 / 4.3218, rel=0.01)
        found = []
        for track in range(4):
            for lengths in self.runs(track):
                bits = lengths / self.bit
                # Half depth is met within a pixel at each end: 2 * 0.0125 / 0.278.
                assert np.abs(bits - np.rint(bits)).max() < 0.1
                found.extend(np.rint(bits).astype(int))
        assert min(found) == 3
        assert max(found) <= 11
        # Greatest entropy under the limits: odds 1.456^-n, mean run 4.6 channel bits. 160 runs
        # of standard deviation 1.9: three standard errors are 0.45.
        assert np.mean(found) == pytest.approx(4.6, abs=0.45)

    def test_pits_and_lands_cover_the_track(self):
        for track in range(4):
            pits, lands = self.runs(track)
            assert pits.sum() + lands.sum() == pytest.approx(4096 * 0.0125)

    def test_walls_are_sloped(self):
        """Smoothstep over 0.1 um: 1.5 * 0.115 / 0.1 at the steepest."""
        heights = np.asarray(self.field.heights)
        assert np.abs(np.diff(heights, axis=1)).max() <= 1.5 * 0.115 / 0.1 * 0.025 * (1 + 1e-9)

    def test_tracks_that_do_not_fit_are_refused(self):
        with pytest.raises(InputError, match=r"hold 7\.5 tracks.*a pixel of 0\.026666667"):
            samples.compact_disc(jax.random.key(0), shape=(64, 480))

    @pytest.mark.parametrize(
        ("options", "text"),
        [
            ({"velocity": 1.0}, "expected 1.2 to 1.4 m/s"),
            ({"wall": 0.0}, "wall=0.0"),
            ({"width": 1.55}, "width=1.55"),
            ({"shape": (32, 64)}, "does not hold whole channel bits"),
        ],
    )
    def test_geometry_is_checked(self, options, text):
        with pytest.raises(InputError, match=text):
            samples.compact_disc(jax.random.key(0), **{"shape": (256, 64), **options})


def test_gaussian_roughness_has_the_rms_length_and_slope_asked():
    field = samples.gaussian_roughness(jax.random.key(3), rms=0.04, correlation_length=0.5)
    figures = field.statistics(periodic=True)
    # 25.6 um side: 830 independent areas of pi 0.5^2; three standard errors of the rms
    # 3 / sqrt(2 * 830) = 7 %.
    assert figures.rms_height == pytest.approx(0.04, rel=0.07)
    assert figures.autocorrelation_length == pytest.approx(0.5, rel=0.1)
    assert figures.rms_slope == pytest.approx(2 * 0.04 / 0.5, rel=0.07)


def test_gaussian_roughness_has_gaussian_heights():
    heights = np.asarray(samples.gaussian_roughness(jax.random.key(4)).heights)
    scaled = heights / heights.std()
    # Fourth moment 3, standard error sqrt(96 / 830) = 0.34 for 830 independent values.
    assert np.mean(scaled**4) == pytest.approx(3.0, abs=1.0)
    assert np.mean(scaled**3) == pytest.approx(0.0, abs=0.3)


@pytest.mark.parametrize("length", [0.05, 4.0])
def test_gaussian_roughness_refuses_lengths_the_patch_cannot_hold(length):
    with pytest.raises(InputError, match=r"two pixels \(0\.1 um\) to a quarter"):
        samples.gaussian_roughness(jax.random.key(0), shape=(200, 300), correlation_length=length)


@pytest.mark.long
def test_random_bumps_have_the_volume_and_variance_of_their_process():
    """Campbell's theorem: mean density H 2 pi sx sy, variance density H^2 pi sx sy."""
    height, (sy, sx), density = 0.1, (0.4, 0.2), 2.0
    means, variances = [], []
    for seed in range(8):
        field = samples.random_bumps(
            jax.random.key(seed), pixel=0.08, height=height, sigma=(sy, sx), density=density
        )
        means.append(float(field.heights.mean()))
        variances.append(float(field.heights.var()))
    # 8 patches of 1678 um^2 with 3355 bumps each: the mean to 0.6 %, the variance to some 2 %.
    assert np.mean(means) == pytest.approx(density * height * 2 * np.pi * sx * sy, rel=0.02)
    assert np.mean(variances) == pytest.approx(density * height**2 * np.pi * sx * sy, rel=0.06)


def test_a_single_bump_is_stams_formula():
    for seed in range(40):
        field = samples.random_bumps(
            jax.random.key(seed), shape=(60, 80), pixel=0.1, sigma=(0.5, 0.25), density=0.02
        )
        if field.provenance.steps == ("1 bumps",):
            break
    else:
        pytest.fail("no patch with one bump in 40 keys")
    # About its maximum, with wrapped offsets: log h is a quadratic form, whatever the centre.
    heights = np.log(np.asarray(field.heights) / 0.15)
    j, i = np.unravel_index(heights.argmax(), heights.shape)
    heights = np.roll(heights, (30 - j, 40 - i), (0, 1))
    second_y = np.diff(heights, n=2, axis=0)[20:38, 40] / 0.1**2
    second_x = np.diff(heights, n=2, axis=1)[30, 30:48] / 0.1**2
    np.testing.assert_allclose(second_y, -1 / 0.5**2, rtol=1e-6)
    np.testing.assert_allclose(second_x, -1 / 0.25**2, rtol=1e-6)


def test_no_bumps_is_flat():
    field = samples.random_bumps(jax.random.key(0), shape=(8, 8), density=0.0)
    np.testing.assert_array_equal(field.heights, 0.0)
    with pytest.raises(InputError, match="density=-1"):
        samples.random_bumps(jax.random.key(0), density=-1.0)


def test_snake_skin_has_its_two_pitches():
    field = samples.snake_skin(jax.random.key(2))
    heights = np.asarray(field.heights)
    assert 0.2 < np.ptp(heights) <= 0.3
    figures = field.statistics(periodic=True)
    assert figures.dominant_period == pytest.approx(0.8, rel=0.02)
    assert abs(figures.dominant_direction) == pytest.approx(np.pi / 2, abs=0.02)
    # Quasi-periodic: less in the one component than a grating has, more than a random surface.
    assert 0.2 < figures.dominant_share < 0.8
    # Rows: the strongest line of the mean over y, 25.6 um / 11 rows apart.
    spectrum = np.abs(np.fft.rfft(heights.mean(axis=0)))
    assert 1 + int(spectrum[1:].argmax()) == 11
    with pytest.raises(InputError, match="expected two pitches or more"):
        samples.snake_skin(jax.random.key(0), shape=(64, 64))


@pytest.mark.parametrize(
    "maker", [samples.sinusoidal_grating, samples.blazed_grating, samples.binary_grating]
)
def test_gratings_must_fit_the_patch(maker):
    with pytest.raises(InputError, match="expected a whole number: a pixel of"):
        maker(period=1.7)
    with pytest.raises(InputError, match="period=-1"):
        maker(period=-1.0)


def test_jumps_of_the_gratings_lie_between_samples():
    binary = np.asarray(samples.binary_grating().heights)
    assert set(np.unique(binary)) == {0.0, 0.12}
    assert (binary > 0).mean() == 0.5
    blazed = np.asarray(samples.blazed_grating().heights)
    # 64 samples a period, at (k + 1/2) / 64 of the depth.
    np.testing.assert_allclose(np.sort(blazed[0, :64]), 0.15 * (np.arange(64) + 0.5) / 64)
