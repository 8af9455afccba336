import itertools
import json
import math
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from jax.test_util import check_grads

from diffopt.errors import InputError
from diffopt.gratings import Binary, Blazed, Sinusoidal, bessel_j

ORDERS = json.loads((Path(__file__).parent / "data" / "grating_orders.json").read_text())
WAVELENGTH, PERIOD = ORDERS["wavelength"], ORDERS["period"]

# Rounding of cosines of arguments up to some tens.
ROUNDING = {"float32": 2e-5, "float64": 1e-13}


def kappa_at_normal_incidence(order):
    cosine = math.sqrt(1 - (order * WAVELENGTH / PERIOD) ** 2)
    return jnp.asarray(-2 * math.pi / WAVELENGTH * (1 + cosine))


@pytest.mark.parametrize("case", ORDERS["sinusoidal"])
def test_sinusoidal_efficiencies(case):
    order, kappa = case["order"], kappa_at_normal_incidence(case["order"])

    def efficiency(amplitude):
        return Sinusoidal(PERIOD, amplitude, 0.7).order_efficiency(order, kappa)

    value, slope = jax.value_and_grad(efficiency)(jnp.asarray(case["amplitude"]))
    assert float(value) == pytest.approx(float(case["efficiency"]), abs=1e-12)
    # The derivative is kappa (25) times larger than the value.
    expected = float(case["d_efficiency_d_amplitude"])
    assert float(slope) == pytest.approx(expected, abs=1e-11)


@pytest.mark.parametrize("case", ORDERS["binary"])
def test_binary_efficiencies(case):
    value = Binary(PERIOD, 0.09, 0.5).order_efficiency(
        case["order"], kappa_at_normal_incidence(case["order"])
    )
    assert float(value) == pytest.approx(float(case["efficiency"]), abs=1e-12)


@pytest.mark.parametrize("case", ORDERS["blazed"])
def test_blazed_efficiencies(case):
    depth = PERIOD * math.tan(math.radians(5))
    value = Blazed(PERIOD, depth).order_efficiency(
        case["order"], kappa_at_normal_incidence(case["order"])
    )
    assert float(value) == pytest.approx(float(case["efficiency"]), abs=1e-12)


GRATINGS = {
    "sinusoidal": lambda dtype="float64": Sinusoidal(*(jnp.asarray(v, dtype) for v in (2, 0.1, 1))),
    "blazed": lambda dtype="float64": Blazed(*(jnp.asarray(v, dtype) for v in (2, 0.15, 0.2))),
    "binary": lambda dtype="float64": Binary(*(jnp.asarray(v, dtype) for v in (2, 0.1, 0.3, 0.2))),
}


