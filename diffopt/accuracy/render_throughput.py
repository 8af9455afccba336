"""Benchmarks of image synthesis: camera rays and camera paths per second.

Beside Mitsuba 3 on the same scenes where its package is installed: an independent renderer, in
processes of its own that take turns with ours. Its vectorised variant needs an LLVM library newer
than 15, named in DRJIT_LIBLLVM_PATH; without that name it is left out.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, get_args

import numpy as np

from diffopt import rendering
from diffopt.accuracy import mitsuba_process, mitsuba_scenes, render_scenes
from diffopt.accuracy.benchmarks import Benchmark, Entry
from diffopt.scenes import raycasting

#: Columns and rows of pictures, by the size of the benchmark.
SIZES = {"small": (96, 72), "full": (256, 192)}
#: Paths a pixel.
SPP = 16


def _rays(size: str) -> list[Entry]:
    """One ray through the middle of each pixel, by every backend."""
    found = []
    for name, make in render_scenes.TIMED.items():
        scene, camera = make()
        # A path is some tens of rays: more pixels for as much work.
        columns, rows = (4 * n for n in SIZES[size])
        camera = dataclasses.replace(camera, resolution=(columns, rows))
        origins, directions = camera.rays(np.arange(columns * rows))
        for backend in get_args(raycasting.Backend):
            caster = raycasting.Caster(scene.geometry, backend)
            found.append(
                Entry(
                    f"{name}, {backend}",
                    lambda o, d, caster=caster: caster.first(o, d).distance,
                    (origins, directions),
                    f"{columns}x{rows} rays, {caster.triangles} triangles",
                    columns * rows,
                    "ray",
                    rate=True,
                    whole=False,
                )
            )
    return found


def _paths(size: str) -> list[Entry]:
    """Pictures by path tracing, ours first, then Mitsuba's."""
    found = []
    columns, rows = SIZES[size]
    for name, make in render_scenes.TIMED.items():
        scene, camera = make()
        camera = dataclasses.replace(camera, resolution=(columns, rows))

        def ours(scene=scene, camera=camera) -> Any:
            return rendering.render(scene, camera, "path", spp=SPP).radiance

        ways: dict[str, Callable[[], Any]] = {"": ours}
        description = mitsuba_scenes.describe(scene, camera, spp=SPP)
        for variant in mitsuba_process.variants():
            try:
                ways[f"Mitsuba {variant}"] = mitsuba_process.Renderer(description, variant)
            except RuntimeError:
                # It does not start on this machine.
                continue
        found += [
            Entry(
                ", ".join(filter(None, (name, way))),
                function,
                (),
                f"{name}, {columns}x{rows}, {SPP} paths a pixel",
                columns * rows * SPP,
                "path",
                rate=True,
                whole=False,
            )
            for way, function in ways.items()
        ]
    return found


RAYS = Benchmark("render.rays", "camera rays per second by the backends of ray casting", _rays)
PATHS = Benchmark("render.paths", "camera paths per second", _paths, alternatives=True)
