"""Materials by name and by file, the property report, its pictures, and ``diffopt material``."""

import json
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

from diffopt import InputError, colour
from diffopt.cli import main
from diffopt.drawing import lobes
from diffopt.materials import Lambert, Mirror, Phong, RoughDielectric, naming
from diffopt.materials.report import over_sphere, properties
from diffopt.materials.tensorfile import write_tensors

PICTURES = {"lobes.png", "hemisphere.png", "sphere.png", "albedo.png", "swatch.png"}
LIGHT = 30.0


@pytest.fixture(scope="module")
def lambert():
    return properties(Lambert(np.array([0.2, 0.5, 0.9])))


@pytest.fixture(scope="module")
def book():
    """Exponent, and the report of a lobe that neither is reciprocal nor conserves energy."""
    return 20.0, properties(Phong(0.8, 20.0, normalisation="book"))


class Braggart(Lambert):
    """Claims what it does not keep, one thing at a time."""

    lies: str = eqx.field(static=True, default="")

    def value(self, wi, wo):
        same_side = (wi[..., 2:] * wo[..., 2:] > 0.0).astype(wi.dtype)
        factors = {"lopsided": 1.0 + 0.01 * wi[..., :1], "transmits": same_side}
        return factors.get(self.lies, 1.0) * super().value(wi, wo)

    def density(self, wi, wo):
        return (0.5 if self.lies == "dense" else 1.0) * super().density(wi, wo)

    @property
    def transmits(self):
        return self.lies == "transmits"


class Denied(Mirror):
    @property
    def delta(self):
        return False


def test_report_of_lambert_is_exact(lambert):
    np.testing.assert_array_equal(lambert.albedo, np.broadcast_to([0.2, 0.5, 0.9], (22, 2, 3)))
    assert (lambert.energy, lambert.energy_channel, lambert.energy_at) == (0.9, 2, (0.0, 0.0))
    assert lambert.reciprocity == 0.0
    np.testing.assert_allclose(lambert.pdf, 1.0, atol=1e-9)
    assert lambert.holds == dict.fromkeys(
        ("reciprocal", "conserves_energy", "delta", "transmits", "pdf"), True
    )
    assert lambert.broken == ()


def test_textbook_lobes_are_neither_reciprocal_nor_bounded(book):
    exponent, report = book
    assert not report.declared["reciprocal"]
    assert report.holds["reciprocal"] is None
    # f(wi, wo) / f(wo, wi) = cos_o / cos_i.
    first, second = np.cos(np.radians(report.reciprocity_at))
    low, high = sorted((first, second))
    assert report.reciprocity == pytest.approx(1.0 - low / high, abs=1e-6)
    assert report.reciprocity > 0.99
    # At normal incidence the integral of cos^(n + 1) over the hemisphere.
    expected = 0.8 * 2.0 * math.pi / (exponent + 2.0)
    np.testing.assert_allclose(report.albedo[0], expected, rtol=1e-6)
    # Elsewhere that of the normalised lobe over the light's cosine.
    normalised = Phong(0.8, exponent)
    for angle in (30.0, 75.0):
        k = int(np.flatnonzero(report.angles == angle)[0])
        wo = np.array([math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))])
        share = float(normalised.albedo(wo, nodes=128)) * 2.0 * math.pi / (exponent + 2.0)
        np.testing.assert_allclose(report.albedo[k], share / wo[2], rtol=1e-4)
    assert report.energy > 1.0
    assert report.energy_at[0] == 89.0


@pytest.mark.parametrize(
    ("lies", "broken"),
    [
        ("bright", "conserves_energy"),
        ("dense", "pdf"),
        ("lopsided", "reciprocal"),
        ("transmits", "transmits"),
    ],
)
def test_broken_promises_are_found(lies, broken):
    material = Braggart(np.array([0.5]), lies=lies)
    if lies == "bright":
        # Lambert knows its albedo without looking at the values.
        material = eqx.tree_at(lambda m: m.colour, material, jnp.asarray([1.5]))
    report = properties(material)
    assert report.broken == (broken,)
    if lies == "lopsided":
        # (1 + x) / (1 - x) with x at most 0.01, by a pair of nearly opposite directions.
        assert 0.018 < report.reciprocity < 0.02


