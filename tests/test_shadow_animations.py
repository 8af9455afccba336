"""Animations, their meshes and pictures, and occluders that follow them."""

import numpy as np
import pytest
import trimesh

from diffopt.errors import InputError
from diffopt.kernels import harmonics
from diffopt.shadows import (
    Occluder,
    ShadowSettings,
    animations,
    creatures,
    distant_light,
    irradiance,
    pictures,
    plane,
    rays,
    sampling,
    shadow_field,
    truth,
)
from diffopt.shadows.moving import Times

SMALL = ShadowSettings(bands=3, directions=(8, 12), rays=12, shells=2, radial=16)
PHASES = np.arange(12) / 12.0


def edges(vertices, faces):
    ends = vertices[faces]
    return np.linalg.norm(np.roll(ends, -1, axis=1) - ends, axis=-1)


@pytest.mark.parametrize("name", animations.NAMES)
def test_loops_close_and_change(name):
    scene = animations.animation(name)
    first = scene.vertices(0.0)
    np.testing.assert_allclose(scene.vertices(1.0), first, atol=1e-12)
    np.testing.assert_allclose(scene.vertices(0.3), scene.vertices(1.3), atol=1e-12)
    # No faster at the seam than elsewhere: the loop has no jump.
    steps = [
        np.linalg.norm(scene.vertices(t + 1e-3) - scene.vertices(t), axis=1).max()
        for t in np.append(PHASES, 0.9995)
    ]
    assert min(steps) > 0.0
    assert max(steps) < 0.03
    for t in PHASES:
        points = scene.vertices(t)
        assert points.shape == first.shape
        assert points[:, 2].min() > 0.1
        centre, radius = sampling.bounding_sphere(points)
        away = np.linalg.norm(points - centre, axis=1)
        assert away.max() <= radius * (1.0 + 1e-9)
        assert 0.5 < radius < 2.0
        assert np.abs(centre[:2]).max() + radius < 0.5 * animations.GROUND
        # Poses are rigid: the frame of the object keeps all lengths.
        shape = scene.shape(t)
        np.testing.assert_allclose(
            edges(points, scene.faces), edges(shape, scene.faces), atol=1e-12
        )


def test_numbers_of_vertices_and_faces():
    found = {
        name: (len(animations.animation(name).shape(0.0)), len(animations.animation(name).faces))
        for name in animations.NAMES
    }
    assert found == {"creature": (1180, 2332), "egg": (482, 960), "sheet": (8382, 16380)}


@pytest.mark.parametrize(("name", "bodies"), [("creature", 7), ("egg", 1)])
def test_bodies_are_closed_and_keep_their_sides(name, bodies):
    scene = animations.animation(name)
    for t in PHASES[::3]:
        mesh = trimesh.Trimesh(scene.vertices(t), scene.faces, process=False)
        assert mesh.is_watertight
        assert mesh.is_winding_consistent
        parts = mesh.split(only_watertight=True)
        assert len(parts) == bodies
        assert all(part.volume > 0.0 for part in parts)
        assert mesh.area_faces.min() > 1e-8
        lengths = edges(mesh.vertices, scene.faces)
        assert lengths.min() > 1e-4
        assert lengths.max() < 0.4


def test_the_creature_is_symmetric_without_sway_and_beats_its_wings():
    still = creatures.creature(0.4, 0.0)
    wings = np.array_split(still[-652:], 2)
    np.testing.assert_array_equal(wings[0] * [1.0, -1.0, 1.0], wings[1])
    tips = [creatures.creature(beat, 0.0)[-652:-326, 2].max() for beat in (1.6, 4.7)]
    assert tips[0] > tips[1] + 0.5
    limbs = creatures.creature_parts()
    assert sum(map(len, limbs)) == 2332
    used = [set(np.unique(part)) for part in limbs]
    assert used[2].isdisjoint(used[3])
    assert set.union(*used) == set(range(1180))


def test_the_sheet_bends_without_stretching():
    scene = animations.animation("sheet")
    rest = edges(scene.shape(0.0), scene.faces)
    for t in (0.1, 0.25, 0.8):
        # Chords of arcs: shorter than these by (curvature x edge)^2 / 24.
        ratio = edges(scene.shape(t), scene.faces) / rest
        assert 0.99995 < ratio.min() <= ratio.max() < 1.0 + 1e-12
    assert np.ptp(scene.shape(0.25)[:, 2]) > 0.6
    np.testing.assert_allclose(np.ptp(scene.shape(0.0)[:, 2]), 0.0, atol=1e-12)


