"""A diffracting surface on a bent sheet, a ball or any mesh, under one light that moves."""

import dataclasses
import math
import time
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from diffopt import checks, fresnel, lookup
from diffopt.diffraction import DiffractionBRDF
from diffopt.drawing import developing, tones, views
from diffopt.errors import InputError
from diffopt.heightfield import Heightfield
from diffopt.scenes import tangents
from diffopt.scenes.meshfiles import Mesh
from diffopt.scenes.primary import Hits, PrimaryCaster, rays
from diffopt.viewer import controls, painting, surfaces
from diffopt.viewer.controls import Control, Menu, Slider, Steps, Toggle, Values
from diffopt.viewer.subject import Coloured, Look, Row

#: Errors of tables that may be asked for, over a mirror's peak.
TOLERANCES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)
#: Words for the shapes made by code.
SHAPES = ("sheet", "ball")
# Largest |u|, |v| of tables, for light and viewer as far as they are shown; and their w.
_WIDEST, _FLATTEST = 1.95, -0.12
# Tables are as fine as pictures of this size need.
_FINE = 512
# Share of the lit samples that stay below white.
_BRIGHT = 96.0
# Rays to the light start this far above the surface, in radii.
_ABOVE = 4e-3
# What is built, and the controls that it depends on.
_TABLE, _BAKED = "the table of colours", ("coherence", "depth", "tolerance")
_NEUTRAL = np.array([92, 92, 92], np.uint8)


class Baked(eqx.Module):
    """A table with all that a frame needs of it."""

    table: lookup.Table
    film: developing.Film
    exposure: Float[Array, ""]
    seconds: float = eqx.field(static=True)


