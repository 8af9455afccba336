"""Parameters of a grating from its measured reflectance, by Levenberg-Marquardt.

The forward model is that of `diffopt.DiffractionBRDF` averaged over window positions, for a
surface that repeats along x for ever: there the power spectrum of exp(i kappa h) is a set of
lines at the orders, so that

    |P|^2 = sum_m |c_m|^2 exp(-|f - f_m|^2 / sigma_f^2),  f = (u, v) / wavelength,

with f_m = (-m / period, 0), sigma_f = 1 / (2 pi sigma_s) and the closed-form amplitudes c_m of
`diffopt.gratings` at the kappa of the pair of directions. Nothing is sampled, and every
parameter has its derivative, which a saw or a step on a grid of pixels does not.

Limits: one grating whose lines run along y, known reflectance and coherence, scalar theory
with Stam's prefactor, no shadowing and no blur by source or pixel. |P|^2 averaged over positions
does not change when the surface is shifted, so shift and phase stay as they are in the start;
nor, for a sinusoid and a binary grating, with the sign of the depth.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from diffopt import checks
from diffopt.diffraction import model_factors
from diffopt.errors import InputError
from diffopt.fitting.measured import Measured, Quantity, require
from diffopt.fresnel import Constant, Reflectance
from diffopt.gratings import Binary, Blazed, Grating, Sinusoidal
from diffopt.kernels import frames

FREE: dict[type[Grating], tuple[str, ...]] = {
    Sinusoidal: ("period", "amplitude"),
    Blazed: ("period", "depth"),
    Binary: ("period", "depth", "duty"),
}
# A fit keeps a length within this factor of its start, so that no trial step leaves the range
# of the closed forms; the period less, since orders are picked for the longest.
_REACH = {"period": 3.0, "amplitude": 8.0, "depth": 8.0}
# Orders are left out where the Gaussian is below this share of its peak.
_FAINT = 1e-7
# Coherence window of the first, coarsest stage in periods of the start.
_COARSEST = 0.2
# Coarse stages compare every value with every other.
_MOST_VALUES = 8192


class HeightfieldFit(eqx.Module):
    """Result of `fit_heightfield`.

    Attributes
    ----------
    model
        The fitted grating.
    errors
        Standard errors of the free parameters by name, from the Jacobian at the solution
        and the scatter of the residuals; infinite, or huge by rounding, where the data do
        not hold a parameter.
    residual
        Norm of the residuals over that of the values, both over the noise.
    steps
        Levenberg-Marquardt steps, all stages together.
    result
        Outcome of the last stage, an `optimistix.RESULTS`.
    """

    model: Grating
    errors: dict[str, Float[Array, ""]]
    residual: Float[Array, ""]
    steps: Int[Array, ""]
    result: optx.RESULTS

    @property
    def message(self) -> str:
        """Optimistix's words for the outcome, ``converged`` if there is nothing to say."""
        return optx.RESULTS[self.result] or "converged"

    def __str__(self) -> str:
        parts = [
            f"{name} {float(getattr(self.model, name)):.6g} +- {float(error):.2g}"
            for name, error in self.errors.items()
        ]
        return (
            f"{type(self.model).__name__}: {', '.join(parts)}; residual {float(self.residual):.2e} "
            f"after {int(self.steps)} steps ({self.message})"
        )


