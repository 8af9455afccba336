"""What holds for reflectances, facets and warps, for all directions and widths."""

import jax
import jax.numpy as jnp
import numpy as np
from drawn import every, exponents, rotation, spread, unit
from hypothesis import strategies

from diffopt.kernels import fresnel, microfacet, octahedral, reflectance, tabulated, warps

N = 64
NORMALS = ("ggx", "beckmann")

polarised = jax.jit(fresnel.dielectric_polarised)
metal = jax.jit(fresnel.conductor_polarised)
density, area = (
    jax.jit(f, static_argnums=0) for f in (microfacet.density, microfacet.projected_area)
)
masking, visible = (
    jax.jit(f, static_argnums=0) for f in (microfacet.masking, microfacet.visible_density)
)
sample_visible = jax.jit(microfacet.sample_visible, static_argnums=0)
visibility = jax.jit(microfacet.visibility, static_argnums=(0, 1))


def eps(dtype):
    return float(jnp.finfo(dtype).eps)


def cosines(seed, dtype):
    """Grazing ones and steep ones, both ends first."""
    return jnp.asarray(np.cos(0.5 * np.pi - spread(seed, N, 1e-6, 0.5 * np.pi, 0.5 * np.pi)), dtype)


def upper(seed, dtype):
    return jnp.asarray(unit(seed, N, upper=True, least=1e-3), dtype)


@every(index=exponents(-0.7, 0.7))
def test_dielectrics_reflect_between_nothing_and_all(seed, index, dtype):
    cos = cosines(seed, dtype)
    for value in polarised(cos, jnp.asarray(index, dtype)):
        found = np.asarray(value, float)
        assert ((found >= 0) & (found <= 1 + 16 * eps(dtype))).all()
    s, p = (np.asarray(v, float) for v in polarised(jnp.zeros(1, dtype), jnp.asarray(index, dtype)))
    grazing = 0.0 if np.asarray(index, dtype) == 1.0 else 1.0
    np.testing.assert_allclose([s[0], p[0]], grazing, rtol=16 * eps(dtype))


@every()
def test_metals_reflect_between_nothing_and_all(seed, dtype):
    eta, k = (jnp.asarray(spread(seed + i, N, 1e-2, 1e1), dtype) for i in (1, 2))
    s, p = (np.asarray(v, float) for v in metal(cosines(seed, dtype), eta, k))
    for found in (s, p):
        assert ((found >= 0) & (found <= 1 + 32 * eps(dtype))).all()
    # Electric fields in the plane of incidence are reflected less.
    assert (p <= s + 64 * eps(dtype)).all()


@every(index=exponents(-0.7, 0.7))
def test_stokes_relations_and_energy(seed, index):
    """Both sides of an interface reflect alike; what is not reflected goes through."""
    c = np.asarray(cosines(seed, "float64"))
    sin2 = (1.0 - c * c) / index**2
    through = sin2 < 1.0 - 1e-9
    t = np.sqrt(np.where(through, 1.0 - sin2, 1.0))
    one = polarised(jnp.asarray(c), jnp.asarray(index))
    other = polarised(jnp.asarray(t), jnp.asarray(1.0 / index))
    gain = index * t / c
    amplitudes = 2.0 * c / (c + index * t), 2.0 * c / (index * c + t)
    for front, back, amplitude in zip(one, other, amplitudes, strict=True):
        front, back = np.asarray(front), np.asarray(back)
        # Beside the critical angle the cosine behind has lost half its digits.
        np.testing.assert_allclose(front[through], back[through], atol=1e-6)
        np.testing.assert_allclose((front + gain * amplitude**2)[through], 1.0, atol=1e-6)
        assert (front[sin2 > 1.0 + 1e-9] == 1.0).all()


