"""Measured reflectance as text: ``.csv``.

First comment lines ``# key: value unit`` with what holds for the whole file::

    # coherence: 2.0 um          sigma_s; nm, um or mm
    # quantity: spectral         spectral, relative, power, xyz, rgb or srgb
    # gain: free                 or known, which it is if left out
    # blur: 0.002                in direction sines; 0 if left out
    # noise: 0.02                of all values, in their unit; or columns, see below
    # noise_known: true          or false, which it is if left out
    # illuminant: A              of colours; D65 if left out
    # wavelengths: 400 410 nm    that colours are summed over; 380 to 780 in steps of 5 nm if not
    # scale: 255                 white of srgb; 1 if left out

Other comments are free where no word comes first that a colon follows. Then a row of names:
``wi_x, wi_y, wi_z, wo_x, wo_y, wo_z`` (unit vectors to the light and to the viewer) or
``theta_i_deg, phi_i_deg, theta_o_deg, phi_o_deg``; values by their wavelengths, as ``450 nm`` or
``0.45 um``, or X, Y, Z, or R, G, B; and perhaps the noise of each, as ``noise 450 nm`` or
``noise X``. Columns may come in any order, separated by commas, semicolons or tabs; the decimal
mark is a point.
"""

import csv
import io
import math
import re
from collections.abc import Collection
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffopt import checks, colour
from diffopt.errors import InputError
from diffopt.illuminants import COMMON
from diffopt.io import limits
from diffopt.io.units import to_micrometres

if TYPE_CHECKING:
    from diffopt.fitting.measured import Measured

VECTORS = ("wi_x", "wi_y", "wi_z", "wo_x", "wo_y", "wo_z")
ANGLES = ("theta_i_deg", "phi_i_deg", "theta_o_deg", "phi_o_deg")
KEYS = (
    "coherence",
    "quantity",
    "gain",
    "blur",
    "noise",
    "noise_known",
    "illuminant",
    "wavelengths",
    "scale",
)
_CHANNELS = {"xyz": ("X", "Y", "Z"), "rgb": ("R", "G", "B")}
_OF_COLUMNS = {"xyz": ("xyz",), "rgb": ("rgb", "srgb"), "": ("spectral", "relative", "power")}

# Of a line without blanks at its ends.
_KEY = re.compile(r"^#\s*([A-Za-z_]\w*)\s*:\s*(.*)$")
# Digits match in one way only: else a long name would take for ever.
_NUMBER = r"[-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?"
_LENGTH = re.compile(rf"^({_NUMBER})\s*([^\d\s.,]\S*)$")


def read(path: Path) -> dict[str, Any]:
    """What a file holds, by the names of `diffopt.fitting.Measured`'s arguments.

    ``lines`` is beside them, the number of each row's line.

    Raises
    ------
    InputError
        Names the file, the line and the column.
    """
    found: dict[str, Any] = {}
    names, rows = _table(path, found)
    columns = {name: k for k, name in enumerate(names)}
    if len(columns) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError(f"{path}: column {twice!r} comes twice; expected it once")
    kind, wavelengths, values, noise = _columns(path, names)
    numbers = _numbers(path, names, rows)
    lines = [line for line, _ in rows]
    found["wi"], found["wo"] = _directions(path, names, numbers, lines)
    found["values"] = numbers[:, [columns[name] for name in values]]
    if noise:
        if "noise" in found:
            raise InputError(f"{path}: expected the noise as a key or in columns; received both")
        found["noise"] = numbers[:, [columns[name] for name in noise]]
        for column, name in enumerate(noise):
            bad = ~(found["noise"][:, column] > 0)
            if bad.any():
                row = int(np.argmax(bad))
                raise InputError(
                    f"{path}: line {lines[row]}, column {name!r}: expected a number above 0; "
                    f"received {found['noise'][row, column]:g}"
                )
    if wavelengths is not None:
        if "wavelengths" in found:
            raise InputError(
                f"{path}: wavelengths are in the names of the columns; leave out that key"
            )
        found["wavelengths"] = wavelengths
    if kind == "xyz":
        found.setdefault("quantity", "xyz")
    quantity = found.get("quantity")
    if quantity is not None and quantity not in _OF_COLUMNS[kind]:
        raise InputError(
            f"{path}: expected the quantity {' or '.join(_OF_COLUMNS[kind])} with the columns "
            f"{', '.join(values)}; received {quantity}"
        )
    return found | {"lines": lines}


