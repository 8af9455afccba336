"""What lobes are fitted to: slices of a BRDF, functions, tables, environment maps.

Every target becomes nodes of a quadrature with values; a node grid gathers about the mean
direction of its function and crowds as far as that is concentrated, so that sharp lobes and
wide ones are resolved by the same number of nodes.
"""

from collections.abc import Callable
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from diffopt import checks
from diffopt.chunks import in_chunks
from diffopt.errors import InputError
from diffopt.fitting.lobe_settings import LobeSettings
from diffopt.fitting.lobes import LobeFit, Method, Nodes, fit_nodes
from diffopt.kernels import mixture, quadrature
from diffopt.lobes import Lobes
from diffopt.materials.base import Material, unit_square

#: Numbers of lobes that ``"auto"`` tries, in turn.
COUNTS = (1, 2, 3, 4, 6, 8, 12, 16)
# Nodes on each axis of the unit square that find where a slice lies.
_SCOUTS = 16
# Of a function of which nothing is known: a grid over the sphere.
_SEARCH = (64, 96)
# Rings crowd within so many standard deviations (1 / sqrt(kappa)) of the mean direction.
_REACH = 8.0


def fit_lobes(
    target: Material | Callable[[Array], Array],
    lobes: int | Literal["auto"] = 3,
    *,
    wo: Any = None,
    tolerance: float = 0.05,
    method: Method = "em+lm",
    settings: LobeSettings | None = None,
    key: PRNGKeyArray | None = None,
) -> LobeFit:
    """Fit lobes to slices of a material, or to a function on the sphere.

    Parameters
    ----------
    target
        A material: what is fitted is f(wi, wo) |cos theta_i| as a function of wi, 1/sr, at
        each `wo`. Or a function from unit vectors [N, 3] to values [N] or [N, C].
    lobes
        How many, or ``"auto"``: as few as meet the tolerance.
    wo
        Directions to the viewer for a material, [..., 3], above the horizon. None: the whole
        BRDF, by `fit_brdf` with its defaults.
    tolerance
        For ``"auto"``, the largest relative L2 error of any slice.
    method, settings, key
        See `diffopt.fitting.lobes.fit_nodes`.

    Returns
    -------
    LobeFit
        Its lobes have the shape of `wo` without the 3 (none for a function), then K.

    Raises
    ------
    InputError
        For materials with perfect mirrors (a lobe has a width), directions below the
        horizon, and values that are negative, not finite or all zero. For ``"auto"`` also if
        `COUNTS` ends before the tolerance is met.
    """
    settings = settings or LobeSettings()
    if not isinstance(target, Material):
        if wo is not None:
            raise InputError("wo is for materials; a function on the sphere has no viewer")
        nodes = _function_nodes(target, settings)
        fit = _counted(nodes, lobes, tolerance, method=method, settings=settings, key=key)
        return _without_batch(fit, ())
    if wo is None:
        from diffopt.fitting.brdf import fit_brdf

        if lobes == "auto" or method != "em+lm":
            raise InputError(
                "a whole BRDF takes a number of lobes and em+lm; for slices give wo, directions "
                "to the viewer [..., 3]"
            )
        return fit_brdf(target, lobes, settings=settings, key=key)
    checks.directions("wo", wo)
    wo = jnp.asarray(wo)
    wo = wo if jnp.issubdtype(wo.dtype, jnp.floating) else wo.astype(float)
    nodes = slices(target, wo.reshape(-1, 3), settings)
    fit = _counted(nodes, lobes, tolerance, method=method, settings=settings, key=key)
    return _without_batch(fit, wo.shape[:-1])


def _counted(
    nodes: Nodes, lobes: int | Literal["auto"], tolerance: float, **options: Any
) -> LobeFit:
    """A fit with as many lobes as asked for, or with the fewest that meet a tolerance."""
    if lobes != "auto":
        return fit_nodes(nodes, lobes, **options)
    checks.tolerance(tolerance)
    error = 0.0
    for count in COUNTS:
        fit = fit_nodes(nodes, count, **options)
        error = float(fit.error.max())
        if error <= tolerance:
            return fit
    raise InputError(
        f"tolerance {tolerance:g} is not met by {COUNTS[-1]} lobes, the most that 'auto' tries: "
        f"relative errors up to {error:.3g}; lobes={COUNTS[-1]} gives that fit"
    )


