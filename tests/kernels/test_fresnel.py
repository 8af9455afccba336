import itertools
import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import fresnel

DATA = json.loads((Path(__file__).parents[1] / "data" / "fresnel.json").read_text())
AL = 0.958 + 6.69j
# A handful of roundings, each amplified at most a few times by the squares.
ULPS = {"float32": 3e-6, "float64": 1e-14}

# Compiled once for each shape: the suite is about values; the last test runs without.
dielectric, conductor, schlick, dielectric_polarised, conductor_polarised = (
    jax.jit(f)
    for f in (
        fresnel.dielectric,
        fresnel.conductor,
        fresnel.schlick,
        fresnel.dielectric_polarised,
        fresnel.conductor_polarised,
    )
)


def twin(cos, m):
    """Fresnel's equations as in a textbook, in extended precision."""
    cos = np.asarray(cos, np.clongdouble)
    m = np.asarray(m, np.clongdouble)
    ct = np.sqrt(1 - (1 - cos**2) / m**2)
    s = (cos - m * ct) / (cos + m * ct)
    p = (m * cos - ct) / (m * cos + ct)
    return (abs(s) ** 2).astype(np.float64), (abs(p) ** 2).astype(np.float64)


def test_reference_values(dtype):
    cos, approximate, glass, metal = np.array(DATA["rows"]).T
    c = jnp.asarray(cos, dtype)
    tol = ULPS[dtype]
    np.testing.assert_allclose(dielectric(c, 1.5), glass, rtol=tol)
    np.testing.assert_allclose(conductor(c, AL.real, AL.imag), metal, rtol=tol)
    # (1 - c)^5 loses digits as c -> 1, but there r0 dominates.
    np.testing.assert_allclose(schlick(c, 0.04), approximate, rtol=tol)


@pytest.mark.parametrize("n", [1.0003, 1.33, 1.5, 2.4, 4.0])
def test_dielectric_against_textbook_form(n, dtype):
    cos = np.linspace(0.0, 1.0, 101).astype(dtype)
    n = float(np.asarray(n, dtype))  # the same index for both
    s, p = dielectric_polarised(jnp.asarray(cos), n)
    want_s, want_p = twin(cos, n)
    # The amplitude r_p passes through 0 at Brewster's angle and is good to a rounding of 1
    # there.
    for got, want in ((s, want_s), (p, want_p)):
        amplitude = 4 * float(jnp.finfo(dtype).eps)
        np.testing.assert_allclose(np.sqrt(got), np.sqrt(want), rtol=ULPS[dtype], atol=amplitude)


@pytest.mark.parametrize("m", [AL, 0.13 + 3.2j, 1.2 + 0.66j, 0.5 + 0.01j, 3.0 + 1e-4j, 0.05 + 8j])
def test_conductor_against_textbook_form(m, dtype):
    cos = np.linspace(0.0, 1.0, 101).astype(dtype)
    eta, k = (np.asarray(x, dtype) for x in (m.real, m.imag))
    s, p = conductor_polarised(jnp.asarray(cos), float(eta), float(k))
    want_s, want_p = twin(cos, float(eta) + 1j * float(k))
    # Near a critical or pseudo-Brewster angle one rounding of g^2 counts several times.
    for got, want in ((s, want_s), (p, want_p)):
        np.testing.assert_allclose(got, want, rtol=10 * ULPS[dtype], atol=ULPS[dtype] / 10)


def test_no_cancellation_for_index_near_one(dtype):
    """R = ((n-1)/(n+1))^2 at normal incidence keeps its digits however small it is."""
    step = 2.0**-20
    n = 1.0 + step  # exact in both types
    one = jnp.ones((), dtype)
    want = (step / (2.0 + step)) ** 2
    for got in (dielectric(one, n), conductor(one, n, 0.0)):
        np.testing.assert_allclose(got, want, rtol=ULPS[dtype])