def test_bending_and_twisting_keep_what_they_should(rng):
    points = rng.normal(size=(50, 3))
    np.testing.assert_allclose(animations.bent(points, 0.0), points, atol=1e-15)
    np.testing.assert_allclose(animations.bent(points, 1e-9), points, atol=1e-7)
    twisted = animations.twisted(points, 0.7)
    np.testing.assert_allclose(twisted[:, 2], points[:, 2])
    np.testing.assert_allclose(np.hypot(*twisted[:, :2].T), np.hypot(*points[:, :2].T), rtol=1e-12)
    # A circle: points of the sheet lie at the distance 1 / curvature from its centre.
    line = np.stack([np.linspace(-1.0, 1.0, 9), np.zeros(9), np.zeros(9)], -1)
    bent = animations.bent(line, 0.8)
    np.testing.assert_allclose(np.linalg.norm(bent - [0.0, 0.0, 1.25], axis=1), 1.25)


def test_any_mesh_is_scaled_turned_and_put_over_the_ground():
    mesh = trimesh.creation.cone(radius=30.0, height=100.0, sections=12)
    points = np.asarray(mesh.vertices)[:, (1, 2, 0)]  # its tip along y
    scene = animations.of_mesh(points, mesh.faces, "cone.ply", up="y")
    first = scene.vertices(0.0)
    tip = np.argmax(mesh.vertices[:, 2])
    assert np.argmax(first[:, 2]) == tip
    np.testing.assert_allclose(np.linalg.norm(first - first[tip], axis=1).max(), 1.81, atol=0.1)
    np.testing.assert_allclose(scene.vertices(1.0), first, atol=1e-12)
    assert trimesh.Trimesh(first, scene.faces, process=False).volume > 0.0
    assert min(scene.vertices(t)[:, 2].min() for t in PHASES) > 0.05
    assert np.abs(scene.vertices(0.5) - first).max() > 0.2
    with pytest.raises(InputError, match="up must be one of x, y, z; received 'w'"):
        animations.of_mesh(points, mesh.faces, up="w")
    with pytest.raises(InputError, match="dot: all vertices lie in one point"):
        animations.of_mesh(np.ones((3, 3)), np.array([[0, 1, 2]]), "dot")
    with pytest.raises(InputError, match="animation must be one of creature, egg, sheet"):
        animations.animation("dragon")


def test_light_of_the_sky_and_the_lamp():
    up, down = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    assert (animations.sky(up) > 0.0).all()
    np.testing.assert_array_equal(animations.sky(down), 0.0)
    first, last = animations.lamp(0.0), animations.lamp(1.0)
    np.testing.assert_allclose(first.centre, last.centre, atol=1e-6)
    reach = animations.animation("creature").vertices(0.0)
    assert np.linalg.norm(reach - np.asarray(first.centre), axis=1).min() > 0.2


@pytest.fixture
def casts(monkeypatch):
    """Numbers of rays of each query."""
    counted = []
    blocked = rays.Rays.blocked

    def counting(self, starts, directions):
        counted.append(len(starts))
        return blocked(self, starts, directions)

    monkeypatch.setattr(rays.Rays, "blocked", counting)
    return counted


def test_only_changed_shapes_cast_rays(casts):
    egg = animations.animation("egg")
    occluder = Occluder(egg.faces, SMALL)
    assert occluder.update(egg.shape(0.0))
    cast = sum(casts)
    assert cast > 8 * 12 * 144
    assert occluder.times.sampled == 1
    assert occluder.times.sampling > 0.0
    assert occluder.times.conversion > 0.0
    casts.clear()
    first = occluder.fields[0]
    assert not occluder.update(egg.shape(0.0).copy())
    occluder.move(translation=[1.0, 2.0, 3.0])
    assert not occluder.update(egg.shape(0.0))
    assert casts == []
    assert occluder.times.sampled == 0
    assert occluder.times.conversion == 0.0
    assert occluder.fields[0].table is first.table
    np.testing.assert_allclose(occluder.fields[0].centre - first.centre, [1, 2, 3], atol=1e-6)
    # The same array with other numbers in it is another shape.
    shape = egg.shape(0.0)
    assert not occluder.update(shape)
    shape[0, 2] *= 1.01
    assert occluder.update(shape)
    assert sum(casts) == cast


