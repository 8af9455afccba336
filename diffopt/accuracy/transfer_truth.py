"""What precomputed transfer should give: reflected light, and its moments, by brute force.

Directions are drawn at every point by the reflectance's formula and by the light, and followed
to a second surface. Written in NumPy from the formulas of Lambert and of Blinn and Phong, in
float64; only the rays are cast by the same code as everywhere. Every number has a standard error.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from diffopt.accuracy.transfer_scenes import Bright, Subject, densities
from diffopt.errors import InputError
from diffopt.materials import BlinnPhong, Lambert, Material, Sum
from diffopt.scenes import raycasting
from diffopt.scenes.raycasting import Caster
from diffopt.scenes.scene import Scene
from diffopt.scenes.textures import Textured

# Paths followed at a time.
_PATHS = 2**18
# Sets of paths of a point, each spread evenly on its own: the error is that of their mean.
_SETS = 8
# Steps of evenly spread numbers in four dimensions; the third goes through strata.
_STEPS = (0.7548776662466927, 0.6180339887498949, 0.0, 0.5698402909980532)


class Points(NamedTuple):
    """Surface points as a viewer sees them.

    Attributes
    ----------
    position, geometric, normal
        In the world, normals towards the viewer, [n, 3].
    wo
        Unit vectors to the viewer, [n, 3].
    material
        Lambert's albedo, the factor of (n.h)^e, and e, [n, 3].
    """

    position: Float[np.ndarray, "n 3"]
    geometric: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    wo: Float[np.ndarray, "n 3"]
    material: Float[np.ndarray, "n 3"]

    def some(self, rows: np.ndarray) -> "Points":
        """Chosen ones."""
        return Points(*(a[rows] for a in self))


class Estimate(NamedTuple):
    """Means over paths and their standard errors, [n]."""

    value: Float[np.ndarray, " n"]
    error: Float[np.ndarray, " n"]


class Paths(NamedTuple):
    """A block of paths.

    Attributes
    ----------
    row
        Point of each, [m].
    group
        Which set of paths of its point, [m].
    direct, towards
        Weight and direction where it leaves the scene at once, [m], [m, 3].
    diffuse, glossy, later
        Weights by the term that reflected it last, and the direction in which it then leaves.
    """

    row: Int[np.ndarray, " m"]
    group: Int[np.ndarray, " m"]
    direct: Float[np.ndarray, " m"]
    towards: Float[np.ndarray, "m 3"]
    diffuse: Float[np.ndarray, " m"]
    glossy: Float[np.ndarray, " m"]
    later: Float[np.ndarray, "m 3"]


def formula(material: Material | Textured) -> tuple[float, float, float]:
    """Lambert's albedo, the factor of (n.h)^e, and e, of a grey material."""
    if isinstance(material, Lambert):
        return float(np.asarray(material.colour)), 0.0, 1.0
    if isinstance(material, BlinnPhong):
        e = float(np.asarray(material.exponent))
        factor = float(np.asarray(material.colour))
        if material.normalised:
            factor *= (e + 2.0) * (e + 4.0) / (8.0 * np.pi * (2.0 ** (-0.5 * e) + e))
        return 0.0, factor, e
    if isinstance(material, Sum) and len(material.parts) == 2:
        (d, _, _), (_, factor, e) = (formula(part) for part in material.parts)
        return d, factor, e
    raise InputError(
        f"the truth of transfer is for Lambert, Blinn-Phong, and their sum; received "
        f"{type(material).__name__}"
    )


