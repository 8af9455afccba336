"""Mixtures of lobes by expectation maximisation: degenerate cases, recovery, symmetries."""

import json
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import Lobes
from diffopt.kernels import mixture, quadrature
from diffopt.kernels.langevin import langevin, langevin_slope
from diffopt.kernels.mixture import Mixture

CASES = json.loads((Path(__file__).parents[1] / "data" / "vmf.json").read_text())["fit_cases"]
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
CAP = 1e6
STEPS = 50
# Directions of every problem, padded with weights of zero: one program for all.
SIZE = 64


def padded(samples, weights, dtype, size=SIZE):
    s = np.broadcast_to([0.0, 0.0, 1.0], (size, 3)).copy()
    w = np.zeros(size)
    s[: len(samples)], w[: len(samples)] = samples, weights
    return jnp.asarray(s, dtype), jnp.asarray(w, dtype)


def stacked(problems, dtype, size=SIZE):
    return tuple(
        jnp.stack(x) for x in zip(*(padded(*p, dtype, size) for p in problems), strict=True)
    )


def ring(theta, count):
    phi = 2 * np.pi * np.arange(count) / count
    sin = np.sin(theta)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), np.cos(theta) + 0 * phi], -1)


@jax.jit
@jax.vmap
def moments(s, w):
    return mixture.moments(s, w, 1e9)


@jax.jit
@jax.vmap
def slopes(s, w):
    def total(s, w):
        alpha, mu, kappa = mixture.moments(s, w, 1e9)
        return alpha + mu.sum() + kappa

    return jax.grad(total, (0, 1))(s, w)


@jax.jit
def fitted(s, w, start):
    return jax.vmap(lambda s, w, start: mixture.expectation_maximisation(s, w, start, STEPS, CAP))(
        s, w, start
    )


log_likelihood = jax.jit(mixture.log_likelihood)


@partial(jax.jit, static_argnums=3)
def scattered_fit(keys, s, w, count):
    """The same problem from several starts."""

    def one(key):
        start = mixture.scattered_start(key, s, w, count, CAP)
        return mixture.expectation_maximisation(s, w, start, STEPS, CAP)

    return jax.vmap(one)(keys)


@jax.jit
def started(keys, s, w):
    """Starts of two lobes of either kind."""
    return jax.vmap(
        lambda k, s, w: (
            mixture.scattered_start(k, s, w, 2, CAP),
            mixture.split_start(s, w, 2, CAP),
        )
    )(keys, s, w)


def test_cases_of_one_lobe(dtype):
    """Identical samples, one, weights of zero, cancelling ones, rings: see the data."""
    found = moments(*stacked([(c["samples"], c["weights"]) for c in CASES], dtype))
    alpha, mu, kappa = (np.asarray(x, np.float64) for x in found)
    for i, case in enumerate(CASES):
        name, expected = case["name"], case["expect"]
        assert alpha[i] == np.sum(case["weights"]), name  # small integers and 2.5
        assert np.linalg.norm(mu[i]) == pytest.approx(1, abs=4 * EPS[dtype]), name
        if "mu" in expected:
            np.testing.assert_allclose(mu[i], expected["mu"], atol=4 * EPS[dtype], err_msg=name)
        if expected["kappa"] == "cap":
            # 1 / cap was the complement, on which kappa is inverted.
            assert kappa[i] == pytest.approx(1e9, rel=1e-3), name
        else:
            # Sums of up to 12 rounded directions; about 0 an eps of length is 3 of kappa.
            tolerance = 32 * EPS[dtype]
            assert kappa[i] == pytest.approx(expected["kappa"], rel=tolerance, abs=tolerance), name


def test_slopes_of_moments_are_finite(dtype):
    none = [(CASES[0]["samples"], np.zeros(len(CASES[0]["samples"])))]
    found = slopes(*stacked([(c["samples"], c["weights"]) for c in CASES] + none, dtype))
    assert all(bool(jnp.isfinite(x).all()) for x in found)


