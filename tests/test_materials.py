"""Materials as the trusted renderers test theirs: sampling, energy, reciprocity, limits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but
from scipy.special import roots_legendre
from scipy.stats import chi2

import diffopt as do
from diffopt import fresnel, materials
from diffopt.materials import BlinnPhong, Lambert, Microfacet, OrenNayar, Phong, RoughDielectric
from reference import directions


def at(degrees, azimuth=0.7):
    """Unit vectors at angles to the normal."""
    t = np.radians(degrees)
    return np.stack([np.sin(t) * np.cos(azimuth), np.sin(t) * np.sin(azimuth), np.cos(t)], -1)


MODELS = {
    "lambert": Lambert([0.2, 0.5, 0.9]),
    "oren-nayar": OrenNayar(0.8, 0.5),
    "phong": Phong(0.9, 40.0),
    "phong-halfway": Phong(0.9, 10.0, "halfway"),
    "phong-0": Phong(0.9, 0.0),
    "blinn-phong": BlinnPhong(0.9, 50.0),
    "blinn-phong-0": BlinnPhong(0.9, 0.0),
    "ggx": Microfacet(0.3),
    "ggx-1": Microfacet(1.0, masking="uncorrelated"),
    "ggx-0.02": Microfacet(0.02),
    "ggx-anisotropic": Microfacet((0.1, 0.6)),
    "beckmann": Microfacet(0.3, normals="beckmann"),
    "beckmann-1": Microfacet(1.0, normals="beckmann", masking="uncorrelated"),
    "beckmann-anisotropic": Microfacet((0.5, 0.15), normals="beckmann"),
    "beckmann-cavity": Microfacet(0.4, normals="beckmann", masking="v-cavity"),
    "gaussian": Microfacet(0.4, normals="gaussian", masking="v-cavity"),
    "gold": Microfacet(0.2, fresnel=fresnel.metal("Au"), wavelengths=[0.45, 0.55, 0.65]),
    "compensated": Microfacet(0.7, compensation="kulla-conty"),
    "ground glass": RoughDielectric(1.5, 0.3),
    "ground glass, power": RoughDielectric(1.33, 0.2, "beckmann", radiance=False),
    "plastic": Lambert([0.2, 0.5, 0.3]) + Microfacet(0.2, fresnel=fresnel.Dielectric(1.5)),
    "lacquer": materials.Mirror(fresnel.Schlick(0.04)) + Lambert(0.5),
    "scaled": [0.5, 0.2, 0.1] * BlinnPhong(1.0, 8.0),
}
SMOOTH = {name: m for name, m in MODELS.items() if not m.delta}


@pytest.fixture(params=SMOOTH)
def material(request):
    return SMOOTH[request.param]


def sphere(count):
    """Gauss's rule in cos and the trapezoid in azimuth: directions [count, 2 count], weights."""
    mu, w = roots_legendre(count)
    phi = (np.arange(2 * count) + 0.5) / count * np.pi
    sin = np.sqrt(1 - mu**2)
    w3 = np.stack(
        [
            sin[:, None] * np.cos(phi),
            sin[:, None] * np.sin(phi),
            np.broadcast_to(mu[:, None], (count, 2 * count)),
        ],
        -1,
    )
    return w3, np.broadcast_to((w * np.pi / count)[:, None], w3.shape[:-1])


def composite(parts, nodes):
    """Gauss's rule on each of equal parts of [0, 1]: points and weights."""
    x, w = roots_legendre(nodes)
    points = (np.arange(parts)[:, None] + 0.5 * (x + 1)) / parts
    return points.ravel(), np.tile(0.5 * w / parts, parts)


ANGLES = (0.0, 45.0, 80.0, 89.5)
# By day every material at one angle, the next one at the next; by night each at all.
SEEN = [
    pytest.param(name, degrees, marks=() if k % 4 == ANGLES.index(degrees) else pytest.mark.long)
    for degrees in ANGLES
    for k, name in enumerate(SMOOTH)
]


