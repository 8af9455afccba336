"""Cards of fits: parameters with their errors, what the data tell, and the fitted surface."""

import dataclasses
import math

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import reflectance_cases
from preview_cases import like, none, parts
from reflectance_cases import REACH, disc

import diffopt as do
from diffopt import brdf_lobes, fitting
from diffopt.fitting.freeform.result import HeightsFit
from diffopt.fitting.lobe_table import LobeComparison
from diffopt.fitting.lobe_table import Row as LobeRow
from diffopt.fitting.lobes import LobeFit
from diffopt.fitting.reflectance.answers import Minimum, ReflectanceFit
from diffopt.fitting.scans.fit import ScanFit
from diffopt.gratings import Roughness, Sinusoidal

WAVELENGTHS = np.linspace(0.42, 0.68, 3)
GRATING = Sinusoidal(2.3, 0.09, 0.0, 0.6)
# Ends of the colour map of heights.
LOW, HIGH = (0, 34, 78), (253, 231, 55)


def ranked(name, difference, **changes):
    one = fitting.Ranked(
        name, difference - 50.0, difference, 4, 0.01, True, "It ended <well> & so."
    )
    return dataclasses.replace(one, **changes)


def reflectance_fit(**changes):
    names = ("period", "amplitude", "angle")
    found = ReflectanceFit(
        model=GRATING,
        names=names,
        covariance=np.diag([0.0012, np.inf, 0.0005]) ** 2,
        gain=1.0,
        loss=0.105,
        chi2=0.987,
        converged=False,
        reason="The amplitude & the <gain> are not told apart.",
        identifiable={"period": "determined", "amplitude": "It is <tied> to the gain."},
        minima=(Minimum({"period": 2.3}, 0.1, 7), Minimum({"period": 4.6}, 0.4, 5)),
        steps=17,
        values=np.ones((4, 3)),
        curves={},
        criterion=12.0,
        interrupted=False,
        reach=REACH,
        ranking=(ranked("sinusoidal", 0.0), ranked("blazed", 31.5)),
    )
    return dataclasses.replace(found, **changes)


def scan_fit(model, names, **changes):
    fields = {
        "model": model,
        "names": names,
        "covariance": np.diag([0.004**2] * len(names)),
        "tilt": (0.01, -0.02),
        "lines": np.zeros(8),
        "residual": jnp.full((8, 8), 0.003),
        "noise": {"white": 0.0021, "length": 0.4, "lines": 0.0},
        "ranking": (),
        "converged": True,
        "reason": "Least squares came to an end.",
        "identifiable": dict.fromkeys(names, "determined"),
        "goodness": 0.9876,
        "curves": {},
    }
    return ScanFit(**(fields | changes))


