"""What holds for transforms of surfaces, harmonics, colours, rays and maps of angles."""

import jax
import jax.numpy as jnp
import numpy as np
from drawn import every, exponents, rotation, spread, unit
from hypothesis import strategies

import diffopt as do
from diffopt.kernels import (
    dtft,
    harmonic_products,
    harmonic_rotation,
    harmonics,
    hemispherical,
    intersect,
    lobe_harmonics,
    rescaling,
    rescaling_matrices,
    special,
    spectrum,
    spline,
)

NY, NX, STEP, SIGMA = 12, 16, 0.25, 0.4
N = 24


def rough(seed, depth):
    """Heights to some wavelengths deep."""
    return depth * np.random.default_rng(seed).uniform(0.0, 1.0, (NY, NX))


def pairs(seed, count=N):
    return (jnp.asarray(unit(seed + i, count, upper=True, least=0.05)) for i in (0, 1))


@jax.jit
def brdf(heights, wi, wo, wavelengths, scale=1.0):
    """Of a patch under a window; every length times a scale."""
    scan = do.Heightfield(heights * scale, pixel=STEP)
    surface = do.DiffractionBRDF(scan, coherence=SIGMA)
    return surface(wi, wo, wavelengths)


LAM = np.array([0.45, 0.55, 0.65])
DEEP = exponents(-3.0, 0.7)


def far(found):
    """What rounding may add: phases of some turns, sums of 192 terms, over the largest value."""
    return {"rtol": 1e-9, "atol": 1e-12 * float(np.abs(found).max())}


@every(depth=DEEP)
def test_diffraction_is_reciprocal_and_positive(seed, depth):
    wi, wo = pairs(seed)
    heights = jnp.asarray(rough(seed, depth))
    found = np.asarray(brdf(heights, wi, wo, LAM))
    assert (found >= 0).all()
    np.testing.assert_allclose(brdf(heights, wo, wi, LAM), found, **far(found))


@every(depth=DEEP, up=strategies.floats(-5.0, 5.0))
def test_diffraction_does_not_see_where_the_surface_is(seed, depth, up):
    """Averaged over positions of the window: periodic shifts, and another base."""
    wi, wo = pairs(seed)
    heights = rough(seed, depth)
    found = np.asarray(brdf(jnp.asarray(heights), wi, wo, LAM))
    moved = np.roll(heights, tuple(np.random.default_rng(seed).integers(-9, 9, 2)), (0, 1)) + up
    np.testing.assert_allclose(brdf(jnp.asarray(moved), wi, wo, LAM), found, **far(found))


@every(depth=DEEP)
def test_mirrored_surfaces_diffract_mirrored(seed, depth):
    wi, wo = pairs(seed)
    heights = rough(seed, depth)
    found = np.asarray(brdf(jnp.asarray(heights), wi, wo, LAM))
    for axis, flip in ((1, (-1.0, 1.0, 1.0)), (0, (1.0, -1.0, 1.0))):
        mirror = jnp.asarray(np.flip(heights, axis))
        mirrored = brdf(mirror, *(w * jnp.asarray([flip]) for w in (wi, wo)), LAM)
        np.testing.assert_allclose(mirrored, found, **far(found))


@jax.jit
def relative(heights, pixel_over_wavelength, wave):
    """|P|^2 of wave vectors in wavelengths: nothing but ratios of lengths."""
    s, fx, fy = wave[2], wave[0] * pixel_over_wavelength, wave[1] * pixel_over_wavelength
    wx, wy = (dtft.bin_weights(n, 1.0, f, jnp.asarray(0.1)) for n, f in ((NX, fx), (NY, fy)))
    return dtft.averaged_intensity(heights, s, wx, wy)


@every(depth=DEEP, scale=exponents(-1.0, 1.0))
def test_only_heights_over_the_wavelength_count(seed, depth, scale):
    """Heights times a factor are a phase with that factor in its frequency."""
    heights = jnp.asarray(rough(seed, depth))
    wave = jnp.asarray(np.random.default_rng(seed).uniform(-2.0, 2.0, 3))
    one = relative(heights * scale, jnp.asarray(0.5), wave)
    other = relative(heights, jnp.asarray(0.5), wave * jnp.asarray([1.0, 1.0, scale]))
    # Phases of up to 100 turns.
    np.testing.assert_allclose(one, other, atol=1e-11)


