"""Path tracing of some effects and no others, each told apart.

What paths went through is known on the host, beside the arrays: what is left out is neither
traced nor shaded, and no ray is cast for it.
"""

import collections
import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from diffopt.rendering import pathtrace, rows, shading
from diffopt.rendering.effects import (
    BITS,
    GLOSSY,
    MATTE,
    OF_SOFT,
    Composition,
    after,
    scattered,
)
from diffopt.rendering.families import Beams, Points
from diffopt.rendering.happenings import Parts
from diffopt.rendering.ledgers import Layers, Ledger, Whole
from diffopt.rendering.programs import Program
from diffopt.rendering.queries import Queries
from diffopt.rendering.rows import Tree
from diffopt.rendering.shading import Rays, Shadow
from diffopt.rendering.sources import Sources
from diffopt.rendering.stage import Stage
from diffopt.scenes.raycasting import Hits
from diffopt.scenes.world import World

_EMISSION, _SURROUNDINGS, _AMBIENT = (BITS[k] for k in ("emission", "surroundings", "ambient"))
_HARD, _SOFT, _SELF = (BITS[k] for k in ("hard-shadows", "soft-shadows", "self-shadows"))


class Composed:
    """Path tracing of a composition as a level; see `Level` of `diffopt.rendering.driver`.

    Parameters
    ----------
    composition
        What is in.
    layers
        Whether each effect's light is told apart: rays return `Layers`.

    Attributes
    ----------
    rays
        See `Walk`.
    """

    def __init__(self, composition: Composition, layers: bool = False) -> None:
        self.composition, self.layers = composition, layers
        self.rays: collections.Counter[str] = collections.Counter()

    def __call__(self, stage: Stage, rays: Rays, queries: Queries, key: PRNGKeyArray) -> Rays:
        """Follow paths to their end."""
        kind = Layers if self.layers else Whole
        ledger = kind(rays.throughput.shape[0], stage.channels, stage.dtype)
        walk = Walk(self.composition, ledger)
        walk.trace(stage, rays, queries, key)
        self.rays.update(walk.rays)
        return eqx.tree_at(lambda r: r.radiance, rays, jnp.asarray(ledger.total))


@dataclasses.dataclass
class _State:
    """What is known of rays on the host, [N] each.

    Attributes
    ----------
    home
        Rays of the camera that they come from.
    code
        What they need so far, see `effects`.
    kind
        What happened last.
    owner
        Of the surface that they leave.
    """

    home: np.ndarray
    code: np.ndarray
    kind: np.ndarray
    owner: np.ndarray

    def of(self, which: np.ndarray) -> "_State":
        """Some of the rays."""
        return _State(**{name: value[which] for name, value in vars(self).items()})


def _start(count: int) -> _State:
    none = np.zeros(count, np.int64)
    return _State(np.arange(count), none, none + GLOSSY, none - 1)


def _joined(states: list[_State]) -> _State:
    return _State(**{k: np.concatenate([vars(s)[k] for s in states]) for k in vars(states[0])})


