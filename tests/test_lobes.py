"""Sums of lobes as objects: values, integrals, samples, files; BRDFs of lobes over views."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import BRDFLobes, InputError, Lobes
from diffopt.brdf_lobes import icosahedral_views
from diffopt.kernels import quadrature

EPS = {"float32": 2.0**-23, "float64": 2.0**-52}
AXES = np.array([[0.48, -0.36, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.6, -0.8]])
KAPPA = np.array([12.0, 0.0, 3.0])
ALPHA = np.array([0.7, 0.4, 1.5])
COLOURED = np.array([[0.7, 0.1, 0.0], [0.4, 0.4, 0.2], [1.5, 0.0, 0.3]])


def lobes(dtype="float64", alpha=ALPHA):
    return Lobes(*(jnp.asarray(x, dtype) for x in (alpha, AXES, KAPPA)))


def summed(s, alpha, mu, kappa):
    """In plain NumPy, [..., *C]."""
    total = 0.0
    for a, m, k in zip(alpha, mu, kappa, strict=True):
        peak = k / (2 * np.pi * -np.expm1(-2 * k)) if k else 1 / (4 * np.pi)
        density = peak * np.exp(k * (s @ m - 1))
        total = total + density.reshape(*density.shape, *(1,) * np.ndim(a)) * a
    return total


@pytest.fixture(scope="module")
def sphere():
    s, solid = jax.jit(lambda: quadrature.polar_grid(jnp.asarray([0.0, 0.0, 1.0]), 48, 64))()
    return s, np.asarray(solid, np.float64)


@pytest.mark.parametrize("alpha", [ALPHA, COLOURED], ids=["scalar", "colours"])
def test_values(alpha, dtype, rng):
    s = rng.normal(size=(5, 4, 3))
    s /= np.linalg.norm(s, axis=-1, keepdims=True)
    f = lobes(dtype, alpha)
    value = f(s)
    assert value.dtype == dtype
    assert value.shape == (5, 4, *f.channels)
    assert (f.count, f.channels) == (3, alpha.shape[1:])
    # kappa t of up to 24, rounded.
    np.testing.assert_allclose(value, summed(s, alpha, AXES, KAPPA), rtol=64 * EPS[dtype])
    np.testing.assert_allclose(f.integral(), alpha.sum(0), rtol=4 * EPS[dtype])
    np.testing.assert_allclose(f.scaled(2.0)(s), 2 * value, rtol=4 * EPS[dtype])


def test_batches(dtype, rng):
    """A batch of two functions, at directions of their own: member by member."""
    s = rng.normal(size=(2, 4, 3))
    s /= np.linalg.norm(s, axis=-1, keepdims=True)
    turned = AXES[::-1]
    members = [(COLOURED, AXES, KAPPA), (2 * COLOURED, turned, KAPPA + 1)]
    batch = Lobes(*(jnp.asarray(np.stack(x), dtype) for x in zip(*members, strict=True)))
    value = batch(s)
    assert value.shape == (2, 4, 3)
    for i in range(2):
        expected = summed(s[i], *members[i])
        np.testing.assert_allclose(value[i], expected, rtol=64 * EPS[dtype])
        np.testing.assert_allclose(batch[i](s[i]), expected, rtol=64 * EPS[dtype])
    expected = np.stack([COLOURED.sum(0), 2 * COLOURED.sum(0)])
    np.testing.assert_allclose(batch.integral(), expected, rtol=4 * EPS[dtype])
    np.testing.assert_allclose(batch.scaled([1.0, 3.0])(s)[1], 3 * value[1], rtol=4 * EPS[dtype])
    assert batch.sample(jax.random.key(0), 5).shape == (2, 5, 3)
    assert str(batch) == "(2,) sums of 3 lobes"
    with pytest.raises(InputError, match=r"directions must be \[\*\(2,\), \.\.\., 3\]"):
        batch(s[0])
    with pytest.raises(InputError, match="not a batch"):
        lobes()[0]
    with pytest.raises(InputError, match=r"without a batch.*jax\.vmap"):
        batch.inner(batch)


def test_integrals_by_quadrature(sphere):
    s, solid = sphere
    f, g = lobes(alpha=COLOURED), lobes().scaled(0.5)
    g = Lobes(g.alpha, g.mu[::-1], g.kappa + 2.0)
    product = np.asarray(f(s))[..., None] * np.asarray(g(s))[:, None, None]
    expected = (product[..., 0] * solid[:, None]).sum(0)
    np.testing.assert_allclose(f.inner(g), expected, rtol=1e-10)
    np.testing.assert_allclose(g.inner(f), expected, rtol=1e-10)
    total = (np.asarray(f(s)) * solid[:, None]).sum(0)
    np.testing.assert_allclose(total, f.integral(), rtol=1e-12)
    assert f.inner(f).shape == (3, 3)


def test_samples_follow_their_density(sphere):
    """First and second moments of 40000 samples within five standard errors of the density's."""
    f = lobes(alpha=np.array([[0.7, 0.3], [-2.0, 0.2], [0.5, 1.5]]))  # means 0.5, -0.9, 1
    s, solid = sphere
    density = np.asarray(f.pdf(s)) * solid
    assert density.sum() == pytest.approx(1, abs=1e-12)
    drawn = np.asarray(f.sample(jax.random.key(5), 40_000), np.float64)
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1, atol=1e-14)

    def moments(v):
        x, y, z = np.asarray(v).T
        return np.stack([x, y, z, x * x, y * y, x * y, x * z, y * z, (z > 0) + 0.0])

    expected = (moments(s) * density).sum(1)
    spread = np.sqrt((moments(s) ** 2 * density).sum(1) - expected**2)
    error = moments(drawn).mean(1) - expected
    # The half sphere is counted by nodes, 1 / 48 of the density off at most.
    error[-1] = max(abs(error[-1]) - 5e-3, 0)
    assert (np.abs(error) < 5 * spread / np.sqrt(len(drawn))).all()


