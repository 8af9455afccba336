"""What accuracy costs for lobes of samples: how many samples, and which of three fits.

Likelihood and square error have different optima: EM on the samples themselves holds with few of
them, least squares on bins is closer with many.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.accuracy.studies import Case, Job, Study
from diffopt.fitting import lobe_samples
from diffopt.fitting.lobe_settings import LobeSettings
from diffopt.fitting.lobe_studies import truth
from diffopt.fitting.lobes import Nodes, fit_nodes
from diffopt.kernels import frames, mixture, vmf, vmf_sampling

# Rings and sectors of the bins, which have equal shares of a lobe a quarter as sharp.
_BINS = (20, 32)
# Below one over the solid angle of the smallest bin.
_SHARPEST = 1e3


def drawn(count: int, exponent: float, degrees: float, seed: int = 5) -> Float[np.ndarray, "N 3"]:
    """Directions with the density of a slice, exactly.

    Half vectors of density (n.h)^(e+1), mirrored; of these the share cos (h.o) / (2 (n.h)) < 1.
    """
    rng = np.random.default_rng(seed)
    t = np.radians(degrees)
    view = np.array([np.sin(t), 0.0, np.cos(t)])
    found: list[np.ndarray] = []
    while sum(map(len, found)) < count:
        u, turn, keep = rng.random((3, 400_000 if count > 10_000 else 100_000))
        z = u ** (1.0 / (exponent + 2.0))
        r, phi = np.sqrt(1.0 - z * z), 2.0 * np.pi * turn
        half = np.stack([r * np.cos(phi), r * np.sin(phi), z], -1)
        seen = half @ view
        wi = 2.0 * seen[:, None] * half - view
        found.append(wi[(seen > 0.0) & (2.0 * z * keep < wi[:, 2] * seen)])
    return np.concatenate(found)[:count]


def _binned(directions: Float[Array, "N 3"]) -> Nodes:
    """Samples as a table: bins about the mean with equal shares of a wide lobe."""
    count, (rings, sectors) = directions.shape[0], _BINS
    _, mu, kappa = mixture.moments(directions, jnp.ones_like(directions[:, 0]), _SHARPEST)
    wide = 0.25 * kappa
    first, second = frames.tangents(mu)
    share = jnp.expm1(-wide * vmf.complement(directions, mu[None])) / jnp.expm1(-2.0 * wide)
    turn = 0.5 + jnp.arctan2(directions @ second, directions @ first) / (2.0 * np.pi)
    ring, sector = (
        jnp.clip((size * x).astype(int), 0, size - 1)
        for x, size in ((share, rings), (turn, sectors))
    )
    mass = jnp.zeros(rings * sectors, kappa.dtype).at[ring * sectors + sector].add(1.0 / count)
    edges = vmf_sampling.one_minus_cosine(jnp.arange(rings, dtype=kappa.dtype) / rings, wide)
    solid = jnp.diff(edges, append=2.0) * (2.0 * np.pi / sectors)
    solid = jnp.repeat(solid, sectors)
    v, u = (jnp.arange(0.5, n, dtype=kappa.dtype) / n for n in (rings, sectors))
    # `warp` counts turns from the first tangent on, the bins from its opposite.
    square = jnp.stack([jnp.tile(u - 0.5, rings) % 1.0, jnp.repeat(v, sectors)], -1)
    centres = vmf_sampling.warp(square, mu[None], wide[None])
    return Nodes(centres[None], solid[None], (mass / solid)[None, :, None])


def _samples(quick: bool) -> list[Case]:
    """Lobes of samples of one slice: moments, EM on the samples, least squares on bins."""
    exponent, degrees = 32.0, 60.0
    given = functools.cache(functools.partial(drawn, exponent=exponent, degrees=degrees))
    chosen = LobeSettings(sharpest=_SHARPEST)

    def likeliest(samples, key, lobes):
        weights = jnp.ones_like(samples[:, 0])
        return lobe_samples._fitted(samples, weights, key, lobes, 50, _SHARPEST)[0]

    def squares(samples, key):
        found = fit_nodes(_binned(samples), 4, settings=chosen, key=key).lobes
        return found.alpha[0], found.mu[0], found.kappa[0]

    methods: dict[str, Callable[..., Any]] = {
        "moments": functools.partial(likeliest, lobes=1),
        "EM": functools.partial(likeliest, lobes=4),
        "least squares": squares,
    }

    def judge(value):
        right = truth(exponent, degrees)
        whole = float(right.solid_angles @ right.values)
        error = right._replace(values=right.values / whole).error(*value)
        return error, "kappa " + ", ".join(f"{k:.3g}" for k in np.sort(np.asarray(value[2])))

    def case(count, method):
        def build():
            samples = jnp.asarray(given(count), "float32")
            return Job(methods[method], (samples, jax.random.key(0)), judge)

        return Case({"samples": count, "method": method}, "float32", build)

    counts = (10_000,) if quick else (100, 1_000, 10_000, 100_000, 1_000_000)
    return [case(count, method) for count in counts for method in methods]


SAMPLES = Study(
    name="lobes.samples",
    quantity="relative L2 error over the sphere of the density of samples of a slice, 1 lobe by "
    "moments, 4 by EM and by least squares on bins",
    reference="the slice (Blinn-Phong's exponent 32 at 60 degrees) in float64 on 96 x 144 nodes",
    cases=_samples,
    against="samples",
)
