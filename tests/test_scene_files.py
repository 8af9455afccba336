"""Scenes as files: there and back, every fault with its line, and what a check finds."""

import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest

from diffopt import InputError, fresnel, materials
from diffopt.lobes import Lobes
from diffopt.materials import naming
from diffopt.rendering import render
from diffopt.scenes import (
    Ambient,
    Box,
    Camera,
    Directional,
    Disc,
    Environment,
    Falloff,
    Flood,
    Mesh,
    Object,
    PerFace,
    Plane,
    Point,
    Scene,
    Sphere,
    Texture,
    Textured,
    area_light,
    build_mesh,
    check,
    checkerboard,
    examples,
    facing,
    files,
    light_tables,
    load_environment,
    load_lobes,
    load_material,
    load_mesh,
    load_scene,
    load_texture,
    material_tables,
    material_words,
    rotate,
    save_scene,
    scale,
    spectra,
    translate,
)
from diffopt.scenes.channels import Channels
from diffopt.scenes.tables import SceneFileError
from diffopt.scenes.toml_lines import line_numbers

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
BALL = '[[objects]]\nshape = "sphere"\nmaterial = "lambert"\n'
LIT = BALL + '[[lights]]\nkind = "ambient"\n'


def written(tmp_path, text):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return path


def faults(tmp_path, text):
    with pytest.raises(SceneFileError) as caught:
        load_scene(written(tmp_path, text))
    return [line.replace(str(tmp_path) + "/", "") for line in caught.value.lines]


@pytest.fixture
def assets(tmp_path):
    folder = tmp_path / "assets"
    folder.mkdir()
    (folder / "body.obj").write_text(TETRAHEDRON)
    pixels = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3) * 3
    PIL.Image.fromarray(pixels).save(folder / "wood.png")
    sky = np.linspace(0.1, 1.0, 4 * 8 * 3).reshape(4, 8, 3)
    np.save(folder / "sky.npy", sky)
    Lobes(jnp.asarray([0.5]), jnp.asarray([[0.0, 0.0, 1.0]]), jnp.asarray([4.0])).save(
        folder / "sky.json"
    )
    rows = ["theta_i,phi_i,theta_o,phi_o,f"]
    rows += [f"{a},0,{b},{c},0.25" for a in (0, 40, 80) for b in (0, 40, 80) for c in (0, 90, 180)]
    (folder / "felt.csv").write_text("\n".join(rows) + "\n")
    return folder


def test_there_and_back_is_the_same_scene(tmp_path, assets):
    wood = load_texture(assets / "wood.png", repeat=(2.0, 3.0))
    mesh = load_mesh(assets / "body.obj", crease_deg=10.0)
    floor = Textured(
        materials.Lambert(), colour=checkerboard(0.8, (0.1, 0.2, 0.3), repeat=(4.0, 4.0))
    )
    turned = translate(0.3, 0.1, 0.0) @ rotate((1, 2, 3), 33.0) @ scale(0.7)
    scene = Scene(
        [
            Object(Plane(6.0, 5.0), floor, translate(0.0, 0.0, -1.0), name="floor"),
            Object(Sphere(0.6), materials.Lambert((0.1, 0.7, 1 / 3)), translate(1.0, 0.0, 0.0)),
            Object(mesh, Textured(materials.Lambert(), colour=load_texture(assets / "wood.png"))),
            Object(Box((0.4, 0.5, 0.6)), Textured(materials.Lambert(), colour=wood), turned),
            Object(Disc(0.5), "lambert", translate(-1.0, 1.0, 0.0), emission=(0.3, 0.2, 1e-5)),
            area_light(1.0, 2.0, facing((0, 0, 4), (0, 0, 0), (0, 1, 0)), radiance=2.5),
        ],
        [
            Ambient(0.05),
            Directional((1.0, -1.0, 2.0), (0.3, 0.2, 0.1)),
            Point((2.0, -2.0, 2.0), 3.0, Falloff(1.0, 1.0, 0.5)),
            Flood((0.0, -3.0, 2.0), (0.0, 1.0, -0.7), 4.0, 3.0),
            load_environment(assets / "sky.npy", scale=0.5, turn=20.0, up="y")[0],
        ],
    )
    camera = Camera((0.3, -4.0, 1.2), (0.0, 0.0, -0.1), resolution=(12, 9), field_of_view=50.0)
    deep = tmp_path / "deep"
    deep.mkdir()
    save_scene(scene, camera, deep / "a.toml", options={"level": "incremental", "spp": 2})
    assert 'file = "../assets/body.obj"' in (deep / "a.toml").read_text()
    found = load_scene(deep / "a.toml")
    assert found.camera == camera
    assert found.options == {"level": "incremental", "spp": 2}
    for one, other in zip(scene.objects, found.scene.objects, strict=True):
        assert (one.name, one.place.matrix) == (other.name, other.place.matrix)
    parts = [
        (s.lights, [(o.material, o.emission) for o in s.objects]) for s in (scene, found.scene)
    ]
    leaves = [jax.tree.leaves(part) for part in parts]
    for one, other in zip(*leaves, strict=True):
        np.testing.assert_array_equal(one, other)
    # Once more: what was read from a file is written as it was.
    save_scene(found.scene, found.camera, deep / "b.toml", options=found.options)
    assert (deep / "a.toml").read_text() == (deep / "b.toml").read_text()