@jax.jit
def spectra(heights, s, f, center):
    ax = dtft.gaussian_axis(NX, STEP, f[0], jnp.asarray(SIGMA, s.dtype), center[0])
    ay = dtft.gaussian_axis(NY, STEP, f[1], jnp.asarray(SIGMA, s.dtype), center[1])
    return dtft.power_spectrum(heights, s), dtft.coherent_intensity(heights, s, ax, ay)


@every(depth=DEEP)
def test_parseval(seed, depth):
    """Phases take no energy: powers of all bins add up to 1, and no direction gets more."""
    rng = np.random.default_rng(seed)
    s, f, center = (
        jnp.asarray(v) for v in (rng.uniform(-4, 4), rng.uniform(-2, 2, 2), rng.normal(size=2))
    )
    power, intensity = spectra(jnp.asarray(rough(seed, depth)), s, f, center)
    assert (np.asarray(power) >= 0).all()
    np.testing.assert_allclose(np.asarray(power).sum(), 1.0, rtol=1e-12)
    # The window on the grid of samples is 1 to exp(-2 (pi sigma / step)^2).
    assert 0.0 <= float(intensity) <= 1.0 + 1e-12
    flat, _ = spectra(jnp.full((NY, NX), depth), s, f, center)
    np.testing.assert_allclose(flat[0, 0], 1.0, rtol=1e-12)


@every(copies=strategies.integers(2, 40))
def test_factor_of_many_periods(seed, copies):
    t = jnp.asarray(np.random.default_rng(seed).uniform(-3, 3, N))
    re, im = (np.asarray(v) for v in special.dirichlet(t, copies))
    assert (re**2 + im**2 <= 1 + 1e-13).all()
    again = special.dirichlet(t + 1.0, copies)
    # A period on, t has lost an eps or two, which N turns multiply.
    np.testing.assert_allclose(np.stack(again), np.stack([re, im]), atol=1e-15 * 10 * copies)


BANDS = 6
BAND = harmonics.degrees(BANDS)
rotate = jax.jit(harmonic_rotation.rotate)
evaluate = jax.jit(harmonics.evaluate)
basis = jax.jit(harmonics.basis, static_argnums=1)
product = jax.jit(harmonic_products.product)
zonal = jax.jit(harmonics.zonal)


def norms(c):
    return np.array([np.linalg.norm(np.asarray(c)[l == BAND]) for l in range(BANDS)])


@every()
def test_rotations_compose_and_keep_every_band(seed):
    c = jnp.asarray(np.random.default_rng(seed).normal(size=BANDS**2))
    a, b = (jnp.asarray(rotation(seed + i)) for i in (0, 1))
    turned = rotate(rotate(c, a), b)
    np.testing.assert_allclose(turned, rotate(c, b @ a), atol=1e-12)
    np.testing.assert_allclose(norms(turned), norms(c), atol=1e-12)
    # The function turned has its values where they were carried to.
    d = jnp.asarray(unit(seed, N))
    np.testing.assert_allclose(evaluate(rotate(c, a), d @ a.T), evaluate(c, d), atol=1e-12)


@every()
def test_addition_theorem(seed, dtype):
    d = jnp.asarray(unit(seed, N), dtype)
    values = np.asarray(basis(d, BANDS), float)
    for l in range(BANDS):
        total = (values[l == BAND] ** 2).sum(0)
        # Unit vectors to eps, powers of twice the degree.
        atol = 64 * (l + 1) * float(jnp.finfo(dtype).eps)
        np.testing.assert_allclose(total, (2 * l + 1) / (4 * np.pi), atol=atol)


@every()
def test_products_of_functions(seed):
    rng = np.random.default_rng(seed)
    # Three bands each: the product has five.
    a, b = (jnp.asarray(np.pad(rng.normal(size=9), (0, 16))) for _ in range(2))
    found = product(a, b)
    d = jnp.asarray(unit(seed, N))
    np.testing.assert_allclose(evaluate(found, d), evaluate(a, d) * evaluate(b, d), atol=1e-11)
    np.testing.assert_allclose(found, product(b, a), atol=1e-12)
    one = jnp.zeros(25).at[0].set((4 * np.pi) ** 0.5)
    np.testing.assert_allclose(product(one, a), a, atol=1e-12)


