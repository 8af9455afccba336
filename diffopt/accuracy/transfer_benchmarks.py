"""Benchmarks of precomputed transfer: relighting vertices and pixels, moments of slices.

Times do not depend on what the lobes are: they are made up, the layout is as computed.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffopt.accuracy import transfer_runs
from diffopt.accuracy.benchmarks import Benchmark, Entry
from diffopt.scenes import models
from diffopt.scenes.camera import Camera
from diffopt.transfer import between, references, relighting, slices
from diffopt.transfer.lighting import HarmonicSettings
from diffopt.transfer.raster import Raster, Seen
from diffopt.transfer.relighting import Tables
from diffopt.transfer.views import hemisphere, locator
from diffopt.transfer.weighting import Weights

# A ring of 10,080 vertices.
_AROUND, _ACROSS = 140, 72
# Level of the views of all vertices: 31 of them.
_LEVEL = 1
_EYE = (0.0, -3.2, 2.4)
# Rays of a vertex, and vertices at a time, as by default.
_RAYS, _CHUNK = 4096, 32


def held() -> Tables:
    """Tables of a ring of one glossy material, three lobes a view."""
    mesh = models.torus(1.0, 0.45, _AROUND, _ACROSS)
    rng = np.random.default_rng(3)
    count, views = len(mesh.vertices), hemisphere(_LEVEL).counts[-1]
    normal = np.asarray(mesh.normals)
    least = np.eye(3)[np.argmin(np.abs(normal), -1)]
    tangent = np.cross(normal, least)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    axes = np.stack([tangent, np.cross(normal, tangent), normal], 1)
    axis = rng.normal(size=(count * views, 3, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    axis[:, 0] = [0.0, 0.0, 1.0]
    log = rng.uniform(0.0, 3.0, (count * views, 3, 1))
    log[:, 0] = 0.0
    rows = np.concatenate([axis, log, rng.uniform(0.0, 1.0, log.shape)], -1)
    wo = hemisphere(references.LEVEL).views
    mirrored = wo * [-1.0, -1.0, 1.0]
    over = references.pack(
        np.full((len(wo), 1, 1), 0.8), mirrored[:, None], np.full((len(wo), 1), 32.0)
    )
    return Tables(
        jnp.asarray(mesh.vertices, jnp.float32),
        jnp.asarray(axes, jnp.float32),
        jnp.full(count, _LEVEL, jnp.int32),
        jnp.arange(count, dtype=jnp.int32) * views,
        jnp.zeros(count, jnp.int32),
        references.reference([over], 1, references.LEVEL),
        jnp.asarray(rows.reshape(len(rows), -1), jnp.float32),
        jnp.zeros((count, 15), jnp.float32),
        locator(_LEVEL),
        3,
        3,
        glossy=True,
        matte=False,
    )


def _seen(resolution: int) -> Seen:
    mesh = models.torus(1.0, 0.45, _AROUND, _ACROSS)
    camera = Camera(eye=_EYE, field_of_view=50.0, resolution=(resolution, resolution))
    return Raster(np.asarray(mesh.vertices), np.asarray(mesh.faces))(camera, 1)


def _relight(size: str) -> list[Entry]:
    """Radiance of vertices, and of pixels, by each way of averaging light."""
    tables = held()
    count = len(tables.position)
    away = np.array([_EYE]) - np.asarray(tables.position, np.float64)
    wo = jnp.asarray(away / np.linalg.norm(away, axis=1, keepdims=True), jnp.float32)
    numbers = jnp.arange(count, dtype=jnp.int32)
    bands = (8,) if size == "small" else (8, 16)
    ways = [("pyramid", None), ("lobes", None)]
    ways += [("harmonics", HarmonicSettings(n)) for n in bands]
    lights = [
        (
            f"{method} {how.bands} bands" if how else method,
            transfer_runs.lighting("suns", method, how),
        )
        for method, how in ways
    ]
    at = _seen(512)
    arrays = {n: getattr(at, n) for n in at._fields if isinstance(getattr(at, n), np.ndarray)}
    at = at._replace(**{name: jnp.asarray(array) for name, array in arrays.items()})

    def vertices(tables: Any, light: Any, numbers: Any, wo: Any) -> jax.Array:
        return relighting.vertex_radiance(tables, light, numbers, wo)

    def frame(tables: Any, light: Any) -> jax.Array:
        return between.picture(tables, light, at)

    found = [
        Entry(
            f"vertices, {name}",
            vertices,
            (tables, light, numbers, wo),
            f"{count:,} vertices x 3 lobes",
            count,
            "vertex",
        )
        for name, light in lights
    ]
    pixels = int((np.asarray(at.place) < len(at.covered)).sum())
    return found + [
        Entry(
            f"pixels, {name}",
            frame,
            (tables, light),
            f"512x512 pixels, {pixels:,} of the surface",
            pixels,
            "pixel",
            rate=True,
            # Compiled by itself as it is for pictures, which is not as within another program.
            whole=False,
        )
        for name, light in (lights if size == "full" else lights[:2])
    ]


def _slices(size: str) -> list[Entry]:
    """Slices of a chunk of vertices from what their rays brought."""
    rng = np.random.default_rng(3)
    rays = 1024 if size == "small" else _RAYS
    found = []
    for lobes, channels in ((1, 1), (1, 3), (2, 1)):
        views = hemisphere(2).counts[-1]
        rows = views * lobes
        weight = rng.random((rows, rays), np.float32) / rays
        axis = rng.normal(size=(views, lobes, 3)).astype(np.float32)
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
        weights = Weights(
            jnp.asarray(weight),
            jnp.asarray(weight.sum(1)),
            jnp.zeros((rows, 3), jnp.float32),
            jnp.ones((views, channels), jnp.float32),
            jnp.asarray(axis),
            jnp.full((views, lobes), 32.0, jnp.float32),
        )
        columns = rng.random((_CHUNK, rays, 4 + 2 * (channels + 3)), np.float32)
        sharpest = jnp.asarray([2e4, 32.0, 256.0], jnp.float32)

        def run(weights: Any, columns: Any, sharpest: Any) -> Any:
            return _moments(weights, columns, sharpest)

        count = _CHUNK * views
        found.append(
            Entry(
                f"{lobes} lobes, {channels} channels",
                run,
                (weights, jnp.asarray(columns), sharpest),
                f"{count:,} slices, {rays:,} rays",
                count,
                "slice",
            )
        )
    return found


@eqx.filter_jit
def _moments(weights: Weights, columns: Any, sharpest: Any) -> Any:
    return slices.from_moments(weights, columns, sharpest)


RELIGHT = Benchmark(
    "transfer.relight", "radiance of vertices and pixels under light", _relight, True
)
SLICES = Benchmark("transfer.slices", "slices from the moments of shared rays", _slices, True)
