"""Plans: what is in and why; what is out leaves nothing; the real difference is bounded."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
import pytest
from lengths import but

import diffopt as do
from diffopt import planning, scenes
from diffopt.errors import InputError
from diffopt.materials import Dielectric, Lambert, Microfacet, Mirror, Sum
from diffopt.materials.combined import matte_part
from diffopt.planning import checking, pilot, reductions
from diffopt.rendering import composed, driver, effects, ledgers, pathtrace
from diffopt.rendering.composed import Composed
from diffopt.rendering.direct import Direct
from diffopt.rendering.effects import BITS, LAYERS, PATHS, Composition
from diffopt.rendering.settings import PathSettings, RecursiveSettings
from diffopt.rendering.stage import Stage
from diffopt.scenes import Object, Scene, raycasting

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
INTERREFLECTION = frozenset({"diffuse-interreflection", "glossy-interreflection", "caustics"})
PLASTIC = Sum((Lambert((0.5, 0.2, 0.1)), Microfacet(0.3)), chances=(0.6, 0.4))


def room(ball=None, lights=(), floor=None):
    """A floor, a wall, a ball between them, a lamp."""
    objects = [
        Object(scenes.Plane(6.0, 6.0), Lambert((0.6, 0.6, 0.5)) if floor is None else floor),
        Object(
            scenes.Plane(6.0, 4.0),
            Lambert((0.7, 0.2, 0.1)),
            scenes.facing((0.0, 2.5, 1.5), (0.0, 0.0, 1.5)),
        ),
        Object(
            scenes.Sphere(0.8),
            PLASTIC if ball is None else ball,
            scenes.translate(0.0, 0.5, 0.8),
        ),
        scenes.area_light(
            1.0, 1.0, scenes.facing((-1.5, -1.0, 4.0), (0.0, 0.0, 0.5)), radiance=9.0
        ),
    ]
    return Scene(objects, lights)


@pytest.fixture(scope="module")
def camera():
    return scenes.Camera((0.0, -6.0, 2.2), (0.0, 0.5, 0.9), resolution=(24, 18), field_of_view=40.0)


@pytest.fixture(scope="module")
def full():
    """Everything at once: glass, mirror, plastic, ambient, points, a lamp, an even sky."""
    scene = room(lights=[do.scenes.Point((2.0, -2.0, 3.0), 6.0), scenes.Ambient(0.05)])
    more = [
        Object(scenes.Sphere(0.4), Dielectric(1.5), scenes.translate(-1.3, -0.6, 0.4)),
        Object(scenes.Sphere(0.4), Mirror(), scenes.translate(1.3, -0.6, 0.4)),
    ]
    return Scene([*scene.objects, *more], [*scene.lights, scenes.Environment(0.1)])


def picture(scene, camera, level, spp=16, seed=0):
    settings = PathSettings(spp=spp, seed=seed)
    return driver.picture(scene, camera, settings, level, even=False)


def test_codes_of_paths():
    """Direct light, interreflection of both kinds, what is seen in a mirror, caustics."""

    def code(*kinds):
        found = np.zeros(1, np.int64)
        for kind in kinds:
            found = effects.after(found, np.array([kind]))
        return {name for name, bit in BITS.items() if found[0] & bit}

    matte, glossy, mirror, glass = range(4)
    assert code(matte) == {"matte-light"}
    assert code(mirror, glossy) == {"mirror", "glossy-light"}
    assert code(matte, matte, matte) == {"matte-light", "diffuse-interreflection"}
    assert code(matte, matte, glossy) == {"matte-light", "glossy-interreflection"}
    assert code(matte, glossy, matte) == {"matte-light", "glossy-interreflection"}
    assert code(glossy, matte) == {"glossy-light", "glossy-interreflection"}
    assert code(glass, glass, matte) == {"refraction", "matte-light"}
    assert code(matte, glass) == {"matte-light", "caustics"}
    counts = effects.after(np.zeros(1, np.int64), np.array([mirror]))
    counts = effects.after(effects.after(counts, np.array([matte])), np.array([matte]))
    assert (effects.coherent(counts), effects.scattered(counts)) == (1, 2)


def test_everything_is_path_tracing(full, camera):
    """All effects together are the path tracer's picture, from the same random numbers.

    The plastic's parts are told apart by chance there: it is left out, so that they are equal.
    """
    objects = [o for o in full.objects if not isinstance(o.material, Sum)]
    scene = Scene(objects, full.lights)
    every = picture(scene, camera, Composed(Composition()))
    right = picture(scene, camera, pathtrace.Paths(PathSettings(depth=64)))
    # Sums in float32 in another order.
    np.testing.assert_allclose(every.radiance, right.radiance, rtol=1e-5, atol=1e-6)


@pytest.mark.long
def test_parts_told_apart_keep_the_mean(camera):
    """A material's matte and glossy parts by chance: the mean of the picture stays.

    The difference of two independent means over 432 pixels, against their standard errors.
    """
    scene = room()
    one = picture(scene, camera, Composed(Composition()), spp=64)
    other = picture(scene, camera, pathtrace.Paths(PathSettings(depth=64)), spp=64, seed=1)
    difference = (one.radiance - other.radiance).mean((0, 1))
    error = np.sqrt((one.error**2 + other.error**2).sum((0, 1))) / one.error[..., 0].size
    assert (np.abs(difference) < 4.0 * error).all()


def test_layers_add_up_to_the_picture(full, camera):
    image = do.render(full, camera, "path", spp=16, depth=8, layers=True)
    total = sum(image.layers.values())
    scale = image.radiance.max()
    # Light that is hidden is added and taken away again, in float32.
    np.testing.assert_allclose(total, image.radiance, atol=2e-5 * scale)
    assert set(image.layers) <= set(LAYERS)
    wanted = {"matte-light", "glossy-light", "mirror", "refraction", "diffuse-interreflection"}
    assert wanted | {"glossy-interreflection", "ambient", "surroundings"} <= set(image.layers)
    for name, part in image.layers.items():
        assert (part <= 0.0).all() if "shadows" in name else (part >= -1e-6).all()
    plain = do.render(full, camera, "path", spp=16, depth=8)
    assert np.abs(plain.radiance.mean() - image.radiance.mean()) < 0.1 * plain.radiance.mean()


def test_a_layer_is_what_is_missing_without_its_effect(full, camera):
    """The notes of paths against pictures without the effect, from the same random numbers."""
    scene = Scene([o for o in full.objects if not isinstance(o.material, Sum)], full.lights)
    every = picture(scene, camera, Composed(Composition()))
    notes = pilot.fly(scene, camera, Composition(), pixels=24 * 18, paths=16)
    for name in ("mirror", "refraction", "diffuse-interreflection", "caustics", "emission"):
        without = picture(scene, camera, Composed(Composition(excluded=frozenset({name}))))
        missing = float(((every.radiance - without.radiance) @ LUMINANCE).mean())
        share = notes.share(notes.lost([name]))[0]
        # Paths end at random at other places where others are left out; float32 sums.
        np.testing.assert_allclose(
            missing / (every.radiance @ LUMINANCE).mean(), share, rtol=2e-2, atol=1e-5
        )


@pytest.mark.long
def test_hidden_light_is_what_shadows_take_away(camera):
    """Direct light without shadows less that with them, by even samples, against the notes."""
    light = scenes.Directional((0.3, -0.5, 1.0), 2.0)
    scene = Scene(room(Lambert(0.5)).objects[:3], [light])
    direct = INTERREFLECTION | {"self-shadows"}
    settings = RecursiveSettings(spp=64)

    def even(*hard):
        what = Composition(excluded=direct, hard=frozenset(hard), soft=frozenset())
        level = Direct(settings, None, what)
        found = driver.picture(scene, camera, settings, level, even=True)
        return (found.radiance @ LUMINANCE).mean()

    lit, bare = even(0, 1, 2), even()
    notes = pilot.fly(scene, camera, Composition(excluded=INTERREFLECTION), paths=64)
    hidden = notes.share(notes.lost(["hard-shadows", "self-shadows"]))[0]
    # The noise of 64 paths in each of 2000 pixels is some per cent of the hidden light.
    np.testing.assert_allclose((bare - lit) / lit, hidden, rtol=0.05)
    # The ball's shadow falls on the floor alone: elsewhere nothing need be asked.
    assert even(0) == pytest.approx(lit, rel=1e-6)
    assert even(1, 2) == pytest.approx(bare, rel=1e-6)
    assert bare > 1.01 * lit


def test_matte_parts():
    """Of sums and scaled materials; itself where all is matte."""
    grey = Lambert(0.5)
    assert matte_part(grey) is grey
    assert matte_part(Microfacet(0.2)) is None
    both = 0.5 * Sum((grey, Microfacet(0.2)))
    found = matte_part(both)
    wi, wo = np.array([0.3, 0.0, 0.954]), np.array([-0.5, 0.2, 0.843])
    np.testing.assert_allclose(found.f(wi, wo), 0.5 * 0.5 / np.pi, rtol=1e-5)
    assert matte_part(Sum((grey, Lambert(0.1)))).parts[0] is grey


def bounce_of(scene):
    """What a bounce at the first object is traced to."""
    stage = Stage(scene)
    count = 64
    one = np.zeros((count, 3), np.float32)
    rays = driver.shading.camera_rays(
        one, np.float32([0.0, 0.0, -1.0]) + one, stage.channels, stage.dtype
    )
    zeros = np.zeros(count, np.float32)
    hits = raycasting.Hits(np.zeros(count, np.int32), zeros + 1.0, zeros, zeros)
    arrays = (stage.world, stage.sources, stage.member, jax.random.key(0), rays, hits)
    number = np.asarray(0, np.uint32), np.asarray(False)

    def one_bounce(group, *rest):
        return pathtrace._bounce(group, *rest, *number, stage.offset, None, True)

    lowered = eqx.filter_jit(one_bounce).lower(stage.groups[0], *arrays)
    text = str(eqx.filter_make_jaxpr(one_bounce)(stage.groups[0], *arrays)[0])
    cost = lowered.compile().compiled.cost_analysis()
    return text, cost["flops"]


def test_what_is_out_leaves_no_operation():
    """The program without an effect is that of a scene that never had it."""
    lights = [scenes.Point((2.0, -2.0, 3.0), 6.0)]

    def one(material):
        return Scene([Object(scenes.Sphere(1.0), material)], lights)

    glossy = one(Sum((Lambert((0.5, 0.2, 0.1)), Microfacet(0.3))))
    matte = one(Lambert((0.5, 0.2, 0.1)))
    out = frozenset({"glossy-light", "glossy-interreflection"})
    whole, most = bounce_of(glossy)
    left, few = bounce_of(reductions.reduced(glossy, out))
    never, right = bounce_of(matte)
    assert left == never
    assert few == right < 0.7 * most
    assert left != whole
    coated = one(Sum((Mirror(), Lambert(0.5))))
    out = frozenset({"mirror", "refraction", "caustics"})
    assert bounce_of(reductions.reduced(coated, out))[0] == bounce_of(one(Lambert(0.5)))[0]
    # Light that is not there: neither drawn nor scattered.
    ambient = Scene(matte.objects, [*lights, scenes.Ambient(0.1)])
    reduced = reductions.reduced(ambient, frozenset({"ambient"}))
    assert bounce_of(reduced)[0] == never
    assert bounce_of(ambient)[0] != never


def test_tables_of_what_is_out_are_gone():
    """Neither the heights nor the table of a diffracting surface, nor an environment's map."""
    heights = np.random.default_rng(0).normal(size=(64, 64)) * 0.05
    scan = do.Heightfield(heights.astype(np.float32), 0.1)
    material = do.materials.Diffraction(do.DiffractionBRDF(scan, 0.5), [0.45, 0.55, 0.65])
    sky = scenes.Environment(np.random.default_rng(0).random((32, 64, 3)).astype(np.float32))
    scene = Scene([Object(scenes.Sphere(1.0), material)], [sky])

    def size(scene):
        leaves = jax.tree.leaves((Stage(scene).groups, Stage(scene).sources))
        return sum(leaf.size for leaf in leaves if eqx.is_array(leaf))

    assert size(scene) > 64 * 64 + 32 * 64 * 3
    left = reductions.reduced(scene, frozenset({"environment-map"}))
    assert size(left) < size(scene) - 32 * 64 * 3
    assert reductions.has(scene, "diffraction")
    flat = reductions.reduced(scene, frozenset({"diffraction"}))
    assert not reductions.has(flat, "diffraction")
    assert size(flat) < size(scene) - 64 * 64 + 16


