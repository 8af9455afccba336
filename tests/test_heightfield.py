import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.errors import InputError
from diffopt.heightfield import Heightfield, Provenance


def wave(shape=(20, 30), dtype="float64"):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (0.05 * np.sin(2 * np.pi * x / 10) + 0.01 * y).astype(dtype)


def test_shape_extent_and_dtype(dtype):
    scan = Heightfield(jnp.asarray(wave(dtype=dtype)), (0.1, 0.2))
    assert scan.heights.dtype == dtype
    assert scan.shape == (20, 30)
    assert scan.extent == (pytest.approx(2.0), pytest.approx(6.0))
    assert Heightfield(scan.heights, 0.1).pixel == (0.1, 0.1)
    for other in (scan.levelled(), scan.cropped(rows=(2, 9)), scan.squared(), scan.filled()):
        assert other.heights.dtype == dtype


@pytest.mark.parametrize(
    ("heights", "text"),
    [
        (np.zeros(5), r"expected a floating-point \[ny, nx\].*float64 \(5,\)"),
        (np.zeros((3, 3), dtype=int), "received int64"),
        (np.zeros((3, 3), dtype=complex), "received complex128"),
        (np.zeros((1, 3)), "at least 2 x 2 pixels, received"),
        (np.full((3, 3), np.inf), "infinity"),
        (np.full((3, 3), np.nan), "9 of 9 pixels are missing"),
    ],
)
def test_heights_are_refused(heights, text):
    with pytest.raises(InputError, match=text):
        Heightfield(heights, 0.1)


@pytest.mark.parametrize("pixel", [0.0, -0.1, math.nan, math.inf, (0.1, 0.0)])
def test_pixel_is_refused(pixel):
    with pytest.raises(InputError, match="expected one positive number or a pair"):
        Heightfield(wave(), pixel)


def test_missing_pixels_are_kept_filled_or_refused():
    heights = wave()
    heights[5, 7] = heights[0, 0] = np.nan
    with pytest.raises(InputError, match=r"2 of 600 pixels are missing.*\.filled\(\)"):
        Heightfield(heights, 0.1)
    kept = Heightfield(heights, 0.1, missing="keep")
    assert kept.missing == 2
    assert kept.levelled().missing == 2
    for method in (kept.statistics, lambda: kept.resampled(0.2), lambda: kept.rotated(10)):
        with pytest.raises(InputError, match="missing"):
            method()
    with pytest.raises(InputError, match="missing='drop'"):
        Heightfield(heights, 0.1, missing="drop")
    filled = Heightfield(heights, 0.1, missing="fill")
    assert filled.missing == 0
    assert filled.provenance.filled == 2
    assert "filled 2 missing pixels" in filled.provenance.steps[-1]
    # Nothing to fill: nothing recorded.
    assert filled.filled() is filled


def test_history_is_kept_in_order_and_hashable():
    scan = Heightfield(wave(), 0.1, provenance=Provenance("wave"))
    done = scan.levelled(by="line").cropped(size=1.0).flipped().resampled(0.2).rotated(90)
    words = ("each scan line", "cropped", "reverse", "resampled", "rotated by 90")
    assert len(done.provenance.steps) == len(words)
    for step, word in zip(done.provenance.steps, words, strict=True):
        assert word in step
    assert hash(done.provenance) != hash(scan.provenance)
    assert scan.provenance.steps == ()


def test_crop_by_index_and_by_size():
    scan = Heightfield(wave(), (0.1, 0.2))
    part = scan.cropped(rows=(3, 8), columns=(10, 30))
    np.testing.assert_array_equal(part.heights, scan.heights[3:8, 10:30])
    centre = scan.cropped(size=(1.0, 2.0))
    np.testing.assert_array_equal(centre.heights, scan.heights[5:15, 10:20])


@pytest.mark.parametrize(
    "part",
    [
        {"rows": (-1, 5)},
        {"rows": (5, 21)},
        {"rows": (5, 6)},
        {"columns": (9, 3)},
        {"size": 2.5},
        {"size": 0.1},
    ],
)
def test_crop_outside_is_refused(part):
    with pytest.raises(InputError, match="of a map of 20 x 30 pixels"):
        Heightfield(wave(), 0.1).cropped(**part)


def test_crop_takes_one_way_only():
    with pytest.raises(InputError, match="either size or rows"):
        Heightfield(wave(), 0.1).cropped(size=1.0, rows=(0, 5))


def test_square_pixels_keep_the_extent_and_the_surface():
    x = np.arange(60) * 0.1
    scan = Heightfield(np.tile(np.sin(2 * np.pi * x / 3), (24, 1)), (0.25, 0.1))
    square = scan.squared(periodic=True)
    assert square.pixel == (0.1, 0.1)
    assert square.extent == (pytest.approx(6.0), pytest.approx(6.0))
    # Constant along y: the filter's weights sum to one to rounding.
    np.testing.assert_allclose(square.heights, np.tile(scan.heights[:1], (60, 1)), atol=1e-12)
    assert square.squared() is square


