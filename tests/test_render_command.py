"""``diffopt render`` and ``diffopt scene``, run in this process."""

import json
import sys

import numpy as np
import PIL.Image
import pytest

from diffopt.cli import main, progress
from diffopt.scenes import raycasting

SCENE = """
[camera]
eye = [0, -4, 0.5]
resolution = [16, 12]
[[objects]]
name = "ball"
shape = "sphere"
material = { kind = "lambert", colour = [0.8, 0.4, 0.2] }
[[lights]]
kind = "directional"
towards = [1, -1, 1]
[render]
level = "incremental"
spp = 2
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(SCENE)
    return path


def test_pictures_in_several_formats(scene, tmp_path, capsys, monkeypatch):
    targets = [tmp_path / f"a.{suffix}" for suffix in ("png", "npz", "exr")]
    words = [word for target in targets for word in ("-o", str(target))]
    assert main(["render", str(scene), *words, "--exposure", "1.5"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    for word in ("incremental, 2 samples", "16 x 12 pixels", "time", "noise", "a.png, ", "a.exr"):
        assert word in out
    with np.load(targets[1]) as arrays:
        assert arrays["radiance"].shape == (12, 16, 3)
        assert arrays["radiance"].max() > 0.05
        assert json.loads(str(arrays["summary"]))["settings"]["spp"] == 2
    with PIL.Image.open(targets[0]) as picture:
        assert picture.size == (16, 12)
    # Into the folder at hand, by the scene's name, other pixels, quietly.
    monkeypatch.chdir(tmp_path)
    assert main(["render", str(scene), "--size", "4x3", "--spp", "1", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    with PIL.Image.open("ball.png") as picture:
        assert picture.size == (4, 3)


def test_levels_and_their_settings(scene, tmp_path, capsys):
    target = str(tmp_path / "a.npz")
    words = ["--level", "path", "--spp", "2", "--depth", "2", "--seed", "5", "--size", "4x3"]
    assert main(["render", str(scene), "-o", target, *words]) == 0
    out = capsys.readouterr().out
    assert "path, 2 samples" in out
    assert "standard error" in out
    assert "note: spp of the file belong to the level incremental: left out" in out
    with np.load(target) as arrays:
        settings = json.loads(str(arrays["summary"]))["settings"]
    assert (settings["spp"], settings["depth"], settings["seed"]) == (2, 2, 5)


def test_an_interrupt_keeps_what_is_done(scene, tmp_path, capsys, monkeypatch):
    scene.write_text(SCENE + "rays = 64\n")
    first = raycasting.Caster.first
    calls = []

    def interrupted(self, origins, directions):
        calls.append(len(origins))
        # Each tile asks twice: for the samples, and for depth and normals.
        if len(calls) > 2:
            raise KeyboardInterrupt
        return first(self, origins, directions)

    monkeypatch.setattr(raycasting.Caster, "first", interrupted)
    target = tmp_path / "a.npz"
    assert main(["render", str(scene), "-o", str(target)]) == 130
    out = capsys.readouterr().out
    assert "interrupted" in out
    with np.load(target) as arrays:
        done = arrays["done"]
    assert 0 < done.sum() < done.size
    share = 100.0 * done.mean()
    assert f"{share:.0f} % of the pixels are done" in out


def test_the_bar_shows_the_time_left(monkeypatch):
    seen = []
    monkeypatch.setattr("rich.progress.Progress.add_task", lambda self, *a, **k: 0)
    monkeypatch.setattr("rich.progress.Progress.update", lambda self, *a, **k: seen.append(k))
    with progress.stages(1, left=True) as stages, stages.stage("path") as report:
        report(1, 4)
    assert {"completed": 0.25} in seen


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["gone.toml"], "gone.toml: no such file"),
        (["SCENE", "-o", "a.jpg"], "-o a.jpg: pictures are written to .png, .exr, .npz"),
        (["SCENE", "-o", "no/a.png"], "-o no/a.png: the folder no does not exist"),
        (["SCENE", "--size", "4"], "--size must be WxH, 1 to 16384 pixels each; received '4'"),
        (["SCENE", "--size", "0x3"], "--size must be WxH"),
        (["SCENE", "--level", "fast"], "--level must be one of incremental, recursive"),
        (["SCENE", "--spp", "0"], "--spp must be a whole number from 1 to"),
        (["SCENE", "--depth", "99"], "--depth must be a whole number from 0 to 64; received 99"),
        (["SCENE", "--exposure", "0"], "--exposure must be a factor above 0; received 0"),
        (["SCENE", "--seed", "x"], "--seed"),
        (["BAD"], "bad.toml:2: [camera], fov: unknown key; expected"),
        (["BAD"], "(and 1 more: diffopt scene check"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(words, text, scene, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.toml").write_text("[camera]\nfov = 3\n[render]\nspp = 0\n")
    named = {"SCENE": str(scene), "BAD": str(tmp_path / "bad.toml")}
    assert main(["render", *(named.get(word, word) for word in words)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("diffopt: error: ")
    assert text in err
    assert err.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"ball.toml", "bad.toml"}


def test_check_lists_objects_lights_and_findings(scene, tmp_path, capsys):
    assert main(["scene", "check", str(scene)]) == 0
    out = capsys.readouterr().out
    for word in ("linear RGB", "16 x 12 pixels", "ball", "Sphere", "Directional", "irradiance 1"):
        assert word in out
    assert "nothing to object to" in out
    scene.write_text(SCENE.replace("directional", "point").replace("towards", "position"))
    assert main(["scene", "check", str(scene)]) == 0
    scene.write_text(SCENE.partition("[[lights]]")[0])
    assert main(["scene", "check", str(scene)]) == 1
    assert "error: scene: there is no light" in capsys.readouterr().out


def test_check_lists_all_faults(tmp_path, capsys):
    path = tmp_path / "bad.toml"
    path.write_text("[camera]\nfov = 3\n[render]\nspp = 0\n")
    assert main(["scene", "check", str(path)]) == 1
    out, err = capsys.readouterr()
    assert err == ""
    assert "bad.toml:2: [camera], fov: unknown key" in out
    assert "bad.toml:4: [render], spp: must be" in out
    assert "2 faults" in out
    assert main(["scene", "check", str(tmp_path / "gone.toml")]) == 2
    assert "gone.toml: no such file" in capsys.readouterr().err


def test_examples_are_written_once(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["scene", "example", "cornell"]) == 0
    assert "diffopt render cornell.toml -o cornell.png" in capsys.readouterr().out
    assert main(["scene", "check", "cornell.toml"]) == 0
    capsys.readouterr()
    assert main(["scene", "example", "cornell"]) == 2
    assert "cornell.toml: is there already; name another file with -o" in capsys.readouterr().err
    assert main(["scene", "example", "bunny"]) == 2
    assert "NAME must be one of cornell, balls, disc, lamp, teapot" in capsys.readouterr().err


def test_exr_without_its_package_is_refused_before_anything_is_rendered(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    monkeypatch.setattr("diffopt.rendering.synthesis.render", None)
    target = tmp_path / "a.exr"
    assert main(["scene", "example", "lamp", "-o", str(tmp_path / "lamp.toml")]) == 0
    assert main(["render", str(tmp_path / "lamp.toml"), "-o", str(target)]) == 2
    error = capsys.readouterr().err
    assert "a.exr: .exr needs OpenEXR: pip install OpenEXR (extra exr), or save as .npz" in error
    assert not target.exists()