@pytest.mark.float32
def test_denied_delta_lobes_are_found():
    assert "delta" in properties(Denied()).broken


def test_interfaces_are_judged_by_power():
    report = properties(RoughDielectric(1.5, 0.1))
    # Radiance is squeezed by the square of the index on the way in.
    assert report.reciprocity == pytest.approx(1.0 - 1.0 / 1.5**2, abs=1e-6)
    assert 0.9 < report.energy <= 1.0
    assert report.broken == ()
    np.testing.assert_allclose(report.pdf, 1.0, atol=1e-4)
    glass = properties(naming.named("glass").material)
    np.testing.assert_allclose(glass.albedo, 1.0, atol=1e-12)
    assert glass.reciprocity is None
    assert (glass.holds["pdf"], glass.holds["reciprocal"], glass.broken) == (None, None, ())


def test_cubature_finds_narrow_lobes_and_steps(rng):
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    kappa = 1e5

    def lobe(w):
        """Of von Mises and Fisher, beside its double, [n, 2]; 2 sin^2 keeps the digits."""
        distance = ((w - axis) ** 2).sum(-1)
        value = kappa / (2.0 * math.pi) * np.exp(-0.5 * kappa * distance)
        return np.stack([value, 2.0 * value], -1)

    near = axis + rng.normal(size=(512, 3)) / math.sqrt(kappa)
    total, error = over_sphere(lobe, near / np.linalg.norm(near, axis=-1, keepdims=True))
    assert np.abs(total - [1.0, 2.0]).max() <= max(error, 1e-9) < 1e-4
    anywhere = rng.normal(size=(512, 3))
    total, _ = over_sphere(lambda w: (w[:, 2] > 0.0).astype(float), anywhere)
    assert total == pytest.approx(2.0 * math.pi, abs=1e-7)
    # A step that no edge of cells follows: a cap of half angle 0.7. The error is an estimate.
    cap, error = over_sphere(lambda w: (w @ axis > math.cos(0.7)).astype(float), anywhere)
    assert abs(float(cap) - 2.0 * math.pi * (1.0 - math.cos(0.7))) < 3.0 * error < 1e-2


@pytest.mark.parametrize("name", naming.NAMES)
def test_every_name_is_a_material(name):
    subject = naming.named(name)
    wi, wo = np.array([0.0, 0.6, 0.8]), np.array([0.0, -0.6, 0.8])
    value = np.asarray(subject.material.f(wi, wo))
    assert value.shape == subject.material.channels
    assert (value.max() > 0.0) == (not subject.material.delta)


def test_colours_of_metals_do_not_depend_on_the_wavelength_step():
    subject = naming.named("gold", roughness=0.4)
    assert float(subject.material.alpha[0]) == pytest.approx(0.16)
    facets = subject.material.fresnel
    xyz = subject.xyz(facets.normal(jnp.asarray(subject.wavelengths)))
    fine = colour.wavelengths(1.0)
    truth = np.asarray(facets.normal(jnp.asarray(fine))) @ colour.spectral_weights(fine)
    # Over the white of each step, which is that of the pictures too.
    truth *= subject.xyz(np.ones(41)) / colour.white_point("D65", fine)
    # A delta E of 1 is about the least that can be seen.
    assert colour.delta_e_2000(xyz, truth) < 0.02
    red, green, blue = subject.rgb(facets.normal(jnp.asarray(subject.wavelengths)))
    assert red > green > 1.5 * blue > 0.0


def test_white_is_white_and_rgb_comes_back():
    spectral = naming.named("silver")
    grey, tinted = naming.named("lambert"), naming.named("lambert", colour=(0.1, 0.2, 0.3))
    uneven = np.array([0.42, 0.5, 0.53, 0.61, 0.7])
    few = naming.Subject("five", Lambert(np.full(5, 0.5)), uneven)
    for subject in (spectral, grey, tinted, few):
        white = np.ones((2, *subject.material.channels))
        np.testing.assert_allclose(subject.rgb(white), 1.0, atol=1e-12)
    np.testing.assert_allclose(tinted.rgb([0.1, 0.2, 0.3]), [0.1, 0.2, 0.3], atol=1e-12)
    assert grey.channel(0) is None
    assert tinted.channel(2) == "blue"
    assert few.channel(1) == "500 nm"