@eqx.filter_jit
def grating_brdf(
    grating: Grating,
    wi: Float[Array, "M 3"],
    wo: Float[Array, "M 3"],
    wavelengths: Float[Array, " L"],
    coherence: Float[Array, ""],
    *,
    orders: int,
    fresnel: Reflectance | None = None,
    quantity: Quantity = "spectral",
) -> Float[Array, "M L"]:
    """BRDF of an endless grating, see the head of this module; 0 below the horizon.

    Parameters
    ----------
    grating
        The grating.
    wi, wo
        Unit vectors, [M, 3].
    wavelengths
        Micrometres, [L].
    coherence
        sigma_s, micrometres.
    orders
        Orders on either side of the nearest one that are summed; the first one left out
        weighs exp(-((orders + 1/2) 2 pi sigma_s / period)^2) at most.
    fresnel
        Power reflectance; a perfect mirror by default.
    quantity
        ``spectral``: f in 1/sr; ``relative``: as `DiffractionBRDF.relative`.
    """
    valid, wi, wo = frames.above_horizon(wi, wo)
    wave = frames.wave_vector(wi, wo)
    fx, fy, s = (wave[:, i, None] / wavelengths[None, :] for i in range(3))
    nearest = jax.lax.stop_gradient(jnp.round(-fx * grating.period))[..., None]
    order = nearest + jnp.arange(-orders, orders + 1, dtype=fx.dtype)[None, None, :]
    off = jnp.stack(jnp.broadcast_arrays(fx[..., None] + order / grating.period, fy[..., None]))
    weight = jnp.exp(-(off**2).sum(0) * (2.0 * math.pi * coherence) ** 2)
    kappa = jnp.broadcast_to(2.0 * math.pi * s[..., None], order.shape)
    power = (grating.order_efficiency(order.astype(jnp.int32), kappa) * weight).sum(-1)
    before = model_factors(
        Constant() if fresnel is None else fresnel,
        wi,
        wo,
        wavelengths,
        prefactor="stam",
        shadowing="none",
        relative=quantity == "relative",
    )
    area = 1.0 if quantity == "relative" else 4.0 * math.pi * coherence**2
    return jnp.where(valid[:, None], before * power * area, 0.0)


def orders_needed(longest: float, coherence: float) -> int:
    """`orders` for `grating_brdf` that leaves out 1e-10 of a line at most, up to a period."""
    reach = math.sqrt(-math.log(_FAINT)) * longest / (2.0 * math.pi * coherence)
    return max(math.ceil(reach - 0.5), 0)


def fit_heightfield(
    measured: Measured,
    model: Grating | Sequence[Grating],
    *,
    free: Sequence[str] | None = None,
    fresnel: Reflectance | None = None,
    stages: int = 4,
    tolerance: float | None = None,
    max_steps: int = 64,
    orders: int | None = None,
) -> HeightfieldFit:
    """Fit a grating to measured reflectance by least squares.

    Every stage is a Levenberg-Marquardt solve. The last one compares values with the model as
    they are; the ones before compare both after the same Gaussian blur over f, as wide as that
    of a coherence window that grows from a fifth of the start's period to the measured one.
    Lines far from their place overlap under a short window and pull the period towards it. That
    needs directions as dense as lines are wide, steps in u of wavelength / (2 pi sigma_s) or less;
    with coarser ones, or few values, give several starts.

    Optimistix has no bounds, so unbounded y stand for the parameters: a length is
    start * exp(log(r) tanh(y)), which keeps its sign and stays within the factor r of its start
    (3 for the period, 8 for depth and amplitude); a duty is a sigmoid of y.

    Parameters
    ----------
    measured
        The data; converted to the dtype of the model.
    model
        The start, or several of one kind: all are fitted in one program, and the fit of
        smallest residual is returned. One start is enough for a sinusoid; a blazed
        grating has many minima and wants 4 to 16 depths.
    free
        Names of the parameters to fit; by default period and amplitude or depth, and the
        duty of a `Binary` (do not start it at 1/2, where no order depends on it to first
        order).
    fresnel
        Power reflectance of the surface; a perfect mirror by default.
    stages
        Coarse stages before the last one, 0 or more.
    tolerance
        Of a solve, relative and absolute, for y and for half the squared relative residual;
        the square root of the rounding unit by default.
    max_steps
        Of each stage. A fit that needs more is returned, with a `message` that says so.
    orders
        See `grating_brdf`; by default enough for three times the period of the start. Needed
        where the start or the coherence is traced by a caller's jit or vmap. Vmap over single
        starts or data; over a list of starts (a vmap in a vmap) the compiled program has been
        seen to crash on CPUs.

    Raises
    ------
    InputError
        If the start is of an unknown kind or not usable, fewer values than free parameters
        were measured, or there are too many for coarse stages.
    RuntimeError
        At run time, for sinusoids beyond the range of `diffopt.gratings.bessel_j`.
    """
    starts = [model] if isinstance(model, Grating) else list(model)
    names = _check(measured, starts, free, stages)
    if orders is None:
        lengths = [checks.concrete(start.period) for start in starts]
        sigma = checks.concrete(measured.coherence)
        if sigma is None or any(length is None for length in lengths):
            raise InputError("orders must be given where period or coherence is traced")
        longest = _REACH["period"] * max(float(np.max(n)) for n in lengths if n is not None)
        orders = orders_needed(longest, float(sigma))
    dtype = starts[0].period.dtype
    measured = jax.tree.map(lambda leaf: leaf.astype(dtype), measured)
    tolerance = float(jnp.finfo(dtype).eps) ** 0.5 if tolerance is None else tolerance
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *starts)
    return _fit(
        measured,
        stacked,
        Constant() if fresnel is None else fresnel,
        names=names,
        stages=stages,
        tolerance=tolerance,
        max_steps=max_steps,
        orders=orders,
    )


