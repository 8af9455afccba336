"""What rays meet: asked of a caster, or taken from a record of what it said.

A record makes an image a differentiable function of the scene at fixed visibility: rays and
what they meet are constants of it.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from diffopt.rendering.shading import Rays, Shadow
from diffopt.scenes.raycasting import Caster, Hits


@dataclasses.dataclass
class Record:
    """Answers in the order in which they were asked for; see `Queries`."""

    answers: list[Any] = dataclasses.field(default_factory=list)


class Queries:
    """Answers which surfaces rays meet and which lights are hidden.

    Parameters
    ----------
    caster
        Casts the rays; None to repeat a record.
    record
        Where answers are kept, or taken from if there is no caster; None to keep none.
    """

    def __init__(self, caster: Caster | None, record: Record | None = None) -> None:
        self.caster, self.record = caster, record
        self._next = 0

    def _answer(self, ask: Any) -> Any:
        if self.caster is None:
            assert self.record is not None
            found = self.record.answers[self._next]
            self._next += 1
            return found
        found = ask()
        if self.record is not None:
            self.record.answers.append(found)
        return found

    def first(self, rays: Rays) -> tuple[Rays, Hits, Int[np.ndarray, " n"]]:
        """The rays, what those that live meet, in arrays [N], and which those are.

        From a record, the rays lie where they lay then.
        """

        def ask() -> tuple[Any, ...]:
            assert self.caster is not None
            rows = np.flatnonzero(np.asarray(rays.alive))
            way = np.asarray(rays.origin), np.asarray(rays.direction)
            some = self.caster.first(*(a[rows] for a in way))
            count = len(rays.alive)
            blank = Hits(
                np.full(count, -1, np.int32),
                np.full(count, np.inf, np.float32),
                *(np.zeros(count, np.float32) for _ in range(2)),
            )
            for whole, part in zip(blank, some, strict=True):
                whole[rows] = part
            return way, blank, rows

        way, hits, rows = self._answer(ask)
        if self.caster is None:
            fixed = [jnp.asarray(a) for a in way]
            rays = eqx.tree_at(lambda r: (r.origin, r.direction), rays, fixed)
        return rays, hits, rows

    def packed(self, waves: list[Rays], count: int) -> list[Rays]:
        """The living rays of several arrays in as few arrays of `count` as they fill."""

        def ask() -> list[np.ndarray]:
            alive = np.concatenate([np.asarray(w.alive) for w in waves] or [np.zeros(0, bool)])
            rows = np.flatnonzero(alive).astype(np.int32)
            padded = np.full(-(-len(rows) // count) * count, len(alive), np.int32)
            padded[: len(rows)] = rows
            return list(padded.reshape(-1, count))

        return [_packed(waves, jnp.asarray(rows)) for rows in self._answer(ask)]

    def lit(self, rays: Rays, shadow: Shadow) -> Rays:
        """Add the light that nothing hides."""
        return _added(rays, shadow.value, jnp.asarray(self.seen(shadow)))

    def seen(self, shadow: Shadow) -> Bool[np.ndarray, " N"]:
        """Whether there is light that nothing hides."""

        def ask() -> np.ndarray:
            assert self.caster is not None
            value = np.asarray(shadow.value)
            # Channel by channel: a maximum along so short an axis takes longer.
            bright = np.zeros(len(value), bool)
            for channel in value.T:
                bright |= channel != 0.0
            rows = np.flatnonzero(bright)
            way = (np.asarray(a)[rows] for a in (shadow.origin, shadow.towards, shadow.length))
            seen = np.zeros(len(shadow.length), bool)
            seen[rows] = ~self.caster.blocked(*way)
            return seen

        return self._answer(ask)


@eqx.filter_jit
def _added(rays: Rays, value: Array, seen: Array) -> Rays:
    total = rays.radiance + jnp.where(seen[:, None], value, 0.0)
    return eqx.tree_at(lambda r: r.radiance, rays, total)


@eqx.filter_jit
def _packed(waves: list[Rays], rows: Int[Array, " N"]) -> Rays:
    whole = jax.tree.map(lambda *arrays: jnp.concatenate(arrays), *waves)
    total = whole.alive.shape[0]
    out = jax.tree.map(lambda a: a[jnp.minimum(rows, total - 1)], whole)
    return eqx.tree_at(lambda r: r.alive, out, rows < total)
