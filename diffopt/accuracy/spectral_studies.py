"""Studies of the spectral integral: few wavelengths, and the form of the reflectance."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffopt import colour, few, samples
from diffopt.accuracy.comparison import random_pairs
from diffopt.accuracy.studies import Case, Job, Study
from diffopt.diffraction import DiffractionBRDF, evaluate
from diffopt.fresnel import Constant, Dielectric, Reflectance, metal
from diffopt.heightfield import Heightfield
from diffopt.kernels import fresnel
from diffopt.settings import ChebyshevSettings, DirectSettings, FewSettings, SeparableSettings


def _wavelengths(quick: bool) -> list[Case]:
    period, pixel, n = 2.0, 0.0625, 512
    line = 0.1 * np.cos(2.0 * np.pi * (np.arange(n) - n // 2) * pixel / period)
    heights = np.broadcast_to(line, (2, n)).astype(np.float32)
    u = np.linspace(-0.95, 0.95, 48 if quick else 191)
    wo = np.stack([u, 0.0 * u, np.sqrt(1.0 - u**2)], -1)
    wi = np.broadcast_to([0.0, 0.0, 1.0], wo.shape)
    w_range = (float(-(1.0 + wo[:, 2]).max()), float(-(1.0 + wo[:, 2]).min()))
    nodes = SeparableSettings(nodes=12)  # 6e-12 of a mirror's peak over the whole range of w

    def brdf(sigma, dtype):
        # Nothing varies along y: two samples there, sigma_s apart, hold the window.
        scan = Heightfield(jnp.asarray(heights, dtype), pixel=(sigma, pixel))
        return DiffractionBRDF(scan, sigma, balance="peak")

    def xyz(model, wi, wo, wavelengths, weights, settings):
        return evaluate(model, wi, wo, wavelengths, settings, output="xyz", weights=weights)

    plain = functools.partial(xyz, settings=nodes)

    @functools.cache
    def expected(sigma):
        with jax.enable_x64(True):
            rule = colour.ColourSettings(step_nm=1.0).quadrature()
            direct = jax.jit(functools.partial(xyz, settings=DirectSettings()))
            return np.asarray(direct(brdf(sigma, "float64"), wi, wo, *rule))

    def case(sigma, rule, count, step=5.0):
        def judge(value):
            value, right = np.asarray(value, np.float64), expected(sigma)
            error = np.abs(value - right)
            difference = colour.delta_e_2000(right, value)
            return float(error.max() / right.max()), (
                f"mean over mean {error.mean() / right.mean():.1e}, delta E 2000 "
                f"mean {difference.mean():.2g} max {difference.max():.2g}"
            )

        def build():
            model = brdf(sigma, "float32")
            directions = (jnp.asarray(wi, "float32"), jnp.asarray(wo, "float32"))
            if rule == "few, mirror apart":
                full = colour.ColourSettings(step_nm=1.0).quadrature()
                settings = FewSettings(count=count, nodes=nodes.nodes)
                made = few.few_wavelengths(model, *full, w_range, settings)
                run = functools.partial(few.evaluate_few, settings=settings)
                return Job(run, (model, made, *directions), judge)
            if rule == "plain":
                used = colour.ColourSettings(step_nm=step)
            else:
                used = colour.ColourSettings(bands="three", samples=count // 3)
            points = [jnp.asarray(a, "float32") for a in used.quadrature()]
            return Job(plain, (model, *directions, *points), judge)

        return Case({"sigma_um": sigma, "rule": rule, "wavelengths": count}, "float32", build)

    steps = (5.0, 20.0) if quick else (1.0, 2.0, 2.5, 5.0, 10.0, 20.0, 40.0)
    counts = (21,) if quick else (81, 41, 21, 11)
    return [
        each
        for sigma in ((5.0,) if quick else (1.25, 5.0, 16.0))
        for each in (
            *(case(sigma, "plain", round(400.0 / step) + 1, step) for step in steps),
            *(case(sigma, "three bands", count) for count in ((3,) if quick else (3, 6))),
            *(case(sigma, "few, mirror apart", count) for count in counts),
        )
    ]


SPECTRUM = Study(
    name="diffraction.wavelengths",
    quantity="number of wavelengths for a sinusoidal grating (period 2 um, amplitude 0.1 um) "
    "seen in its plane, largest error of XYZ over the largest XYZ",
    reference="the same in float64 at 1 nm, the step of the tables",
    cases=_wavelengths,
    conditions=("sigma_um",),
    against="wavelengths",
)


class NormalOf(Reflectance):
    """The exact reflectance at normal incidence at every angle."""

    exact: Reflectance

    def __call__(self, cos_h, wavelengths):
        """See `Reflectance`."""
        r0 = self.exact.normal(wavelengths).astype(cos_h.dtype)
        r0 = r0.reshape((1,) * cos_h.ndim + r0.shape)
        return jnp.broadcast_to(r0, (*cos_h.shape, r0.shape[-1]))


class SchlickOf(NormalOf):
    """Schlick's formula from the exact reflectance at normal incidence at each wavelength."""

    def __call__(self, cos_h, wavelengths):
        """See `Reflectance`."""
        r0 = super().__call__(cos_h, wavelengths)
        return fresnel.schlick(jnp.broadcast_to(cos_h[..., None], r0.shape), r0)