class Diffracting:
    """A surface that diffracts, see `diffopt.viewer.subject.Subject`.

    Parameters
    ----------
    scan
        Heights, levelled and complete.
    coherence
        sigma_s at first, micrometres, from one pixel to half the patch; an eighth if left out.
    material
        Word for `diffopt.fresnel.parse`.
    mesh
        To lie on; a sheet or a ball if left out.
    up
        Axis of the mesh that is upwards.
    name
        Of the surface, for the title.

    Raises
    ------
    InputError
        For a coherence length outside the patch, or a patch of too few pixels.
    """

    turns, takes, averages = True, 4, False

    def __init__(
        self,
        scan: Heightfield,
        *,
        coherence: float | None = None,
        material: str = "al",
        mesh: Mesh | None = None,
        up: tuple[float, float, float] = (0.0, 0.0, 1.0),
        name: str = "surface",
    ) -> None:
        self.scan, self.fresnel = scan, fresnel.parse(material)
        self.title = f"{name}: diffraction, {material}"
        least, most = max(2.0 * max(scan.pixel), 0.2), 0.125 * min(scan.extent)
        if coherence is None:
            coherence = most
        checks.coherence(coherence, scan.pixel, scan.extent)
        least, most = min(least, coherence), max(most, coherence)
        if not least < most:
            raise InputError(
                f"{name}: a patch of {min(scan.extent):g} um with pixels of {max(scan.pixel):g} um "
                "is too small to be looked at; expected 16 pixels at least"
            )
        step = 10.0 ** (math.floor(math.log10(most - least)) - 2)
        # Inwards: a longer coherence than the given one may not fit the patch.
        least = round(math.ceil(least / step - 1e-6) * step, 6)
        most = round(math.floor(most / step + 1e-6) * step, 6)
        self._own = mesh
        self._up = np.asarray(up, np.float64)
        shapes = ("mesh",) if mesh is not None else SHAPES
        self.controls: Sequence[Control] = (
            Menu("shape", "shape", shapes, shapes[0]),
            *controls.light_sliders(-60.0, 55.0),
            Slider("turn", "surface turned (°)", -180.0, 180.0, 1.0, 0.0),
            Slider(
                "coherence",
                "coherence length σ (µm)",
                least,
                most,
                step,
                float(np.clip(round(coherence / step) * step, least, most)),
                "Width of the window within which waves interfere; a table is baked for each.",
            ),
            Slider("depth", "heights ×", 0.1, 3.0, 0.1, 1.0),
            Steps("tolerance", "tolerance", TOLERANCES, 1e-3, "Of the table, over a mirror's peak"),
            Slider("exposure", "exposure (stops)", -4.0, 4.0, 0.1, 0.0),
            Toggle("shadows", "self-shadows", mesh is not None),
        )
        self._meshes: dict[str, tuple[Mesh, PrimaryCaster, Array]] = {}
        # For another shape the table is the same.
        self._last: tuple[Any, Baked | None] = None, None
        whole = self._mesh(shapes[0])[0]
        self.place = surfaces.place(whole, self._up, mesh is not None)

    def _mesh(self, shape: str) -> tuple[Mesh, PrimaryCaster, Array]:
        """A mesh, its rays, and position, normal and tangent of its vertices, [V, 9]."""
        if shape not in self._meshes:
            if self._own is not None:
                mesh = self._own
                field, _ = tangents.own(mesh, self._up)
            else:
                mesh, field = surfaces.sheet() if shape == "sheet" else surfaces.ball()
            rows = np.concatenate([mesh.vertices, mesh.normals, field], -1)
            skin = jnp.asarray(rows, jnp.float32)
            self._meshes[shape] = mesh, PrimaryCaster(mesh.vertices, mesh.faces), skin
        return self._meshes[shape]

    def moves(self, values: Values) -> bool:
        """Nothing moves by itself."""
        return False

    def wanted(self, values: Values, built: Mapping[str, Any]) -> dict[str, Hashable]:
        """A table and the programs that read it."""
        return {_TABLE: tuple(values[name] for name in ("shape", *_BAKED))}

    def build(self, name: str, key: Any) -> Any:
        """Bake a table, and compile what reads it."""
        shape, *rest = key
        baked = self._baked(*rest)
        skin = self._mesh(shape)[-1]
        corners = np.zeros((painting.CHUNK, 3), np.int32)
        shares = np.full((painting.CHUNK, 3), 1.0 / 3.0, np.float32)
        lit = np.ones(painting.CHUNK, bool)
        eye = np.asarray(self.place.eye, np.float32)
        light = np.array([0.0, 0.0, 1.0], np.float32)
        turn = np.float32(0.0)
        np.asarray(_seen(baked, skin, corners, shares, lit, eye, light, turn, np.float32(1.0)))
        np.asarray(_vertices(baked, skin, eye, light, turn, np.float32(1.0)))
        return key, baked

    def _baked(self, coherence: float, depth: float, tolerance: float) -> Baked:
        key = coherence, depth, tolerance
        if key != self._last[0]:
            self._last = key, self._bake(*key)
        found = self._last[1]
        assert found is not None
        return found

    def _bake(self, coherence: float, depth: float, tolerance: float) -> Baked:
        begun = time.perf_counter()
        heights = self.scan.heights * np.asarray(depth, self.scan.heights.dtype)
        scan = dataclasses.replace(self.scan, heights=heights)
        brdf = DiffractionBRDF(scan, coherence, fresnel=self.fresnel, blur=0.0023)
        ends = np.array([[-_WIDEST, -_WIDEST, -2.0], [_WIDEST, _WIDEST, _FLATTEST]])
        table = views.bake(brdf, ends, size=_FINE, error=tolerance)
        film = developing.film(brdf)
        baked = Baked(table, film, jnp.ones((), jnp.float32), time.perf_counter() - begun)
        exposure = self._exposed(baked)
        return eqx.tree_at(lambda b: b.exposure, baked, jnp.asarray(exposure, jnp.float32))

    def _exposed(self, baked: Baked) -> float:
        """Exposure at first, by vertices of the first shape; it stays as the light moves."""
        first = controls.initial(self.controls)
        skin = self._mesh(first["shape"])[-1]
        light = np.asarray(controls.light_direction(first, self._axis), np.float32)
        eye = np.asarray(self.place.eye, np.float32)
        rgb, bright = _linear(baked, skin, eye, light, np.float32(0.0))
        return tones.exposure(np.asarray(rgb, np.float64)[np.asarray(bright)], _BRIGHT)

    @property
    def _axis(self) -> int:
        return int(np.argmax(np.abs(self._up)))

    def _scene(self, look: Look) -> tuple[np.ndarray, np.ndarray, np.float32]:
        values = look.values
        light = np.asarray(controls.light_direction(values, self._axis), np.float32)
        turn = np.float32(math.radians(values["turn"]))
        return np.asarray(look.camera.eye, np.float32), light, turn

    def pixels(self, built: Mapping[str, Any], look: Look) -> UInt8[np.ndarray, "h w 3"]:
        """A frame: the table at every pixel."""
        (shape, *_), baked = built[_TABLE]
        mesh, caster, skin = self._mesh(shape)
        eye, light, turn = self._scene(look)
        hits = caster(look.camera, look.inside)
        rows, columns = look.camera.shape
        out = painting.backdrop(rows, columns)
        flat = out.reshape(-1, 3)
        flat[hits.pixel[~hits.front]] = _NEUTRAL
        shown = np.flatnonzero(hits.front)
        corners = mesh.faces[hits.face[shown]].astype(np.int32)
        shares = np.ascontiguousarray(hits.shares[shown], np.float32)
        lit = self._lit(caster, look, hits, shown, mesh, light)
        stops = np.float32(2.0 ** look.values["exposure"])

        def shade(corners: np.ndarray, shares: np.ndarray, lit: np.ndarray) -> Any:
            return _seen(baked, skin, corners, shares, lit, eye, light, turn, stops)

        found = painting.in_chunks(shade, len(shown), corners, shares, lit)
        flat[hits.pixel[shown]] = found
        return out

    def _lit(
        self,
        caster: PrimaryCaster,
        look: Look,
        hits: Hits,
        shown: np.ndarray,
        mesh: Mesh,
        light: np.ndarray,
    ) -> np.ndarray:
        """Which samples the light reaches past the mesh."""
        if not look.values["shadows"]:
            return np.ones(len(shown), bool)
        along = rays(look.camera, look.inside)[hits.pixel[shown]]
        points = np.asarray(look.camera.eye) + hits.distance[shown, None] * along
        return ~caster.blocked(points + _ABOVE * mesh.radius * light, light)

    def colours(self, built: Mapping[str, Any], look: Look) -> Coloured:
        """A frame: the table at every vertex; nothing casts a shadow."""
        (shape, *_), baked = built[_TABLE]
        mesh, _, skin = self._mesh(shape)
        eye, light, turn = self._scene(look)
        stops = np.float32(2.0 ** look.values["exposure"])
        found = np.asarray(_vertices(baked, skin, eye, light, turn, stops))
        return Coloured(mesh.vertices, mesh.faces, found)

    def rows(self, built: Mapping[str, Any], look: Look) -> list[Row]:
        """The table beside the picture."""
        (_, coherence, depth, tolerance), baked = built[_TABLE]
        shape = baked.table.coefficients.shape
        size = baked.table.coefficients.nbytes / 2**20
        shadows = look.values["shadows"]
        return [
            Row(
                "diffraction",
                True,
                f"error ≤ {tolerance:g} of a mirror's peak",
                f"table {shape[1]}×{shape[0]}×{shape[2]}, {size:.0f} MB, baked in "
                f"{baked.seconds:.1f} s; σ {coherence:.3g} µm, heights ×{depth:g}",
            ),
            Row("shadows of the body", shadows, "one ray a pixel" if shadows else "switched off"),
            Row("scattering from one part to another", False, "the model is of one reflection"),
            Row("polarisation", False, "scalar theory"),
        ]


