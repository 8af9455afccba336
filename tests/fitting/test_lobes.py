"""Fits of lobes: published errors, energy, targets of every kind, settings, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

from diffopt import BlinnPhong, InputError, Lobes
from diffopt.fitting import LobeSettings, fit_environment, fit_lobes, fit_samples, fit_table
from diffopt.fitting.lobe_targets import map_directions, slices
from diffopt.fitting.lobes import Nodes, fit_nodes
from diffopt.kernels import mixture, quadrature
from diffopt.materials import Lambert, Merl, Microfacet, Mirror

SMALL = LobeSettings(rings=16, sectors=24)
THETA = np.radians([0.0, 30.0, 60.0, 80.0])
WO = np.stack([np.sin(THETA), 0 * THETA, np.cos(THETA)], -1)
EXPONENTS = (4.0, 16.0, 32.0, 64.0, 128.0)


@jax.jit
def fine(axes):
    """Grids of 11000 nodes about mirror directions, in float64."""
    return jax.vmap(lambda a: quadrature.polar_grid(a, 90, 128, jnp.asarray(0.5)))(axes)


@jax.jit
def valued(material, s):
    return material.f(s, jnp.broadcast_to(jnp.asarray(WO)[:, None], s.shape))


def reference(material):
    """Directions, solid angles and f cos on grids that no fit has seen."""
    s, solid = map(np.asarray, fine(WO * [-1, -1, 1]))
    f = np.asarray(valued(material, s))
    cos = np.maximum(s[..., 2], 0)
    return s, solid, f * cos.reshape(*cos.shape, *(1,) * (f.ndim - 2))


at = jax.jit(lambda lobes, s: lobes(s))


def errors(lobes, s, solid, values):
    missed = np.asarray(at(lobes, s)) - values
    return np.sqrt((solid * missed**2).sum(1) / (solid * values**2).sum(1))


@pytest.fixture(scope="module")
def wo():
    return jnp.asarray(WO, jnp.float32)


PUBLISHED = {1: 0.1766, 2: 0.0928, 4: 0.033}


@pytest.mark.parametrize("count", but({1, 4}, PUBLISHED))
def test_published_errors(count, wo):
    """The mean over 20 slices of Blinn-Phong, on an independent grid, and node by node."""
    found = []
    for exponent in EXPONENTS:
        settings = LobeSettings(energy="fitted")
        fit = fit_lobes(BlinnPhong(1.0, exponent), count, wo=wo, settings=settings)
        independent = errors(fit.lobes, *reference(BlinnPhong(1.0, exponent)))
        # The norm on 32 x 48 nodes is right to 4e-4; a fit to them is better there: four lobes
        # for the sharpest slice by .02, a seventh of its error.
        np.testing.assert_allclose(fit.error, independent, rtol=0.15, atol=4e-4)
        found.append(independent)
    mean = np.mean(found)
    if count == 1:  # one optimum: the four digits that were published
        assert mean == pytest.approx(PUBLISHED[count], abs=1e-4)
        expected = [0.099, 0.101, 0.124, 0.180], [0.015, 0.057, 0.223, 0.407]
        np.testing.assert_allclose([found[0], found[2]], expected, atol=6e-4)
    else:
        assert mean <= PUBLISHED[count]
        assert (np.array(found) < [[0.17], [0.17], [0.24], [0.3], [0.37]]).all()


@pytest.fixture(scope="module")
def restored(wo):
    """Two lobes, with the energy kept, on small grids; what other fits are compared with."""
    return fit_lobes(BlinnPhong(1.0, 32.0), 2, wo=wo, settings=SMALL)


@pytest.fixture(scope="module")
def nodes(wo):
    """What `restored` was fitted to."""
    return slices(BlinnPhong(1.0, 32.0), wo, SMALL)


def test_energy_is_kept(restored, nodes):
    wanted = (nodes.solid_angles * nodes.values[..., 0]).sum(1)
    # Sums of 384 terms in float32.
    np.testing.assert_allclose(restored.lobes.integral(), wanted, rtol=1e-5)
    fitted = fit_nodes(nodes, 2, settings=_with(energy="fitted"))
    off = np.abs(np.asarray(fitted.lobes.integral() / wanted) - 1)
    np.testing.assert_allclose(off, fitted.energy_error, atol=1e-5)
    assert off.max() > 1e-2  # else there was nothing to restore
    assert (np.asarray(fitted.error) < np.asarray(restored.error)).all()
    assert "energy off by" in str(restored)


def _with(**changes):
    return LobeSettings(rings=16, sectors=24, **changes)


def test_key_reproduces_and_batches_do_not_matter(restored, wo):
    again = fit_lobes(BlinnPhong(1.0, 32.0), 2, wo=wo, settings=SMALL, key=jax.random.key(0))
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(restored), strict=True):
        np.testing.assert_array_equal(one, other)
    other = fit_lobes(BlinnPhong(1.0, 32.0), 2, wo=wo, settings=SMALL, key=jax.random.key(1))
    assert not np.array_equal(other.lobes.mu, restored.lobes.mu)
    chunks = fit_lobes(BlinnPhong(1.0, 32.0), 2, wo=wo, settings=_with(chunk=2))
    # Other programs round otherwise; thirty steps in a flat valley.
    np.testing.assert_allclose(chunks.error, restored.error, rtol=2e-3)
    shaped = fit_lobes(BlinnPhong(1.0, 32.0), 2, wo=wo.reshape(2, 2, 3), settings=SMALL)
    assert shaped.lobes.mu.shape == (2, 2, 2, 3)
    np.testing.assert_array_equal(shaped.error.ravel(), restored.error)


def test_rounds_settle_and_never_do_harm(restored, nodes):
    more = fit_nodes(nodes, 2, settings=_with(rounds=8, energy="fitted"))
    assert bool(more.settled.all())
    first = SMALL.coarse_steps + SMALL.lm_steps
    steps = np.asarray(more.steps)
    assert ((steps - first) % SMALL.lm_steps == 0).all()
    assert (steps <= first + 7 * SMALL.lm_steps).all()
    # The square error of the least squares themselves never rises; restored, it is larger.
    assert (np.asarray(more.error) <= np.asarray(restored.error) * (1 + 1e-5)).all()
    assert "settled" in str(more)


def test_moments_are_the_closed_form(nodes, wo):
    fit = fit_lobes(BlinnPhong(1.0, 32.0), 1, wo=wo, method="moments", settings=SMALL)
    weights = np.asarray(nodes.solid_angles) * np.asarray(nodes.values[..., 0])
    moments = jax.jit(jax.vmap(lambda s, w: mixture.moments(s, w, 1e6)))
    alpha, mu, kappa = moments(nodes.directions, weights)
    np.testing.assert_allclose(fit.lobes.alpha[:, 0], alpha, rtol=1e-5)
    np.testing.assert_allclose(fit.lobes.mu[:, 0], mu, atol=1e-6)
    np.testing.assert_allclose(fit.lobes.kappa[:, 0], kappa, rtol=1e-4)
    np.testing.assert_array_equal(fit.steps, 0)
    with pytest.raises(InputError, match="1 for moments; received 2"):
        fit_lobes(BlinnPhong(), 2, wo=wo, method="moments")


def test_clamped_cosine_has_its_optimum():
    """kappa = 2.14376 with relative error .17737; halves of the sphere have grids of their own."""
    x, w = np.polynomial.legendre.leggauss(16)
    z, w = np.concatenate([x - 1, x + 1]) / 2, np.concatenate([w, w]) / 2
    phi = 2 * np.pi * np.arange(12) / 12
    sin = np.sqrt(1 - z * z)[:, None]
    s = np.stack([sin * np.cos(phi), sin * np.sin(phi), z[:, None] + 0 * phi], -1).reshape(-1, 3)
    solid = np.repeat(w * 2 * np.pi / 12, 12)
    values = np.maximum(s[:, 2], 0)
    fit = fit_table(s, values, solid, 1, settings=_with(energy="fitted"))
    # The optimum as it was given: five decimals.
    assert float(fit.lobes.kappa[0]) == pytest.approx(2.14376, abs=2e-5)
    assert float(fit.error) == pytest.approx(0.17737, abs=1e-5)
    np.testing.assert_allclose(fit.lobes.mu[0], [0, 0, 1], atol=1e-7)


@jax.jit
def known(s):
    s = jnp.asarray(s)
    mu = jnp.asarray([[0.6, 0.0, 0.8], [-0.6, 0.48, 0.64]], s.dtype)
    lobes = Lobes(jnp.asarray([1.0, 2.0], s.dtype), mu, jnp.asarray([20.0, 5.0], s.dtype))
    return lobes(s)


def test_function_of_lobes_is_found():
    fit = fit_lobes(known, 2, settings=_with(lm_steps=20))
    order = np.argsort(np.asarray(fit.lobes.alpha))
    np.testing.assert_allclose(np.asarray(fit.lobes.alpha)[order], [1, 2], rtol=1e-6)
    np.testing.assert_allclose(np.asarray(fit.lobes.kappa)[order], [20, 5], rtol=1e-6)
    assert fit.error.shape == ()
    # "auto": the first number that meets the tolerance, and no other.
    auto = fit_lobes(known, "auto", tolerance=0.02, settings=_with(lm_steps=20))
    assert auto.lobes.count == 2
    assert float(auto.error) <= 0.02


def test_signed_lobes_lower_the_error():
    """A lobe with a dimple, from a start that is right in kind: EM's own starts are positive."""
    s, solid = jax.jit(lambda: quadrature.polar_grid(jnp.asarray([0.0, 0.0, 1.0]), 16, 24))()
    away = np.asarray(s)[:, 2] - 1.0
    values = np.exp(5.0 * away) - 0.9 * np.exp(20.0 * away)
    nodes = Nodes(s[None], solid[None], jnp.asarray(values[None, :, None]))
    axes = np.array([[[0.0, 0.0, 1.0], [0.0, 0.1, 1.0]]])
    axes = jnp.asarray(axes / np.linalg.norm(axes, axis=-1, keepdims=True))
    kappa = jnp.asarray([[4.0, 15.0]])
    found = [
        fit_nodes(
            nodes,
            2,
            settings=_with(lm_steps=30, signed=signed, energy="fitted"),
            start=Lobes(jnp.asarray([[1.0, second]]), axes, kappa),
        )
        for signed, second in ((True, -0.2), (False, 0.2))
    ]
    assert float(found[0].error[0]) < 1e-6  # a sum of two such lobes, exactly
    assert float(found[0].lobes.alpha.min()) < 0
    assert float(found[1].error[0]) > 0.1
    assert float(found[1].lobes.alpha.min()) >= 0


