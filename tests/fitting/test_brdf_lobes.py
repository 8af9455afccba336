"""Whole BRDFs as lobes: lobes of neighbouring views belong together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import BlinnPhong, BRDFLobes
from diffopt.brdf_lobes import icosahedral_views
from diffopt.fitting import LobeSettings, fit_brdf, fit_lobes
from diffopt.fitting.brdf import _rotate, _waves
from diffopt.fitting.lobe_targets import slices

SETTINGS = LobeSettings(rings=16, sectors=24, chunk=128)
MATERIAL = BlinnPhong(1.0, 32.0)


@pytest.fixture(scope="module")
def fit():
    return fit_brdf(MATERIAL, 3, level=2, settings=SETTINGS)


def nodes_at(views):
    """Nodes of slices, and their values, in batches as large as that of the fit: one program."""
    size = len(icosahedral_views(2)[0])
    padded = np.resize(views, (-(-len(views) // size) * size, 3)).astype(np.float32)
    parts = [
        slices(MATERIAL, jnp.asarray(part), SETTINGS)
        for part in np.split(padded, len(padded) // size)
    ]
    columns = [(p.directions, p.solid_angles, p.values[..., 0]) for p in map(jax.device_get, parts)]
    return [np.concatenate(column)[: len(views)] for column in zip(*columns, strict=True)]


def midpoint_errors(brdf):
    """Relative errors half-way between neighbours whose slices lobes can hold."""
    views, faces = np.asarray(brdf.views, np.float64), np.asarray(brdf.faces)
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]), 1), axis=0)
    middle = views[edges].sum(1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    middle = middle[middle[:, 2] > 0.4].astype(np.float32)
    directions, solid, values = nodes_at(middle)
    found = brdf.at(middle)(directions)
    missed = np.asarray(found) - values
    return np.sqrt((solid * missed**2).sum(1) / (solid * values**2).sum(1))


def test_lobes_belong_together(fit):
    """Half-way between views 16 degrees apart: well below the error of fits apart.

    Those draw the same numbers at every view and so are often alike: with three keys their
    error is 1.9 to 2.3 times as large, with a key for each view 3 to 6 times.
    """
    views, faces = icosahedral_views(2)
    apart = fit_lobes(MATERIAL, 3, wo=jnp.asarray(views, jnp.float32), settings=SETTINGS)
    alone = midpoint_errors(BRDFLobes(views, faces, apart.lobes))
    together = midpoint_errors(fit.brdf)
    assert together.mean() * 1.6 < alone.mean()
    # At the views themselves it costs little: they are in other local minima, not worse ones.
    assert float(fit.error.mean()) < 1.25 * float(apart.error.mean())


def test_result(fit):
    assert fit.error.shape == (89,)
    assert fit.lobes.count == 3
    np.testing.assert_array_equal(fit.lobes.mu, fit.brdf.lobes.mu)
    assert fit.lobes.kappa.dtype == "float32"
    walked = SETTINGS.lm_steps + SETTINGS.coarse_steps // 2
    np.testing.assert_array_equal(fit.steps, SETTINGS.lm_steps + walked)
    assert str(fit).startswith("89 functions, 3 lobes by lm")


def test_mirrored_views_have_mirrored_slices(fit):
    """The material is isotropic; the fit does not know, but has to find it, to its own error.

    A view and its mirror image in y see mirror images of one slice.
    """
    views = np.asarray(fit.brdf.views, np.float64)
    mirrored = np.argmin(((views * [1, -1, 1])[:, None] - views[None]) ** 2 @ np.ones(3), 1)
    np.testing.assert_allclose(views[mirrored], views * [1, -1, 1], atol=1e-6)
    some = np.flatnonzero(views[:, 2] > 0.4)
    directions, solid, values = nodes_at(views[some])
    here = np.asarray(fit.lobes[some](directions))
    there = np.asarray(fit.lobes[mirrored[some]](directions * np.float32([1.0, -1.0, 1.0])))
    gap = np.sqrt((solid * (here - there) ** 2).sum(1) / (solid * values**2).sum(1))
    bound = np.asarray(fit.error)[some] + np.asarray(fit.error)[mirrored[some]]
    # Both errors are on nodes, and so is the gap: the triangle inequality, with rounding of
    # nodes that are not mirror images themselves.
    assert (gap <= 1.05 * bound + 1e-3).all()


def test_waves_reach_every_view_once():
    views, faces = icosahedral_views(2)
    waves = _waves(len(views), faces, 5)
    reached = {5}
    for wave, parents in waves:
        assert set(parents) <= reached
        assert not set(wave) & reached
        reached |= set(wave)
    assert reached == set(range(len(views)))


def test_shortest_rotations(rng):
    a, b, v = rng.normal(size=(3, 6, 3))
    a, b, v = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b, v))
    a, b, v = (x[:, None] for x in (a, b, v))
    np.testing.assert_allclose(_rotate(a, b, a), b, atol=1e-14)
    normal = np.cross(a, b)
    np.testing.assert_allclose(_rotate(a, b, normal), normal, atol=1e-14)
    turned, other = np.asarray(_rotate(a, b, v)), np.asarray(_rotate(a, b, b))
    np.testing.assert_allclose((turned * other).sum(-1), (v * b).sum(-1), atol=1e-14)
    np.testing.assert_allclose(_rotate(a, a, v), v, atol=1e-14)
