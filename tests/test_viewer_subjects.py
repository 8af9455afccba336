"""What the viewer draws, against the parts of the library that draw it more slowly."""

import dataclasses
import json
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from transfer_cases import LAMBERT, grid, lifted

import diffopt as do
from diffopt import samples
from diffopt.drawing import meshes, tones, views
from diffopt.errors import InputError
from diffopt.kernels import spectrum
from diffopt.scenes import Directional, Environment, primary
from diffopt.scenes.shapes import Box
from diffopt.shadows import animations, pictures
from diffopt.transfer import Relit, layers, precompute, relighting
from diffopt.transfer.settings import TransferSettings
from diffopt.viewer import controls, exponents, glossy, gltf, painting, panels, surfaces
from diffopt.viewer.diffracting import Diffracting
from diffopt.viewer.scenery import Scenery
from diffopt.viewer.screen import PIXELS, Times
from diffopt.viewer.shadowed import Shadowed
from diffopt.viewer.subject import Coloured, Look, Meshed, Row, StaleError, Subject


def built(subject, values):
    """All that frames of these values are made from, as a session asks for it."""
    found, keys = {}, {}
    while True:
        wanted = subject.wanted(values, found)
        missing = [name for name, key in wanted.items() if keys.get(name) != key]
        if not missing:
            return found
        name = missing[0]
        found[name], keys[name] = subject.build(name, wanted[name]), wanted[name]


def camera(subject, size=(96, 64)):
    place = subject.place
    return do.Camera(place.eye, place.target, place.up, size, place.field_of_view)


@pytest.fixture(scope="module")
def disc():
    scan = samples.compact_disc(jax.random.key(0), shape=(128, 128), pixel=0.1)
    return Diffracting(scan, coherence=0.8, name="disc")


@pytest.fixture(scope="module")
def table(disc):
    return built(disc, {**controls.initial(disc.controls), "tolerance": 0.03})


def values(subject, **changed):
    found = controls.initial(subject.controls)
    for name, value in changed.items():
        found = controls.changed(subject.controls, found, name, value)
    return found


def test_rays_meet_what_is_before_the_camera():
    mesh, _ = surfaces.ball()
    view = do.Camera((0.0, -4.0, 1.0), resolution=(80, 60), field_of_view=45.0)
    hits = primary.PrimaryCaster(mesh.vertices, mesh.faces)(view)
    origin, along = view.rays(np.arange(80 * 60))
    b = (origin * along).sum(1)
    root = b * b - (origin[0] @ origin[0] - 1.0)
    seen = np.zeros(len(along), bool)
    seen[hits.pixel] = True
    # But for the outline: facets of the ball lie up to 3e-4 below it.
    assert seen[root > 2e-3].all()
    assert not seen[root < 0.0].any()
    inner = np.flatnonzero(root[hits.pixel] > 0.05)
    exact = -b[hits.pixel] - np.sqrt(np.maximum(root[hits.pixel], 0.0))
    np.testing.assert_allclose(hits.distance[inner], exact[inner], atol=3e-3)
    assert hits.front[inner].all()
    points = (hits.shares[..., None] * mesh.vertices[mesh.faces[hits.face]]).sum(1)
    there = np.asarray(view.eye) + hits.distance[:, None] * along[hits.pixel]
    np.testing.assert_allclose(points, there, atol=1e-5)  # float32 of Embree


def test_rays_from_within_and_from_far_away():
    mesh, _ = surfaces.ball()
    caster = primary.PrimaryCaster(mesh.vertices, mesh.faces)
    inside = caster(do.Camera((0.0, 0.1, 0.0), (0.0, 1.0, 0.0), resolution=(20, 20)))
    assert len(inside.pixel) == 400
    assert not inside.front.any()
    far = do.Camera((0.0, -1e4, 0.0), resolution=(40, 40), field_of_view=0.015)
    hits = caster(far)
    assert 0.2 < len(hits.pixel) / 1600 < 0.9
    np.testing.assert_allclose(hits.distance.min(), 1e4 - 1.0, atol=0.02)  # rounding at 1e4


def test_chunks_are_put_together_in_order():
    count = 2 * painting.CHUNK + 17
    numbers = np.arange(count) % 251
    seen = []

    def shade(rows):
        seen.append(rows.shape)
        return np.stack([rows, rows + 1, rows + 2], -1).astype(np.uint8)

    found = painting.in_chunks(shade, count, numbers)
    assert set(seen) == {(painting.CHUNK,)}
    np.testing.assert_array_equal(found[:, 0], numbers)
    assert painting.in_chunks(shade, 0, numbers[:0]).shape == (0, 3)


