import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.polynomial.polynomial import polyval2d

from diffopt import conditioning
from diffopt.errors import InputError

# Rounding of sums over some thousand pixels of order one.
ROUNDING = {"float32": 2e-5, "float64": 1e-12}


def grid(ny, nx):
    return np.meshgrid(np.linspace(-1, 1, ny), np.linspace(-1, 1, nx), indexing="ij")


class TestLevel:
    @pytest.mark.parametrize("order", [0, 1, 2, 5])
    def test_removes_any_polynomial_of_its_degree(self, rng, dtype, order):
        y, x = grid(40, 57)
        coefficients = rng.normal(size=(order + 1, order + 1))
        coefficients[np.add.outer(np.arange(order + 1), np.arange(order + 1)) > order] = 0
        heights = jnp.asarray(polyval2d(y, x, coefficients), dtype)
        rest = conditioning.level(heights, order)
        assert rest.dtype == dtype
        np.testing.assert_allclose(rest, 0.0, atol=ROUNDING[dtype])

    def test_leaves_what_is_orthogonal_and_agrees_with_numpy(self, rng):
        heights = rng.normal(size=(30, 41))
        y, x = grid(30, 41)
        basis = np.stack([np.ones_like(x), x, y], axis=-1).reshape(-1, 3)
        fit = basis @ np.linalg.lstsq(basis, heights.ravel())[0]
        expected = heights - fit.reshape(heights.shape)
        level = conditioning.level(jnp.asarray(heights), 1)
        np.testing.assert_allclose(level, expected, atol=1e-13)
        np.testing.assert_allclose(conditioning.level(level, 1), level, atol=1e-13)

    def test_missing_pixels_take_no_part(self, rng):
        y, x = grid(30, 41)
        heights = 3 + 2 * x - y
        heights[rng.random(heights.shape) < 0.3] = np.nan
        level = conditioning.level(jnp.asarray(heights), 1)
        np.testing.assert_array_equal(np.isnan(level), np.isnan(heights))
        np.testing.assert_allclose(np.nan_to_num(level), 0, atol=1e-13)

    def test_a_large_offset_costs_no_resolution(self):
        # 100 um of offset: float32 steps are 8e-6 um there, and no worse may come out.
        _, x = grid(64, 64)
        fine = 0.01 * np.sin(9 * x)
        level = conditioning.level(jnp.asarray(100 + x + fine, jnp.float32), 1)
        exact = conditioning.level(jnp.asarray(100 + x + fine), 1)
        np.testing.assert_allclose(level, exact, atol=2e-5)

    def test_lines(self, rng):
        _, x = grid(12, 50)
        offsets, slopes = rng.normal(size=(2, 12, 1))
        structure = np.cos(40 * x)
        heights = structure + offsets + slopes * x
        flat = conditioning.level_lines(jnp.asarray(heights), 1)
        expected = conditioning.level_lines(jnp.asarray(structure), 1)
        np.testing.assert_allclose(flat, expected, atol=1e-12)
        medium = conditioning.level_lines(jnp.asarray(heights), 0)
        np.testing.assert_allclose(np.mean(medium, axis=1), 0, atol=1e-14)

    def test_too_few_pixels_are_refused(self):
        heights = np.full((5, 6), np.nan)
        heights[0, :2] = 1.0
        with pytest.raises(InputError, match="2 valid pixels; the polynomial has 3 terms"):
            conditioning.level(jnp.asarray(heights), 1)
        with pytest.raises(InputError, match="a row has 0 valid pixels"):
            conditioning.level_lines(jnp.asarray(heights), 0)


class TestFill:
    def test_smooth_surface_comes_back(self, dtype):
        y, x = grid(40, 40)
        surface = 1.5 + 0.3 * x + 0.2 * y + 0.1 * x * y
        heights = surface.copy()
        heights[10:13, 20:22] = heights[30, 5] = np.nan
        filled = conditioning.fill(jnp.asarray(heights, dtype))
        assert filled.dtype == dtype
        known = ~np.isnan(heights)
        np.testing.assert_array_equal(np.asarray(filled)[known], surface.astype(dtype)[known])
        # Linear and bilinear functions are biharmonic: the discrete solution is exact.
        np.testing.assert_allclose(filled, surface, atol=1e-6)

    def test_nothing_is_done_to_a_complete_map(self):
        heights = jnp.ones((4, 5))
        assert conditioning.fill(heights) is heights

    def test_level_surface_far_from_zero(self):
        heights = np.full((12, 12), -250.0)
        heights[4:6, 4:6] = np.nan
        np.testing.assert_allclose(conditioning.fill(jnp.asarray(heights)), -250.0, rtol=1e-12)

    def test_too_much_missing_is_refused(self):
        heights = np.zeros((10, 10))
        heights[:3] = np.nan
        with pytest.raises(InputError, match=r"30 of 100 pixels \(30.0 %\).*accepts 20 %"):
            conditioning.fill(jnp.asarray(heights))
        assert not np.isnan(conditioning.fill(jnp.asarray(heights), most=0.5)).any()