@every(index=exponents(-0.7, 0.7))
def test_nothing_in_the_plane_is_reflected_at_brewsters_angle(seed, index):
    cos = jnp.asarray([1.0 / np.hypot(1.0, index)])
    s, p = polarised(cos, jnp.asarray(index))
    # The angle is rounded; the amplitude has a slope of up to 1 / n^2.
    assert float(p[0]) <= 1e-26
    np.testing.assert_allclose(float(s[0]), ((1 - index**2) / (1 + index**2)) ** 2, atol=1e-14)


@every(index=exponents(-0.7, 0.7))
def test_conductor_without_absorption_is_a_dielectric(seed, index, dtype):
    cos = cosines(seed, dtype)
    right = polarised(cos, jnp.asarray(index, dtype))
    found = metal(cos, jnp.full(N, index, dtype), jnp.zeros(N, dtype))
    for a, b in zip(found, right, strict=True):
        # Beside the critical angle: the root of a difference of numbers of 1.
        np.testing.assert_allclose(a, b, atol=4 * eps(dtype) ** 0.5)


# Slopes of facets over their widths: tan(t) in 80 rings, 16 sectors.
X, W = np.polynomial.legendre.leggauss(80)
RING, RING_WEIGHT = (0.25 * np.pi * v for v in (X + 1.0, W))
PHI = (np.arange(16) + 0.5) * (2.0 * np.pi / 16)


def facets(ax, ay, phi=PHI):
    """Normals and solid angles that gather where the facets are."""
    r, weight = np.tan(RING), RING_WEIGHT / np.cos(RING) ** 2
    sx, sy = ax * np.outer(r, np.cos(phi)), ay * np.outer(r, np.sin(phi))
    cos = 1.0 / np.sqrt(1.0 + sx * sx + sy * sy)
    h = np.stack([-sx * cos, -sy * cos, cos], -1)
    solid = cos**3 * ax * ay * (r * weight)[:, None] * (2.0 * np.pi / len(phi))
    return jnp.asarray(h.reshape(-1, 3)), solid.ravel()


@every(ax=exponents(-3.0, 0.0), ay=exponents(-3.0, 0.0), normals=strategies.sampled_from(NORMALS))
def test_facets_cover_the_surface(seed, ax, ay, normals):
    h, solid = facets(ax, ay)
    found = density(normals, h, (jnp.asarray(ax), jnp.asarray(ay)))
    assert (np.asarray(found) >= 0).all()
    # The rule on 1 / (1 + r^2)^2 and exp(-r^2).
    np.testing.assert_allclose((np.asarray(found) * np.asarray(h[:, 2])) @ solid, 1.0, atol=1e-6)


MANY_PHI = (np.arange(240) + 0.5) * (2.0 * np.pi / 240)


@every(ax=exponents(-2.0, 0.0), ay=exponents(-2.0, 0.0), normals=strategies.sampled_from(NORMALS))
def test_weak_white_furnace(seed, ax, ay, normals):
    """What a direction sees of the facets adds up to what it sees of the surface."""
    h, solid = facets(ax, ay, MANY_PHI)
    w = jnp.asarray(unit(seed, 1, upper=True, least=0.05))
    found = visible(normals, h, jnp.broadcast_to(w, h.shape), (jnp.asarray(ax), jnp.asarray(ay)))
    # Facets turn away along a line, on which the rule has a kink.
    np.testing.assert_allclose(np.asarray(found) @ solid, 1.0, atol=5e-3)


@every(alpha=exponents(-3.0, 0.0), normals=strategies.sampled_from(NORMALS))
def test_masking_falls_towards_the_horizon(seed, alpha, normals, dtype):
    z = jnp.sort(cosines(seed, dtype))
    w = jnp.stack([jnp.sqrt((1 - z) * (1 + z)), jnp.zeros_like(z), z], -1)
    found = np.asarray(masking(normals, w, (jnp.asarray(alpha, dtype),) * 2), float)
    assert ((found >= 0) & (found <= 1 + 8 * eps(dtype))).all()
    assert (np.diff(found) >= -8 * eps(dtype)).all()