@pytest.mark.parametrize(("name", "degrees"), SEEN)
def test_sampling_follows_the_density(name, degrees):
    """Chi-square over cells of the sphere, in the coordinates of the peak."""
    material, count = SMOOTH[name], 40_000
    wo = at(degrees)
    found = material.sample(jax.random.key(3), np.broadcast_to(wo, (count, 3)))
    # Cells as equal shares of a cloud of the material's own, so that a narrow peak fills many:
    # cut first by height, then by azimuth about the mean direction of the cloud.
    rows, columns = 12, 8
    cloud = np.asarray(material.sample(jax.random.key(4), np.broadcast_to(wo, (count, 3))).wi)
    axis = cloud.mean(0) / np.linalg.norm(cloud.mean(0))
    frame = np.linalg.svd(axis[None])[2]
    frame[0] = axis

    def coordinates(w):
        local = np.asarray(w, np.float64) @ frame.T
        return local[..., 0], np.arctan2(local[..., 2], local[..., 1])

    height, _ = coordinates(cloud)
    edges = np.quantile(height, np.linspace(0, 1, rows + 1))[1:-1]
    edges = np.concatenate([[-1.0], edges, [1.0]])

    def histogram(w):
        height, turn = coordinates(w)
        return np.histogram2d(height, turn, (edges, np.linspace(-np.pi, np.pi, columns + 1)))[0]

    # The integral of the density over each cell, by Gauss's rule on parts of it: densities
    # have kinks at the horizon of the facets, and narrow peaks at grazing views.
    x, w = composite(40 if name == "ggx-0.02" else 16, 12)
    low, high = edges[:-1], edges[1:]
    h = low[:, None] + (high - low)[:, None] * x
    t = (np.arange(columns)[:, None] + x) / columns * 2 * np.pi - np.pi
    expected = np.zeros((rows, columns))
    for row in range(rows):
        hh, tt = h[row][None, :, None], t[:, None, :]
        sin = np.sqrt(np.maximum(1 - hh**2, 0.0))
        local = np.stack(np.broadcast_arrays(hh, sin * np.cos(tt), sin * np.sin(tt)), -1)
        density = np.asarray(material.pdf(local @ frame, wo), np.float64)
        area = (high - low)[row] * (2 * np.pi / columns)
        expected[row] = count * area * (density * w[:, None] * w).sum((1, 2))
    observed = histogram(found.wi)
    large = expected > 30
    assert expected[large].sum() > 0.85 * count
    statistic = ((observed - expected)[large] ** 2 / expected[large]).sum()
    # One in a million by chance; the quadrature of a kinked density adds 0.2 % of each cell.
    slack = (0.002 * expected[large]) ** 2 / expected[large]
    assert statistic < chi2.isf(1e-6, large.sum() - 1) + slack.sum()
    assert bool(jnp.isfinite(found.weight).all())


