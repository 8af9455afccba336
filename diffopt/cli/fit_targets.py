"""What ``diffopt fit lobes`` is given: a material, an environment map, or samples.

Files are told apart by what they hold:

=============  ==================================================================
map            ``.exr`` (extra ``exr``), ``.hdr``, ``.png`` (sRGB), ``.npy`` [H, W] or
               [H, W, C], radiance; first row at the zenith, columns from azimuth 0
samples        ``.npy`` [N, 3] or, with weights, [N, 4]; ``.npz`` with ``directions`` and
               perhaps ``weights``; ``.csv`` with columns x, y, z and perhaps weight
material       every other ``.csv`` and ``.npz``, and ``.binary``, ``.bsdf``, ``.pbsdf``
=============  ==================================================================
"""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from diffopt import checks
from diffopt.cli import material as material_command
from diffopt.cli.limits import refuse_enormous
from diffopt.drawing import tones
from diffopt.drawing.lobe_fits import Function, in_blocks
from diffopt.errors import InputError
from diffopt.io import environments, numpy_files
from diffopt.io.files import existing_file
from diffopt.materials import naming, scattered
from diffopt.materials.base import Material

#: Maps with more rows are averaged down before the fit.
MOST_ROWS = 256
#: Suffixes of maps.
MAPS = environments.SUFFIXES

_SAMPLES = "[N, 3] directions, or [N, 4] with weights"


@dataclasses.dataclass(frozen=True)
class Target:
    """What lobes are fitted to.

    Attributes
    ----------
    name
        As it was asked for; of a file without folders.
    kind
        ``material``, ``map`` or ``samples``.
    content
        A `Subject`, an image [H, W, C], or directions [N, 3] with weights [N] or None.
    notes
        What was assumed.
    """

    name: str
    kind: Literal["material", "map", "samples"]
    content: Any
    notes: tuple[str, ...] = ()


def read(word: str, chosen: dict[str, Any]) -> Target:
    """What is meant by a name or a file.

    Parameters
    ----------
    word
        As typed.
    chosen
        Options of named materials; None for those not given.

    Raises
    ------
    InputError
        For what is neither, cannot be read, or has no lobes.
    """
    path = Path(word)
    suffix = path.suffix.lower()
    if word not in naming.NAMES and suffix in (*MAPS, ".npy", ".npz", ".csv"):
        existing_file(path)
        refuse_enormous(path)
        found = _file(path, suffix)
        used = [name for name, value in chosen.items() if value is not None]
        if found is not None and used:
            raise InputError(f"--{used[0]} is for named materials; {word} is a file")
        if found is not None:
            return found
    known = word in naming.NAMES or path.exists() or suffix in naming.SUFFIXES
    if not known:
        raise InputError(f"{naming.unknown(word)}; a map or samples ({', '.join(MAPS)}, .npy)")
    subject = material_command.subject(word, chosen)
    if subject.material.delta:
        raise InputError(
            f"{word}: perfect mirrors and refraction have no width, and no lobes; take a rough "
            "material"
        )
    # Some notes are about the picture of a sphere.
    notes = tuple(note for note in subject.notes if "the sphere" not in note)
    return Target(subject.name, "material", subject, notes)


def reflected(material: Material, wo: Float[np.ndarray, "3"]) -> Function:
    """F(wi, wo) |cos theta_i| against wi, 1/sr, the mean of the channels, in float32."""
    viewer = np.broadcast_to(wo.astype(np.float32), (tones.BLOCK, 3))

    def values(wi: np.ndarray) -> np.ndarray:
        f = np.asarray(material.f(wi.astype(np.float32), viewer), np.float64)
        return f.reshape(len(wi), -1).mean(-1) * np.abs(wi[:, 2])

    return lambda directions: in_blocks(values, directions)


def _file(path: Path, suffix: str) -> Target | None:
    """A map or samples, None for a table of a material."""
    if suffix == ".csv":
        return _text(path)
    if suffix in (".npy", ".npz"):
        return _arrays(path, suffix)
    return _map(path, environments.read(path))


def _text(path: Path) -> Target | None:
    columns = scattered._text(path)
    if not {"x", "y", "z"} <= set(columns):
        return None
    others = set(columns) - {"x", "y", "z", "weight"}
    if others:
        raise InputError(
            f"{path}: samples have columns x, y, z and perhaps weight; received "
            f"{', '.join(sorted(others))} too"
        )
    directions = np.stack([columns[name] for name in "xyz"], -1)
    return _samples(path, directions, columns.get("weight"))


def _arrays(path: Path, suffix: str) -> Target | None:
    if suffix == ".npz":
        content = numpy_files.archive(path)
        if "directions" not in content:
            return None
        if "values" in content:
            raise InputError(
                f"{path}: values at directions need solid angles, see diffopt.fitting.fit_table; "
                "samples have directions and perhaps weights"
            )
        return _samples(path, content["directions"], content.get("weights"))
    found = numpy_files.array(path)
    if found.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected real numbers; received {found.dtype}")
    if found.ndim == 2 and found.shape[1] in (3, 4):
        return _samples(path, found[:, :3], found[:, 3] if found.shape[1] == 4 else None)
    if found.ndim not in (2, 3) or min(found.shape[:2]) < 4:
        raise InputError(
            f"{path}: expected a map [H, W] or [H, W, C], or {_SAMPLES}; received {found.shape}"
        )
    return _map(path, found)


def _samples(path: Path, directions: np.ndarray, weights: np.ndarray | None) -> Target:
    for name, values in (("directions", directions), ("weights", weights)):
        if values is not None and values.dtype.kind not in "fiu":
            raise InputError(f"{path}: {name} must be real numbers; received {values.dtype}")
    directions = np.asarray(directions, np.float64)
    if directions.ndim != 2 or directions.shape[1] != 3 or not len(directions):
        raise InputError(f"{path}: expected {_SAMPLES}; received {directions.shape}")
    checks.directions(f"{path}: directions", directions)
    if weights is not None:
        weights = np.asarray(weights, np.float64)
        if weights.shape != directions.shape[:1]:
            raise InputError(
                f"{path}: weights must be [{len(directions)}]; received {weights.shape}"
            )
        if not (np.isfinite(weights) & (weights >= 0.0)).all():
            raise InputError(f"{path}: weights must be finite and >= 0")
        if not weights.any():
            raise InputError(f"{path}: all weights are zero")
    return Target(path.name, "samples", (directions, weights))


def _map(path: Path, image: np.ndarray) -> Target:
    """A map that can be fitted: finite, not negative, not too fine."""
    image, said = environments.checked(path, image)
    notes = list(said)
    height, width = image.shape[:2]
    block = -(-height // MOST_ROWS)
    if block > 1:
        height, width = height // block, width // block
        image = image[: height * block, : width * block]
        image = image.reshape(height, block, width, block, -1).mean((1, 3))
        notes.append(f"averaged to {width} x {height} pixels")
    return Target(path.name, "map", image, tuple(notes))
