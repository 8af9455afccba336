"""What scenes name: environment maps, textures and meshes."""

from pathlib import Path
from typing import Any

import numpy as np

from fuzzing.readers.base import Seed, colours, grey, npy, picture, single, sky, written


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
