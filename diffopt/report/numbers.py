"""Sections of numbers: lobes, a grating found again, accuracy against time, hard cases."""

import statistics
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import diffopt as do
from diffopt import gratings
from diffopt.fitting import LobeFit, LobeSettings, Measured, fit_heightfield, fit_lobes
from diffopt.kernels import langevin, vmf
from diffopt.previews import markup, studies
from diffopt.report.page import Section

#: Studies that are run for the page: quick, and of different kinds.
STUDIES = ("diffraction.wavelengths", "lobes.distance", "shadow.bands")
_LOBES = (1, 2, 4, 8)


def lobes() -> Section:
    """Blinn-Phong in lobes, by expectation maximisation and by least squares."""
    from diffopt.fitting import previews as cards

    material, wo = do.BlinnPhong(exponent=64.0), [0.5, 0.0, 0.866025]
    rows, last = [], None
    for count in _LOBES:
        for name, method, settings in (
            ("EM, 50 steps", "em", LobeSettings(em_steps=50)),
            ("EM, then least squares", "em+lm", LobeSettings()),
        ):

            def fit(method: Any = method, settings: Any = settings, count: int = count) -> LobeFit:
                found = fit_lobes(material, count, wo=wo, method=method, settings=settings)
                jax.block_until_ready(found.lobes.arrays)
                return found

            found, seconds = _timed(fit)
            rows.append(
                (str(count), name, f"{100 * float(found.error):.2g} %", f"{1e3 * seconds:.2g} ms")
            )
            last = found
    assert last is not None
    return Section(
        "lobes",
        "A BRDF as a few lobes",
        "A slice of Blinn-Phong (exponent 64, seen at 30 degrees) as von Mises-Fisher lobes: "
        "relative L2 error, and the time of one fit without compilation. Expectation maximisation "
        "fits likelihood; the least squares that follow it fit what is measured here.",
        (
            markup.table(("lobes", "method", "error", "time"), rows),
            cards.lobe_card(last),
        ),
        "diffopt fit lobes blinn-phong --exponent 64 --lobes 4 --angle 0,30,60 -o out/lobes",
    )


def surface() -> Section:
    """A binary grating, seen with noise and found again."""
    from diffopt.fitting import previews as cards

    wavelengths = np.linspace(0.42, 0.68, 7)
    x, y = np.meshgrid(*2 * [np.linspace(-0.9, 0.9, 31)])
    inside = np.hypot(x, y) < 0.9
    wo = np.stack([x[inside], y[inside], np.sqrt(1 - x[inside] ** 2 - y[inside] ** 2)], -1)
    wi = np.array([0.17, 0.0, np.sqrt(1 - 0.17**2)])
    true = gratings.Binary(period=2.6, depth=0.2, duty=0.3, angle=0.6)
    f = np.asarray(
        gratings.brdf(
            true,
            jnp.asarray(np.broadcast_to(wi, wo.shape), jnp.float32),
            jnp.asarray(wo, jnp.float32),
            jnp.asarray(wavelengths, jnp.float32),
            jnp.float32(2.0),
            reach=gratings.Reach(6, 48),
        )
    )
    noise = 0.02 * f + 1e-3 * f.max()
    seen = f + noise * np.random.default_rng(0).normal(size=f.shape).astype(np.float32)
    data = Measured(wi, wo, wavelengths, seen, 2.0, noise=noise, noise_known=True)
    begun = time.perf_counter()
    found: Any = fit_heightfield(data, "binary")
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    found = fit_heightfield(data, "binary")
    again = time.perf_counter() - begun
    rows = []
    for name in ("period", "depth", "duty", "angle"):
        value, error = float(getattr(found.model, name)), float(found.errors[name])
        wanted = float(getattr(true, name))
        off = abs(value - wanted) / max(error, 1e-30)
        rows.append((name, f"{wanted:g}", f"{value:.5g}", f"{error:.1g}", f"{off:.1f}"))
    columns = ("parameter", "true", "found", "standard error", "off by standard errors")
    return Section(
        "surface",
        "Back to the surface",
        f"A binary grating (lengths in micrometres, angle in radians) is seen at {len(wo)} "
        f"directions and {len(wavelengths)} wavelengths with 2 % noise; period, depth, duty and "
        f"angle come from these data alone: {again:.2f} s, the first time {first:.1f} s with "
        "compilation.",
        (markup.table(columns, rows), cards.reflectance_card(found)),
        "diffopt fit heightfield docs/examples/grating_reflectance.csv --model binary",
    )


