"""Energy that rough facets lose by scattering once, and what compensation gives back.

Facets that reflect everything lose nothing: light that one of them throws onto another goes
on until it leaves, and the albedo is 1 at every roughness. What single scattering leaves out is
the error. For coloured facets the truth is a random walk on Smith's surface (Heitz, Hanika,
d'Eon and Dachsbacher, "Multiple-scattering microfacet BSDFs with the Smith model", 2016).
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt.accuracy.studies import Case, Job, Study
from diffopt.fresnel import Constant, Reflectance, metal
from diffopt.kernels.microfacet import Normals
from diffopt.materials import Microfacet

#: Wavelengths at which coloured facets are judged, um.
WAVELENGTHS = np.array([0.45, 0.55, 0.65])
# Nodes of Gauss's rule on each axis, for each of the two maps of `hemisphere`.
_NODES = 96


def hemisphere(
    normals: Normals, alpha: float, view: Float[np.ndarray, "3"], nodes: int = _NODES
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, " M"]]:
    """Directions to the light and weights, so that the albedo is the sum of weight times f.

    Two maps of the unit square, facets as they lie and directions by their cosine, share the
    hemisphere in proportion to their densities (Veach's balance heuristic): a narrow lobe and a
    wide one are integrated alike, to 1e-4 for `alpha` of at least 0.05, and nothing of the
    material's own sampling is used.

    Parameters
    ----------
    normals
        ``ggx`` or ``beckmann``.
    alpha
        Width of the normals.
    view
        Unit vector in the plane y = 0: half of the hemisphere stands for both.
    nodes
        On each axis of the square.
    """
    x, w = np.polynomial.legendre.leggauss(nodes)
    u, turn = (a.ravel() for a in np.meshgrid(0.5 * (x + 1.0), 0.5 * np.pi * (x + 1.0)))
    share = 0.25 * np.outer(w, w).ravel()
    tan2 = alpha**2 * (u / (1.0 - u) if normals == "ggx" else -np.log1p(-u))
    facets = _direction(1.0 / np.sqrt(1.0 + tan2), turn)
    mirrored = 2.0 * (facets @ view)[:, None] * facets - view
    wi = np.concatenate([mirrored, _direction(np.sqrt(u), turn)])
    total = wi + view
    length = np.sqrt((total * total).sum(-1))
    half = total / length[:, None]
    # Facets turned away from the viewer mirror him from behind; light comes from above.
    behind = np.concatenate([facets @ view <= 0.0, np.full(len(u), False)])
    seen = ~behind & (wi[:, 2] > 0.0)
    by_facets = _density(normals, alpha, half) * half[:, 2] / (2.0 * length)
    density = np.where(seen, by_facets + wi[:, 2] / np.pi, 1.0)
    weight = np.where(seen, wi[:, 2] * np.tile(share, 2) / density, 0.0)
    # f is asked above the horizon only.
    return np.where(seen[:, None], wi, [0.0, 0.0, 1.0]), weight


def walk(
    reflectance: Reflectance,
    alpha: float,
    view: Float[np.ndarray, "3"],
    wavelengths: Float[np.ndarray, " L"] = WAVELENGTHS,
    count: int = 200_000,
    seed: int = 0,
) -> tuple[Float[np.ndarray, "B L"], Float[np.ndarray, " L"]]:
    """Random walk on Smith's surface with GGX normals, in float64.

    Heights enter as the share of the surface below, s: a ray goes from s to
    s (1 - u)^(-1 / Lambda), u random and Lambda Smith's (negative for a ray that goes down), and
    leaves where that passes 1. It meets facets as they are seen, and keeps their reflectance.

    Parameters
    ----------
    reflectance
        Of the facets.
    alpha
        Width of the normals, isotropic.
    view
        Unit vector that light comes from.
    wavelengths
        In micrometres.
    count, seed
        Of the walkers.

    Returns
    -------
    tuple
        The albedo by the number of facets met, from 1 [B, L], and the standard error of their
        sum [L].
    """
    rng = np.random.default_rng(seed)
    cosines = np.linspace(0.0, 1.0, 4001)
    with jax.enable_x64(True):
        table = np.asarray(reflectance(jnp.asarray(cosines), jnp.asarray(wavelengths)))
    ray = np.tile(-view, (count, 1))
    below, power = np.ones(count), np.ones((count, len(wavelengths)))
    by_bounces, squares = [], np.zeros(len(wavelengths))
    while len(ray):
        up = np.where(ray[:, 2] < 0.0, -1.0, 1.0)
        # Straight up nothing masks (Lambda is 0), and the ray leaves; level it stays where it is.
        with np.errstate(divide="ignore", over="ignore"):
            masked = 0.5 * (up * _projected(alpha, ray) / np.abs(ray[:, 2]) - 1.0)
            below = below * (1.0 - rng.random(len(ray))) ** (-1.0 / masked)
        leaves = below > 1.0
        by_bounces.append(power[leaves].sum(0) / count)
        squares += (power[leaves] ** 2).sum(0) / count
        ray, below, power = ray[~leaves], below[~leaves], power[~leaves]
        facets = _visible(alpha, -ray, rng)
        cos = -(ray * facets).sum(-1)
        met = [np.interp(cos, cosines, column) for column in table.T]
        power = power * np.stack(met, -1)
        ray = ray + 2.0 * cos[:, None] * facets
    albedo = np.sum(by_bounces, 0)
    # The first ray comes from outside, and meets a facet.
    variance = np.maximum(squares - albedo**2, 0.0)
    return np.stack(by_bounces[1:]), np.sqrt(variance / count)


def _projected(alpha: float, w: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
    """sqrt(z^2 + alpha^2 (x^2 + y^2)): z (1 + 2 Lambda) of GGX normals, on either side."""
    return np.sqrt(w[:, 2] ** 2 + alpha**2 * (w[:, 0] ** 2 + w[:, 1] ** 2))


def _visible(alpha: float, w: Float[np.ndarray, "N 3"], rng: np.random.Generator) -> np.ndarray:
    """Facets that w meets, GGX, from either side of the horizon (spherical caps)."""
    stretched = w * [alpha, alpha, 1.0] / _projected(alpha, w)[:, None]
    u = rng.random((2, len(w)))
    cos = 1.0 - u[0] * (1.0 + stretched[:, 2])
    facets = (_direction(cos, 2.0 * np.pi * u[1]) + stretched) * [alpha, alpha, 1.0]
    return facets / np.sqrt((facets * facets).sum(-1, keepdims=True))


def _direction(cos: np.ndarray, turn: np.ndarray) -> np.ndarray:
    sin = np.sqrt(np.maximum(1.0 - cos * cos, 0.0))
    return np.stack([sin * np.cos(turn), sin * np.sin(turn), cos], -1)


def _density(normals: Normals, alpha: float, half: np.ndarray) -> np.ndarray:
    """D per steradian; 0 below the horizon."""
    cos2 = np.maximum(half[:, 2], 1e-9) ** 2
    tan2 = (1.0 - cos2) / (cos2 * alpha**2)
    falls = (1.0 + tan2) ** -2.0 if normals == "ggx" else np.exp(-tan2)
    return np.where(half[:, 2] > 0.0, falls / (np.pi * alpha**2 * cos2**2), 0.0)


def _value(material: Microfacet, wi: jax.Array, wo: jax.Array) -> jax.Array:
    return material.f(wi, wo)


def _energy(quick: bool) -> list[Case]:
    """Perfect facets against 1, gold ones against the walk, with and without compensation."""

    @functools.cache
    def gold(alpha, angle):
        walked, deviation = walk(metal("Au", "measured"), alpha, _view(angle))
        return walked.sum(0), float(deviation.max())

    def case(facets, normals, alpha, angle, compensation):
        coloured = facets == "gold"

        def build():
            view = _view(angle)
            wi, weight = hemisphere(normals, alpha, view)
            fresnel = metal("Au", "measured") if coloured else Constant()
            material = Microfacet(
                alpha,
                fresnel,
                WAVELENGTHS if coloured else WAVELENGTHS[1],
                normals,
                compensation=compensation,
            ).typed("float32")
            pair = (jnp.asarray(w, "float32") for w in (wi, np.broadcast_to(view, wi.shape)))

            def judge(value):
                albedo = weight @ np.asarray(value, np.float64)
                if not coloured:
                    return abs(float(1.0 - albedo)), f"albedo {albedo:.4f}"
                right, deviation = gold(alpha, angle)
                shown = [" ".join(f"{v:.3f}" for v in values) for values in (albedo, right)]
                return float(np.abs(albedo - right).max()), (
                    f"albedo {shown[0]}, walk {shown[1]} +- {deviation:.4f}"
                )

            return Job(_value, (material, *pair), judge)

        settings = {
            "facets": facets,
            "normals": normals,
            "alpha": alpha,
            "view_deg": angle,
            "compensation": compensation,
        }
        return Case(settings, "float32", build, program=(facets, normals, compensation))

    widths = (0.25, 1.0) if quick else (0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
    problems = [
        ("perfect", normals, alpha, angle)
        for normals in ("ggx", "beckmann")
        for angle in ((0.0, 60.0) if quick else (0.0, 60.0, 80.0))
        for alpha in widths
    ]
    problems += [
        ("gold", "ggx", alpha, angle)
        for angle in ((0.0,) if quick else (0.0, 60.0, 80.0))
        for alpha in ((1.0,) if quick else (0.25, 0.5, 1.0))
    ]
    return [
        case(*problem, compensation)
        for problem in problems
        for compensation in ("none", "kulla-conty")
    ]


def _view(angle: float) -> np.ndarray:
    t = math.radians(angle)
    return np.array([math.sin(t), 0.0, math.cos(t)])


ENERGY = Study(
    name="material.energy",
    quantity="energy that rough facets lose or gain: error of the albedo, of gold the largest of "
    f"those at 450, 550 and 650 nm; time of {2 * _NODES**2:,} values of f",
    reference="1 for perfect facets; for gold a random walk on Smith's surface",
    cases=_energy,
    conditions=("facets", "normals", "view_deg", "alpha"),
    against="alpha",
)
