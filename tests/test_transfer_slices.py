"""Slices of transfer: weights of rays, moments, lobes, what lies between and how far apart."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but
from transfer_cases import LAMBERT, hemisphere_rule, reflector, unit

import diffopt as do
from diffopt.kernels import mixture, vmf, vmf_pairs
from diffopt.transfer import fits, references, reflectors, slices, weighting
from diffopt.transfer.references import Unoccluded
from diffopt.transfer.slices import Slices
from diffopt.transfer.views import hemisphere

RAYS, LEVEL = 1024, 2
GLOSSY = do.BlinnPhong((0.8, 0.4, 0.2), 40.0)


def weights(material, lobes=1, rays=RAYS, level=LEVEL):
    made = reflector(material)
    among = weighting.directions(rays, weighting.fineness(made, rays))
    sphere = hemisphere(level)
    found = weighting.glossy(made, among, sphere, slice(0, sphere.counts[level]), lobes)
    return made, among, sphere.views, found


@pytest.fixture(scope="module")
def one():
    return weights(GLOSSY)


@pytest.fixture(scope="module")
def two():
    return weights(GLOSSY, lobes=2)


def test_one_direction_in_every_cell():
    among = weighting.directions(256, 8)
    assert len(among.rays) == 256
    assert len(among.fine) == 2048
    # Points of equal solid angle: the mean of z^k is 1 / (k + 1).
    for k in (1, 2, 3):
        np.testing.assert_allclose((among.rays[:, 2] ** k).mean(), 1 / (k + 1), rtol=1e-4)
    nearest = np.argmax(among.fine @ among.rays.T, -1)
    np.testing.assert_array_equal(among.cell, nearest)


def test_sums_of_weights_are_the_albedo(one):
    made, _, views, found = one
    d, solid = hemisphere_rule(300, 600)
    rows = [0, 5, 12, 40, 90]
    alpha, whole = np.asarray(found.alpha)[:, 0], np.asarray(found.whole)
    np.testing.assert_allclose(np.asarray(found.rays).sum(-1), whole, rtol=1e-5)
    for row in rows:
        f = np.asarray(GLOSSY.f(d, np.broadcast_to(views[row], d.shape)), np.float64)
        each = f * (d[:, 2] * solid)[:, None]
        # Fine directions: 256 for the lobe, evenly spread.
        np.testing.assert_allclose(alpha[row], each.sum(0), rtol=5e-3)
        first = (
            np.asarray(found.rays)[row].astype(np.float64)
            @ weighting.directions(RAYS, weighting.fineness(made, RAYS)).rays
            + np.asarray(found.off)[row, 0]
        )
        expected = (each.mean(-1)[:, None] * d).sum(0)
        np.testing.assert_allclose(first, expected, atol=5e-3 * whole[row])


def test_the_diffuse_slice_is_a_cosine():
    made = reflector(LAMBERT((0.9, 0.6, 0.3)))
    found = weighting.diffuse(made, weighting.directions(RAYS, 1), 1)
    # Midpoints of z in 1024 cells: the error of the integral is their number to the power -2.
    np.testing.assert_allclose(np.asarray(found.alpha)[0, 0], [0.9, 0.6, 0.3], rtol=1e-5)
    np.testing.assert_allclose(np.asarray(found.mu)[0, 0], [0, 0, 1], atol=2e-3)
    # The mean cosine of a cosine lobe is 2/3.
    kappa = float(found.kappa[0, 0])
    np.testing.assert_allclose(1 / np.tanh(kappa) - 1 / kappa, 2 / 3, rtol=1e-4)


@pytest.mark.parametrize("glossy", [True, False])
def test_lobes_share_the_weights(glossy, one, two):
    """However many lobes: together they are what one is, ray by ray."""
    if glossy:
        single, double = one[3], two[3]
    else:
        among = weighting.directions(RAYS, 1)
        single, double = (weighting.diffuse(reflector(LAMBERT(0.7)), among, k) for k in (1, 2))
    views = single.kappa.shape[0]
    apart = np.asarray(double.rays).reshape(views, 2, -1)
    assert (apart >= 0.0).all()
    # The softmax of two numbers sums to 1 but for its rounding.
    np.testing.assert_allclose(apart.sum(1), single.rays, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(
        np.asarray(double.alpha).sum(1), np.asarray(single.alpha)[:, 0], rtol=1e-5
    )
    np.testing.assert_allclose(
        np.asarray(double.off).reshape(views, 2, 3).sum(1),
        np.asarray(single.off).reshape(views, 3),
        atol=1e-6,
    )


def columns(rays, free, channels):
    """Of one vertex that sees light along some rays."""
    direct = np.concatenate([free[:, None], free[:, None] * rays], -1)
    return np.concatenate([direct, np.zeros((len(rays), 2 * (channels + 3)))], -1)[None]


def test_moments_make_the_likeliest_lobe(rng):
    """Against the closed form of `kernels.mixture`, over the rays that are free."""
    made, among, _, found = weights(do.BlinnPhong(0.8, 4.0), rays=4096, level=1)
    assert len(among.fine) == len(among.rays)  # nothing is added within cells
    free = (among.rays @ unit(np.array([0.3, -0.2, 0.5])) > 0.7).astype(float)
    sharpest = jnp.full(3, reflectors.SHARPEST, jnp.float32)
    held = jnp.asarray(columns(among.rays, free, 1), jnp.float32)
    got = slices.from_moments(found, held, sharpest)
    s = jnp.asarray(among.rays, jnp.float32)
    for view in (0, 7, 20, 30):
        weight = found.rays[view] * jnp.asarray(free, jnp.float32)
        alpha, mu, kappa = mixture.moments(s, weight, reflectors.SHARPEST)
        # Sums of 4096 numbers in float32, in another order.
        np.testing.assert_allclose(got.alpha[0, view, 0, 0, 0], alpha, rtol=1e-5)
        np.testing.assert_allclose(got.mu[0, view, 0, 0], mu, atol=1e-5)
        np.testing.assert_allclose(got.kappa[0, view, 0, 0], kappa, rtol=1e-4)
    assert not np.asarray(got.alpha[:, :, 1:]).any()
    assert made.channels == 1


@pytest.mark.parametrize("lobes", but({2}, [1, 2]))
def test_nothing_hidden_is_the_unoccluded_slice(lobes, one, two):
    _, among, _, found = one if lobes == 1 else two
    free = np.ones(len(among.rays))
    sharpest = jnp.full(3, reflectors.SHARPEST, jnp.float32)
    held = jnp.asarray(columns(among.rays, free, 3), jnp.float32)
    got = slices.from_moments(found, held, sharpest)
    whole = slices.unoccluded(found)
    # Sums of 1024 numbers in float32, in another order; moments of a lobe of concentration 10
    # are told apart from 1 to a tenth of that.
    np.testing.assert_allclose(got.alpha[0], whole.alpha, rtol=1e-5, atol=1e-8)
    np.testing.assert_allclose(got.mu[0, :, 0], whole.mu[:, 0], atol=1e-5)
    np.testing.assert_allclose(got.kappa[0, :, 0], whole.kappa[:, 0], rtol=1e-4)
    # Nothing arrives by way of surfaces.
    assert not np.asarray(got.alpha[0, :, 1:]).any()


def test_nothing_seen_has_finite_lobes(one):
    _, among, _, found = one
    dark = jnp.zeros((1, len(among.rays), 4 + 2 * 6), jnp.float32)
    got = slices.from_moments(found, dark, jnp.full(3, 100.0, jnp.float32))
    assert all(np.isfinite(a).all() for a in got)
    assert not np.asarray(got.alpha).any()
    np.testing.assert_allclose(np.linalg.norm(got.mu, axis=-1), 1.0, rtol=1e-5)


KAPPAS = np.array([0.0, 1e-3, 0.5, 1.0, 30.0, 2e3, 2e4])


def single(alpha, mu, kappa, dtype):
    """One kind of one lobe, one channel: [n, 1, 1, ...]."""
    return Slices(
        jnp.asarray(alpha, dtype)[:, None, None, None],
        jnp.asarray(mu, dtype)[:, None, None],
        jnp.asarray(kappa, dtype)[:, None, None],
    )


def test_distance_of_single_lobes(dtype, rng):
    """That of `kernels.vmf_pairs`, and for kappa = 0 in closed form."""
    k0, k1 = (a.reshape(-1) for a in np.meshgrid(KAPPAS, KAPPAS))
    n = len(k0)
    mu0 = unit(rng.normal(size=(n, 3)))
    mu1 = unit(mu0 + 0.3 * rng.normal(size=(n, 3)) / np.sqrt(1.0 + k0)[:, None])
    a0, a1 = rng.uniform(0.0, 2.0, (2, n))
    one, other = single(a0, mu0, k0, dtype), single(a1, mu1, k1, dtype)
    got = np.asarray(jax.jit(slices.squared_distance)(one, other))
    held = [jnp.asarray(a, dtype) for a in (a0, mu0, k0, a1, mu1, k1)]
    expected = np.asarray(jax.jit(vmf_pairs.squared_distance)(*held))
    size = np.asarray(slices.squared_norm(one) + slices.squared_norm(other))
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose((got - expected) / size, 0.0, atol=32 * eps)
    even = (k0 == 0.0) & (k1 == 0.0)
    np.testing.assert_allclose(got[even], ((a0 - a1) ** 2)[even] / (4.0 * np.pi), rtol=64 * eps)
    np.testing.assert_allclose(slices.squared_distance(one, one) / size, 0.0, atol=32 * eps)


def test_norms_by_quadrature():
    d, solid = hemisphere_rule()
    d, solid = np.concatenate([d, -d]), np.concatenate([solid, solid])
    for kappa in (0.0, 0.5, 30.0):
        pdf = np.asarray(vmf.pdf(*(jnp.asarray(a, jnp.float32) for a in (d, [[0, 0, 1]], [kappa]))))
        got = slices.squared_norm(single([2.0], [[0.0, 0.0, 1.0]], [kappa], jnp.float32))
        np.testing.assert_allclose(got[0], 4.0 * (pdf**2 * solid).sum(), rtol=1e-4)


def test_between_two_lobes(dtype, rng):
    """Halfway between like lobes: mean weight, geometric mean concentration, middle axis."""
    n = 40
    mu = unit(rng.normal(size=(n, 2, 3)))
    kappa = 10 ** rng.uniform(-2, 4, (n, 2))
    alpha = np.tile(rng.uniform(0.1, 2.0, (n, 1)), (1, 2))
    pair = Slices(
        jnp.asarray(alpha, dtype)[:, :, None, None, None],
        jnp.asarray(mu, dtype)[:, :, None, None],
        jnp.asarray(kappa, dtype)[:, :, None, None],
    )
    got = jax.jit(slices.between)(jnp.full((n, 2), 0.5, dtype), pair)
    eps = float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(got.alpha[:, 0, 0, 0], alpha[:, 0], rtol=8 * eps)
    # Logarithms up to 10 in units of the dtype's eps.
    np.testing.assert_allclose(got.kappa[:, 0, 0], np.sqrt(kappa.prod(1)), rtol=64 * eps)
    middle = mu.sum(1)
    length = np.linalg.norm(middle, axis=-1, keepdims=True)
    error = np.abs(np.asarray(got.mu[:, 0, 0]) - middle / length) * length
    assert error.max() < 16 * eps


def test_at_a_corner_lies_the_corner(rng):
    """Shares 1, 0, 0: the first lobe, even where the others have more light."""
    n = 30
    found = Slices(
        jnp.asarray(rng.uniform(0.0, 1.0, (n, 3, 3, 2, 3)), jnp.float32),
        jnp.asarray(unit(rng.normal(size=(n, 3, 3, 2, 3))), jnp.float32),
        jnp.asarray(10 ** rng.uniform(-1, 3, (n, 3, 3, 2)), jnp.float32),
    )
    shares = jnp.asarray(np.tile([1.0, 0.0, 0.0], (n, 1)), jnp.float32)
    got = slices.between(shares, found)
    for a, b in zip(got, found, strict=True):
        np.testing.assert_allclose(a, b[:, 0], rtol=3e-6, atol=1e-6)


def test_a_lobe_without_light_says_nothing_of_where():
    """Between a lobe and one with no weight the axis is the lobe's."""
    mu = np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    pair = Slices(
        jnp.asarray([[1.0, 0.0]], jnp.float32)[:, :, None, None, None],
        jnp.asarray(mu, jnp.float32)[:, :, None, None],
        jnp.asarray([[50.0, 3.0]], jnp.float32)[:, :, None, None],
    )
    got = slices.between(jnp.asarray([[0.25, 0.75]], jnp.float32), pair)
    np.testing.assert_allclose(got.alpha[0, 0, 0, 0], 0.25)
    np.testing.assert_allclose(got.mu[0, 0, 0], mu[0, 0], atol=1e-6)
    np.testing.assert_allclose(got.kappa[0, 0, 0], 50.0, rtol=1e-5)


