"""A deforming object and its soft shadow on the ground, under a sky, a sun and a lamp."""

import functools
import time
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from diffopt.scenes.camera import Camera
from diffopt.scenes.primary import PrimaryCaster, rays
from diffopt.shadows import animations, choosing, pictures
from diffopt.shadows.animations import Animation
from diffopt.shadows.lights import SphereLight, distant_light
from diffopt.shadows.moving import Occluder
from diffopt.shadows.rays import Rays
from diffopt.shadows.settings import ShadowSettings
from diffopt.shadows.shading import irradiance, plane
from diffopt.viewer import controls, painting, surfaces
from diffopt.viewer.controls import Control, Slider, Steps, Toggle, Values
from diffopt.viewer.subject import Coloured, Look, Place, Row

#: RMS errors of irradiance over the open light that may be asked for.
TOLERANCES = (0.05, 0.03, 0.02, 0.012, 0.008, 0.005, 0.002)
_FIELDS = "shadow fields"
# Receivers on a side of the ground.
_COUNT = 128
# Phases that tables are made to hold.
_FORESEEN = 24
# Directions to the sky from vertices of the object: fewer than in `diffopt shadow`.
_DIRECTIONS = (6, 16)
# Nodes by which the sky is projected: its sun is 30 degrees wide.
_NODES = 40
# The open ground becomes this bright.
_EXPOSED = 0.66
# The least value that becomes white.
_WHITE = 1.7
_UP = np.array([0.0, 0.0, 1.0])
_BULB = (10.0, 7.0, 4.0)


