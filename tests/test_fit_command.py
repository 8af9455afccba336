"""``diffopt fit lobes``: materials, maps and samples in; lobes, errors and pictures out."""

import csv
import functools
import json
import math
import sys

import jax
import numpy as np
import OpenEXR
import PIL.Image
import pytest

import diffopt as do
from diffopt import InputError, fitting, materials
from diffopt.cli import fit_targets, main
from diffopt.drawing import lobe_fits, pictures
from diffopt.materials import naming

SMALL = functools.partial(
    fitting.LobeSettings, rings=16, sectors=16, em_steps=4, coarse_steps=6, lm_steps=4
)
NOTHING = dict.fromkeys(("alpha", "exponent"))


@pytest.fixture(autouse=True)
def few_nodes(monkeypatch):
    monkeypatch.setattr(fitting, "LobeSettings", SMALL)
    monkeypatch.setattr(pictures, "_DPI", 50)


def two_lobes():
    mu = np.array([[0.6, 0.0, 0.8], [0.0, -0.8, -0.6]])
    return do.Lobes(np.array([0.7, 0.3]), mu, np.array([40.0, 15.0]))


def sorted_kappa(path):
    return np.sort(np.asarray(do.Lobes.load(path).kappa))


def test_slices_are_fitted_kept_and_drawn(tmp_path, capsys):
    target = tmp_path / "out"
    words = "lambert --colour 0.8 --lobes 2 --angle 0,45 --method lm"
    assert main(["fit", "lobes", *words.split(), "-o", str(target)]) == 0
    pictures = {f"{kind}_{angle}.png" for kind in ("plane", "residual") for angle in (0, 45)}
    assert {p.name for p in target.iterdir()} == pictures | {
        "lobes.json",
        "lobes.npz",
        "errors.csv",
    }
    for name in pictures:
        with PIL.Image.open(target / name) as image:
            assert np.asarray(image.convert("RGB"), np.float64).std() > 2.0, name
    kept, text = (do.Lobes.load(target / f"lobes.{kind}") for kind in ("npz", "json"))
    assert kept.kappa.shape == (2, 2)
    np.testing.assert_array_equal(kept.mu, text.mu)
    with (target / "errors.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["angle_deg"]) for row in rows] == [0.0, 45.0]
    # Weights that are restored add up to the albedo; errors are those on another grid.
    np.testing.assert_allclose(kept.integral(), 0.8, rtol=1e-3)
    grid = lobe_fits._grid(180, 360)
    weight = np.hypot(grid[:, 0], grid[:, 1])
    truth = 0.8 / math.pi * np.maximum(grid[:, 2], 0.0)
    for k, row in enumerate(rows):
        missed = np.asarray(kept[k](grid)) - truth
        error = math.sqrt((weight * missed**2).sum() / (weight * truth**2).sum())
        # The command ran on few nodes.
        assert float(row["relative_error"]) == pytest.approx(error, rel=0.1)
        assert error < 0.25
    out = capsys.readouterr().out
    for word in ("lambert: 2 lobes by lm, float32", "relative error", "45°", "kappa"):
        assert word in out
    assert f"{float(rows[1]['relative_error']):.3g}" in out


def test_without_a_folder_nothing_is_written(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = "lambert --method moments --energy fitted --angle 30 --dtype float32"
    assert main(["fit", "lobes", *words.split()]) == 0
    out = capsys.readouterr().out
    assert "lambert: 1 lobe by moments, float32" in out
    assert "restored" not in out
    assert list(tmp_path.iterdir()) == []


def test_auto_refuses_a_tolerance_that_it_cannot_meet(capsys, monkeypatch):
    from diffopt.fitting import lobe_targets

    monkeypatch.setattr(lobe_targets, "COUNTS", (1, 2))
    words = "lambert --lobes auto --tolerance 0.0001 --angle 30 --method em"
    assert main(["fit", "lobes", *words.split()]) == 2
    said = capsys.readouterr().err
    assert "tolerance 0.0001 is not met by 2 lobes, the most that 'auto' tries" in said
    assert "lobes=2 gives that fit" in said


def test_maps_give_back_the_lobes_that_made_them(tmp_path, capsys):
    made = two_lobes()
    grid = lobe_fits._grid(32, 64)
    image = np.asarray(made(grid)).reshape(32, 64)
    np.save(tmp_path / "sky.npy", np.stack([image, 2.0 * image], -1).astype(np.float32))
    target = tmp_path / "out"
    words = ["--lobes", "2", "--method", "em", "-o", str(target)]
    assert main(["fit", "lobes", str(tmp_path / "sky.npy"), *words]) == 0
    assert {p.name for p in target.iterdir()} == {
        "lobes.json",
        "lobes.npz",
        "errors.csv",
        "map.png",
    }
    np.testing.assert_allclose(sorted_kappa(target / "lobes.npz"), [15.0, 40.0], rtol=0.05)
    assert "alpha (mean of 2)" in capsys.readouterr().out


def test_samples_are_read_from_arrays_archives_and_text(tmp_path, capsys):
    drawn = np.asarray(two_lobes().sample(jax.random.key(3), 400), np.float64)
    weights = np.linspace(0.5, 1.5, 400)
    np.save(tmp_path / "a.npy", np.column_stack([drawn, weights]))
    np.savez(tmp_path / "b.npz", directions=drawn, weights=weights)
    table = np.column_stack([drawn, weights])
    np.savetxt(tmp_path / "c.csv", table, "%.17g", ",", header="x,y,z,weight", comments="")
    for name in ("a.npy", "b.npz", "c.csv"):
        found = fit_targets.read(str(tmp_path / name), NOTHING)
        assert found.kind == "samples"
        np.testing.assert_array_equal(found.content[0], drawn)
        np.testing.assert_array_equal(found.content[1], weights)
    target = tmp_path / "out"
    assert main(["fit", "lobes", str(tmp_path / "a.npy"), "--lobes", "2", "-o", str(target)]) == 0
    assert {p.name for p in target.iterdir()} == {"lobes.json", "lobes.npz", "samples.png"}
    np.testing.assert_allclose(sorted_kappa(target / "lobes.npz"), [15.0, 40.0], rtol=0.25)
    found = json.loads((target / "lobes.json").read_text())["lobes"]
    assert np.shape(found["mu"]) == (2, 3)
    # The mean weight.
    assert float(do.Lobes.load(target / "lobes.npz").integral()) == pytest.approx(1.0)
    assert "expectation maximisation on samples" in capsys.readouterr().out


def test_tables_of_materials_stay_materials(tmp_path, monkeypatch):
    # What the reader gives is its own to test.
    monkeypatch.setattr(naming, "load", lambda p: naming.Subject(p.name, materials.Lambert(0.2)))
    rows = ["theta_i,phi_i,theta_o,phi_o,f"]
    rows += [f"{a},0,{b},{c},0.25" for a in (0, 40, 80) for b in (0, 40, 80) for c in (0, 90, 180)]
    path = tmp_path / "even.csv"
    path.write_text("\n".join(rows) + "\n")
    found = fit_targets.read(str(path), NOTHING)
    assert (found.kind, found.name) == ("material", "even.csv")
    with pytest.raises(InputError, match="--alpha is for named materials"):
        fit_targets.read(str(path), NOTHING | {"alpha": 0.1})


def test_radiance_pictures_plain_and_packed(tmp_path, rng):
    code = rng.integers(0, 256, (6, 12, 4)).astype(np.uint8)
    code[:3, :, 1] = 7
    code[0, 0] = 0
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 6 +X 12\n"
    mantissa, exponent = code[..., :3].astype(float), code[..., 3:].astype(float)
    expected = np.where(exponent > 0, (mantissa + 0.5) * 2.0 ** (exponent - 136), 0.0)
    (tmp_path / "plain.hdr").write_bytes(head + code.tobytes())
    packed = b""
    for row in code:
        packed += bytes([2, 2, 0, 12])
        for channel in row.T:
            flat = (channel == channel[0]).all()
            packed += bytes([128 + 12, channel[0]]) if flat else bytes([12, *channel])
    (tmp_path / "packed.hdr").write_bytes(head + packed)
    for name in ("plain.hdr", "packed.hdr"):
        content = fit_targets.read(str(tmp_path / name), NOTHING).content
        np.testing.assert_array_equal(content, expected)
    (tmp_path / "short.hdr").write_bytes(head + packed[:-5])
    with pytest.raises(InputError, match="ends before its 12 x 6 pixels"):
        fit_targets.read(str(tmp_path / "short.hdr"), NOTHING)
    (tmp_path / "turned.hdr").write_bytes(head.replace(b"-Y", b"+Y") + packed)
    with pytest.raises(InputError, match=r"rows from the top.*received '\+Y 6"):
        fit_targets.read(str(tmp_path / "turned.hdr"), NOTHING)


def test_png_is_linear_and_fine_maps_are_averaged(tmp_path):
    grey = np.full((8, 16, 3), 188, np.uint8)
    PIL.Image.fromarray(grey).save(tmp_path / "grey.png")
    found = fit_targets.read(str(tmp_path / "grey.png"), NOTHING)
    np.testing.assert_allclose(found.content, 0.5029, atol=1e-4)
    assert "brighter than white" in found.notes[0]
    fine = np.arange(600.0)[:, None] + np.zeros((600, 7))
    fine[0, 0] = -1.0
    np.save(tmp_path / "fine.npy", fine)
    found = fit_targets.read(str(tmp_path / "fine.npy"), NOTHING)
    assert found.content.shape == (200, 2, 1)
    np.testing.assert_allclose(found.content[1:, 0, 0], 3.0 * np.arange(1, 200) + 1.0)
    notes = " ".join(found.notes)
    for words in ("1 pixels with negative", "not twice as wide", "averaged to 2 x 200"):
        assert words in notes


def test_exr_needs_its_package(tmp_path, monkeypatch):
    path = tmp_path / "a.exr"
    path.write_bytes(b"\x76\x2f\x31\x01 and more")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(InputError, match=r"\.exr needs OpenEXR: pip install OpenEXR"):
        fit_targets.read(str(path), NOTHING)


@pytest.mark.parametrize(
    ("name", "shape", "kept"),
    [("RGB", (4, 8, 3), 3), ("RGBA", (4, 8, 4), 3), ("Y", (4, 8), 1), ("Z", (4, 8), 0)],
)
def test_exr_as_its_library_writes_it(name, shape, kept, tmp_path):
    path = tmp_path / "a.exr"
    pixels = np.linspace(0.25, 1.0, np.prod(shape)).reshape(shape).astype(np.float16)
    OpenEXR.File({}, {name: pixels}).write(str(path))
    if not kept:
        with pytest.raises(InputError, match="expected channels R, G, B or Y; received Z"):
            fit_targets.read(str(path), NOTHING)
        return
    found = fit_targets.read(str(path), NOTHING)
    np.testing.assert_array_equal(found.content, pixels.reshape(4, 8, -1)[..., :kept])
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(InputError, match=r"a.exr: cannot be read: "):
        fit_targets.read(str(path), NOTHING)


def test_pictures_show_the_lobes_where_they_are():
    lobes = two_lobes()

    def target(directions):
        return 1.5 * np.asarray(lobes(directions))

    figure = lobe_fits.in_plane("test", 30.0, target, lobes)
    linear = figure.axes[0]
    curves = {line.get_label(): line.get_data() for line in linear.lines}
    for label, factor in (("target", 1.5), ("sum of the lobes", 1.0)):
        at, values = (np.asarray(v, np.float64) for v in curves[label])
        assert math.degrees(at[values.argmax()]) == pytest.approx(36.87, abs=0.3)
        assert values.max() == pytest.approx(factor * 0.7 * 40.0 / (2.0 * math.pi), rel=1e-3)
    assert {"lobe 1: κ 40", "lobe 2: κ 15", "viewer"} <= set(curves)
    figure = lobe_fits.over_hemisphere("test", 30.0, target, lobes, below=True, size=64)
    first, _, residual, _, _, below = (axes.images[0].get_array() for axes in figure.axes[:6])
    j, i = np.unravel_index(np.nanargmax(first), first.shape)
    assert (2 * i + 1) / 64 - 1 == pytest.approx(0.6, abs=0.05)
    assert (2 * j + 1) / 64 - 1 == pytest.approx(0.0, abs=0.05)
    # Two thirds of the target's peak stay.
    assert float(np.nanmin(residual)) == pytest.approx(-100.0 / 3.0, abs=0.5)
    assert -10.0 < float(np.nanmin(below)) < -3.0
    narrow = do.Lobes(lobes.alpha[:1], lobes.mu[:1], np.array([1e4]))
    x, y, half = lobe_fits._window(narrow, 1.0)
    assert (x, y, half) == pytest.approx((0.6, 0.0, 0.05))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("gould", "'gould' is no material (did you mean gold?)"),
        ("glass", "glass: perfect mirrors and refraction have no width"),
        ("nothere.hdr", "nothere.hdr: no such file"),
        ("lambert --lobes 65", "--lobes must be 1 to 64, or auto; received '65'"),
        ("lambert --lobes 2 --method moments", "--lobes must be 1 for --method moments"),
        ("lambert --tolerance 0.1", "--tolerance is for --lobes auto"),
        ("lambert --lobes auto --tolerance 2", "--tolerance must lie between 0 and 1"),
        ("lambert --angle 90", "--angle must lie between 0 and 89 degrees; received 90"),
        ("lambert --method newton", "--method must be one of em+lm, lm, em, moments"),
        ("lambert --energy lost", "--energy must be one of restored, fitted"),
        ("lambert --start here", "--start must be one of scattered, split"),
        ("lambert --rounds 0", "--rounds must be at least 1; received 0"),
        ("lambert --key -1", "--key must be at least 0; received -1"),
        ("lambert --dtype half", "--dtype must be one of float32, float64"),
        ("lambert --sigma 100", "--sigma must lie between 0 and 90 degrees; received 100"),
        ("lambert --eta 2", "lambert has no eta; it takes colour"),
        ("lambert --colour 0 --angle 0", "lambert: function 0 is zero at every node"),
        ("IN/map.npy --angle 3", "--angle does not go with map.npy: a map has no viewer"),
        ("IN/map.npy --exponent 3", "--exponent is for named materials"),
        ("IN/samples.npy --method em", "--method does not go with samples.npy"),
        ("IN/nan.npy", "nan.npy: 32 of 32 pixels are NaN or infinite"),
        ("IN/dark.npy", "dark.npy: the map is black"),
        ("IN/long.npy", "long.npy: directions must be unit vectors"),
        ("IN/line.npy", "expected a map [H, W] or [H, W, C], or [N, 3] directions"),
        ("IN/complex.npy", "expected real numbers; received complex128"),
        ("IN/values.npz", "values at directions need solid angles"),
        ("IN/weights.npz", "weights must be [3]; received (2,)"),
        ("IN/more.csv", "columns x, y, z and perhaps weight; received value too"),
        ("IN/text.exr", "expected an OpenEXR image, found text"),
        ("IN/text.hdr", "expected a Radiance .hdr image, found text"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(words, text, tmp_path, capsys):
    given = tmp_path / "in"
    given.mkdir()
    arrays = {"map": np.ones((4, 8)), "samples": np.eye(3), "nan": np.full((4, 8), np.nan)}
    arrays |= {"dark": np.zeros((4, 8)), "long": np.ones((5, 3)), "line": np.ones(5)}
    arrays["complex"] = np.ones((4, 8), complex)
    for name, array in arrays.items():
        np.save(given / f"{name}.npy", array)
    np.savez(given / "values.npz", directions=np.eye(3), values=np.ones(3))
    np.savez(given / "weights.npz", directions=np.eye(3), weights=np.ones(2))
    (given / "more.csv").write_text("x,y,z,value\n0,0,1,2\n")
    for name in ("text.exr", "text.hdr"):
        (given / name).write_text("hello")
    typed = words.replace("IN", str(given)).split()
    assert main(["fit", "lobes", *typed, "-o", str(tmp_path / "o" / "p")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert text in err
    assert err.startswith("diffopt: error: ")
    assert err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["in"]
