"""Lobes and pairs of lobes against values of 50 digits and against quadrature."""

import json
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import roots_legendre

from diffopt.kernels import langevin as eager_langevin
from diffopt.kernels import vmf as eager_vmf
from diffopt.kernels import vmf_pairs as eager_pairs

DATA = json.loads((Path(__file__).parents[1] / "data" / "vmf.json").read_text())
EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
Z = np.array([0.0, 0.0, 1.0])
SLANT = np.array([0.48, -0.36, 0.8])


class Compiled:
    """Functions of a module, each compiled whole: eagerly, every operation is a program."""

    def __init__(self, module):
        self.module = module

    def __getattr__(self, name):
        function = jax.jit(getattr(self.module, name))
        setattr(self, name, function)
        return function


langevin, vmf, vmf_pairs = map(Compiled, (eager_langevin, eager_vmf, eager_pairs))


def column(kind, name):
    """One column of a table, in float64."""
    return np.array([float(Fraction(r[name])) for r in DATA[kind]])


def tilted(theta):
    """Unit vectors at angles from z."""
    return np.stack([np.sin(theta), 0 * theta, np.cos(theta)], -1)


def held(dtype, *values):
    return tuple(jnp.asarray(v, dtype) for v in values)


def close(found, expected, tolerance):
    """Errors relative to a tolerance, by record."""
    error = np.abs(np.asarray(found, np.float64) - expected)
    worst = np.argmax(error / tolerance)
    assert (error <= tolerance).all(), (worst, error.flat[worst], np.ravel(tolerance)[worst])


def quadrature(nodes=100, turns=64, kappa=1.0):
    """Directions [nodes, turns, 3] and their solid angles, dense about z for large kappa.

    Gauss-Legendre in log(1 + c t), t = 1 - cos; c = 0.05 kappa keeps 1/kappa well
    resolved. 1e-13 at 100 nodes; more have larger rounding of the weights at the ends.
    """
    x, w = roots_legendre(nodes)
    c = max(0.05 * kappa, 1e-6)
    end = np.log1p(2 * c)
    t = np.expm1(end * (x + 1) / 2) / c
    w = w * end / 2 * (1 + c * t) / c
    phi = 2 * np.pi * (np.arange(turns) + 0.5) / turns
    sin = np.sqrt(t * (2 - t))[:, None]
    s = np.stack([sin * np.cos(phi), sin * np.sin(phi), (1 - t)[:, None] + 0 * phi], -1)
    return s, (w * 2 * np.pi / turns)[:, None] + 0 * phi


def random_pairs(rng, count, dtype):
    """Lobes of all widths; half of the second ones much like the first."""
    mu0 = rng.normal(size=(count, 3))
    mu1 = rng.normal(size=(count, 3))
    kappa0, kappa1 = 10 ** rng.uniform(-9, 8, (2, count))
    near = np.arange(count) % 2 == 0
    mu0 /= np.linalg.norm(mu0, axis=-1, keepdims=True)
    step = 10 ** rng.uniform(-6, 0, (count, 1)) * mu1 / np.sqrt(np.maximum(kappa0, 1))[:, None]
    mu1 = np.where(near[:, None], mu0 + step, mu1)
    mu1 /= np.linalg.norm(mu1, axis=-1, keepdims=True)
    kappa1 = np.where(near, kappa0 * (1 + 10 ** rng.uniform(-8, 0, count)), kappa1)
    return held(dtype, mu0, kappa0, mu1, kappa1)