@every(kappa=exponents(-2.0, 1.0))
def test_funk_and_hecke(seed, kappa):
    """Convolved with a lobe, every band is multiplied by the lobe's ratio."""
    c = np.random.default_rng(seed).normal(size=BANDS**2)
    d, weight = harmonics.sphere_rule(40, 80)
    axis = unit(seed, 1)[0]
    lobe = kappa / (2 * np.pi * -np.expm1(-2 * kappa)) * np.exp(kappa * (d @ axis - 1.0))
    right = (np.asarray(evaluate(jnp.asarray(c), jnp.asarray(d))) * lobe) @ weight
    factor = np.asarray(lobe_harmonics.ratios(jnp.asarray(kappa), BANDS))[BAND]
    # The rule is exact for 80 degrees; lobes of 10 hold 1e-14 beyond.
    np.testing.assert_allclose(
        evaluate(jnp.asarray(c * factor), jnp.asarray(axis)), right, atol=1e-11
    )


@every()
def test_symmetric_functions_turn_with_their_axis(seed):
    rng = np.random.default_rng(seed)
    z, d, axis = rng.normal(size=BANDS), unit(seed, N), unit(seed + 1, 1)[0]
    found = evaluate(zonal(jnp.asarray(z), jnp.asarray(axis)), jnp.asarray(d))
    x = d @ axis
    scale = np.sqrt((2 * np.arange(BANDS) + 1) / (4 * np.pi)) * z
    np.testing.assert_allclose(found, np.polynomial.legendre.legval(x, scale), atol=1e-12)


@every()
def test_hemispherical_functions_keep_rotations_about_the_normal(seed):
    rng = np.random.default_rng(seed)
    d, turn = unit(seed, N, upper=True), rng.uniform(0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    values = [
        np.asarray(hemispherical.basis(jnp.asarray(v), BANDS))
        for v in (d, d @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))
    ]
    for l in range(BANDS):
        of = l == BAND
        one, other = ((v[of] ** 2).sum(0) for v in values)
        np.testing.assert_allclose(one, other, atol=1e-12)
        np.testing.assert_allclose(one, (2 * l + 1) / (2 * np.pi), atol=1e-12)


WEIGHTS = jnp.asarray(np.asarray(do.colour.spectral_weights(do.colour.wavelengths(5.0))))


@every()
def test_colours_are_linear_and_positive(seed):
    rng = np.random.default_rng(seed)
    count = WEIGHTS.shape[0]
    a, b = (jnp.asarray(rng.uniform(0, 1, (4, count))) for _ in range(2))
    x, y = (spectrum.weights_to_xyz(v, WEIGHTS) for v in (a, b))
    both = spectrum.weights_to_xyz(2.0 * a + 3.0 * b, WEIGHTS)
    np.testing.assert_allclose(both, 2.0 * x + 3.0 * y, rtol=1e-13)
    assert (np.asarray(x) >= 0).all()
    assert (np.asarray(x)[:, 1] <= 1 + 1e-12).all()
    # A perfect reflector is the white of the illuminant.
    white = spectrum.weights_to_xyz(jnp.ones((1, count)), WEIGHTS)
    np.testing.assert_allclose(white[0, 1], 1.0, rtol=1e-12)


@every()
def test_srgb_and_back(seed, dtype):
    eps = float(jnp.finfo(dtype).eps)
    x = jnp.sort(jnp.asarray(spread(seed, N, 1e-9, 1e3, 0.0, 1.0, 0.0031308), dtype))
    encoded = spectrum.encode_srgb(x)
    # The two branches of the standard meet to 1e-8 of 0.04.
    assert (np.diff(np.asarray(encoded, float)) >= -3e-8).all()
    near = np.abs(np.asarray(x, float) - 0.0031308) < 1e-7
    found = np.where(near, x, spectrum.decode_srgb(encoded))
    np.testing.assert_allclose(found, x, rtol=32 * eps)
    np.testing.assert_allclose(spectrum.encode_srgb(-x), -encoded)


@every()
def test_colours_brought_into_the_gamut_keep_their_luminance(seed):
    rng = np.random.default_rng(seed)
    rgb = rng.normal(0.3, 0.5, (N, 3))
    luminance = rgb @ np.array([0.2126, 0.7152, 0.0722])
    found = np.asarray(spectrum.desaturate(jnp.asarray(rgb), jnp.asarray(luminance)))
    assert (found >= 0).all()
    kept = luminance > 0
    np.testing.assert_allclose(
        (found @ [0.2126, 0.7152, 0.0722])[kept], luminance[kept], atol=1e-13
    )
    inside = (rgb >= 0).all(1)
    np.testing.assert_allclose(found[inside], rgb[inside], atol=1e-15)


