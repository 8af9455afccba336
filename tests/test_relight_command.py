"""``diffopt relight``, run in this process."""

import json

import numpy as np
import PIL.Image
import pytest

import diffopt as do
from diffopt import transfer
from diffopt.cli import main, relight_output
from diffopt.scenes import Camera, Scene
from diffopt.transfer import working
from diffopt.transfer.interactive import Relit
from diffopt.transfer.precomputation import precompute

FILE = """
[camera]
eye = [0, -4, 2]
target = [0, 0, 0]
resolution = [24, 18]
field_of_view = 40

[materials]
glaze = { kind = "sum", parts = [
    { kind = "lambert", colour = 0.3 },
    { kind = "blinn-phong", colour = 0.5, exponent = 16 },
] }

[[objects]]
name = "ring"
shape = "torus"
radius = 1.0
tube = 0.4
around = 8
across = 5
material = "glaze"

[[lights]]
kind = "environment"
radiance = [0.4, 0.5, 0.6]

[[lights]]
kind = "area"
width = 2
height = 2
radiance = 5
facing = { origin = [4, -3, 6], target = [0, 0, 0] }
"""
SETTINGS = transfer.TransferSettings(rays=256, finest=2, splits=1, tolerance=0.4)


@pytest.fixture(scope="module")
def at(tmp_path_factory):
    """A folder with a scene file and the store of its transfer."""
    folder = tmp_path_factory.mktemp("relight")
    file = folder / "ring.toml"
    file.write_text(FILE)
    found = do.scenes.load_scene(file).scene
    bare = Scene([one for one in found.objects if one.emission is None], found.lights)
    held = precompute(bare, SETTINGS)
    identity = working.identity(bare, SETTINGS)
    transfer.save(folder / "ring.zarr", held, {"identity": identity})
    return folder


@pytest.fixture(scope="module")
def sky(at):
    """A small map, brighter above, with a bright patch: lights of the scene take seconds each."""
    rows = np.linspace(1.5, 0.2, 16)[:, None, None]
    image = rows * np.ones((1, 32, 3)) * np.array([1.0, 0.7, 0.4])
    image[3:5, 5:8] = 20.0
    file = at / "sky.npy"
    np.save(file, image)
    return file


def words(at, *more):
    return ["relight", str(at / "ring.zarr"), str(at / "ring.toml"), "-o", *map(str, more)]


def pixels(path):
    with PIL.Image.open(path) as image:
        return np.asarray(image.convert("RGB"), int)