def test_one_lobe(dtype):
    """In float32 the rounding of kappa is 1 of the 16 eps: no column goes faster than kappa^2."""
    kappa = column("scalar", "kappa")
    (k,) = held(dtype, kappa)
    z, s = held(dtype, np.broadcast_to(Z, (kappa.size, 3)), tilted(np.array([0.0, 0.1, 1e-4, 3.0])))

    def slope(f):
        return jax.jit(jax.vmap(jax.grad(f)))(k)

    found = {
        "log_c": vmf.log_normaliser(k),
        "dlog_c": slope(vmf.log_normaliser),
        "dlog_n": slope(vmf.log_peak),
        "A3": langevin.langevin(k),
        "one_minus_A3": langevin.langevin_complement(k),
        "dA3": langevin.langevin_slope(k),
        "dentropy": slope(vmf.entropy),
        "norm2": vmf.squared_norm(k),
        "banerjee_of_A3": langevin.pade_inverse_langevin(
            langevin.langevin(k), langevin.langevin_complement(k)
        ),
        "pdf_peak": vmf.pdf(z, z, k),
    }
    for name, value in found.items():
        expected = column("scalar", name)
        close(value, expected, 16 * EPS[dtype] * np.abs(expected))
    np.testing.assert_allclose(
        slope(langevin.langevin), column("scalar", "dA3"), rtol=64 * EPS[dtype]
    )
    # These cross zero: relative to 1 at least, or to their larger term.
    log_n = column("scalar", "log_n")
    size = np.maximum(1, np.abs(log_n))
    close(vmf.log_peak(k), log_n, 16 * EPS[dtype] * size)
    close(vmf.entropy(k), column("scalar", "entropy"), 16 * EPS[dtype] * size)
    for index, name, theta in ((1, "0p1", 0.1), (2, "1e_4", 1e-4), (3, "3", 3.0)):
        there = jnp.broadcast_to(s[index], z.shape)
        exponent = kappa * 2 * np.sin(theta / 2) ** 2
        expected = column("scalar", f"logpdf_theta_{name}")
        close(vmf.log_pdf(there, z, k), expected, 16 * EPS[dtype] * np.maximum(size, exponent))


@pytest.mark.parametrize("kind", ["A3_inverse", "A3_inverse_from_complement"])
def test_inverse_of_the_mean_cosine(kind, dtype):
    name = "R" if kind == "A3_inverse" else "one_minus_R"
    # The other one of the two from the decimal, not from the rounded number.
    given = [Decimal(r[name]) for r in DATA[kind]]
    pair = np.array([[float(x), float(1 - x)] for x in given]).T
    value, rest = held(dtype, *(pair if name == "R" else pair[::-1]))
    kappa, slope = column(kind, "kappa"), column(kind, "dkappa_dR")
    k = langevin.inverse_langevin(value, rest)
    close(k, kappa, 16 * EPS[dtype] * kappa)
    if name == "R":
        pade = langevin.pade_inverse_langevin(value, rest)
        close(pade, column(kind, "banerjee"), 16 * EPS[dtype] * kappa)
        close((pade - k) / k, column(kind, "banerjee_relerr"), 32 * EPS[dtype])

    def along(value, rest):
        """Slope where 1 - R moves with R."""
        one = jnp.ones_like(value)
        return jax.jvp(langevin.inverse_langevin, (value, rest), (one, -one))[1]

    close(along(value, rest), slope, 32 * EPS[dtype] * slope)
    slopes = jax.jit(jax.grad(lambda *a: langevin.inverse_langevin(*a).sum(), (0, 1)))
    by_value, by_rest = slopes(value, rest)
    # One of the two arguments carries the slope: the smaller one.
    np.testing.assert_array_equal(np.asarray(by_value) == 0, value > 0.5)
    np.testing.assert_array_equal(np.asarray(by_rest) == 0, value <= 0.5)


