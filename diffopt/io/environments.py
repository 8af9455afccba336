"""Maps of radiance and pictures from files: ``.exr``, ``.hdr``, ``.png``, ``.npy``.

Maps are in longitude and latitude: the first row at the zenith, columns from azimuth 0.
"""

import re
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float

from diffopt.errors import InputError
from diffopt.io import limits, numpy_files
from diffopt.io.files import describe, existing_file, one_line, openexr, require_signature
from diffopt.io.images import png

#: Suffixes of pictures; ``.npy`` is read as well.
SUFFIXES = (".exr", ".hdr", ".png")

# Attributes of an .exr: name, type, length of the value, value.
_WINDOW = re.compile(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", re.DOTALL)
_TILES = re.compile(rb"tiles\0tiledesc\0\x09\0\0\0(.{8})", re.DOTALL)


def read(path: Path) -> np.ndarray:
    """Linear values of a picture, [H, W] or [H, W, C]; 1 is white in a ``.png``.

    Parameters
    ----------
    path
        ``.exr`` (extra ``exr``), ``.hdr`` (Radiance), ``.png`` (sRGB) or ``.npy`` (values as
        they are).

    Raises
    ------
    InputError
        For another suffix, a file that is not there, or one that cannot be read.
    """
    readers = {".exr": _exr, ".hdr": _radiance_hdr, ".png": _png, ".npy": _array}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"{path}: expected one of {', '.join(readers)}")
    return reader(existing_file(path))


def checked(path: Path, image: np.ndarray) -> tuple[Float[np.ndarray, "H W C"], tuple[str, ...]]:
    """A map that can light something, and what was assumed about it.

    Parameters
    ----------
    path
        Its file, for texts.
    image
        [H, W] or [H, W, C].

    Returns
    -------
    tuple
        [H, W, C], float64, nothing below 0; notes of one sentence each.

    Raises
    ------
    InputError
        If a value is not finite, or all are 0.
    """
    image = numpy_files.doubles(np.asarray(image))
    image = image[..., None] if image.ndim == 2 else image
    if not np.isfinite(image).all():
        bad = int((~np.isfinite(image)).any(-1).sum())
        raise InputError(f"{path}: {bad} of {image[..., 0].size} pixels are NaN or infinite")
    notes = []
    if path.suffix.lower() == ".png":
        notes.append("a .png holds 8 or 16 bits of sRGB: what is brighter than white is cut off")
    if (image < 0.0).any():
        notes.append(f"{int((image < 0.0).any(-1).sum())} pixels with negative values: taken as 0")
        image = np.maximum(image, 0.0)
    if not image.any():
        raise InputError(f"{path}: the map is black")
    height, width = image.shape[:2]
    if width != 2 * height:
        notes.append(
            f"{width} x {height} pixels: taken for the whole sphere, 360 x 180 degrees, though not "
            "twice as wide as high"
        )
    return image, tuple(notes)


def linear(srgb: np.ndarray) -> np.ndarray:
    """Linear values of sRGB's code values in [0, 1]."""
    return np.where(srgb > 0.04045, ((srgb + 0.055) / 1.055) ** 2.4, srgb / 12.92)


def codes(path: Path) -> np.ndarray:
    """Code values of a PNG picture as they are stored, 0 to 1, [H, W] or [H, W, 3]; no alpha."""
    found, _ = png(path)
    if found.dtype.kind != "u" or found.ndim not in (2, 3):
        raise InputError(f"{path}: expected 8 or 16 bits a channel; received {found.dtype}")
    if found.ndim == 3:
        found = found[..., :3] if found.shape[2] > 2 else found[..., 0]
    return found / np.iinfo(found.dtype).max


def _array(path: Path) -> np.ndarray:
    found = numpy_files.array(path)
    if found.dtype.kind not in "fiu":
        raise InputError(f"{path}: expected an array of real numbers")
    if found.ndim not in (2, 3) or 0 in found.shape:
        raise InputError(f"{path}: expected [H, W] or [H, W, C]; received {found.shape}")
    return numpy_files.doubles(found)


def _png(path: Path) -> np.ndarray:
    """Linear radiance of an sRGB image; 1 is white."""
    return linear(codes(path))


