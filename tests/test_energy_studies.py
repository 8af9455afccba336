"""Energy of rough surfaces: the study, and albedos known from elsewhere at every limit."""

import csv

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf, roots_legendre

import diffopt
from diffopt import fresnel, metals
from diffopt.accuracy import energy_studies
from diffopt.cli import main
from diffopt.materials import Dielectric, Microfacet, Mirror, OrenNayar, RoughDielectric

pytestmark = pytest.mark.float32


def at(degrees):
    t = np.radians(np.asarray(degrees, float))
    return np.stack([np.sin(t), 0.0 * t, np.cos(t)], -1)


def gauss(low, high, nodes):
    x, w = roots_legendre(nodes)
    return low + 0.5 * (high - low) * (x + 1), 0.5 * (high - low) * w


def normals_of(kind, alpha, cos):
    """D of Trowbridge and Reitz, or Beckmann."""
    tan2 = 1 / cos**2 - 1
    if kind == "ggx":
        return alpha**2 / (np.pi * cos**4 * (alpha**2 + tan2) ** 2)
    return np.exp(-tan2 / alpha**2) / (np.pi * alpha**2 * cos**4)


def masked_by(kind, alpha, cos):
    """Smith's Lambda, by the slope of the direction."""
    slope = alpha * np.sqrt(1 - cos**2) / cos
    if kind == "ggx":
        return 0.5 * (np.sqrt(1 + slope**2) - 1)
    a = 1 / np.maximum(slope, 0.04)  # exp(-625) is nothing
    return 0.5 * (erf(a) - 1) + np.exp(-(a**2)) / (2 * a * np.sqrt(np.pi))


def scattered_once(kind, alpha, degrees, nodes=300):
    """Albedo of perfect facets, over directions to the light; heights tie both ends."""
    mu, dmu = gauss(0, 1, nodes)
    phi, dphi = gauss(0, np.pi, nodes)
    sin = np.sqrt(1 - mu**2)[:, None]
    view = at(degrees)
    wi = np.stack(np.broadcast_arrays(sin * np.cos(phi), sin * np.sin(phi), mu[:, None]), -1)
    half = wi + view
    half = half / np.linalg.norm(half, axis=-1, keepdims=True)
    shadow = masked_by(kind, alpha, mu)[:, None] + masked_by(kind, alpha, view[2])
    value = normals_of(kind, alpha, half[..., 2]) / (4 * view[2] * (1 + shadow))
    return 2 * dmu @ value @ dphi


def exact_reflectance(m, cos):
    """Unpolarised, for a complex index m, as textbooks write it."""
    inner = np.sqrt(m**2 - 1 + cos**2 + 0j)
    s = (cos - inner) / (cos + inner)
    p = (m**2 * cos - inner) / (m**2 * cos + inner)
    return 0.5 * (np.abs(s) ** 2 + np.abs(p) ** 2)


@pytest.fixture(scope="module")
def study():
    return diffopt.study("material.energy").run(quick=True, repeats=1)


def row(study, facets, normals, alpha, angle, compensation):
    settings = {"facets": facets, "normals": normals, "alpha": alpha, "view_deg": angle}
    return study.where(**settings, compensation=compensation).rows[0]


@pytest.mark.parametrize("normals", ["ggx", "beckmann"])
@pytest.mark.parametrize("angle", [0.0, 60.0])
def test_the_study_finds_what_quadrature_finds(study, normals, angle):
    """Loss without compensation; and it grows with the width."""
    lost = []
    for alpha in (0.25, 1.0):
        expected = 1 - scattered_once(normals, alpha, angle)
        error = row(study, "perfect", normals, alpha, angle, "none").error
        # The rule of the study has 1e-4, at the kink of the horizon.
        assert error == pytest.approx(expected, abs=1e-4)
        lost.append(error)
    assert lost[1] > lost[0] + 0.15


@pytest.mark.parametrize("normals", ["ggx", "beckmann"])
def test_compensation_in_the_study(study, normals):
    """Energy to 0.4 %, the interpolation of the albedos; at ten times less than what is lost."""
    for alpha in (0.25, 1.0):
        for angle in (0.0, 60.0):
            rows = [
                row(study, "perfect", normals, alpha, angle, kind)
                for kind in ("none", "kulla-conty")
            ]
            assert rows[1].error < 4e-3
            if rows[0].error > 0.04:
                assert rows[1].error < 0.1 * rows[0].error