def test_pairs(dtype):
    table = DATA["pairs"]
    k0, k1, a0, a1 = (column("pairs", n) for n in ("kappa0", "kappa1", "alpha0", "alpha1"))
    # In 80 bits: 3.14 rounded to 64 is off by 1e-13 of its distance to pi.
    theta = np.array([np.longdouble(r["theta"]) for r in table])
    mus = np.broadcast_to(Z, (len(table), 3)), tilted(theta)
    mu0, kappa0, mu1, kappa1 = held(dtype, mus[0], k0, mus[1], k1)
    alpha0, alpha1 = held(dtype, a0, a1)
    lobes = mu0, kappa0, mu1, kappa1
    eps = EPS[dtype]
    peaks = sum(np.abs(np.asarray(vmf.log_peak(k))) for k in (kappa0, kappa1))

    both, _ = vmf_pairs.combined(*lobes)
    close(both, column("pairs", "kappa_c"), 16 * eps * column("pairs", "kappa_c"))
    inner = column("pairs", "log_inner")
    # Logarithms of up to 17, and an exponent.
    close(vmf_pairs.log_inner(*lobes), inner, 16 * eps * (1 + peaks + np.abs(inner)))
    similarity = np.log(column("pairs", "cos_sim"))
    tolerance = 16 * eps * (1 + peaks + np.abs(similarity))
    close(vmf_pairs.log_similarity(*lobes), similarity, tolerance)

    weighted = alpha0, mu0, kappa0, alpha1, mu1, kappa1
    scale = a0**2 * np.asarray(vmf.squared_norm(jnp.asarray(k0)))
    scale = scale + a1**2 * np.asarray(vmf.squared_norm(jnp.asarray(k1)))
    exact = column("pairs", "l2_sq")
    distance = np.asarray(vmf_pairs.squared_distance(*weighted))
    close(distance, exact, 16 * eps * scale)
    if dtype == "float64":
        resolved = (np.minimum(k0, k1) >= 1) & (exact > 1e-8 * scale)
        np.testing.assert_allclose(distance[resolved], exact[resolved], rtol=1e-10)
    limit = column("pairs", "l2_sq_eq7")
    own = np.abs(limit) + (a0**2 * k0 + a1**2 * k1) / (4 * np.pi)
    close(vmf_pairs.squared_distance_asymptotic(*weighted), limit, 16 * eps * own)

    # Close concentrations by a quadrature without cancellation (kappa of 1e-3 and 2e-3 round by
    # half an eps each, their difference by up to 3), others as a difference of logarithms.
    near = np.abs(k1 - k0) < 0.25 * np.maximum(np.minimum(k0, k1), 1)
    for name, order in (("kl_01", lobes), ("kl_10", (mu1, kappa1, mu0, kappa0))):
        expected = column("pairs", name)
        tolerance = 16 * eps * (expected + np.where(near, 0, 1 + peaks))
        close(vmf_pairs.divergence(*order), expected, np.maximum(tolerance, 1e-300))


def test_slopes_of_pairs(dtype):
    names = ("alpha0", "kappa0", "alpha1", "kappa1", "theta")
    a0, k0, a1, k1, theta = held(dtype, *(column("pair_gradients", n) for n in names))
    z = jnp.asarray(Z, dtype)

    def lobe(theta):
        return jnp.stack([jnp.sin(theta), jnp.zeros_like(theta), jnp.cos(theta)])

    def distance(a0, k0, a1, k1, theta):
        return vmf_pairs.squared_distance(a0, z, k0, a1, lobe(theta), k1)

    def divergence(k0, k1, theta):
        return vmf_pairs.divergence(z, k0, lobe(theta), k1)

    d_alpha, d_kappa, d_theta = jax.jit(jax.vmap(jax.grad(distance, (0, 1, 4))))(
        a0, k0, a1, k1, theta
    )
    kl = jax.jit(jax.vmap(jax.grad(divergence, (0, 1))))(k0, k1, theta)
    value = np.asarray(jax.vmap(distance)(a0, k0, a1, k1, theta))
    # Differences of terms as large as the distance over the argument (theta: kappa theta, with
    # the rounding of cos theta of 0.9998 against 1).
    for found, name, size in (
        (d_alpha, "d_alpha0", np.abs(value)),
        (d_kappa, "d_kappa0", np.abs(value / k0)),
        (d_theta, "d_theta", 0.0),
        (kl[0], "dkl_dkappa0", 1 / np.asarray(k0)),
        (kl[1], "dkl_dkappa1", 1 / np.asarray(k1)),
    ):
        expected = column("pair_gradients", name)
        close(found, expected, 64 * EPS[dtype] * (np.abs(expected) + size))


def test_convolution(dtype):
    k0, k1 = held(dtype, column("convolution", "kappa0"), column("convolution", "kappa1"))
    expected = column("convolution", "kappa_moment")
    found = vmf_pairs.convolved(k0, k1)
    close(found, expected, 16 * EPS[dtype] * expected)
    # The order-1 coefficient of a convolution is the product of both, exactly.
    product = langevin.langevin(k0) * langevin.langevin(k1)
    np.testing.assert_allclose(langevin.langevin(found), product, rtol=8 * EPS[dtype])
    harmonic = column("convolution", "kappa_harmonic")
    assert (
        np.abs(np.asarray(found) / harmonic - 1) < 1 / np.minimum(np.asarray(k0), np.asarray(k1))
    ).all()


