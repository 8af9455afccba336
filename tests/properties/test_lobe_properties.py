"""What holds for von Mises-Fisher lobes of every concentration."""

import jax
import jax.numpy as jnp
import numpy as np
from drawn import every, exponents, rotation, spread, unit

from diffopt.kernels import langevin, lobe_harmonics, mixture, vmf, vmf_pairs, vmf_sampling

MOST = {"float32": 1e8, "float64": 1e12}
N = 48


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


def concentrations(seed, dtype, most=None):
    k = spread(seed, N, 1e-4, most or MOST[dtype], 0.0, 1.0, most or MOST[dtype])
    return jnp.asarray(k, dtype)


def pair(seed, dtype, most=1e6):
    """Two lobes each; half of the axes lie as close as the lobes are wide."""
    k0, k1 = concentrations(seed, dtype, most), concentrations(seed + 1, dtype, most)
    mu0, mu1 = unit(seed, N), unit(seed + 1, N)
    near = mu0 + mu1 / np.sqrt(1.0 + np.asarray(k0, float))[:, None]
    near /= np.sqrt((near * near).sum(-1, keepdims=True))
    mu1[::2] = near[::2]
    return jnp.asarray(mu0, dtype), k0, jnp.asarray(mu1, dtype), k1


log_inner, log_similarity, divergence = (
    jax.jit(f) for f in (vmf_pairs.log_inner, vmf_pairs.log_similarity, vmf_pairs.divergence)
)
both_langevin = jax.jit(lambda k: (langevin.langevin(k), langevin.langevin_complement(k)))
inverse = jax.jit(langevin.inverse_langevin)
log_peak = jax.jit(vmf.log_peak)
one_minus_cosine = jax.jit(vmf_sampling.one_minus_cosine)
ratios = jax.jit(lambda k: lobe_harmonics.ratios(k, 8))
product = jax.jit(vmf_pairs.product)
log_pdf = jax.jit(vmf.log_pdf)
convolved = jax.jit(vmf_pairs.convolved)
moments = jax.jit(lambda s, w: mixture.moments(s, w, jnp.asarray(1e6, w.dtype)))


@jax.jit
def distance(a0, mu0, k0, a1, mu1, k1):
    return vmf_pairs.squared_distance(a0, mu0, k0, a1, mu1, k1)


@every()
def test_density_integrates_to_one(seed, dtype):
    k = concentrations(seed, dtype)
    # Over t = 1 - cosine, to where exp(-kappa t) is below 1e-17.
    x, w = np.polynomial.legendre.leggauss(48)
    exact = np.asarray(k, float)
    end = np.minimum(2.0, 40.0 / np.maximum(exact, 1.0))[:, None]
    t, weight = 0.5 * end * (x + 1.0), 0.5 * end * w
    log = np.asarray(log_peak(k), float)[:, None] - exact[:, None] * t
    total = 2.0 * np.pi * (np.exp(log) * weight).sum(-1)
    # The logarithm of the peak is rounded: 28 at most.
    np.testing.assert_allclose(total, 1.0, atol=64 * eps(dtype) + 1e-12)


@every()
def test_mean_cosine_rises_and_is_concave(seed, dtype):
    k = jnp.sort(concentrations(seed, dtype))
    mean, rest = (np.asarray(v, float) for v in both_langevin(k))
    assert (np.diff(mean) >= -2 * eps(dtype)).all()
    assert (np.diff(rest) <= 2 * eps(dtype) * rest[:-1]).all()
    assert (mean >= 0).all()
    assert (rest > 0).all()
    np.testing.assert_allclose(mean + rest, 1.0, atol=4 * eps(dtype))
    # Concave and 1/3 at 0: below k / 3; and below 1.
    assert (mean <= np.asarray(k, float) / 3.0 * (1 + 4 * eps(dtype))).all()


@every()
def test_mean_cosine_inverts(seed, dtype):
    k = concentrations(seed, dtype)
    found = np.asarray(inverse(*both_langevin(k)), float)
    # Rounding of the smaller of mean and rest is multiplied by 3 at most.
    np.testing.assert_allclose(found, np.asarray(k, float), rtol=64 * eps(dtype), atol=1e-30)


@every()
def test_products_are_symmetric(seed, dtype):
    mu0, k0, mu1, k1 = pair(seed, dtype)
    for function in (log_inner, log_similarity):
        one, other = function(mu0, k0, mu1, k1), function(mu1, k1, mu0, k0)
        size = 1.0 + np.abs(np.asarray(one, float))
        assert (
            np.abs(np.asarray(one, float) - np.asarray(other, float)) <= 32 * eps(dtype) * size
        ).all()