def test_reflectance_fit():
    found = parts(reflectance_fit())
    expected = (
        "ReflectanceFit: Sinusoidal",
        "converged no",
        "0.987",
        "2, from 12 starts",
        "The amplitude & the <gain> are not told apart.",
        "period 2.3 0.0012 µm determined",
        "amplitude 0.09 ∞ µm It is <tied> to the gain.",
        "angle 0.6 0.0005 rad determined",
        "phase 0 — rad not fitted",
        "blazed 31.5",
    )
    for words in expected:
        assert words in found.text, words
    assert "<tied>" not in found.html
    (picture,) = found.pictures
    # Back from colours to heights: those of a sinusoid have a standard deviation of 1 / sqrt(8)
    # of peak-to-valley (even ones 1 / sqrt(12) = 0.29), whole periods or not to 5 %.
    scale = np.asarray(matplotlib.colormaps["cividis"].colors) * 255.0
    left = picture[::4, : picture.shape[1] // 2 : 4].astype(float)
    near = np.stack([np.abs(left - colour).max(-1) for colour in scale])
    heights = near.argmin(0)[near.min(0) < 2.0] / 255.0
    assert heights.mean() == pytest.approx(0.5, abs=0.03)
    assert heights.std() == pytest.approx(8.0**-0.5, rel=0.05)
    nothing = reflectance_fit(chi2=None, ranking=(), identifiable={})
    assert "noise not known" in parts(nothing).text
    lost = reflectance_fit(
        model=Sinusoidal(2.3, jnp.float64(0.09)).replaced({"amplitude": jnp.nan})
    )
    assert "heights are not finite" in none(lost)


@pytest.mark.long
def test_a_fit_to_simulated_reflectance(rng):
    data = reflectance_cases.simulated(GRATING, rng, disc(11), WAVELENGTHS)
    fit = fitting.fit_reflectance(data, Sinusoidal(2.29, 0.088, 0.0, 0.6))
    found = parts(fit)
    for name in fit.names:
        assert f"{name} {float(fit.model.get(name)):.6g}" in found.text
    assert fit.reason in found.text


def test_scan_fit():
    found = parts(scan_fit(GRATING, ("period", "amplitude")))
    for words in ("ScanFit: Sinusoidal", "converged yes", "98.76 %", "rms of the residual 3 nm",
                  "white 2.1 nm", "0.01, −0.02", "period 2.3 0.004 µm determined"):  # fmt: skip
        assert words in found.text, words
    assert "length" not in found.text  # the noise's other figures are no rms
    rough = scan_fit(
        Roughness(0.05, 0.4),
        ("rms", "length"),
        ranking=tuple(ranked(f"m{k}", float(k)) for k in range(12)),
        covariance=np.full((2, 2), np.nan),
    )
    found = parts(rough)
    assert "one draw" in found.text
    assert "The best 9 of 12 models" in found.text
    assert "unknown" in found.text


def test_heights_fit():
    heights = np.zeros((20, 20))
    heights[:, :5] = 0.1
    fit = HeightsFit(
        heightfield=do.Heightfield(heights, 0.1),
        loss=3.0,
        misfit={"relative": 0.0432, "chi2": 1.07},
        gain=1.0,
        weight=0.25,
        steps=40,
        converged=True,
        reason="The minimum was <reached>.",
        history=(100.0, 10.0, 3.0),
        values=jnp.ones((3, 2)),
        error_map=jnp.full((20, 20), 0.0031),
    )
    found = parts(fit)
    for words in ("0.0432", "1.07", "The minimum was <reached>.", "3.1 nm, median",
                  f"{1000 * heights.std():.4g} nm"):  # fmt: skip
        assert words in found.text, words
    high, low = (like(found.pictures[0], colour, 12).sum() for colour in (HIGH, LOW))
    # The colour bar has both.
    assert high / low == pytest.approx(1.0 / 3.0, rel=0.15)


def test_profile():
    values = np.linspace(1.0, 3.0, 41)
    loss = 0.1 * np.sqrt(1.0 + 4.0 * (values - 2.2) ** 2)
    chi2 = ((values - 2.2) / 0.12) ** 2
    found = parts(fitting.Profile("period", values, loss, chi2, {"depth": values}))
    for words in ("Profile over period", "41, 1 to 3", "0.1 at 2.2", "2.1 to 2.3"):
        assert words in found.text, words
    # The curve falls and rises: it is lowest near 60 % of the axis.
    (picture,) = found.pictures
    rows, columns = np.nonzero(like(picture, (31, 119, 180), 30))
    lowest = columns[rows > rows.max() - 6].mean() / picture.shape[1]
    assert lowest == pytest.approx(0.62, abs=0.06)
    assert "no loss is finite" in none(
        fitting.Profile("period", values, np.full(41, np.nan), None, {})
    )


def test_ranked():
    found = parts(ranked("a<b", 3.25, converged=False))
    assert "Ranked: a<b" in found.text
    assert "3.25 −46.75 4 0.01 no It ended <well> & so." in found.text
    assert "∞" in parts(ranked("x", math.inf)).text


@pytest.mark.parametrize("quantity", ["spectral", "xyz"])
def test_measured(quantity, rng):
    wo = disc(9)
    count = 3 if quantity == "xyz" else 4
    values = rng.uniform(0.5, 2.0, (len(wo), count))
    wi = np.array([math.sin(0.3), 0.0, math.cos(0.3)])
    lam = None if quantity == "xyz" else np.linspace(0.42, 0.68, 4)
    data = fitting.Measured(wi, wo, lam, values, 1.5, quantity=quantity, noise=0.02)
    found = parts(data)
    steepest = np.degrees(np.arccos(wo[:, 2])).max()
    for words in (f"{len(wo)} pairs of directions × {count} channels", quantity, "1, 17.19°",
                  f"0 to {steepest:.4g}°", "known up to a factor only", "1.5 µm",
                  f"{0.02 / values.max():.3g} of the largest value"):  # fmt: skip
        assert words in found.text, words
    assert ("380 to 780 nm" if quantity == "xyz" else "420 to 680 nm") in found.text
    # The light's star is red, right of the middle.
    (picture,) = found.pictures
    assert like(picture, (214, 39, 40), 30).sum() > 50


def lobe_fit(shape, brdf=None, count=2):
    mu = np.broadcast_to([0.6, 0.0, 0.8], (*shape, count, 3))
    lobes = do.Lobes(np.full((*shape, count), 0.4), mu, np.full((*shape, count), 30.0))
    error = jnp.linspace(0.01, 0.05, math.prod(shape)).reshape(shape)
    full = jnp.ones(shape)
    return LobeFit(
        lobes,
        error,
        1e-3 * full,
        jnp.full(shape, 25),
        full > 0,
        fitting.LobeSettings(),
        "em+lm",
        brdf,
    )


def test_lobe_fits():
    found = parts(lobe_fit(()))
    for words in ("LobeFit: 2 lobes", "relative L2 error 0.01", "method em+lm", "steps 25",
                  "settled yes", "36.9°", "κ"):  # fmt: skip
        assert words in found.text, words
    many = parts(lobe_fit((2, 3)))
    assert "each of 2×3 functions" in many.text
    assert "0.03 (0.01 to 0.05)" in many.text
    assert "function 5, the one with the largest error" in many.text
    views, faces = brdf_lobes.icosahedral_views(0)
    fit = lobe_fit((8,))
    whole = parts(lobe_fit((8,), do.BRDFLobes(views, faces, fit.lobes)))
    assert "LobeFit: 2 lobes at each of 8 views" in whole.text
    assert "0.03 (0.01 to 0.05)" in whole.text


def test_a_comparison_of_lobe_fits():
    rows = (
        LobeRow("em", 2, "float32", 0.123, 0.2, 0.0, 1.0, time_s=1e-4, single_s=2e-3),
        LobeRow("em+lm", 2, "float32", 0.0456, 0.1, 0.0, 1.0, time_s=2e-4, note="<settings>"),
    )
    found = parts(LobeComparison(rows, "a <job>"))
    for words in ("Lobes on a <job>", "0.1230", "0.0456", "100 us", "2 ms", "<settings>"):
        assert words in found.text, words