def test_a_moved_field_is_what_sampling_finds_there():
    creature = animations.animation("creature")
    shape = creature.shape(0.1)
    settings = ShadowSettings(shells=3)
    occluder = Occluder(creature.faces, settings)
    occluder.move(*creature.pose(0.3))
    occluder.move(*creature.pose(0.1))  # places, not steps
    occluder.update(shape)
    world = occluder.vertices
    np.testing.assert_allclose(world, creature.vertices(0.1), atol=1e-12)
    fresh = shadow_field(world, creature.faces, settings)
    ground = plane(animations.GROUND, 24)
    lights = distant_light(animations.sky, 4)
    up = np.array([0.0, 0.0, 1.0])
    moved, again = (
        np.asarray(irradiance(ground, up, fields, lights)) for fields in (occluder.fields, [fresh])
    )
    open_ground = np.asarray(irradiance(ground[0, 0], up, [], lights))
    assert (1.0 - again / open_ground).max() > 0.15
    # Both lie on grids of directions, which are turned against each other.
    error = (moved - again) / open_ground
    assert np.sqrt((error**2).mean()) < 4e-3
    assert np.abs(error).max() < 0.02


def test_parts_are_sampled_where_they_changed(casts):
    creature = animations.animation("creature")
    occluder = Occluder(creature.faces, SMALL, parts=creature.limbs)
    shape = creature.shape(0.0)
    assert occluder.update(shape)
    assert occluder.times.sampled == 4
    before = occluder.fields
    each = sum(casts) // 4
    casts.clear()
    wing = np.unique(creature.limbs[2])
    shape[wing, 2] += 0.1
    assert occluder.update(shape)
    assert occluder.times.sampled == 1
    assert sum(casts) == each
    same = [a.table is b.table for a, b in zip(before, occluder.fields, strict=True)]
    assert same == [True, True, False, True]
    # A number: split once, by the first shape.
    halves = Occluder(creature.faces, SMALL, parts=2)
    halves.update(creature.shape(0.0))
    halves.update(creature.shape(0.5))
    assert len(halves.fields) == 2


def test_shells_inside_go_down_once_and_for_all(casts):
    egg = animations.animation("egg")
    below = np.array([[0.0, 0.0, -1.07]])
    shape = egg.shape(0.0)
    centre, radius = sampling.bounding_sphere(shape)
    inside = centre - np.array([0.0, 0.0, 0.75 * radius])
    occluder = Occluder(egg.faces, SMALL)
    occluder.update(shape, below)
    rows = occluder.fields[0].table.shape
    # Receivers inside the sphere: sampled there once, and not given up for others.
    assert occluder.update(shape, inside)
    assert occluder.times == Times(*occluder.times[:2], 1)
    deeper = occluder.fields[0].table.shape
    assert occluder.fields[0].inner == 3
    assert not occluder.update(shape, inside)
    assert not occluder.update(shape, below)
    occluder.update(egg.shape(0.1), below)
    assert occluder.fields[0].table.shape == deeper
    assert rows != deeper
    # Foreseen, they need no second shape of the table, and no ray until then.
    other = Occluder(egg.faces, SMALL)
    casts.clear()
    other.foresee(shape, inside)
    assert casts == []
    other.update(shape, below)
    assert other.fields[0].table.shape == deeper
    assert not other.update(shape, inside)


