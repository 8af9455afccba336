"""Batches that a run left behind, damaged: they count as none, and are computed again."""

import io
import json
import shutil

import numpy as np
import pytest
from fuzzing.crafted.base import archive, npy_header, npz_bomb, objects
from fuzzing.damage import plain
from fuzzing.shells import special

from diffopt.errors import InputError
from diffopt.materials import Lambert
from diffopt.scenes import Object, Scene, models
from diffopt.transfer import store, working
from diffopt.transfer.angular import Vertices
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.working import Working

SETTINGS = TransferSettings(rays=64, finest=1, splits=0, tolerance=1.0)
RING = models.MODELS["torus"](radius=1.0, tube=0.4, around=4, across=3)
SCENE = Scene([Object(RING, Lambert(0.5))])
COUNT = 2


def slices(rows):
    sides = (rows, 3, SETTINGS.lobes)
    return Slices(*(np.ones((*sides, *more), np.float32) for more in ((1,), (3,), ())))


@pytest.fixture
def kept(tmp_path):
    """A store that was begun, with one batch of matte vertices; and the batch as bytes."""
    path = store.begin(tmp_path / "ring.zarr")
    level = np.full(COUNT, -1, np.int32)
    with Working(path, SCENE, SETTINGS) as batches:
        batches.save(0, Vertices(level, slices(0), slices(COUNT), np.zeros(COUNT)))
        yield batches, next(batches.folder.glob("*.npz"))


def sound(found):
    """Whether a batch may be taken for one."""
    numbers = (found.error, *found.views, *found.diffuse)
    return found.level.tolist() == [-1] * COUNT and all(a.dtype.kind == "f" for a in numbers)


def test_damaged_batches_are_none(kept, long):
    batches, file = kept
    whole = file.read_bytes()
    rng = np.random.default_rng(12)
    outcomes = [0, 0]
    for number in range(10_000 if long else 1000):
        # Of every second one the checksums fit.
        repacked = special(whole)[0][1]
        file.write_bytes((repacked if number % 2 else plain)(whole, rng))
        found = batches.load(0)
        assert found is None or sound(found), number
        outcomes[found is None] += 1
    # Some damage is to names, dates or values alone.
    assert 0 < outcomes[False] < outcomes[True]


def test_batches_that_are_made_to_harm_are_none(kept):
    batches, file = kept
    with np.load(file) as content:
        arrays = dict(content)

    def packed(**other):
        out = io.BytesIO()
        np.savez(out, **(arrays | other))
        return out.getvalue()

    alpha = arrays["diffuse_alpha"]
    bad = {
        "promises terabytes": archive(**dict.fromkeys(arrays, npy_header((10**6, 10**6)))),
        "pickles": archive(**dict.fromkeys(arrays, objects())),
        "no arrays": archive(**dict.fromkeys(arrays, b"")),
        "bomb": npz_bomb(100, "level"),
        "an array": npy_header((COUNT,)) + bytes(8 * COUNT),
        "a bare pickle": b"\x80\x04\x95",
        "levels with fractions": packed(level=np.full(COUNT, -1.0)),
        "levels that are dates": packed(level=np.zeros(COUNT, "M8[s]")),
        "levels in words": packed(level=np.array(["a"] * COUNT)),
        "a level there is not": packed(level=np.full(COUNT, 9)),
        "lobes in words": packed(diffuse_alpha=np.full(alpha.shape, "1")),
        "complex errors": packed(error=np.zeros(COUNT, complex)),
        "lobes of other sides": packed(diffuse_alpha=alpha[:, :2]),
        "seconds that are none": packed(clock=np.nan),
    }
    for label, content in bad.items():
        file.write_bytes(content)
        assert batches.load(0) is None, label
    file.write_bytes(packed())
    assert sound(batches.load(0))


@pytest.mark.parametrize("settings", [[1], 3, "abc", None])
def test_a_record_that_is_none(kept, settings):
    """What it belongs to is not known: the batches go."""
    batches, file = kept
    record = batches.folder / "record.json"
    text = record.read_text()
    batches.close()
    whole = json.loads(text)
    for bad in (json.dumps(whole | {"settings": settings}), "[" * 100_000, "[]", "", text[:-9]):
        record.write_text(bad)
        file.write_bytes(b"a batch")
        working.discard(batches.path, whole)
        assert file.exists()
        with Working(batches.path, SCENE, SETTINGS) as again:
            assert again.kept == 0
        assert json.loads(record.read_text()) == whole


def test_another_identity_that_is_none(kept):
    here = kept[0].identity
    assert not working.differences(json.loads(json.dumps(here)), here)
    for bad in ([], "abc", {}, here | {"settings": [1]}, here | {"settings": None}):
        assert "rays None there, 64 here" in working.differences(bad, here)


def test_records_of_another_run_are_refused(kept):
    batches, _ = kept
    record = batches.folder / "record.json"
    record.write_text(json.dumps(batches.identity | {"shapes": None}))
    batches.close()
    with pytest.raises(InputError, match="another scene or other settings: other shapes"):
        Working(batches.path, SCENE, SETTINGS)
    shutil.rmtree(batches.folder)
    with Working(batches.path, SCENE, SETTINGS) as again:
        assert again.kept == 0