def test_environment_with_a_sun():
    """A sky of three channels with a sun of one pixel, which keeps its place and its energy."""
    height, width = 16, 32
    s, solid = map_directions(height, width, dtype=jnp.float64)
    assert float(solid.sum()) == pytest.approx(4 * np.pi, rel=1e-12)
    z = np.asarray(s[:, 2])
    image = np.maximum(z, 0)[:, None] * [0.3, 0.5, 1.0] + 0.05
    sun = 3 * width + 7
    image[sun] += [300.0, 280.0, 240.0]
    fit = fit_environment(image.reshape(height, width, 3), 4, settings=_with(lm_steps=20))
    assert fit.lobes.alpha.shape == (4, 3)
    sharpest = int(np.argmax(np.asarray(fit.lobes.kappa)))
    assert float(fit.lobes.mu[sharpest] @ s[sun]) > np.cos(0.5 * np.pi / height)
    wanted = (np.asarray(solid)[:, None] * image).sum(0)
    np.testing.assert_allclose(fit.lobes.integral(), wanted, rtol=1e-12)
    # Of one cell a lobe of its size misses the corners: a fifth.
    assert float(fit.error) < 0.3
    assert bool((fit.lobes.alpha >= 0).all())


@pytest.mark.long
def test_rough_and_measured_materials(wo):
    """GGX in three channels, and a table of half and difference angles of a metallic gloss."""
    gold = [1.0, 0.8, 0.3] * Microfacet(0.4)
    theta = np.linspace(0, 1, 12) ** 2 * np.pi / 2
    gloss = 0.1 + 3 * np.exp(-((theta / 0.3) ** 2))
    table = Merl(np.broadcast_to(gloss[:, None, None, None], (12, 6, 8, 3)))
    for material, bound in ((gold, 0.25), (table, 0.25)):
        fit = fit_lobes(material, 3, wo=wo[1:2], settings=SMALL)
        assert fit.lobes.alpha.shape == (1, 3, 3)
        s, solid, values = (part[1] for part in reference(material))
        solid = solid[:, None]
        missed = np.asarray(at(fit.lobes[0], s.astype(np.float32))) - values
        error = np.sqrt((solid * missed**2).sum() / (solid * values**2).sum())
        # Far from the peak both fall slower than lobes: an exponential against a power.
        assert error < bound
        np.testing.assert_allclose(fit.lobes[0].integral(), (solid * values).sum(0), rtol=0.01)