def test_convolution_by_its_order_1_coefficient():
    """The blur of one lobe by another, integrated over the first: its mean cosine."""
    k0, k1 = jnp.asarray(4.0), jnp.asarray(9.0)
    s, weight = quadrature(60, 32)
    # A lobe about a direction has its mean there, shortened by its mean cosine.
    (axis,) = held("float64", s[20:21, 5:6])
    (directions,) = held("float64", s)
    second = np.asarray(vmf.pdf(directions, axis, k1))
    mean = (second[..., None] * weight[..., None] * s).sum((0, 1))
    np.testing.assert_allclose(mean, float(langevin.langevin(k1)) * s[20, 5], atol=1e-9)
    first = np.asarray(vmf.pdf(directions, jnp.asarray(Z)[None, None], k0))
    cosine = float(langevin.langevin(k1)) * (first * weight * s[..., 2]).sum()
    both = vmf_pairs.convolved(k0, k1)
    assert float(langevin.langevin(both)) == pytest.approx(cosine, rel=1e-12)


def test_limits(dtype):
    limits = DATA["limits"]
    R, q = held(dtype, 2 / 3, 1 / 3)
    mle, pade = langevin.inverse_langevin(R, q), langevin.pade_inverse_langevin(R, q)
    assert float(mle) == pytest.approx(limits["cos_lobe_kappa_MLE"], rel=16 * EPS[dtype])
    assert float(pade) == pytest.approx(limits["cos_lobe_kappa_banerjee"], rel=16 * EPS[dtype])
    (k,) = held(dtype, np.linspace(4.5, 5.5, 1001))
    error = langevin.pade_inverse_langevin(langevin.langevin(k), langevin.langevin_complement(k))
    error = np.asarray(error / k - 1)
    assert error.max() == pytest.approx(
        limits["banerjee_max_rel_err"],
        abs=16 * EPS[dtype] + 1e-9,  # the grid
    )
    # The top is flat: 1e-6 of error is a tenth in kappa.
    width = 0.2 if dtype == "float32" else 1e-3
    assert float(k[error.argmax()]) == pytest.approx(limits["banerjee_argmax_kappa"], abs=width)
    (far,) = held(dtype, 1e4)
    error = langevin.pade_inverse_langevin(
        langevin.langevin(far), langevin.langevin_complement(far)
    )
    # 5/4 / kappa from the limit.
    tolerance = 1.3e-4 + 16e4 * EPS[dtype]
    assert float(error - far) == pytest.approx(limits["banerjee_abs_err_limit"], abs=tolerance)
    x, w = roots_legendre(40)
    z = (x - 1) / 2
    s = np.stack([np.sqrt(1 - z * z), 0 * z, z], -1)
    density = vmf.pdf(*held(dtype, s, np.broadcast_to(Z, s.shape), 3.0))
    below = np.pi * (np.asarray(density) * w).sum()
    assert below == pytest.approx(limits["below_horizon_mass_kappa3"], rel=32 * EPS[dtype])


@pytest.mark.parametrize("kappa", [0.0, 1e-6, 0.3, 1.0, 3.0, 30.0, 1e3, 1e4])
def test_density_integrates_to_one(kappa, dtype):
    s, weight = quadrature(kappa=kappa)
    k = jnp.asarray(kappa, dtype)
    density = np.asarray(vmf.pdf(*held(dtype, s, np.broadcast_to(Z, s.shape)), k), np.float64)
    # In float32 the rounding of theta times kappa theta, averaged over the nodes.
    rounding = 16 * EPS[dtype] * (1 + 0.1 * np.sqrt(kappa))
    assert (density * weight).sum() == pytest.approx(1, abs=rounding + 1e-12)
    mean = (density[..., None] * weight[..., None] * s).sum((0, 1))
    cosine = float(langevin.langevin(k))
    np.testing.assert_allclose(mean, [0, 0, cosine], atol=rounding + 1e-12)
    norm2 = (density**2 * weight).sum()
    assert norm2 == pytest.approx(float(vmf.squared_norm(k)), rel=rounding + 1e-12)


