"""Lights and responses of shadow fields against closed forms, quadrature and rays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shadow_cases as cases
import trimesh

from diffopt import materials, shadows
from diffopt.errors import InputError
from diffopt.kernels import harmonics
from diffopt.scenes.lights import Environment, LobeEnvironment
from diffopt.shadows import ShadowSettings, SphereLight

pytestmark = pytest.mark.float32

UP = np.array([0.0, 0.0, 1.0])
BANDS = 6
SETTINGS = ShadowSettings(bands=BANDS)
AXIS = np.array([0.48, 0.36, 0.8])


def lobe(directions):
    return np.exp(8.0 * (np.asarray(directions) @ AXIS - 1.0))


def above(polar=64):
    z, weight = np.polynomial.legendre.leggauss(polar)
    return harmonics.rule_of(0.5 * (z + 1.0), 0.5 * weight, 2 * polar)


def one(value):
    """The only value of a result."""
    return float(np.asarray(value).reshape(()))


@pytest.mark.parametrize("distance", [1.5, 3.0, 10.0, 100.0])
@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_a_sphere_lights_a_plane(distance, degrees):
    """E = pi L (R / d)^2 cos t; the clamped cosine's bands leave out what odd ones hold."""
    t = np.radians(degrees)
    light = SphereLight(distance * np.array([np.sin(t), 0.0, np.cos(t)]), 0.8, 2.0)
    found = one(shadows.irradiance(np.zeros((1, 3)), UP, [], light, SETTINGS))
    right = np.pi * 2.0 * (0.8 / distance) ** 2 * np.cos(t)
    # The cosine cut to six bands is 0.969 in the middle.
    assert found == pytest.approx(right, rel=0.033)


def test_light_of_a_sphere_falls_with_the_square_of_the_distance():
    found = [
        one(
            shadows.irradiance(
                np.zeros((1, 3)), UP, [], SphereLight([0.0, 0.0, d], 0.5, 1.0), SETTINGS
            )
        )
        for d in (8.0, 16.0, 32.0)
    ]
    # Small spheres: nothing but the solid angle changes.
    np.testing.assert_allclose(found[0] / np.array(found), [1.0, 4.0, 16.0], rtol=0.02)


@pytest.fixture(scope="module")
def glowing():
    """The field of a sphere that emits, of radius 0.8, in three channels."""
    mesh = trimesh.creation.icosphere(3, 0.8)
    # As wide as the true sphere in the mean, not inscribed.
    mesh.apply_scale(1.0 + 0.25 * (1.0 - np.linalg.norm(mesh.triangles_center, axis=1).min() / 0.8))
    radiance = np.tile([1.0, 2.0, 0.5], (len(mesh.faces), 1))
    return shadows.shadow_field(
        mesh.vertices, mesh.faces, ShadowSettings(bands=BANDS, rays=48), emission=radiance
    )


@pytest.mark.parametrize("distance", [1.1, 1.5, 2.0, 4.0])
def test_an_emitting_mesh_is_the_sphere_that_it_stands_for(glowing, distance):
    light = shadows.FieldLight(glowing)
    closed = SphereLight([0.0, 0.0, 0.0], 0.8, [1.0, 2.0, 0.5])
    points = jnp.asarray(distance * cases.towards(16), float)
    normals = -np.asarray(points) / distance
    found, right = (
        np.asarray(shadows.irradiance(points, normals, [], each, SETTINGS))
        for each in (light, closed)
    )
    assert found.shape == (16, 3)
    # No factor beside the solid angle: at four radii it would be 16. Facets have 0.5 %, rows of
    # the table 1.5 % at five radii.
    np.testing.assert_allclose(found, right, rtol=0.03)


def test_colours_of_an_emitting_mesh(glowing):
    found = np.asarray(
        shadows.irradiance(
            np.array([[0.3, -0.2, -3.0]]), UP, [], shadows.FieldLight(glowing), SETTINGS
        )
    )[0]
    np.testing.assert_allclose(found / found[0], [1.0, 2.0, 0.5], rtol=1e-5)


