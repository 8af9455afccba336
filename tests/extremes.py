"""The ends of what every kernel takes, by kernel.

`SWEEPS` gives for each kernel a call of numbers and small arrays, and for each of them a range
or a list. A range stands for its ends, both zeros, the smallest denormal and normal numbers, 1 and
what is an eps beside it, as far as they lie within. (XLA on the CPU takes denormals for 0: they are
passed, and nothing is promised but that they do as little harm.) `EXEMPT` says why a kernel is not
swept here.
"""

from functools import partial
from itertools import product

import jax.numpy as jnp
import numpy as np

from diffopt.kernels import (
    bessel,
    dtft,
    ensemble,
    expansions,
    frames,
    fresnel,
    gather,
    harmonic_products,
    harmonic_rotation,
    harmonics,
    hemispherical,
    intersect,
    langevin,
    lobe_harmonics,
    microfacet,
    mixture,
    octahedral,
    phase,
    prefactor,
    reflectance,
    rescaling,
    rescaling_matrices,
    rescaling_tables,
    special,
    spectrum,
    spline,
    tabulated,
    vmf,
    vmf_pairs,
    vmf_sampling,
    warps,
)

PI = float(np.pi)
MOST = 300  # combinations; beyond, as many of them are drawn


class Between:
    """Numbers from low to high; a name stands for a limit that depends on the dtype."""

    def __init__(self, low, high):
        self.ends = low, high

    def values(self, dtype):
        info = np.finfo(dtype)
        single = dtype == "float32"
        named = {
            "least": info.tiny,
            "most": info.max,
            "root": float(np.sqrt(info.max)) / 4.0,
            "sharpest": 1e8 if single else 1e12,
            "whole": 2.0**22 if single else 2.0**51,
            "below 1": 1.0 - info.epsneg,
        }
        named["-whole"] = -named["whole"]
        low, high = (named.get(end, end) for end in self.ends)
        small = (0.0, info.smallest_subnormal, info.tiny, info.eps, 1e-3)
        near = (0.5, 1.0 - info.epsneg, 1.0, 1.0 + info.eps, 2.0)
        found = np.array([low, high, *small, *near], dtype)
        found = np.concatenate([found, -found, np.array([low], dtype) * (1 + info.eps)])
        found = found[(found >= np.asarray(low, dtype)) & (found <= np.asarray(high, dtype))]
        # Both zeros are kept: they are told apart by their bits.
        word = np.uint32 if single else np.uint64
        return np.unique(found.view(word)).view(dtype)


class Of:
    """Arrays to choose from."""

    def __init__(self, *arrays):
        self.arrays = [np.asarray(a, float) for a in arrays]

    def values(self, dtype):
        return np.stack(self.arrays).astype(dtype)


def directions(lowest):
    """Unit vectors at the pole, the horizon (if z may be 0 or below) and grazing."""
    found = [(0, 0, 1), (-0.0, -0.0, 1), (1e-30, 0, 1), (1e-45, -1e-45, 1), (0.6, 0, 0.8)]
    found += [(np.sin(a), 0, np.cos(a)) for a in (1e-7, 1e-4, PI / 2 - 1e-4, PI / 2 - 1e-7)]
    found += [(0.48, -0.36, 0.8), (0.0, np.sqrt(1 - 1e-12), 1e-6)]
    if lowest <= 0:
        found += [(1, 0, 0), (0, -1, 0), (0.6, 0.8, -0.0), (1, 0, 1e-38)]
    if lowest < 0:
        found += [(0, 0, -1), (-1e-30, 0, -1), (0.48, -0.36, -0.8), (1, 0, -1e-7)]
    return Of(*found)


