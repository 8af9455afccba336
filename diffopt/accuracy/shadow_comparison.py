"""Shadow fields against ray-cast truth on all scenes, by every map, in one run.

``diffopt compare shadows``: errors beside their floor, which is what remains when the true
visibility is cut to as many bands, and what sampling, tables and receivers take.
"""

import dataclasses
import functools
import os
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt import checks
from diffopt.accuracy import output, shadow_scenes
from diffopt.errors import InputError
from diffopt.kernels import harmonics
from diffopt.shadows import animations, fields, lights, parts, sampling, shading, tables
from diffopt.shadows import truth as ray_cast
from diffopt.shadows.settings import ShadowSettings

#: Scenes at rest, and two that deform, at some moment.
SCENES = (*shadow_scenes.SINGLE, "creature", "egg")
#: Settings beside the default ones; "parts" are four sub-volumes.
METHODS: dict[str, dict[str, Any]] = {
    "square": {"map": "square", "inner_step": 0.0},
    "sphere rule": {"map": "sphere rule", "inner_step": 0.0},
    "tangent": {"shells": 1, "inner_step": 0.0},
    "two-shell": {"shells": 2, "inner_step": 0.0},
    "parts": {},
    "default": {},
    "fine": {"directions": (24, 40), "rays": 48},
}
# Of the loop of an animation, where the creature's wings are up and the egg is no egg.
_MOMENT = 0.3
_PARTS = 4


@dataclasses.dataclass(frozen=True)
class Row:
    """One method on one scene.

    Attributes
    ----------
    scene, method, bands
        What.
    error
        RMS error of irradiance, over the unshadowed irradiance.
    floor
        The same of the true visibility, cut to as many bands.
    sampling_s, table_s
        Seconds of rays with their projection, and of the table.
    receiver_ns
        Nanoseconds of one receiver of 100,000, without the table.
    frame_ns
        The same with the table, which every frame of a deforming object makes anew.
    """

    scene: str
    method: str
    bands: int
    error: float
    floor: float
    sampling_s: float
    table_s: float
    receiver_ns: float
    frame_ns: float


@dataclasses.dataclass(frozen=True)
class Comparison:
    """All rows of one run."""

    rows: tuple[Row, ...]
    receivers: int

    def table(self) -> Any:
        """A `rich.table.Table` of all rows."""
        from rich.table import Table

        found = Table(
            title="Soft shadows: fields in spherical harmonics against cast rays",
            caption=f"Error: RMS of irradiance over the unshadowed, {self.receivers} receivers. "
            "Floor: the same of the true visibility, cut to as many bands. Frame: table and "
            "receivers, of 100,000. Medians, without compilation.",
        )
        for name in ("scene", "bands", "method"):
            found.add_column(name, justify="right" if name == "bands" else "left")
        for name in ("error", "floor", "ratio", "sampling", "table", "receiver", "frame"):
            found.add_column(name, justify="right")
        for row in self.rows:
            found.add_row(
                row.scene,
                str(row.bands),
                row.method,
                f"{row.error:.4f}",
                f"{row.floor:.4f}",
                f"{row.error / row.floor:.2f}",
                output.seconds(row.sampling_s),
                output.seconds(row.table_s),
                f"{row.receiver_ns:.0f} ns",
                f"{row.frame_ns:.0f} ns",
            )
        return found

    def __str__(self) -> str:
        return output.as_text(self.table())

    def save_csv(self, path: str | os.PathLike) -> None:
        """Write the rows."""
        names = [field.name for field in dataclasses.fields(Row)]
        output.write_csv(names, [dataclasses.astuple(row) for row in self.rows], path)


class _Solved(NamedTuple):
    """A scene with its truth: receivers, meshes with spheres, irradiance, floors by bands."""

    points: Float[np.ndarray, "N 3"]
    vertices: np.ndarray
    faces: np.ndarray
    centre: np.ndarray
    radius: float
    irradiance: Float[np.ndarray, " N"]
    unshadowed: float
    floors: dict[int, float]


