"""Precomputed glossy transfer under lights that turn."""

import dataclasses
import math
import time
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from diffopt.rendering import programs
from diffopt.scenes.camera import Camera
from diffopt.scenes.primary import PrimaryCaster, rays
from diffopt.scenes.scene import Scene
from diffopt.transfer import (
    angular,
    beginning,
    between,
    infinity,
    layers,
    lighting,
    references,
    relighting,
)
from diffopt.transfer.backgrounds import Background
from diffopt.transfer.distant import Lights, Suns
from diffopt.transfer.relighting import Tables
from diffopt.transfer.result import Transfer
from diffopt.transfer.settings import KINDS
from diffopt.viewer import controls, exponents, painting
from diffopt.viewer.controls import Control, Slider, Steps, Toggle, Values
from diffopt.viewer.subject import Coloured, Look, Place, Row

#: Shares of the light that may be left out.
TOLERANCES = (0.3, 0.1, 0.03, 0.01, 0.0)
_PLAN, _TABLES = "the plan", "tables and programs"
# The plan is made anew when a light has moved by so many degrees.
_STEP = 15.0
# Exposure at first: the mean luminance of the vertices becomes this.
_MEAN = 0.35


class Held(eqx.Module):
    """Tables, and what becomes of the channels."""

    tables: Tables
    to_rgb: Float[Array, "C 3"] | None
    exposure: Float[Array, ""]


