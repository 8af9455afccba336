"""Slices of vertices over viewing directions, as many as they need.

Level by level the slices of new views are computed and compared with what those between which
they lie predict (the glossy-transfer paper, section 4.2, with the exact distance). A level that
is predicted within the tolerance is not kept.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.transfer import fits, references, reflectors, slices, tracing, weighting
from diffopt.transfer.references import Unoccluded
from diffopt.transfer.refinement import Measure
from diffopt.transfer.reflectors import Reflector
from diffopt.transfer.settings import TransferSettings
from diffopt.transfer.slices import Slices
from diffopt.transfer.tracing import Frames, Surroundings
from diffopt.transfer.views import Hemisphere, hemisphere
from diffopt.transfer.weighting import Weights

# Concentration of light that a diffuse surface reflects, at most: less than a hemisphere is
# seen where it is partly hidden, and a few samples alone would make a sharp lobe of it.
_DIFFUSE_SHARPEST = 32.0


class Vertices(NamedTuple):
    """Slices of some vertices.

    Attributes
    ----------
    level
        Level of views of each, [n]; -1 where the material has no glossy rest.
    views
        Slices of vertex after vertex, as many as its level has views, [S, 3, K, ...]: over those
        of the unoccluded material, see `diffopt.transfer.references`.
    diffuse
        Slices that serve all views, in the local frames, [n, 3, K, ...].
    error
        Difference of the last level computed from its prediction, over the norm, [n].
    """

    level: Int[np.ndarray, " n"]
    views: Slices
    diffuse: Slices
    error: Float[np.ndarray, " n"]


class Estimator:
    """Computes slices of vertices of one material.

    Parameters
    ----------
    around
        The scene.
    number
        Which of its reflectors the vertices have.
    settings
        See there.
    """

    def __init__(self, around: Surroundings, number: int, settings: TransferSettings) -> None:
        self.around, self.settings = around, settings
        self.reflector: Reflector = around.reflectors[number]
        fine = max(weighting.fineness(self.reflector, settings.rays), 1)
        self.among = weighting.directions(settings.rays, fine)
        self.sphere: Hemisphere = hemisphere(max(settings.finest, references.LEVEL))
        sharp = max(reflectors.sharpness(one) for one in around.reflectors)
        # Half the angle between mirrored directions of a grazing lobe: up to e^2 as sharp.
        most = min(8.0 * max(sharp, 4.0), reflectors.SHARPEST)
        self.sharpest = jnp.asarray([reflectors.SHARPEST, _DIFFUSE_SHARPEST, most], jnp.float32)

    @functools.cached_property
    def diffuse(self) -> Weights:
        """Of the view-independent share."""
        return weighting.diffuse(self.reflector, self.among, self.settings.lobes)

    @functools.lru_cache(maxsize=8)  # noqa: B019
    def weights(self, level: int) -> Weights:
        """Of the views that come with a level."""
        new = self.sphere.new(level)
        lobes = self.settings.lobes
        return weighting.glossy(self.reflector, self.among, self.sphere, new, lobes)

    @functools.cached_property
    def reference(self) -> np.ndarray:
        """Rows of the unoccluded lobes, for the views of `references.LEVEL`."""
        lobes, channels = self.settings.lobes, self.around.channels
        count = hemisphere(references.LEVEL).counts[-1]
        if self.reflector.glossy is None:
            up = np.broadcast_to([0.0, 0.0, 1.0], (count, lobes, 3))
            return references.pack(np.zeros((count, lobes, channels)), up, np.ones((count, lobes)))
        parts = [self.fitted(level) for level in range(references.LEVEL + 1)]
        return references.pack(*(np.concatenate(a) for a in zip(*parts, strict=True)))

    @functools.lru_cache(maxsize=8)  # noqa: B019
    def fitted(self, level: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unoccluded lobes of the views that come with a level, fitted."""
        views = self.sphere.views[self.sphere.new(level)]
        return fits.best(self.reflector, views, self.weights(level))

    def unoccluded(self, level: int) -> Unoccluded:
        """The same, with an axis in front for the vertices."""
        alpha, mu, kappa = (jnp.asarray(a, jnp.float32)[None] for a in self.fitted(level))
        return Unoccluded(alpha, mu, jnp.log(jnp.maximum(kappa, 1e-6)))

    @functools.lru_cache(maxsize=8)  # noqa: B019
    def scale(self, level: int) -> Float[Array, ""]:
        """Mean squared norm of the unoccluded slices that come with a level."""
        norm = slices.squared_norm(slices.unoccluded(self.weights(level)))
        return jnp.maximum(norm.mean(), jnp.finfo(norm.dtype).tiny)

    @functools.cached_property
    def measure(self) -> Measure:
        """What differences are measured by."""
        return Measure(self.reference, *self.scales(self.settings.compared))

    def scales(self, most: int) -> tuple[Float[np.ndarray, " L"], float]:
        """Mean squared norms of unoccluded slices: of the views up to each level, and diffuse."""
        matte = float(slices.squared_norm(slices.unoccluded(self.diffuse))[0])
        if self.reflector.glossy is None:
            return np.zeros(1), matte
        sums, count, out = 0.0, 0, []
        for level in range(min(most, self.settings.finest) + 1):
            norm = slices.squared_norm(slices.unoccluded(self.weights(level)))
            sums, count = sums + float(norm.sum()), count + len(norm)
            out.append(sums / count)
        return np.array(out), matte

    def columns(self, vertices: Frames) -> Float[np.ndarray, "n N P"]:
        """What the rays of vertices bring."""
        settings = self.settings
        return tracing.columns(
            self.around, vertices, self.among.rays, settings.depth, settings.seed
        )

    def __call__(self, vertices: Frames) -> Vertices:
        """Slices of vertices, at most a chunk of them."""
        settings, count = self.settings, len(vertices.position)
        found = jnp.asarray(_padded(self.columns(vertices), settings.chunk))
        part = found
        diffuse = _numpy(_slices(self.diffuse, found, self.sharpest), count)
        diffuse = Slices(*(a[:, 0] for a in diffuse))
        if self.reflector.glossy is None:
            none = Slices(*(a[:0] for a in diffuse))
            return Vertices(np.full(count, -1, np.int32), none, diffuse, np.zeros(count))
        levels, error = np.full(count, settings.finest, np.int32), np.zeros(count)
        kept: list[tuple[np.ndarray, Slices]] = []
        active = np.arange(count)
        before: Slices | None = None
        for level in range(settings.finest + 1):
            new = _slices(self.weights(level), part, self.sharpest)
            known = _over(self.weights(level), new)
            if before is not None:
                ends = jnp.asarray(self.sphere.ends[self.sphere.new(level)])
                over = self.unoccluded(level)
                far = _prediction(before, known, over, ends, self.scale(level))
                apart = np.asarray(far)[: len(active)]
                error[active] = apart
                known = jax.tree.map(lambda a, b: jnp.concatenate([a, b], 1), before, known)
                settled = (apart <= settings.tolerance) & (level > settings.coarsest)
                done = active[settled]
                levels[done] = level - 1
                kept.append((done, _numpy_rows(before, np.flatnonzero(settled))))
                rows = np.flatnonzero(~settled)
                active = active[rows]
                if level == settings.finest:
                    kept.append((active, _numpy_rows(known, rows)))
                elif len(active) and len(done):
                    known = slices.picked(known, _filled(rows, settings.chunk))
                    part = found[_filled(active, settings.chunk)]
            elif settings.finest == 0:
                kept.append((active, _numpy_rows(known, active)))
            before = known
            if not len(active):
                break
        return Vertices(levels, _ordered(kept, count), diffuse, error)


