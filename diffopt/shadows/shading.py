"""Light at receivers in the shadow of fields: irradiance, and reflected radiance.

Compiled once for a number of occluders, lights and settings, whatever their values; receivers are
handled in blocks, so that intermediate arrays stay in the processor's caches.
"""

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt import workers
from diffopt.errors import InputError
from diffopt.kernels import harmonic_products
from diffopt.shadows import combining, responses
from diffopt.shadows.fields import Field
from diffopt.shadows.lights import MANY_NORMALS, ONE_NORMAL, WITH_BRDF, DistantLight, Light
from diffopt.shadows.responses import ProjectedBRDF
from diffopt.shadows.settings import ShadowSettings

# Receivers at once.
_BLOCK = 8192


def irradiance(
    points: Any,
    normals: Any,
    occluders: Sequence[Field],
    lights: Light | Sequence[Light],
    settings: ShadowSettings | None = None,
) -> Float[Array, "... C"]:
    """Irradiance of matte receivers past occluders, one value for each channel.

    Parameters
    ----------
    points
        [..., 3].
    normals
        Unit vectors: one for each point, or one [3] for all, which is faster.
    occluders
        Fields, of equal bands; none for no shadow.
    lights
        One or more, with equal numbers of channels.
    settings
        Of the fields; of them `combination` and `clamp` count here.

    Raises
    ------
    InputError
        If shapes, bands or channels do not agree.
    """
    return _evaluate(points, normals, None, None, occluders, lights, settings)


def reflected(
    points: Any,
    normals: Any,
    views: Any,
    brdf: ProjectedBRDF,
    occluders: Sequence[Field],
    lights: Light | Sequence[Light],
    settings: ShadowSettings | None = None,
) -> Float[Array, "... C"]:
    """Radiance that receivers with a BRDF send to the viewer.

    Parameters
    ----------
    points, normals, occluders, lights, settings
        As for `irradiance`.
    views
        Unit vectors to the viewer, as `normals`.
    brdf
        From `project_brdf`.
    """
    return _evaluate(points, normals, views, brdf, occluders, lights, settings)