UP, FLAT, UNIT = directions(1), directions(0), directions(-1)
SHARE = Between(0.0, "below 1")
COSINE = Between(0.0, 1.0)
SINE = Between(-1.0, 1.0)
KAPPA = Between(0.0, "sharpest")
WIDTH = Between(1e-4, 1.0)
TURNS = Between("-whole", "whole")
ANY = Between(-100.0, 100.0)
LINES = Of(np.ones((2, 5)), np.zeros((2, 5)), np.full((2, 5), 1e-30))
ROWS = Of(np.ones((2, 4)), np.zeros((2, 4)), np.full((2, 4), 1e-30))
WEIGHTS = Of(np.ones(5), np.zeros(5), np.full(5, 1e-30))
WEIGHTS_Y = Of(np.ones(4), np.zeros(4))
SPIKE = np.zeros((4, 5))
SPIKE[1, 2] = 1.0
HEIGHTS = Of(0 * SPIKE, SPIKE, SPIKE - 7.0, 1e-45 * SPIKE, 1e-30 * SPIKE, 50.0 * SPIKE)
COEFFICIENTS = Of(np.zeros(9), np.ones(9), np.full(9, 1e-30), np.full(9, -1e6), np.eye(9)[0])
MATRIX = Of(np.eye(3), np.diag([1.0, -1.0, -1.0]), np.diag([-1.0, -1.0, 1.0]))
FACETS = ("ggx", "beckmann")


def _alpha(kernel, *names):
    return lambda *a: kernel(*names, *a[:-2], a[-2:])


def _wave(kernel):
    return lambda wi, wo: kernel(frames.wave_vector(wi, wo), wi[2], wo[2])


def _line(kernel, *arguments, **options):
    return lambda x: kernel(x, *arguments, **options)


def _spheres(o, d):
    return intersect.spheres(o[None], d[None], jnp.zeros((1, 3), o.dtype), jnp.ones(1, o.dtype))[0]


def _discs(o, d):
    up = jnp.zeros((1, 3), o.dtype).at[0, 2].set(1.0)
    return intersect.discs(o[None], d[None], jnp.zeros_like(up), up, jnp.ones(1, o.dtype))[0]


def _finite(t):
    return jnp.where(jnp.isfinite(t), t, 0.0)


def _mixture(s, w):
    start = mixture.Mixture(
        jnp.full(2, -0.7, s.dtype),
        jnp.asarray([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]], s.dtype),
        jnp.asarray([3.0, 50.0], s.dtype),
    )
    return start, mixture.expectation_maximisation(s, w, start, 3, jnp.asarray(1e4, s.dtype))


SAMPLES = Of(
    np.tile([0.0, 0.0, 1.0], (4, 1)),
    np.eye(4)[:, :3] + np.eye(4)[3] @ np.eye(4)[:, :1] + np.outer(np.eye(4)[3], [0, 0, -1.0]),
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]],
)
MASSES = Of(np.ones(4), np.zeros(4), np.eye(4)[0], np.full(4, 1e-30), np.full(4, 1e30))
PAIR = (UNIT, KAPPA, UNIT, KAPPA)


