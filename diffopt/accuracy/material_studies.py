"""Studies of materials: Schlick's formula, masking by a rational fit, colour in three numbers."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import colour
from diffopt.accuracy.comparison import random_pairs
from diffopt.accuracy.spectral_studies import NormalOf, SchlickOf
from diffopt.accuracy.studies import Case, Job, Study
from diffopt.fresnel import Dielectric, Reflectance, metal
from diffopt.kernels import fresnel, microfacet
from diffopt.materials import BlinnPhong, Merl, Microfacet
from diffopt.materials.goniometer import tabulate


def _fresnel(quick: bool) -> list[Case]:
    """Schlick's formula against the exact one, over all angles up to a largest one."""
    count = 2_000 if quick else 20_000
    lam = colour.wavelengths(20.0)
    # Cauchy's coefficients of N-BK7, and the index of water at 20 degrees.
    materials = {"crown glass": lambda: Dielectric([1.5046, 0.0042])}
    if not quick:
        materials |= {
            "water": lambda: Dielectric([1.324, 0.003]),
            "diamond": lambda: Dielectric([2.378, 0.012]),
            **{name: functools.partial(metal, name) for name in ("Al", "Ag", "Au", "Cu")},
        }

    forms = {"exact": lambda m: m, "schlick": SchlickOf, "normal incidence": NormalOf}

    def run(material, cos, wavelengths):
        return material(cos, wavelengths)

    def arguments(material, angle, dtype):
        cos = np.cos(np.radians(np.linspace(0.0, angle, count)))
        return material, jnp.asarray(cos, dtype), jnp.asarray(lam, dtype)

    @functools.cache
    def expected(name, angle):
        with jax.enable_x64(True):
            return np.asarray(jax.jit(run)(*arguments(materials[name](), angle, "float64")))

    def case(name, angle, form):
        def judge(value):
            right = expected(name, angle)
            error = np.asarray(value, np.float64) - right
            return float(np.abs(error).max() / right.max()), (
                f"relative to the value itself: {np.min(error / right):+.0%} to "
                f"{np.max(error / right):+.0%}"
            )

        return Case(
            {"material": name, "within_deg": angle, "form": form},
            "float32",
            lambda: Job(run, arguments(forms[form](materials[name]()), angle, "float32"), judge),
        )

    return [
        case(name, angle, form)
        for name in materials
        for angle in ((60.0,) if quick else (45.0, 60.0, 75.0, 90.0))
        for form in forms
    ]


FRESNEL = Study(
    name="material.fresnel",
    quantity="form of the reflectance, largest error over the largest value, all angles up to one",
    reference="Fresnel's equations in float64",
    cases=_fresnel,
    conditions=("material", "within_deg"),
)


def _masking(quick: bool) -> list[Case]:
    """Smith's G1 for Beckmann's normals: erf, and the rational fit in its place."""
    count = 20_000 if quick else 400_000
    cos = np.linspace(1e-3, 1.0, count)
    directions = np.stack([np.sqrt(1.0 - cos**2), 0.0 * cos, cos], -1)

    def with_erf(w, alpha):
        return microfacet.masking("beckmann", w, (alpha, alpha))

    def rational(w, alpha):
        # Walter et al. 2007, section 5.2.
        tangent = alpha * jnp.sqrt(w[:, 0] ** 2 + w[:, 1] ** 2)
        a = jnp.minimum(w[:, 2] / jnp.maximum(tangent, 1e-6), 1.6)
        fit = (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)
        return jnp.where(a < 1.6, fit, 1.0)

    def arguments(alpha, dtype):
        return jnp.asarray(directions, dtype), jnp.asarray(alpha, dtype)

    @functools.cache
    def expected(alpha):
        # Independent of the kernel: Lambda by erfc of the standard library.
        a = cos / (alpha * np.sqrt(1.0 - cos**2) + 1e-300)
        a = np.minimum(a, 26.0)
        erfc = np.vectorize(math.erfc)(a)
        masked = 0.5 * (np.exp(-a * a) / (a * math.sqrt(math.pi)) - erfc)
        return 1.0 / (1.0 + masked)

    def case(alpha, form, run):
        def judge(value):
            error = np.abs(np.asarray(value, np.float64) - expected(alpha)) / expected(alpha)
            worst = math.degrees(math.acos(cos[int(error.argmax())]))
            return float(error.max()), f"mean {error.mean():.1e}, largest at {worst:.0f} degrees"

        return Case(
            {"alpha": alpha, "form": form},
            "float32",
            lambda: Job(run, arguments(alpha, "float32"), judge, gradient=0),
            program=form,
        )

    return [
        case(alpha, form, run)
        for alpha in ((0.5,) if quick else (0.1, 0.3, 0.5, 1.0))
        for form, run in (("erf", with_erf), ("rational fit", rational))
    ]


MASKING = Study(
    name="material.masking",
    quantity="Smith's masking G1 of Beckmann's normals, largest relative error up to 89.9 degrees",
    reference="1 / (1 + Lambda) with erfc in float64",
    cases=_masking,
    conditions=("alpha",),
)


