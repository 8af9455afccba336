"""Likelihood of random heights on a scan: noise, roughness and ridges by their covariance.

The noise of a scan is the sum of three: white; correlated, with the covariance
exp(-(r / length)^(2 hurst)) of self-affine surfaces with a cut-off (Sinha et al. 1988); and
offsets of the scan lines. A random surface adds its own covariance. What a model expects of
the periodogram of tapered data follows exactly from the covariance,

    S(f) = sum over lags of C(r) a(r) exp(-2 pi i f r),

a the autocorrelation of the taper, and Whittle's likelihood with that S has no bias from
leakage or edges (debiased Whittle likelihood: Guillaumin, Sykulski, Olhede, Simons 2022).
"""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from diffopt.fitting.scans.codes import decoded, encoded, natural
from diffopt.fitting.scans.register import Scan
from diffopt.gratings import Ridges, Roughness, Surface
from diffopt.gratings.parametric import kinds, seen_in_power

# Cosine parts of the taper, as shares of a side.
_TAPER = 0.1
# Pixels on a side of what the likelihood takes, at most; larger scans are averaged over blocks.
MOST = 192
# kappa of the limit in which |c_m|^2 / kappa^2 are the powers of the heights; heights are over
# their deviation, so that the error is some 1e-5.
_KAPPA = 1e-2
_ORDERS = 6
# Least white noise over the scan's deviation. Scans are smooth far below it, and models with
# corners are not: what they miss there shall not decide.
_WHITE = 1e-2
_STEPS = 80
# Number of the noise's parameters: white, correlated, its length and exponent, lines.
NOISE = 5
_NAMES = ("white", "correlated", "length", "hurst", "lines")


@dataclasses.dataclass(frozen=True)
class Field:
    """A fitted law of heights taken as random; lengths in micrometres.

    Attributes
    ----------
    surface
        Random surface, or None for noise alone.
    names
        Its parameters.
    u
        Encoded numbers: noise first.
    noise
        ``white`` (1 % of the scan's deviation at least), ``correlated`` and ``lines``: rms;
        ``length``; ``hurst``; ``rough``, ``rough_length``: of Gaussian roughness beside it.
    deviance
        -2 log likelihood, of heights over the scan's deviation.
    count
        Independent numbers in the likelihood.
    covariance
        Of the surface's parameters.
    converged
        Whether the maximum was reached.
    curve
        [steps], least deviance up to each trial step from the start that was taken.
    """

    surface: Surface | None
    names: tuple[str, ...]
    u: np.ndarray
    noise: dict[str, float]
    deviance: float
    count: float
    covariance: np.ndarray
    converged: bool
    curve: np.ndarray


class _Data(eqx.Module):
    """Periodogram and lags; static shapes, traced values."""

    power: Float[Array, "ny mx"]
    counted: Float[Array, "ny mx"]
    taper_y: Float[Array, "2 ny"]
    taper_x: Float[Array, "2 nx"]
    y: Float[Array, "2 ny"]
    x: Float[Array, "2 nx"]
    scale: Float[Array, ""]
    low: Float[Array, " P"]
    high: Float[Array, " P"]


def noise_covariance(
    u: Float[Array, " P"], y: Float[Array, " ny"], x: Float[Array, " nx"], white: bool = True
) -> Float[Array, "ny nx"]:
    """Covariance of the noise at lags, of heights over the scan's deviation."""
    r2 = y[:, None] ** 2 + x[None, :] ** 2
    lone_y, lone_x = (y == 0.0).astype(u.dtype)[:, None], (x == 0.0).astype(u.dtype)[None, :]
    # The origin has no derivative of its power.
    log_r2 = jnp.log(jnp.where(r2 > 0, r2, 1.0))
    power = jnp.exp(jax.nn.sigmoid(u[3]) * (log_r2 - 2.0 * u[2]))
    correlation = jnp.where(r2 > 0, jnp.exp(-power), 1.0)
    out = jnp.exp(2.0 * u[1]) * correlation + jnp.exp(2.0 * u[4]) * lone_y
    return out + jnp.exp(2.0 * u[0]) * lone_y * lone_x if white else out