def test_turned_about_the_normal(rng):
    mu = unit(rng.normal(size=(5, 3, 2, 3)))
    found = Slices(jnp.ones((5, 3, 2, 1)), jnp.asarray(mu), jnp.ones((5, 3, 2)))
    angle = np.array(0.7)
    got = slices.turned(found, jnp.asarray(np.cos(angle)), jnp.asarray(np.sin(angle)))
    turn = np.array([[np.cos(0.7), -np.sin(0.7), 0], [np.sin(0.7), np.cos(0.7), 0], [0, 0, 1]])
    np.testing.assert_allclose(got.mu, mu @ turn.T, atol=1e-6)


def axes_above(rng):
    n = unit(rng.normal(size=(200, 3)))
    n[:, 2] = np.abs(n[:, 2])
    edge = [
        [0, 0, 1],
        [1, 0, 0],
        [0, -1, 0],
        [0.6, -0.8, 0],
        [1e-20, 0, 1],
        [0.8, 0, -0.4],
        [0, 1, -0.3],
    ]
    return np.concatenate([n, unit(np.array(edge))])


def test_frames_of_axes_are_rotations(dtype, rng):
    axes = axes_above(rng)
    part = tuple(jnp.asarray(a, dtype) for a in axes.T)
    whole = []
    for k in range(3):
        basis = tuple(jnp.full(len(axes), float(k == i), dtype) for i in range(3))
        whole.append(np.stack(references.into(part, basis), -1))
    matrix = np.stack(whole, -1).astype(np.float64)
    # Products of three rounded numbers, over 1 + z >= 1/2.
    atol = 16 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(
        matrix @ matrix.transpose(0, 2, 1), np.tile(np.eye(3), (len(axes), 1, 1)), atol=atol
    )
    np.testing.assert_allclose(np.linalg.det(matrix), 1.0, atol=atol)
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", matrix, axes), np.tile([0.0, 0.0, 1.0], (len(axes), 1)), atol=atol
    )
    v = rng.normal(size=(len(axes), 3))
    there = references.into(part, tuple(jnp.asarray(a, dtype) for a in v.T))
    back = np.stack(references.out_of(part, there), -1)
    np.testing.assert_allclose(back, v, atol=16 * atol)


