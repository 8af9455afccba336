"""What the settings of shadow fields cost and lose: bands, maps, samples, distances, occluders.

Every case samples the objects of a scene (`shadow_scenes`), makes their tables and shades the
receivers; the note tells the seconds of sampling and table, which are spent once a frame, and the
floor: the error of the true visibility cut to as many bands.
"""

import dataclasses
import functools
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import shadows
from diffopt.accuracy import shadow_scenes
from diffopt.accuracy.studies import Case, Job, Study, Value
from diffopt.shadows import ShadowSettings, combining, responses
from diffopt.shadows.fields import Field
from diffopt.shadows.lights import ONE_NORMAL

# Receivers on a side and polar directions of the truth; the truth errs by 0.0005 or less.
_SIDE, _POLAR = {True: 16, False: 32}, {True: 32, False: 64}
_UP = np.array([0.0, 0.0, 1.0])


def fields_of(
    name: str, settings: ShadowSettings, points: np.ndarray
) -> tuple[list[Field], float, float]:
    """Fields of a scene's objects, and the seconds that samples and tables take.

    Fields for "exponential" hold logarithms already.
    """
    fields, sampling = [], 0.0
    for body in shadow_scenes.bodies(name):
        start = time.perf_counter()
        field = shadows.shadow_field(
            body.vertices,
            body.faces,
            settings,
            receivers=points,
            centre=body.centre,
            radius=body.radius,
        )
        jax.block_until_ready(field.table)
        sampling += time.perf_counter() - start
        fields.append(field)
    start = time.perf_counter()
    if settings.combination == "exponential":
        fields = combining.logarithms(fields)
        jax.block_until_ready([field.table for field in fields])
    return fields, sampling, time.perf_counter() - start


def _case(scene: str, settings: ShadowSettings, shown: dict[str, Value], quick: bool) -> Case:
    def build() -> Job:
        right = shadow_scenes.solved(scene, _SIDE[quick], _POLAR[quick])
        # Once for what is compiled, once for the time.
        fields_of(scene, settings, right.points)
        fields, sampling, logarithms = fields_of(scene, settings, right.points)
        light = shadows.distant_light(shadow_scenes.radiance, settings.bands)
        leaves, rest = jax.tree.flatten((fields, light))

        def shade(points: Any, leaves: list[Any]) -> Any:
            fields, light = jax.tree.unflatten(rest, leaves)
            # Logarithms were taken with the samples.
            return irradiance(points, fields, light, settings.combination)

        def judge(value: Any) -> tuple[float, str]:
            error = shadow_scenes.rms(np.asarray(value) / right.unshadowed, right)
            note = f"sampling and table {1e3 * (sampling + logarithms):.3g} ms; floor "
            return error, note + f"{_floor(scene, quick, settings.bands):.2g}"

        return Job(shade, (jnp.asarray(right.points, jnp.float32), leaves), judge)

    conditions: dict[str, Value] = {"scene": scene}
    # Tables of one shape share a program; some receivers of the flat torus lie within its sphere.
    program = (
        *(settings.bands, settings.directions, settings.radial, settings.combination),
        *(scene == "torus flat", len(shadow_scenes.bodies(scene))),
    )
    return Case({**conditions, **shown}, "float32", build, program)


def irradiance(
    points: Any, fields: list[Field], light: shadows.DistantLight, combination: str
) -> Any:
    """Irradiance of receivers that face +z, [N], without the threads of `shadows.irradiance`."""
    visible = combining.visibility(points.T, fields, combination)
    places = responses.cosine_places(ONE_NORMAL)
    up = jnp.asarray(_UP, visible.dtype)[:, None]
    return light.gathered(visible, responses.cosine_rows(up, places), places)[0]


@functools.cache
def _floor(scene: str, quick: bool, bands: int) -> float:
    return shadow_scenes.floor(scene, _SIDE[quick], _POLAR[quick], bands)


def _sweep(
    variants: list[tuple[dict[str, Value], dict[str, Any]]],
    quick: bool,
    bands: tuple[int, ...],
    scenes: tuple[str, ...] = shadow_scenes.SINGLE,
) -> list[Case]:
    """Cases of every scene, number of bands and variant: what is shown, and settings."""
    scenes = scenes[:1] + scenes[-1:] if quick and len(scenes) > 1 else scenes
    return [
        _case(
            scene,
            dataclasses.replace(ShadowSettings(bands=count), **changes),
            {"bands": count, **shown},
            quick,
        )
        for scene in scenes
        for count in (bands[:1] if quick else bands)
        for shown, changes in variants
    ]


def _bands(quick: bool) -> list[Case]:
    counts = (2, 4, 6) if quick else (2, 3, 4, 5, 6, 7, 8)
    return [case for count in counts for case in _sweep([({}, {"shells": None})], quick, (count,))]


def _maps(quick: bool) -> list[Case]:
    variants: list[tuple[dict[str, Value], dict[str, Any]]] = [
        ({"map": name, "shells": 1}, {"map": name, "shells": 1})
        for name in ("square", "sphere rule")
    ]
    shells = (1, 2) if quick else (1, 2, 3, 4, 5, 6, 8)
    variants += [({"map": "tangent", "shells": n}, {"shells": n}) for n in shells]
    return _sweep(variants, quick, (4, 8))


def _directions(quick: bool) -> list[Case]:
    grids = ((6, 10), (12, 20)) if quick else ((6, 10), (8, 14), (12, 20), (16, 28), (24, 40))
    variants: list[tuple[dict[str, Value], dict[str, Any]]] = [
        ({"polar": grid[0], "azimuthal": grid[1]}, {"directions": grid}) for grid in grids
    ]
    return _sweep(variants, quick, (4, 8))


def _rays(quick: bool) -> list[Case]:
    counts = (8, 32) if quick else (8, 12, 16, 24, 32, 48, 64)
    variants: list[tuple[dict[str, Value], dict[str, Any]]] = [
        ({"rays": count}, {"rays": count}) for count in counts
    ]
    return _sweep(variants, quick, (4, 8))


def _radial(quick: bool) -> list[Case]:
    counts = (6, 48) if quick else (4, 6, 8, 12, 16, 24, 48, 96)
    variants: list[tuple[dict[str, Value], dict[str, Any]]] = [
        ({"radial": count}, {"radial": count}) for count in counts
    ]
    return _sweep(variants, quick, (4, 8))


def _combinations(quick: bool) -> list[Case]:
    variants: list[tuple[dict[str, Value], dict[str, Any]]] = [
        ({"combination": kind}, {"combination": kind}) for kind in ("sum", "product", "exponential")
    ]
    return _sweep(variants, quick, (4, 6, 8), (shadow_scenes.STACKED,))


_QUANTITY = "RMS error of irradiance over the unshadowed one; time of the receivers"
_REFERENCE = "rays to all directions above every receiver"


def _study(name: str, about: str, cases: Any) -> Study:
    return Study(
        name=f"shadow.{name}",
        quantity=f"{about}: {_QUANTITY}",
        reference=_REFERENCE,
        cases=cases,
        conditions=("scene",),
    )


BANDS = _study("bands", "bands of spherical harmonics", _bands)
MAPS = _study("map", "how views are carried away from the sphere", _maps)
DIRECTIONS = _study("directions", "directions in which a field is sampled", _directions)
RAYS = _study("rays", "rays on a side of every hemisphere", _rays)
RADIAL = _study("radial", "nodes of the table over distances", _radial)
COMBINATION = _study("combination", "several occluders", _combinations)
