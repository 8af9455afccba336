"""Hard inputs of the kernels behind materials: see `hard_cases`."""

from functools import partial

import numpy as np
from hard_cases import LD, PI, Hard
from scipy.special import erf

from diffopt.kernels import frames, fresnel, microfacet, reflectance, warps

# Directions: grazing, near the normal, and between; azimuths that share no plane.
GRAZING = (np.sqrt(1 - 1e-8) * 0.6, np.sqrt(1 - 1e-8) * 0.8, 1e-4)
STEEP = (3e-5, -4e-5, np.sqrt(1 - 25e-10))
SLANT = (0.48, -0.36, 0.8)
NORMAL = (0.0, 0.0, 1.0)


def material_rows():
    """All of them."""
    yield from _normals()
    yield from _areas()
    yield from _formulas()
    yield from _warps()


def _on_widths(kernel, *names):
    """A kernel with its widths as two arguments of their own."""
    return lambda *a: kernel(*names, *a[:-2], a[-2:])


def _ggx(h, ax, ay):
    return 1 / (PI * ax * ay * ((h[0] / ax) ** 2 + (h[1] / ay) ** 2 + h[2] ** 2) ** 2)


def _beckmann(h, ax, ay):
    tangent = ((h[0] / ax) ** 2 + (h[1] / ay) ** 2) / h[2] ** 2
    return np.exp(-tangent) / (PI * ax * ay * h[2] ** 4)


def _gaussian(h, m, _):
    theta = np.arctan2(np.hypot(h[0], h[1]), h[2])
    return _constant(m) * np.exp(-((theta / m) ** 2))


def _constant(m):
    x, w = np.polynomial.legendre.leggauss(200)
    end = min(PI / (2 * m), LD(9))
    x = (x.astype(LD) + 1) * end / 2
    inner = (w.astype(LD) * np.exp(-x * x) * np.sin(2 * m * x) / m).sum() * end / 2
    return 1 / (PI * m * m * inner)


NORMALS = {"ggx": _ggx, "beckmann": _beckmann, "gaussian": _gaussian}


def _normals():
    for name, twin in NORMALS.items():
        for label, h, ax, ay in (
            ("peak", NORMAL, 1e-4, 1e-4),
            ("flank", STEEP, 1e-4, 1e-4),
            ("slant", SLANT, 0.3, 0.3),
            ("wide", SLANT, 1.0, 1.0),
            ("anisotropic", SLANT, 0.05, 0.9),
        ):
            if name == "gaussian" and label == "anisotropic":
                continue
            if name == "beckmann" and label == "anisotropic":
                ax = 0.2  # 1e-40 at 0.05
            yield Hard(
                "microfacet.density",
                f"{name} {label}",
                _on_widths(microfacet.density, name),
                (np.array(h), ax, ay),
                twin,
                # Rounding of the exponent (up to 6) and of squares of h / alpha.
                ulps=120,
                # The quadrature's constant; and slopes 1 / alpha of a peak.
                gradient_ulps=1e5,
                smooth=ax > 1e-3,
            )
        yield Hard(
            "microfacet.density",
            f"{name} below",
            _on_widths(microfacet.density, name),
            (np.array([0.6, 0.0, -0.8]), 0.3, 0.3),
            lambda h, ax, ay: 0 * ax,
        )
        yield Hard(
            "microfacet.density",
            f"{name} at the horizon",
            _on_widths(microfacet.density, name),
            (np.array([0.6, 0.8, 1e-9]), 0.3, 0.3),
            {"ggx": _ggx, "beckmann": lambda h, ax, ay: 0 * ax, "gaussian": _gaussian}[name],
            ulps=200,
            gradient_ulps=1e5,
            smooth=False,
        )
    for h in (NORMAL, STEEP, SLANT, (0.6, 0.8, 0.0), (0.006, 0.008, np.sqrt(1 - 1e-4))):
        yield Hard(
            "microfacet.squared_angle",
            f"{h}",
            microfacet.squared_angle,
            (np.array(h),),
            _squared_angle,
            # Off the unit sphere the series takes sin^2, the angle the tangent; as a function
            # of z the two differ, so the slope is judged where the angle is used.
            smooth=h == SLANT,
            ulps=200 if h[2] > 0.999 else 8,
        )
    for m in (1e-4, 0.3, 1.0):
        yield Hard(
            "microfacet.gaussian_constant",
            f"m={m}",
            microfacet.gaussian_constant,
            (m,),
            _constant,
            ulps=60,  # 48 terms of either sign
            gradient_ulps=1e5,  # 1 / m
        )


