"""A mesh with colours of its vertices as binary glTF, to be shown as they are, without light."""

import json
import struct

import numpy as np

from diffopt.viewer import painting
from diffopt.viewer.subject import Coloured

# Numbers of the format (Khronos, glTF 2.0, sections 3.6.2 and 4.4).
_FLOAT, _UINT32, _UINT16 = 5126, 5125, 5123
_VERTICES, _INDICES = 34962, 34963


def encode(found: Coloured) -> bytes:
    """A file of one mesh; colours are linear in it, 16 bits each."""
    points = np.ascontiguousarray(found.vertices, "<f4")
    faces = np.ascontiguousarray(found.faces, "<u4")
    colours = np.full((len(points), 4), 65535, "<u2")
    colours[:, :3] = np.round(65535.0 * painting.linear(found.colours))
    parts = (points.tobytes(), faces.tobytes(), colours.tobytes())
    starts = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target}
        for start, part, target in zip(
            starts, parts, (_VERTICES, _INDICES, _VERTICES), strict=False
        )
    ]
    document = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1, "material": 0}
                ]
            }
        ],
        "materials": [{"doubleSided": True, "extensions": {"KHR_materials_unlit": {}}}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": _FLOAT,
                "count": len(points),
                "type": "VEC3",
                "min": points.min(0).tolist(),
                "max": points.max(0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": _UINT32,
                "count": int(faces.size),
                "type": "SCALAR",
            },
            {
                "bufferView": 2,
                "componentType": _UINT16,
                "normalized": True,
                "count": len(points),
                "type": "VEC4",
            },
        ],
        "bufferViews": views,
        "buffers": [{"byteLength": starts[-1]}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(parts)
    binary += b"\0" * (-len(binary) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(binary))
    return b"".join(
        [
            head,
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(binary), b"BIN\0"),
            binary,
        ]
    )
