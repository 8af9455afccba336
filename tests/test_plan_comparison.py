"""Plans over scenes, and ladders of levels: rows, files, refusals; and the scenes themselves."""

import csv
import dataclasses

import pytest

from diffopt import planning
from diffopt.accuracy import plan_comparison, plan_ladders, plan_scenes, plan_scenes_more
from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.rendering import IncrementalSettings, PathSettings
from diffopt.rendering.stage import Stage

pytestmark = pytest.mark.float32

SIZE = (32, 24)
NAMES = ["sunlit-card", "two-walls"]
FEW = 16
# Of what a plan leaves out, 16 paths a pixel measure little: far from the tolerance it is clear.
TOLERANCE = 0.1
WAYS = {"incremental": IncrementalSettings(), "path 16": PathSettings(spp=FEW)}


@pytest.fixture(scope="module")
def found():
    return plan_comparison.compare(
        NAMES, tolerance=TOLERANCE, resolution=SIZE, most_spp=FEW, paths=FEW
    )


@pytest.fixture(scope="module")
def climbed():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan_ladders, "STEPS", WAYS)
        return plan_ladders.climb(
            NAMES, tolerances=(TOLERANCE,), reference=64, resolution=SIZE, most_spp=FEW
        )


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_rows_are_complete(found):
    assert [row.scene for row in found.rows] == NAMES
    for row in found.rows:
        assert row.tolerance == TOLERANCE
        effects = row.included + row.excluded
        assert set(effects) <= set(planning.EFFECTS)
        assert len(set(effects)) == len(effects)
        assert "matte-light" in row.included
        assert set(row.needless) <= set(row.included)
        assert bool(row.worst_effect) == bool(row.excluded)
        assert 0.0 <= row.bound <= TOLERANCE
        assert min(row.plan_s, row.planned_s, row.everything_s) > 0.0
        assert row.scene in str(found)


def test_nothing_exceeds_the_tolerance(found):
    assert found.exceeded == ()
    assert 0.0 <= found.needless <= 1.0
    assert "Exceeded: nowhere" in str(found)


def test_what_exceeds_is_told(found):
    beyond = dataclasses.replace(found.rows[1], together=2.0 * TOLERANCE)
    other = plan_comparison.Comparison((found.rows[0], beyond))
    assert other.exceeded == ("two-walls",)
    assert "Exceeded: two-walls" in str(other)


def test_without_pictures_there_are_no_times():
    (row,) = plan_comparison.compare(
        NAMES[:1], tolerance=TOLERANCE, resolution=SIZE, most_spp=FEW, paths=FEW, render=False
    ).rows
    assert row.planned_s == row.everything_s == 0.0
    assert row.plan_s > 0.0


def test_steps_are_complete(climbed):
    ways = [*WAYS, f"plan {TOLERANCE:g}"]
    assert [(step.scene, step.way) for step in climbed.steps] == [
        (name, way) for name in NAMES for way in ways
    ]
    for step in climbed.steps:
        planned = step.way.startswith("plan")
        assert step.run_s > 0.0
        assert step.error >= 0.0
        assert step.reference_noise >= 0.0
        assert planned == (step.tolerance is not None) == (step.predicted is not None)
        assert planned == (step.plan_s > 0.0) == ("matte-light" in step.effects)
        if step.predicted is not None:
            # 16 paths a pixel may promise more than the tolerance, and say so; a half more is
            # for the noise of the promise and of the mean over few pixels.
            assert step.error <= 1.5 * max(step.predicted, TOLERANCE) + step.reference_noise
    assert [axes.get_title() for axes in climbed.plot().axes] == NAMES