def slices(material: Material, wo: Float[Array, "B 3"], settings: LobeSettings) -> Nodes:
    """The slices of a material at viewing directions, each on nodes about its mean."""
    if material.delta:
        raise InputError(
            "a perfect mirror or refraction is no function on the sphere: fit a rough one"
        )
    below = checks.concrete(wo)
    if below is not None and (below[:, 2] <= 0.0).any():
        raise InputError(f"wo must lie above the horizon; received z = {below[:, 2].min():g}")
    return _slices(material.typed(wo.dtype), wo, settings)


@eqx.filter_jit
def _slices(material: Material, wo: Array, settings: LobeSettings) -> Nodes:
    points, share = unit_square(_SCOUTS, wo.dtype, material.choices)

    def one(wo: Array) -> tuple[tuple, tuple, tuple]:
        there = jnp.broadcast_to(wo, points.shape)
        scouts = material.scatter(points, there)
        weight = scouts.weight.reshape(share.size, -1).mean(-1)
        # A throughput times its density is the value: its square is what the error weighs.
        square = share * weight * (weight * scouts.pdf)

        def on(directions: Array, solid: Array) -> tuple[Array, Array, Array]:
            values = material._reflected(directions, jnp.broadcast_to(wo, directions.shape))
            values = values.reshape(*directions.shape[:1], -1) * jnp.abs(directions[:, 2:])
            return directions, solid, values

        fine, coarse, other = grids(scouts.wi, square, settings)
        return on(*fine), on(*coarse), on(*other)

    fine, coarse, other = (Nodes(*part) for part in in_chunks(one, wo, settings.chunk))
    return Nodes(fine.directions, fine.solid_angles, fine.values, coarse, other)