def _bucket(count: int, most: int) -> int:
    """Sizes that programs are compiled for: a chunk, and halves of it down to an eighth."""
    size = most
    while size // 2 >= max(count, most // 8, 1):
        size //= 2
    return size


def _filled(rows: np.ndarray, size: int) -> np.ndarray:
    size = _bucket(len(rows), size)
    return np.concatenate([rows, np.repeat(rows[:1], size - len(rows))])


def _padded(array: np.ndarray, size: int) -> np.ndarray:
    short = size - len(array)
    return np.concatenate([array, np.repeat(array[:1], short, axis=0)]) if short else array


def _numpy(found: Slices, count: int) -> Slices:
    return Slices(*(np.asarray(a)[:count] for a in found))


def _numpy_rows(found: Slices, rows: np.ndarray) -> Slices:
    return Slices(*(np.asarray(a)[rows] for a in found))


def _ordered(kept: list[tuple[np.ndarray, Slices]], count: int) -> Slices:
    """Slices one after the other, in the order of the vertices."""
    rows: list[Any] = [None] * count
    for which, found in kept:
        for k, row in enumerate(which):
            rows[row] = [a[k] for a in found]
    return Slices(*(np.concatenate(a) for a in zip(*rows, strict=True)))


@jax.jit
def _slices(weights: Weights, columns: Array, sharpest: Array) -> Slices:
    return slices.from_moments(weights, columns, sharpest)


@jax.jit
def _over(weights: Weights, found: Slices) -> Slices:
    log = jnp.log(jnp.maximum(weights.kappa, 1e-6))
    return references.relative(found, Unoccluded(weights.alpha[None], weights.mu[None], log[None]))


@jax.jit
def _prediction(before: Slices, new: Slices, over: Unoccluded, ends: Array, scale: Array) -> Array:
    """Root of the mean squared distance of new slices from those between which they lie."""
    pair = Slices(*(a[:, ends] for a in before))
    half = jnp.full((*pair.kappa.shape[:3],), 0.5, pair.kappa.dtype)
    between = references.absolute(slices.between(half, pair), over)
    apart = slices.squared_distance(between, references.absolute(new, over))
    return jnp.sqrt(apart.mean(-1) / scale)
