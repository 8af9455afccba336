"""Damaged and malicious files: one line of refusal, bounded memory and time, nothing else.

The child process, the damage and the seeds are in `fuzzing`.
"""

import os
import pickle
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from fuzzing.attempts import MEMORY, attempt
from fuzzing.cases import Case, case, lay
from fuzzing.crafted import CRAFTED
from fuzzing.crafted.base import npz_bomb
from fuzzing.crafted.stores import changed
from fuzzing.parent import Child, scratch
from fuzzing.readers import READERS
from fuzzing.readers.assets import solid
from fuzzing.readers.base import BARE, single
from fuzzing.readers.heights import load_heights
from fuzzing.readers.materials import load_measured
from fuzzing.watch import Watch

from diffopt import stores
from diffopt.errors import InputError
from diffopt.io import limits, numpy_files
from diffopt.lobes import Lobes
from diffopt.scenes import load_scene, meshfiles

BALL = '[[objects]]\nshape = "sphere"\nmaterial = "lambert"\n'


@pytest.fixture(scope="module")
def child():
    if not Path("/proc/self/status").exists():
        pytest.skip("limits on memory are read from /proc")
    with scratch() as folder:
        worker = Child(Path(folder))
        yield worker
        worker.close()


@pytest.mark.parametrize("name", READERS)
def test_damaged_files_are_read_or_refused(child, name, long):
    reader = READERS[name]
    count = reader.long if long else reader.quick
    found = child.run(name, count)
    assert sum(found.outcomes.values()) == count
    # Some damage does no harm, most of it does: else nothing was tried.
    assert 0 < found.outcomes.get("read", 0) < found.outcomes["refused"]
    assert not found.faults, "\n".join(found.faults[:20])


@pytest.mark.parametrize("name", READERS)
def test_files_that_are_made_to_harm_are_refused(child, name):
    found = child.run(name, None)
    assert found.outcomes["refused"] > 5
    assert not found.faults, "\n".join(found.faults[:20])


def test_every_reader_of_files_is_among_them():
    assert set(CRAFTED) == set(READERS)


@pytest.fixture(scope="module")
def watch():
    found = Watch()
    yield found
    found.close()


