"""The command line: what it writes, prints and returns."""

import csv
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

import diffopt
from diffopt import DiffractionBRDF, Heightfield, InputError
from diffopt.accuracy import studies
from diffopt.cli import main, options
from diffopt.cli.output import folder

PICTURES = {"scan.png", "in_plane.png", "hemisphere.png", "sphere.png", "sheet.png"}
NUMBERS = {"result.npz", "result.json"}
PERIOD = 1.2


@pytest.fixture(scope="module")
def scan_file(tmp_path_factory):
    """A sinusoid along x, 9.6 um wide, with a tilt that levelling takes out."""
    y, x = np.mgrid[:96, :96] * 0.1
    heights = 0.06 * np.sin(2 * np.pi * x / PERIOD) + 0.01 * x - 0.02 * y
    path = tmp_path_factory.mktemp("scan") / "grating.npz"
    Heightfield(jnp.asarray(heights), 0.1).save(path)
    return path


@pytest.fixture(scope="module")
def finished(scan_file, tmp_path_factory):
    """Folder after one small run, its exit code, and a file that was there before."""
    target = tmp_path_factory.mktemp("out") / "grating"
    target.mkdir()
    (target / "notes.txt").write_text("mine")
    (target / "scan.png").write_text("old")
    words = ["--incidence", "30", "--material", "al", "--size", "24", "--coherence", "1.0"]
    code = main(["diffraction", str(scan_file), *words, "-o", str(target)])
    return target, code


@pytest.fixture(scope="module")
def summary(finished):
    return json.loads((finished[0] / "result.json").read_text())


def test_everything_is_in_the_folder_and_nothing_else(finished):
    target, code = finished
    assert code == 0
    assert {p.name for p in target.iterdir()} == PICTURES | NUMBERS | {"notes.txt"}
    assert (target / "notes.txt").read_text() == "mine"
    assert [p.name for p in target.parent.iterdir()] == ["grating"]


def test_pictures_are_pictures(finished):
    for name in PICTURES:
        with PIL.Image.open(finished[0] / name) as image:
            pixels = np.asarray(image.convert("RGB"), np.float64)
        assert pixels.std() > 2.0, f"{name} is empty"
    with PIL.Image.open(finished[0] / "sphere.png") as image:
        assert image.size == (24, 24)


def test_json_states_settings_method_versions_and_history(summary):
    assert summary["versions"]["diffopt"] == diffopt.__version__
    assert summary["versions"]["jax"] == jax.__version__
    assert summary["settings"]["material"] == "al"
    assert summary["settings"]["coherence"] == 1.0
    assert summary["settings"]["blur"] == pytest.approx(0.00231, rel=1e-2)
    assert summary["statistics"]["dominant_period"] == pytest.approx(PERIOD, rel=0.02)
    assert summary["provenance"]["source"] == "grating.npz"
    assert any("levelled" in step for step in summary["provenance"]["steps"])
    method = summary["method"]
    assert method["name"] in method["choice"]
    assert 0 < method["error_bound"] <= method["tolerance"] == 1e-3
    assert {"compile_s", "run_s"} == set(summary["times"]["hemisphere"])
    assert all(value >= 0 for stage in summary["times"].values() for value in stage.values())
    assert summary["units"]["lengths"] == "um"


def test_brightest_direction_is_the_mirror(summary):
    angles = [peak["angle_deg"] for peak in summary["brightest"]]
    # Viewing angles are 2.7 degrees apart at this size.
    assert angles[0] == pytest.approx(-30.0, abs=2.7)


def test_numbers_are_those_of_the_model(finished, scan_file):
    with np.load(finished[0] / "result.npz") as archive:
        data = dict(archive)
    units = json.loads(str(data["attributes"]))["units"]
    assert units["spectra"] == "1/sr"
    assert set(units) == set(data) - {"attributes"}
    with jax.enable_x64(True):
        scan = Heightfield.load(scan_file).levelled(by="plane")
        brdf = DiffractionBRDF(
            scan, 1.0, fresnel=diffopt.fresnel.metal("al"), blur=0.5 * np.sin(np.radians(0.265))
        )
        some = slice(None, None, 5)
        direct = np.asarray(brdf(data["wi"], data["wo"][some], data["wavelengths"]))
    error = np.abs(data["spectra"][some] - direct).max() / data["spectra"].max()
    assert error < 1e-3
    np.testing.assert_allclose(data["wi"], [0.5, 0.0, np.sqrt(0.75)], atol=0.02)
    assert data["heights"].dtype == np.float32
    assert data["xyz_hemisphere"].shape == (24, 24, 3)


