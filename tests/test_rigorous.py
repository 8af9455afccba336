"""The rigorous sinusoid against reference efficiencies and the conservation of energy."""

import numpy as np
import pytest

from diffopt import InputError, rigorous
from reference import cases


@pytest.mark.parametrize("case", cases("rigorous_PEC"), ids=lambda c: c["id"])
def test_against_reference(case):
    got = rigorous.sinusoid(case["d_um"], case["a_um"], case["lambda_um"], case["theta_rad"])
    for name, values in (("effTE", got.te), ("effTM", got.tm), ("eff", got.unpolarised)):
        found = dict(zip(got.orders.tolist(), values, strict=True))
        expected = {int(m): e for m, e in case[name].items()}
        assert expected.keys() <= found.keys()
        # Both truncate their orders: agreement to the conditioning of the system, which is
        # worst at the slope of 0.6 of the last case.
        tolerance = 1e-8 if case["a_um"] / case["d_um"] < 0.05 else 1e-5
        np.testing.assert_allclose(
            [found[m] for m in expected], list(expected.values()), atol=tolerance
        )


@pytest.mark.parametrize("depth", [0.0, 0.02, 0.06])
@pytest.mark.parametrize("theta", [0.0, 0.5])
def test_energy_is_conserved(depth, theta):
    got = rigorous.sinusoid(2.3, depth * 2.3, 0.55, theta)
    assert got.te.sum() == pytest.approx(1.0, abs=1e-7)
    assert got.tm.sum() == pytest.approx(1.0, abs=1e-7)
    if depth == 0.0:
        assert float(got.te[got.orders == 0][0]) == pytest.approx(1.0, abs=1e-12)


def test_too_steep_is_refused():
    with pytest.raises(
        InputError, match=r"slope of 1.88: the Rayleigh-Fourier method is good up to 0.62"
    ):
        rigorous.sinusoid(1.0, 0.3, 0.5)