def expected(name: str, known: Collection[str]) -> str:
    """What was expected in place of an unknown name: the nearest one, or all."""
    near = checks.nearest(name, known)
    return f"did you mean {near!r}?" if near else f"expected one of {', '.join(known)}"


def has_names(path: Path) -> bool:
    """Whether the first line that is no comment names columns of reflectance."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        for line in file:
            line = line.strip()
            if line and not line.startswith("#"):
                words = {word.strip() for word in line.split(_separator(line))}
                return bool(words & {*VECTORS, *ANGLES})
    return False


def _separator(line: str) -> str:
    return next((mark for mark in "\t;," if mark in line), ",")


def _table(path: Path, found: dict[str, Any]) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Names of columns, and the words of each row with its line; keys go into `found`."""
    try:
        text = limits.text(path, limits.MOST_TEXT).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected text in UTF-8; {error.reason}") from error
    names: list[str] = []
    rows: list[tuple[int, list[str]]] = []
    mark = ","
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip(" \t;,"):
            continue
        if line.lstrip().startswith("#"):
            match = _KEY.match(line.strip())
            if match:
                _keep(path, number, found, *match.groups())
            continue
        if not names:
            mark = _separator(line)
        try:
            words = [word.strip() for word in next(csv.reader([line], delimiter=mark, strict=True))]
        except csv.Error as error:
            raise InputError(f"{path}: line {number}: {error}") from None
        if not names:
            names = [" ".join(word.split()) for word in words]
            continue
        if len(words) != len(names):
            raise InputError(
                f"{path}: line {number}: expected {len(names)} values, as there are columns; "
                f"received {len(words)}"
            )
        rows.append((number, words))
    if not names:
        raise InputError(f"{path}: expected a row of column names; received none")
    if not rows:
        raise InputError(f"{path}: expected rows of values below the names; received none")
    return names, rows


def _keep(path: Path, line: int, found: dict[str, Any], key: str, text: str) -> None:
    """Read one ``# key: value unit``."""
    where = f"{path}: line {line}"
    if key not in KEYS:
        raise InputError(f"{where}: key {key!r} is not known; {expected(key, KEYS)}")
    if key in found:
        raise InputError(f"{where}: {key} is stated twice; expected it once")
    if key == "noise_known":
        if text not in ("true", "false"):
            raise InputError(f"{where}: noise_known must be true or false; received {text!r}")
        found[key] = text == "true"
    elif key in ("blur", "noise", "scale"):
        try:
            found[key] = float(text)
        except ValueError:
            raise InputError(f"{where}: {key} must be one number; received {text!r}") from None
    elif key == "coherence":
        found[key] = float(_length(f"{where}: coherence", text, "2.0 um"))
    elif key == "wavelengths":
        *some, unit = text.replace(",", " ").split() or [""]
        example = "400 410 420 nm"
        if not some or re.match(_NUMBER, unit):
            raise InputError(
                f"{where}: wavelengths must be numbers and their unit, as {example!r}; received "
                f"{text!r}"
            )
        found[key] = np.array(
            [float(_length(f"{where}: wavelengths", f"{word} {unit}", example)) for word in some]
        )
    else:
        if not text:
            raise InputError(f"{where}: {key} must be a word; received none")
        found[key] = text