def test_through_jax(dtype):
    """One program for all lobes; slopes in every parameter; a batch by vmap."""
    s = np.array([[0.0, 0.6, 0.8], [0.48, -0.36, 0.8]])
    f = lobes(dtype)
    compiled = eqx.filter_jit(lambda f: f(jnp.asarray(s, dtype)))
    np.testing.assert_allclose(compiled(f), f(s), rtol=16 * EPS[dtype])
    slope = eqx.filter_jit(eqx.filter_grad(lambda f: f(jnp.asarray(s, dtype)).sum()))(f)
    value = np.asarray(f(s)).sum()
    # Euler: the sum is linear in alpha.
    assert float((slope.alpha * f.alpha).sum()) == pytest.approx(value, rel=32 * EPS[dtype])
    # The derivative in kappa at 0 of exp(kappa (cos - mean)) / 4 pi.
    expected = ALPHA[1] / (4 * np.pi) * (s @ AXES[1]).sum()
    assert float(slope.kappa[1]) == pytest.approx(expected, rel=64 * EPS[dtype])
    assert bool(jnp.isfinite(slope.mu).all())
    two = jax.tree.map(lambda x: jnp.stack([x, x]), f)
    mapped = jax.vmap(lambda f: f(jnp.asarray(s, dtype)))(two)
    np.testing.assert_allclose(mapped[1], f(s), rtol=16 * EPS[dtype])


@pytest.mark.parametrize("suffix", [".npz", ".json"])
def test_files_come_back(suffix, tmp_path):
    path = tmp_path / f"lobes{suffix}"
    batch = Lobes(*(jnp.asarray(np.stack([x, x])) for x in (COLOURED, AXES, KAPPA)))
    for f in (lobes(), lobes(alpha=COLOURED), batch):
        f.save(path)
        found = Lobes.load(path)
        for name in ("alpha", "mu", "kappa"):
            np.testing.assert_array_equal(getattr(found, name), getattr(f, name))
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def json_of(**changes):
    fields = {"alpha": ALPHA.tolist(), "mu": AXES.tolist(), "kappa": KAPPA.tolist()} | changes
    return json.dumps({"lobes": {k: v for k, v in fields.items() if v is not None}}).encode()


