"""Bad inputs: one line that names the cause, exit code 2, nothing left behind."""

import os
import struct
import subprocess
import sys
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

from diffopt import DiffractionBRDF, Heightfield, InputError, TaylorSettings, fresnel
from diffopt.cli import limits, main

HEIGHTS = 0.05 * np.sin(np.arange(24.0)[:, None] + 0.5 * np.arange(32.0)[None, :])


def png(path, heights=HEIGHTS):
    grey = np.rint(255 * (heights - heights.min()) / np.ptp(heights)).astype(np.uint8)
    PIL.Image.fromarray(grey).save(path, format="PNG")
    return path


def npz(path, heights=HEIGHTS):
    Heightfield(jnp.asarray(heights), 0.1, missing="keep").save(path)
    return path


def truncated_png(path):
    content = png(path).read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path


def truncated_npz(path):
    content = npz(path).read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path


def huge_npy(path):
    header = str({"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}).encode()
    header += b" " * (63 - (10 + len(header)) % 64) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    return path


def huge_png(path):
    body = b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 0, 0, 0, 0)
    chunk = struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk + b"\x00\x00\x00\x00IEND\xaeB`\x82")
    return path


def write(content):
    def make(path):
        path.write_bytes(content)
        return path

    return make


def folder(path):
    path.mkdir()
    return path


def text(content):
    return write(content.encode())


def with_nan(path):
    heights = HEIGHTS.copy()
    heights[3, 4:9] = np.nan
    return npz(path, heights)


def numbers(array):
    def make(path):
        np.save(path, array)
        return path

    return make


NPY = ["--pixel-size", "0.1", "--height-unit", "um"]
GREY = ["--pixel-size", "0.1", "--height-range", "0.2"]

# name of the file, how it is made (None: not at all), options, what the message says
FILES = {
    "missing": ("gone.npz", None, [], "no such file"),
    "directory": ("scan.npz", folder, [], "is a folder; expected a file"),
    "empty": ("scan.png", write(b""), GREY, "the file is empty"),
    "truncated PNG": ("scan.png", truncated_png, GREY, "truncated"),
    "truncated archive": ("scan.npz", truncated_npz, [], "the archive cannot be read"),
    "renamed": ("scan.npy", png, NPY, "found a PNG image"),
    "renamed instrument": ("scan.sur", png, [], "a PNG image"),
    "no known format": ("scan.foo", write(b"\x01\x02\x03" * 50), [], "no reader knows this file"),
    "letters": ("scan.txt", text("1 2 3\n4 five 6\n7 8 9\n"), NPY, "five"),
    "ragged": ("scan.txt", text("1 2 3\n4 5\n7 8 9\n"), NPY, "scan.txt"),
    "PNG without pixel": ("scan.png", png, ["--height-range", "0.2"], "pass --pixel-size"),
    "PNG without range": ("scan.png", png, ["--pixel-size", "0.1"], "--height-range"),
    "matrix without unit": ("scan.npy", numbers(HEIGHTS), NPY[:2], "pass --height-unit"),
    "unit of mass": ("scan.npy", numbers(HEIGHTS), [*NPY[:2], "--height-unit", "kg"], "kg"),
    "negative pixel": ("scan.png", png, [*GREY, "--pixel-size", "-0.1"], "positive"),
    "pixel of letters": ("scan.png", png, [*GREY, "--pixel-size", "a,b"], "received 'a,b'"),
    "contradicted pixel": ("scan.npz", npz, ["--pixel-size", "0.2"], "contradicts the file"),
    "upside-down range": ("scan.png", png, [*GREY, "--height-range", "0.2,0.1"], "low < high"),
    "one pixel": ("scan.npy", numbers(np.zeros((1, 1))), NPY, "expected at least 2x2"),
    "three pixels": ("scan.npy", numbers(np.eye(3)), NPY, "at least 4 x 4"),
    "NaN": ("scan.npz", with_nan, [], "5 of 768 pixels are missing; add --fill"),
    "all NaN": ("scan.npy", numbers(np.full((9, 9), np.nan)), NPY, "every pixel is missing"),
    "infinite": ("scan.npy", numbers(np.full((9, 9), np.inf)), NPY, "infinite heights"),
    "complex": ("scan.npy", numbers(np.eye(9) * 1j), NPY, "expected a real"),
    "objects": ("scan.npy", numbers(np.array([{}], object)), NPY, "cannot be read"),
    "volume": ("scan.npy", numbers(np.zeros((4, 4, 4))), NPY, r"found float64 \(4, 4, 4\)"),
    "huge array": ("scan.npy", huge_npy, NPY, r"1e\+12 samples; at most 1.34e\+08"),
    "huge picture": ("scan.png", huge_png, GREY, r"1e\+10 samples; at most 1.34e\+08"),
    "no such channel": ("scan.npz", npz, ["--channel", "7"], "--channel"),
}