class Surfaces:
    """The triangles of a scene of grey materials, as the truth sees them."""

    def __init__(self, scene: Scene) -> None:
        geometry = scene.geometry
        shapes = geometry.world
        triangles, spheres, discs = shapes.counts
        if spheres + discs:
            raise InputError("the truth of transfer is for triangles; received spheres or discs")
        self.caster: Caster = raycasting.caster(geometry)
        self.corners = np.asarray(shapes.vertices, np.float64)[np.asarray(shapes.faces)[:triangles]]
        self.normals = np.asarray(shapes.normals, np.float64)[np.asarray(shapes.faces)[:triangles]]
        known = np.array([formula(one.material) for one in scene.objects])
        self.material = known[geometry.owner[:triangles]]

    def met(
        self,
        primitive: np.ndarray,
        u: np.ndarray,
        v: np.ndarray,
        wo: Float[np.ndarray, "n 3"],
    ) -> tuple[Points, Bool[np.ndarray, " n"]]:
        """Points of triangles, and whether their fronts are seen."""
        shares = np.stack([1.0 - u - v, u, v], -1).astype(np.float64)[:, :, None]
        corners = self.corners[primitive]
        normal = _unit((shares * self.normals[primitive]).sum(1))
        flat = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
        side = np.where((flat * wo).sum(-1) < 0.0, -1.0, 1.0)[:, None]
        point = (shares * corners).sum(1)
        points = Points(point, side * flat, side * normal, wo, self.material[primitive])
        return points, side[:, 0] > 0.0


def seen(subject: Subject) -> tuple[Int[np.ndarray, " n"], Points]:
    """Pixels whose middle sees the front of a surface, and the points that they see."""
    rows, columns = subject.camera.shape
    origin, towards = subject.camera.rays(np.arange(rows * columns), 0.5)
    around = Surfaces(subject.scene)
    hits = around.caster.first(origin, towards)
    on = np.flatnonzero(hits.primitive >= 0)
    points, front = around.met(hits.primitive[on], hits.u[on], hits.v[on], -towards[on])
    return on[front], points.some(np.flatnonzero(front))


def paths(
    scene: Scene,
    points: Points,
    count: int,
    light: Bright | None = None,
    seed: int = 0,
    near: float = 0.0,
) -> Iterator[Paths]:
    """Paths from points, `count` from each; sums of weights over `count` are integrals.

    First directions are spread evenly within each of eight sets.

    Parameters
    ----------
    scene
        Of grey Lambert and Blinn-Phong.
    points
        Where they begin.
    count
        From each, a multiple of 8.
    light
        If given, directions are drawn from it as well, and the weights stay right.
    seed
        Of the random numbers.
    near
        Hits nearer than this count as the surface itself: dark.
    """
    if count < _SETS or count % _SETS:
        raise InputError(f"count must be a multiple of {_SETS}; received {count}")
    around = Surfaces(scene)
    generator = np.random.default_rng(seed)
    total, each = len(points.wo) * count, count // _SETS
    shift = generator.random((len(points.wo), _SETS, 4))
    for start in range(0, total, _PATHS):
        number = np.arange(start, min(start + _PATHS, total))
        row, group, place = number // count, number % count // each, number % each
        at = points.some(row)
        even = place[:, None] * np.array([_STEPS]) + shift[row, group]
        even[:, 2] += place / each
        towards, f = _scattered(even % 1.0, at, light)
        weight = f.sum(-1)
        alive = weight > 0.0
        hits = around.caster.first(_lifted(around, at), towards)
        free = hits.primitive < 0
        diffuse, glossy = np.zeros((2, len(row)))
        out = Paths(row, group, weight * (alive & free), towards, diffuse, glossy, towards)
        on = np.flatnonzero(alive & ~free & (hits.distance > near))
        if len(on):
            met, _ = around.met(hits.primitive[on], hits.u[on], hits.v[on], -towards[on])
            then, more = _scattered(generator.random((len(on), 4)), met, light)
            far = np.full(len(on), np.inf)
            hidden = around.caster.blocked(_lifted(around, met), then, far)
            more *= (weight[on] * ~hidden)[:, None]
            later = towards.copy()
            later[on] = then
            out.diffuse[on], out.glossy[on] = more.T
            out = out._replace(later=later)
        yield out


def radiance(
    scene: Scene, points: Points, light: Bright, count: int = 256, seed: int = 0
) -> Estimate:
    """Radiance of points towards their viewers: direct light and one interreflection."""
    n = len(points.wo)
    sums = np.zeros(n * _SETS)
    for block in paths(scene, points, count, light, seed):
        each = block.direct * light.radiance(block.towards)
        each += (block.diffuse + block.glossy) * light.radiance(block.later)
        sums += np.bincount(block.row * _SETS + block.group, each, n * _SETS)
    means = sums.reshape(n, _SETS) * (_SETS / count)
    return Estimate(means.mean(1), means.std(1, ddof=1) / np.sqrt(_SETS))


