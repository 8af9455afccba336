"""Tables written and read back; what is damaged or foreign is refused."""

import json
import shutil

import jax
import numpy as np
import pytest

import diffopt as do
from diffopt import stores
from reference import directions

WAVELENGTHS = np.array([0.42, 0.5, 0.61])


@pytest.fixture(scope="module")
def job():
    rng = np.random.default_rng(5)
    return directions(rng, 30), directions(rng, 30)


@pytest.fixture(scope="module")
def prepared(job):
    scan = do.samples.compact_disc(jax.random.key(1), shape=(64, 64), pixel=0.1)
    brdf = do.DiffractionBRDF(
        do.Heightfield(scan.heights, scan.pixel),
        0.6,
        fresnel=do.fresnel.Schlick(0.04),
        shadowing="v-cavity",
    )
    return brdf.prepare(pairs=job, output="xyz", tolerance=1e-2, method="table")


@pytest.fixture
def saved(prepared, tmp_path):
    prepared.save(tmp_path / "disc.zarr", scan="disc of a test")
    return tmp_path / "disc.zarr"


def test_a_saved_table_gives_the_same_values_without_the_model(prepared, saved, job):
    baked = do.load_table(saved)
    np.testing.assert_array_equal(baked(*job), prepared(*job))
    record = baked.record
    assert record["scan"] == "disc of a test"
    assert record["output"] == "xyz"
    assert record["error_bound"] == prepared.choice.error_bound <= 1e-2
    assert len(record["wavelengths_um"]) == 81
    assert "0.04" in record["fresnel"]
    assert record["heights"]["shape"] == [64, 64]
    assert len(record["heights"]["sha256"]) == 64


def test_saving_again_replaces_and_leaves_nothing_aside(prepared, saved, job):
    prepared.save(saved, scan="second")
    assert do.load_table(saved).record["scan"] == "second"
    assert [p.name for p in saved.parent.iterdir()] == ["disc.zarr"]


def test_a_failed_save_leaves_the_old_table(prepared, saved, monkeypatch):
    monkeypatch.setattr(stores.os, "rename", _refuse)
    with pytest.raises(OSError, match="no room"):
        prepared.save(saved, scan="third")
    monkeypatch.undo()
    assert do.load_table(saved).record["scan"] == "disc of a test"
    assert [p.name for p in saved.parent.iterdir()] == ["disc.zarr"]
    with pytest.raises(TypeError, match="JSON"):
        prepared.save(saved, scan=object())
    assert do.load_table(saved).record["scan"] == "disc of a test"


def _refuse(*_):
    raise OSError("no room")


def test_a_chunk_that_is_missing_is_noticed(saved):
    chunks = sorted(p for p in (saved / "coefficients").rglob("*") if p.is_file())
    chunks = [p for p in chunks if p.name != "zarr.json"]
    chunks[0].unlink()
    with pytest.raises(do.InputError, match=r"chunks of coefficients are missing: bake the table"):
        do.load_table(saved)


def test_a_damaged_chunk_is_noticed(saved):
    chunk = next(
        p for p in (saved / "coefficients").rglob("*") if p.is_file() and p.name != "zarr.json"
    )
    chunk.write_bytes(chunk.read_bytes()[:40])
    with pytest.raises(do.InputError, match=r"damaged: .*; bake the table again"):
        do.load_table(saved)


def test_foreign_folders_are_refused(saved, tmp_path):
    with pytest.raises(do.InputError, match="no such folder; expected the folder of a saved table"):
        do.load_table(tmp_path / "nothing.zarr")
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(do.InputError, match="empty: not a saved table"):
        do.load_table(empty)
    for key, value, words in (
        ("format", "other", "expected a diffopt table, found 'other'"),
        ("version", 9, "written as version 9; this program reads 1"),
    ):
        copy = tmp_path / key
        shutil.copytree(saved, copy)
        content = json.loads((copy / "zarr.json").read_text())
        content["attributes"][key] = value
        (copy / "zarr.json").write_text(json.dumps(content))
        with pytest.raises(do.InputError, match=words):
            do.load_table(copy)


def test_unusable_targets_are_refused(prepared, tmp_path):
    with pytest.raises(do.InputError, match="does not exist"):
        prepared.save(tmp_path / "none" / "t.zarr")
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "thesis.txt").write_text("irreplaceable")
    with pytest.raises(do.InputError, match="exists and is not a saved table"):
        prepared.save(tmp_path / "notes")
    assert (tmp_path / "notes" / "thesis.txt").exists()


def test_other_methods_have_nothing_to_save(job, tmp_path):
    scan = do.samples.flat(shape=(16, 16), pixel=0.1)
    fast = do.DiffractionBRDF(scan, 0.4).prepare(
        pairs=job, wavelengths=WAVELENGTHS, method="direct", tolerance=1e-2
    )
    with pytest.raises(do.InputError, match="method 'direct' has no table to save"):
        fast.save(tmp_path / "t.zarr")


def test_outside_the_table_is_an_error(saved):
    baked = do.load_table(saved)
    grazing = np.array([np.sin(1.5), 0.0, np.cos(1.5)])
    with pytest.raises(do.InputError, match="pairs outside the table"):
        baked(grazing, grazing)
    with pytest.raises(do.InputError, match="received shape"):
        baked(np.zeros(2), grazing)
