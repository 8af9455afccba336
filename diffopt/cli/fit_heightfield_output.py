"""What ``diffopt fit heightfield`` leaves: numbers, a table, pictures.

====================  ======================================================
parameters.json       values, errors, covariance, ranking, settings, provenance; strict JSON
parameters.txt        the table, as it is printed
measured_fitted.png   measured against fitted
residual.png          what the fit leaves, over its noise where that is known
loss.png              loss of each start by step
fitted.npz            fitted values or heights, residuals, units in ``attributes``
heights.png           of a fit of every height: start, fit and their difference
====================  ======================================================
"""

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffopt import __version__
from diffopt.cli import fit_heightfield_table
from diffopt.gratings import CompactDisc, Surface
from diffopt.gratings.parametric import KINDS, kinds

if TYPE_CHECKING:
    from diffopt.cli.fit_heightfield import Asked, Subject

_WORDS = {
    "scan": "a scan",
    "reflectance": "reflectance",
    "heights": "every height, from reflectance",
}
_UNITS = {"spectral": "1/sr", "relative": "of a mirror", "power": "of a mirror's peak"}


def plain(value: Any) -> Any:
    """Dictionaries, lists, words and finite numbers; None for what is not finite."""
    if isinstance(value, dict):
        return {str(name): plain(part) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(part) for part in value]
    if isinstance(value, (bool, str, int)) or value is None:
        return value
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return plain(dataclasses.asdict(value))
    array = np.asarray(value)
    if array.ndim:
        return plain(array.tolist())
    number = array.item()
    return number if not isinstance(number, float) or math.isfinite(number) else None


def document(subject: "Subject", asked: "Asked", fit: Any, seconds: float) -> dict[str, Any]:
    """What ``parameters.json`` holds."""
    import jax

    content: dict[str, Any] = {
        "what": _WORDS[subject.kind],
        "converged": bool(fit.converged),
        "reason": fit.reason,
    }
    if subject.kind == "heights":
        h = np.asarray(fit.heightfield.heights, np.float64)
        content |= {
            "heights": {
                "shape": list(h.shape),
                "pixel": list(fit.heightfield.pixel),
                "rms": float(h.std()),
                "peak_to_valley": float(np.ptp(h)),
            },
            "misfit": fit.misfit["relative"],
            "chi2": fit.misfit["chi2"] if subject.data.noise_known else None,
            "gain": fit.gain,
            "weight": fit.weight,
            "steps": fit.steps,
        }
    else:
        content |= _parametric(fit)
    if subject.kind == "scan":
        content |= {
            "misfit": math.sqrt(max(1.0 - float(fit.goodness), 0.0)),
            "goodness": fit.goodness,
            "tilt": list(fit.tilt),
            "noise": fit.noise,
        }
        provenance = dataclasses.asdict(subject.data.provenance)
    else:
        data = subject.data
        provenance = {
            "file": asked.file,
            "pairs": len(data.values),
            "channels": int(data.values.shape[1]),
            "quantity": data.quantity,
            "coherence": float(data.coherence),
            "blur": float(data.blur),
            "gain": data.gain,
            "noise_known": data.noise_known,
        }
        if subject.start is not None:
            provenance["start"] = dataclasses.asdict(subject.start.provenance)
    content |= {
        "units": {
            "lengths": "um",
            "angles": "rad",
            "misfit": "norm of the residuals over that of the data, both over the noise"
            if subject.kind != "scan"
            else "root of the share of the variance of the levelled heights that is not explained",
            "ranking misfit": "um, rms" if subject.kind == "scan" else "as misfit",
            "criterion": "Bayesian information criterion",
        },
        "settings": dataclasses.asdict(asked),
        "provenance": provenance,
        "notes": list(subject.notes),
        "seconds": round(seconds, 3),
        "versions": {"diffopt": __version__, "jax": jax.__version__, "numpy": np.__version__},
    }
    return plain(content)


def _parametric(fit: Any) -> dict[str, Any]:
    errors = fit.errors
    table = {}
    for name, kind in kinds(fit.model).items():
        table[name] = {
            "value": float(fit.model.get(name)),
            "error": errors.get(name),
            "unit": KINDS[kind][0],
            "kind": kind,
            "identifiable": fit.identifiable.get(
                name, f"{name} is not told from the plane that is fitted beside the surface"
            ),
        }
    content = {
        "model": fit.model.title,
        "parameters": table,
        "names": list(fit.names),
        "covariance": np.asarray(fit.covariance, np.float64),
        "ranking": [dataclasses.asdict(row) for row in fit.ranking],
    }
    for name in ("loss", "chi2", "gain", "steps", "minima", "criterion"):
        if hasattr(fit, name):
            found = getattr(fit, name)
            content["misfit" if name == "loss" else name] = (
                [dataclasses.asdict(one) for one in found] if name == "minima" else found
            )
    return content


def write(
    target: Path, subject: "Subject", asked: "Asked", fit: Any, content: dict[str, Any]
) -> None:
    """Write everything into a folder."""
    from rich.console import Console

    from diffopt.drawing import pictures

    text = json.dumps(content, indent=2, allow_nan=False, ensure_ascii=False)
    (target / "parameters.json").write_text(text + "\n", encoding="utf-8")
    with (target / "parameters.txt").open("w", encoding="utf-8") as file:
        fit_heightfield_table.show(
            Console(file=file, width=120, highlight=False, color_system=None), content
        )
    title = f"{Path(asked.file).name}: {content.get('model', 'every height')}"
    if not content["converged"]:
        title += " (no answer)"
    draw = _scan_pictures if subject.kind == "scan" else _reflectance_pictures
    arrays, figures = draw(subject, fit, title)
    if subject.kind == "heights":
        arrays |= _as_heightfield(fit.heightfield.heights, fit.heightfield)
    figures["loss.png"] = _losses(subject, fit, title)
    np.savez_compressed(target / "fitted.npz", **arrays)
    for name, figure in figures.items():
        pictures.save(figure, target / name)