def test_start_of_ones_own(restored, nodes):
    swapped = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[:, ::-1]), restored.lobes)
    again = fit_nodes(nodes, 2, settings=SMALL, start=swapped)
    # The order is kept: lobe j starts and stays near its own start.
    near = (again.lobes.mu * swapped.mu).sum(-1)
    assert float(near.min()) > 0.95
    with pytest.raises(InputError, match=r"start must be 4 times 3 lobes; received \(4, 2\)"):
        fit_nodes(nodes, 3, start=swapped)


def test_samples(rng):
    truth = Lobes(
        jnp.asarray([0.3, 0.7]),
        jnp.asarray([[0.6, 0, 0.8], [-0.8, 0, 0.6]]),
        jnp.asarray([40.0, 8.0]),
    )
    s = truth.sample(jax.random.key(0), 4000)
    two = fit_samples(s, "auto")
    assert two.count == 2
    # Standard errors of 2 % and less.
    np.testing.assert_allclose(np.sort(two.alpha), [0.3, 0.7], atol=0.04)
    np.testing.assert_allclose(np.sort(two.kappa), [8, 40], rtol=0.1)
    one = fit_samples(s, 1, weights=np.full(4000, 2.5))
    _, mu, kappa = mixture.moments(s, jnp.ones(4000), 1e6)
    assert float(one.alpha[0]) == pytest.approx(2.5)
    assert float(one.kappa[0]) == pytest.approx(float(kappa), rel=1e-12)
    np.testing.assert_allclose(one.mu[0], mu, atol=1e-14)
    alike = fit_samples(np.tile([[0.6, 0.0, 0.8]], (4000, 1)), 1)
    assert float(alike.kappa[0]) == pytest.approx(1e6, rel=1e-6)


