"""Heights as grey values: 8- and 16-bit PNG and TIFF, and floating-point TIFF.

Grey values are taken as they are stored, linear in height: 0 is the low end of
``height_range`` and the greatest value of the type (255 or 65535) the high end. Gamma and
colour profiles are disregarded. Row 0 is the top row of the picture.
"""

import json
import math
import struct
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from diffopt.errors import InputError
from diffopt.io import limits, numpy_files
from diffopt.io.files import one_line, replacing, require_signature
from diffopt.io.record import Options, Record

FORMAT = "diffopt heightfield"
VERSION = 1
LEVELS = 65535
# Name and checksum of the chunk that ends every PNG; decoders do without it.
_PNG_END = b"IEND\xaeB`\x82"
# Numbers of TIFF's compressions: none, LZW, deflate by two numbers, PackBits. Others need memory
# that only their data state.
_DEFLATED = (8, 32946)
_COMPRESSIONS = (1, 5, *_DEFLATED, 32773)


def read_png(path: Path, options: Options) -> Record:
    """Read an 8- or 16-bit grey PNG; ``pixel_size`` and ``height_range`` are required.

    Grey stored as opaque colour (three equal channels) is accepted.

    Raises
    ------
    InputError
        If the file is damaged, of another format, in colour, or has more pixels than
        ``PIL.Image.MAX_IMAGE_PIXELS``.
    """
    options.refuse(path, "a PNG image has one channel", "channel")
    options.refuse(path, "grey values have no unit; pass height_range=", "height_unit")
    grey, mode = png(path)
    if mode in ("RGB", "RGBA"):
        equal = (grey[..., 0] == grey[..., 1]) & (grey[..., 0] == grey[..., 2])
        opaque = mode == "RGB" or (grey[..., 3] == 255).all()
        if not (equal.all() and opaque):
            raise InputError(f"{path}: a colour image ({mode}); expected heights as grey values")
        grey = grey[..., 0]
    elif mode not in ("L", "I;16", "I;16B", "I;16L", "I;16N"):
        raise InputError(f"{path}: PNG of mode {mode}; expected 8- or 16-bit grey")
    return _from_grey(path, grey, options)


def png(path: Path) -> tuple[np.ndarray, str]:
    """Values of a PNG as they are stored, [H, W] or [H, W, C], and Pillow's name of its mode.

    Raises
    ------
    InputError
        If the file is damaged, of another format, or has more pixels than
        ``PIL.Image.MAX_IMAGE_PIXELS``.
    """
    import PIL.Image

    require_signature(path, (b"\x89PNG\r\n\x1a\n",), "a PNG image")
    content = path.read_bytes()
    if _PNG_END not in content:
        raise InputError(f"{path}: the PNG image is truncated: its end chunk is missing")
    _png_claim(path, content)
    try:
        # Pillow warns beyond its limit and raises beyond twice that: here both are refusals.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.simplefilter("error", PIL.Image.DecompressionBombWarning)
            with PIL.Image.open(path, formats=["PNG"]) as image:
                # Numbers of a palette are no values: its colours are.
                shown = image.convert("RGB") if image.mode in ("P", "PA") else image
                return np.asarray(shown), image.mode
    except (PIL.Image.DecompressionBombWarning, PIL.Image.DecompressionBombError) as error:
        width, height = struct.unpack(">II", content[16:24])
        raise InputError(
            f"{path}: {width * height} pixels ({width} x {height}); expected at most "
            f"PIL.Image.MAX_IMAGE_PIXELS = {PIL.Image.MAX_IMAGE_PIXELS} (crop or resample the "
            "picture, or raise the limit if you trust the file)"
        ) from error
    except Exception as error:  # a damaged picture fails in many ways inside the decoder
        raise InputError(f"{path}: the PNG image is damaged: {one_line(error)}") from error


def _png_claim(path: Path, content: bytes) -> None:
    """Refuse more samples than are read, more than the packed bytes can hold, and chunks that
    claim to go on beyond the file.
    """
    import PIL.Image

    at = 8
    while at + 8 <= len(content):
        (size,) = struct.unpack_from(">I", content, at)
        at += 12 + size
    if at > len(content):
        raise InputError(
            f"{path}: the PNG image is truncated: a chunk ends at byte {at} of {len(content)}"
        )
    width, height, depth, kind = struct.unpack(">IIBB", content[16:26].ljust(10, b"\0"))
    channels = {2: 3, 3: 3, 4: 2, 6: 4}.get(kind, 1)
    # Of more pixels Pillow's own limit speaks.
    if width * height > (PIL.Image.MAX_IMAGE_PIXELS or 0):
        return
    limits.samples(path, (width, height, channels))
    row = 1 + width * depth * (1 if kind == 3 else channels) // 8
    limits.inflated(path, height * row, len(content), "the PNG image")


def read_tiff(path: Path, options: Options) -> Record:
    """Read a TIFF image: the project's own, 8- or 16-bit grey, or floating point.

    Grey values need ``pixel_size`` and ``height_range``; floating-point values need
    ``pixel_size`` and ``height_unit``; the project's own files need neither. Of several
    pages ``channel`` is the number of the one to read.

    Raises
    ------
    InputError
        If the file is damaged, of another format, or in colour.
    """
    import tifffile

    signatures = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
    require_signature(path, signatures, "a TIFF image")
    size = path.stat().st_size
    try:
        with tifffile.TiffFile(path) as file:
            page = _page(path, file, options)
            ends = np.add(page.dataoffsets, page.databytecounts)
            if len(ends) == 0 or ends.max() > size:
                raise InputError(
                    f"{path}: the TIFF image is truncated: {size} bytes, its data would need "
                    f"{int(ends.max()) if len(ends) else 'more'}"
                )
            _plausible(path, file, page)
            values, description = page.asarray(), page.description
    except InputError:
        raise
    except Exception as error:  # a damaged header fails in many ways inside the decoder
        raise InputError(f"{path}: the TIFF image is damaged: {one_line(error)}") from error
    if values.ndim != 2:
        raise InputError(
            f"{path}: TIFF image of shape {values.shape}; expected heights as one grey plane"
        )
    if f'"{FORMAT}"' in description:
        return _own(path, values, description, options)
    if values.dtype.kind == "f":
        options.refuse(path, "the TIFF holds numbers, not grey values", "height_range")
        heights = numpy_files.doubles(values) * options.unit(path)
        return Record(heights, options.pixel(path), _channel(options))
    options.refuse(path, "grey values have no unit; pass height_range=", "height_unit")
    return _from_grey(path, values, options)


