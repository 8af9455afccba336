"""Readers of files that come from outside, each with small sound files to be damaged.

A seed is a folder: files by their names, and the one that is loaded. Seeds are made by the
project's writers, by the libraries that read them, or byte by byte where nothing here writes
the format.
"""

import dataclasses
import io
import struct
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

PIXEL = (0.25, 0.125)
HEIGHTS = np.add.outer(np.arange(6.0) ** 2, 0.5 * np.arange(9.0)) / 100
GREY = {"pixel_size": PIXEL, "height_range": 2.0}
BARE = {"pixel_size": PIXEL, "height_unit": "um"}


@dataclasses.dataclass(frozen=True)
class Seed:
    """A folder of files: their contents by name, and the name that is loaded."""

    files: dict[str, bytes]
    main: str
    options: dict[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class Reader:
    """A loading function and its seeds.

    Attributes
    ----------
    load
        Of a path and the seed's options, as the command line or a script calls it.
    seeds
        Makes them.
    quick, long
        Damaged files in the usual run and at night.
    """

    load: Callable[..., Any]
    seeds: Callable[[], dict[str, Seed]]
    quick: int = 1000
    long: int = 10_000


def written(name: str, write: Callable[[Path], Any], **options: Any) -> Seed:
    """The seed that a function leaves at a path: a file or a folder."""
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write(Path(folder) / name)
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in sorted(Path(folder).rglob("*"))
            if path.is_file()
        }
    return Seed(files, name, options)


def single(name: str, content: bytes | str, **options: Any) -> Seed:
    """A seed of one file."""
    raw = content.encode() if isinstance(content, str) else content
    return Seed({name: raw}, name, options)


# --- heights -------------------------------------------------------------------------------


def load_heights(path: Path, **options: Any) -> Any:
    from diffopt.heightfield import Heightfield

    return Heightfield.load(path, missing="keep", **options)


def picture(values: np.ndarray, kind: str) -> bytes:
    import PIL.Image

    out = io.BytesIO()
    PIL.Image.fromarray(values).save(out, format=kind)
    return out.getvalue()


def grey(kind: Any) -> np.ndarray:
    return np.rint(HEIGHTS / HEIGHTS.max() * np.iinfo(kind).max).astype(kind)


def tiff(values: np.ndarray, **more: Any) -> bytes:
    import tifffile

    out = io.BytesIO()
    tifffile.imwrite(out, values, **more)
    return out.getvalue()


def npy(array: Any) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def npz(**arrays: Any) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
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


# --- materials and lobes -------------------------------------------------------------------


def load_small_merl(path: Path) -> Any:
    from diffopt.materials.merl import load_merl

    return load_merl(path, shape=(4, 3, 4))


def merl() -> dict[str, Seed]:
    planes = np.random.default_rng(1).uniform(0.1, 2.0, (3, 4, 3, 4))
    return {"merl": single("a.binary", struct.pack("<3i", 4, 3, 4) + planes.tobytes())}


def load_named(path: Path) -> Any:
    from diffopt.materials import naming

    return naming.load(path)


def tensors() -> dict[str, Seed]:
    from diffopt.materials.tensorfile import write_tensors

    rng = np.random.default_rng(2)
    turn = np.float32(np.pi)
    polarised = {
        "phi_d": np.linspace(-turn, turn, 3)[None],
        "theta_d": np.linspace(0, turn / 2, 3)[None],
        "theta_h": np.zeros((1, 0)),
        "wvls": np.array([450, 600], np.uint16),
        "M": rng.uniform(0.1, 1.0, (3, 3, 2, 2, 4, 4)),
    }

    def rgl(phi: np.ndarray) -> dict[str, np.ndarray]:
        n = len(phi)
        return {
            "phi_i": phi,
            "theta_i": np.linspace(0, turn / 2, 3),
            "ndf": rng.uniform(0.5, 2.0, (3, 4)),
            "sigma": rng.uniform(0.5, 1.0, (3, 3)),
            "vndf": rng.uniform(0.3, 2.0, (n, 3, 3, 4)),
            "rgb": rng.uniform(0.1, 1.0, (n, 3, 3, 2, 2)),
            "jacobian": np.array([1], np.uint8),
        }

    def seed(name: str, fields: dict[str, np.ndarray]) -> Seed:
        kept = {k: v.astype(np.float32) if v.dtype.kind == "f" else v for k, v in fields.items()}
        return written(name, lambda path: write_tensors(path, kept))

    return {
        "rgl": seed("a.bsdf", rgl(np.linspace(-turn, -turn / 2, 3))),
        "rgl isotropic": seed("a.bsdf", rgl(np.zeros(1))),
        "pbsdf": seed("a.pbsdf", polarised),
    }


