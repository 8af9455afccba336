"""Cards of rendered pictures: as they are saved, and how they were made."""

import numpy as np

from diffopt.accuracy import output
from diffopt.previews import markup
from diffopt.previews.bundles import NoCardError
from diffopt.rendering.images import Image

#: Pixels of the page that a picture is wide, at least and at most.
WIDTHS = (240, 640)


def card(image: Image) -> markup.Markup:
    """HTML of a picture.

    Raises
    ------
    NoCardError
        If there are no pixels, or radiance is not finite where it is done.
    """
    if not image.done.size:
        raise NoCardError("it has no pixels")
    if not np.isfinite(image.radiance[image.done]).all():
        raise NoCardError("its radiance is not finite")
    h, w = image.radiance.shape[:2]
    summary = image.summary()
    shown = float(np.clip(w, *WIDTHS))
    alt = f"Rendered picture of {w} x {h} pixels, level {image.settings.level}"
    picture = markup.picture(_decimated(image.display()), alt, width=shown, most=markup.MOST)
    noise = float(summary["noise"])
    pairs = [
        ("size", f"{w} × {h} pixels"),
        ("level", image.settings.level),
        ("samples per pixel", str(image.settings.spp)),
        ("time", output.seconds(image.seconds)),
        ("standard error", f"{noise:.2%} of the mean luminance" if np.isfinite(noise) else "—"),
        ("exposure", markup.number(image.exposure(), 3)),
        ("channels", _channels(image)),
        ("objects", str(len(image.names))),
    ]
    notes = []
    if not image.done.all() or image.interrupted:
        share = f"{float(image.done.mean()):.0%} of the pixels are done"
        notes.append(markup.note(f"Interrupted: {share}." if image.interrupted else f"{share}."))
    return markup.card("Image", picture, markup.key_figures(pairs), *notes)


def _channels(image: Image) -> str:
    lam = image.channels.wavelengths
    if lam is None:
        return "linear RGB"
    return f"{len(lam)} wavelengths, {1000.0 * lam[0]:.4g} to {1000.0 * lam[-1]:.4g} nm"


def _decimated(pixels: np.ndarray) -> np.ndarray:
    """Means over blocks where a picture is far larger than it is shown."""
    step = -(-pixels.shape[1] // int(markup.DENSITY * WIDTHS[1]))
    step = max(1, min(step, *pixels.shape[:2]))
    if step == 1:
        return pixels
    h, w = (n // step for n in pixels.shape[:2])
    blocks = pixels[: h * step, : w * step].reshape(h, step, w, step, 3)
    return np.round(blocks.mean((1, 3), dtype=np.float32)).astype(np.uint8)