def test_no_rays_for_what_is_out(full, camera):
    """Rays by what they are cast for; and those that the caster is asked for."""
    key = jax.random.key(0)
    stage = Stage(full)
    counted = []

    class Counting(raycasting.Caster):
        def first(self, origins, directions):
            counted.append(len(origins))
            return super().first(origins, directions)

        def blocked(self, origins, directions, lengths):
            counted.append(len(origins))
            return super().blocked(origins, directions, lengths)

    caster = Counting(full.geometry)

    def rays(**what):
        counted.clear()
        settings = PathSettings(spp=4)
        pixels = np.arange(24 * 18)
        primary = driver.primary(camera, stage, key, pixels, len(pixels), 0, 4, settings, False)
        ledger = ledgers.Whole(len(primary.alive), stage.channels, stage.dtype)
        walk = composed.Walk(Composition(**what), ledger)
        walk.trace(stage, primary, composed.Queries(caster), key)
        assert sum(walk.rays.values()) == sum(counted)
        return walk.rays

    every = rays()
    for name in ("mirror", "refraction", "caustics", "hard-shadows", "soft-shadows"):
        assert every[name] > 0, name
    for name in ("mirror", "refraction", "caustics"):
        assert rays(excluded=frozenset({name}))[name] == 0
    none = frozenset()
    assert rays(hard=none)["hard-shadows"] == 0
    assert rays(soft=none)["soft-shadows"] == 0
    direct = rays(excluded=INTERREFLECTION)
    assert direct["interreflection"] == direct["caustics"] == 0
    assert sum(direct.values()) < sum(every.values())


