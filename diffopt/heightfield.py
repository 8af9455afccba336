"""The heightfield: heights on a grid, with units and history."""

import math
import os
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from diffopt import conditioning, loading
from diffopt.errors import InputError
from diffopt.io.record import pair
from diffopt.loading import Number as Number
from diffopt.loading import Provenance as Provenance
from diffopt.sampling import check_sampling
from diffopt.statistics import SurfaceStatistics, surface_statistics


class Heightfield(eqx.Module):
    """Heights h(y, x) on a regular grid.

    ``heights[j, i]`` is the height at x = (i - nx // 2) dx, y = (j - ny // 2) dy, along the
    surface normal z. Row 0 is the first row of a file, so that y runs down the picture of a
    scan; handed structures appear mirrored in the right-handed frame x, y, z unless the map
    is turned over by `flipped`.

    The heights are a leaf, pixel and provenance are static: transformations such as
    ``jax.grad`` act on the heights, and a compiled function is compiled anew for another
    pixel or provenance.

    Parameters
    ----------
    heights
        [ny, nx] in micrometres, real floating point; at least 2 x 2.
    pixel
        (dy, dx), or one number for both, in micrometres.
    provenance
        Source and history.
    missing
        What to do about NaN: ``"refuse"``, ``"fill"`` (see `filled`) or ``"keep"``.

    Raises
    ------
    InputError
        If heights or pixel are not as above, or NaN are left over.
    """

    heights: Float[Array, "ny nx"]
    pixel: tuple[float, float] = eqx.field(static=True)
    provenance: Provenance = eqx.field(static=True)

    def __init__(
        self,
        heights: Any,
        pixel: Number | tuple[Number, Number],
        *,
        provenance: Provenance | None = None,
        missing: str = "refuse",
    ):
        heights = jnp.asarray(heights)
        if heights.ndim != 2 or not jnp.issubdtype(heights.dtype, jnp.floating):
            raise InputError(
                f"heights: expected a floating-point [ny, nx] array in micrometres, received "
                f"{heights.dtype} {heights.shape}"
            )
        if min(heights.shape) < 2:
            raise InputError(f"heights: expected at least 2 x 2 pixels, received {heights.shape}")
        self.heights = heights
        self.pixel = pair(pixel, "pixel")
        self.provenance = Provenance() if provenance is None else provenance
        if missing not in ("refuse", "fill", "keep"):
            raise InputError(f"missing={missing!r}: expected 'refuse', 'fill' or 'keep'")
        if isinstance(heights, Tracer):
            return
        if bool(jnp.isinf(heights).any()):
            raise InputError("heights: expected finite numbers, received infinity")
        if missing == "fill":
            whole = self.filled()
            self.heights, self.provenance = whole.heights, whole.provenance
        elif missing == "refuse":
            self.require_complete()

    @classmethod
    def load(
        cls,
        path: str | os.PathLike,
        *,
        pixel_size: Number | tuple[Number, Number] | None = None,
        height_range: Number | tuple[Number, Number] | None = None,
        height_unit: str | None = None,
        lateral_unit: str | None = None,
        channel: int | str | None = None,
        format: str | None = None,
        missing: str = "refuse",
    ) -> "Heightfield":
        """Read a heightfield from a file.

        ``.npy``, ``.npz``, PNG, TIFF, text matrices (``.txt``, ``.asc``, ``.csv``), ``.xyz``,
        ``.gwy`` (extra ``gwy``); everything else is tried as an instrument file (extra
        ``afm``). What the file does not state must be passed; what it states cannot be
        contradicted.

        Parameters
        ----------
        path
            The file.
        pixel_size
            (dy, dx), or one number for both, in micrometres.
        height_range
            (low, high), or one number for (0, number), in micrometres: the heights of grey 0
            and of full grey, for PNG and TIFF.
        height_unit
            Unit of the stored numbers, as ``"um"`` or ``"nm"``, for formats without units.
        lateral_unit
            Unit of the x and y columns of an xyz list, if not ``height_unit``.
        channel
            Number or name; the first channel that is a height if left out.
        format
            Reader to use where the suffix does not tell: ``npy``, ``npz``, ``png``, ``tiff``,
            ``matrix``, ``xyz``, ``gwy``, ``instrument``.
        missing
            What to do about pixels without a value: ``"refuse"`` the file, ``"fill"`` them
            (see `filled`) or ``"keep"`` them as NaN.

        Raises
        ------
        InputError
            If the file cannot be used; the text names it and says what was expected.
        """
        record, provenance = loading.load(
            path,
            pixel_size=pixel_size,
            height_range=height_range,
            height_unit=height_unit,
            lateral_unit=lateral_unit,
            channel=channel,
            format=format,
        )
        absent = int(np.isnan(record.heights).sum())
        if missing == "refuse" and absent:
            raise InputError(
                f"{path}: {absent} of {record.heights.size} pixels are missing; pass "
                "missing='fill' to fill them, or 'keep' to level first and call .filled()"
            )
        heights = jnp.asarray(record.heights, jnp.result_type(float))
        return cls(heights, record.pixel, provenance=provenance, missing=missing)

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx)."""
        ny, nx = self.heights.shape
        return ny, nx

    @property
    def extent(self) -> tuple[float, float]:
        """(ny dy, nx dx) in micrometres."""
        return self.shape[0] * self.pixel[0], self.shape[1] * self.pixel[1]

    @property
    def missing(self) -> int:
        """Number of pixels without a height (NaN); not for traced heights."""
        return int(jnp.isnan(self.heights).sum())

    def require_complete(self) -> None:
        """Refuse missing pixels.

        Raises
        ------
        InputError
            If a height is NaN. Traced heights are not looked at.
        """
        if isinstance(self.heights, Tracer) or not self.missing:
            return
        raise InputError(
            f"heights: {self.missing} of {self.heights.size} pixels are missing (NaN); call "
            ".filled(), or pass missing='fill' or 'keep'"
        )

    def levelled(self, order: int | None = None, *, by: str = "plane") -> "Heightfield":
        """Remove tilt, bow or scan-line offsets by least squares.

        Missing pixels take no part and stay missing. Differentiable.

        Parameters
        ----------
        order
            Degree, 0 to 8; without it 1 for a plane, 2 for a polynomial, 0 for lines. An
            order passed alone asks for a polynomial.
        by
            ``"plane"``; ``"polynomial"`` of total degree ``order`` in x and y; or ``"line"``,
            one polynomial in x for each row.

        Raises
        ------
        InputError
            If ``by`` or ``order`` is out of range, or too few pixels are valid.
        """
        degrees = {"plane": 1, "polynomial": 2, "line": 0}
        if by not in degrees:
            raise InputError(f"by={by!r}: expected 'plane', 'polynomial' or 'line'")
        order = degrees[by] if order is None else order
        if by == "line":
            heights = conditioning.level_lines(self.heights, order)
            return self._with(heights, f"each scan line levelled, order {order}")
        heights = conditioning.level(self.heights, order)
        return self._with(heights, f"levelled by a polynomial of degree {order}")

    def filled(self, most: float = 0.2) -> "Heightfield":
        """Fill missing pixels from their surroundings; ``provenance.filled`` counts them.

        Parameters
        ----------
        most
            Largest share of missing pixels accepted.

        Raises
        ------
        InputError
            If more than ``most`` of the pixels are missing.
        """
        if not (count := self.missing):
            return self
        share = 100 * count / self.heights.size
        step = f"filled {count} missing pixels ({share:.2g} %)"
        return Heightfield(
            conditioning.fill(self.heights, most),
            self.pixel,
            provenance=self.provenance.then(step, count),
        )

    def cropped(
        self,
        *,
        rows: tuple[int, int] | None = None,
        columns: tuple[int, int] | None = None,
        size: Number | tuple[Number, Number] | None = None,
    ) -> "Heightfield":
        """Cut out a part.

        Parameters
        ----------
        rows, columns
            (start, stop) in pixels, stop excluded; all of them if left out.
        size
            Instead: (y, x), or one number for both, in micrometres, about the centre,
            rounded to whole pixels.

        Raises
        ------
        InputError
            If the part does not lie within the map or has fewer than 2 x 2 pixels.
        """
        ny, nx = self.shape
        if size is not None:
            if rows is not None or columns is not None:
                raise InputError("cropped: pass either size or rows and columns")
            counts = [round(s / d) for s, d in zip(pair(size, "size"), self.pixel, strict=True)]
            (top, bottom), (left, right) = (
                ((n - count) // 2, (n - count) // 2 + count)
                for n, count in zip((ny, nx), counts, strict=True)
            )
        else:
            (top, bottom), (left, right) = rows or (0, ny), columns or (0, nx)
        if not (0 <= top <= bottom - 2 < ny - 1 and 0 <= left <= right - 2 < nx - 1):
            raise InputError(
                f"cropped: rows {top}:{bottom}, columns {left}:{right} of a map of {ny} x {nx} "
                "pixels; expected a part of it of at least 2 x 2"
            )
        heights = self.heights[top:bottom, left:right]
        return self._with(heights, f"cropped to rows {top}:{bottom}, columns {left}:{right}")

    def resampled(
        self, pixel: Number | tuple[Number, Number], *, periodic: bool = False
    ) -> "Heightfield":
        """Sample anew at another pixel (dy, dx), low-passed where it is coarser.

        See `diffopt.conditioning.resample`. Differentiable.

        Raises
        ------
        InputError
            If pixels are missing, or the new pixel does not suit the extent.
        """
        self.require_complete()
        new = pair(pixel, "pixel")
        heights = conditioning.resample(self.heights, self.pixel, new, periodic=periodic)
        return self._with(heights, f"resampled to {new[0]:.6g} x {new[1]:.6g} um", new)

    def squared(self, *, periodic: bool = False) -> "Heightfield":
        """Make anisotropic pixels square by refining the coarser axis; differentiable.

        Raises
        ------
        InputError
            If pixels are missing, or a periodic extent is no multiple of the finer pixel.
        """
        if self.pixel[0] == self.pixel[1]:
            return self
        return self.resampled(min(self.pixel), periodic=periodic)

    def rotated(self, angle_deg: Number) -> "Heightfield":
        """Turn the surface by an angle in degrees, from x towards y.

        Quarter turns are exact; others are interpolated and cut to the largest rectangle
        without empty corners, and need square pixels.

        Raises
        ------
        InputError
            If pixels are missing or not square, or too few would be left.
        """
        self.require_complete()
        if not math.isfinite(angle_deg):
            raise InputError(f"angle_deg={angle_deg}: expected a finite number of degrees")
        odd_turn, quarter = round(angle_deg / 90) % 2 == 1, angle_deg % 90 == 0
        if not quarter and not math.isclose(*self.pixel, rel_tol=1e-6):
            raise InputError(
                f"rotated: the pixel {self.pixel} is not square; call .squared() first"
            )
        heights = conditioning.rotate(self.heights, math.radians(angle_deg))
        dy, dx = self.pixel
        pixel = (dx, dy) if quarter and odd_turn else (dy, dx)
        return self._with(heights, f"rotated by {angle_deg:g} degrees", pixel)

    def flipped(self) -> "Heightfield":
        """Turn the order of the rows round, so that y points the other way."""
        return self._with(self.heights[::-1], "rows in reverse order")

    def statistics(self, *, periodic: bool = False) -> SurfaceStatistics:
        """Peak-to-valley, rms height and slope, autocorrelation length, dominant period.

        See `diffopt.statistics`. Level a scan first.

        Raises
        ------
        InputError
            If pixels are missing or the map is smaller than 4 x 4.
        """
        self.require_complete()
        if min(self.shape) < 4:
            raise InputError(f"statistics: expected at least 4 x 4 pixels, the map is {self.shape}")
        return surface_statistics(np.asarray(self.heights), self.pixel, periodic=periodic)

    def check_sampling(
        self,
        wavelength: Any,
        *,
        max_angle: Number | None = None,
        u_max: Number | None = None,
        jumps: bool = False,
    ) -> None:
        """Refuse a pixel too coarse for diffraction; the text says which would do.

        See `diffopt.sampling.check_sampling` for the two limits and the arguments.

        Raises
        ------
        InputError
            If pixels are missing, the pixel is too coarse, or an argument is out of range.
        """
        self.require_complete()
        check_sampling(
            np.asarray(self.heights),
            self.pixel,
            wavelength,
            max_angle=max_angle,
            u_max=u_max,
            jumps=jumps,
        )

    def save(self, path: str | os.PathLike) -> None:
        """Write ``.npz`` (exact) or 16-bit ``.tif``, with units and history.

        Both load back without further arguments. Nothing is left behind on failure.

        Raises
        ------
        InputError
            If the suffix is another one, the folder does not exist, or pixels are missing
            and the file is a TIFF.
        """
        from diffopt.io import write

        record = self.provenance
        origin = f"from {record.source}" + (f", channel {record.channel}" if record.channel else "")
        write(path, np.asarray(self.heights), self.pixel, (origin, *record.steps))

    def _with(
        self, heights: Array, step: str, pixel: tuple[float, float] | None = None
    ) -> "Heightfield":
        return Heightfield(
            heights,
            self.pixel if pixel is None else pixel,
            provenance=self.provenance.then(step),
            missing="keep",
        )

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        from diffopt.previews import bundles, heights

        return bundles.bundle(self, heights.card)
