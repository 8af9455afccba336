"""Cards of objects: sound HTML, figures computed otherwise, pictures that show the object."""

import dataclasses
import io
import math
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
from preview_cases import Parts, like, none, parts

import diffopt as do
from diffopt import brdf_lobes, previews, scenes
from diffopt.accuracy import studies
from diffopt.errors import InputError
from diffopt.loading import Provenance
from diffopt.materials import Dielectric, Lambert, Microfacet, Mirror
from diffopt.materials.combined import Emission
from diffopt.materials.diffracting import Diffraction
from diffopt.planning.plans import Plan, Row
from diffopt.previews import markup
from diffopt.rendering.effects import Composition
from diffopt.rendering.settings import PathSettings

# Ends of the colour map of heights, and matplotlib's first colour.
LOW, HIGH, BLUE = (0, 34, 78), (253, 231, 55), (31, 119, 180)


def lobes(theta, azimuth=0.0, kappa=60.0):
    """One lobe of integral 1 at an angle to the normal, degrees."""
    t, p = math.radians(theta), math.radians(azimuth)
    mu = [[math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)]]
    return do.Lobes(np.ones(1), np.array(mu), np.array([kappa]))


def image(h=24, w=32, seed=0):
    """A picture, red on the left and blue on the right, with some noise."""
    scene = scenes.Scene([scenes.Object(scenes.Sphere(1.0), Lambert(0.5))])
    camera = scenes.Camera((0.0, -4.0, 0.0), (0.0, 0.0, 0.0), resolution=(w, h))
    found = do.Image.blank(scene, camera, PathSettings(spp=7))
    rng = np.random.default_rng(seed)
    found.radiance[:, : w // 2, 0] = 1.0
    found.radiance[:, w // 2 :, 2] = 1.0
    found.radiance[...] *= rng.uniform(0.5, 1.0, (h, w, 1))
    found.error[...] = 0.03
    found.done[...] = True
    found.seconds = 1.5
    return found


def result(rows, **study):
    """A result of a study with rows (settings, error, run time)."""
    found = [studies.Row(settings, error, None, 0.1, run) for settings, error, run in rows]
    of = studies.Study("some.study", "of <this>", "truth & more", lambda quick: [], **study)
    return studies.StudyResult(of, tuple(found))


@pytest.fixture(scope="module")
def prepared():
    scan = do.samples.sinusoidal_grating(shape=(24, 24), pixel=0.1, period=1.2)
    brdf = do.DiffractionBRDF(scan, 0.5)
    return brdf.prepare(pairs=50, wavelengths=[0.5, 0.6], tolerance=1e-2)


def test_text_is_escaped():
    assert markup.escape("<a href='x'>&\"") == "&lt;a href=&#x27;x&#x27;&gt;&amp;&quot;"
    found = markup.table(("a<b",), [("<i>&",), (markup.Markup("<b>x</b>"),)])
    assert "<i>" not in found
    assert Parts(found).text == "a<b <i>& x"
    assert Parts(markup.key_figures([("<", "&amp;")])).text == "< &amp;"
    assert Parts(markup.card("<t>", None, markup.note("n & <m>"))).text == "<t> n & <m>"
    assert "onload" not in markup.picture(np.zeros((2, 2)), 'x" onload="y').split('alt="')[0]
    assert Parts(markup.picture(np.zeros((2, 2)), 'x" onload="y')).files


def test_an_image_is_kept_as_it_is(rng):
    for shape in ((5, 7), (5, 7, 3), (1, 1), (3, 2, 4)):
        pixels = rng.integers(0, 256, shape, dtype=np.uint8)
        ((kind, file),) = Parts(markup.picture(pixels, "some")).files
        assert kind == "png"
        assert (np.asarray(PIL.Image.open(io.BytesIO(file))) == pixels).all()
    found = Parts(markup.picture(np.array([[0.0, 0.5, 1.0, np.nan, 7.0]]), "grey")).pictures[0]
    assert found[0, :, 0].tolist() == [0, 128, 255, 0, 255]
    for bad in (np.zeros((0, 3)), np.zeros((2, 2, 2)), np.zeros(3), np.zeros((2, 2), int)):
        with pytest.raises(InputError, match="picture: expected"):
            markup.picture(bad, "bad")


def test_pictures_have_their_limit(rng):
    noise = rng.integers(0, 256, (300, 400, 3), dtype=np.uint8)
    found = Parts(markup.picture(noise, "noise", most=60_000))
    assert len(found.files[0][1]) <= 60_000
    # What is left is the noise's mean grey, 127.5; 0.5 is 100 times its standard error.
    assert found.pictures[0].mean() == pytest.approx(127.5, abs=2.0)
    with_alpha = np.concatenate([noise, noise[..., :1]], -1)
    ((kind, file),) = Parts(markup.picture(with_alpha, "noise", most=60_000)).files
    assert kind == "png"
    assert len(file) <= 60_000


def test_figures_are_drawn_and_not_kept():
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.0, 2.0))
    figure.add_axes((0.0, 0.0, 1.0, 1.0)).set_facecolor("red")
    found = Parts(markup.picture(figure, "red", width=150))
    assert found.pictures[0].shape == (200, 300, 3)  # twice the width on the page
    assert like(found.pictures[0], (255, 0, 0)).mean() > 0.9
    assert 'width="150"' in found.html