def test_relative_and_absolute_are_inverse(rng):
    found = Slices(
        jnp.asarray(rng.uniform(0.0, 1.0, (50, 3, 2, 3)), jnp.float32),
        jnp.asarray(unit(rng.normal(size=(50, 3, 2, 3))), jnp.float32),
        jnp.asarray(10 ** rng.uniform(-2, 4, (50, 3, 2)), jnp.float32),
    )
    axes = unit(np.abs(rng.normal(size=(50, 2, 3))))
    over = Unoccluded(
        jnp.asarray(rng.uniform(0.1, 1.0, (50, 2, 3)), jnp.float32),
        jnp.asarray(axes, jnp.float32),
        jnp.asarray(rng.uniform(-2, 9, (50, 2)), jnp.float32),
    )
    held = references.relative(found, over)
    for a, b in zip(references.absolute(held, over), found, strict=True):
        # Concentrations go by exp of up to 9.
        np.testing.assert_allclose(a, b, rtol=3e-6, atol=2e-6)
    own = Slices(
        jnp.stack([over.alpha] * 3, 1),
        jnp.stack([over.mu] * 3, 1),
        jnp.exp(jnp.stack([over.log_kappa] * 3, 1)),
    )
    none = references.relative(own, over)
    np.testing.assert_allclose(none.alpha, 1.0, rtol=1e-6)
    np.testing.assert_allclose(none.mu[:, 0], np.tile([0.0, 0.0, 1.0], (50, 2, 1)), atol=1e-6)
    np.testing.assert_allclose(none.kappa[:, 0], 1.0, rtol=1e-5)