def test_codes_are_those_of_the_tone_curve(rng):
    linear = rng.gamma(0.5, 2.0, (500, 3)).astype(np.float32)
    found = np.asarray(painting.codes(linear, np.float32(0.7)))
    expected = np.round(255.0 * tones.encode(tones.tone(linear.astype(float), 0.7)))
    assert np.abs(found.astype(int) - expected).max() <= 1  # rounding of float32
    codes = np.arange(258, dtype=np.uint8).reshape(-1, 3)
    encoded = np.asarray(spectrum.encode_srgb(jnp.asarray(painting.linear(codes))))
    np.testing.assert_allclose(255.0 * encoded, codes, atol=2e-4)


def test_a_mesh_file_holds_the_colours():
    mesh, _ = surfaces.sheet(around=5, along=4)
    colours = np.arange(len(mesh.vertices) * 3, dtype=np.uint8).reshape(-1, 3)
    data = gltf.encode(Coloured(mesh.vertices, mesh.faces, colours))
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    head = json.loads(data[20 : 20 + size])
    assert head["extensionsUsed"] == ["KHR_materials_unlit"]
    import trimesh

    # Another program's reader.
    found = trimesh.load_mesh(trimesh.util.wrap_as_stream(data), file_type="glb", process=False)
    np.testing.assert_allclose(found.vertices, mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)


def test_subjects_are_subjects(disc):
    for subject in (disc, Shadowed(animations.animation("egg"))):
        assert isinstance(subject, Subject)
        assert isinstance(subject, Meshed)


def test_diffraction_is_that_of_a_photograph(disc, table):
    """Its colours, by another geometry and the numbers of NumPy in float64."""
    chosen = values(disc, shape="ball", azimuth=-70.0, elevation=50.0, tolerance=0.03)
    found = built(disc, chosen)
    view = camera(disc)
    drawn = disc.pixels(found, Look(chosen, view))
    (_, _, _, _), baked = found["the table of colours"]
    mesh, field = surfaces.ball()
    seen = meshes.view(
        mesh,
        (64, 96),
        eye=np.array(view.eye),
        target=np.array(view.target),
        up=view.up,
        field_of_view_deg=view.field_of_view,
        field=field,
    )
    light = np.array(controls.light_direction(chosen))
    brdf = do.DiffractionBRDF(disc.scan, 0.8, fresnel=disc.fresnel, blur=0.0023)
    image = views.photograph(brdf, baked.table, seen, light)
    factor = float(baked.exposure)
    surroundings = np.asarray(baked.film.surroundings, float)
    rgb = tones.tone(tones.display(image.xyz + surroundings / factor), factor)
    expected = np.round(255.0 * tones.encode(rgb))
    # Away from the outline, where interpolated normals are turned.
    facing = (seen.normal * seen.eye).sum(-1) > 0.3
    sure = seen.covered & facing
    assert sure.sum() > 500
    difference = np.abs(drawn.astype(int) - expected)[sure]
    assert difference.max() <= 6  # the steep foot of the code, see test_frames
    assert difference.mean() < 0.3
    assert expected[sure].std() > 5.0  # there is something to be seen


def test_diffraction_follows_its_controls(disc, table):
    view = camera(disc)
    first = disc.pixels(table, Look(values(disc, tolerance=0.03), view))
    for name, value in (("azimuth", 20.0), ("turn", 40.0), ("exposure", -2.0)):
        other = disc.pixels(table, Look(values(disc, tolerance=0.03, **{name: value}), view))
        assert np.abs(other.astype(int) - first).mean() > 0.3, name
    colours = disc.colours(table, Look(values(disc, tolerance=0.03), view))
    assert colours.colours.shape == colours.vertices.shape
    assert colours.colours.std() > 3.0
    rows = disc.rows(table, Look(values(disc, tolerance=0.03), view))
    assert "0.03" in rows[0].because
    assert [row.included for row in rows] == [True, False, False, False]


def test_a_surface_that_is_too_small_is_refused():
    scan = do.Heightfield(np.zeros((8, 8), np.float32), 0.1)
    with pytest.raises(InputError, match="too small"):
        Diffracting(scan)