def _plausible(path: Path, file: Any, page: Any) -> None:
    """Refuse a page that says it is larger than it can be, before room is made for it."""
    limits.samples(path, page.shape)
    limits.samples(path, (page.imagewidth, page.imagelength, page.samplesperpixel))
    if int(page.compression) not in _COMPRESSIONS:
        raise InputError(
            f"{path}: TIFF compressed by {page.compression!r}; expected none, deflate, LZW or "
            "PackBits"
        )
    # A strip or a tile, at the widest that a number can be.
    piece = limits.samples(path, page.chunks) * 8
    whole = sum(page.databytecounts)
    if int(page.compression) == 1:
        need = math.prod(page.shape) * page.dtype.itemsize
        if need > file.filehandle.size:
            raise InputError(
                f"{path}: the TIFF image is truncated: {page.shape} of {page.dtype} need {need} "
                f"bytes, the file has {file.filehandle.size}"
            )
        return
    # What is packed best, deflated data, grows by 1,032; a strip of nothing needs some bytes.
    limits.inflated(path, math.prod(page.shape) * page.dtype.itemsize, whole, "the TIFF image")
    if int(page.compression) in _DEFLATED:
        for offset, count in zip(page.dataoffsets, page.databytecounts, strict=True):
            file.filehandle.seek(offset)
            limits.inflates_to(path, file.filehandle.read(count), piece)


def write_tiff(
    path: Path, heights: np.ndarray, pixel: tuple[float, float], steps: tuple[str, ...]
) -> None:
    """Write a 16-bit TIFF whose description states unit, pixel, range and history.

    Heights are rounded to 65,535 steps between their extremes: the error is at most
    peak-to-valley / 131,070. The resolution tags carry the pixel size as well.

    Raises
    ------
    InputError
        If pixels are missing: 16-bit grey cannot mark them.
    """
    import tifffile

    heights = heights.astype(np.float64)
    missing = int(np.isnan(heights).sum())
    if missing:
        raise InputError(
            f"{path}: {missing} missing pixels cannot be written to a 16-bit TIFF; "
            "call .filled() first, or write .npz"
        )
    low, high = float(heights.min()), float(heights.max())
    grey = np.rint((heights - low) * (LEVELS / (high - low) if high > low else 0.0))
    description = {
        "format": FORMAT,
        "version": VERSION,
        "unit": "um",
        "pixel": list(pixel),
        "height_range": [low, high],
        "steps": list(steps),
    }
    with replacing(path) as file:
        tifffile.imwrite(
            file,
            grey.astype(np.uint16),
            description=json.dumps(description),
            metadata=None,
            resolution=(1e4 / pixel[1], 1e4 / pixel[0]),
            resolutionunit="CENTIMETER",
            software="diffopt",
        )


def _page(path: Path, file: Any, options: Options) -> Any:
    count = len(file.pages)
    index = options.channel
    if index is None and count != 1:
        raise InputError(f"{path}: {count} pages; name one by channel=0 to {count - 1}")
    index = 0 if index is None else index
    if not isinstance(index, int) or not 0 <= index < count:
        raise InputError(f"{path}: no page {index!r}; there are {count}, counted from 0")
    return file.pages[index]


def _own(path: Path, values: np.ndarray, description: str, options: Options) -> Record:
    options.refuse(path, "the file states its heights", "height_range", "height_unit")
    try:
        stated = json.loads(description)
        version, unit = stated["version"], stated["unit"]
        dy, dx = (float(value) for value in stated["pixel"])
        low, high = (float(value) for value in stated["height_range"])
        steps = tuple(str(step) for step in stated["steps"])
    except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: a damaged {FORMAT} file: {one_line(error)}") from error
    if version != VERSION or unit != "um" or values.dtype != np.uint16:
        raise InputError(
            f"{path}: {FORMAT} version {version} in {unit!r} as {values.dtype}; "
            f"expected version {VERSION} in 'um' as uint16"
        )
    heights = low + numpy_files.doubles(values) * ((high - low) / LEVELS)
    note = f"16-bit heights in steps of {(high - low) / LEVELS:.3g} um"
    return Record(heights, options.pixel(path, (dy, dx)), steps=steps, notes=(note,))


def _from_grey(path: Path, grey: np.ndarray, options: Options) -> Record:
    if grey.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: grey values of type {grey.dtype}; expected uint8 or uint16")
    pixel = options.pixel(path)
    if options.height_range is None:
        raise InputError(
            f"{path}: grey values state no height; pass height_range=(low, high) in micrometres"
        )
    low, high = options.height_range
    step = (high - low) / np.iinfo(grey.dtype).max
    note = f"{8 * grey.dtype.itemsize}-bit heights in steps of {step:.3g} um"
    heights = low + grey.astype(np.float64) * step
    return Record(heights, pixel, _channel(options), notes=(note,))


def _channel(options: Options) -> str | None:
    return None if options.channel is None else f"page {options.channel}"
