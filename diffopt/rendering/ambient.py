"""Ambient light in place of what a level leaves out, so that energy is kept.

Light is followed to its first scattering; what becomes of it later is taken as even over all
surfaces and directions. Of the mean radiosity B1 after the first scattering a share c (that of
the rays which leave surfaces and meet one again) arrives on surfaces, the mean albedo of which
is scattered again: B1 + rho c B1 + ... = R B1, with the overall interreflection factor
R = 1 / (1 - rho c) of Cohen and Greenberg, "The hemi-cube" (SIGGRAPH 1985) for c = 1. The even
light has the radiance c R B1 / pi; in a closed room c = 1.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.rendering import patches, radiosity
from diffopt.rendering.radiosity_settings import RadiositySettings
from diffopt.rendering.settings import Settings
from diffopt.rendering.stage import Stage
from diffopt.scenes.scene import Scene

# Parts of the surfaces, rays of each, and draws of light for each.
_PATCHES, _RAYS, _DRAWS = 128, 64, 16


def ambient_radiance(scene: Scene, settings: Settings) -> Float[Array, " C"]:
    """Radiance of the even light that stands for all light scattered more than once.

    Parameters
    ----------
    scene
        The scene. Glossy surfaces count as diffuse, mirrors and glass as black.
    settings
        Of the level: its `seed` and `backend`.

    The error is that of the idea, some ten per cent of the light and more where it is not
    even; that of the rays is a few per cent.
    """
    rough = RadiositySettings(
        seed=settings.seed,
        backend=settings.backend,
        patches=_PATCHES,
        rays_per_patch=_RAYS,
        refinements=0,
        light_samples=_DRAWS,
    )
    if not scene.objects:
        return jnp.zeros(scene.channels.count)
    transport, stage = radiosity.prepare(scene, rough), Stage(scene)
    albedo = patches.albedo(stage, transport.patches)
    surfaces, other = transport.light.irradiance(stage.sources)
    direct = surfaces + other
    once = albedo * direct
    # Only surfaces that light reaches count, not the backs of the walls of a room.
    bright = once.sum(1)
    reached = (direct.sum(1) > 0.0) | (jnp.matmul(transport.exchange, bright) > 0.0)
    area = jnp.where(reached, transport.area, 0.0)
    share = area / jnp.maximum(area.sum(), jnp.finfo(area.dtype).tiny)
    back = 1.0 - (share * transport.escaped).sum()
    return even_light((share[:, None] * once).sum(0), (share[:, None] * albedo).sum(0), back)


def even_light(
    first: Float[Array, " C"], albedo: Float[Array, " C"], share: Any
) -> Float[Array, " C"]:
    """Radiance of even light from means over surfaces.

    Parameters
    ----------
    first
        Radiosity after the first scattering.
    albedo
        Below 1, or surfaces do not close.
    share
        Of the light from surfaces that meets a surface.
    """
    back = jnp.minimum(albedo * share, 0.99)
    return share * first / (np.pi * (1.0 - back))
