"""Precomputed transfer of test scenes: what it took, and pictures of it beside the truth.

The truth is known in the middle of every pixel, where the pictures are taken too: edges of
pixels play no part.
"""

import dataclasses
import functools
import statistics
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from diffopt.accuracy import transfer_scenes, transfer_truth
from diffopt.errors import InputError
from diffopt.scenes.channels import Channels
from diffopt.transfer import between, precomputation
from diffopt.transfer.lighting import Lighting, prepare
from diffopt.transfer.raster import Raster, Seen
from diffopt.transfer.relighting import Tables
from diffopt.transfer.result import Transfer
from diffopt.transfer.settings import TransferSettings


@dataclasses.dataclass(frozen=True)
class Setup:
    """A scene under a light, at a size.

    Attributes
    ----------
    scene, light
        Names, see `diffopt.accuracy.transfer_scenes`.
    detail, resolution
        Of the meshes and the picture, see there.
    paths
        Of the truth at every pixel, a multiple of 8.
    """

    scene: str
    light: str = "suns"
    detail: int = 8
    resolution: int = 96
    paths: int = 2048

    @property
    def subject(self) -> transfer_scenes.Subject:
        """The scene without its light."""
        return transfer_scenes.subject(self.scene, self.detail, self.resolution)


class Made(NamedTuple):
    """Transfer, seconds and core-seconds of its last precomputation, and what a first took more."""

    transfer: Transfer
    seconds: float
    core_seconds: float
    compile_s: float


class Reference(NamedTuple):
    """Radiance at the middle of pixels.

    Attributes
    ----------
    pixels
        Numbers of those that see the front of a surface, [n].
    value, error
        Radiance and its standard error, [n].
    """

    pixels: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]
    error: Float[np.ndarray, " n"]


@dataclasses.dataclass(frozen=True)
class Score:
    """A picture against the truth.

    Attributes
    ----------
    rmse
        Root-mean-square difference over the mean of the truth, less what is the noise of the
        truth.
    noise
        Root-mean-square standard error of the truth over its mean.
    bias
        Mean difference over the mean of the truth.
    worst
        What 1 % of the pixels exceed, over the mean; noise of the truth included.
    ssim
        Structural similarity (scikit-image), 1 for equal pictures.
    """

    rmse: float
    noise: float
    bias: float
    worst: float
    ssim: float


@functools.lru_cache(maxsize=8)
def made(
    scene: str,
    detail: int,
    settings: TransferSettings,
    uniform: int | None = None,
    again: bool = True,
) -> Made:
    """Transfer of a scene.

    Parameters
    ----------
    scene, detail
        See `diffopt.accuracy.transfer_scenes.subject`.
    settings, uniform
        See `diffopt.transfer.precomputation.precompute`.
    again
        Whether it is computed a second time, so that no time is that of compilation.
    """
    subject = transfer_scenes.subject(scene, detail)
    found, seconds, cores = None, [], []
    for _ in range(2 if again else 1):
        begun, spent = time.perf_counter(), time.process_time()
        found = precomputation.precompute(subject.scene, settings, uniform=uniform)
        seconds.append(time.perf_counter() - begun)
        cores.append(time.process_time() - spent)
    assert found is not None
    return Made(found, seconds[-1], cores[-1], max(seconds[0] - seconds[-1], 0.0))


@functools.lru_cache(maxsize=8)
def reference(setup: Setup) -> Reference:
    """The truth of a setup, direct light and one interreflection."""
    subject = setup.subject
    pixels, points = transfer_truth.seen(subject)
    light = transfer_scenes.light(setup.light)
    found = transfer_truth.radiance(subject.scene, points, light, setup.paths)
    return Reference(pixels, found.value, found.error)


def lighting(light: str, method: str | None = None, settings: Any = None) -> Lighting:
    """A light ready for relighting, in one channel; by default as exactly as it can be."""
    how = method or ("lobes" if light == "suns" else "pyramid")
    return prepare([transfer_scenes.light(light).light], Channels(), how, settings)


def seen(transfer: Transfer, setup: Setup) -> Seen:
    """What the camera of a setup sees of a mesh, a sample in the middle of each pixel."""
    raster = Raster(transfer.mesh.vertices, transfer.triangles)
    return raster(setup.subject.camera, 1)


def covered(transfer: Transfer, setup: Setup) -> np.ndarray:
    """Whether pixels see the front of a mesh, [pixels]."""
    found = seen(transfer, setup).covered
    out = np.zeros(setup.resolution**2, bool)
    out[found[found < len(out)]] = True
    return out


def picture(
    held: Tables, light: Lighting, at: Seen, per_pixel: bool = True
) -> Float[np.ndarray, "h w"]:
    """Relit picture of a grey scene under grey light."""
    found = between.picture(held, light, at, per_pixel=per_pixel)
    return np.asarray(found, np.float64)[..., 0]


def frame_s(
    held: Tables, light: Lighting, at: Seen, repeats: int = 5, per_pixel: bool = True
) -> float:
    """Median seconds of a frame, its light turned a little each time, without compilation."""
    turns = [_turn(0.1 * k) for k in range(repeats + 1)]
    arrays = {n: getattr(at, n) for n in at._fields if isinstance(getattr(at, n), np.ndarray)}
    at = at._replace(**{name: jnp.asarray(array) for name, array in arrays.items()})
    times = []
    for turn in turns:
        now = light.turned(turn)
        jax.block_until_ready(jax.tree.leaves(now))
        begun = time.perf_counter()
        jax.block_until_ready(between.picture(held, now, at, per_pixel=per_pixel))
        times.append(time.perf_counter() - begun)
    return statistics.median(times[1:])


def _turn(angle: float) -> Float[Array, "3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    return jnp.asarray([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], jnp.float32)


def score(image: Float[np.ndarray, "h w"], truth: Reference, front: np.ndarray) -> Score:
    """How far a picture is off, where both it and the truth see a surface.

    Raises
    ------
    InputError
        If they see no surface together.
    """
    from skimage.metrics import structural_similarity

    some = front[truth.pixels]
    if not some.any():
        raise InputError("picture and truth see no surface together")
    pixels, value, error = (a[some] for a in truth)
    off = image.reshape(-1)[pixels] - value
    mean, noise = value.mean(), (error**2).mean()
    whole = np.zeros(image.size)
    whole[pixels] = value
    own = np.zeros(image.size)
    own[pixels] = image.reshape(-1)[pixels]
    similar: Any = structural_similarity(
        whole.reshape(image.shape), own.reshape(image.shape), data_range=float(value.max())
    )
    return Score(
        rmse=float(np.sqrt(max((off**2).mean() - noise, 0.0)) / mean),
        noise=float(np.sqrt(noise) / mean),
        bias=float(off.mean() / mean),
        worst=float(np.quantile(np.abs(off), 0.99) / mean),
        ssim=float(similar),
    )


def size_bytes(held: Tables) -> int:
    """Bytes of the slices and of where they belong."""
    arrays = (held.position, held.axes, held.level, held.first, held.material)
    return sum(a.nbytes for a in (*arrays, held.views, held.diffuse, held.over.rows))


def without_indirect(transfer: Transfer) -> Transfer:
    """Transfer of direct light alone."""

    def direct(found: Any) -> Any:
        alpha = np.array(found.alpha)
        alpha[:, 1:] = 0.0
        return found._replace(alpha=alpha)

    return dataclasses.replace(
        transfer, views=direct(transfer.views), diffuse=direct(transfer.diffuse)
    )
