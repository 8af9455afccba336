"""Random surfaces, windows, directions and wavelengths for `diffopt.choice.prepare`.

What is prepared within a tolerance is compared with the direct sum in float64 on the same
heights: the largest difference over the largest value of the job.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from diffopt import candidates, choice, colour
from diffopt.accuracy.promises import Answer, Draw, Promise, refusal
from diffopt.baking import Box
from diffopt.candidates import METHODS, Candidate, Job
from diffopt.diffraction import DiffractionBRDF, Output, evaluate
from diffopt.errors import InputError
from diffopt.fresnel import Conductor, Constant, Dielectric
from diffopt.heightfield import Heightfield
from diffopt.settings import DirectSettings

#: Shapes of the heightfields; few, as each compiles programs of its own.
SHAPES = ((48, 48), (64, 64), (40, 72))
PIXELS = (0.08, 0.15, 0.3)
#: Heights from lowest to highest, micrometres: up to 20 wavelengths.
DEPTHS = (0.01, 8.0)
_KINDS = ("rough", "noise", "binary", "blazed", "sinusoidal", "crossed", "scratched")
# Pairs of a job, and those at the mirror direction among them.
_PAIRS = 24
# Where cheaper settings are looked for: within so many times the tolerance.
_LOOSER = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)


def heights(rng: np.random.Generator, kind: str, shape: tuple[int, int]) -> np.ndarray:
    """Heights of a kind from 0 to 1.

    Parameters
    ----------
    rng
        For all that is left to chance.
    kind
        rough (correlated Gaussian noise), noise (each sample alone), binary, blazed,
        sinusoidal, crossed (two sines) or scratched (a plane with grooves).
    shape
        Of the array.
    """
    ny, nx = shape
    y, x = np.mgrid[:ny, :nx].astype(np.float64)
    turn, periods = rng.uniform(0, np.pi), rng.integers(2, 9)
    along = (x * np.cos(turn) / nx + y * np.sin(turn) / ny) * periods + rng.uniform()
    if kind == "noise":
        found = rng.uniform(size=shape)
    elif kind == "rough":
        fy, fx = np.fft.fftfreq(ny)[:, None], np.fft.fftfreq(nx)[None]
        length = rng.uniform(1.0, 8.0)
        keep = np.exp(-2.0 * (np.pi * length) ** 2 * (fx * fx + fy * fy) / 4.0)
        found = np.fft.ifft2(np.fft.fft2(rng.normal(size=shape)) * keep).real
    elif kind == "binary":
        found = (along % 1.0 < rng.uniform(0.2, 0.8)).astype(np.float64)
    elif kind == "blazed":
        found = along % 1.0
    elif kind == "sinusoidal":
        found = np.sin(2.0 * np.pi * along)
    elif kind == "crossed":
        other = x * rng.integers(1, 6) / nx + y * rng.integers(1, 6) / ny
        found = np.sin(2.0 * np.pi * along) + rng.uniform(0.2, 1.0) * np.cos(2.0 * np.pi * other)
    else:
        found = np.ones(shape)
        for place in rng.uniform(size=rng.integers(1, 5)):
            found -= np.exp(-(((along / periods - place) * rng.uniform(20, 60)) ** 2))
    span = found.max() - found.min()
    return (found - found.min()) / (span if span > 0.0 else 1.0)


def directions(rng: np.random.Generator, count: int, largest: float) -> Float[np.ndarray, "n 3"]:
    """Unit vectors within so many degrees of the normal, even in solid angle."""
    cos = rng.uniform(np.cos(np.radians(largest)), 1.0, count)
    phi = rng.uniform(0.0, 2.0 * np.pi, count)
    sin = np.sqrt(1.0 - cos * cos)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], -1)


def pairs(rng: np.random.Generator, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """Random pairs, a third of them near the mirror direction."""
    wi = directions(rng, _PAIRS, largest)
    wo = directions(rng, _PAIRS, largest)
    near = _PAIRS // 3
    moved = wi[:near] * [-1.0, -1.0, 1.0] + rng.normal(scale=0.03, size=(near, 3))
    moved[:2] = wi[:2] * [-1.0, -1.0, 1.0]
    moved[:, 2] = np.abs(moved[:, 2])
    wo[:near] = moved / np.linalg.norm(moved, axis=-1, keepdims=True)
    return wi, wo


def model(rng: np.random.Generator, dtype: Any) -> tuple[DiffractionBRDF, str]:
    """A random model, and what it is."""
    kind = str(rng.choice(_KINDS))
    shape = SHAPES[rng.integers(len(SHAPES))]
    pixel = float(rng.choice(PIXELS))
    depth = float(np.exp(rng.uniform(*np.log(DEPTHS))))
    scan = Heightfield(jnp.asarray(depth * heights(rng, kind, shape), dtype), (pixel, pixel))
    coverage = str(rng.choice(["positions", "window", "patch"], p=[0.55, 0.25, 0.2]))
    # From little more than a pixel to half the patch.
    sigma = float(np.exp(rng.uniform(np.log(1.5 * pixel), np.log(0.5 * pixel * min(shape)))))
    options: dict[str, Any] = {}
    if coverage == "positions":
        options["blur"] = float(rng.choice([0.0, 0.0023, 0.02]))
        options["mirror"] = str(rng.choice(["included", "included", "apart"]))
    if coverage == "window":
        place = rng.uniform(-0.3, 0.3, 2) * pixel * np.array(shape)
        options["position"] = (float(place[0]), float(place[1]))
    fresnel = (Constant(), Dielectric(1.5), Conductor([0.3, 0.5, 0.9], [1.5, 0.6, 0.2], [2, 3, 6]))
    brdf = DiffractionBRDF(
        scan,
        None if coverage == "patch" else sigma,
        average="window" if coverage == "window" else "positions",
        prefactor=str(rng.choice(["stam", "rohs", "rghs", "kirchhoff"])),
        shadowing=str(rng.choice(["none", "v-cavity"])),
        balance=str(rng.choice(["radiometric", "peak"])),
        fresnel=fresnel[rng.integers(3)],
        **options,
    )
    named = f"{kind} {shape[0]}x{shape[1]}, {depth:.2g} um deep, {np.dtype(dtype).name}"
    return brdf, f"{named}, {coverage}" + (
        "" if coverage == "patch" else f", coherence {sigma:.2g} um"
    )


def in_double(brdf: DiffractionBRDF) -> DiffractionBRDF:
    """The same model on the same heights in float64."""
    return jax.tree.map(lambda a: jnp.asarray(a, "float64"), brdf)


def _answer(draw: Draw, outputs: tuple[Output, ...]) -> Answer:
    rng = draw.rng
    brdf, named = model(rng, rng.choice(["float32", "float64"]))
    output = outputs[rng.integers(len(outputs))]
    counted = bool(rng.uniform() < 0.3)
    wi, wo = pairs(rng, 75.0 if counted else 89.0)
    gradient = str(rng.choice(["none", "none", "directions", "model"]))
    wanted = "auto" if rng.uniform() < 0.5 else str(rng.choice(METHODS))
    if output == "xyz":
        lam = colour.wavelengths(float(rng.choice([10.0, 20.0])))
    else:
        lam = np.sort(rng.uniform(0.36, 0.83, int(rng.choice([1, 3, 6]))))
    words = [named, output, f"method {wanted}", f"gradient {gradient}"]
    words.append("pairs counted" if counted else "pairs given")
    weights = colour.spectral_weights(lam) if output == "xyz" else None
    right = _direct(brdf, wi, wo, lam, output, weights)
    largest = float(right.max())
    asked = {"wavelengths": lam, "output": output, "gradient": gradient}
    try:
        prepared = choice.prepare(
            brdf,
            # A table over every pair above the horizon would be baked for each of them.
            pairs=1000 if counted and wanted != "table" else (wi, wo),
            tolerance=draw.tolerance,
            method=wanted,
            **asked,
        )
    except InputError as error:
        return refusal(", ".join(words), error)
    if counted:
        # Relative to the largest value of the job, of which these pairs are a part.
        more = choice.sample_pairs(256)
        largest = max(largest, float(_direct(brdf, *more, lam, output, weights).max()))
    found = np.asarray(prepared(wi, wo), np.float64)
    error = float(np.abs(found - right).max()) / largest
    words.append(f"chose {prepared.settings}")
    price = None
    if draw.priced and not counted and wanted == "auto":
        job = Job(
            brdf,
            wi,
            wo,
            len(wi),
            Box.around(-(wi + wo)),
            lam,
            None if weights is None else np.asarray(weights),
            output,
            draw.tolerance,
            gradient,  # type: ignore[arg-type]
            candidates.gain(brdf, wi, wo, lam, output, weights, draw.tolerance),
        )
        chosen = prepared.choice.setup_s + prepared.choice.run_s
        least = _least(job, chosen, lambda s: _error(job, s, asked, right) <= draw.tolerance)
        price = chosen / least
    return Answer(", ".join(words), error, price=price)


def _direct(brdf, wi, wo, lam, output, weights) -> np.ndarray:
    with jax.enable_x64(True):
        value = evaluate(
            in_double(brdf),
            wi,
            wo,
            lam,
            DirectSettings(),
            output=output,
            weights=None if weights is None else jnp.asarray(weights, "float64"),
        )
        return np.asarray(value)


def _error(job: Job, settings, asked: dict[str, Any], right: np.ndarray) -> float:
    try:
        prepared = choice.prepare(job.brdf, pairs=(job.wi, job.wo), settings=settings, **asked)
    except InputError:
        return np.inf
    found = np.asarray(prepared(job.wi, job.wo), np.float64)
    return float(np.abs(found - right).max() / right.max())


def _least(job: Job, chosen: float, enough) -> float:
    """Predicted cost of the cheapest settings that would have done, at most what was chosen."""
    looser: dict[Any, Candidate] = {}
    for times in _LOOSER:
        loose = dataclasses.replace(job, tolerance=min(times * job.tolerance, 0.5))
        for name in METHODS:
            found = candidates.candidate(loose, name)
            if found.settings is not None and found.total_s < chosen:
                looser[found.settings] = found
    for found in sorted(looser.values(), key=lambda c: c.total_s):
        if enough(found.settings):
            return found.total_s
    return chosen


_REFERENCE = "the direct sum in float64 over the same heights"

SPECTRAL = Promise(
    name="diffraction.spectral",
    entry="DiffractionBRDF.prepare(output='spectral' or 'relative', tolerance=)",
    quantity="largest error of f over its largest value in the job",
    reference=_REFERENCE,
    answer=lambda draw: _answer(draw, ("spectral", "relative")),
)

XYZ = Promise(
    name="diffraction.xyz",
    entry="DiffractionBRDF.prepare(output='xyz', tolerance=)",
    quantity="largest error of XYZ over its largest value in the job",
    reference=_REFERENCE,
    answer=lambda draw: _answer(draw, ("xyz",)),
)
