"""From a file to heights, pixel and history, for `Heightfield.load`."""

import dataclasses
import math
import os

import jax.numpy as jnp
import numpy as np

from diffopt.errors import InputError
from diffopt.io.record import Options, Record, pair

Number = float | int

# A load that would leave float32 steps coarser than this share of peak-to-valley, because
# of a large common offset, takes the offset out first.
_OFFSET_SHARE = 1e-4


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Where heights come from and what was done to them.

    Attributes
    ----------
    source
        File name or name of the generator.
    channel
        Channel of the file, where it has several.
    steps
        What was done, in order, in words.
    notes
        Remarks of the reader, as quantisation.
    filled
        Number of missing pixels that were filled.
    """

    source: str = "array"
    channel: str | None = None
    steps: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    filled: int = 0

    def then(self, step: str, filled: int = 0) -> "Provenance":
        """The same with one more step."""
        return dataclasses.replace(self, steps=(*self.steps, step), filled=self.filled + filled)


def load(
    path: str | os.PathLike,
    *,
    pixel_size: Number | tuple[Number, Number] | None,
    height_range: Number | tuple[Number, Number] | None,
    height_unit: str | None,
    lateral_unit: str | None,
    channel: int | str | None,
    format: str | None,
) -> tuple[Record, Provenance]:
    """Read a file; the arguments are those of `Heightfield.load`.

    Returns
    -------
    tuple
        The record, with heights [ny, nx] in micrometres, float64, NaN where missing, and
        without a common offset that would cost float32 its resolution; and its provenance.

    Raises
    ------
    InputError
        If the file cannot be used; the text names it and says what was expected.
    """
    from diffopt.io import read

    record = read(
        path,
        Options(
            pixel_size=None if pixel_size is None else pair(pixel_size, "pixel_size"),
            height_range=_range(height_range),
            height_unit=height_unit,
            lateral_unit=lateral_unit,
            channel=channel,
            format=format,
        ),
    )
    record = _without_coarse_offset(record)
    source = os.path.basename(os.fspath(path))
    return record, Provenance(source, record.channel, record.steps, record.notes)


def _range(value: Number | tuple[Number, Number] | None) -> tuple[float, float] | None:
    if value is None:
        return None
    low, high = (float(v) for v in (value if isinstance(value, tuple) else (0.0, value)))
    if not (math.isfinite(low) and math.isfinite(high) and high > low):
        raise InputError(f"height_range={value!r}: expected (low, high) in micrometres, low < high")
    return low, high


def _without_coarse_offset(record: Record) -> Record:
    """Take out a common offset that would cost float32 its resolution."""
    heights = record.heights
    if jnp.result_type(float) != jnp.float32:
        return record
    peak_to_valley = np.nanmax(heights) - np.nanmin(heights)
    step = float(np.spacing(np.float32(np.nanmax(np.abs(heights)))))
    if peak_to_valley == 0 or step <= _OFFSET_SHARE * peak_to_valley:
        return record
    offset = float(np.nanmean(heights))
    note = f"offset of {offset:.9g} um taken out for float32"
    return dataclasses.replace(record, heights=heights - offset, notes=(*record.notes, note))
