"""Heightfields: arrays, pictures, texts, Gwyddion's files and those of instruments."""

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.readers.base import (
    BARE,
    GREY,
    HEIGHTS,
    PIXEL,
    Seed,
    grey,
    npy,
    npz,
    picture,
    single,
    written,
)


def load_heights(path: Path, **options: Any) -> Any:
    from diffopt.heightfield import Heightfield

    return Heightfield.load(path, missing="keep", **options)


def tiff(values: np.ndarray, **more: Any) -> bytes:
    import tifffile

    out = io.BytesIO()
    tifffile.imwrite(out, values, **more)
    return out.getvalue()


def own(path: Path) -> None:
    from diffopt.heightfield import Heightfield

    Heightfield(HEIGHTS, PIXEL).save(path)


def text(array: np.ndarray, **more: Any) -> str:
    out = io.StringIO()
    np.savetxt(out, array, **more)
    return out.getvalue()


def points() -> np.ndarray:
    y, x = np.mgrid[:6, :9]
    return np.stack([x * 125.0, y * 250.0, HEIGHTS * 1000], axis=-1).reshape(-1, 3)


def arrays() -> dict[str, Seed]:
    return {
        "npy": single("a.npy", npy(HEIGHTS), **BARE),
        "npy fortran": single("a.npy", npy(np.asfortranarray(HEIGHTS.astype(">f4"))), **BARE),
        "npy whole": single("a.npy", npy(grey(np.int16)), **BARE),
        "npz": written("a.npz", own),
        "npz foreign": single("a.npz", npz(z=HEIGHTS, extra=np.arange(3)), **BARE),
    }


def pictures() -> dict[str, Seed]:
    colour = np.repeat(grey(np.uint8)[..., None], 3, axis=-1)
    return {
        "png 8": single("a.png", picture(grey(np.uint8), "PNG"), **GREY),
        "png 16": single("a.png", picture(grey(np.uint16), "PNG"), **GREY),
        "png colour": single("a.png", picture(colour, "PNG"), **GREY),
        "own": written("a.tif", own),
        "tiff 8": single("a.tif", tiff(grey(np.uint8)), **GREY),
        "tiff 16": single("a.tif", tiff(grey(np.uint16), byteorder=">"), **GREY),
        "tiff packed": single("a.tiff", tiff(grey(np.uint16), compression="zlib"), **GREY),
        "tiff big": single("a.tiff", tiff(grey(np.uint16), bigtiff=True), **GREY),
        "tiff tiles": single("a.tif", tiff(grey(np.uint8), tile=(16, 16)), **GREY),
        "tiff float": single("a.tif", tiff(HEIGHTS.astype(np.float32)), **BARE),
    }


def texts() -> dict[str, Seed]:
    header = "Channel: Height\nWidth: 1.125 µm\nHeight: 1.5 µm\nValue units: nm"
    return {
        "matrix": single("a.txt", text(HEIGHTS, fmt="%.4g"), **BARE),
        "gwyddion": single("a.asc", text(HEIGHTS, header=header, fmt="%.3f", delimiter="\t")),
        "comma": single("a.csv", text(HEIGHTS, delimiter=",", fmt="%g"), **BARE),
        "xyz": single("a.xyz", text(points(), fmt="%g"), height_unit="nm"),
    }


def gwyddion() -> dict[str, Seed]:
    from gwyfile.objects import GwyContainer, GwyDataField

    def field(data: np.ndarray, unit: str) -> Any:
        field = GwyDataField(data, si_unit_xy="m", si_unit_z=unit)
        field.xreal, field.yreal = 9 * 125e-9, 6 * 250e-9
        return field

    content = GwyContainer()
    content["/0/data/title"], content["/0/data"] = "Phase", field(HEIGHTS, "deg")
    content["/3/data/title"], content["/3/data"] = "Topography", field(HEIGHTS * 1e-6, "m")
    content["/3/mask"] = field((HEIGHTS > 0.2).astype(float), "")
    return {"gwy": written("a.gwy", lambda path: content.tofile(str(path)))}


def digital_surf() -> bytes:
    """A file by its published layout: header of 512 bytes, 32-bit points."""
    data = np.rint(HEIGHTS * 1e5).astype("<i4")
    low, high, (ny, nx) = int(data.min()), int(data.max()), data.shape
    micro = "\u00b5m".encode("latin-1").ljust(16, b"\0")
    header = b"DIGITAL SURF" + struct.pack("<4H30s30s", 0, 1, 1, 2, b"seed", b"none")
    header += struct.pack("<5H2IH", 0, 0, 0, 0, 1, 0, 0, 32)
    header += struct.pack("<4iI3f", low, high, nx, ny, nx * ny, 0.125, 0.25, 0.01)
    header += struct.pack("<16s16s16s", b"X", b"Y", b"Z") + (micro * 2 + b"nm".ljust(16, b"\0")) * 2
    header += struct.pack("<3f3H3I7Hf2I3H", 1, 1, 1, 0, 0, 0, 0, 0, 0, *[1] * 6, 2026, 0, *[0] * 5)
    return header.ljust(512, b"\0") + data.tobytes()


def instruments() -> dict[str, Seed]:
    """Formats of SurfaceTopography that it, SciPy or h5py write, or whose layout is short."""
    import h5py
    import scipy.io
    from SurfaceTopography import Topography

    surface = Topography(HEIGHTS.T * 1e3, (9 * 125.0, 6 * 250.0), unit="nm")

    def hdf5(path: Path) -> None:
        with h5py.File(path, "w") as file:
            file["surface"] = HEIGHTS

    sdf = "aISO-1.0\nManufacID = seed\nCreateDate = 010120261200\nModDate = 010120261200\n"
    sdf += "NumPoints = 9\nNumProfiles = 6\nXscale = 1.25e-7\nYscale = 2.5e-7\nZscale = 1e-9\n"
    sdf += "Zresolution = -1\nCompression = 0\nDataType = 7\nCheckType = 0\n*\n"
    sdf += text(HEIGHTS * 1e3, fmt="%.4f") + "*\n"
    bcr = "fileformat = bcrf\nheadersize = 2048\nxpixels = 9\nypixels = 6\nxlength = 1125\n"
    bcr += "ylength = 1500\nxunit = nm\nyunit = nm\nzunit = nm\nbit2nm = 1\nintelmode = 1\n"
    floats = (HEIGHTS * 1e3).astype("<f4").tobytes()
    return {
        "sur": single("a.sur", digital_surf()),
        "x3p": written("a.x3p", lambda path: surface.to_x3p(str(path))),
        "netcdf": written("a.nc", lambda path: surface.to_netcdf(str(path))),
        "hdf5": written("a.h5", hdf5, **BARE),
        "matlab": written("a.mat", lambda path: scipy.io.savemat(path, {"h": HEIGHTS}), **BARE),
        "sdf": single("a.sdf", sdf),
        "bcr": single("a.bcrf", bcr.encode().ljust(2048, b" ") + floats),
        "npy": single("a.dat", npy(HEIGHTS), **BARE),
        "npz": single("a.dat", npz(z=HEIGHTS), **BARE),
        "asc": single("a.ascii", text(HEIGHTS, fmt="%.3f"), **BARE),
    }
