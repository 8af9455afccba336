"""The function `plan`: which effects a picture of a scene calls for within a tolerance.

A tolerance bounds the mean difference of luminance over the picture. Six tenths of it are for
what is left out, four tenths for the noise or the sampling of what is in; by the triangle
inequality both together keep within it.
"""

import dataclasses
from typing import Any

import numpy as np

from diffopt.errors import InputError
from diffopt.planning import costs, pilot, reasons, replacing
from diffopt.planning.pilot import Pilot
from diffopt.planning.plans import Plan, Row
from diffopt.planning.reductions import EFFECTS, REPLACED, reduced
from diffopt.planning.replacing import Difference
from diffopt.rendering.effects import PATHS, Composition
from diffopt.rendering.stage import Stage
from diffopt.scenes.camera import Camera
from diffopt.scenes.scene import Scene

#: Shares of the tolerance for what is left out, and for noise.
LEFT_OUT, NOISE = 0.6, 0.4
# Share of the first one that goes to whole effects; the rest is for depths and receivers.
_EFFECTS = 0.8
# Bounces that are looked at.
_DEEPEST = 32


def plan(
    scene: Scene,
    camera: Camera,
    tolerance: float = 0.01,
    *,
    include: Any = (),
    exclude: Any = (),
    most_spp: int = 1024,
    seed: int = 0,
    backend: str = "embree",
) -> Plan:
    """Find the effects that a picture calls for.

    Parameters
    ----------
    scene, camera
        What is rendered, and from where.
    tolerance
        Mean absolute difference of luminance from a picture of everything, over the mean
        luminance, in (0, 1].
    include, exclude
        Effects (of `diffopt.planning.EFFECTS`) that are in or out whatever they bring.
    most_spp
        Paths of a pixel, at most: where noise would need more of them, the plan says what is
        left of it.
    seed, backend
        As of `diffopt.rendering.settings.Settings`; the same seed makes the same plan.

    Returns
    -------
    Plan
        For ``render(scene, camera, plan)``; ``print`` it for a table.

    Raises
    ------
    InputError
        For a tolerance outside its range, names that are not effects, or choices that
        contradict each other.
    """
    if not 0.0 < tolerance <= 1.0:
        raise InputError(f"tolerance must be above 0 and at most 1; received {tolerance:g}")
    wanted, unwanted = _names("include", include), _names("exclude", exclude)
    _consistent(wanted, unwanted)
    everything = Composition(bounces=_DEEPEST, coherent=_DEEPEST)
    stage = Stage(scene)
    seen = pilot.fly(scene, camera, everything, seed=seed, backend=backend, stage=stage)
    budget = LEFT_OUT * tolerance
    replaced = replacing.differences(scene, camera, seed=seed, backend=backend)
    out = _excluded(seen, replaced, stage, _EFFECTS * budget, wanted, unwanted)
    rest = 0.5 * max(budget - _bias(seen, stage, out, replaced), 0.0)
    composition = _depths(seen, out, rest)
    composition = _receivers(seen, composition, len(scene.objects), rest)
    small = reduced(scene, out)
    again = pilot.fly(small, camera, composition, seed=seed, backend=backend)
    best, paths, shares = costs.affordable(
        small,
        camera,
        again,
        seen,
        composition,
        NOISE * tolerance,
        most_spp,
        {"seed": seed, "backend": backend},
    )
    bias = _bias(seen, stage, out, replaced, composition)
    rows = tuple(
        _row(
            name,
            scene,
            seen,
            stage,
            out,
            replaced,
            composition,
            best.settings,
            shares,
            name in wanted or name in unwanted,
        )
        for name in EFFECTS
    )
    return Plan(tolerance, rows, composition, best.settings, bias, best.error, best.seconds, paths)


def _names(argument: str, given: Any) -> frozenset[str]:
    names = [given] if isinstance(given, str) else list(given)
    for name in names:
        if name not in EFFECTS:
            raise InputError(f"{argument} must be of {', '.join(EFFECTS)}; received {name!r}")
    return frozenset(names)


#: Effects that need another one.
_NEEDS = {
    "glossy-interreflection": ("glossy-light",),
    "diffuse-interreflection": ("matte-light",),
}


def _consistent(wanted: frozenset[str], unwanted: frozenset[str]) -> None:
    both = wanted & unwanted
    if both:
        raise InputError(f"include and exclude both name {', '.join(sorted(both))}")
    if "matte-light" in unwanted:
        raise InputError("matte-light cannot be left out: nothing would be lit")
    for name, needed in _NEEDS.items():
        missing = unwanted & set(needed)
        if name in wanted and missing:
            raise InputError(
                f"include names {name}, which needs {', '.join(sorted(missing))}; exclude names it"
            )


