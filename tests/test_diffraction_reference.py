"""The direct sum and the BRDF against 40-digit reference values and rigorous optics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffopt as do
from diffopt import fresnel
from diffopt.kernels import dtft, special
from reference import cases, diffraction, heights_of

HEIGHTFIELDS = cases("heightfield")
IDS = [c["id"] for c in HEIGHTFIELDS]


def evaluation(case, dtype):
    """(heights, q, axis factors) of the bare patch for one reference case."""
    spec = case["height"]
    heights = jnp.asarray(heights_of(spec), dtype)
    wave = -(np.asarray(case["wi"]) + np.asarray(case["wr"]))
    q = jnp.asarray(wave / case["lambda_um"], dtype)
    step = spec["T0_um"]
    ax = dtft.finite_axis(spec["nx"], step, q[0])
    ay = dtft.finite_axis(spec["ny"], step, q[1])
    return heights, q, ax, ay


def phase_turns(case):
    """Largest phase of a case in turns: its rounding is the conditioning of P."""
    spec = case["height"]
    wave = np.abs(np.asarray(case["wi"]) + np.asarray(case["wr"])) / case["lambda_um"]
    size = np.array([spec["nx"], spec["ny"]]) * spec["T0_um"] / 2
    return wave[2] * np.abs(heights_of(spec)).max() + wave[:2] @ size


@pytest.mark.parametrize("case", HEIGHTFIELDS, ids=IDS)
def test_transform_matches_reference(case, dtype):
    heights, q, ax, ay = evaluation(case, dtype)
    re, im = jax.jit(dtft.amplitude)(heights, q[2], ax, ay)
    square = jax.jit(dtft.coherent_intensity)(heights, q[2], ax, ay)
    out, n = case["out"], heights.size
    # float64: 1e-9 of N is asked. float32: the phases round by half an ulp of their turns,
    # 2 pi eps/2 per turn, on every sample (coherently at worst, through q itself).
    tolerance = 1e-9 if dtype == "float64" else 6e-8 * (4 + 2 * np.pi * phase_turns(case))
    assert abs(float(re) - float(out["P_re"]) / n) < tolerance
    assert abs(float(im) - float(out["P_im"]) / n) < tolerance
    # In float32 the square doubles the error of a bright direction.
    slack = tolerance if dtype == "float64" else 2 * tolerance
    assert abs(float(square) - float(out["P2"]) / n**2) < slack


@pytest.mark.parametrize(
    "case",
    [c for c in HEIGHTFIELDS if "dP2_dh_sum" in c["out"] or "dP2_dh" in c],
    ids=lambda c: c["id"],
)
def test_gradient_matches_reference(case, dtype):
    out, spec = case["out"], case["height"]
    heights, _, _, _ = evaluation(case, dtype)
    wave = jnp.asarray(-(np.asarray(case["wi"]) + np.asarray(case["wr"])), dtype)

    def square(heights, wavelength):
        q = wave / wavelength
        ax = dtft.finite_axis(spec["nx"], spec["T0_um"], q[0])
        ay = dtft.finite_axis(spec["ny"], spec["T0_um"], q[1])
        return dtft.coherent_intensity(heights, q[2], ax, ay)

    lam = jnp.asarray(case["lambda_um"], dtype)
    by_height, by_wavelength = jax.jit(jax.grad(square, (0, 1)))(heights, lam)
    n2 = heights.size**2
    # A height moves a phase by 2 pi s per micrometre; its gradient is at most
    # 2 (2 pi s) |P| g, so errors are compared with 2 (2 pi s) / N.
    scale = 4 * np.pi * abs(float(wave[2])) / case["lambda_um"] / heights.size
    eps = 1e-9 if dtype == "float64" else 6e-8 * (4 + 2 * np.pi * phase_turns(case))
    assert np.isfinite(np.asarray(by_height)).all()
    if "dP2_dh" in out:
        expected = np.array(out["dP2_dh"], float) / n2
        np.testing.assert_allclose(by_height, expected, atol=scale * eps, rtol=0)
    for place in out.get("dP2_dh_at", []):
        got = float(by_height[place["j"], place["i"]])
        assert abs(got - float(place["g"]) / n2) < scale * eps
    norm = float(out["dP2_dh_l2"]) / n2
    assert abs(float(jnp.linalg.norm(by_height)) - norm) < scale * eps * np.sqrt(heights.size)
    if out["dP2_dlambda"] is None:
        return
    # d/dlambda sums N phases: the phase itself multiplies its rounding.
    bound = 2 * (2 * np.pi * phase_turns(case)) / case["lambda_um"]
    assert abs(float(by_wavelength) - float(out["dP2_dlambda"]) / n2) < bound * eps


def brdf_of(case, dtype, **options):
    spec = case["height"]
    scan = do.Heightfield(jnp.asarray(heights_of(spec), dtype), pixel=spec["T0_um"])
    return do.DiffractionBRDF(scan, options.pop("coherence", None), **options)


@pytest.mark.parametrize(
    "case",
    [c for c in HEIGHTFIELDS if min(c["height"]["nx"], c["height"]["ny"]) > 1],
    ids=lambda c: c["id"],
)
def test_brdf_matches_reference(case, dtype):
    out = case["out"]
    brdf = brdf_of(case, dtype, fresnel=fresnel.Schlick(0.04))
    lam = np.array([case["lambda_um"]])
    f = float(brdf(case["wi"], case["wr"], lam)[0])
    rho = float(brdf.relative(case["wi"], case["wr"], lam)[0])
    scale_f = float(out["brdf_abs_schlick_noshadow"]) / float(out["P2_over_N2"])
    scale_rho = float(out["rho_peak_schlick_noshadow"]) / float(out["P2_over_N2"])
    expected_f = float(out["brdf_abs_schlick_noshadow"])
    expected_rho = float(out["rho_peak_schlick_noshadow"])
    if dtype == "float64":
        # At 89.9 degrees the cosine of the given vectors carries 6e-17 / 1.7e-3.
        assert f == pytest.approx(expected_f, abs=1e-9 * scale_f, rel=1e-9)
        assert rho == pytest.approx(expected_rho, abs=1e-9 * scale_rho, rel=1e-9)
    else:
        eps = 6e-8 * (8 + 4 * np.pi * phase_turns(case))
        assert abs(f - expected_f) < eps * scale_f
        assert abs(rho - expected_rho) < eps * scale_rho


def test_geometry_matches_reference(dtype):
    from diffopt.kernels import frames, prefactor

    tolerance = 1e-12 if dtype == "float64" else 2e-6  # a dozen operations
    for case in HEIGHTFIELDS:
        wi, wo = jnp.asarray(case["wi"], dtype), jnp.asarray(case["wr"], dtype)
        wave, out = frames.wave_vector(wi, wo), case["out"]
        got = {
            "G_over_w2": prefactor.geometric_factor("stam", wave, wi[2], wo[2]),
            "cos_half": frames.half_cosine(wave),
            "shadow_vcavity": frames.v_cavity(wave, wi[2], wo[2]),
        }
        for key, value in got.items():
            assert float(value) == pytest.approx(float(out[key]), rel=tolerance), (case["id"], key)


@pytest.mark.parametrize("name", ["r2_windowed", "crossed_windowed_nonsquare"])
def test_window_matches_reference(name, dtype):
    case = diffraction()[name]
    out = case["out"]
    spec, sigma = case["height"], float(out["sigma_s_um"])
    heights, q, _, _ = evaluation(case, dtype)
    zero = jnp.zeros((), dtype)
    s = jnp.asarray(sigma, dtype)
    ax = dtft.gaussian_axis(spec["nx"], spec["T0_um"], q[0], s, zero)
    ay = dtft.gaussian_axis(spec["ny"], spec["T0_um"], q[1], s, zero)
    re, im = dtft.amplitude(heights, q[2], ax, ay)
    expected = out["window_periodic"]
    # float32: rounding of the phases over three windows, as for the bare patch.
    tolerance = 1e-9 if dtype == "float64" else 6e-8 * (4 + 2 * np.pi * phase_turns(case))
    assert abs(float(re) - float(expected["Phat_re"])) < tolerance
    assert abs(float(im) - float(expected["Phat_im"])) < tolerance
    brdf = brdf_of(case, dtype, coherence=sigma, average="window", fresnel=fresnel.Schlick(0.04))
    f = float(brdf(case["wi"], case["wr"], np.array([case["lambda_um"]]))[0])
    value = float(expected["brdf_abs_window_schlick_noshadow"])
    assert abs(f - value) < 2 * tolerance * value / float(expected["Phat2"])


def test_array_factor_matches_reference(dtype):
    for case in cases("array_factor"):
        n, turns = int(case["N"]), case["turns"] + float(case["dx"]) / (2 * np.pi)
        t = jnp.asarray(turns, dtype)
        re, im = special.dirichlet(t, n)
        got = float(re**2 + im**2) * n**2
        # One turn more costs the rounding of t: eps N^2 |d ln D^2 / dt| in all.
        slack = 1e-12 if dtype == "float64" else 1e-5
        assert abs(got - float(case["A2"])) < slack * n**2, case["id"]
        gradient = jax.grad(lambda t, n=n: special.dirichlet(t, n)[0])(t)
        assert bool(jnp.isfinite(gradient))


def test_repeats_match_reference(dtype):
    case = diffraction()["sin_between_orders"]
    repeats = case["out"]["repeats"]
    nx, ny = repeats["Nx"], repeats["Ny"]
    brdf = brdf_of(case, dtype, repeats=(ny, nx))
    lam = np.array([case["lambda_um"]])
    rho = float(brdf.relative(case["wi"], case["wr"], lam)[0])
    out = case["out"]
    cells = case["height"]["nx"] * case["height"]["ny"] * nx * ny
    expected = float(repeats["P2_total"]) / cells**2 * float(out["G_over_w2"])
    assert rho == pytest.approx(expected, rel=1e-9 if dtype == "float64" else 1e-4)


@pytest.mark.parametrize("case", cases("colour"), ids=lambda c: c["id"])
def test_colour_matches_reference(case):
    brdf = brdf_of(case, "float64", fresnel=fresnel.Schlick(0.04), balance="peak")
    xyz = brdf.xyz(case["wi"], case["wr"])
    np.testing.assert_allclose(xyz, np.array(case["XYZ"], float), atol=1e-9, rtol=0)
    from diffopt import colour

    rgb = colour.xyz_to_linear(xyz)
    np.testing.assert_allclose(rgb, np.array(case["lin_rgb"], float), atol=1e-8, rtol=0)


def scalar_orders(case, samples=64):
    """Efficiencies Q_m |c_m|^2 of a sinusoid in one period, by the BRDF's own kernels."""
    d, a, lam = case["d_um"], case["a_um"], case["lambda_um"]
    theta = case["theta_rad"]
    x = (np.arange(samples) - samples // 2) * d / samples
    heights = jnp.asarray(np.broadcast_to(a * np.cos(2 * np.pi * x / d), (2, samples)))
    scan = do.Heightfield(heights, pixel=d / samples)
    brdf = do.DiffractionBRDF(scan, None)
    # Orders are counted along the incident wave, which travels towards -wi.
    wi = np.array([-np.sin(theta), 0.0, np.cos(theta)])
    found = {}
    for m in range(-6, 7):
        # grating equation in this frame: u = -m lambda / d
        ox = m * lam / d - wi[0]
        if abs(ox) < 1:
            wo = np.array([ox, 0.0, np.sqrt(1 - ox**2)])
            # efficiency = Q |c|^2 = rho / cos_i
            found[m] = float(brdf.relative(wi, wo, np.array([lam]))[0]) / np.cos(theta)
    return found


@pytest.mark.parametrize(
    ("name", "tolerance"),
    [
        # section 10 of the model's notes: 1e-5 at d = 10 lambda (a <= 0.1), 5e-4 at
        # d = 5 lambda (a = 0.2; here a = 0.05), 11 % at d = 2.1 lambda, a = 0.2.
        ("pec_sin_d10.1lam_a0.1lam_th0", 2e-4),
        ("pec_sin_d10.1lam_a0.05lam_th30", 2e-4),
        ("pec_sin_d5.1lam_a0.05lam_th0", 5e-4),
        ("pec_sin_d2.1lam_a0.2lam_th0", 0.12),
    ],
)
def test_orders_against_rigorous_conductor(name, tolerance):
    case = diffraction()[name]
    found = scalar_orders(case)
    rigorous = {int(m): e for m, e in case["eff"].items()}
    errors = {m: abs(found[m] - rigorous[m]) for m in rigorous if m in found}
    assert len(errors) >= 5
    assert max(errors.values()) < tolerance