def test_there_and_back_is_the_same_picture(tmp_path):
    floor = Textured(materials.Lambert(), colour=checkerboard(0.8, 0.2, repeat=(4.0, 4.0)))
    turned = translate(0.3, 0.1, 0.0) @ rotate((1, 2, 3), 33.0) @ scale(0.7)
    scene = Scene(
        [
            Object(Plane(6.0, 5.0), floor, translate(0.0, 0.0, -1.0)),
            Object(Box(), floor, turned),
            area_light(1.0, 2.0, facing((0, 0, 4), (0, 0, 0), (0, 1, 0)), radiance=(2.5, 0.1, 0.7)),
        ],
        [Point((2.0, -2.0, 2.0), 3.0, Falloff(1.0, 1.0, 0.5))],
    )
    camera = Camera((0.3, -4.0, 1.2), resolution=(12, 9))
    save_scene(scene, camera, tmp_path / "a.toml")
    found = load_scene(tmp_path / "a.toml")
    pictures = [render(s, found.camera, "incremental", spp=2) for s in (scene, found.scene)]
    assert pictures[0].radiance.max() > 0.1
    np.testing.assert_array_equal(pictures[0].radiance, pictures[1].radiance)


def test_materials_there_and_back(tmp_path, assets):
    lam = np.array([0.45, 0.55, 0.65])
    made = {
        name: naming.named(name).material for name in naming.NAMES if name not in ("silver", "gold")
    }
    made |= {
        "facets": materials.Microfacet((0.1, 0.3), fresnel.metal("Au"), lam, compensation="none"),
        "beckmann": materials.RoughDielectric(1.33, 0.3, "beckmann"),
        "sum": materials.Sum((materials.Lambert(0.2), materials.Phong(0.3, 9.0)), (0.25, 0.75)),
        "scaled": 0.5 * materials.Mirror(),
        "table": load_material(assets / "felt.csv"),
    }
    scene = Scene([Object(Sphere(), each, name=name) for name, each in made.items()])
    save_scene(scene, Camera(), tmp_path / "m.toml")
    back = load_scene(tmp_path / "m.toml").scene
    for one, other in zip(scene.objects, back.objects, strict=True):
        assert type(one.material) is type(other.material), one.name
        tree = material_words.described(other.material)
        assert tree == material_words.described(one.material), one.name


