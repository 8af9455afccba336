"""Why an effect is in or out, and at what settings, in words."""

from typing import Any

from diffopt.materials.combined import matte_part
from diffopt.planning.pilot import Pilot
from diffopt.rendering.effects import Composition
from diffopt.rendering.families import Beams, Points, Surfaces
from diffopt.rendering.settings import PathSettings
from diffopt.rendering.stage import Stage
from diffopt.scenes.scene import Scene

_NONE = {
    "spectrum": "the scene is in linear RGB",
    "fresnel": "no mirror or facet follows Fresnel's formulas",
    "diffraction": "no surface diffracts",
    "environment-map": "no map",
    "emission": "no surface emits",
    "surroundings": "nothing surrounds the scene",
    "ambient": "no ambient light",
    "glossy-light": "all surfaces are matte, mirrors or glass",
    "mirror": "no mirror or smooth glass",
    "refraction": "no smooth glass",
    "glossy-interreflection": "all surfaces are matte, mirrors or glass",
    "caustics": "no mirror or smooth glass beside a surface that scatters",
    "hard-shadows": "no parallel light, point or flood",
    "soft-shadows": "no light from surfaces or surroundings",
    "self-shadows": "nothing can hide light",
    "diffuse-interreflection": "no matte surface",
    "matte-light": "no matte surface",
}
_BRINGS = {
    "emission": "lights that are seen bring {0}",
    "surroundings": "what is seen past all surfaces brings {0}",
    "ambient": "ambient light brings {0}",
    "matte-light": "matte surfaces that are seen bring {0}",
    "glossy-light": "glossy surfaces that are seen bring {0}",
    "mirror": "coherent reflection brings {0}",
    "refraction": "smooth glass lets pass {0}",
    "diffuse-interreflection": "matte surfaces bring {0} to each other; {1} of what surrounds "
    "them is surface",
    "glossy-interreflection": "glossy surfaces bring {0} to others or of others",
    "caustics": "mirrors and glass throw {0} onto surfaces",
    "hard-shadows": "occluders of parallel light and points hide {0}",
    "soft-shadows": "occluders of wide lights hide {0}",
    "self-shadows": "surfaces hide {0} from themselves",
}


def absent(effect: str, stage: Stage) -> bool:
    """Whether a scene has nothing that an effect could come from; of `effects.PATHS`."""
    lights = stage.sources
    kinds = lights.families
    sky = lights.constant is not None
    hard = any(isinstance(one, Beams | Points) for one in kinds)
    soft = sky or any(not isinstance(one, Beams | Points) for one in kinds)
    around = sky or any(not isinstance(one, Beams | Points | Surfaces) for one in kinds)
    parts = [(group, matte_part(group.kind)) for group in stage.groups]
    matte = any(part is not None for _, part in parts)
    glossy = any(group.kind.smooth and part is not group.kind for group, part in parts)
    delta = any(group.delta for group in stage.groups)
    glass = any(group.delta and group.transmits for group in stage.groups)
    has = {
        "emission": any(isinstance(one, Surfaces) for one in kinds),
        "surroundings": around,
        "ambient": lights.has_ambient,
        "matte-light": matte,
        "glossy-light": glossy,
        "mirror": delta,
        "refraction": glass,
        "diffuse-interreflection": matte,
        "glossy-interreflection": glossy,
        "caustics": delta and (matte or glossy),
        "hard-shadows": hard,
        "soft-shadows": soft,
        "self-shadows": hard or soft,
    }
    return not has[effect]


def none(effect: str) -> str:
    """Why an effect cannot be there."""
    return _NONE[effect]


def text(effect: str, estimate: float, bound: float, seen: Pilot) -> str:
    """What an effect brings."""
    if estimate <= 0.0:
        return f"not needed by any of {seen.pixels * seen.paths} paths: below {bound:.2%}"
    size = f"{estimate:.2%} of the light"
    return _BRINGS[effect].format(size, f"{seen.again:.0%}")


def words(effect: str, scene: Scene, composition: Composition, settings: Any) -> str:
    """At what settings an effect is computed."""
    paths = isinstance(settings, PathSettings)
    if effect == "spectrum":
        return f"{scene.channels.count} wavelengths"
    if effect in ("mirror", "refraction"):
        return f"depth {min(composition.mirrors, getattr(settings, 'depth', 64))}"
    if effect in ("diffuse-interreflection", "glossy-interreflection"):
        return f"{composition.scattered - 1} bounces"
    if effect in ("hard-shadows", "soft-shadows"):
        which = composition.soft if effect == "soft-shadows" else composition.hard
        return f"on {len(which or ())} of {len(scene.objects)} objects"
    if effect == "matte-light":
        if paths:
            return f"paths a pixel: {settings.spp}"
        return f"rays a pixel: {settings.spp}, points of a light: {settings.light_samples}"
    return ""
