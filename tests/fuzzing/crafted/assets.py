"""Environment maps and meshes, with what meshes name."""

import json
import struct
from typing import Any

import numpy as np

from fuzzing.crafted.base import PIPE, Crafted, arrays_of, strange
from fuzzing.crafted.pictures import pictures_of
from fuzzing.readers import assets
from fuzzing.readers.base import Seed, single


def maps() -> dict[str, Crafted]:
    def hdr(size: str, body: bytes = b"\x02\x02\x00\x08" + bytes(200)) -> bytes:
        return b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n" + size.encode() + b"\n" + body

    found = {
        "terabytes": hdr("-Y 1000000 +X 20000"),
        "more than 64 bits": hdr(f"-Y {'9' * 30} +X 8"),
        "digits": hdr(f"-Y {'9' * 5000} +X 8"),
        "below 0": hdr("-Y -4 +X 8"),
        "nothing": hdr("-Y 0 +X 8"),
        "runs of nothing": hdr("-Y 4 +X 8", b"\x02\x02\x00\x08" + b"\x80\x00" * 60),
        "a head without end": b"#?RADIANCE\n" * 100_000,
    }
    cases = {f"hdr: {k}": Crafted(single("a.hdr", v)) for k, v in found.items()}
    return cases | pictures_of() | arrays_of(".npy", ("",)) | strange("a.hdr") | strange("a.npy")


def exr() -> dict[str, Crafted]:
    content = assets.exr()["exr"].files["a.exr"]
    cases = {}
    for label, window in {
        "terabytes": (0, 0, 10**6, 10**6),
        "all of 32 bits": (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1),
        "turned round": (10, 10, 0, 0),
        "one wide": (0, 0, 2**31 - 2, 0),
    }.items():
        at = content.index(b"dataWindow\0box2i\0") + 17 + 4
        changed = content[:at] + struct.pack("<4i", *window) + content[at + 16 :]
        cases[label] = Crafted(single("a.exr", changed))
    return cases | strange("a.exr")


def gltf(**changes: Any) -> dict[str, Any]:
    """A triangle whose numbers stand in the text."""
    import base64

    data = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    tree = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": uri}],
    }
    return tree | changes


def meshes() -> dict[str, Crafted]:
    def tree(**changes: Any) -> Seed:
        return single("a.gltf", json.dumps(gltf(**changes)))

    zero = [{"componentType": 5126, "count": 10**12, "type": "MAT4"}]
    many = [{"children": [k + 1, k + 1]} for k in range(40)] + [{"mesh": 0}]
    diamond = [{"children": [2 * k + 1, 2 * k + 2]} for k in range(40)]
    shared = [{"children": [k + 1, 41 + k]} for k in range(40)] + [{"mesh": 0}]
    shared += [{"children": [k + 1]} for k in range(40)]
    names = {"up": "../secret.bin", "root": "/etc/passwd", "device": "/dev/zero", "pipe": "pipe"}
    names |= {"link": "link", "url": "http://127.0.0.1:9/a.bin", "proc": "/proc/self/environ"}
    ply = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\n"
    ply += "property float z\nelement face {}\nproperty list uchar int vertex_indices\nend_header\n"
    binary = "binary_little_endian"
    body = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    glb = b"glTF" + struct.pack("<III4s", 2, 1000, 2**32 - 4, b"JSON") + b"{}"
    found = {
        "gltf: terabytes of nothing": tree(accessors=zero),
        "gltf: count below 0": tree(accessors=[gltf()["accessors"][0] | {"count": -3}]),
        "gltf: doubled 40 times": tree(nodes=many),
        "gltf: many ways": tree(nodes=shared),
        "gltf: children that are none": tree(nodes=diamond),
        "gltf: nested deep": single("a.gltf", "[" * 100_000),
        "glb: a chunk of gigabytes": single("a.glb", glb),
        "ply: terabytes": single("a.ply", ply.format("ascii", 10**12, 10**12) + body),
        "ply: binary terabytes": single("a.ply", ply.format(binary, 10**12, 10**12) + body),
        "ply: below 0": single("a.ply", ply.format(binary, -3, -1) + body),
        "stl: 4 10^9 faces": single("a.stl", bytes(80) + b"\xff\xff\xff\xff" + bytes(100)),
        "off: terabytes": single("a.off", f"OFF\n{10**12} {10**12} 0\n{body}"),
        "obj: far corners": single("a.obj", f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 {10**18}\n"),
        "obj: megabytes of a word": single("a.obj", "v 0 0 0\n" + "f" * 1_000_000),
        "obj: nan": single("a.obj", "v nan 0 0\nv 1 0 0\nv 0 inf 0\nf 1 2 3\n"),
    }
    cases = {k: Crafted(v) for k, v in found.items()}
    circle = tree(nodes=[{"mesh": 0, "children": [1]}, {"children": [0]}])
    cases["gltf: a circle"] = Crafted(circle, harmless=True)
    links: dict[str, str | int] = {"pipe": PIPE, "link": "/etc/passwd"}
    for label, name in names.items():
        buffers = [{"byteLength": 36, "uri": name}]
        cases[f"gltf: buffer {label}"] = Crafted(tree(buffers=buffers), links)
        looks = {
            "images": [{"uri": name}],
            "textures": [{"source": 0}],
            "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        }
        primitive = {"attributes": {"POSITION": 0}, "material": 0}
        pictured = tree(**looks, meshes=[{"primitives": [primitive]}])
        # Pictures do not matter here: whether they can be had is all the same.
        cases[f"gltf: picture {label}"] = Crafted(pictured, links, harmless=True)
        triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n"
        obj = Seed({"a.obj": f"mtllib {name}\n{triangle}".encode()}, "a.obj")
        cases[f"obj: material {label}"] = Crafted(obj, links, harmless=True)
        texture = ply.format("ascii", 3, 1).replace("1.0\n", f"1.0\ncomment TextureFile {name}\n")
        textured = single("a.ply", texture + body)
        cases[f"ply: picture {label}"] = Crafted(textured, links, harmless=True)
    return cases | strange("a.ply") | strange("a.obj") | strange("a.glb")
