"""What accuracy costs for fits of von Mises-Fisher lobes: their number, steps, nodes.

The functions are slices of Blinn and Phong's BRDF, ``(n.h)^e cos``, which errors are judged on
with NumPy in float64 on a finer quadrature of its own, so that nothing of the fit is trusted.
Times are of the fit, from values at the nodes on.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.accuracy.studies import Case, Job, Study
from diffopt.fitting.lobe_settings import LobeSettings
from diffopt.fitting.lobe_targets import grids
from diffopt.fitting.lobes import LobeFit, Method, Nodes, fit_nodes

EXPONENTS = (4.0, 32.0, 128.0)
VIEWS = (0.0, 30.0, 60.0, 80.0)
_PROBLEMS = [(exponent, degrees) for exponent in EXPONENTS for degrees in VIEWS]
# Of the quadrature that judges.
_FINE = (96, 144)
_SLICES = "mean relative L2 error over the sphere of 12 slices (Blinn-Phong's exponents 4, 32, 128"
_SLICES += " at 0, 30, 60, 80 degrees)"


class Slice(NamedTuple):
    """A function at the nodes of a quadrature, in float64.

    Attributes
    ----------
    directions, solid_angles, values
        [N, 3], [N] and [N].
    """

    directions: Float[np.ndarray, "N 3"]
    solid_angles: Float[np.ndarray, " N"]
    values: Float[np.ndarray, " N"]

    def error(self, alpha: Any, mu: Any, kappa: Any) -> float:
        """Relative L2 error of a sum of lobes."""
        alpha, mu, kappa = (np.asarray(a, np.float64) for a in (alpha, mu, kappa))
        peak = -kappa / (2.0 * np.pi * np.expm1(-2.0 * kappa))
        lobes = np.exp(kappa * (self.directions @ mu.T - 1.0))
        missed = lobes @ (alpha * peak) - self.values
        weights = self.solid_angles
        return float(np.sqrt((weights @ missed**2) / (weights @ self.values**2)))


@functools.cache
def truth(exponent: float, degrees: float) -> Slice:
    """The slice ``(n.h)^e cos`` at a viewing angle, on fine nodes about its mean direction."""
    axis = _view(degrees) * [-1.0, 1.0, 1.0]
    found = None
    for _ in range(2):  # about the mirrored view, then about the mean
        directions, solid = _polar(axis)
        found = Slice(directions, solid, _blinn(directions, exponent, degrees))
        mean = (solid * found.values) @ directions
        axis = mean / np.linalg.norm(mean)
    assert found is not None
    return found


def _view(degrees: float) -> np.ndarray:
    t = np.radians(degrees)
    return np.array([np.sin(t), 0.0, np.cos(t)])


def _blinn(wi: np.ndarray, exponent: float, degrees: float) -> np.ndarray:
    half = wi + _view(degrees)
    cos = half[:, 2] / np.maximum(np.linalg.norm(half, axis=-1), 1e-12)
    return np.maximum(cos, 0.0) ** exponent * np.maximum(wi[:, 2], 0.0)


def _polar(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gauss's rule in the sine of half the angle to an axis in the plane y = 0."""
    x, dx = np.polynomial.legendre.leggauss(_FINE[0])
    x, dx = 0.5 + 0.5 * x, 0.5 * dx
    phi = (np.arange(_FINE[1]) + 0.5) * 2.0 * np.pi / _FINE[1]
    cos, sin = 1.0 - 2.0 * x * x, 2.0 * x * np.sqrt(1.0 - x * x)
    first, second = np.array([axis[2], 0.0, -axis[0]]), np.array([0.0, 1.0, 0.0])
    around = np.cos(phi)[:, None] * first + np.sin(phi)[:, None] * second
    directions = sin[:, None, None] * around + cos[:, None, None] * axis
    return directions.reshape(-1, 3), np.repeat(8.0 * np.pi / _FINE[1] * x * dx, _FINE[1])