def _exr(path: Path) -> np.ndarray:
    require_signature(path, (b"\x76\x2f\x31\x01",), "an OpenEXR image")
    _window(path)
    library = openexr(path, "it as .npy or .hdr")
    try:
        parts = library.File(str(path)).channels()
    except Exception as error:  # what the library throws is of any kind
        raise InputError(f"{path}: cannot be read: {one_line(error)}") from error
    pixels = {name: np.asarray(channel.pixels) for name, channel in parts.items()}
    for name in ("RGB", "RGBA", "Y"):
        if name in pixels:
            return pixels[name] if name == "Y" else pixels[name][..., :3]
    raise InputError(f"{path}: expected channels R, G, B or Y; received {', '.join(pixels)}")


def _window(path: Path) -> None:
    """Refuse an .exr whose header states more pixels than are read, for any of its parts."""
    with path.open("rb") as file:
        head = file.read(2**16)
    for found in _WINDOW.finditer(head):
        left, top, right, bottom = struct.unpack("<4i", found[1])
        sides = right - left + 1, bottom - top + 1
        if min(sides) < 1:
            raise InputError(f"{path}: a data window of {sides[0]} x {sides[1]} pixels")
        limits.samples(path, (*sides, 4))
    for found in _TILES.finditer(head):
        limits.samples(path, (*struct.unpack("<2I", found[1]), 4))


def _radiance_hdr(path: Path) -> Float[np.ndarray, "H W 3"]:
    """Radiance's RGBE pictures: rows from the top, plain or run-length encoded."""
    data = path.read_bytes()
    if not data.startswith(b"#?"):
        raise InputError(f"{path}: expected a Radiance .hdr image, found {describe(path)}")
    head, _, rest = data.partition(b"\n\n")
    size, _, body = rest.partition(b"\n")
    words = size.split()
    if b"32-bit_rle_rgbe" not in head or len(words) != 4 or words[::2] != [b"-Y", b"+X"]:
        raise InputError(
            f"{path}: expected 32-bit_rle_rgbe with rows from the top (-Y H +X W); received "
            f"{size[:40].decode('latin1')!r}"
        )
    if not (words[1].isdigit() and words[3].isdigit() and len(words[1] + words[3]) <= 20):
        raise InputError(f"{path}: expected numbers of rows and columns; received {size[:40]!r}")
    height, width = int(words[1]), int(words[3])
    pixels = limits.samples(path, (height, width), "pixels")
    if not pixels:
        raise InputError(f"{path}: {width} x {height} pixels; expected at least one")
    code = np.frombuffer(body, np.uint8)
    # A run of 127 equal bytes takes two.
    if 64 * code.size < 4 * pixels:
        raise InputError(f"{path}: the file ends before its {width} x {height} pixels do")
    if code.size >= 4 and code[0] == code[1] == 2 and 8 <= width < 32768:
        try:
            code = _unpacked(code, height, width)
        except IndexError:
            code = code[:0]
    if code.size < 4 * height * width:
        raise InputError(f"{path}: the file ends before its {width} x {height} pixels do")
    pixels = code[: 4 * height * width].reshape(height, width, 4).astype(np.float64)
    scale = np.where(pixels[..., 3:] > 0.0, np.exp2(pixels[..., 3:] - 136.0), 0.0)
    return (pixels[..., :3] + 0.5 * (pixels[..., 3:] > 0.0)) * scale


def _unpacked(code: np.ndarray, height: int, width: int) -> np.ndarray:
    """Run-length encoded rows, each channel apart."""
    out = np.empty((height, 4, width), np.uint8)
    at = 0
    for row in out:
        at += 4
        for channel in row:
            done = 0
            while done < width:
                count = int(code[at])
                run = count > 128
                count = count - 128 if run else count
                values = code[at + 1] if run else code[at + 1 : at + 1 + count]
                if not count or done + count > width or np.size(values) not in (1, count):
                    raise IndexError
                channel[done : done + count] = values
                at += 2 if run else 1 + count
                done += count
    return out.transpose(0, 2, 1).reshape(-1)