@pytest.mark.parametrize("name", GRATINGS)
class TestEveryGrating:
    def test_amplitudes_are_the_fourier_integral_of_the_profile(self, name, dtype):
        """Gauss-Legendre on the pieces between the jumps, with 60 nodes each: exact here."""
        grating = GRATINGS[name](dtype)
        kappa = jnp.asarray(-18.3, dtype)
        # Jumps of the blazed profile at 0.4, of the binary one at 0.4 and 1.0.
        breaks = [-0.4, 0.4, 1.0, 1.6]
        nodes, weights = np.polynomial.legendre.leggauss(60)
        for order in (-7, -1, 0, 1, 2, 12):
            total = 0j
            for left, right in itertools.pairwise(breaks):
                x = (left + right) / 2 + (right - left) / 2 * nodes
                height = np.asarray(grating.profile(jnp.asarray(x, dtype)), np.float64)
                wave = np.exp(1j * float(kappa) * height - 2j * np.pi * order * x / 2)
                total += np.sum(weights * wave) * (right - left) / 2 / 2
            amplitude = grating.order_amplitude(order, kappa)
            assert amplitude.dtype == {"float32": "complex64", "float64": "complex128"}[dtype]
            np.testing.assert_allclose(amplitude, total, atol=ROUNDING[dtype])

    def test_orders_hold_all_the_energy(self, name):
        """Parseval: abs(exp(i kappa h)) is 1, so the efficiencies sum to 1."""
        orders = jnp.arange(-100, 101)
        total = GRATINGS[name]().order_efficiency(orders, jnp.full(201, -20.0)).sum()
        # Beyond order 100 a jump leaves 2 / (pi^2 100) of its squared height, at most 4.
        assert 0.99 < float(total) <= 1 + 1e-12
        if name == "sinusoidal":
            assert float(total) == pytest.approx(1.0, abs=1e-12)

    def test_sampled_heights_give_the_amplitudes(self, name):
        """The discrete sum over one period tends to c_m with the first power of the pixel."""
        grating, kappa, n = GRATINGS[name](), jnp.asarray(-18.3), 4000
        line = np.asarray(grating.heights((2, n), (1.0, 2 / n)))[0]
        x = (np.arange(n) - n // 2) * 2 / n
        for order in (-2, 0, 3):
            total = np.mean(np.exp(1j * float(kappa) * line - 1j * np.pi * order * x))
            np.testing.assert_allclose(total, grating.order_amplitude(order, kappa), atol=1e-3)

    def test_averaged_heights_are_means_over_pixels(self, name):
        grating = GRATINGS[name]()
        fine = grating.heights((1, 40 * 1000), (1.0, 0.1 / 1000))[0]
        coarse = grating.heights((3, 40), (1.0, 0.1), edges="averaged")
        assert coarse.shape == (3, 40)
        # Pixel 20 covers -0.05 to 0.05: fine samples from 20,000 - 500.
        means = np.roll(fine, 500).reshape(40, 1000).mean(axis=1)
        # The fine mean is off by half a fine pixel at a jump, 0.15 / 1000 / 2.
        np.testing.assert_allclose(coarse[0, 1:], means[1:], atol=2e-4)

    def test_averaged_heights_are_differentiable_in_every_parameter(self, name):
        grating = GRATINGS[name]()
        weights = jnp.asarray(np.random.default_rng(3).normal(size=(1, 53)))

        def functional(values):
            model = jax.tree.unflatten(jax.tree.structure(grating), values)
            return jnp.sum(weights * model.heights((1, 53), (1.0, 0.1), edges="averaged"))

        values = [jnp.asarray(v) for v in jax.tree.leaves(grating)]
        gradient = jax.grad(functional)(values)
        for index, slope in enumerate(gradient):
            step = 1e-6
            up = functional([v + step * (i == index) for i, v in enumerate(values)])
            down = functional([v - step * (i == index) for i, v in enumerate(values)])
            # Rounding 1e-16 / 1e-6 and the curvature of the profile over the step.
            np.testing.assert_allclose(slope, (up - down) / (2 * step), atol=1e-5, rtol=1e-5)

    def test_order_amplitudes_are_differentiable_in_every_parameter(self, name):
        grating = GRATINGS[name]()

        def functional(model):
            orders = jnp.arange(-3, 4)
            amplitude = model.order_amplitude(orders, jnp.linspace(-25.0, -20.0, 7))
            return jnp.sum(amplitude.real * 0.3 + amplitude.imag)

        # Central differences: step^2 times the third derivative, some 20^3.
        check_grads(functional, (grating,), order=1, eps=1e-5, atol=1e-5, rtol=1e-5)

    def test_heightfield_and_dtype(self, name, dtype):
        field = GRATINGS[name](dtype).heightfield((4, 20), 0.1)
        assert field.heights.dtype == dtype
        assert field.pixel == (0.1, 0.1)
        assert name in field.provenance.source

    def test_heights_repeat_with_the_period(self, name):
        # 37 samples a period: none falls on a jump.
        heights = GRATINGS[name]().heights((1, 74), (1.0, 2 / 37))
        np.testing.assert_allclose(heights[0, :37], heights[0, 37:], atol=1e-12)

    def test_unknown_edges_are_refused(self, name):
        with pytest.raises(InputError, match="edges='round'"):
            GRATINGS[name]().heights((4, 20), 0.1, edges="round")


def test_the_middle_pixel_lies_at_zero():
    for n in (20, 21):
        heights = Sinusoidal(1.7, 0.1).heights((1, n), 0.1)
        assert float(heights[0, n // 2]) == pytest.approx(0.1)


def test_a_blaze_rises_along_x():
    heights = Blazed(1.0, 0.2, -0.05).heights((1, 10), 0.1)
    assert (np.diff(heights[0, 5:]) > 0).all()


@pytest.mark.parametrize("order", [-3, 0, 1, 2, 17, 80])
def test_bessel_against_scipy(order, dtype):
    z = np.array([-150.0, -20.0, -1.0, -1e-3, 0.0, 1e-8, 0.5, 3.0, 40.0, 299.0])
    value = bessel_j(order, jnp.asarray(z, dtype))
    # Rounding of arguments up to 300 + 80 * 2 pi.
    tolerance = {"float32": 1e-4, "float64": 2e-13}[dtype]
    np.testing.assert_allclose(value, scipy.special.jv(order, z), atol=tolerance)


def test_bessel_derivative():
    z = jnp.asarray([-4.0, 0.0, 2.5, 60.0])
    slope = jax.vmap(jax.grad(lambda t: bessel_j(2, t)))(z)
    np.testing.assert_allclose(slope, scipy.special.jvp(2, np.asarray(z)), atol=1e-13)


def test_bessel_beyond_its_range_is_refused():
    with pytest.raises(Exception, match=r"reaches 400"):
        jax.block_until_ready(bessel_j(3, jnp.asarray(399.0)))