def test_over_a_material_that_is_black():
    """Weights over none are none, and finite."""
    found = Slices(
        jnp.zeros((1, 3, 1, 3)),
        jnp.tile(jnp.asarray([0.0, 0.0, 1.0]), (1, 3, 1, 1)),
        jnp.ones((1, 3, 1)),
    )
    over = Unoccluded(
        jnp.zeros((1, 1, 3)), jnp.asarray([[[0.0, 0.0, 1.0]]]), jnp.full((1, 1), -13.8)
    )
    held = references.relative(found, over)
    assert all(np.isfinite(a).all() for a in held)
    assert not np.asarray(held.alpha).any()

    def total(found, over):
        return sum(jnp.sum(a**2) for a in references.relative(found, over))

    for part in jax.tree.leaves(jax.grad(total, argnums=(0, 1))(found, over)):
        assert np.isfinite(part).all()


def lobe_error(made, view, alpha, mu, kappa):
    """Squared error of lobes for the mean of the channels, over squared norm; by quadrature."""
    d, solid = hemisphere_rule(160, 320)
    f = np.asarray(
        made.value(*(jnp.asarray(a, jnp.float32) for a in (d, np.tile(view, (len(d), 1)))))
    )
    truth = f.mean(-1) * d[:, 2]
    both, weights = np.concatenate([d, -d]), np.concatenate([solid, solid])
    truth = np.concatenate([truth, np.zeros(len(d))])
    pdf = np.asarray(
        vmf.pdf(*(jnp.asarray(a, jnp.float32) for a in (both[None], mu[:, None], kappa[:, None])))
    )
    shown = (alpha[:, None] * pdf).sum(0)
    return ((shown - truth) ** 2 * weights).sum() / (truth**2 * weights).sum()


