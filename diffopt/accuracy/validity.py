"""Study of the scalar models against rigorous optics: where they fail, and which one least."""

import jax.numpy as jnp
import numpy as np

from diffopt import rigorous
from diffopt.accuracy.studies import Case, Job, Study
from diffopt.diffraction import DiffractionBRDF, evaluate
from diffopt.heightfield import Heightfield
from diffopt.kernels.prefactor import NAMES as PREFACTORS
from diffopt.settings import DirectSettings

WAVELENGTH = 0.5
# Samples of a period: the rectangle rule over a smooth period is exact to rounding, and
# central differences (Kirchhoff's facets) err by (2 pi / samples)^2 / 6 = 1e-4.
SAMPLES = 256


def _orders(period: float, theta: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Propagating orders within 75 degrees, and their directions."""
    wi = np.array([-np.sin(theta), 0.0, np.cos(theta)])
    orders = np.arange(-100, 101)
    sine = orders * WAVELENGTH / period - wi[0]
    kept = np.abs(sine) < np.sin(np.radians(75.0))
    sine = sine[kept]
    wo = np.stack([sine, 0.0 * sine, np.sqrt(1.0 - sine**2)], -1)
    return orders[kept], wi, wo


def _scalar(quick: bool) -> list[Case]:
    periods = (2.1, 5.1) if quick else (2.1, 5.1, 10.1)
    amplitudes = (0.05, 0.2) if quick else (0.02, 0.05, 0.1, 0.2, 0.3, 0.5)
    models = ("stam", "rghs") if quick else PREFACTORS

    def case(period, amplitude, angle, model):
        d, a, theta = period * WAVELENGTH, amplitude * WAVELENGTH, np.radians(angle)

        def build():
            orders, wi, wo = _orders(d, theta)
            x = (np.arange(SAMPLES) - SAMPLES // 2) / SAMPLES
            heights = np.broadcast_to(a * np.cos(2.0 * np.pi * x), (2, SAMPLES))
            scan = Heightfield(jnp.asarray(heights, "float64"), (d / SAMPLES, d / SAMPLES))
            brdf = DiffractionBRDF(scan, None, prefactor=model)
            exact = rigorous.sinusoid(d, a, WAVELENGTH, theta)
            right = dict(zip(exact.orders.tolist(), exact.unpolarised, strict=True))
            polarised = float(np.abs(exact.te - exact.tm).max())

            def efficiencies(brdf, wo):
                rho = evaluate(
                    brdf, wi, wo, np.array([WAVELENGTH]), DirectSettings(), output="relative"
                )
                return rho[:, 0] / np.cos(theta)

            def judge(value):
                value = np.asarray(value)
                error = np.abs(value - [right[m] for m in orders.tolist()])
                return float(error.max()), (
                    f"orders within 75 degrees sum to {value.sum():.3f}; "
                    f"polarisations differ by {polarised:.1e}"
                )

            return Job(efficiencies, (brdf, jnp.asarray(wo)), judge)

        settings = {
            "period_wavelengths": period,
            "amplitude_wavelengths": amplitude,
            "incidence_deg": angle,
            "prefactor": model,
        }
        # Amplitudes differ in the heights only: one compilation serves them all.
        return Case(settings, "float64", build, (period, angle, model))

    return [
        case(period, amplitude, angle, model)
        for period in periods
        for amplitude in amplitudes
        if 2.0 * np.pi * amplitude / period < rigorous.LARGEST_SLOPE
        for angle in ((0.0,) if quick else (0.0, 30.0))
        for model in models
    ]


SCALAR = Study(
    name="diffraction.scalar",
    quantity="scalar models of a conducting sinusoid, largest error of an order's efficiency "
    "(unpolarised, orders within 75 degrees)",
    reference="the Rayleigh-Fourier method (diffopt.rigorous)",
    cases=_scalar,
    conditions=("period_wavelengths", "amplitude_wavelengths", "incidence_deg"),
    against="amplitude_wavelengths",
)