def test_files(found, climbed, tmp_path, capsys, monkeypatch):
    asked = {}

    def compare(names, **options):
        asked["plans"] = {"names": names, **options}
        return found

    def climb(names, **options):
        asked["ladders"] = {"names": names, **options}
        return climbed

    monkeypatch.setattr(plan_comparison, "compare", compare)
    monkeypatch.setattr(plan_ladders, "climb", climb)
    out = tmp_path / "out"
    words = ["compare", "plans", "--quick", "--ladders", "--no-render", "-o", str(out)]
    assert main([*words, "--tolerance", "0.1"]) == 0
    for each in asked.values():
        assert each["names"] == NAMES
        assert each["resolution"] == SIZE
        assert each["most_spp"] == 32
    assert asked["plans"]["tolerance"] == 0.1
    assert asked["plans"]["paths"] == 32
    assert asked["plans"]["render"] is False
    printed = capsys.readouterr().out
    assert "Exceeded: nowhere" in printed
    assert "path 16" in printed
    read = rows(out / "plans.csv")
    assert [row["scene"] for row in read] == NAMES
    assert [tuple(row["included"].split()) for row in read] == [row.included for row in found.rows]
    assert [float(row["together"]) for row in read] == [row.together for row in found.rows]
    read = rows(out / "ladders.csv")
    assert [float(row["error"]) for row in read] == [step.error for step in climbed.steps]
    assert (out / "ladders.png").read_bytes().startswith(b"\x89PNG")


def test_defaults_of_the_command(found, climbed, tmp_path, monkeypatch):
    asked = []

    def compare(names, **options):
        asked.append((names, options))
        return found

    monkeypatch.setattr(plan_comparison, "compare", compare)
    monkeypatch.setattr(plan_ladders, "climb", None)
    out = tmp_path / "out"
    assert main(["compare", "plans", "cornell", "--size", "40x30", "-o", str(out)]) == 0
    ((names, options),) = asked
    assert names == ["cornell"]
    assert options["resolution"] == (40, 30)
    assert options["render"] is True
    # Those of `compare` and `climb`, which differ.
    assert "most_spp" not in options
    assert [path.name for path in out.iterdir()] == ["plans.csv"]


def test_refusals():
    with pytest.raises(InputError, match=r"scene must be one of sunlit-card, .*received 'box'"):
        plan_comparison.compare(["box"])
    with pytest.raises(InputError, match=r"scene must be one of sunlit-card, .*received 'box'"):
        plan_ladders.climb(["box"])
    with pytest.raises(InputError, match="triangles must be at least 18; received 4"):
        plan_scenes.large(4)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        # A known name first: nothing is planned before all names are known.
        (["cornell", "box"], "SCENE must be one of sunlit-card, card-in-a-sky, "),
        (["cornell", "box"], "received 'box'"),
        (["--tolerance", "0"], "--tolerance must be above 0 and at most 1; received 0"),
        (["--tolerance", "nan"], "--tolerance must be above 0 and at most 1; received nan"),
        (["--most-spp", "0"], "--most-spp must be a whole number from 1"),
        (["--paths", "0"], "--paths must be a whole number from 1"),
        (["--size", "96"], "--size must be WxH"),
    ],
)
def test_refusals_of_the_command(words, said, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(plan_comparison, "compare", None)
    out = tmp_path / "out"
    assert main(["compare", "plans", *words, "-o", str(out)]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not out.exists()


@pytest.mark.long
def test_there_are_many_scenes_and_all_can_be_made(monkeypatch):
    # For few directions no tables are baked, which would take most of the time.
    monkeypatch.setattr(plan_scenes_more, "_PAIRS", 20_000)
    plan_scenes_more._diffracting.cache_clear()
    assert len(plan_scenes.SCENES) >= 24
    assert set(plan_ladders.SHOWN) <= set(plan_scenes.SCENES)
    for name in plan_scenes.SCENES:
        scene, camera = plan_scenes.planned(name)
        stage = Stage(scene)
        assert set(stage.owner) == set(range(len(scene.objects))), name
        assert stage.groups, name
        assert min(camera.resolution) > 0, name
    plan_scenes_more._diffracting.cache_clear()


@pytest.mark.long
def test_the_large_scene_plans():
    scene, camera = plan_scenes.large(2000)
    camera = dataclasses.replace(camera, resolution=SIZE)
    plan = planning.plan(scene, camera, TOLERANCE, most_spp=FEW)
    inside = {row.effect for row in plan.rows if row.included}
    # A ball of glass fills a tenth of the picture, and the bumpy one shadows the floor.
    assert {"matte-light", "refraction", "soft-shadows"} <= inside
    assert plan.bias <= TOLERANCE