def _losses(subject: "Subject", fit: Any, title: str) -> Any:
    from diffopt.drawing import surface_fits
    from diffopt.fitting.reflectance.templates import NAMED

    if subject.kind == "heights":
        from diffopt.fitting.freeform.stages import BLOCK

        curves = {"fit": np.asarray(fit.history)}
        return surface_fits.losses(title, curves, label="loss", every=BLOCK)
    if subject.kind == "reflectance":
        what = "norm of the residuals over that of the data"
        return surface_fits.losses(title, fit.curves, label=what)
    random = {name for name, make in NAMED.items() if _drawn(make())}
    squares = {name: curve for name, curve in fit.curves.items() if name not in random}
    others = {name: curve for name, curve in fit.curves.items() if name in random}
    return surface_fits.losses(
        title, squares, label="mean weighted square of the residual / µm²", likelihoods=others
    )


def _drawn(surface: Surface) -> bool:
    """Whether a scan is no more than one draw of it: the pits of a disc are the scan's own."""
    return surface.RANDOM and not isinstance(surface, CompactDisc)


def _as_heightfield(heights: Any, scan: Any) -> dict[str, Any]:
    """Entries by which `diffopt.Heightfield.load` knows heights."""
    from diffopt.io.arrays import entries

    return entries(np.asarray(heights), scan.pixel, (*scan.provenance.steps, "fitted"))


def _scan_pictures(
    subject: "Subject", fit: Any, title: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    import jax

    from diffopt.drawing import surface_fits
    from diffopt.fitting.reflectance.templates import lattice

    scan = subject.data
    given = np.asarray(scan.heights, np.float64)
    (ny, nx), (dy, dx) = given.shape, scan.pixel
    y, x = (np.arange(ny) - ny // 2) * dy, (np.arange(nx) - nx // 2) * dx
    offsets = np.asarray(fit.lines, np.float64)
    plane = fit.tilt[0] * y[:, None] + fit.tilt[1] * x + (offsets[:, None] if offsets.size else 0)
    residual = np.asarray(fit.residual, np.float64)
    drawn = _drawn(fit.model)
    if drawn:
        shown = np.asarray(
            fit.model.heights(given.shape, scan.pixel, key=jax.random.key(0)), np.float64
        )
    else:
        shown = given - residual - plane
    paths = lattice(fit.model)
    angle = float(fit.model.get(paths[0][1])) if paths else 0.0
    figures = {
        "measured_fitted.png": surface_fits.scan(
            title, given - plane, shown, scan.pixel, angle=angle, drawn=drawn
        ),
        "residual.png": surface_fits.scan_residual(title, residual, scan.pixel),
    }
    units = {"heights": "um", "residual": "um", "lines": "um", "tilt": "1 (y, x)", "pixel": "um"}
    what = "one draw of the fitted model" if drawn else "fitted, with plane and line offsets"
    heights = shown if drawn else given - residual
    return {
        **_as_heightfield(heights.astype(np.asarray(scan.heights).dtype), scan),
        "residual": np.asarray(fit.residual),
        "lines": offsets,
        "tilt": np.asarray(fit.tilt, np.float64),
        "attributes": np.array(json.dumps({"units": units, "heights": what})),
    }, figures


def _reflectance_pictures(
    subject: "Subject", fit: Any, title: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    from diffopt.drawing import reflectance_fits, surface_fits

    data = subject.data
    measured = np.asarray(data.values, np.float64)
    values = np.asarray(fit.values, np.float64)
    wave = -np.asarray(data.wi + data.wo, np.float64)[:, :2]
    wavelengths = np.asarray(data.wavelengths, np.float64)
    noise = np.asarray(data.noise, np.float64)
    unit = _UNITS.get(data.quantity, f"{data.quantity.upper()} of f")
    width = float(np.median(wavelengths)) / (2.0 * math.pi * float(data.coherence))
    left = values - measured
    if data.noise_known:
        over, of = left / noise, "noise"
    else:
        over, of = 100.0 * left / float(np.abs(measured).max()), "% of the largest value"
    figures: dict[str, Any] = {
        "measured_fitted.png": reflectance_fits.values(
            title,
            wave,
            wavelengths,
            measured,
            values,
            quantity=data.quantity,
            unit=unit,
            width=max(width, float(data.blur)),
            noise=noise if data.noise_known else None,
        ),
        "residual.png": reflectance_fits.residual(
            title, wave, wavelengths, over, quantity=data.quantity, unit=of
        ),
    }
    if subject.kind == "heights":
        figures["heights.png"] = surface_fits.heights(
            title,
            np.asarray(subject.start.heights, np.float64),
            np.asarray(fit.heightfield.heights, np.float64),
            fit.heightfield.pixel,
        )
    units = {"wavelengths": "um", "values": unit, "residual": "fitted less measured, as values"}
    return {
        "wi": np.asarray(data.wi),
        "wo": np.asarray(data.wo),
        "wavelengths": np.asarray(data.wavelengths),
        "values": values.astype(np.asarray(data.values).dtype),
        "residual": left.astype(np.asarray(data.values).dtype),
        "attributes": np.array(json.dumps({"units": units, "quantity": data.quantity})),
    }, figures