def _length(what: str, text: str, example: str) -> Decimal:
    """Micrometres, exact in decimals, so that 450 nm is the number nearest to 0.45."""
    match = _LENGTH.match(text)
    if match is None:
        raise InputError(f"{what} must be a number and its unit, as {example!r}; received {text!r}")
    factor = to_micrometres(match.group(2), what)
    try:
        return Decimal(match.group(1)) * Decimal(repr(factor))
    except ArithmeticError:
        raise InputError(f"{what} must be a number; received {match.group(1)!r}") from None


def _columns(path: Path, names: list[str]) -> tuple[str, np.ndarray | None, list[str], list[str]]:
    """Kind of colours or none, wavelengths, names of values, and of their noise in that order."""
    found: dict[Any, str] = {}
    noise: dict[Any, str] = {}
    channels = {name for some in _CHANNELS.values() for name in some}
    for name in names:
        if name in VECTORS or name in ANGLES:
            continue
        head, _, rest = name.partition(" ")
        into, what = (noise, rest) if head == "noise" else (found, name)
        if what in channels:
            key: Any = what
        elif _LENGTH.match(what):
            key = _length(f"{path}: column {name!r}", what, "450 nm")
        else:
            known = (*VECTORS, *ANGLES, *sorted(channels), "450 nm", "noise 450 nm", "noise X")
            raise InputError(f"{path}: column {name!r} is not known; {expected(name, known)}")
        if key in into:
            raise InputError(
                f"{path}: columns {into[key]!r} and {name!r} are the same; expected one"
            )
        into[key] = name
    if not found:
        raise InputError(
            f"{path}: expected columns of values, as '450 nm', X, Y, Z or R, G, B; received "
            f"{', '.join(names)}"
        )
    kind = ""
    for one, some in _CHANNELS.items():
        if set(found) & set(some):
            if set(found) != set(some):
                raise InputError(
                    f"{path}: expected the values {', '.join(some)} and no others; received "
                    f"{', '.join(found.values())}"
                )
            kind = one
    order = list(_CHANNELS[kind]) if kind else list(found)
    if noise and set(noise) != set(found):
        name = next(iter([found[k] for k in order if k not in noise] or noise.values()))
        raise InputError(
            f"{path}: expected a column of noise for each column of values, or none; received no "
            f"pair for {name!r}"
        )
    wavelengths = None if kind else np.array([float(length) for length in order])
    return kind, wavelengths, [found[k] for k in order], [noise[k] for k in order if noise]


def _numbers(path: Path, names: list[str], rows: list[tuple[int, list[str]]]) -> np.ndarray:
    out = np.empty((len(rows), len(names)))
    for row, (line, words) in zip(out, rows, strict=True):
        for k, word in enumerate(words):
            try:
                row[k] = float(word)
            except ValueError:
                row[k] = math.nan
            if not math.isfinite(row[k]):
                raise InputError(
                    f"{path}: line {line}, column {names[k]!r}: expected a number; received "
                    f"{word!r}"
                )
    return out