@eqx.filter_jit
def _fit(measured, starts, fresnel, *, names, stages, tolerance, max_steps, orders):
    """Fit from every start [S] and return the best."""
    weight = 1.0 / (measured.noise * jnp.linalg.norm(measured.values / measured.noise))
    frequency = _frequencies(measured)

    def residuals(model):
        value = grating_brdf(
            model,
            measured.wi,
            measured.wo,
            measured.wavelengths,
            measured.coherence,
            orders=orders,
            fresnel=fresnel,
            quantity=measured.quantity,
        )
        return ((value - measured.values) * weight).reshape(-1)

    # The solver's step size has JAX's default type, and its linear solves take no other: with
    # 64-bit types on, a float32 model is evaluated in float32 and stepped in float64.
    wide = jnp.result_type(float)
    solver = optx.LevenbergMarquardt(rtol=tolerance, atol=tolerance)

    def solve(function, y):
        done = optx.least_squares(
            lambda y, _: function(y).astype(wide), solver, y, max_steps=max_steps, throw=False
        )
        # A stage that failed hands on where it began.
        y = jax.tree.map(lambda new, old: jnp.where(jnp.isfinite(new), new, old), done.value, y)
        return y, done.stats["num_steps"], done.result

    def one(start):
        def at(y):
            return residuals(_model(start, names, y))

        def stage(y, window):
            blur = _blur(frequency, window, measured.coherence)
            y, steps, _ = solve(lambda y: jnp.matmul(blur, at(y), precision="highest"), y)
            return y, steps

        y, steps = jnp.zeros(len(names), wide), jnp.zeros((), int)
        if stages:
            share = jnp.arange(stages, dtype=start.period.dtype) / stages
            coarsest = jnp.minimum(_COARSEST * start.period, measured.coherence)
            windows = coarsest ** (1.0 - share) * measured.coherence**share
            y, counts = jax.lax.scan(stage, y, windows)
            steps = counts.sum()
        y, last, result = solve(at, y)
        model = _model(start, names, y)
        final = residuals(model)
        values = jnp.stack([getattr(model, name) for name in names])
        jacobian = jax.jacfwd(lambda p: residuals(_replace(model, names, p)))(values)
        errors = dict(zip(names, _standard_errors(jacobian, final), strict=True))
        return HeightfieldFit(model, errors, jnp.linalg.norm(final), steps + last, result)

    if starts.period.shape[0] == 1:
        return one(jax.tree.map(lambda leaf: leaf[0], starts))
    fits = eqx.filter_vmap(one)(starts)
    best = jnp.argmin(jnp.nan_to_num(fits.residual, nan=jnp.inf))
    return jax.tree.map(lambda leaf: leaf[best], fits)


