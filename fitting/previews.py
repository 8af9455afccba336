"""Cards of fits for notebooks: parameters with their errors, what the data tell, a small picture.

Made from what a result holds: nothing is fitted anew.
"""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from diffopt.drawing import surface_fits
from diffopt.fitting.freeform.result import HeightsFit
from diffopt.fitting.lobe_table import LobeComparison
from diffopt.fitting.lobes import LobeFit
from diffopt.fitting.measured import COLOURS, Measured
from diffopt.fitting.ranked import Ranked
from diffopt.fitting.reflectance.answers import DETERMINED, ReflectanceFit
from diffopt.fitting.reflectance.profiles import Profile
from diffopt.fitting.scans.fit import ScanFit
from diffopt.gratings import Surface
from diffopt.gratings.parametric import KINDS, kinds
from diffopt.previews import heights, lobes, markup
from diffopt.previews.bundles import NoCardError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

#: Pixels of the drawn surface on an axis, and how often its longest length fits in.
DRAWN, LENGTHS = 160, 6.0
#: Directions drawn of a measurement, members of a ranking, and lobe fits of a table.
DOTS, RANKS, ROWS = 4000, 9, 40

_UNITS = {"um": "µm", "1/um^2": "1/µm²"}


def lobe_card(fit: LobeFit) -> markup.Markup:
    """HTML of a fit of lobes, of one function or a batch."""
    error = np.atleast_1d(np.asarray(fit.error, np.float64)).ravel()
    if not np.isfinite(error).all():
        raise NoCardError("its error is not finite")
    settled = np.atleast_1d(np.asarray(fit.settled)).ravel()
    some = f"{int(settled.sum())} of {settled.size}" if settled.any() else "no"
    pairs = [
        ("relative L2 error", _spread(error)),
        (
            "energy off before it was restored",
            _spread(np.abs(np.asarray(fit.energy_error)).ravel()),
        ),
        ("method", fit.method),
        ("steps", str(int(np.max(fit.steps)))),
        ("settled", "yes" if settled.all() else some),
    ]
    if fit.brdf is not None:
        return lobes.brdf_card(fit.brdf, *pairs, name="LobeFit")
    one = fit.lobes
    if one.kappa.ndim == 1:
        picture, *rest = lobes.single(one)
        return markup.card(f"LobeFit: {one.count} lobes", picture, markup.key_figures(pairs), *rest)
    shape = "×".join(map(str, one.kappa.shape[:-1]))
    flat = lobes._flat(one)
    worst = int(error.argmax())
    picture, *rest = lobes.single(flat[worst])
    pairs = [("functions", shape), *pairs, *lobes.spread(flat)]
    words = markup.note(f"Picture and table: function {worst}, the one with the largest error.")
    title = f"LobeFit: {one.count} lobes for each of {shape} functions"
    return markup.card(title, picture, markup.key_figures(pairs), *rest, words)


def comparison_card(found: LobeComparison) -> markup.Markup:
    """HTML of a comparison of lobe fits: error against time, and the rows."""
    from diffopt.accuracy import output

    figure = found.plot()
    picture = markup.picture(figure, f"Lobes on {found.job}", width=620, most=markup.MOST)
    columns = ("lobes", "method", "type", "error", "worst", "batch", "alone", "done", "settings")
    rows = [
        (
            str(row.lobes),
            row.method,
            row.dtype,
            f"{row.error:.4f}",
            f"{row.worst:.3f}",
            output.seconds(row.time_s),
            output.seconds(row.single_s),
            "" if row.success is None else f"{row.success:.0%}",
            row.note,
        )
        for row in found.rows[:ROWS]
    ]
    words = markup.note("Times are per slice, in a batch and alone, without compilation.")
    return markup.card(f"Lobes on {found.job}", picture, markup.table(columns, rows), words)


def scan_card(fit: ScanFit) -> markup.Markup:
    """HTML of a parametric fit to a scan."""
    noise = ", ".join(f"{name} {_length(v)}" for name, v in fit.noise.items() if _rms(name) and v)
    pairs = [
        *_verdict(fit.converged, fit.reason),
        ("explained variance", f"{100.0 * float(fit.goodness):.4g} %"),
        ("rms of the residual", f"{_length(_rms_of(fit.residual))}"),
        ("noise, rms", noise or "none"),
        ("tilt along y, x", ", ".join(markup.number(value, 3) for value in fit.tilt)),
    ]
    return _surface_card("ScanFit", fit.model, fit, pairs, fit.ranking)


