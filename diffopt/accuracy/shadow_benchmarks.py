"""Benchmarks of shadow fields: receivers, samples, tables, and matrices applied in other ways."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import shadows
from diffopt.accuracy import shadow_scenes
from diffopt.accuracy.benchmarks import Benchmark, Entry
from diffopt.kernels import rescaling_matrices, rescaling_tables
from diffopt.shadows import ShadowSettings, sampling, tables
from diffopt.shadows.fields import field_of

# Distances at which a field is wanted, for extrapolation against sampling it at each of them.
_DISTANCES = 48


def _body() -> shadow_scenes.Body:
    return shadow_scenes.bodies("torus tilted", 2)[0]


def _samples(settings: ShadowSettings, backend: str = "embree") -> sampling.Samples:
    body = _body()
    return sampling.sample(
        body.vertices,
        body.faces,
        settings,
        centre=body.centre,
        radius=body.radius,
        backend=backend,
    )


def _receivers(size: str) -> list[Entry]:
    """Whole shadows under a sky, of one normal for all receivers and of one for each."""
    found = []
    body = _body()
    for bands in (4, 6, 8):
        settings = ShadowSettings(bands=bands)
        field = shadows.shadow_field(
            body.vertices, body.faces, settings, centre=body.centre, radius=body.radius
        )
        light = shadows.distant_light(shadow_scenes.radiance, bands)
        for side in (100, 316) if size == "small" else (100, 316, 1000):
            points = jnp.asarray(shadows.plane(8.0, side).reshape(-1, 3), jnp.float32)
            up = jnp.asarray([0.0, 0.0, 1.0], jnp.float32)
            for name, normals in (
                ("one normal", up),
                ("normal each", jnp.broadcast_to(up, points.shape)),
            ):

                def run(
                    points: Any, normals: Any, field: Any = field, light: Any = light
                ) -> jax.Array:
                    return shadows.irradiance(points, normals, [field], light)

                found.append(
                    Entry(
                        f"{bands} bands, {name}",
                        run,
                        (points, normals),
                        f"{len(points):,} receivers",
                        len(points),
                        "receiver",
                        whole=False,
                    )
                )
    return found


def _sampling(size: str) -> list[Entry]:
    """All rays of a frame, and what they meet as coefficients."""
    found = []
    for backend in ("embree", "jax"):
        for bands in (4, 8):
            settings = ShadowSettings(bands=bands)
            if backend == "jax":
                settings = dataclasses.replace(settings, directions=(6, 10), rays=16)
            if backend == "jax" and bands == 8 and size == "small":
                continue
            polar, azimuthal = settings.directions
            count = (settings.shells or 1) * polar * azimuthal * settings.rays**2

            def run(settings: ShadowSettings = settings, backend: str = backend) -> np.ndarray:
                return _samples(settings, backend).outer

            found.append(
                Entry(
                    f"{bands} bands, {backend}",
                    run,
                    (),
                    f"{polar}x{azimuthal} directions, {settings.shells} shells, "
                    f"{len(_body().faces):,} triangles",
                    count,
                    "ray",
                    whole=False,
                )
            )
    return found


def _table(size: str) -> list[Entry]:
    """From samples to all distances."""
    found = []
    for bands in (4, 6, 8):
        settings = ShadowSettings(bands=bands, rays=8)
        samples = _samples(settings)

        def run(samples: Any = samples, settings: ShadowSettings = settings) -> jax.Array:
            return tables.build(samples, settings)

        nodes = int(np.prod(run().shape[:3]))
        found.append(
            Entry(f"{bands} bands", run, (), f"{nodes:,} nodes", nodes, "node", whole=False)
        )
    return found


def _distances(size: str) -> list[Entry]:
    """A field at many distances: carried there from a few shells, or sampled at each."""
    body = _body()
    rays = 16 if size == "small" else 32
    settings = ShadowSettings(bands=4, radial=_DISTANCES, rays=rays)
    every = dataclasses.replace(settings, shells=16)

    def carried() -> jax.Array:
        samples = _samples(settings)
        return tables.build(samples, settings)

    def sampled() -> list[np.ndarray]:
        return [_samples(every).outer for _ in range(_DISTANCES // 16)]

    polar, azimuthal = settings.directions
    shape = f"{_DISTANCES} distances, {polar}x{azimuthal} directions, {len(body.faces):,} triangles"
    return [
        Entry(name, run, (), shape, _DISTANCES, "distance", whole=False)
        for name, run in (("carried", carried), ("sampled at each", sampled))
    ]


def _matrices(size: str) -> list[Entry]:
    """M(k) S for a k of every receiver, four bands: what the tables above save."""
    bands, kind = 4, "tangent hemisphere"
    count = 100_000 if size == "small" else 1_000_000
    rng = np.random.default_rng(5)
    k = jnp.asarray(rng.uniform(0.1, 0.99, count), jnp.float32)
    views = jnp.asarray(rng.normal(size=(bands**2, count)), jnp.float32)
    line = rescaling_tables.linear(bands, kind, 48, jnp.float32)
    terms = rescaling_tables.chebyshev(bands, kind, 12, jnp.float32)
    apply = rescaling_matrices.apply

    def sparse(k: Any, views: Any) -> jax.Array:
        return apply(rescaling_tables.from_chebyshev(terms, k, kind), views, bands)

    def gathered(k: Any, views: Any) -> jax.Array:
        return apply(rescaling_tables.from_linear(line, k, kind), views, bands)

    def dense(k: Any, views: Any) -> jax.Array:
        entries = rescaling_tables.from_chebyshev(terms, k, kind)
        return jnp.einsum("ijn,jn->in", rescaling_matrices.dense(entries, bands), views)

    samples = _samples(ShadowSettings(bands=bands, rays=8))
    field = field_of(samples, ShadowSettings(bands=bands), np.zeros(3), 1.0)
    away = rng.normal(size=(3, count))
    points = away / np.linalg.norm(away, axis=0) / np.asarray(k, float)

    def read(points: Any, field: Any) -> jax.Array:
        return field.seen(points)

    shape = f"{bands} bands, {count:,} receivers"
    return [
        *(
            Entry(name, run, (k, views), shape, count, "receiver")
            for name, run in (
                ("distinct entries, polynomials", sparse),
                ("distinct entries, table", gathered),
                ("whole matrix, polynomials", dense),
            )
        ),
        # The whole way from the place of a receiver to its view, rotation and all.
        Entry(
            "views from a table",
            read,
            (jnp.asarray(points, jnp.float32), field),
            shape,
            count,
            "receiver",
        ),
    ]


RECEIVERS = Benchmark("shadow.receivers", "irradiance past one shadow field", _receivers)
SAMPLING = Benchmark("shadow.sampling", "samples of a field by rays", _sampling)
TABLE = Benchmark("shadow.table", "tables of a field over all distances", _table)
DISTANCES = Benchmark(
    "shadow.distances", "a field at many distances: carried, or sampled", _distances, True
)
MATRICES = Benchmark(
    "shadow.matrices", "matrices of the tangent map, one for each receiver", _matrices, True
)
