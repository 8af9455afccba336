"""``diffopt fit heightfield``: scans and reflectance in; parameters, errors and pictures out."""

import functools
import io
import json
import math
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
from rich.console import Console

import diffopt as do
from diffopt import fitting, gratings
from diffopt.cli import fit_heightfield_output, fit_heightfield_table, main
from diffopt.cli.progress import Stages
from diffopt.drawing import pictures, surface_fits
from diffopt.kernels import spectrum

EXAMPLE = Path(__file__).parents[1] / "docs" / "examples"
SMALL = functools.partial(
    fitting.FitSettings, lattices=2, design=6, starts=3, finalists=1, rows=60, max_steps=24
)
FILES = {"parameters.json", "parameters.txt", "measured_fitted.png", "residual.png", "loss.png"}
FILES |= {"fitted.npz"}


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Few starts, coarse pictures."""
    monkeypatch.setattr(pictures, "_DPI", 40)
    monkeypatch.setattr(fitting, "FitSettings", SMALL)


def grating_data(quantity="spectral", count=11, **options):
    """A sinusoid of period 2.1 um and amplitude 0.1 um, turned by 0.3, with 1 % noise."""
    lam = np.array([0.45, 0.55, 0.65])
    x, y = np.meshgrid(*2 * [np.linspace(-0.7, 0.7, count)])
    wo = np.stack([x, y, np.sqrt(1 - x**2 - y**2)], -1).reshape(-1, 3)
    wi = np.broadcast_to([0.1, 0.0, math.sqrt(0.99)], wo.shape)
    true = gratings.Sinusoidal(2.1, 0.1, 0.0, 0.3)
    reach = gratings.Reach(4, 32)
    f = np.asarray(gratings.brdf(true, wi, wo, lam, np.float64(1.0), reach=reach))
    if quantity == "xyz":
        f = f @ np.asarray(do.colour.spectral_weights(lam))
    noise = 0.01 * f + 1e-3 * f.max()
    f = f + noise * np.random.default_rng(3).normal(size=f.shape)
    given = {"quantity": quantity, "noise": noise, "noise_known": True} | options
    return fitting.Measured(wi, wo, lam, f, 1.0, **given)


def scan(**changes):
    """A tilted sinusoid with white noise of 2 nm and a hole."""
    true = gratings.Sinusoidal(1.3, 0.05, 0.4, 0.2)
    # As the fit takes pixels: means over their area.
    heights = np.array(true.heights((48, 48), 0.1, edges="averaged"), np.float64)
    heights += 0.003 * np.arange(48) + 0.002 * np.random.default_rng(5).normal(size=(48, 48))
    heights[20:23, 10:14] = np.nan
    return do.Heightfield(heights, 0.1, missing="keep")


def strict(path):
    """JSON without NaN or Infinity."""

    def refuse(word):
        raise AssertionError(f"{word} in {path}")

    return json.loads(path.read_text(), parse_constant=refuse)


def drawn(folder, names):
    for name in names:
        with PIL.Image.open(folder / name) as image:
            assert np.asarray(image.convert("RGB"), np.float64).std() > 2.0, name


@pytest.fixture
def few(monkeypatch):
    """The fit of reflectance with small settings, whichever way it is called."""
    real = fitting.fit_heightfield

    def fit(data, model="auto", **options):
        if isinstance(data, fitting.Measured) and not isinstance(model, do.Heightfield):
            options.setdefault("settings", SMALL())
        return real(data, model, **options)

    monkeypatch.setattr(fitting, "fit_heightfield", fit)
    return fit


def test_the_example_file_is_fitted(tmp_path, capsys, few):
    target = tmp_path / "out"
    file = EXAMPLE / "grating_reflectance.csv"
    assert file.stat().st_size < 60_000
    assert main(["fit", "heightfield", str(file), "--model", "binary", "-o", str(target)]) == 0
    assert {p.name for p in target.iterdir()} == FILES
    drawn(target, [name for name in FILES if name.endswith(".png")])
    content = strict(target / "parameters.json")
    truth = {"period": 2.6, "depth": 0.2, "duty": 0.3, "angle": 0.6}
    for name, value in truth.items():
        row = content["parameters"][name]
        # Four normal errors; the draw is fixed.
        assert abs(row["value"] - value) < 4 * row["error"], name
        assert row["identifiable"] == "determined"
        assert row["error"] < 0.01
    assert content["converged"] is True
    assert content["names"] == list(truth)
    assert np.shape(content["covariance"]) == (4, 4)
    np.testing.assert_allclose(
        np.sqrt(np.diag(content["covariance"])),
        [content["parameters"][name]["error"] for name in truth],
        rtol=1e-12,
    )
    # The noise of the file is known: 2,005 values give 1 to sqrt(2 / 2005) = 0.03.
    assert 0.88 < content["chi2"] < 1.12
    assert content["parameters"]["shift"]["error"] is None
    assert "not determined" in content["parameters"]["shift"]["identifiable"]
    assert content["parameters"]["angle"]["unit"] == "rad"
    assert content["provenance"]["file"] == str(file)
    # The table on the screen is the table in the file; angles are in degrees there.
    out, kept = capsys.readouterr().out, (target / "parameters.txt").read_text()
    assert re.sub(r"\s+", " ", kept) in re.sub(r"\s+", " ", out)
    assert re.search(r"angle +34\.\d+ +0\.0\d+ +deg +yes", kept)
    # Residuals and values add up to the data.
    data = fitting.Measured.load(file)
    with np.load(target / "fitted.npz") as arrays:
        np.testing.assert_allclose(
            arrays["values"] - arrays["residual"], data.values, rtol=0, atol=1e-12
        )
        assert json.loads(str(arrays["attributes"]))["units"]["wavelengths"] == "um"


@pytest.mark.long
def test_several_models_are_ranked(tmp_path, capsys, few):
    grating_data().save(tmp_path / "a.npz")
    target = tmp_path / "out"
    words = ["--model", "blazed,sinusoidal", "-o", str(target)]
    assert main(["fit", "heightfield", str(tmp_path / "a.npz"), *words]) == 0
    content = strict(target / "parameters.json")
    assert content["model"] == "sinusoidal"
    assert [row["name"] for row in content["ranking"]] == ["sinusoidal", "blazed"]
    assert content["ranking"][0]["difference"] == 0.0
    assert content["ranking"][1]["difference"] > 10.0
    assert re.search(r"blazed +\+\d", capsys.readouterr().out)


def test_a_scan_is_fitted_with_its_tilt_and_holes(tmp_path, capsys):
    given = scan()
    given.save(tmp_path / "scan.npz")
    target = tmp_path / "out"
    words = ["--model", "sinusoidal", "--no-drift", "-o", str(target)]
    assert main(["fit", "heightfield", str(tmp_path / "scan.npz"), *words]) == 0
    assert {p.name for p in target.iterdir()} == FILES
    drawn(target, [name for name in FILES if name.endswith(".png")])
    content = strict(target / "parameters.json")
    for name, value in {"period": 1.3, "amplitude": 0.05, "angle": 0.2}.items():
        row = content["parameters"][name]
        assert abs(row["value"] - value) < 4 * row["error"], name
    assert content["tilt"][1] == pytest.approx(0.03, abs=1e-3)
    assert content["settings"]["drift"] is False
    # Fitted heights are read as a scan, and with the residual they are the scan.
    back = do.Heightfield.load(target / "fitted.npz", missing="keep")
    with np.load(target / "fitted.npz") as arrays:
        residual = arrays["residual"]
    known = ~np.isnan(given.heights)
    np.testing.assert_array_equal(np.isnan(residual), ~known)
    np.testing.assert_allclose((back.heights + residual)[known], given.heights[known], atol=1e-12)
    assert np.nanstd(residual) == pytest.approx(0.002, rel=0.1)
    assert "sinusoidal, from a scan" in capsys.readouterr().out


@pytest.mark.long
def test_a_scan_without_a_grating_is_no_answer(tmp_path, capsys):
    target = tmp_path / "out"
    rng = np.random.default_rng(1)
    do.Heightfield(0.01 * rng.normal(size=(32, 32)), 0.1).save(tmp_path / "noise.npz")
    words = ["--model", "sinusoidal", "-o", str(target)]
    assert main(["fit", "heightfield", str(tmp_path / "noise.npz"), *words]) == 1
    content = strict(target / "parameters.json")
    assert content["converged"] is False
    assert content["reason"].endswith(".")
    out = re.sub(r"\s+", " ", capsys.readouterr().out)
    assert f"no answer {content['reason']}" in out
    assert {p.name for p in target.iterdir()} == FILES


def test_random_surfaces_are_drawn_by_their_spectrum(tmp_path):
    true = gratings.Roughness(0.02, 0.4)
    true.heightfield((48, 48), 0.1, key=jax.random.key(0)).save(tmp_path / "rough.npz")
    target = tmp_path / "out"
    words = ["--model", "roughness", "-o", str(target)]
    main(["fit", "heightfield", str(tmp_path / "rough.npz"), *words])
    drawn(target, [name for name in FILES if name.endswith(".png")])
    with np.load(target / "fitted.npz") as arrays:
        assert "one draw" in str(arrays["attributes"])
        spread = arrays["heights"].std()
    # Some 20 correlation areas: the rms of one draw is within a third of the fitted one.
    fitted = strict(target / "parameters.json")["parameters"]["rms"]["value"]
    assert spread == pytest.approx(fitted, rel=0.33)


def test_every_height_from_a_start(tmp_path, capsys):
    rng = np.random.default_rng(7)
    shape, pixel = (16, 16), 0.25
    smooth = np.fft.fft2(rng.normal(size=shape))
    f = np.hypot(*np.meshgrid(np.fft.fftfreq(16, pixel), np.fft.fftfreq(16, pixel)))
    true = np.real(np.fft.ifft2(smooth * np.exp(-((f / 0.4) ** 2))))
    true = 0.05 * true / true.std()
    start = do.Heightfield(0.9 * true, pixel)
    data = grating_data(count=8)
    brdf = do.DiffractionBRDF(do.Heightfield(true, pixel), 0.5)
    f = np.asarray(brdf(data.wi, data.wo, data.wavelengths))
    data = fitting.Measured(
        data.wi, data.wo, data.wavelengths, 3.0 * f, 0.5, noise=0.02 * f.max(), gain="free"
    )
    data.save(tmp_path / "a.csv")
    start.save(tmp_path / "start.npz")
    target = tmp_path / "out"
    words = ["--start", str(tmp_path / "start.npz"), "--level", "none", "--solver", "lbfgs"]
    code = main(["fit", "heightfield", str(tmp_path / "a.csv"), *words, "-o", str(target)])
    content = strict(target / "parameters.json")
    assert code == (0 if content["converged"] else 1)
    assert {p.name for p in target.iterdir()} == FILES | {"heights.png"}
    drawn(target, ["heights.png", "measured_fitted.png", "loss.png"])
    back = do.Heightfield.load(target / "fitted.npz")
    assert back.shape == shape
    # What is drawn as fitted is what the fit says of itself.
    with np.load(target / "fitted.npz") as arrays:
        misfit = np.linalg.norm(arrays["residual"]) / np.linalg.norm(data.values)
    # The forward settings of the fit leave 1e-6 of a mirror's peak.
    assert misfit == pytest.approx(content["misfit"], rel=1e-3)
    assert content["gain"] == pytest.approx(3.0, rel=0.1)
    assert content["heights"]["shape"] == [16, 16]
    assert "every height, from reflectance" in capsys.readouterr().out


def test_an_interrupted_fit_is_kept(tmp_path, capsys, monkeypatch, few):
    """Ctrl-C after the first solve: the best until then, exit code 1."""
    grating_data().save(tmp_path / "a.npz")
    told = []
    real = Stages.tell

    def tell(self, text):
        told.append(text)
        real(self, text)
        if "misfit" in text:
            raise KeyboardInterrupt

    monkeypatch.setattr(Stages, "tell", tell)
    target = tmp_path / "out"
    words = ["--model", "sinusoidal", "-o", str(target)]
    assert main(["fit", "heightfield", str(tmp_path / "a.npz"), *words]) == 1
    content = strict(target / "parameters.json")
    assert content["converged"] is False
    assert "interrupted" in content["reason"]
    assert content["reason"] in re.sub(r"\s+", " ", capsys.readouterr().out)
    assert {p.name for p in target.iterdir()} == FILES
    assert len(told) > 1


def test_interrupted_before_anything_is_found(tmp_path, capsys, monkeypatch):
    grating_data().save(tmp_path / "a.npz")

    def tell(self, text):
        raise KeyboardInterrupt

    monkeypatch.setattr(Stages, "tell", tell)
    target = tmp_path / "out"
    assert main(["fit", "heightfield", str(tmp_path / "a.npz"), "-o", str(target)]) == 130
    assert not target.exists()
    assert capsys.readouterr().out == ""


@pytest.mark.long
def test_colours_that_are_clipped_leave_a_note(tmp_path, capsys):
    data = grating_data("xyz")
    linear = np.asarray(do.colour.xyz_to_linear(data.values))
    encoded = np.array(spectrum.encode_srgb(jnp.asarray(0.5 * linear / linear.max())))
    encoded[0, 0] = 1.0
    rows = np.concatenate([data.wi, data.wo, encoded.clip(1e-3)], axis=1)
    text = "# coherence: 1 um\n# gain: free\n# wavelengths: 450 550 650 nm\n"
    text += "wi_x,wi_y,wi_z,wo_x,wo_y,wo_z,R,G,B\n"
    text += "".join(",".join(map(repr, row)) + "\n" for row in rows.tolist())
    (tmp_path / "a.csv").write_text(text)
    words = ["--model", "sinusoidal", "--quantity", "srgb", "--free", "period,angle,amplitude"]
    main(["fit", "heightfield", str(tmp_path / "a.csv"), *words, "-o", str(tmp_path / "out")])
    content = strict(tmp_path / "out" / "parameters.json")
    assert "1 of 121 rows were left out" in content["notes"][0]
    assert "note: " in capsys.readouterr().out
    assert content["parameters"]["period"]["value"] == pytest.approx(2.1, rel=0.02)
    drawn(tmp_path / "out", ["measured_fitted.png", "residual.png"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("no.csv", "no such file"),
        ("scan.npz --free period", "--free is for reflectance"),
        ("scan.npz --start scan.npz", "--start is for reflectance"),
        ("scan.npz --coherence 2", "--coherence is for reflectance"),
        ("scan.npz --solver lm", "--solver is for reflectance"),
        ("scan.npz --fill", "--fill is for --start"),
        ("scan.npz --model cheese", "cheese"),
        ("scan.npz --level up", "--level must be one of"),
        ("scan.npz --dtype float16", "--dtype must be one of"),
        ("sample:nothing", "nothing"),
        ("a.npz --coherence 3", "the file states coherence"),
        ("a.npz --model cheese", "cheese"),
        ("a.npz --model auto,binary", "auto stands alone"),
        ("a.npz --model binary,", "names separated by commas"),
        ("a.npz --model binary --start scan.npz", "goes without --model"),
        ("a.npz --solver cg", "--solver must be one of normal-lm"),
        ("a.npz --start scan.npz --fill --solver lm", "--solver must be one of lbfgs, cg"),
        ("a.npz --start scan.npz --fill --free period", "--free names parameters"),
        ("a.npz --start scan.npz", "pixels are missing; add --fill"),
        ("a.npz --no-drift", "--no-drift is for scans"),
        ("a.npz --pixel-size 0.1", "--pixel-size is for scans"),
        ("a.npz --model binary --free colour", "colour"),
        ("bare.csv --model binary", "expected coherence"),
        ("bare.csv --model binary --coherence 1", "expected quantity"),
    ],
)
def test_what_does_not_go_together(tmp_path, capsys, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    grating_data(count=4).save("a.npz")
    scan().save("scan.npz")
    Path("bare.csv").write_text("theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg,450 nm\n0,0,9,0,1\n")
    before = set(tmp_path.iterdir())
    assert main(["fit", "heightfield", *words.split(), "-o", "out"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("diffopt: error: ")
    assert error.count("\n") == 1
    assert said in error
    assert set(tmp_path.iterdir()) == before


def test_nothing_is_written_without_a_folder(tmp_path, capsys, monkeypatch, few):
    monkeypatch.chdir(tmp_path)
    grating_data().save("a.csv")
    assert main(["fit", "heightfield", "a.csv", "--model", "sinusoidal", "--dtype", "float32"]) == 0
    assert [p.name for p in tmp_path.iterdir()] == ["a.csv"]
    assert "period" in capsys.readouterr().out


def test_json_has_no_number_that_is_none():
    given = {"a": math.nan, "b": [math.inf, 1.0, np.float32(2.0)], "c": np.array([1, -np.inf])}
    given |= {"d": True, "e": None, "f": np.int64(3), "g": (np.bool_(True), "x")}
    found = fit_heightfield_output.plain(given)
    assert found == {
        "a": None,
        "b": [None, 1.0, 2.0],
        "c": [1.0, None],
        "d": True,
        "e": None,
        "f": 3,
        "g": [True, "x"],
    }
    json.dumps(found, allow_nan=False)


def test_brackets_in_sentences_are_printed():
    row = {"name": "disc", "difference": None, "parameters": 0, "misfit": None}
    row |= {"converged": False, "reason": "expected [ny, nx]."}
    parameter = {"value": 1.0, "error": None, "unit": "um", "identifiable": "not [bold]."}
    content = {
        "what": "reflectance",
        "converged": False,
        "reason": "no [red].",
        "misfit": 0.1,
        "units": {"misfit": "norm"},
        "provenance": {},
        "seconds": 1.0,
        "parameters": {"period": parameter},
        "ranking": [row | {"difference": 0.0, "misfit": 0.1}, row],
        "notes": ["a [dim] note"],
    }
    console = Console(file=io.StringIO(), width=200)
    fit_heightfield_table.show(console, content)
    text = console.file.getvalue()
    for words in ("no [red].", "not [bold].", "expected [ny, nx].", "a [dim] note"):
        assert words in text


def test_curves_of_every_shape_are_drawn(tmp_path):
    curves = {
        "stage": np.array([[1.0, 0.5, np.nan], [0.9, 0.1, 0.05]]),
        "one": np.array([2.0, 1.0]),
        "nothing": np.array([np.nan, np.nan]),
        "dead start": np.array([[np.nan, np.nan], [1.0, 0.3]]),
    }
    figure = surface_fits.losses("all", curves, likelihoods={"rough": np.array([-3.0, -9.0])})
    left, right = figure.axes
    labels = [text.get_text() for text in left.get_legend().get_texts()]
    assert labels == ["stage, best of 2 starts", "one", "dead start"]
    assert [line.get_ydata()[-1] for line in right.lines] == [-9.0]
    pictures.save(figure, tmp_path / "a.png")
    drawn(tmp_path, ["a.png"])