class Shadowed:
    """An animation over the ground, see `diffopt.viewer.subject.Subject`.

    Parameters
    ----------
    animation
        Of `diffopt.shadows.animations`.
    """

    turns, takes, averages = False, 4, False

    def __init__(self, animation: Animation) -> None:
        self.animation = animation
        self.title = f"{animation.name}: soft shadow of a deforming object"
        self.place = Place((0.6, -6.9, 3.9), (0.0, 0.0, 0.95), field_of_view=31.0)
        self.controls: Sequence[Control] = (
            Toggle("play", "play", True),
            Slider("phase", "phase", 0.0, 1.0, 0.01, 0.0),
            Slider("speed", "loops per minute", 1.0, 30.0, 1.0, 6.0),
            *controls.light_sliders(-146.0, 53.0, least=10.0),
            Toggle("lamp", "lamp", True),
            Slider("round", "lamp, round the object", 0.0, 1.0, 0.01, 0.0),
            Steps("tolerance", "tolerance", TOLERANCES, 0.012, "RMS error of the light."),
            Slider("exposure", "exposure (stops)", -4.0, 4.0, 0.1, 0.0),
        )
        self._ground = plane(animations.GROUND, _COUNT)
        self._faces = np.asarray(animation.faces, np.int32)
        self._bulb = _ball()

    def moves(self, values: Values) -> bool:
        """Whether it plays."""
        return bool(values["play"])

    def wanted(self, values: Values, built: Mapping[str, Any]) -> dict[str, Hashable]:
        """Fields to a tolerance."""
        return {_FIELDS: (values["tolerance"], values["lamp"])}

    def build(self, name: str, key: Any) -> Any:
        """Settings, and the programs of frames."""
        tolerance, lamp = key
        settings = choosing.settings_for(tolerance)
        values = {**controls.initial(self.controls), "play": False, "lamp": lamp}
        camera = Camera(self.place.eye, self.place.target, resolution=(64, 48))
        begun = time.perf_counter()
        built = {_FIELDS: (settings, 0.0)}
        self.pixels(built, Look(values, camera))
        return settings, time.perf_counter() - begun

    def _occluder(self, settings: ShadowSettings, memory: dict[str, Any]) -> Occluder:
        if memory.get("settings") != settings:
            found = Occluder(self.animation.faces, settings)
            for t in np.arange(_FORESEEN) / _FORESEEN:
                found.move(*self.animation.pose(float(t)))
                found.foresee(self.animation.shape(float(t)), self._ground)
            memory.clear()
            memory.update(settings=settings, occluder=found)
        return memory["occluder"]

    def _sky(self, values: Values) -> Any:
        sun = np.asarray(controls.light_direction(values))
        return functools.partial(animations.sky, sun=sun)

    def _frame(self, built: Mapping[str, Any], look: Look) -> dict[str, Any]:
        """Shape and light of a frame; what is as it was in the last one is not computed again."""
        settings, _ = built[_FIELDS]
        memory, values = look.memory, look.values
        occluder = self._occluder(settings, memory)
        phase = values["phase"]
        if values["play"]:
            phase = (phase + look.clock * values["speed"] / 60.0) % 1.0
        moved = memory.get("phase") != phase
        if moved:
            occluder.move(*self.animation.pose(phase))
            occluder.update(self.animation.shape(phase), self._ground)
            memory.update(phase=phase, rays=Rays(occluder.vertices, self._faces))
        lamp = animations.lamp(values["round"]) if values["lamp"] else None
        sun = (values["azimuth"], values["elevation"])
        if memory.get("sun") != sun:
            memory.update(sun=sun, sky=distant_light(self._sky(values), settings.bands, _NODES))
        key = sun, values["lamp"], values["round"]
        if moved or memory.get("light") != key:
            begun = time.perf_counter()
            lights = [memory["sky"]] if lamp is None else [memory["sky"], lamp]
            ground = irradiance(self._ground, _UP, occluder.fields, lights, settings)
            memory["grid"] = np.asarray(ground, np.float32)
            memory["shadowing"] = time.perf_counter() - begun
            self._body(memory, occluder.vertices, lamp, self._sky(values))
            memory["light"] = key
        return memory

    def _body(
        self,
        memory: dict[str, Any],
        vertices: Float[np.ndarray, "V 3"],
        lamp: SphereLight | None,
        sky: Any,
    ) -> None:
        """The object and the bulb as one mesh, with radiance on both sides of their vertices."""
        light = pictures.lit(
            memory["rays"], vertices, self._faces, lamp, sky=sky, directions=_DIRECTIONS
        )
        value = light * np.asarray(self.animation.colour) / np.pi
        faces = self._faces
        if lamp is not None:
            points, corners = self._bulb
            ball = np.asarray(lamp.centre) + float(lamp.radius) * points
            faces = np.concatenate([faces, corners + len(vertices)])
            vertices = np.concatenate([vertices, ball])
            glow = np.broadcast_to(_BULB, (2, len(ball), 3)) / self._factor
            value = np.concatenate([value, glow], 1)
        memory["body"] = vertices, faces, value.astype(np.float32)
        memory["caster"] = PrimaryCaster(vertices, faces)

    @functools.cached_property
    def _factor(self) -> float:
        """Exposure: the open ground under the first sky becomes `_EXPOSED`."""
        bright = pictures.open_ground() * pictures.GROUND_RGB / np.pi
        return _EXPOSED / pictures.luminance(bright)

    def pixels(self, built: Mapping[str, Any], look: Look) -> UInt8[np.ndarray, "h w 3"]:
        """A frame: the ground between receivers, the object between vertices."""
        held, camera = self._frame(built, look), look.camera
        exposure = np.float32(self._factor * 2.0 ** look.values["exposure"])
        rows, columns = camera.shape
        out = painting.backdrop(rows, columns)
        flat = out.reshape(-1, 3)
        along, eye = rays(camera, look.inside), np.asarray(camera.eye, np.float32)
        grid = jnp.asarray(held["grid"])
        down = np.flatnonzero(along[:, 2] * eye[2] < 0.0)
        if len(down):
            far = -eye[2] / along[down, 2]
            place = eye[:2] + far[:, None] * along[down, :2]
            near = (place * place).sum(1) < (0.5 * animations.GROUND) ** 2
            down, place = down[near], place[near]
            flat[down] = painting.in_chunks(
                lambda at, behind: _floor(grid, at, behind, exposure), len(down), place, flat[down]
            )
        hits = held["caster"](camera, look.inside)
        # The ground hides what lies below it, and the other way round.
        height = eye[2] + hits.distance * along[hits.pixel, 2]
        shown = np.flatnonzero(height * eye[2] > 0.0)
        _, faces, value = held["body"]
        corners = faces[hits.face[shown]].astype(np.int32)
        shares = np.ascontiguousarray(hits.shares[shown], np.float32)
        side = np.where(hits.front[shown], 0, 1).astype(np.int32)
        # One length for all shapes, with a lamp and without.
        values = jnp.asarray(value)
        flat[hits.pixel[shown]] = painting.in_chunks(
            lambda c, s, k: _surface(values, c, s, k, exposure), len(shown), corners, shares, side
        )
        return out

    def colours(self, built: Mapping[str, Any], look: Look) -> Coloured:
        """A frame: receivers and vertices, each with its colour."""
        held = self._frame(built, look)
        exposure = self._factor * 2.0 ** look.values["exposure"]
        vertices, faces, value = held["body"]
        ground = held["grid"].reshape(-1, 3) * pictures.GROUND_RGB / np.pi
        both = np.concatenate([value[0], ground]).astype(np.float32)
        found = np.asarray(painting.encoded(jnp.asarray(both), np.float32(exposure), _WHITE)).copy()
        distance = np.linalg.norm(self._ground.reshape(-1, 3)[:, :2], axis=1)
        share = pictures.ground_share(distance)[:, None]
        floor = found[len(vertices) :]
        found[len(vertices) :] = np.round(share * floor + (1.0 - share) * _BEHIND)
        squares = surfaces.triangles(_COUNT, _COUNT)
        squares = squares[share[squares, 0].max(1) > 0.0] + len(vertices)
        return Coloured(
            np.concatenate([vertices, self._ground.reshape(-1, 3)]).astype(np.float64),
            np.concatenate([faces, squares]).astype(np.int32),
            found,
        )

    def rows(self, built: Mapping[str, Any], look: Look) -> list[Row]:
        """The table beside the picture."""
        settings, seconds = built[_FIELDS]
        memory, values = look.memory, look.values
        times = memory["occluder"].times if "occluder" in memory else None
        spent = ""
        if times is not None:
            spent = (
                f"{1e3 * times.sampling:.0f} ms rays, {1e3 * times.conversion:.0f} ms tables, "
                f"{1e3 * memory.get('shadowing', 0.0):.0f} ms for {_COUNT**2} receivers"
            )
        polar, azimuth = settings.directions
        return [
            Row(
                "shadow of sky and sun",
                True,
                f"RMS error ≤ {values['tolerance']:g} of the open light",
                f"{settings.bands} bands, {settings.shells} shells of {polar}×{azimuth}; {spent}",
            ),
            Row(
                "shadow of the lamp",
                values["lamp"],
                "a sphere of light near by" if values["lamp"] else "switched off",
            ),
            Row(
                "shadow of the object on itself",
                True,
                "rays",
                f"{_DIRECTIONS[0] * _DIRECTIONS[1]} directions a vertex",
            ),
            Row("light from the ground to the object", True, "even, without shadow"),
            Row(
                "light from the object to the ground",
                False,
                "shadow fields only hide",
            ),
            Row("programs", True, f"compiled in {seconds:.1f} s"),
        ]


