"""Files made to do harm: promises of terabytes, bombs, pickles, pipes, names that lead elsewhere.

For each reader some folders; all of them must be refused, but for those that say otherwise.
"""

import dataclasses
import io
import json
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import fuzz_readers
import numpy as np
from fuzz_readers import Seed, npz, single

#: Kinds of content of a folder beside bytes: a pipe, a link to a path, so many bytes of a hole.
PIPE = "pipe"


@dataclasses.dataclass(frozen=True)
class Crafted:
    """A folder that does harm to a careless reader.

    Attributes
    ----------
    seed
        Its files.
    others
        What is no plain file, by its name: `PIPE`, the target of a link, or a size.
    harmless
        Whether it may be read.
    """

    seed: Seed
    others: dict[str, str | int] = dataclasses.field(default_factory=dict)
    harmless: bool = False


class Mischief:
    """Unpickled it makes a folder."""

    def __reduce__(self) -> tuple[Any, ...]:
        import os

        return os.mkdir, ("unpickled",)


def zeros(megabytes: int) -> bytes:
    """Deflated zeros, made without holding them: blocks that stand alone are repeated."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    return block * megabytes + packer.flush()


def wrapped(raw: bytes) -> bytes:
    """Deflated data as zlib has them; the checksum, which is at the end, does not fit."""
    return b"\x78\x9c" + raw + bytes(4)


def npy_header(shape: Any, kind: str = "<f8") -> bytes:
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}}}".encode()
    text += b" " * (63 - (10 + len(text)) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def member(name: str, packed: bytes, size: int) -> bytes:
    """A ZIP archive of one deflated member that claims so many bytes."""
    size = min(size, 2**32 - 2)
    fields = struct.pack("<HHHHHIII", 20, 0, 8, 0, 0, 0, len(packed), size)
    name_ = name.encode()
    local = b"PK\x03\x04" + fields + struct.pack("<HH", len(name_), 0) + name_
    central = b"PK\x01\x02" + struct.pack("<H", 20) + fields
    central += struct.pack("<HHHHHII", len(name_), 0, 0, 0, 0, 0, 0) + name_
    end = b"PK\x05\x06" + struct.pack("<4H2IH", 0, 0, 1, 1, len(central), len(local + packed), 0)
    return local + packed + central + end


def npz_bomb(megabytes: int, name: str = "z") -> bytes:
    """Zeros of 2^20 bytes each, after the header of an array that holds them."""
    head = npy_header((megabytes, 131072))
    start = zlib.compressobj(9, zlib.DEFLATED, -15)
    first = start.compress(head) + start.flush(zlib.Z_FULL_FLUSH)
    return member(f"{name}.npy", first + zeros(megabytes), len(head) + 2**20 * megabytes)


def archive(**members: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(f"{name}.npy", content)
    return out.getvalue()


def objects() -> bytes:
    out = io.BytesIO()
    np.save(out, np.array([Mischief()], dtype=object), allow_pickle=True)
    return out.getvalue()


def arrays_of(suffix: str, names: tuple[str, ...], **options: Any) -> dict[str, Crafted]:
    """Of an array or an archive with these members."""
    one, first = suffix == ".npy", names[0]
    wrap: Callable[[bytes], bytes] = (
        (lambda raw: raw) if one else lambda raw: archive(**dict.fromkeys(names, raw))
    )
    found = {
        "promises terabytes": wrap(npy_header((10**6, 10**6)) + bytes(64)),
        "promises more than 64 bits": wrap(npy_header((2**62, 2**62, 7)) + bytes(64)),
        "a side below 0": wrap(npy_header((-1, 8)) + bytes(64)),
        "nothing, of terabytes": wrap(npy_header((0, 2**62)) + bytes(64)),
        "items of no size": wrap(npy_header((2**40, 8), "|S0") + bytes(64)),
        "a pickle": wrap(objects()),
        "a bare pickle": pickle.dumps(Mischief()),
        "header of code": wrap(npy_header("__import__('os').mkdir('ran')")),
        "header of brackets": wrap(npy_header("(" * 9000)),
    }
    if not one:
        found["bomb"] = npz_bomb(3000, first)
        found["member claims 4 GB"] = member(f"{first}.npy", zeros(1), 2**32 - 2)
        found["member claims less"] = member(f"{first}.npy", zeros(2000), 2000)
        found["pickle as a member"] = archive(**dict.fromkeys(names, pickle.dumps(Mischief())))
    cases = {k: Crafted(single(f"a{suffix}", v, **options)) for k, v in found.items()}
    return {f"{suffix}: {k}": v for k, v in cases.items()}


def strange(name: str, **options: Any) -> dict[str, Crafted]:
    """What is no plain file, under a name that a reader takes."""
    empty = Seed({}, name, options)
    return {
        f"{name}: a pipe": Crafted(empty, {name: PIPE}),
        f"{name}: an endless device": Crafted(empty, {name: "/dev/zero"}),
        f"{name}: a text of the system": Crafted(empty, {name: "/proc/self/environ"}),
        f"{name}: a link to itself": Crafted(empty, {name: name}),
        f"{name}: a link to nothing": Crafted(empty, {name: "nowhere"}),
        f"{name}: a folder": Crafted(Seed({f"{name}/x": b"x"}, name, options)),
        f"{name}: a terabyte": Crafted(empty, {name: 2**40}),
    }


def chunk(name: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))


def png(width: int, height: int, *chunks: bytes, depth: int = 8) -> bytes:
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + b"".join(chunks) + chunk(b"IEND", b"")


def pictures_of(**options: Any) -> dict[str, Crafted]:
    small = chunk(b"IDAT", zlib.compress(bytes(20)))
    bomb = wrapped(zeros(1500))
    found = {
        "promises 10^10 pixels": png(100_000, 100_000, small),
        "promises 10^18 pixels": png(2**31 - 1, 2**31 - 1, small),
        "text of gigabytes": png(4, 4, chunk(b"zTXt", b"a\0\0" + bomb), small),
        "profile of gigabytes": png(4, 4, chunk(b"iCCP", b"a\0\0" + bomb), small),
        "no pixels": png(0, 4, small),
    }
    cases = {f"png: {k}": Crafted(single("a.png", v, **options)) for k, v in found.items()}
    more = single("a.png", png(4, 4, chunk(b"IDAT", bomb)), **options)
    return cases | {"png: pixels of gigabytes": Crafted(more, harmless=True)}


def tiff(width: int, height: int, strip: bytes, compression: int, **entries: int) -> bytes:
    """A page of one strip, 8 bits."""
    tags = {256: width, 257: height, 258: 8, 259: compression, 262: 1, 273: 0, 277: 1}
    tags |= {278: min(height, 2**32 - 1), 279: len(strip)}
    start = 8 + 2 + 12 * len(tags) + 4
    tags[273] = start
    body = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in sorted(tags.items()))
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + body + bytes(4) + strip


def heights_of_pictures() -> dict[str, Crafted]:
    grey = fuzz_readers.GREY
    pages = {
        "promises terabytes": tiff(10**6, 10**6, bytes(100), 1),
        "promises 10^19": tiff(2**32 - 1, 2**32 - 1, zlib.compress(bytes(100)), 8),
        "strip of gigabytes": tiff(4, 4, wrapped(zeros(1500)), 8),
        "wide and compressed": tiff(40_000, 40_000, wrapped(zeros(1500)), 8),
        "pages in a circle": b"II*\0" + struct.pack("<IHI", 8, 0, 8),
    }
    found = {f"tiff: {k}": Crafted(single("a.tif", v, **grey)) for k, v in pages.items()}
    return pictures_of(**grey) | found | strange("a.png", **grey) | strange("a.tif", **grey)


def heights_of_text() -> dict[str, Crafted]:
    bare = fuzz_readers.BARE
    texts = {
        "width without end": "# Width: " + "1" * 60_000 + " x x\n1 2\n3 4\n",
        "a channel of blanks": "# Channel: x" + " " * 60_000 + "x\n1 2\n3 a\n",
        "one long line": "1 " * 500_000 + "\n2 3\n",
        "digits": "9" * 1_000_000 + " 1\n2 3\n",
        "infinite numbers": "1e999 1\n2 3\n",
        "width of nothing": "# Width: 0 um\n# Height: 0 um\n# Value units: nm\n1 2\n3 4\n",
        "size that is no number": "# Width: 1e1e1 um\n# Height: e um\n1 2\n3 4\n",
    }
    found = {
        # A comment that says nothing does no harm.
        k: Crafted(single("a.txt", v, **bare), harmless=k.startswith("width without"))
        for k, v in texts.items()
    }
    far = "0 0 1\n1 0 1\n1e-300 1e300 2\n1e300 1e-300 3\n"
    grid = "".join(f"{k} {k} 1\n" for k in range(30_000))
    found["xyz: far apart"] = Crafted(single("a.xyz", far, height_unit="um"))
    found["xyz: a diagonal"] = Crafted(single("a.xyz", grid, height_unit="um"))
    return found | strange("a.txt", **bare)


def gwyddion() -> dict[str, Crafted]:
    def component(name: bytes, kind: bytes, data: bytes) -> bytes:
        return name + b"\0" + kind + data

    def gwy(body: bytes) -> bytes:
        return b"GWYPGwyContainer\0" + struct.pack("<I", len(body)) + body

    deep = b""
    for _ in range(3000):
        inner = b"GwyContainer\0" + struct.pack("<I", len(deep)) + deep
        deep = component(b"a", b"o", inner)
    found = {
        "objects in objects": gwy(deep),
        "10^9 texts": gwy(component(b"a", b"S", struct.pack("<I", 2**32 - 1) + b"a\0")),
        "10^9 objects": gwy(component(b"a", b"O", struct.pack("<I", 2**32 - 1))),
        "10^9 numbers": gwy(component(b"/0/data", b"D", struct.pack("<I", 2**32 - 1))),
    }
    return {k: Crafted(single("a.gwy", v)) for k, v in found.items()} | strange("a.gwy")


def instruments() -> dict[str, Crafted]:
    surf = bytearray(fuzz_readers.digital_surf())
    at = 12 + 8 + 60 + 10 + 8 + 2 + 8
    surf[at : at + 8] = struct.pack("<2i", 2**31 - 1, 2**31 - 1)
    laughs = '<?xml version="1.0"?><!DOCTYPE z [<!ENTITY a0 "ha">'
    for k in range(1, 40):
        laughs += f'<!ENTITY a{k} "&a{k - 1};&a{k - 1};">'
    laughs += "]><z>&a39;</z>"
    outside = (
        '<?xml version="1.0"?><!DOCTYPE z [<!ENTITY a SYSTEM "file:///etc/passwd">]><z>&a;</z>'
    )

    def x3p(text: str) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as file:
            file.writestr("main.xml", text)
        return out.getvalue()

    found = {
        "sur of terabytes": single("a.sur", bytes(surf)),
        "entities": single("a.x3p", x3p(laughs)),
        "entity of a file": single("a.x3p", x3p(outside)),
        "archive of gigabytes": single("a.x3p", member("main.xml", zeros(2000), 2**31)),
        "npy of terabytes": single("a.dat", npy_header((10**6, 10**6)), **fuzz_readers.BARE),
        "npz of gigabytes": single("a.dat", npz_bomb(3000), **fuzz_readers.BARE),
        "npy of objects": single("a.dat", objects(), **fuzz_readers.BARE),
        "pickle": single("a.spm", pickle.dumps(Mischief())),
    }
    return {k: Crafted(v) for k, v in found.items()} | strange("a.sur")


def tensor_files() -> dict[str, Crafted]:
    def field(name: bytes, axes: int, kind: int, offset: int, shape: tuple[int, ...]) -> bytes:
        head = struct.pack("<H", len(name)) + name + struct.pack("<HBQ", axes, kind, offset)
        return head + struct.pack(f"<{len(shape)}Q", *shape)

    def file(count: int, *fields: bytes) -> bytes:
        return struct.pack("<12s2BI", b"tensor_file\0", 1, 0, count) + b"".join(fields) + bytes(64)

    found = {
        "terabytes": file(1, field(b"phi_i", 2, 11, 40, (2**20, 2**20))),
        "100 axes": file(1, field(b"phi_i", 100, 11, 40, (1,) * 100)),
        "nothing, of terabytes": file(1, field(b"phi_i", 2, 11, 40, (0, 2**63))),
        "4 10^9 fields": file(2**32 - 1, field(b"phi_i", 1, 11, 40, (1,))),
        "place beyond the file": file(1, field(b"phi_i", 1, 11, 2**63, (0,))),
    }
    cases = {k: Crafted(single("a.bsdf", v)) for k, v in found.items()}
    return cases | strange("a.bsdf") | strange("a.pbsdf")


def tables() -> dict[str, Crafted]:
    head = "theta_i,phi_i,theta_o,phi_o,f\n"
    found = {
        "a cell of megabytes": head + "1" * 200_000 + ",0,0,0,1\n30,0,30,0,1\n",
        "an open quote": head + '30,0,30,180,"1\n60,0,30,180,.1\n"\n',
        "an open quote at the end": head + '30,0,30,180,.1\n60,0,30,180,"1\n1,1,1,1,1\n',
        "columns": ",".join(f"c{k}" for k in range(50_000)) + "\n" + "1," * 49_999 + "1\n",
        "wavelengths": "theta_i,phi_i,theta_o,phi_o," + "9" * 400 + "nm\n0,0,0,0,1\n1,0,1,0,1\n",
    }
    cases = {k: Crafted(single("a.csv", v)) for k, v in found.items()}
    names = (*fuzz_readers.goniometer(),)
    return cases | arrays_of(".npz", names) | strange("a.csv") | strange("a.npz")


def lobes() -> dict[str, Crafted]:
    deep = '{"lobes": {"alpha": ' + "[" * 100_000
    found = {
        "nested deep": deep,
        "numbers of digits": '{"lobes": {"alpha": [' + "9" * 100_000 + "]}}",
        "ragged": '{"lobes": {"alpha": [[1], 2], "mu": [[0, 0, 1]], "kappa": [1]}}',
    }
    cases = {k: Crafted(single("a.json", v)) for k, v in found.items()}
    return cases | arrays_of(".npz", ("alpha", "mu", "kappa")) | strange("a.json")


def reflectance() -> dict[str, Crafted]:
    head = "# coherence: 2.0 um\n# quantity: spectral\n"
    names = "theta_i_deg,phi_i_deg,theta_o_deg,phi_o_deg,450 nm\n"
    found = {
        "a key of blanks": "# a: x" + " " * 60_000 + "x\n" + head + names + "10,0,20,0,1\n",
        "a cell of megabytes": head + names + "1" * 200_000 + ",0,20,0,1\n",
        "an open quote": head + names + '10,0,20,0,"1\n10,0,30,0,1\n',
        "exponent": head.replace("2.0", "1e999999999") + names + "10,0,20,0,1\n",
        "wavelength": head + names.replace("450", "1e99999999") + "10,0,20,0,1\n",
        "infinite": head.replace("2.0", "1e400") + names + "10,0,20,0,1\n",
    }
    cases = {k: Crafted(single("a.csv", v)) for k, v in found.items()}
    ways = np.array([[0.0, 0.0, 1.0]])
    deep = npz(wi=ways, wo=ways, values=np.ones((1, 1)), attributes=np.array("[" * 100_000))
    cases["attributes nested deep"] = Crafted(single("a.npz", deep))
    return cases | arrays_of(".npz", ("wi", "wo", "values")) | strange("a.csv") | strange("a.npz")


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
    content = fuzz_readers.exr()["exr"].files["a.exr"]
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


def scenes() -> dict[str, Crafted]:
    ball = '[[objects]]\nshape = "sphere"\nmaterial = "lambert"\n'
    mesh = '[[objects]]\nshape = "mesh"\nmaterial = "lambert"\nfile = "{}"\n'

    def toml(text: str, **others: str | int) -> Crafted:
        return Crafted(single("a.toml", text), dict(others))

    doubled = "".join(
        f'[materials.m{k}]\nkind = "sum"\nparts = ["m{k + 1}", "m{k + 1}"]\n' for k in range(40)
    )
    doubled += '[materials.m40]\nkind = "lambert"\n[[objects]]\nshape = "sphere"\nmaterial = "m0"\n'
    sizes = {
        "torus": 'shape = "torus"\naround = 1000000\nacross = 1000000',
        "knot": 'shape = "knot"\naround = 2000000000\nacross = 1000',
        "teapot": 'shape = "teapot"\ndivisions = 100000',
        "rabbit": 'shape = "rabbit"\nsubdivisions = 60',
    }
    found = {
        "brackets": toml("a = " + "[" * 100_000),
        "tables in tables": toml("a = " + "{a = " * 5000 + "1" + "}" * 5000),
        "dots": toml("a." * 20_000 + "b = 1"),
        "a header of blanks": toml("[" + " " * 60_000 + "x"),
        "a header of blanks that ends": toml("[a" + " " * 60_000 + "b]"),
        "a key of blanks": toml("a" + " " * 60_000 + "b = 1"),
        "digits": toml(ball + "radius = " + "9" * 100_000),
        "400 digits": toml(ball + "radius = " + "9" * 400),
        "not a date": toml(ball + "radius = 2026-99-99"),
        "materials doubled": toml(doubled),
        "materials in materials": toml(
            ball.replace('"lambert"', '{kind = "scaled", material = ' * 600 + '"x"' + "}" * 600)
        ),
        "a circle": toml('[materials.a]\nkind = "scaled"\nmaterial = "a"\n' + ball),
        "NUL": toml(ball + 'name = "a\\u0000b"\nfile = "a\\u0000b"'),
        "a name of NUL": toml(mesh.format("a\\u0000b")),
        "a long name": toml(mesh.format("a" * 5000)),
        "a user that is none": toml(mesh.format("~nobody-here/a.ply")),
    }
    found |= {
        f"a {name} of gigabytes": toml(f'[[objects]]\nmaterial = "lambert"\n{words}\n')
        for name, words in sizes.items()
    }
    targets = {
        "device": "/dev/zero",
        "system": "/proc/self/environ",
        "memory": "/proc/self/mem",
        "passwords": "/etc/passwd",
        "up": "../../../../../../../../../etc/passwd",
        "itself": "a.toml",
        "folder": ".",
        "pipe": "pipe",
        "link": "link",
    }
    places = {
        "mesh": (".ply", mesh),
        "map": (".hdr", ball + '[[lights]]\nkind = "environment"\nfile = "{}"\n'),
        "lobes": (".json", ball + '[[lights]]\nkind = "lobes"\nfile = "{}"\n'),
        "material": (".csv", '[materials.a]\nfile = "{}"\n' + ball),
        "texture": (".png", ball + 'texture = {{ colour = "{}" }}\n'),
        "scan": (".txt", '[materials.a]\nkind = "diffraction"\nscan = "{}"\n' + ball),
    }
    for place, (suffix, text) in places.items():
        for label, target in targets.items():
            found[f"{place}: {label}"] = toml(text.format(target), pipe=PIPE, link="/etc/passwd")
        # By a link with the suffix that the reader wants.
        for label in ("device", "system", "passwords"):
            named = {f"a{suffix}": targets[label]}
            found[f"{place}: link to {label}"] = toml(text.format(f"a{suffix}"), **named)
        found[f"{place}: pipe {suffix}"] = toml(text.format(f"a{suffix}"), **{f"a{suffix}": PIPE})
        found[f"{place}: terabyte"] = toml(text.format(f"a{suffix}"), **{f"a{suffix}": 2**40})
    return found | strange("a.toml")


def changed(seed: Seed, name: str, change: Callable[[dict[str, Any]], None]) -> Seed:
    """A folder with one JSON text changed."""
    tree = json.loads(seed.files[name])
    change(tree)
    return dataclasses.replace(seed, files=seed.files | {name: json.dumps(tree).encode()})


def stores_of(seed: Seed, folder: str) -> dict[str, Crafted]:
    """Of a store with an array in this folder."""
    meta = f"{folder}/zarr.json"
    chunks = sorted(name for name in seed.files if name.startswith(f"{folder}/c"))
    first = chunks[0]
    rest = {k: v for k, v in seed.files.items() if k != first}
    sides = len(json.loads(seed.files[meta])["shape"])

    def huge(tree: dict[str, Any]) -> None:
        tree["shape"] = [10**6] * sides

    def huge_chunk(tree: dict[str, Any]) -> None:
        tree["shape"] = [10**6] * sides
        tree["chunk_grid"]["configuration"]["chunk_shape"] = [10**6] * sides

    def small_chunks(tree: dict[str, Any]) -> None:
        tree["shape"] = [10**9] * sides
        tree["chunk_grid"]["configuration"]["chunk_shape"] = [1] * sides

    def codec(name: str, **settings: Any) -> Callable[[dict[str, Any]], None]:
        def change(tree: dict[str, Any]) -> None:
            tree["codecs"] = [tree["codecs"][0], {"name": name, "configuration": settings}]

        return change

    import gzip

    packed = gzip.compress(bytes(2**20), mtime=0)
    version2 = {
        **{k: v for k, v in rest.items() if not k.startswith(f"{folder}/")},
        f"{folder}/.zarray": json.dumps(
            {
                "zarr_format": 2,
                "shape": [1],
                "chunks": [1],
                "dtype": "|O",
                "compressor": None,
                "filters": [{"id": "pickle", "protocol": 5}],
                "fill_value": None,
                "order": "C",
            }
        ).encode(),
        f"{folder}/0": pickle.dumps(Mischief()),
    }
    whole2 = {
        f"{seed.main}/.zgroup": b'{"zarr_format": 2}',
        f"{seed.main}/.zattrs": json.dumps(
            json.loads(seed.files[f"{seed.main}/zarr.json"])["attributes"]
        ).encode(),
        **{k: v for k, v in version2.items() if k.startswith(f"{folder}/")},
    }
    zstd = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 2**40) + b"\x01\x00\x00"
    blosc = b"\x02\x01\x21\x08" + struct.pack("<3I", 2**31 - 1, 2**20, 16)
    files = seed.files

    def with_chunk(content: bytes) -> Crafted:
        return Crafted(dataclasses.replace(seed, files=files | {first: content}))

    return {
        "terabytes in chunks": Crafted(changed(seed, meta, huge)),
        "a chunk of terabytes": Crafted(changed(seed, meta, huge_chunk)),
        "10^27 chunks": Crafted(changed(seed, meta, small_chunks)),
        "gzip": Crafted(
            dataclasses.replace(
                changed(seed, meta, codec("gzip", level=5)),
                files=changed(seed, meta, codec("gzip", level=5)).files | {first: packed * 3000},
            )
        ),
        "another codec": Crafted(changed(seed, meta, codec("numcodecs.bz2", level=5))),
        "zstd that claims a terabyte": with_chunk(zstd),
        "blosc that claims 2 GB": with_chunk(blosc),
        "pickles of version 2 within": Crafted(dataclasses.replace(seed, files=version2)),
        "pickles of version 2": Crafted(dataclasses.replace(seed, files=whole2)),
        "a chunk that is a pipe": Crafted(dataclasses.replace(seed, files=rest), {first: PIPE}),
        "a chunk that is a device": Crafted(
            dataclasses.replace(seed, files=rest), {first: "/dev/zero"}
        ),
        "a chunk of a terabyte": Crafted(dataclasses.replace(seed, files=rest), {first: 2**40}),
        "metadata nested deep": Crafted(
            dataclasses.replace(seed, files=files | {f"{seed.main}/zarr.json": b"[" * 100_000})
        ),
        "a file": Crafted(single(seed.main, b"nothing")),
    }


#: By the names of `fuzz_readers.READERS`.
CRAFTED: dict[str, Callable[[dict[str, Seed]], dict[str, Crafted]]] = {
    "heights: arrays": lambda _: (
        arrays_of(".npy", ("",), **fuzz_readers.BARE)
        | arrays_of(".npz", ("z",), **fuzz_readers.BARE)
        | strange("a.npy", **fuzz_readers.BARE)
        | strange("a.npz", **fuzz_readers.BARE)
    ),
    "heights: pictures": lambda _: heights_of_pictures(),
    "heights: text": lambda _: heights_of_text(),
    "heights: Gwyddion": lambda _: gwyddion(),
    "heights: instruments": lambda _: instruments(),
    "materials: MERL": lambda _: strange("a.binary"),
    "materials: tensor files": lambda _: tensor_files(),
    "materials: tables": lambda _: tables(),
    "lobes": lambda _: lobes(),
    "targets of lobes": lambda _: (
        arrays_of(".npy", ("",)) | arrays_of(".npz", ("directions",)) | strange("a.csv")
    ),
    "measured reflectance": lambda _: reflectance(),
    "environment maps": lambda _: maps(),
    "environment maps: EXR": lambda _: exr(),
    "textures": lambda _: pictures_of() | pictures_of(space="linear") | strange("a.png"),
    "meshes": lambda _: meshes(),
    "scenes": lambda _: scenes(),
    "stores: tables": lambda seeds: stores_of(seeds["table"], "a.zarr/coefficients"),
    "stores: transfer": lambda seeds: stores_of(seeds["exact"], "a.zarr/transfer/diffuse_mu"),
}