@pytest.mark.slow
def test_a_mesh_is_drawn_and_described(scan_file, tmp_path, capsys):
    import trimesh

    made = trimesh.creation.torus(2.0, 0.8, major_sections=40, minor_sections=20)
    made.export(tmp_path / "ring.stl")
    target = tmp_path / "out"
    words = ["--size", "32", "--coherence", "1.0", "--mesh", str(tmp_path / "ring.stl")]
    words += ["--mesh-up", "0,0,1", "--mesh-turn", "30", "--mesh-light", "-1,0,2"]
    assert main(["diffraction", str(scan_file), *words, "-o", str(target)]) == 0
    assert {p.name for p in target.iterdir()} == PICTURES | NUMBERS | {"mesh.png"}
    with PIL.Image.open(target / "mesh.png") as image:
        assert image.size == (32, 32)
        assert np.asarray(image.convert("RGB"), np.float64).std() > 2.0
    summary = json.loads((target / "result.json").read_text())
    mesh = summary["mesh"]
    assert (mesh["file"], mesh["vertices"], mesh["faces"]) == ("ring.stl", 800, 1600)
    assert mesh["turn"] == 30.0
    assert "circles around the upward axis (no texture" in mesh["tangents"]
    np.testing.assert_allclose(mesh["light"], np.array([-1, 0, 2]) / np.sqrt(5))
    np.testing.assert_allclose(mesh["camera"]["target"], 0.0, atol=1e-6)
    assert mesh["camera"]["up"] == [0.0, 0.0, 1.0]
    assert mesh["camera"]["eye"][2] > 0
    assert 0.5 < mesh["lit_share"] < 1.0
    assert "mesh" in summary["times"]
    assert "note: ring.stl: the scan's x axis, turned by 30 degrees" in capsys.readouterr().out


