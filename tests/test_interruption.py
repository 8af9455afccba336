"""Kills, full disks, disks that cannot be written to, two processes on one store."""

import contextlib
import dataclasses
import errno
import functools
import io
import json
import os
import shutil
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
from killing import Child, Frozen, Killed, as_another, content, fresh, many
from test_transfer_store import FILE, WORDS, same
from test_transfer_store import SETTINGS as RING

import diffopt as do
from diffopt import gratings
from diffopt.accuracy import keeping as rows_keeping
from diffopt.accuracy import studies
from diffopt.accuracy.studies import Case, Job, Study
from diffopt.cli import main
from diffopt.cli.output import folder
from diffopt.errors import InputError
from diffopt.io.files import replacing
from diffopt.materials import BlinnPhong
from diffopt.rendering import keeping
from diffopt.scenes import Object, Scene
from diffopt.transfer import store
from diffopt.transfer.compression import CompressionSettings
from diffopt.transfer.precomputation import precompute
from diffopt.transfer.working import Working

LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Linux only")
# The programs of another test.
SETTINGS = dataclasses.replace(RING, splits=0)
EXACT = CompressionSettings(0)


@pytest.fixture(scope="module")
def scene():
    return Scene([Object(do.scenes.Plane(2.0, 2.0), BlinnPhong(0.5, 16.0))])


class Memory(dict):
    """Batches of a run, and at which of them it was given its result."""

    load = dict.get
    save = dict.__setitem__


@pytest.fixture(scope="module")
def batches():
    return Memory()


@pytest.fixture(scope="module")
def transfer(scene, batches):
    return precompute(scene, SETTINGS, batches=batches)


def full():
    return OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def crashed(monkeypatch, frozen, work, *arguments):
    """Work until it is killed, as by a process that is gone then."""
    with monkeypatch.context() as patched, frozen:
        as_another(patched)
        with contextlib.suppress(Killed):
            work(*arguments)
    fresh()
    return frozen


def loaded(path):
    """Transfer of a store, or None where it says in one line that there is none."""
    try:
        if store.state(path) != "finished":
            return None
    except InputError:
        return None
    return store.load(path)


def names(path):
    return sorted(one.name for one in path.iterdir())


def computed(path, scene, transfer, batches):
    """What `diffopt precompute` does to a folder; gives the batches that were not there."""
    made = []
    with Working(store.begin(path), scene, SETTINGS) as kept:
        for number, batch in sorted(batches.items()):
            if kept.load(number) is None:
                made.append(number)
                kept.save(number, batch)
        store.finish(kept, transfer, settings=EXACT)
    return made


def test_a_store_killed_at_any_operation(scene, transfer, batches, tmp_path, monkeypatch, long):
    """From nothing to the finished store, every change of the folder being the last one."""
    job = scene, transfer, batches
    with Frozen(tmp_path) as counted:
        computed(tmp_path / "whole.zarr", *job)
    expected, result = content(tmp_path / "whole.zarr"), store.load(tmp_path / "whole.zarr")
    begun = finished = 0
    for number in counted.points(long):
        at = tmp_path / f"{number}"
        at.mkdir()
        path = at / "a.zarr"
        crashed(monkeypatch, Frozen(at, number), computed, path, *job)
        found = loaded(path)
        before = {int(one.stem) for one in path.glob("working/[0-9]*.npz")}
        if found is None:
            begun += path.exists()
            # No batch that was kept is made again.
            assert computed(path, *job) == sorted({*batches} - before)
        else:
            finished += 1
            same(found, result)
            store.tidy(path, store.record_of(path)["identity"])
        assert content(path) == expected
        assert names(path) == ["transfer", "zarr.json"]
        assert names(at) == ["a.zarr"]
        shutil.rmtree(at)
    assert begun > 4
    assert finished > 1


