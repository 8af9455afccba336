"""Which starts a fit to reflectance compares, solves from, and finishes."""

import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.fitting.reflectance import forward, starts
from diffopt.fitting.reflectance.answers import Minimum
from diffopt.fitting.reflectance.maps import Bounds
from diffopt.fitting.reflectance.settings import FitSettings
from diffopt.fitting.reflectance.templates import lattice
from diffopt.gratings import Surface
from diffopt.gratings.parametric import kinds

# Ends this far apart in unbounded parameters are different minima.
_APART = 0.02
_MOST_POINTS = 1024
# Vectors that are tried as the first of two.
_FIRSTS = 4


def tried(
    job: forward.Job, like: Surface, box: Bounds, settings: FitSettings, coherence: float
) -> np.ndarray:
    """Parameters of all starts to compare, [S, P].

    S does not depend on the data, so that programs are shared.

    Raises
    ------
    InputError
        If the surface has a period and all data lie within the mirror's peak.
    """
    paths, names = lattice(like), box.names
    own = [path for pair in paths for path in pair]
    others = [k for k, name in enumerate(names) if name not in own]
    count = min(settings.design * 2 ** max(len(others) - 1, 0), _MOST_POINTS)
    points = starts.halton(count, max(len(others), 1))
    design = np.zeros((len(points), len(names)))
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    for column, k in enumerate(others):
        design[:, k] = _spread(names[k], box.shapes[k], low[k], high[k], points[:, column])
    if not paths:
        return design
    vectors = starts.lattices(job, coherence, settings.lattices)
    if not len(vectors):
        raise InputError(
            "measured: expected light away from the mirror direction to take a period from; "
            "received frequencies within the mirror's peak only. Give a start"
        )
    ways = 1 if like.symmetric else 2
    if len(paths) > 1:
        most = 2 * settings.lattices
        groups = _pairs(job, coherence, vectors, most)
    else:
        most = ways * settings.lattices
        groups = [(way * vector,) for vector in vectors for way in (1.0, -1.0)[:ways]]
    out = []
    for group in groups:
        block = design.copy()
        for (period, angle), vector in zip(paths, group, strict=True):
            for path, value in (
                (period, 1.0 / math.hypot(*vector)),
                (angle, math.atan2(vector[1], vector[0])),
            ):
                if path in names:
                    block[:, names.index(path)] = value
        out.append(block)
    out += [out[0]] * (most - len(out))
    return np.concatenate(out)


def around(
    like: Surface, box: Bounds, head: str, inner: list[dict[str, float]], count: int
) -> np.ndarray:
    """Starts about fits of the surface within, [count len(inner), P].

    What spreads lines takes from their peaks: heights within are up to twice as large.

    Parameters
    ----------
    like, box
        The whole surface.
    head, inner
        Name of the surface within, and its parameters where fits of it alone ended.
    count
        Points of the other parameters for each of these.
    """
    names, every = box.names, kinds(like)
    low, high = np.asarray(box.low, float), np.asarray(box.high, float)
    varied = [
        k
        for k, name in enumerate(names)
        if not name.startswith(f"{head}.") or every[name] == "height"
    ]
    points = starts.halton(count, len(varied))
    out = np.zeros((len(inner), count, len(names)))
    for block, found in zip(out, inner, strict=True):
        for k, name in enumerate(names):
            block[:, k] = found.get(name.removeprefix(f"{head}."), 1.0)
        for column, k in enumerate(varied):
            if names[k].startswith(f"{head}."):
                block[:, k] = np.minimum(block[:, k] * 2.0 ** points[:, column], high[k])
            else:
                shape = box.shapes[k]
                block[:, k] = _spread(names[k], shape, low[k], high[k], points[:, column])
    return out.reshape(-1, len(names))


def _spread(name: str, shape: str, low: float, high: float, t: np.ndarray) -> np.ndarray:
    """Values of a parameter over the part of its range where starts are worth it."""
    last = name.split(".")[-1]
    if shape == "share":
        # Ridges of duty d and 1 - d reflect alike.
        top = 0.5 if last in ("duty", "width") else high
        return low + (top - low) * (0.05 + 0.9 * t)
    if last in ("depth", "amplitude", "height"):
        # Even in the depth itself: phases, and minima, are.
        return high * (0.02 + 0.6 * t)
    return low * (high / low) ** (0.2 + 0.6 * t)


def _pairs(
    job: forward.Job, coherence: float, vectors: np.ndarray, most: int
) -> list[tuple[Any, ...]]:
    """Lattices of two vectors: the second from what lines of the first leave."""
    found: list[tuple[Any, ...]] = []
    for first in vectors[:_FIRSTS]:
        others = starts.second(job, coherence, first, most // _FIRSTS)
        found += [(first, other) for other in others]
    if not found:
        a = vectors[0]
        found = [(a, np.array([-a[1], a[0]]))]
    return found[:most]


def diverse(loss: np.ndarray, count: int, groups: int) -> np.ndarray:
    """The best starts, no more than a third of them from one of so many lattices."""
    loss = np.nan_to_num(loss, nan=np.inf)
    size = max(len(loss) // max(groups, 1), 1) if groups else 1
    most = max(math.ceil(count / 3), 1) if groups else count
    taken: dict[int, int] = {}
    chosen = []
    for k in np.argsort(loss):
        group = int(k) // size
        if taken.get(group, 0) < most:
            taken[group] = taken.get(group, 0) + 1
            chosen.append(int(k))
        if len(chosen) == count:
            break
    # Always the same number, so that programs are shared.
    return np.array((chosen * math.ceil(count / len(chosen)))[:count])


def finalists(y: np.ndarray, loss: np.ndarray, count: int) -> np.ndarray:
    """The best ends that differ from each other; repeated where few are near the best."""
    chosen: list[int] = []
    for k in np.argsort(loss):
        if chosen and loss[k] > 1.5 * loss[chosen[0]] + 1e-6:
            break
        if all(np.abs(y[k] - y[j]).max() > _APART for j in chosen):
            chosen.append(int(k))
        if len(chosen) == count:
            break
    return np.array((chosen * count)[:count])


def minima(y: np.ndarray, loss: np.ndarray, box: Bounds) -> tuple[Minimum, ...]:
    """Distinct places where solves ended, best first."""
    found: list[Minimum] = []
    order = np.argsort(loss)
    left = list(order[np.isfinite(loss[order])])
    while left:
        first = left[0]
        near = [k for k in left if np.abs(y[k] - y[first]).max() < _APART]
        values = np.asarray(box.values(jnp.asarray(y[first])))
        parameters = dict(zip(box.names, values.tolist(), strict=True))
        found.append(Minimum(parameters, float(loss[first]), len(near)))
        left = [k for k in left if k not in near]
    return tuple(found)
