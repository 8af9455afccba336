"""``diffopt shadow``, run in this process."""

import csv
import dataclasses
import itertools
import json

import numpy as np
import PIL.Image
import pytest
import trimesh

from diffopt.cli import film, main, progress, shadow
from diffopt.errors import InputError
from diffopt.shadows import animations, pictures

QUICK = [
    *("--size", "20", "--picture", "48x30", "--spp", "1"),
    *("--bands", "3", "--rays", "8", "--shells", "2"),
]


def test_frames_animation_and_times(tmp_path, capsys):
    target = tmp_path / "made" / "on the way"
    words = ["shadow", "--scene", "egg", "--frames", "4", "-o", str(target), "--check", *QUICK]
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert err == ""
    frames = [f"frame_{k:04d}.png" for k in range(4)]
    others = ["animation.gif", "result.json", "times.csv", "times.txt"]
    assert sorted(path.name for path in target.iterdir()) == sorted(frames + others)
    pixels = []
    for name in frames:
        with PIL.Image.open(target / name) as image:
            assert image.size == (48, 30)
            pixels.append(np.asarray(image, int))
    assert all(np.abs(a - b).max() > 20 for a, b in itertools.pairwise(pixels))
    with PIL.Image.open(target / "animation.gif") as film:
        assert film.n_frames == 4
        assert film.info["loop"] == 0
        assert film.info["duration"] == 200
        for k, expected in enumerate(pixels):
            film.seek(k)
            found = np.asarray(film.convert("RGB"), int)
            assert np.abs(found - expected).mean() < 6.0
    # The table: this run beside the paper's.
    lines = out.splitlines()
    assert lines[0].split() == ["vertices", "sampling", "conversion", "shadowing", "frames/s"]
    assert lines[1].split()[:2] == ["egg", "482"]
    assert lines[2].split() == [
        *("Egg", "(paper)", "482", "7.4", "ms", "5.0", "ms", "36.7", "ms", "22.5"),
    ]
    assert (target / "times.txt").read_text().splitlines() == lines[:3]
    assert "400 receivers on the ground under sky, sun and lamp" in out
    assert "RMS error of the sky's light over the open light, frames 0, 2: " in out
    assert "frame_0000.png .. frame_0003.png, animation.gif" in out
    with (target / "times.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["phase"]) for row in rows] == [0.0, 0.25, 0.5, 0.75]
    assert [bool(row["error"]) for row in rows] == [True, False, True, False]
    for row in rows:
        assert all(float(row[f"{stage}_ms"]) > 0.0 for stage in ("sampling", "conversion"))
        assert all(float(row[f"{stage}_ms"]) > 0.0 for stage in ("shadowing", "picture"))
    summary = json.loads((target / "result.json").read_text())
    assert summary["scene"] == "egg"
    assert (summary["frames"], summary["receivers"], summary["fields"]) == (4, 400, 1)
    assert summary["settings"]["bands"] == 3
    assert summary["lights"] == ["sky and sun", "lamp"]
    own, paper = summary["times"]
    spent = [own[f"{stage}_ms"] for stage in ("sampling", "conversion", "shadowing")]
    assert own["frames_s"] == pytest.approx(1e3 / sum(spent), rel=0.6)
    assert (paper["shadowing_ms"], paper["frames_s"]) == (36.7, 22.5)
    # Three bands under this sky: small, and not nothing.
    assert all(1e-3 < error < 0.08 for error in summary["errors"].values())


def test_parts_maps_and_a_mesh(tmp_path, capsys):
    file = tmp_path / "cone.ply"
    trimesh.creation.cone(radius=3.0, height=9.0, sections=12).export(file)
    target = tmp_path / "cone"
    words = ["--mesh", str(file), "--up", "z", "--frames", "2", "--no-lamp", "-o", str(target)]
    assert main(["shadow", *words, "--parts", "2", "--combination", "sum", *QUICK]) == 0
    out = capsys.readouterr().out
    assert "cone.ply" in out
    for name in ("Dragon (paper)", "Egg (paper)", "Plane (paper)"):
        assert name in out
    assert "receivers on the ground under sky and sun:" in out
    summary = json.loads((target / "result.json").read_text())
    assert summary["fields"] == 2
    assert summary["lights"] == ["sky and sun"]
    assert summary["errors"] == {}
    # A shorter run leaves frames of the longer one, and says so.
    assert main(["shadow", *words, "--map", "square", "--quiet", *QUICK[:-2]]) == 0
    assert capsys.readouterr().out == ""
    assert json.loads((target / "result.json").read_text())["settings"]["map"] == "square"
    words[words.index("2")] = "1"
    assert main(["shadow", *words, *QUICK]) == 0
    out = capsys.readouterr().out
    assert "holds 1 more frames of another run, from frame_0001.png on" in out
    assert f"{target}: frame_0000.png, animation.gif" in out
    assert (target / "frame_0001.png").exists()


def test_limbs_of_the_creature_are_its_parts():
    scene = animations.animation("creature")
    settings = shadow._settings(None, 1, bands=3, rays=8, shells=2)
    made = film.Film(scene, settings, 4, 4, (12, 8), 1)
    assert made.occluder._count == 4
    made.occluder.update(scene.shape(0.0))
    widths = [float(field.radius) for field in made.occluder.fields]
    assert widths[2] == pytest.approx(widths[3])
    assert max(widths) < 1.0


def test_an_interrupt_keeps_finished_frames(tmp_path, capsys, monkeypatch):
    draw, drawn = pictures.Stage.draw, []

    def interrupted(self, *args):
        drawn.append(0)
        if len(drawn) > 2:
            raise KeyboardInterrupt
        return draw(self, *args)

    monkeypatch.setattr(pictures.Stage, "draw", interrupted)
    target = tmp_path / "some"
    words = ["shadow", "--scene", "egg", "--frames", "5", "-o", str(target), *QUICK]
    assert main(words) == 130
    assert "interrupted: 2 of 5 frames" in capsys.readouterr().out
    frames = sorted(path.name for path in target.glob("*.png"))
    assert frames == ["frame_0000.png", "frame_0001.png"]
    with PIL.Image.open(target / "animation.gif") as film:
        assert film.n_frames == 2
    summary = json.loads((target / "result.json").read_text())
    assert (summary["frames"], summary["frames_of_the_loop"]) == (2, 5)
    # Before the first frame there is nothing to keep.
    words[words.index(str(target))] = str(tmp_path / "none")
    assert main(words) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["some"]


def test_progress_counts_frames(tmp_path, monkeypatch):
    seen = []
    update = progress.Stages.stage

    def spied(self, name):
        from contextlib import contextmanager

        @contextmanager
        def stage():
            with update(self, name) as report:
                yield lambda done, of: (seen.append((name, done, of)), report(done, of))

        return stage()

    monkeypatch.setattr(progress.Stages, "stage", spied)
    words = ["shadow", "--scene", "egg", "--frames", "2", "-o", str(tmp_path / "a"), "--quiet"]
    assert main([*words, *QUICK]) == 0
    assert seen == [("egg", 0, 2), ("egg", 1, 2), ("egg", 2, 2)]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scene", "dragon"], "--scene must be one of creature, egg, sheet; received 'dragon'"),
        (["--scene", "egg", "--mesh", "a.ply"], "--scene egg and --mesh a.ply: give one of them"),
        (["--mesh", "a.ply"], "a.ply: no such file"),
        (["--up", "w"], "--up must be one of x, y, z; received 'w'"),
        (["--frames", "0"], "--frames must lie between 1 and 999; received 0"),
        (["--size", "1"], "--size must lie between 2 and 4096; received 1"),
        (["--spp", "9"], "--spp must lie between 1 and 8; received 9"),
        (["--picture", "12"], "--picture must be WxH, 1 to 16384 pixels each; received '12'"),
        (
            ["--picture", "9000x9000"],
            "--picture 9000x9000 --spp 2 are 324000000 samples; at most 16777216",
        ),
        (["--bands", "17"], "--bands must be a whole number from 1 to 16; received 17"),
        (["--rays", "2"], "--rays must be a whole number from 4 to 1024; received 2"),
        (["--map", "x"], "--map must be one of tangent, square, sphere rule; received 'x'"),
        (
            ["--map", "square", "--shells", "2"],
            "--shells must be 1 for the square map; received 2",
        ),
        (
            ["--combination", "max"],
            "--combination must be one of product, exponential, sum; received 'max'",
        ),
        (["--parts", "0"], "--parts must lie between 1 and 2332; received 0"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(words, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["shadow", *words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err == f"diffopt: error: {message}\n"
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_place_of_the_folder(tmp_path, capsys):
    target = tmp_path / "a"
    target.write_text("")
    assert main(["shadow", "-o", str(target)]) == 2
    assert capsys.readouterr().err.endswith("is a file; expected a folder for the results\n")


def test_settings_by_tolerance():
    coarse = shadow._settings(0.05, 1)
    fine = shadow._settings(0.01, 1)
    assert coarse.bands < fine.bands
    assert shadow._settings(0.01, 1, rays=7) == dataclasses.replace(fine, rays=7)
    with pytest.raises(InputError, match=r"^--tolerance 1e-05 is met by no settings"):
        shadow._settings(1e-5, 1)
    with pytest.raises(InputError, match=r"^--tolerance is met by the tangent map.*'square'"):
        shadow._settings(0.01, 1, map="square")
