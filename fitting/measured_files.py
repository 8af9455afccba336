"""Measured reflectance in files: ``.npz``, which keeps all, and ``.csv`` (`measured_text`).

``.npz`` holds wi, wo, wavelengths, values and, if they are known, noise, coherence, blur and
weights (spectra to colours), under the names of `diffopt.fitting.Measured`, and an entry
``attributes``: JSON with ``quantity``, ``noise_known``, ``gain``, ``illuminant`` and ``units`` of
wavelengths and coherence.

sRGB is read, too: values of quantity ``srgb`` from 0 to ``scale`` become linear ``rgb``, their
noise through the derivative of the decoding. A row with a channel at white, or with a channel at
black beside others that are not, was clipped: its true colour is not known, and the row is left
out with a warning. A row that is black in all channels is dark, and stays.
"""

import json
import os
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.fitting import measured_text
from diffopt.fitting.measured import COLOURS, Gain, Measured, Quantity
from diffopt.fitting.measured_text import expected
from diffopt.io import numpy_files
from diffopt.io.files import existing_file, one_line, replacing
from diffopt.io.units import to_micrometres

FORMAT, VERSION = "diffopt measured", 1
#: Quantities of files: sRGB is decoded to ``rgb``.
QUANTITIES = (*get_args(Quantity), "srgb")
#: What may be stated when a file is read, if the file does not.
STATED = (
    "coherence",
    "quantity",
    "noise",
    "noise_known",
    "gain",
    "blur",
    "illuminant",
    "wavelengths",
    "scale",
    "unit",
)

_ARRAYS = ("wi", "wo", "wavelengths", "values", "noise", "coherence", "blur", "weights")
_WORDS = ("quantity", "noise_known", "gain", "illuminant", "scale", "units")
_UNITS = {
    "spectral": "1/sr",
    "relative": "of a mirror",
    "power": "of a mirror's peak",
    "xyz": "CIE 1931 XYZ of f in 1/sr",
    "rgb": "linear sRGB of f in 1/sr",
}


