"""The entry points: a picture of a scene by one of the levels of image synthesis."""

import dataclasses
from collections.abc import Callable
from typing import Any

from diffopt import checks, workers
from diffopt.errors import InputError
from diffopt.rendering import driver, radiosity
from diffopt.rendering.ambient import ambient_radiance
from diffopt.rendering.coupled import Coupled
from diffopt.rendering.direct import Direct
from diffopt.rendering.images import Image
from diffopt.rendering.pathtrace import Paths
from diffopt.rendering.radiosity_settings import RadiosityRaysSettings, RadiositySettings
from diffopt.rendering.recording import View
from diffopt.rendering.settings import (
    IncrementalSettings,
    PathSettings,
    RecursiveSettings,
    Settings,
)
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene

#: Levels by name, and their settings.
LEVELS: dict[str, type[Settings]] = {
    kind.level: kind
    for kind in (
        IncrementalSettings,
        RecursiveSettings,
        RadiositySettings,
        RadiosityRaysSettings,
        PathSettings,
    )
}


def render(
    scene: Scene,
    camera: Camera,
    level: str = "path",
    *,
    settings: Settings | None = None,
    dtype: Any = "float32",
    progress: driver.Progress | None = None,
    **options: Any,
) -> Image:
    """Render a scene.

    Parameters
    ----------
    scene, camera
        What, and from where.
    level
        ``"incremental"``: direct light of abstract sources, unshadowed unless asked for.
        ``"recursive"``: with shadows, mirrors and glass. ``"radiosity"``: light between
        surfaces that scatter it evenly; ``"radiosity+rays"``: and mirrors and glass.
        ``"path"``: everything, with noise of a stated standard error: the reference for the
        others.
    settings
        Of the level, instead of `level` and options.
    dtype
        "float32" or "float64" (where JAX has it enabled).
    progress
        Called with (tiles done, tiles in all).
    **options
        Fields of the level's settings, such as ``spp=256`` or ``seed=1``.

    Returns
    -------
    Image
        Radiance, standard error, depth, normals. A keyboard interrupt keeps what is finished.

    Raises
    ------
    InputError
        For another level, or an option that its settings do not have.
    """
    chosen = chosen_settings(level, settings, options)
    even = not isinstance(chosen, PathSettings)
    return driver.picture(
        scene,
        camera,
        chosen,
        _level(chosen, scene)(),
        even=even,
        dtype=dtype,
        progress=progress,
        # The other levels keep what they have prepared.
        workers=1 if even else workers.count(),
    )


def record(
    scene: Scene,
    camera: Camera,
    level: str = "recursive",
    *,
    settings: Settings | None = None,
    dtype: Any = "float32",
    **options: Any,
) -> View:
    """Render once and keep what rays meet, for pictures that are differentiable.

    Parameters
    ----------
    scene, camera, level, settings, dtype, **options
        As for `render`. Memory grows with all rays here: choose a small picture.

    Returns
    -------
    View
        A function from scenes that differ in numbers of materials, emission and lights to
        their pictures, [h, w, C], to be differentiated by JAX. Of the level "path" it is the
        same estimate for every scene: its derivative is that of the estimate, and unbiased.
    """
    chosen = chosen_settings(level, settings, options)
    even = not isinstance(chosen, PathSettings)
    return View(scene, camera, chosen, _level(chosen, scene), dtype, even)


def _level(chosen: Settings, scene: Scene) -> Callable[[], driver.Level]:
    """Makes what follows the rays; what is known of the scene is found once."""
    if isinstance(chosen, PathSettings):
        return lambda: Paths(chosen)
    if isinstance(chosen, RadiositySettings):
        transport = radiosity.prepare(scene, chosen)
        return lambda: Coupled(chosen, transport)
    if isinstance(chosen, IncrementalSettings):
        ambient = ambient_radiance(scene, chosen) if chosen.ambient == "derived" else None
        return lambda: Direct(chosen, ambient)
    raise InputError(f"settings must be those of a level; received {type(chosen).__name__}")


def chosen_settings(level: str, settings: Settings | None, options: dict[str, Any]) -> Settings:
    """Settings as given, or those of a level from its name and options."""
    if settings is not None:
        if options:
            given = ", ".join(options)
            raise InputError(f"give settings or options, not both; received {given}")
        return settings
    kind = LEVELS[checks.choice("level", level, tuple(LEVELS))]
    known = [field.name for field in dataclasses.fields(kind)]
    for name in options:
        if name not in known:
            raise InputError(f"{level} has no setting {name}; it has {', '.join(known)}")
    return kind(**options)