# Behind the rim of the ground where the browser draws it: the middle of the backdrop.
_BEHIND = 48.0


@eqx.filter_jit
def _floor(grid: Any, place: Any, behind: Any, exposure: Any) -> UInt8[Array, "n 3"]:
    """The ground at points, bilinear between receivers, fading into what is behind it."""
    count = grid.shape[0]
    at = jnp.clip((place / animations.GROUND + 0.5) * count - 0.5, 0.0, count - 1.0)
    low = jnp.clip(at.astype(jnp.int32), 0, count - 2)
    part = at - low.astype(at.dtype)
    flat = grid.reshape(-1, 3)
    first = low[:, 0] * count + low[:, 1]
    x, y = part[:, :1], part[:, 1:]
    lower = (1.0 - y) * flat[first] + y * flat[first + 1]
    upper = (1.0 - y) * flat[first + count] + y * flat[first + count + 1]
    light = (1.0 - x) * lower + x * upper
    colour = jnp.asarray(pictures.GROUND_RGB, jnp.float32) / jnp.float32(np.pi)
    found = painting.codes(light * colour[None, :], exposure, _WHITE).astype(jnp.float32)
    distance = jnp.sqrt(place[:, 0] ** 2 + place[:, 1] ** 2)
    share = pictures.ground_share(distance)[:, None]
    return jnp.round(share * found + (1.0 - share) * behind.astype(jnp.float32)).astype(jnp.uint8)


@eqx.filter_jit
def _surface(
    values: Any, corners: Any, shares: Any, side: Any, exposure: Any
) -> UInt8[Array, "n 3"]:
    """The object at points, between its vertices."""
    parts = [values[side, corners[:, k]] * shares[:, k : k + 1] for k in range(3)]
    return painting.codes(parts[0] + parts[1] + parts[2], exposure, _WHITE)


def _ball() -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    found = trimesh.creation.icosphere(subdivisions=2)
    return np.asarray(found.vertices), np.asarray(found.faces, np.int32)
