"""Closed forms of von Mises-Fisher lobes against the approximations that papers use.

The distance of two lobes and the concentration of a mean cosine have exact forms; these studies
say what the approximations lose, and what they save.
"""

import functools

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.accuracy.studies import Case, Job, Study
from diffopt.kernels.langevin import inverse_langevin, pade_inverse_langevin
from diffopt.kernels.vmf_pairs import squared_distance, squared_distance_asymptotic

_COUNT = 100_000


def distance_of_alike(kappa: float, degrees: float) -> float:
    """Squared L2 distance of two lobes of one concentration, in 80 bits where there are such.

    ``2 (k coth k / (4 pi) - (k / (4 pi sinh k))^2 4 pi sinh(c) / c)`` with ``c = |k mu0 + k mu1|``.
    """
    k, half = np.longdouble(kappa), np.radians(np.longdouble(degrees)) / 2
    c = 2 * k * np.cos(half)
    # sinh c / sinh^2 k, with 2k - c = 4k sin^2 of a quarter of the angle.
    sines = np.exp(-4 * k * np.sin(half / 2) ** 2) * -2 * np.expm1(-2 * c) / np.expm1(-2 * k) ** 2
    return float((k / np.tanh(k) - k * k * sines / c) / (2 * np.longdouble(np.pi)))


def _pairs(degrees: float) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Axes at an angle from each other, turned every way."""
    rng = np.random.default_rng(7)
    first, other = rng.normal(size=(2, _COUNT, 3))
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    across = other - (other * first).sum(-1, keepdims=True) * first
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    angle = np.radians(degrees)
    return first, np.cos(angle) * first + np.sin(angle) * across


def _distances(quick: bool) -> list[Case]:
    """The exact squared distance, and its limit for large concentrations."""
    forms = {"exact": squared_distance, "eq. 7": squared_distance_asymptotic}
    axes = functools.cache(_pairs)

    def case(degrees, kappa, form):
        def build():
            mu0, mu1 = (jnp.asarray(mu, "float32") for mu in axes(degrees))
            one = jnp.ones(mu0.shape[:1], "float32")
            given = (one, mu0, kappa * one, one, mu1, kappa * one)
            return Job(forms[form], given, judge)

        def judge(value):
            off = np.asarray(value, np.float64) / distance_of_alike(kappa, degrees) - 1.0
            worst = off[np.abs(off).argmax()]
            return float(abs(worst)), f"{worst:+.2g}"

        settings = {"angle_deg": degrees, "kappa": kappa, "form": form}
        return Case(settings, "float32", build, program=form)

    return [
        case(degrees, kappa, form)
        for degrees in ((10.0, 165.0) if quick else (10.0, 45.0, 90.0, 135.0, 165.0, 175.0))
        for kappa in ((1.0, 2.0, 3.0, 32.0) if quick else (1.0, 2.0, 3.0, 4.0, 8.0, 32.0, 128.0))
        for form in forms
    ]


DISTANCE = Study(
    name="lobes.distance",
    quantity="squared L2 distance of two lobes of unit integral and one concentration, exact and "
    f"for large concentrations, largest relative error; time of {_COUNT:,} pairs",
    reference="the exact form in 80 bits",
    cases=_distances,
    conditions=("angle_deg", "kappa"),
    against="kappa",
)


def mean_cosine(
    kappa: Float[np.ndarray, " N"],
) -> tuple[np.ndarray, np.ndarray]:
    """Mean cosine coth k - 1/k and one minus it, by a continued fraction.

    ``k / (3 + k^2 / (5 + k^2 / (7 + ...)))``: no term cancels.
    """
    k = np.asarray(kappa, np.longdouble)
    low = np.minimum(k, 8)
    fraction = np.full_like(low, 81)
    for odd in range(79, 1, -2):
        fraction = odd + low**2 / fraction
    rest = 1 / k + 2 * np.exp(-2 * k) / np.expm1(-2 * k)
    value = np.where(k < 8, low / fraction, 1 - rest)
    return value, np.where(k < 8, 1 - value, rest)


def _from_value(value: Float[Array, "..."], _: Float[Array, "..."]) -> Float[Array, "..."]:
    """The inverse without the digits that one minus the mean cosine keeps."""
    return inverse_langevin(value, 1.0 - value)


def _concentrations(quick: bool) -> list[Case]:
    """Concentration of a mean cosine: Newton's method, and the rational form it starts from."""
    forms = {
        "exact": inverse_langevin,
        "exact, of R alone": _from_value,
        "Banerjee": pade_inverse_langevin,
    }

    def case(kappa, form):
        # Up to the next of the full study.
        given = kappa * 10.0 ** np.linspace(0.0, 0.5, _COUNT)

        def build():
            pair = tuple(jnp.asarray(a, "float32") for a in mean_cosine(given))
            return Job(forms[form], pair, judge)

        def judge(value):
            off = np.asarray(value, np.float64) - given
            at = int(np.abs(off / given).argmax())
            return float(abs(off[at] / given[at])), (
                f"{off[at] / given[at]:+.3g} at {given[at]:.3g}; mean absolute {off.mean():+.3g}"
            )

        return Case({"kappa": kappa, "form": form}, "float32", build, program=form)

    exponents = (-2.0, 0.5, 2.0, 6.0) if quick else np.arange(-2.0, 6.1, 0.5)
    return [case(float(f"{10.0**e:.3g}"), form) for e in exponents for form in forms]


CONCENTRATION = Study(
    name="lobes.concentration",
    quantity="concentration of a mean cosine R, largest relative error up to 3.16 "
    f"kappa; {_COUNT:,} values",
    reference="the concentration that the mean cosine was made of, in 80 bits",
    cases=_concentrations,
    conditions=("kappa",),
    against="kappa",
)