UP = np.array([[0.0, 0.0, 1.0]])
SPHERE = np.array([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 0.6, -0.8]])
ONES = np.ones(4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: fit_samples(np.zeros((0, 3))), r"directions must be \[N, 3\] with N >= 1"),
        (lambda: fit_samples(SPHERE * np.nan), "directions must be unit vectors"),
        (lambda: fit_samples(2 * SPHERE), "received one of length 2"),
        (lambda: fit_samples(SPHERE[:, :2]), r"unit vectors \[\.\.\., 3\]; received shape"),
        (
            lambda: fit_samples(SPHERE, weights=-ONES),
            "weights must be finite and >= 0; received -1",
        ),
        (lambda: fit_samples(SPHERE, weights=ONES * np.nan), "weights must be finite"),
        (lambda: fit_samples(SPHERE, weights=0 * ONES), "all weights are zero"),
        (lambda: fit_samples(SPHERE, weights=ONES[:2]), r"weights must be \[4\]; received \(2,\)"),
        (lambda: fit_samples(SPHERE, 0), "lobes must be >= 1; received 0"),
        (lambda: fit_table(SPHERE, 0 * ONES, ONES), "function 0 is zero at every node"),
        (lambda: fit_table(SPHERE, -ONES, ONES), r"values to fit must be >= 0 \(or set signed"),
        (lambda: fit_table(SPHERE, ONES * np.nan, ONES), "values to fit must be finite"),
        (lambda: fit_table(SPHERE, ONES, -ONES), "solid_angles must be finite and >= 0"),
        (lambda: fit_table(SPHERE, ONES[:2], ONES), r"must be \[N, 3\], \[N\] or \[N, C\]"),
        (lambda: fit_table(2 * SPHERE, ONES, ONES), "directions must be unit vectors"),
        (lambda: fit_table(SPHERE, ONES, ONES, 0), "lobes must be 1 to 64"),
        (lambda: fit_table(SPHERE, ONES, ONES, "auto", tolerance=2.0), "relative error in"),
        (lambda: fit_environment(ONES), r"image must be \[H, W\] or \[H, W, C\]"),
        (lambda: fit_environment(np.zeros((0, 4))), "image must be"),
        (lambda: fit_lobes(Lambert(), wo=-UP), "wo must lie above the horizon; received z = -1"),
        (lambda: fit_lobes(Lambert(), wo=2 * UP), "wo must be unit vectors"),
        (
            lambda: fit_lobes(BlinnPhong(0.0, 32.0), 1, wo=np.float32(WO), settings=SMALL),
            "is zero at every node",
        ),
        (lambda: fit_lobes(Mirror(), wo=UP), "a perfect mirror or refraction is no function"),
        (lambda: fit_lobes(Lambert(), "auto"), "a whole BRDF takes a number of lobes"),
        (lambda: fit_lobes(known, wo=UP), "wo is for materials"),
        (lambda: fit_lobes(lambda s: s[0], settings=SMALL), r"function must return \[\d+\] or"),
        (lambda: LobeSettings(rings=4), "rings must be >= 8; received 4"),
        (lambda: LobeSettings(rounds=0), "rounds must be >= 1"),
        (lambda: LobeSettings(sharpest=0.5), r"sharpest must lie in \[1, 1e12\]"),
        (lambda: LobeSettings(settled=1.0), r"settled must lie in \[0, 1\)"),
    ],
)
def test_refusals(call, message):
    with pytest.raises(InputError, match=message):
        call()
