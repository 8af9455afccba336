"""Cards of materials: polar plot of f cos, colours of the albedo, what is declared."""

import dataclasses
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from diffopt import checks, costs
from diffopt.baking import Box
from diffopt.choice import PreparedBRDF
from diffopt.diffraction import DiffractionBRDF
from diffopt.drawing import lobes
from diffopt.errors import InputError
from diffopt.materials.base import Material
from diffopt.materials.diffracting import Diffraction
from diffopt.materials.naming import Subject
from diffopt.materials.report import carrying_power, direction
from diffopt.previews import colours, markup, polar
from diffopt.previews.bundles import NoCardError

#: Angles of the light in the plot, and of the swatches, degrees.
LIGHTS, SWATCHES = (0.0, 30.0, 60.0), (0.0, 60.0)
#: Viewing angles of a curve; nodes of the albedo's rule on an axis.
VIEWS, NODES = 361, 16
#: Predicted seconds beyond which a picture is left out.
PATIENCE = 0.5
# Parameters and letters of each that are listed.
_LISTED, _LETTERS = 12, 80


def card(material: Material) -> markup.Markup:
    """HTML of a material.

    Raises
    ------
    NoCardError
        If a parameter is traced or its values are not finite.
    """
    pairs = [("channels", _channels(material)), *_declared(material), *_parameters(material)]
    name = type(material).__name__
    seconds = _seconds(material)
    if seconds > PATIENCE:
        words = (
            f"No picture: it would take some {seconds:.2g} s. `prepare(output='spectral', "
            "pairs=...)` makes a faster one of a DiffractionBRDF."
        )
        return markup.card(name, None, markup.key_figures(pairs), markup.note(words))
    try:
        # Pictures need no more than float32.
        material = material.typed(jnp.float32)
        subject = Subject(name, material, _wavelengths(material))
    except InputError as reason:
        return markup.card(
            name, None, markup.key_figures(pairs), markup.note(f"No picture: {reason}")
        )
    parts = [markup.key_figures(pairs)]
    with jax.enable_x64(False):
        albedo = carrying_power(material).albedo(_ways(np.array(SWATCHES)), NODES)
        xyz = subject.xyz(np.asarray(albedo))
        if not np.isfinite(xyz).all():
            raise NoCardError("its albedo is not finite")
        if not xyz.any():
            return markup.card(name, None, *parts, markup.note("It scatters no light."))
        drawn = _drawn(subject) if material.smooth else _stems(subject)
    labels = [f"{a:g}°: {_luminance(c)}" for a, c in zip(SWATCHES, xyz, strict=True)]
    parts.append(colours.row(colours.swatches(xyz, labels)))
    words = (
        "Squares: the albedo by the angle of the light, under D65; Y = 1 is a perfect reflector."
    )
    if material.delta and material.smooth:
        words += " Light in single directions (mirror, refraction) is in the albedo alone."
    return markup.card(name, drawn, *parts, markup.note(words))


def _drawn(subject: Subject) -> markup.Markup:
    """Polar plots of f cos of the viewer, by its luminance where it is coloured."""
    material = subject.material
    end = 180.0 if material.transmits else 90.0
    at = np.linspace(-end, end, VIEWS)
    # Peaks near the mirror direction and the straight one; the number of angles is one.
    curves = []
    for k, angle in enumerate(LIGHTS):
        near = np.concatenate([-np.geomspace(0.03, 8.0, 45)[::-1], np.geomspace(0.03, 8.0, 45)])
        extra = np.concatenate([near - angle, near + 180.0 - angle, [-angle]])
        degrees = np.sort(np.concatenate([at, np.clip(extra, -end, end)]))
        wo, wi = _ways(degrees), np.broadcast_to(direction(angle), (len(degrees), 3))
        values = subject.xyz(np.asarray(material.f(wi.astype(np.float32), wo)))[:, 1]
        values = values * np.abs(np.asarray(wo, np.float64)[:, 2])
        if not np.isfinite(values).all():
            raise NoCardError(f"its values for light at {angle:g}° are not finite")
        label = f"light at {angle:g}°: peak {values.max():.3g}"
        at_radians = np.radians(degrees)
        curves.append(polar.Curve(at_radians, values, f"C{k}", label, mark=math.radians(angle)))
    what = "f cos θ" if material.channels in ((), (1,)) else "luminance of f cos θ"
    titles = (f"{what}, over each peak", f"{what}, logarithmic, 1/sr")
    figure = polar.plot(curves, titles, whole=material.transmits, relative=True)
    alt = f"{what} of {subject.name} over the viewing angle, for light at 0, 30 and 60 degrees"
    return markup.picture(figure, alt, most=markup.MOST)


