"""Pictures as differentiable functions of a scene, at fixed visibility.

>>> view = record(scene, camera, "recursive")
>>> def loss(scene):
...     return ((view(scene) - target) ** 2).mean()
>>> slope = equinox.filter_grad(loss)(scene)
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.rendering import driver
from diffopt.rendering.queries import Queries, Record
from diffopt.rendering.settings import Settings
from diffopt.rendering.stage import Stage
from diffopt.scenes import raycasting
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene


class View:
    """A camera's picture of a scene and of its variations; see `record`.

    Attributes
    ----------
    scene, camera, settings
        What it was recorded with.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        settings: Settings,
        level: Callable[[], driver.Level],
        dtype: Any,
        even: bool,
    ) -> None:
        self.scene, self.camera, self.settings = scene, camera, settings
        self._level, self._dtype, self._even = level, dtype, even
        self._records: list[Record] = []
        stage, follow = Stage(scene, dtype, held=scene), level()
        caster = raycasting.caster(scene.geometry, settings.backend)
        for rays in self._passes(stage):
            self._records.append(Record())
            follow(stage, rays, Queries(caster, self._records[-1]), self._key)

    @property
    def _key(self) -> Array:
        return jax.random.key(self.settings.seed)

    def _passes(self, stage: Stage) -> Any:
        """Rays of each pass, tile by tile."""
        runs, together = driver.tiles(self.camera, self.settings)
        size = len(runs[0])
        for pixels in runs:
            for first in range(0, self.settings.spp, together):
                yield driver.primary(
                    self.camera,
                    stage,
                    self._key,
                    pixels,
                    size,
                    first,
                    together,
                    self.settings,
                    self._even,
                )

    def __call__(self, scene: Scene) -> Float[Array, "h w C"]:
        """Radiance of a scene over the pixels.

        Parameters
        ----------
        scene
            The recorded one with other numbers in its materials and lights. Rays, what they
            meet and what they are shaded by stay as recorded; that is exact for the recorded
            scene and its derivatives, apart from the motion of shadows and reflections.

        Raises
        ------
        InputError
            If shapes or their places differ from the recorded ones.
        """
        places = [one.place for one in scene.objects]
        if places != [one.place for one in self.scene.objects]:
            raise InputError("shapes and places must be those that were recorded")
        stage, follow = Stage(scene, self._dtype, held=self.scene), self._level()
        runs, together = driver.tiles(self.camera, self.settings)
        size, count = len(runs[0]), self.settings.spp
        passes = iter(zip(self._passes(stage), self._records, strict=True))
        image = []
        for pixels in runs:
            total = jnp.zeros((size, stage.channels), self._dtype)
            for first in range(0, count, together):
                rays, record = next(passes)
                rays = follow(stage, rays, Queries(None, record), self._key)
                found = rays.radiance.reshape(size, together, -1)
                total = total + found[:, : count - first].sum(1)
            image.append(total[: len(pixels)] / count)
        return jnp.concatenate(image).reshape(*self.camera.shape, -1)
