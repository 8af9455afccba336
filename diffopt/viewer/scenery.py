"""Any scene: by the effects that a plan calls for, or by a level of image synthesis."""

import dataclasses
import time
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import UInt8

from diffopt.drawing import tones
from diffopt.planning.choosing import plan as plan_of
from diffopt.planning.plans import Plan
from diffopt.rendering.settings import (
    IncrementalSettings,
    PathSettings,
    Settings,
)
from diffopt.rendering.synthesis import render
from diffopt.scenes.camera import Camera
from diffopt.scenes.lights import Directional, Environment, LobeEnvironment
from diffopt.scenes.scene import Scene
from diffopt.transfer import infinity
from diffopt.viewer import controls, exponents
from diffopt.viewer.controls import Control, Menu, Slider, Steps, Values
from diffopt.viewer.glossy import place_of
from diffopt.viewer.subject import Look, Row, StaleError

#: Mean differences of luminance that may be asked for.
TOLERANCES = (0.3, 0.1, 0.05, 0.03, 0.01)
_PLAN, _PROGRAMS = "the plan", "programs"
_PLANNED = "what the plan calls for"
# One size of tile for all pictures of more pixels: nothing is compiled for another size.
_RAYS = 2**13
# The picture that a plan is made of.
_PILOT = (160, 120)
# The plan is made anew when lights have turned by so many degrees.
_STEP = 30.0
_BRIGHT = 97.0
_LEVELS: dict[str, Settings] = {
    "direct light": IncrementalSettings(spp=1, rays=_RAYS),
    "all paths": PathSettings(spp=1, rays=_RAYS),
}


class Scenery:
    """A scene, see `diffopt.viewer.subject.Subject`.

    Parameters
    ----------
    scene, camera
        What, and from where at first.
    name
        For the title.
    """

    takes, averages = 64, True

    def __init__(self, scene: Scene, camera: Camera, name: str = "scene") -> None:
        self.scene, self.title = scene, f"{name}: {len(scene.objects)} objects"
        self.place, self._camera = place_of(camera), camera
        self._exponent = exponents.first(scene)
        distant = (Environment, LobeEnvironment, Directional)
        turning: tuple[Slider, ...] = ()
        if any(isinstance(light, distant) for light in scene.lights):
            turning = (Slider("turn", "distant light turned (°)", -180.0, 180.0, 1.0, 0.0),)
        hint = "Of all materials that have one."
        self.controls: Sequence[Control] = (
            Menu("level", "light", (_PLANNED, *_LEVELS), _PLANNED),
            Steps("tolerance", "tolerance", TOLERANCES, 0.05, "Of the plan, over the mean."),
            *turning,
            *exponents.sliders(self._exponent, hint),
            Slider("exposure", "exposure (stops)", -6.0, 6.0, 0.1, 0.0),
        )
        self._exposure: float | None = None

    def moves(self, values: Values) -> bool:
        """Nothing moves by itself."""
        return False

    def wanted(self, values: Values, built: Mapping[str, Any]) -> dict[str, Hashable]:
        """A plan if it is asked for, and programs of its effects or of a level."""
        level = values["level"]
        if level != _PLANNED:
            return {_PROGRAMS: level}
        turned = round(values.get("turn", 0.0) / _STEP)
        found: dict[str, Hashable] = {_PLAN: (values["tolerance"], values.get("exponent"), turned)}
        if _PLAN in built:
            found[_PROGRAMS] = built[_PLAN]
        return found

    def build(self, name: str, key: Any) -> Any:
        """Make a plan, or compile for a level or a plan."""
        values = controls.initial(self.controls)
        if name == _PLAN:
            tolerance, exponent, turned = key
            values = {**values, "turn": _STEP * turned, "exponent": exponent}
            camera = dataclasses.replace(self._camera, resolution=_PILOT)
            return plan_of(self._scene(values), camera, tolerance)
        camera = dataclasses.replace(self._camera, resolution=_filled(self._camera.resolution))
        begun = time.perf_counter()
        image = self._picture(key, self._scene(values), Look(values, camera))
        if self._exposure is None:
            self._exposure = tones.exposure(_clipped(image.rgb), _BRIGHT)
        return key, time.perf_counter() - begun

    def _scene(self, values: Values) -> Scene:
        found = self.scene
        if values.get("turn"):
            turned = infinity.turned(found.lights, values["turn"])
            found = Scene(found.objects, turned, wavelengths=found.channels.wavelengths)
        wanted, own = values.get("exponent"), self._exponent
        if wanted is not None and own is not None and wanted != round(own):
            found = exponents.replaced(found, wanted)
        return found

    def _picture(self, key: Any, scene: Scene, look: Look) -> Any:
        """One sample a pixel; another one for each take."""

        def told(done: int, of: int) -> None:
            if look.stale():
                raise StaleError

        planned = isinstance(key, Plan)
        settings = key.paths if planned else _LEVELS[key]
        settings = dataclasses.replace(settings, spp=1, rays=_RAYS, seed=look.take)
        level = key if planned else "path"
        return render(scene, look.camera, level, settings=settings, progress=told)

    def pixels(self, built: Mapping[str, Any], look: Look) -> UInt8[np.ndarray, "h w 3"]:
        """A frame: the mean over one path a pixel of each take so far."""
        key, _ = built[_PROGRAMS]
        memory, camera = look.memory, look.camera
        here = tuple(look.values.get(name) for name in ("turn", "exponent"))
        if memory.get("here") != here:
            memory.update(here=here, scene=self._scene(look.values))
        camera = dataclasses.replace(camera, resolution=_filled(camera.resolution))
        now = dataclasses.replace(look, camera=camera)
        image = self._picture(key, memory["scene"], now)
        found = np.asarray(image.rgb, np.float32)
        if look.take == 0 or memory["sum"].shape != found.shape:
            memory["sum"] = np.zeros_like(found)
            memory["count"] = 0
        memory["sum"] += found
        memory["count"] += 1
        mean = _clipped(memory["sum"] / memory["count"])
        factor = (self._exposure or 1.0) * 2.0 ** look.values["exposure"]
        toned = tones.tone(mean, factor)
        return np.round(255.0 * tones.encode(toned)).astype(np.uint8)

    def rows(self, built: Mapping[str, Any], look: Look) -> list[Row]:
        """The plan."""
        key, seconds = built[_PROGRAMS]
        programs = Row("programs", True, f"compiled in {seconds:.1f} s")
        count = look.memory.get("count", 0)
        paths = Row("paths of a pixel so far", True, str(count))
        if not isinstance(key, Plan):
            return [Row(key, True, "chosen"), paths, programs]
        found = [
            Row(row.effect, row.included, row.because, row.settings if row.included else "")
            for row in key.rows
        ]
        return [*found, paths, programs]


def _filled(resolution: tuple[int, int]) -> tuple[int, int]:
    """A resolution near another one that fills whole tiles, at least one."""
    count = max(resolution[0] * resolution[1] // _RAYS, 1) * _RAYS
    rows = max(round(np.sqrt(count * resolution[1] / resolution[0])), 1)
    columns = max(count // rows, 1)
    # Less than a tile would be another program.
    return (columns + 1, rows) if columns * rows < _RAYS else (columns, rows)


def _clipped(rgb: Any) -> np.ndarray:
    return np.maximum(np.asarray(rgb, np.float64), 0.0)
