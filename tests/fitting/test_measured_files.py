"""Files of measured reflectance: round trips, units, sRGB, and every refusal."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import colour
from diffopt.errors import InputError
from diffopt.fitting import Measured, measured_files
from diffopt.kernels import spectrum


def directions(rng, count, dtype):
    """Unit vectors above the horizon."""
    theta, phi = rng.uniform(0.0, 1.4, count), rng.uniform(0.0, 2.0 * np.pi, count)
    sine = np.sin(theta)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], -1).astype(dtype)


def some(rng, dtype="float64", *, count=7, quantity="spectral", **changes):
    wavelengths = np.linspace(0.42, 0.68, 4).astype(dtype)
    colours = quantity in ("xyz", "rgb")
    values = rng.uniform(0.1, 2.0, (count, 3 if colours else 4)).astype(dtype)
    given = {"noise": 0.02 * values, "noise_known": True, "gain": "free", "blur": 0.003}
    return Measured(
        directions(rng, count, dtype),
        directions(rng, count, dtype),
        None if colours else wavelengths,
        values,
        2.1,
        quantity=quantity,
        **(given | changes),
    )


def same(found, expected):
    """Leaves, statics and types, to the last bit."""
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("quantity", ["spectral", "relative", "power", "xyz", "rgb"])
def test_npz_keeps_everything(tmp_path, rng, dtype, quantity):
    data = some(rng, dtype, quantity=quantity)
    data.save(tmp_path / "a.npz")
    same(Measured.load(tmp_path / "a.npz"), data)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"]


@pytest.mark.parametrize("quantity", ["spectral", "relative", "power", "xyz", "rgb"])
@pytest.mark.parametrize("noise", ["each", "one", "none"])
def test_text_keeps_every_number(tmp_path, rng, dtype, quantity, noise):
    changes = {"each": {}, "one": {"noise": 0.125}, "none": {"noise": None, "noise_known": False}}
    data = some(rng, dtype, quantity=quantity, **changes[noise])
    data.save(tmp_path / "a.csv")
    # Text has no type: it is read in the default one, of which float32 is a part.
    same(Measured.load(tmp_path / "a.csv").astype(dtype), data)


def test_colours_under_another_light(tmp_path, rng):
    named = some(rng, quantity="xyz", illuminant="A")
    named.save(tmp_path / "a.csv")
    assert "# illuminant: A\n" in (tmp_path / "a.csv").read_text()
    same(Measured.load(tmp_path / "a.csv"), named)
    lam = np.linspace(0.38, 0.78, 5)
    own = some(rng, quantity="xyz", illuminant=(lam, np.array([1.0, 3.0, 2.0, 1.0, 4.0])))
    own.save(tmp_path / "own.npz")
    same(Measured.load(tmp_path / "own.npz"), own)
    with pytest.raises(InputError, match=r"own\.csv: .*illuminant by its name"):
        own.save(tmp_path / "own.csv")
    assert not (tmp_path / "own.csv").exists()


def text(tmp_path, content, name="a.csv"):
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
    return path


HEAD = "# coherence: 2000 nm\n# quantity: spectral\n"
NAMES = "theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg,450 nm,0.6 um\n"
ROWS = "10,0,20,180,0.5,0.25\n10,0,60,90,0.125,0.0625\n"


def test_angles_units_and_order_of_columns(tmp_path):
    found = Measured.load(text(tmp_path, f"# by hand\n{HEAD}# blur: 0.01\n{NAMES}{ROWS}"))
    np.testing.assert_array_equal(found.wavelengths, [0.45, 0.6])
    np.testing.assert_array_equal(found.values, [[0.5, 0.25], [0.125, 0.0625]])
    assert float(found.coherence) == 2.0
    assert float(found.blur) == 0.01
    assert not found.noise_known
    assert found.gain == "known"
    sine = np.sin(np.radians([10.0, 20.0, 60.0]))
    # Rounding of sine and cosine.
    np.testing.assert_allclose(found.wi[0], [sine[0], 0.0, np.sqrt(1 - sine[0] ** 2)], atol=1e-15)
    np.testing.assert_allclose(found.wo[0], [-sine[1], 0.0, np.sqrt(1 - sine[1] ** 2)], atol=1e-15)
    np.testing.assert_allclose(found.wo[1], [0.0, sine[2], 0.5], atol=1e-15)
    # Another order, another separator, a length in millimetres.
    turned = "0.6 um;noise 0.0006 mm;450 nm;noise 0.45 um;phi_o_deg;theta_o_deg;phi_i_deg;"
    turned += "theta_i_deg\n0.25;0.01;0.5;0.02;180;20;0;10\n"
    head = HEAD.replace("2000 nm", "0.002 mm") + "# noise_known: true\n"
    found = Measured.load(text(tmp_path, head + turned))
    np.testing.assert_array_equal(found.wavelengths, [0.6, 0.45])
    np.testing.assert_array_equal(found.values, [[0.25, 0.5]])
    np.testing.assert_array_equal(found.noise, [[0.01, 0.02]])
    assert float(found.coherence) == 2.0
    assert found.noise_known


def test_what_the_file_does_not_state_must_be_stated_once(tmp_path):
    path = text(tmp_path, NAMES + ROWS)
    with pytest.raises(InputError, match=r"a\.csv: expected coherence .* received neither"):
        Measured.load(path, quantity="spectral")
    with pytest.raises(InputError, match=r"a\.csv: expected quantity .* received neither"):
        Measured.load(path, coherence=2.0)
    found = Measured.load(path, coherence=2.0, quantity="power", noise=0.5, gain="free")
    assert found.quantity == "power"
    assert found.gain == "free"
    np.testing.assert_array_equal(found.noise, 0.5)
    full = text(tmp_path, HEAD + NAMES + ROWS)
    with pytest.raises(InputError, match="the file states coherence; leave out coherence="):
        Measured.load(full, coherence=2.0)
    with pytest.raises(InputError, match="did you mean 'coherence'"):
        Measured.load(full, coherance=2.0)
    with pytest.raises(InputError, match=r"states its units; leave out unit="):
        Measured.load(full, unit="nm")


RGB = "# coherence: 2 um\n# quantity: srgb\n"
COLOURS = "theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg,R,G,B"


def test_srgb_is_decoded_and_its_noise_with_it(tmp_path):
    encoded = np.array([[40, 10, 200], [0, 0, 0], [128, 64, 3]])
    rows = "".join(f"0,0,{10 * k},0,{r},{g},{b}\n" for k, (r, g, b) in enumerate(encoded))
    found = Measured.load(
        text(tmp_path, f"{RGB}# scale: 255\n# noise: 2\n{COLOURS}\n{rows}"), noise_known=True
    )
    assert found.quantity == "rgb"
    assert found.noise_known
    # IEC 61966-2-1 by hand; its first three values are in the power's part.
    linear = ((encoded / 255.0 + 0.055) / 1.055) ** 2.4
    linear = np.where(encoded / 255.0 <= 0.04045, encoded / 255.0 / 12.92, linear)
    np.testing.assert_allclose(found.values, linear, rtol=1e-12)
    # The noise is that of the linear values to first order: a central difference of the
    # decoding, whose error is its third derivative times (2 / 255)^2 / 6, some 1e-4.
    step = 1e-3
    up, down = (spectrum.decode_srgb(jnp.asarray(encoded / 255.0 + s)) for s in (step, -step))
    np.testing.assert_allclose(found.noise, (up - down) / (2 * step) * 2 / 255, rtol=1e-3)


def test_clipped_colours_are_left_out(tmp_path):
    rows = "0,0,0,0,1.0,0.5,0.5\n0,0,10,0,0,0.5,0.5\n0,0,20,0,0,0,0\n0,0,30,0,0.2,0.3,0.4\n"
    path = text(tmp_path, f"{RGB}{COLOURS}\n{rows}")
    with pytest.warns(UserWarning, match=r"a\.csv: 2 of 4 rows were left out.*clipped"):
        found = Measured.load(path)
    np.testing.assert_allclose(found.wo[:, 0], np.sin(np.radians([20.0, 30.0])), rtol=1e-15)
    np.testing.assert_array_equal(found.values[0], 0.0)
    only = text(tmp_path, f"{RGB}{COLOURS}\n0,0,0,0,1,0.5,0.5\n")
    with pytest.raises(InputError, match="all 1 rows are clipped"):
        Measured.load(only)
    # Noise by columns loses the same rows.
    noisy = "0,0,0,0,1,0.5,0.5,.1,.1,.1\n0,0,20,0,.04,.04,.04,.1,.2,.3\n"
    with pytest.warns(UserWarning, match="1 of 2 rows"):
        found = Measured.load(text(tmp_path, f"{RGB}{COLOURS},noise R,noise G,noise B\n{noisy}"))
    np.testing.assert_allclose(found.noise, np.array([[0.1, 0.2, 0.3]]) / 12.92, rtol=1e-12)


def test_colours_over_own_wavelengths(tmp_path):
    head = "# coherence: 2 um\n# wavelengths: 400, 500, 600 700 nm\n# illuminant: E\n"
    found = Measured.load(
        text(tmp_path, head + COLOURS.replace("R,G,B", "X,Y,Z") + "\n0,0,5,0,.1,.2,.3\n")
    )
    assert found.quantity == "xyz"
    expected = colour.spectral_weights(np.array([0.4, 0.5, 0.6, 0.7]), illuminant="E")
    np.testing.assert_array_equal(found.weights, expected)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (f"# coherance: 2 um\n{NAMES}{ROWS}", "line 1: key 'coherance' is not known; did you"),
        (f"# coherence: 2\n{NAMES}{ROWS}", "line 1: coherence must be a number and its unit"),
        (f"# coherence: 2 kg\n{NAMES}{ROWS}", "line 1: coherence has the unit 'kg'"),
        (f"{HEAD}{HEAD}{NAMES}{ROWS}", "line 3: coherence is stated twice"),
        (f"{HEAD}# noise: 2 %\n{NAMES}{ROWS}", "line 3: noise must be one number; received '2 %'"),
        (f"{HEAD}# noise_known: yes\n{NAMES}{ROWS}", "line 3: noise_known must be true or false"),
        (f"{HEAD}# wavelengths: 450 600\n{NAMES}{ROWS}", "numbers and their unit"),
        (f"{HEAD}# wavelengths: 450 nm\n{NAMES}{ROWS}", "are in the names of the columns"),
        (f"{HEAD}# scale: 255\n{NAMES}{ROWS}", "scale is for quantity srgb"),
        (
            f"{HEAD}# gain: loose\n{NAMES}{ROWS}",
            "gain must be known or free; received 'loose'",
        ),
        (f"{HEAD}# illuminant: A\n{NAMES}{ROWS}", "illuminant is for colours"),
        (f"{HEAD}# noise_known: true\n{NAMES}{ROWS}", "expected the noise, received none"),
        (f"{HEAD}{NAMES.replace('450 nm', '450nn')}{ROWS}", "column '450nn' has the unit 'nn'"),
        (f"{HEAD}{NAMES.replace('phi_o', 'phi_0')}{ROWS}", "'phi_0_deg' is not known; did you"),
        (f"{HEAD}{NAMES.replace('0.6 um', '450 nm')}{ROWS}", "column '450 nm' comes twice"),
        (
            f"{HEAD}{NAMES.replace('0.6 um', '0.45 um')}{ROWS}",
            "'0.45 um' are the same",
        ),
        (
            f"{HEAD}{NAMES.replace('0.6 um', 'X')}{ROWS}",
            "the values X, Y, Z and no others",
        ),
        (f"{HEAD}{NAMES.replace('0.6 um', 'noise 450 nm')}{ROWS[:0]}", "expected rows of values"),
        (f"{HEAD}{NAMES.replace('0.6 um', 'noise 500 nm')}{ROWS}", "no pair for '450 nm'"),
        (f"{HEAD}{NAMES.replace('phi_i_deg', 'wi_x')}{ROWS}", "received no wi_y, wi_z, wo_x"),
        (
            f"{HEAD}{NAMES}{ROWS}1,2\n",
            "line 6: expected 6 values, .* received 2",
        ),
        (
            f"{HEAD}{NAMES}{ROWS}1,2,3,4,,6\n",
            "line 6, column '450 nm': .* received ''",
        ),
        (f"{HEAD}{NAMES}{ROWS}1,2,3,4,nan,6\n", "line 6, column '450 nm': expected a number"),
        (
            f"{HEAD}{NAMES}{ROWS}90,2,3,4,5,6\n",
            "column theta_i_deg: expected 0 to below 90",
        ),
        (
            f"{HEAD}{NAMES.replace('0.6 um', 'noise 450 nm')}1,2,3,4,1,0\n",
            "column 'noise 450",
        ),
        (f"{HEAD}{NAMES}1,2,3,4,0,0\n", "finite, not all 0"),
        (HEAD, "expected a row of column names; received none"),
        (f"# quantity: rgb\n{NAMES}{ROWS}", "expected the quantity spectral or relative or power"),
        (f"{RGB}{COLOURS}\n0,0,5,0,.1,1.2,0\n", "line 4, column G: expected sRGB from 0 to 1"),
        (f"{RGB}# scale: 0\n{COLOURS}\n0,0,5,0,.1,1,0\n", "scale must be a number above 0"),
        (
            f"{HEAD}wi_x,wi_y,wi_z,wo_x,wo_y,wo_z,450 nm\n0,0,1,0,0,0.9,1\n",
            "line 4, column wo: expected a unit vector, of length; received 0.9",
        ),
        (
            f"{HEAD}wi_x,wi_y,wi_z,wo_x,wo_y,wo_z,450 nm\n0,0,1,0,0,-1,1\n",
            r"line 4, column wo: expected z above 0 \(the horizon\); received -1",
        ),
    ],
)
def test_bad_text_is_refused_by_place(tmp_path, content, words):
    with pytest.raises(InputError, match=words) as caught:
        Measured.load(text(tmp_path, content))
    assert str(caught.value).startswith(str(tmp_path / "a.csv"))
    assert "\n" not in str(caught.value)


def entries(rng, **changes):
    way = directions(rng, 3, np.float64)
    content = {
        "wi": way,
        "wo": way,
        "values": np.ones((3, 2)),
        "wavelengths": np.array([450, 600]),
        "coherence": np.array(2000.0),
        "attributes": {"quantity": "power", "units": {"wavelengths": "nm", "coherence": "nm"}},
    } | changes
    if isinstance(content["attributes"], dict):
        content["attributes"] = json.dumps(content["attributes"])
    return {name: np.asarray(array) for name, array in content.items() if array is not None}


def test_npz_of_others_with_units(tmp_path, rng):
    np.savez(tmp_path / "a.npz", **entries(rng))
    found = Measured.load(tmp_path / "a.npz")
    np.testing.assert_allclose(found.wavelengths, [0.45, 0.6], rtol=1e-15)
    assert float(found.coherence) == 2.0
    # Without attributes all is stated in the call.
    np.savez(tmp_path / "b.npz", **entries(rng, attributes=None, coherence=None))
    found = Measured.load(tmp_path / "b.npz", unit="nm", quantity="relative", coherence=2.0)
    np.testing.assert_allclose(found.wavelengths, [0.45, 0.6], rtol=1e-15)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"attributes": None}, "expected the unit of wavelengths"),
        ({"attributes": "[1, 2]"}, "attributes must be a JSON object"),
        ({"attributes": "{"}, "attributes must be a JSON object"),
        ({"attributes": {"quantity": "power", "units": []}}, "attributes must be a JSON object"),
        ({"attributes": {"quantitty": "power"}}, "'quantitty' is not known; did you mean 'quant"),
        ({"attributes": {"format": "x"}}, "expected the format"),
        ({"attributes": {"version": 9}}, "expected version 1"),
        ({"attributes": {"noise_known": 1}}, "noise_known must be true or false"),
        ({"valuess": np.ones(2)}, "entry 'valuess' is not known; did you mean 'values'"),
        ({"values": np.array(["a"])}, "values must be real numbers"),
        ({"wo": None}, "expected an entry 'wo'"),
        ({"values": np.ones((3, 4))}, r"values must be \[M, L\]"),
        ({"weights": np.ones((2, 3))}, "weights is for colours"),
        ({"wi": np.ones((3, 3))}, "wi must be unit vectors"),
    ],
)
def test_bad_npz_is_refused(tmp_path, rng, changes, words):
    path = tmp_path / "a.npz"
    np.savez(path, **entries(rng, **changes))
    with pytest.raises(InputError, match=words) as caught:
        Measured.load(path)
    assert str(caught.value).startswith(str(path))


def test_files_that_are_none(tmp_path, rng):
    for name in ("no.csv", "no.npz"):
        with pytest.raises(InputError, match="no such file"):
            Measured.load(tmp_path / name)
    for name, words in (("a.npz", "expected a NumPy archive"), ("a.txt", "read from .npz or .csv")):
        with pytest.raises(InputError, match=words):
            Measured.load(text(tmp_path, "hello", name))
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(InputError, match="the archive cannot be read"):
        Measured.load(tmp_path / "cut.npz")
    (tmp_path / "latin.csv").write_bytes(b"# 450 \xb5m\n")
    with pytest.raises(InputError, match="expected text in UTF-8"):
        Measured.load(tmp_path / "latin.csv")
    with pytest.raises(InputError, match=r"written to \.npz or \.csv"):
        some(rng).save(tmp_path / "a.txt")
    with pytest.raises(InputError, match="does not exist"):
        some(rng).save(tmp_path / "none" / "a.csv")


def test_reflectance_is_told_from_heights(tmp_path, rng):
    data = some(rng)
    for suffix in ("npz", "csv"):
        data.save(tmp_path / f"a.{suffix}")
        assert measured_files.is_measured(tmp_path / f"a.{suffix}")
    np.savez(tmp_path / "h.npz", heights=np.zeros((4, 4)))
    assert not measured_files.is_measured(tmp_path / "h.npz")
    assert not measured_files.is_measured(text(tmp_path, "# Width: 10 um\n1,2,3\n4,5,nan\n"))
    assert not measured_files.is_measured(text(tmp_path, "1 2\n", "a.txt"))
    assert measured_files.is_measured(text(tmp_path, NAMES + ROWS))