def _all():
    """(kernel, call, ranges)."""
    yield (
        "bessel.bessel_sequence",
        _line(lambda z: bessel.bessel_sequence(z[None], 3, nodes=72)),
        (Between(-20.0, 20.0),),
    )
    yield (
        "dtft.gaussian_axis",
        partial(dtft.gaussian_axis, 6, 0.25),
        (
            Between(-4.0, 4.0),
            Between(0.25, 0.75),
            ANY,
        ),
    )
    yield "dtft.finite_axis", lambda f: dtft.finite_axis(6, 0.25, f, 3), (ANY,)
    yield "dtft.bin_weights", partial(dtft.bin_weights, 6, 0.25), (ANY, Between(1e-6, 10.0))
    yield "dtft.amplitude", dtft.amplitude, (HEIGHTS, ANY, LINES, ROWS)
    yield "dtft.coherent_intensity", dtft.coherent_intensity, (HEIGHTS, ANY, LINES, ROWS)
    yield "dtft.power_spectrum", dtft.power_spectrum, (HEIGHTS, ANY)
    yield "dtft.averaged_intensity", dtft.averaged_intensity, (HEIGHTS, ANY, WEIGHTS, WEIGHTS_Y)
    yield "ensemble.log_poisson", ensemble.log_poisson, (Between(1.0, 1e6), Between(1e-20, 1e6))
    yield (
        "ensemble.poisson_terms",
        partial(ensemble.poisson_terms, terms=32, widths=20.0, halvings=20),
        (Between(1e-30, 1e6), Between(0.0, 1e6)),
    )
    yield (
        "ensemble.gaussian_roughness",
        ensemble.gaussian_roughness,
        (
            Between(0.0, 100.0),
            Between(-60.0, 0.0),
            Between(0.0, 10.0),
            Between(1e-3, 100.0),
        ),
    )
    yield "ensemble.gaussian_mirror", ensemble.gaussian_mirror, (ANY, Between(0.0, 1e3))
    yield (
        "ensemble.random_bumps",
        partial(ensemble.random_bumps, terms=40),
        (
            ANY,
            ANY,
            Between(-10.0, 0.0),
            SINE,
            WIDTH,
            WIDTH,
            Between(0.0, 1.0),
        ),
    )
    yield (
        "expansions.interval",
        expansions.interval,
        (
            Between(-10.0, -1.0),
            Between(-1.0, 10.0),
            Between(0.0, 1e3),
        ),
    )
    yield (
        "expansions.lowrank_series",
        partial(expansions.lowrank_series, terms=8),
        (Between(0.0, 8.0),),
    )
    yield "expansions.coefficients", partial(expansions.coefficients, terms=8), (SINE,)
    yield (
        "expansions.taylor_coefficients",
        partial(expansions.taylor_coefficients, terms=20),
        (Between(-30.0, 30.0),),
    )
    yield "frames.dot", frames.dot, (UNIT, UNIT)
    yield "frames.reflect", frames.reflect, (UNIT, UNIT)
    yield "frames.half_vector", lambda a, b: frames.half_vector(a, b)[:2], (UNIT, UNIT)
    yield "frames.above_horizon", lambda a, b: frames.above_horizon(a, b)[1:], (UNIT, UNIT)
    yield "frames.wave_vector", frames.wave_vector, (UNIT, UNIT)
    yield "frames.half_cosine", lambda a, b: frames.half_cosine(frames.wave_vector(a, b)), (UP, UP)
    yield "frames.v_cavity", _wave(frames.v_cavity), (UP, UP)
    yield "frames.spherical", frames.spherical, (Between(0.0, PI), Between(-PI, PI))
    yield "frames.direction", frames.direction, (ANY, ANY, ANY)
    yield "frames.around", frames.around, (COSINE, TURNS, SINE)
    yield "frames.tangents", frames.tangents, (UNIT,)
    for name in ("dielectric", "dielectric_polarised"):
        # Slopes grow towards the critical angle, also those by the index at grazing incidence.
        yield f"fresnel.{name}", getattr(fresnel, name), (COSINE, Between(1e-2, 1e2))
    for name in ("conductor", "conductor_polarised"):
        yield (
            f"fresnel.{name}",
            getattr(fresnel, name),
            (
                COSINE,
                Between(0.0, 1e2),
                Between(0.0, 1e2),
            ),
        )
    yield "fresnel.schlick", fresnel.schlick, (COSINE, COSINE)
    yield "fresnel.index_from_normal", fresnel.index_from_normal, (SHARE,)
    yield (
        "fresnel.index_from_permittivity",
        fresnel.index_from_permittivity,
        (
            Between(-1e3, 1e3),
            Between(0.0, 1e3),
        ),
    )
    yield "gather.height_scale", partial(gather.height_scale, centred=True), (HEIGHTS,)
    yield (
        "gather.taylor_spectra",
        partial(gather.taylor_spectra, terms=3, centred=False),
        (HEIGHTS,),
    )
    yield "gather.node_spectra", lambda h, s: gather.node_spectra(h, s[None]), (HEIGHTS, ANY)
    yield "gather.node_powers", lambda h, s: gather.node_powers(h, s[None]), (HEIGHTS, ANY)
    yield "gather.axis_bins", lambda f: gather.axis_bins(6, 0.25, f, 2)[1], (ANY,)
    yield "harmonic_products.product", harmonic_products.product, (COEFFICIENTS, COEFFICIENTS)
    yield "harmonic_products.logarithm", harmonic_products.logarithm, (COEFFICIENTS,)
    yield (
        "harmonic_products.exponential",
        harmonic_products.exponential,
        (Of(np.zeros(9), np.ones(9), np.full(9, 1e-30), np.full(9, -10.0)),),
    )
    yield "harmonic_rotation.blocks", partial(harmonic_rotation.blocks, bands=3), (MATRIX,)
    yield "harmonic_rotation.rotate", harmonic_rotation.rotate, (COEFFICIENTS, MATRIX)
    for name in ("about_z", "about_y"):
        yield (
            f"harmonic_rotation.{name}",
            getattr(harmonic_rotation, name),
            (
                COEFFICIENTS,
                SINE,
                SINE,
            ),
        )
    yield "harmonic_rotation.to_frame", harmonic_rotation.to_frame, (COEFFICIENTS, *(SINE,) * 4)
    yield "harmonics.basis", partial(harmonics.basis, bands=5), (UNIT,)
    yield "harmonics.evaluate", harmonics.evaluate, (COEFFICIENTS, UNIT)
    yield "harmonics.zonal", harmonics.zonal, (Of(np.ones(3), np.zeros(3)), UNIT)
    yield "harmonics.legendre", partial(harmonics.legendre, bands=6), (SINE,)
    yield "harmonics.cap", partial(harmonics.cap, bands=6), (Between(0.0, PI),)
    yield "hemispherical.spread", hemispherical.spread, (UP,)
    yield "hemispherical.basis", partial(hemispherical.basis, bands=4), (UP,)
    yield "intersect.spheres", lambda o, d: _finite(_spheres(o, d)), (ORIGINS, RAYS)
    yield "intersect.discs", lambda o, d: _finite(_discs(o, d)), (ORIGINS, RAYS)
    for name in (
        "log_sinhc",
        "log_sinhc_complement",
        "k_coth",
        "langevin",
        "langevin_complement",
        "langevin_slope",
    ):
        yield f"langevin.{name}", getattr(langevin, name), (KAPPA,)
    yield "langevin.log_sinhc_root", langevin.log_sinhc_root, (Between(0.0, 1e16),)
    for name in ("pade_inverse_langevin", "inverse_langevin"):
        kernel = getattr(langevin, name)
        yield f"langevin.{name}", lambda r, kernel=kernel: kernel(r, 1.0 - r), (SHARE,)
    yield "lobe_harmonics.ratios", partial(lobe_harmonics.ratios, bands=5), (KAPPA,)
    for name in FACETS:
        yield "microfacet.density", _alpha(microfacet.density, name), (UNIT, WIDTH, WIDTH)
        for kernel in ("projected_area", "masking"):
            yield (
                f"microfacet.{kernel}",
                _alpha(getattr(microfacet, kernel), name),
                (
                    UP,
                    WIDTH,
                    WIDTH,
                ),
            )
        yield (
            "microfacet.visible_density",
            _alpha(microfacet.visible_density, name),
            (
                UNIT,
                UP,
                WIDTH,
                WIDTH,
            ),
        )
        yield (
            "microfacet.sample_visible",
            _alpha(microfacet.sample_visible, name),
            (
                SQUARE,
                UP,
                WIDTH,
                WIDTH,
            ),
        )
    for kind in ("correlated", "uncorrelated", "v-cavity"):
        yield (
            "microfacet.visibility",
            _alpha(microfacet.visibility, kind, "ggx"),
            (
                UP,
                UP,
                WIDTH,
                WIDTH,
            ),
        )
    yield "microfacet.squared_angle", microfacet.squared_angle, (FLAT,)
    yield "microfacet.gaussian_constant", microfacet.gaussian_constant, (Between(1e-4, 2.0),)
    yield "mixture.mean_direction", mixture.mean_direction, (SAMPLES, MASSES)
    yield (
        "mixture.moments",
        lambda s, w: mixture.moments(s, w, jnp.asarray(1e6, s.dtype)),
        (
            SAMPLES,
            MASSES,
        ),
    )
    yield "mixture.expectation_maximisation", lambda s, w: _mixture(s, w)[1], (SAMPLES, MASSES)
    yield (
        "mixture.log_likelihood",
        lambda s, w: mixture.log_likelihood(s, w, _mixture(s, w)[0]),
        (
            SAMPLES,
            MASSES,
        ),
    )
    yield "octahedral.encode", octahedral.encode, (ANY, ANY, ANY)
    yield "octahedral.decode", octahedral.decode, (SINE, SINE)
    yield "phase.cis_turns", phase.cis_turns, (TURNS,)
    for name in ("chebyshev_polynomials", "chebyshev_rows"):
        yield f"phase.{name}", partial(getattr(phase, name), count=20), (SINE,)
    yield "phase.chebyshev_weights", partial(phase.chebyshev_weights, nodes=6), (SINE,)
    for name in ("stam", "ghs", "rghs", "kirchhoff"):
        yield (
            "prefactor.geometric_factor",
            _wave(partial(prefactor.geometric_factor, name)),
            (
                UP,
                UP,
            ),
        )
    yield "reflectance.mirrored", reflectance.mirrored, (UNIT,)
    for form in ("reflected", "halfway"):
        yield "reflectance.lobe_angle", partial(reflectance.lobe_angle, form), (UP, UP)
        yield "reflectance.phong", partial(reflectance.phong, form), (Between(0.0, 1e8), UP, UP)
    yield "reflectance.half_angle", reflectance.half_angle, (UP, UP)
    yield "reflectance.blinn_phong", reflectance.blinn_phong, (Between(0.0, 1e8), UP, UP)
    yield "reflectance.blinn_phong_constant", reflectance.blinn_phong_constant, (Between(0.0, 1e8),)
    yield "reflectance.oren_nayar", reflectance.oren_nayar, (Between(0.0, PI / 2), UP, UP)
    for name in ("square", "square_slope", "square_slope_k", "square_sine_ratio", "square_density"):
        yield f"rescaling.{name}", getattr(rescaling, name), (Between(0.0, PI), Between(1e-3, 1e3))
    yield "rescaling.sphere_rule", rescaling.sphere_rule, (Between(0.0, PI), Between(1e-3, 1e3))
    for name in ("tangent", "tangent_inverse"):
        yield (
            f"rescaling.{name}",
            getattr(rescaling, name),
            (Between(0.0, PI / 2), Between(1e-3, 1)),
        )
    for name in ("square", "sphere_rule", "tangent"):
        yield (
            f"rescaling_matrices.{name}",
            partial(getattr(rescaling_matrices, name), bands=3, nodes=16),
            (Between(1e-2, 1.0 if name == "tangent" else 10.0),),
        )
    for kind in rescaling_tables.KINDS:
        yield (
            "rescaling_tables.place",
            partial(rescaling_tables.place, kind=kind),
            (Between(1e-3, 1.0),),
        )
    yield "special.sinc", special.sinc, (TURNS,)
    yield "special.dirichlet", partial(special.dirichlet, copies=9), (TURNS,)
    yield (
        "spectrum.trapezoid_weights",
        spectrum.trapezoid_weights,
        (Of([0.38, 0.5, 0.78], [1e-30, 2e-30, 1.0]),),
    )
    yield "spectrum.weights_to_xyz", spectrum.weights_to_xyz, (RGB, MATRIX)
    yield "spectrum.transform", spectrum.transform, (RGB, MATRIX)
    yield "spectrum.desaturate", spectrum.desaturate, (RGB, Between(-1.0, 10.0))
    for choice in spectrum.GAMUTS:
        yield (
            "spectrum.fit_gamut",
            partial(spectrum.fit_gamut, choice=choice),
            (
                RGB,
                Between(-1.0, 10.0),
            ),
        )
    for name in ("encode_srgb", "decode_srgb"):
        yield f"spectrum.{name}", getattr(spectrum, name), (Between(-1e6, 1e6),)
    for order in (2, 3):
        yield "spline.weights", partial(spline.weights, order=order), (Between(-0.5, 1.0),)
    yield "spline.locate", lambda x: spline.locate(x, 10, 3)[1], (Between(-50.0, 50.0),)
    yield "spline.prefilter", partial(spline.prefilter, axis=0, order=3), (WEIGHTS,)
    yield "tabulated.root", tabulated.root, (Between(-1.0, "most"),)
    yield "tabulated.angle", tabulated.angle, (SINE, SINE)
    yield "tabulated.rusinkiewicz", tabulated.rusinkiewicz, (UNIT, UNIT)
    yield (
        "tabulated.half_difference",
        tabulated.half_difference,
        (
            Between(0.0, PI),
            Between(0.0, PI / 2),
            Between(-PI, PI),
        ),
    )
    yield (
        "tabulated.merl_places",
        partial(tabulated.merl_places, shape=(90, 90, 180)),
        (
            Between(0.0, PI),
            Between(0.0, PI / 2),
            Between(-PI, PI),
        ),
    )
    yield "tabulated.place", tabulated.place, (Of([0.0, 0.5, 2.0], [-1.0, 1e-30, 1.0]), ANY)
    for name in ("log_normaliser", "log_peak", "squared_norm", "entropy"):
        yield f"vmf.{name}", getattr(vmf, name), (KAPPA,)
    yield "vmf.complement", vmf.complement, (UNIT, UNIT)
    for name in ("log_pdf", "pdf"):
        yield f"vmf.{name}", getattr(vmf, name), (UNIT, UNIT, KAPPA)
    for name in ("combined", "log_inner", "product", "divergence", "log_similarity"):
        yield f"vmf_pairs.{name}", getattr(vmf_pairs, name), PAIR
    yield "vmf_pairs.convolved", vmf_pairs.convolved, (KAPPA, KAPPA)
    yield (
        "vmf_pairs.squared_distance",
        vmf_pairs.squared_distance,
        (
            *(Between(0.0, 1e3), UNIT, KAPPA),
            *(Between(0.0, 1e3), UNIT, KAPPA),
        ),
    )
    yield "vmf_sampling.one_minus_cosine", vmf_sampling.one_minus_cosine, (SHARE, KAPPA)
    yield "vmf_sampling.warp", vmf_sampling.warp, (SQUARE, UNIT, KAPPA)
    for name in ("cosine_hemisphere", "uniform_hemisphere"):
        yield f"warps.{name}", getattr(warps, name), (SQUARE,)
    yield "warps.power_cosine", warps.power_cosine, (SQUARE, Between(0.0, 1e8))
    for name in ("power", "power_cosine_density"):
        kernel = getattr(warps, name)
        yield (
            f"warps.{name}",
            lambda w, e, kernel=kernel: kernel(w[2], w[0] ** 2 + w[1] ** 2, e),
            (UNIT, Between(0.0, 1e8)),
        )
    yield "warps.gaussian_angle", warps.gaussian_angle, (SQUARE, Between(1e-3, 2.0))
    yield (
        "warps.gaussian_angle_density",
        warps.gaussian_angle_density,
        (
            Between(0.0, PI**2 / 4),
            Between(1e-3, 2.0),
        ),
    )


