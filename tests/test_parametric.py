"""Closed-form spectra of parametric surfaces against the sampled transform of their heights."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
from lengths import but

import diffopt as do
from diffopt import gratings
from diffopt.errors import InputError
from diffopt.gratings import Reach
from diffopt.gratings.parametric import kinds, seen_in_power
from diffopt.kernels import bessel

SIGMA, LAM = 1.25, np.array([0.45, 0.6])
REACH = Reach(3, 32, 60.0, 24)
# A lattice vector of a 20 um patch: 10 periods of 2 um along (4, 3) / 5.
TURN = math.atan2(3.0, 4.0)


def ways(rng, count):
    radius, angle = np.sqrt(rng.uniform(0, 0.9, count)), rng.uniform(0, 2 * np.pi, count)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    return np.stack([x, y, np.sqrt(1 - x**2 - y**2)], -1)


def both(surface, size, rng, keys=(None,), edges="sharp"):
    """BRDF by the closed form, and by the transform of heights, averaged over keys."""
    wi, wo = np.broadcast_to(ways(rng, 1), (120, 3)), ways(rng, 120)
    closed = gratings.brdf(
        surface, *map(jnp.asarray, (wi, wo, LAM)), jnp.asarray(SIGMA), reach=REACH
    )
    sampled = [
        do.DiffractionBRDF(
            surface.heightfield((size, size), 20.0 / size, key=key, edges=edges), SIGMA
        ).prepare(pairs=(wi, wo), wavelengths=LAM, method="separable", tolerance=1e-6)(wi, wo)
        for key in keys
    ]
    return np.asarray(closed), np.mean(sampled, axis=0)


SINE = gratings.Sinusoidal(2.0, 0.1, 0.3, TURN)
EXACT = {
    # Samples of a sine are exact but for aliases and the method's 1e-6.
    "sinusoidal": (SINE, 256, "sharp", 1e-5),
    # Kinks and steps on 25 or 51 pixels a period: (m / n)^2 of an order.
    "trapezoid": (gratings.Trapezoid(2.0, 0.15, 0.4, 0.5, 0.1, TURN), 512, "sharp", 1e-3),
    "binary": (gratings.Binary(2.0, 0.1, 0.4, 0.1, TURN), 512, "averaged", 2e-2),
    "crossed": (
        gratings.Crossed(SINE, gratings.Trapezoid(2.0, 0.1, 0.3, 0.4, 0.0, TURN + math.pi / 2)),
        512,
        "sharp",
        1e-3,
    ),
}


@pytest.mark.parametrize("name", EXACT)
def test_gratings_at_an_angle(name, rng):
    surface, size, edges, tolerance = EXACT[name]
    closed, sampled = both(surface, size, rng, edges=edges)
    assert sampled.max() > 1e-2
    np.testing.assert_allclose(closed, sampled, atol=tolerance * sampled.max())


RANDOM = {
    "roughness": gratings.Roughness(0.05, 0.5),
    "superposed": gratings.Superposed(SINE, gratings.Roughness(0.05, 0.5)),
    "ridges": gratings.Ridges(SINE, 0.15, 2.0),
    "bumps": gratings.Bumps(0.1, 0.2, 0.5),
    "compactdisc": gratings.CompactDisc(pitch=20 / 12, shift=0.1),
}


@pytest.mark.parametrize("name", but({"superposed", "ridges"}, RANDOM))
def test_random_surfaces_on_average(name, rng):
    closed, sampled = both(RANDOM[name], 256, rng, jax.random.split(jax.random.key(0), 16))
    # Speckle of 16 patches of some 60 windows each leaves 3 % of a value; the ends of pits and
    # crossing bumps, which the closed forms leave out, some 5 %.
    np.testing.assert_allclose(closed, sampled, atol=0.06 * sampled.max())
    assert closed.sum() == pytest.approx(sampled.sum(), rel=0.08)
    faint = sampled < 0.1 * sampled.max()
    assert closed[faint].sum() == pytest.approx(sampled[faint].sum(), rel=0.25)


def test_jitter_is_the_mean_over_domains(rng):
    surface = gratings.Jittered(gratings.Sinusoidal(2.0, 0.1, 0.0, TURN), 0.03, 0.02)
    fx, fy = rng.uniform(-0.7, 0.7, 50), rng.uniform(-0.7, 0.7, 50)
    parts = tuple(map(jnp.asarray, (fx, fy, np.full(50, -20.0))))
    sigma_f = jnp.full(50, 0.1)

    def power(surface):
        return np.asarray(surface.components(*parts, REACH).power(sigma_f, sigma_f))

    # Frequencies scatter as (1 + 0.03 z1), angles as 0.02 z2: a Gauss-Hermite rule over both.
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    weights = weights / weights.sum()
    mean = sum(
        a * b * power(gratings.Sinusoidal(2.0 / (1 + 0.03 * s), 0.1, 0.0, TURN + 0.02 * t))
        for s, a in zip(nodes, weights, strict=True)
        for t, b in zip(nodes, weights, strict=True)
    )
    # The arc of angles is taken as straight: 0.02^2 / 2 of an order's distance.
    np.testing.assert_allclose(power(surface), mean, atol=2e-3 * mean.max())


def test_a_wall_of_nothing_is_a_step():
    kappa = jnp.asarray([-5.0, -20.0])
    values = {"period": 2.0, "depth": 0.13, "duty": 0.37, "shift": 0.2}
    binary = gratings.Binary(**values)
    trapezoid = gratings.Trapezoid(**values, wall=0.0)
    for order in range(-3, 4):
        np.testing.assert_allclose(
            trapezoid.order_amplitude(order, kappa),
            binary.order_amplitude(order, kappa),
            atol=1e-12,
        )


def test_averaged_steps_have_the_derivatives_of_the_closed_form():
    # |c_1|^2 of the averaged heights, by their transform, against the closed form.
    kappa, n, periods = -8.0, 512, 4

    def sampled(values):
        surface = gratings.Binary(values[0], values[1], values[2], 0.13)
        dx = periods * 2.0 / n
        line = surface.heights((2, n), dx, edges="averaged")[0]
        x = (jnp.arange(n, dtype=float) - n // 2) * dx
        phase = kappa * line - 2 * jnp.pi * x / values[0]
        # A window of whole periods that moves with the period would hide its derivative.
        window = jnp.exp(-0.5 * (x / 0.9) ** 2)
        window = window / window.sum()
        return (window * jnp.cos(phase)).sum() ** 2 + (window * jnp.sin(phase)).sum() ** 2

    def closed(values):
        surface = gratings.Binary(values[0], values[1], values[2], 0.13)
        m = jnp.arange(-40, 41)
        c = surface.order_amplitude(m, jnp.full(m.shape, kappa))
        # The window's transform at the distance of each order from the first.
        apart = 2 * jnp.pi * (m - 1).astype(float) / values[0]
        share = jnp.exp(-0.5 * (0.9 * apart) ** 2)
        return (c.real * share).sum() ** 2 + (c.imag * share).sum() ** 2

    at = jnp.asarray([2.0, 0.12, 0.37])
    # 128 pixels a period: edges between pixels cost 1 / 128 of what they change.
    assert float(sampled(at)) == pytest.approx(float(closed(at)), rel=0.01)
    np.testing.assert_allclose(jax.grad(sampled)(at), jax.grad(closed)(at), rtol=0.05, atol=2e-3)


def test_bessel_sequence():
    z = jnp.linspace(-60.0, 60.0, 101)
    found = bessel.bessel_sequence(z, 30, nodes=bessel.sequence_nodes(30, 60.0))
    expected = scipy.special.jv(np.arange(31)[:, None], np.asarray(z)[None])
    np.testing.assert_allclose(found, expected, atol=1e-14)
    picked = bessel.signed(found, jnp.asarray([[-3], [2], [31]]) * jnp.ones((1, 101), int))
    np.testing.assert_allclose(picked[0], -expected[3], atol=1e-14)
    np.testing.assert_array_equal(picked[2], 0.0)


MORE = [gratings.Blazed(2.0, 0.15, 0.2, TURN), gratings.Jittered(SINE, 0.03, 0.02)]


@pytest.mark.parametrize(
    "surface", [*(s for s, *_ in EXACT.values()), *RANDOM.values(), *MORE], ids=str
)
def test_power_has_the_gradient_of_differences(surface, rng):
    fx, fy = map(jnp.asarray, rng.uniform(-0.8, 0.8, (2, 40)))
    kappa, sigma_f = jnp.full(40, -12.0), jnp.full(40, 0.12)
    probe, names = jnp.asarray(rng.normal(size=40)), seen_in_power(surface)

    @jax.jit
    def total(values):
        moved = surface.replaced(dict(zip(names, values, strict=True)))
        found = moved.components(fx, fy, kappa, Reach(2, 16, 32.0, 12))
        return (found.power(sigma_f, sigma_f) * probe).sum()

    values = jnp.stack([surface.get(name) for name in names])
    slope = np.asarray(jax.grad(total)(values))
    for k in range(len(names)):
        step = 1e-6 * max(abs(float(values[k])), 0.1)
        up, down = (float(total(values.at[k].add(sign * step))) for sign in (1.0, -1.0))
        # Central differences: rounding 1e-16 / 1e-7 against slopes of order 1.
        assert slope[k] == pytest.approx((up - down) / (2 * step), rel=1e-4, abs=1e-6)


def test_what_is_wrong_is_said():
    with pytest.raises(InputError, match="Binary: duty must be a finite number, between 0 and 1"):
        gratings.Binary(1.0, 0.1, 1.5)
    with pytest.raises(InputError, match=r"Roughness: rms .* above 0 in um; received -1"):
        gratings.Roughness(-1.0, 0.5)
    with pytest.raises(InputError, match="gratings must differ in angle"):
        gratings.Crossed(SINE, SINE)
    with pytest.raises(InputError, match="drawn at random, pass key"):
        gratings.Roughness(0.1, 1.0).heights((32, 32), 0.2)
    with pytest.raises(InputError, match="Superposed: heights are drawn at random, pass key"):
        RANDOM["superposed"].heights((32, 32), 0.2)
    with pytest.raises(InputError, match="edges='round'"):
        RANDOM["bumps"].heights((32, 32), 0.2, edges="round", key=jax.random.key(0))
    assert kinds(RANDOM["ridges"])["grating.period"] == "length"