def test_plastic_is_a_base_under_a_coat():
    material = naming.named("plastic", colour=(0.5, 0.2, 0.1), eta=1.5, alpha=0.3).material
    wi, wo = np.array([0.6, 0.0, 0.8]), np.array([-0.6, 0.0, 0.8])
    base = np.asarray(material.f(wi, np.array([0.96, 0.0, 0.28]))) - np.array([0.5, 0.2, 0.1]) / 3.2
    assert np.ptp(base - (np.array([0.5, 0.2, 0.1]) * (1 / math.pi - 1 / 3.2))) < 1e-6
    gloss = np.asarray(material.f(wi, wo)) - np.array([0.5, 0.2, 0.1]) / math.pi
    # F(cos_i) D(0) G / (4 cos^2), D(0) = 1 / (pi alpha^2); Smith's G of the mirror direction.
    cos, n = 0.8, math.sqrt(1.5**2 - 0.36)
    fresnel = 0.5 * (((cos - n) / (cos + n)) ** 2 + ((2.25 * cos - n) / (2.25 * cos + n)) ** 2)
    slope = math.sqrt(1.0 + (0.3 * 0.75) ** 2)
    masked = 1.0 / (1.0 + 2.0 * 0.5 * (slope - 1.0))
    expected = fresnel * masked / (math.pi * 0.09) / (4.0 * cos * cos)
    np.testing.assert_allclose(gloss, expected, rtol=1e-5)


def test_unusable_names_and_options_are_refused():
    with pytest.raises(InputError, match=r"did you mean gold.*lambert, oren-nayar"):
        naming.named("gould")
    with pytest.raises(InputError, match="gold has no exponent; it takes alpha, roughness"):
        naming.named("gold", exponent=3.0)
    with pytest.raises(InputError, match="not both"):
        naming.named("gold", alpha=0.1, roughness=0.3)
    with pytest.raises(InputError, match="exponent must be from 0 to 1e\\+06; received inf"):
        naming.named("phong", exponent=math.inf)
    with pytest.raises(InputError, match="gaussian normals need the masking v-cavity"):
        naming.named("copper", normals="gaussian", masking="correlated")
    assert naming.named("copper", normals="gaussian").material.masking == "v-cavity"
    with pytest.raises(InputError, match="7 channels of unknown wavelength"):
        naming.Subject("seven", Lambert(np.full(7, 0.5)))


@pytest.mark.float32
def test_lobes_point_where_the_mirror_does():
    subject = naming.named("phong", exponent=200.0)
    figure = lobes.in_plane(subject, (LIGHT, 60.0))
    linear, logarithmic = figure.axes
    for k, angle in enumerate((LIGHT, 60.0)):
        # Each light has its lobe and, dotted, its own direction.
        at, values = (np.asarray(v, np.float64) for v in linear.lines[2 * k].get_data())
        assert values.max() == pytest.approx(1.0)
        assert math.degrees(at[values.argmax()]) == pytest.approx(-angle, abs=0.02)
        assert math.degrees(linear.lines[2 * k + 1].get_xdata()[0]) == pytest.approx(angle)
    at, radius = (np.asarray(v, np.float64) for v in logarithmic.lines[0].get_data())
    low = math.log10(202.0 / (2.0 * math.pi)) - radius.max()
    assert low == pytest.approx(round(low), abs=1e-5)
    legend = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert "light at 30°: peak 32.1 /sr" in legend
    words = {text.get_text() for text in figure.texts}
    assert {"f over its peak", "f in 1/sr, logarithmic"} <= words