def _squared_angle(h):
    if h[2] > LD("0.999"):
        return np.arcsin(np.hypot(h[0], h[1])) ** 2
    return np.arctan2(np.hypot(h[0], h[1]), h[2]) ** 2


def _area_ggx(w, ax, ay):
    return (w[2] + np.sqrt(w[2] ** 2 + (ax * w[0]) ** 2 + (ay * w[1]) ** 2)) / 2


def _area_beckmann(w, ax, ay):
    across = np.hypot(ax * w[0], ay * w[1])
    if across == 0 or w[2] / across > 9:
        return w[2]
    a = w[2] / across
    return (across * np.exp(-a * a) / np.sqrt(PI) + w[2] * (1 + LD(erf(float(a))))) / 2


AREAS = {"ggx": _area_ggx, "beckmann": _area_beckmann}


def _visibility(kind, area, wi, wo, ax, ay):
    if kind == "v-cavity":
        total = wi + wo
        length2 = (total**2).sum()
        shadow = min(LD(1), 4 * total[2] * min(wi[2], wo[2]) / length2)
        return shadow / (4 * wi[2] * wo[2])
    ai, ao = area(wi, ax, ay), area(wo, ax, ay)
    if kind == "uncorrelated":
        return 1 / (4 * ai * ao)
    # G = 1 / (1 + Lambda_i + Lambda_o).
    return 1 / (4 * wi[2] * wo[2] * (ai / wi[2] + ao / wo[2] - 1))


def _areas():
    for name, twin in AREAS.items():
        for label, w in (
            ("normal", NORMAL),
            ("steep", STEEP),
            ("slant", SLANT),
            ("grazing", GRAZING),
            ("horizon", (0.6, 0.8, 0.0)),
        ):
            for ax, ay in ((1e-4, 1e-4), (0.2, 1.0)):
                arguments = (np.array(w), ax, ay)
                yield Hard(
                    "microfacet.projected_area",
                    f"{name} {label} {ax}",
                    _on_widths(microfacet.projected_area, name),
                    arguments,
                    twin,
                    smooth=label not in ("horizon", "normal"),
                    ulps=16,
                )
            if label == "horizon":
                continue
            yield Hard(
                "microfacet.masking",
                f"{name} {label}",
                _on_widths(microfacet.masking, name),
                (np.array(w), 0.2, 1.0),
                lambda w, ax, ay, twin=twin: w[2] / twin(w, ax, ay),
                smooth=label != "normal",
            )
        for kind in ("correlated", "uncorrelated", "v-cavity"):
            for label, wi, wo in (
                ("alike", SLANT, SLANT),
                ("apart", SLANT, (-0.1, 0.7, np.sqrt(0.5))),
                ("both grazing", GRAZING, (-GRAZING[0], GRAZING[1], 2e-4)),
            ):
                yield Hard(
                    "microfacet.visibility",
                    f"{kind} {name} {label}",
                    _on_widths(microfacet.visibility, kind, name),
                    (np.array(wi), np.array(wo), 0.2, 1.0),
                    partial(_visibility, kind, twin),
                    # A minimum has a kink where two directions are alike.
                    smooth=not (kind == "v-cavity" and label == "alike"),
                    ulps=32,
                    gradient_ulps=1e6,  # 1 / cos at grazing
                )
        yield Hard(
            "microfacet.visible_density",
            name,
            _on_widths(microfacet.visible_density, name),
            (np.array(SLANT), np.array((-0.1, 0.7, np.sqrt(0.5))), 0.3, 0.5),
            lambda h, w, ax, ay, name=name: (
                NORMALS[name](h, ax, ay) * (h * w).sum() / AREAS[name](w, ax, ay)
            ),
            ulps=64,
            gradient_ulps=1e4,
        )
    for w in (NORMAL, SLANT, GRAZING):
        yield Hard(
            "microfacet.sample_visible",
            f"ggx {w}",
            _on_widths(microfacet.sample_visible, "ggx"),
            (np.array([0.3, 0.7]), np.array(w), 0.2, 1.0),
            _cap,
            ulps=64,
            gradient_ulps=1e4,
        )


def _cap(u, w, ax, ay):
    stretched = np.array([ax * w[0], ay * w[1], w[2]])
    stretched = stretched / np.sqrt((stretched**2).sum())
    z = 1 - u[0] * (1 + stretched[2])
    sin = np.sqrt(1 - z * z)
    cap = np.array([sin * np.cos(2 * PI * u[1]), sin * np.sin(2 * PI * u[1]), z]) + stretched
    h = np.array([ax * cap[0], ay * cap[1], cap[2]])
    return h / np.sqrt((h**2).sum())