@pytest.mark.parametrize("alpha", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("angle", [0.0, 60.0, 85.0])
def test_the_walk_is_the_single_scattering_model_at_first(alpha, angle):
    """The light that leaves after one facet, and all that leaves."""
    count = 100_000
    by_bounces, _ = energy_studies.walk(
        fresnel.Constant(), alpha, at(angle), np.array([0.55]), count, seed=3
    )
    np.testing.assert_allclose(by_bounces.sum(), 1.0, rtol=1e-12)
    once = scattered_once("ggx", alpha, angle)
    # Five standard errors of a share of the walkers.
    noise = 5 * np.sqrt(once * (1 - once) / count)
    assert abs(by_bounces[0, 0] - once) < noise


def test_the_walk_of_grey_facets():
    """Reflectance r at every facet: the share after b facets is that of perfect ones, r^b."""
    grey, perfect = (
        energy_studies.walk(fresnel.Constant(r), 0.8, at(40.0), np.array([0.55]), 20_000)[0]
        for r in (0.6, 1.0)
    )
    powers = 0.6 ** np.arange(1, len(perfect) + 1)
    # The same walkers; the reflectance is a float32 number in a program without 64-bit types.
    np.testing.assert_allclose(grey[:, 0], perfect[:, 0] * powers, rtol=1e-5, atol=1e-12)


def test_gold_in_the_study(study):
    """Rough gold without compensation is dark and brown; with it, a few percent off the walk."""
    none, full = (
        row(study, "gold", "ggx", 1.0, 0.0, kind).error for kind in ("none", "kulla-conty")
    )
    assert 0.55 < none < 0.65
    # What a product of mean albedos leaves of the order in which facets are met; 0.032.
    assert 0.01 < full < 0.05


@pytest.mark.parametrize("angle", [0.0, 60.0])
def test_gold_against_the_walk(angle):
    """The material's own albedo, spectral; light of several facets is redder."""
    gold = metals.measured("Au")
    lam = np.array([0.45, 0.55, 0.65])
    by_bounces, deviation = energy_studies.walk(gold, 1.0, at(angle), lam, 100_000, seed=8)
    once, all_of_it = by_bounces[0], by_bounces.sum(0)
    assert deviation.max() < 1e-3
    single = Microfacet(1.0, gold, lam).albedo(at(angle))
    # Four standard errors of the once scattered light, whose spread is the largest; and 2e-4.
    np.testing.assert_allclose(single, once, atol=4 * np.sqrt(0.25 / 1e5) + 2e-4)
    full = np.asarray(Microfacet(1.0, gold, lam, compensation="kulla-conty").albedo(at(angle)))
    np.testing.assert_allclose(full, all_of_it, atol=0.05)
    assert (np.abs(full - all_of_it) < 0.2 * np.abs(once - all_of_it))[1:].all()
    assert all_of_it[0] / all_of_it[2] < 0.75 * once[0] / once[2]


def test_command(tmp_path, capsys, study, monkeypatch):
    monkeypatch.setattr(type(study.study), "run", lambda self, *a, **k: study)
    assert main(["accuracy", "material.energy", "--quick", "-o", str(tmp_path / "out")]) == 0
    assert "kulla-conty" in capsys.readouterr().out
    with (tmp_path / "out" / "material.energy.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(study.rows)
    assert {r["facets"] for r in rows} == {"perfect", "gold"}


@pytest.mark.parametrize("angle", [0.0, 45.0, 70.0])
@pytest.mark.parametrize("normals", ["ggx", "beckmann"])
def test_smooth_facets_reflect_as_fresnel_has_it(normals, angle):
    """alpha = 1e-3: a mirror of glass or gold, against complex arithmetic."""
    cos, view = np.cos(np.radians(angle)), at(angle)
    glass = Microfacet(1e-3, fresnel.Dielectric(1.5), normals=normals)
    # Facets lean by alpha: the tails of GGX carry alpha^2 log(1/alpha) of its light elsewhere,
    # float32 resolves a slope of 1e-3 to 1e-4 of itself.
    np.testing.assert_allclose(glass.albedo(view), exact_reflectance(1.5, cos), rtol=2e-3)
    lam = [0.4509, 0.5486, 0.6595]
    gold = Microfacet(1e-3, metals.measured("Au"), lam, normals).albedo(view)
    m = np.array([1.38 + 1.914j, 0.43 + 2.455j, 0.14 + 3.697j])
    np.testing.assert_allclose(gold, exact_reflectance(m, cos), rtol=2e-3)
    through = RoughDielectric(1.5, 1e-3, normals, radiance=False)
    np.testing.assert_allclose(through.albedo(view), 1.0, atol=2e-3)


def kept_by_glass(kind, alpha, eta, degrees, nodes=200):
    """Reflected and refracted light of rough glass that no second facet stops.

    Over the facets that the viewer sees: D max(o.h, 0) / A of them, and of their light the
    share G1 of its direction (Walter et al. 2007, masking of both ends apart).
    """
    u, du = gauss(0, 1, nodes)
    phi, dphi = gauss(0, np.pi, nodes)
    # Slopes by the inverse of the distribution of normals: D cos dh = du dphi / (2 pi).
    tan2 = alpha**2 * (u / (1 - u) if kind == "ggx" else -np.log1p(-u))
    z = (1 / np.sqrt(1 + tan2))[:, None]
    r = np.sqrt(1 - z**2)
    h = np.stack(np.broadcast_arrays(r * np.cos(phi), r * np.sin(phi), z), -1)
    view = at(degrees)
    facing = np.maximum(h @ view, 0)
    area = view[2] * (1 + masked_by(kind, alpha, view[2]))
    seen = facing / z[..., 0:1] * du[:, None] * dphi / np.pi / area
    f = exact_reflectance(eta, facing)
    inner = np.sqrt(np.maximum(1 - (1 - facing**2) / eta**2, 0))
    back = (2 * facing[..., None] * h - view)[..., 2]
    through = ((facing / eta - inner)[..., None] * h - view / eta)[..., 2]

    def free(z):
        up = np.maximum(z, 1e-12)
        return np.where(z > 0, 1 / (1 + masked_by(kind, alpha, np.minimum(up, 1 - 1e-12))), 0)

    np.testing.assert_allclose(seen.sum(), 1, atol=2e-3)
    return (seen * f * free(back)).sum(), (seen * (1 - f) * free(-through)).sum()


@pytest.mark.parametrize(("normals", "alpha"), [("ggx", 0.3), ("beckmann", 0.3), ("ggx", 1.0)])
@pytest.mark.parametrize("eta", [1.5, 1 / 1.5])
@pytest.mark.parametrize("angle", [0.0, 60.0])
def test_rough_glass_loses_what_second_facets_would_scatter(normals, alpha, eta, angle):
    """Lossless Fresnel: reflected and refracted light are 1 less that, from either side."""
    kept = sum(kept_by_glass(normals, alpha, eta, angle))
    material = RoughDielectric(max(eta, 1 / eta), alpha, normals, radiance=False)
    view = at(angle) * [1, 1, 1 if eta > 1 else -1]
    albedo = float(material.albedo(view))
    # Both rules cross the edge of total reflection and the horizon.
    assert albedo == pytest.approx(kept, abs=1e-3)


def diffuse_reflectance(m):
    """Closed form of a smooth dielectric under diffuse light, m > 1 (Walsh 1926, Duntley 1942)."""
    return (
        0.5
        + (m - 1) * (3 * m + 1) / (6 * (m + 1) ** 2)
        + m**2 * (m**2 - 1) ** 2 / (m**2 + 1) ** 3 * np.log((m - 1) / (m + 1))
        - 2 * m**3 * (m**2 + 2 * m - 1) / ((m**2 + 1) * (m**4 - 1))
        + 8 * m**4 * (m**4 + 1) / ((m**2 + 1) * (m**4 - 1) ** 2) * np.log(m)
    )


@pytest.mark.parametrize("index", [1.5, 1.33])
def test_glass_under_diffuse_light(index):
    """From both sides, by albedos of a mirror and of the whole interface."""
    outside = diffuse_reflectance(index)
    inside = 1 - (1 - outside) / index**2
    if index == 1.5:  # as tables have it, since Egan and Hilgeman (1973)
        assert outside == pytest.approx(0.0918, abs=5e-5)
        assert inside == pytest.approx(0.5963, abs=5e-5)
    # A rule on each side of the critical angle, where the reflectance has a root's kink.
    edge = np.sqrt(1 - 1 / index**2)
    parts = [gauss(low, high, 60) for low, high in ((0, edge), (edge, 1))]
    mu, w = (np.concatenate(part) for part in zip(*parts, strict=True))
    views = np.stack([np.sqrt(1 - mu**2), 0 * mu, mu], -1)
    for material, expected in (
        (Mirror(fresnel.Dielectric(index)), outside),
        (Mirror(fresnel.Dielectric(1 / index)), inside),
        # Facets 1e-3 wide blur the critical angle.
        (Microfacet(1e-3, fresnel.Dielectric(index)), outside),
    ):
        found = 2 * (w * mu) @ np.asarray(material.albedo(views), np.float64)
        assert found == pytest.approx(expected, abs=3e-4)
    # What crosses grows by the square of the index as radiance, and shrinks on the way back.
    for side, reflected, scale in ((1, outside, index**-2), (-1, inside, index**2)):
        whole = np.asarray(Dielectric(index).albedo(views * [1, 1, side]), np.float64)
        found = 2 * (w * mu) @ whole
        assert found == pytest.approx(reflected + (1 - reflected) * scale, rel=3e-4)


@pytest.mark.parametrize("sigma", [0.0, 0.35, np.pi / 2])
def test_oren_nayar_albedo(sigma):
    """Its closed form at every angle: the colour at sigma = 0, A at the normal, A + B/2 grazing."""
    a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    degrees = np.array([0.0, 30.0, 60.0, 85.0])
    t = np.radians(degrees)
    s = np.sin(t)
    # (1/pi) int max(0, cos phi) sin(larger) tan(smaller) cos dw.
    g = (2 / np.pi) * (s * (t - s * np.cos(t)) / 2 + np.tan(t) * (1 - s**3) / 3)
    found = OrenNayar(0.8, sigma).albedo(at(degrees))
    # Gauss's rule across the kinks where cos phi is 0 and where both angles are equal.
    np.testing.assert_allclose(found, 0.8 * (a + b * g), rtol=3e-3)
    if sigma == 0.0:
        np.testing.assert_allclose(found, 0.8, rtol=1e-5)
    grazing = float(OrenNayar(0.8, jnp.asarray(sigma)).albedo(at(89.9)))
    assert grazing == pytest.approx(0.8 * (a + 0.5 * b), rel=0.01)
