"""Functions on the sphere to lobes: expectation maximisation, then least squares.

EM brings the lobes apart in a few steps (it maximises likelihood, not the square error, and
closes in on its optimum slowly); a few Levenberg-Marquardt steps from there reach an error
that EM never does. For one lobe `method="moments"` is the closed form that the glossy-transfer
paper calls EM.

Batches of functions are fitted side by side in chunks. `LobeSettings.rounds` goes on with
those that have not settled, in batches of the next power of two, so that no function waits
for the slowest.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from diffopt import checks, devices
from diffopt.accuracy.measurement import peak_bytes
from diffopt.brdf_lobes import BRDFLobes
from diffopt.chunks import in_chunks
from diffopt.errors import InputError
from diffopt.fitting.lobe_settings import LobeSettings
from diffopt.kernels import lobe_squares, mixture, vmf
from diffopt.kernels.phase import TWO_PI
from diffopt.lobes import Lobes

# Directions [N, 3], solid angles [N] and values [N] of one function; or alpha, mu, kappa.
Scalar = tuple[Array, Array, Array]
# equinox.filter_jit would take half a millisecond of each call to tell these from arrays.
_STATIC = ("count", "method", "settings")
Method = Literal["em+lm", "lm", "em", "moments"]


class LobeFit(eqx.Module):
    """Result of a fit.

    Attributes
    ----------
    lobes
        The fitted functions.
    error
        Relative L2 error over the sphere, for each function: on nodes that the fit did not
        see for materials and functions, on the given ones for tables.
    energy_error
        |integral of the lobes over that of the function - 1| before it was restored, the
        largest over the channels.
    steps
        Levenberg-Marquardt steps, those on coarse nodes included.
    settled
        Whether the last round lowered the squared error by less than `settings.settled` of
        it; for fits without least squares, always.
    settings, method
        What was asked for.
    brdf
        For whole BRDFs, the lobes between their views.
    """

    lobes: Lobes
    error: Float[Array, "*batch"]
    energy_error: Float[Array, "*batch"]
    steps: Int[Array, "*batch"]
    settled: Bool[Array, "*batch"]
    settings: LobeSettings = eqx.field(static=True)
    method: str = eqx.field(static=True)
    brdf: BRDFLobes | None = None

    def __str__(self) -> str:
        error = np.atleast_1d(self.error)
        many = f"{error.size} functions, " if np.ndim(self.error) else ""
        spread = f" ({error.min():.2g} to {error.max():.2g})" if np.ndim(self.error) else ""
        rest = int((~np.atleast_1d(self.settled)).sum())
        ended = "settled" if not rest else f"{rest} still improving"
        ended += f" after {int(np.max(self.steps))} steps"
        return (
            f"{many}{self.lobes.count} lobes by {self.method}: relative error "
            f"{error.mean():.3g}{spread}, energy off by "
            f"{np.abs(self.energy_error).max():.2g} before it was restored; {ended}"
        )

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.fitting import previews
        from diffopt.previews import bundles

        return bundles.bundle(self, previews.lobe_card)


class Nodes(eqx.Module):
    """A batch of functions, each at the nodes of a quadrature of its own.

    Attributes
    ----------
    directions
        Unit vectors, [B, N, 3].
    solid_angles
        Steradian, [B, N].
    values
        [B, N, C] with C colour channels, 1 for scalar functions. The shape of the lobes is
        fitted to their mean.
    coarse
        The same functions on fewer nodes, for the first steps; None for none.
    other
        The same functions on nodes that the fit does not see, for its error; None for none.
    """

    directions: Float[Array, "B N 3"]
    solid_angles: Float[Array, "B N"]
    values: Float[Array, "B N C"]
    coarse: "Nodes | None" = None
    other: "Nodes | None" = None

    def scalar(self) -> Scalar:
        """Directions, solid angles and the mean over the channels."""
        return self.directions, self.solid_angles, self.values.mean(-1)


def fit_nodes(
    nodes: Nodes,
    lobes: int,
    *,
    method: Method = "em+lm",
    settings: LobeSettings | None = None,
    key: PRNGKeyArray | None = None,
    start: Lobes | None = None,
) -> LobeFit:
    """Fit functions that are known at the nodes of quadratures.

    Parameters
    ----------
    nodes
        The functions; spread over devices (`diffopt.spread`), every device fits its share.
    lobes
        Number of lobes, 1 to 64.
    method
        ``"em+lm"``, ``"lm"`` (least squares alone), ``"em"`` (expectation maximisation alone,
        `LobeSettings.em_steps` of it) or ``"moments"`` (closed form; one lobe).
    settings
        `LobeSettings`.
    key
        For the scattered start; ``jax.random.key(0)`` if left out. All functions draw the
        same numbers, so that none depends on what it is fitted beside.
    start
        Lobes [B, K] to start from, in place of EM: their order is kept.

    Raises
    ------
    InputError
        If a value is not finite, or negative where weights may not be, or a function is
        zero at all nodes.
    """
    settings = settings or LobeSettings()
    checks.choice("method", method, get_args(Method))
    count = 1 if method == "moments" else lobes
    if not 1 <= lobes <= 64 or count != lobes:
        raise InputError(f"lobes must be 1 to 64, and 1 for moments; received {lobes}")
    _check(nodes, settings)
    key = jax.random.key(0) if key is None else key
    begun = None
    if start is not None:
        if start.kappa.shape != (nodes.values.shape[0], lobes):
            raise InputError(
                f"start must be {nodes.values.shape[0]} times {lobes} lobes; received "
                f"{start.kappa.shape}"
            )
        begun = (start.alpha.reshape(*start.kappa.shape, -1).mean(-1), start.mu, start.kappa)
        method = "lm"
    place = devices.placement(nodes.values)
    over = None if place is None or place[1] else place[0]
    given = nodes, key, begun, count, method, settings
    if settings.rounds == 1 or "lm" not in method:
        return _each(over, _whole, given, (0, None, 0, *[None] * 3))
    found, gain = _each(over, _fit, given, (0, None, 0, *[None] * 3))
    gain = np.array(gain)
    steps = np.full(gain.shape, _steps(method, settings, begun))
    found = _rounds(nodes, found, gain, steps, settings, over)
    ended = nodes, found, jnp.asarray(gain), jnp.asarray(steps), method, settings
    return _each(over, _finish, ended, (0, 0, 0, 0, None, None))


def _each(over: Any, function: Callable, given: tuple, axes: tuple) -> Any:
    """A compiled part of a fit, where functions are spread over devices every one its share."""
    return function(*given) if over is None else devices.run(function, given, axes, 0, over)


def fit_bytes(nodes: Nodes, lobes: int, settings: LobeSettings, key: PRNGKeyArray) -> int | None:
    """Memory of a fit by ``em+lm``: arguments, results and temporaries of its largest program.

    Rounds after the first take no more: the same steps for no more functions. Programs that a
    fit has compiled are not compiled again. None where the backend does not say.
    """
    static = lobes, "em+lm", settings
    if settings.rounds == 1:
        return peak_bytes(_whole.lower(nodes, key, None, *static).compile())
    first = _fit.lower(nodes, key, None, *static)
    found, gain = first.out_info
    steps = jax.ShapeDtypeStruct(gain.shape, jnp.asarray(0).dtype)
    last = _finish.lower(nodes, found, gain, steps, *static[1:])
    sizes = [peak_bytes(each.compile()) for each in (first, last)]
    return None if None in sizes else max(size for size in sizes if size is not None)


@partial(jax.jit, static_argnames=_STATIC)
def _whole(
    nodes: Nodes, key: Any, start: Any, count: int, method: str, settings: LobeSettings
) -> LobeFit:
    """A fit of one round in one compiled program: nothing waits for the host."""
    found, gain = _fit(nodes, key, start, count, method, settings)
    steps = jnp.full(gain.shape, _steps(method, settings, start))
    return _finish(nodes, found, gain, steps, method, settings)


def _steps(method: str, settings: LobeSettings, start: Any) -> int:
    """Least-squares steps of the first round."""
    if "lm" not in method:
        return 0
    return settings.lm_steps + (settings.coarse_steps if start is None else 0)


def _batched(one: Callable[[Any], Any], batch: Any, count: int, settings: LobeSettings) -> Any:
    """A function over a batch, in chunks where it is larger than one."""
    if count <= settings.chunk:
        return jax.vmap(one)(batch)
    return in_chunks(one, batch, settings.chunk)


def _check(nodes: Nodes, settings: LobeSettings) -> None:
    values = checks.concrete(nodes.values)
    if values is None:
        return
    if not np.isfinite(values).all():
        raise InputError("values to fit must be finite; received NaN or infinity")
    if not settings.signed and (values < 0.0).any():
        raise InputError(
            f"values to fit must be >= 0 (or set signed=True); received {values.min():.3g}"
        )
    empty = ~(values != 0.0).any((1, 2))
    if empty.any():
        raise InputError(f"function {int(np.argmax(empty))} is zero at every node")


@partial(jax.jit, static_argnames=_STATIC)
def _fit(
    nodes: Nodes, key: Any, start: Any, count: int, method: str, settings: LobeSettings
) -> tuple[tuple[Array, Array, Array], Array]:
    """Lobes of every function, and the share of the squared error that the round took away."""

    def one(given: tuple) -> tuple[tuple[Array, Array, Array], Array]:
        fine, coarse, begun = given
        first = fine if coarse is None else coarse
        if begun is None:
            begun = _begin(first, key, count, method, settings)
            if coarse is not None and "lm" in method:
                begun, _ = _descend(first, begun, settings, settings.coarse_steps)
        if "lm" not in method:
            return begun, jnp.zeros_like(fine[1][0])
        # Without a coarse grid or a start, its steps are taken here.
        alone = coarse is None and start is None
        return _descend(fine, begun, settings, settings.lm_steps + alone * settings.coarse_steps)

    coarse = nodes.coarse.scalar() if nodes.coarse is not None and method == "em+lm" else None
    batch = (nodes.scalar(), coarse, start)
    return _batched(one, batch, nodes.values.shape[0], settings)


def _begin(
    given: Scalar, key: Any, count: int, method: str, settings: LobeSettings
) -> tuple[Array, Array, Array]:
    directions, solid, values = given
    weights = solid * jnp.maximum(values, 0.0)
    # No sharper than the cells that hold the weight can show.
    cell = (weights * solid).sum() / jnp.maximum(weights.sum(), 1e-30)
    sharpest = TWO_PI / jnp.maximum(cell, TWO_PI / settings.sharpest)
    if count == 1:
        # Of one lobe EM's first step is its last.
        total, mu, kappa = mixture.moments(directions, weights, sharpest)
        return total[None], mu[None], jnp.maximum(kappa, mixture.FLATTEST)[None]
    if settings.start == "scattered":
        begun = mixture.scattered_start(key, directions, weights, count, sharpest)
    else:
        begun = mixture.split_start(directions, weights, count, sharpest)
    if method != "lm":
        begun, _ = mixture.expectation_maximisation(
            directions, weights, begun, settings.em_steps, sharpest
        )
    return weights.sum() * jnp.exp(begun.log_share), begun.mu, begun.kappa


def _descend(
    function: Scalar, begun: Scalar, settings: LobeSettings, steps: int
) -> tuple[tuple[Array, Array, Array], Array]:
    signed = settings.signed
    given, norm = lobe_squares.problem(*function)
    alpha, mu, kappa = begun
    sharpest = lobe_squares.resolved(mu, function[0], function[1], settings.sharpest)
    kappa = jnp.minimum(kappa, sharpest)
    at, base = lobe_squares.parameters(alpha, mu, kappa, norm, signed=signed)
    start = lobe_squares.begin(at, base, given, signed=signed)
    state = lobe_squares.levenberg_marquardt(start, base, given, steps, sharpest, signed=signed)
    before = jnp.maximum(start.system.cost, 1e-30)
    gain = (start.system.cost - state.system.cost) / before
    return lobe_squares.lobes(state.at, base, norm, signed=signed), gain


def _rounds(
    nodes: Nodes,
    begun: tuple,
    gain: np.ndarray,
    steps: np.ndarray,
    settings: LobeSettings,
    over: Any,
) -> tuple:
    """Go on with what has not settled, in batches of powers of two; changes gain and steps."""
    lobes = begun[2].shape[1]
    for _ in range(settings.rounds - 1):
        active = np.flatnonzero(gain >= settings.settled)
        if not active.size:
            break
        size = min(1 << int(active.size - 1).bit_length(), gain.size)
        if over is not None:
            size = -(-size // over.size) * over.size
        padded = np.resize(active, size)  # the rest repeats
        given = members(nodes, padded), None, members(begun, padded), lobes, "lm", settings
        found, gained = _each(over, _fit, given, (0, None, 0, *[None] * 3))
        begun = _replaced(begun, active, found)
        gain[active] = np.asarray(gained)[: active.size]
        steps[active] += settings.lm_steps
    return begun


def members(batch: Any, rows: np.ndarray | slice) -> Any:
    """Some functions of a batch: the same rows of all its arrays."""
    return jax.tree.map(lambda a: a[rows], batch)


def _replaced(batch: Any, rows: np.ndarray, found: Any) -> Any:
    return jax.tree.map(lambda a, b: a.at[rows].set(b[: rows.size]), batch, found)


@partial(jax.jit, static_argnames=("method", "settings"))
def _finish(
    nodes: Nodes, found: Scalar, gain: Array, steps: Array, method: str, settings: LobeSettings
) -> LobeFit:
    """Weights of every channel with the energy as asked for, and the errors."""
    signed = settings.signed

    def one(given: tuple) -> tuple[Array, Array, Array]:
        (directions, solid, values), other, (alpha, mu, kappa) = given
        if values.shape[-1] > 1:
            alpha = lobe_squares.best_weights(values, solid, directions, mu, kappa, signed=signed)
        else:
            alpha = alpha[:, None]
        wanted = (solid[:, None] * values).sum(0)
        some = wanted != 0.0
        off = jnp.where(some, alpha.sum(0) / jnp.where(some, wanted, 1.0) - 1.0, 0.0)
        if settings.energy == "restored":
            alpha = lobe_squares.restored(alpha, wanted, mu, kappa, signed=signed)
        directions, solid, values = other
        density = vmf.pdf(directions[None], mu[:, None], kappa[:, None])
        # Directions innermost: the other way round the density is copied first.
        missed = jnp.matmul(alpha.T, density, precision="highest").T - values
        square = (solid[:, None] * missed**2).sum() / (solid[:, None] * values**2).sum()
        return alpha, jnp.sqrt(square), jnp.abs(off).max()

    def parts(nodes: Nodes) -> tuple[Array, Array, Array]:
        return nodes.directions, nodes.solid_angles, nodes.values

    given = (parts(nodes), parts(nodes.other or nodes), found)
    alpha, error, off = _batched(one, given, gain.shape[0], settings)
    _, mu, kappa = found
    lobes = Lobes(alpha[..., 0] if nodes.values.shape[-1] == 1 else alpha, mu, kappa)
    return LobeFit(lobes, error, off, steps, gain < settings.settled, settings, method)
