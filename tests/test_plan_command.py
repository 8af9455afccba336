"""``diffopt plan``, and ``diffopt render`` by plans and with layers, run in this process."""

import json
import re
import types

import numpy as np
import PIL.Image
import pytest
from rich.table import Table

from diffopt import planning, rendering
from diffopt.cli import main, render_output
from diffopt.planning import EFFECTS, Plan, Row, checking
from diffopt.rendering.effects import Composition
from diffopt.rendering.settings import PathSettings
from diffopt.scenes import load_scene

# A ball over a floor, under the sun and a sky that is seen.
SCENE = """
[camera]
eye = [0, -4, 1]
resolution = [16, 12]
[[objects]]
name = "ball"
shape = "sphere"
material = { kind = "lambert", colour = [0.8, 0.4, 0.2] }
[[objects]]
name = "floor"
shape = "plane"
width = 6
height = 6
material = { kind = "lambert", colour = 0.5 }
translate = [0, 0, -1]
[[lights]]
kind = "directional"
towards = [1, -1, 2]
irradiance = 2
[[lights]]
kind = "environment"
radiance = 0.1
[render]
level = "path"
spp = 4
depth = 3
"""


@pytest.fixture
def scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "ball.toml"
    path.write_text(SCENE)
    return str(path)


def test_every_effect_is_told_and_kept(scene, tmp_path, capsys):
    words = ["--tolerance", "0.1", "--without", "surroundings", "--most-spp", "64", "--seed", "3"]
    assert main(["plan", scene, *words, "--size", "8x6", "--json", "a.json"]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    lines = {line.split()[1]: line for line in out.splitlines() if line.startswith("│")}
    assert [name for name in lines if name in EFFECTS] == list(EFFECTS)
    assert "as asked" in lines["surroundings"]
    assert out.rstrip().splitlines()[-1] == (
        f"next: diffopt render {scene} --tolerance 0.1 --without surroundings --most-spp 64 "
        "--size 8x6 --seed 3"
    )
    told = json.loads((tmp_path / "a.json").read_text())
    assert set(told) >= {"tolerance", "bias", "noise", "seconds", "level", "settings", "effects"}
    assert [row["effect"] for row in told["effects"]] == list(EFFECTS)
    assert told["tolerance"] == 0.1
    assert told["settings"]["seed"] == 3
    assert told["settings"]["spp"] <= 64
    inside = {row["effect"] for row in told["effects"] if row["included"]}
    assert {"matte-light", "hard-shadows"} <= inside
    assert not inside & {"surroundings", "mirror", "spectrum"}
    for row in told["effects"]:
        assert f"│ {'in' if row['included'] else '- '} │" in lines[row["effect"]]
    # What is left out is a fifth of the picture, and more than was asked for.
    assert told["bias"] > 0.1
    assert "above the tolerance: --without leaves out too much" in out


@pytest.fixture
def asked(monkeypatch):
    """Plans at once; keeps what they were asked for."""
    kept = []

    def plan(scene, camera, tolerance, **options):
        kept.append((scene, camera, options))
        row = Row("matte-light", True, "as asked", None)
        return Plan(
            tolerance,
            (row,),
            Composition(),
            PathSettings(spp=2),
            0.02,
            0.09,
            1.0,
            PathSettings(spp=2),
        )

    monkeypatch.setattr(planning, "plan", plan)
    return kept


def test_examples_go_by_name_where_there_is_no_such_file(scene, asked, capsys):
    words = ["--tolerance", "0.1", "--size", "8x6"]
    assert main(["plan", "cornell", *words]) == 0
    [(found, camera, options)] = asked
    assert "tall" in [one.name for one in found.objects]
    assert camera.resolution == (8, 6)
    assert options == {"include": (), "exclude": (), "most_spp": 1024}
    out = capsys.readouterr().out
    assert "note: 11.00% predicted in all, above the tolerance: noise needs more samples" in out
    command = "diffopt render cornell.toml --tolerance 0.1 --size 8x6"
    assert out.endswith(f"next: diffopt scene example cornell && {command}\n")
    assert main(["plan", "bunny"]) == 2
    assert "bunny: no such file, and no example, which are cornell" in capsys.readouterr().err


def test_seed_and_backend_of_the_file(scene, asked, tmp_path):
    (tmp_path / "ball.toml").write_text(SCENE + 'seed = 7\nbackend = "jax"\n')
    assert main(["plan", scene, "--quiet", "--with", "ambient", "--with", "mirror"]) == 0
    assert main(["plan", scene, "--quiet", "--seed", "8"]) == 0
    first, second = (options for _, _, options in asked)
    assert first["include"] == ["ambient", "mirror"]
    assert (first["seed"], first["backend"]) == (7, "jax")
    assert (second["seed"], second["backend"]) == (8, "jax")


@pytest.mark.usefixtures("asked")
@pytest.mark.parametrize("passed", [True, False])
def test_a_check_that_fails_is_an_exit_code(passed, scene, tmp_path, capsys, monkeypatch):
    checked = []

    def check(scene, camera, plan, *, progress=None):
        checked.append((len(scene.objects), camera.resolution, plan.tolerance))
        if progress is not None:
            progress(1, 1)
        found = Table()
        found.add_column("real differences")
        return types.SimpleNamespace(
            passed=passed, table=lambda: found, summary=lambda: {"passed": passed}
        )

    monkeypatch.setattr(checking, "check", check)
    words = ["--tolerance", "1", "--check", "--json", "a.json"]
    assert main(["plan", scene, *words]) == (0 if passed else 1)
    out = capsys.readouterr().out
    assert "real differences" in out
    assert f"check: the plan {'holds' if passed else 'does not hold'} to its tolerance" in out
    assert json.loads((tmp_path / "a.json").read_text())["check"] == {"passed": passed}
    assert main(["plan", scene, *words, "--quiet"]) == (0 if passed else 1)
    assert capsys.readouterr() == ("", "")
    assert checked == 2 * [(2, (16, 12), 1.0)]


def sum_of_layers(arrays):
    layers = [name for name in arrays if name.startswith("layer ")]
    assert layers
    return sum(arrays[name] for name in layers)


def test_pictures_by_plans_with_their_layers(scene, tmp_path, capsys):
    words = ["--tolerance", "0.2", "--layers", "--spp", "8", "--with", "soft-shadows"]
    words += ["-o", "a.npz", "-o", "a.png"]
    assert main(["render", scene, *words]) == 0
    out = capsys.readouterr().out
    inside = out.splitlines()[0].removeprefix("effects: ").split(", ")
    assert {"matte-light", "hard-shadows"} <= set(inside) <= set(EFFECTS)
    assert re.search(r"^plan for 0\.2: .* bias at most [\d.]+ %, noise [\d.]+ % predicted$", out,
                     re.MULTILINE)  # fmt: skip
    assert "note: depth, level, spp of the file are left out: the plan has its own" in out
    assert "hard-shadows -" in out
    assert "a.LAYER.png for each layer; of shadows the magnitude" in out
    with np.load(tmp_path / "a.npz") as arrays:
        assert json.loads(str(arrays["summary"]))["settings"]["spp"] == 8
        # Sums in float32.
        np.testing.assert_allclose(sum_of_layers(arrays), arrays["radiance"], rtol=1e-5, atol=1e-6)
        assert arrays["layer hard-shadows"].min() < 0.0
        names = {name.removeprefix("layer ") for name in arrays if name.startswith("layer ")}
    assert names <= set(inside)
    assert {p.name for p in tmp_path.glob("a.*.png")} == {f"a.{name}.png" for name in names}
    with PIL.Image.open("a.hard-shadows.png") as picture:
        assert picture.size == (16, 12)
        assert np.asarray(picture).max() > 0


def test_layers_of_the_level_path_are_pictures_at_one_exposure(scene, tmp_path):
    pytest.importorskip("OpenEXR", reason="layers of .exr are read back")
    import OpenEXR

    words = ["--layers", "--quiet", "--exposure", "1.5", "-o", "a.exr", "-o", "a.png"]
    assert main(["render", scene, *words]) == 0
    with OpenEXR.File("a.exr", separate_channels=True) as file:
        channels = {name: np.array(one.pixels) for name, one in file.channels().items()}
    reds = {name.removesuffix(".R") for name in channels if name.endswith(".R")}
    layers = reds & set(EFFECTS)
    assert {"matte-light", "hard-shadows", "surroundings"} <= layers
    total = sum(channels[f"{name}.R"] for name in layers)
    # Sums in float32.
    np.testing.assert_allclose(total, channels["R"], rtol=1e-5, atol=1e-6)
    found = load_scene(scene)
    options = {key: value for key, value in found.options.items() if key != "level"}
    image = rendering.render(found.scene, found.camera, layers=True, **options)
    for name, sign in (("matte-light", 1.0), ("hard-shadows", -1.0)):
        image.radiance = sign * image.layers[name]
        with PIL.Image.open(render_output.layer_path(tmp_path / "a.png", name)) as picture:
            np.testing.assert_array_equal(np.asarray(picture), image.display(1.5))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["plan", "gone.toml"], "gone.toml: no such file"),
        (["plan", "SCENE", "--tolerance", "0"], "--tolerance must be above 0 and at most 1; rec"),
        (["plan", "SCENE", "--tolerance", "nan"], "--tolerance must be above 0 and at most 1"),
        (["plan", "SCENE", "--with", "include"], "--with must be of spectrum, "),
        (["plan", "SCENE", "--with", "include"], "received 'include'"),
        (["plan", "SCENE", "--without", "glow"], "--without must be of spectrum, "),
        (["plan", "SCENE", "--without", "matte-light"], "--without: matte-light cannot be left"),
        (
            ["plan", "SCENE", "--with", "mirror", "--without", "mirror"],
            "--with and --without both name mirror",
        ),
        (
            ["plan", "SCENE", "--with", "glossy-interreflection", "--without", "glossy-light"],
            "--with names glossy-interreflection, which needs glossy-light; --without names it",
        ),
        (["plan", "SCENE", "--most-spp", "0"], "--most-spp must be a whole number from 1 to"),
        (["plan", "SCENE", "--seed", "-1"], "--seed must be a whole number from 0 to"),
        (["plan", "SCENE", "--size", "4"], "--size must be WxH, 1 to 16384 pixels each; rec"),
        (["plan", "SCENE", "--json", "no/a"], "--json no/a: the folder no does not exist"),
        (["plan", "SCENE", "--json", "."], "--json .: is a folder; expected a file"),
        (["render", "SCENE", "--tolerance", "2"], "--tolerance must be above 0 and at most 1"),
        (
            ["render", "SCENE", "--tolerance", "0.1", "--level", "path"],
            "--tolerance and --level exclude each other: the plan chooses the level",
        ),
        (
            ["render", "SCENE", "--tolerance", "0.1", "--depth", "0"],
            "--tolerance and --depth exclude each other: the plan chooses the depth",
        ),
        (["render", "SCENE", "--tolerance", "1", "--spp", "0"], "--spp must be a whole number"),
        (["render", "SCENE", "--with", "mirror"], "--with belongs to plans: give --tolerance too"),
        (["render", "SCENE", "--layers", "--level", "recursive"], "--layers are kept by paths"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(words, text, scene, tmp_path, capsys):
    assert main([scene if word == "SCENE" else word for word in words]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("diffopt: error: ")
    assert text in err
    assert err.count("\n") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"ball.toml"}
