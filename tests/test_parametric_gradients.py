"""Parametric surfaces: derivatives of heights, compiled and batched calls, hard values, turns."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

from diffopt import gratings
from diffopt.gratings import Reach
from diffopt.gratings.parametric import kinds

SHAPE, PIXEL = (48, 44), (0.11, 0.12)
KEY = jax.random.key(5)
REACH = Reach(2, 16, 32.0, 12)
SINE = gratings.Sinusoidal(1.9, 0.1, 0.3, 0.7)
BLAZED = gratings.Blazed(1.9, 0.15, 0.21, 0.4, 0.01)
SURFACES = {
    "sinusoidal": SINE,
    "blazed": BLAZED,
    "binary": gratings.Binary(1.9, 0.1, 0.37, 0.11, -0.5, 0.02),
    "trapezoid": gratings.Trapezoid(1.9, 0.15, 0.4, 0.5, 0.1, 0.9, 0.01),
    "crossed": gratings.Crossed(SINE, gratings.Trapezoid(1.4, 0.1, 0.3, 0.4, 0.2, 2.1)),
    "crossed-blazed": gratings.Crossed(SINE, gratings.Blazed(1.4, 0.1, 0.3, 2.1)),
    "jittered": gratings.Jittered(SINE, 0.03, 0.02),
    "jittered-blazed": gratings.Jittered(BLAZED, 0.03, 0.02),
    "ridges": gratings.Ridges(SINE, 0.15, 0.8),
    "ridges-binary": gratings.Ridges(gratings.Binary(1.9, 0.1, 0.37, 0.11, -0.5), 0.1, 0.8),
    "superposed": gratings.Superposed(BLAZED, gratings.Roughness(0.05, 0.5)),
    "roughness": gratings.Roughness(0.05, 0.5),
    "bumps": gratings.Bumps(0.1, 0.3, 0.5),
    "compactdisc": gratings.CompactDisc(width=0.3, wall=0.4, angle=0.3),
}
# How many bumps there are is drawn, and a disc's pits are made on the host: one draw has no
# derivative in the density, or in any parameter of the disc.
DRAWN = {"bumps": ("height", "size"), "compactdisc": ()}


def moving(surface):
    """Parameters that heights have derivatives in."""
    name = next((n for n, s in SURFACES.items() if s is surface), "")
    return DRAWN.get(name, tuple(kinds(surface)))


def power_at(surface, rng, count=40, kappa=-12.0, sigma=0.12, spread=0.8, reach=REACH):
    """|P|^2 at random frequencies, as a function of parameters by name."""
    dtype = surface.dtype
    fx, fy = (jnp.asarray(a, dtype) for a in rng.uniform(-spread, spread, (2, count)))
    fixed = jnp.full(count, kappa, dtype), jnp.full(count, sigma, dtype)

    def power(values):
        found = surface.replaced(values).components(fx, fy, fixed[0], reach)
        return found.power(fixed[1], fixed[1])

    return power


WITH_HEIGHTS = [name for name, surface in SURFACES.items() if moving(surface)]
# By day alone; every kind of grating is one of them or within one.
COMPOSED = {"crossed", "jittered-blazed", "ridges-binary", "superposed", "bumps"}


@pytest.mark.parametrize("name", WITH_HEIGHTS)
def test_averaged_heights_have_the_gradient_of_differences(name, rng):
    surface = SURFACES[name]
    names, probe = moving(surface), jnp.asarray(rng.normal(size=SHAPE))

    @jax.jit
    def total(values):
        moved = surface.replaced(dict(zip(names, values, strict=True)))
        return (probe * moved.heights(SHAPE, PIXEL, edges="averaged", key=KEY)).sum()

    values = jnp.stack([surface.get(path) for path in names])
    slope = np.asarray(jax.grad(total)(values))
    for k, path in enumerate(names):
        step = 1e-6 * max(abs(float(values[k])), 0.1)
        up, down = (float(total(values.at[k].add(sign * step))) for sign in (1.0, -1.0))
        # Rounding: sums of 2,112 heights of 0.1 to 1e-15, over 2e-7. Kinks, where an edge passes
        # a pixel's border within the step: none of some 500 in 2e-6 of a pixel is likely.
        assert slope[k] == pytest.approx((up - down) / (2 * step), rel=1e-5, abs=1e-6), path


@pytest.mark.parametrize("angle", [0.0, math.pi / 2])
def test_averaged_edges_have_the_derivatives_of_pixel_means(angle):
    """The mean over a pixel changes by the step's height where an edge in it moves by a pixel."""
    period, depth, duty, shift, n, dx = 1.7, 0.13, 0.37, 0.113, 61, 0.1
    shape = (1, n) if angle == 0.0 else (n, 1)
    x = (np.arange(n) - n // 2) * dx
    k = np.arange(-3, 3)

    def inside(place):
        return np.abs(x[:, None] - place[None, :]) < 0.5 * dx

    def heights(kind):
        def at(values):
            made = kind(values[0], depth, *values[1:], shift, angle)
            return made.heights(shape, dx, edges="averaged").reshape(-1)

        return at

    rise, fall = (shift + k) * period, (shift + duty + k) * period
    slopes = np.asarray(jax.jacfwd(heights(gratings.Binary))(jnp.asarray([period, duty])))
    by_period = inside(fall) @ (shift + duty + k) - inside(rise) @ (shift + k)
    np.testing.assert_allclose(slopes[:, 0], depth / dx * by_period, atol=1e-10)
    np.testing.assert_allclose(slopes[:, 1], depth / dx * period * inside(fall).sum(1), atol=1e-10)
    assert (inside(fall).sum(1) > 0).sum() >= 3
    # Teeth stretch as well: -depth x / period^2 between the jumps.
    slopes = np.asarray(jax.jacfwd(heights(gratings.Blazed))(jnp.asarray([period])))
    expected = -depth * x / period**2 + depth / dx * (inside(rise) @ (shift + k))
    np.testing.assert_allclose(slopes[:, 0], expected, atol=1e-10)


@pytest.mark.parametrize("name", but(COMPOSED, WITH_HEIGHTS))
def test_heights_compiled_and_batched(name, rng):
    surface = SURFACES[name]
    names = moving(surface)

    def heights(values):
        moved = surface.replaced(dict(zip(names, values, strict=True)))
        return moved.heights(SHAPE, PIXEL, edges="averaged", key=KEY)

    values = jnp.stack([surface.get(path) for path in names])
    many = values[None] * jnp.asarray(rng.uniform(0.9, 1.1, (3, len(names))))
    loop = np.stack([np.asarray(heights(one)) for one in many])
    # A jump between pixels is where rounding of another order of operations shows most:
    # heights of 0.1, an antiderivative of some 1, over a pixel of 0.1.
    np.testing.assert_allclose(jax.vmap(heights)(many), loop, atol=1e-13)
    np.testing.assert_allclose(jax.jit(heights)(many[0]), loop[0], atol=1e-13)


@pytest.mark.parametrize("name", but(COMPOSED | {"compactdisc"}, SURFACES))
def test_power_compiled_and_batched(name, rng):
    surface = SURFACES[name]
    names, power = tuple(kinds(surface)), power_at(surface, rng)

    def of(values):
        return power(dict(zip(names, values, strict=True)))

    values = jnp.stack([surface.get(path) for path in names])
    many = values[None] * jnp.asarray(rng.uniform(0.9, 1.1, (3, len(names))))
    loop = np.stack([np.asarray(of(one)) for one in many])
    # Rounding of phases of some tens of radians.
    np.testing.assert_allclose(jax.vmap(of)(many), loop, atol=1e-13, rtol=1e-11)
    np.testing.assert_allclose(jax.jit(of)(many[0]), loop[0], atol=1e-13, rtol=1e-11)


# Amplitudes of 20 wavelengths of 0.6 um make phases of 235 rad in reflection.
DEEP, PHASE = 12.0, 260.0
FAR = Reach(2, 300, PHASE, 64)
LONG = {"sigma": 1e-3, "spread": 0.02, "reach": Reach(4, 64, 32.0, 16)}
HARD = {
    "sinusoidal-long": (gratings.Sinusoidal(1e3, 0.1, 0.0, 0.4), LONG),
    "binary-long": (gratings.Binary(1e3, 0.1, 0.37, 0.1, 0.4), LONG),
    "trapezoid-long": (gratings.Trapezoid(1e3, 0.1, 0.37, 0.4, 0.1, 0.4), LONG),
    "ridges-long": (gratings.Ridges(gratings.Sinusoidal(1e3, 0.1, 0.0, 0.4), 20.0, 300.0), LONG),
    "sinusoidal-deep": (gratings.Sinusoidal(20.0, DEEP, 0.0, 0.4), {"reach": FAR}),
    "blazed-deep": (gratings.Blazed(80.0, DEEP, 0.0, 0.4), {"reach": FAR}),
    "binary-deep": (gratings.Binary(2.0, DEEP, 0.37, 0.1, 0.4), {"reach": FAR}),
    "trapezoid-deep": (gratings.Trapezoid(20.0, DEEP, 0.37, 0.4, 0.1, 0.4), {"reach": FAR}),
    "crossed-deep": (
        gratings.Crossed(gratings.Sinusoidal(20.0, DEEP), gratings.Binary(2.0, DEEP, angle=1.5)),
        {"reach": FAR},
    ),
    "superposed-deep": (
        gratings.Superposed(gratings.Binary(2.0, DEEP), gratings.Roughness(1.2, 20.0)),
        {"reach": FAR},
    ),
    "disc-deep": (gratings.CompactDisc(depth=DEEP), {"reach": FAR}),
    **{
        f"{kind.__name__.lower()}-{duty:g}": (kind(2.0, 0.1, duty), {})
        for kind in (gratings.Binary, gratings.Trapezoid)
        for duty in (0.0, 1e-5, 1.0 - 1e-5, 1.0)
    },
    "jittered-0": (gratings.Jittered(SINE), {}),
    "ridges-still": (gratings.Ridges(SINE, 1e-6, 1.0), {}),
}


# By night alone: each is within another, or close to one.
WITHIN = {"sinusoidal-deep", "binary-deep", "binary-long", "ridges-still"}


@pytest.mark.parametrize("name", but(set(HARD) - WITHIN, HARD))
def test_single_precision_at_hard_values(name, rng):
    """Values and slopes in float32 against float64, at the same rounded parameters."""
    surface, options = HARD[name]
    # No whole number of turns over DEEP, at which steps would be a mirror.
    kappa = -2.0 * math.pi * 1.87 / 0.6
    found = {}
    for dtype in ("float32", "float64"):
        one = jax.tree.map(lambda a, d=dtype: jnp.asarray(np.float32(a), d), surface)
        at = power_at(one, np.random.default_rng(3), kappa=kappa, **options)
        values = {path: one.get(path) for path in kinds(one)}
        found[dtype] = at(values)
        assert found[dtype].dtype == dtype
        slopes = jax.grad(lambda v, at=at: at(v).sum())(values)
        assert all(np.isfinite(slope) for slope in slopes.values())
    single, double = (np.asarray(found[d], np.float64) for d in ("float32", "float64"))
    # 235 rad are rounded to 1.4e-5; some of them add up.
    np.testing.assert_allclose(single, double, atol=5e-5 * double.max())


@pytest.mark.parametrize("name", but(COMPOSED | {"compactdisc"}, SURFACES))
def test_symmetric_says_what_a_half_turn_changes(name, rng):
    surface = SURFACES[name]
    fx, fy = map(jnp.asarray, rng.uniform(-0.8, 0.8, (2, 60)))
    kappa, sigma_f = jnp.full(60, -12.0), jnp.full(60, 0.12)
    here, turned = (
        np.asarray(surface.components(s * fx, s * fy, kappa, REACH).power(sigma_f, sigma_f))
        for s in (1.0, -1.0)
    )
    # Nearest orders are the same but for their sign: rounding.
    apart = np.abs(here - turned).max() / here.max()
    assert surface.symmetric == (apart < 1e-9)
    assert surface.symmetric == ("blazed" not in name and name != "superposed")