def test_values_do_not_recompile(camera):
    """Another light, another colour, another roughness: the same programs."""
    plan = do.plan(room(), camera, 0.1)
    # Enough rays to fill a block, as those of the plan do.
    plan = dataclasses.replace(plan, settings=PathSettings(spp=8))
    do.render(room(), camera, plan)
    before = pathtrace._scatter.count, composed._emitted.count, pathtrace._missed.count
    other = Sum((Lambert((0.1, 0.2, 0.7)), Microfacet(0.1)), chances=(0.5, 0.5))
    changed = room(other)
    dimmer = 0.5 * changed.objects[3].emission
    changed = eqx.tree_at(lambda s: s.objects[3].emission, changed, dimmer)
    do.render(changed, camera, plan)
    after = pathtrace._scatter.count, composed._emitted.count, pathtrace._missed.count
    assert before == after


def test_plans_are_values(camera):
    """Equal requests are equal plans, hashable; they are told in words and numbers."""
    one, two = (do.plan(room(), camera, 0.05) for _ in range(2))
    assert one == two
    assert hash(one) == hash(two)
    assert [row.effect for row in one.rows] == list(planning.EFFECTS)
    text = str(one)
    assert all(name in text for name in planning.EFFECTS)
    assert one.row("refraction").because == "no smooth glass"
    assert one.row("diffuse-interreflection").included
    assert 0.0 < sum(row.share for row in one.rows) <= 1.0 + 1e-9
    assert one.summary()["effects"][0]["effect"] == planning.EFFECTS[0]