def _unit_half(wi, wo):
    length = np.sqrt(((wi + wo) ** 2).sum())
    return (wi + wo) / length, length


def _half(wi, wo):
    total = wi + wo
    length2 = (total**2).sum()
    return total[2] / np.sqrt(length2), (total[0] ** 2 + total[1] ** 2) / length2


def _psi(form, wi, wo):
    if form == "reflected":
        gap = ((np.array([-1, -1, 1]) * wi - wo) ** 2).sum() / 4
    else:
        gap = _half(wi, wo)[1]
    return 1 - 2 * gap, 4 * gap * (1 - gap)


def _oren_nayar(sigma, wi, wo):
    a = 1 - sigma**2 / (2 * (sigma**2 + LD("0.33")))
    b = LD("0.45") * sigma**2 / (sigma**2 + LD("0.09"))
    ti, to = (np.arccos(w[2]) for w in (wi, wo))
    turn = np.arctan2(wi[1], wi[0]) - np.arctan2(wo[1], wo[0])
    return (a + b * max(LD(0), np.cos(turn)) * np.sin(max(ti, to)) * np.tan(min(ti, to))) / PI


def _formulas():
    for r0 in (0.0, 1e-10, 0.04, 0.9):
        yield Hard(
            "fresnel.index_from_normal",
            f"r0={r0}",
            fresnel.index_from_normal,
            (r0,),
            lambda r0: (1 + np.sqrt(r0)) / (1 - np.sqrt(r0)),
            smooth=r0 > 1e-6,
            ulps=64 if r0 > 0.5 else 8,  # 1 - sqrt(r0)
        )
    yield Hard(
        "frames.dot",
        "a small component",
        frames.dot,
        (np.array(SLANT), np.array((0.6, 1e-9, 0.35))),
        lambda a, b: (a * b).sum(),
        ulps=16,  # against the largest term below
    )
    for label, h in (("along the half vector", SLANT), ("across it", (0.6, 0.8, 1e-9))):
        yield Hard(
            "frames.reflect",
            label,
            frames.reflect,
            (np.array(SLANT), np.array(h)),
            lambda w, h: 2 * (w * h).sum() * h - w,
        )
    yield Hard(
        "frames.half_vector",
        "none",
        lambda a, b: frames.half_vector(a, b)[:2],
        (np.array(SLANT), -np.array(SLANT)),
        lambda a, b: (np.array(NORMAL), LD(1)),
    )
    other = (-0.479, 0.361, np.sqrt(1 - 0.479**2 - 0.361**2))
    yield Hard(
        "reflectance.mirrored",
        "slant",
        reflectance.mirrored,
        (np.array(SLANT),),
        lambda w: np.array([-1, -1, 1]) * w,
    )
    pairs = {
        "near the peak": (SLANT, other),
        "alike": (SLANT, SLANT),
        "both grazing": (GRAZING, (GRAZING[0], -GRAZING[1], 2e-4)),
    }
    for label, (wi, wo) in pairs.items():
        pair = np.array(wi), np.array(wo)
        yield Hard(
            "frames.half_vector", label, lambda a, b: frames.half_vector(a, b)[:2], pair, _unit_half
        )
        yield Hard("reflectance.half_angle", label, reflectance.half_angle, pair, _half)
        for form in ("reflected", "halfway"):
            yield Hard(
                "reflectance.lobe_angle",
                f"{form} {label}",
                partial(reflectance.lobe_angle, form),
                pair,
                partial(_psi, form),
                ulps=16,
            )
            for exponent in (0.0, 20.0, 1e6):
                cos, sin2 = _psi(form, *(p.astype(LD) for p in pair))
                peak = exponent * float(sin2)
                if cos <= 0.1 or peak > 60:
                    continue
                yield Hard(
                    "reflectance.phong",
                    f"{form} {label} {exponent:g}",
                    partial(reflectance.phong, form),
                    (exponent, *pair),
                    lambda n, wi, wo, form=form: _psi(form, wi, wo)[0] ** n,
                    # n times the rounding of the angle's square.
                    ulps=64 + 20 * peak,
                    gradient_ulps=1e3 + 40 * exponent,
                )
    for exponent in (0.0, 20.0, 1e6):
        yield Hard(
            "reflectance.blinn_phong",
            f"{exponent:g}",
            reflectance.blinn_phong,
            (exponent, *pairs_of("near the peak", pairs)),
            lambda e, wi, wo: _half(wi, wo)[0] ** e,
            ulps=64,
            gradient_ulps=1e3 + 40 * exponent,
        )
        yield Hard(
            "reflectance.blinn_phong_constant",
            f"{exponent:g}",
            reflectance.blinn_phong_constant,
            (exponent,),
            lambda e: (e + 2) * (e + 4) / (8 * PI * (2 ** (-e / 2) + e)),
        )
    for sigma in (0.0, 1e-4, 0.5):
        wi, wo = np.array(SLANT), np.array((0.1, -0.7, np.sqrt(0.5)))
        yield Hard(
            "reflectance.oren_nayar",
            f"{sigma}",
            reflectance.oren_nayar,
            (sigma, wi, wo),
            _oren_nayar,
            smooth=False,  # the twin goes through angles, which hold on the sphere alone
        )


