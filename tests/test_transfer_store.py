"""Stores of precomputed transfer: what is read back, what a kill leaves, what is refused."""

import csv
import dataclasses
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

import diffopt as do
from diffopt.cli import main
from diffopt.errors import InputError
from diffopt.locking import Lock
from diffopt.materials import BlinnPhong, Lambert
from diffopt.scenes import Object, Scene
from diffopt.transfer import precomputation as precomputing
from diffopt.transfer import references, slices, store, working
from diffopt.transfer.compression import CompressionSettings
from diffopt.transfer.precomputation import precompute
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.views import hemisphere
from diffopt.transfer.working import Working

# As the other tests of transfer have it, so that they share programs.
SETTINGS = TransferSettings(rays=256, finest=2, splits=1, tolerance=0.4)

FILE = """
[camera]
eye = [0, -5, 2]
target = [0, 0, 0]
resolution = [32, 32]
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
kind = "area"
width = 1
height = 1
radiance = 5
facing = { origin = [2, 0, 6], target = [0, 0, 0] }
"""
WORDS = ["--rays", "256", "--finest", "2", "--splits", "1", "--tolerance", "0.4"]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ring.toml"
    path.write_text(FILE)
    return path


@pytest.fixture(scope="module")
def scene(file):
    """A ring, which hides parts of itself, without the lamp."""
    found = do.scenes.load_scene(file).scene
    return Scene([one for one in found.objects if one.emission is None])


@pytest.fixture(scope="module")
def transfer(scene):
    return precompute(scene, SETTINGS)


@pytest.fixture(scope="module")
def finished(transfer, tmp_path_factory):
    path = tmp_path_factory.mktemp("finished") / "ring.zarr"
    store.save(path, transfer, {"scene": "ring"}, CompressionSettings(0))
    return path


def arrays(transfer):
    """All arrays by name."""
    out = {}
    for name in ("axes", "reflector", "level", "first", "error", "unoccluded"):
        out[name] = getattr(transfer, name)
    for field in dataclasses.fields(transfer.mesh):
        out[f"mesh {field.name}"] = np.asarray(getattr(transfer.mesh, field.name))
    for name in ("views", "diffuse"):
        for part, values in zip(Slices._fields, getattr(transfer, name), strict=True):
            out[f"{name} {part}"] = np.asarray(values)
    return out


def same(one, other):
    first, second = arrays(one), arrays(other)
    assert first.keys() == second.keys()
    for name, values in first.items():
        assert values.dtype == second[name].dtype, name
        np.testing.assert_array_equal(values, second[name], err_msg=name)


def test_what_is_stored_exactly_is_read_back(transfer, finished):
    found = store.load(finished)
    same(found, transfer)
    assert found.settings == transfer.settings
    assert found.rounds == transfer.rounds
    assert sorted(path.name for path in finished.iterdir()) == ["transfer", "zarr.json"]
    record = store.record_of(finished)
    assert record["scene"] == "ring"
    assert record["diffopt"] == do.__version__
    assert record["vertices"] == {
        "initial": transfer.mesh.initial,
        "final": len(transfer.axes),
    }
    assert record["paths"] == ["direct", "indirect diffuse", "indirect glossy"]
    assert [one["vertices"] for one in record["rounds"]][-1] == len(transfer.axes)
    assert {"units", "date", "settings", "slices"} <= record.keys()


def absolute(transfer):
    """Slices of views as they are, by the references that relighting uses."""
    counts = np.array((*hemisphere(SETTINGS.finest).counts, 0))
    length = counts[transfer.level]
    vertex = np.repeat(np.arange(len(length)), length)
    view = np.arange(len(vertex)) - np.repeat(np.cumsum(length) - length, length)
    rows = transfer.first[vertex] + view
    over = references.unpacked(
        jnp.asarray(transfer.unoccluded[transfer.reflector[vertex], view]), transfer.lobes
    )
    held = Slices(*(jnp.asarray(a[rows]) for a in transfer.views))
    return references.absolute(held, over)