@pytest.mark.parametrize("n", [0.6, 1.5, 2.0])
def test_brewster_angle(n, dtype):
    cos = jnp.asarray(1.0 / np.sqrt(1.0 + n * n), dtype)
    s, p = dielectric_polarised(cos, n)
    # r_p is proportional to the rounding of the angle, its power to the square.
    assert p < (10 * float(jnp.finfo(dtype).eps)) ** 2
    # r_s there is (1 - n^2)/(1 + n^2).
    np.testing.assert_allclose(s, ((1 - n * n) / (1 + n * n)) ** 2, rtol=ULPS[dtype])


def test_both_polarisations_agree_at_normal_incidence(dtype):
    one = jnp.ones((), dtype)
    s, p = conductor_polarised(one, AL.real, AL.imag)
    np.testing.assert_allclose(s, p, rtol=ULPS[dtype])
    np.testing.assert_allclose(s, abs((AL - 1) / (AL + 1)) ** 2, rtol=ULPS[dtype])


def test_reversed_path_reflects_alike(dtype):
    """Stokes: the reflectance from either side of an interface is the same."""
    n = 1.5
    cos_out = np.linspace(0.05, 1.0, 40)
    cos_in = np.sqrt(1 - (1 - cos_out**2) / n**2)
    outside = dielectric(jnp.asarray(cos_out, dtype), n)
    inside = dielectric(jnp.asarray(cos_in, dtype), 1 / n)
    # cos_in is rounded before 1/n^2 is taken off; at the shallowest angle that costs a
    # factor (cos_in/cos_out)^2/n^2, about 100.
    np.testing.assert_allclose(inside, outside, rtol=100 * ULPS[dtype])


def test_total_reflection(dtype):
    n = 1 / 1.5
    critical = np.sqrt(1 - n * n)
    beyond = jnp.asarray(np.linspace(0, critical * 0.999, 50), dtype)
    below = jnp.asarray(critical * 1.001, dtype)
    assert (dielectric(beyond, n) == 1.0).all()
    assert 0.5 < dielectric(below, n) < 1.0
    slope = jax.vmap(jax.grad(dielectric), in_axes=(0, None))(beyond, n)
    assert (slope == 0.0).all()
    # Without extinction the conductor's formula finds total reflection by itself; its 1 - n^2
    # and c^2 + b^2 agree to rounding.
    np.testing.assert_allclose(conductor(beyond, n, 0.0), 1.0, rtol=ULPS[dtype])
    # Extinction only takes away beyond the critical angle.
    lossy = conductor(beyond[1:], n, 1e-3)
    assert (lossy < 1.0).all()


def test_conductor_without_extinction_is_the_dielectric(dtype):
    cos = jnp.linspace(0.0, 1.0, 41, dtype=dtype)
    for n in (0.7, 1.33, 2.0):
        got = conductor_polarised(cos, n, 0.0)
        for a, b in zip(got, dielectric_polarised(cos, n), strict=True):
            # Two orders of the same operations; r_p^2 has an absolute floor near Brewster.
            np.testing.assert_allclose(a, b, rtol=10 * ULPS[dtype], atol=ULPS[dtype] ** 2)


EDGES = [0.0, 1e-20, 1e-10, 1e-4, 0.3, 1 - 1e-6, 1.0]


INDICES = [0.5, 2 / 3, 1.0 - 1e-7, 1.0, 1.0 + 1e-7, 1.5, 10.0]
EXTINCTIONS = [0.0, 1e-12, 1e-3, 5.0]


@pytest.mark.parametrize("compiled", [False, True])
def test_finite_everywhere(compiled, dtype):
    grid = np.array(list(itertools.product(EDGES, INDICES, EXTINCTIONS))).T
    cos, n, k = jnp.asarray(grid, dtype)
    cases = (
        (fresnel.dielectric, (cos, n)),
        (fresnel.conductor, (cos, n, k)),
        (fresnel.schlick, (cos, jnp.abs(n - 1) / (n + 1))),
    )
    for f, arguments in cases:
        both = jax.vmap(jax.value_and_grad(f, argnums=tuple(range(len(arguments)))))
        value, slopes = (jax.jit(both) if compiled else both)(*arguments)
        assert (value >= 0.0).all(), f
        assert (value <= 1.0 + ULPS[dtype]).all(), f
        for slope in slopes:
            bad = ~np.isfinite(slope)
            assert not bad.any(), (f, grid[:, bad])


