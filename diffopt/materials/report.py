"""What a material declares, measured: reciprocity, energy, density, lobes.

Everything is computed in float64, whatever the type of the parameters, on the same directions
in every call.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt.materials.base import Material
from diffopt.materials.interfaces import Dielectric, RoughDielectric

#: Angles to the normal at which albedos are measured, and azimuths from x, degrees.
ANGLES = (*np.arange(0.0, 75.0, 5.0), *np.arange(75.0, 89.0, 2.5), 89.0)
AZIMUTHS = (0.0, 90.0)
#: Angles to the normal at which the density is integrated, degrees.
PDF_ANGLES = (0.0, 30.0, 60.0, 80.0)
#: Random pairs of directions; half of them lie in the material's lobes.
PAIRS = 8192
#: Largest relative difference that counts as reciprocal: float64 rounding on steep lobes, and
#: tables whose entries are in float32.
RECIPROCAL = 1e-4
#: What an albedo may exceed 1 by, and the integral of a density differ from it: the error of
#: the albedo's quadrature on narrow lobes at grazing angles.
ENERGY, DENSITY = 2e-3, 1e-3

# Directions in one call of the density.
_BLOCK = 16384
# Values below this share of the largest are rounding, and no evidence.
_NEGLIGIBLE = 1e-12


@dataclasses.dataclass(frozen=True)
class Properties:
    """The property report of a material.

    Attributes
    ----------
    declared
        ``reciprocal``, ``conserves_energy``, ``delta`` and ``transmits``, as the material
        says.
    holds
        For each, and for ``pdf`` (the density integrates to 1), whether the measurement
        agrees; None where nothing was promised or nothing can be measured.
    reciprocity
        Largest |a - b| / max(a, b), a = f(wi, wo) and b = f(wo, wi), over random pairs and
        channels; in [0, 1] for values of one sign. None where f is 0 everywhere.
    reciprocity_at
        Angles of wi and wo to the normal where it is largest, degrees.
    energy
        Largest albedo over angles, azimuths and channels: the share of the light's power
        that leaves again, crossing included.
    energy_at
        Its angle to the normal and azimuth, degrees.
    energy_channel
        Its channel, 0 for a scalar material.
    angles, azimuths
        Of the albedos, degrees, [A] and [B].
    albedo
        Shares of power, [A, B, *C].
    pdf
        Integral of the density over the sphere at `pdf_angles` (degrees), [P]. 0 for delta
        lobes alone.
    pdf_angles
        Angles of the viewer, degrees, [P].
    pdf_error
        Estimated errors of the integrals, [P].
    """

    declared: dict[str, bool]
    holds: dict[str, bool | None]
    reciprocity: float | None
    reciprocity_at: tuple[float, float] | None
    energy: float
    energy_at: tuple[float, float]
    energy_channel: int
    angles: Float[np.ndarray, " A"]
    azimuths: Float[np.ndarray, " B"]
    albedo: Float[np.ndarray, "A B ..."]
    pdf: Float[np.ndarray, " P"]
    pdf_angles: Float[np.ndarray, " P"]
    pdf_error: Float[np.ndarray, " P"]

    @property
    def broken(self) -> tuple[str, ...]:
        """What was promised and does not hold."""
        return tuple(name for name, found in self.holds.items() if found is False)

    def as_json(self) -> dict[str, Any]:
        """Plain numbers and lists, for a JSON file; angles in degrees."""
        content = {key: getattr(self, key) for key in (f.name for f in dataclasses.fields(self))}
        return {
            key: value.tolist() if isinstance(value, np.ndarray) else value
            for key, value in content.items()
        }


def properties(material: Material, *, seed: int = 0) -> Properties:
    """Measure what a material promises.

    Parameters
    ----------
    material
        Any material; its parameters must be known, not traced.
    seed
        Of the random pairs.

    Returns
    -------
    Properties
        Energy is that of the light that comes from a direction, the integral of
        f(wi, wo) |cos_o| over wo. For a reciprocal material this is `Material.albedo`, and for
        interfaces that of the same with power in place of radiance; what else is not
        reciprocal is integrated over wo, its delta lobes left out.
    """
    with jax.enable_x64(True):
        material = material.typed(jnp.float64)
        declared = {
            "reciprocal": material.reciprocal,
            "conserves_energy": material.conserves_energy,
            "delta": material.delta,
            "transmits": material.transmits,
        }
        wi, wo, measured = _pairs(material, seed)
        difference, where = _asymmetry(material, wi, wo)
        albedo = _albedos(material)
        found = [_integrated(material, direction(angle)) for angle in PDF_ANGLES]
    energy = float(albedo.max())
    # Rounded, so that isotropic materials name the first azimuth.
    at = np.unravel_index(int(albedo.round(6).argmax()), albedo.shape)
    integrals = np.array([value for value, _ in found])
    smooth = not declared["delta"]
    holds: dict[str, bool | None] = {
        "reciprocal": _promise(declared["reciprocal"], difference, RECIPROCAL),
        "conserves_energy": _promise(declared["conserves_energy"], energy - 1.0, ENERGY),
        **{name: declared[name] == measured[name] for name in measured},
        "pdf": bool((np.abs(integrals - 1.0) <= DENSITY).all()) if smooth else None,
    }
    return Properties(
        declared=declared,
        holds=holds,
        reciprocity=difference,
        reciprocity_at=where,
        energy=energy,
        energy_at=(float(ANGLES[at[0]]), AZIMUTHS[at[1]]),
        energy_channel=int(at[2]) if len(at) > 2 else 0,
        angles=np.array(ANGLES, np.float64),
        azimuths=np.array(AZIMUTHS),
        albedo=albedo,
        pdf=integrals,
        pdf_angles=np.array(PDF_ANGLES),
        pdf_error=np.array([error for _, error in found]),
    )


def direction(angle: float, azimuth: float = 0.0) -> Float[np.ndarray, "3"]:
    """Unit vector at an angle to the normal and an azimuth from x, degrees."""
    a, b = math.radians(angle), math.radians(azimuth)
    return np.array([math.sin(a) * math.cos(b), math.sin(a) * math.sin(b), math.cos(a)])


def _pairs(material: Material, seed: int) -> tuple[np.ndarray, np.ndarray, dict[str, bool]]:
    """Random pairs on the material's hemisphere or sphere, and what its samples do."""
    rng = np.random.default_rng(seed)
    wi, wo = rng.normal(size=(2, PAIRS, 3))
    if not material.transmits:
        wi[:, 2], wo[:, 2] = np.abs(wi[:, 2]), np.abs(wo[:, 2])
    wi, wo = (w / np.linalg.norm(w, axis=-1, keepdims=True) for w in (wi, wo))
    sample = material.sample(jax.random.key(seed), wo)
    weight = np.asarray(sample.weight).reshape(PAIRS, -1)
    used = weight.max(-1) > 0.0
    drawn = np.asarray(sample.wi)
    crosses = bool((used & (drawn[:, 2] * wo[:, 2] < 0.0)).any())
    half = used & (np.arange(PAIRS) % 2 == 0)
    # Narrow lobes are all but missed by directions that know nothing of them.
    wi[half] = drawn[half] / np.linalg.norm(drawn[half], axis=-1, keepdims=True)
    return wi, wo, {"delta": bool(np.asarray(sample.delta).any()), "transmits": crosses}