def _replace(model, names, values):
    return eqx.tree_at(lambda m: [getattr(m, n) for n in names], model, list(values))


def _model(start, names, y):
    """The grating that unbounded y stand for; the start at y = 0."""
    values = []
    for name, step in zip(names, y, strict=True):
        value = getattr(start, name)
        step = step.astype(value.dtype)
        if name == "duty":
            values.append(jax.nn.sigmoid(jnp.log(value) - jnp.log1p(-value) + step))
        else:
            values.append(value * jnp.exp(math.log(_REACH[name]) * jnp.tanh(step)))
    return _replace(start, names, values)


def _frequencies(measured: Measured) -> Float[Array, "N 2"]:
    wave = frames.wave_vector(measured.wi, measured.wo)
    return (wave[:, None, :2] / measured.wavelengths[None, :, None]).reshape(-1, 2)


def _blur(
    frequency: Float[Array, "N 2"], window: Float[Array, ""], coherence: Float[Array, ""]
) -> Float[Array, "N N"]:
    """Means over neighbours that widen lines to those of a shorter coherence window."""
    # Squares of widths add; a tenth of a line is as good as none, and keeps 0 / 0 away.
    width2 = jnp.maximum(window**-2 - coherence**-2, 0.01 * coherence**-2) / (2.0 * math.pi) ** 2
    square = (frequency**2).sum(-1)
    product = jnp.matmul(frequency, frequency.T, precision="highest")
    apart = jnp.maximum(square[:, None] + square[None, :] - 2.0 * product, 0.0)
    weight = jnp.exp(-apart / width2)
    return weight / weight.sum(1, keepdims=True)


def _standard_errors(jacobian: Float[Array, "N p"], final: Float[Array, " N"]) -> list[Array]:
    """Roots of the diagonal of s^2 (J^T J)^-1, s^2 the residual variance."""
    count, free = jacobian.shape
    size = jnp.linalg.norm(jacobian, axis=0)
    # Unit columns, so that units of the parameters do not enter the conditioning.
    triangle = jnp.linalg.qr(jacobian / jnp.where(size > 0, size, 1.0)[None, :], mode="r")
    inverse = jax.scipy.linalg.solve_triangular(triangle, jnp.eye(free, dtype=final.dtype))
    scatter = jnp.linalg.norm(final) / math.sqrt(count - free)
    error = scatter * jnp.linalg.norm(inverse, axis=1) / size
    return list(jnp.where(jnp.isfinite(error), error, jnp.inf))


def _check(measured, starts, free, stages):
    """Names of the free parameters, after a look at all that can be looked at."""
    kinds = {type(start) for start in starts}
    if len(kinds) != 1 or (kind := kinds.pop()) not in FREE:
        received = ", ".join(sorted(k.__name__ for k in {type(start) for start in starts}))
        raise InputError(
            f"model must be one kind of {', '.join(k.__name__ for k in FREE)}; "
            f"received {received or 'none'}"
        )
    names = FREE[kind] if free is None else tuple(free)
    if not names or not set(names) <= set(FREE[kind]):
        raise InputError(f"free must be some of {', '.join(FREE[kind])}; received {names}")
    for start in starts:
        for name in names:
            low, high = (0, 1) if name == "duty" else (0 if name == "period" else -np.inf, np.inf)
            expected = f"between {low:g} and {high:g}, not 0, in the start"
            require(
                name,
                getattr(start, name),
                lambda v, low=low, high=high: ((v > low) & (v < high) & (v != 0)).all(),
                expected,
            )
    if stages < 0:
        raise InputError(f"stages must be 0 or more; received {stages}")
    size = measured.values.size
    if size <= len(names):
        raise InputError(f"values must outnumber the {len(names)} free parameters; received {size}")
    if stages and size > _MOST_VALUES:
        raise InputError(
            f"coarse stages take {_MOST_VALUES} values at most; received {size}: leave out "
            "directions or wavelengths for a first fit, then refine it with stages=0"
        )
    return names