def test_a_file_by_hand(tmp_path, assets):
    text = """
[scene]
wavelengths = { from = 0.4, to = 0.7, step = 0.1 }
[camera]
eye = [0, -3, 0]
[materials.paint]
kind = "sum"
parts = ["base", { kind = "phong", colour = 0.2 }]
[materials.base]
kind = "oren-nayar"
sigma = 30
colour = [0.1, 0.2, 0.3, 0.4]
[[objects]]
shape = "mesh"
file = "assets/body.obj"
material = "paint"
scale = [1, 2, 3]
rotate = [[0, 0, 1, 90], [1, 0, 0, 90]]
translate = [5, 0, 0]
tangent = [0, 0, 2]
[[objects]]
shape = "disc"
material = { file = "assets/felt.csv" }
rotate = { axis = [0, 1, 0], degrees = 90 }
emission = 2.0
illuminant = "A"
[[objects]]
shape = "plane"
material = "glass"
matrix = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
[[lights]]
kind = "area"
radiance = 3
temperature = 5600
[[lights]]
kind = "lobes"
file = "assets/sky.json"
[render]
level = "recursive"
depth = 3
exposure = 2
"""
    found = load_scene(written(tmp_path, text))
    scene = found.scene
    assert scene.channels.wavelengths == (0.4, 0.5, 0.6, 0.7)
    assert found.options == {"level": "recursive", "depth": 3, "exposure": 2}
    paint = scene.objects[0].material
    assert float(paint.parts[0].sigma) == pytest.approx(math.radians(30.0))
    assert paint.channels == (4,)
    expected = (
        translate(5.0, 0.0, 0.0)
        @ rotate((1, 0, 0), 90.0)
        @ rotate((0, 0, 1), 90.0)
        @ scale(1.0, 2.0, 3.0)
    )
    np.testing.assert_allclose(np.reshape(scene.objects[0].place.matrix, (4, 4)), expected)
    assert scene.objects[2].place.matrix[3::4] == (1.0, 2.0, 3.0, 1.0)
    weights = scene.channels.luminance()
    for one, strength in ((scene.objects[1], 2.0), (scene.objects[3], 3.0)):
        # Four wavelengths measure the luminance roughly.
        assert float(np.asarray(one.emission) @ weights) == pytest.approx(strength, rel=0.1)
        assert float(one.emission[-1]) > float(one.emission[0])
    assert len(scene.lights) == 1
    assert [k for k in found.notes if "camera" in k] == []


def test_colours_of_lights():
    fine = Channels(np.linspace(0.38, 0.78, 41))
    for channels in (Channels(), fine):
        for tint in (spectra.illuminant(channels, "A"), spectra.black_body(channels, 2856.0)):
            rgb = channels.rgb(tint)
            assert float(tint @ channels.luminance()) == pytest.approx(1.0, rel=1e-3)
            # x = 0.4476, y = 0.4074 by definition.
            xyz = channels.xyz(tint)
            np.testing.assert_allclose(xyz[:2] / xyz.sum(), [0.4476, 0.4074], atol=6e-3)
            assert rgb[0] > rgb[1] > rgb[2]
        np.testing.assert_allclose(spectra.illuminant(channels, "D65"), 1.0, rtol=1e-6)
    with pytest.raises(InputError, match="temperature must be from 500 to 1e\\+06 kelvin; rec"):
        spectra.black_body(fine, 20.0)


@pytest.mark.parametrize("name", sorted(examples.EXAMPLES))
def test_examples_are_sound(name, tmp_path, monkeypatch):
    # A diffracting surface takes seconds to prepare, and has tests of its own.
    grey = materials.Lambert()
    monkeypatch.setattr(material_tables.Materials, "_diffraction", lambda self, table: grey)
    found = load_scene(written(tmp_path, examples.text(name)))
    bad = [f for f in check(found.scene, found.camera) if f.severity != "note"]
    assert bad == []
    with pytest.raises(InputError, match="NAME must be one of cornell, balls, disc, lamp, teapot"):
        examples.text("bunny")


