import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import fresnel, glasses
from diffopt.errors import InputError
from diffopt.kernels import fresnel as kernel

LAM = np.array([0.4, 0.55, 0.7])
ALL = {
    "mirror": fresnel.Constant(),
    "constant": fresnel.Constant(0.8),
    "schlick": fresnel.Schlick(0.04),
    "glass": fresnel.Dielectric(1.5),
    "cauchy": fresnel.Dielectric((1.5046, 0.0042)),
    "table": fresnel.Conductor(np.array([0.38, 0.6, 0.78]), np.array([1.0, 0.9, 2.0]), 5 + LAM),
    "al": fresnel.metal("Al"),
    "ag": fresnel.metal("Ag"),
    "au": fresnel.metal("Au"),
    "cu": fresnel.metal("Cu"),
    "water": glasses.glass("water"),
}
# A few roundings in float32, parameters rounded once.
TOL = {"float32": 2e-5, "float64": 1e-13}


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_one_protocol(name, batch, dtype):
    material = ALL[name]
    cos = jnp.linspace(0.0, 1.0, int(np.prod(batch)), dtype=dtype).reshape(batch)
    lam = jnp.asarray(LAM, dtype)
    value = material(cos, lam)
    assert value.shape == (*batch, 3)
    assert value.dtype == dtype
    assert (value >= 0).all()
    assert (value <= 1 + TOL[dtype]).all()
    compiled = eqx.filter_jit(lambda m, c, l: m(c, l))(material, cos, lam)
    np.testing.assert_allclose(compiled, value, rtol=TOL[dtype])


@pytest.mark.parametrize("name", ALL)
def test_normal_incidence(name, dtype):
    material = ALL[name]
    lam = jnp.asarray(LAM, dtype)
    got = material.normal(lam)
    assert got.dtype == dtype
    np.testing.assert_allclose(got, material(jnp.ones((1,), dtype), lam)[0], rtol=TOL[dtype])
    if hasattr(material, "index"):
        index = material.index(lam)
        eta, k = index if isinstance(index, tuple) else (index, 0.0)
        m = np.asarray(eta) + 1j * np.asarray(k)
        np.testing.assert_allclose(got, abs((m - 1) / (m + 1)) ** 2, rtol=TOL[dtype])


@pytest.mark.parametrize("name", ALL)
def test_parameters_have_gradients(name):
    material = ALL[name]
    cos, lam = jnp.asarray([0.0, 0.4, 1.0]), jnp.asarray(LAM)
    slopes = eqx.filter_grad(lambda m: m(cos, lam).sum())(material)
    leaves = jax.tree.leaves(slopes)
    assert leaves
    assert all(np.isfinite(leaf).all() for leaf in leaves)
    assert any((np.asarray(leaf) != 0).any() for leaf in leaves)


def test_cauchy_dispersion():
    """BK7 from its published Cauchy terms: n_F = 1.5224, n_d = 1.5168, n_C = 1.5143."""
    glass = fresnel.Dielectric((1.5046, 0.0042))
    n = glass.index(jnp.asarray([0.4861, 0.5876, 0.6563]))
    # Two Cauchy terms follow the catalogue's indices to some 1e-3.
    np.testing.assert_allclose(n, [1.5224, 1.5168, 1.5143], atol=6e-4)


def test_metal_against_complex_formula(dtype):
    """The published formula in complex arithmetic, with the free electrons written apart."""
    w = 1.239841984 / LAM
    eps = 1 - 0.760 * 9.03**2 / (w * (w + 0.053j))
    for f, g, w0 in (
        (0.024, 0.241, 0.415),
        (0.010, 0.345, 0.830),
        (0.071, 0.870, 2.969),
        (0.601, 2.494, 4.304),
        (4.384, 2.214, 13.32),
    ):
        eps = eps + f * 9.03**2 / (w0**2 - w**2 - 1j * w * g)
    eta, k = fresnel.metal("au").index(jnp.asarray(LAM, dtype))
    np.testing.assert_allclose(np.asarray(eta) + 1j * np.asarray(k), np.sqrt(eps), rtol=TOL[dtype])


def test_metals_look_like_metals():
    """Aluminium near 0.958 + 6.69 i at 0.55 um; silver white; gold and copper red by far."""
    red, green, blue = 2, 1, 0
    lam = jnp.asarray(LAM)
    al, ag, au, cu = (np.asarray(fresnel.metal(m).normal(lam)) for m in fresnel.METALS)
    # The fit is 0.006 off measured aluminium.
    assert abs(al[green] - 0.9211) < 0.008
    assert (ag > 0.85).all()
    assert (ag[1:] > 0.95).all()
    assert au[red] > 0.9
    assert au[blue] < 0.45
    assert au[blue] < au[green] < au[red]
    assert cu[red] > 0.9
    assert cu[blue] < 0.6


