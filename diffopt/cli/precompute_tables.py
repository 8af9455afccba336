"""Figures of precomputed transfer beside those of the glossy-transfer paper."""

import dataclasses
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from diffopt.materials.base import Material
    from diffopt.scenes import SceneFile
    from diffopt.transfer.result import Transfer

# The paper computed on 8 cores at 3 GHz.
_CORES = 8
# Of a picture that frames are counted of, and how many of them.
_PIXELS, _FRAMES = 512, 5


@dataclasses.dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes
    ----------
    scene
        Name.
    initial, final
        Vertices before and after refinement.
    seconds
        By the clock.
    core_seconds
        Of all cores, for each vertex.
    megabytes
        Of the store.
    frames
        Relit in a second.
    """

    scene: str
    initial: int
    final: int
    seconds: float
    core_seconds: float
    megabytes: float
    frames: float


def _paper(name: str, initial: int, final: int, hours: float, size: float, frames: float) -> Row:
    seconds = 3600.0 * hours
    return Row(f"{name} (paper)", initial, final, seconds, seconds * _CORES / final, size, frames)


# Tables 1 and 2 of the paper, by the name of the example and the exponent.
_PAPER = {
    ("teapot", 4): _paper("teapot, 4", 2086, 9727, 2.1, 25.3, 453.0),
    ("teapot", 16): _paper("teapot, 16", 2086, 10496, 3.6, 39.3, 431.0),
    ("teapot", 32): _paper("teapot, 32", 2086, 11646, 4.1, 45.6, 403.0),
    ("teapot", 64): _paper("teapot, 64", 2086, 13724, 5.3, 57.9, 360.0),
    ("teapot", 128): _paper("teapot, 128", 2086, 17146, 21.8, 256.2, 281.0),
    ("buddha", 64): _paper("buddha, 64", 13997, 25998, 10.3, 99.8, 183.0),
    ("rabbit", 64): _paper("bunny, 64", 2602, 10326, 1.5, 19.0, 300.0),
}


def rows(path: Path, found: "SceneFile") -> list[Row]:
    """The line of a store, with its frames a second measured now, and those of the paper."""
    from diffopt.transfer import store

    record, transfer = store.record_of(path), store.load(path)
    name = str(record.get("scene", found.path.stem))
    exponents = sorted({e for one in found.scene.objects for e in _exponents(one.material)})
    final = int(record["vertices"]["final"])
    own = Row(
        ", ".join([name, *(f"{e:g}" for e in exponents)]),
        int(record["vertices"]["initial"]),
        final,
        float(record.get("seconds", math.nan)),
        float(record.get("core_seconds", math.nan)) / final,
        store.size(path) / 1e6,
        frames_a_second(transfer, found),
    )
    known = {key: row for key, row in _PAPER.items() if key[0] == name}
    same = [row for key, row in known.items() if key[1] in exponents]
    return [own, *(same or known.values())]


def _exponents(material: "Material | Any") -> list[float]:
    """Of the Phong and Blinn-Phong lobes in a material."""
    parts = [*getattr(material, "parts", ()), getattr(material, "material", None)]
    inner = [e for part in parts if part is not None for e in _exponents(part)]
    own = getattr(material, "exponent", None)
    return inner if own is None else [float(own), *inner]


def frames_a_second(transfer: "Transfer", found: "SceneFile") -> float:
    """Pictures of 512 x 512 pixels under a map of light, compiled, from the scene's camera."""
    import jax
    import numpy as np

    from diffopt.scenes.lights import Environment
    from diffopt.transfer import between, lighting, raster, relighting

    camera = dataclasses.replace(found.camera, resolution=(_PIXELS, _PIXELS))
    held = relighting.tables(transfer)
    seen = raster.Raster(transfer.mesh.vertices, transfer.triangles)(camera)
    # A sky with a sun: any map takes the same time.
    height = np.linspace(1.0, -1.0, 64)[:, None] + np.zeros((1, 128))
    height[12:15, 30:33] = 50.0
    sky = Environment(np.maximum(height, 0.1).astype(np.float32))
    light = lighting.prepare([sky], found.scene.channels)
    spent = []
    for _ in range(_FRAMES + 1):
        began = time.perf_counter()
        jax.block_until_ready(between.picture(held, light, seen))
        spent.append(time.perf_counter() - began)
    return 1.0 / sorted(spent[1:])[_FRAMES // 2]


def tell(found: list[Row], path: Path) -> None:
    """Print the table, the error of what is stored and the file."""
    import os

    from rich.table import Table

    from diffopt.cli.progress import terminal
    from diffopt.transfer import store

    console = terminal()
    table = Table(box=None, padding=(0, 2, 0, 0))
    titles = ("", "vertices", "refined", "time", "core s/vertex", "size", "frames/s")
    for title in titles:
        table.add_column(title, justify="right" if title else "left")
    for row in found:
        table.add_row(
            row.scene,
            str(row.initial),
            str(row.final),
            _duration(row.seconds),
            f"{row.core_seconds:.3g}",
            f"{row.megabytes:.3g} MB",
            f"{row.frames:.3g}",
        )
    console.print(table, markup=False)
    record = store.record_of(path)
    stored = record["compression"]
    raw = 2 * 5 * 3 * int(record["settings"]["lobes"]) * int(record["slices"]) / 1e6
    text = f"{record['slices']} slices, {raw:.3g} MB in 16 bits each"
    if stored["tolerance"]:
        error = stored["errors"]["views"]
        shares = (error["rms"], error["percentile_99"], error["largest"])
        rms, most, worst = (f"{100.0 * share:.2g} %" for share in shares)
        text += f"; stored within {rms} (rms; 99 % of them {most}, all {worst})"
        text += f", {100.0 * error['even']:.2g} % in even light"
    else:
        text += "; stored as computed"
    console.print(text, markup=False)
    if len(found) > 1:
        console.print(
            f"the paper: {_CORES} cores at 3 GHz, frames on a graphics card of 2009; here "
            f"{os.cpu_count()} cores, frames of {_PIXELS} x {_PIXELS} pixels",
            markup=False,
        )
    console.print(str(path), markup=False)


def _duration(seconds: float) -> str:
    if not seconds >= 120.0:
        return f"{seconds:.3g} s"
    return f"{seconds / 60.0:.3g} min" if seconds < 7200.0 else f"{seconds / 3600.0:.3g} h"


def write(found: list[Row], path: Path) -> None:
    """Write the table as comma-separated values."""
    import csv
    import io

    from diffopt.io.files import replacing

    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in dataclasses.fields(Row)])
    writer.writeheader()
    for row in found:
        writer.writerow(dataclasses.asdict(row))
    with replacing(path) as file:
        file.write(text.getvalue().encode())