# Text of the file, and the start of the fault, with its line.
FAULTS = {
    "syntax": ("[camera]\neye = [0, 1\n", "scene.toml:2: not TOML: unclosed array"),
    "unknown table": (LIT + "[camara]\n", r"scene.toml:6: \[camara\]: unknown key \(did you mean "),
    "unknown key": (
        LIT + "[camera]\nfov = 3\nfield_of_veiw = 5",
        r"scene.toml:8: \[camera\], field_of_veiw: unknown key \(did you mean field_of_view",
    ),
    "wrong kind": (
        LIT + "[camera]\neye = [0, 'a', 2]",
        r"scene.toml:7: \[camera\], eye: expected 3 numbers; received \[0, 'a', 2\]",
    ),
    "out of range": (
        LIT + "[camera]\n\nfield_of_view = 190",
        r"scene.toml:8: \[camera\], field_of_view: must be above 0 and below 180 deg.*received 190",
    ),
    "second object": (
        BALL + BALL + "radius = -1",
        r"scene.toml:7: \[\[objects\]\] 2, radius: must be a length above 0; received -1",
    ),
    "name of the object": (
        BALL + 'name = "ball"\nradius = "big"',
        r"scene.toml:5: \[\[objects\]\] 1 \(ball\), radius: expected a number; received 'big'",
    ),
    "no shape": (
        "[[objects]]\nmaterial='gold'",
        r"scene.toml:1: \[\[objects\]\] 1: needs shape: one",
    ),
    "shape": (
        "[[objects]]\nshape='bal'\nmaterial='gold'",
        "expected one of sphere.*received 'bal'",
    ),
    "key of another shape": (BALL + "width = 2", "width: a sphere has no width; it has radius"),
    "no material": ("[[objects]]\nshape='box'", r"\[\[objects\]\] 1: needs a material"),
    "material": (
        "[[objects]]\nshape='box'\nmaterial='golt'",
        r"scene.toml:3: .*no material 'golt' \(did you mean gold\?\); expected a table \[materials",
    ),
    "kind of material": (
        "[materials.a]\nkind='goldd'",
        r"scene.toml:2: \[materials.a\], kind: .*received 'goldd' \(did you mean gold\?\)",
    ),
    "option of material": (
        "[materials.a]\nkind='lambert'\ncolour=2",
        r"scene.toml:3: \[materials.a\], colour: must be from 0 to 1; received 2",
    ),
    "angle of material": (
        "[materials.a]\nkind='oren-nayar'\nsigma=91",
        "sigma: must be from 0 to 90",
    ),
    "circle of materials": (
        "[materials]\na={kind='sum', parts=['b']}\nb={kind='scaled', material='a'}",
        "a material must not contain itself: a -> b -> a",
    ),
    "channels": (
        "[materials.a]\nkind='lambert'\ncolour=[0.1,0.2,0.3,0.4]\n"
        "[[objects]]\nshape='box'\nmaterial='a'",
        "scene.toml:6: .*material: expected 1 or 3 channels; received 4",
    ),
    "file of material": ("[materials.a]\nfile='no.bsdf'", "scene.toml:2: .*no.bsdf: no such file"),
    "kind of file": ("[materials.a]\nfile='scene.toml'", "scene.toml: unknown kind of file; exp"),
    "scan": ("[materials.a]\nkind='diffraction'", r'needs scan: "sample:NAME" or a file'),
    "sample": ("[materials.a]\nkind='diffraction'\nscan='sample:dvd'", "no sample 'dvd'; expected"),
    "mesh": (
        "[[objects]]\nshape='mesh'\nfile='gone.obj'\nmaterial='gold'",
        r"scene.toml:3: \[\[objects\]\] 1, file: .*gone.obj: no such file",
    ),
    "no mesh": ("[[objects]]\nshape='mesh'\nmaterial='gold'", "a mesh needs file"),
    "stretched": (BALL + "scale = [1, 2, 1]", "spheres and discs stay round"),
    "flattened": (BALL + "scale = 0", "scale: must not be 0"),
    "two places": (
        BALL + "matrix = [[1]]\ntranslate = [1, 2, 3]",
        "a matrix stands alone; received translate as well",
    ),
    "matrix": (
        BALL + "matrix = [[1, 2]]",
        r"expected four rows of four numbers; received \[\[1, 2",
    ),
    "turn": (BALL + "rotate = [0, 0, 1]", r"expected \[\[x, y, z, degrees\], ...\] or {axis"),
    "facing": (BALL + "facing = {origin = [0, 0, 1]}", "facing needs target"),
    "facing nowhere": (
        BALL + "facing = {origin = [0, 0, 1], target = [0, 0, 1]}",
        "facing.target: - origin must be a direction",
    ),
    "texture": (BALL + "texture = {}", r"texture: needs either colour \(a picture\) or checks"),
    "checks": (BALL + "texture = {checks = [1, 2]}", "checks: must be from 0 to 1; received 2"),
    "texture of glass": (
        "[[objects]]\nshape='box'\nmaterial='glass'\ntexture={checks=[0, 1]}",
        "colour is no parameter of Dielectric: eta|no parameter of Dielectric",
    ),
    "tint without light": (BALL + "illuminant = 'A'", "needs emission beside illuminant or temp"),
    "emission": (BALL + "emission = -2", "emission: must be from 0; received -2"),
    "kind of light": (
        "[[lights]]\nkind='sun'",
        r"scene.toml:2: \[\[lights\]\] 1, kind: expected one",
    ),
    "light": ("[[lights]]\nkind='point'\nintensity=-1", "intensity: must be from 0; received -1"),
    "key of light": ("[[lights]]\nkind='ambient'\nradiannce=1", r"did you mean radiance\?"),
    "illuminant": ("[[lights]]\nkind='ambient'\nilluminant='D99'", "'D99' given, expected one of"),
    "temperature": ("[[lights]]\nkind='ambient'\ntemperature=7", "scene.toml:3: .*to 1e.06 kelvin"),
    "both": (
        "[[lights]]\nkind='ambient'\ntemperature=5000\nilluminant='A'",
        "give illuminant or temperature, not both",
    ),
    "falloff": (
        "[[lights]]\nkind='point'\nfalloff={a=-1}",
        "falloff: a of a falloff must be from 0; received -1|falloff.a: of a falloff must be",
    ),
    "map": ("[[lights]]\nkind='environment'\nfile='sky.hdr'", "sky.hdr: no such file"),
    "colour of a map": (
        "[[lights]]\nkind='environment'\nfile='scene.toml'\ntemperature=3000",
        "a map brings its own colours",
    ),
    "lobes": ("[[lights]]\nkind='lobes'", "lobes need a file"),
    "two skies": (
        "[[lights]]\nkind='environment'\n[[lights]]\nkind='environment'",
        "a scene has at most one environment; received 2",
    ),
    "lights": ("lights = 3", "lights.*: expected tables, each under ..lights..; received 3"),
    "level": (
        "[render]\nlevel='fast'",
        "expected one of incremental, recursive, .*received 'fast'",
    ),
    "setting": ("[render]\nspp=0", r"scene.toml:2: \[render\], spp: must be a whole number from 1"),
    "setting's kind": ("[render]\nspp='many'", "spp: expected a whole number; received 'many'"),
    "no setting": ("[render]\nlight_samples=4", r"light_samples: unknown key; expected .*depth"),
    "wavelengths": ("[scene]\nwavelengths=[0.5, 0.4]", "wavelengths.*ascending"),
    "nanometres": ("[scene]\nwavelengths=[500, 600]", "wavelengths: .*nanometres"),
    "step": (
        "[scene]\nwavelengths={from=0.4, to=0.7, step=0.17}",
        "expected a step that divides the range",
    ),
}


