"""Random scenes for the compression of stored transfer (`CompressionSettings.tolerance`).

What is read back from a store is compared with what was precomputed, by the closed form of the
distance of lobes in float64: root mean square over all slices of all views, each over the root
mean square of the norms of its material's slices.
"""

import functools
import tempfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt import scenes
from diffopt.accuracy.promises import Answer, Draw, Promise
from diffopt.materials import BlinnPhong, Lambert, Material, Microfacet, Sum
from diffopt.scenes import Object, Scene
from diffopt.transfer import precomputation, references, store
from diffopt.transfer.compression import CompressionSettings
from diffopt.transfer.result import Transfer
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.views import hemisphere

#: Small; the errors of rays and refinement are not asked about here.
SETTINGS = TransferSettings(rays=256, finest=2, splits=1, tolerance=0.4)
# Concentrations below this are even: the closed form would divide 0 by 0.
_EVEN = 1e-8


def scene(rng: np.random.Generator) -> tuple[Scene, str]:
    """A glossy ring, in half of the scenes on a glossy floor."""
    ring = scenes.models.torus(1.0, float(rng.uniform(0.25, 0.6)), 8, 5)
    glaze, words = _glossy(rng)
    objects = [Object(ring, glaze)]
    if rng.uniform() < 0.5:
        floor, more = _glossy(rng)
        objects.append(Object(scenes.Plane(4.0, 4.0), floor, scenes.translate(0.0, 0.0, -0.6)))
        words = f"{words} on {more}"
    return Scene(objects), words


def _glossy(rng: np.random.Generator) -> tuple[Material, str]:
    matte = Lambert(rng.uniform(0.05, 0.5, 3))
    if rng.uniform() < 0.5:
        exponent = float(np.exp(rng.uniform(np.log(4.0), np.log(500.0))))
        coat: Material = BlinnPhong(rng.uniform(0.1, 0.5, 3), exponent)
        words = f"exponent {exponent:.3g}"
    else:
        alpha = float(rng.uniform(0.1, 0.6))
        coat, words = Microfacet(alpha), f"alpha {alpha:.2f}"
    return Sum((matte, coat)), words


def slices(transfer: Transfer) -> tuple[list[np.ndarray], np.ndarray]:
    """Of all views of all vertices: weights, axes, concentrations (float64); the material."""
    counts = np.array((*hemisphere(SETTINGS.finest).counts, 0))
    length = counts[transfer.level]
    vertex = np.repeat(np.arange(len(length)), length)
    view = np.arange(len(vertex)) - np.repeat(np.cumsum(length) - length, length)
    over = references.unpacked(
        jnp.asarray(transfer.unoccluded[transfer.reflector[vertex], view]), transfer.lobes
    )
    held = Slices(*(jnp.asarray(a[transfer.first[vertex] + view]) for a in transfer.views))
    alpha, mu, kappa = (np.asarray(a, np.float64) for a in references.absolute(held, over))
    # A length that is off by 6e-8 counts kappa times over.
    mu /= np.linalg.norm(mu, axis=-1, keepdims=True)
    return [alpha, mu, kappa], transfer.reflector[vertex]


def inner(one: list[np.ndarray], other: list[np.ndarray]) -> np.ndarray:
    """Integral over the sphere of the products of lobes of two slices, summed over lobes.

    Of normalised densities it is C(k1) C(k2) / C(|k1 mu1 + k2 mu2|), C(k) = k / (4 pi sinh k)
    (Mardia and Jupp 2000, Directional Statistics, section 9.3.2).
    """
    (a, m, k), (b, n, q) = one, other
    joint = np.linalg.norm(k[..., None] * m + q[..., None] * n, axis=-1)
    log = _log_normaliser(k) + _log_normaliser(q) - _log_normaliser(joint)
    return (a * b * np.exp(log)[..., None]).sum((-3, -2, -1))


def _log_normaliser(k: np.ndarray) -> np.ndarray:
    safe = np.maximum(k, _EVEN)
    # sinh k = e^k (1 - e^-2k) / 2.
    return np.log(safe / (2.0 * np.pi)) - safe - np.log(-np.expm1(-2.0 * safe))


def apart(one: Transfer, other: Transfer) -> float:
    """Root-mean-square distance of slices over the root-mean-square norm of their material."""
    (a, material), (b, _) = slices(one), slices(other)
    norm, both, own = inner(a, a), inner(a, b), inner(b, b)
    mean = np.bincount(material, norm) / np.maximum(np.bincount(material), 1)
    squares = np.maximum(norm - 2.0 * both + own, 0.0) / mean[material]
    return float(np.sqrt(squares.mean()))


@functools.lru_cache(maxsize=1)
def _precomputed(seed: int) -> tuple[Transfer, str]:
    subject, words = scene(np.random.default_rng(seed))
    return precomputation.precompute(subject, SETTINGS), words


def _answer(draw: Draw) -> Answer:
    transfer, words = _precomputed(int(draw.rng.integers(2**31)))
    shared = bool(draw.rng.uniform() < 0.5)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "found.zarr"
        record: dict[str, Any] = store.save(
            path, transfer, {}, CompressionSettings(draw.tolerance, shared)
        )
        error = apart(transfer, store.load(path))
    told = record["compression"]["errors"]["views"]["rms"]
    words = f"{words}, {len(transfer.views.kappa)} slices, stated {told:.3g}"
    return Answer(words, error)


COMPRESSION = Promise(
    name="transfer.compression",
    entry="CompressionSettings(tolerance)",
    quantity="RMS distance of slices (L2 over the sphere) over the RMS norm of their material's",
    reference="closed forms in float64 of what was precomputed",
    answer=_answer,
    tolerances=(1e-4, 5e-1),
    x64=False,
    shared=True,
)