class Walk:
    """Follows paths of a composition; what is counted and kept is found in it afterwards.

    Parameters
    ----------
    composition
        What is in.
    ledger
        Takes the light.

    Attributes
    ----------
    rays
        Number of rays cast by what they were cast for: ``camera``, an effect of `effects.PATHS`,
        ``interreflection``, or ``light``: for light that paths meet.
    first
        Rays that leave the first surface that scatters light, and those that meet a surface
        again.
    """

    def __init__(self, composition: Composition, ledger: Ledger) -> None:
        self.composition, self.ledger = composition, ledger
        self.rays: collections.Counter[str] = collections.Counter()
        self.first = np.zeros(2, np.int64)

    def trace(self, stage: Stage, rays: Rays, queries: Queries, key: PRNGKeyArray) -> None:
        """Follow rays of the camera to their end.

        Parameters
        ----------
        stage, queries, key
            As for `diffopt.rendering.pathtrace.trace`.
        rays
            As they leave the camera.
        """
        owners = stage.owner
        count = rays.throughput.shape[0]
        size = min(rows.block(), count)
        state = _start(count)
        deepest = min(self.composition.scattered + self.composition.mirrors, pathtrace.DEEPEST)
        for bounce in range(deepest + 1):
            self._counted(stage, np.asarray(rays.alive), state)
            rays, hits, alive = queries.first(rays)
            if not len(alive):
                return
            self._missed(stage, rays, state, alive[hits.primitive[alive] < 0], size)
            met = alive[hits.primitive[alive] >= 0]
            once = [scattered(state.code[k]) == 1 for k in (alive, met)]
            self.first += [int(some.sum()) for some in once]
            if stage.sources.constant is not None:
                self._even_sky(stage, rays, state.of(met), met, owners[hits.primitive[met]])
            found, states = [], []
            for _, group, here in stage.by_group(alive, hits):
                some = state.of(here)
                scatters = np.zeros(len(here), bool)
                if group.kind.smooth:
                    scatters |= self.composition.may_scatter(some.code)
                if group.delta:
                    scatters |= self.composition.may_mirror(some.code)
                self._seen(stage, group, rays, hits, state, here[~scatters], size)
                for block, wanted in rows.blocks(here[scatters], size):
                    part = shading.alive(rows.taken(rays, block), np.arange(size) < wanted)
                    scene = stage.world, stage.sources, stage.member, key
                    number = np.asarray(bounce, np.uint32), np.asarray(False)
                    onwards, shadow, told = pathtrace._scatter(
                        group, *scene, part, rows.taken(hits, block), *number,
                        stage.offset, None, True,
                    )  # fmt: skip
                    before = state.of(block[:wanted])
                    before.owner = owners[hits.primitive[block[:wanted]]]
                    got = (_first(one, wanted) for one in (onwards, shadow, told))
                    found.append(self._settled(stage, queries, group, before, *got))
                    states.append(before)
            if not found:
                return
            rays, state = rows.joined(found), _joined(states)

    def _counted(self, stage: Stage, alive: np.ndarray, state: _State) -> None:
        """Count rays that are about to be cast."""
        some = state.of(np.flatnonzero(alive))
        if not len(some.home):
            return
        left = np.ones(len(some.home), bool)
        coherent, caustic = some.kind > GLOSSY, (some.code & BITS["caustics"]) != 0
        for name, which in (
            ("camera", some.owner < 0),
            ("caustics", caustic),
            ("refraction", coherent & ((some.code & BITS["refraction"]) != 0)),
            ("mirror", coherent),
            ("interreflection", self.composition.may_scatter(some.code)),
            ("light", left.copy()),
        ):
            self.rays[name] += int((which & left).sum())
            left &= ~which

    def _missed(self, stage: Stage, rays: Rays, state: _State, gone: np.ndarray, size: int) -> None:
        """Light of the surroundings."""
        some = state.of(gone)
        code = np.where(scattered(some.code) == 0, some.code | _SURROUNDINGS, some.code)
        kept = self.composition.allows(code)
        homes, codes = some.home[kept], code[kept]
        at = 0
        for block, wanted in rows.blocks(gone[kept], size):
            seen = pathtrace._missed(stage.sources, rows.taken(rays, block))
            part = slice(at, at + wanted)
            self._add(homes[part], codes[part], np.asarray(seen)[:wanted])
            at += wanted

    def _seen(
        self,
        stage: Stage,
        group: Any,
        rays: Rays,
        hits: Hits,
        state: _State,
        here: np.ndarray,
        size: int,
    ) -> None:
        """Light of surfaces that scatter none of it any more."""
        entry = np.asarray(stage.sources.entry)
        here = here[entry[hits.primitive[here]] >= 0]
        for block, wanted in rows.blocks(here, size):
            scene = stage.world, stage.sources, stage.member
            light = _emitted(group, *scene, rows.taken(rays, block), rows.taken(hits, block))
            self._emission(state.of(block[:wanted]), np.asarray(light)[:wanted])

    def _emission(self, some: _State, light: np.ndarray) -> None:
        code = np.where(scattered(some.code) == 0, some.code | _EMISSION, some.code)
        kept = self.composition.allows(code)
        self._add(some.home[kept], code[kept], light[kept])

    def _settled(
        self,
        stage: Stage,
        queries: Queries,
        group: Any,
        some: _State,
        onwards: Rays,
        shadow: Shadow,
        told: Parts,
    ) -> Rays:
        """Add what a bounce brought; `some` becomes the state of the rays that go on."""
        what = self.composition
        self._emission(some, np.asarray(onwards.radiance))
        kind = np.asarray(told.kind, np.int64)
        smooth = what.may_scatter(some.code)
        if group.kind.smooth and stage.sources.families:
            self._drawn(queries, some, shadow, told, smooth)
        code = after(some.code, kind)
        if stage.sources.has_ambient:
            even = code | _AMBIENT
            kept = (kind <= GLOSSY) & smooth & what.allows(even)
            self._add(some.home[kept], even[kept], np.asarray(told.ambient)[kept])
        possible = np.where(kind <= GLOSSY, smooth, what.may_mirror(some.code))
        some.code, some.kind = code, kind
        lives = np.asarray(onwards.alive) & possible & what.allows(code)
        return shading.alive(onwards, lives & self._useful(stage, some))

    def _useful(self, stage: Stage, some: _State) -> np.ndarray:
        """Whether rays may meet light, or something that scatters it on."""
        what, sources = self.composition, stage.sources
        lights = sources.constant is not None
        lights |= any(not isinstance(one, Beams | Points) for one in sources.families)
        smooth = any(group.kind.smooth for group in stage.groups)
        delta = any(group.delta for group in stage.groups)
        on = smooth & what.may_scatter(some.code)
        return on | (delta & what.may_mirror(some.code)) | lights

    def _drawn(
        self, queries: Queries, some: _State, shadow: Shadow, told: Parts, smooth: np.ndarray
    ) -> None:
        """Light that was drawn, of both parts of the material, where nothing hides it."""
        what = self.composition
        soft, matte = np.asarray(told.soft) == 1, np.asarray(told.matte)
        codes = [after(some.code, np.full(len(soft), k)) for k in (MATTE, GLOSSY)]
        value = np.asarray(shadow.value)
        values = [
            value * share * (smooth & what.allows(code))[:, None]
            for share, code in zip((matte, 1.0 - matte), codes, strict=True)
        ]
        casts = np.where(soft, what.receivers(True, some.owner), what.receivers(False, some.owner))
        bright = ((values[0] != 0.0) | (values[1] != 0.0)).any(1)
        asked = np.flatnonzero(casts & bright)
        way = [np.asarray(a)[asked] for a in (shadow.origin, shadow.towards, shadow.length)]
        assert queries.caster is not None
        seen = np.ones(len(soft), bool)
        if not len(asked):
            pass
        elif self.ledger.shadows:
            met = queries.caster.first(way[0], way[1])
            hidden = (met.primitive >= 0) & (met.distance < way[2])
            owner = queries.caster.geometry.owner[np.maximum(met.primitive, 0)]
            seen[asked] = ~hidden
            at = asked[hidden]
            own = owner[hidden] == some.owner[at]
            bit = np.where(own, _SELF, np.where(soft[at], _SOFT, _HARD))
            bit = bit | np.where(soft[at], OF_SOFT, 0)
            whole = 1.0 / np.maximum(np.asarray(told.weight)[at], 1e-6)[:, None]
            for found, code in zip(values, codes, strict=True):
                self.ledger.add(some.home[at], code[at] | bit, -found[at] * whole, some.owner[at])
        else:
            seen[asked] = ~queries.caster.blocked(*way)
        for name, kinds in (("hard-shadows", ~soft), ("soft-shadows", soft)):
            self.rays[name] += int(kinds[asked].sum())
        for found, code in zip(values, codes, strict=True):
            self._add(some.home[seen], code[seen], found[seen])

    def _even_sky(
        self, stage: Stage, rays: Rays, some: _State, met: np.ndarray, owner: np.ndarray
    ) -> None:
        """Light of an even sky behind surfaces: hidden, or not where no shadow falls."""
        behind = (some.kind <= GLOSSY) & (some.owner >= 0)
        bare = np.flatnonzero(behind & ~self.composition.receivers(True, some.owner))
        if len(bare):
            light = np.asarray(rays.throughput)[met[bare]]
            self._add(some.home[bare], some.code[bare], light * np.asarray(stage.sources.constant))
            behind[bare] = False
        if not self.ledger.shadows:
            return
        sky = np.asarray(stage.sources.constant)
        value = np.asarray(rays.throughput)[met[behind]] * sky[None]
        bit = np.where(owner[behind] == some.owner[behind], _SELF, _SOFT) | OF_SOFT
        self.ledger.add(some.home[behind], some.code[behind] | bit, -value, some.owner[behind])

    def _add(self, home: np.ndarray, code: np.ndarray, values: np.ndarray) -> None:
        bright = np.flatnonzero((values != 0.0).any(1))
        if len(bright):
            none = np.full(len(bright), -1)
            self.ledger.add(home[bright], code[bright], values[bright], none)


def _first(tree: Tree, count: int) -> Tree:
    """The first rows of all arrays, on the host."""
    return jax.tree.map(lambda array: np.asarray(array)[:count], tree)


def _light(
    group: Any, world: World, sources: Sources, member: Array, rays: Rays, hits: Hits
) -> Float[Array, "n C"]:
    met = shading.meet(group, world, rays, hits, member)
    return met.throughput * shading.emitted(met, sources, rays, drawn=True)


_emitted = Program(_light)
