"""The files that the pages name as a reader's own, each made here by the simplest means."""

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from doc_blocks import ROOT

SIDE, PIXEL = 128, 0.08


def heights() -> np.ndarray:
    """A sinusoidal grating of 1.6 um with some noise, micrometres."""
    x = PIXEL * np.arange(SIDE)
    noise = 0.002 * np.random.default_rng(0).normal(size=(SIDE, SIDE))
    return 0.05 * np.sin(2.0 * np.pi * x / 1.6)[None] + noise


def sur(path: Path) -> None:
    """A Digital Surf file by its published layout: header of 512 bytes, 32-bit points."""
    points = np.rint(heights() * 1e5).astype("<i4")
    low, high, (ny, nx) = int(points.min()), int(points.max()), points.shape
    text = lambda value, size: value.ljust(size, b"\x00")  # noqa: E731
    header = b"DIGITAL SURF" + struct.pack("<4H", 0, 1, 1, 2)
    header += text(b"grating", 30) + text(b"none", 30)
    header += struct.pack("<5H2IH", 0, 0, 0, 0, 1, 0, 0, 32)
    header += struct.pack("<4iI", low, high, nx, ny, nx * ny)
    header += struct.pack("<3f", PIXEL, PIXEL, 0.01)
    header += text(b"X", 16) + text(b"Y", 16) + text(b"Z", 16)
    header += (text("\u00b5m".encode("latin-1"), 16) * 2 + text(b"nm", 16)) * 2
    header += struct.pack("<3f3H3I7Hf2I3H", 1, 1, 1, 0, 0, 0, 0, 0, 0, *[1] * 6, 2026, 0, *[0] * 5)
    header += bytes(128) + struct.pack("<3f", 0, 0, 0) + bytes(34)
    path.write_bytes(header + points.tobytes())


def npz(path: Path) -> None:
    import diffopt as do

    do.Heightfield(heights(), PIXEL).save(path)


def grey(path: Path) -> None:
    import PIL.Image

    h = heights()
    PIL.Image.fromarray(np.rint((h - h.min()) / np.ptp(h) * 65535).astype(np.uint16)).save(path)


def wood(path: Path) -> None:
    import PIL.Image

    rings = 120 + 60 * np.sin(np.hypot(*np.mgrid[:32, :32]))
    PIL.Image.fromarray(np.stack([rings, 0.7 * rings, 0.4 * rings], -1).astype(np.uint8)).save(path)


def mesh(path: Path) -> None:
    import trimesh

    trimesh.creation.icosphere(2, 1.0).export(path)


def sky() -> np.ndarray:
    up = np.linspace(1.0, 0.0, 16)[:, None, None]
    return np.broadcast_to(0.2 + up * np.array([0.4, 0.6, 1.0]), (16, 32, 3)).astype(np.float32)


def sky_exr(path: Path) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(sky())}) as file:
        file.write(str(path))


def sky_npy(path: Path) -> None:
    np.save(path, sky())


def paths(path: Path) -> None:
    """Directions about the normal, and weights."""
    rng = np.random.default_rng(1)
    w = rng.normal(size=(2000, 3)) * 0.3 + [0.0, 0.0, 1.0]
    np.save(path, np.c_[w / np.linalg.norm(w, axis=1, keepdims=True), rng.uniform(size=2000)])


def felt(path: Path) -> None:
    """A table of a gonioreflectometer: sheen of a rough cloth, by a virtual one."""
    import diffopt as do

    cloth = do.materials.OrenNayar([0.5, 0.2, 0.2], 0.5)
    theta, phi = np.radians([0.0, 40.0, 80.0]), np.radians([0.0, 60.0, 120.0, 180.0])
    do.materials.measure(cloth, theta, theta, phi).save(path)


def examples(path: Path) -> None:
    shutil.copytree(ROOT / "docs" / "examples", path)


#: Name in the pages: how it is made.
INPUTS: dict[str, Callable[[Path], None]] = {
    "scan.sur": sur,
    "scan.npz": npz,
    "photo_of_heights.png": grey,
    "wood.png": wood,
    "bunny.ply": mesh,
    "sky.exr": sky_exr,
    "sky.npy": sky_npy,
    "paths.npy": paths,
    "felt.npz": felt,
    "docs/examples": examples,
}


def provide(folder: Path, text: str) -> None:
    """Make the files that a text names."""
    for name, make in INPUTS.items():
        if name in text:
            target = folder / name
            target.parent.mkdir(parents=True, exist_ok=True)
            make(target)
