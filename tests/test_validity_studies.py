"""The scalar models fail where they should, and Stam's prefactor is what makes them good."""

import pytest

import diffopt as do


@pytest.mark.slow
def test_scalar_study_shows_where_the_model_fails(tmp_path):
    result = do.study("diffraction.scalar").run(quick=True, repeats=1)
    error = {
        (
            r.settings["period_wavelengths"],
            r.settings["amplitude_wavelengths"],
            r.settings["prefactor"],
        ): r.error
        for r in result.rows
    }
    # Published with the model: 11 % (sum of orders 1.10) at d = 2.1 and a = 0.2 wavelengths
    # (relative to the order; 4.6 % of the incident power), below 5e-4 at d = 5 wavelengths.
    assert 0.03 < error[2.1, 0.2, "stam"] < 0.06
    assert error[5.1, 0.05, "stam"] < 5e-4
    assert error[5.1, 0.2, "stam"] < 5e-4
    # Without the square of the half-vector factor the error is tens of times larger.
    assert error[5.1, 0.2, "rghs"] > 5 * error[5.1, 0.2, "stam"]
    figure = result.plot(tmp_path / "scalar.png")
    assert [len(axes.lines) for axes in figure.axes] == [2, 2]  # two periods, two models
    assert (tmp_path / "scalar.png").stat().st_size > 10_000
    deep = next(r for r in result.rows if r.settings["period_wavelengths"] == 2.1)
    assert "polarisations differ by" in deep.note