def _stems(subject: Subject) -> markup.Markup:
    """Lines in the single directions of mirrors and glass, as long as their share of the power."""
    figure = lobes._stems(subject, LIGHTS)
    alt = f"Directions and shares of the power of {subject.name}, for light at 0, 30 and 60 degrees"
    return markup.picture(figure, alt, width=360, most=markup.MOST)


def _ways(degrees: np.ndarray) -> np.ndarray:
    """Directions in the plane y = 0, float32."""
    angles = np.radians(degrees)
    return np.stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)], -1).astype(np.float32)


def _declared(material: Material) -> list[tuple[str, str]]:
    return [
        ("reciprocal", _said(material.reciprocal)),
        ("energy", "conserved" if material.conserves_energy else "not promised"),
        ("in single directions", "yes" if material.delta else "no"),
        ("transmits", _said(material.transmits)),
    ]


def _said(holds: bool) -> str:
    return "yes" if holds else "no"


def _channels(material: Material) -> str:
    shape, lam = material.channels, _wavelengths(material)
    if lam is not None:
        return f"{len(lam)} wavelengths, {1000.0 * lam[0]:.4g} to {1000.0 * lam[-1]:.4g} nm"
    known = {(): "1 (scalar)", (1,): "1", (3,): "3 (linear RGB)"}
    return known[shape] if shape in known else f"{shape[0]}, of unknown wavelengths"


def _wavelengths(material: Material) -> np.ndarray | None:
    """Of the channels, from the material or one that it is made of; None for scalars and RGB."""
    shape = material.channels
    for part in _parts(material):
        lam = checks.concrete(getattr(part, "wavelengths", None))
        if lam is not None and lam.ndim == 1 and lam.shape == shape and len(lam) > 1:
            # Linear RGB of a prepared BRDF, at three wavelengths, is RGB.
            if isinstance(part, Diffraction) and part._rgb:
                continue
            return np.asarray(lam, np.float64)
    return None


def _parts(thing: Any) -> list[Material]:
    """A material and all within it."""
    found = [thing] if isinstance(thing, Material) else []
    inner = thing if isinstance(thing, tuple | list) else None
    if inner is None and isinstance(thing, eqx.Module):
        inner = [getattr(thing, field.name) for field in dataclasses.fields(thing)]
    for part in inner or ():
        if isinstance(part, Material | tuple | list):
            found += _parts(part)
    return found


def _parameters(material: Material) -> list[tuple[str, str]]:
    """Fields in few words; large arrays by their shape."""
    out = []
    for field in dataclasses.fields(material)[:_LISTED]:
        if not field.name.startswith("_") and field.name != "wavelengths":
            value = getattr(material, field.name)
            if value is not None:
                out.append((field.name, _short(value)))
    return out


def _short(value: Any) -> str:
    if isinstance(value, jax.Array | np.ndarray):
        array = np.asarray(value)
        if array.size <= 4:
            said = [markup.number(number) for number in array.ravel().astype(float)]
            return said[0] if array.size == 1 else f"({', '.join(said)})"
        return f"{'×'.join(map(str, array.shape))} values"
    if isinstance(value, tuple | list) and value:
        return ", ".join(_short(one) for one in value[:4]) + (", …" if len(value) > 4 else "")
    if isinstance(value, PreparedBRDF):
        return f"prepared, method {value.choice.method}"
    if isinstance(value, eqx.Module):
        return type(value).__name__
    text = str(value)
    return text if len(text) <= _LETTERS else text[: _LETTERS - 1] + "…"


def _seconds(material: Material) -> float:
    """What the picture's diffraction takes, by the model behind `prepare`; 0 for the rest."""
    nodes = len(SWATCHES) * NODES * NODES * len(material.choices)
    pairs = len(LIGHTS) * (VIEWS + 181) + nodes
    total = 0.0
    for part in _parts(material):
        if isinstance(part, Diffraction):
            total += _diffraction(part.brdf, part.wavelengths, pairs)
    return total


def _diffraction(brdf: DiffractionBRDF | PreparedBRDF, lam: Array, pairs: int) -> float:
    from diffopt.settings import DirectSettings

    prepared = isinstance(brdf, PreparedBRDF)
    surface = brdf.brdf.surface if prepared else brdf.surface
    return costs.cost(
        surface,
        brdf.settings if prepared else DirectSettings(),
        pairs=pairs,
        wavelengths=len(lam),
        box=Box((-2.0, 2.0), (-2.0, 2.0), (-2.0, 0.0)),
        shortest=float(jnp.min(lam)),
        channels=3 if prepared and brdf.output == "xyz" else len(lam),
    ).run_s


def _luminance(xyz: np.ndarray) -> str:
    return f"{float(xyz[1]):.3g}"