def surface_covariance(
    surface: Surface, y: Float[Array, " ny"], x: Float[Array, " nx"], scale: Float[Array, ""]
) -> Float[Array, "ny nx"]:
    """Covariance of a random surface at lags, over the square of a height.

    Ridges: the sum over orders of 2 |h_m|^2 cos(2 pi m r / period) exp(-g_m (1 - rho(r))), h_m
    the profile's Fourier coefficients, g_m and rho as in `diffopt.gratings.Ridges`.
    """
    r2 = y[:, None] ** 2 + x[None, :] ** 2
    if isinstance(surface, Roughness):
        return (surface.rms / scale) ** 2 * jnp.exp(-r2 / surface.correlation_length**2)
    assert isinstance(surface, Ridges)
    grating = surface.grating
    kappa = jnp.broadcast_to(_KAPPA / scale, (_ORDERS,))
    order = jnp.arange(1, _ORDERS + 1, dtype=jnp.int32)
    power = 2.0 * grating.order_efficiency(order, kappa) / _KAPPA**2
    wave = 2.0 * math.pi / grating.period
    across = jnp.cos(grating.angle) * x[None, :] + jnp.sin(grating.angle) * y[:, None]
    apart = 1.0 - jnp.exp(-r2 / surface.correlation_length**2)

    def line(total: Array, part: tuple[Array, Array]) -> tuple[Array, None]:
        m, p = part
        g = (m * wave * surface.displacement) ** 2
        return total + p * jnp.cos(m * wave * across) * jnp.exp(-g * apart), None

    total, _ = jax.lax.scan(line, jnp.zeros_like(r2), (order.astype(r2.dtype), power))
    return total


def _expected(u: Array, data: _Data, surface: Surface | None, names: tuple[str, ...]) -> Array:
    def at(k: int, l: int) -> Array:
        cov = noise_covariance(u, data.y[k], data.x[l])
        if surface is not None:
            drawn = decoded(u[NOISE:], surface, names, data.scale)
            cov = cov + surface_covariance(drawn, data.y[k], data.x[l], data.scale)
        return cov * data.taper_y[k][:, None] * data.taper_x[l][None, :]

    wrapped = at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1)
    spectrum = jnp.fft.rfft2(wrapped).real
    return jnp.maximum(spectrum, 10.0 * jnp.finfo(u.dtype).eps * spectrum.max())


