import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

from diffopt import scenes
from diffopt.errors import InputError
from diffopt.materials import Lambert
from diffopt.rendering import RadiositySettings, formfactors, patches, radiosity, render
from diffopt.rendering.ambient import ambient_radiance, even_light
from diffopt.scenes import raycasting

DOWN = scenes.rotate((1, 0, 0), 180.0)


def factors(scene, wanted, rays, depth=0):
    cut = patches.cut(scene, wanted, depth)
    caster = raycasting.caster(scene.geometry)
    casts = formfactors.cast(cut, scene.geometry.typed("float32"), caster, rays, seed=1)
    return cut, formfactors.form_factors(cut, casts)


def between(cut, found, one, two):
    """Form factor of the front of one object to that of another, and its standard error."""
    here = np.flatnonzero((cut.owner == one) & (cut.side == 0))
    there = np.flatnonzero((cut.owner == two) & (cut.side == 0))
    weight = found.area[here] / found.area[here].sum()
    block = np.ix_(here, there)
    errors = (weight[:, None] * found.error()[block]) ** 2
    return (weight @ found.shares[block]).sum(), np.sqrt(errors.sum())


def room(material, emission=None, size=2.0):
    """Six planes that face inwards."""
    wall = scenes.Plane(size, size)
    turns = [scenes.rotate((1, 0, 0), a) for a in (0.0, 90.0, 180.0, 270.0)]
    turns += [scenes.rotate((0, 1, 0), a) for a in (90.0, 270.0)]
    places = [turn @ scenes.translate(0.0, 0.0, -0.5 * size) for turn in turns]
    return [scenes.Object(wall, material, place, emission=emission) for place in places]


# Squares of side 1: Hottel's and Howell's tables, to six places.
@pytest.mark.parametrize(
    ("place", "exact"),
    [
        (scenes.translate(0.0, 0.0, 1.0) @ DOWN, 0.199825),
        (scenes.translate(0.5, 0.0, 0.5) @ scenes.rotate((0, 1, 0), -90.0), 0.200044),
    ],
)
def test_form_factors_of_squares(place, exact):
    square = scenes.Plane(1.0, 1.0)
    scene = scenes.Scene(
        [scenes.Object(square, Lambert(0.5)), scenes.Object(square, Lambert(0.5), place)]
    )
    cut, found = factors(scene, 64, 1024)
    value, error = between(cut, found, 0, 1)
    assert error < 0.02 * exact
    assert abs(value - exact) < 3 * error
    assert value == pytest.approx(between(cut, found, 1, 0)[0], rel=1e-4)