def test_a_texture_is_seen_from_its_side():
    """A sphere whose upper half shines: bright from above, dark from below."""
    mesh = trimesh.creation.icosphere(3, 1.0)
    radiance = (mesh.triangles_center[:, 2] > 0.0).astype(float)
    field = shadows.shadow_field(
        mesh.vertices, mesh.faces, ShadowSettings(bands=BANDS), emission=radiance
    )
    light = shadows.FieldLight(field)
    points = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, -3.0], [3.0, 0.0, 0.0]])
    found = np.asarray(shadows.irradiance(points, -points / 3.0, [], light, SETTINGS))[:, 0]
    whole = np.pi / 9.0
    np.testing.assert_allclose(found / whole, [1.0, 0.0, 0.5], atol=0.05)


@pytest.fixture(scope="module")
def ball():
    """It fills the sphere of its field, as objects should."""
    return shadows.shadow_field(*cases.shape("small"), SETTINGS, centre=np.zeros(3), radius=0.5)


@pytest.mark.parametrize("height", [-1.1, 2.0])
def test_an_occluder_hides_only_what_lies_behind_it(ball, height):
    """A ball of radius 0.5 at the origin, seen from 1.3 below; the light before it or behind."""
    point = np.array([[0.0, 0.0, -1.6]])
    light = SphereLight([0.0, 0.0, height], 0.2 if height < 0.0 else 1.0, 1.0)
    free = one(shadows.irradiance(point, UP, [], light, SETTINGS))
    found = one(shadows.irradiance(point, UP, [ball], light, SETTINGS))
    if height < 0.0:
        assert found == pytest.approx(free, rel=1e-5)
    else:
        # All of it is hidden, but for what six bands blur: the ball is 18 degrees wide.
        assert found < 0.65 * free


def test_shadow_of_a_local_light(ball):
    """Penumbra of a large sphere light: the product of light, cosine and true visibility."""
    light = SphereLight([0.0, 0.0, 2.5], 1.2, 1.0)
    x = np.linspace(0.0, 3.0, 9)
    points = np.stack([x, 0.0 * x, np.full(9, -1.2)], -1)
    found = np.asarray(shadows.irradiance(points, UP, [ball], light, SETTINGS))[:, 0]
    directions, weights = harmonics.sphere_rule(24, 48)
    basis = harmonics.numpy_basis(directions, BANDS)
    visible = 1.0 - cases.hidden([cases.shape("small")], points, BANDS).T @ basis
    shining = np.asarray(light.source(jnp.asarray(points.T, float), BANDS))[:, :, 0].T @ basis
    facing = np.asarray(shadows.responses.cosine(jnp.asarray(UP[:, None], float), BANDS)).T @ basis
    right = (visible * shining * facing) @ weights
    # Of the brightest: rays of the field and of the truth, each 1 % of what is hidden.
    np.testing.assert_allclose(found, right, atol=0.03 * right.max())
    assert right.min() < 0.5 * right.max()


@pytest.mark.parametrize("source", ["number", "function", "environment", "channels"])
def test_distant_light_is_not_cut_to_the_bands(source):
    """Unshadowed irradiance under any light, for any normal, by quadrature."""
    given, at = {
        "number": (1.5, lambda d: np.full((len(d), 1), 1.5)),
        "function": (lobe, lambda d: lobe(d)[:, None]),
        "environment": (Environment(2.0), lambda d: np.full((len(d), 1), 2.0)),
        "channels": (
            lambda d: np.stack([lobe(d), 1.0 + d[:, 0]], -1),
            lambda d: np.stack([lobe(d), 1.0 + d[:, 0]], -1),
        ),
    }[source]
    light = shadows.distant_light(given, BANDS)
    directions, weights = harmonics.sphere_rule(128, 256)
    normals = cases.towards(6, 4)
    points = np.zeros((6, 3))
    right = np.stack(
        [(np.maximum(directions @ n, 0.0) * weights) @ at(directions) for n in normals]
    )
    found = np.asarray(shadows.irradiance(points, normals, [], light, SETTINGS))
    # The clamped cosine of nine bands has 0.4 % of its largest value.
    np.testing.assert_allclose(found, right, atol=0.006 * np.abs(right).max())
    one_normal = np.asarray(shadows.irradiance(points[:1], normals[0], [], light, SETTINGS))
    np.testing.assert_allclose(one_normal[0], right[0], atol=0.003 * np.abs(right).max())


