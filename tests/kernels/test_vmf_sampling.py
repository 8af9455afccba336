"""Sampled directions against the exact distribution and against SciPy."""

import json
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare, vonmises_fisher

from diffopt.kernels import frames, langevin, vmf, vmf_sampling

DATA = json.loads((Path(__file__).parents[1] / "data" / "vmf.json").read_text())
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
SLANT = np.array([0.48, -0.36, 0.8])
BELOW = np.array([0.0, 0.0, -1.0])
WARP = jax.jit(vmf_sampling.warp)
SLOPE = jax.jit(
    lambda u, mu, k: jax.jvp(lambda k: vmf_sampling.warp(u, mu, k), (k,), (jnp.ones_like(k),))[1]
)
# Compiled whole: eagerly, every operation is a program for each shape.
LOG_PDF, PDF, ENTROPY = map(jax.jit, (vmf.log_pdf, vmf.pdf, vmf.entropy))
MEAN, REST = jax.jit(langevin.langevin), jax.jit(langevin.langevin_complement)
VARIANCE = jax.jit(langevin.langevin_slope)


def uniform(rng, count, dtype):
    """Numbers in [0, 1) that float32 holds: cast, those of float64 reach 1."""
    return jnp.asarray(rng.integers(0, 2**24, (count, 2)) / 2.0**24, dtype)


def sampled(rng, count, mu, kappa, dtype):
    """Directions, and the axis as the dtype holds it, in float64."""
    mu = jnp.asarray(mu, dtype)
    axes = jnp.broadcast_to(mu, (count, 3))
    s = WARP(uniform(rng, count, dtype), axes, jnp.full(count, kappa, dtype))
    assert s.dtype == dtype
    return np.asarray(s, np.float64), np.asarray(mu, np.float64)


def gap(s, mu):
    return 0.5 * ((s - mu) ** 2).sum(-1)


def test_angles_of_the_table(dtype):
    def column(name):
        return np.array([float(Fraction(r[name])) for r in DATA["sampler"]])

    v, kappa = (jnp.asarray(column(n), dtype) for n in ("v", "kappa"))
    # Rounding of v and of kappa is one eps of it.
    np.testing.assert_allclose(
        vmf_sampling.one_minus_cosine(v, kappa), column("one_minus_cos"), rtol=16 * EPS[dtype]
    )


@pytest.mark.parametrize("kappa", [0.0, 1e-3, 1.0, 30.0, 89.0, 1e3, 1e6])
def test_directions_have_the_density(kappa, dtype, rng):
    """Chi-square over cells of equal probability, 40 along the axis by 8 around it."""
    count = 200_000
    s, mu = sampled(rng, count, SLANT, kappa, dtype)
    t = gap(s, mu)
    share = np.expm1(-kappa * t) / np.expm1(-2 * kappa) if kappa else t / 2
    first, second = (np.asarray(e) for e in frames.tangents(jnp.asarray(mu)))
    turn = np.arctan2(s @ second, s @ first) / (2 * np.pi) % 1
    rows = np.clip((40 * share).astype(int), 0, 39)
    cells = np.bincount(8 * rows + (8 * turn).astype(int), minlength=320)
    assert chisquare(cells).pvalue > 1e-6
    # Five standard deviations, sqrt(A') each.
    k = jnp.asarray(kappa)
    spread = float(np.sqrt(VARIANCE(k) / count))
    assert abs(t.mean() - float(REST(k))) < 5 * spread


@pytest.mark.parametrize("axis", [SLANT, BELOW, -SLANT], ids=["slant", "down", "away"])
def test_unit_vectors_at_all_concentrations(axis, dtype, rng):
    kappas = [0.0, 1e-12, 1e-4, 1e-3, 1.0, 44.0, 89.0, 710.0, 1e5, 1e8]
    for kappa in kappas:
        s, mu = sampled(rng, 10_000, axis, kappa, dtype)
        assert np.isfinite(s).all(), kappa
        np.testing.assert_allclose(np.linalg.norm(s, axis=-1), 1, atol=6 * EPS[dtype])
        if kappa:
            mean = float(REST(jnp.asarray(kappa)))
            spread = float(np.sqrt(VARIANCE(jnp.asarray(kappa)) / 10_000))
            # At 1e8 a direction in float32 is 1e-3 of the angle off its place.
            assert abs(gap(s, mu).mean() - mean) < 5 * spread + 1e-5 * mean, kappa


def test_corners_of_the_square(dtype):
    """The smallest and the largest numbers, at concentrations where exp(2 kappa) overflows."""
    last = 1 - 2.0**-24
    u = [[x, y] for x in (0.0, 0.25, last) for y in (0.0, 2.0**-24, last)]
    kappas = np.array([0.0, 1e-12, 1.0, 44.0, 89.0, 710.0, 1e8])
    u = np.broadcast_to(np.array(u), (kappas.size, 9, 2))
    k = jnp.asarray(np.broadcast_to(kappas[:, None], u.shape[:2]), dtype)
    mu = jnp.asarray(np.broadcast_to(BELOW, (*k.shape, 3)), dtype)
    u = jnp.asarray(u, dtype)
    s = np.asarray(WARP(u, mu, k), np.float64)
    np.testing.assert_allclose(np.linalg.norm(s, axis=-1), 1, atol=6 * EPS[dtype])
    np.testing.assert_allclose(s[:, ::3], BELOW + 0 * s[:, ::3], atol=1e-15)  # on the axis
    slopes = jax.jit(jax.grad(lambda *a: vmf_sampling.warp(*a).sum(), (0, 1, 2)))(u, mu, k)
    assert all(bool(jnp.isfinite(g).all()) for g in slopes)


