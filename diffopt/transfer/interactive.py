"""Relighting in a loop: what did not change since the last frame is not computed again."""

import functools
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import checks
from diffopt.errors import InputError
from diffopt.scenes import lights
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene
from diffopt.transfer import between, infinity, lighting, relighting
from diffopt.transfer.backgrounds import Background
from diffopt.transfer.raster import Raster
from diffopt.transfer.result import Transfer


class Relit:
    """A scene of precomputed transfer, looked at and lit as one likes.

    Programs are compiled for the first frame. Those after it are not compiled again, unless a
    camera sees more of the scene, or of what is behind it, than any before.

    Parameters
    ----------
    transfer
        Of the scene.
    scene
        Its lights and channels; those of `diffopt.transfer.infinity.from_infinity` are used.
    camera
        Looked through first.
    method, settings
        Of the lights, see `diffopt.transfer.lighting.prepare`.
    samples
        On a side of each pixel, 1 to 16.
    per_pixel
        Whether lobes are lit at every sample; False: at vertices only, coarser and faster.
    raster
        Finds what the camera sees; made of the transfer by default.

    Attributes
    ----------
    notes
        What was changed about the lights of the scene.
    """

    def __init__(
        self,
        transfer: Transfer,
        scene: Scene,
        camera: Camera,
        *,
        method: str = "pyramid",
        settings: Any = None,
        samples: int = 1,
        per_pixel: bool = True,
        raster: Raster | None = None,
    ) -> None:
        if isinstance(samples, bool) or not isinstance(samples, int) or not 1 <= samples <= 16:
            raise InputError(f"samples must be a whole number from 1 to 16; received {samples!r}")
        self.channels, self.samples, self.per_pixel = scene.channels, samples, per_pixel
        self.method, self.settings = method, settings
        found = infinity.from_infinity(scene)
        self.notes = found.notes
        self.tables = relighting.tables(transfer)
        self.raster = raster or Raster(transfer.mesh.vertices, transfer.triangles)
        self._sizes = [0, 0, 0]
        self._stops = 0.0
        self.light(found.scene.lights)
        self.look(camera)

    def light(self, sources: Sequence[lights.Light]) -> None:
        """Put other lights in place, from infinity all of them; errors as for `prepare`."""
        self._prepared = lighting.prepare(sources, self.channels, self.method, self.settings)
        self._behind = Background(sources, self.channels)
        self._axis = infinity.axis(sources)
        self.turn(0.0)

    def turn(self, degrees: float) -> None:
        """Turn the lights about the axis that is up, counter-clockwise, from where they were put.

        Raises
        ------
        InputError
            If the angle is not finite.
        """
        _finite("degrees", degrees)
        matrix = infinity.rotation(self._axis, float(degrees))
        self._turn = jnp.asarray(matrix, jnp.float32)
        self._lit = self._prepared.turned(self._turn)
        self._open = None

    def expose(self, stops: float) -> None:
        """Brighten frames by powers of two, or darken them; errors as for `turn`."""
        _finite("stops", stops)
        self._stops = float(stops)

    def look(self, camera: Camera) -> None:
        """Look through another camera."""
        seen = self.raster(camera, self.samples)
        self.camera = camera
        count, rows = len(seen.place), len(seen.covered)
        size = self._size(1, rows)
        fields = {
            "vertices": _filled(seen.vertices, self._size(0, len(seen.vertices)), 0),
            "covered": _filled(seen.covered, size, count),
            "place": np.where(seen.place == rows, np.int32(size), seen.place),
            "corners": _filled(seen.corners, size, 0),
            "shares": _filled(seen.shares, size, 1.0 / 3.0),
        }
        length = self._size(2, _bucket(len(seen.past)))
        self._past = jnp.asarray(_filled(seen.past, length, count))
        self._towards = jnp.asarray(seen.towards)[jnp.minimum(self._past, count - 1)]
        held: Any = {name: jnp.asarray(a) for name, a in fields.items()}
        # On the device, so that frames after this one carry nothing there.
        self._seen = seen._replace(eye=jnp.asarray(seen.eye), **held)  # type: ignore[arg-type]
        self._count, self._open = count, None

    def _size(self, which: int, wanted: int) -> int:
        self._sizes[which] = max(self._sizes[which], wanted)
        return self._sizes[which]

    @property
    def background(self) -> Float[Array, "S C"]:
        """Radiance of samples that see no surface, 0 elsewhere."""
        if self._open is None:
            found = self._behind(self._towards, self._turn)
            self._open = _spread(found, self._past, self._count)
        return self._open

    def radiance(
        self, held: relighting.Tables | None = None, background: bool = True
    ) -> Float[Array, "h w C"]:
        """The frame in the channels of the scene, on the device, without exposure.

        Parameters
        ----------
        held
            Tables in place of those of the transfer, see `diffopt.transfer.layers`.
        background
            Whether the environment is seen; 0 otherwise.
        """
        return between.picture(
            self.tables if held is None else held,
            self._lit,
            self._seen,
            background=self.background if background else None,
            per_pixel=self.per_pixel,
        )

    def frame(self) -> Float[np.ndarray, "h w 3"]:
        """The frame in linear RGB with the primaries of sRGB, exposed."""
        found = np.asarray(self.radiance())
        rgb = found if self.channels.wavelengths is None else self.channels.rgb(found)
        return (rgb * 2.0**self._stops).astype(np.float32)


def _finite(name: str, value: float) -> None:
    known = checks.concrete(value)
    if known is None or not np.isfinite(known).all() or np.ndim(known) != 0:
        raise InputError(f"{name} must be a finite number; received {value}")


def _bucket(count: int) -> int:
    """The next power of two, at least 1024."""
    return max(1024, 1 << max(count - 1, 0).bit_length())


def _filled(rows: np.ndarray, size: int, value: Any) -> np.ndarray:
    more = np.full((size - len(rows), *rows.shape[1:]), value, rows.dtype)
    return np.concatenate([rows, more])


@functools.partial(jax.jit, static_argnums=2)
def _spread(values: Array, places: Array, count: int) -> Array:
    whole = jnp.zeros((count, values.shape[1]), values.dtype)
    return whole.at[places].set(values, mode="drop")