@every()
def test_pairs_do_not_see_rotations(seed):
    mu0, k0, mu1, k1 = pair(seed, "float64", 1e4)
    turn = jnp.asarray(rotation(seed))
    for function in (log_inner, log_similarity, divergence):
        one, other = function(mu0, k0, mu1, k1), function(mu0 @ turn.T, k0, mu1 @ turn.T, k1)
        # Axes are turned to eps, of angles down to 1 / 100: kappa t is moved by kappa eps / 100.
        np.testing.assert_allclose(one, other, rtol=1e-10, atol=1e-10)


@every()
def test_cosine_between_lobes_is_at_most_one(seed, dtype):
    """Cauchy and Schwarz, with the norms taken apart."""
    mu0, k0, mu1, k1 = pair(seed, dtype)
    assert (np.asarray(log_similarity(mu0, k0, mu1, k1)) <= 0).all()
    inner, own0, own1 = (
        log_inner(mu0, k0, mu1, k1),
        log_inner(mu0, k0, mu0, k0),
        log_inner(mu1, k1, mu1, k1),
    )
    size = 1.0 + np.abs(np.asarray(inner, float))
    assert (np.asarray(2.0 * inner - own0 - own1, float) <= 64 * eps(dtype) * size).all()


@every()
def test_cauchy_and_schwarz_hold_for_mixtures(seed):
    rng = np.random.default_rng(seed)
    mu0, k0, mu1, k1 = pair(seed, "float64", 1e3)
    a, b = rng.normal(size=(2, N))

    def gram(m, k, n, j):
        whole = log_inner(
            *(jnp.repeat(v, N, 0) for v in (m, k)),
            *(jnp.tile(v, (N,) + (1,) * (v.ndim - 1)) for v in (n, j)),
        )
        return np.exp(np.asarray(whole)).reshape(N, N)

    cross, own_a, own_b = gram(mu0, k0, mu1, k1), gram(mu0, k0, mu0, k0), gram(mu1, k1, mu1, k1)
    left, right = (a @ cross @ b) ** 2, (a @ own_a @ a) * (b @ own_b @ b)
    # Sums of 2,304 terms of either sign.
    assert left <= right * (1 + 1e-9) + 1e-12
    assert np.linalg.eigvalsh(own_a).min() >= -1e-12 * np.trace(own_a)


@every()
def test_distance_obeys_the_triangle(seed):
    mu0, k0, mu1, k1 = pair(seed, "float64", 1e4)
    mu2, k2 = jnp.asarray(unit(seed + 7, N)), concentrations(seed + 7, "float64", 1e4)
    a0, a1, a2 = (jnp.asarray(spread(seed + s, N, 1e-2, 1e2)) for s in (2, 3, 4))
    lobes = (a0, mu0, k0), (a1, mu1, k1), (a2, mu2, k2)

    def apart(i, j):
        square = np.asarray(distance(*lobes[i], *lobes[j]))
        # A few eps of both norms.
        norms = sum(np.asarray(lobes[n][0] ** 2 * vmf.squared_norm(lobes[n][2])) for n in (i, j))
        assert (square >= -16 * eps("float64") * norms).all()
        return np.sqrt(np.maximum(square, 0.0)), norms

    (ab, n0), (bc, n1), (ac, _) = apart(0, 1), apart(1, 2), apart(0, 2)
    assert (ac <= ab + bc + 1e-7 * np.sqrt(n0 + n1)).all()
    same, norms = apart(0, 0)
    assert (same <= 1e-7 * np.sqrt(norms)).all()


@every()
def test_divergence_is_positive_and_zero_for_like_lobes(seed, dtype):
    mu0, k0, mu1, k1 = pair(seed, dtype)
    size = 1.0 + np.asarray(k0 + k1, float)
    assert (np.asarray(divergence(mu0, k0, mu1, k1), float) >= -4 * eps(dtype)).all()
    same = np.asarray(divergence(mu0, k0, mu0, k0), float)
    assert (np.abs(same) <= 4 * eps(dtype) * size).all()


