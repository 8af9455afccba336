"""Studies of von Mises-Fisher lobes: published errors, and what the tables say."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import dblquad

import diffopt
from diffopt.accuracy import lobe_studies
from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.fitting import lobe_studies as fits
from diffopt.fitting import sample_studies
from diffopt.kernels.langevin import pade_inverse_langevin

pytestmark = pytest.mark.float32


@pytest.fixture(scope="module")
def distance():
    return diffopt.study("lobes.distance").run(quick=True, repeats=1)


@pytest.fixture(scope="module")
def concentration():
    return diffopt.study("lobes.concentration").run(quick=True, repeats=1)


@pytest.mark.parametrize(("kappa", "share"), [(1.0, 0.29), (2.0, 0.037), (3.0, 0.005)])
def test_the_distance_for_large_concentrations_errs_as_published(distance, kappa, share):
    """Lobes close to each other; facing away it is much worse, and negative."""
    kept = distance.where(form="eq. 7", kappa=kappa)
    row = kept.where(angle_deg=10.0).rows[0]
    assert row.error == pytest.approx(share, rel=0.02)
    assert row.note.startswith("-")
    assert kept.where(angle_deg=165.0).rows[0].error > 2.5 * share


def test_the_exact_distance(distance):
    """A few roundings of float32; the limit joins it at large concentrations."""
    assert max(row.error for row in distance.where(form="exact").rows) < 5e-6
    assert max(row.error for row in distance.where(form="eq. 7", kappa=32.0).rows) < 5e-6
    assert distance.cheapest(1e-4).settings["form"] == "exact"
    with pytest.raises(InputError, match="no settings have an error of at most 1e-09"):
        distance.cheapest(1e-9)


@pytest.mark.parametrize(("kappa", "degrees"), [(0.5, 170.0), (3.0, 10.0), (20.0, 90.0)])
def test_the_reference_of_distances_against_quadrature(kappa, degrees):
    angle = np.radians(degrees)

    def square(phi, z):
        lobe = kappa / (4 * np.pi * np.sinh(kappa))
        x = np.sqrt(1 - z * z) * np.cos(phi)
        first = np.exp(kappa * z)
        second = np.exp(kappa * (np.cos(angle) * z + np.sin(angle) * x))
        return 2 * (lobe * (first - second)) ** 2  # half of the azimuths

    expected = dblquad(square, -1, 1, 0, np.pi, epsabs=1e-12, epsrel=1e-10)[0]
    assert lobe_studies.distance_of_alike(kappa, degrees) == pytest.approx(expected, rel=1e-8)


def test_the_rational_inverse_errs_as_published(concentration):
    """Banerjee et al.: 4.94 % near 4.94, at most; one half for large concentrations."""
    rows = concentration.where(form="Banerjee").rows
    worst = max(rows, key=lambda row: row.error)
    assert worst.settings["kappa"] == 3.16
    assert worst.error == pytest.approx(0.0494, abs=1e-4)
    assert worst.note.startswith("+0.0494 at 4.9")
    for row in rows:
        if row.settings["kappa"] == 100.0:
            assert row.error == pytest.approx((0.5 - 1.25 / 100.0) / 100.0, rel=1e-3)


def test_half_too_much_at_every_large_concentration():
    kappa = np.array([1e2, 1e4, 1e6])
    with jax.enable_x64(True):
        pair = (jnp.asarray(a, "float64") for a in lobe_studies.mean_cosine(kappa))
        found = np.asarray(pade_inverse_langevin(*pair))
    # The next term, and one over the square of the smallest.
    np.testing.assert_allclose(found - kappa, 0.5 - 1.25 / kappa, atol=5e-4)


def test_the_exact_inverse(concentration):
    """To rounding, where one minus the mean cosine is kept; kappa eps where it is not."""
    assert max(row.error for row in concentration.where(form="exact").rows) < 2e-6
    assert concentration.cheapest(1e-5).settings["form"] == "exact"
    alone = concentration.where(form="exact, of R alone", kappa=1e6).rows[0].error
    assert 1e-2 < alone < 0.3


def test_mean_cosines_against_their_series():
    kappa = np.array([1e-2, 1.0, 7.99, 8.01, 40.0])
    value, rest = lobe_studies.mean_cosine(kappa)
    k = kappa.astype(np.longdouble)
    np.testing.assert_allclose(value.astype(float), 1 / np.tanh(kappa) - 1 / kappa, rtol=1e-11)
    np.testing.assert_allclose((value + rest).astype(float), 1.0, rtol=1e-15)
    # k / 3 - k^3 / 45 + 2 k^5 / 945
    series = k[0] / 3 - k[0] ** 3 / 45 + 2 * k[0] ** 5 / 945
    np.testing.assert_allclose(float(value[0] / series), 1.0, rtol=1e-13)


def test_more_lobes_are_closer():
    result = diffopt.study("lobes.count").run(quick=True, repeats=1)
    one, four = (result.where(lobes=k).rows[0] for k in (1, 4))
    # Measured 0.18 and 0.037; starts are drawn.
    assert four.error < 0.05 < 0.15 < one.error < 0.2
    assert result.cheapest(0.1).settings["lobes"] == 4
    assert result.cheapest(0.3).run_s <= min(one.run_s, four.run_s)


@pytest.mark.long
def test_expectation_maximisation_stays_above_least_squares():
    """A thousand steps of the one against ten and a few of the other."""
    result = diffopt.study("lobes.steps").run(quick=True, repeats=1)
    alone = result.where(em_steps=1000, lm_steps=0).rows[0]
    after = result.where(em_steps=10, lm_steps=5).rows[0]
    assert after.error < 0.8 * alone.error
    assert after.run_s < alone.run_s
    assert result.cheapest(0.06) == after


@pytest.mark.long
def test_more_nodes_are_closer_and_say_so():
    result = diffopt.study("lobes.quadrature").run(quick=True, repeats=1)
    coarse, fine = (result.where(rings=n).rows[0] for n in (8, 32))
    assert fine.error < 0.05 < 0.1 < coarse.error
    own = float(fine.note.rpartition(" ")[2])
    # Lobes are no sharper than the nodes resolve: what these say of the error is so.
    assert fine.error == pytest.approx(own, rel=0.05)


def test_samples(tmp_path, capsys, monkeypatch):
    result = diffopt.study("lobes.samples").run(quick=True, repeats=1)
    moments, em, bins = (
        result.where(samples=10_000, method=method).rows[0].error
        for method in ("moments", "EM", "least squares")
    )
    # The floors of one lobe, 0.24, of EM, 0.035, and of least squares, 0.011; and noise.
    assert 0.2 < moments < 0.3
    assert 0.035 < em < 0.08
    assert bins < 0.8 * em
    monkeypatch.setattr(type(result.study), "run", lambda self, *a, **k: result)
    assert main(["accuracy", "lobes.samples", "--quick", "-o", str(tmp_path / "out")]) == 0
    assert "least squares" in capsys.readouterr().out
    with (tmp_path / "out" / "lobes.samples.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 3
    assert (tmp_path / "out" / "lobes.samples.png").stat().st_size > 10_000


def test_samples_have_the_density_of_the_slice():
    right = fits.truth(32.0, 60.0)
    share = right.solid_angles * right.values
    share /= share.sum()
    samples = sample_studies.drawn(200_000, 32.0, 60.0)
    np.testing.assert_allclose(np.linalg.norm(samples, axis=-1), 1.0, rtol=1e-12)
    mean = share @ right.directions
    spread = share @ (right.directions - mean) ** 2
    # Five standard errors; y has mean 0.
    np.testing.assert_allclose(samples.mean(0), mean, atol=5 * np.sqrt(spread.max() / 2e5))
    np.testing.assert_allclose(samples.var(0), spread, rtol=0.03)


def test_the_judge_of_slices():
    """No lobe misses all of a function; its mean lobe misses what the kernels say it does."""
    right = fits.truth(4.0, 0.0)
    assert right.error([0.0], [[0.0, 0.0, 1.0]], [3.0]) == pytest.approx(1.0)
    # (1 + cos) / 2 is (n.h)^2: the integral of (n.h)^4 cos over the hemisphere.
    whole = right.solid_angles @ right.values
    assert whole == pytest.approx(2 * np.pi * (1 / 2 + 2 / 3 + 1 / 4) / 4, rel=1e-4)
    np.testing.assert_allclose(right.solid_angles.sum(), 4 * np.pi, rtol=1e-12)
