"""The entry points: a picture of a scene by one of the levels of image synthesis."""

import dataclasses
import os
from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from diffopt import checks, workers
from diffopt.errors import InputError
from diffopt.rendering import driver, radiosity
from diffopt.rendering.ambient import ambient_radiance
from diffopt.rendering.composed import Composed
from diffopt.rendering.coupled import Coupled
from diffopt.rendering.direct import Direct
from diffopt.rendering.effects import EVERYTHING, Composition
from diffopt.rendering.images import Image
from diffopt.rendering.keeping import Kept, identity
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


@runtime_checkable
class Planned(Protocol):
    """What a plan tells of a picture; see `diffopt.planning.Plan`."""

    @property
    def settings(self) -> Settings:
        """Of the level."""
        ...

    @property
    def paths(self) -> PathSettings:
        """By which layers are told apart."""
        ...

    @property
    def composition(self) -> Composition:
        """What is in."""
        ...

    def scene(self, scene: Scene) -> Scene:
        """The scene without what is out."""
        ...


def render(
    scene: Scene,
    camera: Camera,
    level: "str | Planned" = "path",
    *,
    settings: Settings | None = None,
    dtype: Any = "float32",
    progress: driver.Progress | None = None,
    layers: bool = False,
    keep: str | os.PathLike | None = None,
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
        others. Or a plan (`diffopt.plan`): its effects and no others.
    settings
        Of the level, instead of `level` and options; of a plan, instead of its own.
    dtype
        "float32" or "float64" (where JAX has it enabled).
    progress
        Called with (tiles done, tiles in all).
    layers
        Keep the light of each effect apart, see `Image.layers`: by paths, also where the
        plan's level would be another one.
    keep
        A file for what is finished, written every ten seconds or so: after a kill the same call
        goes on from it, to the same bits. To be removed when the picture is saved.
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
    composition = told = None
    if not isinstance(level, str):
        told = _changed(level.paths, options) if layers else None
        settings = _changed(level.settings if settings is None else settings, options)
        scene, composition, level, options = level.scene(scene), level.composition, "path", {}
    chosen = chosen_settings(level, settings, options)
    if layers and not isinstance(chosen, PathSettings):
        if composition is None:
            raise InputError(f"layers are kept by paths; received the level {chosen.level}")
        assert told is not None
        chosen = told
    even = not isinstance(chosen, PathSettings)
    follow = _level(chosen, scene, composition, layers)()
    kept = None
    if keep is not None:
        kept = Kept(keep, identity(scene, camera, chosen, composition, layers, dtype))
    return driver.picture(
        scene,
        camera,
        chosen,
        follow,
        even=even,
        dtype=dtype,
        progress=progress,
        # The other levels keep what they have prepared.
        workers=1 if even else workers.count(),
        keep=kept,
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


def _changed(settings: Settings, options: dict[str, Any]) -> Settings:
    """Settings of a plan with some of them changed."""
    known = [field.name for field in dataclasses.fields(settings)]
    for name in options:
        if name not in known:
            raise InputError(f"{settings.level} has no setting {name}; it has {', '.join(known)}")
    return dataclasses.replace(settings, **options)


def _level(
    chosen: Settings,
    scene: Scene,
    composition: Composition | None = None,
    layers: bool = False,
) -> Callable[[], driver.Level]:
    """Makes what follows the rays; what is known of the scene is found once."""
    if isinstance(chosen, PathSettings):
        if composition is None and not layers:
            return lambda: Paths(chosen)
        deepest = Composition(bounces=chosen.depth, coherent=chosen.depth)
        return lambda: Composed(deepest if composition is None else composition, layers)
    what = EVERYTHING if composition is None else composition
    if isinstance(chosen, RadiositySettings):
        transport = radiosity.prepare(scene, chosen)
        return lambda: Coupled(chosen, transport, what)
    if isinstance(chosen, IncrementalSettings):
        ambient = ambient_radiance(scene, chosen) if chosen.ambient == "derived" else None
        return lambda: Direct(chosen, ambient, what)
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