class Glossy:
    """Precomputed transfer, see `diffopt.viewer.subject.Subject`.

    Parameters
    ----------
    transfer
        Of the scene.
    scene
        Its lights and materials.
    camera
        At first.
    name
        For the title.
    """

    turns, takes, averages = True, 4, False

    def __init__(self, transfer: Transfer, scene: Scene, camera: Camera, name: str = "scene"):
        found = infinity.from_infinity(scene)
        self.transfer, self.scene = transfer, found.scene
        self.title = f"{name}: glossy transfer, {len(transfer.axes)} vertices"
        self.place = place_of(camera)
        self._tables = relighting.tables(transfer)
        self._caster = PrimaryCaster(transfer.mesh.vertices, transfer.triangles)
        self._triangles = np.asarray(transfer.triangles, np.int32)
        channels = self.scene.channels
        self._around = lighting.prepare(self.scene.lights, channels)
        self._behind = Background(self.scene.lights, channels)
        self._axis = infinity.axis(self.scene.lights)
        spectral = channels.wavelengths is not None
        self._to_rgb = channels.rgb(np.eye(channels.count)) if spectral else None
        self._exponent = exponents.first(self.scene)
        hint = "Direct lobes are fitted again; light between surfaces stays as precomputed."
        self.controls: Sequence[Control] = (
            Slider("turn", "environment turned (°)", -180.0, 180.0, 1.0, 0.0),
            Slider("strength", "parallel light", 0.0, 10.0, 0.1, 0.0, "Irradiance of a sun."),
            *controls.light_sliders(-40.0, 40.0),
            *exponents.sliders(self._exponent, hint),
            Steps(
                "tolerance",
                "tolerance",
                TOLERANCES,
                0.0,
                "Kinds of light that bring less than this together are left out.",
            ),
            Slider("exposure", "exposure (stops)", -6.0, 6.0, 0.1, 0.0),
            Toggle("surroundings", "surroundings", True, "The environment behind the scene."),
        )
        self._first: float | None = None

    def moves(self, values: Values) -> bool:
        """Nothing moves by itself."""
        return False

    def wanted(self, values: Values, built: Mapping[str, Any]) -> dict[str, Hashable]:
        """What the lights call for, and tables of that."""
        places = tuple(round(values[k] / _STEP) for k in ("turn", "azimuth", "elevation"))
        plan = (values["tolerance"], *places, round(values["strength"], 1))
        kept = built[_PLAN][0] if _PLAN in built else (*KINDS, layers.LAYERS[-1])
        return {_PLAN: plan, _TABLES: (values.get("exponent"), kept)}

    def build(self, name: str, key: Any) -> Any:
        """Measure the shares of the kinds of light; or fit and reduce tables, and compile."""
        if name == _PLAN:
            tolerance, turn, azimuth, elevation, strength = key
            values = {
                "turn": _STEP * turn,
                "azimuth": _STEP * azimuth,
                "elevation": _STEP * elevation,
                "strength": strength,
            }
            return self._planned(tolerance, values)
        wanted, kept = key
        begun = time.perf_counter()
        tables = self._tables
        if wanted is not None and wanted != round(self._exponent or 0.0):
            tables = self._sharper(tables, wanted)
        tables = reduced(tables, kept)
        exposure = jnp.asarray(self._exposed(), jnp.float32)
        to_rgb = None if self._to_rgb is None else jnp.asarray(self._to_rgb, jnp.float32)
        held = Held(tables, to_rgb, exposure)
        light = self._light(controls.initial(self.controls))
        eye, one = np.asarray(self.place.eye, np.float32), np.float32(1.0)
        corners = np.zeros((painting.CHUNK, 3), np.int32)
        shares = np.full((painting.CHUNK, 3), 1.0 / 3.0, np.float32)
        known = _met(held, light, eye)
        np.asarray(_codes(held, light, known, corners, shares, eye, one))
        np.asarray(_vertices(held, light, eye, one))
        towards = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (painting.CHUNK, 1))
        np.asarray(_sky(held, self._behind, towards, self._matrix(0.0), one))
        return held, time.perf_counter() - begun

    def _matrix(self, degrees: float) -> np.ndarray:
        return infinity.rotation(self._axis, degrees).astype(np.float32)

    def _light(self, values: Values) -> Lights:
        """Lights of the scene, turned, and one more."""
        sun = np.asarray(controls.light_direction(values, self._axis), np.float32)
        whole = np.full(self.scene.channels.count, values["strength"], np.float32)
        suns = Suns(jnp.asarray(sun[None]), jnp.asarray(whole[None]))
        return Lights((self._around.turned(jnp.asarray(self._matrix(values["turn"]))), suns))

    def _sharper(self, tables: Tables, wanted: float) -> Tables:
        """Tables over the unoccluded lobes of another exponent."""
        settings = self.transfer.settings
        around = beginning.surroundings(exponents.replaced(self.scene, wanted))
        rows = [
            angular.Estimator(around, k, settings).reference for k in range(len(around.reflectors))
        ]
        over = references.reference(rows, self.transfer.lobes, references.LEVEL)
        return eqx.tree_at(lambda t: t.over.rows, tables, over.rows)

    def _planned(self, tolerance: float, values: Values) -> tuple[tuple[str, ...], Any]:
        """Kinds of light that are kept, and the share of each in the light of the vertices."""
        light = self._light(values)
        away = np.asarray(self.place.eye) - self.transfer.mesh.vertices
        facing = (away * self.transfer.mesh.normals).sum(1) > 0.0
        means = {}
        for name in layers.LAYERS:
            if name in KINDS and not self._tables.glossy:
                continue
            if name not in KINDS and not self._tables.matte:
                continue
            value = self._luminance(layers.layer(self._tables, name), light)
            means[name] = float(value[facing].mean())
        total = max(sum(means.values()), 1e-30)
        shares = {name: value / total for name, value in means.items()}
        kept, left = list(shares), tolerance
        for name in sorted(shares, key=lambda one: shares[one]):
            if name != KINDS[0] and shares[name] <= left and len(kept) > 1:
                left -= shares[name]
                kept.remove(name)
        return tuple(kept), (tolerance, shares)

    def _luminance(self, held: Tables, light: Lights) -> Float[np.ndarray, " V"]:
        """Of the vertices, from where they are looked at first."""
        vertices = jnp.arange(len(self.transfer.axes))
        wo = between.towards(held, vertices, jnp.asarray(self.place.eye, jnp.float32))
        value = np.asarray(relighting.vertex_radiance(held, light, vertices, wo))
        weights = self.scene.channels.luminance()
        return np.broadcast_to(value, (len(value), len(weights))) @ weights

    def _exposed(self) -> float:
        """That makes the mean luminance of what is seen at first `_MEAN`."""
        if self._first is None:
            light = self._light(controls.initial(self.controls))
            value = self._luminance(self._tables, light)
            bright = value[value > 0.0]
            self._first = _MEAN / max(float(bright.mean()), 1e-9) if len(bright) else 1.0
        return self._first

    def pixels(self, built: Mapping[str, Any], look: Look) -> UInt8[np.ndarray, "h w 3"]:
        """A frame: lobes at every pixel."""
        held, _ = built[_TABLES]
        light, camera = self._light(look.values), look.camera
        eye = np.asarray(camera.eye, np.float32)
        stops = np.float32(2.0 ** look.values["exposure"])
        hits = self._caster(camera, look.inside)
        rows, columns = camera.shape
        out = painting.backdrop(rows, columns)
        flat = out.reshape(-1, 3)
        flat[hits.pixel] = 0
        if look.values["surroundings"]:
            free = np.ones(len(flat), bool)
            free[hits.pixel] = False
            past = np.flatnonzero(free)
            towards, turn = rays(camera, look.inside)[past], self._matrix(look.values["turn"])
            flat[past] = painting.in_chunks(
                lambda along: _sky(held, self._behind, along, turn, stops), len(past), towards
            )
        shown = np.flatnonzero(hits.front)
        known = _met(held, light, eye)
        corners = self._triangles[hits.face[shown]]
        shares = np.ascontiguousarray(hits.shares[shown], np.float32)

        def shade(corners: np.ndarray, shares: np.ndarray) -> Any:
            return _codes(held, light, known, corners, shares, eye, stops)

        flat[hits.pixel[shown]] = painting.in_chunks(shade, len(shown), corners, shares)
        return out

    def colours(self, built: Mapping[str, Any], look: Look) -> Coloured:
        """A frame: radiance of vertices."""
        held, _ = built[_TABLES]
        stops = np.float32(2.0 ** look.values["exposure"])
        eye = np.asarray(look.camera.eye, np.float32)
        found = np.asarray(_vertices(held, self._light(look.values), eye, stops))
        return Coloured(self.transfer.mesh.vertices, self._triangles, found)

    def rows(self, built: Mapping[str, Any], look: Look) -> list[Row]:
        """The table beside the picture."""
        kept, (tolerance, shares) = built[_PLAN]
        seconds = built[_TABLES][1]
        found = []
        for name, share in shares.items():
            brings = f"{100.0 * share:.2g} % of the light of the vertices"
            if name not in kept:
                brings += f", within the tolerance of {100.0 * tolerance:g} %"
            found.append(Row(_WORDS[name], name in kept, brings))
        own = self._exponent
        now = look.values.get("exponent")
        settings = self.transfer.settings
        said = f"{self.transfer.slices} slices of {self.transfer.lobes} lobes"
        if own is not None and now != round(own):
            said += f"; exponent {now:g} in direct light, {own:g} in light between surfaces"
        found.append(
            Row(
                "precomputed",
                True,
                f"to a tolerance of {settings.tolerance:g} of slices",
                f"{said}; tables made in {seconds:.1f} s",
            )
        )
        return found


