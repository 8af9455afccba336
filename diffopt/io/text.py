"""Heights as text: a matrix of numbers, or a list of x, y, z.

Columns are separated by tabs, semicolons, commas or blanks (found from the first line of
numbers); the decimal mark is a point. Lines starting with ``#``, ``%`` or ``;`` are
comments; of these the ones that Gwyddion writes (``# Width: 10 µm``, ``# Height: 8 µm``,
``# Value units: nm``) are understood. ``nan`` marks a missing pixel. The first line of a
matrix is row 0.
"""

import math
import re
from pathlib import Path

import numpy as np

from diffopt.errors import InputError
from diffopt.io import limits
from diffopt.io.record import Options, Record
from diffopt.io.units import to_micrometres

# Where the number ends the unit begins, in one way only: else a long line would take for ever.
_SIZE = re.compile(r"^[#%;]\s*(Width|Height):\s*([-+0-9.eE]+)(?:\s+|(?=[^-+0-9.eE\s]))(\S+)\s*$")
_VALUE_UNITS = re.compile(r"^[#%;]\s*Value units:\s*(\S+)\s*$")
_CHANNEL = re.compile(r"^[#%;]\s*Channel:\s*(\S.*)$")

# Grid lines of an xyz list count as the same when they differ by less than this share of
# the spacing: files are rounded, scanners do not jitter more.
_GRID_TOLERANCE = 0.02


def read_matrix(path: Path, options: Options) -> Record:
    """Read a matrix of heights, one row of the scan a line.

    Needs ``pixel_size`` and ``height_unit`` unless the comments state them.

    Raises
    ------
    InputError
        If a line is not numbers, rows differ in length, or units are missing.
    """
    options.refuse(path, "a text matrix has one channel", "channel")
    options.refuse(path, "a text file holds numbers, not grey values", "height_range")
    comments, rows = _numbers(path)
    heights = _rectangular(path, rows)
    if heights.shape[1] == 3 and heights.shape[0] > 9 and options.format is None:
        raise InputError(
            f"{path}: {heights.shape[0]} lines of 3 numbers look like a list of x, y, z; "
            "pass format='xyz', or format='matrix' if they are heights"
        )
    sizes, unit, channel = _header(path, comments)
    stated = None
    if {"Width", "Height"} <= sizes.keys():
        stated = (sizes["Height"] / heights.shape[0], sizes["Width"] / heights.shape[1])
    if unit is None:
        factor = options.unit(path)
    else:
        options.refuse(path, f"the file states {unit!r}", "height_unit")
        factor = to_micrometres(unit, f"{path}: channel {channel or 'without name'}")
    return Record(heights * factor, options.pixel(path, stated), channel)


def read_xyz(path: Path, options: Options) -> Record:
    """Read a list of points x, y, z on a regular grid, in any order.

    ``height_unit`` is the unit of all three columns, unless ``lateral_unit`` states another
    for x and y. The pixel size follows from the grid. Grid points without a line are
    missing pixels. Row 0 is the least y, column 0 the least x.

    Raises
    ------
    InputError
        If the points do not lie on a regular grid, or one is given twice.
    """
    options.refuse(path, "an xyz list has one channel", "channel")
    options.refuse(path, "a text file holds numbers, not grey values", "height_range")
    _, rows = _numbers(path)
    points = _rectangular(path, rows)
    if points.shape[1] != 3:
        raise InputError(f"{path}: expected three numbers a line, found {points.shape[1]}")
    factor = options.unit(path)
    lateral = factor
    if options.lateral_unit is not None:
        lateral = to_micrometres(options.lateral_unit, f"{path}: lateral_unit=")
    if not np.isfinite(points[:, :2]).all():
        raise InputError(f"{path}: x and y must be finite numbers")
    column, nx, dx = _grid(path, points[:, 0], "x")
    row, ny, dy = _grid(path, points[:, 1], "y")
    limits.samples(path, (ny, nx), "points of the grid")
    heights = np.full((ny, nx), np.nan)
    given = np.zeros((ny, nx), dtype=int)
    np.add.at(given, (row, column), 1)
    if given.max() > 1:
        j, i = np.argwhere(given > 1)[0]
        raise InputError(f"{path}: the grid point in row {j}, column {i} is given twice")
    heights[row, column] = points[:, 2] * factor
    return Record(heights, options.pixel(path, (dy * lateral, dx * lateral)))


def _numbers(path: Path) -> tuple[list[str], list[tuple[int, np.ndarray]]]:
    """Comment lines, and (line number, values) of the others."""
    raw = limits.text(path, limits.MOST_TEXT)
    if b"\x00" in raw[:4096]:
        raise InputError(f"{path}: expected text, found binary data starting with {raw[:8]!r}")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    comments, rows, separator, known = [], [], None, False
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if not line:
            continue
        if line[0] in "#%;":
            comments.append(line)
            continue
        if not known:
            separator = next((mark for mark in "\t;," if mark in line), None)
            known = True
        words = line.strip(separator).split(separator)
        try:
            rows.append((number, np.array([float(word) for word in words])))
        except ValueError as error:
            raise InputError(f"{path}: line {number} is not numbers: {line[:60]!r}") from error
    if not rows:
        raise InputError(f"{path}: no numbers in the file")
    return comments, rows


def _rectangular(path: Path, rows: list[tuple[int, np.ndarray]]) -> np.ndarray:
    width = len(rows[0][1])
    for number, values in rows:
        if len(values) != width:
            raise InputError(
                f"{path}: line {number} has {len(values)} numbers, the lines before {width}"
            )
    return np.stack([values for _, values in rows])


def _header(path: Path, comments: list[str]) -> tuple[dict[str, float], str | None, str | None]:
    """Sizes in micrometres, unit of the values and name of the channel."""
    sizes, unit, channel = {}, None, None
    for line in comments:
        if match := _SIZE.match(line):
            name, value, length = match.groups()
            try:
                number = float(value)
            except ValueError:
                number = math.nan
            if not 0.0 < number < math.inf:
                raise InputError(f"{path}: {name} must be a number above 0; found {value[:40]!r}")
            sizes[name] = number * to_micrometres(length, f"{path}: {name}")
        elif match := _VALUE_UNITS.match(line):
            unit = match.group(1)
        elif match := _CHANNEL.match(line):
            channel = match.group(1)
    return sizes, unit, channel


def _grid(path: Path, values: np.ndarray, name: str) -> tuple[np.ndarray, int, float]:
    """Index of each value on its regular grid, size of the grid, spacing."""
    ordered = np.unique(values)
    extent = ordered[-1] - ordered[0]
    if extent == 0:
        raise InputError(f"{path}: all points have the same {name}; expected a grid")
    # Rounded copies of a grid line lie far closer together than two grid lines.
    gaps = np.diff(ordered)
    lines = 1 + int((gaps > 0.5 * gaps.max()).sum())
    spacing = float(extent / (lines - 1))
    index = np.rint((values - ordered[0]) / spacing).astype(int)
    deviation = np.abs(values - ordered[0] - index * spacing).max() / spacing
    if deviation > _GRID_TOLERANCE:
        raise InputError(
            f"{path}: the {name} values do not lie on a regular grid: off by "
            f"{100 * deviation:.0f} % of the spacing {spacing:.6g}"
        )
    return index, lines, spacing