def test_slopes_are_the_named_functions(dtype):
    (k,) = held(dtype, np.concatenate([[0.0], np.logspace(-12, 8, 201)]))

    def slope(f):
        return np.asarray(jax.jit(jax.vmap(jax.grad(f)))(k))

    rtol = 16 * EPS[dtype]
    for f, expected in (
        (vmf.log_normaliser, -langevin.langevin(k)),
        (langevin.log_sinhc, langevin.langevin(k)),
        (vmf.log_peak, langevin.langevin_complement(k)),
        (vmf.entropy, -k * langevin.langevin_slope(k)),
    ):
        np.testing.assert_allclose(slope(f), expected, rtol=rtol)
    # At 1 it is 0.28, from terms of 1 and 0.72 that are themselves differences.
    np.testing.assert_allclose(slope(langevin.langevin), langevin.langevin_slope(k), rtol=4 * rtol)


def test_inverse_returns_the_concentration(dtype):
    (k,) = held(dtype, np.logspace(-12, 8, 4001))
    found = langevin.inverse_langevin(langevin.langevin(k), langevin.langevin_complement(k))
    np.testing.assert_allclose(found, k, rtol=16 * EPS[dtype])


def test_smooth_at_the_join(dtype):
    """Values and slopes on both sides of 1 differ by what one step of kappa makes, and rounding."""
    one = np.asarray(1.0, dtype)
    (k,) = held(dtype, np.array([np.nextafter(one, 0, dtype=dtype), one]))
    for f in (
        langevin.log_sinhc,
        langevin.log_sinhc_complement,
        langevin.k_coth,
        langevin.langevin,
        langevin.langevin_complement,
        langevin.langevin_slope,
        vmf.log_normaliser,
        vmf.log_peak,
        vmf.squared_norm,
        vmf.entropy,
    ):
        value, slope = jax.jit(jax.vmap(jax.value_and_grad(f)))(k)
        assert abs(float(value[1] - value[0])) < 4 * EPS[dtype], f.__name__
        assert abs(float(slope[1] - slope[0])) < 8 * EPS[dtype], f.__name__


HARD = {
    "antipodal": (SLANT, 3.0, -SLANT, 3.0),
    "alike": (SLANT, 50.0, SLANT, 50.0),
    "uniform": (SLANT, 0.0, -SLANT, 0.0),
    "half": (SLANT, 0.0, -SLANT, 5.0),
    "largest": (SLANT, 1e8, -SLANT, 1e8),
}


def test_slopes_are_finite(dtype):
    pairs = held(dtype, *(np.stack(x) for x in zip(*HARD.values(), strict=True)))

    def every(mu0, k0, mu1, k1, alpha):
        lobes = mu0, k0, mu1, k1
        values = [
            vmf_pairs.combined(*lobes),
            vmf_pairs.log_inner(*lobes),
            vmf_pairs.product(*lobes),
            vmf_pairs.divergence(*lobes),
            vmf_pairs.log_similarity(*lobes),
            vmf_pairs.squared_distance(alpha, mu0, k0, alpha, mu1, k1),
            vmf_pairs.convolved(k0, k1),
            [f(s, mu0, k0) for f in (vmf.pdf, vmf.log_pdf) for s in (mu0, mu1)],
        ]
        # A sum is finite only if all are.
        return sum(v.sum() for v in jax.tree.leaves(values))

    slopes = jax.jit(jax.vmap(jax.grad(every, (0, 1, 2, 3, 4))))(*pairs, 0 * pairs[1] + 0.7)
    for slope in jax.tree.leaves(slopes):
        assert bool(jnp.isfinite(slope).all())


