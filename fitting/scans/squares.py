"""Least squares of a surface on a scan: plane and line offsets are eliminated in closed form.

The heights are z = h(theta) + plane + offset of the line + noise. For given weights of the
pixels the plane (free) and the offsets (with a Gaussian prior) are linear, and projecting them
out of residuals and Jacobian leaves a problem in theta alone (variable projection: Golub and
Pereyra 1973; for linear parts with fixed weights the projected Jacobian is exact). Outliers
lose weight by Cauchy's function, in rounds.
"""

import dataclasses
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.fitting.scans.codes import decoded, encoded, field, free
from diffopt.fitting.scans.descent import descended
from diffopt.fitting.scans.register import Scan
from diffopt.gratings import Parametric
from diffopt.gratings.parametric import kinds

# Cauchy's constant: 95 % of the efficiency of least squares under Gaussian noise.
_CAUCHY = 2.385
# Precision of line offsets, in pixels, that leaves none.
_NONE = 1e12
_ROUNDS = 8
# Rounds end where no parameter moves by this much of its standard error under white noise.
_STILL = 0.02


class Pixels(eqx.Module):
    """What the residuals are made of besides parameters: values are traced.

    Attributes
    ----------
    heights
        Over `scale`.
    weight
        Of each pixel; 0 where missing.
    precision
        Variance of the noise over that of line offsets.
    y, x
        Micrometres.
    scale
        Micrometres.
    """

    heights: Float[Array, "ny nx"]
    weight: Float[Array, "ny nx"]
    precision: Float[Array, ""]
    y: Float[Array, " ny"]
    x: Float[Array, " nx"]
    scale: Float[Array, ""]


def project(
    values: Float[Array, "ny nx"], pixels: Pixels
) -> tuple[Float[Array, "ny nx"], Float[Array, " ny"], Float[Array, " 3"]]:
    """Remove plane and line offsets: what is left, the offsets, and (constant, y, x) slopes.

    Slopes are per half a side.
    """
    w, total = pixels.weight, pixels.weight.sum(1) + pixels.precision
    one = jnp.ones_like(values)
    basis = jnp.stack(
        [
            one,
            one * (pixels.y / jnp.abs(pixels.y).max())[:, None],
            one * (pixels.x / jnp.abs(pixels.x).max())[None, :],
        ]
    )
    means = (w[None] * basis).sum(2) / total[None]
    reduced = w[None] * (basis - means[:, :, None])
    matrix = jnp.einsum("ayx,byx->ab", reduced, basis, precision="highest")
    right = jnp.einsum("ayx,yx->a", reduced, values, precision="highest")
    plane = jnp.linalg.solve(matrix, right)
    rest = values - jnp.einsum("a,ayx->yx", plane, basis, precision="highest")
    lines = (w * rest).sum(1) / total
    return rest - lines[:, None], lines, plane


def heights(
    pixels: Pixels,
    surface: Parametric,
    names: tuple[str, ...],
    pixel: tuple[float, float],
    edges: str,
    u: Float[Array, " P"],
) -> Float[Array, "ny nx"]:
    """Heights of a surface with encoded parameters, over the scale."""
    moved = decoded(u, surface, names, pixels.scale)
    return field(moved, pixels.y, pixels.x, pixel, edges) / pixels.scale


def residuals(
    u: Float[Array, " P"],
    pixels: Pixels,
    surface: Parametric,
    names: tuple[str, ...],
    pixel: tuple[float, float],
    edges: str,
) -> tuple[Float[Array, " N"], Float[Array, "P N"]]:
    """Weighted residuals, those of the offsets' prior, and the rows of their Jacobian."""

    def rows(values: Array) -> Array:
        rest, lines, _ = project(values, pixels)
        prior = jnp.sqrt(pixels.precision) * lines
        return jnp.concatenate([(jnp.sqrt(pixels.weight) * rest).ravel(), prior])

    value, derivative = jax.linearize(partial(heights, pixels, surface, names, pixel, edges), u)
    jacobian = jax.lax.map(lambda t: rows(-derivative(t)), jnp.eye(u.size, dtype=u.dtype))
    return rows(pixels.heights - value), jacobian


@eqx.filter_jit
def _squares(
    u: Array,
    pixels: Pixels,
    surface: Parametric,
    names: tuple[str, ...],
    pixel: tuple[float, float],
    edges: str,
    left: Array,
    steps: int,
) -> tuple[Array, Array, Array, Array, Array, Array]:
    tolerance = 1e-7 if u.dtype == jnp.float64 else 1e-4

    def function(v: Array, args: Pixels) -> tuple[Array, Array]:
        return residuals(v, args, surface, names, pixel, edges)

    u, matrix, count, ended, losses = descended(
        function, u, pixels, left, tolerance=tolerance, steps=steps
    )
    fitted = heights(pixels, surface, names, pixel, edges, u) * pixels.scale
    return u, fitted, matrix, count, ended, losses


@eqx.filter_jit
def _rest(fitted: Array, pixels: Pixels) -> tuple[Array, Array, Array]:
    return project(pixels.heights - fitted / pixels.scale, pixels)