def test_a_row_has_as_many_cells_as_columns():
    with pytest.raises(InputError, match="rows: expected 2 cells"):
        markup.table(("a", "b"), [("1", "2"), ("3",)])


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (12345.6, "12346"),
        (-1.5, "−1.5"),
        (1e-7, "1e−7"),
        (1234567.0, "1.235e6"),
        (np.inf, "∞"),
        (np.nan, "NaN"),
    ],
)
def test_numbers_for_people(value, text):
    assert markup.number(value) == text


def test_heightfield(rng):
    heights = 0.05 * np.sin(2 * np.pi * np.arange(96) * 0.1 / 1.2)[None] + np.zeros((64, 1))
    heights += 0.002 * rng.normal(size=heights.shape)
    source = Provenance("a <b> & c.sur", steps=("cut <here>",))
    found = parts(do.Heightfield(heights, (0.2, 0.1), provenance=source))
    assert f"{1000 * heights.std():.4g} nm" in found.text
    assert f"{1000 * np.ptp(heights):.4g} nm" in found.text
    assert "96 × 64 pixels, 9.6 × 12.8 µm" in found.text
    assert "100 nm × 200 nm (x × y)" in found.text
    # Eight periods under a window: known to a hundredth.
    period = float(found.text.split("dominant period ")[1].split()[0])
    assert period == pytest.approx(1.2, rel=0.01)
    assert "a <b> & c.sur" in found.text
    assert "cut <here>" in found.text
    assert "<b>" not in found.html


def test_the_map_shows_the_heights():
    heights = np.zeros((40, 40))
    heights[:, :10] = 0.1
    (picture,) = parts(do.Heightfield(heights, 0.1)).pictures
    high, low = (like(picture, c, 12) for c in (HIGH, LOW))
    # The colour bar has both, a hundredth of the map's area each.
    assert high.sum() / low.sum() == pytest.approx(1.0 / 3.0, rel=0.1)
    columns = [np.median(np.nonzero(where)[1]) for where in (high, low)]
    assert columns[0] < columns[1]


def test_heightfields_that_are_hard_to_draw():
    missing = np.random.default_rng(0).normal(size=(40, 40))
    missing[5:15, 5:25] = np.nan
    found = parts(do.Heightfield(missing, 0.1, missing="keep"))
    assert "200 pixels (12 %) have no height" in found.text
    assert f"{1000 * np.nanstd(missing):.4g} nm" in found.text
    assert like(found.pictures[0], (153, 153, 153), 3).sum() > 1000
    assert "no pixel has a height" in none(
        do.Heightfield(np.full((4, 4), np.nan), 0.1, missing="keep")
    )
    assert "0 nm" in parts(do.Heightfield(np.zeros((2, 2)), 0.1)).text
    parts(do.Heightfield(np.ones((2, 300)), 0.1))
    batch = jax.vmap(lambda h: do.Heightfield(h, 0.1))(jnp.ones((3, 8, 8)))
    assert "not one map" in none(batch)


def test_a_huge_heightfield_is_drawn_from_means():
    x = np.arange(4096)
    heights = np.where(x < 1024, 0.1, 0.0)[None].repeat(4096, 0).astype(np.float32)
    found = parts(do.Heightfield(heights, 0.05))
    assert "means over 22 × 22 pixels" in found.text
    expected = 100.0 * math.sqrt(0.25 * 0.75)
    assert f"{expected:.4g} nm" in found.text
    high, low = (like(found.pictures[0], c, 12).sum() for c in (HIGH, LOW))
    assert high / low == pytest.approx(1.0 / 3.0, rel=0.1)


