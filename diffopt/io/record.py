"""What a reader returns, and what a caller may tell it."""

import dataclasses
from pathlib import Path

import numpy as np

from diffopt.errors import InputError
from diffopt.io.units import to_micrometres

# Two statements of the same pixel size agree when they differ by less than this share;
# files give four or more digits.
_AGREEMENT = 1e-3


@dataclasses.dataclass(frozen=True)
class Record:
    """Heights as read from a file.

    Attributes
    ----------
    heights
        [ny, nx] in micrometres, float64; NaN where the file has no value.
    pixel
        (dy, dx) in micrometres.
    channel
        Name of the channel, where the format has channels.
    steps
        Processing that the file says was done before it was saved.
    notes
        Remarks on the reading: quantisation, warnings of the reader.
    """

    heights: np.ndarray
    pixel: tuple[float, float]
    channel: str | None = None
    steps: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Options:
    """What the caller states about a file, where the file itself does not.

    Attributes
    ----------
    pixel_size
        (dy, dx), or one number for both, in micrometres.
    height_range
        (low, high) in micrometres: heights of grey 0 and of the greatest grey value. One
        number stands for (0, number).
    height_unit
        Unit of the stored numbers, as ``"nm"``, for formats without units.
    lateral_unit
        Unit of the x and y columns of an xyz list; ``height_unit`` if left out.
    channel
        Number or name of the channel (page) to read.
    format
        Name of the reader, where the file name does not tell.
    """

    pixel_size: tuple[float, float] | None = None
    height_range: tuple[float, float] | None = None
    height_unit: str | None = None
    lateral_unit: str | None = None
    channel: int | str | None = None
    format: str | None = None

    def refuse(self, path: Path, why: str, *names: str) -> None:
        """Refuse options that the format has no use for.

        Raises
        ------
        InputError
            If one of the named options is set.
        """
        for name in names:
            value = getattr(self, name)
            if value is not None:
                raise InputError(f"{path}: {name}={value!r} does not apply: {why}")

    def pixel(self, path: Path, stated: tuple[float, float] | None = None) -> tuple[float, float]:
        """Return the pixel size, from the file or from the caller.

        Parameters
        ----------
        path
            For the error text.
        stated
            (dy, dx) in micrometres as the file states it.

        Raises
        ------
        InputError
            If neither states it, or if both do and differ by more than 0.1 %.
        """
        if stated is None and self.pixel_size is None:
            raise InputError(
                f"{path}: the file states no pixel size; pass pixel_size= in micrometres"
            )
        if stated is None or self.pixel_size is None:
            return self.pixel_size or stated  # type: ignore[return-value]
        if not np.allclose(stated, self.pixel_size, rtol=_AGREEMENT, atol=0):
            raise InputError(
                f"{path}: pixel_size={self.pixel_size} contradicts the file, which states "
                f"({stated[0]:.6g}, {stated[1]:.6g}) micrometres; leave pixel_size out, and "
                "build a Heightfield from the heights to recalibrate"
            )
        return stated

    def unit(self, path: Path) -> float:
        """Micrometres in the unit of the stored numbers.

        Raises
        ------
        InputError
            If the caller does not state the unit, or it is not a length.
        """
        if self.height_unit is None:
            raise InputError(
                f"{path}: the file states no unit of height; pass height_unit=, as 'um' or 'nm'"
            )
        return to_micrometres(self.height_unit, f"{path}: height_unit=")


def pair(value: float | int | tuple | list, name: str) -> tuple[float, float]:
    """Two positive finite numbers from one number or a pair of them.

    Raises
    ------
    InputError
        If it is anything else.
    """
    items = tuple(value) if isinstance(value, tuple | list) else (value, value)
    try:
        floats = tuple(float(item) for item in items)
    except (TypeError, ValueError):
        floats = ()
    if len(floats) != 2 or not all(0 < item < float("inf") for item in floats):
        raise InputError(
            f"{name}={value!r}: expected one positive number or a pair (dy, dx), in micrometres"
        )
    return floats[0], floats[1]