@dataclasses.dataclass
class Squares:
    """A fit by least squares; lengths in micrometres.

    Attributes
    ----------
    surface
        With fitted parameters, offset 0 (the constant is that of the plane).
    names, u
        Free parameters and their encoded numbers.
    matrix
        Normal equations of the encoded numbers, heights over scale.
    plane
        Constant, slope along y, slope along x.
    lines
        Offset of each line.
    rest
        [ny, nx], scan less surface, plane and offsets.
    weight
        [ny, nx].
    precision
        See `Pixels`.
    steps, converged
        Of Levenberg and Marquardt in all rounds, and whether they came to an end.
    inflation
        Variance that the loss of weight adds, um^2.
    curve
        [steps], least loss of the round up to each trial step: mean over the known pixels of
        the weighted squared residuals, um^2, those of the prior of line offsets among them.
    """

    surface: Parametric
    names: tuple[str, ...]
    u: np.ndarray
    matrix: np.ndarray
    plane: np.ndarray
    lines: np.ndarray
    rest: np.ndarray
    weight: np.ndarray
    precision: float
    steps: int
    converged: bool
    inflation: float
    curve: np.ndarray


def fit(
    scan: Scan,
    surface: Parametric,
    *,
    drift: bool,
    robust: bool,
    edges: str,
    max_steps: int,
    dtype: Any,
    precision: float | None = None,
) -> Squares:
    """Fit a grating, or two crossed, from a start.

    Parameters
    ----------
    scan
        The scan.
    surface
        The start.
    drift
        Whether lines have offsets.
    robust
        Whether outliers lose weight.
    edges
        Of the samples, see `Grating.heights`.
    max_steps
        Trial steps in all.
    dtype
        Of the computation.
    precision
        Of the offsets, if known from a coarser fit.
    """
    scale, names = scan.scale, free(surface)
    surface = surface.replaced(dict.fromkeys(_offsets(surface), 0.0))
    surface = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), surface)
    u = jnp.asarray(encoded(surface, names, scale), dtype)
    weight = scan.known.astype(float)
    lam = _NONE if precision is None or not drift else precision
    as_array = {"y": scan.y, "x": scan.x, "scale": scale, "heights": scan.heights / scale}
    fixed = {name: jnp.asarray(value, dtype) for name, value in as_array.items()}
    left, steps, settled = max_steps, 0, False
    matrix, curve = np.eye(len(names)), []
    pixels = fitted = None
    for k in range(_ROUNDS):
        pixels = Pixels(
            weight=jnp.asarray(weight, dtype), precision=jnp.asarray(lam, dtype), **fixed
        )
        before = np.asarray(u, float)
        u, fitted, matrix, count, good, losses = _squares(
            u, pixels, surface, names, scan.pixel, edges, jnp.asarray(left, jnp.int32), max_steps
        )
        steps, left = steps + int(count), left - int(count)
        curve.append(np.asarray(losses, float)[: int(count)])
        rest, lines, _ = (np.asarray(part, float) for part in _rest(fitted, pixels))
        spread = _deviation(rest[scan.known])
        error = spread / np.sqrt(np.maximum(np.diag(np.asarray(matrix, float)), 1e-30))
        moved = np.abs(np.asarray(u, float) - before) / np.maximum(error, 1e-9)
        if not good or left <= 0:
            break
        changes = robust or drift
        if (k > 0 and moved.max() < _STILL) or not changes or spread == 0.0:
            settled = True
            break
        if robust:
            weight = scan.known / (1.0 + (rest / (_CAUCHY * spread)) ** 2)
        if drift:
            lam = _precision(rest + lines[:, None], weight, spread)
    else:
        settled = True
    assert pixels is not None
    assert fitted is not None
    rest, lines, plane = (np.asarray(part, float) for part in _rest(fitted, pixels))
    half = np.array([1.0, np.abs(scan.y).max(), np.abs(scan.x).max()])
    return Squares(
        surface=decoded(u, surface, names, jnp.asarray(scale, dtype)),
        names=names,
        u=np.asarray(u, float),
        matrix=np.asarray(matrix, float),
        plane=plane * scale / half,
        lines=lines * scale,
        rest=rest * scale,
        weight=np.asarray(pixels.weight, float),
        precision=float(lam),
        steps=steps,
        converged=settled,
        inflation=_inflation(rest[scan.known]) * scale**2 if robust else 0.0,
        # Half the sum to the mean.
        curve=np.concatenate(curve) * 2.0 * scale**2 / scan.known.sum(),
    )


def _offsets(surface: Parametric) -> list[str]:
    return [path for path in kinds(surface) if path.split(".")[-1] == "offset"]


def _deviation(values: np.ndarray) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _precision(rest: np.ndarray, weight: np.ndarray, spread: float) -> float:
    """Variance of noise over that of line offsets, from the means of the lines."""
    total = weight.sum(1)
    full = total > 0
    means = (weight * rest).sum(1)[full] / total[full]
    variance = _deviation(means) ** 2 - spread**2 / max(float(total[full].mean()), 1.0)
    return min(spread**2 / max(variance, 1e-30), _NONE)


def _inflation(rest: np.ndarray) -> float:
    """Variance that Cauchy's weights add to that of the estimate, per pixel, beyond the noise's.

    The estimate's variance is that of mean(psi^2) / mean(psi')^2 white noise (Huber 1981).
    """
    s = _CAUCHY * max(_deviation(rest), 1e-30)
    t = (rest / s) ** 2
    psi2 = (rest / (1.0 + t)) ** 2
    slope = ((1.0 - t) / (1.0 + t) ** 2).mean()
    core = (s / _CAUCHY) ** 2
    return max(float(psi2.mean() / slope**2) - core, 0.0)
