"""Heights: pictures, texts, Gwyddion's files and those of instruments."""

import io
import pickle
import struct
import zipfile
import zlib

from fuzzing.crafted.base import (
    Crafted,
    Mischief,
    member,
    npy_header,
    npz_bomb,
    objects,
    strange,
    wrapped,
    zeros,
)
from fuzzing.crafted.pictures import pictures_of, tiff
from fuzzing.readers.base import BARE, GREY, single
from fuzzing.readers.heights import digital_surf


def pictures() -> dict[str, Crafted]:
    pages = {
        "promises terabytes": tiff(10**6, 10**6, bytes(100), 1),
        "promises 10^19": tiff(2**32 - 1, 2**32 - 1, zlib.compress(bytes(100)), 8),
        "strip of gigabytes": tiff(4, 4, wrapped(zeros(1500)), 8),
        "wide and compressed": tiff(40_000, 40_000, wrapped(zeros(1500)), 8),
        "pages in a circle": b"II*\0" + struct.pack("<IHI", 8, 0, 8),
    }
    found = {f"tiff: {k}": Crafted(single("a.tif", v, **GREY)) for k, v in pages.items()}
    return pictures_of(**GREY) | found | strange("a.png", **GREY) | strange("a.tif", **GREY)


def texts() -> dict[str, Crafted]:
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
        k: Crafted(single("a.txt", v, **BARE), harmless=k.startswith("width without"))
        for k, v in texts.items()
    }
    far = "0 0 1\n1 0 1\n1e-300 1e300 2\n1e300 1e-300 3\n"
    grid = "".join(f"{k} {k} 1\n" for k in range(30_000))
    found["xyz: far apart"] = Crafted(single("a.xyz", far, height_unit="um"))
    found["xyz: a diagonal"] = Crafted(single("a.xyz", grid, height_unit="um"))
    return found | strange("a.txt", **BARE)


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
    surf = bytearray(digital_surf())
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
        "npy of terabytes": single("a.dat", npy_header((10**6, 10**6)), **BARE),
        "npz of gigabytes": single("a.dat", npz_bomb(3000), **BARE),
        "npy of objects": single("a.dat", objects(), **BARE),
        "pickle": single("a.spm", pickle.dumps(Mischief())),
    }
    return {k: Crafted(v) for k, v in found.items()} | strange("a.sur")