def goniometer() -> dict[str, np.ndarray]:
    i, o, turn = np.meshgrid([0.0, 30.0], [10.0, 60.0], [0.0, 180.0])
    i, o, turn = i.ravel(), o.ravel(), turn.ravel()
    return {"theta_i": i, "phi_i": 0 * i, "theta_o": o, "phi_o": turn, "f": 0.1 + 0.001 * o}


def columns(names: dict[str, np.ndarray], mark: str = ",") -> str:
    rows = [mark.join(f"{value:g}" for value in row) for row in zip(*names.values(), strict=True)]
    return "# seed\n" + mark.join(names) + "\n" + "\n".join(rows) + "\n"


def tables() -> dict[str, Seed]:
    table = goniometer()
    values = table.pop("f")
    spectrum = table | {"450nm_cos": values, "600nm_cos": values}
    return {
        "csv": single("a.csv", columns(table | {"f": values})),
        "csv spectrum": single("a.csv", columns(spectrum, ";")),
        "npz": single("a.npz", npz(**table, r=values, g=values, b=values)),
    }


def load_lobes(path: Path) -> Any:
    from diffopt.lobes import Lobes

    return Lobes.load(path)


def lobes() -> dict[str, Seed]:
    from diffopt.lobes import Lobes

    found = Lobes(np.ones((2, 3)), np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0]]), np.array([3.0, 9]))
    return {f"lobes {s}": written(f"a.{s}", found.save) for s in ("npz", "json")}


def load_target(path: Path) -> Any:
    from diffopt.cli import fit_targets

    return fit_targets.read(str(path), {})


