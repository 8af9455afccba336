"""Random surfaces that compete for a scan: roughness, bumps and ridges, by likelihood."""

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt.fitting.scans import noise as scan_noise
from diffopt.fitting.scans.convention import canonical
from diffopt.fitting.scans.noise import Field
from diffopt.fitting.scans.setting import Candidate, Setting, law
from diffopt.gratings import Bumps, Ridges, Roughness, Sinusoidal, Surface

# The most that skewness may speak for bumps, twice a log likelihood: other things skew too.
_SKEW = 100.0


def _random(name: str, model: Surface, field: Field, setting: Setting, count: int) -> Candidate:
    scan = setting.scan
    flat = scan.flat
    plane = scan.heights - flat
    half_y, half_x = scan.y[-1] - scan.y[0], scan.x[-1] - scan.x[0]
    tilt = (
        float((plane[-1, 0] - plane[0, 0]) / half_y),
        float((plane[0, -1] - plane[0, 0]) / half_x),
    )
    noise = math.hypot(field.noise["white"], field.noise["correlated"])
    total = flat.var()
    reason = (
        "The likelihood of the spectrum reached its maximum."
        if field.converged
        else "The likelihood of the spectrum did not reach its maximum."
    )
    return Candidate(
        name=name,
        reason=reason,
        converged=field.converged,
        model=model,
        names=field.names,
        covariance=field.covariance,
        tilt=tilt,
        lines=np.zeros(len(scan.y)),
        residual=flat,
        noise=field.noise,
        criterion=field.deviance + (count + scan_noise.NOISE) * math.log(field.count),
        parameters=count + scan_noise.NOISE,
        rms=noise,
        goodness=max(1.0 - noise**2 / total, 0.0),
        deterministic=False,
        curve=field.curve,
    )


def _rough(start: Surface | None, setting: Setting) -> Field:
    if start is not None or "rough" not in setting.shared:
        coarse = setting.coarse
        step = math.sqrt(coarse.pixel[0] * coarse.pixel[1])
        starts: Any = [start] if start is not None else [
            Roughness(0.9 * coarse.scale, factor * step) for factor in (3.0, 10.0)
        ]  # fmt: skip
        setting.shared["rough"] = law(coarse.flat, starts[0], setting, starts)
    return setting.shared["rough"]


def roughness(start: Surface | None, setting: Setting) -> Candidate:
    """Gaussian roughness."""
    field = _rough(start, setting)
    assert field.surface is not None
    return _random("roughness", field.surface, field, setting, 2)


def bumps(setting: Setting) -> Candidate:
    """Bumps have the spectrum of roughness; their skewness tells number from height.

    With size s and number lambda the covariance is lambda pi h^2 s^2 exp(-r^2 / 4 s^2) and the
    skewness 2 / (3 sqrt(lambda pi s^2)) (Campbell's theorem: cumulants of shot noise).
    """
    field = _rough(None, setting)
    assert field.surface is not None
    rms, length = (float(field.surface.get(n)) for n in ("rms", "correlation_length"))
    flat = setting.coarse.flat
    known = setting.coarse.known
    skew = float(((flat - flat[known].mean())[known] ** 3).mean()) / rms**3
    (ny, nx), (dy, dx) = flat.shape, setting.coarse.pixel
    lag_y, lag_x = (np.arange(-n + 1, n) for n in (ny, nx))
    r2 = (lag_y[:, None] * dy) ** 2 + (lag_x[None, :] * dx) ** 2
    overlap = (1.0 - np.abs(lag_y) / ny)[:, None] * (1.0 - np.abs(lag_x) / nx)[None, :]
    # Of Gaussian fields: 6 / n^2 times the sum of cubed correlations.
    variance = 6.0 * float((np.exp(-3.0 * r2 / length**2) * overlap).sum()) / flat.size
    gain = min(skew**2 / variance, _SKEW)
    if abs(skew) < 1e-3:
        skew = math.copysign(1e-3, skew)
    size = 0.5 * length
    density = 4.0 / (9.0 * skew**2 * math.pi * size**2)
    model = Bumps(*(jnp.asarray(v, setting.dtype) for v in (1.5 * skew * rms, size, density)))
    # Height, size and density to rms, length and skewness.
    slope = np.array(
        [
            [1.5 * skew, 0.0, 1.5 * rms],
            [0.0, 0.5, 0.0],
            [0.0, -2.0 * density / length, -2.0 * density / skew],
        ]
    )
    inner = np.zeros((3, 3))
    inner[:2, :2] = field.covariance
    inner[2, 2] = _scatter(flat - flat[known].mean()) / rms**6
    changed = dataclasses.replace(
        field,
        names=("height", "size", "density"),
        covariance=slope @ inner @ slope.T,
        deviance=field.deviance - gain,
        curve=field.curve - gain,
    )
    return _random("bumps", model, changed, setting, 3)


def _scatter(values: np.ndarray) -> float:
    """Variance of the mean cube, from its means over 16 parts of the scan."""
    parts = [
        float((block**3).mean())
        for band in np.array_split(values, 4, 0)
        for block in np.array_split(band, 4, 1)
    ]
    return float(np.var(parts, ddof=1)) / len(parts)


def ridges(start: Surface | None, setting: Setting) -> Candidate:
    """Quasi-periodic ridges about the strongest wave vector; of a sinusoid without a start."""
    starts: list[Any] = [start]
    if start is None:
        period, angle = 1.0 / math.hypot(*setting.vectors[0]), math.atan2(*setting.vectors[0])
        base = Sinusoidal(period, setting.coarse.scale, 0.0, angle)
        starts = [
            Ridges(base, part * period, reach * period)
            for part in (0.04, 0.1)
            for reach in (1.0, 3.0)
        ]
    # Bounds follow the start: each is a fit of its own.
    found = [law(setting.coarse.flat, one, setting) for one in starts]
    field = min(found, key=lambda f: f.deviance)
    model = field.surface
    assert isinstance(model, Ridges)
    free = len(field.names)
    values, _ = canonical(model.grating)
    place = [n for n in values if n in ("phase", "shift")]
    fixed = values | dict.fromkeys(place, 0.0) | {"offset": 0.0}
    model = model.replaced({f"grating.{name}": value for name, value in fixed.items()})
    # Positions are not told.
    names = (*field.names, *(f"grating.{name}" for name in place))
    covariance = np.full((len(names), len(names)), np.nan)
    covariance[:free, :free] = field.covariance
    changed = dataclasses.replace(field, names=names, covariance=covariance)
    return _random("ridges", model, changed, setting, free)
