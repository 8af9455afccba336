import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.kernels import spectrum

EPS = {"float32": 1.2e-7, "float64": 2.3e-16}


def test_trapezoid_weights_on_an_uneven_grid(dtype, rng):
    x = np.sort(rng.uniform(0.38, 0.78, 20)).astype(dtype)
    f = np.cos(7 * x)
    got = spectrum.trapezoid_weights(jnp.asarray(x))
    assert got.dtype == dtype
    # Twenty additions of numbers below 1.
    np.testing.assert_allclose(got @ jnp.asarray(f), np.trapezoid(f, x), atol=20 * EPS[dtype])


def test_trapezoid_weights_stay_in_numpy():
    got = spectrum.trapezoid_weights(np.array([1.0, 2.0, 4.0]))
    assert isinstance(got, np.ndarray)
    np.testing.assert_array_equal(got, [0.5, 1.5, 1.0])


def test_trapezoid_weights_need_two():
    with pytest.raises(ValueError, match="1 given, the trapezoid rule needs at least 2"):
        spectrum.trapezoid_weights(np.array([0.5]))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_products(batch, dtype, rng):
    values, weights = rng.uniform(size=(*batch, 9)), rng.uniform(size=(9, 3))
    got = spectrum.weights_to_xyz(jnp.asarray(values, dtype), jnp.asarray(weights, dtype))
    assert got.dtype == dtype
    # Nine products below 1, summed.
    want = np.einsum("...l,lc->...c", values, weights)
    np.testing.assert_allclose(got, want, rtol=10 * EPS[dtype])
    matrix = rng.normal(size=(3, 3))
    got = spectrum.transform(jnp.asarray(values[..., :3], dtype), jnp.asarray(matrix, dtype))
    want = np.einsum("ij,...j->...i", matrix, values[..., :3])
    np.testing.assert_allclose(got, want, atol=10 * EPS[dtype])


def test_product_linear_and_adjoint(rng):
    """<A x, y> = <x, A' y> between the sum and its reverse-mode derivative."""
    weights = jnp.asarray(rng.uniform(size=(9, 3)))
    x, y = jnp.asarray(rng.normal(size=(5, 9))), jnp.asarray(rng.normal(size=(5, 3)))
    value, pull = jax.vjp(lambda v: spectrum.weights_to_xyz(v, weights), x)
    np.testing.assert_allclose(jnp.vdot(value, y), jnp.vdot(x, pull(y)[0]), rtol=1e-13)


# Luminance of the sRGB primaries (IEC 61966-2-1), good enough to make consistent inputs.
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def test_desaturate_keeps_luminance_and_reaches_the_boundary(dtype, rng):
    rgb = rng.normal(0.4, 0.6, size=(500, 3))
    y = rgb @ LUMINANCE
    keep = y > 0.01
    rgb, y = rgb[keep], y[keep]
    got = np.asarray(spectrum.desaturate(jnp.asarray(rgb, dtype), jnp.asarray(y, dtype)))
    assert (got >= 0).all()
    # A mixture of numbers of size 2 with rounding eps, and luminance rounded on input.
    np.testing.assert_allclose(got @ LUMINANCE, y, atol=10 * EPS[dtype])
    inside = (rgb >= 0).all(axis=1)
    assert inside.any()
    assert (~inside).any()
    np.testing.assert_allclose(got[inside], rgb[inside], atol=4 * EPS[dtype])
    # The most negative coordinate becomes 0, the direction from grey stays.
    assert (got[~inside].min(axis=1) < 10 * EPS[dtype]).all()
    before, after = rgb[~inside] - y[~inside, None], got[~inside] - y[~inside, None]
    assert (np.linalg.norm(np.cross(before, after), axis=1) < 1e2 * EPS[dtype]).all()


def test_desaturate_of_black_and_less(dtype):
    rgb = jnp.asarray([[0.0, 0.0, 0.0], [-0.1, 0.02, 0.1], [-1.0, -1.0, -1.0]], dtype)
    y = jnp.asarray([0.0, 0.0, -1.0], dtype)
    assert (spectrum.desaturate(rgb, y) == 0).all()
    slopes = jax.vmap(jax.grad(lambda c, l: spectrum.desaturate(c, l).sum(), (0, 1)))(rgb, y)
    assert all(np.isfinite(s).all() for s in slopes)


