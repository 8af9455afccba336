"""Benchmark of interactive frames: moving lights on the closed shapes, up to the pixels."""

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import DiffractionBRDF, fresnel, samples
from diffopt.accuracy.benchmarks import Benchmark, Entry
from diffopt.drawing import frames, shapes, views

#: Rows and columns of a frame.
FRAME = (720, 1280)
# Towards the lights, and how far they move in the frames of one run, radians.
LIGHTS = {"sphere": (-0.45, 0.50, 0.75), "sheet": (-0.50, 0.75, 0.85)}
STEPS = (0.0, 0.02, 0.05, 0.09)


def _frames(size: str) -> list[Entry]:
    """Frames one after the other, each under another light, from one compiled loop."""
    scan = samples.compact_disc(jax.random.key(0), shape=(128, 128), pixel=0.1)
    brdf = DiffractionBRDF(scan, 1.6, fresnel=fresnel.metal("al"))
    found = []
    for name, view in (("sphere", shapes.sphere(FRAME)), ("sheet", shapes.sheet(FRAME))):
        lights = np.stack([_moved(LIGHTS[name], step) for step in STEPS])
        table = views.bake(
            brdf, frames.reach(view, lights), size=256 if size == "small" else FRAME[0]
        )
        frame = frames.Frames(brdf, table, view)
        exposure = jnp.asarray(frame.exposure(lights[0]), jnp.float32)
        leaves, rest = jax.tree.flatten(frame)

        def run(leaves, lights, exposure, rest=rest):
            frame = jax.tree.unflatten(rest, leaves)
            return jax.lax.map(lambda light: frame(light, exposure=exposure), lights)

        found.append(
            Entry(
                name,
                run,
                (leaves, jnp.asarray(lights, jnp.float32), exposure),
                f"{FRAME[1]}x{FRAME[0]}, {frame.pixel.shape[0]} samples of the material",
                len(STEPS),
                "frame",
                rate=True,
            )
        )
    return found


def _moved(light: tuple[float, float, float], angle: float) -> np.ndarray:
    """Unit vector, turned about the vertical."""
    x, y, z = light
    cos, sin = np.cos(angle), np.sin(angle)
    return shapes.unit(np.array([cos * x + sin * z, y, cos * z - sin * x]))


FRAMES = Benchmark("frames", "pictures of lit objects under moving lights", _frames)