def save(measured: Measured, path: str | os.PathLike) -> None:
    """Write to .npz, exactly, or to .csv; aside first and then renamed.

    Raises
    ------
    InputError
        For another suffix, a folder that does not exist, or colours in .csv whose illuminant
        has no name.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        with replacing(path) as file:
            entries: dict[str, Any] = _entries(measured)
            np.savez_compressed(file, **entries)
    elif suffix == ".csv":
        text = measured_text.written(path, measured)
        with replacing(path) as file:
            file.write(text.encode())
    else:
        raise InputError(f"{path}: measured reflectance is written to .npz or .csv")


def load(path: str | os.PathLike, **stated: Any) -> Measured:
    """Read measured reflectance.

    Parameters
    ----------
    path
        ``.npz`` or ``.csv``.
    **stated
        What the file does not state, see `STATED`: arguments of `Measured`, lengths in
        micrometres; ``scale``, white of values in sRGB; ``unit``, of the lengths in an .npz
        without units. What a file states cannot be contradicted.

    Raises
    ------
    InputError
        If the file cannot be used, or coherence or quantity are stated neither in it nor here;
        names the file and the place in it.
    """
    path = existing_file(path)
    given = {name: value for name, value in stated.items() if value is not None}
    for name in given:
        if name not in STATED:
            raise InputError(f"{name}= is not known; {expected(name, STATED)}")
    suffix = path.suffix.lower()
    if suffix == ".npz":
        found = _read_npz(path, given)
    elif suffix == ".csv":
        if "unit" in given:
            raise InputError(f"{path}: a .csv states its units; leave out unit=")
        found = measured_text.read(path)
    else:
        raise InputError(f"{path}: measured reflectance is read from .npz or .csv")
    return _made(path, found, given)


def is_measured(path: str | os.PathLike) -> bool:
    """Whether a file holds reflectance, by its content, and not heights: a named column or entry.

    Raises
    ------
    InputError
        If there is no such file, or it is empty.
    """
    path = existing_file(path)
    suffix = path.suffix.lower()
    if suffix == ".npz":
        try:
            with zipfile.ZipFile(path) as archive:
                return "heights.npy" not in archive.namelist() and bool(
                    {"wi.npy", "wo.npy"} & set(archive.namelist())
                )
        except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError):
            return False
    return suffix == ".csv" and measured_text.has_names(path)


def _entries(measured: Measured) -> dict[str, np.ndarray]:
    arrays = {name: getattr(measured, name) for name in _ARRAYS}
    attributes = {
        "format": FORMAT,
        "version": VERSION,
        "quantity": measured.quantity,
        "noise_known": measured.noise_known,
        "gain": measured.gain,
        "units": {
            "wavelengths": "um",
            "coherence": "um",
            "values": _UNITS[measured.quantity],
            "noise": "as values",
            "blur": "direction sines",
        },
    }
    entries = {name: np.asarray(array) for name, array in arrays.items() if array is not None}
    return entries | {"attributes": np.array(json.dumps(attributes))}


def _read_npz(path: Path, given: Mapping[str, Any]) -> dict[str, Any]:
    content = numpy_files.archive(path)
    attributes = _attributes(path, content.pop("attributes", None))
    for name, array in content.items():
        if name not in _ARRAYS:
            raise InputError(f"{path}: entry {name!r} is not known; {expected(name, _ARRAYS)}")
        if array.dtype.kind not in "fiu":
            raise InputError(f"{path}: {name} must be real numbers; received {array.dtype}")
    for name in ("wi", "wo", "values"):
        if name not in content:
            raise InputError(f"{path}: expected an entry {name!r}; found {sorted(content)}")
    units = attributes.pop("units", {})
    for name in ("wavelengths", "coherence"):
        if name not in content:
            continue
        if name in units and "unit" in given:
            raise InputError(f"{path}: the file states the unit of {name}; leave out unit=")
        unit = units.get(name, given.get("unit"))
        if unit is None:
            raise InputError(
                f"{path}: expected the unit of {name}, in the entry 'attributes' or as unit=; "
                "received neither"
            )
        factor = to_micrometres(unit, f"{path}: {name}")
        if factor != 1.0:
            content[name] = content[name].astype(np.float64) * factor
    found: dict[str, Any] = {
        name: array if array.dtype.kind == "f" else array.astype(np.float64)
        for name, array in content.items()
    }
    return found | attributes


def _attributes(path: Path, entry: np.ndarray | None) -> dict[str, Any]:
    """The words of an .npz; none if it has no such entry."""
    if entry is None:
        return {}
    try:
        found = json.loads(str(entry))
        units = found.get("units", {})
        if not isinstance(units, dict):
            raise TypeError(f"units: {units!r}")
    except (TypeError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"{path}: attributes must be a JSON object; {one_line(error)}") from error
    if found.pop("format", FORMAT) != FORMAT:
        raise InputError(f"{path}: expected the format {FORMAT!r} in attributes; received another")
    version = found.pop("version", VERSION)
    if version != VERSION:
        raise InputError(f"{path}: expected version {VERSION} of {FORMAT}; received {version!r}")
    for name in found:
        if name not in _WORDS:
            raise InputError(f"{path}: attribute {name!r} is not known; {expected(name, _WORDS)}")
    if not isinstance(found.get("noise_known", False), bool):
        raise InputError(
            f"{path}: noise_known must be true or false; received {found['noise_known']!r}"
        )
    return found


def _made(path: Path, found: dict[str, Any], given: Mapping[str, Any]) -> Measured:
    """The data, of what a file states and what was stated beside it."""
    for name in given:
        if name in found:
            raise InputError(f"{path}: the file states {name}; leave out {name}=")
    merged = {**found, **{name: value for name, value in given.items() if name != "unit"}}
    for name, text in (
        ("coherence", "sigma_s of the coherence window in micrometres"),
        ("quantity", ", ".join(QUANTITIES)),
    ):
        if name not in merged:
            raise InputError(
                f"{path}: expected {name} ({text}) in the file or as {name}=; received neither"
            )
    quantity = merged["quantity"]
    if quantity not in QUANTITIES:
        raise InputError(
            f"{path}: quantity must be one of {', '.join(QUANTITIES)}; received {quantity!r}"
        )
    gain = merged.get("gain", "known")
    if gain not in get_args(Gain):
        raise InputError(f"{path}: gain must be {' or '.join(get_args(Gain))}; received {gain!r}")
    if quantity != "srgb" and "scale" in merged:
        raise InputError(f"{path}: scale is for quantity srgb; received it with {quantity}")
    lines = merged.pop("lines", None)
    if quantity == "srgb":
        merged = _decoded(path, merged, lines)
    if merged["quantity"] not in COLOURS:
        for name in ("illuminant", "weights"):
            if name in merged:
                raise InputError(f"{path}: {name} is for colours; received it with {quantity}")
    weights = merged.pop("weights", None)
    if weights is not None and "illuminant" in merged:
        raise InputError(f"{path}: expected weights or illuminant; received both")
    merged.setdefault("wavelengths", None)
    arguments = [merged.pop(n) for n in ("wi", "wo", "wavelengths", "values", "coherence")]
    try:
        measured = Measured(*arguments, **merged)
    except (InputError, ValueError, TypeError) as error:
        raise InputError(f"{path}: {one_line(error, 300)}") from error
    if weights is None:
        return measured
    if weights.shape != (measured.wavelengths.size, 3):
        raise InputError(
            f"{path}: weights must be [{measured.wavelengths.size}, 3] as wavelengths; received "
            f"{weights.shape}"
        )
    return eqx.tree_at(lambda m: m.weights, measured, jnp.asarray(weights, measured.values.dtype))


def _decoded(path: Path, merged: dict[str, Any], lines: list[int] | None) -> dict[str, Any]:
    """From sRGB to linear RGB, without rows that were clipped."""
    from diffopt.kernels import spectrum

    merged = dict(merged)
    scale = merged.pop("scale", 1.0)
    if isinstance(scale, bool) or not isinstance(scale, (int, float)) or not 0 < scale < np.inf:
        raise InputError(f"{path}: scale must be a number above 0, as 255; received {scale!r}")
    values = np.asarray(merged["values"], np.float64)
    if values.ndim != 2 or values.shape[1] != 3:
        raise InputError(f"{path}: values in sRGB must be [M, 3]; received {values.shape}")
    encoded = values / float(scale)
    outside = ~((encoded >= 0.0) & (encoded <= 1.0))
    if outside.any():
        row, column = np.argwhere(outside)[0]
        where = f"row {row}" if lines is None else f"line {lines[row]}"
        raise InputError(
            f"{path}: {where}, column {'RGB'[column]}: expected sRGB from 0 to {scale:g}; received "
            f"{values[row, column]:g}"
        )
    black = encoded <= 0.0
    clipped = (encoded >= 1.0).any(1) | (black.any(1) & ~black.all(1))
    if clipped.all():
        raise InputError(
            f"{path}: all {len(encoded)} rows are clipped (a channel at 0 or at {scale:g}); "
            "expected some that are not"
        )
    kept = np.logical_not(clipped)
    if clipped.any():
        warnings.warn(
            f"{path}: {clipped.sum()} of {len(encoded)} rows were left out: a channel of theirs "
            f"is clipped at 0 or at {scale:g}, so that its true value is not known",
            stacklevel=4,
        )
    dtype = jnp.result_type(float)
    at = jnp.asarray(encoded, dtype)
    linear, slope = jax.jvp(spectrum.decode_srgb, (at,), (jnp.ones_like(at),))
    merged |= {"quantity": "rgb", "values": np.asarray(linear)[kept]}
    for name in ("wi", "wo"):
        if np.ndim(merged[name]) == 2 and len(merged[name]) == len(encoded):
            merged[name] = np.asarray(merged[name])[kept]
    if "noise" in merged:
        noise = np.asarray(merged["noise"], np.float64) / float(scale)
        if noise.shape not in ((), encoded.shape):
            raise InputError(
                f"{path}: noise must be one number or as values, {encoded.shape}; received "
                f"{noise.shape}"
            )
        merged["noise"] = (np.asarray(slope) * noise)[kept]
    return merged
