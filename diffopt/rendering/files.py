"""Pictures as files: PNG by Pillow, EXR by OpenEXR, arrays by NumPy."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from diffopt.errors import InputError
from diffopt.io.files import one_line, openexr, replacing

if TYPE_CHECKING:
    from diffopt.rendering.images import Image


def png(image: "Image", path: Path, exposure: float | None) -> None:
    """Write sRGB."""
    import PIL.Image

    pixels = image.display(exposure)
    with replacing(path) as file:
        PIL.Image.fromarray(pixels).save(file, format="PNG")


def npz(image: "Image", path: Path, exposure: float | None) -> None:
    """Write the arrays, and how they were made."""
    del exposure
    names = ("radiance", "error", "depth", "normal", "object", "done")
    arrays: dict[str, Any] = {name: getattr(image, name) for name in names}
    arrays |= {f"layer {name}": part for name, part in image.layers.items()}
    lam = image.channels.wavelengths
    with replacing(path) as file:
        np.savez_compressed(
            file,
            **arrays,
            rgb=image.rgb,
            wavelengths=np.asarray([] if lam is None else lam),
            summary=np.asarray(json.dumps(image.summary())),
        )


def exr(image: "Image", path: Path, exposure: float | None) -> None:
    """Write linear RGB and all layers, in 32 bits."""
    del exposure
    library = openexr(path, "as .npz")
    layers = {name: image.rgb[..., k] for k, name in enumerate("RGB")}
    layers |= {f"N.{name}": image.normal[..., k] for k, name in enumerate("XYZ")}
    layers["Z"] = image.depth
    layers["object"] = image.object
    names = image.channels.names
    layers |= {f"error.{name}": image.error[..., k] for k, name in enumerate(names)}
    for effect, part in image.layers.items():
        linear = image.channels.rgb(part)
        layers |= {f"{effect}.{name}": linear[..., k] for k, name in enumerate("RGB")}
    if image.channels.wavelengths is not None:
        layers |= {f"S0.{name}": image.radiance[..., k] for k, name in enumerate(names)}
    header = {
        "compression": library.ZIP_COMPRESSION,
        "type": library.scanlineimage,
        "diffopt": json.dumps(image.summary()),
    }
    pixels = {name: np.ascontiguousarray(a, np.float32) for name, a in layers.items()}
    with replacing(path) as file:
        try:
            # The library writes to a name, not to an open file.
            library.File(header, pixels).write(file.name)
        except (RuntimeError, ValueError, OSError) as error:
            raise InputError(f"{path}: cannot be written: {one_line(error)}") from error
