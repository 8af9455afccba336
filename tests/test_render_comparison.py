"""Levels against a reference, throughput: rows, files, refusals; and scenes for Mitsuba."""

import csv
import dataclasses
import importlib.util

import numpy as np
import pytest

from diffopt import scenes
from diffopt.accuracy import (
    benchmarks,
    mitsuba_process,
    mitsuba_scenes,
    render_comparison,
    render_scenes,
    render_throughput,
)
from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.materials import Lambert, OrenNayar
from diffopt.rendering import RecursiveSettings
from diffopt.scenes import raycasting, shapes

pytestmark = pytest.mark.float32

SIZE = (24, 18)
# Passes have 16 paths at most: one program serves all of these.
SPP = (16, 64)
NAMES = ["box", "points"]
NEEDS_MITSUBA = pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="needs Mitsuba"
)


@pytest.fixture(scope="module")
def found():
    return render_comparison.compare(
        NAMES, ["path"], spp=SPP, reference=256, resolution=SIZE, repeats=1
    )


def test_rows_are_complete(found):
    ways = ["path 16", "path 64"]
    assert [(row.scene, row.level) for row in found.rows] == [(n, w) for n in NAMES for w in ways]
    for row in found.rows:
        assert row.run_s > 0.0
        assert row.compile_s >= 0.0
        assert abs(row.bias) <= row.error
        assert 0.0 < row.reference_noise < 0.2
        assert row.scene in str(found)


def test_paths_come_nearer_the_more_there_are(found):
    rows = {(row.scene, row.level): row for row in found.rows}
    for name in NAMES:
        few, many = rows[name, "path 16"], rows[name, "path 64"]
        # Half the noise, beside that of the reference: a factor of 1.8, known to some 10 %.
        assert many.error < 0.75 * few.error
        # The bias is noise: some hundred pixels and more average it.
        assert abs(many.bias) < 0.5 * many.error


def test_levels_have_their_settings():
    derived = render_comparison.settings("recursive, derived")["recursive, derived"]
    assert isinstance(derived, RecursiveSettings)
    assert derived.ambient == "derived"
    assert list(render_comparison.settings("path", (2, 8))) == ["path 2", "path 8"]


def test_files(found, tmp_path, capsys, monkeypatch):
    asked = {}

    def compare(names, levels, **options):
        asked.update(names=names, levels=levels, **options)
        return found

    monkeypatch.setattr(render_comparison, "compare", compare)
    out = tmp_path / "out"
    assert main(["compare", "rendering", "map", "--spp", "2,8", "--quick", "-o", str(out)]) == 0
    assert asked["names"] == ["map"]
    assert asked["spp"] == [2, 8]
    assert asked["resolution"] == (32, 24)
    assert "path 64" in capsys.readouterr().out
    with (out / "rendering.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["error"]) for row in rows] == [row.error for row in found.rows]
    for name in ("rendering.png", "pictures.png"):
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_the_plot_has_a_panel_for_each_scene(found):
    figure = found.plot()
    assert [axes.get_title() for axes in figure.axes] == NAMES
    assert len(found.sheet().axes) == len(NAMES) * 3


def test_refusals():
    with pytest.raises(InputError, match=r"scene must be one of box, glass, .*received 'cornell'"):
        render_comparison.compare(["cornell"])
    with pytest.raises(InputError, match=r"level must be one of incremental, .*received 'rays'"):
        render_comparison.compare(["box"], ["rays"])
    with pytest.raises(InputError, match="repeats must be at least 1; received 0"):
        render_comparison.compare(repeats=0)
    with pytest.raises(InputError, match="spp must be a whole number"):
        render_comparison.compare(["box"], spp=[0])


def test_refusals_of_the_command(capsys):
    assert main(["compare", "rendering", "--spp", "1.5"]) != 0
    assert "--spp must be whole numbers" in capsys.readouterr().err
    assert main(["compare", "rendering", "cornell"]) != 0
    assert "cornell" in capsys.readouterr().err


@pytest.mark.long
def test_throughput(monkeypatch):
    monkeypatch.setattr(render_scenes, "TIMED", {"box": render_scenes.TIMED["box"]})
    monkeypatch.setattr(render_throughput, "SIZES", {"small": SIZE})
    # Without Mitsuba: its processes have a test of their own.
    monkeypatch.setattr(mitsuba_process, "variants", lambda: ())
    found = benchmarks.run(["render.rays", "render.paths"], repeats=1)
    names = ["render.rays/box, embree", "render.rays/box, jax", "render.paths/box"]
    assert [result.name for result in found] == names
    for result in found:
        assert result.run_s > 0.0
        assert "per second" in result.note
        assert result.flops is None


def test_the_bumpy_ball_is_closed():
    ball = render_scenes.bumpy_ball(12)
    assert shapes.is_closed(ball)
    assert len(ball.faces) == 2 * 12 * 11
    # Outward, as is what is seen of it.
    assert ((ball.vertices * ball.normals).sum(-1) > 0.0).all()


def test_what_mitsuba_is_not_given():
    camera = scenes.Camera()
    ball = scenes.Object(scenes.Sphere(), OrenNayar())
    with pytest.raises(InputError, match="OrenNayar: not given to Mitsuba"):
        mitsuba_scenes.describe(scenes.Scene([ball]), camera)
    with pytest.raises(InputError, match="Directional: not given to Mitsuba"):
        mitsuba_scenes.describe(scenes.Scene([], [scenes.Directional()]), camera)


def theirs(scene, camera, spp):
    described = mitsuba_scenes.describe(scene, camera, spp=spp)
    renderer = mitsuba_process.Renderer(described, mitsuba_process.VARIANTS[0])
    mean = renderer()
    renderer.close()
    return mean


@NEEDS_MITSUBA
def test_mitsuba_renders_the_same_box(found):
    scene, camera = render_scenes.compared("box")
    image = found.pictures["box"][""]
    mean = theirs(scene, dataclasses.replace(camera, resolution=SIZE), 256)
    deviation = np.sqrt((image.error**2).sum()) / image.error.size
    # As many paths: twice the variance. The channels of a path are noisy together: threefold.
    assert mean == pytest.approx(image.radiance.mean(), abs=4.0 * np.sqrt(6.0) * deviation)


@NEEDS_MITSUBA
def test_mitsuba_sees_the_same_mesh():
    """One that glows and reflects nothing: the picture is what it covers."""
    place = scenes.translate(0.4, 0.0, 0.2) @ scenes.rotate((1, 0, 0), 30.0)
    ball = scenes.Object(render_scenes.bumpy_ball(40), Lambert(0.0), place, emission=1.0)
    scene, camera = scenes.Scene([ball]), scenes.Camera(resolution=SIZE)
    fine = dataclasses.replace(camera, resolution=(8 * SIZE[0], 8 * SIZE[1]))
    hits = raycasting.Caster(scene.geometry).first(*fine.rays(np.arange(64 * SIZE[0] * SIZE[1])))
    # Some 400 of 27,648 rays are at the rim: each a coin of size 1 / 27,648, on both sides.
    assert theirs(scene, camera, 64) == pytest.approx((hits.primitive >= 0).mean(), abs=4e-3)