@every()
def test_product_is_a_lobe(seed):
    mu0, k0, mu1, k1 = pair(seed, "float64", 1e3)
    weight, mu, kappa = product(mu0, k0, mu1, k1)
    s = jnp.asarray(unit(seed + 9, N))
    left = log_pdf(s, mu0, k0) + log_pdf(s, mu1, k1)
    # Exponents to 4,000.
    np.testing.assert_allclose(left, weight + log_pdf(s, mu, kappa), rtol=1e-12, atol=1e-10)


@every()
def test_convolution_multiplies_mean_cosines(seed, dtype):
    k0, k1 = concentrations(seed, dtype), concentrations(seed + 1, dtype)
    both = convolved(k0, k1)
    (a0, r0), (a1, r1), (a, r) = (
        [np.asarray(v, float) for v in both_langevin(k)] for k in (k0, k1, both)
    )
    np.testing.assert_allclose(a, a0 * a1, rtol=32 * eps(dtype), atol=1e-30)
    # 1 - a0 a1 without cancellation.
    np.testing.assert_allclose(r, r0 + a0 * r1, rtol=64 * eps(dtype))
    np.testing.assert_allclose(both, convolved(k1, k0), rtol=64 * eps(dtype), atol=1e-30)


@every()
def test_harmonics_of_a_lobe_fall_with_degree_and_rise_with_concentration(seed, dtype):
    k = jnp.sort(concentrations(seed, dtype))
    found = np.asarray(ratios(k), float)
    # For the sharpest all are 1, and the recurrence hands rounding on over its 72 steps.
    assert ((found >= 0) & (found <= 1 + 32 * eps(dtype))).all()
    assert (np.diff(found, axis=0) <= 32 * eps(dtype)).all()
    assert (np.diff(found, axis=1) >= -64 * eps(dtype) * found[:, 1:]).all()


@every()
def test_samples_invert_the_distribution(seed, dtype):
    k = concentrations(seed, dtype, 1e6)
    v = jnp.asarray(np.random.default_rng(seed).uniform(0.0, 1.0, N) * (1 - 1e-6), dtype)
    t, exact = np.asarray(one_minus_cosine(v, k), float), np.asarray(k, float)
    assert ((t >= 0) & (t <= 2)).all()
    flat = exact == 0.0
    some = np.where(flat, 1.0, exact)
    share = np.where(flat, t / 2.0, np.expm1(-some * t) / np.expm1(-2.0 * some))
    # Near the end the share hardly depends on t; kappa t is rounded, up to 14 there.
    np.testing.assert_allclose(share, np.asarray(v, float), atol=16 * eps(dtype))
    order = np.argsort(np.asarray(v))
    rising = np.asarray(one_minus_cosine(v[order], jnp.full_like(v, k[5])))
    assert (np.diff(rising) >= -4 * eps(dtype) * rising[1:]).all()


@jax.jit
def em(s, w, start):
    return mixture.expectation_maximisation(s, w, start, 12, jnp.asarray(1e4, w.dtype))


@every(sharp=exponents(-1.0, 3.0))
def test_likelihood_never_falls(seed, sharp, dtype):
    rng = np.random.default_rng(seed)
    s = unit(seed, 200)
    s[:100] += 3.0 * unit(seed + 1, 1) / np.sqrt(1.0 + 10.0 / sharp)
    s /= np.sqrt((s * s).sum(-1, keepdims=True))
    weights = rng.uniform(0.0, 1.0, 200) ** 4
    start = mixture.Mixture(
        jnp.full(4, -np.log(4.0), dtype),
        jnp.asarray(unit(seed + 2, 4), dtype),
        jnp.full(4, sharp, dtype),
    )
    _, likelihood = em(jnp.asarray(s, dtype), jnp.asarray(weights, dtype), start)
    values = np.asarray(likelihood, float)
    # A mean of 200 logarithms, which are some units.
    assert (np.diff(values) >= -64 * eps(dtype) * (1.0 + np.abs(values[1:]))).all(), values


@every()
def test_merging_keeps_weight_and_first_moment(seed, dtype):
    s = unit(seed, 64, upper=True)
    weights = spread(seed, 64, 1e-3, 1e3)
    alpha, mu, kappa = moments(jnp.asarray(s, dtype), jnp.asarray(weights, dtype))
    np.testing.assert_allclose(float(alpha), weights.sum(), rtol=64 * eps(dtype))
    first = weights @ s
    mean, _ = both_langevin(kappa)
    # Sums of 64 terms; the concentration has some eps, and so its mean cosine.
    np.testing.assert_allclose(
        np.asarray(alpha * mean * mu, float), first, atol=256 * eps(dtype) * weights.sum()
    )