def test_traced_objects_have_no_card():
    seen = []

    @jax.jit
    def traced(heights, alpha):
        seen.append(none(do.Heightfield(heights, 0.1)))
        seen.append(none(do.Lobes(alpha, jnp.array([[0.0, 0.0, 1.0]]), jnp.ones(1))))
        seen.append(none(do.BlinnPhong(exponent=alpha[0])))
        return heights.sum()

    traced(jnp.ones((8, 8)), jnp.ones(1))
    assert len(seen) == 3
    assert all("its arrays are traced" in line for line in seen)


def test_lobes():
    mu = np.array([[0.0, 0.0, 1.0], [math.sin(0.5), 0.0, math.cos(0.5)]])
    some = do.Lobes(np.array([0.7, 0.2]), mu, np.array([0.2, 90.0]))
    found = parts(some)
    assert "integral 0.9" in found.text
    assert "77.8 %" in found.text
    assert "28.6°" in found.text
    # Half of the peak, found on the lobe itself.
    one = do.Lobes(np.ones(1), mu[:1], np.array([90.0]))
    t = np.linspace(0.0, 0.3, 30001)
    values = one(np.stack([np.sin(t), 0 * t, np.cos(t)], -1))
    half = math.degrees(t[np.argmax(np.asarray(values) < 0.5 * values[0])])
    assert f"{half:.3g}°" in found.text
    # exp(-2 kappa) > 1/2: nowhere half the peak.
    assert "none" in found.text


@pytest.mark.parametrize(("theta", "side"), [(50.0, "left"), (-50.0, "right"), (0.0, "middle")])
def test_polar_plots_have_positive_angles_on_the_left(theta, side):
    (picture,) = parts(lobes(theta)).pictures
    left = picture[:, : picture.shape[1] // 2]
    where = np.nonzero(like(left, BLUE, 20))[1].mean() / left.shape[1]
    # A lobe at 50 degrees lies a sixth of the panel from its middle.
    expected = {"left": where < 0.42, "right": where > 0.58, "middle": abs(where - 0.5) < 0.05}
    assert expected[side]


def test_the_full_circle_where_lobes_point_down():
    up, down = (parts(lobes(theta)).pictures[0].shape for theta in (30.0, 150.0))
    assert down[0] > 1.3 * up[0]
    assert down[1] == up[1]


def test_lobes_that_are_hard_to_draw():
    many = do.Lobes(np.ones((4, 30)), np.tile([0.0, 0.6, 0.8], (4, 30, 1)), np.ones((4, 30)))
    assert "4 sums of 30" in parts(many).text
    assert "14 lighter ones" in parts(many[0]).text
    colour = do.Lobes(np.ones((1, 3)), np.array([[0.0, 0.0, 1.0]]), np.full(1, 1e7))
    assert "The mean of 3 channels" in parts(colour).text
    bad = eqx.tree_at(lambda x: x.kappa, lobes(10.0), jnp.full(1, np.nan))
    assert "kappa is not finite" in none(bad)
    empty = do.Lobes(np.ones(0), np.ones((0, 3)), np.ones(0))
    assert "there are no lobes" in none(empty)
    black = do.Lobes(np.zeros(1), np.array([[0.0, 0.0, 1.0]]), np.ones(1))
    parts(black)


def test_lobes_over_views():
    views, faces = brdf_lobes.icosahedral_views(0)
    mirrored = (views * [-1.0, -1.0, 1.0])[:, None]
    some = do.BRDFLobes(
        views, faces, do.Lobes(np.full((8, 1), 0.5), mirrored, np.full((8, 1), 40.0))
    )
    found = parts(some)
    assert "1 lobes at each of 8 views" in found.text
    assert "integrals 0.5 concentrations κ 40" in found.text


def encoded(linear):
    """Code of linear sRGB by IEC 61966-2-1."""
    c = np.asarray(linear)
    bits = np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.maximum(c, 1e-9) ** (1 / 2.4) - 0.055)
    return "#" + "".join(f"{round(255 * b):02x}" for b in bits)