def test_rows_of_a_closed_room_add_up_to_one_and_are_reciprocal():
    cut, found = factors(scenes.Scene(room(Lambert(0.5))), 96, 128)
    inside = np.flatnonzero(cut.side == 0)
    shares = found.shares[inside]
    np.testing.assert_allclose(shares.sum(1), 1.0, atol=max(2 * found.closure, 1e-5))
    assert found.closure < 2e-3
    product = found.area[:, None] * found.shares
    np.testing.assert_allclose(product, product.T, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(
    "shape", [scenes.Sphere(0.7), scenes.Disc(0.7), scenes.Box((0.5, 1.0, 1.5))]
)
def test_points_of_patches_are_found_again(shape, rng):
    scene = scenes.Scene(
        [scenes.Object(shape, Lambert(0.5), scenes.translate(1.0, 2.0, 3.0) @ DOWN)]
    )
    cut = patches.cut(scene, 40)
    assert cut.area.sum() == pytest.approx(
        scene.geometry.areas.sum() * (2 if isinstance(shape, scenes.Disc) else 1)
    )
    which = np.repeat(np.arange(cut.count), 8)
    position, normal, *_ = cut.sample(which, rng.random((len(which), 2)))
    caster = raycasting.caster(scene.geometry)
    hits = caster.first(position + 0.01 * normal, -normal)
    typed = scene.geometry.typed("float32")
    arrays = hits.primitive, hits.u, hits.v, position + 0.01 * normal, -normal, hits.distance
    moved = [np.asarray(a, np.int32 if k == 0 else np.float32) for k, a in enumerate(arrays)]
    sheet, s, t, _ = formfactors.in_blocks(
        lambda *a: formfactors.arrive(cut.sheets.charts, typed, *a), *moved
    )
    # At the very edge rounding may say the neighbour.
    assert (cut.table[cut.cell(sheet, s, t)] == which).mean() > 0.99


def test_quarters_cover_their_patch():
    scene = scenes.Scene(
        [scenes.Object(scenes.Box(), Lambert(0.5)), scenes.Object(scenes.Disc(), Lambert(0.5))]
    )
    cut = patches.cut(scene, 30, 2)
    split, before = cut.split(np.array([0, 3]))
    assert split.count == cut.count + 6
    assert (before < 0).sum() == 8
    assert split.area.sum() == pytest.approx(cut.area.sum())
    assert (np.bincount(split.table, minlength=split.count) > 0).all()
    again, _ = split.split(np.arange(split.count))
    assert again.count == 4 * split.count
    assert again.area.sum() == pytest.approx(cut.area.sum())


def test_meshes_are_joined_to_patches():
    steps = np.linspace(0, 1, 33)
    x, y = (a.ravel() for a in np.meshgrid(steps, steps))
    at = (np.arange(32)[:, None] * 33 + np.arange(32)).ravel()
    faces = np.concatenate(
        [np.stack([at, at + 1, at + 34], 1), np.stack([at, at + 34, at + 33], 1)]
    )
    mesh = scenes.build_mesh(np.stack([x, y, 0.1 * np.sin(6 * x)], 1), faces)
    scene = scenes.Scene([scenes.Object(mesh, Lambert(0.5))])
    cut = patches.cut(scene, 100)
    assert 60 < cut.count < 250
    assert cut.area.sum() == pytest.approx(2 * scene.geometry.areas.sum())


def test_white_furnace(dtype):
    emission, rho = 0.5, 0.6
    scene = scenes.Scene(room(Lambert(rho), emission))
    settings = RadiositySettings(patches=200, rays_per_patch=128, refinements=0)
    found = radiosity.solve(scene, settings, dtype=dtype)
    assert found.radiosity.dtype == dtype
    inside = np.flatnonzero(found.transport.patches.side == 0)
    value = np.asarray(found.radiosity)[inside]
    exact = emission * np.pi / (1 - rho)
    assert value.mean() == pytest.approx(exact, rel=2e-3)
    np.testing.assert_allclose(value, exact, rtol=0.03)
    assert np.asarray(found.energy.error).max() < 1e-3


def test_even_sky_on_a_convex_body():
    scene = scenes.Scene(
        [scenes.Object(scenes.Sphere(), Lambert((0.2, 0.5, 0.8)))], [scenes.Environment(0.7)]
    )
    found = radiosity.solve(scene, RadiositySettings(patches=50, refinements=0))
    exact = np.array([0.2, 0.5, 0.8]) * np.pi * 0.7
    np.testing.assert_allclose(found.radiosity, np.tile(exact, (len(found.albedo), 1)), rtol=1e-3)


def test_insides_of_bodies_around_lights_count():
    body = scenes.Object(scenes.Box((2.0, 2.0, 2.0)), Lambert(0.5))
    settings = RadiositySettings(patches=48, rays_per_patch=64, refinements=0)
    dark = radiosity.prepare(scenes.Scene([body]), settings)
    assert (dark.patches.side == 0).all()
    lit = radiosity.solve(scenes.Scene([body], [scenes.Point(intensity=1.0)]), settings)
    inside = lit.transport.patches.side == 1
    # All of 4 pi, and in the end twice as much as lands at first.
    power = np.asarray(lit.transport.area)[:, None] * np.asarray(lit.irradiance)
    np.testing.assert_allclose(power[inside].sum(0), 8 * np.pi, rtol=0.02)
    np.testing.assert_allclose(power[~inside], 0.0)


# A room like Cornell's, open to the front.
WHITE, RED, GREEN = (Lambert(c) for c in ((0.7, 0.7, 0.7), (0.6, 0.1, 0.1), (0.1, 0.5, 0.1)))


def cornell(ball=WHITE, radiance=10.0, colour=None):
    wall = scenes.Plane(2.0, 2.0)
    return scenes.Scene(
        [
            scenes.Object(wall, WHITE if colour is None else Lambert(colour), name="floor"),
            scenes.Object(wall, WHITE, scenes.translate(0.0, 0.0, 2.0) @ DOWN, name="ceiling"),
            scenes.Object(
                wall,
                WHITE,
                scenes.translate(0.0, 1.0, 1.0) @ scenes.rotate((1, 0, 0), 90.0),
                name="back",
            ),
            scenes.Object(
                wall,
                RED,
                scenes.translate(-1.0, 0.0, 1.0) @ scenes.rotate((0, 1, 0), 90.0),
                name="left",
            ),
            scenes.Object(
                wall,
                GREEN,
                scenes.translate(1.0, 0.0, 1.0) @ scenes.rotate((0, 1, 0), -90.0),
                name="right",
            ),
            scenes.Object(scenes.Sphere(0.4), ball, scenes.translate(0.2, 0.0, 0.5), name="ball"),
            scenes.area_light(0.6, 0.6, scenes.translate(0.0, 0.0, 1.9) @ DOWN, radiance=radiance),
        ],
        [scenes.Point((0.5, -0.5, 1.0), 0.3)],
    )


SETTINGS = RadiositySettings(patches=300, rays_per_patch=256, refinements=0)


@pytest.fixture(scope="module")
def transport():
    return radiosity.prepare(cornell(), SETTINGS)


def test_power_is_kept(transport):
    energy = radiosity.solve(cornell(), transport=transport).energy
    assert np.asarray(energy.error).max() < 1e-3
    assert (np.asarray(energy.escaped) > 0).all()
    # The light that leaves the front of the lamp.
    np.testing.assert_allclose(energy.emitted, np.pi * 0.36 * 10.0, rtol=1e-4)


def test_derivatives(transport):
    def total(numbers):
        scene = cornell(radiance=numbers[0], colour=jnp.stack([numbers[1]] * 3))
        scene = eqx.tree_at(lambda s: s.lights[0].intensity, scene, numbers[2])
        found = radiosity.solve(scene, transport=transport, dtype="float64")
        return (found.radiosity * transport.area.astype(float)[:, None]).sum()

    at = jnp.asarray([10.0, 0.7, 0.3], "float64")
    slope = jax.grad(total)(at)
    for k in range(3):
        step = 1e-4 * jnp.zeros(3).at[k].set(1.0)
        by_steps = (total(at + step) - total(at - step)) / 2e-4
        assert slope[k] == pytest.approx(float(by_steps), rel=1e-5)


def blocks(values, size):
    high, wide, count = values.shape
    parts = values.reshape(high // size, size, wide // size, size, count)
    return parts.mean((1, 3))


@pytest.fixture(scope="module")
def reference():
    camera = scenes.Camera(
        eye=(0.0, -3.9, 1.0), target=(0.0, 0.0, 1.0), resolution=(24, 24), field_of_view=39.0
    )
    return camera, render(cornell(), camera, "path", spp=256)


@pytest.mark.parametrize("gather", but({"patches"}, ["direct", "patches"]))
def test_agrees_with_path_tracing(reference, gather):
    camera, exact = reference
    finer = {"patches": 600, "light_samples": 48, "refinements": int(gather == "patches")}
    image = render(cornell(), camera, "radiosity", spp=64, gather=gather, **finer)
    found, wanted = blocks(image.radiance, 8), blocks(exact.radiance, 8)
    error = np.sqrt(blocks(exact.error**2, 8) / 64)
    # Shadows as coarse as the patches cost more. Fewer samples would miss the edge of the lamp.
    share = 0.02 if gather == "direct" else 0.05
    assert (np.abs(found - wanted) < share * wanted + 3 * error).all()
    # The reference's noise is the same in all channels, nearly.
    spread = np.sqrt((exact.error.mean(-1) ** 2).sum()) / exact.done.size
    off = abs(image.radiance.mean() - exact.radiance.mean())
    assert off < 0.01 * exact.radiance.mean() + 2 * spread


@pytest.mark.long
def test_mirrors_are_followed_by_rays(reference):
    camera, _ = reference
    scene = cornell("mirror")
    plain = render(scene, camera, "radiosity", patches=200, spp=1)
    coherent = render(scene, camera, "radiosity+rays", patches=200, spp=1)
    ball = plain.object == 5
    assert plain.radiance[ball].max() == 0.0
    assert coherent.radiance[ball].mean() > 0.1
    np.testing.assert_allclose(coherent.radiance[~ball], plain.radiance[~ball], rtol=1e-4)


@pytest.mark.long
def test_refinement_lowers_the_error():
    floor = scenes.Object(scenes.Plane(2.0, 2.0), Lambert(0.5))
    scene = scenes.Scene([floor], [scenes.Point((0.2, 0.1, 0.3), 1.0)])
    rest = {"patches": 32, "rays_per_patch": 32}
    errors, counts = [], []
    for refinements in (0, 1, 2):
        settings = RadiositySettings(refinements=refinements, **rest)
        found = radiosity.solve(scene, settings)
        cut = found.transport.patches
        u = np.random.default_rng(0).random((64 * cut.count, 2))
        which = np.repeat(np.arange(cut.count), 64)
        position, *_ = cut.sample(which, u)
        offset = np.array([0.2, 0.1, 0.3]) - position
        exact = 0.3 / (offset**2).sum(1) ** 1.5 * (cut.side[which] == 0)
        error = np.asarray(found.irradiance)[which, 0] - exact
        errors.append(np.sqrt((cut.area[which] * error**2).sum() / cut.area[which].sum()))
        counts.append(cut.count)
    assert counts[0] < counts[1] < counts[2]
    assert errors[1] < 0.8 * errors[0]
    assert errors[2] < 0.8 * errors[1]


def test_derived_ambient_light():
    # Even light everywhere: the estimate is exact.
    rho, emission = 0.5, 1.0
    scene = scenes.Scene(room(Lambert(rho), emission))
    even = ambient_radiance(scene, RadiositySettings())
    np.testing.assert_allclose(even, rho * emission / (1 - rho), rtol=0.01)
    first, mean = jnp.full(3, np.pi), jnp.full(3, 0.5)
    np.testing.assert_allclose(even_light(first, mean, 1.0), 2.0, rtol=1e-6)


@pytest.mark.long
def test_derived_ambient_light_is_nearer_to_the_whole(reference):
    camera, exact = reference
    plain, derived = (
        render(cornell(), camera, "recursive", ambient=a, light_samples=32).radiance.mean()
        for a in (None, "derived")
    )
    whole = exact.radiance.mean()
    assert abs(derived - whole) < 0.5 * abs(plain - whole)


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("patches", 0),
        ("patches", 10**6),
        ("rays_per_patch", 0),
        ("refinements", -1),
        ("tolerance", 0.0),
        ("tolerance", float("nan")),
        ("light_samples", 0),
        ("gather", "all"),
        ("depth", -1),
    ],
)
def test_bad_settings_are_refused(option, value):
    with pytest.raises(InputError, match=option):
        RadiositySettings(**{option: value})


def test_bad_scenes_are_refused():
    with pytest.raises(InputError, match="no objects"):
        radiosity.solve(scenes.Scene([]))

    def total(radiance):
        return radiosity.solve(cornell(radiance=radiance), SETTINGS).radiosity.sum()

    with pytest.raises(InputError, match="prepare"):
        jax.grad(total)(10.0)
    assert dataclasses.replace(SETTINGS, seed=3).level == "radiosity"