@pytest.mark.float32
@pytest.mark.parametrize("name", MODELS)
def test_what_a_material_declares_holds(name):
    """Energy in the furnace, reciprocity; albedo by its own sampling against plain quadrature."""
    material = MODELS[name]
    views = at(np.array([0.0, 40.0, 70.0, 86.0]))
    albedo = np.asarray(material.albedo(views), np.float64)
    assert albedo.shape == (4, *material.channels)
    if material.conserves_energy and not (material.transmits and material.radiance):
        # Quadrature: 1e-4; compensation interpolates its albedos to 0.3 %.
        assert albedo.max() <= 1.0 + (4e-3 if name == "compensated" else 2e-4)
    if not material.delta:
        w, dw = sphere(160)
        for view, found in list(zip(views, albedo, strict=True))[:3]:
            f = np.asarray(material.f(w, view), np.float64)
            weight = dw * np.abs(w[..., 2])
            plain = np.tensordot(weight, f, ((0, 1), (0, 1)))
            # A peak 0.02 wide has a tenth of a node of the plain rule.
            if name != "ggx-0.02":
                np.testing.assert_allclose(found, plain, rtol=4e-3, atol=2e-4)
    rng = np.random.default_rng(5)
    wi, wo = directions(rng, 300, 89.0), directions(rng, 300, 89.0)
    pairs = [(wi, wo, 1.0)]
    if material.transmits:
        # Through the interface radiance scales by the square of the index (Veach 1997, 5.2).
        scale = float(material.eta) ** (2 if material.radiance else -2)
        pairs.append((wi * [1, 1, -1], wo, scale))
        assert not material.reciprocal
    else:
        assert material.reciprocal or material.delta
    for one, other, scale in pairs:
        a, b = np.asarray(material.f(one, other)), np.asarray(material.f(other, one))
        assert a.max() > 0.0
        # Float32 sees 1/alpha^2 roundings of the half vector in a peak.
        eps = float(jnp.finfo(a.dtype).eps)
        # Where directions nearly cancel in it, values far below the peak lose more.
        np.testing.assert_allclose(a * scale, b, rtol=2e5 * eps, atol=1e-2 * eps * b.max())


@pytest.mark.parametrize("name", ["blinn-phong", "phong-halfway", "ggx", "ground glass"])
def test_albedo_of_many_directions(name):
    """Sixteen at once, in float32, give what one at a time gives."""
    views = at(np.linspace(0.0, 85.0, 16)).astype(np.float32)
    together = MODELS[name].albedo(views)
    alone = [float(MODELS[name].albedo(view)) for view in views]
    np.testing.assert_allclose(together, alone, atol=3e-6)


def test_what_is_not_declared():
    assert not Phong(0.9, 40.0, normalisation="book").reciprocal
    assert not Phong(0.9, 40.0, normalisation="book").conserves_energy
    assert not BlinnPhong(1.0, 32.0, normalised=False).conserves_energy
    book = Phong(1.0, 1.0, normalisation="book")
    rng = np.random.default_rng(5)
    wi, wo = directions(rng, 30), directions(rng, 30)
    assert float(jnp.abs(book.f(wi, wo) - book.f(wo, wi)).max()) > 0.1
    # Unbounded at grazing light.
    assert float(book.f(at(89.99), at(60.0, 0.7 + np.pi))) > 1e3
    assert float((1.5 * Lambert(0.9)).albedo(at(0.0))) > 1.0
    assert not (1.5 * Lambert(0.9)).conserves_energy


def test_published_numbers():
    """Figures known in closed form or from the literature."""
    normal, slant = at(0.0), at(60.0)
    # Energy-normalised Phong: albedo 1 at normal incidence, 1/2 in the limit at 60 degrees.
    sharp = Phong(1.0, 1e4)
    np.testing.assert_allclose(sharp.albedo(normal), 1.0, rtol=1e-3)
    np.testing.assert_allclose(sharp.albedo(slant), 0.5, rtol=2e-3)
    for exponent in (0.0, 1.0, 32.0, 1e6):
        np.testing.assert_allclose(BlinnPhong(0.7, exponent).albedo(normal), 0.7, rtol=1e-3)
    # k_d = albedo / pi; a Lambert sphere or plane, no direction preferred.
    np.testing.assert_allclose(Lambert(0.5).f(slant, normal), 0.5 / np.pi, rtol=1e-6)
    np.testing.assert_allclose(OrenNayar(0.5, 0.0).f(slant, at(30.0)), 0.5 / np.pi, rtol=1e-6)
    # The two forms of Phong's angle agree in the plane of incidence and differ out of it.
    out = at(60.0, 0.7 + np.pi / 2)
    one = [float(Phong(1.0, 1.0, form).f(out, slant)) for form in ("reflected", "halfway")]
    np.testing.assert_allclose(one, [1.5 / np.pi * 0.25, 0.0], atol=1e-6)
    for angle in (20.0, 50.0):
        pair = at(angle), at(30.0, 0.7 + np.pi)
        values = [Phong(1.0, 7.0, form).f(*pair) for form in ("reflected", "halfway")]
        np.testing.assert_allclose(values[0], values[1], rtol=1e-5)
    # Glass: 4 % at normal incidence; radiance grows by n^2 on the way in.
    glass = materials.Dielectric(1.5)
    np.testing.assert_allclose(glass.albedo(normal), 0.04 + 0.96 / 2.25, rtol=1e-6)
    np.testing.assert_allclose(glass.albedo(-normal), 0.04 + 0.96 * 2.25, rtol=1e-6)
    np.testing.assert_allclose(glass.albedo(-slant), 1.0, rtol=1e-6)
    np.testing.assert_allclose(materials.Dielectric(1.5, radiance=False).albedo(slant), 1.0)