def reflectance_card(fit: ReflectanceFit) -> markup.Markup:
    """HTML of a parametric fit to reflectance."""
    pairs = [
        *_verdict(fit.converged, fit.reason),
        ("misfit", markup.number(fit.loss)),
        (
            "chi² per degree of freedom",
            "noise not known" if fit.chi2 is None else f"{fit.chi2:.3g}",
        ),
        ("gain", markup.number(fit.gain)),
        ("minima", f"{len(fit.minima)}, from {sum(one.starts for one in fit.minima)} starts"),
        ("steps", str(fit.steps)),
    ]
    return _surface_card("ReflectanceFit", fit.model, fit, pairs, fit.ranking)


def heights_card(fit: HeightsFit) -> markup.Markup:
    """HTML of a fit of every height: the surface, and how the loss fell."""
    field = fit.heightfield
    known = np.asarray(field.heights, np.float64)
    if known.ndim != 2 or not np.isfinite(known).all():
        raise NoCardError("its heights are not finite")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.9, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    heights.height_map(left, known, field.pixel)
    loss = np.asarray(fit.history, np.float64)
    right.plot(np.arange(len(loss)), loss, "o-", ms=3, lw=1.1)
    if (loss > 0.0).all():
        right.set_yscale("log")
    _small(right, "block of steps", "loss")
    alt = f"Fitted heights, {field.shape[1]} x {field.shape[0]} pixels, and the loss by steps"
    pairs = [
        *_verdict(fit.converged, fit.reason),
        ("misfit", markup.number(fit.misfit["relative"])),
        ("chi² per value", markup.number(fit.misfit["chi2"], 3)),
        ("gain", markup.number(fit.gain)),
        ("weight of the prior", markup.number(fit.weight)),
        ("steps", str(fit.steps)),
        *heights.figures(known, field.pixel),
    ]
    if fit.error_map is not None:
        error = np.asarray(fit.error_map, np.float64)
        pairs.append(("standard error of a height", f"{_length(float(np.median(error)))}, median"))
    picture = markup.picture(figure, alt, most=markup.MOST)
    return markup.card("HeightsFit", picture, markup.key_figures(pairs))


def profile_card(profile: Profile) -> markup.Markup:
    """HTML of a profile of the loss over one parameter."""
    loss = np.asarray(profile.loss, np.float64)
    if not np.isfinite(loss).any():
        raise NoCardError("no loss is finite")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6, 3.0), layout="constrained")
    axes = figure.subplots()
    best = float(profile.values[int(np.nanargmin(loss))])
    axes.plot(profile.values, loss, ".-", ms=3, lw=1.1)
    at = np.isin(profile.values, profile.minima)
    axes.plot(profile.values[at], loss[at], "v", ms=6, mfc="none", color="C3", label="minima")
    if np.nanmax(loss) > 5.0 * np.nanmin(loss) > 0.0:
        axes.set_yscale("log")
    axes.legend(fontsize=7, frameon=False)
    _small(axes, profile.name, "misfit")
    pairs = [
        ("parameter", profile.name),
        ("values", f"{len(loss)}, {_from_to(profile.values)}"),
        ("least misfit", f"{markup.number(np.nanmin(loss))} at {markup.number(best, 6)}"),
        ("minima", ", ".join(markup.number(v, 6) for v in profile.minima[:8])),
        ("fitted beside it", ", ".join(profile.others)),
    ]
    if profile.chi2 is not None:
        # Where chi^2 is by 1 above its least: a standard error on either side.
        near = profile.values[profile.chi2 <= profile.chi2.min() + 1.0]
        pairs.append(("within a standard error", _from_to(near, digits=6)))
    alt = f"Misfit over {profile.name}, least at {best:.5g}"
    picture = markup.picture(figure, alt, most=markup.MOST)
    return markup.card(f"Profile over {profile.name}", picture, markup.key_figures(pairs))


def ranked_card(one: Ranked) -> markup.Markup:
    """HTML of a row of a ranking."""
    return markup.card(f"Ranked: {one.name}", None, _ranking((one,)))