@eqx.filter_jit
def _seen(
    baked: Baked,
    skin: Array,
    corners: Any,
    shares: Any,
    lit: Any,
    eye: Any,
    light: Any,
    turn: Any,
    stops: Any,
) -> UInt8[Array, "n 3"]:
    rows = [skin[corners[:, k]] * shares[:, k : k + 1] for k in range(3)]
    xyz = _radiance(baked, rows[0] + rows[1] + rows[2], eye, light, turn, lit)
    return jnp.stack(developing.codes(baked.film, xyz, stops * baked.exposure), -1)


@eqx.filter_jit
def _vertices(
    baked: Baked, skin: Array, eye: Any, light: Any, turn: Any, stops: Any
) -> UInt8[Array, "V 3"]:
    xyz = _radiance(baked, skin, eye, light, turn)
    return jnp.stack(developing.codes(baked.film, xyz, stops * baked.exposure), -1)


@eqx.filter_jit
def _linear(baked: Baked, skin: Array, eye: Any, light: Any, turn: Any) -> tuple[Array, Array]:
    xyz = _radiance(baked, skin, eye, light, turn)
    return jnp.stack(developing.display(baked.film, xyz), -1), xyz[1] > 0.0


def _radiance(
    baked: Baked, rows: Array, eye: Any, light: Any, turn: Any, lit: Any = None
) -> list[Array]:
    near = jnp.zeros((), jnp.float32)
    return developing.radiance(baked.table, _samples(rows.T, eye), light, turn, near, lit)


def _samples(rows: Float[Array, "9 n"], eye: Any) -> developing.Samples:
    """Frames of the material from columns of interpolated vertices."""
    position, normal, field = rows[0:3], rows[3:6], rows[6:9]
    away = [eye[k] - position[k] for k in range(3)]
    away = _unit(away)
    n = _unit(list(normal))
    # Normals of coarse meshes turn away from a viewer who does see the face.
    lean = jnp.maximum(1e-3 - developing.dot(n, away), 0.0)
    n = _unit([a + lean * b for a, b in zip(n, away, strict=True)])
    along = developing.dot(list(field), n)
    t = _unit([field[k] - along * n[k] for k in range(3)])
    across = [n[1] * t[2] - n[2] * t[1], n[2] * t[0] - n[0] * t[2], n[0] * t[1] - n[1] * t[0]]
    local = [developing.dot(axis, away) for axis in (t, across, n)]
    shown = local[2] > math.cos(views.GRAZING)
    below = (0.0, 0.0, -1.0)
    kept = [jnp.where(shown, a, b) for a, b in zip(local, below, strict=True)]
    return developing.Samples(
        jnp.stack(t), jnp.stack(across), jnp.stack(n), position, jnp.stack(kept)
    )


def _unit(a: list[Array]) -> list[Array]:
    scale = 1.0 / jnp.sqrt(jnp.maximum(developing.dot(a, a), 1e-24))
    return [c * scale for c in a]