def test_smooth_facets_are_a_mirror():
    """As alpha goes to 0 the lobe carries Fresnel's reflectance in the mirror's direction."""
    metal = fresnel.metal("Cu")
    view = at(50.0)
    rough = Microfacet(1e-4, fresnel=metal, wavelengths=[0.45, 0.65])
    mirror = materials.Mirror(metal, [0.45, 0.65])
    np.testing.assert_allclose(rough.albedo(view), mirror.albedo(view), rtol=1e-3)
    drawn = rough.sample(jax.random.key(0), np.broadcast_to(view, (2000, 3)))
    axis = mirror.sample(jax.random.key(0), view).wi
    # GGX has long tails: half of the directions lie within 2 alpha.
    assert float(np.median(np.linalg.norm(np.asarray(drawn.wi) - np.asarray(axis), axis=-1))) < 4e-4
    ground = RoughDielectric(1.5, 1e-3)
    for v in (view, -view):
        np.testing.assert_allclose(ground.albedo(v), materials.Dielectric(1.5).albedo(v), rtol=2e-3)


def test_compensation_restores_what_roughness_loses():
    """Perfect facets: albedo 1 at every roughness."""
    views = at(np.array([0.0, 30.0, 60.0, 80.0]))
    for alpha in (0.2, 0.6, 1.0):
        full = Microfacet(alpha, compensation="kulla-conty").albedo(views)
        np.testing.assert_allclose(full, 1.0, atol=4e-3)


@pytest.mark.parametrize("mapping", ["square", "linear", "pbrt"])
def test_roughness(mapping):
    alpha = np.asarray(materials.alpha_from_roughness(np.array([0.1, 0.5, 1.0]), mapping))
    expected = {
        "square": [0.01, 0.25, 1.0],
        "linear": [0.1, 0.5, 1.0],
        "pbrt": [
            1.62142 + np.polyval([0.000640711, 0.0171201, 0.1734, 0.819955, 0], np.log(r))
            for r in (0.1, 0.5, 1.0)
        ],
    }[mapping]
    np.testing.assert_allclose(alpha, expected, rtol=1e-5)