@pytest.mark.parametrize("lobes", but({2}, [1, 2]))
def test_fitted_lobes_are_nearer_than_moments(lobes, one, two):
    """In the square of the error, at every view, with the energy kept."""
    made, _, views, found = one if lobes == 1 else two
    rows = np.array([0, 3, 11, 40, 77, 100])
    some = weighting.Weights(
        found.rays.reshape(len(views), lobes, -1)[rows].reshape(len(rows) * lobes, -1),
        found.whole.reshape(len(views), lobes)[rows].reshape(-1),
        found.off.reshape(len(views), lobes, 3)[rows].reshape(-1, 3),
        found.tint[rows],
        found.mu[rows],
        found.kappa[rows],
    )
    alpha, mu, kappa = fits.best(made, views[rows], some)
    np.testing.assert_allclose(alpha.sum(1), np.asarray(some.alpha).sum(1), rtol=1e-4)
    assert (alpha >= 0.0).all()
    assert (kappa <= reflectors.SHARPEST).all()
    np.testing.assert_allclose(np.linalg.norm(mu, axis=-1), 1.0, rtol=1e-5)
    start = np.asarray(some.alpha).mean(-1)
    for k, row in enumerate(rows):
        fitted = lobe_error(made, views[row], alpha[k].mean(-1), mu[k], kappa[k])
        begun = lobe_error(
            made, views[row], start[k], np.asarray(some.mu)[k], np.asarray(some.kappa)[k]
        )
        # The grids differ: a hundredth.
        assert fitted < 1.01 * begun + 1e-4