def test_rotation_needs_square_pixels_but_for_quarter_turns():
    scan = Heightfield(wave(), (0.1, 0.2))
    with pytest.raises(InputError, match=r"not square; call \.squared\(\)"):
        scan.rotated(10)
    with pytest.raises(InputError, match="finite number of degrees"):
        scan.rotated(math.nan)
    turned = scan.rotated(-270)
    assert turned.pixel == (0.2, 0.1)
    assert turned.shape == (30, 20)
    assert scan.rotated(180).pixel == scan.pixel


def test_level_options():
    scan = Heightfield(wave(), 0.1)
    np.testing.assert_array_equal(scan.levelled().heights, scan.levelled(1).heights)
    np.testing.assert_array_equal(scan.levelled(by="polynomial").heights, scan.levelled(2).heights)
    with pytest.raises(InputError, match="by='sphere'"):
        scan.levelled(by="sphere")
    with pytest.raises(InputError, match="order=9"):
        scan.levelled(9)


def test_statistics_need_a_map_of_some_size():
    with pytest.raises(InputError, match="at least 4 x 4"):
        Heightfield(np.zeros((3, 8)), 0.1).statistics()


class TestSampling:
    smooth = Heightfield(0.01 * wave(), 0.1)

    def test_alias_limit_is_the_wavelength_over_twice_u(self):
        self.smooth.check_sampling(0.4001)
        with pytest.raises(InputError, match=r"pixel 0\.1 um.*at most 0\.095 um will do"):
            self.smooth.check_sampling(0.38)
        # The pixel that the text names does pass.
        Heightfield(self.smooth.heights, 0.095).check_sampling(0.38)

    def test_the_shortest_of_several_wavelengths_counts(self):
        with pytest.raises(InputError, match=r"wavelength 0\.38 um"):
            self.smooth.check_sampling(np.array([0.78, 0.38, 0.5]))

    def test_the_coarser_axis_counts(self):
        with pytest.raises(InputError, match=r"pixel 0\.2 um"):
            Heightfield(self.smooth.heights, (0.05, 0.2)).check_sampling(0.38)

    def test_the_widest_angle_counts(self):
        scan = Heightfield(self.smooth.heights, 0.19)
        scan.check_sampling(0.38, max_angle=math.pi / 6)
        scan.check_sampling(0.38, u_max=1.0)
        scan.check_sampling(0.38, u_max=0.0)
        with pytest.raises(InputError, match=r"\|u\| up to 1\.035"):
            scan.check_sampling(0.38, max_angle=math.asin(0.5175))

    def test_steep_steps_are_refused_unless_they_are_jumps(self):
        step = np.zeros((8, 8))
        step[:, 4:] = 0.1
        scan = Heightfield(step, 0.05)
        with pytest.raises(InputError, match=r"along x differ by up to 0\.1 um.*less than 0\.095"):
            scan.check_sampling(0.38)
        scan.check_sampling(0.38, jumps=True)
        scan.check_sampling(0.41)

    @pytest.mark.parametrize(
        ("arguments", "text"),
        [
            ({"wavelength": 0.0}, "wavelength=0.0"),
            ({"wavelength": np.zeros(0)}, "wavelength=inf"),
            ({"wavelength": 0.5, "u_max": 2.5}, "u_max=2.5"),
            ({"wavelength": 0.5, "max_angle": 2.0}, "max_angle=2.0"),
            ({"wavelength": 0.5, "max_angle": 1.0, "u_max": 1.0}, "either"),
        ],
    )
    def test_arguments(self, arguments, text):
        with pytest.raises(InputError, match=text):
            self.smooth.check_sampling(**arguments)


def test_passes_through_jit_grad_and_vmap():
    scan = Heightfield(wave(), 0.1)

    @jax.jit
    def energy(s):
        return jnp.sum(s.levelled().resampled(0.2).heights ** 2)

    gradient = jax.grad(energy)(scan)
    assert isinstance(gradient, Heightfield)
    assert gradient.pixel == scan.pixel
    # A plane changes nothing after levelling: its inner product with the gradient is zero to
    # rounding.
    plane = np.add.outer(np.arange(20.0), 2.0 * np.arange(30.0))
    assert abs(np.sum(plane * gradient.heights)) < 1e-10
    # Central difference along one direction: error of second order, 1e-4 squared.
    direction = np.random.default_rng(1).normal(size=scan.shape)
    moved = [
        energy(eqx.tree_at(lambda s: s.heights, scan, scan.heights + t * direction))
        for t in (1e-4, -1e-4)
    ]
    expected = (moved[0] - moved[1]) / 2e-4
    np.testing.assert_allclose(np.sum(direction * gradient.heights), expected, rtol=1e-7)
    stack = jax.tree.map(lambda h: jnp.stack([h, 2 * h]), scan)
    np.testing.assert_allclose(
        jax.vmap(energy)(stack), [energy(scan), 4 * energy(scan)], rtol=1e-12
    )
