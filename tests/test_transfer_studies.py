"""What accuracy costs in precomputed transfer: the truth, the estimators, the studies."""

import csv
import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

import diffopt as do
from diffopt.accuracy import (
    benchmarks,
    studies,
    transfer_benchmarks,
    transfer_comparison,
    transfer_estimators,
    transfer_runs,
    transfer_scenes,
    transfer_truth,
)
from diffopt.accuracy.transfer_comparison import Comparison, Row
from diffopt.accuracy.transfer_estimators import Problem
from diffopt.accuracy.transfer_runs import Reference, Setup
from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.kernels.langevin import langevin
from diffopt.transfer import beginning, path_sampling, relighting
from diffopt.transfer.lighting import prepare
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.tracing import Frames

pytestmark = pytest.mark.float32

NAMES = [name for name in studies.NAMES if name.startswith("transfer.")]
# As the quick studies have it: computed once for all tests.
BASE = TransferSettings(tolerance=0.3, rays=256, finest=1, splits=0)


def plane(material):
    return do.Scene([do.Object(do.scenes.Plane(2.0, 2.0), material)])


def above(material, wo):
    """Points of the plane z = 0 seen from directions."""
    up = np.broadcast_to([0.0, 0.0, 1.0], wo.shape)
    known = np.broadcast_to(transfer_truth.formula(material), wo.shape)
    return transfer_truth.Points(np.zeros_like(wo), up, up, wo, known)


def test_lobes_have_scipys_density():
    rng = np.random.default_rng(0)
    s = rng.normal(size=(50, 3))
    s /= np.linalg.norm(s, axis=1, keepdims=True)
    mu, kappa = np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0]]), np.array([100.0, 1.0])
    found = transfer_scenes.densities(s, mu, kappa)
    for k in range(2):
        np.testing.assert_allclose(
            found[:, k], stats.vonmises_fisher(mu[k], kappa[k]).pdf(s), rtol=1e-9
        )


@pytest.mark.parametrize("exponent", [4.0, 128.0])
def test_reflectance_is_that_of_the_materials(exponent):
    """Two ways to write one formula; the toolkit's works in float32."""
    material = do.materials.Sum((do.materials.Lambert(0.3), do.BlinnPhong(0.5, exponent)))
    rng = np.random.default_rng(1)
    wi, wo = np.abs(rng.normal(size=(2, 100, 3)))
    wi, wo = (w / np.linalg.norm(w, axis=1, keepdims=True) for w in (wi, wo))
    diffuse, factor, e = transfer_truth.formula(material)
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=1, keepdims=True)
    right = diffuse / np.pi + factor * half[:, 2] ** e
    found = material.f(jnp.asarray(wi, jnp.float32), jnp.asarray(wo, jnp.float32))
    np.testing.assert_allclose(np.asarray(found).reshape(-1), right, rtol=1e-4)


def test_moments_of_a_plane_are_closed_forms():
    """Lambert's: albedo, and two thirds of it upwards; nothing is hidden."""
    material = do.materials.Lambert(0.6)
    points = above(material, np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]]))
    whole, first = transfer_truth.moments(plane(material), points, 8192)
    # Even sets of 1024 directions err by some 1e-3; weights are all equal.
    np.testing.assert_allclose(whole, [[0.6, 0.0, 0.0]] * 2, atol=1e-9)
    np.testing.assert_allclose(first[:, 0], [[0.0, 0.0, 0.4]] * 2, atol=2e-3)


def test_light_is_drawn_and_weighed():
    """With directions of the light too the mean is the same, within its error."""
    material = do.BlinnPhong(0.8, 32.0)
    points = above(material, np.array([[0.3, -0.2, 0.933]]))
    light = transfer_scenes.light("suns")
    found = transfer_truth.radiance(plane(material), points, light, 2**14)
    alone = transfer_truth.radiance(plane(material), points, light._replace(lobes=None), 2**15)
    spread = np.hypot(found.error, alone.error)
    assert found.error < 0.02 * found.value
    # Eight sets: a Student's t of seven degrees exceeds 5 in 1 of 600.
    assert abs(found.value - alone.value) < 5.0 * spread