def compare(
    scenes: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    *,
    bands: Sequence[int] = (4, 6, 8),
    side: int = 160,
    polar: int = 40,
    receivers: int = 100_000,
    repeats: int = 5,
    progress: Callable[[int, int, str], object] | None = None,
) -> Comparison:
    """Errors and times of all methods on all scenes.

    Parameters
    ----------
    scenes
        Of `SCENES`. [default: all]
    methods
        Of `METHODS`. [default: all]
    bands
        Of the fields.
    side
        Receivers on a side of the square [-4, 4]^2.
    polar
        Directions of the truth over the polar angle; twice as many over the azimuth.
    receivers
        Whose time is taken.
    repeats
        Runs of which the median counts.
    progress
        Called with what is done, how much there is, and what is next.

    Raises
    ------
    InputError
        For unknown names, and settings that fields refuse.
    """
    names = [checks.choice("scene", name, SCENES) for name in scenes or SCENES]
    ways = [checks.choice("method", way, tuple(METHODS)) for way in methods or METHODS]
    if not bands or side < 2 or polar < 2 or repeats < 1 or receivers < 1:
        raise InputError("bands, side, polar, receivers and repeats must not be empty or below 1")
    rows = []
    for index, name in enumerate(names):
        if progress is not None:
            progress(index, len(names), name)
        solved = _solve(name, tuple(bands), side, polar)
        for count in bands:
            for way in ways:
                settings = ShadowSettings(bands=count, **METHODS[way])
                rows.append(_row(name, way, settings, solved, receivers, repeats))
    return Comparison(tuple(rows), side * side)


def _mesh(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Vertices, faces, centre and radius."""
    if name in shadow_scenes.SINGLE:
        body = shadow_scenes.bodies(name, 2)[0]
        return body.vertices, body.faces, body.centre, body.radius
    animation = animations.animation(name)
    vertices = animation.vertices(_MOMENT)
    return vertices, animation.faces, *sampling.bounding_sphere(vertices)


@functools.lru_cache(maxsize=8)
def _solve(name: str, bands: tuple[int, ...], side: int, polar: int) -> _Solved:
    """Truth and floors from the same rays."""
    vertices, faces, centre, radius = _mesh(name)
    points = shading.plane(8.0, side).reshape(-1, 3)
    above, weights = harmonics.hemisphere_rule(polar, 2 * polar)
    light = shadow_scenes.radiance(above) * above[:, 2] * weights
    weighted = {count: shadow_scenes.cut_light(above, weights, count) for count in bands}
    shadow = np.empty(len(points))
    cut = {count: np.empty(len(points)) for count in bands}
    for part, hidden in ray_cast.hidden(points, [(vertices, faces)], above):
        shadow[part] = hidden @ light
        for count, factor in weighted.items():
            cut[count][part] = hidden @ factor
    total = float(light.sum())
    floors = {
        count: float(np.sqrt(np.mean((values - shadow) ** 2))) / total
        for count, values in cut.items()
    }
    return _Solved(points, vertices, faces, centre, radius, 1.0 - shadow / total, total, floors)


def _row(
    name: str, way: str, settings: ShadowSettings, solved: _Solved, receivers: int, repeats: int
) -> Row:
    mesh, facing = (solved.vertices, solved.faces), np.array([0.0, 0.0, 1.0])
    light = lights.distant_light(shadow_scenes.radiance, settings.bands)
    away = np.linalg.norm(solved.points - solved.centre, axis=1)
    nearest = float(away.min()) / solved.radius

    def sampled() -> sampling.Samples:
        return sampling.sample(
            *mesh, settings, centre=solved.centre, radius=solved.radius, nearest=nearest
        )

    if way == "parts":
        occluders = parts.part_fields(*mesh, _PARTS, settings, receivers=solved.points)
        sampling_s, _ = _timed(
            lambda: parts.part_fields(*mesh, _PARTS, settings, receivers=solved.points), repeats
        )
        table_s = 0.0
    else:
        sampling_s, samples = _timed(sampled, repeats)
        table_s, _ = _timed(lambda: tables.build(samples, settings), repeats)
        occluders = [fields.field_of(samples, settings, solved.centre, solved.radius)]
    found = shading.irradiance(solved.points, facing, occluders, light, settings)
    off = np.asarray(found)[:, 0] / solved.unshadowed - solved.irradiance
    many = jnp.asarray(shading.plane(8.0, int(np.ceil(receivers**0.5))).reshape(-1, 3)[:receivers])
    run_s, _ = _timed(lambda: shading.irradiance(many, facing, occluders, light, settings), repeats)
    return Row(
        name,
        way,
        settings.bands,
        float(np.sqrt((off * off).mean())),
        solved.floors[settings.bands],
        sampling_s,
        table_s,
        run_s / receivers * 1e9,
        (run_s + table_s) / receivers * 1e9,
    )


def _timed(function: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Median seconds after a first run, and what the function returns."""
    found = jax.block_until_ready(function())
    taken = []
    for _ in range(repeats):
        begun = time.perf_counter()
        jax.block_until_ready(function())
        taken.append(time.perf_counter() - begun)
    return statistics.median(taken), found