OPTIONS = {
    "unknown option": (["--colour", "red"], "--colour"),
    "unknown method": (["--method", "magic"], "--method must be one of auto, direct"),
    "unknown material": (["--material", "wood"], "material: 'wood' given"),
    "index of one": (["--material", "n=1"], "reflects nothing"),
    "unknown illuminant": (["--illuminant", "D99"], "--illuminant: 'D99' given, expected one of"),
    "unknown level": (["--level", "sphere"], "--level must be one of plane"),
    "unknown balance": (["--balance", "warm"], "--balance must be one of radiometric, peak"),
    "unknown average": (["--average", "all"], "--average must be one of positions, window"),
    "unknown dtype": (["--dtype", "float16"], "--dtype must be one of auto, float32, float64"),
    "coherence zero": (["--coherence", "0"], "coherence must lie between the pixel"),
    "coherence negative": (["--coherence", "-1"], "received -1 um"),
    "coherence too large": (["--coherence", "1.3"], r"half the patch \(1.2 um\); received 1.3"),
    "coherence NaN": (["--coherence", "nan"], "coherence must lie between"),
    "incidence": (["--incidence", "95"], "--incidence must lie between -90 and 90 degrees"),
    "incidence of letters": (["--incidence", "steep"], "--incidence"),
    "azimuth": (["--azimuth", "inf"], "--azimuth must be a number of degrees"),
    "source angle": (["--source-angle", "-1"], "--source-angle must lie between 0 and 60"),
    "tolerance zero": (["--tolerance", "0"], r"relative error in \(0, 1\); received 0"),
    "tolerance two": (["--tolerance", "2"], r"relative error in \(0, 1\); received 2"),
    "no size": (["--size", "3"], "--size must lie between 16 and 4096 pixels; received 3"),
    "half a pixel": (["--size", "99.5"], "--size"),
    "option for files": (["--pixel-size", "0.1"], "--pixel-size is for files"),
}


def check_refusal(words, match, capsys):
    code = main(words)
    out, err = capsys.readouterr()
    assert code == 2
    assert out == ""
    assert err.startswith("diffopt: error: ")
    assert err.count("\n") == 1, f"more than one line: {err}"
    assert "Traceback" not in err
    with pytest.raises(InputError, match=match):
        raise InputError(err)


@pytest.mark.parametrize("case", FILES)
def test_unusable_files(case, tmp_path, capsys):
    name, make, options, match = FILES[case]
    folder = tmp_path / "in"
    folder.mkdir()
    path = folder / name
    if make is not None:
        make(path)
    target = tmp_path / "deep" / "out"
    check_refusal(["diffraction", str(path), *options, "-o", str(target)], match, capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["in"]
    check_refusal(["info", str(path), *options], match, capsys)


def test_a_pixel_too_coarse_for_the_hemisphere(tmp_path, capsys):
    """Refused with the pixel that would do, or drawn with a warning if asked."""
    path = tmp_path / "scan.npy"
    np.save(path, HEIGHTS)
    words = ["diffraction", str(path), "--height-unit", "um", "--pixel-size", "0.3"]
    target = tmp_path / "out"
    # 0.38 / (2 (1 + sin 20 degrees)) um
    match = r"pixel 0.3 um is too coarse .* at most 0.1416 um will do; --allow-coarse goes on"
    check_refusal([*words, "-o", str(target)], match, capsys)
    assert not target.exists()


@pytest.mark.parametrize("case", OPTIONS)
def test_unusable_options(case, tmp_path, capsys):
    options, match = OPTIONS[case]
    target = tmp_path / "deep" / "out"
    path = npz(tmp_path / "scan.npz")
    scan = ["sample:flat"] if "is for files" in match else [str(path)]
    check_refusal(["diffraction", *scan, *options, "-o", str(target)], match, capsys)
    assert [p.name for p in tmp_path.iterdir()] == ["scan.npz"]


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["diffraction"], "(?i)missing argument 'file'"),
        (["diffraction", "sample:vinyl"], "no sample 'vinyl'; expected one of"),
        (["paint", "sample:flat"], "No such command 'paint'"),
        (["accuracy", "diffraction.magic"], "no study 'diffraction.magic'; expected one of"),
        (["accuracy", "--tolerance", "5"], "tolerance must be a relative error"),
        (["bench", "sorting"], "benchmark must be one of"),
        (["bench", "--size", "giant"], "--size must be one of small, full"),
        (["bench", "-o", "nowhere/bench.csv"], "the folder nowhere does not exist"),
        (["bench", "--repeats", "0"], "--repeats must be at least 1"),
        (["info", "sample:flat", "--key", "x"], "--key"),
    ],
)
def test_unusable_commands(words, match, capsys):
    check_refusal(words, match, capsys)


