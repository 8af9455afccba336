"""Parts of fits to scans: derivatives, conventions, registration, likelihood, recompilation."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffopt.fitting.scans import codes as scan_codes
from diffopt.fitting.scans import noise as scan_noise
from diffopt.fitting.scans import register as scan_register
from diffopt.fitting.scans import squares as scan_squares
from diffopt.fitting.scans.convention import canonical
from diffopt.gratings import Binary, Blazed, Crossed, Ridges, Roughness, Sinusoidal, Trapezoid

SHAPE, PIXEL = (40, 48), (0.05, 0.06)
Y, X = (jnp.asarray((np.arange(n) - n // 2) * d) for n, d in zip(SHAPE, PIXEL, strict=True))
GRATINGS = [
    Sinusoidal(0.83, -0.05, 1.1, 2.0),
    Binary(0.83, -0.1, 0.35, 0.3, -2.0),
    Blazed(0.83, -0.1, 0.3, 2.2),
    Trapezoid(0.83, -0.1, 0.4, 0.6, 0.3, 3.0),
]
CROSSED = Crossed(GRATINGS[1], Sinusoidal(0.6, 0.03, 0.2, 0.3))


@pytest.mark.parametrize("surface", [*GRATINGS, CROSSED], ids=lambda s: s.title)
def test_rows_are_the_derivatives_of_residuals(surface, rng):
    names = scan_codes.free(surface)
    u = jnp.asarray(scan_codes.encoded(surface, names, 0.05))
    pixels = scan_squares.Pixels(
        heights=jnp.asarray(rng.normal(size=SHAPE)),
        weight=jnp.asarray((rng.uniform(size=SHAPE) > 0.1) * rng.uniform(0.5, 1.0, SHAPE)),
        precision=jnp.asarray(3.0),
        y=Y,
        x=X,
        scale=jnp.asarray(0.05),
    )

    def at(v):
        return scan_squares.residuals(v, pixels, surface, names, PIXEL, "averaged")

    _, rows = at(u)
    for k, row in enumerate(np.asarray(rows)):
        step = jnp.zeros_like(u).at[k].set(1e-6)
        central = (np.asarray(at(u + step)[0]) - np.asarray(at(u - step)[0])) / 2e-6
        # Means over pixels have kinks where an edge passes a pixel's border: there, and only
        # there, a difference over 2e-6 is not the derivative.
        close = np.abs(central - row) < 1e-6 * max(np.abs(row).max(), 1.0)
        assert close.mean() > 0.995


def test_projection_leaves_nothing_of_plane_and_lines(rng):
    pixels = scan_squares.Pixels(
        heights=jnp.zeros(SHAPE),
        weight=jnp.asarray(rng.uniform(size=SHAPE)),
        precision=jnp.asarray(1e-9),
        y=Y,
        x=X,
        scale=jnp.asarray(1.0),
    )
    made = 0.3 + 0.1 * Y[:, None] - 0.2 * X[None, :] + jnp.asarray(rng.normal(size=(SHAPE[0], 1)))
    rest, _, _ = scan_squares.project(made, pixels)
    # Precision 1e-9 of lines against weights of 20: they are free but for 1e-10.
    assert np.abs(np.asarray(rest)).max() < 1e-6


@pytest.mark.parametrize("grating", GRATINGS, ids=lambda s: s.title)
def test_conventions_keep_the_heights(grating):
    values, change = canonical(grating)
    same = grating.replaced(values)
    before, after = (
        np.asarray(scan_codes.field(s, Y, X, PIXEL, "averaged")) for s in (grating, same)
    )
    # Rounding of turns: some 1e-15 of heights of 0.1.
    np.testing.assert_allclose(after, before, atol=1e-13)
    height = "amplitude" if isinstance(grating, Sinusoidal) else "depth"
    assert values[height] > 0
    assert -math.pi / 2 < values["angle"] <= math.pi or isinstance(grating, Blazed)
    assert 0 <= values.get("shift", 0.0) < 1
    # The derivatives of the change, against differences.
    for name in grating.PARAMETERS:
        moved, _ = canonical(grating.replaced({name: grating.get(name) + 1e-6}))
        for other in grating.PARAMETERS:
            slope = change.get(other, {other: 1.0}).get(name, 0.0)
            assert (moved[other] - values[other]) / 1e-6 == pytest.approx(slope, abs=1e-6)


def test_wave_vectors_between_samples_of_the_spectrum(rng):
    y, x = (np.asarray(a) for a in (Y, X))
    true = np.array([1.31, 2.17])
    h = np.cos(2 * np.pi * (true[0] * y[:, None] + true[1] * x[None, :]))
    scan = scan_register.prepared(h + 0.05 * rng.normal(size=SHAPE), PIXEL)
    found = np.array(scan_register.wave_vectors(scan)[0])
    # A sample is 0.5 and 0.35 cycles/um wide.
    np.testing.assert_allclose(found, true, atol=0.03)


def test_spikes_are_found_and_corners_are_not(rng):
    h = np.asarray(Binary(0.9, 0.1, 0.5, 0.0, 0.3).heights(SHAPE, PIXEL))
    h = h + 0.002 * rng.normal(size=SHAPE)
    h[5, 7] += 0.3
    h[20, 30] -= 0.3
    scan = scan_register.prepared(h, PIXEL)
    assert set(zip(*np.nonzero(~scan.known), strict=True)) == {(5, 7), (20, 30)}
    assert abs(scan.heights[5, 7]) < 0.15


@pytest.mark.parametrize(
    "surface",
    [Roughness(0.03, 0.15), Ridges(Sinusoidal(0.5, 0.04, 0.0, 0.6), 0.04, 0.4)],
    ids=lambda s: s.title,
)
def test_covariance_is_that_of_drawn_heights(surface):
    draws = [np.asarray(surface.heights((64, 64), 0.05, key=jax.random.key(k))) for k in range(200)]
    y, x = jnp.asarray([0.0, 0.1, 0.25]), jnp.asarray([0.0, 0.15, 0.3])
    expected = np.asarray(scan_noise.surface_covariance(surface, y, x, jnp.asarray(1.0)))
    for j, lag_y in enumerate((0, 2, 5)):
        for i, lag_x in enumerate((0, 3, 6)):
            found = np.mean([(d[: 64 - lag_y, : 64 - lag_x] * d[lag_y:, lag_x:]) for d in draws])
            # Some 50 independent patches a draw: 1 / sqrt(200 50) = 1 %, and twice that for
            # ridges, of which a draw has fewer; the limit in kappa adds 1e-4.
            assert found == pytest.approx(expected[j, i], abs=0.05 * expected[0, 0])


def test_likelihood_recovers_the_noise(rng):
    rough = np.asarray(Roughness(0.02, 0.3).heights((96, 96), 0.05, key=jax.random.key(3)))
    h = rough + 0.01 * rng.normal(size=rough.shape) + 0.008 * rng.normal(size=(96, 1))
    scan = scan_register.prepared(h, (0.05, 0.05))
    found = scan_noise.fit(scan.flat, scan, None, drift=True, dtype=jnp.float64)
    assert found.converged
    assert found.curve[-1] == found.deviance
    assert (np.diff(found.curve) <= 0).all()
    # 9,216 pixels; 96 lines: 7 %; some 80 patches: 11 %. Three of each.
    assert found.noise["white"] == pytest.approx(0.01, rel=0.04)
    assert found.noise["lines"] == pytest.approx(0.008, rel=0.25)
    assert found.noise["correlated"] == pytest.approx(0.02, rel=0.3)
    assert found.noise["length"] == pytest.approx(0.3, rel=0.35)


def test_a_second_scan_compiles_nothing(rng):
    def fit(seed):
        h = np.asarray(GRATINGS[0].heights(SHAPE, PIXEL)) + 0.001 * np.random.default_rng(
            seed
        ).normal(size=SHAPE)
        scan = scan_register.prepared(h, PIXEL)
        scan_squares.fit(
            scan,
            GRATINGS[0],
            drift=True,
            robust=True,
            edges="averaged",
            max_steps=50,
            dtype=jnp.float64,
        )
        scan_noise.fit(scan.flat, scan, None, drift=True, dtype=jnp.float64)

    fit(0)
    events = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, _, **kwargs: events.append(name) if "jaxpr_trace" in name else None
    )
    fit(1)
    assert not events