def measured_card(data: Measured) -> markup.Markup:
    """HTML of measured reflectance: where its directions are, wavelengths, noise."""
    values = np.asarray(data.values, np.float64)
    if values.ndim != 2 or not np.isfinite(values).all():
        raise NoCardError("its values are not finite [M, C]")
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    figure = Figure(figsize=(4.3, 3.5), layout="constrained")
    axes = figure.subplots()
    for ring in (30, 60, 90):
        radius = math.sin(math.radians(ring))
        axes.add_patch(Circle((0.0, 0.0), radius, fc="none", ec="0.7", lw=0.6))
        axes.text(0.0, radius, f"{ring}°", fontsize=6, color="0.45", ha="center", va="center")
    wi, wo = (np.asarray(w, np.float64) for w in (data.wi, data.wo))
    mean = values.mean(1)
    step = max(math.ceil(len(wo) / DOTS), 1)
    order = np.argsort(mean[::step])
    shown, dots = mean[::step][order], wo[::step][order]
    norm = _log_norm(shown)
    size = float(np.clip(6000.0 / len(dots), 2.0, 24.0))
    style = {"cmap": "viridis", "norm": norm, "lw": 0}
    points = axes.scatter(dots[:, 0], dots[:, 1], c=shown, s=size, label="viewers", **style)
    lights = np.unique(wi.round(6), axis=0)
    some = lights[:: max(math.ceil(len(lights) / 200), 1)]
    star = {"ms": 9, "mfc": "white", "mec": "C3", "mew": 1.2, "zorder": 4}
    axes.plot(some[:, 0], some[:, 1], "*", label="lights", **star)
    bar = figure.colorbar(points, ax=axes, shrink=0.85)
    bar.set_label("mean over the channels", fontsize=7)
    bar.ax.tick_params(labelsize=7)
    axes.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
    _small(axes, "direction cosine x", "direction cosine y")
    axes.grid(visible=False)
    figure.legend(fontsize=7, frameon=False, loc="outside lower center", ncols=2)
    lam = 1000.0 * np.asarray(data.wavelengths, np.float64)
    noise = np.asarray(data.noise, np.float64) / max(float(np.abs(values).max()), 1e-300)
    said = f"{_spread(noise)} of the largest value" if noise.max() != noise.min() else None
    said = said or f"{markup.number(noise.flat[0], 3)} of the largest value, for all alike"
    known = "absolute" if data.noise_known else "known up to a factor only"
    angles = [np.degrees(np.arccos(np.clip(w[:, 2], -1.0, 1.0))) for w in (wi, wo)]
    of = "of the integral " if data.quantity in COLOURS else ""
    pairs = [
        ("values", f"{values.shape[0]} pairs of directions × {values.shape[1]} channels"),
        ("quantity", data.quantity),
        ("lights", f"{len(lights)}, {_from_to(angles[0], '°')} to the normal"),
        ("viewers", f"{len(np.unique(wo.round(6), axis=0))}, {_from_to(angles[1], '°')}"),
        ("wavelengths", f"{of}{len(lam)}, {_from_to(lam)} nm"),
        ("range", _from_to(values)),
        ("noise", f"{said}; {known}"),
        ("coherence σₛ", f"{float(data.coherence):.4g} µm"),
        ("blur", markup.number(data.blur)),
        ("gain", data.gain),
    ]
    alt = f"{len(wo)} viewing directions over the hemisphere, by their mean value"
    picture = markup.picture(figure, alt, most=markup.MOST)
    return markup.card("Measured reflectance", picture, markup.key_figures(pairs))


def _surface_card(
    kind: str,
    model: Surface,
    fit: ScanFit | ReflectanceFit,
    pairs: list[tuple[str, str]],
    ranking: tuple[Ranked, ...],
) -> markup.Markup:
    parts = [markup.key_figures(pairs), _parameters(model, fit.errors, fit.identifiable)]
    if ranking:
        parts.append(_ranking(ranking))
        if len(ranking) > RANKS:
            parts.append(markup.note(f"The best {RANKS} of {len(ranking)} models."))
    if model.RANDOM:
        parts.append(markup.note("The map is one draw of the fitted random surface."))
    picture = markup.picture(
        _drawn(model), f"Heights of the fitted {model.title} surface", most=markup.MOST
    )
    return markup.card(f"{kind}: {type(model).__name__}", picture, *parts)


