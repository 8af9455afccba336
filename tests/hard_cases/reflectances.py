"""Fresnel's reflectances."""

import numpy as np

from diffopt.kernels import fresnel
from hard_cases.base import Hard


def _dielectric(cos, n):
    ct = np.sqrt(np.asarray(1 - (1 - cos**2) / n**2, np.clongdouble))
    rs, rp = (cos - n * ct) / (cos + n * ct), (n * cos - ct) / (n * cos + ct)
    return np.abs(rs) ** 2, np.abs(rp) ** 2


def _conductor(cos, eta, k):
    return _dielectric(cos, eta + 1j * k)


def reflectances():
    for cos in (0.0, 1e-20, 1e-4, 0.5, 1.0):
        edge = cos in (0.0, 1e-20, 1.0)
        for n in (0.67, 1.0 + 2.0**-20, 1.5):
            smooth = (n == 1.5 and not edge) or (cos == 0.5 and n == 0.67)
            arguments = (np.float64(cos), n)
            yield Hard(
                "fresnel.dielectric_polarised",
                f"cos={cos}, n={n}",
                fresnel.dielectric_polarised,
                arguments,
                _dielectric,
                ulps=60,
                smooth=smooth,
                gradient_ulps=1e5,
            )
            yield Hard(
                "fresnel.dielectric",
                f"cos={cos}, n={n}",
                fresnel.dielectric,
                arguments,
                lambda c, n: sum(_dielectric(c, n)) / 2,
                ulps=60,
                smooth=smooth,
                gradient_ulps=1e5,
            )
        for eta, k in ((0.96, 6.7), (1.5, 1e-6), (0.05, 3.0)):
            arguments = (np.float64(cos), eta, k)
            yield Hard(
                "fresnel.conductor_polarised",
                f"cos={cos}, {eta}+{k}i",
                fresnel.conductor_polarised,
                arguments,
                _conductor,
                ulps=60,
                smooth=not edge,
                gradient_ulps=1e5,
            )
            yield Hard(
                "fresnel.conductor",
                f"cos={cos}, {eta}+{k}i",
                fresnel.conductor,
                arguments,
                lambda c, e, k: sum(_conductor(c, e, k)) / 2,
                ulps=60,
                smooth=not edge,
                gradient_ulps=1e5,
            )
        yield Hard(
            "fresnel.schlick",
            f"cos={cos}",
            fresnel.schlick,
            (np.float64(cos), 0.04),
            lambda c, r: r + (1 - r) * (1 - c) ** 5,
            smooth=not edge,
        )
    for re, im in ((-40.0, 15.0), (2.25, 0.0), (-9.0, 1e-6), (1e-3, 1e-3)):
        yield Hard(
            "fresnel.index_from_permittivity",
            f"{re}+{im}i",
            fresnel.index_from_permittivity,
            (re, im),
            _index,
            ulps=20,
            smooth=im > 1e-3,
        )


def _index(re, im):
    size = np.hypot(re, im)
    larger = np.sqrt((size + np.abs(re)) / 2)
    smaller = im / (2 * larger)
    return (larger, smaller) if re >= 0 else (smaller, larger)