def test_glass_is_drawn_as_lines_of_its_shares():
    figure = lobes.in_plane(naming.named("glass"), (60.0,))
    ends = [
        (math.degrees(line.get_xdata()[-1]), float(line.get_ydata()[-1]))
        for line in figure.axes[0].lines
        if line.get_marker() == "o"
    ]
    (down, through), (up, back) = sorted(ends)
    # Fresnel's and Snell's laws at 60 degrees and an index of 1.5.
    assert back == pytest.approx(0.0892, abs=1e-4)
    assert through == pytest.approx(1.0 - back, abs=1e-6)
    assert up == pytest.approx(-60.0, abs=0.02)
    assert 180.0 + down == pytest.approx(
        math.degrees(math.asin(math.sin(math.pi / 3) / 1.5)), abs=0.02
    )


def test_maps_and_balls_show_the_highlight_where_it_is(lambert):
    subject = naming.named("blinn-phong", colour=(0.9, 0.3, 0.1), exponent=200.0)
    figure = lobes.hemisphere(subject, LIGHT, size=101)
    image = np.ma.filled(figure.axes[0].images[0].get_array(), np.nan)
    j, i = np.unravel_index(np.nanargmax(image), image.shape)
    # Pixels are 0.02 wide.
    assert (2 * i + 1) / 101 - 1 == pytest.approx(-0.5, abs=0.03)
    assert (2 * j + 1) / 101 - 1 == pytest.approx(0.0, abs=0.03)
    assert "1/sr" in figure.axes[1].get_ylabel()
    assert "30°" in figure.get_suptitle()
    # The report brings the albedo of dim surroundings; any will do.
    picture = lobes.sphere(subject, lambert, size=64)
    j, i = np.unravel_index(picture.sum(-1).argmax(), (64, 64))
    x, y = ((i + 0.5) / 32 - 1) * 1.04, (1 - (j + 0.5) / 32) * 1.04
    half = np.array([-0.45, 0.50, 0.75]) / math.sqrt(0.45**2 + 0.5**2 + 0.75**2) + [0, 0, 1]
    half /= np.linalg.norm(half)
    assert math.hypot(x - half[0], y - half[1]) < 0.08
    red, green, blue = picture[j, i]
    assert red > green > blue