def test_materials():
    found = parts(Lambert((0.8, 0.3, 0.1)))
    # Its albedo is its colour, at every angle.
    assert found.text.count(encoded((0.8, 0.3, 0.1))) == 2
    assert "3 (linear RGB)" in found.text
    assert "energy conserved" in found.text
    mirror = parts(Mirror())
    assert "in single directions yes" in mirror.text
    assert mirror.text.count("#ffffff") == 2
    glass = parts(Dielectric(1.5))
    assert "transmits yes" in glass.text
    facets = parts(Microfacet(0.3))
    assert "alpha (0.3, 0.3)" in facets.text


def test_lobes_of_materials_lie_on_the_mirrors_side():
    (picture,) = parts(do.BlinnPhong(exponent=200.0)).pictures
    left = picture[: int(0.85 * picture.shape[0]), : picture.shape[1] // 2]
    # Lights stand on the left, at 0, 30 and 60 degrees: dotted; the lobes opposite.
    at = [np.nonzero(like(left, shade, 25))[1].mean() / left.shape[1] for shade in
          (BLUE, (255, 127, 14), (44, 160, 44))]  # fmt: skip
    assert abs(at[0] - 0.5) < 0.02
    assert at[0] < at[1] < at[2]


def test_materials_without_a_picture(prepared):
    scan = do.samples.flat(shape=(128, 128))
    slow = Diffraction(do.DiffractionBRDF(scan, 1.0), np.linspace(0.4, 0.7, 31))
    found = parts(slow)
    assert not found.files
    assert "No picture: it would take some" in found.text
    lamp = parts(Emission((1.0, 0.5, 0.2)))
    assert "scatters no light" in lamp.text
    assert "radiance (1, 0.5, 0.2)" in lamp.text
    bad = eqx.tree_at(lambda m: m.colour, Lambert(0.5), jnp.asarray(np.nan))
    assert "not finite" in none(bad)
    quick = parts(Diffraction(prepared))
    assert "2 wavelengths, 500 to 600 nm" in quick.text
    assert quick.files


def test_plan():
    rows = (
        Row("matte-light", True, "it brings <90 %> & more", None, "64 paths", 0.75),
        Row("caustics", False, "nothing focuses", 0.0123),
    )
    plan = Plan(0.02, rows, Composition(), PathSettings(), 0.004, 0.011, 12.3, PathSettings())
    found = parts(plan)
    for words in ("tolerance of 0.02", "1 effects in, 1 out", "level path", "some 12 s", "0.40%",
                  "1.10%", "1.23%", "75%", "it brings <90 %> & more", "64 paths"):  # fmt: skip
        assert words in found.text
    # The row that is out is set back, the other not.
    assert sum(found.styles[k].count("opacity:0.5") for k in range(len(found.tags))) == 1
    dim = next(k for k, style in enumerate(found.styles) if "opacity:0.5;" in style)
    assert found.tags[dim] == "tr"
    assert found.html.index("opacity:0.5;") > found.html.index("matte-light")


def test_study_results():
    rows = [({"kind": "x", "n": n}, 10.0**-n, 1e-3 * n) for n in range(1, 5)]
    rows.append(({"kind": "x", "n": 9}, 0.5, 0.02))  # beaten by all
    found = parts(result(rows))
    assert "of <this>" in found.text
    assert "truth & more" in found.text
    assert "5, 4 of them on the front" in found.text
    assert "smallest error 1.0e-04" in found.text
    assert found.html.count("font-weight:bold") == 4
    # "kind" does not vary, and has no column.
    assert " kind " not in found.text
    assert "Not run yet" in parts(result(rows).study).text
    against = result(rows, against="n")
    assert parts(against).files
    assert "it has no rows" in none(dataclasses.replace(against, rows=()))


def test_many_rows_are_folded():
    rows = [({"n": n, "problem": p}, 0.5**n, 1e-3 * n) for p in range(13) for n in range(1, 30)]
    found = parts(result(rows, conditions=("problem",)))
    assert "details" in found.tags
    assert "48 rows" in found.text
    assert "13, by problem" in found.text


def test_rendered_pictures():
    some = image()
    found = parts(some)
    # Small ones are kept exactly as they are saved.
    assert (found.pictures[0] == some.display()).all()
    weights = some.channels.luminance()
    noise = 0.03 * np.sqrt((weights**2).sum()) / (some.radiance @ weights).mean()
    assert f"{noise:.2%} of the mean luminance" in found.text
    for words in ("32 × 24 pixels", "level path", "samples per pixel 7", "time 1.5 s"):
        assert words in found.text
    some.done[:12] = False
    some.interrupted = True
    assert "Interrupted: 50% of the pixels" in parts(some).text
    some.radiance[20, 3] = np.nan
    assert "radiance is not finite" in none(some)
    parts(image(1, 2))
    wide = parts(image(300, 2000))
    assert wide.pictures[0][:, :100].mean((0, 1))[0] > wide.pictures[0][:, :100].mean((0, 1))[2]


def test_a_picture_that_is_not_begun():
    some = image()
    some.done[...] = False
    found = some._repr_mimebundle_()
    assert "0%" in Parts(found["text/html"]).text


def test_choices(prepared):
    choice = prepared.choice
    for found in (parts(choice), parts(prepared)):
        assert f"method {choice.method}" in found.text
        assert f"{choice.error_bound:.1e} (asked 1.0e-02)" in found.text
        assert choice.job in found.text
        assert all(one.method in found.text for one in choice.candidates)
        assert found.html.count("font-weight:bold") == 1
        refused = [one for one in choice.candidates if one.refused]
        assert found.html.count("opacity:0.5;") == len(refused)
    assert "24 × 24 pixels of 100 nm" in parts(prepared).text


def test_swatches():
    white, red = np.array([0.9505, 1.0, 1.0888]), np.array([0.4125, 0.2127, 0.0193])
    some = previews.swatches([white, red, 0.18 * white], ["<white>", "red", "grey & dull"])
    codes = list(some.codes)
    assert codes[0] == "#ffffff"
    assert codes[1] == "#ff0000"
    assert codes[2] == encoded([0.18] * 3)
    assert not some.outside.any()
    found = parts(some)
    assert "<white>" in found.text
    assert all(code in found.html for code in codes)
    beyond = previews.swatches([[1.5, 0.2, 0.2], [-0.1, 0.5, 0.5], [0.5, 0.5, 0.5]], space="rgb")
    assert beyond.outside.tolist() == [True, True, False]
    assert parts(beyond).text.count("out of gamut") == 2
    assert "(out of gamut)" in repr(beyond)


@pytest.mark.parametrize(
    ("values", "labels", "text"),
    [
        (np.ones((2, 4)), None, r"expected colours \[..., 3\]"),
        (np.full(3, np.nan), None, "expected finite"),
        (np.ones((2, 3)), ["one"], "labels: expected 2"),
        (np.ones((65, 3)), None, "at most 64"),
    ],
)
def test_swatches_refuse(values, labels, text):
    with pytest.raises(InputError, match=text):
        previews.swatches(values, labels)


def test_a_users_style_is_neither_used_nor_changed():
    import matplotlib

    field = do.Heightfield(np.random.default_rng(0).normal(size=(16, 16)), 0.1)
    expected = field._repr_mimebundle_()["text/html"]
    with matplotlib.rc_context({"text.color": "white", "axes.facecolor": "black"}):
        before = dict(matplotlib.rcParams)
        assert field._repr_mimebundle_()["text/html"] == expected
        assert dict(matplotlib.rcParams) == before


def test_what_goes_wrong_is_said_in_the_text():
    class Broken:
        def __repr__(self):
            raise RuntimeError("no name")

    def card(thing):
        raise ValueError("first line\nsecond")

    found = previews.bundles.bundle(Broken(), card)
    assert set(found) == {"text/plain"}
    assert "Broken object" in found["text/plain"]
    assert found["text/plain"].endswith("(no preview: ValueError: first line)")


def test_nothing_is_opened_in_pyplot():
    code = (
        "import sys, numpy as np, diffopt as do, diffopt.previews\n"
        "assert 'matplotlib' not in sys.modules\n"
        "field = do.Heightfield(np.random.default_rng(0).normal(size=(16, 16)), 0.1)\n"
        "assert 'text/html' in field._repr_mimebundle_()\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "from matplotlib import pyplot\n"
        "material = do.BlinnPhong(exponent=5.0)\n"
        "assert 'text/html' in material._repr_mimebundle_()\n"
        "assert pyplot.get_fignums() == []\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.float32
def test_without_64_bit_types():
    with jax.enable_x64(False):
        heights = jnp.asarray(np.random.default_rng(0).normal(size=(16, 16)), jnp.float32)
        assert parts(do.Heightfield(heights, 0.1)).files
        mu = jnp.asarray([[0.6, 0.0, 0.8]], jnp.float32)
        kappa = jnp.asarray([50.0], jnp.float32)
        assert parts(do.Lobes(jnp.ones(1, jnp.float32), mu, kappa)).files
        assert parts(Microfacet(0.3)).files