def _nodes(settings: LobeSettings) -> Nodes:
    """All twelve slices on the nodes that `fit_lobes` would take."""
    given = [truth(*problem) for problem in _PROBLEMS]
    directions = jnp.asarray(np.stack([g.directions for g in given]), "float32")
    # Of the square, as there: that is what the error weighs.
    weights = jnp.asarray(np.stack([g.solid_angles * g.values**2 for g in given]), "float32")
    found = jax.jit(jax.vmap(functools.partial(grids, settings=settings)))(directions, weights)

    def known(directions: Array, solid_angles: Array, coarse: Nodes | None = None) -> Nodes:
        pairs = zip(np.asarray(directions, np.float64), _PROBLEMS, strict=True)
        values = np.stack([_blinn(wi, *problem) for wi, problem in pairs])
        return Nodes(directions, solid_angles, jnp.asarray(values[..., None], "float32"), coarse)

    (fine, solid), coarse, _ = found
    return known(fine, solid, known(*coarse))


def _judge_slices(value: LobeFit) -> tuple[float, str]:
    lobes = value.lobes.alpha, value.lobes.mu, value.lobes.kappa
    errors = np.array([truth(*p).error(*each) for p, *each in zip(_PROBLEMS, *lobes, strict=True)])
    by_exponent = errors.reshape(len(EXPONENTS), -1).mean(1)
    shown = ", ".join(f"{e:g}: {v:.2g}" for e, v in zip(EXPONENTS, by_exponent, strict=True))
    own = float(np.mean(value.error))
    return float(
        errors.mean()
    ), f"by exponent {shown}; worst {errors.max():.2g}; on its own nodes {own:.2g}"


def _slices_case(
    named: dict[str, Any], lobes: int, method: Method = "em+lm", **settings: Any
) -> Case:
    chosen = LobeSettings(**settings)

    def build():
        nodes = _nodes(chosen)
        run = functools.partial(fit_nodes, lobes=lobes, method=method, settings=chosen)
        return Job(run, (nodes,), _judge_slices)

    return Case(named, "float32", build)


def _counts(quick: bool) -> list[Case]:
    counts = (1, 4) if quick else (1, 2, 4, 8, 16)
    return [_slices_case({"lobes": lobes}, lobes) for lobes in counts]


COUNT = Study(
    name="lobes.count",
    quantity=f"number of lobes: {_SLICES}; time of all 12",
    reference="the slices in float64 on 96 x 144 nodes",
    cases=_counts,
)


def _steps(quick: bool) -> list[Case]:
    """EM alone, and a few of its steps with least squares after them; four lobes."""

    def case(em, lm):
        method = "em+lm" if lm else "em"
        named = {"em_steps": em, "lm_steps": lm}
        return _slices_case(named, 4, method, em_steps=em, lm_steps=lm)

    alone, after = ((1000,), (5,)) if quick else ((5, 10, 50, 300, 1000), (3, 5, 10, 50))
    return [*(case(em, 0) for em in alone), *(case(10, lm) for lm in after)]


STEPS = Study(
    name="lobes.steps",
    quantity="steps of EM alone, or of Levenberg-Marquardt after 10 of EM and 20 coarse ones; 4 "
    f"lobes, {_SLICES}; time of all 12",
    reference="the slices in float64 on 96 x 144 nodes",
    cases=_steps,
)


def _quadratures(quick: bool) -> list[Case]:
    sizes = (8, 32) if quick else (8, 12, 16, 24, 32, 48)
    grids = [(rings, rings * 3 // 2) for rings in sizes]
    return [_slices_case({"rings": r, "sectors": s}, 4, rings=r, sectors=s) for r, s in grids]


QUADRATURE = Study(
    name="lobes.quadrature",
    quantity=f"rings x sectors of the nodes that 4 lobes are fitted on: {_SLICES}; time of all 12",
    reference="the slices in float64 on 96 x 144 nodes",
    cases=_quadratures,
)
