"""Stores: baked tables and precomputed transfer."""

from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.readers.base import Seed, written


def load_store(path: Path) -> Any:
    from diffopt import stores

    return stores.load_table(path)


def lookup() -> dict[str, Seed]:
    import jax.numpy as jnp

    from diffopt import stores
    from diffopt.lookup import Table

    ends = {name: jnp.zeros(3) for name in ("first", "low")}
    ends |= {name: jnp.ones(3) for name in ("step", "high")}
    values = np.random.default_rng(5).uniform(size=(4, 4, 4, 3))
    table = Table(
        jnp.asarray(values), **ends, order=3, prefactor="stam", shadowing="none", relative=False
    )
    return {"table": written("a.zarr", lambda path: stores.save(path, table, {"output": "xyz"}))}


def load_transfer(path: Path) -> Any:
    from diffopt.transfer import store

    store.record_of(path)
    return store.load(path)


def transfer() -> dict[str, Seed]:
    from diffopt import materials, scenes
    from diffopt.scenes import models
    from diffopt.transfer import store
    from diffopt.transfer.compression import CompressionSettings
    from diffopt.transfer.precomputation import precompute
    from diffopt.transfer.settings import TransferSettings

    ring = models.MODELS["torus"](radius=1.0, tube=0.4, around=4, across=3)
    scene = scenes.Scene([scenes.Object(ring, materials.Lambert(0.5))])
    found = precompute(scene, TransferSettings(rays=64, finest=1, splits=0, tolerance=1.0))

    def seed(settings: CompressionSettings) -> Seed:
        return written("a.zarr", lambda path: store.save(path, found, {}, settings))

    return {"exact": seed(CompressionSettings(0)), "packed": seed(CompressionSettings())}