def _directions(
    path: Path, names: list[str], numbers: np.ndarray, lines: list[int]
) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors to the light and to the viewer."""
    given = [name for name in names if name in (*VECTORS, *ANGLES)]
    wanted = VECTORS if set(given) & set(VECTORS) else ANGLES
    if set(given) != set(wanted):
        lacking = [name for name in wanted if name not in given]
        other = f"no {', '.join(lacking)}" if lacking else f"{', '.join(given)}"
        raise InputError(f"{path}: expected the columns {', '.join(wanted)}; received {other}")
    table = numbers[:, [names.index(name) for name in wanted]]
    if wanted is VECTORS:
        wi, wo = table[:, :3], table[:, 3:]
        for name, way in (("wi", wi), ("wo", wo)):
            with np.errstate(over="ignore"):
                length = np.linalg.norm(way, axis=1)
            _each(path, lines, name, abs(length - 1) <= 1e-3, "a unit vector, of length", length)
            _each(path, lines, name, way[:, 2] > 0, "z above 0 (the horizon);", way[:, 2])
        return wi, wo
    ways = []
    for k in (0, 2):
        theta, phi = np.radians(table[:, k]), np.radians(table[:, k + 1])
        good = (table[:, k] >= 0) & (table[:, k] < 90)
        _each(path, lines, wanted[k], good, "0 to below 90 degrees;", table[:, k])
        sine = np.sin(theta)
        ways.append(np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], -1))
    return ways[0], ways[1]


def _each(
    path: Path, lines: list[int], name: str, good: np.ndarray, words: str, seen: np.ndarray
) -> None:
    if not good.all():
        row = int(np.argmin(good))
        raise InputError(
            f"{path}: line {lines[row]}, column {name}: expected {words.rstrip(';')}; received "
            f"{seen[row]:g}"
        )


def written(path: Path, measured: "Measured") -> str:
    """The text of a file; every number comes back as it was.

    Raises
    ------
    InputError
        If the illuminant of colours is none of those with a common name.
    """
    out = io.StringIO(newline="")
    kind = measured.quantity if measured.quantity in _CHANNELS else ""
    lines = [
        f"coherence: {_shortest(measured.coherence)} um",
        f"quantity: {measured.quantity}",
        f"gain: {measured.gain}",
    ]
    if float(measured.blur):
        lines.append(f"blur: {_shortest(measured.blur)}")
    noise = np.asarray(measured.noise)
    even = bool((noise == noise[:1, :1]).all())
    if even and (measured.noise_known or noise[0, 0] != 1.0):
        lines.append(f"noise: {_shortest(noise[0, 0])}")
    if measured.noise_known:
        lines.append("noise_known: true")
    wavelengths = np.asarray(measured.wavelengths)
    if kind:
        lines.append(f"illuminant: {_illuminant(path, measured)}")
        if not np.array_equal(wavelengths, colour.wavelengths().astype(wavelengths.dtype)):
            lines.append(f"wavelengths: {' '.join(_nanometres(w) for w in wavelengths)} nm")
        values = list(_CHANNELS[kind])
    else:
        values = [f"{_nanometres(w)} nm" for w in wavelengths]
    out.writelines(f"# {line}\n" for line in lines)
    table = [np.asarray(measured.wi), np.asarray(measured.wo), np.asarray(measured.values)]
    names = [*VECTORS, *values]
    if not even:
        table.append(noise)
        names += [f"noise {name}" for name in values]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(names)
    rows = np.concatenate(table, axis=1)
    writer.writerows([_shortest(number) for number in row] for row in rows)
    return out.getvalue()


def _shortest(number: Any) -> str:
    """The shortest text that gives a number of its type back; no print options touch it."""
    number = np.asarray(number)[()]
    plain = number == 0 or 1e-4 <= abs(number) < 1e6
    write = np.format_float_positional if plain else np.format_float_scientific
    return write(number, unique=True, trim="-")


def _nanometres(wavelength: Any) -> str:
    text = f"{Decimal(_shortest(wavelength)) * 1000:f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def _illuminant(path: Path, measured: "Measured") -> str:
    """Its name, found by the weights."""
    from diffopt.fitting.measured import colour_weights

    weights = np.asarray(measured.weights)
    wavelengths = np.asarray(measured.wavelengths, np.float64)
    close = 1e-4 if weights.dtype == np.float32 else 1e-9
    for name in COMMON:
        try:
            known = colour_weights(wavelengths, name, measured.quantity, weights.dtype)
        except ValueError:  # its table is too short for these wavelengths
            continue
        if np.allclose(weights, known, rtol=0.0, atol=close * float(np.abs(weights).max())):
            return name
    raise InputError(
        f"{path}: a .csv states the illuminant by its name, expected one of {', '.join(COMMON)}; "
        "received another (save to .npz)"
    )