def test_a_replaced_store_is_always_the_old_or_the_new_one(transfer, tmp_path, monkeypatch, long):
    other, new = dataclasses.replace(transfer, error=transfer.error + 1.0), {"which": "new"}
    store.save(tmp_path / "old.zarr", transfer, {"which": "old"}, EXACT)
    shutil.copytree(tmp_path / "old.zarr", tmp_path / "counted.zarr")
    with Frozen(tmp_path) as counted:
        store.save(tmp_path / "counted.zarr", other, new, EXACT)
    seen = []
    for number in counted.points(long):
        path = tmp_path / f"{number}" / "a.zarr"
        shutil.copytree(tmp_path / "old.zarr", path)
        crashed(monkeypatch, Frozen(path, number), store.save, path, other, new, EXACT)
        assert store.state(path) == "finished"
        seen.append(store.record_of(path)["which"])
        same(store.load(path), transfer if seen[-1] == "old" else other)
        assert store.size(path) > 0
        store.save(path, other, new, EXACT)
        assert content(path) == content(tmp_path / "counted.zarr")
        assert names(path) == ["transfer", "zarr.json"]
        shutil.rmtree(path.parent)
    # It is one moment at which the new one takes its place.
    assert seen == sorted(seen, reverse=True)
    assert {*seen} == {"old", "new"}


def test_a_replaced_table_is_always_the_old_or_the_new_one(tmp_path, monkeypatch, long):
    scan = do.samples.compact_disc(jax.random.key(1), shape=(32, 32), pixel=0.1)
    up = np.array([[0.0, 0.0, 1.0]])
    brdf = do.DiffractionBRDF(scan, 0.4)
    made = brdf.prepare(pairs=(up, up), output="xyz", tolerance=0.3, method="table")
    made.save(tmp_path / "old.zarr", which="old")
    shutil.copytree(tmp_path / "old.zarr", tmp_path / "new.zarr")
    with Frozen(tmp_path) as counted:
        made.save(tmp_path / "new.zarr", which="new")
    seen = []
    for number in counted.points(long):
        at = tmp_path / f"{number}"
        shutil.copytree(tmp_path / "old.zarr", at / "a.zarr")
        path = at / "a.zarr"
        crashed(monkeypatch, Frozen(at, number), functools.partial(made.save, which="new"), path)
        baked = do.load_table(path)
        np.testing.assert_array_equal(baked(up, up), made(up, up))
        seen.append(baked.record["which"])
        made.save(path, which="new")
        assert content(path) == content(tmp_path / "new.zarr")
        assert names(at) == ["a.zarr"]
    assert seen == sorted(seen, reverse=True)
    assert {*seen} == {"old", "new"}


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_fills_up_at_any_operation(scene, transfer, batches, tmp_path, long, code):
    """What stood there still does, nothing half-made is left, and room is all that is needed."""

    def refused():
        return OSError(code, os.strerror(code))

    other = dataclasses.replace(transfer, error=transfer.error + 1.0)
    store.save(tmp_path / "old.zarr", transfer, settings=EXACT)
    shutil.copytree(tmp_path / "old.zarr", tmp_path / "counted.zarr")
    with Frozen(tmp_path, error=refused) as counted:
        store.save(tmp_path / "counted.zarr", other, settings=EXACT)
    for number in counted.points(long):
        path = tmp_path / f"{number}.zarr"
        shutil.copytree(tmp_path / "old.zarr", path)
        failed = False
        with Frozen(path, number, refused) as frozen:
            try:
                store.save(path, other, settings=EXACT)
            except OSError as error:
                failed = error.errno == code
        # Writing chunks at once, zarr makes now and then a folder less.
        assert failed == frozen.broken or number > len(counted.events) - 10
        same(store.load(path), transfer if failed else other)
        # A disk on which nothing can be renamed either keeps the old one where it was put.
        assert {*names(path)} - {".transfer.replaced"} <= {"transfer", "zarr.json"}
        shutil.rmtree(path)
    # Batches that were kept before stay, and the lock is given back.
    path = store.begin(tmp_path / "begun.zarr")
    with Working(path, scene, SETTINGS) as kept:
        kept.save(0, batches[0])
        with Frozen(path, 1, refused), pytest.raises(OSError, match=os.strerror(code)) as caught:
            kept.save(1, batches[1])
        assert caught.value.filename == str(path / "working" / "0000001.npz")
        assert kept.kept == 1
    assert names(path / "working") == ["0000000.npz", "record.json"]


