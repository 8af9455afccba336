"""Slices from shared rays and from paths of their own, against the moments of many paths."""

import dataclasses
import functools
import time
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.accuracy import transfer_runs, transfer_scenes, transfer_truth
from diffopt.kernels.langevin import inverse_langevin
from diffopt.transfer import beginning, path_sampling, slices, tracing, weighting
from diffopt.transfer.angular import Estimator
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.tracing import Frames, Surroundings
from diffopt.transfer.views import hemisphere
from diffopt.transfer.weighting import Weights

#: Estimators.
WAYS = ("paths, lobes", "paths, reflectance", "shared rays")
# Vertices among which those are chosen that see much of the scene, and rays of each.
_AMONG, _RAYS = 400, 256
# Share of the hemisphere that is hidden from those chosen, at most.
_HIDDEN = 0.6
# Hits nearer than this many offsets are the surface itself, as in `diffopt.transfer.tracing`.
_NEAR = 50.0


@dataclasses.dataclass(frozen=True)
class Problem:
    """Slices on which estimators are compared.

    Attributes
    ----------
    scene
        Of `diffopt.accuracy.transfer_scenes`; the vertices are those of its first material.
    vertices
        How many: those that see most of the scene.
    level
        Of their views.
    paths
        Of each slice for the truth, a multiple of 8.
    detail
        Of the meshes.
    """

    scene: str
    vertices: int = 12
    level: int = 1
    paths: int = 16384
    detail: int = 8


@dataclasses.dataclass(frozen=True)
class Compared:
    """Errors of an estimator, and its time.

    Attributes
    ----------
    direct, indirect
        RMS error of the integrals of the direct, and of both indirect kinds, over the RMS of
        the integrals of all kinds together.
    angle
        RMS of degrees between the axes of the direct lobes and the true ones, weighed by light.
    kappa
        RMS error of the logarithm of the concentrations of the direct lobes, weighed by light.
    radiance
        RMS error of the radiance under the lobes of light, over its RMS.
    seconds
        Of a slice, in the second run.
    compile_s
        By which the first run was longer.
    rays
        Cast for a slice, secondary ones included.
    """

    direct: float
    indirect: float
    angle: float
    kappa: float
    radiance: float
    seconds: float
    compile_s: float
    rays: float

    def __str__(self) -> str:
        """For a note."""
        return (
            f"direct {self.direct:.2g}, indirect {self.indirect:.2g}, axis {self.angle:.2g} "
            f"degrees, concentration {self.kappa:.2g}; {1e6 * self.seconds:.3g} us and "
            f"{self.rays:.3g} rays a slice"
        )


class _Known(NamedTuple):
    """Lobes of kinds in the world: [S, 3], [S, 3, 3], [S, 3]."""

    alpha: np.ndarray
    mu: np.ndarray
    kappa: np.ndarray


class _Solved(NamedTuple):
    around: Surroundings
    number: int
    at: Frames
    views: np.ndarray
    right: _Known


@functools.lru_cache(maxsize=4)
def _solved(problem: Problem) -> _Solved:
    scene = transfer_scenes.subject(problem.scene, problem.detail).scene
    around = beginning.surroundings(scene)
    mesh = beginning.begun(around)
    axes = beginning.frames(mesh)
    number = int(around.owner[0])
    own = np.unique(mesh.faces[mesh.label == number])
    some = own[np.unique(np.linspace(0, len(own) - 1, min(_AMONG, len(own))).astype(int))]
    vertices = Frames(mesh.vertices[some], axes[some])
    found = tracing.columns(around, vertices, weighting.spiral(_RAYS), 1, 0)
    hidden = 1.0 - found[:, :, 0].mean(1)
    order = np.argsort(-np.where(hidden < _HIDDEN, hidden, -hidden), kind="stable")
    rows = np.sort(order[: problem.vertices])
    at = Frames(vertices.position[rows], vertices.axes[rows])
    views = hemisphere(problem.level).views
    wo = np.einsum("vj,nji->nvi", views, at.axes).reshape(-1, 3)
    normal = np.repeat(at.axes[:, 2], len(views), axis=0)
    place = np.repeat(at.position, len(views), axis=0)
    glossy = transfer_truth.formula(scene.objects[0].material)
    # The glossy rest alone: what slices of views hold.
    material = np.broadcast_to([0.0, *glossy[1:]], normal.shape)
    points = transfer_truth.Points(place, normal, normal, wo, material)
    near = _NEAR * around.caster.offset
    whole, first = transfer_truth.moments(scene, points, problem.paths, near=near)
    sharpest = np.asarray(Estimator(around, number, TransferSettings()).sharpest)
    return _Solved(around, number, at, views, _lobes(whole, first, sharpest))


