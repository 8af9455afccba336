"""A few wavelengths with the mirror peak apart, against all of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt import colour, few
from reference import directions


def model(**options):
    scan = do.samples.compact_disc(jax.random.key(1), shape=(96, 64), pixel=0.1)
    return do.DiffractionBRDF(do.Heightfield(scan.heights, scan.pixel), 0.7, **options)


def relative_error(got, expected):
    return float(jnp.abs(got - expected).max() / jnp.abs(expected).max())


def test_few_wavelengths_come_close_and_all_are_exact(rng):
    brdf = model(fresnel=do.fresnel.Schlick(0.04), blur=0.01)
    wi, wo = directions(rng, 60), directions(rng, 60)
    exact = brdf.xyz(wi, wo)
    errors = []
    for count in (6, 11, 21, 81):
        settings = do.FewSettings(count=count, nodes=18)
        fast = brdf.prepare(pairs=(wi, wo), output="xyz", settings=settings)
        errors.append(relative_error(fast(wi, wo), exact))
    assert errors[0] > errors[1] > errors[2] > errors[3]
    # A line of lambda^2 / (2 pi u sigma) = 60 nm is seen by 11 wavelengths, not by 6.
    assert errors[1] < 1e-2
    assert errors[2] < 1e-4
    # All wavelengths: what 18 nodes and the mirror's 1e-7 leave out.
    assert errors[3] < 1e-6


def test_the_mirror_peak_keeps_every_wavelength(rng):
    """At the mirror direction itself three bands would do; a little aside they do not."""
    brdf = model()
    wi = directions(rng, 30, 60.0)
    wo = wi * np.array([-1.0, -1.0, 1.0])
    fast = brdf.prepare(pairs=(wi, wo), output="xyz", settings=do.FewSettings(count=8, nodes=18))
    # Pits scatter little into the mirror direction: what is left of it is smooth.
    assert relative_error(fast(wi, wo), brdf.xyz(wi, wo)) < 1e-3


@pytest.mark.long
def test_mirror_left_out_stays_out(rng):
    brdf = model(mirror="apart")
    wi, wo = directions(rng, 30), directions(rng, 30)
    fast = brdf.prepare(pairs=(wi, wo), output="xyz", settings=do.FewSettings(count=41, nodes=18))
    assert relative_error(fast(wi, wo), brdf.xyz(wi, wo)) < 1e-5
    assert np.isnan(fast.choice.error_bound)


def test_weights_keep_the_white_point():
    lam = colour.wavelengths()
    weights = np.asarray(colour.spectral_weights(lam))
    at, some = few.few_weights(lam, weights, 9)
    np.testing.assert_allclose(some.sum(0), weights.sum(0), rtol=1e-12)
    # A cubic through nine places is exact for cubics.
    cubic = lambda x: 1.0 + x - 3.0 * x**2 + 2.0 * x**3  # noqa: E731
    np.testing.assert_allclose(cubic(at) @ some, cubic(lam) @ weights, rtol=1e-12)


def test_gradients_are_finite_and_right(rng):
    brdf = model()
    wi, wo = directions(rng, 5), directions(rng, 5)
    fast = brdf.prepare(pairs=(wi, wo), output="xyz", settings=do.FewSettings(count=41, nodes=18))
    got = jax.grad(lambda a: fast(a, wo).sum())(jnp.asarray(wi))
    exact = jax.grad(lambda a: brdf.xyz(a, wo).sum())(jnp.asarray(wi))
    assert relative_error(got, exact) < 1e-4


def test_refusals_say_why(rng):
    wi, wo = directions(rng, 4), directions(rng, 4)
    job = {"pairs": (wi, wo), "settings": do.FewSettings(count=5)}
    with pytest.raises(do.InputError, match="method 'few' is for output='xyz'"):
        model().prepare(**job)
    with pytest.raises(do.InputError, match="only average='positions' has"):
        model(average="window").prepare(**job, output="xyz")
    with pytest.raises(do.InputError, match="count must lie between 4 and the 81"):
        model().prepare(pairs=(wi, wo), settings=do.FewSettings(count=3), output="xyz")
    with pytest.raises(do.InputError, match="no derivative to the model"):
        model().prepare(**job, output="xyz", gradient="model")