@pytest.mark.parametrize("case", FAULTS)
def test_faults_name_file_line_table_and_key(case, tmp_path):
    text, match = FAULTS[case]
    found = faults(tmp_path, text)
    assert any(re.search(match, line) for line in found), found
    assert all(line.startswith("scene.toml") for line in found), found


def test_all_faults_are_collected(tmp_path):
    text = (
        "[camera]\neye = [0]\nfield_of_view = 0\n[materials.a]\nkind = 'lambert'\ncolour = 3\n"
        "sheen = 1\n[[objects]]\nshape = 'disc'\nmaterial = 'a'\nradius = 0\n[[lights]]\n"
        "kind = 'flood'\nexponent = -1\nposition = 4\n"
    )
    found = faults(tmp_path, text)
    assert [line.split(":")[1] for line in found] == ["2", "3", "6", "7", "11", "14", "15"]


def test_what_is_no_scene_file(tmp_path):
    with pytest.raises(InputError, match=r"gone\.toml: no such file"):
        load_scene(tmp_path / "gone.toml")
    with pytest.raises(InputError, match="is a folder; expected a file"):
        load_scene(tmp_path)
    path = tmp_path / "binary.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="expected text in UTF-8"):
        load_scene(path)


def test_lines_of_keys():
    text = """a = [
  1, # ]
]
[[objects]]
"b c" = "[x]"
d.e = 1
[objects.inner]
f = '''
g = 1
'''
h = 2
[[objects]]
b = {c = 1}
"""
    found = line_numbers(text)
    assert found[("a",)] == 1
    assert found[("objects", 0, "b c")] == 5
    assert found[("objects", 0, "d", "e")] == 6
    assert found[("objects", 0, "inner", "h")] == 11
    assert ("objects", 0, "inner", "g") not in found
    assert found[("objects", 1)] == 12
    assert found[("objects", 1, "b")] == 13