def _lobes(whole: np.ndarray, first: np.ndarray, sharpest: np.ndarray) -> _Known:
    with jax.enable_x64(True):
        length = np.linalg.norm(first, axis=-1)
        ratio = length / np.where(whole > 0.0, whole, 1.0)
        rest = np.clip(1.0 - ratio, 1.0 / sharpest, 1.0)
        kappa = np.asarray(inverse_langevin(jnp.asarray(1.0 - rest), jnp.asarray(rest)))
    up = np.broadcast_to([0.0, 0.0, 1.0], first.shape)
    some = (length > 0.0)[..., None]
    mu = np.where(some, first / np.where(some, length[..., None], 1.0), up)
    return _Known(whole, mu, np.minimum(kappa, sharpest))


def compared(problem: Problem, way: str, count: int, seed: int = 0) -> Compared:
    """Error and time of an estimator.

    Parameters
    ----------
    problem
        The slices.
    way
        Of `WAYS`.
    count
        Paths of a slice, or rays of a vertex.
    seed
        Of the random numbers.
    """
    checks.choice("way", way, WAYS)
    solved = _solved(problem)
    number = len(solved.at.position) * len(solved.views)
    begun = time.perf_counter()
    run = _prepared(solved, problem, way, count, seed)
    run()
    first = time.perf_counter() - begun
    begun = time.perf_counter()
    found, rays = run()
    seconds = time.perf_counter() - begun
    axes = np.repeat(solved.at.axes, len(solved.views), axis=0)
    alpha = np.asarray(found.alpha, np.float64).mean(-1).reshape(-1, 3)
    mu = np.einsum("skj,sji->ski", np.asarray(found.mu, np.float64).reshape(-1, 3, 3), axes)
    kappa = np.asarray(found.kappa, np.float64).reshape(-1, 3)
    right = solved.right
    norm = np.sqrt((right.alpha**2).sum(-1).mean())
    off = alpha - right.alpha
    weight = right.alpha[:, 0] / right.alpha[:, 0].sum()
    angle = np.degrees(np.arccos(np.clip((mu[:, 0] * right.mu[:, 0]).sum(-1), -1.0, 1.0)))
    ratio = np.log(np.maximum(kappa[:, 0], 1e-3) / np.maximum(right.kappa[:, 0], 1e-3))
    lit, truth = (_radiance(a, m, k) for a, m, k in ((alpha, mu, kappa), right))
    return Compared(
        direct=float(np.sqrt((off[:, 0] ** 2).mean()) / norm),
        indirect=float(np.sqrt((off[:, 1:] ** 2).sum(-1).mean()) / norm),
        angle=float(np.sqrt((weight * angle**2).sum())),
        kappa=float(np.sqrt((weight * ratio**2).sum())),
        radiance=float(np.sqrt(((lit - truth) ** 2).mean() / (truth**2).mean())),
        seconds=seconds / number,
        compile_s=max(first - seconds, 0.0),
        rays=rays / number,
    )


def _radiance(alpha: np.ndarray, mu: np.ndarray, kappa: np.ndarray) -> Float[np.ndarray, " S"]:
    light = transfer_runs.lighting("suns")
    each = light.radiance(jnp.asarray(mu, jnp.float32), jnp.asarray(kappa, jnp.float32))
    return (alpha * np.asarray(each, np.float64)[..., 0]).sum(-1)


def _prepared(solved: _Solved, problem: Problem, way: str, count: int, seed: int) -> Any:
    """A function that gives slices and the number of rays; tables of materials are made here."""
    if way == "shared rays":
        settings = TransferSettings(rays=count, seed=seed)
        estimator = Estimator(solved.around, solved.number, settings)
        parts = [estimator.weights(level) for level in range(problem.level + 1)]

        def shared() -> Any:
            columns = estimator.columns(solved.at)
            found = [_moments(part, jnp.asarray(columns), estimator.sharpest) for part in parts]
            joined = jax.tree.map(lambda *a: jnp.concatenate(a, 1), *found)
            rays = columns.shape[0] * columns.shape[1]
            # A second ray for each term of what is met: one, but for sums of materials.
            second = int((columns[..., 0] == 0.0).sum())
            return jax.block_until_ready(joined), rays + second

        return shared
    kind = way.split(", ")[1]
    sampler = path_sampling.PathSampler(solved.around, solved.number, kind)

    def drawn() -> Any:
        found = sampler(solved.at, solved.views, count, 2, seed)
        return jax.block_until_ready(found.slices), found.rays

    return drawn


@eqx.filter_jit
def _moments(weights: Weights, columns: Float[Array, "n N P"], sharpest: Array) -> Any:
    return slices.from_moments(weights, columns, sharpest)
