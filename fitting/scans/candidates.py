"""The models that compete for a scan: each is started, fitted and scored in its own way."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from diffopt import gratings
from diffopt.errors import InputError
from diffopt.fitting.reflectance import templates
from diffopt.fitting.scans import codes as scan_codes
from diffopt.fitting.scans import disc as scan_disc
from diffopt.fitting.scans import errors as scan_errors
from diffopt.fitting.scans import noise as scan_noise
from diffopt.fitting.scans import register as scan_register
from diffopt.fitting.scans import squares as scan_squares
from diffopt.fitting.scans.convention import canonical, transformed
from diffopt.fitting.scans.noise import Field
from diffopt.fitting.scans.random_surfaces import bumps, ridges, roughness
from diffopt.fitting.scans.register import Scan
from diffopt.fitting.scans.setting import Candidate, Setting, law
from diffopt.gratings import (
    Binary,
    Blazed,
    CompactDisc,
    Crossed,
    Grating,
    Parametric,
    Roughness,
    Sinusoidal,
    Surface,
)

_KINDS = {
    kind.__name__.lower(): kind
    for kind in vars(gratings).values()
    if isinstance(kind, type) and issubclass(kind, Surface)
}
MODELS: dict[str, type[Surface]] = {name: _KINDS[name] for name in templates.AUTO}
# A second start is tried if it explains this share of what the first does.
_RIVAL = 0.7


def wanted(model: Any) -> list[tuple[str, Surface | None]]:
    """Names and starts of what is to be fitted.

    Raises
    ------
    InputError
        If a model is not known or says nothing about one scan.
    """
    if isinstance(model, str) and model == "auto":
        return [(name, None) for name in MODELS]
    if isinstance(model, Sequence) and not isinstance(model, str):
        if not model:
            raise InputError("model: expected at least one, received an empty sequence")
        return [one for part in model for one in wanted(part)]
    known = ", ".join(MODELS)
    if isinstance(model, str):
        if model not in MODELS:
            raise InputError(f"model={model!r}: expected 'auto' or one of {known}")
        return [(model, None)]
    kind, start = (model, None) if isinstance(model, type) else (type(model), model)
    name = kind.__name__.lower()
    if isinstance(kind, type) and issubclass(kind, gratings.Jittered):
        raise InputError(
            "model: one scan shows one domain of a jittered grating; fit its grating, or ridges"
        )
    if MODELS.get(name) is not kind:
        raise InputError(f"model={kind.__name__}: expected one of {known}")
    return [(name, start)]


def run(name: str, start: Surface | None, setting: Setting, before: list[Candidate]) -> Candidate:
    """Fit one model.

    Parameters
    ----------
    name, start
        Of `wanted`.
    setting
        The scan and how to fit.
    before
        Candidates that are done; a crossed grating starts from the best grating.
    """
    kind = MODELS[name]
    if name == "roughness":
        return roughness(start, setting)
    if name == "bumps":
        return bumps(setting)
    if not setting.vectors and start is None:
        return Candidate(name, "The power spectrum has no peak to start from.")
    if name == "ridges":
        return ridges(start, setting)
    if name == "compactdisc":
        return _disc(setting)
    if name == "crossed":
        return _crossed(start, setting, before)
    assert issubclass(kind, Grating)
    starts = [start] if start is not None else _starts(kind, setting)
    return _scored(name, _best(starts, setting), setting)


def _left(rest: np.ndarray, setting: Setting) -> Field:
    """What a surface leaves: noise, or noise and Gaussian roughness, by the criterion."""
    plain = law(rest, None, setting)
    step, deviation = math.sqrt(setting.coarse.pixel[0] * setting.coarse.pixel[1]), rest.std()
    starts = [Roughness(0.7 * float(deviation), reach * step) for reach in (3.0, 10.0)]
    rough = law(rest, starts[0], setting, starts)
    return min(plain, rough, key=lambda f: f.deviance + (len(f.names) * math.log(f.count)))


def _starts(kind: type[Grating], setting: Setting) -> list[Surface]:
    found = []
    make: Any = kind
    for vector in setting.vectors:
        profile = scan_register.folded(setting.scan, vector)
        values, gain = scan_register.start(kind, profile, vector)
        found.append((gain, make(**values)))
    found.sort(key=lambda pair: -pair[0])
    return [s for gain, s in found[:2] if gain >= _RIVAL * found[0][0]]


def _squares(
    scan: Scan, start: Parametric, setting: Setting, steps: int, precision: float | None = None
) -> scan_squares.Squares:
    return scan_squares.fit(
        scan,
        start,
        drift=setting.drift,
        robust=setting.robust,
        edges=setting.edges,
        max_steps=steps,
        dtype=setting.dtype,
        precision=precision,
    )


def _best(starts: Sequence[Parametric], setting: Setting) -> scan_squares.Squares:
    """Fit from each start to averaged pixels, and the best end."""
    found = [_squares(setting.coarse, start, setting, setting.max_steps) for start in starts]
    return min(found, key=lambda f: float(np.abs(f.rest[setting.coarse.known]).mean()))


def refined(candidate: Candidate, setting: Setting) -> Candidate:
    """The model fitted to all pixels from its fit to averaged ones."""
    start = candidate.coarse
    assert start is not None
    fine = _squares(setting.scan, start.surface, setting, setting.max_steps)
    fine = dataclasses.replace(fine, curve=np.concatenate([start.curve, fine.curve]))
    return _scored(candidate.name, fine, setting)


def _scored(
    name: str, found: scan_squares.Squares, setting: Setting, nuisances: int = 0
) -> Candidate:
    """Noise of what is left, criterion and standard errors of a fit by least squares."""
    scan, dtype = setting.scan, setting.dtype
    y, x = jnp.asarray(scan.y, dtype), jnp.asarray(scan.x, dtype)
    heights = np.asarray(
        scan_codes.field(found.surface, y, x, scan.pixel, setting.edges), np.float64
    )
    # Neighbours in other lines fill a pixel once the lines are level.
    lines = found.lines
    if lines.shape != scan.y.shape:
        lines = np.repeat(lines, setting.factor)
        lines = np.concatenate([lines, np.full(len(scan.y) - len(lines), lines[-1])])
    level = scan.heights - heights - lines[:, None]
    left = scan_register.filled(level, scan.known) + lines[:, None]
    rest = dataclasses.replace(scan, heights=left).binned(setting.factor)
    field = _left(rest.flat, setting)
    plane = found.plane[0] + found.plane[1] * scan.y[:, None] + found.plane[2] * scan.x[None, :]
    residual = level - plane
    whole = residual + heights
    full = found.lines.shape == scan.y.shape
    grid = scan if full else setting.coarse
    # Averages over blocks have less white noise; pixels that are filled have none.
    scatter = field.noise["white"] ** 2 / max(float(setting.coarse.known.mean()), 0.1)
    white = scatter * (setting.factor**2 if full else 1)
    encoded = scan_errors.covariance(
        found, grid, setting.edges, scan_noise.lags(field, grid), white, dtype
    )
    factor = scan_codes.natural(found.u, found.surface, found.names, scan.scale)
    covariance = encoded * np.outer(factor, factor)
    model, covariance = _conventional(found, covariance)
    model = _with_offset(model, float(found.plane[0]))
    known = scan.known
    explained = 1.0 - float(residual[known].var() / max(whole[known].var(), 1e-300))
    count = len(found.names) + nuisances + scan_noise.NOISE + len(field.names)
    converged = found.converged and field.converged
    if not found.converged:
        reason = f"Least squares did not come to an end in {setting.max_steps} steps."
    elif not field.converged:
        reason = "The likelihood of the noise did not reach its maximum, so errors are not known."
    else:
        reason = f"Least squares came to an end after {found.steps} steps."
    return Candidate(
        name=name,
        reason=reason,
        converged=converged,
        model=model,
        names=found.names,
        covariance=covariance,
        tilt=(float(found.plane[1]), float(found.plane[2])),
        lines=lines,
        residual=residual,
        noise=field.noise,
        criterion=field.deviance + count * math.log(field.count),
        parameters=count,
        rms=float(residual[known].std()),
        goodness=explained,
        curve=found.curve,
        coarse=None if full or not found.converged or nuisances else found,
    )


def _conventional(
    found: scan_squares.Squares, covariance: np.ndarray
) -> tuple[Parametric, np.ndarray]:
    surface = found.surface
    if not isinstance(surface, Crossed):
        values, change = canonical(surface)
        return surface.replaced(values), transformed(covariance, found.names, change)
    all_values, all_change = {}, {}
    for part in ("first", "second"):
        values, change = canonical(getattr(surface, part))
        all_values |= {f"{part}.{name}": value for name, value in values.items()}
        all_change |= {
            f"{part}.{name}": {f"{part}.{other}": slope for other, slope in row.items()}
            for name, row in change.items()
        }
    return surface.replaced(all_values), transformed(covariance, found.names, all_change)


def _with_offset(model: Parametric, constant: float) -> Parametric:
    if isinstance(model, Crossed):
        both = float(model.get("first.offset")) + float(model.get("second.offset")) + constant
        return model.replaced({"first.offset": both, "second.offset": 0.0})
    if "offset" not in model.PARAMETERS:
        return model
    return model.replaced({"offset": float(model.get("offset")) + constant})


def _crossed(start: Surface | None, setting: Setting, before: list[Candidate]) -> Candidate:
    """The best grating, and what suits best of what it leaves."""
    if start is not None:
        return _scored("crossed", _best([start], setting), setting)
    done = [c for c in before if isinstance(c.model, Grating)]
    if not done:
        done = [run("sinusoidal", None, setting, before)]
    first = min(done, key=lambda c: c.criterion)
    if not isinstance(first.model, Grating):
        return Candidate("crossed", "No first grating was found.")
    rest = dataclasses.replace(setting.scan, heights=np.where(
        setting.scan.known, first.residual, 0.0
    ))  # fmt: skip
    angle, found = float(first.model.angle), []
    for vector in scan_register.wave_vectors(rest):
        if abs(math.sin(math.atan2(vector[0], vector[1]) - angle)) < 0.05:
            continue
        profile = scan_register.folded(rest, vector)
        for kind in (Sinusoidal, Binary, Blazed):
            values, gain = scan_register.start(kind, profile, vector)
            # A sinusoid unless another explains more.
            found.append((gain * (1.02 if kind is Sinusoidal else 1.0), kind(**values)))
    if not found:
        return Candidate("crossed", "What a grating leaves has no peak in another direction.")
    second = max(found, key=lambda pair: pair[0])[1]
    return _scored("crossed", _best([Crossed(first.model, second)], setting), setting)


def _disc(setting: Setting) -> Candidate:
    try:
        pits = scan_disc.find(setting.coarse, setting.vectors)
    except InputError as error:
        return Candidate("compactdisc", f"The scan shows no tracks: {error}.")
    found = _squares(setting.coarse, pits, setting, setting.max_steps)
    curve = [found.curve]
    for _ in range(2):
        assert isinstance(found.surface, scan_disc.Pits)
        better = scan_disc.ends(found.surface, setting.coarse, found.rest)
        found = _squares(setting.coarse, better, setting, setting.max_steps, found.precision)
        curve.append(found.curve)
    found = dataclasses.replace(found, curve=np.concatenate(curve))
    scored = _scored("compactdisc", found, setting, 2 * len(pits.track))
    last = found.surface
    assert isinstance(last, scan_disc.Pits)
    bit, error = scan_disc.bit(last, setting.coarse)
    assert scored.model is not None
    values = {name: float(scored.model.get(name)) for name in found.names}
    values |= {"bit": bit, "offset": float(found.plane[0])}
    model = CompactDisc(**{n: jnp.asarray(v, setting.dtype) for n, v in values.items()})
    names = (*found.names, "bit")
    covariance = np.zeros((len(names), len(names)))
    covariance[:-1, :-1] = scored.covariance
    covariance[-1, -1] = error**2
    return dataclasses.replace(scored, model=model, names=names, covariance=covariance)
