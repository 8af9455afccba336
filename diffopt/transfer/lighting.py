"""Light from infinity averaged over von Mises-Fisher lobes: what transfer is multiplied with.

    radiance(mu, kappa) = integral of L(s) gamma(s; mu, kappa) over the sphere

for lobes of unit integral with any axes in the world and any concentration kappa >= 0. Three
methods: tables (`diffopt.transfer.pyramid`), the closed form for light that is itself a sum of
lobes (`LobeLight`), spherical harmonics (`HarmonicLight`). Parallel light (`Suns`) and light that
is the same from everywhere (`Even`) have closed forms with each of them. All are differentiable in
their values, in mu and in kappa, and are turned and scaled at next to no cost.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from diffopt import checks
from diffopt.errors import InputError
from diffopt.kernels import harmonics, lobe_harmonics
from diffopt.kernels.frames import dot
from diffopt.scenes import lights
from diffopt.scenes.channels import Channels
from diffopt.transfer import prefiltering
from diffopt.transfer.distant import Even, HarmonicLight, Lights, LobeLight, Suns
from diffopt.transfer.pyramid import Pyramid, PyramidSettings

METHODS = ("pyramid", "lobes", "harmonics")


@dataclasses.dataclass(frozen=True)
class HarmonicSettings:
    """Bands of spherical harmonics.

    Attributes
    ----------
    bands
        L, 1 to 64, at most the rows of a map. The light's part of degree l >= L, damped by
        exp(-l (l + 1) / (2 kappa)), is cut: of a source smaller than the lobe, the share of the
        largest radiance that is missing is exp(-L^2 / (2 kappa)), 1 % for kappa up to L^2 / 9 (28
        at 16 bands). Sharper lobes see light blurred to the bands, with ringing, below 0 in
        places. Time of a lobe grows with L^2 times the channels.
    """

    bands: int = 16

    def __post_init__(self) -> None:
        """Check the value."""
        if isinstance(self.bands, bool) or not isinstance(self.bands, int):
            raise InputError(f"bands must be an integer; received {self.bands!r}")
        if not 1 <= self.bands <= 64:
            raise InputError(f"bands must be from 1 to 64; received {self.bands}")


#: What `prepare` returns.
Lighting = Even | Suns | LobeLight | HarmonicLight | Pyramid | Lights


def prepare(
    sources: Sequence[lights.Light],
    channels: Channels,
    method: str = "pyramid",
    settings: PyramidSettings | HarmonicSettings | None = None,
    dtype: Any = jnp.float32,
) -> Lighting:
    """Lights of a scene, ready to be averaged over lobes.

    Parameters
    ----------
    sources
        `Ambient`, `Environment`, `LobeEnvironment` and `Directional` of `diffopt.scenes`.
    channels
        Of the scene.
    method
        For what surrounds the scene: "pyramid" for any environment, a few texels a look-up;
        "lobes", exact for a `LobeEnvironment`, in time proportional to its lobes; "harmonics",
        smooth light or broad lobes, differentiable in few numbers.
    settings
        `PyramidSettings` or `HarmonicSettings`, as of the method. [default: theirs]
    dtype
        float32 or float64.

    Returns
    -------
    Lighting
        With ``radiance(mu, kappa)``, ``turned(rotation)`` and ``scaled(factor)``.

    Raises
    ------
    InputError
        For light near the scene, light that is not finite, a map with "lobes", settings of
        another method, more bands than a map has rows.
    """
    checks.choice("method", method, METHODS)
    kind = {"pyramid": PyramidSettings, "harmonics": HarmonicSettings}.get(method)
    if settings is not None and not (kind and isinstance(settings, kind)):
        expected = kind.__name__ if kind else "None"
        raise InputError(
            f"settings for {method!r} must be {expected}; received {type(settings).__name__}"
        )
    chosen = settings or (kind() if kind else None)
    even, suns, parts = jnp.zeros(channels.count, dtype), [], []
    for place, light in enumerate(sources):
        name = f"sources[{place}]"
        _finite(name, light)
        if isinstance(light, lights.Ambient):
            even = even + channels.values("radiance", light.radiance).astype(dtype)
        elif isinstance(light, lights.Environment) and not light.is_map:
            value = channels.values("radiance", light.radiance).astype(dtype)
            even = even + value * light.scale.astype(dtype)
        elif isinstance(light, lights.Directional):
            towards = light.towards.astype(dtype)
            towards = towards / jnp.sqrt(dot(towards, towards))
            suns.append((towards, channels.values("irradiance", light.irradiance).astype(dtype)))
        elif isinstance(light, lights.Environment):
            parts.append(_of_map(light, channels, chosen, dtype))
        elif isinstance(light, lights.LobeEnvironment):
            parts.append(_of_lobes(light, channels, chosen, dtype))
        else:
            raise InputError(
                f"{name} must be light from infinity (Ambient, Environment, LobeEnvironment, "
                f"Directional) for precomputed transfer; received {type(light).__name__}"
            )
    if suns:
        parts.append(Suns(*(jnp.stack(part) for part in zip(*suns, strict=True))))
    known = checks.concrete(even)
    if not parts or known is None or known.any():
        parts.append(Even(even))
    return parts[0] if len(parts) == 1 else Lights(tuple(parts))


def _finite(name: str, light: lights.Light) -> None:
    """Lights refuse what is not a number; many let infinity pass."""
    for leaf in jax.tree.leaves(light):
        known = checks.concrete(leaf)
        if known is not None and not np.isfinite(known).all():
            text = f"{name} ({type(light).__name__}) must be finite"
            raise InputError(f"{text}; received {known[~np.isfinite(known)][0]:g}")


def _of_map(light: lights.Environment, channels: Channels, settings: Any, dtype: Any) -> Any:
    if settings is None:
        raise InputError(
            "method 'lobes' needs light that is lobes; received an environment map: fit lobes to "
            "it with diffopt.fitting.fit_environment, or choose 'pyramid' or 'harmonics'"
        )
    image = light.radiance if light.radiance.ndim == 3 else light.radiance[..., None]
    pixels = image.astype(dtype) * light.scale.astype(dtype)
    frame = jnp.asarray(light.axes, dtype)
    if isinstance(settings, PyramidSettings):
        found = prefiltering.from_map(pixels, frame, settings)
        return Pyramid(channels.converted(found.texels), found.frame, found.kappas, found.sides)
    height, width, _ = pixels.shape
    if settings.bands > height or 2 * settings.bands - 1 > width:
        raise InputError(
            f"bands must be at most the rows and half the columns of a map of {height} x {width}; "
            f"received {settings.bands}"
        )
    weights = prefiltering.fejer_weights(height)[:, None, None] * (4.0 * np.pi / width)
    coefficients = prefiltering.project(pixels * jnp.asarray(weights, dtype), settings.bands)
    return HarmonicLight(channels.converted(coefficients), frame)


def _of_lobes(light: lights.LobeEnvironment, channels: Channels, settings: Any, dtype: Any) -> Any:
    alpha, mu, kappa = (array.astype(dtype) for array in light.lobes.arrays)
    alpha = channels.converted(alpha[:, None] if alpha.ndim == 1 else alpha)
    if settings is None:
        return LobeLight(alpha, mu, kappa)
    if isinstance(settings, PyramidSettings):
        return prefiltering.from_lobes(alpha, mu, kappa, settings)
    shares = lobe_harmonics.ratios(kappa, settings.bands)[harmonics.degrees(settings.bands)]
    values = harmonics.basis(mu, settings.bands) * shares
    coefficients = jnp.matmul(values, alpha, precision="highest")
    return HarmonicLight(coefficients, jnp.eye(3, dtype=dtype))
