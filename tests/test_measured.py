"""Measured materials: files made here, closed forms as oracles, every refusal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lengths import but

from diffopt.errors import InputError
from diffopt.kernels import frames, tabulated
from diffopt.materials import BlinnPhong, Lambert, Microfacet
from diffopt.materials.goniometer import measure, tabulate
from diffopt.materials.merl import Merl, load_merl, save_merl
from diffopt.materials.pbsdf import load_pbsdf
from diffopt.materials.rgl import load_rgl
from diffopt.materials.scattered import Scattered, load_table
from diffopt.materials.tensorfile import read_tensors, write_tensors

SHAPE = (12, 10, 8)


def directions(rng, count, dtype=np.float64, steepest=1.3):
    """Pairs above the horizon, uniform in the cosine."""
    cos = rng.uniform(np.cos(steepest), 1.0, (2, count))
    phi = rng.uniform(0, 2 * np.pi, (2, count))
    sin = np.sqrt(1 - cos**2)
    w = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], -1)
    return tuple(jnp.asarray(a, dtype) for a in w)


def table(rng, shape=(*SHAPE, 3)):
    return rng.uniform(0.1, 2.0, shape)


def pbsdf_fields(rng, **changes):
    fields = {
        "phi_d": np.linspace(-np.pi, np.pi, 7, dtype=np.float32)[None],
        "theta_d": np.linspace(0, np.pi / 2, 5, dtype=np.float32)[None],
        "theta_h": np.linspace(0, np.pi / 2, 4, dtype=np.float32)[None],
        "wvls": np.array([450, 500, 600], np.uint16),
        "M": rng.uniform(0.1, 1.0, (7, 5, 4, 3, 4, 4)).astype(np.float32),
    }
    return fields | changes


def rgl_fields(rng, phi=(-np.pi, np.pi, 5), **changes):
    slices = (phi[2], 4)
    fields = {
        "phi_i": np.linspace(*phi, dtype=np.float32),
        "theta_i": np.linspace(0, np.pi / 2, 4, dtype=np.float32),
        "ndf": rng.uniform(0.5, 2.0, (7, 9)),
        "sigma": rng.uniform(0.5, 1.0, (5, 6)),
        "vndf": rng.uniform(0.3, 2.0, (*slices, 9, 8)),
        "rgb": rng.uniform(0.1, 1.0, (*slices, 3, 6, 6)),
        "spectra": rng.uniform(0.1, 1.0, (*slices, 4, 6, 6)),
        "wavelengths": np.array([400.0, 500.0, 600.0, 700.0]),
        "jacobian": np.array([1], np.uint8),
    }
    floats = {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in fields.items()}
    return floats | changes


def make_merl(path, rng):
    return Merl(table(rng))


def make_pbsdf(path, rng):
    write_tensors(path / "a.pbsdf", pbsdf_fields(rng))
    return load_pbsdf(path / "a.pbsdf")


def make_rgl(path, rng):
    write_tensors(path / "a.bsdf", rgl_fields(rng))
    return load_rgl(path / "a.bsdf")


def make_folded(path, rng):
    write_tensors(path / "a.bsdf", rgl_fields(rng, phi=(-np.pi, -np.pi / 2, 3)))
    return load_rgl(path / "a.bsdf", wavelengths=[0.45, 0.7])


def make_isotropic(path, rng):
    write_tensors(path / "a.bsdf", rgl_fields(rng, phi=(0.0, 0.0, 1)))
    return load_rgl(path / "a.bsdf")


def make_scattered(path, rng):
    wi, wo = directions(rng, 60)
    return Scattered(wi, wo, rng.uniform(0.1, 1.0, (60, 3)))


MAKERS = (make_merl, make_pbsdf, make_rgl, make_folded, make_isotropic, make_scattered)


# What compiles for seconds is left to one of its kind; by day so is everything.
GRADIENTS = (make_merl, make_pbsdf, make_folded, make_scattered)


def name_of(maker):
    return maker.__name__.removeprefix("make_")


BY_NAME = {name_of(maker): maker for maker in MAKERS}


@pytest.fixture(params=but({name_of(maker) for maker in GRADIENTS}, BY_NAME))
def material(request, tmp_path):
    return BY_NAME[request.param](tmp_path, np.random.default_rng(3))


def rings(wo, count=1000, turns=100):
    """Directions that mirror wo at half vectors, with their solid angles.

    A grid that is fine about the normal: densities there are steep.
    """
    edge = np.linspace(0, 1, count + 1) ** 4 * np.pi / 2
    theta = 0.5 * (edge[1:] + edge[:-1])
    phi = (np.arange(turns) + 0.5) / turns * 2 * np.pi - np.pi
    half = frames.spherical(jnp.asarray(theta)[:, None], jnp.asarray(phi)[None])
    area = np.diff(-np.cos(edge)) * 2 * np.pi / turns
    dot = (half * wo).sum(-1, keepdims=True)
    return 2 * dot * half - wo, 4 * jnp.abs(dot[..., 0]) * jnp.asarray(area)[:, None]


def test_density_is_one_over_the_sphere_and_that_of_samples(material):
    wo = jnp.asarray(frames.spherical(jnp.asarray(0.9), jnp.asarray(0.7)))
    wi, area = rings(wo.reshape(1, 1, 3))
    # Held in single precision, a table's shares sum to 1 within 1e-7; the rest is the grid's.
    pdf = material.pdf(wi, wo)
    assert float((pdf * area).sum()) == pytest.approx(1.0, abs=2e-3)
    sample = material.sample(jax.random.key(2), jnp.broadcast_to(wo, (40000, 3)))
    np.testing.assert_allclose(sample.pdf, material.pdf(sample.wi, wo), rtol=1e-6)
    for moment in (
        lambda w: w[..., 0],
        lambda w: w[..., 1] ** 2,
        lambda w: (w[..., 2] > 0.5).astype(w.dtype),
    ):
        drawn = np.asarray(moment(sample.wi), float)
        expected = float((pdf * area * moment(wi)).sum())
        assert abs(drawn.mean() - expected) < 4.5 * drawn.std() / 200 + 2e-3
    weight = material.f(sample.wi, wo) * jnp.maximum(sample.wi[:, 2:], 0) / sample.pdf[:, None]
    np.testing.assert_allclose(sample.weight, weight, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("material", [name_of(maker) for maker in GRADIENTS], indirect=True)
def test_gradients_are_finite_at_the_seams_and_jit_agrees(material):
    normal = np.array([0.0, 0.0, 1.0])
    lean = np.array([0.6, 0.0, 0.8])
    grazing = np.array([1.0, 0.0, 1e-7])
    wi = jnp.asarray(np.stack([normal, lean, lean, grazing, lean, -lean]))
    wo = jnp.asarray(np.stack([normal, lean, lean * [-1, 1, 1], lean, normal, lean]))

    def total(wi, wo):
        return material.f(wi, wo).sum()

    value, slopes = jax.jit(jax.value_and_grad(total, (0, 1)))(wi, wo)
    assert float(value) == pytest.approx(float(total(wi, wo)), rel=1e-5)
    assert all(bool(jnp.isfinite(s).all()) for s in slopes)
    assert bool((material.f(wi[5], wo[5]) == 0.0).all())


def test_reciprocity_is_as_declared(material, rng):
    wi, wo = directions(rng, 50)
    worst = float(jnp.abs(material.f(wi, wo) - material.f(wo, wi)).max())
    assert (worst < 1e-6) == material.reciprocal


def trilinear(values, wi, wo):
    """A slow twin of `Merl`, by the definition of the angles."""
    half = (wi + wo) / np.linalg.norm(wi + wo)
    theta_h, phi_h = np.arccos(half[2]), np.arctan2(half[1], half[0])
    c, s = np.cos(-phi_h), np.sin(-phi_h)
    x, y, z = c * wi[0] - s * wi[1], s * wi[0] + c * wi[1], wi[2]
    c, s = np.cos(-theta_h), np.sin(-theta_h)
    x, z = c * x + s * z, c * z - s * x
    theta_d, phi_d = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x) % np.pi
    rows, columns, depth = values.shape[:3]
    at = (
        np.clip(rows * np.sqrt(theta_h * 2 / np.pi) - 0.5, 0, rows - 1),
        np.clip(columns * theta_d * 2 / np.pi - 0.5, 0, columns - 1),
        depth * phi_d / np.pi - 0.5,
    )
    low = [int(np.floor(a)) for a in at]
    total, weight = np.zeros(3), np.zeros(3)
    for corner in np.ndindex(2, 2, 2):
        part = np.prod([abs(1 - b - (a - k)) for a, k, b in zip(at, low, corner, strict=True)])
        i, j, k = (a + b for a, b in zip(low, corner, strict=True))
        entry = values[min(i, rows - 1), min(j, columns - 1), k % depth]
        total += part * np.where(entry < 0, 0, entry)
        weight += part * (entry >= 0)
    return np.where(weight > 0, total / np.where(weight > 0, weight, 1), 0.0)


def test_merl_is_its_twin(dtype, rng):
    values = table(rng)
    values[rng.uniform(size=values.shape) < 0.2] = -1.0
    wi, wo = directions(rng, 60, dtype)
    pairs = zip(np.asarray(wi, np.float64), np.asarray(wo, np.float64), strict=True)
    expected = [trilinear(values, a, b) for a, b in pairs]
    found = Merl(jnp.asarray(values, dtype)).f(wi, wo)
    assert found.dtype == jnp.dtype(dtype)
    # Places have the rounding of phi_d times ten entries; the entries differ by 2.
    np.testing.assert_allclose(found, expected, atol=5e3 * float(jnp.finfo(dtype).eps))


def test_merl_gradient_in_the_table(rng):
    wi, wo = directions(rng, 30)
    values = jnp.asarray(table(rng))

    def mean(values):
        return Merl(values).f(wi, wo).mean()

    slope = jax.grad(mean)(values)
    # Linear in the table, its weights sum to 1.
    assert float(slope.sum()) == pytest.approx(1.0)
    assert float((slope * values).sum()) == pytest.approx(float(mean(values)))


def test_tabulated_materials_and_their_albedo():
    microfacet = Microfacet(0.3)
    found = tabulate(microfacet, shape=(60, 40, 24))
    wo = frames.spherical(jnp.linspace(0.1, 0.9, 6), jnp.zeros(6))
    # All at once: a batch of five is what one compiler got wrong.
    for dtype in (jnp.float32, jnp.float64):
        batch = found.albedo(wo.astype(dtype))
        np.testing.assert_allclose(batch, microfacet.albedo(wo), rtol=5e-3)


def test_merl_files_come_back(tmp_path, rng):
    values = table(rng)
    values[3, 2] = -1.0
    path = tmp_path / "a.binary"
    save_merl(path, Merl(values))
    raw = np.fromfile(path, "<f8", offset=12).reshape(3, *SHAPE)
    np.testing.assert_allclose(raw[2] * (1.66 / 1500), values[..., 2])
    np.testing.assert_allclose(load_merl(path, shape=SHAPE).table, values, rtol=1e-14)


def broken_merl(path, rng, what):
    save_merl(path, table(rng))
    data = path.read_bytes()
    if what == "short":
        path.write_bytes(data[:-9])
    elif what == "long":
        path.write_bytes(data + b"more")
    elif what == "foreign":
        path.write_bytes(b"\x89PNG\r\n\x1a\n" + data)
    elif what == "text":
        path.write_bytes(b"none")
    else:
        path.write_bytes(data[:20] + np.float64(np.nan).tobytes() + data[28:])


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("short", "a.binary: is cut short: expected 23052 bytes, found 23043"),
        ("long", "has bytes left over: expected 23052 bytes, found 23056"),
        ("foreign", "expected a MERL file that starts with the sizes 12 x 10 x 8.*a PNG image"),
        ("text", "found 4 bytes"),
        ("nan", "expected finite values, found nan in plane 0 at .0, 0, 1."),
    ],
)
def test_broken_merl_files(tmp_path, rng, what, message):
    path = tmp_path / "a.binary"
    broken_merl(path, rng, what)
    with pytest.raises(InputError, match=message):
        load_merl(path, shape=SHAPE)


def test_merl_refuses(tmp_path, rng):
    save_merl(tmp_path / "a", table(rng))
    with pytest.raises(InputError, match="sizes 90 x 90 x 180, found 12 x 10 x 8"):
        load_merl(tmp_path / "a")
    with pytest.raises(InputError, match="no such file"):
        load_merl(tmp_path / "none")
    with pytest.raises(InputError, match=r"table must be .* received shape \(3, 4\)"):
        Merl(np.ones((3, 4)))
    with pytest.raises(InputError, match=r"must be finite, .* received inf"):
        Merl(np.full((2, 2, 2), np.inf))
    with pytest.raises(InputError, match=r"holds a table .* received shape \(2, 2, 2\)"):
        save_merl(tmp_path / "b", np.ones((2, 2, 2)))
    with pytest.raises(InputError, match="table must be finite"):
        save_merl(tmp_path / "b", np.full((2, 2, 2, 3), np.nan))
    assert not (tmp_path / "b").exists()


def test_tensor_files_come_back(tmp_path, rng):
    fields = rgl_fields(rng) | {"empty": np.zeros((0, 9), np.float64), "n": np.int16([[-3]])}
    write_tensors(tmp_path / "a", fields)
    found = read_tensors(tmp_path / "a")
    assert list(found) == list(fields)
    for name, array in fields.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)
    with pytest.raises(InputError, match="'x' is of type complex128; expected real numbers"):
        write_tensors(tmp_path / "b", {"x": np.ones(2, complex)})


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: b"II*\x00" + d, "expected a tensor file .*, found a TIFF image"),
        (lambda d: d[:12] + b"\x02\x01" + d[14:], "version 2.1; expected 1.0"),
        (lambda d: d[:40], "cut short within its list of fields"),
        (lambda d: d[:-1], "cut short: field 'M' ends at byte"),
        (lambda d: d[:27] + b"\x63" + d[28:], "field 'phi_d' is of type 99; expected 1 to 11"),
    ],
)
def test_broken_tensor_files(tmp_path, rng, edit, message):
    path = tmp_path / "a.pbsdf"
    write_tensors(path, pbsdf_fields(rng))
    path.write_bytes(edit(path.read_bytes()))
    with pytest.raises(InputError, match=message):
        load_pbsdf(path)


def test_polarised_table_is_read_at_its_nodes(tmp_path, rng):
    path = tmp_path / "a.pbsdf"
    fields = pbsdf_fields(rng)
    fields["M"][2, 1, 1] = np.nan
    fields["M"][3, 1, 1, :, 0, 0] = -0.1
    write_tensors(path, fields)
    material = load_pbsdf(path, wavelengths=[0.45, 0.55])
    nodes = [fields[n].ravel() for n in ("theta_h", "theta_d", "phi_d")]
    m = fields["M"][..., 0, 0]

    def at(p, d, h):
        angles = (nodes[0][h], nodes[1][d], nodes[2][p])
        return material.f(*tabulated.half_difference(*map(jnp.asarray, angles)))

    expected = [m[4, 2, 1, 0], 0.5 * (m[4, 2, 1, 1] + m[4, 2, 1, 2])]
    # Rounded angles move the place by 1e-6 of a step.
    np.testing.assert_allclose(at(4, 2, 1), expected, atol=1e-5)
    np.testing.assert_allclose(at(3, 1, 1), 0.0, atol=1e-5)
    np.testing.assert_allclose(material.wavelengths, [0.45, 0.55], rtol=1e-6)
    assert bool((material.table[2, 1, 1] == -1.0).all())
    regular = {name: np.zeros((0, fields[name].size), np.float32) for name in list(fields)[:3]}
    write_tensors(path, fields | regular)
    np.testing.assert_allclose(load_pbsdf(path).theta_h, nodes[0], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"M": None}, {}, "no field M; there are"),
        ({"M": np.ones((7, 5, 4, 2, 4, 4))}, {}, "expected M over .* found shape"),
        ({"phi_d": np.zeros((1, 7), np.float32)}, {}, "7 increasing nodes phi_d"),
        ({"M": np.full((7, 5, 4, 3, 4, 4), np.inf)}, {}, "infinite values"),
        ({}, {"wavelengths": [0.4]}, "within 0.45 to 0.6 micrometres; received 0.4"),
    ],
)
def test_polarised_tables_refuse(tmp_path, rng, change, options, message):
    fields = {k: v for k, v in pbsdf_fields(rng, **change).items() if v is not None}
    write_tensors(tmp_path / "a", fields)
    with pytest.raises(InputError, match=message):
        load_pbsdf(tmp_path / "a", **options)


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        ({"rgb": None}, {}, "no field rgb"),
        ({"vndf": np.ones((5, 4, 9))}, {}, r"expected vndf \[5, 4, height, width\]; found shape"),
        ({"sigma": np.full((2, 2), np.nan)}, {}, "field 'sigma' must be finite"),
        ({}, {"wavelengths": [0.8]}, "within 0.4 to 0.7 micrometres; received 0.8"),
        ({"theta_i": np.zeros(4)}, {}, "4 increasing nodes theta_i"),
    ],
)
def test_rgl_refuses(tmp_path, rng, change, options, message):
    fields = {k: v for k, v in rgl_fields(rng, **change).items() if v is not None}
    write_tensors(tmp_path / "a", fields)
    with pytest.raises(InputError, match=message):
        load_rgl(tmp_path / "a", **options)


def test_rgl_of_even_tables_is_their_microfacet_model(tmp_path, rng):
    flat = {
        "vndf": np.ones((5, 4, 9, 8)),
        "ndf": np.full((7, 9), 0.7),
        "rgb": np.ones((5, 4, 3, 6, 6)),
    }
    flat |= {"sigma": np.full((5, 6), 0.5)}
    write_tensors(tmp_path / "a", rgl_fields(rng, **flat))
    wi, wo = directions(rng, 20)
    expected = 0.7 / (4 * 0.5 * wo[:, 2:]) * jnp.ones((1, 3))
    np.testing.assert_allclose(load_rgl(tmp_path / "a").f(wi, wo), expected, rtol=1e-6)


def test_scattered_goes_through_its_samples(dtype, rng):
    wi, wo = directions(rng, 80, dtype)
    values = jnp.asarray(rng.uniform(0.1, 1.0, 80), dtype)
    material = Scattered(wi, wo, values)
    limit = 1e4 * float(jnp.finfo(dtype).eps)
    np.testing.assert_allclose(material.f(wi, wo), values, atol=limit)
    np.testing.assert_allclose(material.f(wo, wi), values, atol=limit)
    flip = jnp.asarray([1.0, -1.0, 1.0], dtype).reshape(1, 3)
    np.testing.assert_allclose(material.f(wi * flip, wo * flip), values, atol=limit)
    between = material.f(*directions(rng, 80, dtype, 1.5))
    assert bool(((between >= values.min()) & (between <= values.max())).all())


THETA, PHI = np.radians(np.arange(0, 81, 8.0)), np.radians(np.arange(0, 181, 18.0))


@pytest.mark.parametrize("ending", ["csv", "npz"])
def test_measured_materials_are_read_back(tmp_path, rng, ending):
    wi, wo = directions(rng, 400, steepest=np.radians(78))
    for material in (Lambert(0.5), Microfacet(0.3), BlinnPhong(1.0, 20.0)):
        measurement = measure(material, THETA, THETA, PHI)
        measurement.save(tmp_path / f"a.{ending}")
        again = load_table(tmp_path / f"a.{ending}")
        found = again.f(wi, wo)
        np.testing.assert_allclose(found, measurement.material().f(wi, wo), atol=1e-7)
        if ending == "csv":
            # Peaks that are narrower than a step at grazing angles are missed by both, so
            # the largest errors are not compared; nine of ten have to keep the estimate.
            error = np.abs(found - material.f(wi, wo))
            estimate = np.asarray(measurement.error())
            assert np.quantile(error, 0.9) <= np.quantile(estimate, 0.9) + 1e-12
            assert np.median(error) <= np.median(estimate) + 1e-12
            assert np.quantile(error, 0.9) <= 0.05


def test_symmetries_save_measurements():
    angles = np.radians([10.0, 30.0, 50.0])
    turns = np.radians([0.0, 90.0, 180.0, 270.0])
    plain = measure(Lambert(0.5), angles, angles, turns, reciprocal=False)
    # 90 and 270 degrees are mirror images; exchange leaves 6 of 9 pairs of angles.
    assert (plain.count, len(plain.values)) == (27, 36)
    assert measure(Lambert(0.5), angles, angles, turns).count == 18
    both = measure(Lambert(0.5), angles, angles, turns, isotropic=False)
    assert (both.count, len(both.values)) == (78, 144)
    microfacet = measure(Microfacet([0.2, 0.5]), angles, angles, turns, isotropic=False)
    every = [frames.spherical(*microfacet.angles.T[k : k + 2]) for k in (0, 2)]
    np.testing.assert_allclose(microfacet.values, Microfacet([0.2, 0.5]).f(*every), rtol=1e-10)
    with pytest.raises(InputError, match="isotropic; the measurement is not"):
        microfacet.to_merl()


def test_noise_is_relative_and_repeatable():
    angles, turns = np.radians([10.0, 20.0, 30.0, 40.0, 50.0]), np.radians(np.arange(0, 180, 2.0))
    key = jax.random.key(1)
    noisy = measure(Lambert(0.5), angles, angles, turns, noise=0.1, key=key)
    spread = np.asarray(noisy.values)[noisy.measured] * np.pi / 0.5 - 1.0
    assert spread.std() == pytest.approx(0.1, rel=0.1)
    again = measure(Lambert(0.5), angles, angles, turns, noise=0.1, key=key)
    np.testing.assert_array_equal(noisy.values, again.values)


def test_measurement_as_a_merl_table():
    found = measure(Lambert([0.2, 0.4, 0.6]), THETA[::2], THETA[::2], PHI[::2]).to_merl(shape=SHAPE)
    wi = jnp.asarray([0.0, 0.6, 0.8])
    np.testing.assert_allclose(found.f(wi, wi), np.array([0.2, 0.4, 0.6]) / np.pi, rtol=1e-6)
    assert float(found.table.min()) == -1.0


HEAD = "theta_i,phi_i,theta_o,phi_o,"
ROWS = ("10,0,20,90,", "60,5,30,45,", "0,0,0,0,")


@pytest.mark.parametrize(
    ("names", "cells", "expected"),
    [
        ("f", "0.5", 0.5),
        ("f_cos", "0.5", 0.5 / np.cos(np.radians(20))),
        ("r,g,b", "1,2,3", [1, 2, 3]),
        ("700nm,450.5nm", "7,4", [4, 7]),
    ],
)
def test_tables_of_all_kinds(tmp_path, names, cells, expected):
    path = tmp_path / "a.csv"
    path.write_text("# made here\n" + "\n".join([HEAD + names, *(r + cells for r in ROWS)]))
    material = load_table(path)
    w = [frames.spherical(*map(jnp.asarray, np.radians(a))) for a in ((10.0, 0.0), (20.0, 90.0))]
    np.testing.assert_allclose(material.f(*w), expected, rtol=1e-4)
    if "nm" in names:
        np.testing.assert_allclose(material.wavelengths, [0.4505, 0.7], rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{HEAD}f\n1,2,3,4,x\n", "a.csv, line 2: f must be a number; received 'x'"),
        (f"#\n{HEAD}f\n1,2,3\n", "line 3: expected 5 cells, found 3"),
        ("theta_i,phi_i,f\n1,2,3\n", "no column theta_o, phi_o; there are theta_i, phi_i, f"),
        (f"{HEAD}g\n1,2,3,4,5\n", "no values: expected a column f, or r, g, b"),
        (f"{HEAD}f\n91,2,3,4,5\n", "theta_i must be from 0 to 90 degrees .* received 91 in row 1"),
        (f"{HEAD}f_cos\n1,2,90,4,5\n", "theta_o must be .* received 90 in row 1"),
        (f"{HEAD}f\n1,2,3,4,nan\n", "column f is nan in row 1"),
        (f"{HEAD}f\n1,2,3,4,5\n", "at least two samples"),
        (f"{HEAD}f,f\n1,2,3,4,5,6\n", "column names must differ"),
        ("# nothing\n", "found comments alone"),
    ],
)
def test_broken_tables(tmp_path, text, message):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        load_table(path)


def test_broken_archives(tmp_path):
    path = tmp_path / "a.npz"
    path.write_bytes(b"\x89PNG\r\n\x1a\n")
    with pytest.raises(InputError, match=r"expected a NumPy archive .*, found a PNG image"):
        load_table(path)
    path.write_bytes(b"PK\x03\x04 and no more")
    with pytest.raises(InputError, match="the archive cannot be read"):
        load_table(path)
    np.savez(path, theta_i=np.ones(3), phi_i=np.ones(2))
    with pytest.raises(InputError, match="column phi_i has 2 entries, theta_i has 3"):
        load_table(path)
    path.with_suffix(".csv").write_bytes(b"\xff\xd8\xff\xe0")
    with pytest.raises(InputError, match="expected a table in text, found a JPEG image"):
        load_table(path.with_suffix(".csv"))


def test_measuring_refuses(tmp_path):
    few = np.radians([10.0, 30.0])
    with pytest.raises(InputError, match="theta_i must be from 0 to below pi / 2"):
        measure(Lambert(0.5), [2.0], few, few)
    with pytest.raises(InputError, match="phi must be finite angles"):
        measure(Lambert(0.5), few, few, [np.nan])
    with pytest.raises(InputError, match="noise must be at least 0; received -1"):
        measure(Lambert(0.5), few, few, few, noise=-1.0)
    with pytest.raises(InputError, match="noise needs a key"):
        measure(Lambert(0.5), few, few, few, noise=0.1)
    small = measure(Lambert([0.5, 0.2]), few, few, few)
    with pytest.raises(InputError, match="three angles on each axis"):
        small.error()
    with pytest.raises(InputError, match=r"ends in .csv or .npz"):
        small.save(tmp_path / "a.txt")
    with pytest.raises(InputError, match="2 channels without wavelengths"):
        small.save(tmp_path / "a.csv")


def test_scattered_refuses():
    up = np.array([[0.0, 0.0, 1.0]] * 3)
    with pytest.raises(InputError, match=r"at least two samples; received shapes"):
        Scattered(up, up, np.ones(4))
    with pytest.raises(InputError, match="values must be finite"):
        Scattered(up, up, np.full(3, np.nan))
    with pytest.raises(InputError, match="neighbours must be at least 1; received 0"):
        Scattered(up, up, np.ones(3), neighbours=0)