def test_bad_shapes_and_places():
    egg = animations.animation("egg")
    occluder = Occluder(egg.faces, SMALL)
    with pytest.raises(InputError, match=r"no shape yet: call update\(vertices\) first"):
        occluder.fields  # noqa: B018
    with pytest.raises(InputError, match=r"no shape yet: call update\(vertices\) first"):
        occluder.vertices  # noqa: B018
    with pytest.raises(InputError, match="faces must name vertices 0 to 9; received 0 to 481"):
        occluder.update(egg.shape(0.0)[:10])
    with pytest.raises(InputError, match=r"receivers must be points \[..., 3\]; received \(4, 2\)"):
        occluder.update(egg.shape(0.0), np.zeros((4, 2)))
    with pytest.raises(InputError, match="rotation must be orthogonal with determinant 1"):
        occluder.move(2.0 * np.eye(3))
    with pytest.raises(InputError, match="rotation must be orthogonal with determinant 1"):
        occluder.move(np.diag([1.0, 1.0, -1.0]))
    with pytest.raises(InputError, match=r"rotation must be \[3, 3\]; received \(3,\)"):
        occluder.move(np.ones(3))
    with pytest.raises(InputError, match="translation must be three finite numbers"):
        occluder.move(translation=[0.0, np.nan, 0.0])
    with pytest.raises(InputError, match="parts must be at least 1; received 0"):
        Occluder(egg.faces, SMALL, parts=0)
    with pytest.raises(InputError, match="parts must hold the faces of one part at least"):
        Occluder(egg.faces, SMALL, parts=())


def test_pictures_show_ground_object_lamp_and_shadow():
    stage = pictures.Stage((64, 40), spp=2)
    ball, faces = creatures.ball(12, 16)
    ball = 0.6 * ball + [0.0, 0.0, 1.0]
    grid = plane(animations.GROUND, 24)
    found, clear = truth.irradiance(grid.reshape(-1, 3), [(ball, faces)], animations.sky, polar=12)
    open_ground = np.broadcast_to(clear, grid.shape)
    red = (0.8, 0.05, 0.05)
    lit = stage.draw(ball, faces, red, open_ground)
    shaded = stage.draw(ball, faces, red, found.reshape(grid.shape))
    assert lit.shape == (40, 64, 3)
    assert lit.dtype == np.uint8
    covered = lit[..., 0].astype(int) - lit[..., 1] > 60
    assert 60 < covered.sum() < 500
    # Only the ground darkens, and it does so near the object.
    darker = lit.astype(int).sum(-1) - shaded.sum(-1)
    assert darker.min() >= -6
    assert darker.max() > 60
    inner = covered.copy()  # pixels at its edge hold some ground
    for axis, step in ((0, 1), (0, -1), (1, 1), (1, -1)):
        inner &= np.roll(covered, step, axis)
    assert inner.sum() > 40
    assert (lit[inner] == shaded[inner]).all()
    lamp = animations.lamp(0.0)
    bright = stage.draw(ball, faces, red, open_ground, lamp).astype(int)
    bulb = (bright - lit).sum(-1) > 250
    assert 1 <= bulb.sum() < 60


def test_light_on_an_object_by_rays():
    """A small ball has the irradiance of its normals; the ground sends light to its lower half."""
    ball, faces = creatures.ball(9, 12)
    ball = 1e-1 * ball + [0.0, 0.0, 5.0]
    normals = pictures.vertex_normals(ball, faces)
    np.testing.assert_allclose(normals, (ball - [0, 0, 5.0]) / 0.1, atol=0.07)
    front, back = pictures.lit(rays.Rays(ball, faces), ball, faces)
    above, weights = harmonics.hemisphere_rule(12, 28)
    clear = np.clip(normals @ above.T, 0.0, None) @ (animations.sky(above) * weights[:, None])
    bounce = front - clear
    assert bounce.min() > -1e-9
    assert bounce[-1].max() < 1e-3  # the top sees no ground
    assert bounce[-2].min() > 0.2
    assert (back[-1] < front[-1]).all()
    lamp = animations.lamp(0.0)
    with_lamp, _ = pictures.lit(rays.Rays(ball, faces), ball, faces, lamp)
    towards = np.asarray(lamp.centre) - ball
    facing = (normals * towards).sum(1) > 0.3 * np.linalg.norm(towards, axis=1)
    assert facing.any()
    gain = (with_lamp - front)[facing]
    distance = np.linalg.norm(towards[facing], axis=1)
    cosine = (normals[facing] * towards[facing]).sum(1) / distance
    expected = np.pi * cosine * (float(lamp.radius) / distance) ** 2
    np.testing.assert_allclose(gain, expected[:, None] * np.asarray(lamp.radiance), rtol=0.03)
