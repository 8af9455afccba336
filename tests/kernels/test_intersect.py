"""Rays against triangles, spheres and discs: every pair in NumPy, Embree, and exact relations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from trimesh.creation import icosphere

from diffopt.kernels import hierarchy, intersect

# Shapes are shared: each costs seconds to compile. 1,280 triangles; rays of the tests of both
# dtypes, and of those of many.
SPHERE = np.asarray(icosphere(subdivisions=3).triangles)
FEW, MANY = 2000, 100_000

first_hit, blocked = jax.jit(intersect.first_hit), jax.jit(intersect.blocked)
spheres, discs = jax.jit(intersect.spheres), jax.jit(intersect.discs)


def soup(rng, count=1280):
    return rng.uniform(-1, 1, (count, 1, 3)) + 0.2 * rng.normal(size=(count, 3, 3))


def bumpy(triangles):
    x, y, z = np.moveaxis(triangles, -1, 0)
    return triangles * (1 + 0.2 * np.sin(7 * x) * np.sin(6 * y + 1) * np.sin(5 * z))[..., None]


def shots(rng, count, dtype):
    """Rays from anywhere in a cube around, to anywhere within."""
    origins = rng.uniform(-2, 2, (count, 3))
    return (a.astype(dtype) for a in (origins, rng.uniform(-1, 1, (count, 3)) - origins))


def every_pair(triangles, origins, directions):
    """Distances of every ray to every triangle in float64, and how far inside it meets."""
    p, d = triangles.astype(float), directions.astype(float)[:, None]
    first, second = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    away = origins.astype(float)[:, None] - p[:, 0]
    across, turned = np.cross(d, second), np.cross(away, first)
    volume = (first * across).sum(-1)
    with np.errstate(all="ignore"):
        t = (second * turned).sum(-1) / volume
        u, v = (away * across).sum(-1) / volume, (d * turned).sum(-1) / volume
    inside = np.minimum(np.minimum(u, v), 1 - u - v)
    return np.where((inside >= 0) & (t > 0), t, np.inf), u, v


def test_same_as_every_pair(rng, dtype):
    triangles = soup(rng).astype(dtype)
    origins, directions = shots(rng, FEW, dtype)
    longest = np.where(np.arange(FEW) % 2 == 0, np.inf, rng.uniform(0, 1.2, FEW)).astype(dtype)
    tree = hierarchy.build(triangles)
    t, triangle, u, v = map(np.asarray, first_hit(tree, origins, directions, longest))
    assert t.dtype == u.dtype == v.dtype == dtype
    assert triangle.dtype == np.int32
    every, us, vs = every_pair(triangles, origins, directions)
    every = np.where(every < longest[:, None], every, np.inf)
    nearest = every.argmin(1)
    expected = every[np.arange(FEW), nearest]
    hit = np.isfinite(expected)
    assert 0.5 < hit.mean() < 0.95
    np.testing.assert_array_equal(triangle, np.where(hit, nearest, -1))
    assert (np.isinf(t) == ~hit).all()
    assert not u[~hit].any()
    assert not v[~hit].any()
    # Faces seen at down to 1e-3 of their size lose that factor.
    atol = 1e4 * np.finfo(dtype).eps
    rows = np.flatnonzero(hit)
    for got, exact in ((t, every), (u, us), (v, vs)):
        np.testing.assert_allclose(got[rows], exact[rows, nearest[rows]], atol=atol)
    np.testing.assert_array_equal(blocked(tree, origins, directions, longest), hit)


@pytest.mark.float32
def test_same_as_embree(rng):
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    triangles = bumpy(SPHERE).astype(np.float32)
    origins, directions = shots(rng, MANY, np.float32)
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, triangles)
    expected = scene.run(origins, directions, output=1)
    t, triangle, u, v = map(np.asarray, first_hit(hierarchy.build(triangles), origins, directions))
    # Rays through an edge may count for either side.
    same = triangle == expected["primID"]
    assert same.mean() > 0.9999
    hit = same & (triangle >= 0)
    assert hit.mean() > 0.3
    np.testing.assert_allclose(t[hit], expected["tfar"][hit], atol=1e-5)
    # Weights of faces seen at down to 1e-4 of their size, in either of the two.
    for got, name in ((u, "u"), (v, "v")):
        error = np.abs(got - expected[name])[hit]
        assert error.max() < 5e-2
        assert np.quantile(error, 0.999) < 1e-4


@pytest.mark.float32
@pytest.mark.parametrize("moved", [0.0, 100.0])
def test_no_ray_slips_through_an_edge(rng, moved):
    """From within a closed surface to corners and to places on edges."""
    triangles = (SPHERE + moved * np.array([1.0, -0.5, 0.3])).astype(np.float32)
    face, corner = rng.integers(0, len(SPHERE), MANY), rng.integers(0, 3, MANY)
    share = rng.choice([0.0, 0.5, 0.25, rng.uniform()], MANY)
    share = np.where(np.arange(MANY) % 2 == 0, share, rng.uniform(size=MANY)).astype(np.float32)
    a, b = triangles[face, corner], triangles[face, (corner + 1) % 3]
    origins = triangles.mean((0, 1)) + rng.uniform(-0.4, 0.4, (MANY, 3))
    origins = origins.astype(np.float32)
    directions = a + share[:, None] * (b - a) - origins
    t, triangle, *_ = first_hit(hierarchy.build(triangles), origins, directions)
    assert int((triangle < 0).sum()) == 0
    # Rounding of corners, over the cosine of at least a half.
    np.testing.assert_allclose(t, 1.0, atol=1e-5 * (1 + moved))


def test_rays_of_all_kinds(dtype):
    """Zeros of both signs, from corners and from faces, and what is no direction."""
    triangles = SPHERE.astype(dtype)
    tree = hierarchy.build(triangles)
    kinds = [(1, 0, 0), (-0.0, 1, 0), (0, -0.0, -1), (0, 1, 1), (1e-30, 0, -1), (-1, 1e-7, 0)]
    directions = np.resize(np.array(kinds, dtype), (FEW, 3))
    origins = np.zeros((FEW, 3), dtype)
    on = triangles.reshape(-1, 3)
    origins[600:1200], origins[1200:1800] = on[:600], triangles.mean(1)[:600]
    directions[1800:1900], directions[1900:1950] = 0.0, np.nan
    origins[1950:] = np.inf
    endless = np.full(FEW, np.inf, dtype)
    t, triangle, u, v = map(np.asarray, first_hit(tree, origins, directions, endless))
    for a in (t, u, v):
        assert not np.isnan(a).any()
    assert (triangle[:600] >= 0).all()
    assert (triangle[1800:] == -1).all()
    length = np.linalg.norm(directions[:600], axis=-1)
    assert (np.abs(t[:600] * length - 1) < 0.01).all()


def test_sizes_of_meshes_and_directions(rng, dtype):
    """Scaled by powers of two everything stays the same to the last bit."""
    triangles = soup(rng).astype(dtype)
    origins, directions = shots(rng, FEW, dtype)
    longest = np.full(FEW, 0.9, dtype)
    t, triangle, u, v = first_hit(hierarchy.build(triangles), origins, directions, longest)
    for size, length in ((2.0**90, 1.0), (2.0**-90, 1.0), (1.0, 2.0**60), (1.0, 2.0**-60)):
        got = first_hit(
            hierarchy.build(triangles * dtype_of(size, dtype)),
            origins * dtype_of(size, dtype),
            directions * dtype_of(length, dtype),
            longest * dtype_of(size / length, dtype),
        )
        np.testing.assert_array_equal(got[1], triangle)
        np.testing.assert_array_equal(got[0], t * dtype_of(size / length, dtype))
        np.testing.assert_array_equal(got[2], u)
        np.testing.assert_array_equal(got[3], v)


def dtype_of(value, dtype):
    return np.asarray(value, dtype)


def test_coincident_triangles(dtype):
    tree = hierarchy.build(np.repeat(SPHERE[:1], len(SPHERE), 0).astype(dtype))
    directions = np.resize(SPHERE[0].mean(0), (FEW, 3)).astype(dtype)
    endless = np.full(FEW, np.inf, dtype)
    t, triangle, *_ = first_hit(tree, np.zeros((FEW, 3), dtype), directions, endless)
    np.testing.assert_allclose(t, 1.0, rtol=20 * np.finfo(dtype).eps)
    assert (np.asarray(triangle) >= 0).all()


@pytest.mark.float32
def test_nothing_and_one():
    rays = np.zeros((3, 3), np.float32), np.array([[0, 0, 1], [1, 0, 0], [0, 0, -1]], np.float32)
    t, triangle, u, v = first_hit(hierarchy.build(np.zeros((0, 3, 3), np.float32)), *rays)
    assert np.isinf(t).all()
    assert (np.asarray(triangle) == -1).all()
    assert not u.any() | v.any()
    one = np.array([[[-1, -1, 2], [3, -1, 2], [-1, 3, 2]]], np.float32)
    t, triangle, u, v = first_hit(hierarchy.build(one), *rays)
    np.testing.assert_array_equal(triangle, [0, -1, -1])
    np.testing.assert_array_equal([t[0], u[0], v[0]], [2.0, 0.25, 0.25])
    none = np.zeros((0, 3), np.float32)
    assert [a.shape for a in first_hit(hierarchy.build(one), none, none)] == [(0,)] * 4


@pytest.mark.float32
def test_types_must_agree():
    tree = hierarchy.build(SPHERE.astype(np.float32))
    with pytest.raises(TypeError, match="different types"):
        first_hit(tree, np.zeros((2, 3), np.float16), np.ones((2, 3), np.float32))


def aimed(rng, count=20, rays=30):
    """A few triangles, and rays to the middles of some and past all."""
    triangles = soup(rng, count)
    middles = triangles.mean(1)[rng.integers(0, count, rays)]
    origins = 3 * rng.normal(size=(rays, 3))
    directions = middles - origins
    directions[::5] *= -1.0
    return tuple(map(jnp.asarray, (triangles, origins, directions)))


def check_slopes(rng, function, arguments):
    """Slopes both ways, in one program, against differences along a random direction.

    The first of the values is the distance, zero for the rays that miss; the first two
    arguments are the rays.
    """

    @jax.jit
    def all_of(arguments, tangents, weights):
        values, forward = jax.linearize(function, *arguments)
        backward = jax.linear_transpose(forward, *tangents)
        only_distance = (weights[0], *(jnp.zeros_like(w) for w in weights[1:]))
        return values, forward(*tangents), backward(weights), backward(only_distance)

    def random(a):
        return jnp.asarray(rng.normal(size=a.shape))

    tangents = tuple(map(random, arguments))
    weights = tuple(map(random, jax.eval_shape(function, *arguments)))
    values, slopes, pulled, rays = all_of(arguments, tangents, weights)
    ends = []
    for step in (1e-7, -1e-7):
        moved = tuple(a + step * t for a, t in zip(arguments, tangents, strict=True))
        ends.append(all_of(moved, tangents, weights)[0])
    for slope, high, low, value in zip(slopes, *ends, values, strict=True):
        # Rounding over the step, and the third derivative, of sizes up to 10.
        np.testing.assert_allclose(slope, (high - low) / 2e-7, rtol=1e-5, atol=1e-5)
        assert np.isfinite(value).all()
    total = sum(float((w * s).sum()) for w, s in zip(weights, slopes, strict=True))
    other = sum(float((p * t).sum()) for p, t in zip(pulled, tangents, strict=True))
    np.testing.assert_allclose(total, other, rtol=1e-9)
    missed = np.asarray(values[0] == 0)
    assert 0 < missed.sum() < len(missed)
    for slope in rays[:2]:
        assert not np.asarray(slope)[missed].any()
        assert np.abs(np.asarray(slope)[~missed]).max(-1).all()


def test_slopes(rng):
    triangles, origins, directions = aimed(rng)
    tree = hierarchy.build(np.asarray(triangles))

    def values(origins, directions, triangles):
        moved = tree._replace(triangles=triangles)
        t, _, u, v = intersect.first_hit(moved, origins, directions)
        return jnp.where(jnp.isfinite(t), t, 0.0), u, v

    check_slopes(rng, values, (origins, directions, triangles))


def test_batches_and_traces(rng):
    triangles, origins, directions = aimed(rng)
    traces = []

    @jax.jit
    def many(tree, origins, directions):
        traces.append(1)
        one = jax.vmap(intersect.first_hit, (None, 0, None))
        return one(tree, origins, directions)

    tree = hierarchy.build(np.asarray(triangles))
    stacked = jnp.stack([origins, origins + 0.1])
    together = many(tree, stacked, directions)
    many(hierarchy.build(np.asarray(triangles) + 0.5), stacked, directions)
    assert len(traces) == 1
    for i in range(2):
        for a, b in zip(first_hit(tree, stacked[i], directions), together, strict=True):
            np.testing.assert_allclose(a, b[i], rtol=1e-12)
    # One tree for each member.
    trees = jax.tree.map(
        lambda *a: jnp.stack(a), tree, hierarchy.build(np.asarray(triangles) + 0.1)
    )
    both = jax.jit(jax.vmap(intersect.blocked, (0, 0, None)))(trees, stacked, directions)
    np.testing.assert_array_equal(both[0], both[1])


def balls(rng, rays=500, count=40):
    centres, radii = rng.uniform(-1, 1, (count, 3)), rng.uniform(0.05, 0.2, count)
    return *shots(rng, rays, float), centres, radii, rng.normal(size=(count, 3))


def test_spheres_and_discs_by_every_pair(rng, dtype):
    origins, directions, centres, radii, normals = (a.astype(dtype) for a in balls(rng))
    o, d, c, r, n = (
        a.astype(np.longdouble) for a in (origins, directions, centres, radii, normals)
    )
    away = o[:, None] - c
    a, b = (d * d).sum(-1)[:, None], (away * d[:, None]).sum(-1)
    inside = b * b - a * ((away * away).sum(-1) - r * r)
    root = np.sqrt(np.maximum(inside, 0))
    roots = np.stack([(-b - root) / a, (-b + root) / a])
    good = (inside > 0) & (roots > 0.1) & (roots < 0.9)
    compare(
        np.where(good, roots, np.inf).min(0),
        *spheres(origins, directions, centres, radii, dtype_of(0.9, dtype), 0.1),
    )
    t = -(away * n).sum(-1) / (d @ n.T)
    off = away + t[..., None] * d[:, None]
    good = ((off**2).sum(-1) <= r * r) & (t > 0.1) & (t < 0.9)
    compare(
        np.where(good, t, np.inf),
        *discs(origins, directions, centres, normals, radii, dtype_of(0.9, dtype), 0.1),
    )


def compare(every, distance, index):
    """A shape is chosen among those at the least distance."""
    nearest = every.min(1)
    hit = np.isfinite(nearest)
    assert 0.05 < hit.mean() < 0.95
    np.testing.assert_array_equal(index, np.where(hit, every.argmin(1), -1))
    # Distances near the rim of a sphere lose the square root of rounding over its height.
    np.testing.assert_allclose(
        distance, nearest.astype(float), rtol=2e3 * np.finfo(distance.dtype).eps
    )


@pytest.mark.float32
def test_a_small_sphere_far_away(rng):
    """Of radius 1 from 1e4 away, in float32: which rays hit, and where, to its rounding."""
    across = rng.uniform(-1.2, 1.2, (500, 2))
    origins = np.column_stack([across, np.full(500, 1e4)]).astype(np.float32)
    directions = np.resize(np.array([0, 0, -2.0], np.float32), (500, 3))
    distance, index = spheres(
        origins, directions, np.zeros((40, 3), np.float32), np.ones(40, np.float32)
    )
    height = 1 - (origins[:, :2].astype(float) ** 2).sum(-1)
    sure = np.abs(height) > 1e-6
    np.testing.assert_array_equal((np.asarray(index) >= 0)[sure], (height > 0)[sure])
    hit = height > 1e-6
    expected = (1e4 - np.sqrt(height[hit])) / 2
    np.testing.assert_allclose(np.asarray(distance)[hit], expected, atol=1e-3)


@pytest.mark.float32
def test_rays_from_a_sphere(rng):
    """Inwards they meet the other side, outwards nothing, if roots of rounding are left out."""
    normals = rng.normal(size=(500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    directions = rng.normal(size=(500, 3))
    cosine = (normals * directions).sum(-1) / np.linalg.norm(directions, axis=1)
    centres, radii = np.zeros((40, 3), np.float32), np.ones(40, np.float32)
    origins, directions = normals.astype(np.float32), directions.astype(np.float32)
    distance, index = map(
        np.asarray, spheres(origins, directions, centres, radii, jnp.float32(jnp.inf), 1e-4)
    )
    clear = np.abs(cosine) > 1e-3
    np.testing.assert_array_equal((index >= 0)[clear], (cosine < 0)[clear])
    inwards = clear & (cosine < 0)
    length = np.linalg.norm(directions, axis=1)
    np.testing.assert_allclose((distance * length)[inwards], -2 * cosine[inwards], atol=1e-5)


def test_slopes_of_spheres_and_discs(rng):
    origins, directions, centres, radii, normals = map(jnp.asarray, balls(rng, 40, 10))
    # Towards the middles, so that a small step leaves no rim; every fifth ray away from all.
    directions = centres[jnp.arange(40) % 10] + 0.01 * directions - origins
    directions = directions.at[::5].multiply(-1.0)
    for meet, *shapes in (
        (intersect.spheres, centres, radii),
        (intersect.discs, centres, normals, 4 * radii),
    ):

        def values(*arguments, meet=meet):
            t, _ = meet(*arguments)
            return (jnp.where(jnp.isfinite(t), t, 0.0),)

        check_slopes(rng, values, (origins, directions, *shapes))
    none = intersect.spheres(origins, directions, centres[:0], radii[:0])
    assert np.isinf(none[0]).all()
    assert (np.asarray(none[1]) == -1).all()