@every(radius=exponents(-2.0, 0.5))
def test_rays_end_on_spheres_and_discs(seed, radius):
    rng = np.random.default_rng(seed)
    o, d = 3.0 * rng.normal(size=(N, 3)), unit(seed, N) * spread(seed, N, 1e-2, 1e2)[:, None]
    centres, normals = rng.normal(size=(5, 3)), unit(seed + 1, 5)
    radii = np.full(5, radius)
    turn = rotation(seed)
    for shapes in ((centres, radii), (centres, normals, radii)):
        meet = intersect.spheres if len(shapes) == 2 else intersect.discs
        t, index = (np.asarray(v) for v in meet(*map(jnp.asarray, (o, d, *shapes))))
        hit = index >= 0
        assert (np.isinf(t) == ~hit).all()
        assert (t[hit] > 0).all()
        off = (o + np.where(hit, t, 0.0)[:, None] * d - centres[index])[hit]
        if len(shapes) == 2:
            np.testing.assert_allclose(
                np.linalg.norm(off, axis=-1), radius, atol=1e-12 * (1 + radius)
            )
        else:
            assert np.abs((off * normals[index][hit]).sum(-1)).max(initial=0.0) < 1e-11
            assert (np.linalg.norm(off, axis=-1) <= radius * (1 + 1e-11)).all()
        turned = [v if v.ndim == 1 else v @ turn.T for v in (o, d, *shapes)]
        again, at = (np.asarray(v) for v in meet(*map(jnp.asarray, turned)))
        same = at == index  # rays that graze may pass
        assert same.mean() > 0.9
        np.testing.assert_allclose(again[same & hit], t[same & hit], rtol=1e-6)


@every(a=exponents(-1.0, 1.0), b=exponents(-1.0, 1.0))
def test_maps_of_angles_compose(seed, a, b, dtype):
    eps = float(jnp.finfo(dtype).eps)
    theta = jnp.asarray(np.append(np.random.default_rng(seed).uniform(0, np.pi, N - 1), 0.0), dtype)
    a, b, one = (jnp.asarray(k, dtype) for k in (a, b, 1.0))
    twice = rescaling.square(rescaling.square(theta, a), b)
    # Slopes of either map are up to 100 and more.
    np.testing.assert_allclose(twice, rescaling.square(theta, a * b), atol=2e4 * eps)
    back = rescaling.square(rescaling.square(theta, a), 1.0 / a)
    np.testing.assert_allclose(back, theta, atol=2e4 * eps)
    np.testing.assert_allclose(rescaling.square(theta, one), theta, atol=8 * eps)
    low = 0.5 * theta
    np.testing.assert_allclose(rescaling.tangent(low, one), low, atol=8 * eps)
    rising = np.asarray(rescaling.square(jnp.sort(theta), a))
    assert (np.diff(rising) >= -8 * eps).all()


own_sphere = jax.jit(lambda k: rescaling_matrices.square(k, BANDS))


@every()
def test_fields_at_their_own_sphere_stay(seed, dtype):
    c = jnp.asarray(np.random.default_rng(seed).normal(size=BANDS**2), dtype)
    found = rescaling_matrices.apply(own_sphere(jnp.ones((), dtype)), c, BANDS)
    # A rule of 48 nodes; its weights are rounded.
    np.testing.assert_allclose(found, c, atol=256 * float(jnp.finfo(dtype).eps))


@every(order=strategies.sampled_from((1, 2, 3)))
def test_splines_pass_through_constants_and_samples(seed, order):
    rng = np.random.default_rng(seed)
    t = rng.uniform(-0.5, 0.5, N) if order == 2 else rng.uniform(0, 1, N)
    parts = [np.asarray(w) for w in spline.weights(jnp.asarray(t), order)]
    assert min(part.min() for part in parts) >= 0
    np.testing.assert_allclose(sum(parts), 1.0, atol=1e-15)
    values = rng.normal(size=12)
    c = np.asarray(spline.prefilter(jnp.asarray(values), axis=0, order=order))
    at = [float(w) for w in spline.weights(jnp.asarray(0.0), order)]
    first = 0 if order == 1 else 1
    found = sum(w * np.roll(c, first - k) for k, w in enumerate(at))
    np.testing.assert_allclose(found[2:-2], values[2:-2], atol=1e-12)