class TestTheWatch:
    """What the child is to see, it sees."""

    def seen(self, watch, tmp_path, load, **more):
        found = Case("", single("a", b"a"), **more)
        return attempt(watch, load, tmp_path, found)["faults"]

    def test_other_exceptions(self, watch, tmp_path):
        def load(path):
            raise KeyError("xres")

        assert any("KeyError" in fault for fault in self.seen(watch, tmp_path, load))

    def test_warnings(self, watch, tmp_path):
        faults = self.seen(watch, tmp_path, lambda path: warnings.warn("odd", stacklevel=1))
        assert any("UserWarning" in fault for fault in faults)

    def test_texts_of_several_lines_and_without_the_file(self, watch, tmp_path):
        def load(path):
            raise InputError("two\nlines")

        faults = self.seen(watch, tmp_path, load)
        assert any("not one line" in fault for fault in faults)
        assert any("does not name the file" in fault for fault in faults)

    def test_a_refusal_for_want_of_memory(self, watch, tmp_path):
        def load(path):
            try:
                raise MemoryError
            except MemoryError as error:
                raise InputError(f"{path}: damaged") from error

        assert any("limit on memory" in fault for fault in self.seen(watch, tmp_path, load))

    def test_memory(self, watch, tmp_path):
        faults = self.seen(watch, tmp_path, lambda path: np.ones(MEMORY // 4).sum())
        assert any("MiB of memory" in fault for fault in faults)

    def test_writing_removing_unpickling_and_starting(self, watch, tmp_path):
        def load(path):
            (path.parent / "b").write_bytes(b"")
            pickle.loads(pickle.dumps(np.ones(1)))
            os.remove(path)

        faults = " ".join(self.seen(watch, tmp_path, load))
        for word in ("for writing", "pickle.loads", "pickle.find_class", "os.remove", "changed"):
            assert word in faults

    def test_reading_what_must_not_be_read(self, watch, tmp_path):
        faults = self.seen(watch, tmp_path, lambda path: None, harmless=False)
        assert faults == ["it was read"]

    def test_a_child_that_dies_is_named_and_replaced(self, child):
        process = child._started()
        process.kill()
        process.wait()
        with pytest.raises(RuntimeError, match=r"died of signal 9.* before its first file"):
            child.run("lobes", 1)
        assert sum(child.run("lobes", 2).outcomes.values()) == 2


def test_the_same_number_is_the_same_file():
    seeds = READERS["lobes"].seeds()
    for number in (0, 7, 8):
        one, other = (case("lobes", seeds, number) for _ in range(2))
        assert one == other
    assert case("lobes", seeds, 7) != case("lobes", seeds, 9)


class TestArrays:
    def test_what_numpy_writes_is_read(self, tmp_path, rng):
        every = {
            "plain": rng.normal(size=(3, 4)),
            "fortran": np.asfortranarray(rng.normal(size=(3, 4))),
            "big": rng.normal(size=5).astype(">f4"),
            "whole": np.arange(6, dtype=np.uint16).reshape(1, 2, 3),
            "nothing": np.zeros((0, 3)),
            "one": np.array(2.5),
            "text": np.array("words"),
            "truth": np.array([True, False]),
        }
        np.savez(tmp_path / "a.npz", **every)
        np.savez_compressed(tmp_path / "b.npz", **every)
        for path in (tmp_path / "a.npz", tmp_path / "b.npz"):
            found = numpy_files.archive(path)
            assert list(found) == list(every)
            for name, array in every.items():
                assert found[name].dtype == array.dtype
                np.testing.assert_array_equal(found[name], array)
                assert found[name].flags.writeable
        for name, array in every.items():
            np.save(tmp_path / f"{name}.npy", array)
            np.testing.assert_array_equal(numpy_files.array(tmp_path / f"{name}.npy"), array)

    def test_headers_of_gigabytes(self, tmp_path):
        (tmp_path / "a.npy").write_bytes(b"\x93NUMPY\x02\x00\xff\xff\xff\xff{" + bytes(99))
        with pytest.raises(InputError, match=r"its header is damaged: it claims 4294967295 bytes"):
            numpy_files.array(tmp_path / "a.npy")

    def test_a_checksum_that_does_not_fit(self, tmp_path):
        np.savez(tmp_path / "a.npz", z=np.ones(9))
        content = bytearray((tmp_path / "a.npz").read_bytes())
        content[content.index(np.ones(9).tobytes()) + 3] ^= 1
        (tmp_path / "a.npz").write_bytes(content)
        with pytest.raises(InputError, match=r"the archive cannot be read: .*Bad CRC-32"):
            numpy_files.archive(tmp_path / "a.npz")

    def test_bombs_are_refused_for_what_they_claim(self, tmp_path):
        (tmp_path / "a.npz").write_bytes(npz_bomb(3000))
        with pytest.raises(InputError, match=r"the archive claims 3.146e\+09 bytes; expected at"):
            numpy_files.archive(tmp_path / "a.npz")

    def test_inflated_data_are_counted_without_being_held(self, tmp_path):
        limits.inflates_to(tmp_path, zlib.compress(bytes(10_000)), 10_000)
        with pytest.raises(InputError, match="more than the 9999 bytes that are stated"):
            limits.inflates_to(tmp_path, zlib.compress(bytes(10_000)), 9_999)

    def test_limits_of_shapes(self, tmp_path):
        assert limits.samples(tmp_path, (2**13, 2**14)) == limits.MOST_SAMPLES
        assert limits.samples(tmp_path, ()) == 1
        with pytest.raises(InputError, match=r"1.34e\+08 samples; at most 1.34e\+08"):
            limits.samples(tmp_path, (2**13, 2**14 + 1))
        with pytest.raises(InputError, match=r"sides of \[-1, -1\]"):
            limits.samples(tmp_path, (-1, -1))


class TestScenes:
    """A scene reads what it names, and says so where that lies elsewhere."""

    def scene(self, folder, name):
        path = folder / "a.toml"
        words = f'[[objects]]\nshape = "mesh"\nmaterial = "lambert"\nfile = "{name}"\n'
        path.write_text(words)
        return load_scene(path)

    def test_files_beside_it_are_not_worth_a_word(self, tmp_path):
        (tmp_path / "parts").mkdir()
        (tmp_path / "parts" / "box.ply").write_bytes(solid("ply"))
        assert not any("outside" in note for note in self.scene(tmp_path, "parts/box.ply").notes)
        assert not any(
            "outside" in note for note in self.scene(tmp_path, "parts/../parts/box.ply").notes
        )

    def test_files_elsewhere_are_said(self, tmp_path, capsys):
        from diffopt.cli import main

        folder = tmp_path / "scene"
        folder.mkdir()
        box = tmp_path / "box.ply"
        box.write_bytes(solid("ply"))
        (folder / "link.ply").symlink_to(box)
        for name in ("../box.ply", str(box), "link.ply"):
            notes = self.scene(folder, name).notes
            assert f"{name} is outside of the scene's folder: read from {box.resolve()}" in notes
        main(["scene", "check", str(folder / "a.toml")])
        told = " ".join(capsys.readouterr().out.split())
        assert "note: link.ply is outside of the scene's folder: read from" in told

    def test_a_mesh_names_only_what_is_beside_it(self, tmp_path):
        inside = tmp_path / "inside"
        inside.mkdir()
        files = solid("gltf")
        name = next(word for word in files if word.endswith(".gltf"))
        buffer = next(word for word in files if word.endswith(".bin"))
        for word, content in files.items():
            (inside / word).write_bytes(content)
        assert len(meshfiles.load(inside / name).faces) == 12
        (inside / buffer).rename(tmp_path / buffer)
        text = (inside / name).read_text()
        (inside / name).write_text(text.replace(buffer, f"../{buffer}"))
        with pytest.raises(InputError, match=rf"names '../{buffer}', outside of its folder"):
            meshfiles.load(inside / name)
        (inside / name).write_text(text)
        (inside / buffer).symlink_to(tmp_path / buffer)
        with pytest.raises(InputError, match="outside of its folder"):
            meshfiles.load(inside / name)

    def test_whole_numbers_beyond_every_float(self, tmp_path):
        (tmp_path / "a.toml").write_text(BALL + f"radius = {'9' * 400}\n")
        with pytest.raises(InputError, match=r"a.toml:4: .*radius: expected a number"):
            load_scene(tmp_path / "a.toml")

    def test_keys_of_many_parts(self, tmp_path):
        (tmp_path / "a.toml").write_text(BALL + "a." * 70 + "b = 1\n")
        with pytest.raises(InputError, match=r"a.toml:4: not a scene: a key of 65 parts or more"):
            load_scene(tmp_path / "a.toml")
        (tmp_path / "a.toml").write_text(BALL + f'name = "{"a." * 50}"\n# {"0.5, " * 99}\n')
        load_scene(tmp_path / "a.toml")

    def test_materials_that_double(self, tmp_path):
        text = "".join(
            f'[materials.m{k}]\nkind = "sum"\nparts = ["m{k + 1}", "m{k + 1}"]\n' for k in range(20)
        )
        (tmp_path / "a.toml").write_text(text + '[materials.m20]\nkind = "lambert"\n' + BALL)
        with pytest.raises(InputError, match=r"parts of 10.. arrays; at most 1000 are accepted"):
            load_scene(tmp_path / "a.toml")


class TestStores:
    def test_a_table_that_begins_at_zero_comes_back(self, tmp_path):
        """Chunks of zeros were not written, and their want taken for damage."""
        seed = READERS["stores: tables"].seeds()["table"]
        found = stores.load_table(lay(tmp_path, seed))
        np.testing.assert_array_equal(np.asarray(found.table.first), np.zeros(3))

    @pytest.mark.parametrize(
        ("key", "value"),
        [("order", 7), ("order", True), ("relative", 1), ("shadowing", "all"), ("record", None)],
    )
    def test_settings_that_are_none(self, tmp_path, key, value):
        seed = READERS["stores: tables"].seeds()["table"]

        def change(tree):
            tree["attributes"][key] = value
            if value is None:
                del tree["attributes"][key]

        other = changed(seed, "a.zarr/zarr.json", change)
        with pytest.raises(InputError, match=rf"{key}.*bake the table again"):
            stores.load_table(lay(tmp_path, other))


def test_small_triangles_beside_large_ones_have_normals():
    """Their corners fell together when all were measured from the middle of the mesh."""
    one = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    far = np.array([[1e30, 0.0, 0.0], [0.0, 1e30, 0.0], [0.0, 0.0, 1e30]])
    mesh = meshfiles.build(np.concatenate([one, far]), np.arange(6).reshape(2, 3))
    assert np.isfinite(mesh.normals).all()
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, rtol=1e-12)


def test_meshes_of_the_plane_are_none(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"a\.obj: "):
        meshfiles.load(tmp_path / "a.obj")


def test_numbers_without_end_take_no_time(tmp_path):
    names = "theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg," + "1" * 60_000 + "\n"
    (tmp_path / "a.csv").write_text("# coherence: 2 um\n" + names + "1,2,3,4,5\n")
    with pytest.raises(InputError, match=r"a\.csv: column '1111"):
        load_measured(tmp_path / "a.csv")


def test_lines_without_end_take_no_time(tmp_path):
    """Patterns that matched in many ways took the square of a line's length."""
    (tmp_path / "a.txt").write_text("# Width: " + "1" * 60_000 + " x x\n1 2\n3 4\n")
    assert load_heights(tmp_path / "a.txt", **BARE).shape == (2, 2)


@pytest.mark.parametrize("text", ['{"lobes": ' + "[" * 100_000, '{"lobes": 1e999}', "[]", "1"])
def test_lobes_that_are_none(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=r"a\.json: expected lobes"):
        Lobes.load(tmp_path / "a.json")