def test_conductor_table():
    table = fresnel.Conductor(np.array([0.4, 0.6]), np.array([1.0, 2.0]), np.array([4.0, 3.0]))
    eta, k = table.index(jnp.asarray([0.4, 0.45, 0.6]))
    np.testing.assert_allclose(eta, [1.0, 1.25, 2.0], rtol=1e-14)
    np.testing.assert_allclose(k, [4.0, 3.75, 3.0], rtol=1e-14)
    cos = jnp.ones(())
    with pytest.raises(ValueError, match=r"0\.39 to 0\.5 um given, .* has 0\.4 to 0\.6 um"):
        table(cos, jnp.asarray([0.39, 0.5]))
    compiled = eqx.filter_jit(lambda m, l: m(cos, l))
    with pytest.raises(eqx.EquinoxRuntimeError, match="outside the table of the conductor"):
        compiled(table, jnp.asarray([0.5, 0.61]))
    # The end points stand, in either type and by either route.
    ends = jnp.asarray([0.4, 0.6], "float32")
    assert np.isfinite(table(jnp.ones((), "float32"), ends)).all()
    assert np.isfinite(eqx.filter_jit(lambda m, l: m.normal(l))(table, ends)).all()


def test_bad_parameters():
    two = np.array([0.4, 0.6])
    with pytest.raises(ValueError, match="wavelengths: a table of 1 given"):
        fresnel.Conductor(two[:1], two[:1], two[:1])
    with pytest.raises(ValueError, match=r"wavelengths: .* expected an ascending table"):
        fresnel.Conductor(two[::-1], two, two)
    with pytest.raises(ValueError, match=r"k: -0\.6 to -0\.4 given, expected values of at least 0"):
        fresnel.Conductor(two, two, -two)
    with pytest.raises(ValueError, match=r"n: -1\.5 given"):
        fresnel.Dielectric(-1.5)
    with pytest.raises(ValueError, match=r"r0: 1\.2 given"):
        fresnel.Schlick(1.2)
    with pytest.raises(ValueError, match="value: 0 given"):
        fresnel.Constant(0.0)
    with pytest.raises(ValueError, match=r"width: 0 to 0\.1 given, expected values above 0 eV"):
        fresnel.LorentzDrude(9.0, two, np.array([0.0, 0.1]), two)
    with pytest.raises(InputError, match="metal: 'Fe' given, expected one of Al, Ag, Au, Cu"):
        fresnel.metal("Fe")


@pytest.mark.parametrize(
    ("text", "want"),
    [
        ("mirror", 1.0),
        ("constant=0.8", 0.8),
        ("n=1.5", 0.04),
        (" N = 1.5 ", 0.04),
        ("schlick=0.04", 0.04),
        ("schlick=4e-2", 0.04),
    ],
)
def test_parse_numbers(text, want):
    got = fresnel.parse(text).normal(jnp.asarray(LAM))
    np.testing.assert_allclose(got, want, rtol=1e-13)


@pytest.mark.parametrize("text", ["al", "Ag", "AU", "cu"])
def test_parse_metals(text):
    lam = jnp.asarray(LAM)
    assert (fresnel.parse(text).normal(lam) == fresnel.metal(text).normal(lam)).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("glass", "material: 'glass' given, expected mirror, al, ag, au, cu, n=NUMBER"),
        ("n", "material: 'n' given"),
        ("", "material: '' given"),
        ("n=glass", "'glass' given for n, expected a number"),
        ("n=", "'' given for n, expected a number"),
        ("n=-1", "material 'n=-1': n: -1 given, expected a refractive index above 0"),
        ("n=nan", "n: nan given"),
        ("n=inf", "n: inf given, expected a finite index"),
        ("n=1", "an index of 1 reflects nothing"),
        ("schlick=2", "r0: 2 given, expected above 0 and at most 1"),
        ("constant=0", "value: 0 given"),
    ],
)
def test_parse_errors(text, message):
    with pytest.raises(InputError, match=message):
        fresnel.parse(text)


@pytest.mark.parametrize(
    ("name", "n_d", "dispersion"),
    # Index at 587.6 nm and n_F - n_C, as the sources of the coefficients tabulate them.
    [("n-bk7", 1.51680, 0.008054), ("silica", 1.45846, 0.006761), ("water", 1.33342, 0.00597)],
)
def test_glasses_have_their_published_index(name, n_d, dispersion):
    index = glasses.glass(name).index(jnp.asarray([0.5875618, 0.4861327, 0.6562725]))
    assert float(index[0]) == pytest.approx(n_d, abs=1.5e-4)
    assert float(index[1] - index[2]) == pytest.approx(dispersion, rel=0.01)
    with pytest.raises(InputError, match="one of n-bk7, silica, water, diamond; received 'ruby'"):
        glasses.glass("ruby")


def test_index_from_the_reflectance_at_normal_incidence():
    n = jnp.asarray([1.0, 1.33, 1.5, 2.4])
    r0 = kernel.dielectric(jnp.ones(4), n)
    np.testing.assert_allclose(kernel.index_from_normal(r0), n, rtol=1e-5)