def _asymmetry(
    material: Material, wi: np.ndarray, wo: np.ndarray
) -> tuple[float | None, tuple[float, float] | None]:
    """Largest relative difference of f and its transpose, and the angles of that pair."""
    a, b = (np.asarray(material.f(*pair)).reshape(len(wi), -1) for pair in ((wi, wo), (wo, wi)))
    larger = np.maximum(np.abs(a), np.abs(b))
    if not larger.max() > 0.0:
        return None, None
    counts = larger > _NEGLIGIBLE * larger.max()
    relative = np.where(counts, np.abs(a - b) / np.where(counts, larger, 1.0), 0.0).max(-1)
    worst = int(relative.argmax())
    at = [math.degrees(math.acos(float(np.clip(w[worst, 2], -1.0, 1.0)))) for w in (wi, wo)]
    return float(relative[worst]), (at[0], at[1])


def _albedos(material: Material) -> np.ndarray:
    """Shares of the power that leaves again, [A, B, *C]."""
    towards = np.stack([[direction(a, b) for b in AZIMUTHS] for a in ANGLES])
    if material.reciprocal or any(map(_interface, jax.tree.leaves(material, is_leaf=_interface))):
        return np.asarray(carrying_power(material).albedo(towards))
    return np.stack([[_outgoing(material, wi) for wi in row] for row in towards])


def carrying_power(material: Material) -> Material:
    """The material with light that crosses interfaces counted as power, not as radiance."""
    return jax.tree.map(
        lambda x: dataclasses.replace(x, radiance=False) if _interface(x) else x,
        material,
        is_leaf=_interface,
    )


def _interface(part: Any) -> bool:
    return isinstance(part, (Dielectric, RoughDielectric))


def _outgoing(material: Material, wi: np.ndarray) -> np.ndarray:
    """The integral of f(wi, wo) |cos_o| over wo, [*C]."""

    def values(wo: np.ndarray) -> np.ndarray:
        found = np.asarray(material.f(wi, wo))
        return found * np.abs(wo[:, 2]).reshape((-1,) + (1,) * (found.ndim - 1))

    drawn = material.sample(jax.random.key(1), np.broadcast_to(wi, (PAIRS, 3)))
    return over_sphere(_blocks(values), np.asarray(drawn.wi), tolerance=1e-6, most=300_000)[0]


def _integrated(material: Material, wo: np.ndarray) -> tuple[float, float]:
    """The integral of the density at a viewer over the sphere, and its estimated error."""
    drawn = material.sample(jax.random.key(1), np.broadcast_to(wo, (PAIRS, 3)))
    density = _blocks(lambda wi: np.asarray(material.pdf(wi, wo)))
    total, error = over_sphere(density, np.asarray(drawn.wi))
    return float(total), error