_WORDS = dict(
    zip(
        layers.LAYERS,
        (
            "direct light, glossy",
            "by matte surfaces to glossy ones",
            "by glossy surfaces to glossy ones",
            "matte light",
        ),
        strict=True,
    )
)


@eqx.filter_jit
def _met(held: Held, light: Any, eye: Any) -> Any:
    if not held.tables.glossy:
        return relighting.matte_radiance(held.tables, light, _all(held))
    return between.met(held.tables, light, _all(held), eye)


def _all(held: Held) -> Array:
    return jnp.arange(held.tables.position.shape[0])


def _shaded(
    held: Held, light: Any, known: Any, corners: Any, shares: Any, eye: Any, stops: Any
) -> UInt8[Array, "n 3"]:
    def some(args: tuple[Array, Array]) -> Array:
        if held.tables.glossy:
            return between.shaded(held.tables, light, known, *args, eye)
        where, share = args
        parts = [share[:, k : k + 1] * known[where[:, k]] for k in range(3)]
        return parts[0] + parts[1] + parts[2]

    # Blocks that stay in the processor's caches.
    blocks = (a.reshape(-1, between.BLOCK, 3) for a in (corners, shares))
    value = jax.lax.map(some, tuple(blocks))
    return _developed(held, value.reshape(len(corners), -1), stops)


# Long chains of arithmetic, see `diffopt.rendering.programs`.
_codes = programs.Program(_shaded)


@eqx.filter_jit
def _vertices(held: Held, light: Any, eye: Any, stops: Any) -> UInt8[Array, "V 3"]:
    numbers = _all(held)
    wo = between.towards(held.tables, numbers, eye)
    return _developed(held, relighting.vertex_radiance(held.tables, light, numbers, wo), stops)


@eqx.filter_jit
def _sky(held: Held, behind: Background, towards: Any, turn: Any, stops: Any) -> Array:
    return _developed(held, behind(towards, turn), stops)


def _developed(held: Held, value: Array, stops: Any) -> UInt8[Array, "n 3"]:
    if held.to_rgb is not None:
        value = jnp.matmul(value, held.to_rgb, precision="highest")
    return painting.codes(value, stops * held.exposure)


def reduced(tables: Tables, kept: tuple[str, ...]) -> Tables:
    """Tables of some kinds of light; direct light, if any is glossy, is always of them.

    Parameters
    ----------
    tables
        Of all kinds.
    kept
        Some of `diffopt.transfer.LAYERS`.
    """
    kinds = [k for k, name in enumerate(KINDS) if name in kept]
    found = tables
    if tables.glossy and kinds and len(kinds) < len(KINDS):
        each = tables.lobes // len(KINDS)
        rows = tables.views.reshape(len(tables.views), len(KINDS), -1)[:, jnp.asarray(kinds)]
        found = eqx.tree_at(lambda t: t.views, found, rows.reshape(len(rows), -1))
        found = dataclasses.replace(found, lobes=each * len(kinds))
    glossy = tables.glossy and bool(kinds)
    return dataclasses.replace(
        found, glossy=glossy, matte=tables.matte and layers.LAYERS[-1] in kept
    )


def place_of(camera: Camera) -> Place:
    """From where a camera of a scene looks."""
    columns, rows = camera.resolution
    slope = math.tan(math.radians(0.5 * camera.field_of_view)) * max(rows / columns, 1.0)
    return Place(camera.eye, camera.target, camera.up, math.degrees(2.0 * math.atan(slope)))
