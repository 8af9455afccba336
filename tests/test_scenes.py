"""Scenes: shapes in their places, what rays meet, lights against closed forms, channels."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import scenes
from diffopt.errors import InputError
from diffopt.lobes import Lobes
from diffopt.materials import Lambert, Microfacet, Mirror, Sum
from diffopt.materials.naming import named
from diffopt.rendering import sources
from diffopt.scenes import raycasting, sky, transforms, world
from diffopt.scenes.channels import Channels

GREY = Lambert(0.5)


def everything():
    """One of each shape, turned and scaled."""
    turn = scenes.rotate((1, 2, 3), 40.0)
    bump = scenes.build_mesh(
        np.array([[0.0, 0, 0], [1, 0, 0.2], [1, 1, 0], [0, 1, 0.3]]),
        np.array([[0, 1, 2], [0, 2, 3]]),
        np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]),
    )
    return scenes.Scene(
        [
            scenes.Object(scenes.Plane(3.0, 2.0), GREY, scenes.translate(0.0, 0.0, -2.0) @ turn),
            scenes.Object(
                scenes.Sphere(0.7), GREY, scenes.translate(2.0, 0.0, 0.0) @ scenes.scale(1.5)
            ),
            scenes.Object(
                scenes.Box((1.0, 2.0, 0.5)), GREY, scenes.translate(-2.0, 0.5, 0.0) @ turn
            ),
            scenes.Object(scenes.Disc(0.8), GREY, scenes.translate(0.0, 2.0, 0.5) @ turn),
            scenes.Object(bump, GREY, scenes.scale(1.0, -1.0, 2.0)),
        ]
    )


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(3)
    origin = rng.normal(size=(4000, 3))
    origin *= 5.0 / np.linalg.norm(origin, axis=1, keepdims=True)
    towards = rng.uniform(-2.0, 2.0, (4000, 3)) - origin
    return origin, towards / np.linalg.norm(towards, axis=1, keepdims=True)


@pytest.fixture(scope="module")
def met(rays):
    geometry = everything().geometry
    hits = raycasting.caster(geometry).first(*rays)
    some = np.flatnonzero(hits.primitive >= 0)
    reached = rays[0][some] + hits.distance[some, None] * rays[1][some]
    found = jax.jit(world.surface)(
        geometry.typed("float32"),
        jnp.asarray(hits.primitive[some]),
        jnp.asarray(hits.u[some]),
        jnp.asarray(hits.v[some]),
        jnp.asarray(reached, jnp.float32),
    )
    return geometry, hits, some, reached, jax.tree.map(np.asarray, found)


def test_rays_meet_every_shape_where_they_say(rays, met):
    geometry, hits, some, reached, found = met
    assert set(geometry.owner[hits.primitive[some]]) == set(range(5))
    # Embree's distances in float32, in a scene of radius 4.
    np.testing.assert_allclose(found.position, reached, atol=2e-5)


def test_frames_are_right_handed_and_on_the_front(met):
    found = met[-1]
    frame = np.stack([found.tangent, found.across, found.normal], axis=1)
    np.testing.assert_allclose(
        frame @ frame.transpose(0, 2, 1), np.broadcast_to(np.eye(3), frame.shape), atol=3e-6
    )
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, atol=3e-6)
    assert ((found.normal * found.geometric).sum(-1) > 0.5).all()
    assert (found.uv > -1e-5).all()
    assert (found.uv < 1.0 + 1e-5).all()


def test_closed_shapes_face_outwards(met):
    geometry, hits, some, reached, found = met
    owner = geometry.owner[hits.primitive[some]]
    for number, centre in ((1, [2.0, 0, 0]), (2, [-2.0, 0.5, 0])):
        here = owner == number
        outwards = reached[here] - centre
        assert ((found.geometric[here] * outwards).sum(-1) > 0.0).all()


def test_backends_agree(rays, met):
    geometry, hits, *_ = met
    other = raycasting.Caster(geometry, "jax")
    found = other.first(*rays)
    # Rays through edges may be given to either neighbour.
    assert (found.primitive == hits.primitive).mean() > 0.999
    same = found.primitive == hits.primitive
    np.testing.assert_allclose(found.distance[same], hits.distance[same], rtol=3e-6)
    length = np.full(len(rays[0]), 4.5)
    blocked = raycasting.caster(geometry).blocked(*rays, length)
    assert (other.blocked(*rays, length) == blocked).mean() > 0.999
    assert (blocked == (hits.distance < 4.5)).mean() > 0.999


def test_camera_centre_and_edges():
    camera = scenes.Camera(eye=(0.0, -3.0, 0.0), resolution=(4, 2), field_of_view=90.0)
    origin, along = camera.rays(np.arange(8))
    assert np.allclose(origin, [0.0, -3.0, 0.0])
    # Pixels are half as high as the picture's half slope, 1; x to the right, z up.
    slopes = along[:, [0, 2]] / along[:, 1:2]
    np.testing.assert_allclose(slopes[0], [-1.5, 0.5])
    np.testing.assert_allclose(slopes[7], [1.5, -0.5])


def plane_under(light, wavelengths=None, emitter=None):
    """Radiance that a grey plane at the origin reflects of lights, by their own sampling."""
    objects = [scenes.Object(scenes.Plane(), GREY)]
    scene = scenes.Scene(
        objects + ([emitter] if emitter else []), [light] if light else [], wavelengths=wavelengths
    )
    lights = sources.gather(scene, "float64")
    rng = np.random.default_rng(5)
    u = jnp.asarray(rng.random((20000, 4)))
    drawn = jax.jit(lambda u: lights.draw(u, jnp.zeros((len(u), 3))))(u)
    value = np.asarray(drawn.value) * np.maximum(np.asarray(drawn.towards)[:, 2:], 0.0)
    error = value.std(axis=0) / np.sqrt(len(value))
    return value.mean(axis=0), error + 1e-12


POINT = {"position": (0.0, 3.0, 4.0), "intensity": (2.0, 1.0, 0.5)}
COS, DISTANCE = 0.8, 5.0


@pytest.mark.parametrize(
    ("light", "expected"),
    [
        (scenes.Directional((0, 3, 4), 2.0), 2.0 * COS),
        (scenes.Point(**POINT), COS / DISTANCE**2 * np.array([2.0, 1.0, 0.5])),
        (
            scenes.Point(**POINT, falloff=scenes.Falloff(0.5, 1, 2)),
            COS / (0.5 * DISTANCE + 2.0) * np.array([2.0, 1.0, 0.5]),
        ),
        (
            scenes.Point(**POINT, falloff=scenes.Falloff(0.1, 3, 1)),
            COS / (0.1 * DISTANCE**3 + 1.0) * np.array([2.0, 1.0, 0.5]),
        ),
        (
            scenes.Flood(**POINT, aim=(0, 0, -2), exponent=5),
            COS**6 / DISTANCE**2 * np.array([2.0, 1.0, 0.5]),
        ),
        (scenes.Flood(**POINT, aim=(0, 0, 1), exponent=5), 0.0),
    ],
)
def test_abstract_lights_by_their_formulas(light, expected):
    found, _ = plane_under(light)
    np.testing.assert_allclose(found, np.broadcast_to(expected, 3), rtol=1e-9, atol=1e-12)


def overhead(shape):
    return scenes.Object(
        shape,
        GREY,
        scenes.translate(0.0, 0.0, 2.0) @ scenes.rotate((1, 0, 0), 180.0),
        emission=(3.0, 2.0, 1.0),
    )


def test_surfaces_that_emit_by_their_solid_angles():
    colour = np.array([3.0, 2.0, 1.0])
    # Disc: pi L sin^2 of the half angle (any textbook of radiometry). Sphere: the same.
    disc, error = plane_under(None, emitter=overhead(scenes.Disc(1.0)))
    assert (np.abs(disc - np.pi * colour / 5.0) < 4.0 * error).all()
    ball, error = plane_under(None, emitter=overhead(scenes.Sphere(1.0)))
    assert (np.abs(ball - np.pi * colour / 4.0) < 4.0 * error).all()
    # Rectangle over its middle: four times a corner's, by Lambert's formula for a polygon.
    a = b = 0.5 / 2.0
    corner = (
        a / np.sqrt(1 + a * a) * np.arctan(b / np.sqrt(1 + a * a))
        + b / np.sqrt(1 + b * b) * np.arctan(a / np.sqrt(1 + b * b))
    ) / (2.0 * np.pi)
    flat, error = plane_under(None, emitter=overhead(scenes.Plane(1.0, 1.0)))
    assert (np.abs(flat - np.pi * colour * 4.0 * corner) < 4.0 * error).all()


def test_environments_by_their_integrals():
    height, width = 16, 32
    theta = (np.arange(height) + 0.5) * np.pi / height
    phi = (np.arange(width) + 0.5) * 2.0 * np.pi / width
    # Radiance 1 + x / 2: the cosine-weighted integral over the upper half is pi.
    image = 1.0 + 0.5 * np.sin(theta)[:, None] * np.cos(phi)[None]
    found, error = plane_under(scenes.Environment(image, scale=2.0))
    # Bilinear interpolation of the map lowers its curvature by half a percent.
    assert (np.abs(found - 2.0 * np.pi) < 4.0 * error + 0.01 * np.pi).all()
    lobes = Lobes(np.array([1.0, 2.0]), np.array([[0.0, 0, 1], [1.0, 0, 0]]), np.array([50.0, 3.0]))
    found, error = plane_under(scenes.LobeEnvironment(lobes))
    z, w = np.polynomial.legendre.leggauss(400)
    z, w = 0.5 * (z + 1.0), 0.5 * w
    turn = 2.0 * np.pi * (np.arange(200) + 0.5) / 200
    s = np.sqrt(1.0 - z * z)
    directions = np.stack(
        [s[:, None] * np.cos(turn), s[:, None] * np.sin(turn), z[:, None] + 0 * turn], -1
    )
    values = np.asarray(lobes(jnp.asarray(directions)))
    whole = (w[:, None] * z[:, None] * values).sum() * 2.0 * np.pi / 200
    assert (np.abs(found - whole) < 4.0 * error + 1e-6).all()


@pytest.mark.parametrize("up", ["z", "y"])
def test_map_is_drawn_with_the_density_that_it_states(up):
    rng = np.random.default_rng(0)
    light = scenes.Environment(rng.gamma(0.3, 1.0, (8, 12, 3)), up=up, turn=30.0)
    found = sky.Map(light, Channels(), "float64")
    u = jnp.asarray(rng.random((50000, 2)))
    towards, density = eqx.filter_jit(found.draw)(u)
    np.testing.assert_allclose(found.density(towards), density, rtol=1e-6)
    # Counts in the pixels of another division of the sphere.
    place = np.asarray(towards)
    bins = np.histogram2d(
        np.arctan2(place[:, 1], place[:, 0]), place[:, 2], [6, 5], [[-np.pi, np.pi], [-1, 1]]
    )[0]
    fine = np.stack(
        np.meshgrid(
            (np.arange(600) + 0.5) / 600 * 2 * np.pi - np.pi,
            (np.arange(500) + 0.5) / 250 - 1.0,
            indexing="ij",
        ),
        -1,
    )
    z, turn = fine[..., 1], fine[..., 0]
    s = np.sqrt(1 - z * z)
    grid = np.stack([s * np.cos(turn), s * np.sin(turn), z], -1).reshape(-1, 3)
    shares = np.asarray(eqx.filter_jit(found.density)(jnp.asarray(grid))).reshape(6, 100, 5, 100)
    shares = shares.mean((1, 3)) * 4 * np.pi / 30
    # Within a row the density grows as one over the sine, which the sum feels at the poles.
    assert shares.sum() == pytest.approx(1.0, abs=1e-2)
    chi2 = ((bins - 50000 * shares) ** 2 / (50000 * shares)).sum()
    assert chi2 < 70.0  # 29 degrees of freedom: chance 3e-5


def test_spectral_scene_means_the_same_colours():
    lam = np.arange(0.40, 0.701, 0.01)
    spectral, rgb = Channels(lam), Channels()
    colour = jnp.asarray([[0.8, 0.3, 0.1]])
    found = spectral.rgb(np.asarray(spectral.converted(colour)))
    # The grid ends at 700 nm and has steps of 10 nm.
    np.testing.assert_allclose(found, colour, atol=0.02)
    gold = named("gold").material
    from_spectrum = rgb.converted(jnp.ones((1, 41)), gold.wavelengths)
    np.testing.assert_allclose(from_spectrum, 1.0, atol=1e-6)
    assert spectral.luminance().sum() == pytest.approx(1.0)
    lit, _ = plane_under(scenes.Directional((0, 0, 1), (0.8, 0.3, 0.1)), lam)
    assert lit.shape == (31,)
    np.testing.assert_allclose(spectral.rgb(lit), [0.8, 0.3, 0.1], atol=0.02)


def test_textures_follow_the_surface():
    image = np.arange(12.0).reshape(3, 4) / 12.0
    texture = scenes.Texture(image)
    u, v = np.meshgrid((np.arange(4) + 0.5) / 4, 1.0 - (np.arange(3) + 0.5) / 3)
    uv = jnp.asarray(np.stack([u, v], -1).reshape(-1, 2))
    np.testing.assert_allclose(texture.at(uv, jnp.zeros(12, int)), image.ravel(), atol=1e-6)
    twice = scenes.Texture(image, (2.0, 1.0))
    np.testing.assert_allclose(
        twice.at(uv * jnp.asarray([[0.5, 1.0]]), jnp.zeros(12, int)), image.ravel(), atol=1e-6
    )
    faces = scenes.PerFace(jnp.asarray([0.1, 0.9]))
    np.testing.assert_allclose(faces.at(uv[:2], jnp.asarray([1, 0])), [0.9, 0.1])


def test_similar_scenes_have_equal_geometry():
    one, other = everything(), everything()
    # Meshes are equal only where they are the same object.
    assert one.geometry is not other.geometry
    scene = scenes.Scene(one.objects[:3])
    moved = eqx.tree_at(lambda s: s.objects[0].material.colour, scene, jnp.asarray(0.1))
    assert moved.geometry is scene.geometry


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: scenes.Sphere(-1.0), "radius must be a length above 0; received -1"),
        (lambda: scenes.Box((1, 2)), "size must be three finite numbers"),
        (lambda: scenes.Object("ball", GREY), "shape must be a Sphere"),
        (lambda: scenes.Object(scenes.Sphere(), "gould"), "did you mean gold"),
        (lambda: scenes.Object(scenes.Sphere(), 3), "material must be a material"),
        (
            lambda: scenes.Object(scenes.Sphere(), GREY, scenes.scale(1.0, 2.0, 1.0)),
            "spheres and discs stay round",
        ),
        (lambda: scenes.Object(scenes.Plane(), GREY, np.zeros((4, 4))), "last row of transform"),
        (
            lambda: scenes.Object(scenes.Plane(), GREY, np.diag([1.0, 0, 1, 1])),
            "must not flatten space",
        ),
        (lambda: scenes.Object(scenes.Plane(), GREY, emission=-1.0), "emission must be from 0"),
        (
            lambda: scenes.Camera(eye=(0.0, 0.0, 1.0), target=(0.0, 0.0, 0.0)),
            "up must not point along",
        ),
        (lambda: scenes.Camera(resolution=(0, 3)), "resolution must be columns and rows"),
        (lambda: scenes.Camera(field_of_view=180.0), "field_of_view must be above 0"),
        (lambda: scenes.Point(intensity=-1.0), "intensity must be from 0"),
        (lambda: scenes.Flood(aim=(0, 0, 0)), "aim must be a direction"),
        (lambda: scenes.Falloff(0, 1, 0), "must not both be 0"),
        (lambda: scenes.Environment(np.ones((2, 2, 2, 2))), "radiance must be a number"),
        (lambda: scenes.Environment(1.0, up="x"), "up"),
        (lambda: scenes.Scene([GREY]), r"objects\[0\] must be an Object"),
        (lambda: scenes.Scene([], [GREY]), r"lights\[0\] must be a light"),
        (
            lambda: scenes.Scene([], [scenes.Environment(), scenes.Environment()]),
            "at most one environment",
        ),
        (
            lambda: scenes.Scene(
                [scenes.Object(scenes.Plane(), Lambert(np.full(7, 0.5)), name="x")]
            ),
            "object x: expected 1 or 3 channels; received 7",
        ),
        (lambda: scenes.Scene([], wavelengths=[0.5]), "wavelengths of a scene"),
        (lambda: scenes.Textured(GREY, colour=scenes.Texture([[0.5, 1.5]])), "colour must be from"),
        (lambda: scenes.Textured(GREY, shine=scenes.Texture([[0.5]])), "shine is no parameter"),
        (lambda: scenes.Textured(GREY), "needs a map"),
        (lambda: transforms.facing((0, 0, 0), (0, 0, 0)), "must be a direction"),
    ],
)
def test_refusals(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_coherent_lobes_of_sums_and_scaled_materials():
    wo = jnp.asarray([[0.0, 0.6, 0.8]])
    both = Sum((0.5 * Mirror(), Microfacet(alpha=0.2)))
    (lobe,) = both.coherent(wo)
    np.testing.assert_allclose(lobe.weight, 0.5)
    np.testing.assert_allclose(lobe.wi, [[0.0, -0.6, 0.8]])
    assert both.smooth
    assert not Mirror().smooth
