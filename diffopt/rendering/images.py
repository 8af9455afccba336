"""Rendered pictures: radiance, its standard error, and what is seen where; their files."""

import dataclasses
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from diffopt.errors import InputError
from diffopt.rendering import effects
from diffopt.rendering.settings import Settings
from diffopt.scenes.camera import Camera
from diffopt.scenes.channels import Channels
from diffopt.scenes.scene import Scene

#: Suffixes of the files that pictures are written to.
FORMATS = (".png", ".exr", ".npz")


@dataclasses.dataclass
class Image:
    """A picture.

    Attributes
    ----------
    radiance
        Mean over each pixel, in the scene's channels, [h, w, C]; 0 where it is not done.
    error
        Standard error of that, [h, w, C]; infinite for one sample. Of levels whose samples lie
        evenly it is a bound.
    depth, normal, object
        At the middle of each pixel: distance from the camera (infinite for none), the unit
        normal that faces it (0 for none), and the number of the object (-1 for none);
        [h, w], [h, w, 3], [h, w].
    done
        Whether the pixel was rendered, [h, w].
    channels
        What C stands for.
    names
        Of the objects.
    settings
        How it was rendered.
    seconds
        How long that took.
    interrupted
        Whether it was ended before all was done.
    restored
        Share of the pixels that an earlier run had done, see `diffopt.rendering.render`.
    layers
        Radiance by effect, [h, w, C] each, where they were asked for: their sum is `radiance`.
        Light is as it would arrive unshadowed; what shadows take away is theirs, below 0.
    """

    radiance: Float[np.ndarray, "h w C"]
    error: Float[np.ndarray, "h w C"]
    depth: Float[np.ndarray, "h w"]
    normal: Float[np.ndarray, "h w 3"]
    object: Int[np.ndarray, "h w"]
    done: Bool[np.ndarray, "h w"]
    channels: Channels
    names: tuple[str, ...]
    settings: Settings
    seconds: float = 0.0
    interrupted: bool = False
    restored: float = 0.0
    layers: dict[str, Float[np.ndarray, "h w C"]] = dataclasses.field(default_factory=dict)

    @staticmethod
    def blank(scene: Scene, camera: Camera, settings: Settings) -> "Image":
        """A picture of which nothing is done."""
        shape, count = camera.shape, scene.channels.count
        return Image(
            radiance=np.zeros((*shape, count)),
            error=np.full((*shape, count), np.inf),
            depth=np.full(shape, np.inf),
            normal=np.zeros((*shape, 3)),
            object=np.full(shape, -1, np.int32),
            done=np.zeros(shape, bool),
            channels=scene.channels,
            names=tuple(one.name or str(k) for k, one in enumerate(scene.objects)),
            settings=settings,
        )

    def fill(self, pixels: np.ndarray, total: np.ndarray, squares: np.ndarray, count: int) -> None:
        """Put in sums over the samples of pixels, [n, C], and over their squares.

        Beyond the channels there may be those of `effects.LAYERS`, one after the other.
        """
        channels = self.channels.count
        for k, name in enumerate(effects.LAYERS if total.shape[1] > channels else ()):
            part = total[:, (k + 1) * channels : (k + 2) * channels] / count
            if part.any() or name in self.layers:
                whole = self.layers.setdefault(name, np.zeros_like(self.radiance))
                whole.reshape(-1, channels)[pixels] = part
        total, squares = total[:, :channels], squares[:, :channels]
        mean = total / count
        self.radiance.reshape(-1, mean.shape[1])[pixels] = mean
        if count > 1:
            variance = np.maximum(squares / count - mean * mean, 0.0) / (count - 1)
            self.error.reshape(-1, mean.shape[1])[pixels] = np.sqrt(variance)
        self.done.reshape(-1)[pixels] = True

    @property
    def rgb(self) -> Float[np.ndarray, "h w 3"]:
        """Linear RGB with the primaries of sRGB; outside [0, 1] where a display cannot follow."""
        return self.channels.rgb(self.radiance)

    @property
    def xyz(self) -> Float[np.ndarray, "h w 3"]:
        """XYZ; a radiance of 1 in all channels is D65 with Y = 1."""
        return self.channels.xyz(self.radiance)

    @property
    def noise(self) -> float:
        """Standard error of the luminance over its mean, as a mean over the pixels."""
        weights = self.channels.luminance()
        mean = float((self.radiance @ weights)[self.done].mean()) if self.done.any() else 0.0
        error = np.sqrt((self.error**2) @ (weights**2))[self.done]
        return float(error.mean()) / mean if mean > 0.0 else 0.0

    def exposure(self, percentile: float = 97.0) -> float:
        """Factor that brings a percentile of the brightest channel to white."""
        from diffopt.drawing import tones

        return tones.exposure(np.maximum(self.rgb[self.done], 0.0), percentile)

    def display(
        self, exposure: float | None = None, *, tone: bool = True
    ) -> UInt8[np.ndarray, "h w 3"]:
        """Pixels for an sRGB display.

        Parameters
        ----------
        exposure
            Factor on linear values; that of the method if left out.
        tone
            Compress what is brighter than white; clipped otherwise.
        """
        from diffopt.drawing import tones

        rgb = tones.display(self.xyz)
        factor = self.exposure() if exposure is None else exposure
        linear = tones.tone(rgb, factor) if tone else factor * rgb
        return np.round(255.0 * tones.encode(linear)).astype(np.uint8)

    def save(self, path: str | os.PathLike, *, exposure: float | None = None) -> None:
        """Write the picture, aside first and then renamed.

        Parameters
        ----------
        path
            ``.png``: tone-mapped sRGB, 8 bits. ``.exr``: linear RGB, every channel of a
            spectral scene, standard error, normals, depth and objects as layers of 32 bits;
            needs OpenEXR. ``.npz``: the arrays.
        exposure
            For ``.png``, see `display`.

        Raises
        ------
        InputError
            For another suffix, a folder that is not there, or ``.exr`` without OpenEXR.
        """
        from diffopt.rendering import files

        path = Path(path)
        write = {".png": files.png, ".exr": files.exr, ".npz": files.npz}.get(path.suffix.lower())
        if write is None:
            raise InputError(f"{path}: pictures are written to {', '.join(FORMATS)}")
        write(self, path, exposure)

    def summary(self) -> dict[str, Any]:
        """What was rendered, for records."""
        return {
            "level": self.settings.level,
            "settings": dataclasses.asdict(self.settings),
            "resolution": list(self.radiance.shape[1::-1]),
            "seconds": self.seconds,
            "done": float(self.done.mean()),
            "noise": self.noise,
        }

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, renders

        return bundles.bundle(self, renders.card)