def test_distant_light_of_lobes():
    from diffopt.lobes import Lobes

    lobes = Lobes(
        jnp.asarray([0.7, 1.3], float),
        jnp.asarray([AXIS, UP], float),
        jnp.asarray([6.0, 2.0], float),
    )
    light = shadows.distant_light(LobeEnvironment(lobes), BANDS)
    directions, weights = harmonics.sphere_rule(96, 192)
    value = np.asarray(lobes(jnp.asarray(directions, float)))
    right = (np.maximum(directions[:, 2], 0.0) * weights) @ value.reshape(len(directions), -1)
    found = shadows.irradiance(np.zeros((1, 3)), UP, [], light, SETTINGS)
    np.testing.assert_allclose(np.asarray(found)[0], right, rtol=3e-3)


def test_lights_add_up(ball):
    point = np.array([[0.4, 0.0, -1.4]])
    parts = [shadows.distant_light(lobe, BANDS), SphereLight([0.0, 1.0, 3.0], 0.5, 4.0)]
    single = [one(shadows.irradiance(point, UP, [ball], each, SETTINGS)) for each in parts]
    together = one(shadows.irradiance(point, UP, [ball], parts, SETTINGS))
    assert together == pytest.approx(sum(single), rel=1e-5)


def test_clamping(ball):
    """Between nothing and what comes unshadowed, and no other change."""
    points = shadows.plane(3.0, 12, -1.1)
    light = shadows.distant_light(lobe, BANDS)
    free = float(np.asarray(shadows.irradiance(points, UP, [], light, SETTINGS)).max())
    found, cut = (
        np.asarray(
            shadows.irradiance(points, UP, [ball], light, ShadowSettings(bands=BANDS, clamp=clamp))
        )
        for clamp in (False, True)
    )
    np.testing.assert_allclose(cut, np.clip(found, 0.0, free), rtol=1e-5, atol=1e-6)


@pytest.mark.long
def test_a_projected_matte_material_is_irradiance(ball):
    # As many points as where light is clamped, which has the same program.
    points = shadows.plane(3.0, 12, -1.3)
    light = shadows.distant_light(lobe, BANDS)
    brdf = shadows.project_brdf(materials.Lambert(0.6), 9)
    view = np.array([0.6, 0.0, 0.8])
    found = shadows.reflected(points, UP, view, brdf, [ball], light, SETTINGS)
    right = shadows.irradiance(points, UP, [ball], light, SETTINGS)
    # The cosine of nine bands or more here, of sixteen there.
    np.testing.assert_allclose(found, 0.6 / np.pi * np.asarray(right), atol=2e-3)
    below = shadows.reflected(points, UP, -view, brdf, [ball], light, SETTINGS)
    np.testing.assert_array_equal(below, 0.0)


def glossy(wi, wo):
    """Phong's lobe about the mirrored view, exponent 8, normalised."""
    mirrored = 2.0 * wo[..., 2:] * jnp.zeros_like(wo).at[..., 2].set(1.0) - wo
    cosine = jnp.sum(wi * mirrored, -1)
    return jnp.where((cosine > 0) & (wi[..., 2] > 0), 9.0 / (2 * jnp.pi) * cosine**8, 0.0)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_glossy_lobe_against_quadrature(seed):
    """Any normal and viewer, under a lobe of light."""
    normal, view = cases.towards(2, seed)
    view = view if view @ normal > 0.2 else -view if view @ normal < -0.2 else normal
    brdf = shadows.project_brdf(glossy, 9)
    light = shadows.distant_light(lobe, BANDS)
    found = one(shadows.reflected(np.zeros((1, 3)), normal, view, brdf, [], light, SETTINGS))
    directions, weights = harmonics.sphere_rule(128, 256)
    upright = directions @ normal
    mirrored = 2.0 * (view @ normal) * normal - view
    value = 9.0 / (2 * np.pi) * np.maximum(directions @ mirrored, 0.0) ** 8
    right = float((value * lobe(directions) * np.maximum(upright, 0.0)) @ weights)
    brightest = 9.0 / (2 * np.pi) * float(lobe(directions) @ weights)
    # Nine bands of a lobe 35 degrees wide, tabulated at 33 angles of the viewer.
    assert found == pytest.approx(right, abs=0.004 * brightest)