def test_glass_balls_turn_the_world_upside_down():
    """The ground of the reflecting mirror is where the ball shows the sky."""
    size, pictures = 32, {}
    for name in ("mirror", "glass"):
        subject = naming.named(name)
        pictures[name] = lobes.sphere(subject, properties(subject.material), size=size)
    blueness = {name: p[..., 2] - p[..., 0] for name, p in pictures.items()}
    above, below = (size // 4, size // 2 + 4), (3 * size // 4, size // 2 + 4)
    assert blueness["mirror"][above] > 0.05 > -0.02 > blueness["mirror"][below]
    assert blueness["glass"][below] > 0.05 > -0.02 > blueness["glass"][above]


@pytest.fixture(scope="module")
def gold(tmp_path_factory):
    target = tmp_path_factory.mktemp("out") / "gold"
    words = ["gold", "--roughness", "0.4", "--angles", "0,45", "--size", "32"]
    return target, main(["material", *words, "-o", str(target)])


def test_command_leaves_pictures_and_report(gold):
    target, code = gold
    assert code == 0
    assert {p.name for p in target.iterdir()} == PICTURES | {"report.json"}
    for name in PICTURES:
        with PIL.Image.open(target / name) as image:
            pixels = np.asarray(image.convert("RGB"), np.float64)
        assert pixels.std() > 2.0, f"{name} is empty"
    content = json.loads((target / "report.json").read_text())
    assert content["name"] == "gold"
    assert len(content["wavelengths_um"]) == 41
    assert content["declared"]["reciprocal"] is True
    assert content["broken"] == []
    assert content["reciprocity"] < 1e-12
    np.testing.assert_allclose(content["pdf"], 1.0, atol=1e-4)
    albedo = np.array(content["albedo"])
    assert albedo.shape == (len(content["angles"]), 2, 41)
    assert albedo.max() == content["energy"] < 1.0


@pytest.mark.float32
def test_command_prints_the_report(tmp_path, capsys):
    target = tmp_path / "flat"
    assert main(["material", "lambert", "--size", "16", "-o", str(target)]) == 0
    out = capsys.readouterr().out
    for words in ("lambert, one channel", "largest albedo 0.5000, at 0°", "1.0000 (80°)", "holds"):
        assert words in out
    assert "DOES NOT HOLD" not in out


def test_json_is_all_that_is_printed(tmp_path, capsys):
    target = tmp_path / "glass"
    assert main(["material", "glass", "--json", "--size", "16", "-o", str(target)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert json.loads(out) == json.loads((target / "report.json").read_text())
    assert {p.name for p in target.iterdir()} == (PICTURES - {"hemisphere.png"}) | {"report.json"}
    assert any("there is no map" in note for note in json.loads(out)["notes"])


def test_files_are_drawn_as_names_are(tmp_path, capsys, monkeypatch):
    path = tmp_path / "felt.binary"
    path.touch()
    # What the readers of files give is theirs to test; compiled programs are Lambert's.
    monkeypatch.setattr(naming, "load", lambda p: naming.Subject(p.name, Lambert(0.25)))
    target = tmp_path / "felt"
    assert main(["material", str(path), "--size", "16", "-o", str(target)]) == 0
    assert "largest albedo 0.2500" in capsys.readouterr().out
    assert json.loads((target / "report.json").read_text())["name"] == "felt.binary"


def test_measured_materials_are_read_by_suffix(tmp_path, capsys):
    nodes = {"phi_d": (9, math.pi), "theta_d": (5, math.pi / 2), "theta_h": (7, math.pi / 2)}
    fields = {
        name: np.linspace(-end if name == "phi_d" else 0.0, end, count)[None]
        for name, (count, end) in nodes.items()
    }
    values = np.zeros((9, 5, 7, 3, 4, 4))
    values[..., 0, 0] = np.array([0.1, 0.2, 0.4]) / math.pi
    fields |= {"wvls": np.array([450.0, 550.0, 650.0]), "M": values}
    path = tmp_path / "even.pbsdf"
    write_tensors(path, {name: field.astype(np.float32) for name, field in fields.items()})
    subject = naming.load(path)
    wi, wo = np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.0, 1.0])
    np.testing.assert_allclose(subject.material.f(wi, wo), values[0, 0, 0, :, 0, 0], rtol=1e-5)
    assert subject.channel(2) == "650 nm"
    rows = ["theta_i,phi_i,theta_o,phi_o,f"]
    rows += [f"{a},0,{b},{c},0.25" for a in (0, 40, 80) for b in (0, 40, 80) for c in (0, 90, 180)]
    (tmp_path / "even.csv").write_text("\n".join(rows) + "\n")
    table = naming.load(tmp_path / "even.csv")
    assert float(table.material.f(wi, wo)) == pytest.approx(0.25, rel=1e-5)
    assert (table.name, table.wavelengths) == ("even.csv", None)
    assert main(["material", str(path), "--alpha", "0.1"]) == 2
    assert "--alpha is for named materials" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("gould", "'gould' is no material (did you mean gold?): expected lambert, oren-nayar"),
        ("nothere.binary", "nothere.binary: no such file"),
        ("gold --alpha 5", "alpha must be from 0.001 to 4; received 5"),
        ("gold --alpha a,b", "--alpha must be one number or 2 separated by commas"),
        ("gold --normals cone", "normals must be one of ggx, beckmann, gaussian"),
        ("lambert --colour 2", "colour must be from 0 to 1; received 2"),
        ("lambert --colour 1,2", "--colour must be one number or 3 separated by commas"),
        ("lambert --angles 95", "--angles must lie between 0 and 89 degrees; received 95"),
        ("lambert --size 3", "--size must lie between 16 and 4096 pixels; received 3"),
        ("lambert --eta 2", "lambert has no eta; it takes colour"),
        ("mirror --eta 2", "mirror has no eta; it takes no options"),
        ("oren-nayar --sigma 100", "--sigma must lie between 0 and 90 degrees; received 100"),
        ("plastic --eta 0.5", "eta of plastic must be above 1 to 100; received 0.5"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(words, text, tmp_path, capsys):
    assert main(["material", *words.split(), "-o", str(tmp_path / "o" / "p")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert text in err
    assert err.startswith("diffopt: error: ")
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