BAD_FILES = {
    "empty": ("a.npz", b""),
    "empty text": ("a.json", b""),
    "truncated": ("a.json", json_of()[:80]),
    "no archive": ("a.npz", b"PK\x03\x04 not an archive"),
    "other text": ("a.json", b'{"meshes": []}'),
    "a list": ("a.json", b"[1, 2]"),
    "a number": ("a.json", b'{"lobes": 3}'),
    "binary text": ("a.json", b"\xff\xfe\x00\x80"),
    "missing field": ("a.json", json_of(kappa=None)),
    "ragged": ("a.json", json_of(mu=[[0, 0, 1], [0, 1]])),
    "letters": ("a.json", json_of(alpha=["a", "b", "c"])),
    "shapes": ("a.json", json_of(kappa=[1.0])),
    "negative": ("a.json", json_of(kappa=[1.0, -2.0, 3.0])),
    "NaN": ("a.json", json_of(alpha=[1.0, float("nan"), 3.0])),
    "no unit vectors": ("a.json", json_of(mu=(2 * AXES).tolist())),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_are_named(case, tmp_path):
    name, content = BAD_FILES[case]
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=name):
        Lobes.load(tmp_path / name)


def test_foreign_and_damaged_archives(tmp_path):
    path = tmp_path / "b.npz"
    np.savez(path, heights=np.ones((2, 2)))
    with pytest.raises(InputError, match=r"b\.npz: expected lobes \(alpha, mu, kappa\)"):
        Lobes.load(path)
    np.savez(path, alpha=np.array([{}], object), mu=AXES, kappa=KAPPA)
    with pytest.raises(InputError, match=r"b\.npz"):
        Lobes.load(path)
    np.savez(path, alpha=ALPHA * 1j, mu=AXES, kappa=KAPPA)
    with pytest.raises(InputError, match=r"b\.npz: alpha must be real numbers; found complex128"):
        Lobes.load(path)
    np.save(tmp_path / "c.npy", ALPHA)
    (tmp_path / "c.npy").rename(path)
    with pytest.raises(InputError, match=r"b\.npz"):
        Lobes.load(path)
    lobes().save(path)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match=r"b\.npz"):
        Lobes.load(path)
    damaged = bytearray(content)
    damaged[content.index(ALPHA.tobytes()) + 4] ^= 0xFF
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=r"b\.npz"):
        Lobes.load(path)
    with pytest.raises(InputError, match="no such file"):
        Lobes.load(tmp_path / "gone.npz")
    with pytest.raises(InputError, match=r"d\.txt: lobes are written to \.npz or \.json"):
        lobes().save(tmp_path / "d.txt")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mu": 2 * AXES}, "mu must be unit vectors; received one of length 2"),
        ({"mu": AXES * np.nan}, "mu must be unit vectors"),
        ({"mu": AXES[:2]}, r"alpha, mu and kappa must be .*received \(3,\), \(2, 3\) and \(3,\)"),
        ({"mu": AXES[:, :2]}, "alpha, mu and kappa must be"),
        ({"alpha": ALPHA[:2]}, "alpha, mu and kappa must be"),
        ({"kappa": 3.0}, "alpha, mu and kappa must be"),
        ({"alpha": ALPHA * np.inf}, "alpha must be finite; received inf"),
        ({"kappa": KAPPA * np.nan}, "kappa must be finite; received nan"),
        ({"kappa": -KAPPA}, "kappa must be >= 0; received -12"),
    ],
)
def test_refusals(changes, message):
    given = {"alpha": ALPHA, "mu": AXES, "kappa": KAPPA} | changes
    with pytest.raises(InputError, match=message):
        Lobes(**given)


def test_directions_are_checked():
    for s in (np.ones(3), np.ones((4, 2)), np.full(3, np.nan)):
        for call in (lobes(), lobes().pdf):
            with pytest.raises(InputError, match="directions must be unit vectors"):
                call(s)


def test_printed():
    text = str(lobes())
    assert text.splitlines()[1].split() == ["0.7", "12", "36.87", "-36.87"]


@pytest.mark.parametrize(("level", "count"), [(0, 8), (1, 25), (2, 89), (3, 337)])
def test_views(level, count):
    views, faces = icosahedral_views(level)
    assert len(views) == count
    np.testing.assert_allclose(np.linalg.norm(views, axis=1), 1, atol=1e-15)
    assert views[:, 2].min() >= np.sin(0.02) * (1 - 1e-12)
    assert set(faces.ravel()) == set(range(count))
    # One sheet without holes: vertices - edges + faces of a disc; each edge in one face or two.
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), 1)
    edges, times = np.unique(edges, axis=0, return_counts=True)
    assert count - len(edges) + len(faces) == 1
    assert set(times) == {1, 2}
    for bad in (-1, 7):
        with pytest.raises(InputError, match=f"level must be 0 to 6; received {bad}"):
            icosahedral_views(bad)