def test_clamped_cosine(dtype):
    """Mean and concentration of max(z, 0), by Gauss's rule in z over the half where it is not 0."""
    x, weight = np.polynomial.legendre.leggauss(8)
    z = (x + 1) / 2
    s = np.concatenate([ring(np.arccos(t), 8) for t in z])
    w = np.repeat(weight * z * np.pi / 8, 8)
    alpha, mu, kappa = (np.asarray(a)[0] for a in moments(*stacked([(s, w)], dtype)))
    assert float(alpha) == pytest.approx(np.pi, rel=16 * EPS[dtype])
    np.testing.assert_allclose(mu, [0, 0, 1], atol=4 * EPS[dtype])
    assert float(kappa) == pytest.approx(2.951500029474472, rel=64 * EPS[dtype])


def test_tight_ring_in_either_type(dtype):
    """kappa = 2e8 from the spread: from the length alone float32 finds infinity."""
    # On dyadic numbers about z, so that rounding of the directions has no part in it.
    step = 2.0**-14 + 2.0**-15
    s = np.array([[step, 0, 1], [-step, 0, 1], [0, step, 1], [0, -step, 1]])
    # Their mean square distance from the mean is step^2, beside it they are off the sphere by
    # half of it, which the complement does not feel: q = step^2 / 2.
    _, _, kappa = moments(*stacked([(s, np.ones(4))], dtype))
    assert float(kappa[0]) == pytest.approx(2 / step**2, rel=1e-6)
    assert 2 / step**2 > 2e8