@every(
    ax=exponents(-3.0, 0.0),
    ay=exponents(-3.0, 0.0),
    normals=strategies.sampled_from(NORMALS),
    kind=strategies.sampled_from(("correlated", "uncorrelated", "v-cavity")),
)
def test_shadowing_is_reciprocal(seed, ax, ay, normals, kind):
    alpha = jnp.asarray(ax), jnp.asarray(ay)
    wi, wo = upper(seed, "float64"), upper(seed + 1, "float64")
    one, other = (visibility(kind, normals, a, b, alpha) for a, b in ((wi, wo), (wo, wi)))
    np.testing.assert_allclose(one, other, rtol=1e-13)
    # G is at most 1, and that of either direction alone.
    g = np.asarray(4.0 * one * wi[:, 2] * wo[:, 2])
    assert ((g >= 0) & (g <= 1 + 1e-13)).all()
    if kind != "v-cavity":
        most = np.minimum(*(np.asarray(masking(normals, w, alpha)) for w in (wi, wo)))
        assert (g <= most * (1 + 1e-12)).all()


@every(ax=exponents(-3.0, 0.0), ay=exponents(-3.0, 0.0), normals=strategies.sampled_from(NORMALS))
def test_sampled_facets_are_seen(seed, ax, ay, normals, dtype):
    u = jnp.asarray(np.random.default_rng(seed).uniform(0, 1 - 1e-6, (N, 2)), dtype)
    w = upper(seed, dtype)
    h = np.asarray(sample_visible(normals, u, w, (jnp.asarray(ax, dtype), jnp.asarray(ay, dtype))))
    # A component that cancels may be computed twice, and rounded in two ways.
    np.testing.assert_allclose((h * h).sum(-1), 1.0, atol=256 * eps(dtype))
    assert (h[:, 2] >= 0).all()
    # Facets in profile, within what the inversion keeps of a share.
    assert ((h * np.asarray(w)).sum(-1) >= -1e-3 * max(ax, ay)).all()


MODELS = {
    "phong": lambda e, a, b: reflectance.phong("reflected", e, a, b),
    "half phong": lambda e, a, b: reflectance.phong("halfway", e, a, b),
    "blinn": reflectance.blinn_phong,
    "oren-nayar": lambda e, a, b: reflectance.oren_nayar(1.0 / (1.0 + e), a, b),
}
models = {name: jax.jit(model) for name, model in MODELS.items()}


@every(
    exponent=exponents(-2.0, 6.0),
    name=strategies.sampled_from(sorted(MODELS)),
    turn=exponents(-3, 0.7),
)
def test_empirical_models_are_reciprocal_positive_and_isotropic(seed, exponent, name, turn, dtype):
    wi, wo = upper(seed, dtype), upper(seed + 1, dtype)
    e = jnp.full(N, exponent, dtype)
    found = np.asarray(models[name](e, wi, wo), float)
    assert (found >= 0).all()
    assert np.isfinite(found).all()
    c, s = np.cos(turn), np.sin(turn)
    about = jnp.asarray([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], dtype)
    # Powers multiply the rounding of the angle.
    options = {"rtol": 64 * eps(dtype) * (1 + exponent), "atol": 64 * eps(dtype)}
    np.testing.assert_allclose(np.asarray(models[name](e, wo, wi), float), found, **options)
    turned = models[name](e, *(jnp.matmul(w, about, precision="highest") for w in (wi, wo)))
    np.testing.assert_allclose(np.asarray(turned, float), found, **options)