class TestResample:
    @staticmethod
    def wave(n, extent, cycles):
        """A periodic wave at the centres of n pixels, the patch centred at 0."""
        centres = (np.arange(n) - (n - 1) / 2) * extent / n
        return np.cos(2 * np.pi * cycles * centres / extent + 0.4)

    # 42 cycles of 50 (Nyquist on 100 samples) are 0.84; the pass band ends at 0.87.
    @pytest.mark.parametrize(("m", "cycles"), [(250, 40), (160, 42), (100, 42), (80, 33), (50, 21)])
    def test_pass_band_is_kept(self, dtype, m, cycles):
        line = self.wave(100, 10.0, cycles)
        heights = jnp.asarray(np.stack([line, 2 * line, line, line]), dtype)
        new = conditioning.resample(heights, (0.1, 0.1), (0.1, 10.0 / m), periodic=True)
        assert new.dtype == dtype
        expected = self.wave(m, 10.0, cycles)
        # Flat to 1e-4 (the window's 80 dB), and as much of the image beyond Nyquist.
        np.testing.assert_allclose(new[0], expected, atol=2e-4)
        np.testing.assert_allclose(new[1], 2 * expected, atol=4e-4)

    @pytest.mark.parametrize("cycles", [30, 40, 49])
    def test_what_would_alias_is_taken_out(self, cycles):
        """On 50 samples 25 cycles are the limit; the stop band starts at 1.13 of that."""
        heights = jnp.asarray(np.stack([self.wave(100, 10.0, cycles)] * 2))
        new = conditioning.resample(heights, (0.1, 0.1), (0.1, 0.2), periodic=True)
        assert np.abs(new).max() < 2e-4  # stop band of the Kaiser window, 80 dB
        # Taking every second sample would have kept it whole.
        assert np.abs(heights[:, ::2]).max() > 0.9

    @pytest.mark.parametrize("periodic", [True, False])
    @pytest.mark.parametrize("new", [0.05, 0.1, 0.25, 1.0])
    def test_constants_stay(self, periodic, new):
        out = conditioning.resample(
            jnp.full((40, 60), 3.25), (0.1, 0.1), (new, new), periodic=periodic
        )
        np.testing.assert_allclose(out, 3.25, rtol=1e-13)
        assert out.shape == (round(4 / new), round(6 / new))

    def test_edges_are_mirrored_not_wrapped(self):
        ramp = jnp.asarray(np.tile(np.linspace(0, 1, 64), (4, 1)))
        out = conditioning.resample(ramp, (1.0, 1.0), (1.0, 0.5))
        # Wrapped, the seam of the ramp would ring by tenths; mirrored, the kink adds hundredths.
        assert out.min() > -0.01
        assert out.max() < 1.01

    def test_same_pixel_is_the_identity(self, rng):
        heights = jnp.asarray(rng.normal(size=(20, 30)))
        out = conditioning.resample(heights, (0.1, 0.3), (0.1, 0.3))
        np.testing.assert_allclose(out, heights, atol=1e-14)

    def test_adjoint_is_the_transpose(self, rng):
        heights, other = rng.normal(size=(20, 30)), rng.normal(size=(10, 45))

        def apply(h):
            return conditioning.resample(h, (0.1, 0.3), (0.2, 0.2))

        out, back = jax.vjp(apply, jnp.asarray(heights))
        left = np.sum(other * out)
        np.testing.assert_allclose(left, np.sum(heights * back(jnp.asarray(other))[0]), rtol=1e-12)

    def test_pixels_that_do_not_fit_are_refused(self):
        heights = jnp.zeros((20, 30))
        with pytest.raises(InputError, match=r"does not divide.*nearest that does is 0\.28571429"):
            conditioning.resample(heights, (0.1, 0.1), (0.3, 0.3), periodic=True)
        with pytest.raises(InputError, match="leaves 1 samples"):
            conditioning.resample(heights, (0.1, 0.1), (1.5, 0.1))


class TestRotate:
    def test_quarter_turns_move_x_towards_y(self):
        heights = np.zeros((5, 7))
        heights[2, 6] = 1.0  # on +x
        turned = conditioning.rotate(jnp.asarray(heights), math.pi / 2)
        assert turned.shape == (7, 5)
        assert turned[6, 2] == 1.0  # on +y
        again = conditioning.rotate(turned, -math.pi / 2)
        np.testing.assert_array_equal(again, heights)

    @pytest.mark.parametrize("degrees", [10, -30, 45, 80, 200])
    def test_a_wave_turns_by_the_angle(self, dtype, degrees):
        angle = math.radians(degrees)

        def wave(ny, nx, direction):
            y, x = np.mgrid[:ny, :nx]
            along = (x - (nx - 1) / 2) * math.cos(direction) + (y - (ny - 1) / 2) * math.sin(
                direction
            )
            return np.sin(2 * np.pi * along / 16 + 0.3)

        turned = conditioning.rotate(jnp.asarray(wave(90, 120, 0.2), dtype), angle)
        assert turned.dtype == dtype
        assert min(turned.shape) > 20
        inner = np.s_[6:-6, 6:-6]  # the mirrored edge bends the spline over a few pixels
        # Cubic splines at 16 samples a period: error of fourth order, (2 pi / 16)^4 / 100.
        np.testing.assert_allclose(
            turned[inner], wave(*turned.shape, 0.2 + angle)[inner], atol=5e-4
        )

    @pytest.mark.parametrize("degrees", [1, 20, 45, 70])
    @pytest.mark.parametrize("shape", [(50, 50), (40, 90), (90, 30)])
    def test_no_corner_lies_outside(self, shape, degrees):
        """The rectangle's corners lie inside the turned map, and one touches its edge."""
        angle = math.radians(degrees)
        turned = conditioning.rotate(jnp.zeros(shape), angle)
        half = [(n - 1) / 2 for n in turned.shape]
        c, s = math.cos(angle), math.sin(angle)
        reach_x = abs(half[1] * c) + abs(half[0] * s)
        reach_y = abs(half[1] * s) + abs(half[0] * c)
        assert reach_y <= (shape[0] - 1) / 2 + 1e-9
        assert reach_x <= (shape[1] - 1) / 2 + 1e-9
        assert max(reach_y - (shape[0] - 1) / 2, reach_x - (shape[1] - 1) / 2) > -1.5