def grids(
    directions: Array, weights: Array, settings: LobeSettings
) -> tuple[tuple[Array, Array], tuple[Array, Array], tuple[Array, Array]]:
    """Nodes for something of which weighted directions are known: fine, coarse, other.

    The coarse ones are a quarter as many. The fit does not see the others, on which its error
    is measured; they are more than twice as many.
    """
    _, mu, kappa = mixture.moments(directions, weights, settings.sharpest)
    core = jnp.minimum(_REACH * jax.lax.rsqrt(jnp.maximum(kappa, 1.0)), 1.0)
    rings, sectors = settings.rings, settings.sectors
    return (
        quadrature.polar_grid(mu, rings, sectors, core),
        quadrature.polar_grid(mu, rings // 2, sectors // 2, core),
        quadrature.polar_grid(mu, 3 * rings // 2 + 1, 3 * sectors // 2 + 1, core),
    )


def _function_nodes(target: Callable, settings: LobeSettings) -> Nodes:
    up = jnp.asarray([0.0, 0.0, 1.0])
    start = quadrature.polar_grid(up, *_SEARCH)
    # Twice: the first grid is too coarse to say how sharp a sharp function is.
    found, _, _ = grids(*_squared(target, *start), settings)
    chosen = grids(*_squared(target, *found), settings)

    def alone(grid: tuple[Array, Array]) -> Nodes:
        return Nodes(grid[0][None], grid[1][None], _evaluated(target, grid[0])[None])

    fine, coarse, other = map(alone, chosen)
    return Nodes(fine.directions, fine.solid_angles, fine.values, coarse, other)


def _squared(target: Callable, directions: Array, solid: Array) -> tuple[Array, Array]:
    return directions, solid * _evaluated(target, directions).mean(-1) ** 2


def _evaluated(target: Callable, directions: Array) -> Array:
    values = jnp.asarray(target(directions))
    if values.shape[:1] != directions.shape[:1] or values.ndim > 2:
        raise InputError(
            f"the function must return [{directions.shape[0]}] or [{directions.shape[0]}, C]; "
            f"received {values.shape}"
        )
    return values.reshape(values.shape[0], -1).astype(directions.dtype)


def fit_table(
    directions: Any,
    values: Any,
    solid_angles: Any,
    lobes: int | Literal["auto"] = 3,
    *,
    tolerance: float = 0.05,
    method: Method = "em+lm",
    settings: LobeSettings | None = None,
    key: PRNGKeyArray | None = None,
) -> LobeFit:
    """Fit lobes to values at given directions.

    Parameters
    ----------
    directions
        Unit vectors, [N, 3]. They should cover the sphere: where there are none, a fit may
        put what it likes.
    values
        [N] or with colour channels [N, C].
    solid_angles
        Of each direction, steradian, [N], >= 0.
    lobes, tolerance, method, settings, key
        As for `fit_lobes`.
    """
    checks.directions("directions", directions)
    directions, values = jnp.asarray(directions), jnp.asarray(values)
    solid_angles = jnp.asarray(solid_angles)
    count = directions.shape[0]
    if directions.ndim != 2 or values.shape[:1] != (count,) or solid_angles.shape != (count,):
        raise InputError(
            "directions, values and solid_angles must be [N, 3], [N] or [N, C], and [N]; "
            f"received {directions.shape}, {values.shape}, {solid_angles.shape}"
        )
    no_negative("solid_angles", solid_angles)
    nodes = Nodes(directions[None], solid_angles[None], values.reshape(count, -1)[None])
    fit = _counted(nodes, lobes, tolerance, method=method, settings=settings, key=key)
    return _without_batch(fit, ())


def fit_environment(
    image: Any,
    lobes: int | Literal["auto"] = 16,
    *,
    tolerance: float = 0.05,
    method: Method = "em+lm",
    settings: LobeSettings | None = None,
    key: PRNGKeyArray | None = None,
) -> LobeFit:
    """Fit lobes to an environment map in longitude and latitude.

    Parameters
    ----------
    image
        Radiance, [H, W] or [H, W, C]; the first row at the zenith (z up), columns from
        azimuth 0 (x) by way of y.
    lobes, tolerance, method, settings, key
        As for `fit_lobes`; rings and sectors of the settings are not used.
    """
    image = jnp.asarray(image)
    if image.ndim not in (2, 3) or 0 in image.shape:
        raise InputError(f"image must be [H, W] or [H, W, C]; received {image.shape}")
    directions, solid = map_directions(*image.shape[:2], dtype=image.dtype)
    values = image.reshape(directions.shape[0], *image.shape[2:])
    return fit_table(
        directions,
        values,
        solid,
        lobes,
        tolerance=tolerance,
        method=method,
        settings=settings,
        key=key,
    )


def map_directions(height: int, width: int, *, dtype: Any) -> tuple[Array, Array]:
    """Centres and solid angles of the pixels of a map in longitude and latitude, [H W]."""
    edges = np.linspace(0.0, np.pi, height + 1)
    theta, phi = np.meshgrid(
        0.5 * (edges[1:] + edges[:-1]), (np.arange(width) + 0.5) * 2 * np.pi / width, indexing="ij"
    )
    sin = np.sin(theta)
    directions = np.stack([sin * np.cos(phi), sin * np.sin(phi), np.cos(theta)], -1)
    band = (np.cos(edges[:-1]) - np.cos(edges[1:])) * 2.0 * np.pi / width
    return (
        jnp.asarray(directions.reshape(-1, 3), dtype),
        jnp.asarray(np.repeat(band, width), dtype),
    )


def no_negative(name: str, values: Array) -> None:
    """Refuse weights that are negative or not finite."""
    array = checks.concrete(values)
    if array is not None and not (np.isfinite(array) & (array >= 0.0)).all():
        raise InputError(f"{name} must be finite and >= 0; received {array.min():g}")


def _without_batch(fit: LobeFit, shape: tuple[int, ...]) -> LobeFit:
    """A fit with the batch [B] in another shape."""

    def shaped(array: Array) -> Array:
        return array.reshape(*shape, *array.shape[1:])

    lobes = Lobes(*map(shaped, fit.lobes.arrays))
    return eqx.tree_at(
        lambda f: (f.lobes, f.error, f.energy_error, f.steps, f.settled),
        fit,
        (lobes, *(shaped(a) for a in (fit.error, fit.energy_error, fit.steps, fit.settled))),
    )
