"""Lights of shadow fields: distant ones, spheres, and emitting meshes.

What a receiver makes of light is its **response** F: the clamped cosine about its normal, or a BRDF
times it. Distant light, which is the same everywhere, is projected together with the response,
integral of L Y_i Y_j: no triple product remains, and light is not truncated to the bands.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.errors import InputError
from diffopt.kernels import harmonics
from diffopt.kernels.tabulated import root
from diffopt.materials.base import floating
from diffopt.materials.checking import within
from diffopt.shadows.fields import Field

#: Bands of a response to distant light: of one normal for all receivers; of a normal for each,
#: whose cosine has 1/64 in the last degree; of a BRDF.
ONE_NORMAL, MANY_NORMALS, WITH_BRDF = 16, 7, 9
# Nodes over the polar angle by which distant light is projected.
_NODES = 96


class DistantLight(eqx.Module):
    """Light from infinity.

    Attributes
    ----------
    matrix
        Integrals of radiance times two harmonics, [C, L^2, 256].
    """

    matrix: Float[Array, "C L2 R2"]

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.matrix.shape[0]

    def gathered(
        self, visible: Float[Array, " L2 #N"], response: Float[Array, " R #N"], places: np.ndarray
    ) -> Float[Array, " C #N"]:
        """Light that comes through visibility, times a response known by some coefficients.

        N of the response may be 1: one for all.
        """
        matrix = self.matrix[:, :, places]
        weights = jnp.einsum("cij,jn->cin", matrix, response)
        if weights.shape[2] == 1:
            return jnp.einsum("ci,in->cn", weights[:, :, 0], visible)
        return jnp.sum(weights * visible[None], 1)


def distant_light(radiance: Any, bands: int, nodes: int = _NODES) -> DistantLight:
    """Light from infinity for fields of some bands.

    Parameters
    ----------
    radiance
        A function of unit vectors [n, 3] to radiance [n] or [n, C]; an `Environment` or
        `LobeEnvironment` of `diffopt.scenes`; or one number for all directions.
    bands
        L of the fields.
    nodes
        Over the polar angle; twice as many over the azimuth.

    Raises
    ------
    InputError
        If the function returns another shape, or what is not finite.
    """
    directions, weights, values = _rule(nodes)
    found = np.asarray(radiance_function(radiance)(directions), np.float64)
    if found.ndim not in (1, 2) or len(found) != len(directions):
        raise InputError(
            f"radiance of {len(directions)} directions must be [n] or [n, C]; received "
            f"{found.shape}"
        )
    if not np.isfinite(found).all():
        raise InputError("radiance of distant light must be finite")
    found = (found[:, None] if found.ndim == 1 else found) * weights[:, None]
    first = values[: bands**2]
    matrix = np.stack([(first * channel) @ values.T for channel in found.T])
    return DistantLight(jnp.asarray(matrix, jnp.result_type(float)))


# Lights that change from frame to frame are projected again and again.
@functools.lru_cache(maxsize=2)
def _rule(nodes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directions, weights and harmonics of a rule over the sphere."""
    directions, weights = harmonics.sphere_rule(nodes, 2 * nodes)
    return directions, weights, harmonics.numpy_basis(directions, ONE_NORMAL)


def radiance_function(radiance: Any) -> Callable[[np.ndarray], Any]:
    """What `distant_light` takes as a function of directions."""
    from diffopt.scenes.lights import Environment, LobeEnvironment

    if isinstance(radiance, LobeEnvironment):
        return lambda d: radiance.lobes(jnp.asarray(d))
    if isinstance(radiance, Environment):
        from diffopt.scenes.channels import Channels
        from diffopt.scenes.sky import Map

        if not radiance.is_map:
            value = np.atleast_1d(np.asarray(radiance.radiance * radiance.scale))
            return lambda d: np.broadcast_to(value, (len(d), len(value)))
        dtype = jnp.result_type(float)
        sky = Map(radiance, Channels(), dtype)
        return lambda d: sky.radiance(jnp.asarray(d, dtype))
    if callable(radiance):
        return radiance
    value = float(radiance)
    return lambda d: np.full(len(d), value)


def _channels(value: Any) -> Array:
    return jnp.atleast_1d(floating(value))


class SphereLight(eqx.Module):
    """A sphere that emits the same radiance everywhere.

    Parameters
    ----------
    centre
        [3].
    radius
        Above 0.
    radiance
        A number or channels [C].
    """

    centre: Float[Array, "3"] = eqx.field(converter=floating)
    radius: Float[Array, ""] = eqx.field(converter=floating)
    radiance: Float[Array, " C"] = eqx.field(converter=_channels)

    def __check_init__(self) -> None:
        """Check the values, where they are known."""
        if self.centre.shape != (3,) or self.radiance.ndim != 1:
            raise InputError(
                f"centre must be [3] and radiance a number or [C]; received "
                f"{self.centre.shape} and {self.radiance.shape}"
            )
        within("radius", self.radius, 0.0, math.inf)

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.radiance.shape[0]

    def distance(self, x: Float[Array, "3 N"]) -> Float[Array, " N"]:
        """From points to the centre."""
        away = self.centre[:, None] - x
        return root(jnp.sum(away * away, 0))

    def source(self, x: Float[Array, "3 N"], bands: int) -> Float[Array, "L2 N C"]:
        """Coefficients of radiance at points: a cap of half-angle asin(R / d); within, a half."""
        away = self.centre[:, None] - x
        distance = self.distance(x)
        safe = jnp.where(distance > 0.0, distance, 1.0)
        sine = jnp.clip(self.radius / safe, 0.0, 1.0 - 1e-6)
        half = jnp.where(distance > self.radius, jnp.arcsin(sine), 0.5 * math.pi)
        up = jnp.zeros_like(away).at[2].set(1.0)
        axis = jnp.where((distance > 0.0)[None], away / safe[None], up)
        caps = harmonics.zonal(harmonics.cap(half, bands), axis.T)
        return caps[:, :, None] * self.radiance[None, None]


class FieldLight(eqx.Module):
    """An emitting mesh, textured by its faces: the field of `shadow_field(..., emission=...)`.

    Attributes
    ----------
    field
        With channels.
    """

    field: Field

    def __check_init__(self) -> None:
        """A field of what is hidden is no light."""
        if not self.field.channels:
            raise InputError("field must be that of a light: shadow_field(..., emission=...)")

    @property
    def channels(self) -> int:
        """Number of channels."""
        return self.field.channels

    def distance(self, x: Float[Array, "3 N"]) -> Float[Array, " N"]:
        """From points to the centre."""
        return self.field.distance(x)

    def source(self, x: Float[Array, "3 N"], bands: int) -> Float[Array, "L2 N C"]:
        """Coefficients of radiance at points, in the bands of the field."""
        if bands != self.field.bands:
            raise InputError(f"light must have {bands} bands; received {self.field.bands}")
        return self.field.seen(x)


Light = DistantLight | SphereLight | FieldLight