def targets() -> dict[str, Seed]:
    ways = np.array([[0.0, 0.6, 0.8], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    return {
        "npy": single("a.npy", npy(np.c_[ways, np.ones(4)])),
        "npz": single("a.npz", npz(directions=ways, weights=np.ones(4))),
        "csv": single("a.csv", columns(dict(zip("xyz", ways.T, strict=True)))),
        "map": single("a.npy", npy(sky())),
    }


def load_measured(path: Path) -> Any:
    from diffopt.fitting import measured_files

    measured_files.is_measured(path)
    with warnings.catch_warnings():
        # Documented: rows of sRGB that were clipped are left out with a warning.
        warnings.filterwarnings("ignore", "(?s).*rows were left out")
        return measured_files.load(path)


def reflectance() -> dict[str, Seed]:
    from diffopt.fitting.measured import Measured

    wi = np.array([0.0, 0.6, 0.8])
    wo = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    values = np.array([[0.1, 0.2], [0.3, 0.1], [0.2, 0.2]])
    data = Measured(wi, wo, np.array([0.45, 0.6]), values, 2.0, noise=0.01, noise_known=True)
    angles = "theta_i_deg;phi_i_deg;theta_o_deg;phi_o_deg;R;G;B\n"
    colours = "# coherence: 2.0 um\n# quantity: srgb\n# scale: 255\n# illuminant: A\n" + angles
    colours += "10;0;20;0;20;30;40\n10;0;30;0;25;35;1\n10;0;40;90;10;20;30\n"
    tri = "# coherence: 2 um\n# wavelengths: 500 550 600 nm\n# gain: free\n# blur: 0.01\n"
    tri += angles.replace("R;G;B", "X;Y;Z") + "10;0;20;0;.2;.3;.4\n10;0;30;0;.2;.3;.1\n"
    return {
        "npz": written("a.npz", data.save),
        "csv": written("a.csv", data.save),
        "csv srgb": single("a.csv", colours),
        "csv xyz": single("a.csv", tri),
    }


# --- scenes and their parts ----------------------------------------------------------------


def sky() -> np.ndarray:
    return np.linspace(0.1, 2.0, 4 * 8 * 3).reshape(4, 8, 3).astype(np.float32)


def radiance_hdr(packed: bool) -> bytes:
    rng = np.random.default_rng(3)
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 4 +X 8\n"
    rows = rng.integers(60, 140, (4, 4, 8), dtype=np.uint8)
    if not packed:
        return head + rows.transpose(0, 2, 1).tobytes()
    body = b""
    for row in rows:
        body += b"\x02\x02\x00\x08"
        for channel in row:
            body += bytes([4]) + channel[:4].tobytes() + bytes([128 + 4, channel[4]])
    return head + body


def open_exr(path: Path) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGB": np.ascontiguousarray(sky())}) as file:
        file.write(str(path))


def load_map(path: Path) -> Any:
    from diffopt.scenes.assets import load_environment

    return load_environment(path)


def load_texture(path: Path, **options: Any) -> Any:
    from diffopt.scenes.assets import load_texture as load

    return load(path, **options)


def colours() -> np.ndarray:
    return np.random.default_rng(4).integers(1, 255, (4, 8, 3), dtype=np.uint8)


def maps() -> dict[str, Seed]:
    return {
        "hdr": single("a.hdr", radiance_hdr(packed=False)),
        "hdr packed": single("a.hdr", radiance_hdr(packed=True)),
        "png": single("a.png", picture(colours(), "PNG")),
        "npy": single("a.npy", npy(sky())),
    }


def exr() -> dict[str, Seed]:
    return {"exr": written("a.exr", open_exr)}


def textures() -> dict[str, Seed]:
    return {
        "srgb": single("a.png", picture(colours(), "PNG")),
        "linear": single("a.png", picture(colours(), "PNG"), space="linear"),
        "grey": single("a.png", picture(grey(np.uint8), "PNG")),
        "npy": single("a.npy", npy(sky()[..., 0])),
    }


def load_mesh(path: Path) -> Any:
    from diffopt.scenes import meshfiles

    return meshfiles.load(path)


def solid(kind: str, **more: Any) -> Any:
    import trimesh

    return trimesh.creation.box().export(file_type=kind, **more)


def meshes() -> dict[str, Seed]:
    import trimesh
    from trimesh.visual import TextureVisuals

    obj = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0.5\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    obj += "usemtl one\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    gltf = dict(solid("gltf"))
    named = next(name for name in gltf if name.endswith(".gltf"))
    textured = trimesh.creation.box()
    textured.visual = TextureVisuals(uv=np.asarray(textured.vertices)[:, :2])
    glb: Any = textured.export(file_type="glb")
    return {
        "ply": single("a.ply", solid("ply")),
        "ply text": single("a.ply", solid("ply", encoding="ascii")),
        "stl": single("a.stl", solid("stl")),
        "stl text": single("a.stl", solid("stl_ascii")),
        "off": single("a.off", solid("off")),
        "obj": Seed({"a.obj": obj.encode(), "a.mtl": b"newmtl one\nKd 1 0 0\n"}, "a.obj"),
        "glb": single("a.glb", glb),
        "gltf": Seed(gltf, named),
    }


SCENE = """\
[scene]
# wavelengths = { from = 0.4, to = 0.7, step = 0.1 }

[camera]
eye = [0, -6, 2]
target = [0, 0, 1]
resolution = [32, 24]
field_of_view = 40

[materials.brass]
kind = "gold"
alpha = 0.15
[materials.felt]
file = "felt.csv"
[materials.paint]
kind = "sum"
parts = ["felt", { kind = "phong", colour = 0.2 }]
[materials.dark]
kind = "scaled"
material = "paint"
factor = [0.5, 0.2, 0.1]

[[objects]]
name = "ball"
shape = "sphere"
radius = 0.5
material = "felt"
translate = [0, 0, 0.5]
rotate = [[0, 0, 1, 30]]
[[objects]]
shape = "mesh"
file = "box.ply"
material = "dark"
scale = 0.5
[[objects]]
shape = "plane"
width = 4
height = 4
material = "lambert"
texture = { checks = [0.8, 0.2], repeat = [4, 4] }
emission = [1, 2, 3]
[[objects]]
shape = "torus"
radius = 1.0
tube = 0.4
around = 8
across = 5
material = "plastic"

[[lights]]
kind = "area"
radiance = 8
temperature = 3200
width = 1
facing = { origin = [0, 0, 4], target = [0, 0, 0], up = [0, 1, 0] }
[[lights]]
kind = "environment"
file = "sky.npy"
[[lights]]
kind = "flood"
aim = [0, 0, -1]
position = [0, 0, 3]
exponent = 3
falloff = { a = 1, m = 2, b = 0.1 }

[render]
level = "path"
spp = 64
"""
SPECTRAL = """\
[scene]
wavelengths = [0.45, 0.55, 0.65]
[materials.wood]
kind = "phong"
[[objects]]
shape = "disc"
material = { kind = "lambert", colour = [0.1, 0.5, 0.2] }
matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.5], [0, 0, 0, 1]]
tangent = [1, 0, 0]
[[objects]]
shape = "plane"
material = "wood"
texture = { colour = "wood.png", repeat = [2, 2], space = "linear" }
[[lights]]
kind = "point"
position = [0, 0, 2]
illuminant = "A"
"""
LOBES = """\
[[objects]]
shape = "box"
size = [1, 2, 3]
material = "mirror"
[[lights]]
kind = "lobes"
file = "lamp.json"
[[lights]]
kind = "ambient"
radiance = [1, 1, 1]
"""


def load_scene(path: Path) -> Any:
    from diffopt.scenes import load_scene as load

    return load(path)


def scenes() -> dict[str, Seed]:
    lamp = lobes()["lobes json"].files["a.json"]
    parts = {
        "felt.csv": tables()["csv"].files["a.csv"],
        "box.ply": solid("ply"),
        "sky.npy": npy(sky()),
    }
    wood = {"wood.png": picture(colours(), "PNG")}
    return {
        "rgb": Seed({"a.toml": SCENE.encode(), **parts}, "a.toml"),
        "spectral": Seed({"a.toml": SPECTRAL.encode(), **wood}, "a.toml"),
        "lobes": Seed({"a.toml": LOBES.encode(), "lamp.json": lamp}, "a.toml"),
    }


# --- stores --------------------------------------------------------------------------------


def load_store(path: Path) -> Any:
    from diffopt import stores

    return stores.load_table(path)


def lookup() -> dict[str, Seed]:
    import jax.numpy as jnp

    from diffopt import stores
    from diffopt.lookup import Table

    ends = {name: jnp.zeros(3) for name in ("first", "low")}
    ends |= {name: jnp.ones(3) for name in ("step", "high")}
    values = np.random.default_rng(5).uniform(size=(4, 4, 4, 3))
    table = Table(
        jnp.asarray(values), **ends, order=3, prefactor="stam", shadowing="none", relative=False
    )
    return {"table": written("a.zarr", lambda path: stores.save(path, table, {"output": "xyz"}))}


def load_transfer(path: Path) -> Any:
    from diffopt.transfer import store

    store.record_of(path)
    return store.load(path)


def transfer() -> dict[str, Seed]:
    from diffopt import materials, scenes
    from diffopt.scenes import models
    from diffopt.transfer import store
    from diffopt.transfer.compression import CompressionSettings
    from diffopt.transfer.precomputation import precompute
    from diffopt.transfer.settings import TransferSettings

    ring = models.MODELS["torus"](radius=1.0, tube=0.4, around=4, across=3)
    scene = scenes.Scene([scenes.Object(ring, materials.Lambert(0.5))])
    found = precompute(scene, TransferSettings(rays=64, finest=1, splits=0, tolerance=1.0))

    def seed(settings: CompressionSettings) -> Seed:
        return written("a.zarr", lambda path: store.save(path, found, {}, settings))

    return {"exact": seed(CompressionSettings(0)), "packed": seed(CompressionSettings())}


#: All readers of files that a user may have got from somebody else.
READERS: dict[str, Reader] = {
    "heights: arrays": Reader(load_heights, arrays),
    "heights: pictures": Reader(load_heights, pictures),
    "heights: text": Reader(load_heights, texts),
    "heights: Gwyddion": Reader(load_heights, gwyddion),
    "heights: instruments": Reader(load_heights, instruments, 300),
    "materials: MERL": Reader(load_small_merl, merl),
    "materials: tensor files": Reader(load_named, tensors),
    "materials: tables": Reader(load_named, tables, 600),
    "lobes": Reader(load_lobes, lobes),
    "targets of lobes": Reader(load_target, targets),
    "measured reflectance": Reader(load_measured, reflectance),
    "environment maps": Reader(load_map, maps),
    "environment maps: EXR": Reader(load_map, exr),
    "textures": Reader(load_texture, textures),
    "meshes": Reader(load_mesh, meshes),
    "scenes": Reader(load_scene, scenes, 600),
    "stores: tables": Reader(load_store, lookup),
    "stores: transfer": Reader(load_transfer, transfer, 200),
}