def _blocks(values: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """The same function in calls of one shape: one compilation."""

    def all_of(points: np.ndarray) -> np.ndarray:
        parts = []
        for first in range(0, len(points), _BLOCK):
            part = points[first : first + _BLOCK]
            block = np.tile([0.0, 0.0, 1.0], (_BLOCK, 1))
            block[: len(part)] = part
            parts.append(values(block)[: len(part)])
        return np.concatenate(parts)

    return all_of


def over_sphere(
    values: Callable[[np.ndarray], np.ndarray],
    near: Float[np.ndarray, "S 3"],
    *,
    tolerance: float = 1e-7,
    most: int = 2_000_000,
) -> tuple[Float[np.ndarray, "..."], float]:
    """Integral over the unit sphere by adaptive cells, [*C], and its estimated error.

    Cells lie on the faces of a cube; 5 x 5 nodes of Gauss's rule in each are compared with
    those of its quarters until they agree. The horizon z = 0 is an edge of cells, so that a
    step there costs nothing.

    Parameters
    ----------
    values
        Function of unit vectors [n, 3], giving [n, *C].
    near
        Unit vectors where narrow lobes lie; cells are small there from the start.
    tolerance
        Of each cell, absolute.
    most
        Nodes at which refinement stops; the estimated error tells.
    """
    corners = np.linspace(-1.0, 0.5, 4)
    grid = np.stack(np.meshgrid(np.arange(6.0), corners, corners, indexing="ij"), -1)
    cells = np.concatenate([grid.reshape(-1, 3), np.full((96, 1), 0.5)], -1)
    # Enough to find every lobe that holds a tenth of the samples.
    at = _on_cube(near[:: max(1, len(near) // 512)])
    for _ in range(10):
        inside = (at[None, :, 1:] >= cells[:, None, 1:3]) & (
            at[None, :, 1:] < cells[:, None, 1:3] + cells[:, None, 3:]
        )
        held = (inside.all(-1) & (at[None, :, 0] == cells[:, None, 0])).sum(-1)
        crowded = held > len(at) // 32
        cells = np.concatenate([cells[~crowded], _quarters(cells[crowded])])
    coarse = _by_gauss(values, cells)
    total, error, used = np.zeros(coarse.shape[1:]), 0.0, 25 * len(cells)
    while len(cells):
        children = _quarters(cells)
        fine = _by_gauss(values, children).reshape(-1, 4, *coarse.shape[1:])
        used += 25 * len(children)
        off = np.abs(fine.sum(1) - coarse).reshape(len(cells), -1).max(-1)
        rough = (off > tolerance) & (used < most)
        total = total + fine[~rough].sum((0, 1))
        error += float(off[~rough].sum())
        cells = children.reshape(-1, 4, 4)[rough].reshape(-1, 4)
        coarse = fine[rough].reshape(-1, *coarse.shape[1:])
    return np.asarray(total), error


def _on_cube(directions: np.ndarray) -> np.ndarray:
    """Face and the two coordinates on it in [-1, 1], [n, 3]."""
    axis = np.abs(directions).argmax(-1)
    along, u, v = (
        np.take_along_axis(directions, ((axis + k) % 3)[:, None], -1)[:, 0] for k in range(3)
    )
    return np.stack([2 * axis + (along < 0.0), u / np.abs(along), v / np.abs(along)], -1)


def _quarters(cells: np.ndarray) -> np.ndarray:
    """The four parts of each cell (face, u, v, width), one after the other."""
    steps = np.array([[0.0, i, j, 0.0] for i in (0.0, 0.5) for j in (0.0, 0.5)])
    parts = cells[:, None] * [1.0, 1.0, 1.0, 0.5] + steps * cells[:, None, 3:]
    return parts.reshape(-1, 4)


def _by_gauss(values: Callable[[np.ndarray], np.ndarray], cells: np.ndarray) -> np.ndarray:
    """The integral over each cell."""
    x, w = np.polynomial.legendre.leggauss(5)
    x, w = 0.5 * (x + 1.0), 0.5 * w
    shape = (len(cells), 5, 5)
    u = np.broadcast_to((cells[:, 1:2] + cells[:, 3:] * x)[:, :, None], shape).ravel()
    v = np.broadcast_to((cells[:, 2:3] + cells[:, 3:] * x)[:, None, :], shape).ravel()
    face = np.repeat(cells[:, 0].astype(int), 25)
    axis, rows = face // 2, np.arange(len(face))
    points = np.empty((len(face), 3))
    points[rows, axis] = 1.0 - 2.0 * (face % 2)
    points[rows, (axis + 1) % 3], points[rows, (axis + 2) % 3] = u, v
    length2 = 1.0 + u * u + v * v
    found = values(points / np.sqrt(length2)[:, None])
    weights = np.outer(w, w).ravel() * cells[:, 3:] ** 2 * length2.reshape(-1, 25) ** -1.5
    return np.einsum("nk,nk...->n...", weights, found.reshape(-1, 25, *found.shape[1:]))


def _promise(declared: bool, excess: float | None, tolerance: float) -> bool | None:
    return excess <= tolerance if declared and excess is not None else None