def pairs_of(label, pairs):
    """A pair as arrays."""
    return tuple(np.array(w) for w in pairs[label])


def _around(turn, cos2, sin2):
    sin, cos = np.sqrt(sin2), np.sqrt(cos2)
    return np.array([sin * np.cos(2 * PI * turn), sin * np.sin(2 * PI * turn), cos])


def _warps():
    for u in ((0.3, 0.7), (1e-6, 0.25), (0.999, 0.0)):
        point = (np.array(u),)
        yield Hard(
            "warps.cosine_hemisphere",
            f"{u}",
            warps.cosine_hemisphere,
            point,
            lambda u: _around(u[1], 1 - u[0], u[0]),
            smooth=u[0] > 0.1,
        )
        yield Hard(
            "warps.uniform_hemisphere",
            f"{u}",
            warps.uniform_hemisphere,
            point,
            lambda u: _around(u[1], (1 - u[0]) ** 2, u[0] * (2 - u[0])),
            smooth=u[0] > 0.1,
            ulps=16,
        )
        for n in (0.0, 30.0, 1e8):
            yield Hard(
                "warps.power_cosine",
                f"{u} {n:g}",
                warps.power_cosine,
                (np.array(u), n),
                _power_cosine,
                smooth=u[0] > 0.1,
                ulps=32,
            )
        for m in (1e-4, 0.3, 1.5):
            yield Hard(
                "warps.gaussian_angle",
                f"{u} {m}",
                warps.gaussian_angle,
                (np.array(u), m),
                _gaussian_angle,
                smooth=u[0] > 0.1,
                ulps=64,
            )
    yield Hard(
        "warps.cosine_hemisphere",
        "corner",
        warps.cosine_hemisphere,
        (np.array([0.0, 0.0]),),
        lambda u: np.array([LD(0), LD(0), LD(1)]),
        smooth=False,
    )
    for cos, sin2, n in (
        (1.0, 0.0, 1e6),
        (1 - 5e-8, 1e-7, 1e6),
        (0.6, 0.64, 0.0),
        (1e-5, 1.0, 2.0),
    ):
        for name, constant in (("power", lambda n: 1), ("power_cosine_density", _per_sphere)):
            yield Hard(
                f"warps.{name}",
                f"{cos} {n:g}",
                getattr(warps, name),
                (cos, sin2, n),
                lambda c, s, n, k=constant: (
                    k(n) * (np.exp(n / 2 * np.log1p(-s)) if s < 0.5 else c**n)
                ),
                ulps=32,
                smooth=n < 1e3,  # differences see curvature first at 1e6
            )
    for theta2, m in ((0.0, 0.3), (1e-9, 1e-4), (0.09, 0.3), (2.0, 1.5)):
        yield Hard(
            "warps.gaussian_angle_density",
            f"{theta2} {m}",
            warps.gaussian_angle_density,
            (theta2, m),
            lambda t, m: (
                (np.sqrt(t) / np.sin(np.sqrt(t)) if t else LD(1))
                * np.exp(-t / m**2)
                / (PI * m * m * -np.expm1(-((PI / 2 / m) ** 2)))
            ),
            ulps=32,
            smooth=theta2 > 1e-3,
        )


def _per_sphere(n):
    return (n + 1) / (2 * PI)


def _power_cosine(u, n):
    cos2 = np.exp(2 * np.log1p(-u[0]) / (n + 1))
    return _around(u[1], cos2, -np.expm1(2 * np.log1p(-u[0]) / (n + 1)))


def _gaussian_angle(u, m):
    theta = m * np.sqrt(-np.log1p(np.expm1(-((PI / 2 / m) ** 2)) * u[0]))
    sin = np.sin(theta)
    return np.array([sin * np.cos(2 * PI * u[1]), sin * np.sin(2 * PI * u[1]), np.cos(theta)])