@pytest.mark.long
def test_less_tolerance_leaves_less_out(full, camera):
    plans = [do.plan(full, camera, t) for t in (0.3, 0.05, 0.005)]
    sizes = [len(plan.excluded) for plan in plans]
    assert sizes[0] > sizes[1] >= sizes[2]
    for plan in plans:
        assert plan.bias <= 0.6 * plan.tolerance


def test_choices_are_kept(full, camera):
    plan = do.plan(full, camera, 0.2, include=["caustics"], exclude="soft-shadows")
    assert plan.row("caustics").included
    assert not plan.row("soft-shadows").included
    assert plan.row("caustics").because.startswith("as asked")
    assert plan.composition.soft == frozenset()


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"tolerance": 0.0}, "tolerance must be above 0 and at most 1; received 0"),
        ({"tolerance": float("nan")}, "received nan"),
        ({"include": ["fog"]}, "include must be of spectrum, .*; received 'fog'"),
        ({"include": ["mirror"], "exclude": ["mirror"]}, "both name mirror"),
        ({"exclude": ["matte-light"]}, "nothing would be lit"),
        (
            {"include": ["glossy-interreflection"], "exclude": ["glossy-light"]},
            "glossy-interreflection, which needs glossy-light",
        ),
        ({"include": ["refraction"]}, "refraction cannot be in: the scene has none"),
        ({"include": ["spectrum"]}, "spectrum cannot be in: the scene has none"),
    ],
)
def test_bad_requests(camera, arguments, text):
    with pytest.raises(InputError, match=text):
        do.plan(room(), camera, **arguments)


