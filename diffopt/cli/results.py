"""``result.npz`` and ``result.json`` of a job: numbers with their units and history."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from diffopt import __version__, colour
from diffopt.cli.options import Job
from diffopt.cli.progress import Stages
from diffopt.drawing import tones, views

UNITS = {
    "wi": "unit vector to the light",
    "wo": "unit vectors to the viewer",
    "angles": "radians",
    "wavelengths": "um",
    "spectra": "1/sr",
    "xyz_in_plane": "f cos_i in 1/sr, weighted to XYZ",
    "xyz_hemisphere": "f cos_i in 1/sr, weighted to XYZ",
    "cosines_hemisphere": "direction cosines of rows (y) and columns (x) of xyz_hemisphere",
    "heights": "um",
    "pixel": "um (y, x)",
}


@dataclasses.dataclass(frozen=True)
class Peak:
    """A bright direction of the in-plane cut: angle in degrees, wavelength in nm, sRGB hex."""

    angle_deg: float
    wavelength_nm: float
    rgb: str


def write_arrays(path: Path, job: Job, cut: views.InPlane, dome: views.Hemisphere) -> None:
    """Write ``result.npz``; the entry ``attributes`` is JSON with units and provenance."""
    relative = "relative reflectance, weighted to XYZ" if job.options.balance == "peak" else None
    units = UNITS if relative is None else {**UNITS, "xyz_in_plane": relative}
    attributes = {"units": units, "provenance": dataclasses.asdict(job.scan.provenance)}
    np.savez_compressed(
        path,
        wi=cut.wi,
        wo=cut.wo,
        angles=cut.angles,
        wavelengths=cut.wavelengths,
        spectra=cut.spectra.astype(np.asarray(job.scan.heights).dtype),
        xyz_in_plane=cut.xyz,
        xyz_hemisphere=dome.xyz.astype(np.float32),
        cosines_hemisphere=dome.line,
        heights=np.asarray(job.scan.heights),
        pixel=np.asarray(job.scan.pixel),
        attributes=np.array(json.dumps(attributes)),
    )


def summary(job: Job, cut: views.InPlane, stages: Stages) -> dict[str, Any]:
    """What ``result.json`` holds."""
    import jax

    choice = cut.choice
    times = {
        name: {"compile_s": round(t.compile_s, 4), "run_s": round(t.run_s, 4)}
        for name, t in stages.times.items()
    }
    return {
        "versions": {
            "diffopt": __version__,
            "jax": jax.__version__,
            "numpy": np.__version__,
        },
        "units": {"lengths": "um", "angles": "degrees", "f": "1/sr", "times": "s"},
        "provenance": dataclasses.asdict(job.scan.provenance),
        "settings": {
            **dataclasses.asdict(job.options),
            "azimuth": math.degrees(job.azimuth),
            "coherence": job.sigma,
            "blur": float(job.brdf.surface.blur),
            "dtype": str(job.scan.heights.dtype),
        },
        "statistics": dataclasses.asdict(job.statistics),
        "method": {
            "name": choice.method,
            "settings": dataclasses.asdict(choice.settings),
            "choice": str(choice),
            "tolerance": choice.tolerance,
            "error_bound": choice.error_bound,
            "patch_error": 0.0 if job.periodic else choice.patch_error,
        },
        "brightest": [dataclasses.asdict(peak) for peak in peaks(cut, job.illuminant)],
        "times": times,
        "notes": list(job.notes),
        "warnings": list(job.warnings),
    }


def write_summary(path: Path, content: dict[str, Any]) -> None:
    """Write ``result.json``."""
    path.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def peaks(cut: views.InPlane, illuminant: colour.IlluminantLike, most: int = 5) -> list[Peak]:
    """Brightest local maxima of the luminance over the viewing angle, brightest first."""
    y = cut.xyz[:, 1]
    inner = np.flatnonzero((y[1:-1] > y[:-2]) & (y[1:-1] >= y[2:])) + 1
    inner = inner[np.argsort(-y[inner])][:most]
    weights = np.asarray(colour.spectral_weights(cut.wavelengths, illuminant=illuminant))[:, 1]
    found = []
    for index in inner:
        shade = tones.swatch(cut.xyz[index], illuminant)
        seen = cut.spectra[index] * weights
        centre = float((cut.wavelengths * seen).sum() / seen.sum())
        code = "#" + "".join(f"{round(255 * float(c)):02x}" for c in shade)
        found.append(Peak(round(math.degrees(cut.angles[index]), 2), round(1000 * centre, 1), code))
    return found