def random_problems(rng, count=6):
    problems = []
    for _ in range(count):
        s = rng.normal(size=(SIZE, 3)) + 2 * rng.normal(size=(2, 3)).repeat(SIZE // 2, 0)
        problems.append((s / np.linalg.norm(s, axis=1, keepdims=True), rng.uniform(0, 1, SIZE)))
    return problems


@pytest.fixture
def batch(rng, dtype):
    s, w = stacked(random_problems(rng), dtype)
    scattered, split = started(jax.random.split(jax.random.key(1), len(s)), s, w)
    return s, w, scattered, split


def test_likelihood_never_falls(batch, dtype):
    s, w, *starts = batch
    for start in starts:
        found, likelihood = fitted(s, w, start)
        rise = np.diff(np.asarray(likelihood, np.float64), axis=1)
        # Means of terms up to 5 nats.
        assert rise.min() >= -32 * EPS[dtype]
        assert rise.max() > 1e-3  # it did something
        for i in (0, 1):
            last = log_likelihood(s[i], w[i], Mixture(*(x[i] for x in found)))
            assert float(last) >= float(likelihood[i, -1]) - 32 * EPS[dtype]
        np.testing.assert_allclose(
            np.exp(np.asarray(found.log_share)).sum(1), 1, rtol=16 * EPS[dtype]
        )
        np.testing.assert_allclose(np.linalg.norm(found.mu, axis=-1), 1, atol=8 * EPS[dtype])


def test_symmetries_and_single_problems(batch, dtype, rng):
    """Permuted, rotated, weighed twice, alone: the same fit; fifty steps amplify rounding."""
    s, w, start, _ = batch
    expected, likelihood = fitted(s, w, start)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    order = rng.permutation(SIZE)

    def turned(x):
        return jnp.asarray(np.asarray(x, np.float64) @ turn.T, dtype)

    def close(found, mixture_expected, atol=2e4 * EPS[dtype]):
        for one, other in zip(found, mixture_expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=atol, atol=atol)

    close(fitted(s[:, order], w[:, order], start)[0], expected)
    close(fitted(s, 2 * w, start)[0], expected, 16 * EPS[dtype])
    rotated, _ = fitted(turned(s), w, start._replace(mu=turned(start.mu)))
    close(rotated, expected._replace(mu=turned(expected.mu)))
    swapped, _ = fitted(s, w, jax.tree.map(lambda x: x[:, ::-1], start))
    close(swapped, jax.tree.map(lambda x: x[:, ::-1], expected))
    alone, steps = fitted(*jax.tree.map(lambda x: x[2:3], (s, w, start)))
    close(jax.tree.map(lambda x: x[0], alone), jax.tree.map(lambda x: x[2], expected))
    np.testing.assert_allclose(steps[0], likelihood[2], atol=1e3 * EPS[dtype])


def test_one_program_for_all(batch):
    s, w, start, split = batch
    fitted(s, w, start)
    before = fitted._cache_size()
    for _ in range(2):
        fitted(s + 0, w, split)
    assert fitted._cache_size() == before


def test_lobes_that_coincide_or_die(dtype, rng):
    """Degenerate starts and data, in one batch; nothing is NaN."""
    s, w = random_problems(rng, 1)[0]
    few = ([[1, 0, 0], [0, 0.6, 0.8]], [1.0, 3.0])
    given = stacked([(s, w), few, (s, 0 * w), (s, w), few], dtype)
    axes = np.array([[0.6, 0, 0.8], [0.6, 0, 0.8]])
    apart = np.array([[0.6, 0, 0.8], [-0.6, 0, -0.8]])
    near = np.array([[0.8, 0, 0.6], [0, 0, 1]])
    start = Mixture(
        jnp.asarray(np.log([[0.5, 0.5]] * 5), dtype),
        jnp.asarray(np.stack([axes, axes, apart, apart, near]), dtype),
        # The fourth: a lobe so sharp, and so far from all samples, that it owns none.
        jnp.asarray([[3.0, 3.0], [3.0, 3.0], [3.0, 5.0], [3.0, 1e6], [5.0, 5.0]], dtype),
    )
    found, likelihood = fitted(*given, start)
    assert all(bool(jnp.isfinite(x).all()) for x in (*found, likelihood))
    share, mu, kappa = (np.asarray(x, np.float64) for x in found)
    # Coincident: both stay the one lobe of the whole.
    _, axis, single = (np.asarray(x, np.float64) for x in moments(*(x[:2] for x in given)))
    for i in (0, 1):
        np.testing.assert_allclose(share[i], np.log(0.5), atol=32 * EPS[dtype])
        # EM's own slope is zero there: what is left is the rounding of one step.
        np.testing.assert_allclose(kappa[i], single[i], rtol=64 * EPS[dtype])
        np.testing.assert_allclose(mu[i], np.stack([axis[i]] * 2), atol=16 * EPS[dtype])
    # Without weight every lobe is dead and stays where it was.
    for i, which in ((2, slice(None)), (3, slice(1, 2))):
        np.testing.assert_array_equal(share[i, which], -1e4)
        np.testing.assert_array_equal(mu[i, which], np.asarray(start.mu)[i, which])
        np.testing.assert_array_equal(kappa[i, which], np.asarray(start.kappa)[i, which])
    # Lobes on one direction each end at the cap, on top of it.
    np.testing.assert_allclose(kappa[4], CAP, rtol=1e-6)
    np.testing.assert_allclose(np.exp(share[4]), [0.25, 0.75], rtol=32 * EPS[dtype])
    np.testing.assert_allclose(mu[4], few[0], atol=16 * EPS[dtype])


@pytest.mark.float32
def test_more_lobes_than_directions():
    dtype = "float32"
    s, w = padded([[0.6, 0, 0.8], [0, 0, 1]], [1.0, 1.0], dtype)
    found, likelihood = scattered_fit(jax.random.split(jax.random.key(0), 3), s, w, 4)
    assert all(bool(jnp.isfinite(x).all()) for x in (*found, likelihood))
    assert float(found.kappa.max()) <= CAP * (1 + EPS[dtype])
    # Two lobes at the cap, half of all each, are the likeliest there is; and are found.
    best = np.log(CAP / (2 * np.pi) / 2)
    np.testing.assert_allclose(likelihood[:, -1], best, rtol=32 * EPS[dtype])


KNOWN = {
    2: (np.array([0.3, 0.7]), np.array([[0.6, 0, 0.8], [-0.6, 0.48, 0.64]]), np.array([40.0, 8.0])),
    3: (
        np.array([0.5, 0.3, 0.2]),
        np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]]),
        np.array([10.0, 30.0, 200.0]),
    ),
}