def test_desaturate_gradient():
    # Away from the kinks: one coordinate clearly the most negative.
    rgb = jnp.asarray([[-0.4, 0.6, 0.1], [0.2, 0.5, 0.9], [0.9, -0.5, -0.1]])
    y = jnp.asarray([0.35, 0.46, 0.2])
    way = jnp.asarray([[0.3, -0.2, 0.7], [0.1, 0.4, -0.5], [-0.6, 0.2, 0.9]])
    value, slope = jax.jvp(spectrum.desaturate, (rgb, y), (way, way[:, 0]))
    h = 1e-6
    want = (
        spectrum.desaturate(rgb + h * way, y + h * way[:, 0])
        - spectrum.desaturate(rgb - h * way, y - h * way[:, 0])
    ) / (2 * h)
    # Central differences: h^2 and 1e-16/h.
    np.testing.assert_allclose(slope, want, atol=1e-9)
    _, pull = jax.vjp(spectrum.desaturate, rgb, y)
    to_rgb, to_y = pull(value)
    np.testing.assert_allclose(
        jnp.vdot(to_rgb, way) + jnp.vdot(to_y, way[:, 0]), jnp.vdot(value, slope), rtol=1e-12
    )


def test_gamut_choices(dtype):
    rgb, y = jnp.asarray([-0.2, 0.5, 1.4], dtype), jnp.asarray(0.4, dtype)
    assert (spectrum.fit_gamut(rgb, y, "none") == rgb).all()
    np.testing.assert_array_equal(
        spectrum.fit_gamut(rgb, y, "clip"), np.array([0.0, 0.5, 1.4], dtype)
    )
    assert spectrum.fit_gamut(rgb, y, "desaturate")[1] < 0.5
    with pytest.raises(ValueError, match="gamut: 'squash' given, expected one of desaturate"):
        spectrum.fit_gamut(rgb, y, "squash")


def test_srgb_published_values(dtype):
    """Points that follow from the standard by hand, and its 8-bit mid grey."""
    linear = jnp.asarray([0.0, 0.0031308, 0.21404114, 1.0], dtype)
    # 0.21404114 encodes to 0.5: ((0.5 + 0.055)/1.055)^2.4 = 0.2140411404822325.
    want = [0.0, 0.040449936, 0.5, 1.0]
    np.testing.assert_allclose(spectrum.encode_srgb(linear), want, rtol=1e-6)  # digits given
    np.testing.assert_allclose(
        spectrum.decode_srgb(jnp.asarray([0.5], dtype)), [0.2140411404822325], rtol=10 * EPS[dtype]
    )


def test_srgb_round_trip_and_odd_extension(dtype):
    x = jnp.asarray(np.concatenate([np.linspace(0, 0.01, 101), np.linspace(0, 2, 101)]), dtype)
    encoded = spectrum.encode_srgb(x)
    # The pieces of the standard miss each other by 3e-8 at the joint, an encoded value of
    # 0.04045 against 0.0404499; powers cost a few roundings each.
    np.testing.assert_allclose(spectrum.decode_srgb(encoded), x, atol=1e-8 + 20 * EPS[dtype])
    assert (spectrum.encode_srgb(-x) == -encoded).all()
    assert (jnp.diff(encoded[101:]) > 0).all()


def test_srgb_slopes(dtype):
    slope = jax.vmap(jax.grad(spectrum.encode_srgb))
    toe = jnp.asarray([-0.003, -0.0, 0.0, 1e-30, 0.003], dtype)
    # 12.92 exactly, at 0 too, where an absolute value has none.
    np.testing.assert_allclose(slope(toe), 12.92, rtol=EPS[dtype])
    inverse = jax.vmap(jax.grad(spectrum.decode_srgb))
    np.testing.assert_allclose(inverse(toe), 1 / 12.92, rtol=EPS[dtype])
    x = jnp.asarray([-0.5, 0.0031308, 0.01, 0.5, 1.0, 3.0], dtype)
    chain = slope(x) * inverse(spectrum.encode_srgb(x))
    # The slopes of the two pieces differ at the joint (12.92 against 12.70), hence not there.
    np.testing.assert_allclose(np.delete(chain, 1), 1.0, rtol=50 * EPS[dtype])
    assert np.isfinite(slope(x)).all()


def test_compiled_and_mapped_agree(dtype, rng):
    rgb = jnp.asarray(rng.normal(0.4, 0.6, (20, 3)), dtype)
    y = jnp.asarray(rng.uniform(0, 1, 20), dtype)

    def pixel(c, l):
        return spectrum.encode_srgb(spectrum.fit_gamut(c, l, "desaturate"))

    whole = pixel(rgb, y)
    # A multiply-add may be fused: an ulp of 1, times the slope 12.92 of the toe.
    np.testing.assert_allclose(jax.jit(pixel)(rgb, y), whole, atol=30 * EPS[dtype])
    np.testing.assert_allclose(jax.vmap(pixel)(rgb, y), whole, atol=30 * EPS[dtype])