@pytest.mark.parametrize("name", SMOOTH)
def test_gradients_in_every_parameter(name):
    """Reverse mode against central differences, in parameters and in both directions."""
    material = SMOOTH[name].typed(jnp.float64)
    wi, wo = at(25.0), at(48.0, 0.7 + np.pi + 0.2)
    if name == "ggx-0.02":
        wi = at(47.0, 0.7)
    arrays, rest = eqx.partition(material, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten((arrays, jnp.asarray(wi), jnp.asarray(wo)))
    flat = np.concatenate([np.ravel(x) for x in leaves])

    @jax.jit
    def total(x):
        parts, start = [], 0
        for leaf in leaves:
            parts.append(x[start : start + leaf.size].reshape(leaf.shape))
            start += leaf.size
        arrays, wi, wo = jax.tree.unflatten(tree, parts)
        return eqx.combine(arrays, rest).f(wi, wo).sum()

    slope = jax.jit(jax.grad(total))(flat)
    for k in range(flat.size):
        if flat[k] == 0.0 or abs(float(slope[k])) > 1e6:
            continue  # at the end of a range
        h = 1e-6 * max(abs(flat[k]), 1e-2)
        step = np.zeros_like(flat)
        step[k] = h
        numeric = (total(flat + step) - total(flat - step)) / (2 * h)
        # Truncation h^2 f''' and rounding eps / h, against the value's own scale.
        scale = max(abs(float(numeric)), float(total(flat)), 1e-3)
        assert abs(float(slope[k] - numeric)) < 2e-6 * scale, (k, slope[k], numeric)


HARD = {
    "alike": (at(30.0), at(30.0)),
    "both at the normal": (at(0.0), at(0.0)),
    "both grazing, alike": (at(89.99), at(89.99)),
    "both grazing, opposite": (at(89.99), at(89.99, 0.7 + np.pi)),
    "horizon": (np.array([0.6, 0.8, 0.0]), at(20.0)),
    "below": (at(120.0), at(20.0)),
    "no half vector": (at(180.0), at(0.0)),
}
EXTREMES = {
    "alpha 1e-4": lambda: Microfacet(1e-4),
    "alpha 1": lambda: Microfacet(1.0, normals="beckmann"),
    "cavity": lambda: Microfacet(1e-4, normals="gaussian", masking="v-cavity"),
    "exponent 0": lambda: Phong(1.0, 0.0),
    "exponent 1e6": lambda: Phong(1.0, 1e6),
    "halfway 1e6": lambda: Phong(1.0, 1e6, "halfway"),
    "blinn 0": lambda: BlinnPhong(1.0, 0.0),
    "blinn 1e6": lambda: BlinnPhong(1.0, 1e6),
    "smooth clay": lambda: OrenNayar(1.0, 0.0),
    "glass": lambda: RoughDielectric(1.5, 1e-3),
    "barely glass": lambda: RoughDielectric(1.0001, 0.3),
}


# By night alone: what others are more extreme than.
MILDER = {"alpha 1", "blinn 0", "barely glass"}


@pytest.mark.parametrize("extreme", but(set(EXTREMES) - MILDER, EXTREMES))
def test_hard_cases(extreme, dtype):
    """Values, densities, samples and all their gradients are finite; masked pairs are 0."""
    material = EXTREMES[extreme]().typed(dtype)
    wi, wo = (jnp.asarray(np.stack(v), dtype) for v in zip(*HARD.values(), strict=True))

    def outputs(material, wi, wo):
        sample = material.sample(jax.random.key(1), wo)
        return material.f(wi, wo), material.pdf(wi, wo), sample.wi, sample.weight, sample.pdf

    @eqx.filter_jit
    @eqx.filter_value_and_grad(has_aux=True)
    def each(inputs):
        found = outputs(*inputs)
        return sum(x.sum() for x in found), found

    (_, found), slopes = each((material, wi, wo))
    assert all(bool(jnp.isfinite(x).all()) for x in found)
    assert all(x.dtype == dtype for x in found)
    if not material.transmits:
        np.testing.assert_array_equal(found[0][4:], 0.0)
    assert all(bool(jnp.isfinite(x).all()) for x in jax.tree.leaves(slopes))


def test_no_retrace_and_vmap():
    """New parameters of the same kind reuse the program; a material maps over its leaves."""
    wi, wo = at(20.0), at(40.0)
    values = []
    for alpha in (0.1, 0.2, 0.3):
        values.append(float(Microfacet(alpha).f(wi, wo)))
    from diffopt.materials import base

    before = base._value._cached._cache_size()
    Microfacet(0.4).f(wi, wo)
    assert base._value._cached._cache_size() == before
    many = eqx.filter_vmap(lambda a: Microfacet(a).f(wi, wo))(jnp.asarray([0.1, 0.2, 0.3]))
    np.testing.assert_allclose(many, values, rtol=1e-6)


def test_diffraction_as_a_material():
    """Alone the BRDF itself; prepared, in RGB; over a texture, mixed by relative reflectance."""
    scan = do.samples.compact_disc(jax.random.key(1), shape=(48, 48), pixel=0.1)
    brdf = do.DiffractionBRDF(scan, 0.6)
    lam = np.array([0.45, 0.55, 0.65])
    rng = np.random.default_rng(2)
    wi, wo = directions(rng, 20), directions(rng, 20)
    alone = materials.Diffraction(brdf, lam)
    expected = brdf(wi, wo, lam)
    np.testing.assert_allclose(alone.f(wi, wo), expected, rtol=2e-4, atol=1e-6)
    drawn = alone.sample(jax.random.key(1), np.broadcast_to(at(30.0), (4000, 3)))
    mean, spread = drawn.weight.mean(0), drawn.weight.std(0) / np.sqrt(4000)
    # Five standard errors, and the quadrature of the speckle.
    assert bool((abs(alone.albedo(at(30.0)) - mean) < 5 * spread + 0.03 * mean).all())
    mixed = materials.Diffraction(brdf, lam, texture=[0.2, 0.4, 0.6]).f(wi, wo)
    rho = np.asarray(brdf.relative(wi, wo, lam))
    diffuse = (1 - np.clip(rho, 0, 1)) * np.array([0.2, 0.4, 0.6]) / np.pi
    np.testing.assert_allclose(mixed, expected + diffuse, rtol=1e-3, atol=1e-5)
    fast = brdf.prepare(output="xyz", pairs=(wi, wo), tolerance=1e-2)
    rgb = materials.Diffraction(fast).f(wi, wo)
    xyz = np.asarray(fast(wi, wo))
    np.testing.assert_allclose(rgb, xyz @ do.colour.rgb_matrix().T, rtol=1e-3, atol=1e-4)
    with pytest.raises(do.InputError, match="needs wavelengths"):
        materials.Diffraction(brdf)
    with pytest.raises(do.InputError, match="output='spectral'; received output='xyz'"):
        materials.Diffraction(fast, texture=0.5)


def test_emission():
    lamp = materials.Emission([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(lamp.f(at(10.0), at(20.0)), 0.0)
    shines = lamp.emitted(jnp.asarray(np.stack([at(80.0), at(100.0)])))
    np.testing.assert_array_equal(shines, [[1, 2, 3], [0, 0, 0]])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Lambert(1.2), r"colour must be from 0 to 1; received 1.2"),
        (lambda: Microfacet(0.0), r"alpha must be above 0 to 4; received 0"),
        (lambda: Microfacet(0.1, normals="phong"), "normals must be one of ggx, beckmann"),
        (lambda: Microfacet(0.1, normals="gaussian"), "use masking='v-cavity'"),
        (
            lambda: Microfacet((0.1, 0.2), normals="gaussian", masking="v-cavity"),
            "isotropic; received two widths",
        ),
        (lambda: Phong(1.0, -1.0), "exponent must be from 0; received -1"),
        (lambda: Phong(1.0, 1.0, "half"), "form must be one of reflected, halfway"),
        (lambda: materials.Sum(()), "at least one material"),
        (lambda: materials.Sum((Lambert(),), [0.5]), "chances must add up to 1; received 0.5"),
        (lambda: RoughDielectric(0.0), "eta must be above 0"),
        (lambda: Lambert().f([0.0, 1.0], [0.0, 0.0, 1.0]), r"last axis of 3; received shape \(2,"),
        (
            lambda: Lambert().f(np.zeros((2, 3)), np.zeros((4, 3))),
            r"must broadcast; received shapes \(2, 3\) and \(4, 3\)",
        ),
        (lambda: materials.alpha_from_roughness(1.5), "roughness must be from 0 to 1"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(do.InputError, match=message):
        make()