@pytest.mark.parametrize("count", KNOWN)
def test_recovers_what_was_sampled(count):
    """Within five standard errors, of lobes far enough apart to count as known samples.

    Of n samples of one lobe: kappa by 1 / sqrt(n A'), each tangential coordinate of the axis by
    1 / sqrt(n kappa A), with A the mean cosine; a share by sqrt(p (1 - p) / N). Lobes that
    overlap widen these by less than half (a sample of either weighs p there).
    """
    share, mu, kappa = KNOWN[count]
    N = 20_000
    s = Lobes(*(jnp.asarray(x) for x in (share, mu, kappa))).sample(jax.random.key(3), N)
    w = jnp.ones(N)
    found, likelihood = scattered_fit(jax.random.split(jax.random.key(4), 1), s, w, count)
    found, likelihood = jax.tree.map(lambda x: x[0], (found, likelihood))
    truth = Mixture(*(jnp.asarray(x) for x in (np.log(share), mu, kappa)))
    assert float(likelihood[-1]) >= float(log_likelihood(s, w, truth))
    order = np.argmax(mu @ np.asarray(found.mu).T, 1)
    assert sorted(order) == list(range(count))
    n, A = N * share, np.asarray(langevin(truth.kappa))
    error = np.asarray(found.kappa)[order] - kappa
    assert (np.abs(error) < 7.5 / np.sqrt(n * np.asarray(langevin_slope(truth.kappa)))).all()
    angle = np.linalg.norm(np.asarray(found.mu)[order] - mu, axis=1)
    assert (angle < 7.5 / np.sqrt(n * kappa * A)).all()
    error = np.exp(np.asarray(found.log_share))[order] - share
    assert (np.abs(error) < 7.5 * np.sqrt(share * (1 - share) / N)).all()


def test_one_lobe_is_the_closed_form(dtype, rng):
    """EM's first step from anywhere is the closed form."""
    s, w = padded(*random_problems(rng, 1)[0], dtype)
    start = Mixture(*(jnp.asarray(x, dtype) for x in ([0.0], [[0, 0.6, -0.8]], [20.0])))
    found, _ = jax.jit(lambda: mixture.expectation_maximisation(s, w, start, 1, CAP))()
    _, mu, kappa = moments(s[None], w[None])
    assert float(found.kappa[0]) == pytest.approx(float(kappa[0]), rel=32 * EPS[dtype])
    np.testing.assert_allclose(found.mu[0], mu[0], atol=8 * EPS[dtype])


def test_split_start_lies_along_the_widest_direction():

    @jax.jit
    def split():
        s, solid = quadrature.polar_grid(jnp.asarray([0.0, 0.0, 1.0]), 16, 24)
        x, y, z = s.T
        w = solid * jnp.exp(-((x / 0.4) ** 2) - (y / 0.1) ** 2)
        return mixture.split_start(s, jnp.where(z > 0, w, 0.0), 3, CAP)

    start = split()
    # Steps of two standard deviations, 0.4 / sqrt(2) on a plane; the sphere curves.
    assert np.abs(np.asarray(start.mu)[:, 1]).max() < 1e-6
    np.testing.assert_allclose(np.abs(np.asarray(start.mu)[:, 0]), [0.5, 0, 0.5], atol=0.05)
    np.testing.assert_allclose(np.asarray(start.mu)[1], [0, 0, 1], atol=1e-12)