def test_slopes_are_finite(dtype):
    """With weights of 0, at both ends of the concentrations, and for axes that cancel."""
    up = np.array([0.0, 0.0, 1.0])
    mu = np.array([[up, up], [up, -up], [up, [1.0, 0, 0]]])
    mu = np.repeat(mu, len(KAPPAS) * 2, axis=0)
    kappa = np.tile(np.stack([KAPPAS, KAPPAS[::-1]], -1), (6, 1))
    alpha = np.tile(np.repeat([[0.0, 0.0], [0.0, 1.0]], len(KAPPAS), axis=0), (3, 1))
    found = Slices(
        jnp.asarray(alpha, dtype)[:, :, None, None, None],
        jnp.asarray(mu, dtype)[:, :, None, None],
        jnp.asarray(kappa, dtype)[:, :, None, None],
    )
    half = jnp.full((len(mu), 2), 0.5, dtype)
    edge = jnp.asarray(np.tile([1.0, 0.0], (len(mu), 1)), dtype)
    numbers = jnp.asarray(np.linspace(0.5, 1.5, len(mu)), dtype)

    def values(found, shares):
        got = slices.between(shares, found)
        first, last = (Slices(*(a[:, k] for a in found)) for k in (0, 1))
        return (
            (numbers[:, None, None, None] * got.alpha).sum()
            + (numbers[:, None, None, None] * got.mu).sum()
            + (numbers[:, None, None] * got.kappa).sum()
            + (numbers * slices.squared_distance(first, last)).sum()
            + slices.squared_norm(first).sum()
        )

    gradient = jax.jit(jax.value_and_grad(values, argnums=(0, 1)))
    for shares in (half, edge):
        value, slopes = gradient(found, shares)
        # What is infinite in one place is so, or not a number, in the sum.
        assert np.isfinite(value)
        for place, part in enumerate(jax.tree.leaves(slopes)):
            assert np.isfinite(np.asarray(part)).all(), place


def test_slopes_of_lobes_from_moments(dtype):
    """Nothing, one direction alone, directions that cancel."""
    whole = jnp.asarray([0.0, 1.0, 1.0, 1e-20, 2.0], dtype)
    first = jnp.asarray([[0, 0, 0], [0, 0, 1], [0, 0, 0], [0, 0, 1e-20], [0.6, 0, 0.8]], dtype)
    up = jnp.tile(jnp.asarray([0.0, 0.0, 1.0], dtype), (5, 1))
    most = jnp.full(5, 2e4, dtype)

    def total(whole, first):
        alpha, mu, kappa = weighting.lobe(whole, first, up, most)
        return (alpha + kappa).sum() + (mu * jnp.asarray([1.0, 2.0, 3.0], dtype)[None]).sum()

    alpha, mu, kappa = weighting.lobe(whole, first, up, most)
    assert all(np.isfinite(a).all() for a in (alpha, mu, kappa))
    np.testing.assert_allclose(kappa[1], 2e4, rtol=1e-5)
    np.testing.assert_allclose(kappa[2], 0.0, atol=1e-6)
    for part in jax.jit(jax.grad(total, argnums=(0, 1)))(whole, first):
        assert np.isfinite(part).all()