# content of ring.obj, options, what the message says
MESHES = {
    "missing": (None, [], "ring.obj: no such file"),
    "points": ("v 0 0 0\nv 1 0 0\n", [], "ring.obj: no faces; found 2 points, expected triangles"),
    "flat": ("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", [], "none of the 1 faces has an area"),
    "words": (..., ["--mesh-light", "left"], "--mesh-light must be a direction X,Y,Z, .*'left'"),
    "two": (..., ["--mesh-direction", "1,0"], "--mesh-direction must be .* received '1,0'"),
    "zero": (..., ["--mesh-up", "0,0,0"], "--mesh-up must be a direction .* not all 0"),
    "infinite": (..., ["--mesh-eye", "inf,0,0"], "--mesh-eye must be a direction"),
    "upwards": (..., ["--mesh-eye", "0,2,0"], "--mesh-eye 0,2,0 lies along the upward direction"),
    "turn": (..., ["--mesh-turn", "nan"], "--mesh-turn must be a number of degrees"),
}


@pytest.mark.parametrize("case", MESHES)
def test_unusable_meshes(case, tmp_path, capsys):
    content, options, match = MESHES[case]
    path = tmp_path / "ring.obj"
    if content is not None:
        path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" if content is ... else content)
    words = ["diffraction", "sample:flat", "--mesh", str(path), *options]
    check_refusal([*words, "-o", str(tmp_path / "out")], match, capsys)
    assert not (tmp_path / "out").exists()


def test_options_of_a_mesh_without_one(capsys):
    words = ["diffraction", "sample:flat", "--mesh-turn", "3"]
    check_refusal(words, "--mesh-turn needs --mesh FILE", capsys)


def test_the_folder_of_results_is_a_file(tmp_path, capsys):
    for target in (tmp_path / "out", tmp_path / "out" / "deeper"):
        (tmp_path / "out").write_text("mine")
        words = ["diffraction", "sample:flat", "-o", str(target)]
        check_refusal(words, "is a file; expected a folder", capsys)
        assert [p.name for p in tmp_path.iterdir()] == ["out"]
        assert (tmp_path / "out").read_text() == "mine"


def test_the_folder_of_results_cannot_be_written_to(tmp_path, capsys, monkeypatch):
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if os.access(locked, os.W_OK):
        # Permissions do not bind this user: the system call refuses in their place.
        def refuse(self, *_, **__):
            raise PermissionError(13, "Permission denied", str(self))

        monkeypatch.setattr("pathlib.Path.mkdir", refuse)
    check_refusal(
        ["diffraction", "sample:flat", "-o", str(locked / "out")], "ermission denied", capsys
    )
    assert list(locked.iterdir()) == []


def test_an_interrupted_second_run_leaves_the_first_as_it_was(tmp_path, capsys):
    target = tmp_path / "out"
    target.mkdir()
    (target / "result.json").write_text("{}")
    words = ["diffraction", "sample:flat", "--coherence", "100", "-o", str(target)]
    check_refusal(words, "coherence must lie between", capsys)
    assert [p.name for p in target.iterdir()] == ["result.json"]
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_taylor_terms_that_float32_cannot_carry(tmp_path, capsys):
    # 2 pi 2 h / 0.38 of 0.91 um peak to valley is a phase range of 30.
    with jax.enable_x64(False):
        heights = 9.1 * HEIGHTS.astype(np.float32)
        path = npz(tmp_path / "deep.npz", heights)
    target = tmp_path / "out"
    words = ["diffraction", str(path), "--method", "taylor", "--dtype", "float32", "--size", "16"]
    check_refusal([*words, "-o", str(target)], "cannot carry Taylor terms over a phase", capsys)
    assert not target.exists()