SQUARE = Of(*((a, b) for a in (0.0, 1e-45, 0.5, 1 - 2.0**-24) for b in (0.0, 0.25, 1 - 2.0**-24)))
ORIGINS = Of((0, 0, 0), (0, 0, 3), (0, 0, 1), (1, 0, 0.5), (1e-30, -0.0, 0), (1e6, 0, 1e6))
RAYS = Of((0, 0, -1), (0, 0, 0), (1, 0, 0), (-0.6, 0, -0.8), (1e-18, 0, -1e-18), (1e15, 0, -1e15))
RGB = Of((0, 0, 0), (-0.0, 1, 1), (1e-30, 0, -1e-30), (-5, 2, 1), (1e-45, 1, 0), (1e6, -1e6, 0))

_TABLES = "takes tables with their places, which its caller clips to them; its rows hold the ends"
_FITS = "a step of a fit: its rows hold dead lobes, no weight, no step"
_SHAPES = "takes no number that has an end: shapes, or arrays in which it is linear"
EXEMPT = {
    "bessel.signed": "picks rows of a sequence",
    "dtft.positions": _SHAPES,
    "expansions.chebyshev_projection": _SHAPES,
    "frames.valid_wave_vector": "picks one of the wave vectors",
    "gather.project": _SHAPES,
    "gather.table": _SHAPES,
    "gather.whole_pixels": "whole numbers and the rest",
    "gather.move_origin": _TABLES,
    "gather.gather_bins": _TABLES,
    "gather.gather_sum": _TABLES,
    "gather.coherent": _TABLES,
    "gather.averaged": _TABLES,
    "harmonics.project": _SHAPES,
    "hierarchy.build": "on the host; degenerate triangles are in its own tests",
    "intersect.first_hit": "rays at corners, edges and infinities are in `intersect_cases`",
    "intersect.blocked": "returns what is true or false",
    "traversal.search": "as `intersect.first_hit`",
    "traversal.size": "scales directions of any length: `intersect_cases`",
    "lobe_squares.problem": _FITS,
    "lobe_squares.parameters": _FITS,
    "lobe_squares.lobes": _FITS,
    "lobe_squares.residuals": _FITS,
    "lobe_squares.normal_equations": _SHAPES,
    "lobe_squares.damped_step": _FITS,
    "lobe_squares.resolved": _FITS,
    "lobe_squares.begin": _FITS,
    "lobe_squares.moved": _FITS,
    "lobe_squares.levenberg_marquardt": _FITS,
    "lobe_squares.best_weights": _FITS,
    "lobe_squares.restored": _FITS,
    "mixture.scattered_start": "drawn from a key; its rows hold samples without weight",
    "mixture.split_start": "its rows hold samples without weight",
    "phase.chebyshev_points": _SHAPES,
    "prefactor.height_factor": "picks a component",
    "prefactor.kirchhoff_weight": _SHAPES,
    "quadrature.polar_grid": "its rows hold the poles and the narrowest core",
    "rescaling_matrices.transposed": _SHAPES,
    "rescaling_matrices.dense": _SHAPES,
    "rescaling_matrices.apply": _SHAPES,
    "rescaling_tables.linear": _SHAPES,
    "rescaling_tables.from_linear": _TABLES,
    "rescaling_tables.chebyshev": _SHAPES,
    "rescaling_tables.from_chebyshev": _TABLES,
    "separable.contract": _SHAPES,
    "separable.coherent": "phases as in `dtft`; its rows hold a single w and flat heights",
    "separable.averaged": "phases as in `dtft`; its rows hold a single w and flat heights",
    "spline.lookup": _TABLES,
    "tabulated.linear": _TABLES,
    "tabulated.corners": _TABLES,
    "tabulated.invert_bilinear": _TABLES,
    "tabulated.sample_bilinear": _TABLES,
    "uniforms.at": "takes whole numbers",
    "uniforms.pairs": "takes whole numbers",
    "vmf_pairs.squared_distance_asymptotic": "documented to fail where two lobes cancel",
    "vmf_pairs.interpolated": "its rows hold opposite lobes and weights of 0",
    "vmf_pairs.interpolant_pdf": "its rows hold opposite lobes and weights of 0",
    "vmf_sampling.sample": "as `vmf_sampling.warp`",
}
SWEEPS = list(_all())


def places(ranges, dtype):
    """All combinations of the values of every argument, or `MOST` of them."""
    values = [r.values(dtype) for r in ranges]
    sizes = [len(v) for v in values]
    if np.prod([float(n) for n in sizes]) <= MOST:
        index = np.array(list(product(*map(range, sizes))))
    else:
        index = np.random.default_rng(0).integers(0, sizes, (MOST, len(sizes)))
    return [v[i] for v, i in zip(values, index.T, strict=True)]