def _excluded(
    seen: Pilot,
    replaced: dict[str, Difference],
    stage: Stage,
    budget: float,
    wanted: frozenset[str],
    unwanted: frozenset[str],
) -> frozenset[str]:
    """What is left out: as many effects as fit, those that bring least first."""
    out = set(unwanted)
    if "glossy-light" in out:
        out.add("glossy-interreflection")
    absent = {name for name in PATHS if reasons.absent(name, stage)} - {"matte-light"}
    absent |= set(REPLACED) - set(replaced)
    if absent & wanted:
        raise InputError(f"{', '.join(sorted(absent & wanted))} cannot be in: the scene has none")
    out |= absent

    def alone(name: str) -> float:
        if name in replaced:
            return replaced[name].bound
        return seen.share(seen.lost([name]))[1]

    for name in sorted(set(EFFECTS) - out - wanted - {"matte-light"}, key=alone):
        more = out | {name} | ({"glossy-interreflection"} if name == "glossy-light" else set())
        if more & wanted:
            continue
        if _bias(seen, stage, more, replaced) <= budget:
            out = more
    return frozenset(out)


def _bias(
    seen: Pilot,
    stage: Stage,
    out: Any,
    replaced: dict[str, Difference],
    composition: Composition | None = None,
) -> float:
    """Bound of the difference that effects make together, and depths and receivers."""
    depths = {}
    if composition is not None:
        depths = {"bounces": composition.bounces, "coherent": composition.coherent}
    lost = seen.lost(out, **depths)
    if composition is not None:
        lost |= seen.bare(composition)
    # What the scene has may be there though no path found it.
    present = any(name in PATHS and not reasons.absent(name, stage) for name in out)
    bound = seen.share(lost)[1] if present or lost.any() else 0.0
    return bound + sum(replaced[name].bound for name in out if name in replaced)


def _depths(seen: Pilot, out: frozenset[str], rest: float) -> Composition:
    """The composition with as few bounces as the rest of a budget allows."""
    best: dict[str, int] = {"bounces": _DEEPEST, "coherent": _DEEPEST}
    for name, least in (("bounces", 1), ("coherent", 0)):
        known = seen.share(seen.lost(out, **best))[1]
        for depth in range(least, _DEEPEST):
            trial = {**best, name: depth}
            if seen.share(seen.lost(out, **trial))[1] - known <= 0.5 * rest:
                best = trial
                break
    # A scene may have no matte light to begin with; a composition cannot leave it out.
    return Composition(
        excluded=(out - {"matte-light"}) & frozenset(PATHS),
        bounces=best["bounces"],
        coherent=best["coherent"],
    )


def _receivers(seen: Pilot, composition: Composition, objects: int, rest: float) -> Composition:
    """Objects on which shadows fall: all that lose light worth it."""
    chosen: dict[str, Any] = {}
    for kind in ("hard", "soft"):
        which = seen.hidden(kind == "soft", composition)
        taken = np.bincount(seen.owner[which], np.abs(seen.luminance[which]), objects)
        order = np.argsort(taken)
        few = np.cumsum(taken[order]) <= 0.5 * rest * seen.total
        chosen[kind] = frozenset(int(k) for k in order[~few])
    return dataclasses.replace(composition, **chosen)


def _row(
    name: str,
    scene: Scene,
    seen: Pilot,
    stage: Stage,
    out: frozenset[str],
    replaced: dict[str, Difference],
    composition: Composition,
    settings: Any,
    shares: dict[str, float],
    fixed: bool,
) -> Row:
    included = name not in out and not (name in PATHS and reasons.absent(name, stage))
    bound: float | None
    if name in REPLACED:
        bound = replaced[name].bound if name in replaced else 0.0
        because = replaced[name].because if name in replaced else reasons.none(name)
    elif reasons.absent(name, stage):
        bound, because = 0.0, reasons.none(name)
    else:
        estimate, bound = seen.share(seen.lost([name]))
        because = reasons.text(name, estimate, bound, seen)
        if name == "matte-light":
            bound = None
    if fixed:
        because = f"as asked; {because}"
    words = reasons.words(name, scene, composition, settings) if included else ""
    return Row(name, included, because, bound, words, shares.get(name, 0.0) if included else 0.0)