def test_a_picture_with_everything(at, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(relight_output, "_FIGURE", 48)
    out = tmp_path / "out"
    more = ["--layers", "--check", "--mesh", "--levels", "--spp", "16", "--samples", "1"]
    assert main(words(at, out, *more)) == 0
    printed, err = capsys.readouterr()
    assert err == ""
    assert "frames/s with the lights turned" in printed
    assert "to compile" in printed
    assert "against path tracing, all vertices: RMSE" in printed
    assert "note: what emits light (light) is taken as light from infinity" in printed
    layers = ["direct", "indirect_diffuse", "indirect_glossy", "view_independent", "background"]
    figures = ["check.png", "levels.png", "mesh.png", "picture.png", "result.json"]
    names = sorted([*figures, *(f"layer_{name}.png" for name in layers)])
    assert sorted(path.name for path in out.iterdir()) == names
    assert pixels(out / "picture.png").shape == (18, 24, 3)
    found = json.loads((out / "result.json").read_text())
    assert found["seconds"]["relight"] > 0.0
    rate = found["frames_a_second"]["relight"]
    assert rate == pytest.approx(1.0 / found["seconds"]["relight"])
    # Shares of the light are of the same picture.
    assert sum(found["layers"].values()) == pytest.approx(1.0, abs=1e-4)
    assert set(found["differences"]) == {"found", "initial"}
    # 256 rays from few vertices, 16 paths: the same picture, roughly.
    assert found["differences"]["found"]["rmse"] < 0.7


def test_frames_turn_the_lights_or_the_camera(at, sky, tmp_path, capsys):
    still, around = tmp_path / "turned", tmp_path / "orbited"
    few = ["--frames", "3", "--samples", "1", "--size", "16x12", "--per-vertex"]
    few += ["--environment", sky]
    assert main(words(at, still, *few)) == 0
    assert "frame_0000.png .. frame_0002.png, animation.gif" in capsys.readouterr().out
    assert main(words(at, around, *few, "--orbit", "--quiet")) == 0
    assert capsys.readouterr().out == ""
    for folder in (still, around):
        frames = [pixels(folder / f"frame_{k:04d}.png") for k in range(3)]
        assert all(frame.shape == (12, 16, 3) for frame in frames)
        assert all(np.abs(frames[0] - frame).max() > 10 for frame in frames[1:])
        with PIL.Image.open(folder / "animation.gif") as film:
            assert film.n_frames == 3
    # Both begin at the same picture.
    same = [pixels(folder / "frame_0000.png") for folder in (still, around)]
    np.testing.assert_array_equal(*same)


def test_maps_methods_and_exposure(at, sky, tmp_path, capsys, long):
    shown = {}
    for method in ("pyramid", "lobes", "harmonics") if long else ("pyramid", "lobes"):
        target = tmp_path / f"{method}.png"
        given = ["--environment", sky, "--method", method, "--samples", "1", "--turn", "30"]
        # Harmonics have at most as many bands as the map has rows.
        assert main(words(at, target, *given)) == 0
        shown[method] = pixels(target)
    printed = capsys.readouterr().out
    assert "sky.npy in place of all lights of the scene" in printed
    assert "16 lobes were fitted to the map" in printed
    # Ways to average one light over broad lobes; the lobes themselves are seen behind.
    middle = np.s_[8:16, 4:20]
    for picture in shown.values():
        apart = np.abs(picture - shown["pyramid"])[middle]
        assert apart.mean() < 12.0
    dark = tmp_path / "dark.png"
    given = ["--environment", sky, "--samples", "1", "--turn", "30", "--exposure", "-2", "--quiet"]
    assert main(words(at, dark, *given)) == 0
    assert pixels(dark).mean() < 0.75 * shown["pyramid"].mean()


def test_an_interrupt_keeps_what_is_finished(at, sky, tmp_path, capsys, monkeypatch):
    whole = Relit.turn
    seen = []

    def stopping(self, degrees):
        seen.append(degrees)
        if degrees == 180.0:
            raise KeyboardInterrupt
        whole(self, degrees)

    monkeypatch.setattr(Relit, "turn", stopping)
    out = tmp_path / "out"
    few = ["--frames", "4", "--samples", "1", "--size", "16x12", "--environment", sky]
    assert main(words(at, out, *few)) == 130
    assert (
        "interrupted: the animation holds the frames that are finished" in capsys.readouterr().out
    )
    names = sorted(path.name for path in out.iterdir())
    assert names == ["animation.gif", "frame_0000.png", "frame_0001.png", "result.json"]


def test_cameras_go_round_their_target():
    camera = Camera((3.0, 0.0, 2.0), (1.0, 0.0, 0.0))
    found = relight_output.orbited(camera, 90.0)
    np.testing.assert_allclose(found.eye, (1.0, 2.0, 2.0), atol=1e-12)
    assert found.target == camera.target
    np.testing.assert_allclose(relight_output.orbited(camera, 360.0).eye, camera.eye, atol=1e-12)


@pytest.mark.parametrize(
    ("more", "text"),
    [
        (["out.png", "--layers"], "is one picture; --layers need a folder"),
        (["out.exr"], "expected a folder, or a .png"),
        (["no/out.png"], "the folder no does not exist"),
        (["out", "--frames", "0"], "--frames must lie between 1 and 999; received 0"),
        (["out", "--samples", "9"], "--samples must lie between 1 and 8"),
        (["out", "--turn", "nan"], "--turn must be a finite number"),
        (["out", "--size", "3"], "--size must be WxH"),
        (["out", "--size", "9000x9000"], "samples in a picture; at most"),
        (["out", "--method", "rays"], "--method must be one of pyramid, lobes, harmonics"),
        (["out", "--environment", "none.exr"], "none.exr: no such file"),
    ],
)
def test_what_is_refused(more, text, at, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(words(at, *more)) == 2
    assert text in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_scene_must_be_that_of_the_store(at, tmp_path, capsys):
    other = tmp_path / "other.toml"
    other.write_text(FILE.replace("tube = 0.4", "tube = 0.35"))
    store = str(at / "ring.zarr")
    assert main(["relight", store, str(other), "-o", str(tmp_path / "out")]) == 2
    assert "computed for other shapes than the scene has now" in capsys.readouterr().err
    other.write_text(FILE.replace("exponent = 16", "exponent = 20"))
    assert main(["relight", store, str(other), "-o", str(tmp_path / "out")]) == 2
    assert "computed for other materials than the scene has now" in capsys.readouterr().err
    other.write_text(FILE[: FILE.index("[[lights]]")])
    assert main(["relight", store, str(other), "-o", str(tmp_path / "out")]) == 2
    assert "no light; --environment FILE brings some" in capsys.readouterr().err
    assert main(["relight", str(tmp_path), str(other), "-o", str(tmp_path / "out")]) == 2
    assert "not a store of transfer" in capsys.readouterr().err