GLOSS = LAMBERT(0.4) + do.BlinnPhong(0.5, 20.0)
QUICK = TransferSettings(rays=256, finest=2, splits=1, tolerance=0.2, depth=2)


@pytest.fixture(scope="module")
def scene():
    box = do.Object(Box((0.8, 0.8, 0.8)), GLOSS, lifted(0.4))
    lights = [Environment(0.6), Directional((1.0, -1.0, 2.0), 2.0)]
    return do.Scene([do.Object(grid(4.0, 5), GLOSS), box], lights)


@pytest.fixture(scope="module")
def eye():
    return do.Camera((2.5, -3.5, 2.5), (0.0, 0.0, 0.3), resolution=(60, 44), field_of_view=45.0)


@pytest.fixture(scope="module")
def relit(scene, eye):
    return glossy.Glossy(precompute(scene, QUICK), scene, eye, "box")


@pytest.fixture(scope="module")
def tables(relit):
    return built(relit, controls.initial(relit.controls))


def test_glossy_frames_are_those_of_relighting(relit, tables, scene, eye):
    chosen = values(relit, turn=50.0, surroundings=True)
    drawn = relit.pixels(tables, Look(chosen, eye))
    loop = Relit(relit.transfer, scene, eye)
    loop.turn(50.0)
    held, _ = tables["tables and programs"]
    expected = np.asarray(painting.codes(loop.frame().reshape(-1, 3), held.exposure))
    difference = np.abs(drawn.reshape(-1, 3).astype(int) - expected)
    # Outlines may fall on another pixel by the rounding of rays.
    assert np.mean(difference.max(1) > 2) < 0.01
    assert expected.std() > 5.0  # there is something to be seen


def test_glossy_light_that_is_left_out_is_that_of_its_layers(relit, tables, eye):
    light = relit._light(values(relit))
    vertices = np.arange(len(relit.transfer.axes))
    away = np.asarray(eye.eye) - relit.transfer.mesh.vertices
    wo = (away / np.linalg.norm(away, axis=1, keepdims=True)).astype(np.float32)
    held = relighting.tables(relit.transfer)
    names = layers.LAYERS
    for kept in ((names[0],), (names[0], names[3]), (names[0], names[2], names[3]), names):
        less = glossy.reduced(held, kept)
        found = relighting.vertex_radiance(less, light, vertices, wo)
        parts = [
            relighting.vertex_radiance(layers.layer(held, name), light, vertices, wo)
            for name in kept
        ]
        np.testing.assert_allclose(found, sum(parts), rtol=2e-4, atol=1e-5)
    assert glossy.reduced(held, (names[0],)).lobes == held.lobes // 3


def test_a_tolerance_leaves_out_what_brings_less(relit, tables, eye):
    kept, (_, shares) = tables["the plan"]
    assert sum(shares.values()) == pytest.approx(1.0)
    assert set(kept) == set(shares)  # a tolerance of 0 leaves out nothing that brings anything
    chosen = values(relit, tolerance=0.3)
    less = built(relit, chosen)
    fewer = less["the plan"][0]
    out = set(shares) - set(fewer)
    assert out
    assert sum(shares[name] for name in out) <= 0.3
    rows = relit.rows(less, Look(chosen, eye))
    assert sum(not row.included for row in rows) == len(out)
    both = [relit.pixels(each, Look(chosen, eye)).astype(int) for each in (tables, less)]
    assert 0.0 < np.abs(both[0] - both[1]).mean() < 40.0


def test_exponents_are_replaced(scene):
    changed = exponents.replaced(scene, 60.0)
    assert exponents.first(changed) == 60.0
    assert exponents.first(scene) == 20.0
    with pytest.raises(InputError, match="no material of the scene has an exponent"):
        exponents.replaced(do.Scene([do.Object(grid(1.0, 1), LAMBERT(0.5))]), 3.0)


@pytest.mark.long
def test_another_exponent_is_that_of_another_precomputation(scene, eye):
    """Of a plane that sees nothing else, where direct light is all."""
    lights = scene.lights
    flat = do.Scene([do.Object(grid(4.0, 3), GLOSS)], lights)
    sharp = do.Scene([do.Object(grid(4.0, 3), LAMBERT(0.4) + do.BlinnPhong(0.5, 60.0))], lights)
    subject = glossy.Glossy(precompute(flat, QUICK), flat, eye)
    found = subject._sharper(subject._tables, 60.0)
    expected = relighting.tables(precompute(sharp, QUICK))
    np.testing.assert_allclose(found.over.rows, expected.over.rows, rtol=1e-5, atol=1e-6)