def accuracy(names: tuple[str, ...] = STUDIES) -> Section:
    """Some studies, quick."""
    parts = []
    for name in names:
        found = do.study(name).run(quick=True)
        parts.append(studies.card(found))
    return Section(
        "accuracy",
        "What accuracy costs",
        "Each approximation is measured against a trusted reference: error against time, with the "
        "settings on the points of the front. Below a few of the studies on few and small cases; "
        "the command runs all of them.",
        tuple(parts),
        "diffopt accuracy -o out/accuracy\ndiffopt compare diffraction sample:compact_disc",
    )


def stability() -> Section:
    """Formulas as they stand in papers, and as they are computed here, both in float32."""
    rows = []
    for what, argument, naive, ours, exact in _cases():
        value, slope = (_said(naive, x, exact) for x in (0, 1))
        mine, rise = (_said(ours, x, exact) for x in (0, 1))
        rows.append((what, argument, value, mine, slope, rise))
    columns = (
        "quantity",
        "at",
        "error as written",
        "error here",
        "derivative as written",
        "derivative here",
    )
    return Section(
        "stability",
        "Hard cases in float32",
        "Relative errors of values and derivatives, against float64 formulas without cancellation.",
        (markup.table(columns, rows),),
    )


Function = Callable[[Any], Any]


def _cases() -> list[tuple[str, str, tuple[Any, Any], tuple[Any, Any], tuple[float, float]]]:
    """Name, argument, (value, derivative) of the naive formula and of ours, and exact ones."""

    def naive_peak(kappa: Any) -> Any:
        return kappa / (4.0 * jnp.pi * jnp.sinh(kappa)) * jnp.exp(kappa)

    def ours_peak(kappa: Any) -> Any:
        up = jnp.array([0.0, 0.0, 1.0], jnp.float32)
        return vmf.pdf(up, up, kappa)

    def naive_mean(kappa: Any) -> Any:
        return 1.0 / jnp.tanh(kappa) - 1.0 / kappa

    found = []
    for kappa in (1e-4, 1.0, 1e2, 1e6):
        exact = _peak(kappa)
        found.append(
            (
                "peak of a von Mises-Fisher lobe",
                f"κ = {kappa:g}",
                _both(naive_peak, kappa),
                _both(ours_peak, kappa),
                exact,
            )
        )
    for kappa in (1e-4, 1e-2, 1.0, 1e6):
        exact = _mean(kappa)
        found.append(
            (
                "its mean cosine",
                f"κ = {kappa:g}",
                _both(naive_mean, kappa),
                _both(langevin.langevin, kappa),
                exact,
            )
        )
    return found


def _both(function: Function, at: float) -> tuple[Any, Any]:
    value, slope = jax.jit(jax.value_and_grad(function))(jnp.float32(at))
    return float(value), float(slope)


def _peak(kappa: float) -> tuple[float, float]:
    """Kappa / (2 pi (1 - exp(-2 kappa))), and its derivative, float64."""
    k = float(np.float32(kappa))
    q = -np.expm1(-2.0 * k)
    value = k / (2.0 * np.pi * q)
    if k < 1e-2:  # by the series of x / (1 - exp(-x)) = 1 + x / 2 + x^2 / 12 at x = 2 k
        return value, (1.0 + 2.0 * k / 3.0) / (4.0 * np.pi)
    return value, (q - 2.0 * k * np.exp(-2.0 * k)) / (2.0 * np.pi * q * q)


def _mean(kappa: float) -> tuple[float, float]:
    """coth(kappa) - 1 / kappa, by its series for small ones, and the derivative, float64."""
    k = float(np.float32(kappa))
    if k < 0.05:
        return k / 3.0 - k**3 / 45.0 + 2.0 * k**5 / 945.0, 1.0 / 3.0 - k * k / 15.0 + 2 * k**4 / 189
    sinh = np.sinh(min(k, 300.0))
    return 1.0 / np.tanh(k) - 1.0 / k, 1.0 / k**2 - (1.0 / sinh**2 if k < 300.0 else 0.0)


def _said(found: tuple[Any, Any], which: int, exact: tuple[float, float]) -> str:
    value, wanted = found[which], exact[which]
    if not np.isfinite(value):
        return "NaN" if np.isnan(value) else "∞"
    return f"{abs(value - wanted) / abs(wanted):.1e}"


def _timed(function: Callable[[], Any], repeats: int = 5) -> tuple[Any, float]:
    """Result and median seconds, after one call that compiles."""
    found, spent = function(), []
    for _ in range(repeats):
        begun = time.perf_counter()
        found = function()
        spent.append(time.perf_counter() - begun)
    return found, statistics.median(spent)