@eqx.filter_jit
def _maximise(
    u: Array, data: _Data, surface: Surface | None, names: tuple[str, ...], steps: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Fisher's scoring with damping.

    Parameters, deviance, information, whether it ended, and the least deviance up to each of at
    most `_STEPS` steps, NaN beyond the last.
    """

    def log_spectrum(v: Array) -> Array:
        return jnp.log(_expected(v, data, surface, names))

    def deviance(v: Array) -> tuple[Array, Array, Array]:
        logs, derivative = jax.linearize(log_spectrum, v)
        rows = jax.lax.map(derivative, jnp.eye(v.size, dtype=v.dtype))
        ratio = data.power * jnp.exp(-logs)
        weighted = rows * data.counted[None]
        slope = jnp.einsum("ayx,yx->a", weighted, 1.0 - ratio, precision="highest")
        matrix = jnp.einsum("ayx,byx->ab", weighted, rows, precision="highest")
        return (data.counted * (logs + ratio)).sum(), slope, matrix

    # Of the deviance: a hundredth is a tenth of a standard error.
    tolerance = 1e-2 if u.dtype == jnp.float64 else 1e-1

    def body(state: Any) -> Any:
        v, value, slope, matrix, damping, k, _, curve = state
        # A parameter at its bound that wants to go beyond is held.
        held = ((v <= data.low) & (slope > 0)) | ((v >= data.high) & (slope < 0))
        move = (~held).astype(v.dtype)
        reduced = matrix * move[:, None] * move[None, :]
        diagonal = jnp.diagonal(matrix) * (1.0 + damping) + 1e-3 * data.counted.mean()
        system = reduced - jnp.diag(jnp.diagonal(reduced)) + jnp.diag(diagonal)
        step = jnp.clip(-jnp.linalg.solve(system, slope * move), -1.0, 1.0)
        trial = jnp.clip(v + step, data.low, data.high)
        new = deviance(trial)
        better = new[0] < value
        fall = value - new[0]
        done = (better & (fall < tolerance)) | (~better & (damping > 1e6))
        kept = jax.tree.map(
            lambda a, b: jnp.where(better, a, b), (trial, *new), (v, value, slope, matrix)
        )
        curve = curve.at[k].set(kept[1])
        return (*kept, jnp.where(better, damping / 5.0, damping * 6.0), k + 1, done, curve)

    first = deviance(u)
    curve = jnp.full((_STEPS,), jnp.nan, first[0].dtype)
    start = (u, *first, jnp.asarray(1e-2, u.dtype), jnp.zeros((), jnp.int32), False, curve)
    out = jax.lax.while_loop(lambda s: ~s[6] & (s[5] < steps), body, start)
    return out[0], out[1], out[3], out[6], out[7]


def _taper(n: int) -> np.ndarray:
    t = (np.arange(n) + 0.5) / n
    edge = np.minimum(np.minimum(t, 1.0 - t) / _TAPER, 1.0)
    return np.sin(0.5 * np.pi * edge) ** 2


def _axis(n: int, step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Lags [2, n] that wrap onto one another, their taper, the taper, and its efficiency."""
    taper = _taper(n)
    square = (taper**2).sum()
    full = np.correlate(taper, taper, "full") / square
    lags = np.stack([np.arange(n), np.arange(n) - n]) * step
    weight = np.stack([full[n - 1 :], np.concatenate([[0.0], full[: n - 1]])])
    return lags, weight, taper / math.sqrt(square), square**2 / (n * (taper**4).sum())


def fit(
    rest: np.ndarray,
    scan: Scan,
    surface: Surface | None,
    *,
    drift: bool,
    dtype: Any,
    starts: list[Surface] | None = None,
    max_steps: int = _STEPS,
) -> Field:
    """Fit noise, and a random surface, to heights less what is not random.

    Parameters
    ----------
    rest
        [ny, nx] in micrometres, complete.
    scan
        Gives pixel and scale.
    surface
        `Roughness` or `Ridges`, or None.
    drift
        Whether lines have offsets.
    dtype
        Of the computation.
    starts
        Of the surface; the best end is taken.
    max_steps
        Of each start, 80 at most.
    """
    (ny, nx), (dy, dx) = rest.shape, scan.pixel
    lag_y, weight_y, taper_y, share_y = _axis(ny, dy)
    lag_x, weight_x, taper_x, share_x = _axis(nx, dx)
    values = (rest - rest.mean()) / scan.scale
    window = taper_y[:, None] * taper_x[None, :]
    # The mean under the window leaks into the lowest frequencies.
    values = values - (values * window).sum() / window.sum()
    power = np.abs(np.fft.rfft2(values * window)) ** 2
    counted = np.full(power.shape, 2.0)
    counted[:, 0] = 1.0
    if nx % 2 == 0:
        counted[:, -1] = 1.0
    # A plane was removed: it took from the lowest frequencies.
    counted[np.ix_([0, 1, -1], [0, 1])] = 0.0
    counted *= share_y * share_x
    count = float(counted.sum())
    deviation = max(float(values.std()), 1e-6)
    side = min(ny * dy, nx * dx)
    names = () if surface is None else seen_in_power(surface)
    least, most = 0.3 * min(dy, dx), 2.0 * side
    # Correlation within a pixel is white noise.
    bounds = [(math.log(_WHITE), 2.0), (-9.0, 2.0), (math.log(max(dy, dx)), math.log(most))]
    bounds.append((-2.0, 4.0))
    bounds.append((-9.0, 2.0) if drift else (-30.0, -30.0))
    for name in names:
        kind = kinds(surface)[name] if surface is not None else ""
        bounds.append(
            {
                "length": (math.log(least), math.log(most)),
                "share": (-4.0, 4.0),
                "height": (-10.0, 10.0),
            }.get(kind, (-10.0, 10.0))
        )
        if name == "rms":
            bounds[-1] = (math.log(1e-4 * scan.scale), math.log(10.0 * scan.scale))
    if isinstance(surface, Ridges):
        _keep_ridges(bounds, names, surface)
    low, high = np.array(bounds).T
    arrays = {
        "power": power, "counted": counted, "taper_y": weight_y, "taper_x": weight_x,
        "y": lag_y, "x": lag_x, "scale": scan.scale, "low": low, "high": high,
    }  # fmt: skip
    data = _Data(**{name: jnp.asarray(value, dtype) for name, value in arrays.items()})
    top = float(np.quantile(power[ny // 4 : -(ny // 4), nx // 4 :], 0.5)) / math.log(2.0)
    white = math.log(max(math.sqrt(top), 1e-3 * deviation))
    line = math.log(0.05 * deviation) if drift else -30.0
    best = None
    for start in [None] if surface is None else (starts or [surface]):
        for length in (2.0 * dx, 0.05 * side) if surface is None else (0.05 * side,):
            share = 0.9 if surface is None else 0.2
            u = [white, math.log(share * deviation), math.log(length), 1.0, line]
            if start is not None:
                u += list(encoded(start, names, scan.scale))
            u = jnp.asarray(np.clip(u, low, high), dtype)
            shape = None if start is None else jax.tree.map(lambda a: jnp.asarray(a, dtype), start)
            steps = jnp.asarray(min(max_steps, _STEPS), jnp.int32)
            found = [np.asarray(a) for a in _maximise(u, data, shape, names, steps)]
            if np.isfinite(found[1]) and (best is None or found[1] < best[0][1]):
                best = (found, shape)
    assert best is not None
    (u, value, matrix, done, curve), shape = best
    u = np.asarray(u, float)
    fitted, covariance = None, np.zeros((0, 0))
    if shape is not None:
        scale = jnp.asarray(scan.scale, dtype)
        fitted = decoded(jnp.asarray(u[NOISE:], dtype), shape, names, scale)
        # Minus half the deviance has half its curvature: the information is matrix / 2.
        inside = (u > low) & (u < high)
        information = np.where(np.outer(inside, inside), 0.5 * np.asarray(matrix, float), 0.0)
        full = np.linalg.pinv(information, hermitian=True, rcond=1e-10)
        factor = natural(u[NOISE:], fitted, names, scan.scale)
        covariance = full[NOISE:, NOISE:] * np.outer(factor, factor)
    rms = np.exp(u[[0, 1, 4]]) * scan.scale
    noise = {
        "white": float(rms[0]),
        "correlated": float(rms[1]),
        "length": float(np.exp(u[2])),
        "hurst": float(1.0 / (1.0 + np.exp(-u[3]))),
        "lines": float(rms[2]) if drift else 0.0,
        "rough": float(fitted.rms) if isinstance(fitted, Roughness) else 0.0,
        "rough_length": float(fitted.correlation_length) if isinstance(fitted, Roughness) else 0.0,
    }
    curve = np.asarray(curve, float)
    return Field(
        surface=fitted,
        names=names,
        u=u,
        noise=noise,
        deviance=float(value),
        count=count,
        covariance=covariance,
        converged=bool(done),
        curve=curve[~np.isnan(curve)],
    )


def _keep_ridges(
    bounds: list[tuple[float, float]], names: tuple[str, ...], surface: Ridges
) -> None:
    """Bounds within which ridges follow one another: else they stand for any rough surface."""
    period, angle = float(surface.grating.period), float(surface.grating.angle)
    at = {name: NOISE + k for k, name in enumerate(names)}
    bounds[at["grating.period"]] = (math.log(0.75 * period), math.log(1.33 * period))
    bounds[at["grating.angle"]] = (angle - 0.3, angle + 0.3)
    # g below 0.9: the line keeps 40 % of its power.
    bounds[at["displacement"]] = (math.log(1e-3 * period), math.log(0.15 * period))
    bounds[at["correlation_length"]] = (math.log(0.15 * period), math.log(20.0 * period))


def lags(field: Field, scan: Scan) -> np.ndarray:
    """Covariance of the noise without its white part, [2 ny, 2 nx] in the FFT's order, um^2."""
    ny, nx = scan.heights.shape
    y = np.fft.fftfreq(2 * ny, 0.5 / ny) * scan.pixel[0]
    x = np.fft.fftfreq(2 * nx, 0.5 / nx) * scan.pixel[1]
    dtype = jnp.result_type(float)
    u = jnp.asarray(field.u[:NOISE], dtype)
    cov = noise_covariance(u, jnp.asarray(y, dtype), jnp.asarray(x, dtype), white=False)
    if isinstance(field.surface, Roughness):
        rough = field.surface
        half = (jnp.asarray(v, dtype) for v in (y, x, scan.scale))
        rough = Roughness(*(float(rough.get(n)) for n in ("rms", "correlation_length")))
        cov = cov + surface_covariance(rough, *half)
    return np.asarray(cov, float) * scan.scale**2
