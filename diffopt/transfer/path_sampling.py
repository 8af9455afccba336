"""Slices by paths of their own: the estimator of the glossy-transfer paper, for comparison.

Each slice sends out its own paths, drawn from a lobe that stands for the glossy rest of its
material; where they meet a surface, a diffuse and a glossy lobe are drawn in turn (its sections
5.1 and 5.2). `diffopt.transfer.angular` gets the same slices from one set of rays that all views
of a vertex share. The paper's formulas are put right: directions are averaged by the weights of
their paths (eqs. 13 and 14), the integral is the mean of the weights over all paths that were
begun (eq. 15), and concentrations come from the exact inverse.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt import checks
from diffopt.errors import InputError
from diffopt.kernels import vmf, vmf_sampling
from diffopt.kernels.frames import dot
from diffopt.kernels.langevin import inverse_langevin
from diffopt.scenes import world
from diffopt.transfer import references, weighting
from diffopt.transfer.angular import Estimator
from diffopt.transfer.references import Reference
from diffopt.transfer.reflectors import Reflector
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.tracing import Frames, Surroundings
from diffopt.transfer.views import hemisphere

# Paths that one compiled program follows.
_BLOCK = 2**15
# Directions of the rule by which lobes of the materials are found.
_RULE = 4096
# Hits nearer than this many offsets are the surface itself, as for shared rays.
_NEAR = 50.0
# Of the cosine: mean cosine 2/3.
_COSINE = 2.0 / 3.0


class Drawn(NamedTuple):
    """Slices of pairs of a vertex and a view, and what they come from.

    Attributes
    ----------
    slices
        In the local frames of the vertices, [S, 3, 1, ...].
    rays
        Cast in all.
    """

    slices: Slices
    rays: int


class _Lobes(NamedTuple):
    """Sums over paths, by slice: weights [S, 3, C], their mean times directions [S, 3, 3]."""

    whole: np.ndarray
    first: np.ndarray


class PathSampler:
    """Computes slices of vertices of one material, each from its own paths.

    Parameters
    ----------
    around
        The scene, see `diffopt.transfer.beginning.surroundings`.
    number
        Which of its reflectors the vertices have; it must have a glossy rest.
    weights
        "lobes": a lobe stands for the reflectance, as in the paper, which leaves an error however
        many paths there are; "reflectance": paths are weighed by what the reflectance is over the
        lobe, right on average, but with rare heavy paths where the lobe is too narrow.

    Raises
    ------
    InputError
        For a material without a glossy rest, or another word for the weights.
    """

    def __init__(self, around: Surroundings, number: int, weights: str = "lobes") -> None:
        self.exact = checks.choice("weights", weights, ("lobes", "reflectance")) == "reflectance"
        self.around, self.number = around, number
        if around.reflectors[number].glossy is None:
            raise InputError(f"reflector {number} must have a glossy rest; it is matte")

    @functools.cached_property
    def lobes(self) -> tuple[Reference | None, ...]:
        """One lobe of the glossy rest of each material, over views: moments, as eq. 9 is fitted."""
        return tuple(self._table(k) for k in range(len(self.around.reflectors)))

    @functools.cached_property
    def sharpest(self) -> np.ndarray:
        """Largest concentration of each kind, as for shared rays."""
        settings = TransferSettings(rays=_RULE)
        return np.asarray(Estimator(self.around, self.number, settings).sharpest)

    def _table(self, number: int) -> Reference | None:
        made = self.around.reflectors[number]
        if made.glossy is None:
            return None
        sphere = hemisphere(references.LEVEL)
        among = weighting.directions(_RULE, max(weighting.fineness(made, _RULE), 1))
        found = weighting.glossy(made, among, sphere, slice(0, len(sphere.views)), 1)
        arrays = (np.asarray(a) for a in (found.alpha, found.mu, found.kappa))
        return references.reference([references.pack(*arrays)], 1, references.LEVEL)

    def __call__(
        self,
        vertices: Frames,
        views: Float[np.ndarray, "V 3"],
        paths: int,
        depth: int = 2,
        seed: int = 0,
    ) -> Drawn:
        """Slices of vertices for views, from `paths` paths each.

        Parameters
        ----------
        vertices
            n of them.
        views
            Unit vectors in the local frames, above the horizon.
        paths
            Begun for each slice, 1 to 10 million.
        depth
            Surfaces that a path meets at most.
        seed
            Of the random numbers.

        Returns
        -------
        Drawn
            Slices [n V, 3, 1, ...], those of a vertex one after the other.
        """
        for name, value, most in (("paths", paths, 10**7), ("depth", depth, 16)):
            if not 1 <= value <= most:
                raise InputError(f"{name} must be from 1 to {most:,}; received {value}")
        count, channels = len(vertices.position) * len(views), self.around.channels
        sums = _Lobes(np.zeros((count, 3, channels)), np.zeros((count, 3, 3)))
        rays = 0
        for start in range(0, count * paths, _BLOCK):
            row = np.arange(start, min(start + _BLOCK, count * paths)) // paths
            generator = np.random.default_rng((seed, start // _BLOCK))
            rays += self._followed(vertices, views, row, depth, generator, sums)
        whole = sums.whole / paths
        found = _lobes_of(
            jnp.asarray(whole, jnp.float32),
            jnp.asarray(sums.first / paths, jnp.float32),
            jnp.asarray(self.sharpest),
        )
        return Drawn(found, rays)

    def _followed(
        self,
        vertices: Frames,
        views: np.ndarray,
        row: np.ndarray,
        depth: int,
        generator: np.random.Generator,
        sums: _Lobes,
    ) -> int:
        """Add a block of paths to the sums of their slices; how many rays that took."""
        around, caster = self.around, self.around.caster
        vertex = row // len(views)
        axes = vertices.axes.astype(np.float32)
        wo = views[row % len(views)].astype(np.float32)
        made, table = around.reflectors[self.number], self.lobes[self.number]
        u = generator.random((len(row), 3), np.float32)
        wi, weight = _by_blocks(_first, (made, table, self.exact), [wo, u])
        alive = np.flatnonzero((weight > 0.0).any(-1))
        at, weight, wi = vertex[alive], weight[alive], wi[alive]
        towards = np.einsum("nj,nji->ni", wi, axes[at])
        start = vertices.position[at] + caster.offset * vertices.axes[at, 2]
        hits = caster.first(start, towards)
        free = hits.primitive < 0
        slot = row[alive]
        _add(sums, 0, slot[free], weight[free], wi[free])
        rays = len(alive)
        on = np.flatnonzero(~free & (hits.distance > _NEAR * caster.offset))
        # Of each path: slice, hit, its ray, and its weight.
        state = (
            slot[on],
            *(a[on] for a in (hits.primitive, hits.u, hits.v, towards, start, hits.distance)),
            weight[on],
        )
        for _ in range(1, depth):
            if not len(state[0]):
                break
            state, cast = self._bounced(vertices, views, state, generator, sums)
            rays += cast
        return rays

    def _bounced(
        self,
        vertices: Frames,
        views: np.ndarray,
        state: tuple[np.ndarray, ...],
        generator: np.random.Generator,
        sums: _Lobes,
    ) -> tuple[tuple[np.ndarray, ...], int]:
        """Both terms at every hit; what escapes is added, the others are returned."""
        around, caster = self.around, self.around.caster
        shapes = caster.geometry.typed(np.float32)
        owner = around.owner[state[1]]
        kept, rays = [], 0
        for number, made in enumerate(around.reflectors):
            rows = np.flatnonzero(owner == number)
            for kind in (1, 2):
                if not len(rows) or not _has(made, kind):
                    continue
                part = [a[rows] for a in state]
                u = generator.random((len(rows), 3), np.float32)
                offset = np.float32(caster.offset)
                fixed = (shapes, made, self.lobes[number], kind, self.exact, offset)
                arrays = [a if a.dtype.kind == "i" else a.astype(np.float32) for a in part[1:]]
                origin, towards, weight = _by_blocks(_next, fixed, [*arrays, u])
                alive = np.flatnonzero((weight > 0.0).any(-1))
                slot, origin, towards = part[0][alive], origin[alive], towards[alive]
                weight = weight[alive]
                hits = caster.first(origin, towards)
                rays += len(alive)
                free = hits.primitive < 0
                axes = vertices.axes[slot[free] // len(views)]
                _add(
                    sums,
                    kind,
                    slot[free],
                    weight[free],
                    np.einsum("nij,nj->ni", axes, towards[free]),
                )
                on = np.flatnonzero(~free)
                met = (hits.primitive, hits.u, hits.v, towards, origin, hits.distance, weight)
                kept.append((slot[on], *(a[on] for a in met)))
        if not kept:
            return tuple(a[:0] for a in state), rays
        return tuple(np.concatenate(a) for a in zip(*kept, strict=True)), rays


def _has(made: Reflector, kind: int) -> bool:
    if kind == 2:
        return made.glossy is not None
    return bool((np.asarray(made.diffuse) > 0.0).any())


def _add(sums: _Lobes, kind: int, slot: np.ndarray, weight: np.ndarray, local: np.ndarray) -> None:
    count = len(sums.whole)
    for c in range(weight.shape[1]):
        sums.whole[:, kind, c] += np.bincount(slot, weight[:, c], count)
    mean = weight.mean(-1)
    for i in range(3):
        sums.first[:, kind, i] += np.bincount(slot, mean * local[:, i], count)


def _by_blocks(program, fixed: tuple, arrays: list[np.ndarray]) -> list[np.ndarray]:
    """Rows through a compiled program, padded to a few sizes."""
    count, parts = len(arrays[0]), []
    for start in range(0, count, _BLOCK):
        some = [a[start : start + _BLOCK] for a in arrays]
        own = len(some[0])
        size = _BLOCK if own > _BLOCK // 8 else _BLOCK // 8
        block = [np.concatenate([a, np.repeat(a[:1], size - own, axis=0)]) for a in some]
        parts.append([np.asarray(a)[:own] for a in program(*fixed, *block)])
    return [np.concatenate(a) for a in zip(*parts, strict=True)]


def _glossy(
    made: Reflector, table: Reference, exact: bool, wo: Array, u: Array
) -> tuple[Array, Array]:
    """Directions of the lobe of the glossy rest, and their weights [n, C]."""
    lobe = table.at(jnp.zeros(wo.shape[:1], jnp.int32), wo)
    mu, log = lobe.mu[:, 0], lobe.log_kappa[:, 0]
    kappa = jnp.exp(log)
    wi = vmf_sampling.warp(u[:, :2], mu, kappa)
    weight = lobe.alpha[:, 0]
    if exact:
        density = jnp.exp(vmf.log_pdf(wi, mu, kappa))
        value = made.value(wi, wo) * jnp.maximum(wi[:, 2:], 0.0)
        weight = value / jnp.maximum(density, 1e-30)[:, None]
    fine = (wi[:, 2] > 0.0) & (wo[:, 2] > 0.0)
    return wi, jnp.where(fine[:, None], weight, 0.0)


def _diffuse(made: Reflector, exact: bool, wo: Array, u: Array) -> tuple[Array, Array]:
    """The same of the diffuse term: a lobe with the moments of the cosine."""
    mean = jnp.asarray(_COSINE, wo.dtype)
    kappa = jnp.broadcast_to(inverse_langevin(mean, 1.0 - mean), wo.shape[:1])
    up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], wo.dtype), wo.shape)
    wi = vmf_sampling.warp(u[:, :2], up, kappa)
    weight = jnp.broadcast_to(made.diffuse[None], (wo.shape[0], made.channels))
    if exact:
        density = jnp.exp(vmf.log_pdf(wi, up, kappa))
        weight = weight * (wi[:, 2] / (jnp.pi * density))[:, None]
    return wi, jnp.where((wi[:, 2] > 0.0)[:, None], weight, 0.0)


@eqx.filter_jit
def _first(
    made: Reflector, table: Reference, exact: bool, wo: Float[Array, "n 3"], u: Float[Array, "n 3"]
) -> tuple[Array, Array]:
    return _glossy(made, table, exact, wo, u)


@eqx.filter_jit
def _next(
    shapes: world.World,
    made: Reflector,
    table: Reference | None,
    kind: int,
    exact: bool,
    offset: Array,
    primitive: Int[Array, " n"],
    u: Float[Array, " n"],
    v: Float[Array, " n"],
    towards: Float[Array, "n 3"],
    origin: Float[Array, "n 3"],
    distance: Float[Array, " n"],
    weight: Float[Array, "n C"],
    numbers: Float[Array, "n 3"],
) -> tuple[Array, Array, Array]:
    """Where reflected rays start, their directions, and the weights of their paths."""
    met = world.surface(shapes, primitive, u, v, origin + distance[:, None] * towards)
    met, front = world.facing(met, -towards, both=False)
    wo = met.local(-towards)
    if kind == 1:
        wi, factor = _diffuse(made, exact, wo, numbers)
    else:
        assert table is not None
        wi, factor = _glossy(made, table, exact, wo, numbers)
    leaving = met.outwards(wi)
    side = jnp.where(front, 1.0, -1.0).astype(wo.dtype)[:, None] * met.geometric
    out = dot(leaving, side) > 0.0
    return met.position + offset * side, leaving, jnp.where(out[:, None], weight * factor, 0.0)


@eqx.filter_jit
def _lobes_of(
    whole: Float[Array, "S 3 C"], first: Float[Array, "S 3 3"], sharpest: Float[Array, "3"]
) -> Slices:
    """One lobe of each kind."""
    mean = whole.mean(-1)
    up = jnp.broadcast_to(jnp.asarray([0.0, 0.0, 1.0], first.dtype), first.shape)
    _, mu, kappa = weighting.lobe(mean, first, up, jnp.broadcast_to(sharpest[None], mean.shape))
    return Slices(whole[:, :, None], mu[:, :, None], kappa[:, :, None])