def test_files_and_folders_are_whole_or_absent(tmp_path, monkeypatch):
    old, new = b"old" * 1000, b"new" * 2000

    def file(at):
        with replacing(at / "a") as opened:
            opened.write(new)

    def several(at):
        with folder(at / "deep" / "out") as staging:
            for name in "bc":
                (staging / name).write_bytes(new)

    for work, paths in ((file, ["a"]), (several, ["deep/out/b", "deep/out/c"])):
        for there in (False, True):
            number = 0
            for number in range(40):
                at = tmp_path / f"{work.__name__}{there}{number}"
                for path in [at / one for one in paths] if there else [at / "a"]:
                    path.parent.mkdir(parents=True, exist_ok=True)
                    if there:
                        path.write_bytes(old)
                frozen = crashed(monkeypatch, Frozen(at, number), work, at)
                for one in paths:
                    path = at / one
                    assert path.read_bytes() in (old, new) if path.exists() else not there
                work(at)
                whole = [path for path in at.rglob("*") if path.is_file()]
                assert {str(path.relative_to(at)) for path in whole} == {*paths}
                assert all(path.read_bytes() == new for path in whole)
                if not frozen.broken:
                    break
            assert 1 < number < 39


# Rows


def study():
    """Four cases; the third and fourth share a program."""

    def case(k):
        def build():
            x = jnp.full(4, 0.5 + k)
            return Job(jnp.sin, (x,), lambda y: (abs(float(y[0]) - 0.4), f"case {k}"))

        return Case({"k": k, "name": "sine"}, "float32", build, program=None if k < 2 else "one")

    return Study("made.up", "a number", "arithmetic", lambda quick: [case(k) for k in range(4)])


def timeless(result):
    return [(row.settings, row.error, row.bound, row.note) for row in result.rows]


def test_rows_of_a_study_killed_at_any_operation(tmp_path, monkeypatch):
    whole = timeless(study().run(repeats=1))
    measured = []
    row = studies._row
    monkeypatch.setattr(
        studies, "_row", lambda case, *more: (measured.append(case), row(case, *more))[1]
    )

    def run(path):
        with rows_keeping.Rows(path, "made.up", True) as rows:
            study().run(repeats=1, keep=rows)

    lost, number = [], 0
    for number in range(40):
        at = tmp_path / f"{number}"
        at.mkdir()
        path = at / "rows"
        measured.clear()
        frozen = crashed(monkeypatch, Frozen(at, number), run, path)
        with rows_keeping.Rows(path, "made.up", True) as rows:
            found = study().run(repeats=1, keep=rows)
            assert timeless(found) == whole
            rows.discard()
        assert names(at) == []
        lost.append(len(measured) - 4)
        if not frozen.broken:
            break
    # The row in work at most.
    assert {*lost} == {0, 1}
    assert 4 < number < 39


def test_rows_that_are_cut_or_of_something_else(tmp_path):
    path = tmp_path / "rows"
    with rows_keeping.Rows(path, "made.up", True) as rows:
        first = study().run(repeats=1, keep=rows)
    data = path.read_bytes()
    ends = [k + 1 for k, byte in enumerate(data) if byte == ord("\n")]
    for size in range(len(data) + 1):
        path.write_bytes(data[:size])
        with rows_keeping.Rows(path, "made.up", True) as rows:
            # The line without its end counts where nothing else is missing.
            assert len(rows.found) == max(sum(end <= size + 1 for end in ends) - 1, 0)
    for cut in (ends[2] + 5, ends[3] - 1):
        path.write_bytes(data[:cut])
        with rows_keeping.Rows(path, "made.up", True) as rows:
            again = study().run(repeats=1, keep=rows)
        # Times too, of rows that were there.
        assert again.rows[:2] == first.rows[:2]
        with rows_keeping.Rows(path, "made.up", True) as rows:
            assert len(rows.found) == 4
    for other in (("other", True), ("made.up", False)):
        with rows_keeping.Rows(path, *other) as rows:
            assert rows.found == {}
    with (
        rows_keeping.Rows(path, "made.up", True),
        pytest.raises(InputError, match=rf"rows: process {os.getpid()} on .* is at work on it"),
    ):
        rows_keeping.Rows(path, "made.up", True)