@pytest.mark.parametrize(
    ("k0", "k1", "theta"),
    [(0.0, 0.0, 1.0), (0.5, 0.9, 2.0), (0.9, 1.1, 0.3), (3.0, 3.0, 3.1), (20.0, 35.0, 0.2)],
)
def test_product_and_distance_by_quadrature(k0, k1, theta):
    s, weight = quadrature(100, 128, max(k0, k1))
    mu1 = tilted(np.asarray(theta))
    s, mu0, mu1, k0, k1 = (jnp.asarray(x) for x in (s, Z, mu1, k0, k1))

    def on_grid(f, mu, kappa):
        return f(s, mu[None, None], kappa)

    first, second = on_grid(vmf.pdf, mu0, k0), on_grid(vmf.pdf, mu1, k1)
    inner = float((first * second * weight).sum())
    log_weight, mu, kappa = vmf_pairs.product(mu0, k0, mu1, k1)
    assert float(jnp.exp(log_weight)) == pytest.approx(inner, rel=1e-11)
    assert float(vmf_pairs.log_inner(mu0, k0, mu1, k1)) == float(log_weight)
    np.testing.assert_allclose(
        jnp.exp(log_weight) * on_grid(vmf.pdf, mu, kappa), first * second, rtol=1e-12
    )
    a0, a1 = jnp.asarray(0.7), jnp.asarray(1.3)
    expected = float(((a0 * first - a1 * second) ** 2 * weight).sum())
    found = float(vmf_pairs.squared_distance(a0, mu0, k0, a1, mu1, k1))
    assert found == pytest.approx(expected, rel=1e-11)
    log_ratio = on_grid(vmf.log_pdf, mu0, k0) - on_grid(vmf.log_pdf, mu1, k1)
    expected = float((first * log_ratio * weight).sum())
    assert float(vmf_pairs.divergence(mu0, k0, mu1, k1)) == pytest.approx(expected, abs=1e-11)


def test_distances_of_random_lobes(dtype, rng):
    lobes = random_pairs(rng, 20_000, dtype)
    mu0, k0, mu1, k1 = lobes
    a0, a1 = held(dtype, *rng.uniform(0, 2, (2, 20_000)))
    distance = np.asarray(vmf_pairs.squared_distance(a0, mu0, k0, a1, mu1, k1))
    back = np.asarray(vmf_pairs.squared_distance(a1, mu1, k1, a0, mu0, k0))
    scale = np.asarray(a0**2 * vmf.squared_norm(k0) + a1**2 * vmf.squared_norm(k1))
    assert (distance >= 0).all()
    assert (np.abs(distance - back) <= 16 * EPS[dtype] * scale).all()
    assert (
        np.asarray(vmf_pairs.squared_distance(a0, mu0, k0, a0, mu0, k0)) <= 4 * EPS[dtype] * scale
    ).all()
    assert (np.asarray(vmf_pairs.log_similarity(*lobes)) <= 0).all()
    np.testing.assert_array_equal(vmf_pairs.divergence(mu0, k0, mu0, k0), 0.0)
    # Concentrations that differ by more than a quarter: a difference of logarithms up to 18,
    # but never less than 0.02 then.
    assert (np.asarray(vmf_pairs.divergence(*lobes)) >= 0).all()
    every = tuple(range(6))
    slopes = jax.jit(jax.grad(lambda *a: vmf_pairs.squared_distance(*a).sum(), every))(
        a0, mu0, k0, a1, mu1, k1
    )
    assert all(bool(jnp.isfinite(s).all()) for s in slopes)


def test_asymptotic_distance_has_its_published_errors():
    """29 % too small at kappa = 1, 3.7 % at 2, 0.5 % at 3; negative for opposite lobes."""
    kappa = jnp.asarray([1.0, 2.0, 3.0])
    one = jnp.ones(3)
    z = jnp.broadcast_to(jnp.asarray(Z), (3, 3))
    for theta in (0.5, 1.0):
        mu1 = jnp.broadcast_to(jnp.asarray(tilted(np.asarray(theta))), (3, 3))
        lobes = one, z, kappa, one, mu1, kappa
        exact = vmf_pairs.squared_distance(*lobes)
        error = np.asarray(vmf_pairs.squared_distance_asymptotic(*lobes) / exact - 1)
        np.testing.assert_allclose(error, [-0.29, -0.037, -0.005], rtol=0.1)
    k, a = jnp.asarray(3.0), jnp.asarray(1.0)
    for angle, sign in ((179.8, -1), (179.5, 1)):  # through 0 at 179.7 degrees
        mu1 = jnp.asarray(tilted(np.asarray(np.radians(angle))))
        found = vmf_pairs.squared_distance_asymptotic(a, jnp.asarray(Z), k, a, mu1, k)
        assert np.sign(float(found)) == sign
    opposite = vmf_pairs.squared_distance_asymptotic(a, jnp.asarray(Z), k, a, -jnp.asarray(Z), k)
    assert float(opposite) == -np.inf