@pytest.mark.parametrize("tolerance", but({0.03}, [0.003, 0.03]))
def test_compression_is_within_its_stated_error(transfer, finished, tmp_path, tolerance):
    path = tmp_path / "small.zarr"
    stated = store.save(path, transfer, {}, CompressionSettings(tolerance))["compression"]
    found = store.load(path)
    # The distance of the lobes in the frame of the vertex, not of what is relative to others.
    one, other = absolute(transfer), absolute(found)
    squares = np.asarray(slices.squared_distance(one, other), float)
    apart = np.sqrt(np.maximum(squares, 0.0)) / np.sqrt(slices.squared_norm(one).mean())
    errors = stated["errors"]["views"]
    # Distances of float32 lobes are known to some 1e-4 of their norm.
    assert errors["rms"] <= tolerance
    assert np.sqrt((apart**2).mean()) == pytest.approx(errors["rms"], abs=3e-4)
    assert apart.max() == pytest.approx(errors["largest"], abs=1e-3)
    assert errors["rms"] <= errors["percentile_99"] <= errors["largest"] < 4.0 * tolerance
    # Not better than asked for: bytes would be wasted.
    assert errors["rms"] > 0.25 * tolerance
    # Names and mesh aside; of so few slices not many are the same.
    held = [
        sum(f.stat().st_size for f in p.glob("transfer/views_*/c/**/*") if f.is_file())
        for p in (path, finished)
    ]
    assert held[0] < 0.3 * held[1]
    # No weight is off by more than half a step, of at most twice the tolerance.
    assert errors["even"] < tolerance
    near, far = (np.asarray(s.alpha, float).mean(-1).sum((1, 2)) for s in (one, other))
    even = np.sqrt(((far - near) ** 2).mean() / (near**2).mean())
    assert even == pytest.approx(errors["even"], abs=1e-4)
    for name in ("level", "first", "reflector", "error"):
        np.testing.assert_array_equal(getattr(found, name), getattr(transfer, name))
    np.testing.assert_allclose(found.axes, transfer.axes, atol=1e-6)


@pytest.mark.long
def test_what_sees_nothing_of_itself_is_not_changed(tmp_path):
    """Unoccluded slices stand on the grid, however coarse it is."""
    settings = dataclasses.replace(SETTINGS, splits=0)
    plane = Object(do.scenes.Plane(2.0, 2.0), BlinnPhong(0.5, 16.0))
    found = precompute(Scene([plane]), settings)
    stated = store.save(tmp_path / "plane.zarr", found, {}, CompressionSettings(0.3))
    # Sums over the rays in float32 are off by some 1e-6, the root of a distance by 1e-3.
    assert stated["compression"]["errors"]["views"]["largest"] < 1e-3
    again = store.load(tmp_path / "plane.zarr")
    direct = np.asarray(again.views.alpha)[:, 0]
    np.testing.assert_array_equal(direct, 1.0)
    np.testing.assert_allclose(again.views.mu[:, 0], found.views.mu[:, 0], atol=1e-5)
    np.testing.assert_allclose(again.views.kappa[:, 0], found.views.kappa[:, 0], rtol=1e-5)
    np.testing.assert_array_equal(np.asarray(again.views.alpha)[:, 1:], 0.0)


def test_sharing_changes_bytes_only(transfer, tmp_path):
    one, other = tmp_path / "one.zarr", tmp_path / "other.zarr"
    store.save(one, transfer, {}, CompressionSettings(0.02))
    store.save(other, transfer, {}, CompressionSettings(0.02, shared=False))
    same(store.load(one), store.load(other))


@pytest.mark.long
def test_colours_lobes_and_matte_surfaces(tmp_path):
    """Two lobes in three channels beside a surface that has no views; and nothing but that."""
    floor = Object(do.scenes.Plane(4.0, 4.0), Lambert((0.8, 0.4, 0.1)))
    turned = np.array([[0, 0, 1, -1], [0, 1, 0, 0], [-1, 0, 0, 0.5], [0, 0, 0, 1]], float)
    wall = Object(do.scenes.Plane(1.0, 1.0), BlinnPhong((0.2, 0.5, 0.9), 8.0), turned)
    settings = dataclasses.replace(SETTINGS, splits=0, lobes=2, finest=1)
    for objects in ([floor, wall], [floor]):
        found = precompute(Scene(objects), settings)
        assert found.channels == 3
        assert set(np.unique(found.level)) == ({-1, 1} if len(objects) == 2 else {-1})
        exact, small = tmp_path / f"{len(objects)}.zarr", tmp_path / f"{len(objects)} small.zarr"
        store.save(exact, found, {}, CompressionSettings(0))
        same(store.load(exact), found)
        stated = store.save(small, found, {}, CompressionSettings(0.01))["compression"]["errors"]
        again = store.load(small)
        for name in ("views", "diffuse"):
            assert stated[name]["rms"] <= 0.01
            assert stated[name]["largest"] < 0.05
            # Half a step for each weight, of two hundredths of the mean at most.
            assert stated[name]["even"] < 0.01
            alpha, near = getattr(found, name).alpha, getattr(again, name).alpha
            assert alpha.shape == near.shape
            assert np.isfinite(near).all()