def test_the_truth_agrees_with_path_tracing():
    """A point of the ring, seen through a picture so narrow that all of it is that point."""
    subject = transfer_scenes.subject("ring", 8, 24)
    pixels, _ = transfer_truth.seen(subject)
    origin, towards = subject.camera.rays(pixels[len(pixels) // 3 : len(pixels) // 3 + 1], 0.5)
    camera = do.Camera(
        eye=tuple(origin[0]),
        target=tuple(origin[0] + towards[0]),
        field_of_view=0.02,
        resolution=(4, 4),
    )
    _, points = transfer_truth.seen(transfer_scenes.Subject(subject.scene, camera))
    found = transfer_truth.radiance(subject.scene, points, transfer_scenes.light("suns"), 2048)
    settings = do.rendering.PathSettings(spp=1000, depth=2)
    image = do.render(transfer_scenes.lit("ring", "suns", 8, 24), camera, "path", settings=settings)
    error = np.hypot(
        np.sqrt((found.error**2).sum()), np.sqrt((image.error[..., 0] ** 2).sum())
    ) / len(points.wo)
    assert abs(found.value.mean() - image.radiance[..., 0].mean()) < 4.0 * error
    assert error < 0.03 * found.value.mean()


def test_paths_of_their_own_on_a_plane():
    """Nothing hidden: the integral is the albedo, the lobe that of the material's moments."""
    material = do.BlinnPhong(0.8, 32.0)
    around = beginning.surroundings(plane(material))
    sampler = path_sampling.PathSampler(around, 0, "reflectance")
    at = Frames(np.zeros((1, 3)), np.eye(3)[None])
    wo = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    found = sampler(at, wo, 20_000)
    assert found.rays <= 40_000
    whole, first = transfer_truth.moments(plane(material), above(material, wo), 2**15)
    alpha = np.asarray(found.slices.alpha)[:, :, 0, 0]
    # The weight of a path varies by about its mean: 1 / sqrt(20,000), four times.
    np.testing.assert_allclose(alpha[:, 0], whole[:, 0], rtol=0.03)
    assert (alpha[:, 1:] == 0.0).all()
    mean = np.linalg.norm(first[:, 0], axis=1) / whole[:, 0]
    kappa = np.asarray(found.slices.kappa)[:, 0, 0]
    rest = 1.0 - np.asarray(langevin(jnp.asarray(kappa, jnp.float32)))
    np.testing.assert_allclose(rest, 1.0 - mean, rtol=0.06)


def test_lobes_in_place_of_the_reflectance_keep_the_energy():
    """From steep to grazing: what the lobes have below the horizon is little."""
    material = do.BlinnPhong(0.8, 32.0)
    around = beginning.surroundings(plane(material))
    sampler = path_sampling.PathSampler(around, 0)
    at = Frames(np.zeros((1, 3)), np.eye(3)[None])
    height = np.array([1.0, 0.6, 0.3, 0.05])
    wo = np.stack([np.sqrt(1.0 - height**2), 0.0 * height, height], -1)
    alpha = np.asarray(sampler(at, wo, 5000).slices.alpha)[:, 0, 0, 0]
    whole, _ = transfer_truth.moments(plane(material), above(material, wo), 2**14)
    # Views between the tabulated ones are interpolated to 0.2 %, the truth errs by as much.
    np.testing.assert_allclose(alpha, whole[:, 0], rtol=0.01)


@pytest.mark.long
def test_estimators_agree_within_their_errors():
    """All of them on slices of the ring; the errors of paths fall with their number."""
    problem = Problem("ring", 3, 0, 4096)
    few, many = (
        transfer_estimators.compared(problem, "paths, reflectance", n) for n in (100, 6400)
    )
    # Eight times less by theory; 30 slices tell it to a factor of 1.5 or so.
    assert many.direct < few.direct / 3.0
    assert many.radiance < few.radiance / 3.0
    assert many.direct < 0.02
    assert many.angle < 2.0
    # The truth itself has 4096 paths a slice.
    assert many.indirect < 0.03
    shared = transfer_estimators.compared(problem, "shared rays", 1024)
    assert shared.direct < 0.03
    assert shared.radiance < 0.06
    # The rays serve all ten views.
    assert shared.rays < 250 < many.rays
    assert "us and" in str(shared)


def test_matte_reflectors_have_no_glossy_paths():
    around = beginning.surroundings(plane(do.materials.Lambert(0.5)))
    with pytest.raises(InputError, match=r"reflector 0 must have a glossy rest"):
        path_sampling.PathSampler(around, 0)
    around = beginning.surroundings(plane(do.BlinnPhong(0.5, 8.0)))
    with pytest.raises(InputError, match=r"weights must be one of lobes, reflectance.*'fits'"):
        path_sampling.PathSampler(around, 0, "fits")
    at = Frames(np.zeros((1, 3)), np.eye(3)[None])
    with pytest.raises(InputError, match=r"paths must be from 1 to 10,000,000; received 0"):
        path_sampling.PathSampler(around, 0)(at, np.eye(3)[2:], 0)


@pytest.mark.parametrize("name", NAMES)
def test_cases_are_different(name):
    for quick in (True, False):
        found = [tuple(case.settings.items()) for case in studies.study(name).cases(quick)]
        assert len(set(found)) == len(found) >= 2


@pytest.mark.long
def test_more_vertices_err_less():
    rows = studies.study("transfer.tolerance").run(quick=True).rows
    assert [row.settings["tolerance"] for row in rows] == [0.9, 0.1]
    assert rows[1].error < rows[0].error
    vertices = [int(row.note.split(" ")[0].replace(",", "")) for row in rows]
    assert vertices[1] > vertices[0] >= 200
    assert "core-ms a vertex; noise of truth" in rows[0].note


@pytest.mark.long
def test_more_views_take_more_slices():
    rows = studies.study("transfer.levels").run(quick=True).rows
    slices = [int(row.note.split(", ")[1].split(" ")[0].replace(",", "")) for row in rows]
    vertices = [int(row.note.split(" ")[0].replace(",", "")) for row in rows]
    # Ten views and 31, and the view-independent slice.
    assert slices == [vertices[0] * 11, vertices[1] * 32]


def test_stored_slices_err_little():
    exact, coarse = studies.study("transfer.quantisation").run(quick=True).rows
    # A tenth of the slices' norm is little beside what 200 vertices err.
    assert coarse.error == pytest.approx(exact.error, abs=0.05)
    size = [float(row.note.split(", ")[1].split(" ")[0]) for row in (exact, coarse)]
    assert size[1] < 0.8 * size[0]


@pytest.mark.long
def test_ways_to_average_light_agree():
    rows = studies.study("transfer.lighting").run(quick=True).rows
    off = [float(row.note.split(" ")[0]) for row in rows]
    assert off[0] == 0.0
    # Tables err by about a percent; eight bands are few for lobes of suns.
    assert off[1] < 0.02
    assert off[1] < off[2] < 0.3
    assert all(row.error < 0.3 for row in rows)


@pytest.fixture(scope="module")
def compared():
    return transfer_comparison.compare(
        ["ring"],
        ["adaptive", "adaptive, no indirect", "adaptive, per vertex"],
        settings=BASE,
        resolution=24,
        paths=512,
        again=False,
    )


def test_indirect_light_is_missed(compared, tmp_path):
    whole, each, direct = compared.rows
    assert [row.way for row in compared.rows] == [
        "adaptive",
        "adaptive, per vertex",
        "adaptive, no indirect",
    ]
    assert direct.bias < whole.bias
    assert whole.vertices == each.vertices == direct.vertices >= 200
    assert whole.rmse < each.rmse
    assert all(0.0 < row.ssim < 1.0 for row in compared.rows)
    compared.save_csv(tmp_path / "found.csv")
    with (tmp_path / "found.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert float(lines[2]["rmse"]) == direct.rmse
    assert "per vertex" in str(compared)


def test_even_vertices_of_equal_error():
    """By the power law that the made-up errors follow."""
    row = Row("ring", "adaptive", 0.05, 0.0, 0.0, 0.0, 1.0, 300, 1, 1.0, 1.0, 1.0, 1.0)
    rows = [row] + [
        dataclasses.replace(row, way=way, vertices=count, rmse=10.0 / count)
        for way, count in (("initial", 100), ("uniform 1", 400))
    ]
    found = Comparison(tuple(rows), "suns")
    assert found.equal("ring") == pytest.approx(200.0)
    assert "300 adaptive vertices are as good as 200 even ones" in " ".join(str(found).split())
    assert Comparison(tuple(rows[:2]), "suns").equal("ring") is None


def test_scores_of_known_pictures():
    """A picture that is off by a number; noise of the truth is taken out."""
    rng = np.random.default_rng(2)
    right = rng.uniform(0.5, 1.5, (16, 16))
    truth = Reference(np.arange(256), right.reshape(-1), np.zeros(256))
    front = np.ones(256, bool)
    same = transfer_runs.score(right, truth, front)
    assert (same.rmse, same.worst, same.ssim) == (0.0, 0.0, 1.0)
    off = transfer_runs.score(right + 0.1, truth, front)
    assert off.rmse == pytest.approx(0.1 / right.mean())
    assert off.bias == pytest.approx(off.rmse)
    noisy = right + rng.normal(0.0, 0.1, right.shape)
    told = truth._replace(error=np.full(256, 0.1))
    # The mean of 256 squares has an error of 9 %.
    assert transfer_runs.score(noisy, told, front).rmse < 0.05
    with pytest.raises(InputError, match="see no surface together"):
        transfer_runs.score(right, truth, ~front)


def test_layout_of_the_benchmark():
    """Under even light radiance is the sum of the weights, of which direct ones are held over
    the unoccluded 0.8 as all others are."""
    held = transfer_benchmarks.held()
    even = prepare([do.scenes.Ambient(1.0)], do.scenes.channels.Channels())
    numbers = jnp.arange(20, dtype=jnp.int32)
    up = held.axes[:20, 2]
    found = relighting.vertex_radiance(held, even, numbers, up)
    weights = np.asarray(held.views).reshape(len(held.position), -1, 3, 5)[:20, :, :, 4]
    assert np.isfinite(np.asarray(found)).all()
    assert (np.asarray(found)[:, 0] <= 0.8 * weights.max(1).sum(-1) + 1e-5).all()
    assert (np.asarray(found)[:, 0] >= 0.8 * weights.min(1).sum(-1) - 1e-5).all()
    for name in ("transfer.relight", "transfer.slices"):
        assert benchmarks._benchmark(name).name == name


def test_what_it_does_not_know_is_named(capsys):
    with pytest.raises(InputError, match=r"scene must be one of teapot 32.*'cube'"):
        transfer_comparison.compare(["cube"])
    with pytest.raises(InputError, match=r"way must be one of adaptive.*'best'"):
        transfer_comparison.compare(["ring"], ["best"])
    with pytest.raises(InputError, match=r"light must be one of suns, sky.*'lamp'"):
        transfer_comparison.compare(["ring"], ["initial"], light="lamp")
    with pytest.raises(InputError, match=r"received 1, 96"):
        transfer_comparison.compare(["ring"], ["initial"], detail=1)
    with pytest.raises(InputError, match=r"count must be a multiple of 8; received 12"):
        transfer_runs.reference(Setup("ring", resolution=24, paths=12))
    with pytest.raises(InputError, match=r"way must be one of paths, lobes"):
        transfer_estimators.compared(Problem("ring"), "rays", 1)
    assert main(["compare", "transfer", "--rays", "5"]) == 2
    assert "rays must be a whole number from 64" in capsys.readouterr().err