def _evaluate(
    points: Any,
    normals: Any,
    views: Any,
    brdf: ProjectedBRDF | None,
    occluders: Sequence[Field],
    lights: Light | Sequence[Light],
    settings: ShadowSettings | None,
) -> Array:
    settings = settings or ShadowSettings()
    lights = (lights,) if isinstance(lights, Light) else tuple(lights)
    if not lights:
        raise InputError("lights must hold one at least")
    if len({light.channels for light in lights}) > 1:
        raise InputError(
            f"lights must have equal numbers of channels; received "
            f"{[light.channels for light in lights]}"
        )
    bands = combining.same_bands(occluders) if occluders else settings.bands
    for light in lights:
        if isinstance(light, DistantLight) and light.matrix.shape[1] != bands**2:
            raise InputError(
                f"distant light must have {bands} bands, as the fields; received "
                f"{round(light.matrix.shape[1] ** 0.5)}"
            )
    dtype = jnp.result_type(float)
    points = jnp.asarray(points, dtype)
    if points.shape[-1:] != (3,):
        raise InputError(f"points must be [..., 3]; received {points.shape}")
    sides: Any = []
    for name, value in (("normals", normals), ("views", views)):
        if value is None:
            sides.append(None)
            continue
        value = jnp.asarray(value, dtype)
        if value.shape not in ((3,), points.shape):
            raise InputError(f"{name} must be [3] or {points.shape}; received {value.shape}")
        each = value.ndim > 1 or brdf is not None
        value = jnp.broadcast_to(value, points.shape).reshape(-1, 3) if each else value
        sides.append(value)
    if settings.combination == "exponential":
        occluders = combining.logarithms(occluders)
    rows = points.reshape(-1, 3)

    def shade(part: slice) -> Array:
        own: Any = [_padded(a[part], size) if a is not None and a.ndim > 1 else a for a in sides]
        return _shade(
            _padded(rows[part], size),
            own[0],
            own[1],
            brdf,
            tuple(occluders),
            lights,
            bands,
            settings.combination,
            settings.clamp,
        )

    # A block's loops are too short for XLA to share among cores: each thread takes a part of the
    # receivers. Within somebody else's program there are no threads.
    traced = any(
        isinstance(leaf, jax.core.Tracer)
        for leaf in jax.tree.leaves((points, sides, brdf, occluders, lights))
    )
    threads = 1 if traced or len(rows) < 2 * _BLOCK else workers.count()
    size = -(-len(rows) // threads)
    parts = [slice(first, first + size) for first in range(0, len(rows), size)] or [slice(0)]
    pieces = list(workers.ahead(shade, parts, threads))
    found = jnp.concatenate(pieces)[: len(rows)] if len(pieces) > 1 else pieces[0]
    return found.reshape(*points.shape[:-1], found.shape[-1])


def _padded(rows: Array, size: int) -> Array:
    """Rows up to a size, the last one repeated: one compiled program serves all threads."""
    if not 0 < len(rows) < size:
        return rows
    return jnp.concatenate([rows, jnp.broadcast_to(rows[-1:], (size - len(rows), 3))])


@eqx.filter_jit
def _shade(
    points: Array,
    normals: Array,
    views: Array | None,
    brdf: ProjectedBRDF | None,
    occluders: tuple[Field, ...],
    lights: tuple[Light, ...],
    bands: int,
    combination: str,
    clamp: bool,
) -> Array:
    count = points.shape[0]
    if brdf is not None:
        places = np.arange(max(WITH_BRDF, bands) ** 2)
    else:
        places = responses.cosine_places(ONE_NORMAL if normals.ndim == 1 else MANY_NORMALS)
    fixed = responses.cosine_rows(normals[:, None], places) if normals.ndim == 1 else None
    local = any(not isinstance(light, DistantLight) for light in lights)

    def block(x: Array, n: Array | None, v: Array | None) -> Array:
        facing = normals[:, None] if n is None else n
        if brdf is None:
            response = fixed if fixed is not None else responses.cosine_rows(facing, places)
            low = responses.cosine(facing, bands) if local else response
        else:
            assert v is not None
            response = brdf.response(facing, v, max(WITH_BRDF, bands))
            low = response[: bands**2]
        return _gathered(x, (response, places, low), occluders, lights, bands, combination, clamp)

    return _in_blocks(block, count, points, normals if fixed is None else None, views)


def _gathered(
    x: Array,
    responding: tuple[Array, np.ndarray, Array],
    occluders: tuple[Field, ...],
    lights: tuple[Light, ...],
    bands: int,
    combination: str,
    clamp: bool,
) -> Array:
    """Sum over lights, [C, N], of a response to distant light, its places, and to local light."""
    response, places, low = responding
    clear = combining.nothing_hidden(bands, x[:, :1])
    total: Any = 0.0
    everything: Any = None
    for light in lights:
        if isinstance(light, DistantLight):
            if occluders:
                if everything is None:
                    everything = combining.visibility(x, occluders, combination)
                found = light.gathered(everything, response, places)
            else:
                found = light.gathered(clear, response, places)
            unshadowed = light.gathered(clear, response, places)
        else:
            source = light.source(x, bands)
            seen = low
            if occluders:
                near = combining.visibility(x, occluders, combination, light.distance(x))
                seen = harmonic_products.product(near, jnp.broadcast_to(low, near.shape))
            found = jnp.sum(source * seen[:, :, None], 0).T
            unshadowed = jnp.sum(source * low[:, :, None], 0).T
        if clamp:
            found = jnp.clip(found, 0.0, jnp.maximum(unshadowed, 0.0))
        total = total + found
    return jnp.broadcast_to(total, (total.shape[0], x.shape[1]))


def _in_blocks(
    block: Callable[..., Array], count: int, *parts: Array | None
) -> Float[Array, "N C"]:
    """A function of [3, n] arrays over rows [N, 3], a block at a time; the last row fills up."""
    blocks = max(1, -(-count // _BLOCK))
    size = -(-count // blocks) if count else 1
    spare = blocks * size - count

    def split(part: Array) -> Array:
        if spare:
            last = part[-1:] if count else jnp.ones((1, 3), part.dtype)
            part = jnp.concatenate([part, jnp.broadcast_to(last, (spare, 3))])
        return jnp.moveaxis(part.reshape(blocks, size, 3), 2, 1)

    given = [None if part is None else split(part) for part in parts]
    found = jax.lax.map(lambda xs: block(*xs), tuple(given))
    return jnp.moveaxis(found, 2, 1).reshape(blocks * size, -1)[:count]


def plane(size: float, count: int, height: float = 0.0) -> Float[np.ndarray, "n n 3"]:
    """Receivers in the middle of the cells of a square grid in the plane z = height."""
    side = (np.arange(count) + 0.5) * (size / count) - 0.5 * size
    x, y = np.meshgrid(side, side, indexing="ij")
    return np.stack([x, y, np.full_like(x, height)], -1)
