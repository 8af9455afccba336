"""Cards of prepared BRDFs and of the choice of their method."""

import dataclasses
import math

import numpy as np

from diffopt.accuracy import output
from diffopt.choice import Choice, PreparedBRDF
from diffopt.previews import markup
from diffopt.settings import Settings


def card(choice: Choice) -> markup.Markup:
    """HTML of a choice: the method, what it guarantees and costs, and all candidates."""
    return markup.card(f"Choice: {choice.method}", None, *_parts(choice))


def prepared_card(brdf: PreparedBRDF) -> markup.Markup:
    """HTML of a prepared BRDF: its model in a line, and the choice."""
    surface = brdf.brdf.surface
    ny, nx = surface.heights.shape
    lam = 1000.0 * np.asarray(brdf.wavelengths, np.float64)
    dy, dx = (1000.0 * d for d in surface.pixel)
    pixel = f"{dx:.4g}" if dx == dy else f"{dx:.4g} × {dy:.4g}"
    pairs = [
        ("output", {"spectral": "f, 1/sr"}.get(brdf.output, brdf.output)),
        ("wavelengths", f"{len(lam)}, {lam.min():.4g} to {lam.max():.4g} nm"),
        ("surface", f"{nx} × {ny} pixels of {pixel} nm"),
        ("coherence σₛ", f"{float(surface.sigma):.4g} µm"),
    ]
    title = f"PreparedBRDF by the method {brdf.choice.method}"
    return markup.card(title, None, markup.key_figures(pairs), *_parts(brdf.choice))


def _parts(choice: Choice) -> list[markup.Markup]:
    pairs = [
        ("method", choice.method),
        ("settings", _settings(choice.settings)),
        ("job", choice.job),
        ("error bound", f"{_error(choice.error_bound)} (asked {choice.tolerance:.1e})"),
        ("finite patch, apart", f"about {choice.patch_error:.1e}"),
        ("set up, predicted", output.seconds(choice.setup_s)),
        ("run, predicted", output.seconds(choice.run_s)),
        ("memory", f"{choice.nbytes / 1e6:.3g} MB"),
    ]
    rows, out, chosen = [], [], []
    for k, one in enumerate(choice.candidates):
        if one.refused is not None:
            out.append(k)
            rows.append((one.method, "", "", "", "", one.refused))
            continue
        if one.method == choice.method:
            chosen.append(k)
        memory = f"{one.nbytes / 1e6:.3g} MB" if one.nbytes else ""
        costs = (output.seconds(one.setup_s), output.seconds(one.run_s), memory)
        rows.append((one.method, _error(one.bound), *costs, _settings(one.settings)))
    columns = ("method", "error bound", "set up", "run", "memory", "settings, or why it is out")
    return [
        markup.key_figures(pairs),
        markup.table(columns, rows, dimmed=out, strong=chosen),
    ]


def _settings(settings: Settings | None) -> str:
    if settings is None:
        return ""
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    return ", ".join(
        f"{name} {markup.number(value) if isinstance(value, float) else value}"
        for name, value in values.items()
    )


def _error(bound: float) -> str:
    return "none known" if math.isnan(bound) else f"{bound:.1e}"
