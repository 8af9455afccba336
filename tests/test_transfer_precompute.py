"""Precomputed transfer of whole scenes, and pictures under light: against path tracing."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from transfer_cases import LAMBERT, ceiling, grid, lifted, unit

import diffopt as do
from diffopt.scenes import Environment, LobeEnvironment
from diffopt.scenes.channels import Channels
from diffopt.scenes.shapes import Box, Plane
from diffopt.scenes.transforms import facing, translate
from diffopt.transfer import between, relighting, tessellation
from diffopt.transfer.lighting import prepare
from diffopt.transfer.precomputation import precompute
from diffopt.transfer.raster import Raster
from diffopt.transfer.settings import TransferSettings

RGB = Channels()
QUICK = TransferSettings(rays=256, finest=2, splits=2, tolerance=0.1, depth=2)
GLOSSY = LAMBERT(0.5) + do.BlinnPhong(0.4, 20.0)
CAMERA = do.Camera((2.5, -3.5, 2.5), (0.0, 0.0, 0.3), resolution=(24, 24), field_of_view=45.0)


def on_a_floor():
    box = do.Object(Box((0.8, 0.8, 0.8)), GLOSSY, lifted(0.4), name="box")
    return [do.Object(grid(4.0, 6), GLOSSY, name="floor"), box]


@pytest.fixture(scope="module")
def transfer():
    return precompute(do.Scene(on_a_floor()), QUICK)


@pytest.fixture(scope="module")
def held(transfer):
    return relighting.tables(transfer)


@pytest.fixture(scope="module")
def raster(transfer):
    return Raster(transfer.mesh.vertices, transfer.triangles)


@pytest.fixture(scope="module")
def seen(raster):
    return raster(CAMERA, 2)


def sky(height=32):
    """1 + 0.6 z + 0.3 x as a map."""
    theta = (np.arange(height)[:, None] + 0.5) * np.pi / height
    phi = (np.arange(2 * height) + 0.5) * np.pi / height
    return 1.0 + 0.6 * np.cos(theta) + 0.3 * np.sin(theta) * np.cos(phi)


def soft(colour=(1.0, 1.0, 1.0)):
    """Broad lobes."""
    mu = unit(np.array([[0.4, -0.5, 0.7], [-0.6, 0.2, 0.5], [0.0, 0.0, 1.0]]))
    alpha = np.array([2.0, 3.0, 6.0])[:, None] * np.asarray(colour)[None]
    return LobeEnvironment(do.Lobes(alpha, mu, np.array([3.0, 2.0, 0.5])))


def arrays(transfer):
    parts = [*transfer.views, *transfer.diffuse, transfer.level, transfer.first, transfer.error]
    return [*parts, transfer.mesh.vertices, transfer.mesh.faces, transfer.unoccluded]


@pytest.mark.long
def test_the_same_again_with_other_threads(transfer):
    again = precompute(do.Scene(on_a_floor()), QUICK, threads=3)
    for a, b in zip(arrays(transfer), arrays(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert [r.vertices for r in transfer.rounds] == [r.vertices for r in again.rounds]


def test_everything_is_finite_and_in_range(transfer):
    assert all(np.isfinite(a).all() for a in arrays(transfer))
    assert transfer.channels == 1  # grey
    np.testing.assert_allclose(np.linalg.norm(transfer.views.mu, axis=-1), 1.0, rtol=1e-4)
    # No more light is seen directly than there is.
    assert transfer.views.alpha[:, 0].max() < 1.0 + 1e-4
    assert transfer.views.alpha.min() >= 0.0
    counts = np.array([10, 31, 109])[transfer.level]
    assert transfer.level.min() >= 1
    np.testing.assert_array_equal(
        np.sort(transfer.first), np.sort(transfer.first)[0] + np.sort(transfer.first)
    )
    assert counts.sum() == len(transfer.views.kappa)
    np.testing.assert_allclose(
        np.einsum("vij,vkj->vik", transfer.axes, transfer.axes),
        np.tile(np.eye(3), (len(transfer.axes), 1, 1)),
        atol=1e-12,
    )
    # Levels end where the next one is predicted.
    stopped = transfer.level < QUICK.finest
    assert (transfer.error[stopped] <= QUICK.tolerance).all()
    assert transfer.rounds[-1].faces == len(tessellation.leaves(transfer.mesh))
    assert transfer.slices == len(transfer.views.kappa) + len(transfer.level)


def test_the_floor_is_split_next_to_what_stands_on_it(transfer):
    mesh = transfer.mesh
    leaves = tessellation.leaves(mesh)
    middle = mesh.vertices[mesh.faces[leaves]].mean(1)
    floor = np.abs(middle[:, 2]) < 1e-6
    floor &= (np.abs(mesh.normals[mesh.faces[leaves]][..., 2]) > 0.9).all(-1)
    away = np.abs(middle[:, :2]).max(-1) - 0.4
    level = mesh.level[leaves]
    near = floor & (away > -0.3) & (away < 0.25)
    assert level[near].mean() > 1.5
    assert level[floor & (away > 1.2)].max() == 0
    assert level.max() == QUICK.splits
    # Nothing of the box's top is hidden.
    top = middle[:, 2] > 0.79
    assert level[top].max() <= 1


@pytest.mark.long
def test_uniform_and_adaptive_agree(transfer, held, seen):
    """All triangles split twice: four times the vertices, the same picture."""
    whole = precompute(do.Scene(on_a_floor()), QUICK, uniform=2)
    assert len(whole.level) > 2.0 * len(transfer.level)
    assert len(whole.rounds) == 1
    light = prepare([soft()], RGB, "lobes")
    found = Raster(whole.mesh.vertices, whole.triangles)(CAMERA, 2)
    a = np.asarray(between.picture(held, light, seen))
    b = np.asarray(between.picture(relighting.tables(whole), light, found))
    lit = b[..., 0] > 0.0
    # The tolerance, in the square mean, is more than is lost by what was not split.
    assert np.sqrt(((a - b)[lit] ** 2).mean()) < QUICK.tolerance * b[lit].mean()
    assert abs((a - b)[lit].mean()) < 0.02 * b[lit].mean()


@pytest.mark.parametrize("name", ["even", "linear"])
def test_pictures_agree_with_path_tracing(name, held, seen):
    """Two surfaces deep, with all interreflection between box and floor."""
    # Maps both, which the same programs render.
    light = Environment(np.ones((32, 64)) if name == "even" else sky())
    settings = do.rendering.PathSettings(spp=128, depth=2)
    truth = do.render(do.Scene(on_a_floor(), [light]), CAMERA, "path", settings=settings)
    got = np.asarray(between.picture(held, prepare([light], RGB), seen))
    inside = truth.object >= 0
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):  # pixels of one object alone
        inside &= np.roll(truth.object, shift, (0, 1)) == truth.object
    mean = truth.radiance[inside].mean()
    error, noise = (got - truth.radiance)[inside], truth.error[inside]
    # What is between vertices of a floor of cells of 1/6, next to the box: a few per cent of
    # the mean in the middle of all pixels, mostly bright, as light leaks under the box.
    assert abs(error.mean()) < 0.025 * mean
    assert np.sqrt((error**2).mean()) < 0.06 * mean + 2.0 * np.sqrt((noise**2).mean())
    assert np.median(np.abs(error)) < 0.02 * mean + np.median(noise)


@pytest.mark.long
def test_a_turned_sky_is_a_sky_of_turned_lobes(held, seen):
    angle = 0.8
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    tilt = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
    light = soft()
    for rotation in (turn, tilt @ turn):
        lobes = do.Lobes(
            light.lobes.alpha, np.asarray(light.lobes.mu) @ rotation.T, light.lobes.kappa
        )
        expected = between.picture(held, prepare([LobeEnvironment(lobes)], RGB, "lobes"), seen)
        for method in ("lobes", "harmonics"):
            turned = prepare([light], RGB, method).turned(jnp.asarray(rotation, jnp.float32))
            got = between.picture(held, turned, seen)
            # Rounding; the sky's harmonics of degree 16 and more are below that.
            np.testing.assert_allclose(got, expected, atol=2e-5 * float(expected.max()))


@pytest.mark.long
def test_three_methods_on_a_smooth_sky(held, seen):
    exact = np.asarray(between.picture(held, prepare([soft()], RGB, "lobes"), seen))
    for method, most in (("pyramid", 0.015), ("harmonics", 1e-3)):
        got = np.asarray(between.picture(held, prepare([soft()], RGB, method), seen))
        # As documented for each of them.
        assert np.abs(got - exact).max() < most * exact.max()


class Counted(eqx.Module):
    """Light that counts how often its function is traced."""

    light: object
    count: object = eqx.field(static=True)

    def radiance(self, mu, kappa):
        self.count[0] += 1
        return self.light.radiance(mu, kappa)


class Count(list):
    __hash__ = object.__hash__
    __eq__ = object.__eq__


def test_programs_serve_all_lights_and_cameras(held, raster):
    count = Count([0])
    sizes = []
    for k, eye in enumerate([(2.5, -3.5, 2.5), (2.4, -3.6, 2.6), (2.7, -3.3, 2.4)]):
        light = prepare([soft((1.0 + k, 1.0, 0.5))], RGB, "lobes").scaled(1.0 + k)
        camera = dataclasses.replace(CAMERA, eye=eye)
        found = raster(camera, 1)
        got = between.picture(held, Counted(light, count), found)
        assert np.isfinite(np.asarray(got)).all()
        sizes.append((len(found.vertices), len(found.covered)))
        if not k:
            first = count[0]
    assert len(set(sizes)) == 1
    assert count[0] == first > 0


@pytest.mark.long
def test_slopes_in_the_pixels_of_the_sky(held, seen, rng):
    """The picture is linear in them."""
    base, along = sky(8), rng.normal(size=(8, 16))

    def mean(pixels):
        light = prepare([Environment(pixels)], RGB)
        return between.picture(held, light, seen).mean()

    both = jax.jit(jax.value_and_grad(mean))
    gradient = np.asarray(both(jnp.asarray(base, jnp.float32))[1], float)
    assert np.isfinite(gradient).all()
    slope = (gradient * along).sum()
    ends = [float(both(jnp.asarray(base + s * 0.3 * along, jnp.float32))[0]) for s in (1, -1)]
    # Means of 10^3 numbers in float32, over a difference of a hundredth of them.
    assert abs(slope - (ends[0] - ends[1]) / 0.6) < 1e-3 * np.abs(gradient * along).sum()
    # More light makes nothing darker.
    assert gradient.min() > -1e-7


def test_slopes_in_the_weights_of_lobes(held, seen, rng):
    """Of views and of the view-independent share, one after the other."""
    light = prepare([soft()], RGB, "lobes")
    tables = held.views, held.diffuse

    @jax.jit
    @jax.value_and_grad
    def both(tables):
        changed = eqx.tree_at(lambda h: (h.views, h.diffuse), held, tables)
        return between.picture(changed, light, seen).mean()

    _, gradients = both(tables)
    for which, (table, gradient) in enumerate(zip(tables, gradients, strict=True)):
        assert np.isfinite(np.asarray(gradient)).all()
        columns = (np.arange(table.shape[1]) % 5) == 4  # axis, logarithm of kappa, weight
        along = jnp.asarray(rng.normal(size=table.shape) * columns * np.asarray(table), "float32")
        slope = float((gradient * along).sum())
        ends = []
        for s in (1.0, -1.0):
            moved = table + s * 0.05 * along
            ends.append(float(both((moved, tables[1]) if which == 0 else (tables[0], moved))[0]))
        # Axes go by the weights: third derivatives of 1 / 20 of them, and float32.
        size = float(jnp.abs(gradient * along).sum())
        assert abs(slope - (ends[0] - ends[1]) / 0.1) < 5e-3 * size + 1e-5
        assert size > 0.0


def test_vertices_and_pixels_on_a_fine_mesh(held, seen):
    """Broad light changes little between vertices: lobes or radiance may be interpolated."""
    light = prepare([soft()], RGB, "lobes")
    pixels, vertices = (
        np.asarray(between.picture(held, light, seen, per_pixel=p)) for p in (True, False)
    )
    assert np.abs(pixels - vertices).max() < 0.03 * pixels.max()
    lobes = relighting.vertex_lobes(held, *_towards(held, CAMERA.eye))
    assert all(np.isfinite(np.asarray(a)).all() for a in lobes)


def _towards(held, eye):
    away = np.asarray(eye) - np.asarray(held.position)
    return jnp.arange(len(away)), jnp.asarray(unit(away), jnp.float32)


def test_radiance_of_vertices_is_the_sum_over_their_lobes(held):
    """Under even light, of what their weights say."""
    light = prepare([Environment(2.0)], RGB)
    vertices, wo = _towards(held, CAMERA.eye)
    total = relighting.vertex_radiance(held, light, vertices, wo)
    glossy = relighting.vertex_lobes(held, vertices, wo).alpha.sum((1, 2))
    matte = np.asarray(held.diffuse).reshape(len(wo), -1, 5)[..., 4].sum(1)
    expected = 2.0 * (np.asarray(glossy) + matte[:, None])
    np.testing.assert_allclose(total, np.broadcast_to(expected, total.shape), rtol=1e-5)


def test_coloured_light_on_a_grey_scene(held, seen):
    colour = np.array([0.2, 1.0, 3.0])
    got = np.asarray(between.picture(held, prepare([Environment(colour)], RGB), seen))
    grey = np.asarray(between.picture(held, prepare([Environment(1.0)], RGB), seen))
    assert got.shape == (24, 24, 3)
    np.testing.assert_allclose(got, grey[..., :1] * colour, rtol=1e-5, atol=1e-6)
    assert got.max() > 0.5


def test_backgrounds(held, raster):
    """Samples beside all surfaces, one by one."""
    found = raster(CAMERA, 2)
    light = prepare([Environment(1.0)], RGB)
    dark = np.asarray(between.picture(held, light, found))
    bright = np.asarray(between.picture(held, light, found, background=5.0))
    covered = np.zeros(24 * 24 * 4)
    covered[np.unique(found.covered[found.covered < len(covered)])] = 1.0
    free = 1.0 - covered.reshape(-1, 4).mean(1).reshape(24, 24, 1)
    np.testing.assert_allclose(bright - dark, np.broadcast_to(5.0 * free, dark.shape), atol=1e-4)


def test_a_red_wall_on_a_white_floor():
    """Glossy and diffuse light of the wall is red; the floor far from it is white."""
    wall = facing((0.0, 1.0, 0.5), (0.0, 0.0, 0.5), (0.0, 0.0, 1.0))
    objects = [
        do.Object(grid(2.0, 3), LAMBERT(0.4) + do.BlinnPhong(0.5, 60.0), name="floor"),
        do.Object(Plane(2.0, 1.0), LAMBERT((0.9, 0.05, 0.05)), wall, name="wall"),
    ]
    settings = dataclasses.replace(QUICK, splits=0, finest=1)
    found = precompute(do.Scene(objects), settings)
    assert found.channels == 3
    held = relighting.tables(found)
    floor = np.flatnonzero((found.axes[:, 2, 2] > 0.9) & (found.mesh.vertices[:, 1] > 0.3))
    floor = floor[found.mesh.vertices[floor, 1] < 0.9]
    wo = np.tile(unit(np.array([0.0, -1.0, 0.6])), (len(floor), 1))
    light = prepare([Environment(1.0)], RGB)
    value = np.asarray(
        relighting.vertex_radiance(held, light, jnp.asarray(floor), jnp.asarray(wo, jnp.float32))
    )
    assert (value[:, 0] > 1.1 * value[:, 1]).all()
    np.testing.assert_allclose(value[:, 1], value[:, 2], rtol=1e-4)
    # Its glossy lobes of light from the wall leave the wall towards the floor's front.
    lobes = relighting.vertex_lobes(held, jnp.asarray(floor), jnp.asarray(wo, jnp.float32))
    diffuse = np.asarray(lobes.alpha)[:, 1, 0]
    assert (diffuse[:, 0] > 10.0 * diffuse[:, 1]).all()
    assert (np.asarray(lobes.mu)[:, 1, 0, 1] < 0.0).all()
    # The wall itself is matte: it has no views.
    assert (found.level[found.axes[:, 2, 2] < 0.5] == -1).all()


def test_depth_adds_light():
    """Between two white planes each surface more that light may meet adds to it."""
    objects = [
        do.Object(grid(2.0, 2), LAMBERT(0.8), name="floor"),
        do.Object(Plane(2.0, 2.0), LAMBERT(0.8), ceiling(1.0, 1.0), name="ceiling"),
    ]
    light = prepare([Environment(1.0)], RGB)
    before = 0.0
    for depth in (1, 2, 4):
        settings = dataclasses.replace(QUICK, depth=depth, splits=0)
        held = relighting.tables(precompute(do.Scene(objects), settings))
        value = float(relighting.vertex_radiance(held, light, *_towards(held, (0, 0, 5.0)))[4, 0])
        assert value > before + 0.01
        before = value
    # All light at a white place is 1; the floor's middle reflects 0.8 of what arrives.
    assert before < 0.8


@pytest.mark.long
def test_translate_moves_nothing_but_places():
    """The same scene elsewhere: the same slices, but for the rounding of places."""
    here, there = (
        precompute(
            do.Scene(
                [
                    do.Object(grid(2.0, 1), GLOSSY, translate(*shift)),
                    do.Object(Box((0.5, 0.5, 0.5)), GLOSSY, translate(*(shift + 0.6))),
                ]
            ),
            dataclasses.replace(QUICK, splits=0, finest=1, depth=1),
        )
        for shift in (np.zeros(3), np.array([3.0, -7.0, 2.0]))
    )
    np.testing.assert_array_equal(here.level, there.level)
    apart = np.abs(here.diffuse.alpha - there.diffuse.alpha)
    # A ray or two of 256 that passes an edge.
    assert apart.max() < 2.0 / 256
