"""The same materials by an independent renderer, Mitsuba 3."""

import jax.numpy as jnp
import numpy as np
import pytest

from diffopt import fresnel
from diffopt.accuracy import mitsuba_lobes, mitsuba_scenes
from diffopt.kernels import fresnel as kernel
from diffopt.materials import BlinnPhong, Lambert, Microfacet, RoughDielectric, Sum
from reference import directions

mitsuba = pytest.importorskip("mitsuba")
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")

PAIRS = 1000
ETA, K = 0.27, 3.1


@pytest.fixture(scope="module")
def mi():
    mitsuba.set_variant("scalar_rgb")
    return mitsuba


def theirs(mi, description, wi, wo, *, density=False):
    """f or density of pairs; Mitsuba calls the viewer wi, the light wo, and takes f cos."""
    bsdf, context = mi.load_dict(description), mi.BSDFContext()
    at = mi.SurfaceInteraction3f()

    def one(light, viewer):
        at.wi = viewer
        if density:
            return bsdf.pdf(context, at, light)
        return bsdf.eval(context, at, light)[0] / abs(light[2])

    return np.array([one(*pair) for pair in zip(wi.tolist(), wo.tolist(), strict=True)])


def conductor(normals, alpha):
    au, av = np.broadcast_to(alpha, 2)
    return {
        "type": "roughconductor",
        "distribution": normals,
        "alpha_u": float(au),
        "alpha_v": float(av),
        "eta": {"type": "spectrum", "value": ETA},
        "k": {"type": "spectrum", "value": K},
    }


METAL = fresnel.Conductor([0.3, 1.0], [ETA, ETA], [K, K])
# Mitsuba works in float32: a few hundred roundings in the half vector of a peak 1/alpha wide.
# Its masking for Beckmann is a rational fit, good to 0.35 %.
SAME, FIT = 1e-4, 3.5e-3
CASES = {
    "diffuse": (
        Lambert(0.5),
        {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}},
        SAME,
    ),
    **{
        f"conductor {normals} {alpha}": (
            Microfacet(alpha, METAL, normals=normals, masking="uncorrelated"),
            conductor(normals, alpha),
            SAME if normals == "ggx" else 2 * FIT,
        )
        for normals in ("ggx", "beckmann")
        for alpha in (0.1, 0.5, (0.2, 0.6))
    },
    **{
        f"dielectric {normals} {alpha}": (
            RoughDielectric(1.5, alpha, normals),
            {
                "type": "roughdielectric",
                "distribution": normals,
                "alpha": alpha,
                "int_ior": 1.5,
                "ext_ior": 1.0,
            },
            SAME if normals == "ggx" else 2 * FIT,
        )
        for normals in ("ggx", "beckmann")
        for alpha in (0.15, 0.5)
    },
}


@pytest.mark.parametrize("case", CASES)
def test_values_agree(case, mi, rng):
    material, description, tolerance = CASES[case]
    wi, wo = directions(rng, PAIRS, 89.0), directions(rng, PAIRS, 89.0)
    if material.transmits:
        # All four ways through the interface.
        wi[::2, 2] *= -1
        wo[1::3, 2] *= -1
    ours = np.asarray(material.f(wi, wo), np.float64)
    expected = theirs(mi, description, wi, wo)
    # Two peaks of masking multiply; below a millionth of the largest, float32 underflows.
    np.testing.assert_allclose(ours, expected, rtol=tolerance, atol=1e-6 * expected.max())
    assert (expected > 1e-3 * expected.max()).sum() > 50


def test_densities_agree(mi, rng):
    """Visible normals on both sides; reflecting lobes, which Mitsuba cuts at the horizon."""
    wi, wo = directions(rng, PAIRS, 85.0), directions(rng, PAIRS, 85.0)
    for alpha in (0.1, (0.2, 0.6)):
        ours = np.asarray(Microfacet(alpha, METAL).pdf(wi, wo))
        expected = theirs(mi, conductor("ggx", alpha), wi, wo, density=True)
        np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-6 * expected.max())


def test_fresnel_agrees(mi):
    """Both sides of glass, past the critical angle, and a metal."""
    cosines = np.linspace(0.01, 1.0, 60)
    for n in (1.33, 1.5, 1 / 1.5):
        expected = [mi.fresnel(c, n)[0] for c in cosines]
        ours = np.asarray(kernel.dielectric(jnp.asarray(cosines, "float32"), n))
        np.testing.assert_allclose(ours, expected, rtol=2e-4, atol=1e-6)
    expected = [mi.fresnel_conductor(c, mi.Complex2f(ETA, K)) for c in cosines]
    ours = np.asarray(kernel.conductor(jnp.asarray(cosines, "float32"), ETA, K))
    np.testing.assert_allclose(ours, expected, rtol=2e-4)


GLOSSY = {
    "lobe": BlinnPhong(0.6, 64.0),
    "plain constant": BlinnPhong(0.6, 16.0, normalised=False),
    "over matte": Sum([Lambert(0.3), BlinnPhong(0.5, 32.0)]),
}


@pytest.mark.parametrize("case", GLOSSY)
def test_lobes_that_are_written_for_it_agree(case, mi, rng):
    """Blinn-Phong, which Mitsuba has not: values, and its samples against its values."""
    mitsuba_lobes.register(mi)
    material = GLOSSY[case]
    described = mitsuba_scenes._lobe(material)
    wi, wo = directions(rng, PAIRS, 85.0), directions(rng, PAIRS, 85.0)
    expected = theirs(mi, described, wi, wo)
    ours = np.asarray(material.f(wi, wo), np.float64)
    # The power of a half vector rounded to float32.
    np.testing.assert_allclose(ours, expected, rtol=1e-4, atol=1e-6 * expected.max())
    bsdf, context = mi.load_dict(described), mi.BSDFContext()
    at = mi.SurfaceInteraction3f()
    at.wi = [0.6, 0.0, 0.8]
    drawn = [
        bsdf.sample(context, at, float(a), [float(b), float(c)])
        for a, b, c in rng.uniform(size=(4000, 3))
    ]
    weights = np.array([weight[0] for _, weight in drawn])
    z = (np.arange(400) + 0.5) / 400
    turn = (np.arange(800) + 0.5) * 2.0 * np.pi / 800
    z, turn = np.meshgrid(z, turn, indexing="ij")
    r = np.sqrt(1.0 - z**2)
    light = np.stack([r * np.cos(turn), r * np.sin(turn), z], -1).reshape(-1, 3)
    viewer = np.broadcast_to(np.array([0.6, 0.0, 0.8]), light.shape)
    values = np.asarray(material.f(light.astype("float32"), viewer.astype("float32")))
    albedo = (values * light[:, 2]).mean() * 2.0 * np.pi
    # The standard error of 4000 samples, four times.
    assert abs(weights.mean() - albedo) < 4.0 * weights.std() / np.sqrt(len(weights))