def test_meshes_follow_their_texture_or_a_direction(tmp_path):
    from diffopt.cli import meshes

    path = tmp_path / "sheet.obj"
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 0 1\nvt 1 1\nvt 1 0\n"
    path.write_text(corners + "f 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    # u grows along y.
    subject = meshes.prepare(meshes.Words(str(path), mesh_eye="0,0,1", mesh_light="0,0,-3"))
    assert subject.tangents == "follows u of the texture"
    shot = subject.shoot(16)
    seen = shot.view.covered
    np.testing.assert_allclose(shot.view.tangent[seen], [[0, 1, 0]] * seen.sum(), atol=1e-12)
    assert shot.notes()[-1] == "sheet.obj: the light reaches nothing that is seen"
    along = meshes.Words(str(path), 90.0, "1,0,1", mesh_eye="0,0,1")
    # Its projection is x; a quarter turn of the material puts y there.
    shot = meshes.prepare(along).shoot(16)
    np.testing.assert_allclose(shot.view.tangent[seen], [[0, -1, 0]] * seen.sum(), atol=1e-12)
    assert shot.summary()["tangents"] == "follows the direction 1,0,1"
    back = meshes.prepare(meshes.Words(str(path), mesh_eye="0,0,-1")).shoot(16)
    assert "100 % of what is seen are backs of faces" in back.notes()[1]
    path.write_text(
        corners.replace("vt 1 1", "vt 0 0").replace("vt 1 0", "vt 0 0") + "f 1/1 3/3 4/4\n"
    )
    assert "degenerate" in meshes.prepare(meshes.Words(str(path))).tangents


@pytest.mark.slow
def test_summary_is_printed(scan_file, tmp_path, capsys):
    words = ["--average", "window", "--dtype", "float64", "--size", "16", "--coherence", "4"]
    words += ["--illuminant", "A", "--balance", "peak", "--method", "direct", "--level", "none"]
    assert main(["diffraction", str(scan_file), *words, "-o", str(tmp_path / "o")]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "direct: DirectSettings" in out
    assert "to compile" in out
    assert "the angle of the source is left out" in out
    assert "coherence lengths wide" in out
    with np.load(tmp_path / "o" / "result.npz") as archive:
        assert archive["spectra"].dtype == np.float64
        assert archive["heights"].dtype == np.float64
        assert "relative reflectance" in str(archive["attributes"])


def test_spectra_go_to_float64_where_float32_cannot_keep_the_tolerance():
    from diffopt.cli.diffraction import precision, spectra

    source = options.Source("sample:sinusoidal_grating")
    asked = options.Appearance(size=16, method="taylor", tolerance=1e-7, coherence=1.5)
    with precision("auto"):
        with pytest.raises(InputError, match="use --dtype float64"):
            spectra(options.job(source, dataclasses.replace(asked, dtype="float32")))
        job = options.job(source, asked)
        cut = spectra(job)
    assert job.scan.heights.dtype == jnp.float32
    assert cut.choice.error_bound <= 1e-7


def test_info_and_samples(scan_file, capsys):
    assert main(["info", str(scan_file)]) == 0
    out = capsys.readouterr().out
    for words in ("96 x 96 pixels", "9.6 x 9.6 µm", "100 x 100 nm", "levelled", "dominant period"):
        assert words in out
    assert main(["info", "sample:snake_skin", "--key", "3"]) == 0
    assert "snake skin" in capsys.readouterr().out
    assert main(["samples"]) == 0
    out = capsys.readouterr().out
    assert all(f"sample:{name}" in out for name in diffopt.samples.NAMES)


def test_help_and_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"diffopt {diffopt.__version__}\n"
    assert main(["--help"]) == 0
    out = capsys.readouterr().out
    commands = ("diffraction", "demo", "accuracy", "bench", "samples", "info")
    assert all(command in out for command in commands)
    assert main([]) == 2
    assert "Commands" in capsys.readouterr().out


def read_rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def tiny_study():
    def cases(quick):
        def build(n):
            x = jnp.linspace(0.0, 1.0, n)
            return studies.Job(
                lambda x: (x * x).mean(), (x,), lambda v: (abs(float(v) - 1 / 3), "")
            )

        counts = (5, 50) if quick else (5, 50, 500)
        return [studies.Case({"points": n}, "float32", lambda n=n: build(n)) for n in counts]

    return studies.Study("test.mean", "mean of x^2", "1/3", cases)


def test_accuracy_prints_a_table_and_writes_plot_and_rows(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(studies, "NAMES", {"test.mean": ""})
    monkeypatch.setattr(studies, "study", lambda name: tiny_study())
    target = tmp_path / "accuracy"
    words = ["accuracy", "--quick", "--tolerance", "0.01", "-o", str(target)]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "mean of x^2" in out
    assert "cheapest within 0.01: points=50" in out
    assert {p.name for p in target.iterdir()} == {"test.mean.png", "test.mean.csv"}
    rows = read_rows(target / "test.mean.csv")
    assert [row["points"] for row in rows] == ["5", "50"]
    assert main(["accuracy", "test.mean", "--tolerance", "1e-9"]) == 0
    assert "no settings have an error of at most 1e-09" in capsys.readouterr().out


def test_bench_prints_and_writes_rows(tmp_path, capsys):
    from diffopt.accuracy import benchmarks

    name = next(iter(benchmarks.NAMES))
    path = tmp_path / "bench.csv"
    assert main(["bench", name, "--repeats", "1", "-o", str(path)]) == 0
    assert name in capsys.readouterr().out
    rows = read_rows(path)
    assert rows
    assert all(row["name"].startswith(name) for row in rows)
    assert all(float(row["run_s"]) > 0 for row in rows)


@pytest.mark.slow
def test_demo_makes_a_page_of_its_pictures(tmp_path, capsys):
    target = tmp_path / "demo"
    assert main(["demo", "-o", str(target), "--size", "32", "--only", "diffraction"]) == 0
    names = {p.name for p in target.iterdir()}
    assert names == PICTURES | NUMBERS | {"disc.png", "index.html"}
    page = (target / "index.html").read_text()
    assert page.count("<figure>") == len(PICTURES) + 1
    assert page.count('src="data:image/') == len(PICTURES) + 1
    assert "src=" not in page.replace('src="data:image/', "")
    assert f"open {target / 'index.html'}" in capsys.readouterr().out


def test_folder_appears_whole_or_not_at_all(tmp_path):
    target = tmp_path / "a" / "b"

    def interrupted():
        with folder(target) as staging:
            (staging / "half.txt").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert list(tmp_path.iterdir()) == []
    with folder(target) as staging:
        (staging / "whole.txt").write_text("whole")
        assert not target.exists()
    assert [p.name for p in target.iterdir()] == ["whole.txt"]
    assert [p.name for p in target.parent.iterdir()] == ["b"]


def test_bugs_keep_their_traceback(monkeypatch, scan_file, tmp_path):
    from diffopt.drawing import views

    def broken(*_, **__):
        raise ValueError("shapes do not match")

    monkeypatch.setattr(views, "in_plane", broken)
    with pytest.raises(ValueError, match="shapes do not match"):
        main(["diffraction", str(scan_file), "-o", str(tmp_path / "o")])
    assert list(tmp_path.iterdir()) == []


def test_the_command_line_imports_nothing_slow():
    slow = ("matplotlib", "colour", "skimage", "scipy.signal", "tifffile", "SurfaceTopography")
    slow += ("trimesh", "embreex")
    code = f"import sys, diffopt.cli; print([m for m in {slow!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"


def test_module_runs_as_a_program():
    done = subprocess.run(
        [sys.executable, "-m", "diffopt", "info", "sample:flat"],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "256 x 256 pixels" in done.stdout


def test_names_of_folders():
    assert options.name("sample:flat") == "flat"
    assert options.name(str(Path("some") / "where" / "scan.v2.sur")) == "scan.v2"