@pytest.fixture(scope="module")
def brdf():
    """Two lobes at each view, that vary smoothly."""
    views, faces = icosahedral_views(1)
    mirror = views * [-1, -1, 1]
    mu = np.stack([mirror, np.broadcast_to([0.0, 0.0, 1.0], mirror.shape)], 1)
    z = views[:, 2]
    kappa = np.stack([5 + 40 * (1 - z), 1 + z], 1)
    alpha = np.stack([0.5 + 0.3 * views[:, :1] + 0 * mirror, 0.2 * views[:, 2:] + 0 * mirror], 1)
    return BRDFLobes(views, faces, Lobes(*(jnp.asarray(x) for x in (alpha, mu, kappa))))


def test_interpolation(brdf, rng):
    views, faces = np.asarray(brdf.views), np.asarray(brdf.faces)
    at = brdf.at(views)
    # Shares of a view in its own triangle are 1, 0, 0 but for rounding of an inverse; kappa by a
    # logarithm.
    for name, scale in (("alpha", 1), ("mu", 1), ("kappa", 50)):
        found, expected = getattr(at, name), getattr(brdf.lobes, name)
        np.testing.assert_allclose(found, expected, atol=1e-13 * scale, err_msg=name)
    # Across the edges of triangles: points 1e-7 apart on both sides of inner edges.
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs, times = np.unique(np.sort(edges, 1), axis=0, return_counts=True)
    a, b = views[pairs[times == 2]].transpose(1, 0, 2)
    middle = 0.7 * a + 0.3 * b
    side = np.cross(a, b) / np.linalg.norm(np.cross(a, b), axis=1, keepdims=True)
    ends = [brdf.at(_unit(middle + step * side)) for step in (-5e-8, 5e-8)]
    for name, scale in (("alpha", 1), ("mu", 1), ("kappa", 50)):
        gap = np.abs(getattr(ends[0], name) - getattr(ends[1], name)).max()
        assert gap < 1e-6 * scale, name
        assert gap > 0, name
    # In a triangle: linear weights, and unit axes between those of the corners.
    inside = _unit(views[faces].mean(1))
    found = brdf.at(inside)
    share = np.linalg.solve(views[faces].transpose(0, 2, 1), inside[..., None])[..., 0]
    share /= share.sum(1, keepdims=True)
    expected = (share[..., None, None] * np.asarray(brdf.lobes.alpha)[faces]).sum(1)
    np.testing.assert_allclose(found.alpha, expected, atol=1e-13)
    expected = np.exp((share[..., None] * np.log(np.asarray(brdf.lobes.kappa)[faces])).sum(1))
    np.testing.assert_allclose(found.kappa, expected, rtol=1e-12)


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def test_values_of_a_brdf(brdf):
    wi = _unit(np.array([[0.1, 0.2, 1.0], [-0.5, 0.1, 0.7]]))
    wo = _unit(np.array([[0.5, 0.3, 0.8], [0.9, 0.1, 1e-3]]))
    value = brdf(wi, wo)
    assert value.shape == (2, 3)
    for i in range(2):
        # Below the lowest views, the nearest edge's: no extrapolation.
        np.testing.assert_allclose(value[i], brdf.at(wo[i])(wi[i]), rtol=1e-12)
        assert float(brdf.at(wo[i]).kappa[0]) <= 45.0
    slope = jax.jit(jax.grad(lambda v: brdf(jnp.asarray(wi), v / jnp.linalg.norm(v)).sum()))
    assert bool(jnp.isfinite(slope(jnp.asarray(np.tile(wo[:1], (2, 1))))).all())


def test_brdf_refusals(brdf):
    views, faces = np.asarray(brdf.views), np.asarray(brdf.faces)
    with pytest.raises(InputError, match=r"expected views \[V, 3\], faces \[F, 3\] and V sums"):
        BRDFLobes(views[:-1], faces[:1], brdf.lobes)
    with pytest.raises(InputError, match="expected views"):
        BRDFLobes(views, faces[:, :2], brdf.lobes)
    with pytest.raises(InputError, match="views must be unit vectors"):
        BRDFLobes(2 * views, faces, brdf.lobes)
    with pytest.raises(InputError, match="wo must be unit vectors"):
        brdf.at([0.0, 0.0, 2.0])