def test_the_command_goes_on_from_rows(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(studies.NAMES, "made.up", "test_interruption:MADE_UP")
    row, measured = studies._row, []

    def stopping(case, *more):
        if len(measured) == 2:
            raise KeyboardInterrupt
        measured.append(case)
        return row(case, *more)

    words = ["accuracy", "made.up", "-o", str(tmp_path / "out")]
    with monkeypatch.context() as patched:
        patched.setattr(studies, "_row", stopping)
        assert main(words) == 130
    assert names(tmp_path) == [".out.made.up.rows"]
    capsys.readouterr()
    assert main(words) == 0
    out, err = capsys.readouterr()
    assert "made.up: goes on from 2 rows of an earlier run, kept in " in out
    assert err == ""
    assert names(tmp_path) == ["out"]
    assert names(tmp_path / "out") == ["made.up.csv", "made.up.png"]


MADE_UP = study()


# Tiles

PICTURE = """
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
level = "path"
spp = 2
rays = 128
"""


@pytest.fixture
def ball(tmp_path):
    path = tmp_path / "ball.toml"
    path.write_text(PICTURE)
    return path


@pytest.fixture
def always(monkeypatch):
    """Tiles are written as soon as they are done."""
    monkeypatch.setattr(keeping, "EVERY", 0.0)
    monkeypatch.setattr(keeping, "_SHARE", 1e9)


def test_pictures_killed_at_any_operation(ball, tmp_path, monkeypatch, always):
    def words(at):
        return ["render", str(ball), "-o", str(at / "a.png"), "--layers", "--quiet"]

    whole = tmp_path / "whole"
    whole.mkdir()
    assert main(words(whole)) == 0
    expected = content(whole)
    noted, note = [], keeping.Kept.note
    monkeypatch.setattr(
        keeping.Kept, "note", lambda self, image: (noted.append(0), note(self, image))[1]
    )
    lost, number = [], 0
    for number in range(60):
        at = tmp_path / f"{number}"
        at.mkdir()
        noted.clear()
        frozen = crashed(monkeypatch, Frozen(at, number), main, words(at))
        first = len(noted)
        assert main(words(at)) == 0
        assert content(at) == expected
        lost.append(len(noted) - 3 if first < 3 or frozen.broken else 0)
        shutil.rmtree(at)
        if not frozen.broken:
            break
    # Three tiles; the one in work at most is made again.
    assert {*lost} == {0, 1}
    assert 8 < number < 59


UNFIT = (
    ("depth", lambda a: a[:-1]),
    ("depth", lambda a: a[0]),
    ("radiance", lambda a: a[:, :2]),
    ("normal", lambda a: a.astype("U8")),
    ("object", lambda a: np.concatenate([a, a])),
)


def misshapen(data, name, make):
    """A file with one array changed, whose checksums and head fit."""
    with np.load(io.BytesIO(data)) as file:
        arrays = dict(file)
    arrays[name] = make(arrays[name])
    out = io.BytesIO()
    np.savez(out, **arrays)
    return out.getvalue()


def test_tiles_of_another_picture_or_damaged_ones_are_not_taken(
    ball, tmp_path, monkeypatch, always, capsys
):
    target, tiles = tmp_path / "a.png", tmp_path / ".a.png.tiles"
    monkeypatch.setattr(Path, "unlink", lambda self, missing_ok=False: None)
    assert main(["render", str(ball), "-o", str(target), "--quiet"]) == 0
    monkeypatch.undo()
    monkeypatch.setattr(keeping, "EVERY", 0.0)
    whole, data = target.read_bytes(), tiles.read_bytes()

    def printed(*more):
        tiles.write_bytes(data)
        assert main(["render", str(ball), "-o", str(target), *more]) == 0
        assert not tiles.exists()
        return capsys.readouterr().out

    assert "goes on  100 % of the pixels were done by an earlier run" in printed()
    assert target.read_bytes() == whole
    for more in (["--seed", "1"], ["--spp", "3"], ["--depth", "2"], ["--layers"]):
        assert "goes on" not in printed(*more)
    for old, new in (("0.4, 0.2]", "0.4, 0.3]"), ("[1, -1, 1]", "[1, -1, 2]"), ("0.5", "0.6")):
        ball.write_text(PICTURE.replace(old, new))
        assert "goes on" not in printed()
    ball.write_text(PICTURE)
    changed = bytearray(data)
    changed[len(data) // 2] ^= 1
    unfit = [misshapen(data, name, make) for name, make in UNFIT]
    for bad in (data[: len(data) // 2], bytes(changed), b"", *unfit):
        data = bad
        assert "goes on" not in printed()
        assert target.read_bytes() == whole


def test_a_picture_without_room_for_its_tiles(ball, tmp_path, monkeypatch, always, capsys):
    at = tmp_path / "at"
    at.mkdir()
    with Frozen(at, 0, full):
        assert main(["render", str(ball), "-o", str(at / "a.png")]) == 2
    err = capsys.readouterr().err
    assert err == f"diffopt: error: {at / 'a.png'}: cannot be written: no space left on device\n"
    assert names(at) == []


# Two processes, real kills, real disks


@pytest.fixture(scope="module")
def ring(tmp_path_factory):
    path = tmp_path_factory.mktemp("ring") / "ring.toml"
    path.write_text(FILE)
    return path


@LINUX
@pytest.mark.long
def test_kills_of_a_precomputation_and_a_second_process(ring, tmp_path, capsys):
    words = ["precompute", ring, *WORDS, "--compression", "0", "--quiet", "-o"]
    code, _, err, seconds = Child([*words, tmp_path / "whole.zarr"]).ended()
    assert (code, err) == (0, "")
    path = tmp_path / "a.zarr"

    def batches():
        return len(list(path.glob("working/[0-9]*.npz")))

    # A second process asks for the store; some time later the first one is killed.
    child = Child([*words, path])
    told = []

    def second():
        if batches() < 2:
            return False
        told.append((main([*map(str, words), str(path)]), capsys.readouterr().err))
        time.sleep(np.random.default_rng(12).uniform(0.0, 0.3) * seconds)
        return True

    assert child.killed(when=second) or store.state(path) == "finished"
    assert told[0][0] == 2
    assert f"a.zarr: process {child.process.pid} on " in told[0][1]
    assert "is at work on it; wait for it, or delete " in told[0][1]
    assert store.state(path) in ("begun", "finished")
    assert store.state(path) == "finished" or batches() >= 2
    code, _, err, _ = Child([*words, path]).ended()
    assert (code, err) == (0, "")
    assert content(path) == content(tmp_path / "whole.zarr")
    assert names(tmp_path) == ["a.zarr", "whole.zarr"]


DISKS = """
    import os, subprocess, sys
    from pathlib import Path
    import jax
    jax.config.update("jax_enable_x64", sys.argv[1] == "1")
    from diffopt.cli import main
    from diffopt.transfer import store

    ring, ball, at, many = sys.argv[2:6]
    os.chdir(at)
    said = lambda text: print(text, file=sys.stderr, flush=True)
    def mounted(*options):
        subprocess.run(["mount", "-t", "tmpfs", "-o", ",".join(options), "disk", at], check=True)
        os.chdir(at)
    commands = (
        ["precompute", ring, *sys.argv[6:], "-o", "a.zarr", "--quiet"],
        ["render", ball, "-o", "a.npz", "--quiet"],
        ["accuracy", "lobes.concentration", "--quick", "-o", "out"],
    )[: int(many)]
    mounted("size=64k")
    subprocess.run(["mount", "-o", "remount,ro", at], check=True)
    for words in commands:
        said(f"read-only {words[0]}: {main(words)} {os.listdir()}")
    subprocess.run(["mount", "-o", "remount,rw", at], check=True)
    Path("filler").write_bytes(bytes(56 * 1024))
    for words in commands:
        code = main(words)
        said(f"full {words[0]}: {code} {sorted(os.listdir())}")
    said(f"state {store.state('a.zarr')}")
    os.remove("filler")
    subprocess.run(["mount", "-o", "remount,size=64m", at], check=True)
    for words in commands:
        said(f"room {words[0]}: {main(words)}")
    said(f"left {sorted(os.listdir())} {store.state('a.zarr')}")
"""


@LINUX
@pytest.mark.long
def test_disks_that_are_full_or_read_only(ring, ball, tmp_path, long):
    """On a disk of a few pages, in name spaces of their own, where that is allowed."""
    at = tmp_path / "disk"
    at.mkdir()
    commands = ("precompute", "render", "accuracy") if long else ("precompute",)
    many = str(len(commands))
    alone = ["unshare", "--map-root-user", "--mount"]
    try:
        subprocess.run([*alone, "mount", "-t", "tmpfs", "disk", at], check=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        pytest.skip("no disk can be mounted here")
    wide = "1" if jnp.ones(()).dtype == jnp.float64 else "0"
    words = [sys.executable, "-c", textwrap.dedent(DISKS), wide, ring, ball, at, many, *WORDS]
    done = subprocess.run([*alone, *words], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    said = [line for line in done.stderr.splitlines() if ": error: " not in line]
    store_, picture, rows = "a.zarr", "a.npz", f"{at}/out"
    kept = "; finished batches are kept, and the same command goes on from them"
    errors = [
        f"{store_}: cannot be written: read-only file system{kept}",
        f"-o {picture}: the folder . cannot be written to",
        f"{rows}: cannot be written to: read-only file system",
        f"{store_}: cannot be written: no space left on device{kept}",
        f"{picture}: cannot be written: no space left on device",
        f"{rows}: cannot be written: no space left on device",
    ]
    found = [line for line in done.stderr.splitlines() if ": error: " in line]
    errors = errors[: len(commands)] + errors[3 : 3 + len(commands)]
    assert found == [f"diffopt: error: {text}" for text in errors]
    assert said == [
        *(f"read-only {name}: 2 []" for name in commands),
        *(f"full {name}: 2 ['a.zarr', 'filler']" for name in commands),
        "state begun",
        *(f"room {name}: 0" for name in commands),
        f"left {sorted(['a.zarr', *['a.npz', 'out'][: len(commands) - 1]])} finished",
    ]


# A night


def transfer_phase(path):
    state = "absent" if not path.exists() else store.state(path)
    kept = len(list(path.glob("working/[0-9]*.npz")))
    if state == "finished":
        return "finished, batches still there" if kept else "finished"
    if any(path.glob(".transfer.*")):
        return "writing the result"
    return "first batch" if state == "begun" and not kept else "batches" if kept else state


def transfer_readable(path):
    if path.exists() and store.state(path) == "finished":
        store.load(path)


def beside_phase(kept):
    """Of an output with one file beside it for what is done; `kept` says of that how much."""

    def phase(path):
        beside = [one for one in path.parent.iterdir() if one.name.endswith((".tiles", ".rows"))]
        return "finished" if path.exists() else kept if beside else "nothing kept yet"

    return phase


def results_readable(path):
    """What is there under its name is whole."""
    files = [one for one in path.rglob("*") if one.is_file()] if path.is_dir() else [path]
    for one in files if path.exists() else []:
        if one.suffix == ".png":
            with PIL.Image.open(one) as image:
                image.load()
        elif one.suffix == ".json":
            json.loads(one.read_text())
        else:
            assert one.stat().st_size > 0


def night(what, kills, ring, at):
    """Kills of one command; what they hit."""
    scan = at / "scan.npz"
    true = gratings.Sinusoidal(1.3, 0.05, 0.4, 0.2)
    heights = np.array(true.heights((48, 48), 0.1, edges="averaged"), np.float64)
    heights += 0.002 * np.random.default_rng(5).normal(size=(48, 48))
    do.Heightfield(heights, 0.1).save(scan)
    slow = at / "slow.toml"
    slow.write_text(FILE + "[render]\nrays = 1024\nspp = 64\n")
    cases = {
        "precompute": (
            ["precompute", ring, *WORDS, "--compression", "0", "--quiet", "-o", "a.zarr"],
            transfer_phase,
            transfer_readable,
        ),
        "render": (
            ["render", slow, "--size", "96x96", "--quiet", "-o", "a.png"],
            beside_phase("tiles"),
            results_readable,
        ),
        "accuracy": (
            ["accuracy", "lobes.concentration", "--quick", "-o", "out"],
            beside_phase("rows"),
            results_readable,
        ),
        "fit": (
            ["fit", "heightfield", scan, "--model", "sinusoidal", "-o", "out"],
            beside_phase(""),
            results_readable,
        ),
    }
    words, phase, readable = cases[what]
    folder = at / what
    folder.mkdir()
    # A picture of error against time is another one each time.
    drawn = ("lobes.concentration.png",)
    return many(words, folder, kills, phase=phase, readable=readable, drawn=drawn)


@LINUX
@pytest.mark.long
@pytest.mark.parametrize("what", ["precompute", "render", "accuracy", "fit"])
def test_fifty_kills(what, ring, tmp_path):
    found = night(what, 50, ring, tmp_path)
    print(what, found)
    assert found["same"] > 1
    # Kills hit more than one phase, of those where something is kept.
    assert len(found) > (3 if what == "fit" else 4)