@every(exponent=exponents(-2.0, 8.0))
def test_density_of_powers_of_the_cosine_integrates_to_one(seed, exponent):
    # Over gap = 1 - cos, where the power is.
    end = min(1.0, 40.0 / exponent)
    gap, weight = 0.5 * end * (X + 1.0), 0.5 * end * W
    cos, sin2 = 1.0 - gap, gap * (2.0 - gap)
    found = warps.power_cosine_density(
        *(jnp.asarray(v) for v in (cos, sin2)), jnp.asarray([exponent])
    )
    # Powers below 1 have an infinite slope at the horizon.
    assert abs(2.0 * np.pi * np.asarray(found) @ weight - 1.0) < (1e-9 if exponent > 20 else 1e-3)


@every(exponent=exponents(-2.0, 8.0))
def test_warps_are_unit_vectors_at_the_right_height(seed, exponent, dtype):
    u = jnp.asarray(np.random.default_rng(seed).uniform(0, 1 - 1e-6, (N, 2)), dtype)
    first = np.asarray(u[:, 0], float)
    for d, share in (
        (warps.cosine_hemisphere(u), lambda z: 1.0 - z**2),
        (warps.uniform_hemisphere(u), lambda z: 1.0 - z),
        (warps.power_cosine(u, jnp.asarray([exponent], dtype)), None),
    ):
        d = np.asarray(d, float)
        np.testing.assert_allclose((d * d).sum(-1), 1.0, atol=16 * eps(dtype))
        assert (d[:, 2] >= 0).all()
        if share is not None:
            np.testing.assert_allclose(share(d[:, 2]), first, atol=8 * eps(dtype))


@every()
def test_octahedral_map_and_back(seed, dtype):
    d = jnp.asarray(unit(seed, N), dtype)
    u, v = octahedral.encode(d[:, 0], d[:, 1], d[:, 2])
    assert (np.abs([u, v]) <= 1 + eps(dtype)).all()
    np.testing.assert_allclose(octahedral.decode(u, v), d, atol=16 * eps(dtype))


@every()
def test_half_and_difference_angles_and_back(seed, dtype):
    wi, wo = upper(seed, dtype), upper(seed + 1, dtype)
    angles = tabulated.rusinkiewicz(wi, wo)
    a, b = (np.asarray(w, float) for w in tabulated.half_difference(*angles))
    # A turn about the normal apart: heights and the angle between both are kept.
    atol = 64 * eps(dtype)
    np.testing.assert_allclose(a[:, 2], np.asarray(wi)[:, 2], atol=atol)
    np.testing.assert_allclose(b[:, 2], np.asarray(wo)[:, 2], atol=atol)
    between = (np.asarray(wi, float) * np.asarray(wo, float)).sum(-1)
    np.testing.assert_allclose((a * b).sum(-1), between, atol=atol)
    # Exchanged, and seen from anywhere about the normal.
    swapped = tabulated.rusinkiewicz(wo, wi)
    for one, other in zip(angles[:2], swapped[:2], strict=True):
        np.testing.assert_allclose(one, other, atol=atol)
    off = np.abs(np.asarray(angles[2] - swapped[2], float)) - np.pi
    # Where the half vector nearly is the normal, the turn about it has few digits.
    np.testing.assert_allclose(off, 0.0, atol=1e3 * atol)


@every()
def test_sampled_tables_invert(seed):
    rng = np.random.default_rng(seed)
    table = jnp.asarray(rng.uniform(0.1, 1.0, (3, 5, 7)) ** 3)
    at = [(jnp.full(N, k, jnp.int32), jnp.full(N, w)) for k, w in ((0, 0.3), (2, 0.7))]
    u, v = jnp.asarray(rng.uniform(0, 1, (2, N)))
    x, y = tabulated.sample_bilinear(table, at, u, v)
    back_u, back_v, value = tabulated.invert_bilinear(table, at, x, y)
    assert (np.asarray(value) > 0).all()
    np.testing.assert_allclose(back_u, u, atol=1e-12)
    np.testing.assert_allclose(back_v, v, atol=1e-12)


def test_rotations_are_rotations():
    turn = rotation(3)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.linalg.det(turn), 1.0)