def test_the_ground_is_that_of_diffopt_shadow():
    subject = Shadowed(animations.animation("egg"))
    chosen = values(subject, play=False, phase=0.25, tolerance=0.03, lamp=False)
    found = built(subject, chosen)
    memory = {}
    size = (160, 100)
    drawn = subject.pixels(found, Look(chosen, camera(subject, size), memory=memory))
    stage = pictures.Stage(size, 1)
    body = animations.animation("egg")
    expected = stage.draw(
        body.vertices(0.25), body.faces, body.colour, memory["grid"].astype(float), None
    )
    # Where the ground does not fade and the object is not.
    whole = (stage._shown > 0.999).reshape(100, 160)
    caster = primary.PrimaryCaster(body.vertices(0.25), body.faces)
    covered = np.zeros(100 * 160, bool)
    covered[caster(stage.camera).pixel] = True
    sure = whole & ~covered.reshape(100, 160)
    assert sure.sum() > 1500
    difference = np.abs(drawn.astype(int) - expected.astype(int))[sure]
    assert difference.max() <= 2  # rounding of float32 and of codes
    mesh = subject.colours(found, Look(chosen, camera(subject, size), memory=memory))
    assert mesh.colours.std() > 5.0
    assert mesh.faces.max() < len(mesh.vertices)
    words = [
        row.because for row in subject.rows(found, Look(chosen, camera(subject), memory=memory))
    ]
    assert "0.03" in words[0]


def test_a_shape_that_stays_is_not_sampled_again():
    subject = Shadowed(animations.animation("egg"))
    chosen = values(subject, play=False, tolerance=0.05)
    found = built(subject, chosen)
    look = Look(chosen, camera(subject, (40, 30)))
    subject.pixels(found, look)
    field = look.memory["occluder"].fields[0]
    subject.pixels(found, dataclasses.replace(look, values={**chosen, "azimuth": 10.0}))
    assert look.memory["occluder"].fields[0].table is field.table
    playing = {**chosen, "play": True}
    assert subject.moves(playing)
    subject.pixels(found, dataclasses.replace(look, values=playing, clock=2.0))
    assert look.memory["occluder"].fields[0].table is not field.table


@pytest.mark.long
def test_a_scene_is_the_mean_over_its_takes(scene, eye):
    view = dataclasses.replace(eye, resolution=(128, 64))
    subject = Scenery(scene, view, "box")
    chosen = values(subject, level="all paths")
    found = built(subject, chosen)
    memory = {}
    frames = [subject.pixels(found, Look(chosen, view, take=k, memory=memory)) for k in range(6)]
    assert frames[0].shape == (64, 128, 3)
    truth = do.render(scene, view, "path", spp=64, seed=9)
    factor = subject._exposure
    expected = 255.0 * tones.encode(tones.tone(np.maximum(truth.rgb, 0.0), factor))
    errors = [np.sqrt(((f - expected) ** 2).mean()) for f in frames]
    assert errors[5] < 0.6 * errors[0]  # 1 / sqrt(6), and what the reference has
    with pytest.raises(StaleError):
        subject.pixels(found, Look(chosen, view, memory=memory, stale=lambda: True))


def test_a_scene_by_a_plan_shows_the_plan(scene, eye):
    subject = Scenery(scene, eye, "box")
    chosen = values(subject, tolerance=0.3)
    found = built(subject, chosen)
    rows = subject.rows(found, Look(chosen, eye))
    plan = found["the plan"]
    assert [row.effect for row in rows[:-2]] == [row.effect for row in plan.rows]
    assert [row.included for row in rows[:-2]] == [row.included for row in plan.rows]
    image = subject.pixels(found, Look(chosen, eye))
    assert image.std() > 5.0


def test_words_beside_the_picture_are_escaped():
    text = panels.table([Row("<b>", True, "a & b", "c < d"), Row("x", False, "y")])
    assert "<b>" not in text
    assert "a &amp; b" in text
    assert "opacity" in text
    assert panels.table([]) == ""
    said = panels.status(Times(PIXELS, 0.0123, 0.05, (640, 480), 12.0), "building a table: 3 s")
    assert "12 ms to compute 640×480 pixels, 50 ms" in said
    assert "building a table" in said