def one_object(**given):
    return Scene([Object(**given)], [Ambient()])


MADE = build_mesh(np.eye(3), np.array([[0, 1, 2]]))
PIXELS = np.full((2, 2), 0.5)
REFUSED = {
    "mesh": (lambda: one_object(shape=MADE, material="gold", name="m"), "object m: its mesh was"),
    "texture": (
        lambda: one_object(
            shape=Sphere(), material=Textured(materials.Lambert(), colour=Texture(PIXELS))
        ),
        "object 0: its texture was not read from a file",
    ),
    "faces": (
        lambda: one_object(
            shape=Plane(), material=Textured(materials.Lambert(), colour=PerFace(np.ones(2)))
        ),
        "values for each face: textures of scene files are pictures",
    ),
    "material": (
        lambda: one_object(shape=Sphere(), material=materials.Phong(normalisation="book")),
        "object 0: a Phong with these options has no name in scene files",
    ),
    "map": (
        lambda: Scene([], [Environment(np.ones((2, 4)))]),
        r"light 0 \(Environment\): it was not read from a file",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_files_cannot_hold_is_refused(case, tmp_path):
    make, match = REFUSED[case]
    with pytest.raises(InputError, match=match):
        save_scene(make(), Camera(), tmp_path / "a.toml")
    with pytest.raises(InputError, match=r"scenes are written to .toml"):
        save_scene(Scene([]), Camera(), tmp_path / "a.json")
    assert not list(tmp_path.iterdir())


def test_changed_numbers_have_no_origin(assets):
    light, _ = load_environment(assets / "sky.npy")
    changed = Environment(2.0 * light.radiance)
    assert light_tables.described(light)["file"].endswith("sky.npy")
    with pytest.raises(InputError, match="was not read from a file"):
        light_tables.described(changed)
    assert light_tables.described(load_lobes(assets / "sky.json"))["kind"] == "lobes"
    assert files.TABLES[0] == "scene"
    with pytest.raises(InputError, match="space must be one of srgb, linear"):
        load_texture(assets / "wood.png", space="xyz")
    codes = load_texture(assets / "wood.png", space="linear").pixels
    assert float(codes[0, 0, 1]) == pytest.approx(3 / 255)


def inside_out(closed=True):
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    return corners, faces if closed else faces[:3]


def bare(faces, corners):
    normals = np.tile([0.0, 0.0, 1.0], (len(corners), 1))
    return Mesh(corners, faces, normals)


def balls(*materials, **more):
    return [
        Object(Sphere(), each, translate(3.0 * k, 0.0, 0.0), **more)
        for k, each in enumerate(materials)
    ]


CORNERS, FACES = inside_out()
FLAT = np.array([[0, 2, 1], [0, 1, 1]])
TEXTURED = Textured(materials.Lambert(), colour=Texture(PIXELS))
# A scene, severity, place and text of what is found.
FINDINGS = {
    "turned": (
        lambda: [Object(build_mesh(CORNERS, FACES), "gold")],
        ("note", "object 1", "normals pointed inwards: all 4 faces were turned"),
    ),
    "wound": (
        lambda: [Object(build_mesh(CORNERS, np.r_[FACES[:, ::-1][:3], FACES[3:]]), "gold")],
        ("note", "object 1", "1 faces were wound against the others"),
    ),
    "dropped": (
        lambda: [Object(build_mesh(CORNERS, FLAT), "lambert")],
        ("note", "object 1", "1 faces without area were left out"),
    ),
    "inwards": (
        lambda: [Object(bare(FACES, CORNERS), "gold", name="body")],
        ("error", "object body", "normals point inwards"),
    ),
    "flat": (
        lambda: [Object(bare(FLAT, CORNERS), "lambert")],
        ("warning", "object 1", "1 faces have no area"),
    ),
    "open mesh of glass": (
        lambda: [Object(build_mesh(CORNERS, inside_out(False)[1]), "glass")],
        ("warning", "object 1", "an? open mesh has no inside"),
    ),
    "pane of glass": (
        lambda: [Object(Plane(), "glass")],
        ("warning", "object 1", "a plane has no inside"),
    ),
    "same place": (
        lambda: [Object(Sphere(), "lambert"), Object(Sphere(), "mirror")],
        ("error", "object 1 and object 2", "exactly the same place"),
    ),
    "same plane": (
        lambda: [
            Object(Plane(2.0, 2.0), "lambert"),
            Object(Disc(0.3), "lambert", translate(0.5, 0.0, 0.0), name="b"),
        ],
        ("warning", "object 1 and object b", "surfaces in one plane"),
    ),
    "glass on the floor": (
        lambda: [
            Object(Plane(2.0, 2.0), "lambert"),
            Object(Box(), "glass", translate(0.0, 0.0, 0.5)),
        ],
        ("warning", "object 1 and object 2", "surfaces in one plane"),
    ),
    "glowing glass": (
        lambda: [Object(Sphere(), "glass", emission=1.0)],
        ("warning", "object 1", "emits light and lets light pass"),
    ),
    "too bright": (
        lambda: balls(materials.Lambert(0.9) + materials.Lambert(0.9)),
        ("warning", "object 1", "reflects up to 1.80 of the light"),
    ),
    "dark": (
        lambda: balls("lambert", emission=0.0),
        ("warning", "object 1", "emits 0"),
    ),
    "no uv": (
        lambda: [Object(build_mesh(CORNERS, FACES), TEXTURED)],
        ("error", "object 1", "no texture coordinates for colour"),
    ),
    "number of faces": (
        lambda: [Object(Plane(), Textured(materials.Lambert(), colour=PerFace(np.ones(3))))],
        ("error", "object 1", "colour has values for 3 faces; the shape has 2"),
    ),
    "inside a ball": (
        lambda: [Object(Sphere(9.0), "lambert")],
        ("warning", "camera", "is inside object 1"),
    ),
    "inside a box": (
        lambda: [Object(Box((9.0, 9.0, 9.0)), "lambert", rotate((1, 1, 0), 20.0))],
        ("warning", "camera", "is inside object 1"),
    ),
    "nothing seen": (
        lambda: [Object(Sphere(), "lambert", translate(0.0, -9.0, 0.0))],
        ("error", "camera", "nothing is seen"),
    ),
}


@pytest.mark.parametrize("case", FINDINGS)
def test_findings(case):
    make, (severity, place, text) = FINDINGS[case]
    found = check(Scene(make(), [Ambient()]), Camera())
    hits = [f for f in found if f.severity == severity and f.place == place]
    assert any(re.search(text, f.text) for f in hits), found


def test_lights_that_are_none():
    ball = balls("lambert")
    found = check(Scene(ball, [Point(intensity=0.0), Environment(np.zeros((2, 4)))]), Camera())
    assert [f.severity for f in found] == ["error", "warning", "warning"]
    assert found[0].text.startswith("there is no light")
    assert found[1].place == "light 1 (Point)"
    assert [f.place for f in check(Scene([], [Environment(1.0)]), Camera())] == ["camera"]


def test_nothing_to_object_to():
    objects = [
        Object(Plane(4.0, 4.0), "lambert"),
        # Stands on the floor, beside another with which it shares a side's plane.
        Object(Box(), "lambert", translate(0.0, 0.0, 0.5)),
        Object(Box(), "lambert", translate(1.5, 0.0, 0.5)),
        Object(
            Sphere(0.3), naming.named("plastic", colour=0.5).material, translate(-1.0, 0.0, 1.0)
        ),
    ]
    assert check(Scene(objects, [Environment(0.3)]), Camera((0.0, -4.0, 1.0))) == []