def test_batches_make_the_same_result(scene, transfer, tmp_path):
    path = store.begin(tmp_path / "ring.zarr")
    with Working(path, scene, SETTINGS) as batches:
        same(precompute(scene, SETTINGS, batches=batches, threads=2), transfer)
        count = batches.kept
        assert count >= 3
    assert store.state(path) == "begun"
    with pytest.raises(InputError, match="begun, but not finished"):
        store.load(path)
    computed = []
    with Working(path, scene, SETTINGS) as batches:
        assert batches.kept == count
        # One is cut short and one changed, as when a machine loses its power.
        names = sorted(batches.folder.glob("*.npz"))
        names[0].write_bytes(names[0].read_bytes()[:-100])
        changed = bytearray(names[1].read_bytes())
        changed[len(changed) // 2] ^= 1
        names[1].write_bytes(changed)
        save = batches.save
        batches.save = lambda number, batch: (computed.append(number), save(number, batch))[1]
        again = precompute(scene, SETTINGS, batches=batches, threads=1)
        assert computed == [0, 1]
        record = store.finish(batches, again, {"scene": "ring"}, CompressionSettings(0))
    same(store.load(path), transfer)
    assert store.state(path) == "finished"
    assert sorted(each.name for each in path.iterdir()) == ["transfer", "zarr.json"]
    # The first run's time counts too.
    assert record["seconds"] > 0.0
    assert record["core_seconds"] > 0.0
    assert not working.differences(record["identity"], working.identity(scene, SETTINGS))


KILLED = """
    import os, signal, sys
    import jax
    jax.config.update("jax_enable_x64", sys.argv[3] == "1")
    import diffopt as do
    from diffopt.scenes import Scene
    from diffopt.transfer import store
    from diffopt.transfer.precomputation import precompute
    from diffopt.transfer.settings import TransferSettings
    from diffopt.transfer.working import Working

    settings = TransferSettings(rays=256, finest=2, splits=1, tolerance=0.4)
    found = do.scenes.load_scene(sys.argv[1]).scene
    scene = Scene([one for one in found.objects if one.emission is None])
    batches = Working(store.begin(sys.argv[2]), scene, settings)
    save = batches.save

    def last(number, batch):
        save(number, batch)
        if number == 3:
            # One more is being written.
            (batches.folder / ".0000004.npz.abc").write_bytes(b"PK")
            os.kill(os.getpid(), signal.SIGKILL)

    batches.save = last
    precompute(scene, settings, batches=batches, threads=2)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
@pytest.mark.long
def test_a_killed_run_goes_on_to_the_same_bits(scene, transfer, file, tmp_path):
    path = tmp_path / "ring.zarr"
    wide = "1" if jnp.ones(()).dtype == jnp.float64 else "0"
    words = [sys.executable, "-c", textwrap.dedent(KILLED), str(file), str(path), wide]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert store.state(path) == "begun"
    assert (path / "working" / "lock").is_file()
    with Working(path, scene, SETTINGS) as batches:
        assert batches.kept >= 2  # of two threads, the last need not have all before it
        assert not list(batches.folder.glob(".*"))
        same(precompute(scene, SETTINGS, batches=batches), transfer)


def test_batches_of_something_else_are_refused(scene, tmp_path):
    path = store.begin(tmp_path / "ring.zarr")
    with Working(path, scene, SETTINGS) as batches:
        (batches.folder / "0000000.npz").write_bytes(b"a batch")
    other = dataclasses.replace(SETTINGS, tolerance=0.2)
    with pytest.raises(InputError, match=r"other settings: tolerance 0.4 there, 0.2 here$"):
        Working(path, scene, other)
    ring = scene.objects[0]
    matte = Object(ring.place.shape, Lambert(0.5))
    with pytest.raises(InputError, match=r"other materials$"):
        Working(path, Scene([matte]), SETTINGS)
    moved = np.eye(4)
    moved[0, 3] = 1.0
    with pytest.raises(InputError, match="other shapes"):
        Working(path, Scene([Object(ring.place.shape, ring.material, moved)]), SETTINGS)
    # Neither attempt left its lock behind; asked for, the batches go.
    with Working(path, scene, other, afresh=True) as batches:
        assert batches.kept == 0
    with Working(path, scene, other):
        pass


def test_exponents_colours_and_lights_in_the_identity(scene):
    ring = scene.objects[0]

    def of(material, lights=()):
        return working.identity(Scene([Object(ring.place.shape, material)], lights), SETTINGS)

    one = of(BlinnPhong(0.5, 16.0))
    assert of(BlinnPhong(0.5, 16.0)) == one
    assert of(BlinnPhong(0.5, 16.0), [do.scenes.Ambient(1.0)]) == one
    assert of(BlinnPhong(0.5, 17.0)) != one
    assert of(BlinnPhong(0.4, 16.0)) != one


def test_a_second_process_is_refused_and_a_dead_one_forgotten(scene, tmp_path):
    path = store.begin(tmp_path / "ring.zarr")
    with (
        Working(path, scene, SETTINGS) as batches,
        pytest.raises(InputError, match=rf"process {os.getpid()} on .* is at work on it"),
    ):
        Working(path, scene, SETTINGS)
    assert not (batches.folder / "lock").exists()
    lock = tmp_path / "lock"
    held = Lock(lock, path)
    content = json.loads(lock.read_text())
    # A process that has ended: its number is free, or another's.
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    lock.write_text(json.dumps(content | {"pid": child.pid}))
    Lock(lock, path).release()
    assert not lock.exists()
    # What the first one holds no more it does not remove.
    newer = Lock(lock, path)
    held.release()
    assert lock.exists()
    newer.release()
    if content["began"]:
        lock.write_text(json.dumps(content | {"began": "earlier"}))
        Lock(lock, path).release()
    # Of another machine nothing is known.
    lock.write_text(json.dumps(content | {"host": "elsewhere", "pid": child.pid}))
    with pytest.raises(InputError, match="on elsewhere is at work"):
        Lock(lock, path)


def test_a_damaged_store_is_refused(finished, tmp_path):
    def copied(name):
        return Path(shutil.copytree(finished, tmp_path / name))

    with pytest.raises(InputError, match="no such folder"):
        store.load(tmp_path / "none.zarr")
    path = copied("bit.zarr")
    chunk = next(f for f in (path / "transfer" / "views_mu" / "c").rglob("*") if f.is_file())
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(data)
    with pytest.raises(InputError, match=r"damaged.*precompute it again"):
        store.load(path)
    chunk.unlink()
    with pytest.raises(InputError, match="chunks of views_mu are missing; precompute it again"):
        store.load(path)
    path = copied("array.zarr")
    shutil.rmtree(path / "transfer" / "vertex_level")
    with pytest.raises(InputError, match="damaged"):
        store.load(path)
    path = copied("newer.zarr")
    text = (path / "zarr.json").read_text()
    (path / "zarr.json").write_text(text.replace('"version": 1', '"version": 9'))
    with pytest.raises(InputError, match="version 9; this program reads 1"):
        store.load(path)
    (path / "zarr.json").write_text(text.replace("diffopt transfer", "a table"))
    with pytest.raises(InputError, match="expected a store of diffopt transfer, found 'a table'"):
        store.state(path)
    plain = tmp_path / "plain"
    plain.mkdir()
    with pytest.raises(InputError, match="exists and is not a store of transfer"):
        store.begin(plain)
    with pytest.raises(InputError, match=r"the folder .* does not exist"):
        store.begin(tmp_path / "no" / "ring.zarr")


def test_a_failed_save_leaves_the_old_transfer(transfer, finished, tmp_path, monkeypatch):
    path = Path(shutil.copytree(finished, tmp_path / "ring.zarr"))

    def fail(*arguments):
        raise OSError("no space left")

    with monkeypatch.context() as patched:
        patched.setattr(store.packing, "_write_rest", fail)
        with pytest.raises(OSError, match="no space"):
            store.save(path, transfer)
    same(store.load(path), transfer)
    store.save(path, transfer, {"scene": "second"})
    assert store.record_of(path)["scene"] == "second"
    assert sorted(each.name for each in path.iterdir()) == ["transfer", "zarr.json"]


def test_numbers_out_of_range_are_refused():
    for value in (-0.1, 1e-5, 0.6, float("nan")):
        with pytest.raises(InputError, match="tolerance must be 0 or from"):
            CompressionSettings(value)


def test_the_command_from_scene_to_store(file, transfer, tmp_path, capsys, monkeypatch, long):
    path, table = tmp_path / "ring.zarr", tmp_path / "ring.csv"
    words = ["precompute", str(file), "-o", str(path), *WORDS]

    # Interrupted after a batch.
    inner = precomputing._Run._computed
    seen = []

    def stopping(self, parts):
        for batch in inner(self, parts):
            yield batch
            seen.append(batch)
            if len(seen) == 1:
                raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(precomputing._Run, "_computed", stopping)
        assert main(words) == 130
    out, err = capsys.readouterr()
    assert "note: left out, as transfer is for light from infinity: " in out
    assert re.search(
        r"interrupted: 32 of \d+ vertices known so far are done; the same command", out
    )
    assert err == ""
    assert store.state(path) == "begun"
    assert main([*words, "--table", str(table), "--compression", "0.02"]) == 0
    out, err = capsys.readouterr()
    assert f"{path}: goes on from " in out
    assert err == ""
    lines = out.splitlines()
    row = next(line.split() for line in lines if line.startswith("ring, 16"))
    assert row[2:4] == [str(transfer.mesh.initial), str(len(transfer.axes))]
    assert "stored within" in out
    found = store.load(path)
    assert len(found.axes) == len(transfer.axes)
    with table.open() as text:
        (figures,) = csv.DictReader(text)
    assert int(figures["final"]) == len(transfer.axes)
    assert float(figures["megabytes"]) == pytest.approx(store.size(path) / 1e6)
    assert float(figures["frames"]) > 0.0
    # A finished store is left alone.
    before = store.record_of(path)
    assert main(words) == 0
    assert "finished already; --force computes it again" in capsys.readouterr().out
    assert store.record_of(path) == before
    assert main([*words, "--depth", "1"]) == 2
    assert "depth 2 there, 1 here; --force computes it again" in capsys.readouterr().err
    # Other settings are other programs, which are compiled by night alone.
    if long:
        words += ["--depth", "1"]
    assert main([*words, "--force", "--quiet"]) == 0
    assert capsys.readouterr().out == ""
    assert store.record_of(path)["settings"]["depth"] == (1 if long else 2)
    assert store.record_of(path) != before  # times among others


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["nothing"], "nothing: no such file, and not the name of an example"),
        (["teapot", "--rays", "3"], "--rays must be a whole number from 64 to 65536; received 3"),
        (["teapot", "--tolerance", "0"], "--tolerance must be above 0"),
        (["teapot", "--compression", "0.9"], "--compression must be 0 or from 1e-4 to 0.5"),
        (["teapot", "--threads", "0"], "--threads must lie between 1 and 256"),
        (["teapot", "--table", "figures.txt"], "--table figures.txt: expected a .csv"),
        (["lamp"], "object "),
    ],
)
def test_what_the_command_refuses(words, text, tmp_path, capsys):
    path = tmp_path / "out.zarr"
    assert main(["precompute", *words, "-o", str(path)]) == 2
    assert text in capsys.readouterr().err
    assert not path.exists()


def test_the_command_refuses_folders(file, tmp_path, capsys):
    assert main(["precompute", str(file), "-o", str(tmp_path / "no" / "a.zarr")]) == 2
    assert "no does not exist" in capsys.readouterr().err
    (tmp_path / "kept").mkdir()
    assert main(["precompute", str(file), "-o", str(tmp_path / "kept"), "--force"]) == 2
    assert "exists and is not a store of transfer" in capsys.readouterr().err
