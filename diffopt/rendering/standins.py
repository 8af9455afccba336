"""Abstract light sources in place of all others: parallel beams and points.

A surface that emits light becomes points that shine by the cosine, an environment becomes
beams. They are the same for all points of the scene, so that pictures have no noise; what
they lack is seen as bands in soft shadows, fewer with more of them.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.kernels import frames
from diffopt.rendering.families import Beams, LobeSky, Points, Sky, Surfaces
from diffopt.rendering.sources import Sources

# Powers of the fractions that fill a cube evenly (Roberts 2018).
_STEP = 1.22074408460575947536


class StandIns(eqx.Module):
    """Abstract lights.

    Attributes
    ----------
    beams, points
        Of them.
    ambient
        Radiance of even light that nothing shades, [C].
    even
        Radiance of an even environment, [C], for which the last beams stand; None for none.
    last
        Their number.
    has_ambient
        Whether there is ambient light.
    soft
        Of each beam, then of each point, whether it stands for light from more than one
        direction.
    """

    beams: Beams
    points: Points
    ambient: Float[Array, " C"]
    even: Float[Array, " C"] | None
    last: int = eqx.field(static=True)
    has_ambient: bool = eqx.field(static=True)
    soft: tuple[bool, ...] = eqx.field(static=True)

    @property
    def count(self) -> int:
        """Beams and points."""
        return self.beams.towards.shape[0] + self.points.exponent.shape[0]


@eqx.filter_jit
def stand_ins(sources: Sources, count: int, sky: bool) -> StandIns:
    """Abstract lights for the lights of a scene.

    Parameters
    ----------
    sources
        The lights.
    count
        Points for all surfaces that emit, and directions for an environment.
    sky
        Whether an even environment becomes beams; it adds to the ambient light otherwise.
    """
    dtype, channels = sources.ambient.dtype, sources.ambient.shape[0]
    numbers = jnp.asarray(evenly(count), dtype)
    ambient, even = sources.ambient, None
    beams: list[tuple[Array, Array]] = []
    points: list[tuple[Array, ...]] = []
    soft_beams: list[bool] = []
    soft_points: list[bool] = []
    for one in sources.families:
        if isinstance(one, Beams):
            beams.append((one.towards, one.irradiance))
            soft_beams += [False] * one.towards.shape[0]
        elif isinstance(one, Points):
            points.append((one.position, one.aim, one.intensity, one.exponent, one.falloff))
            soft_points += [False] * one.exponent.shape[0]
        elif isinstance(one, Surfaces):
            points.append(_on_surfaces(one, numbers))
            soft_points += [True] * count
        elif isinstance(one, Sky | LobeSky):
            drawn = one.draw(numbers, jnp.zeros_like(numbers))
            beams.append((drawn.towards, drawn.value / count))
            soft_beams += [True] * count
    if sources.constant is not None:
        if sky:
            z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
            turn = np.arange(count) * (0.5 * (np.sqrt(5.0) - 1.0))
            spiral = (np.sqrt(1.0 - z * z), turn % 1.0, z)
            towards = frames.around(*(jnp.asarray(a, dtype) for a in spiral))
            even = sources.constant
            each = even * (4.0 * np.pi / count)
            beams.append((towards, jnp.broadcast_to(each, (count, channels))))
            soft_beams += [True] * count
        else:
            ambient = ambient + sources.constant
    none = jnp.zeros((0, 3), dtype), jnp.zeros((0, channels), dtype)
    beams.append(none)
    points.append((none[0], none[0], none[1], jnp.zeros(0, dtype), none[0]))
    return StandIns(
        Beams(*(jnp.concatenate(part) for part in zip(*beams, strict=True))),
        Points(*(jnp.concatenate(part) for part in zip(*points, strict=True))),
        ambient,
        even,
        0 if even is None else count,
        sources.has_ambient or (sources.constant is not None and not sky),
        (*soft_beams, *soft_points),
    )


def _on_surfaces(family: Surfaces, numbers: Float[Array, "n 3"]) -> tuple[Array, ...]:
    """Points on surfaces that emit, each with its share of their power."""
    count = numbers.shape[0]
    index = family.pick(numbers[:, 2])
    position, normal = family.place(index, numbers[:, :2])
    share = family.shares[index] * count
    intensity = family.radiance[index] * (family.area[index] / share)[:, None]
    one = jnp.ones(count, numbers.dtype)
    square = jnp.broadcast_to(jnp.asarray([1.0, 2.0, 0.0], numbers.dtype), (count, 3))
    return position, normal, intensity, one, square


def evenly(count: int) -> Float[np.ndarray, "n 3"]:
    """Points that fill the unit cube evenly."""
    steps = _STEP ** -np.arange(1.0, 4.0)
    return (0.5 + np.arange(count)[:, None] * steps) % 1.0