class _OneWavelength(Reflectance):
    """The exact reflectance at one wavelength for all: taken out of the spectral integral."""

    exact: Reflectance
    wavelength: float = eqx.field(static=True)

    def __call__(self, cos_h, wavelengths):
        value = self.exact(cos_h, jnp.asarray([self.wavelength], wavelengths.dtype))
        return jnp.broadcast_to(value, (*cos_h.shape, wavelengths.shape[0]))


def _fresnel(quick: bool) -> list[Case]:
    n, pixel, sigma, count = (64, 0.1, 0.8, 64) if quick else (128, 0.1, 1.6, 512)
    lam = colour.wavelengths(10.0)
    weights = np.asarray(colour.spectral_weights(lam))
    middle = float(lam @ weights[:, 1] / weights[:, 1].sum())
    settings = ChebyshevSettings(terms=20, reach=5)
    scan = samples.compact_disc(jax.random.key(0), shape=(n, n), pixel=pixel)
    heights = np.asarray(scan.heights, np.float32)

    def directions(angle):
        # Random pairs, and mirror pairs, where the light is.
        wi, wo = random_pairs(count, angle)
        across = np.sin(np.radians(np.linspace(0.0, angle, 17)))
        mirror = np.stack([across, 0.0 * across, np.sqrt(1.0 - across**2)], -1)
        return np.append(wi, mirror, 0), np.append(wo, mirror * [-1.0, -1.0, 1.0], 0)

    def run(brdf, wi, wo, lam, weights):
        return evaluate(brdf, wi, wo, lam, settings, output="xyz", weights=weights)

    def arguments(material, angle, dtype):
        brdf = DiffractionBRDF(
            Heightfield(jnp.asarray(heights, dtype), pixel=pixel), sigma, fresnel=material
        )
        return (brdf, *(jnp.asarray(a, dtype) for a in (*directions(angle), lam, weights)))

    # Cauchy's coefficients of a crown glass (N-BK7).
    materials = {"crown glass": lambda: Dielectric([1.5046, 0.0042])}
    if not quick:
        materials |= {"aluminium": lambda: metal("Al"), "gold": lambda: metal("Au")}

    @functools.cache
    def expected(name, angle):
        with jax.enable_x64(True):
            return np.asarray(jax.jit(run)(*arguments(materials[name](), angle, "float64")))

    forms = {
        "exact": lambda m: m,
        "schlick": SchlickOf,
        "normal incidence": NormalOf,
        "one wavelength": lambda m: _OneWavelength(m, middle),
        "none (mirror)": lambda m: Constant(),
    }
    if quick:
        forms.pop("none (mirror)")

    def case(name, angle, form):
        def judge(value):
            value, right = np.asarray(value, np.float64), expected(name, angle)
            error = np.abs(value - right)
            return float(error.max() / right.max()), (
                f"mean over mean {error.mean() / right.mean():.1e}, delta E 2000 "
                f"mean {colour.delta_e_2000(right, value).mean():.2g}"
            )

        return Case(
            {"material": name, "within_deg": angle, "form": form},
            "float32",
            lambda: Job(run, arguments(forms[form](materials[name]()), angle, "float32"), judge),
        )

    return [
        case(name, angle, form)
        for name in materials
        for angle in ((60.0, 75.0) if quick else (30.0, 45.0, 60.0, 75.0))
        for form in forms
    ]


FRESNEL = Study(
    name="diffraction.fresnel",
    quantity="form of the reflectance on a compact disc, largest error of XYZ over the largest",
    reference="the exact reflectance at the half angle and each wavelength, in float64",
    cases=_fresnel,
    conditions=("material", "within_deg"),
    against="within_deg",
)