def _drawn(model: Surface) -> "Figure":
    """A few periods of a surface, and the profile across its lines."""
    from matplotlib.figure import Figure

    of = kinds(model)
    lengths = [abs(float(model.get(name))) for name, kind in of.items() if kind == "length"]
    lengths = [length for length in lengths if math.isfinite(length) and length > 0.0]
    if not lengths:
        raise NoCardError("the fitted surface has no length")
    # The longest may belong to a slow wander: no more than some of the others.
    extent = LENGTHS * min(max(lengths), 6.0 * min(lengths))
    pixel = extent / DRAWN
    key = jax.random.key(0) if model.RANDOM else None
    found = np.asarray(model.heights((DRAWN, DRAWN), pixel, key=key), np.float64)
    if not np.isfinite(found).all():
        raise NoCardError("the fitted surface's heights are not finite")
    angle = next((float(model.get(name)) for name in of if name.split(".")[-1] == "angle"), 0.0)
    figure = Figure(figsize=(5.9, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.25, 1.0))
    heights.height_map(left, found, (pixel, pixel))
    if model.RANDOM:
        along, shown = (np.arange(DRAWN) + 0.5) * pixel, found[DRAWN // 2]
        words = "x / µm, along the middle row"
    else:
        shift, along = surface_fits._richest(found, (pixel, pixel), angle)
        line = surface_fits._line(found.shape, (pixel, pixel), angle, shift, along)
        shown = surface_fits._at(found, (pixel, pixel), line)
        left.plot(line[1], line[0], color="C3", lw=1.0, ls=":")
        words = "across the lines / µm (dotted)"
    right.plot(along, 1000.0 * (shown - found.mean()), lw=1.0, color="C3")
    right.set_xlim(float(along[0]), float(along[-1]))
    _small(right, words, "height / nm")
    return figure


def _parameters(
    model: Surface, errors: Mapping[str, float], identifiable: Mapping[str, str]
) -> markup.Markup:
    """Each parameter with its standard error, unit, and what the data tell of it."""
    of, rows, dimmed = kinds(model), [], []
    for k, (name, kind) in enumerate(of.items()):
        unit = KINDS[kind][0]
        error = errors.get(name)
        if error is None:
            said = "—"
            dimmed.append(k)
        else:
            said = "unknown" if math.isnan(error) else markup.number(error, 2)
        value = markup.number(float(model.get(name)), 6)
        words = identifiable.get(name, "not fitted" if error is None else DETERMINED)
        rows.append((name, value, said, _UNITS.get(unit, unit), words))
    columns = ("parameter", "value", "standard error", "unit", "identifiable")
    return markup.table(columns, rows, dimmed=dimmed)


def _ranking(ranking: tuple[Ranked, ...]) -> markup.Markup:
    rows = [
        (
            one.name,
            markup.number(one.difference),
            markup.number(one.criterion, 6),
            str(one.parameters),
            markup.number(one.misfit, 3),
            "yes" if one.converged else "no",
            one.reason,
        )
        for one in ranking[:RANKS]
    ]
    columns = ("model", "Δ BIC", "BIC", "parameters", "misfit", "converged", "reason")
    return markup.table(columns, rows, strong=(0,) if len(rows) > 1 else ())


def _verdict(converged: bool, reason: str) -> list[tuple[str, str]]:
    return [("converged", "yes" if converged else "no"), ("reason", reason)]


def _small(axes: "Axes", xlabel: str, ylabel: str) -> None:
    axes.tick_params(which="both", labelsize=7)
    axes.set_xlabel(xlabel, fontsize=8)
    axes.set_ylabel(ylabel, fontsize=8)
    axes.grid(alpha=0.3)


def _log_norm(values: np.ndarray) -> Any:
    """Four decades below the largest; linear where none is positive."""
    from matplotlib.colors import LogNorm, Normalize

    high = float(values.max())
    if not high > 0.0:
        return Normalize(float(values.min()), high or 1.0)
    return LogNorm(max(1e-4 * high, min(float(values.min()), 0.5 * high)), high, clip=True)


def _rms(name: str) -> bool:
    return name in ("white", "correlated", "lines", "rough")


def _rms_of(residual: Any) -> float:
    return float(np.sqrt(np.nanmean(np.asarray(residual, np.float64) ** 2)))


def _length(micrometres: float) -> str:
    return f"{1000.0 * float(micrometres):.3g} nm"


def _spread(values: np.ndarray) -> str:
    """One number, or the mean with the range."""
    if values.size == 1:
        return markup.number(values.flat[0], 3)
    ends = f"{markup.number(values.min(), 3)} to {markup.number(values.max(), 3)}"
    return f"{markup.number(values.mean(), 3)} ({ends})"


def _from_to(values: np.ndarray, unit: str = "", digits: int = 4) -> str:
    low, high = (markup.number(end, digits) for end in (np.min(values), np.max(values)))
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"
