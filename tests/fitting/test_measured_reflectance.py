"""Measured reflectance: what is refused, and how."""

import numpy as np
import pytest

from diffopt import fitting
from diffopt.errors import InputError

WAVELENGTHS = np.array([0.45, 0.6])
SIGMA = 2.0
ANGLES = np.radians(np.linspace(-70.0, 70.0, 61))


def plane(angles):
    return np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)


WI, WO = plane(np.radians(10.0)), plane(ANGLES)


class TestRefusals:
    def test_shapes(self):
        values = np.ones((61, 2))
        with pytest.raises(InputError, match=r"values must be \[M, L\] with L = 2 .*\(61, 3\)"):
            fitting.Measured(WI, WO, WAVELENGTHS, np.ones((61, 3)), SIGMA)
        with pytest.raises(InputError, match=r"wo must be \[3\] or \[M, 3\] with the M = 61"):
            fitting.Measured(WI, WO[:5], WAVELENGTHS, values, SIGMA)
        with pytest.raises(InputError, match="wi must be unit vectors"):
            fitting.Measured(2 * WI, WO, WAVELENGTHS, values, SIGMA)
        with pytest.raises(InputError, match="noise must be one number or as values"):
            fitting.Measured(WI, WO, WAVELENGTHS, values, SIGMA, noise=np.ones(2))

    def test_values(self):
        values = np.ones((61, 2))
        cases = (
            ({"wi": -WI}, "wi must lie above the horizon"),
            ({"values": np.full((61, 2), np.nan)}, "values must be finite"),
            ({"values": 0 * values}, "values must be finite, not all 0"),
            ({"values": np.ones((61, 2), int)}, "values must be floating-point"),
            ({"coherence": 0.0}, "coherence must be one length > 0; received 0"),
            ({"wavelengths": 1000 * WAVELENGTHS}, "nanometres"),
            ({"noise": 0 * values}, "noise must be positive"),
        )
        good = {
            "wi": WI,
            "wo": WO,
            "wavelengths": WAVELENGTHS,
            "values": values,
            "coherence": SIGMA,
        }
        for change, text in cases:
            with pytest.raises(InputError, match=text):
                fitting.Measured(**(good | change))