def test_critical_angle_exactly():
    """The root is exactly 0 for n^2 = 0.75, cos = 0.5: value 1, finite gradient."""
    cos = jnp.asarray(0.6)
    n = jnp.asarray(0.8)  # 3-4-5 triangle; rounding decides the side, so step over it too
    for step in (-1e-16, 0.0, 1e-16):
        value, slope = jax.value_and_grad(dielectric, argnums=(0, 1))(cos + step, n)
        np.testing.assert_allclose(value, 1.0, rtol=1e-6)  # 1 - R ~ sqrt(rounding)
        assert np.isfinite(slope).all()
        value, slope = jax.value_and_grad(conductor, argnums=(0, 1, 2))(
            cos + step, n, jnp.asarray(0.0)
        )
        np.testing.assert_allclose(value, 1.0, rtol=1e-6)
        assert np.isfinite(slope).all()


def test_no_interface_reflects_nothing(dtype):
    cos = jnp.asarray([0.0, 1e-12, 1e-3, 0.5, 1.0], dtype)
    assert (dielectric(cos, 1.0) == 0.0).all()
    assert (conductor(cos, 1.0, 0.0) == 0.0).all()


def test_grazing_incidence_reflects_everything(dtype):
    zero = jnp.zeros((), dtype)
    for value in (
        dielectric(zero, 1.5),
        conductor(zero, AL.real, AL.imag),
        schlick(zero, 0.04),
    ):
        np.testing.assert_allclose(value, 1.0, rtol=ULPS[dtype])


def test_gradients_against_complex_step():
    """The reflectances are analytic in every argument; differences of the twin as oracle."""
    h = 1e-6
    for cos in (0.02, 0.3, 0.8, 0.99):
        for m in (AL, 1.5 + 0.1j, 0.2 + 3j):
            got = jax.grad(conductor, argnums=(0, 1, 2))(cos, *map(float, (m.real, m.imag)))
            want = [
                (sum(twin(cos + h * a, m + h * b)) - sum(twin(cos - h * a, m - h * b))) / (4 * h)
                for a, b in ((1, 0), (0, 1), (0, 1j))
            ]
            # Central differences: truncation h^2 times third derivatives (up to 1e4 near
            # grazing), rounding 1e-16/h.
            np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-8)


def test_permittivity_and_index_are_inverse(dtype):
    m = np.array([AL, 0.13 + 3.2j, 1.5 + 0j, 2.0 + 1e-6j, 1e-3 + 1e-3j])
    eps = m**2
    eta, k = fresnel.index_from_permittivity(
        jnp.asarray(eps.real, dtype), jnp.asarray(eps.imag, dtype)
    )
    np.testing.assert_allclose(eta, m.real, rtol=ULPS[dtype], atol=0)
    np.testing.assert_allclose(k, m.imag, rtol=ULPS[dtype], atol=0)


def test_batches_jit_and_type(dtype):
    cos = jnp.linspace(0.0, 1.0, 12, dtype=dtype).reshape(3, 4)
    n = jnp.asarray([[1.3, 1.4, 1.5, 1.6]], dtype)
    got = fresnel.dielectric(cos, n)
    assert got.shape == (3, 4)
    assert got.dtype == dtype
    # Fused multiply-add changes the last digits.
    np.testing.assert_allclose(jax.jit(fresnel.dielectric)(cos, n), got, rtol=ULPS[dtype])
    k = jnp.full((1, 4), 0.5, dtype)
    rows = jax.vmap(fresnel.conductor, in_axes=(0, None, None))(cos, n[0], k[0])
    np.testing.assert_allclose(rows, fresnel.conductor(cos, n, k), rtol=ULPS[dtype])