def test_slope_by_the_concentration(rng):
    """Central differences; 1e-12 of rounding over the step, and the square of the step."""
    u = uniform(rng, 400, "float64")
    mu = rng.normal(size=(400, 3))
    mu = jnp.asarray(mu / np.linalg.norm(mu, axis=-1, keepdims=True))
    for kappa in (1e-9, 1e-3, 0.7, 1.0, 5.0, 89.0, 1e5):
        k = jnp.full(400, kappa)
        step = 1e-4 * max(kappa, 1.0)
        if kappa < step:
            step = kappa / 2
        slope = SLOPE(u, mu, k)
        difference = (WARP(u, mu, k + step) - WARP(u, mu, k - step)) / (2 * step)
        # Relative to directions that move by 1 while kappa changes by itself.
        size = max(float(jnp.abs(slope).max()), 1e-3 / max(kappa, 1.0))
        tolerance = 1e-6 * size + 1e-15 / step
        assert float(jnp.abs(slope - difference).max()) < tolerance, kappa


def test_compiled_and_mapped(dtype, rng):
    u = uniform(rng, 12, dtype)
    kappa = jnp.asarray(10 ** rng.uniform(-6, 8, 12), dtype)
    mu = jnp.asarray(np.stack([SLANT, BELOW] * 6), dtype)
    together = vmf_sampling.warp(u, mu, kappa)
    mapped = jax.vmap(vmf_sampling.warp)(u, mu, kappa)
    np.testing.assert_allclose(mapped, together, atol=4 * EPS[dtype])
    np.testing.assert_allclose(WARP(u, mu, kappa), together, atol=4 * EPS[dtype])
    shaped = vmf_sampling.warp(u.reshape(3, 4, 2), mu.reshape(3, 4, 3), kappa.reshape(3, 4))
    np.testing.assert_allclose(shaped.reshape(12, 3), together, atol=4 * EPS[dtype])


@pytest.mark.parametrize("kappa", [1e-6, 1e-3, 0.5, 1.0, 30.0, 710.0, 1e4, 1e8])
def test_against_scipy(kappa, rng):
    other = vonmises_fisher(SLANT / np.linalg.norm(SLANT), kappa)
    ours, mu = sampled(rng, 20_000, SLANT, kappa, "float64")
    theirs = other.rvs(20_000, random_state=rng)
    k, axis = jnp.asarray(kappa), jnp.asarray(mu)[None]
    # Its exponent is kappa mu.s: an error of kappa eps.
    tolerance = 1e-13 + 4 * kappa * EPS["float64"]
    some = jnp.asarray(theirs[:200])
    log_pdf = LOG_PDF(some, axis, k)
    np.testing.assert_allclose(log_pdf, other.logpdf(theirs[:200]), atol=tolerance)
    if tolerance < 1e-9:
        np.testing.assert_allclose(PDF(some, axis, k), other.pdf(theirs[:200]), rtol=4 * tolerance)
    assert float(ENTROPY(k)) == pytest.approx(other.entropy(), abs=tolerance)
    spread = float(np.sqrt(VARIANCE(k) / 20_000))
    # Two samples of one mean; across the axis the variance is A / kappa.
    assert abs(gap(ours, mu).mean() - gap(theirs, mu).mean()) < 5 * np.sqrt(2) * spread
    across = np.sqrt(float(MEAN(k)) / kappa / 20_000)
    np.testing.assert_allclose(
        ours.mean(0), theirs.mean(0), atol=5 * np.sqrt(2) * max(across, spread)
    )


@pytest.mark.parametrize("kappa", [1e10, 1e12])
def test_beyond_scipy(kappa):
    """SciPy (1.17) draws at any kappa > 0, but its density and entropy are NaN from 1e10 on.

    Where they are not, they come from kappa mu.s: 4e-9 off at 1e8; kappa = 0 is an error
    there. Here against the limit of large concentrations.
    """
    k, mu = jnp.asarray(kappa), jnp.asarray([0.0, 0.0, 1.0])
    theta = 1 / np.sqrt(kappa)
    s = jnp.asarray([np.sin(theta), 0.0, np.cos(theta)])
    log_peak = np.log(kappa / (2 * np.pi))
    exponent = kappa * 2 * np.sin(theta / 2) ** 2
    assert float(LOG_PDF(s, mu, k)) == pytest.approx(log_peak - exponent, rel=1e-14)
    assert float(ENTROPY(k)) == pytest.approx(1 - log_peak, rel=1e-14)