def test_bad_compositions():
    with pytest.raises(InputError, match="received fog"):
        Composition(excluded=frozenset({"fog"}))
    with pytest.raises(InputError, match="nothing would be lit"):
        Composition(excluded=frozenset({"matte-light"}))


def test_layers_need_paths(camera):
    with pytest.raises(InputError, match="layers are kept by paths; received the level recursive"):
        do.render(room(), camera, "recursive", layers=True)


@pytest.mark.parametrize("tolerance", [pytest.param(0.1, marks=pytest.mark.long), 0.03])
def test_planned_pictures_are_within_the_tolerance(camera, tolerance, long):
    """Against path tracing of everything with another seed, its own noise taken out.

    The mean magnitude of the reference's noise adds at most its own to the difference.
    """
    scene = room()
    plan = do.plan(scene, camera, tolerance)
    image = do.render(scene, camera, plan)
    right = do.render(scene, camera, "path", spp=1024 if long else 256, seed=7)
    off = np.abs((image.radiance - right.radiance) @ LUMINANCE).mean()
    off /= (right.radiance @ LUMINANCE).mean()
    assert off <= max(tolerance, plan.bias + plan.noise) + right.noise


@pytest.mark.parametrize("tolerance", but({0.02}, [0.1, 0.02]))
def test_check_finds_what_the_plan_said(full, camera, tolerance):
    plan = do.plan(full, camera, tolerance)
    found = checking.check(full, camera, plan, pixels=600, paths=64)
    assert found.passed
    assert {row.effect for row in found.rows} <= set(planning.EFFECTS)
    for row in found.rows:
        if row.bound is not None:
            # Both are estimates; the bound holds three standard errors of its own.
            assert row.measured - 4.0 * row.error <= 1.1 * row.bound + 1e-3
    assert "Left out together" in str(found)
    # A plan that leaves out too much does not pass.
    wrong = dataclasses.replace(
        plan,
        rows=tuple(dataclasses.replace(r, included=r.effect == "matte-light") for r in plan.rows),
    )
    assert not checking.check(full, camera, wrong, pixels=300, paths=16).passed


def test_reduced_scenes_share_their_geometry(full):
    out = frozenset({"glossy-light", "mirror", "refraction", "caustics", "ambient"})
    left = reductions.reduced(full, out)
    assert left.geometry is full.geometry
    assert not any(group.delta for group in Stage(left).groups)
    assert reductions.reduced(full, frozenset(PATHS) - out - {"glossy-light"}) is full


def test_three_bands_of_a_spectral_scene(camera):
    """Grey things lit by grey light: three bands are enough; the lights keep their colour."""
    grey = Scene(
        [Object(scenes.Plane(6.0, 6.0), Lambert(0.5))],
        [scenes.Directional((0.2, -0.3, 1.0), 2.0)],
        wavelengths=np.linspace(0.4, 0.7, 7),
    )
    plan = do.plan(grey, camera, 0.05)
    assert not plan.row("spectrum").included
    assert plan.scene(grey).channels.count == 3
    spectral = do.plan(grey, camera, 0.05, include=["spectrum"])
    assert spectral.scene(grey) is grey or spectral.scene(grey).channels.count == 7
