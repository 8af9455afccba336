"""Whole BRDFs as lobes over viewing directions, with lobes that belong together.

One view is fitted from scratch. From there the fit walks outwards over the triangles: each view
starts from the lobes of a neighbour that is done, turned with the mean direction, and takes
least-squares steps only. So lobe j stays the same lobe from view to view, and interpolating
its parameters is meaningful; views fitted each on its own end in other orders and other local
minima (two to six times the error half-way between two views).
"""

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from diffopt.brdf_lobes import BRDFLobes, icosahedral_views
from diffopt.fitting.lobe_settings import LobeSettings
from diffopt.fitting.lobe_targets import slices
from diffopt.fitting.lobes import LobeFit, Nodes, fit_nodes, members
from diffopt.kernels import frames, mixture
from diffopt.lobes import Lobes
from diffopt.materials.base import Material

# Elevation of the view to start from: slices at the normal are round, and say nothing about
# the order of lobes elsewhere.
_FIRST_Z = 0.7


def fit_brdf(
    material: Material,
    lobes: int = 3,
    *,
    level: int = 3,
    settings: LobeSettings | None = None,
    key: PRNGKeyArray | None = None,
    dtype: Any = jnp.float32,
) -> LobeFit:
    """Fit lobes to a material at all views of an icosahedral set.

    Parameters
    ----------
    material
        Without perfect mirrors.
    lobes
        How many at each view.
    level
        Of `diffopt.brdf_lobes.icosahedral_views`; 3: 337 views, 8 degrees apart.
    settings, key
        As for `diffopt.fitting.fit_lobes`; the steps are taken at every view.
    dtype
        Type of the fit.

    Returns
    -------
    LobeFit
        The fit of all views, [V]; its `brdf` is a `diffopt.BRDFLobes`.
    """
    settings = settings or LobeSettings()
    views, faces = icosahedral_views(level)
    nodes = slices(material, jnp.asarray(views, dtype), settings)
    first = int(np.argmin(np.abs(views[:, 2] - _FIRST_Z)))
    begun = fit_nodes(members(nodes, np.array([first])), lobes, settings=settings, key=key)
    alpha, mu, kappa = (
        np.resize(np.asarray(a), (len(views), *a.shape[1:])) for a in begun.lobes.arrays
    )
    # No coarse grid leads these fits: some of its steps are taken on all nodes.
    walking = replace(settings, lm_steps=settings.lm_steps + settings.coarse_steps // 2, rounds=1)
    waves = _waves(len(views), faces, first)
    width = max((len(done) for done, _ in waves), default=1)
    for wave, parents in waves:
        # All waves in one shape: one compiled program.
        rows, sources = np.resize(wave, width), np.resize(parents, width)
        here, there = _means(members(nodes, rows)), _means(members(nodes, sources))
        turned = _rotate(there[:, None], here[:, None], jnp.asarray(mu[sources]))
        start = Lobes(alpha[sources], turned, kappa[sources])
        fit = fit_nodes(members(nodes, rows), lobes, settings=walking, start=start)
        for whole, part in zip((alpha, mu, kappa), fit.lobes.arrays, strict=True):
            whole[wave] = np.asarray(part)[: len(wave)]
    # A last round on all views tells which have settled.
    fit = fit_nodes(nodes, lobes, settings=settings, start=Lobes(alpha, mu, kappa))
    steps = fit.steps + walking.lm_steps
    brdf = BRDFLobes(views, faces, fit.lobes)
    return eqx.tree_at(
        lambda f: (f.steps, f.brdf), fit, (steps, brdf), is_leaf=lambda leaf: leaf is None
    )


def _waves(count: int, faces: np.ndarray, first: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Views by their distance over edges from the first, each with a neighbour one nearer."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.concatenate([edges, edges[:, ::-1]])
    parent = np.full(count, -1)
    parent[first] = first
    waves = []
    reached = np.array([first])
    while True:
        out = edges[np.isin(edges[:, 0], reached) & (parent[edges[:, 1]] < 0)]
        reached, at = np.unique(out[:, 1], return_index=True)
        if not reached.size:
            return waves
        parent[reached] = out[at, 0]
        waves.append((reached, out[at, 0]))


@jax.jit
def _means(nodes: Nodes) -> Float[Array, "B 3"]:
    weights = nodes.solid_angles * jnp.maximum(nodes.values.mean(-1), 0.0)
    return jax.vmap(lambda s, w: mixture.mean_direction(s, w)[1])(nodes.directions, weights)


@jax.jit
def _rotate(
    start: Float[Array, "B 1 3"], end: Float[Array, "B 1 3"], vectors: Float[Array, "B K 3"]
) -> Float[Array, "B K 3"]:
    """Vectors turned by the shortest rotation from one direction to another."""
    # Two mirror images: at the start, then at the sum of start and end.
    half = start + end
    half = half / jnp.sqrt(jnp.maximum((half * half).sum(-1, keepdims=True), 1e-12))
    start, half = (jnp.broadcast_to(a, vectors.shape) for a in (start, half))
    return frames.reflect(frames.reflect(vectors, start), half)
