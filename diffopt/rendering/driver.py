"""Pictures tile by tile: camera rays in, means over pixels out, in bounded memory."""

import math
import time
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from diffopt.kernels import uniforms
from diffopt.rendering import shading
from diffopt.rendering.images import Image
from diffopt.rendering.keeping import Kept
from diffopt.rendering.queries import Queries
from diffopt.rendering.settings import Settings
from diffopt.rendering.shading import Rays
from diffopt.rendering.stage import Stage
from diffopt.scenes import raycasting, world
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene
from diffopt.workers import ahead

#: Follows rays: (stage, rays, queries, key) to the rays with what they have collected.
Level = Callable[[Stage, Rays, Queries, PRNGKeyArray], Rays]
#: Told (done, of) as tiles are finished.
Progress = Callable[[int, int], None]

# Samples of a pixel in one pass, at most.
_TOGETHER = 16
_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)


def tiles(camera: Camera, settings: Settings) -> tuple[list[np.ndarray], int]:
    """Runs of pixels that are treated together, and the samples of a pass."""
    together = min(settings.spp, _TOGETHER)
    count = camera.resolution[0] * camera.resolution[1]
    size = min(max(settings.rays // together, 1), count)
    return [np.arange(at, min(at + size, count)) for at in range(0, count, size)], together


def picture(
    scene: Scene,
    camera: Camera,
    settings: Settings,
    level: Level,
    *,
    even: bool,
    dtype: Any = "float32",
    progress: Progress | None = None,
    workers: int = 1,
    stage: Stage | None = None,
    keep: Kept | None = None,
) -> Image:
    """Picture of a scene by one level.

    Parameters
    ----------
    scene, camera, settings
        What is rendered, from where, and how.
    level
        Follows the rays.
    even
        Whether samples lie evenly in the pixel, the same in all; at random otherwise.
    dtype
        Floating type of everything but rays.
    progress
        Told of the tiles.
    workers
        Passes followed at a time, each by a thread. The picture does not depend on it.
    stage
        The scene as arrays, where it is prepared already.
    keep
        Where finished tiles are kept; those that are there are not rendered again.

    A keyboard interrupt ends the work and keeps the finished tiles; see `Image.done`.
    """
    begin = time.perf_counter()
    stage = Stage(scene, dtype) if stage is None else stage
    caster = raycasting.caster(scene.geometry, settings.backend)
    key = jax.random.key(settings.seed)
    runs, together = tiles(camera, settings)
    size = len(runs[0])
    image = Image.blank(scene, camera, settings)
    if keep is not None:
        keep.restore(image)
    before, done = image.seconds, image.done.reshape(-1)
    left = [k for k, pixels in enumerate(runs) if not done[pixels].all()]
    passes = [(k, first) for k in left for first in range(0, settings.spp, together)]

    def one(which: tuple[int, int]) -> np.ndarray:
        number, first = which
        rays = primary(camera, stage, key, runs[number], size, first, together, settings, even)
        rays = level(stage, rays, Queries(caster), key)
        return np.asarray(rays.radiance).reshape(size, together, -1)

    results = ahead(one, passes, workers)
    total = squares = np.zeros((size, 1))
    try:
        for (number, first), found in zip(passes, results, strict=True):
            if first == 0:
                total, squares = (np.zeros((size, found.shape[2])) for _ in range(2))
            found = found[:, : settings.spp - first].astype(np.float64)
            total += found.sum(axis=1)
            squares += (found * found).sum(axis=1)
            if first + together < settings.spp:
                continue
            pixels = runs[number]
            image.fill(pixels, total[: len(pixels)], squares[: len(pixels)], settings.spp)
            _layers(image, camera, scene, caster, pixels, size)
            image.seconds = before + time.perf_counter() - begin
            if keep is not None:
                keep.note(image)
            if progress is not None:
                progress(number + 1, len(runs))
    except KeyboardInterrupt:
        image.interrupted = True
    finally:
        results.close()
    image.seconds = before + time.perf_counter() - begin
    return image


def primary(
    camera: Camera,
    stage: Stage,
    key: PRNGKeyArray,
    pixels: np.ndarray,
    size: int,
    first: int,
    together: int,
    settings: Settings,
    even: bool,
) -> Rays:
    """Rays of a pass: `together` samples of each pixel, from number `first` on.

    Arrays have rows for `size` pixels in every pass; what is too many is not alive.
    """
    pixel = np.zeros(size, np.uint32)
    pixel[: len(pixels)] = pixels
    pixel = np.repeat(pixel, together)
    sample = np.tile(np.arange(first, first + together, dtype=np.uint32), size)
    wanted = np.repeat(np.arange(size) < len(pixels), together) & (sample < settings.spp)
    if even:
        inside = within_pixel(settings.spp)[np.minimum(sample, settings.spp - 1)]
    else:
        inside = _jitter(key, jnp.asarray(pixel), jnp.asarray(sample))
    origin, along = _rays(*_lens(camera), jnp.asarray(pixel), jnp.asarray(inside, jnp.float32))
    rays = shading.camera_rays(
        origin.astype(stage.dtype),
        along.astype(stage.dtype),
        stage.channels,
        stage.dtype,
        pixel,
        sample,
    )
    return shading.alive(rays, jnp.asarray(wanted))


def within_pixel(count: int) -> Float[np.ndarray, "S 2"]:
    """Places of samples within a pixel: its middle for one, else a lattice that fills it.

    Point i of S has the coordinates (i + 1/2) / S and (j + 1/2) / S, j + 1 = g (i + 1) modulo
    S + 1: each S-th part of a row and of a column holds one (four of them are the rotated grid
    of graphics hardware), and their mean is the middle. The generator g is the whole number
    coprime to S + 1 that is nearest to its golden section (Korobov, 1959).
    """
    whole = count + 1
    near = sorted(range(1, whole), key=lambda g: abs(g - _GOLDEN * whole))
    generator = next(g for g in near if math.gcd(g, whole) == 1)
    place = np.arange(1, whole)
    return (np.stack([place, generator * place % whole], -1) - 0.5) / count


@jax.jit
def _jitter(key: PRNGKeyArray, pixel: Array, sample: Array) -> Array:
    pair = uniforms.at(key, pixel, sample * np.uint32(shading.WORDS))
    return jnp.stack(pair, -1)


def _lens(camera: Camera) -> tuple[Any, ...]:
    half = math.tan(math.radians(0.5 * camera.field_of_view)) / (0.5 * min(camera.resolution))
    matrix = jnp.asarray(camera.matrix, jnp.float32)
    return matrix, jnp.float32(half), jnp.asarray(camera.resolution, jnp.uint32)


@jax.jit
def _rays(
    matrix: Array, half: Array, resolution: Array, pixel: Array, inside: Array
) -> tuple[Array, Array]:
    """As `Camera.rays`, on the device."""
    columns = resolution[0]
    size = resolution.astype(jnp.float32)
    column, row = (pixel % columns).astype(jnp.float32), (pixel // columns).astype(jnp.float32)
    x = (column + inside[:, 0] - 0.5 * size[0]) * half
    y = (0.5 * size[1] - row - inside[:, 1]) * half
    right, up, back, place = matrix[None, :3].transpose(2, 0, 1)
    along = x[:, None] * right + y[:, None] * up - back
    along = along * world.inverse_root(shading.dot(along, along))[:, None]
    return jnp.broadcast_to(place, along.shape), along


def _layers(
    image: Image, camera: Camera, scene: Scene, caster: Any, pixels: np.ndarray, size: int
) -> None:
    """Depth, normals and objects at the middle of pixels; a program for up to `size` of them."""
    origin, along = camera.rays(pixels)
    hits = caster.first(origin, along)
    met = hits.primitive >= 0
    image.depth.reshape(-1)[pixels] = hits.distance
    if not met.any():
        return
    reached = origin + np.where(met, hits.distance, 0.0)[:, None] * along
    parts = np.maximum(hits.primitive, 0), hits.u, hits.v, reached.astype(np.float32)
    # The last tile may be short.
    whole = [np.concatenate([a, np.repeat(a[:1], size - len(a), axis=0)]) for a in parts]
    normal = np.asarray(_normals(scene.geometry.typed("float32"), *whole))[: len(pixels)]
    normal = np.where((normal * along).sum(-1, keepdims=True) > 0.0, -normal, normal)
    image.normal.reshape(-1, 3)[pixels] = np.where(met[:, None], normal, 0.0)
    image.object.reshape(-1)[pixels] = np.where(met, scene.geometry.owner[hits.primitive], -1)


@eqx.filter_jit
def _normals(shapes: Any, primitive: Any, u: Any, v: Any, reached: Any) -> Array:
    arrays = (jnp.asarray(a) for a in (primitive, u, v, reached))
    return world.surface(shapes, *arrays).normal