def rotation(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def test_interpolation(dtype, rng):
    weights = rng.dirichlet(np.ones(3), 50)
    alphas = rng.uniform(0.1, 2, (50, 3))
    mus = Z + 0.4 * rng.normal(size=(50, 3, 3))
    mus /= np.linalg.norm(mus, axis=-1, keepdims=True)
    kappas = 10 ** rng.uniform(-2, 6, (50, 3))
    eps = EPS[dtype]
    b, a, m, k = held(dtype, weights, alphas, mus, kappas)
    alpha, mu, kappa = vmf_pairs.interpolated(b, a, m, k)
    np.testing.assert_allclose(np.linalg.norm(mu, axis=-1), 1, atol=4 * eps)
    # Three equal lobes; the logarithms are of up to 14.
    same = vmf_pairs.interpolated(b, *(jnp.broadcast_to(x[:, :1], x.shape) for x in (a, m, k)))
    np.testing.assert_allclose(same[0], a[:, 0], rtol=8 * eps)
    np.testing.assert_allclose(same[1], m[:, 0], atol=8 * eps)
    np.testing.assert_allclose(same[2], k[:, 0], rtol=40 * eps)
    turn = rotation(rng)
    turned = vmf_pairs.interpolated(b, a, jnp.asarray(mus @ turn.T, dtype), k)
    np.testing.assert_array_equal(turned[0], alpha)
    np.testing.assert_array_equal(turned[2], kappa)
    np.testing.assert_allclose(turned[1], np.asarray(mu, np.float64) @ turn.T, atol=16 * eps)


def test_blend_integrates_to_one(dtype):
    s, weight = quadrature(200, 64, 30.0)
    weights = np.array([0.2, 0.5, 0.3])
    alphas = np.array([0.7, 0.1, 1.5])
    mus = np.stack([Z, tilted(np.asarray(0.4)), tilted(np.asarray(-0.8))])
    kappas = np.array([30.0, 0.0, 4.0])
    value = vmf_pairs.interpolant_pdf(
        *held(dtype, s, *(x[None, None] for x in (weights, alphas, mus, kappas)))
    )
    total = (np.asarray(value, np.float64) * weight).sum()
    assert total == pytest.approx(1, abs=16 * EPS[dtype] + 1e-12)


def test_compiled_and_mapped_over_lobes(dtype, rng):
    """One program for all lobes; the same numbers lobe by lobe as in one array."""
    lobes = random_pairs(rng, 12, dtype)
    (alpha,) = held(dtype, rng.uniform(0.1, 1, 12))
    traces = []

    def every(a, mu0, k0, mu1, k1):
        traces.append(a)
        return (
            eager_vmf.log_pdf(mu1, mu0, k0),
            eager_vmf.entropy(k0),
            eager_pairs.product(mu0, k0, mu1, k1),
            eager_pairs.convolved(k0, k1),
            eager_pairs.divergence(mu0, k0, mu1, k1),
            eager_pairs.squared_distance(a, mu0, k0, a, mu1, k1),
        )

    eager = every(alpha, *lobes)
    # Logarithms of 20 in some; a product's concentration is among its terms of 1e8.
    scale = [np.abs(np.asarray(x)).max() for x in jax.tree.leaves(eager)]
    compiled = jax.jit(jax.vmap(every))
    del traces[:]
    for _ in range(2):
        found = compiled(alpha, *lobes)
    assert len(traces) == 1
    for one, other, size in zip(jax.tree.leaves(found), jax.tree.leaves(eager), scale, strict=True):
        assert one.dtype == dtype
        np.testing.assert_allclose(one, other, rtol=16 * EPS[dtype], atol=16 * EPS[dtype] * size)
    shaped = jax.tree.map(lambda x: x.reshape(3, 4, *x.shape[1:]), (alpha, *lobes))
    for one, other in zip(jax.tree.leaves(every(*shaped)), jax.tree.leaves(eager), strict=True):
        np.testing.assert_array_equal(one.reshape(other.shape), other)