def moments(
    scene: Scene, points: Points, count: int, seed: int = 0, near: float = 0.0
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 3"]]:
    """Integrals [n, 3] and first moments [n, 3, 3] of slices by kind of path, in the world."""
    n = len(points.wo)
    whole, first = np.zeros((n, 3)), np.zeros((n, 3, 3))
    for block in paths(scene, points, count, None, seed, near):
        kinds = ((block.direct, block.towards), (block.diffuse, block.later))
        for k, (weight, way) in enumerate((*kinds, (block.glossy, block.later))):
            whole[:, k] += np.bincount(block.row, weight, n)
            for i in range(3):
                first[:, k, i] += np.bincount(block.row, weight * way[:, i], n)
    return whole / count, first / count


def _lifted(around: Surfaces, points: Points) -> np.ndarray:
    return points.position + around.caster.offset * points.geometric


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300)


def _scattered(
    u: Float[np.ndarray, "n 4"], at: Points, light: Bright | None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 2"]]:
    """Directions, and f cos over their density of the diffuse and of the glossy term.

    Each is drawn by one of the cosine, the half vector, and the light, and weighed by the mean
    of their densities.
    """
    diffuse, factor, exponent = at.material.T
    lobes = None if light is None else light.lobes
    ways = np.stack([diffuse > 0.0, factor > 0.0, np.full(len(diffuse), lobes is not None)], -1)
    number = np.maximum(ways.sum(-1), 1)
    pick = np.minimum((u[:, 0] * number).astype(int), number - 1)
    way = (np.cumsum(ways, -1) <= pick[:, None]).sum(-1)
    turn, share = 2.0 * np.pi * u[:, 1], u[:, 2]
    even = _around(at.normal, np.sqrt(1.0 - share), turn)
    half = _around(at.normal, share ** (1.0 / (exponent + 1.0)), turn)
    towards = 2.0 * (half * at.wo).sum(-1, keepdims=True) * half - at.wo
    towards = np.where((way == 0)[:, None], even, towards)
    if lobes is not None:
        rows = np.flatnonzero(way == 2)
        towards[rows] = _drawn(lobes, u[rows, 1:])
    cosine = (towards * at.normal).sum(-1)
    middle = _unit(towards + at.wo)
    up = np.maximum((middle * at.normal).sum(-1), 0.0)
    lobe = up**exponent
    along = np.maximum((middle * at.wo).sum(-1), 1e-9)
    density = ways[:, 0] * np.maximum(cosine, 0.0) / np.pi
    density = density + ways[:, 1] * (exponent + 1.0) / (8.0 * np.pi) * lobe / along
    if lobes is not None:
        alpha, mu, kappa = lobes
        density = density + densities(towards, mu, kappa) @ (alpha / alpha.sum())
    fine = (cosine > 0.0) & ((towards * at.geometric).sum(-1) > 0.0) & (density > 0.0)
    fine &= (at.wo * at.normal).sum(-1) > 0.0
    scale = np.where(fine, cosine * number / np.where(fine, density, 1.0), 0.0)
    return towards, np.stack([diffuse / np.pi * scale, factor * lobe * scale], -1)


def _drawn(lobes: tuple[np.ndarray, ...], u: Float[np.ndarray, "n 3"]) -> np.ndarray:
    alpha, mu, kappa = lobes
    ends = np.cumsum(alpha) / alpha.sum()
    which = np.minimum(np.searchsorted(ends, u[:, 2]), len(alpha) - 1)
    k = kappa[which]
    cosine = 1.0 + np.log1p(u[:, 1] * np.expm1(-2.0 * k)) / k
    return _around(mu[which], np.clip(cosine, -1.0, 1.0), 2.0 * np.pi * u[:, 0])


def _around(axis: np.ndarray, cosine: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Directions at a cosine and azimuth about axes."""
    least = np.eye(3)[np.argmin(np.abs(axis), -1)]
    one = _unit(np.cross(axis, least))
    other = np.cross(axis, one)
    sine = np.sqrt(np.maximum(1.0 - cosine * cosine, 0.0))
    across = np.cos(turn)[:, None] * one + np.sin(turn)[:, None] * other
    return sine[:, None] * across + cosine[:, None] * axis