def test_a_glossy_shadow_against_rays(ball):
    points = np.array([[0.0, 0.0, -1.2], [0.8, 0.3, -1.2], [-1.5, 0.0, -1.2]])
    view = np.array([0.0, 0.6, 0.8])
    brdf = shadows.project_brdf(glossy, 9)
    light = shadows.distant_light(lobe, BANDS)
    found = np.asarray(shadows.reflected(points, UP, view, brdf, [ball], light, SETTINGS))[:, 0]
    directions, weights = above(80)
    caster = shadows.rays.Rays(*cases.shape("small"))
    value = np.asarray(
        glossy(jnp.asarray(directions), jnp.broadcast_to(jnp.asarray(view), directions.shape))
    )
    each = value * lobe(directions) * directions[:, 2] * weights
    right = [
        (~caster.blocked(np.broadcast_to(p, directions.shape), directions)) @ each for p in points
    ]
    # Visibility of six bands against a lobe that has nine.
    np.testing.assert_allclose(found, right, atol=0.02 * each.sum())


def test_slopes_of_lights_are_finite_in_their_middle():
    light = SphereLight([0.0, 0.0, 1.0], 0.3, 1.0)

    def total(points, light):
        return shadows.irradiance(points, jnp.asarray(UP, float), [], light, SETTINGS).sum()

    points = jnp.asarray([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.7]], float)
    slopes = jax.grad(total, (0, 1))(points, light)
    for leaf in jax.tree.leaves(slopes):
        assert np.isfinite(leaf).all()


def test_slope_by_the_place_of_a_light():
    """dE / dz of pi (R / z)^2, straight below."""

    def total(height):
        light = SphereLight(jnp.asarray([0.0, 0.0, 1.0], float) * height, 0.3, 1.0)
        return shadows.irradiance(np.zeros((1, 3)), UP, [], light, SETTINGS).sum()

    found = float(jax.grad(total)(jnp.asarray(3.0, float)))
    assert found == pytest.approx(-2.0 * np.pi * 0.09 / 27.0, rel=0.033)


def test_bad_lights(ball):
    with pytest.raises(InputError, match=r"field must be that of a light: shadow_field"):
        shadows.FieldLight(ball)
    with pytest.raises(InputError, match="radius"):
        SphereLight([0.0, 0.0, 0.0], -1.0, 1.0)
    with pytest.raises(InputError, match=r"centre must be \[3\].*received \(2,\)"):
        SphereLight([0.0, 0.0], 1.0, 1.0)
    with pytest.raises(InputError, match=r"must be \[n\] or \[n, C\]; received \(3,\)"):
        shadows.distant_light(lambda d: np.ones(3), BANDS)
    with pytest.raises(InputError, match="radiance of distant light must be finite"):
        shadows.distant_light(lambda d: np.full(len(d), np.nan), BANDS)
    light = SphereLight([0.0, 0.0, 1.0], 0.3, 1.0)
    brdf = shadows.project_brdf(materials.Lambert(0.6), 4)
    with pytest.raises(InputError, match=r"views must be \[3\] or \(1, 3\); received \(2,\)"):
        shadows.reflected(np.zeros((1, 3)), UP, np.ones(2), brdf, [ball], light, SETTINGS)


def test_a_light_field_of_other_bands(glowing):
    with pytest.raises(InputError, match="light must have 4 bands; received 6"):
        shadows.irradiance(
            np.zeros((1, 3)), UP, [], shadows.FieldLight(glowing), ShadowSettings(bands=4)
        )