def _colours(quick: bool) -> list[Case]:
    """A metal's colour after several reflections, by RGB numbers and by wavelengths."""
    count = 2_000 if quick else 20_000
    cos = np.linspace(0.2, 1.0, count)
    rule = colour.wavelengths(1.0)
    to_rgb = colour.rgb_matrix()

    def spectral(material: Reflectance, cos, wavelengths, weights, bounces):
        value = material(cos, wavelengths) ** bounces
        return jnp.matmul(value, weights, precision="highest")

    def three(r0, cos, bounces):
        return fresnel.schlick(*jnp.broadcast_arrays(cos[:, None], r0[None, :])) ** bounces

    def weights(lam):
        return np.asarray(colour.spectral_weights(lam)) @ to_rgb.T

    @functools.cache
    def expected(name, bounces):
        with jax.enable_x64(True):
            run = jax.jit(functools.partial(spectral, bounces=bounces))
            arrays = (jnp.asarray(a, "float64") for a in (cos, rule, weights(rule)))
            return np.asarray(run(metal(name), *arrays))

    def judged(name, bounces):
        def judge(value):
            value, right = np.asarray(value, np.float64), expected(name, bounces)
            to_xyz = np.linalg.inv(to_rgb).T
            difference = colour.delta_e_2000(right @ to_xyz, value @ to_xyz)
            return float(np.abs(value - right).max() / right.max()), (
                f"delta E 2000 mean {difference.mean():.2g} max {difference.max():.2g}"
            )

        return judge

    def by_wavelengths(name, bounces, step):
        lam = colour.wavelengths(step)

        def build():
            arrays = [jnp.asarray(a, "float32") for a in (cos, lam, weights(lam))]
            run = functools.partial(spectral, bounces=bounces)
            return Job(run, (metal(name), *arrays), judged(name, bounces))

        settings = {"metal": name, "bounces": bounces, "form": "spectral", "numbers": len(lam)}
        return Case(settings, "float32", build)

    def by_rgb(name, bounces):
        def build():
            with jax.enable_x64(True):
                flat = metal(name).normal(jnp.asarray(rule, "float64"))
                r0 = np.asarray(flat) @ weights(rule)
            arrays = (jnp.asarray(r0, "float32"), jnp.asarray(cos, "float32"))
            run = functools.partial(three, bounces=bounces)
            return Job(run, arrays, judged(name, bounces))

        settings = {"metal": name, "bounces": bounces, "form": "RGB, Schlick", "numbers": 3}
        return Case(settings, "float32", build)

    steps = (5.0, 40.0) if quick else (5.0, 10.0, 20.0, 40.0)
    return [
        each
        for name in (("Au",) if quick else ("Au", "Cu", "Ag"))
        for bounces in ((1,) if quick else (1, 2, 4))
        for each in (
            *(by_wavelengths(name, bounces, step) for step in steps),
            by_rgb(name, bounces),
        )
    ]


COLOURS = Study(
    name="material.colour",
    quantity="linear RGB of a metal after reflections, largest error over the largest value",
    reference="Fresnel's equations at 1 nm in float64",
    cases=_colours,
    conditions=("metal", "bounces"),
)


def _tables(quick: bool) -> list[Case]:
    """Tables over half and difference angles: their size, nearest or linear."""
    count = 2_000 if quick else 20_000
    wi, wo = random_pairs(count)
    models = {"ggx 0.3": lambda: Microfacet(0.3)}
    if not quick:
        models |= {"ggx 0.1": lambda: Microfacet(0.1), "blinn 50": lambda: BlinnPhong(1.0, 50.0)}

    def look(table, wi, wo):
        return table.value(wi, wo)

    @functools.cache
    def expected(name):
        with jax.enable_x64(True):
            return np.asarray(models[name]().f(np.asarray(wi), np.asarray(wo)))

    def case(name, rows, nearest):
        def judge(value):
            right = expected(name)
            error = np.abs(np.asarray(value, np.float64).reshape(right.shape) - right)
            return float(error.max() / right.max()), (
                f"mean over mean {error.mean() / right.mean():.1e}"
            )

        def build():
            made = tabulate(models[name](), shape=(rows, rows, 2 * rows))
            table = Merl(made.table, nearest=nearest)
            pair = (jnp.asarray(w, "float32") for w in (wi, wo))
            return Job(look, (table, *pair), judge)

        lookup = "nearest" if nearest else "linear"
        return Case({"material": name, "rows": rows, "lookup": lookup}, "float32", build)

    return [
        case(name, rows, nearest)
        for name in models
        for rows in ((15, 30) if quick else (30, 60, 90))
        for nearest in (True, False)
    ]


TABLES = Study(
    name="material.table",
    quantity="lookup of f in a table of half and difference angles (rows x rows x 2 rows), "
    "largest error over the largest value, random pairs within 75 degrees",
    reference="the material that the table was made of, in float64",
    cases=_tables,
    conditions=("material",),
)