def test_debugging_shows_the_traceback(monkeypatch):
    monkeypatch.setenv("DIFFOPT_DEBUG", "1")
    with pytest.raises(InputError, match="no sample 'vinyl'"):
        main(["info", "sample:vinyl"])


def test_a_lack_of_memory_is_no_traceback(monkeypatch, capsys):
    def starve(*_, **__):
        raise MemoryError("Unable to allocate 7 TiB")

    monkeypatch.setattr(Heightfield, "load", starve)
    check_refusal(["info", "any.npz"], "not enough memory for this input: Unable", capsys)


@pytest.mark.parametrize("name", ["a.npz", "a.tif"])
def test_claims_of_archives_and_tiffs_are_counted(name, tmp_path, monkeypatch):
    path = tmp_path / name
    Heightfield(jnp.asarray(HEIGHTS), 0.1).save(path)
    limits.refuse_enormous(path)
    monkeypatch.setattr(limits, "MOST_SAMPLES", HEIGHTS.size - 1)
    with pytest.raises(InputError, match="768 samples; at most 767"):
        limits.refuse_enormous(path)


@pytest.fixture(scope="module")
def brdf():
    return DiffractionBRDF(Heightfield(jnp.asarray(HEIGHTS), 0.1), 0.5)


UP, LAM = np.array([0.0, 0.0, 1.0]), np.array([0.5])


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ((2.0 * UP, UP, LAM), "wi must be unit vectors; received one of length 2"),
        ((UP, UP * np.nan, LAM), "wo must be unit vectors"),
        ((UP, np.ones(2), LAM), r"wo must be unit vectors \[..., 3\]; received shape \(2,\)"),
        ((UP, UP, np.array([0.0])), "wavelengths must be positive"),
        ((UP, UP, np.array([-0.5])), "received -0.5"),
        ((UP, UP, np.array([550.0])), r"received 550 \(nanometres\? divide by 1000\)"),
        ((UP, UP, np.array([np.nan])), "wavelengths must be positive"),
        ((UP, UP, np.zeros(0)), "wavelengths must hold at least one value"),
    ],
)
def test_unusable_directions_and_wavelengths(brdf, arguments, match):
    with pytest.raises(InputError, match=match):
        brdf(*arguments)


def test_unusable_models():
    scan = Heightfield(jnp.asarray(HEIGHTS), 0.1)
    for value in (0.0, -1.0, 1.3, np.nan, np.inf):
        with pytest.raises(InputError, match="coherence must lie between the pixel"):
            DiffractionBRDF(scan, value)
    with pytest.raises(InputError, match="blur needs average='positions'"):
        DiffractionBRDF(scan, 0.5, average="window", blur=0.01)
    with pytest.raises(InputError, match="repeats needs coherence=None"):
        DiffractionBRDF(scan, 0.5, repeats=(2, 2))
    for pixel in (0.0, -0.1, np.nan, np.inf):
        with pytest.raises(InputError, match="expected one positive number or a pair"):
            Heightfield(jnp.asarray(HEIGHTS), pixel)
    with pytest.raises(InputError, match="expected a floating-point"):
        Heightfield(jnp.arange(12).reshape(3, 4), 0.1)
    for word in ("", "n=", "n=glass", "schlick=2", "gold", "constant=-1"):
        with pytest.raises(InputError, match="material"):
            fresnel.parse(word)


def test_unusable_jobs(brdf):
    for value in (0.0, 2.0, -1.0, np.nan):
        with pytest.raises(InputError, match="tolerance must be a relative error"):
            brdf.prepare(pairs=10, tolerance=value)
    with pytest.raises(InputError, match="magic"):
        brdf.prepare(pairs=10, method="magic")
    with pytest.raises(InputError, match="pairs must be at least 1; received 0"):
        brdf.prepare(pairs=0)
    with pytest.raises(InputError, match="at least one pair above the horizon"):
        brdf.prepare(pairs=(-UP, UP))
    bare = DiffractionBRDF(Heightfield(jnp.asarray(HEIGHTS), 0.1), None)
    with pytest.raises(InputError, match="gathers with a coherence window"):
        bare.prepare(pairs=(UP, UP), settings=TaylorSettings())


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["diffraction", "gone.sur"], "diffopt: error: gone.sur: no such file\n"),
        (["diffraction", "sample:flat", "--incidence", "95"], "--incidence must lie between"),
        (["--nonsense"], "--nonsense"),
    ],
)
def test_programs_refuse_bad_input_in_one_line(words, match, tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "diffopt", *words],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        cwd=tmp_path,
    )
    assert done.returncode == 2
    assert match in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
